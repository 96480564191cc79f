"""Evaluation of flights against the true motion of the target.

Plans and whole flights in a closed loop (replanning, thrust errors, delay) are compared with ground
truth. ``Motion`` is the ground truth, or a reference fitted to the whole log, as a function of
time. Guidance has no access to it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.plan import _cone
from avsreplay.plan.guidance import Guidance, GuidanceState, PlannerInput, Segment
from avsreplay.plan.limits import Scene, in_fixture_axes
from avsreplay.plan.path import BurnPath, CostatePath, RobotPath, StepPath
from avsreplay.plan.supervisor import Action
from avsreplay.plan.uncertainty import Disturbance, Tolerance

PATH_INSTANTS = 10  # instants between two scans at which the flown path is known

Motion = Callable[[Array], tuple[Array, Array, Array]]
"""Instants (n,) [s, on the log's clock] -> positions (n, 3), velocities (n, 3), attitudes (n, 4)
of {C} in {A}.
"""


@value_class(eq=True)
class Miss:
    """Error of a plan at its planned end against ground truth.

    Attributes:
        lead_s: Time between planning and the planned end [s].
        at_s: Planned end [s].
        distance_m, speed_mps: Distance and relative speed between robot and true grasp point.
        angle_deg: Angle between predicted and true attitude of the fixture, NaN where unknown.
    """

    lead_s: float
    at_s: float
    distance_m: float
    speed_mps: float
    angle_deg: float

    def inside(self, tolerance: Tolerance) -> bool:
        """Return whether the errors are within the tolerance; an unknown angle is accepted.

        Args:
            tolerance: Largest errors of a successful capture.
        """
        angle = math.isnan(self.angle_deg) or self.angle_deg <= tolerance.angle_deg
        return (
            self.distance_m <= tolerance.position_m
            and self.speed_mps <= tolerance.speed_mps
            and angle
        )


def miss(path: RobotPath, t_s: float, truth: Motion, attitude: Array | None = None) -> Miss:
    """Compare the end of a path with ground truth.

    Args:
        path: Path of the robot.
        t_s: Begin of the path on the clock of ``truth`` [s].
        truth: True motion of the fixture.
        attitude: (4,) predicted q_ac at the end, None where unknown.
    """
    position, velocity = path.at(np.array([path.t_go_s]))
    return _miss_at(t_s + path.t_go_s, path.t_go_s, position[0], velocity[0], truth, attitude)


def _miss_at(
    at_s: float, lead_s: float, r: Array, v: Array, truth: Motion, attitude: Array | None
) -> Miss:
    rho, rate, q = truth(np.array([at_s]))
    turn = math.nan
    if attitude is not None:
        turn = math.degrees(float(geometry.angle_between(q[0], attitude)))
    return Miss(
        lead_s, at_s, float(np.linalg.norm(rho[0] - r)), float(np.linalg.norm(rate[0] - v)), turn
    )


def closed_miss(
    state: GuidanceState, since_ns: int, truth: Motion, attitude: Array | None = None
) -> Miss:
    """Return the error when the gripper closes, at the end of the current segment.

    Args:
        state: State of a guidance whose action is ``capture``.
        since_ns: Instant from which ``truth`` counts its seconds.
        truth: True motion of the fixture.
        attitude: (4,) q_ac of the gripper.
    """
    end_ns = state.segment.end_ns
    made_ns = end_ns if state.plan is None else state.plan.t_ns
    r, v = state.segment.at(end_ns)
    return _miss_at((end_ns - since_ns) * 1e-9, (end_ns - made_ns) * 1e-9, r, v, truth, attitude)


def true_scene(truth: Motion) -> Scene:
    """Return the target of a true motion.

    Args:
        truth: True motion of the fixture.
    """
    return Scene(lambda times: truth(times)[:2], lambda times: truth(times)[2])


def interpolated(times_s: Array, poses: Sequence[geometry.Pose]) -> Motion:
    """Interpolate recorded poses: cubic spline for the position, constant angular rate between
    attitudes.

    Args:
        times_s: (n,) ascending times [s], n >= 4.
        poses: n poses T_ac.

    Returns:
        A motion that is NaN outside the recorded times.

    Raises:
        ValueError: There are too few poses, or the times do not ascend.
    """
    times = np.asarray(times_s, dtype=np.float64)
    if len(times) < 4 or len(times) != len(poses) or np.any(np.diff(times) <= 0.0):
        raise ValueError(
            f"{len(poses)} poses at {len(times)} instants, must be at least 4 at ascending instants"
        )
    line, q = _cone.spline(times, np.array([p.t for p in poses])), np.array([p.q for p in poses])
    turns = geometry.log(
        geometry.multiply(geometry.conjugate(q[:-1]), q[1:])
    )  # (n - 1, 3) between the poses

    def at(instants: Array) -> tuple[Array, Array, Array]:
        inside = (instants >= times[0]) & (instants <= times[-1])
        position, velocity = (_cone.values(line, times, instants, order) for order in (0, 1))
        k = np.clip(np.searchsorted(times, instants, "right") - 1, 0, len(turns) - 1)
        share = np.clip((instants - times[k]) / (times[k + 1] - times[k]), 0.0, 1.0)
        attitude = geometry.multiply(q[k], geometry.exp(share[:, None] * turns[k]))
        for values in (position, velocity, attitude):
            values[~inside] = np.nan
        return position, velocity, attitude

    return at


Decided = tuple[float, str, str]
"""Time after the first scan [s], action and rule of a decision of the supervisor."""


def changes_of(decisions: Iterable[Decided]) -> tuple[Decided, ...]:
    """Return the decisions that differ from the one before.

    Args:
        decisions: one after each scan.
    """
    return tuple(next(alike) for _, alike in groupby(decisions, key=itemgetter(1, 2)))


@value_class
class Ended:
    """End of one simulated approach.

    Attributes:
        actions: (t_s, action, rule) at every change of the supervisor's decision.
        at_s: instant at which the gripper closed, else that of the last decision.
        miss: errors when the gripper closed; None where it did not.
        path: (n, 3) the flown path from the grasp point in {C} [m]; empty where the attitude of the
            target is not known.
    """

    actions: tuple[Decided, ...]
    at_s: float
    miss: Miss | None
    path: Array

    @property
    def rule(self) -> str:
        """The rule of the last decision."""
        return self.actions[-1][2]

    def outcome(self, tolerance: Tolerance) -> str:
        """Return ``captured``, ``outside`` (closed outside the tolerance) or the last action.

        Args:
            tolerance: Largest errors of a capture.
        """
        if self.miss is None:
            return self.actions[-1][1]
        return "captured" if self.miss.inside(tolerance) else "outside"


def pushed(segment: Segment, t_ns: int, dr: Array, dv: Array) -> Segment:
    """Return the segment of a robot that has left its path: from t_ns on it flies the same thrust
    from its own state.

    Args:
        segment: What the robot flies.
        t_ns: Instant of the deviation.
        dr: (3,) deviation of the position [m].
        dv: (3,) deviation of the velocity [m/s].
    """
    since_s = (t_ns - segment.t_ns) * 1e-9
    r0, v0 = segment.r0 + dr - since_s * dv, segment.v0 + dv
    path = segment.path
    if isinstance(path, (CostatePath, StepPath, BurnPath)):
        path = replace(path, r0=r0, v0=v0)
    previous = None if segment.previous is None else pushed(segment.previous, t_ns, dr, dv)
    return replace(segment, r0=r0, v0=v0, path=path, previous=previous)


def with_thrust_error(
    segment: Segment, t_ns: int, span_s: float, thrust: Disturbance | None
) -> Segment:
    """Return the segment of a robot whose thrust was wrong since the last scan; a coasting robot
    has no error.

    Args:
        segment: What the robot flies.
        t_ns: Instant of the present scan.
        span_s: Time since the last one [s], during which the error was constant.
        thrust: The errors; None: there are none.
    """
    if segment.path is None or thrust is None or thrust.sigma_mps2 == 0.0 or span_s <= 0.0:
        return segment
    u = thrust.mean_over(span_s)
    return pushed(segment, t_ns, 0.5 * span_s * span_s * u, span_s * u)


def closed_loop(
    guidance: Guidance,
    inputs: Generator[PlannerInput, GuidanceState, None],
    target: Scene,
    start_ns: int,
    thrust: Disturbance | None = None,
    state: GuidanceState | None = None,
) -> Ended:
    """Fly one approach with replanning, errors of the thrust and the delay of the planner.

    Args:
        guidance: Guidance of the robot.
        inputs: What is known after each scan, in the order of the scans; the state after each is
            sent to it.
        target: The true target.
        start_ns: Instant from which its times count.
        thrust: Errors of the thrust, constant between two scans and independent from one interval
            to the next; None: there are none.
        state: State of the robot at ``start_ns``; None: at its configured start.

    Raises:
        ValueError: There is no input.
    """
    aimed: Array | None = None
    decisions: list[Decided] = []
    last_ns, known, state = start_ns, next(inputs, None), state or guidance.initial(start_ns)
    flown = [np.zeros((0, 3))]
    while known is not None:
        span = (known.t_ns - last_ns) * 1e-9
        flown.append(relative_path(target, state.segment, start_ns, last_ns, known.t_ns))
        segment = with_thrust_error(state.segment, known.t_ns, span, thrust)
        state, last_ns = guidance.step(replace(state, segment=segment), known), known.t_ns
        decision, t_s = state.decision, (known.t_ns - start_ns) * 1e-9
        decisions.append((t_s, decision.action.value, decision.rule))
        closing, attitude = state.decision.action is Action.CAPTURE, known.scene.attitude
        if closing and aimed is None and attitude is not None:
            aimed = attitude(np.array([(state.segment.end_ns - known.t_ns) * 1e-9]))[0]
        ended = state.captured_ns is not None or state.decision.action is Action.ABORT
        known = None if ended else _sent(inputs, state)
    if not decisions:
        raise ValueError("the log contains no scan")
    actions, path = changes_of(decisions), np.concatenate(flown)
    if state.decision.action is not Action.CAPTURE:
        return Ended(actions, (last_ns - start_ns) * 1e-9, None, path)

    def truth(times: Array) -> tuple[Array, Array, Array]:
        turned = np.full((len(times), 4), np.nan)
        return *target.goal(times), turned if target.attitude is None else target.attitude(times)

    found = closed_miss(state, start_ns, truth, aimed)
    return Ended(actions, found.at_s, found, path)


def _sent(
    inputs: Generator[PlannerInput, GuidanceState, None], state: GuidanceState
) -> PlannerInput | None:
    """The next input after a state; None at the end."""
    try:
        return inputs.send(state)
    except StopIteration:
        return None


def flown_positions(
    segment: Segment, begin_ns: int, end_ns: int
) -> tuple[NDArray[np.int64], Array]:
    """Return ten instants (n,) [ns] from ``begin_ns`` on before ``end_ns``, and the positions
    (n, 3) in {A}, up to the end of the segment.

    Args:
        segment: What the robot flies.
        begin_ns: First instant.
        end_ns: End of the interval.
    """
    steps = np.arange(PATH_INSTANTS, dtype=np.int64)
    instants = begin_ns + steps * (end_ns - begin_ns) // PATH_INSTANTS
    if segment.path is not None:
        instants = instants[instants <= segment.end_ns]
    return instants, segment.positions(instants)


def relative_path(
    scene: Scene, segment: Segment, start_ns: int, begin_ns: int, end_ns: int
) -> Array:
    """Return the positions (n, 3) of the robot from the grasp point in {C} between two scans, where
    the target is known.

    Args:
        scene: The target.
        segment: What the robot flies.
        start_ns: Instant from which the times of the scene count.
        begin_ns: First scan.
        end_ns: The other scan.
    """
    instants, r = flown_positions(segment, begin_ns, end_ns)
    if not len(r) or scene.attitude is None:
        return np.zeros((0, 3))
    times = np.asarray((instants - start_ns) * 1e-9, dtype=np.float64)
    y = in_fixture_axes(geometry.matrix(scene.attitude(times)), r - scene.goal(times)[0])
    return y[np.isfinite(y).all(axis=1)]
