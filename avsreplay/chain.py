"""The path: one scan in, one row out. Read ``step`` and know the program.

scan -> register -> innovation -> verdict (gamma) -> estimate -> monitors -> plan -> row; the predicted pose goes back
to registration as its guess, the only loop; the last scan's word on convergence lets a fit give way to the filter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.config import Guess
from avsreplay.estimate import Estimator, Prediction, Track
from avsreplay.estimate.deskew import deskew, with_scan_duration
from avsreplay.fill import Findings, row_of
from avsreplay.geometry import Array, Pose
from avsreplay.monitor.faults import FaultDetector
from avsreplay.plan import Guidance, GuidanceState
from avsreplay.records import Alignment, Innovation, Scan, Verdict
from avsreplay.register import Registrar
from avsreplay.rows import Row
from avsreplay.sight import Aim, Hindsight, aim_columns, plan_columns, see
from avsreplay.watch import Monitors, Watch, look

__all__ = ["Memory", "Stages", "fold", "step"]

_SURE_OF_REACH, _SURE_RAD = 0.25, np.radians(15.0)


@dataclass(frozen=True, slots=True, eq=False)
class Sighted:
    """An alignment and where its guess came from: start, truth, given, predicted, last, acquired.

    Attributes:
        instants: (6, 6) when it was seen, by direction [s], see ``Registrar.instants``; None at the scan's own instant.
    """

    alignment: Alignment
    origin: str
    instants: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Stages:
    """The parts of the chain, ready.

    Attributes:
        hindsight: the only part that knows the truth; nothing it says goes back into the chain.
        standoff_c: (3,) approach point in {C} [m].
        reacquire: search without a guess where the prediction is no guess any more.
        first_pose: first scan -> T_ac to begin with (None: acquire it), and where it comes from.
    """

    registrar: Registrar
    estimator: Estimator
    detector: FaultDetector
    monitors: Monitors
    pilot: Guidance
    hindsight: Hindsight
    standoff_c: Array
    guess: Guess
    deskew: bool
    reference: str
    reacquire: bool
    first_pose: Callable[[Scan], tuple[Pose | None, str]]


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """What is carried from scan to scan.

    Attributes:
        watch: the monitors' memory.  pilot: plan in force and robot.  aim: the leg that closes in.
        track: the estimate, None before the first scan.
        last: last healthy measured pose, None before one.  origin: where the first pose came from.
        since_ns: instant of the first scan.
    """

    watch: Watch
    pilot: GuidanceState | None = None
    aim: Aim = field(default_factory=Aim)
    track: Track | None = None
    last: Pose | None = None
    origin: str = ""
    since_ns: int = 0


def step(stages: Stages, memory: Memory, scan: Scan) -> tuple[Memory, Row]:
    """One scan through the whole chain. A scan that goes wrong still leaves a row."""
    memory, track, begun = _track(stages, memory, scan)
    prediction = stages.estimator.predict(track, scan.t_ns)
    sighted = begun or _register(stages, memory, scan, prediction)
    prior, seen, verdict = _judge(stages, scan, prediction, sighted)
    if not verdict.gamma and _lost(stages, scan, prediction):
        sighted = _acquired(stages, scan, _still(stages, memory, scan, prediction), "acquired")
        prior, seen, verdict = _judge(stages, scan, prediction, sighted)
    track = stages.estimator.update(track, prior, seen, verdict.gamma, memory.watch.convergence.converged)

    watch, columns = look(stages.monitors, memory.watch, stages.estimator, prior, seen, verdict.gamma, track)
    converged = watch.convergence.converged
    sight = see(stages.estimator, track, scan.t_ns, verdict.gamma, converged, stages.standoff_c)
    before = memory.pilot or stages.pilot.initial(scan.t_ns)
    pilot = stages.pilot.step(before, sight)
    aim = memory.aim.follow(pilot, stages.estimator, track, stages.hindsight)
    columns |= plan_columns(pilot, memory.since_ns, scan.t_ns)
    columns |= aim_columns(memory.aim, aim, pilot.captured_ns is not before.captured_ns)
    row = row_of(
        Findings(
            scan=scan,
            since_ns=memory.since_ns,
            guess=sighted.origin,
            alignment=sighted.alignment,
            verdict=verdict,
            innovation=seen,
            belief=track.belief,
            estimator=track.mode,
            reference=stages.reference,
            converged=converged,
            columns=columns,
        )
    )
    last = sighted.alignment.T_ac if verdict.gamma else memory.last
    return replace(memory, watch=watch, pilot=pilot, aim=aim, track=track, last=last), row


def fold(stages: Stages, memory: Memory, scans: Iterable[Scan]) -> Iterator[tuple[Scan, Memory, Row]]:
    """Fold ``step`` over the scans, one at a time: what is held is one scan, not one log."""
    for scan in scans:
        memory, row = step(stages, memory, scan)
        yield scan, memory, row


def _track(stages: Stages, memory: Memory, scan: Scan) -> tuple[Memory, Track, Sighted | None]:
    """The track so far; at the first scan a new one. What was acquired is tried anew until a scan is healthy."""
    if memory.track is not None and not (memory.origin == "acquired" and memory.last is None):
        return memory, memory.track, None
    pose, origin = stages.first_pose(scan)
    begun = None
    if pose is None:
        begun = _acquired(stages, scan, scan.points, origin)
        pose = begun.alignment.T_ac
    since_ns = scan.t_ns if memory.track is None else memory.since_ns
    return replace(memory, origin=origin, since_ns=since_ns), stages.estimator.initial(scan.t_ns, pose), begun


def _register(stages: Stages, memory: Memory, scan: Scan, prediction: Prediction) -> Sighted:
    """The scan against the model, from the guess that the configuration asks for."""
    points = _still(stages, memory, scan, prediction)
    guess, origin = prediction.belief.x.T_ac, "predicted"
    if memory.last is None:
        origin = memory.origin
    elif stages.guess is Guess.LAST:
        guess, origin = memory.last, "last"
    return _sighted(stages, scan, points, stages.registrar.register(points, guess), origin)


def _acquired(stages: Stages, scan: Scan, points: NDArray[Any], origin: str) -> Sighted:
    """The scan's points against the model without a guess."""
    return _sighted(stages, scan, points, stages.registrar.acquire(points), origin)


