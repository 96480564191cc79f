"""Config and log header into ready stages: the only place where names become objects."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from avsreplay.chain import Memory, Stages
from avsreplay.config import RunConfig, parse_pose
from avsreplay.errors import UsageError
from avsreplay.estimate import Estimator
from avsreplay.estimate.params import Start
from avsreplay.geometry import Pose
from avsreplay.monitor.consistency import Consistency
from avsreplay.monitor.convergence import Convergence
from avsreplay.monitor.faults import FaultDetector
from avsreplay.monitor.observability import gramian
from avsreplay.plan import Guidance, Supervisor
from avsreplay.records import LogHeader, Scan, Surface
from avsreplay.register import Registrar
from avsreplay.sight import Hindsight
from avsreplay.watch import Monitors, Watch

__all__ = ["first_memory", "stages"]


def stages(
    config: RunConfig,
    header: LogHeader,
    surface: Surface,
    truth: Sequence[tuple[int, Pose]] = (),
    registrar: Registrar | None = None,
) -> Stages:
    """The chain for one log; ``truth`` (T_ac by instant) is for hindsight alone. A ``registrar`` may serve again.

    Raises:
        UsageError: no first pose is to be had.  MissingBackend: the back end is not installed.
    """
    start = header.start if config.init == "log" or config.estimator.start is Start.NEAR else None
    supervision = config.supervisor.resolved(surface.extent)
    return Stages(
        registrar=registrar or Registrar(surface, config.register),
        estimator=Estimator(config.estimator, start, surface.extent),
        detector=FaultDetector(config.faults, surface.extent),
        monitors=Monitors(Consistency(config.consistency), Convergence(config.convergence, surface.extent)),
        pilot=Guidance(config.plan, Supervisor(supervision)),
        hindsight=Hindsight(truth),
        standoff_c=(supervision.standoff_m or 0.0) * np.array(config.fixture_axis_c),
        guess=config.guess,
        deskew=config.deskew,
        reference=config.reference.value,
        reacquire=config.reacquire,
        first_pose=_first_pose(config, header),
    )


def first_memory(ready: Stages) -> Memory:
    """What the fold begins with."""
    start = ready.estimator.start
    prior_1s = ready.estimator.params.start_1s if start is None else np.sqrt(np.diag(start.P))
    monitors = ready.monitors
    watch = Watch(gramian(prior_1s), monitors.consistency.initial(), monitors.convergence.initial())
    return Memory(watch)


def _first_pose(config: RunConfig, header: LogHeader) -> Callable[[Scan], tuple[Pose | None, str]]:
    """Where the first pose comes from; "log" is the log's first belief, else its truth, else acquisition."""
    if config.init == "truth":
        return _truth
    if config.init == "auto":
        return _acquire
    if config.init == "log":
        start = header.start
        if start is not None:
            return lambda _scan: (start.x.T_ac, "start")
        return lambda scan: _acquire(scan) if scan.truth is None else (scan.truth, "truth")
    pose = parse_pose(config.init)
    return lambda _scan: (pose, "given")


def _acquire(_scan: Scan) -> tuple[Pose | None, str]:
    return None, "acquired"


def _truth(scan: Scan) -> tuple[Pose | None, str]:
    if scan.truth is None:
        hint = "name its truth with --truth-topic, or give --init auto"
        raise UsageError("the log has no true pose at its first scan", where="--init truth", hint=hint)
    return scan.truth, "truth"
