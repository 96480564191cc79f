"""Attitude of the gripper: it turns to the attitude and the rate of the fixture within an angular
acceleration.

The turn is planned in the rotation vector from the attitude at its begin: q(t) = q0 o exp(psi(t)).
For a turn about one axis psi'' is the angular acceleration, so the time-optimal rendezvous of psi
with the fixture is exact. For a general turn the bound on psi'' is reduced until the angular
acceleration itself keeps its bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.outcome import Plan, PlanStatus
from avsreplay.plan import _cone
from avsreplay.plan.path import MOTION_FACTOR, CostatePath
from avsreplay.plan.rendezvous import PlanParams, no_plan, rendezvous
from avsreplay.records import Trajectory

ATTITUDE_GRID_S = 0.1  # spacing of the samples of the relative attitude
DIFFERENCE_S = 1e-3  # step of the difference quotients of the attitude [s]
CHECKED_INSTANTS = 201  # instants at which the angular acceleration of a turn is checked
SAME_TIME_S = 1e-3  # a capture this soon after the turn is delayed by it
REDUCTIONS = 8  # largest number of reductions of the bound on psi''

Attitude = Callable[[Array], Array]
"""Times (n,) [s] -> quaternions (n, 4) that take coordinates of a body to {A}."""


@value_class
class Turn:
    """A turn of the gripper; afterwards it follows the fixture.

    Attributes:
        t_ns: Begin of the turn.
        q0: (4,) attitude of the gripper at t_ns, q_ag.
        path: Rotation vector in the gripper's axes at t_ns [rad] as a path; None: the attitude is
            kept.
        target: Attitude of the fixture, in seconds after t_ns.
    """

    t_ns: int
    q0: Array
    path: CostatePath | None = None
    target: Attitude | None = None

    def ready_s(self, horizon_s: float) -> float:
        """Return the time until attitude and rate are those of the fixture [s].

        Args:
            horizon_s: Returned where no turn was found.
        """
        return horizon_s if self.path is None else self.path.t_go_s

    def at(self, times: Array) -> Array:
        """Return the attitude of the gripper (n, 4).

        Args:
            times: (n,) [s after t_ns].
        """
        if self.path is None or self.target is None:
            return np.tile(self.q0, (len(times), 1))
        turning = geometry.multiply(
            self.q0, geometry.exp(self.path.at(np.minimum(times, self.path.t_go_s))[0])
        )
        return np.where((times >= self.path.t_go_s)[:, None], self.target(times), turning)

    def rate(self, t: float) -> Array:
        """Return the angular rate (3,) in the gripper's axes [rad/s].

        Args:
            t: Time [s after t_ns].
        """
        rate: Array = _rates(self.at, np.array([max(t, DIFFERENCE_S)]))[0]
        return rate


def turn_to(
    target: Attitude, q0: Array, rate0: Array, accel: float, params: PlanParams, t_ns: int
) -> Turn | None:
    """Plan the turn of the gripper to the attitude and the rate of the fixture; None if none is
    found.

    Args:
        target: Attitude of the fixture, in seconds after t_ns.
        q0: (4,) attitude of the gripper at t_ns.
        rate0: (3,) its angular rate in its own axes [rad/s].
        accel: Largest angular acceleration [rad/s2].
        params: Horizon, latency and grid.
        t_ns: Begin of the turn.
    """
    found = []
    for winding in (0, -1):
        goal, end_s = _relative(target, q0, params.horizon_s, winding)
        if end_s > params.latency_s:
            found.append(
                _within(goal, target, q0, rate0, accel, replace(params, horizon_s=end_s), t_ns)
            )
    turns = [turn for turn in found if turn is not None]
    return min(turns, key=lambda turn: turn.ready_s(math.inf), default=None)


def _within(
    goal: Trajectory,
    target: Attitude,
    q0: Array,
    rate0: Array,
    accel: float,
    params: PlanParams,
    t_ns: int,
) -> Turn | None:
    """Return the turn to one branch of the relative attitude whose angular acceleration keeps its
    bound.
    """
    bound = accel
    for _ in range(REDUCTIONS):
        late = PlanParams(bound, params.horizon_s, params.latency_s, grid_s=params.grid_s)
        plan = rendezvous(goal, np.zeros(3), rate0, late, t_ns)
        if not plan.found:
            return None
        turn = Turn(t_ns, q0, CostatePath.of(plan, np.zeros(3), rate0), target)
        largest = angular_acceleration(turn)
        if largest <= accel * (1.0 + 1e-3):
            return turn
        bound *= 0.999 * accel / largest
    return None


def angular_acceleration(turn: Turn) -> float:
    """Return the largest angular acceleration of a turn [rad/s2], by difference quotients at many
    instants.

    Args:
        turn: The turn; it must have a path.
    """
    edge_s = (
        6.0 * DIFFERENCE_S
    )  # the quotients at the ends are those just inside the turn, where the largest often is
    times = np.linspace(edge_s, max(turn.ready_s(0.0) - edge_s, edge_s), CHECKED_INSTANTS)
    rates = _rates(
        turn.at, np.concatenate([times - 5.0 * DIFFERENCE_S, times + 5.0 * DIFFERENCE_S])
    )
    before, after = rates[: len(times)], rates[len(times) :]
    return float(np.linalg.norm(after - before, axis=1).max(initial=0.0)) / (10.0 * DIFFERENCE_S)


def _rates(attitude: Attitude, times: Array) -> Array:
    """Return the angular rates (n, 3) in the body's axes [rad/s] by central differences."""
    step = geometry.multiply(
        geometry.conjugate(attitude(times - DIFFERENCE_S)), attitude(times + DIFFERENCE_S)
    )
    return np.asarray(geometry.log(step) / (2.0 * DIFFERENCE_S))


