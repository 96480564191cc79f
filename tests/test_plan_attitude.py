"""The turn of the gripper: closed form, the angular bound, the end condition, and its
coupling with the flight.
"""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avsreplay.outcome import PlanStatus
from avsreplay.plan.attitude import Turn, angular_acceleration, turn_to, without_turn
from avsreplay.plan.constrained import constrained
from avsreplay.plan.limits import Scene
from avsreplay.plan.path import path_of
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.plan.robot import Limits

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
PARAMS = PlanParams(horizon_s=60.0)
REST = np.zeros(3)


def spinning(axis, angle, rate):
    """Attitude of a body that turns about one axis."""
    e = np.array(axis, dtype=float) / np.linalg.norm(axis)
    return lambda t: Rotation.from_rotvec((angle + rate * np.asarray(t))[:, None] * e).as_quat()


def tumbling(seed):
    """Attitude of a body whose axis of rotation moves."""
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 3))
    start = Rotation.random(random_state=seed)
    wa, wb = rng.uniform(0.02, 0.08, 2)

    def attitude(t):
        first = Rotation.from_rotvec(np.outer(wa * np.asarray(t), a / np.linalg.norm(a)))
        second = Rotation.from_rotvec(np.outer(wb * np.asarray(t), b / np.linalg.norm(b)))
        return (first * start * second).as_quat()

    return attitude


@pytest.mark.parametrize("angle", [0.3, 1.5, 3.0])
def test_rest_to_rest_about_one_axis_in_closed_form(angle):
    turn = turn_to(spinning([1, 2, -1], angle, 0.0), IDENTITY, REST, 0.02, PARAMS, 0)
    assert turn.ready_s(0.0) == pytest.approx(2.0 * math.sqrt(angle / 0.02), rel=1e-3)


def test_the_shorter_way_round_is_taken():
    turn = turn_to(spinning([0, 0, 1], 3.0, 0.05), IDENTITY, REST, 0.02, PARAMS, 0)
    back = turn_to(spinning([0, 0, 1], 3.0, -0.05), IDENTITY, REST, 0.02, PARAMS, 0)
    onward = rendezvous(
        lambda t: (np.outer(3.0 + 0.05 * t, [0, 0, 1]), np.tile([0, 0, 0.05], (len(t), 1))),
        REST,
        REST,
        PlanParams(a_max_mps2=0.02),
    )
    other = rendezvous(
        lambda t: (
            np.outer(3.0 - 2 * np.pi + 0.05 * t, [0, 0, 1]),
            np.tile([0, 0, 0.05], (len(t), 1)),
        ),
        REST,
        REST,
        PlanParams(a_max_mps2=0.02),
    )
    assert turn.ready_s(0.0) == pytest.approx(min(onward.t_go_s, other.t_go_s), rel=2e-3)
    assert back.ready_s(0.0) < turn.ready_s(0.0)


@pytest.mark.parametrize(
    ("accel", "status"), [(0.0016, PlanStatus.INFEASIBLE), (0.0017, PlanStatus.NOT_FOUND)]
)
def test_a_rate_out_of_reach_is_proven_impossible_and_no_other(accel, status):
    """In 60 s the gripper reaches 60 s times its angular acceleration, the fixture has 0.1
    rad/s.
    """
    target = spinning([0, 0, 1], 3.0, 0.1)
    assert turn_to(target, IDENTITY, REST, accel, PARAMS, 0) is None
    answer = without_turn(Turn(0, IDENTITY), target, accel, PARAMS, 0)
    assert answer.status is status
    assert answer.delayed_by == "attitude"
    moving = Turn(0, IDENTITY, turn_to(target, IDENTITY, REST, 0.02, PARAMS, 0).path, target)
    assert without_turn(moving, target, accel, PARAMS, round(30e9)).status is PlanStatus.NOT_FOUND


@pytest.mark.parametrize("seed", range(6))
def test_attitude_and_rate_agree_at_the_end_within_the_bound(seed):
    target, accel = tumbling(seed), 0.03
    q0 = Rotation.random(random_state=100 + seed).as_quat()
    turn = turn_to(target, q0, REST, accel, PARAMS, 0)
    end = turn.ready_s(math.nan)
    assert math.isfinite(end)
    assert np.allclose(turn.at(np.zeros(1))[0], q0) or np.allclose(turn.at(np.zeros(1))[0], -q0)
    before, after = (Rotation.from_quat(turn.at(np.array([end + s]))[0]) for s in (-1e-4, 1e-4))
    exact = Rotation.from_quat(target(np.array([end]))[0])
    assert (before.inv() * exact).magnitude() < 1e-4
    rates = [
        (
            Rotation.from_quat(f(np.array([end - 2e-3]))[0]).inv()
            * Rotation.from_quat(f(np.array([end - 1e-3]))[0])
        ).as_rotvec()
        / 1e-3
        for f in (turn.at, target)
    ]
    assert np.allclose(*rates, atol=1e-4)
    assert (before.inv() * after).magnitude() < 1e-3
    assert angular_acceleration(turn) <= accel * (1 + 2e-3)


@pytest.mark.parametrize("seed", [15, 51])
def test_the_bound_holds_at_the_end_of_the_turn_where_the_acceleration_is_largest(seed):
    accel = 0.004
    turn = turn_to(tumbling(seed), IDENTITY, REST, accel, PlanParams(horizon_s=150.0), 0)
    t = turn.ready_s(math.nan) - np.array([0.03, 0.02, 0.01])
    before, middle, after = Rotation.from_quat(turn.at(t))
    change = (middle.inv() * after).as_rotvec() - (before.inv() * middle).as_rotvec()
    assert np.linalg.norm(change) / 0.01**2 <= accel * (1 + 2e-3)


def test_the_capture_is_the_later_of_flight_and_turn():
    def goal(t):
        return (
            np.stack([0 * t, 4.0 + 0.01 * t, 0 * t], 1),
            np.tile([0.0, 0.01, 0.0], (len(t), 1)),
        )

    free = rendezvous(goal, REST, REST, PARAMS)
    assert rendezvous(goal, REST, REST, PARAMS, earliest_s=free.t_go_s - 1.0).t_go_s == free.t_go_s
    late = rendezvous(goal, REST, REST, PARAMS, earliest_s=free.t_go_s + 7.0)
    assert late.status is PlanStatus.OPTIMAL
    assert late.t_go_s == pytest.approx(free.t_go_s + 7.0)
    assert late.u_max < free.u_max
    assert late.position_error_m < 1e-8
    limited = constrained(
        Scene(goal), REST, REST, PARAMS, Limits(speed_max_mps=0.3), earliest_s=40.0
    )
    assert limited.t_go_s >= 40.0 - 1e-9
    assert limited.t_go_s == pytest.approx(40.0, abs=1e-3)
    speed = np.linalg.norm(
        path_of(limited, REST, REST).at(np.linspace(0.0, limited.t_go_s, 2001))[1], axis=1
    )
    assert speed.max() <= 0.3 * (1 + 1e-6)
