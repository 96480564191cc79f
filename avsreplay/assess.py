"""Computes the assessment of a capture (``assessment.Assessment``).

The flight is that of guidance over the log: replanning, blackouts, delay and supervisor as they
were. Where the log ends before the capture, the flight is continued by simulation against targets
drawn from the last belief, with the noise of the measured poses and the blackouts of the log. A
flight that ended is compared with targets drawn from the belief at its end. Draws are made in the
chart of the estimator (``estimate.chart``), in which nearly equal moments of inertia are no
singularity.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Generator, Iterator
from dataclasses import field, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.assessment import Assessment, Chance, InFact, chance_of, errors_text
from avsreplay.errors import value_class
from avsreplay.estimate import Estimator
from avsreplay.estimate.chart import (
    ARM,
    ETA,
    INERTIA,
    POSITION,
    RATE,
    VELOCITY,
    to_chart,
    to_errors,
    to_state,
)
from avsreplay.estimate.driven import DrivenBelief
from avsreplay.estimate.params import Adaptation, NoiseSource
from avsreplay.estimate.pose_noise import cholesky_root
from avsreplay.geometry import Array, Pose
from avsreplay.monitor.convergence import Convergence, ConvergenceTrack
from avsreplay.outcome import CaptureError, Plan, PlanStatus
from avsreplay.pipeline import planned_time, planner_input
from avsreplay.plan.constrained import constrained
from avsreplay.plan.contact import Contact
from avsreplay.plan.flights import (
    Ended,
    Miss,
    Motion,
    closed_loop,
    closed_miss,
    flown_positions,
    relative_path,
    true_scene,
)
from avsreplay.plan.guidance import Guidance, GuidanceState, PlannerInput, Segment
from avsreplay.plan.limits import Scene, TargetGeometry, axis_blocked
from avsreplay.plan.rendezvous import rendezvous
from avsreplay.plan.supervisor import RULES, Action
from avsreplay.plan.uncertainty import Disturbance, draws, wilson
from avsreplay.records import Alignment, AlignStatus, Belief, State
from avsreplay.task import Task

SIMULATED_FLIGHTS = 16  # simulated flights where the log ends before the capture
DRAWN_TARGETS = 128  # targets drawn for a flight that ended
NOISE_SCANS = 50  # last measured poses whose noise is that of the simulated ones
# least share of the variance of an error by which one quantity is named
_LEAST_VARIANCE_SHARE = 0.2
_WHY = {rule.name: rule.why for rule in RULES}
_AXES = "xyz"
_COORDINATES = (
    *((ETA.start + k, f"the attitude about {a}") for k, a in enumerate(_AXES)),
    *((RATE.start + k, f"the rate about {a}") for k, a in enumerate(_AXES)),
    *((POSITION.start + k, f"the position along {a}") for k, a in enumerate(_AXES)),
    *((VELOCITY.start + k, f"the velocity along {a}") for k, a in enumerate(_AXES)),
    *((k, "the inertia") for k in range(INERTIA.start, INERTIA.stop)),
    *((ARM.start + k, f"the mass centre along {a}") for k, a in enumerate(_AXES)),
)
Flags = NDArray[np.bool_]
_QUANTITIES = ("position", "speed", "attitude")


@value_class
class Leg:
    """What the robot did after one scan.

    Attributes:
        belief: the belief after the scan.
        segment: the flight of the robot from then on.
        action, rule: the action of the supervisor and the rule that determined it.
    """

    belief: Belief
    segment: Segment
    action: Action
    rule: str


@value_class
class ScanErrors:
    """What is known of errors after a scan.

    Attributes:
        noise: (6, 6) covariance of d = [theta; v], the error of the measured pose in {C} [rad, m];
            None where nothing was measured.
        disturbances: root densities of the random torque [rad/s^1.5] and force [m/s^1.5]; None
            where the estimator gives none.
        lasting: 1 sigma of the position [m] and attitude [rad] of the grasp point that no further
            pose reduces.
    """

    noise: Array | None = None
    disturbances: tuple[float, float] | None = None
    lasting: tuple[float, float] = (0.0, 0.0)


class FlightLog:
    """The flight of guidance over a log, as far as the assessment needs it.

    Attributes:
        legs: one per scan from the first approach to the end of the flight.
        state: the state of guidance after the last scan of the flight; None before the first
            approach.
        belief: the belief after the last scan.
        convergence: whether this belief may be used for planning, and since when its test holds.
        gammas: gamma of every scan.
        stamps: instant of every scan [ns].
        failing_ns: instant since which no capture is planned [ns]; None where one is.
        noises: (6, 6) covariances of the last measured poses, as ``noise`` gives them.
        errors: after the last scan.
    """

    def __init__(self) -> None:
        self.legs: list[Leg] = []
        self.state: GuidanceState | None = None
        self.belief: Belief | None = None
        self.convergence = ConvergenceTrack()
        self.gammas: list[int] = []
        self.stamps: list[int] = []
        self.noises: list[Array] = []
        self.failing_ns: int | None = None
        self.errors = ScanErrors()

    def take(
        self,
        belief: Belief,
        guidance: GuidanceState | None,
        gamma: int,
        convergence: ConvergenceTrack,
        errors: ScanErrors | None = None,
    ) -> None:
        """Take one scan.

        Args:
            belief: the belief after the scan.
            guidance: the state of guidance after the scan; it does not change after the capture.
            gamma: 1 for a healthy scan, else 0.
            convergence: whether the belief may be used for planning.
            errors: what is known of errors after the scan.
        """
        self.errors = errors or ScanErrors()
        self.gammas.append(gamma)
        self.stamps.append(belief.t_ns)
        if self.errors.noise is not None and gamma:
            self.noises = [*self.noises[-NOISE_SCANS + 1 :], self.errors.noise]
        if self.ended or guidance is None:
            return
        self.state, self.belief, self.convergence = guidance, belief, convergence
        converged = convergence.converged
        if converged and guidance.plan is not None and guidance.plan.found:
            self.failing_ns = None
        elif self.failing_ns is None and converged:
            self.failing_ns = belief.t_ns
        if guidance.supervisor.moving:
            decided = guidance.decision
            self.legs.append(Leg(belief, guidance.segment, decided.action, decided.rule))

    @property
    def ended(self) -> bool:
        """Whether the gripper has closed or the approach was aborted."""
        state = self.state
        return state is not None and (
            state.captured_ns is not None or state.decision.action is Action.ABORT
        )

    @property
    def noise(self) -> Array | None:
        """The covariance (6, 6) of d = [theta; v], the error of a pose in {C} [rad, m], whose
        information is the mean of the last poses; None where no pose was measured.

        A view that does not determine a direction tells nothing of it; the next views do.
        """
        if not self.noises:
            return None
        return np.linalg.inv(np.mean(np.linalg.inv(np.array(self.noises)), axis=0))


@value_class
class Setup:
    """The inputs of an assessment.

    Attributes:
        task: the task of the gripper.
        estimator, guidance: estimator and guidance of the run.
        convergence: decides in a simulated flight whether its estimate may be used for planning.
        target: geometry of the target about the grasp point, with its surface.
        solid: whether inside and outside of the surface are known.
        extent_m: extent of the target [m].
        since_ns: instant of the first scan [ns].
        thrust_noise_mps2: standard deviation of the thrust error of each axis, as its mean over 1 s
            [m/s2].
        flights: number of simulated flights where the log ends before the capture.
        seed: seed of all random draws.
        advice: grasp points that could be used instead, in words.
    """

    task: Task
    estimator: Estimator
    guidance: Guidance
    convergence: Convergence
    target: TargetGeometry
    solid: bool
    extent_m: float
    since_ns: int
    thrust_noise_mps2: float = 0.0
    flights: int = SIMULATED_FLIGHTS
    seed: int = 0
    advice: str = ""
    contact: Contact | None = field(init=False)

    def __post_init__(self) -> None:
        t, closest = self.task, self.target.surface
        half = 0.5 * t.opening_m + t.tolerance.position_m
        found = None
        if closest is not None and self.solid:
            found = Contact(closest, t.axis_c, t.radius_m, half, t.mouth_m)
        object.__setattr__(self, "contact", found)

    @property
    def limits(self) -> Array:
        """Largest position error [m], speed [m/s] and angle [deg] (3,) of a capture."""
        t = self.task.tolerance
        return np.array([t.position_m, t.speed_mps, t.angle_deg])

    def touched(self, path: Array) -> bool | None:
        """Return whether the end-effector touches the body outside the grasp; None where contact is
        not checked.

        Args:
            path: (n, 3) from the grasp point in {C} [m], in the order of time.
        """
        return None if self.contact is None else bool(self.contact.touched(path[None])[0])

    def at_s(self, t_ns: int) -> float:
        """Return an instant in seconds after the first scan.

        Args:
            t_ns: the instant.
        """
        return (t_ns - self.since_ns) * 1e-9

    def rng(self, which: int) -> np.random.Generator:
        """Return a random generator of its own for one purpose.

        Args:
            which: number of the purpose.
        """
        return np.random.Generator(np.random.PCG64([self.seed, which]))


def assess(setup: Setup, log: FlightLog, truth: Motion | None = None) -> Assessment:
    """Return whether the robot would have captured the target.

    Args:
        setup: task, estimator, guidance and target.
        log: the flight over the log.
        truth: true motion of the grasp point by the time after the first scan [s]; None: unknown.
    """
    task = setup.task
    known: dict[str, Any] = {
        "tolerance": CaptureError(*setup.limits.tolist()),
        "task": task.text,
        "basis": "flight over the log",
        "asked": setup.guidance.params.enabled and "grasp point" not in task.assumed,
    }
    if not setup.guidance.params.enabled:
        limit = "no plans are made (plan.enabled = false)"
        return Assessment(chance=Chance.NOT_ASSESSED, limit=limit, **known)
    if task.problem:
        return Assessment(
            chance=Chance.NOT_ASSESSED, limit=task.problem, change=setup.advice, **known
        )
    state, belief = log.state, log.belief
    if state is None or belief is None or not any(log.gammas):
        return Assessment(chance=Chance.NONE, limit="no scan was used", probability=0.0, **known)
    if state.decision.action is Action.CAPTURE:
        found = _closed(setup, log, state)
    elif state.decision.action is Action.ABORT:
        found = _aborted(setup, log, state)
    elif log.convergence.converged and state.plan is not None and state.plan.found:
        found = _continued(setup, log, state, belief)
    else:
        found = _at_rest(setup, log, state, belief)
    fact = None if truth is None else _in_fact(setup, log, state, truth)
    return Assessment(**{**known, **found, "in_fact": fact})


def _closed(setup: Setup, log: FlightLog, state: GuidanceState) -> dict[str, Any]:
    """The gripper closed: the errors in draws of the belief at that instant."""
    end_ns = state.segment.end_ns
    leg = next((leg for leg in reversed(log.legs) if leg.belief.t_ns <= end_ns), log.legs[0])
    belief, after = leg.belief, np.array([(end_ns - leg.belief.t_ns) * 1e-9])
    steps, drawn = drawn_beliefs(belief, DRAWN_TARGETS, setup.rng(1))
    aimed = setup.estimator.attitude(belief)(after)[0]
    r, v = state.segment.at(end_ns)
    since_s = np.array([0.0, max((end_ns - state.segment.t_ns) * 1e-9, 1e-9)])
    noise = Disturbance(setup.thrust_noise_mps2, setup.rng(2))
    pushed = [noise.deviation(since_s) for _ in drawn]
    errors = np.empty((len(drawn), 7))
    for k, (each, (dr, dv)) in enumerate(zip(drawn, pushed, strict=True)):
        (rho, rate), q = setup.estimator.motion(each)(after), setup.estimator.attitude(each)(after)
        errors[k] = [
            *(rho[0] - r - dr[-1]),
            *(rate[0] - v - dv[-1]),
            geometry.angle_between(q[0], aimed),
        ]
    sizes = np.column_stack(
        [
            np.linalg.norm(errors[:, :3], axis=1),
            np.linalg.norm(errors[:, 3:6], axis=1),
            np.degrees(errors[:, 6]),
        ]
    )
    inside, touched = (sizes <= setup.limits).all(axis=1), _touched_by_draws(setup, log, end_ns)
    at_s = setup.at_s(end_ns)
    late = at_s > setup.task.deadline_s
    good: Flags = np.asarray(inside if touched is None else inside & ~touched) & np.bool_(not late)
    found = _probability(good)
    largest = np.quantile(sizes, 0.95, axis=0)
    worst = int(np.argmax(largest / setup.limits))
    words = _cause(steps, errors, worst, np.array([np.concatenate(p, axis=1)[-1] for p in pushed]))
    contact = None if touched is None else float(touched.mean())
    limit = words
    if late:
        limit = f"the deadline of {setup.task.deadline_s:g} s"
    elif contact is not None and contact > 1.0 - float(inside.mean()):
        limit = "contact with the body"
    change = ""
    if found["chance"] is not Chance.LIKELY:
        change = "a later deadline" if late else _change(setup, limit)
        found["known_s"] = setup.at_s(belief.t_ns)
    miss = CaptureError(*largest.tolist())
    return {**found, "at_s": at_s, "miss": miss, "contact": contact, "limit": limit} | {
        "change": change
    }


def _aborted(setup: Setup, log: FlightLog, state: GuidanceState) -> dict[str, Any]:
    """The approach was aborted; the rules that withdrew the attempts before say why."""
    withdrawn = [
        leg.rule for leg in log.legs if leg.action in (Action.HOLD, Action.RETREAT) and leg.rule
    ]
    first = next((leg for leg in log.legs if leg.action is Action.ABORT), log.legs[-1])
    often = Counter(withdrawn).most_common(1)
    cause = f", mostly held because {_WHY.get(often[0][0], often[0][0])}" if often else ""
    rule = _WHY.get(state.decision.rule, state.decision.rule)
    touched = _touched_by_draws(setup, log, log.legs[-1].segment.end_ns)
    last = _rule_change(often[0][0] if often else state.decision.rule)
    return {
        "chance": Chance.NONE,
        "probability": 0.0,
        "contact": None if touched is None else float(touched.mean()),
        "limit": f"the approach was aborted ({rule}{cause})",
        "known_s": setup.at_s(first.belief.t_ns),
        "change": last,
    }


def _at_rest(setup: Setup, log: FlightLog, state: GuidanceState, belief: Belief) -> dict[str, Any]:
    """The robot waits or holds without a plan: the estimate does not suffice, or no capture
    exists.
    """
    touched = None if not log.legs else _touched_by_draws(setup, log, belief.t_ns)
    contact = 0.0 if setup.contact is not None else None
    if touched is not None:
        contact = float(touched.mean())
    found: dict[str, Any] = {"chance": Chance.NONE, "probability": 0.0, "contact": contact}
    params, free = setup.guidance.params, _planned(setup, belief)
    plan = state.plan if log.convergence.converged else None
    plan = free if plan is None and free.status is PlanStatus.INFEASIBLE else plan
    if plan is not None:
        proven = plan.status is PlanStatus.INFEASIBLE
        cause, change = _prevented(setup, belief, plan.lower_bound_s)
        return {
            **found,
            "limit": (
                f"no capture within {params.horizon_s:g} s with {params.a_max_mps2:g} m/s2"
                f" ({'proven impossible' if proven else 'none found'}{cause})"
            ),
            "known_s": setup.at_s(log.failing_ns or plan.t_ns),
            "change": change,
        }
    return {**found, **_insufficient(setup, log, belief)}


def _insufficient(setup: Setup, log: FlightLog, belief: Belief) -> dict[str, Any]:
    """Why an estimate does not suffice for an approach, and what would change it; undecided where
    further scans may reduce the error.
    """
    lost = " any more" if any(leg.action is not Action.STAND_STILL for leg in log.legs) else ""
    words = f"the estimate does not suffice{lost}"
    sigmas, (position, turn) = setup.guidance.supervisor.params.sigmas, log.errors.lasting
    lasting = sigmas * np.array([position, 0.0, math.degrees(turn)])
    if (lasting > setup.limits).any():
        worst = int(np.argmax(lasting / setup.limits))
        limit = f"{sigmas:g} sigma of the {_QUANTITIES[worst]} error that all poses have in common"
        return {
            "limit": f"{words}: {limit} are {_of_tolerance(setup, worst, lasting[worst])}",
            "known_s": setup.at_s(belief.t_ns),
            "change": "a larger tolerance or a more exact model would help",
        }
    after = _planned_s(setup, belief)
    worst, size, cause = _predicted(setup, belief, after)
    if size <= setup.limits[worst]:
        limit = "it has to be consistent and within the tolerances for convergence.dwell_s"
    else:
        limit = f"predicted {_QUANTITIES[worst]} error {_of_tolerance(setup, worst, size)}"
        limit += f" at a capture in {after:.0f} s, from {cause}"
    return {
        "chance": Chance.UNDECIDED,
        "probability": None,
        "limit": f"{words}: {limit}",
        "change": _change(setup, cause),
    }


def _of_tolerance(setup: Setup, which: int, size: float) -> str:
    """An error and its tolerance in words."""
    unit, scale = (("mm", 1e3), ("mm/s", 1e3), ("deg", 1.0))[which]
    return f"{scale * size:.3g} of {scale * setup.limits[which]:.3g} {unit}"


def _prevented(setup: Setup, belief: Belief, after_s: float) -> tuple[str, str]:
    """Why no plan is found, as far as the shape of the target shows it, and what would change
    it.
    """
    limits, forecast = setup.guidance.limits, partial(setup.estimator.forecast, belief)
    scene = planner_input(setup.estimator, belief, setup.target, 1, True, forecast).scene
    blocked = axis_blocked(scene, limits, setup.extent_m)
    if blocked is None:
        if scene.sigma is None or not _found_without_allowance(setup, scene, belief):
            return "", "more thrust or a longer horizon; 'avsreplay plan' names the settings"
        position_m = float(scene.sigma(np.array([max(after_s, 0.0)]))[0][0])
        cause = f"the predicted error of {1e3 * position_m:.3g} mm takes the room to approach"
        change = "a longer observation would help, or a smaller limits.clearance_sigmas"
        return f": {cause}", change
    name, until_m, short_m = blocked
    if name != "body":
        cause = f"the {name} is violated by {short_m:.3g} m on the axis of the approach"
        return f": {cause}", "another fixture or other limits"
    length = limits.final_range_m or 0.0
    cause = (
        f"the corridor ends {length:.3g} m from the grasp point, where the body is"
        f" {short_m:.3g} m nearer than the clearance"
    )
    return f": {cause}", f"limits.final_range_m={1.05 * until_m:.2g}, or a smaller clearance"


def _continued(
    setup: Setup, log: FlightLog, state: GuidanceState, belief: Belief
) -> dict[str, Any]:
    """The log ends before the capture: the flight continues in simulation."""
    flown = simulated(setup, log, state, belief)
    touched = _touched_by_draws(setup, log, belief.t_ns)
    before = np.zeros(len(flown), bool) if touched is None else np.resize(touched, len(flown))
    start_s = setup.at_s(belief.t_ns)
    ends = [start_s + each.at_s for each in flown]
    hits = [bool(hit or setup.touched(each.path)) for each, hit in zip(flown, before, strict=True)]
    why = [_why_not(setup, *each) for each in zip(flown, ends, hits, strict=True)]
    found = _probability(np.array([not reason for reason in why]))
    reasons = Counter(reason for reason in why if reason).most_common(1)
    cause = _predicted(setup, belief, _planned_s(setup, belief))[2]
    limit = reasons[0][0] if reasons else cause
    closed = [end for end, each in zip(ends, flown, strict=True) if each.miss is not None]
    sizes = [_sizes(each.miss) for each in flown if each.miss is not None]
    done: dict[str, Any] = {
        **found,
        "basis": f"{len(flown)} simulated flights after the end of the log at {start_s:.1f} s",
        "at_s": float(np.median(closed)) if closed else None,
        "miss": CaptureError(*np.quantile(sizes, 0.95, axis=0).tolist()) if sizes else None,
        "contact": None if setup.contact is None else float(np.mean(hits)),
        "limit": limit,
    }
    if found["chance"] is not Chance.LIKELY:
        done |= {"known_s": start_s, "change": _change(setup, limit if any(hits) else cause)}
    return done


def _sizes(miss: Miss) -> Array:
    """Position error [m], speed [m/s] and angle [deg] (3,) when the gripper closes."""
    return np.array([miss.distance_m, miss.speed_mps, miss.angle_deg])


def _why_not(setup: Setup, flight: Ended, end_s: float, hit: bool) -> str:
    """Why a simulated flight did not capture, "" where it did."""
    if hit:
        return "contact with the body"
    if flight.miss is None:
        return f"an end without capture ({_WHY.get(flight.rule, flight.rule)})"
    if not flight.miss.inside(setup.task.tolerance):
        worst = int(np.nanargmax(_sizes(flight.miss) / setup.limits))
        return f"the {_QUANTITIES[worst]} when the gripper closes"
    return "the deadline" if end_s > setup.task.deadline_s else ""


def simulated(
    setup: Setup, log: FlightLog, state: GuidanceState | None, belief: Belief
) -> list[Ended]:
    """Simulate approaches that begin at a belief, with measured scans, thrust errors, delay and the
    blackouts of the log, against targets that are drawn from the belief.

    Args:
        setup: task, estimator, guidance and target.
        log: the flight so far, whose scans give interval and blackouts.
        state: the state of guidance at the belief; None if the robot is at its start.
        belief: the belief from which the targets are drawn.

    Returns:
        The ends of the flights, whose paths begin with that which was flown over the log.
    """
    rng = setup.rng(3)
    _, drawn = drawn_beliefs(belief, setup.flights, rng)
    before = np.zeros((0, 3))
    if setup.contact is not None and state is not None:
        estimated = np.zeros((1, 6))
        before = _flown_past(setup, setup.contact, log, belief.t_ns, estimated)[0]
    out, thrust = list[Ended](), Disturbance(setup.thrust_noise_mps2, rng)
    for each in drawn:
        target = Scene(setup.estimator.motion(each), setup.estimator.attitude(each))
        known = measured(setup, log, belief, target, state, rng)
        ended = closed_loop(setup.guidance, known, target, belief.t_ns, thrust, state)
        out.append(replace(ended, path=np.concatenate([before, ended.path])))
    return out


def _simulating(setup: Setup, log: FlightLog, belief: Belief) -> Estimator:
    """Return the estimator of simulated flights, with the disturbances of the log.

    The noise is known here, and a fit to the poses of the flight would have none of the log.

    Args:
        setup: task, estimator, guidance and target.
        log: the flight so far.
        belief: the belief from which it goes on.
    """
    params = replace(
        setup.estimator.params,
        noise=NoiseSource.REGISTRATION,
        adapt=Adaptation.OFF,
        audit_poses=0,
    )
    if log.errors.disturbances is not None:
        torque, force = log.errors.disturbances
        params = replace(params, torque_noise_radps15=torque, force_noise_mps15=force)
    return Estimator(params, belief, setup.extent_m, setup.since_ns)


def measured(
    setup: Setup,
    log: FlightLog,
    belief: Belief,
    target: Scene,
    state: GuidanceState | None,
    rng: np.random.Generator,
) -> Generator[PlannerInput, GuidanceState, None]:
    """Inputs of guidance for a drawn target after each scan: the filter with poses that have the
    noise of the log, no pose where the log had a blackout, and the test of convergence. The state
    of guidance after the input is sent to the generator.

    Args:
        setup: task, estimator, guidance and target.
        log: the flight so far.
        belief: the belief from which the filter goes on.
        target: the target, with its attitude, by the time after the belief [s].
        state: the state of guidance at the belief; None if the robot is at its start.
        rng: random generator.
    """
    assert target.attitude is not None
    estimator, held = _simulating(setup, log, belief), log.convergence
    track, C = estimator.resumed(belief), log.noise
    if C is None:  # no pose was measured
        position, half = np.split(np.diag(estimator.params.R0), 2)
        C = np.diag(np.concatenate([4.0 * half, position]))
    C = geometry.covariance_about(C, setup.task.grasp_c)
    root = cholesky_root(C)
    step_ns = int(np.median(np.diff(log.stamps))) if len(log.stamps) > 1 else 100_000_000
    offset = int(rng.integers(len(log.gammas)))
    last_ns = round(setup.guidance.params.horizon_s * 2e9)
    for k, since_ns in enumerate(range(step_ns, last_ns, step_ns)):
        t_ns = belief.t_ns + since_ns
        prior, gamma = estimator.predict(track, t_ns), log.gammas[(offset + k) % len(log.gammas)]
        turn, move = np.split(root @ rng.standard_normal(6), 2)
        if gamma:
            at = np.array([since_ns * 1e-9])
            (position,), (q,) = target.goal(at)[0], target.attitude(at)
            pose = Pose(
                geometry.multiply(q, geometry.exp(turn)), position + geometry.matrix(q) @ move
            )
            quality = 1, True, 1000, 1000, 0.0, np.eye(6), AlignStatus.ALIGNED
            innovation = estimator.innovate(prior, Alignment(pose, *quality, covariance=C))
            track = estimator.update(track, prior, innovation, 1)
        else:
            track = estimator.update(track, prior, None, 0)
        forecast = partial(estimator.forecast, track.belief)
        planned = planned_time(estimator, setup.guidance, state, track.belief)
        at_capture = setup.convergence.at_capture(forecast, planned.after_s)
        held = setup.convergence.judge(held, track.belief, at_capture, flown=planned.flown)
        state = yield planner_input(
            estimator, track.belief, setup.target, gamma, held.converged, forecast
        )


def drawn_beliefs(
    belief: Belief, count: int, rng: np.random.Generator
) -> tuple[Array, list[Belief]]:
    """Draw targets from a belief, in the chart of the estimator.

    Args:
        belief: mean and covariance; with a constant acceleration, this is drawn as well.
        count: number of draws.
        rng: random generator.

    Returns:
        Chart steps (count, 20) from the mean, and the beliefs, each with the covariance of the
        given one.
    """
    chart, n = to_chart(belief.x), len(belief.P)
    P, driven = belief.P, isinstance(belief, DrivenBelief)
    if isinstance(belief, DrivenBelief):
        P = np.block([[belief.P, belief.cross], [belief.cross.T, belief.P_u]])
    errors = draws(P, count, rng)
    steps: Array = np.asarray(np.linalg.solve(to_errors(chart), errors[:, :n].T).T, np.float64)
    out: list[Belief] = []
    for y, d in zip(steps, errors, strict=True):
        x: State = to_state(chart.moved(y))
        more = {"u": belief.u + d[n:]} if isinstance(belief, DrivenBelief) and driven else {}
        out.append(replace(belief, x=x, **more))
    return steps, out


def _touched_by_draws(setup: Setup, log: FlightLog, end_ns: int) -> Flags | None:
    """Return for each of ``DRAWN_TARGETS`` targets (n,) whether the flown path touches it; None
    where contact is not checked.
    """
    if setup.contact is None:
        return None
    z = setup.rng(4).standard_normal((DRAWN_TARGETS, 6))
    return setup.contact.touched(_flown_past(setup, setup.contact, log, end_ns, z))


def _flown(log: FlightLog, end_ns: int) -> Iterator[tuple[Leg, int, int]]:
    """Legs that were flown until an instant, each with its begin and its end [ns]."""
    stamps = [leg.belief.t_ns for leg in log.legs]
    for leg, (begin_ns, next_ns) in zip(log.legs, pairwise([*stamps, end_ns]), strict=True):
        if (stop_ns := min(next_ns, end_ns)) > begin_ns:
            yield leg, begin_ns, stop_ns


def _flown_past(setup: Setup, contact: Contact, log: FlightLog, end_ns: int, z: Array) -> Array:
    """Path (m, n, 3) in {C} that was flown until an instant, past m targets whose poses differ from
    the estimate by ``z`` (m, 6) standard normal numbers.

    A draw has the same share of the pose error at all scans. Parts of the path that are farther
    from the centre of mass than the target reaches cannot touch it and are left out.
    """
    reach = float(np.linalg.norm(setup.target.hull_c, axis=1).max()) + contact.radius_m
    parts: list[Array] = [np.zeros((len(z), 0, 3))]
    for leg, begin_ns, stop_ns in _flown(log, end_ns):
        instants, r = flown_positions(leg.segment, begin_ns, stop_ns)
        times: Array = np.asarray((instants - leg.belief.t_ns) * 1e-9, np.float64)
        rho = setup.estimator.motion(leg.belief)(times)[0] if len(times) else r
        if not len(r) or float(np.linalg.norm(r - rho, axis=1).min()) > 1.5 * reach:
            continue
        parts.append(_seen_by_draws(setup, leg.belief, times, r - rho, z))
    return np.concatenate(parts, axis=1)


def _seen_by_draws(setup: Setup, belief: Belief, times: Array, d: Array, z: Array) -> Array:
    """Positions (m, n, 3) in {C} of the robot, displaced by ``d`` (n, 3) from the predicted grasp
    point, about m targets whose poses differ by ``z`` (m, 6) standard normal numbers.
    """
    root = cholesky_root(setup.estimator.pose_covariance(belief) + 1e-18 * np.eye(6))
    errors = z @ root.T
    R_ac = geometry.matrix(setup.estimator.attitude(belief)(times))
    y = np.einsum("nji,mnj->mni", R_ac, d[None] - errors[:, None, :3])
    R_bc = geometry.matrix(belief.x.q_bc)
    turns = geometry.matrix(geometry.exp(-2.0 * errors[:, 3:] @ R_bc))
    return np.asarray(np.einsum("mij,mnj->mni", turns, y))


def _in_fact(setup: Setup, log: FlightLog, state: GuidanceState, truth: Motion) -> InFact | None:
    """What happened by the true motion; None where it is not known at the end of the flight."""
    closed = state.decision.action is Action.CAPTURE
    if not closed and state.decision.action is not Action.ABORT:
        return None
    end_ns = state.segment.end_ns if closed else log.legs[-1].belief.t_ns
    touched = _touched_in_fact(setup, log, end_ns, truth)
    hit = {None: "contact not checked", True: "contact", False: "no contact"}[touched]
    if not closed:
        return InFact(False, None, touched, f"not captured, {hit}")
    leg = next((leg for leg in log.legs if leg.action is Action.CAPTURE), log.legs[-1])
    after = np.array([(end_ns - leg.belief.t_ns) * 1e-9])
    aimed = setup.estimator.attitude(leg.belief)(after)[0]
    found = closed_miss(state, setup.since_ns, truth, aimed)
    if not math.isfinite(found.distance_m):
        return None
    errors = CaptureError(found.distance_m, found.speed_mps, found.angle_deg)
    inside = found.inside(setup.task.tolerance) and found.at_s <= setup.task.deadline_s
    word = "captured" if inside and not touched else "not captured"
    return InFact(inside and not touched, errors, touched, f"{word}: {errors_text(errors)}, {hit}")


def _touched_in_fact(setup: Setup, log: FlightLog, end_ns: int, truth: Motion) -> bool | None:
    """Whether the flown path touched the true target; None where this is not known."""
    target = true_scene(truth)
    parts = [
        relative_path(target, leg.segment, setup.since_ns, begin_ns, stop_ns)
        for leg, begin_ns, stop_ns in _flown(log, end_ns)
    ]
    return setup.touched(np.concatenate([np.zeros((0, 3)), *parts]))


def _probability(good: Any) -> dict[str, Any]:
    count, number = len(good), int(np.count_nonzero(good))
    probability = number / count
    return {
        "chance": chance_of(probability),
        "probability": probability,
        "probability_95": wilson(number, count),
    }


def _planned(setup: Setup, belief: Belief) -> Plan:
    """A capture that is planned from the start of the robot, without constraints."""
    params = setup.guidance.params
    return rendezvous(setup.estimator.motion(belief), *params.start, params, belief.t_ns)


def _found_without_allowance(setup: Setup, scene: Scene, belief: Belief) -> bool:
    """Whether a capture is found from there under the constraints without an allowance for the
    predicted error of the grasp point.
    """
    limits, params = setup.guidance.limits, setup.guidance.params
    if limits.clearance_sigmas <= 0.0:
        return False
    exact = replace(limits, clearance_sigmas=0.0)
    return constrained(scene, *params.start, params, exact, belief.t_ns, setup.extent_m).found


def _planned_s(setup: Setup, belief: Belief) -> float:
    """Time to that capture; the horizon where there is none [s]."""
    found = _planned(setup, belief)
    return found.t_go_s if found.found else setup.guidance.params.horizon_s


def _predicted(setup: Setup, belief: Belief, after_s: float) -> tuple[int, float, str]:
    """The error of the grasp point in some time that is largest in units of its tolerance: which
    one, its 1 sigma, and the quantity of the belief from which it mostly comes.
    """
    found = setup.estimator.forecast(belief, np.array([after_s]))
    sizes = np.array(
        [found.pos_1s_m[-1], found.vel_1s_mps[-1], math.degrees(float(found.rot_1s_rad[-1]))]
    )
    worst = int(np.argmax(sizes / setup.limits))
    steps, drawn = drawn_beliefs(belief, DRAWN_TARGETS, setup.rng(5))
    at, errors = np.array([after_s]), np.empty((DRAWN_TARGETS, 7))
    (rho, rate), q = setup.estimator.motion(belief)(at), setup.estimator.attitude(belief)(at)[0]
    for k, each in enumerate(drawn):
        (r, v), own = setup.estimator.motion(each)(at), setup.estimator.attitude(each)(at)[0]
        turn = geometry.angle_between(own, q)
        errors[k] = [*(r - rho)[0], *(v - rate)[0], turn]
    return worst, float(sizes[worst]), _cause(steps, errors, worst)


def _cause(steps: Array, errors: Array, worst: int, pushed: Array | None = None) -> str:
    """The quantity that explains most of an error.

    Args:
        steps: (n, 20) chart steps of the draws.
        errors: (n, 7) errors of position, velocity and angle.
        worst: which of them.
        pushed: (n, 6) deviations of the robot by errors of the thrust.
    """
    part = errors[:, (slice(0, 3), slice(3, 6), slice(6, 7))[worst]]
    x = np.abs(steps) if worst == 2 else steps
    columns = [*x.T]
    names = [name for _, name in sorted(_COORDINATES)]
    if pushed is not None and np.any(pushed) and worst < 2:
        columns += list(pushed[:, 3 * worst : 3 * worst + 3].T)
        names += ["errors of the thrust"] * 3
    centred = part - part.mean(axis=0)
    total = float(np.sum(centred**2))
    shares: dict[str, float] = {}
    for name, column in zip(names, columns, strict=True):
        c = column - column.mean()
        size = float(c @ c)
        if size > 0.0 and total > 0.0:
            share = float(np.sum((c @ centred) ** 2)) / (size * total)
            grouped = name in ("errors of the thrust", "the inertia")
            shares[name] = share + (shares.get(name, 0.0) if grouped else 0.0)
    best = max(shares, key=lambda name: shares[name], default="")
    if not best or shares[best] < _LEAST_VARIANCE_SHARE:
        return f"the {_QUANTITIES[worst]} error when the gripper closes"
    return best


def _change(setup: Setup, cause: str) -> str:
    """What would change a capture that fails because of a quantity, in words."""
    if cause.startswith(("the attitude", "the rate", "the inertia", "the mass")):
        return "a longer observation would help, or a fixture nearer to the mass centre"
    if "contact" in cause:
        clear = setup.guidance.limits.clearance_m is not None
        more = "a larger limits.clearance_m" if clear else "task.approach=axis with a clearance"
        return f"another fixture or approach axis would help, or {more}"
    if "thrust" in cause:
        return "a robot with smaller errors of the thrust, or a larger tolerance, would help"
    return "a longer observation or a larger tolerance would help"


def _rule_change(rule: str) -> str:
    """What would change a flight that a rule of the supervisor ended, in words."""
    if rule in ("plan_lost", "no_plan_yet", "too_long"):
        return "more thrust or a longer time limit would help"
    if rule in ("constraint_broken", "too_close_unsure"):
        return "another fixture or wider limits would help"
    return "a longer observation or fewer rejected scans would help"
