"""Config and log header into ready stages: the only place where names become objects."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avsreplay.config import RunConfig, parse_pose
from avsreplay.errors import UsageError
from avsreplay.estimate import Estimator
from avsreplay.geometry import Pose
from avsreplay.mission import Mission
from avsreplay.monitor.consistency import Consistency
from avsreplay.monitor.convergence import Convergence
from avsreplay.monitor.faults import FaultDetector
from avsreplay.monitor.observability import gramian
from avsreplay.records import LogHeader, Scan, Surface
from avsreplay.register import Registrar
from avsreplay.replay import Memory, Stages
from avsreplay.watch import Monitors, Watch

__all__ = ["first_memory", "stages"]


def stages(config: RunConfig, header: LogHeader, surface: Surface) -> Stages:
    """The chain for one log.

    Raises:
        UsageError: no first pose is to be had.  MissingBackend: the back end is not installed.
    """
    registrar = Registrar(surface, config.register)
    start = header.start if config.init == "log" else None
    return Stages(
        registrar=registrar,
        estimator=Estimator(config.estimator, start, surface.extent),
        detector=FaultDetector(config.faults, surface.extent),
        monitors=Monitors(Consistency(config.consistency), Convergence(config.convergence, surface.extent)),
        plan=config.plan,
        guess=config.guess,
        first_pose=_first_pose(config, header),
    )


def first_memory(ready: Stages) -> Memory:
    """What the fold begins with."""
    start = ready.estimator.start
    prior_1s = ready.estimator.params.start_1s if start is None else np.sqrt(np.diag(start.P))
    monitors = ready.monitors
    watch = Watch(gramian(prior_1s), monitors.consistency.initial(), monitors.convergence.initial())
    return Memory(watch, Mission())


def _first_pose(config: RunConfig, header: LogHeader) -> Callable[[Scan], Pose]:
    if config.init == "truth":
        return _truth
    if config.init != "log":
        pose = parse_pose(config.init)
        return lambda _scan: pose
    if header.start is None:
        hint = "give --init truth or --init x,y,z,qx,qy,qz,qw"
        raise UsageError("the log says no first pose of the target", where="--init", hint=hint)
    pose = header.start.x.T_ac
    return lambda _scan: pose


def _truth(scan: Scan) -> Pose:
    if scan.truth is None:
        hint = "name it with --truth-topic, or give --init x,y,z,qx,qy,qz,qw"
        raise UsageError("the log has no true pose at its first scan", where="--init truth", hint=hint)
    return scan.truth