def _sighted(stages: Stages, scan: Scan, points: NDArray[Any], alignment: Alignment, origin: str) -> Sighted:
    if scan.times_s is None or not (stages.deskew and alignment.measured):
        return Sighted(alignment, origin)
    return Sighted(alignment, origin, stages.registrar.instants(points, scan.times_s, alignment.T_ac))


def _judge(
    stages: Stages, scan: Scan, prediction: Prediction, sighted: Sighted
) -> tuple[Prediction, Innovation | None, Verdict]:
    """The prediction as this scan tests it, the innovation and the verdict."""
    if scan.times_s is not None and sighted.instants is not None:
        prediction = with_scan_duration(prediction, sighted.instants, scan.times_s)
    seen = stages.estimator.innovate(prediction, sighted.alignment) if sighted.alignment.measured else None
    return prediction, seen, stages.detector.judge(scan.status, sighted.alignment, seen, prediction.belief)


def _lost(stages: Stages, scan: Scan, prediction: Prediction) -> bool:
    """Is the predicted pose too unsure to be a guess: 3 sigma beyond a quarter of the reach, or beyond 15 deg?"""
    if not stages.reacquire or not len(scan.points):
        return False
    variance = np.diag(prediction.H @ prediction.belief.P @ prediction.H.T)
    position, half_angle = 3.0 * np.sqrt(variance[:3].sum()), 3.0 * np.sqrt(variance[3:].sum())
    return bool(position > _SURE_OF_REACH * stages.registrar.limits.reach_m or 2.0 * half_angle > _SURE_RAD)


def _still(stages: Stages, memory: Memory, scan: Scan, prediction: Prediction) -> NDArray[Any]:
    """The scan's points at one instant: carried by the prior's motion where they have times and there is a motion."""
    known = memory.last is not None or stages.estimator.start is not None
    if scan.times_s is None or not (stages.deskew and known):
        return scan.points
    return deskew(scan.points, scan.times_s, prediction)
