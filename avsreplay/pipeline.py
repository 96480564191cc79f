"""The processing chain: one scan in, one outcome out. Read ``step`` first.

scan -> registration -> innovation -> rules on the scan -> estimate, tracker -> verdict (gamma) ->
monitors -> guidance -> outcome. The predicted pose is the initial guess of the registration; that
is the only feedback, apart from the convergence flag of the previous scan, which lets the filter
take over from the batch fit. Nothing here has access to ground truth.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.aliasing import Turns, in_words, two_rates
from avsreplay.config import Guess
from avsreplay.errors import value_class
from avsreplay.estimate import Prediction, Track, after_change, in_doubt
from avsreplay.estimate.chart import body_parameters
from avsreplay.estimate.grasp_point import at_grasp
from avsreplay.estimate.kinematic import Motion, kinematic_track
from avsreplay.estimate.plugged import AnyEstimator
from avsreplay.estimate.reference import FittedMotion
from avsreplay.estimate.scan_duration import deskew, with_scan_duration
from avsreplay.estimate.track import moves
from avsreplay.geometry import Array, Pose
from avsreplay.monitor.convergence import (
    Consistency,
    ConsistencyTrack,
    Convergence,
    ConvergenceTrack,
    violations,
)
from avsreplay.monitor.fault_detection import Examined, FaultDetector
from avsreplay.monitor.gramian import Gramian, from_trajectory, measure, observe
from avsreplay.monitor.gramian import gramian as empty_gramian
from avsreplay.outcome import MonitorReport, Outcome
from avsreplay.plan.guidance import Guidance, GuidanceState, PlannerInput, Segment
from avsreplay.plan.limits import Scene, TargetGeometry
from avsreplay.plan.rendezvous import rendezvous
from avsreplay.records import (
    Admission,
    Alignment,
    AlignStatus,
    Belief,
    Finding,
    Forecast,
    Innovation,
    Moves,
    Scan,
)
from avsreplay.region import Followed, Region
from avsreplay.register.backend import measured_alignment
from avsreplay.register.registrar import Registrar
from avsreplay.register.sensor_frame import SensorFrame
from avsreplay.register.shown import Effort, effort_for, shown
from avsreplay.tracker import Kinematics, Tracker

_LISTED_POSES = 3  # poses that explain one scan, or are equal, and are named
MAX_POSITION_3S_OF_REACH = 0.25
MAX_ATTITUDE_3S_RAD = np.radians(15.0)
# Scans in a row that the estimate of the free body uses, after which the target counts as free
# again. With fewer it is left and returned to more often.
FREE_AGAIN_SCANS = 10


@value_class
class Measurement:
    """A registered scan.

    Attributes:
        alignment: the graded pose.
        guess: start, truth, given, predicted, last, acquired; measured: pose of the log.
        instants: (6, 6) mean instant for each direction [s] (``Registrar.instants``); None for the
            scan's instant.
        weighed: the pose with the covariance that the estimate uses; None before it is examined.
    """

    alignment: Alignment
    guess: str
    instants: Array | None = None
    weighed: Alignment | None = None


@value_class
class MonitorState:
    """What the monitors carry from scan to scan; ``motion``: motion of the last fit,
    which the Gramian follows.
    """

    gramian: Gramian
    consistency: ConsistencyTrack
    convergence: ConvergenceTrack
    violations: int = 0
    motion: FittedMotion | None = None
    turns: Turns = Turns()


@value_class
class PlannedTime:
    """Time to the planned capture.

    Attributes:
        flown: a capture plan is flown.
        after_s: returns the time [s after the scan]; before a plan is flown, a plan without
            constraints is made, and the horizon taken where there is none.
    """

    flown: bool
    after_s: Callable[[], float]


@value_class
class MonitorInput:
    """What a scan gave to the monitors.

    Attributes:
        prior: prediction at the scan.
        alignment: of the scan.
        innovation: of the measurement; None where nothing was measured.
        gamma: 1 if the fault detector accepts the measurement, else 0.
        track: estimate after the scan.
        belief: what is published of it.
        grasp_c: (3,) grasp point in {C} [m].
    """

    prior: Prediction
    alignment: Alignment
    innovation: Innovation | None
    gamma: int
    track: Track
    belief: Belief
    grasp_c: Array


@value_class
class Monitors:
    """Observability, consistency and convergence; they do not change the estimate."""

    consistency: Consistency
    convergence: Convergence

    def initial(self, prior_1s: Array) -> MonitorState:
        """Return the state before the first scan.

        Args:
            prior_1s: (20,) prior standard deviations of the error states.
        """
        return MonitorState(
            empty_gramian(prior_1s), self.consistency.initial(), self.convergence.initial()
        )

    def observe(
        self, state: MonitorState, estimator: AnyEstimator, seen: MonitorInput, planned: PlannedTime
    ) -> tuple[MonitorState, MonitorReport]:
        """Process one scan.

        Args:
            state: state of the monitors before the scan.
            estimator: estimator of the run.
            seen: what the scan gave.
            planned: time to the planned capture.
        """
        track, belief = seen.track, seen.belief
        healthy = seen.innovation if seen.gamma else None
        tested = self.consistency.observe(state.consistency, seen.innovation, seen.gamma)
        rows = estimator.gramian_rows(track, seen.prior, healthy, state.motion)
        if rows.anew and rows.R is not None:
            gramian = from_trajectory(state.gramian.scale, rows.H, rows.R, rows.Phi)
        else:
            gramian = observe(state.gramian, rows.Phi, rows.H, rows.R)
        rank, window = measure(gramian), self.consistency.judge(tested, max(track.levels.common))
        found = estimator.residual_after(track, seen.prior, healthy) if healthy else None
        failed = violations(track.belief, *found) if found else ()
        consistent = window.consistent and not (
            track.window.many_outliers or in_doubt(track) or failed
        )
        predicted = partial(estimator.track_forecast, track, grasp_c=seen.grasp_c)
        forecast = self.convergence.at_capture(predicted, planned.after_s)
        possible = after_change(belief, forecast.times_s, track.change_probability, track.change_P)
        turns = state.turns
        if seen.alignment.measured:
            turns = turns.after(belief.t_ns, seen.alignment.T_ac.q)
        alias = two_rates(turns)
        judged = self.convergence.judge(
            state.convergence,
            belief,
            forecast,
            consistent is True and alias is None,
            possible,
            planned.flown,
        )
        report = MonitorReport(
            ogm_rank=rank.rank,
            ogm_log10_cond=rank.log10_cond,
            ogm_log10_cond_scaled=rank.log10_cond_scaled,
            consistent=consistent,
            violations=state.violations + len(failed),
            nis_mean=window.nis_mean,
            autocorrelation=window.autocorrelation,
            converged=judged.converged,
            covariance_converged=judged.covariance_converged,
            predictive_converged=judged.predictive_converged,
            unconverged=judged.unknown if alias is None else (*judged.unknown, in_words(alias)),
            alias=alias,
            forecast=forecast,
        )
        violated = state.violations + len(failed)
        return MonitorState(gramian, tested, judged, violated, rows.motion, turns), report


@value_class
class Stages:
    """The stages of the chain, configured for one log.

    Attributes:
        target: geometry of the target about the grasp point, for guidance.
        grasp_c: (3,) grasp point in {C} [m].
        deskew: move points with times of their own to the scan's instant by the predicted motion.
        reacquire: register without a guess where the prediction is too uncertain to be one.
        region: what follows the target and removes the points around it; None: all are used.
        tracker: what judges a pose by those before it where the target does not move freely; None
            with the method of the paper and with an estimator that is a plug-in.
        initialise: first scan -> T_ac to begin with (None: acquire it), and where it comes from.
    """

    registrar: Registrar
    estimator: AnyEstimator
    faults: FaultDetector
    monitors: Monitors
    guidance: Guidance
    target: TargetGeometry
    grasp_c: Array
    guess: Guess
    deskew: bool
    reacquire: bool
    initialise: Callable[[Scan], tuple[Pose | None, str]]
    region: Region | None = None
    tracker: Tracker | None = None


@value_class
class Following:
    """What is known of the target whatever moves it.

    Attributes:
        kinematics: the track of its poses; None before one.
        contradicted: the estimate of the free body did not use the last pose, and the track
            confirms it.
        driven: that estimate has found no explanation for a pose that the track confirms.
        used: scans in a row that it has used since.
        shown: while the target is driven, the estimate that is published in place of that one.
    """

    kinematics: Kinematics | None = None
    contradicted: bool = False
    driven: bool = False
    used: int = 0
    shown: Track | None = None

    @property
    def confirmed(self) -> bool:
        """Whether the last pose is used because the track confirms it."""
        return self.driven and self.contradicted


@value_class
class PipelineState:
    """What is carried from scan to scan.

    Attributes:
        guidance: plan in force and robot.
        track: the estimate.  Both are None before the first scan.
        last_pose: last healthy measured pose, None before one.
        failed: what the scans showed before that pose whose searches found none.
        ambiguous: T_ac of the last measured scan, if it is one of several that a nearly symmetric
            model leaves, and no pose was healthy yet.
        origin: where the first pose came from.
        followed: the target, where a region follows it.
        start_ns: instant of the first scan.
        following: the target whatever moves it.
        content: digest of the points or the pose of the last scan that had any.
    """

    monitors: MonitorState
    guidance: GuidanceState | None = None
    track: Track | None = None
    last_pose: Pose | None = None
    origin: str = ""
    start_ns: int = 0
    failed: tuple[Array, ...] = ()
    ambiguous: Pose | None = None
    followed: Followed | None = None
    following: Following = Following()
    content: str = ""

    @property
    def captured_ns(self) -> int | None:
        """Instant at which the gripper closed, None before it."""
        return None if self.guidance is None else self.guidance.captured_ns


def step(stages: Stages, state: PipelineState, scan: Scan) -> tuple[PipelineState, Outcome]:
    """Process one scan. A bad scan still produces an outcome.

    Args:
        stages: the stages of the run.
        state: state before the scan.
        scan: points in {A} [m] with their instant.

    Returns:
        The state after the scan and the outcome of the scan.
    """
    content = _content(scan)
    repeated = bool(content) and content == state.content
    scan, followed = _in_region(stages, state, scan)
    state, track, acquired = _track(stages, state, scan)
    errors, predicted = track.errors, stages.estimator.predict(track, scan.t_ns)
    tracked = _tracked(stages, state, scan.t_ns)
    measurement = acquired or _register(stages, state, scan, predicted, tracked)
    track, predicted = stages.estimator.determined(track, predicted, measurement.alignment)
    measurement = _weighed(stages, state, measurement)
    prior, innovation, examined = _examined(stages, scan, predicted, measurement, repeated)
    lost = tracked is None and _prediction_lost(stages, scan, predicted)
    if acquired is None and examined.admission is not Admission.ADMITTED and lost:
        points = _deskewed(stages, state, scan, predicted)
        near = stages.estimator.frame.state_out(predicted.belief.x, scan.t_ns).T_ac
        measurement = _acquire(stages, state, scan, points, "acquired", near)
        measurement = _weighed(stages, state, measurement)
        prior, innovation, examined = _examined(stages, scan, predicted, measurement, repeated)
    track, finding = stages.estimator.step(
        track, prior, innovation, examined.admission, state.monitors.convergence.converged
    )
    following = _followed_on(stages, state, scan, measurement, track, finding)
    verdict = stages.faults.judge(examined, finding, following.confirmed)
    gamma, used = verdict.gamma, measurement.alignment if verdict.gamma else None
    track = track.changed(
        errors=errors.with_scan(used, stages.registrar.index.extent_m, scan.sensor)
    )
    free = track
    if following.shown is not None:
        track = following.shown
        prior, innovation = _seen(stages, state, scan, measurement) or (prior, innovation)
    belief = stages.estimator.published(track)
    aim = at_grasp(belief, stages.grasp_c)
    planned = planned_time(stages.estimator, stages.guidance, state.guidance, aim)
    seen = MonitorInput(
        prior=prior,
        alignment=measurement.alignment,
        innovation=innovation,
        gamma=gamma,
        track=track,
        belief=belief,
        grasp_c=stages.grasp_c,
    )
    monitors, report = stages.monitors.observe(state.monitors, stages.estimator, seen, planned)
    guidance = state.guidance or stages.guidance.initial(scan.t_ns)
    if stages.guidance.params.enabled and guidance.captured_ns is None:
        forecast = partial(stages.estimator.track_forecast, track, grasp_c=stages.grasp_c)
        known = planner_input(
            stages.estimator, aim, stages.target, gamma, report.converged, forecast
        )
        guidance = stages.guidance.stated(stages.guidance.step(guidance, known), known)
    outcome = Outcome(
        scan=scan,
        start_ns=state.start_ns,
        guess=measurement.guess,
        alignment=measurement.alignment,
        innovation=innovation,
        verdict=verdict,
        belief=belief,
        pose=belief.x.T_ac,
        pose_covariance=stages.estimator.pose_covariance(belief),
        body=body_parameters(belief),
        estimator=track.mode,
        moves=Moves.DRIVEN if following.shown is not None else moves(track),
        disturbances=stages.estimator.disturbances_of(track),
        sigma_hits=track.sigma_hits,
        r_floors=track.r_floors,
        reinitialised=track.reinitialised,
        manoeuvres=track.manoeuvres,
        drift=track.drift,
        monitors=report,
        action=guidance.decision.action.value,
        supervisor_rule=guidance.decision.rule,
        plan=guidance.plan,
    )
    pose = measurement.alignment.T_ac if gamma else state.last_pose
    failed = _failed(state, scan, measurement.alignment) if pose is None else ()
    ambiguous = _ambiguous(state, measurement.alignment) if pose is None else None
    return (
        PipelineState(
            monitors,
            guidance,
            free,
            pose,
            state.origin,
            state.start_ns,
            failed,
            ambiguous,
            followed,
            following,
            content or state.content,
        ),
        outcome,
    )


def _tracked(stages: Stages, state: PipelineState, t_ns: int) -> Motion | None:
    """The motion that the tracker predicts, where the estimate of the free body contradicts the
    last poses; else None.
    """
    following = state.following
    if stages.tracker is None or not (following.contradicted or following.driven):
        return None
    return stages.tracker.predicted(following.kinematics, t_ns)


def _followed_on(
    stages: Stages,
    state: PipelineState,
    scan: Scan,
    measurement: Measurement,
    track: Track,
    finding: Finding,
) -> Following:
    """What is known of the target whatever moves it after a scan.

    A pose that the track confirms is used also where the estimate of the free body finds no
    explanation for it, and from then on where that one is in doubt.
    """
    tracker, before = stages.tracker, state.following
    if tracker is None:
        return before
    kinematics, confirmed = tracker.after(before.kinematics, scan.t_ns, measurement.alignment)
    if finding.used:
        kinematics = tracker.used(kinematics, scan.t_ns)
    contradicted = confirmed and finding in (Finding.UNEXPLAINED, Finding.OPEN)
    unexplained = contradicted and finding is Finding.UNEXPLAINED
    used = 0 if contradicted else before.used + finding.used
    driven = unexplained or (before.driven and used < FREE_AGAIN_SCANS)
    shown = None
    if driven and kinematics is not None:
        known = kinematics.t_ns == scan.t_ns or tracker.predicted(kinematics, scan.t_ns) is not None
        if known:
            motion = tracker.motion(kinematics, scan.t_ns)
            of = stages.estimator.frame, stages.estimator.params
            shown = kinematic_track(*of, track, scan.t_ns, motion)
    return Following(kinematics, contradicted, driven, used, shown)


def _seen(
    stages: Stages, state: PipelineState, scan: Scan, measurement: Measurement
) -> tuple[Prediction, Innovation] | None:
    """Prior and innovation of a pose by the kinematic estimate of the last scan, None without
    one.
    """
    before = state.following.shown
    if before is None or not measurement.alignment.measured:
        return None
    prior = stages.estimator.predict(before, scan.t_ns)
    alignment = measurement.weighed or measurement.alignment
    return prior, stages.estimator.innovate(prior, alignment)


def _weighed(stages: Stages, state: PipelineState, measurement: Measurement) -> Measurement:
    """The measurement with the covariance that the estimate uses: while the target is driven that
    of the tracker, because the noise of the free motion is adapted to its own innovations.
    """
    weighed = measurement.alignment
    if stages.tracker is not None and state.following.driven:
        weighed = stages.tracker.weighed(state.following.kinematics, weighed)
    return replace(measurement, weighed=weighed)


def planned_time(
    estimator: AnyEstimator, guidance: Guidance, state: GuidanceState | None, belief: Belief
) -> PlannedTime:
    """Return the time to the capture that is flown, or that a plan from the robot's start would
    take.

    Args:
        estimator: predicts the motion.
        guidance: guidance of the robot.
        state: its state before the scan; None before the first one.
        belief: the estimate after the scan, about the grasp point.
    """
    params, t_ns = guidance.params, belief.t_ns
    if state is not None and state.captured_ns is not None:
        return PlannedTime(True, lambda: 0.0)
    if state is not None and state.segment.capture:
        left_s = max((state.segment.end_ns - t_ns) * 1e-9, 0.0)
        return PlannedTime(True, lambda: left_s)

    def planned() -> float:
        made = rendezvous(estimator.motion(belief), *params.start, params, t_ns)
        return made.t_go_s if made.found else params.horizon_s

    return PlannedTime(False, planned)


def fold(
    stages: Stages, state: PipelineState, scans: Iterable[Scan]
) -> Iterator[tuple[PipelineState, Outcome]]:
    """Apply ``step`` to the scans one at a time, so that memory holds one scan and not one log.

    Args:
        stages: the stages.
        state: the state before the first scan.
        scans: the scans in order.
    """
    for scan in scans:
        state, outcome = step(stages, state, scan)
        yield state, outcome


def planned_segment(state: PipelineState) -> Segment | None:
    """Return the flight of the capture plan made at the last scan; None where none was made or none
    is flown.

    Args:
        state: state after that scan.
    """
    guidance, track = state.guidance, state.track
    if guidance is None or track is None or guidance.plan is None or not guidance.segment.capture:
        return None
    return guidance.segment if guidance.plan.t_ns == track.belief.t_ns else None


def _in_region(stages: Stages, state: PipelineState, scan: Scan) -> tuple[Scan, Followed | None]:
    """The scan with the points in the region of the target, and where the target is followed to."""
    if stages.region is None or scan.pose is not None or not len(scan.points):
        return scan, state.followed
    tracked = _tracked(stages, state, scan.t_ns)
    pose = None if tracked is None else tracked.T_ac
    if pose is None and state.track is not None and state.last_pose is not None:
        predicted = stages.estimator.predict(state.track, scan.t_ns)
        if not _prediction_lost(stages, scan, predicted):
            pose = stages.estimator.frame.state_out(predicted.belief.x, scan.t_ns).T_ac
    kept, followed = stages.region.cut(scan.points, scan.t_ns, state.followed, pose)
    return scan.keep(kept), followed


def _track(
    stages: Stages, state: PipelineState, scan: Scan
) -> tuple[PipelineState, Track, Measurement | None]:
    """The track so far, or a new one at the first scan.

    An acquired start is repeated until a scan is healthy.
    """
    if state.track is not None and not (
        state.origin in ("acquired", "measured") and state.last_pose is None
    ):
        return state, state.track, None
    pose, origin = stages.initialise(scan)
    measurement = None
    if pose is None:
        measurement = _acquire(stages, state, scan, scan.points, origin)
        pose = measurement.alignment.T_ac
    state = replace(
        state, origin=origin, start_ns=scan.t_ns if state.track is None else state.start_ns
    )
    return state, stages.estimator.initial(scan.t_ns, pose, measurement is not None), measurement


def _register(
    stages: Stages,
    state: PipelineState,
    scan: Scan,
    predicted: Prediction,
    tracked: Motion | None,
) -> Measurement:
    """Register the scan from the configured guess, or from that of the tracker where there is one;
    a measured pose is taken as it is.
    """
    if scan.pose is not None:
        return Measurement(measured_alignment(scan.pose), "measured")
    points = _deskewed(stages, state, scan, predicted)
    guess, origin = (
        stages.estimator.frame.state_out(predicted.belief.x, scan.t_ns).T_ac,
        "predicted",
    )
    if state.last_pose is None:
        origin = state.origin
    elif stages.guess is Guess.LAST:
        guess, origin = state.last_pose, "last"
    elif tracked is not None:
        guess, origin = tracked.T_ac, "tracked"
    effort, carried = _effort(state, scan), points is not scan.points
    unknown = (
        None
        if state.track is None
        else stages.estimator.frame.motions_out(state.track.undetermined)
    )
    found = SensorFrame(stages.registrar, scan.sensor).register(
        points, guess, scan.seq, carried, effort, unknown
    )
    return _measurement(stages, scan, points, found, origin)


def _acquire(
    stages: Stages,
    state: PipelineState,
    scan: Scan,
    points: NDArray[Any],
    origin: str,
    near: Pose | None = None,
) -> Measurement:
    """Register the scan without a guess. Of poses that exact symmetries make equal, the run follows
    one: that which is nearest to a pose T_ac, or the registered one.
    """
    frame, effort = SensorFrame(stages.registrar, scan.sensor), _effort(state, scan)
    found = frame.acquire(points, effort, state.ambiguous)
    if found.equal:
        best = found.T_ac
        if near is not None:
            turn = partial(geometry.angle_between, near.q)
            best = min(found.members, key=lambda T_ac: float(turn(T_ac.q)))
        one = frame.register(points, best, scan.seq, False, effort, None)
        found = replace(one, message=one.message or _equal_words(found))
    elif found.members and not found.message:
        options = _options(found.members[:_LISTED_POSES])
        found = replace(found, message=f"{len(found.members)} poses explain the scan: {options}")
    return _measurement(stages, scan, points, found, origin)


def _equal_words(found: Alignment) -> str:
    """That the pose is one of several that a symmetry of the model makes equal."""
    others = _options(found.members[1 : _LISTED_POSES + 1])
    return (
        f"one of {len(found.members)} poses that the symmetry of the model makes equal"
        f" ({found.free_directions}); the others: {others}"
    )


def _options(poses: Iterable[Pose]) -> str:
    """The options that begin a run with one of some poses."""
    texts = (",".join(f"{x:.6g}" for x in (*pose.t, *pose.q)) for pose in poses)
    return ", ".join(f"--init {text}" for text in texts)


def _effort(state: PipelineState, scan: Scan) -> Effort:
    return effort_for(shown(scan.points), state.failed)


def _content(scan: Scan) -> str:
    """Digest of the points or the pose of a scan, empty where it has none."""
    if scan.pose is not None:
        T_ac = scan.pose.T_ac
        return T_ac.q.tobytes().hex() + T_ac.t.tobytes().hex()
    if not len(scan.points):
        return ""
    return hashlib.blake2b(np.ascontiguousarray(scan.points).data, digest_size=16).hexdigest()


def _ambiguous(state: PipelineState, found: Alignment) -> Pose | None:
    """The pose of a scan that is one of several; that of the scan before if this one has none."""
    if found.status is AlignStatus.AMBIGUOUS:
        return found.T_ac
    return None if found.measured else state.ambiguous


def _failed(state: PipelineState, scan: Scan, found: Alignment) -> tuple[Array, ...]:
    """What the scans without an accepted pose showed whose searches found none, with this scan.

    After an ambiguous scan, another one is none whose search failed.
    """
    if state.ambiguous is not None and found.status is AlignStatus.AMBIGUOUS:
        return state.failed
    seen = shown(scan.points)
    searched = seen is not None and effort_for(seen, state.failed) is Effort.FULL
    return (*state.failed, seen) if searched and seen is not None else state.failed


def _measurement(
    stages: Stages, scan: Scan, points: NDArray[Any], alignment: Alignment, origin: str
) -> Measurement:
    if scan.times_s is None or not (stages.deskew and alignment.measured):
        return Measurement(alignment, origin)
    instants = SensorFrame(stages.registrar, scan.sensor).instants(
        points, scan.times_s, alignment.T_ac
    )
    return Measurement(alignment, origin, instants)


def _examined(
    stages: Stages,
    scan: Scan,
    predicted: Prediction,
    measurement: Measurement,
    repeated: bool,
) -> tuple[Prediction, Innovation | None, Examined]:
    """The prior at the instant of the measurement, the innovation (None: nothing measured)
    and what the rules on the scan alone find.
    """
    if scan.times_s is not None and measurement.instants is not None:
        instants = stages.estimator.frame.instants_into(measurement.instants)
        predicted = with_scan_duration(predicted, instants, scan.times_s)
    alignment = measurement.weighed or measurement.alignment
    innovation = stages.estimator.innovate(predicted, alignment) if alignment.measured else None
    return (
        predicted,
        innovation,
        stages.faults.examine(scan.status, alignment, innovation, predicted.belief, repeated),
    )


def _prediction_lost(stages: Stages, scan: Scan, predicted: Prediction) -> bool:
    """Whether 3 standard deviations of the predicted pose exceed a quarter of the registration's
    reach, or 15 deg.
    """
    if not stages.reacquire or not len(scan.points):
        return False
    variance = np.diag(predicted.H @ predicted.belief.P @ predicted.H.T)
    position, angle = (
        3.0 * np.sqrt(variance[:3].sum()),
        6.0 * np.sqrt(variance[3:].sum()),
    )  # P holds half angles
    return bool(
        position > MAX_POSITION_3S_OF_REACH * stages.registrar.limits.reach_m
        or angle > MAX_ATTITUDE_3S_RAD
    )


def _deskewed(
    stages: Stages, state: PipelineState, scan: Scan, predicted: Prediction
) -> NDArray[Any]:
    """The points at the scan's instant: moved by the predicted motion where they have times
    and a motion is known.
    """
    if scan.times_s is None or not (stages.deskew and (state.last_pose or stages.estimator.start)):
        return scan.points
    return deskew(
        scan.points, scan.times_s, stages.estimator.frame.state_out(predicted.belief.x, scan.t_ns)
    )


Forecaster = Callable[[Array], Forecast]
"""Times (n,) ascending [s after a belief] -> predicted standard deviations of the grasp point
without measurements.
"""


def target_scene(
    estimator: AnyEstimator, belief: Belief, target: TargetGeometry, forecast: Forecaster
) -> Scene:
    """Return the predicted target after a belief about the grasp point, as the planner uses it:
    estimate and forecast, never the truth.

    Args:
        estimator: predicts the motion.
        belief: the estimate.
        target: geometry of the target about the grasp point.
        forecast: predicts the belief at a later instant.
    """

    def sigma(times_s: Array) -> tuple[Array, Array]:
        return (predicted := forecast(times_s)).pos_1s_m, predicted.rot_1s_rad

    return Scene(
        goal=estimator.motion(belief),
        attitude=estimator.attitude(belief),
        axis_c=target.axis_c,
        centre_c=-geometry.matrix(belief.x.q_bc).T @ belief.x.c_b,
        surface=target.surface,
        sigma=sigma,
        hull_c=target.hull_c,
    )


def planner_input(
    estimator: AnyEstimator,
    belief: Belief,
    target: TargetGeometry,
    gamma: int,
    converged: bool,
    forecast: Forecaster,
) -> PlannerInput:
    """Return the input of guidance after a scan.

    Args:
        estimator: predicts the motion.
        belief: the estimate after the scan.
        target: geometry of the target about the grasp point.
        gamma: 1 for a healthy scan, 0 for a faulty one.
        converged: whether the estimate has converged.
        forecast: predicts the belief at a later instant.
    """
    return PlannerInput(
        belief.t_ns, gamma, converged, target_scene(estimator, belief, target, forecast), forecast
    )
