"""The path: one scan in, one row out. Read ``step`` and know the program.

scan -> register -> innovation -> verdict (gamma) -> estimate -> monitors -> plan -> row; the predicted pose goes back
to registration as its guess, the only loop.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace

from avsreplay.config import Guess
from avsreplay.estimate import Estimator, Prediction, Track
from avsreplay.fill import Findings, row_of
from avsreplay.geometry import Array, Pose
from avsreplay.monitor.faults import FaultDetector
from avsreplay.plan import Pilot, PilotMemory
from avsreplay.records import Alignment, AlignStatus, Innovation, Scan
from avsreplay.register import Registrar
from avsreplay.rows import Row
from avsreplay.sight import Aim, Hindsight, aim_columns, plan_columns, see
from avsreplay.watch import Monitors, Watch, look

__all__ = ["Memory", "Stages", "fold", "step"]

_UNMEASURED = (AlignStatus.NO_POINTS, AlignStatus.NO_OVERLAP, AlignStatus.FAILED)


@dataclass(frozen=True, slots=True, eq=False)
class Stages:
    """The parts of the chain, ready.

    Attributes:
        hindsight: the only part that knows the truth; nothing it says goes back into the chain.
        standoff_c: (3,) approach point in {C} [m].
        first_pose: first scan -> T_ac to begin with, and where it comes from.
    """

    registrar: Registrar
    estimator: Estimator
    detector: FaultDetector
    monitors: Monitors
    pilot: Pilot
    hindsight: Hindsight
    standoff_c: Array
    guess: Guess
    first_pose: Callable[[Scan], tuple[Pose, str]]


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
    pilot: PilotMemory | None = None
    aim: Aim = field(default_factory=Aim)
    track: Track | None = None
    last: Pose | None = None
    origin: str = ""
    since_ns: int = 0


def step(stages: Stages, memory: Memory, scan: Scan) -> tuple[Memory, Row]:
    """One scan through the whole chain. A scan that goes wrong still leaves a row."""
    memory, track = _track(stages, memory, scan)
    prediction = stages.estimator.predict(track, scan.t_ns)
    guess, origin = _guess(stages, memory, prediction)

    alignment = stages.registrar.register(scan.points, guess)
    seen = _innovate(stages.estimator, prediction, alignment)
    verdict = stages.detector.judge(scan.status, alignment, seen, prediction.belief)
    track = stages.estimator.update(track, prediction, seen, verdict.gamma)

    watch, columns = look(stages.monitors, memory.watch, stages.estimator, prediction, seen, verdict.gamma, track)
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
            guess=origin,
            alignment=alignment,
            verdict=verdict,
            innovation=seen,
            belief=track.belief,
            estimator=track.mode,
            converged=converged,
            columns=columns,
        )
    )
    last = alignment.T_ac if verdict.gamma else memory.last
    return replace(memory, watch=watch, pilot=pilot, aim=aim, track=track, last=last), row


def fold(stages: Stages, memory: Memory, scans: Iterable[Scan]) -> Iterator[tuple[Memory, Row]]:
    """Fold ``step`` over the scans, one at a time: what is held is one scan, not one log."""
    for scan in scans:
        memory, row = step(stages, memory, scan)
        yield memory, row


def _track(stages: Stages, memory: Memory, scan: Scan) -> tuple[Memory, Track]:
    """The track so far; at the first scan a new one, with its origin noted."""
    if memory.track is not None:
        return memory, memory.track
    pose, origin = stages.first_pose(scan)
    return replace(memory, origin=origin, since_ns=scan.t_ns), stages.estimator.initial(scan.t_ns, pose)


def _guess(stages: Stages, memory: Memory, prediction: Prediction) -> tuple[Pose, str]:
    if memory.last is None:
        return prediction.belief.x.T_ac, memory.origin
    if stages.guess is Guess.LAST:
        return memory.last, "last"
    return prediction.belief.x.T_ac, "predicted"


def _innovate(estimator: Estimator, prediction: Prediction, alignment: Alignment) -> Innovation | None:
    return None if alignment.status in _UNMEASURED else estimator.innovate(prediction, alignment)
