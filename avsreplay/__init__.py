"""avsreplay: record, replay and gate the chain of vision-guided capture. THE LAW of the package stands here.

Frames
    {A} camera, taken as inertial.  {B} principal axes of the target at its centre of mass.
    {C} grapple fixture, which is also the frame of the model.  ``T_ab`` takes coordinates in b to coordinates in a.
Quaternions
    ``[x y z w]``, unit, active: ``matrix(q_ab)`` takes b to a.  Code composes with Hamilton's product,
    ``q_ac = multiply(q_ab, q_bc)``; the paper's product has its factors exchanged, a (x) b = multiply(b, a).
Units
    SI and radians inside; degrees only where a person reads; a unit is the suffix of whatever leaves
    (``pos_err_m``, ``rot_err_deg``, ``t_go_s``).  Instants are integers ``t_ns``, spans float seconds.
State (20 error states, in this order everywhere)
    dq_v 0:3 (half angle), w 3:6, rho_o 6:9, v 9:12, sigma 12:14, varrho 14:17, dmu_v 17:20 (half angle);
    q = dq (x) q_hat, mu = mu_hat (x) dmu in the paper's product, all else additive.
Alignment error
    d = [theta; v] in {C} [rad, m], T_ac_true = T_ac @ Exp(d).
Sources
    F. Aghili, "Adaptive Visual Servo Control for Autonomous Robots"; its corrections are in ``docs/equations.md``.

Importing the package does nothing; the public names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avsreplay.config import RunConfig
    from avsreplay.errors import AvsError
    from avsreplay.rows import Row
    from avsreplay.run import Job, Run, replay

__version__ = "0.1.0"
__all__ = ["AvsError", "Job", "Row", "Run", "RunConfig", "__version__", "replay"]

_HOME = {"AvsError": "errors", "Job": "run", "Row": "rows", "Run": "run", "RunConfig": "config", "replay": "run"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