def _relative(
    target: Attitude, q0: Array, horizon_s: float, winding: int
) -> tuple[Trajectory, float]:
    """Return the rotation vector from q0 to the fixture with its derivative, and the time up to
    which it is continuous.

    A rotation by theta about e is also one by theta - 2 pi; ``winding`` selects the branch at the
    begin.
    """
    times = np.linspace(0.0, horizon_s, math.ceil(horizon_s / ATTITUDE_GRID_S) + 1)
    psi = np.array(geometry.log(geometry.multiply(geometry.conjugate(q0), target(times))))
    size = np.maximum(np.linalg.norm(psi, axis=1, keepdims=True), 1e-12)
    branches = (
        psi[:, None]
        + 2.0 * math.pi * np.array([-2, -1, 0, 1, 2])[None, :, None] * (psi / size)[:, None]
    )
    nearest = np.argmin(
        np.sum((branches[1:, :, None] - branches[:-1, None]) ** 2, axis=3), axis=1
    ).tolist()
    branch = [2 + winding]
    for following in nearest:  # of each branch the nearest one at the next instant
        branch.append(following[branch[-1]])
    taken = branches[np.arange(len(times)), branch]
    jumps = np.flatnonzero(np.linalg.norm(np.diff(taken, axis=0), axis=1) > 1.0)
    last = int(jumps[0]) if len(jumps) else len(times) - 1
    if last < 4:
        return (lambda t: (np.zeros((len(t), 3)), np.zeros((len(t), 3)))), 0.0
    nodes = times[: last + 1]
    pieces = _cone.spline(nodes, taken[: last + 1])
    return (
        lambda t: (_cone.values(pieces, nodes, t, 0), _cone.values(pieces, nodes, t, 1))
    ), float(times[last])


def next_turn(
    before: Turn, target: Attitude, accel_radps2: float, params: PlanParams, t_ns: int
) -> Turn | None:
    """Return the turn to the fixture that begins after the latency; None where none was found.

    Args:
        before: The turn until then.
        target: Attitude of the fixture, in seconds after t_ns.
        accel_radps2: Largest angular acceleration [rad/s2].
        params: Horizon, latency and grid.
        t_ns: Instant of planning.
    """
    wait_s = params.latency_s
    begin_ns = t_ns + round(wait_s * 1e9)
    since_s = (begin_ns - before.t_ns) * 1e-9
    q0, rate0 = before.at(np.array([since_s]))[0], before.rate(since_s)
    late = replace(params, latency_s=0.0, horizon_s=params.horizon_s - wait_s)
    return turn_to(lambda t: target(t + wait_s), q0, rate0, accel_radps2, late, begin_ns)


def turn_time(
    target: Attitude | None, gripper: tuple[Array, float] | None, params: PlanParams, t_ns: int
) -> float | None:
    """Return the time that a gripper at rest needs to attitude and rate of the fixture [s].

    Args:
        target: Attitude of the fixture, in seconds after t_ns; None where it is not known.
        gripper: Attitude (4,) of the gripper and its largest angular acceleration [rad/s2]; None:
            not planned.
        params: Horizon, latency and grid.
        t_ns: Instant of planning.

    Returns:
        The time, or None where the attitude is not planned; infinite where no turn was found.
    """
    if target is None or gripper is None:
        return None
    turn = turn_to(target, gripper[0], np.zeros(3), gripper[1], params, t_ns)
    return math.inf if turn is None else turn.ready_s(math.inf)


def without_turn(
    before: Turn, target: Attitude, accel_radps2: float, params: PlanParams, t_ns: int
) -> Plan:
    """Return the answer where no turn was found: impossible if the rate of the fixture is out of
    reach at all times.

    Between two instants the rate changes by at most half the spacing times its largest derivative,
    times 1.5.

    Args:
        before: The turn until the end of the latency.
        target: Attitude of the fixture, in seconds after t_ns.
        accel_radps2: Largest angular acceleration [rad/s2].
        params: Largest acceleration of the end-effector, latency and horizon.
        t_ns: Instant of planning.
    """
    count, end_s = math.ceil(params.horizon_s / ATTITUDE_GRID_S), params.horizon_s - DIFFERENCE_S
    times = np.linspace(DIFFERENCE_S, end_s, count + 1)
    rates = np.linalg.norm(_rates(target, times), axis=1)
    begun = float(np.linalg.norm(before.rate((t_ns - before.t_ns) * 1e-9 + params.latency_s)))
    missing = rates - begun - accel_radps2 * np.maximum(times - params.latency_s, 0.0)
    never = float(missing.min()) > 0.5 * MOTION_FACTOR * float(np.abs(np.diff(missing)).max())
    status, bound_s = (
        (PlanStatus.INFEASIBLE, params.horizon_s)
        if never
        else (PlanStatus.NOT_FOUND, params.latency_s)
    )
    return replace(no_plan(t_ns, status, params.a_max_mps2, bound_s), delayed_by="attitude")


def with_turn(plan: Plan, turn_s: float | None) -> Plan:
    """Return the plan with the time of the gripper's turn; it is delayed by the attitude where the
    turn decides.

    Args:
        plan: The plan of the flight.
        turn_s: Time until attitude and rate are those of the fixture [s after the instant of
            planning]; None where the attitude is not planned.
    """
    if turn_s is None or not plan.found:
        return plan
    delayed_by = "attitude" if plan.t_go_s <= turn_s + SAME_TIME_S else plan.delayed_by
    return replace(plan, attitude_s=turn_s, delayed_by=delayed_by)
