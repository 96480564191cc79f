"""avsreplay: record and replay point-cloud logs through the processing chain of vision-guided
capture.

The conventions that hold in every module:

Frames {A} camera, assumed inertial.  {B} principal axes of the target, origin at its centre of
    mass. {C} grapple fixture; the model file uses this frame.  ``T_ab`` takes coordinates in b to
    coordinates in a.
Quaternions ``[x y z w]``, unit length, active: ``matrix(q_ab)`` takes b to a.  The code uses
    Hamilton's product, ``q_ac = multiply(q_ab, q_bc)``; the paper's product has the factors in the
    other order, a (x) b = multiply(b, a).
Units SI units and radians; degrees in output for people only. The names of all output values end
    with their unit (``pos_err_m``, ``rot_err_deg``, ``t_go_s``).  Instants are integer nanoseconds
    ``t_ns``, durations float seconds.
State (20 error states, always in this order) dq_v 0:3 (half angle), w 3:6, rho_o 6:9, v 9:12, sigma
    12:14, varrho 14:17, dmu_v 17:20 (half angle); q = dq (x) q_hat and mu = mu_hat (x) dmu in the
    paper's product; the other errors are additive.
Alignment error
    d = [theta; v] in {C} [rad, m], T_ac_true = T_ac @ Exp(d).
Source F. Aghili, "Adaptive Visual Servo Control for Autonomous Robots"; ``docs/equations.md`` lists
    the corrections.

Importing the package loads no other module; the public names are loaded when they are first used.
"""

from __future__ import annotations

# the command starts this package twice, and the module typing would be loaded for nothing
TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from typing import Any

    from avsreplay.config import RunConfig
    from avsreplay.errors import AvsError
    from avsreplay.rows import Row
    from avsreplay.run import Job, Run

__version__ = "0.1.0"
__all__ = ["AvsError", "Job", "Row", "Run", "RunConfig", "__version__", "replay"]

_HOME = {"AvsError": "errors", "Job": "run", "Row": "rows", "Run": "run", "RunConfig": "config"}


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if name == "arithmetic":  # the one module that must be available before numpy is imported
        return import_module(f"{__name__}.arithmetic")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def replay(source: str | Path, *assignments: str, **options: Any) -> Iterator[Row]:
    """Replay a log and yield one row for each scan.

    ``for row in avsreplay.replay("log.mcap", "faults.policy=all", n_scans=100): ...``

    Args:
        source: a log, a bag or a folder of scans.
        *assignments: settings ``a.b=c`` as for the option ``--set``.
        **options: how to read the log, as fields of ``log.SourceOptions``.

    Yields:
        The row of each scan, in the order of the log.

    Raises:
        AvsError: the log, the model or a setting cannot be used; its ``str`` is one line.
    """
    from pathlib import Path

    from avsreplay.log import SourceOptions
    from avsreplay.run import Job, Run

    with Run(
        Job(source=Path(source), options=SourceOptions(**options), assignments=assignments)
    ) as run:
        yield from run.rows()
