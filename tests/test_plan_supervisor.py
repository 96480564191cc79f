"""The supervisor: every rule can apply, and their order holds. Guidance: flights on a
constructed estimate.
"""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from avsreplay.geometry import IDENTITY_QUAT, Pose, exp
from avsreplay.plan.flights import closed_loop, interpolated, miss, true_scene
from avsreplay.plan.guidance import Guidance, PlannerInput
from avsreplay.plan.limits import Scene
from avsreplay.plan.path import CostatePath
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.plan.robot import Limits
from avsreplay.plan.supervisor import (
    RULES,
    Action,
    Facts,
    Supervisor,
    SupervisorMemory,
    SupervisorParams,
)
from avsreplay.plan.uncertainty import Tolerance
from avsreplay.records import Forecast

PARAMS = SupervisorParams().resolved(8.0)
GOOD = Facts(
    t_s=50.0,
    gamma=1,
    converged=True,
    planned=True,
    t_go_s=10.0,
    pos_1s_m=0.002,
    vel_1s_mps=0.001,
    rot_1s_deg=0.1,
    distance_m=3.0,
    now_1s_m=0.001,
)
MOVING = SupervisorMemory(Action.APPROACH, "healthy", 49.8, 9, None, True)
HOLDING = SupervisorMemory(Action.HOLD, "prediction_poor", 49.8, 0, 45.0, True)
POOR = {"pos_1s_m": 0.5}

REACHED = {
    "aborted": (SupervisorMemory(Action.ABORT, "held_too_long", moving=True), {}),
    "captured": (
        SupervisorMemory(Action.CAPTURE, "arrived_sure", moving=True),
        {"gamma": 0, "converged": False},
    ),
    "held_too_long": (dataclasses.replace(HOLDING, held_since_s=-11.0), {}),
    "constraint_broken": (MOVING, {"margin": -0.01}),
    "too_long": (dataclasses.replace(MOVING, began_s=-600.0), {}),
    "too_many_attempts": (dataclasses.replace(HOLDING, attempts=5), {}),
    "too_close_unsure": (MOVING, {**POOR, "distance_m": 0.5, "now_1s_m": 0.2}),
    "not_converged": (SupervisorMemory(), {"converged": False}),
    "convergence_lost": (MOVING, {"converged": False}),
    "no_plan_yet": (SupervisorMemory(), {"planned": False}),
    "plan_lost": (MOVING, {"planned": False}),
    "blind_at_rest": (SupervisorMemory(seen_s=49.8), {"gamma": 0}),
    "recovering": (HOLDING, {}),
    "arrived_sure": (MOVING, {"t_go_s": 0.4}),
    "arrived_unsure": (MOVING, {"t_go_s": 0.4, **POOR}),
    "healthy": (MOVING, POOR),
    "prediction_good": (MOVING, {"gamma": 0}),
    "blind_holding": (HOLDING, {"gamma": 0, **POOR}),
    "short_gap": (MOVING, {"gamma": 0, **POOR}),
    "prediction_poor": (dataclasses.replace(MOVING, seen_s=40.0), {"gamma": 0, **POOR}),
}


@pytest.mark.parametrize("rule", [rule.name for rule in RULES])
def test_every_rule_is_reached(rule):
    memory, change = REACHED[rule]
    after, decision = Supervisor(PARAMS).decide(memory, dataclasses.replace(GOOD, **change))
    assert decision.rule == rule
    assert decision.action is next(r for r in RULES if r.name == rule).action
    assert after.action is decision.action


def test_the_page_documents_every_rule():
    page = (Path(__file__).parents[1] / "docs" / "planning.md").read_text(encoding="utf-8")
    for rule in RULES:
        assert f"| `{rule.name}` | {rule.action.value} |" in page


def test_every_action_can_be_chosen():
    assert {rule.action for rule in RULES} == set(Action)


def test_an_unknown_sigma_never_counts_as_good():
    supervisor = Supervisor(PARAMS)
    facts = dataclasses.replace(GOOD, t_go_s=0.1, pos_1s_m=math.nan)
    assert supervisor.decide(MOVING, facts)[1].rule == "arrived_unsure"


def test_a_hold_keeps_its_begin_and_loses_it_when_it_ends():
    supervisor = Supervisor(PARAMS)
    memory, _ = supervisor.decide(HOLDING, dataclasses.replace(GOOD, gamma=0, **POOR))
    assert memory.held_since_s == 45.0
    for expected in ("recovering", "healthy"):
        memory, decision = supervisor.decide(memory, GOOD)
        assert decision.rule == expected
    assert memory.held_since_s is None


@pytest.mark.parametrize("scans", [1, 2])
def test_holds_of_single_scans_use_no_attempt(scans):
    """Twenty holds that are shorter than a gap that is bridged, in one approach."""
    supervisor, memory = Supervisor(PARAMS), SupervisorMemory()
    t, held = 0.0, 0
    for _ in range(20):
        for converged in (*[True] * 4, *[False] * scans):
            t += 0.2
            facts = dataclasses.replace(GOOD, t_s=t, converged=converged)
            memory, decision = supervisor.decide(memory, facts)
            held += decision.rule == "convergence_lost"
    assert held == 20 * scans
    assert memory.attempts == 1
    assert memory.action is not Action.ABORT


def test_lengths_scale_with_the_target():
    small, big = SupervisorParams().resolved(0.2), SupervisorParams().resolved(8.0)
    assert big.capture_pos_m == pytest.approx(0.02)
    assert small.capture_pos_m / big.capture_pos_m == pytest.approx(0.2 / 8.0)
    with pytest.raises(ValueError, match="capture_pos_m is None"):
        Supervisor(SupervisorParams())
    with pytest.raises(ValueError, match="hold_limit_s is -1"):
        SupervisorParams(hold_limit_s=-1.0)


def turning(rate=0.1, arm=1.0, distance=5.0):
    """Grasp point on a body that turns about y, [s from 0]."""

    def at(t):
        c, s = np.cos(rate * t), np.sin(rate * t)
        zero = np.zeros_like(t)
        position = np.stack([zero + arm * s, zero, distance - arm * c], 1)
        velocity = np.stack([arm * rate * c, zero, arm * rate * s], 1)
        return position, velocity, exp(np.stack([zero, -rate * t, zero], 1))

    return at


def inputs(
    truth, error=0.0, blind=(), sigma=(0.001, 0.0003, 0.001), growth=0.0, end=90.0, from_s=5.0
):
    """What a made-up estimator knows: the truth, moved by ``error`` [m]; sigmas grow with
    prediction time.
    """
    seen = 0.0
    for t in np.arange(0.0, end, 0.2):
        gamma = int(not any(a <= t < b for a, b in blind))
        seen = t if gamma else seen

        def goal(dt, t=t):
            position, velocity, _ = truth(t + dt)
            return position + np.array([error, 0, 0]), velocity

        def forecast(dt, t=t, seen=seen):
            grown = 1.0 + growth * (t - seen + dt)
            return Forecast(dt, sigma[0] * grown, sigma[1] * grown, sigma[2] * grown)

        x = np.array([0.0, 0.0, -1.0])
        scene = Scene(goal, lambda dt, t=t: truth(t + dt)[2], x, -x, hull_c=1.5 * x[None] - x)
        yield PlannerInput(round(t * 1e9), gamma, t >= from_s, scene, forecast)


def fly(truth, **kwargs):
    guidance = Guidance(PlanParams(), Supervisor(PARAMS))
    return closed_loop(guidance, inputs(truth, **kwargs), true_scene(truth), 0)


def rules_of(execution):
    return [rule for _, _, rule in execution.actions]


def test_a_clear_view_ends_in_a_capture():
    execution = fly(turning())
    assert execution.outcome(Tolerance()) == "captured"
    assert execution.miss.distance_m < 1e-6
    assert execution.miss.speed_mps < 1e-6
    assert execution.miss.angle_deg < 1e-4
    assert rules_of(execution) == ["not_converged", "healthy", "arrived_sure", "captured"]


def test_replanning_does_not_move_a_capture_that_was_right():
    truth = turning()
    execution = fly(truth)
    plan = rendezvous(lambda t: truth(t + 5.0)[:2], np.zeros(3), np.zeros(3))
    assert execution.miss.at_s == pytest.approx(5.0 + plan.t_go_s, abs=1e-6)


def test_a_biased_estimate_misses_by_its_bias():
    execution = fly(turning(), error=0.03)
    assert execution.outcome(Tolerance()) == "outside"
    assert execution.miss.distance_m == pytest.approx(0.03, abs=1e-6)


def test_without_vision_a_good_prediction_continues():
    execution = fly(turning(), blind=[(15.0, 60.0)])
    assert execution.outcome(Tolerance()) == "captured"
    assert "prediction_good" in rules_of(execution)


def test_without_vision_a_poor_prediction_holds_and_then_captures():
    truth = turning()
    execution = fly(truth, blind=[(15.0, 40.0)], growth=2.0)
    assert "prediction_poor" in rules_of(execution)
    assert "recovering" in rules_of(execution)
    assert execution.outcome(Tolerance()) == "captured"
    assert execution.miss.at_s > 40.0


def test_vision_lost_for_too_long_aborts():
    execution = fly(turning(), blind=[(15.0, 120.0)], growth=2.0, end=120.0)
    assert execution.outcome(Tolerance()) == "abort"
    assert execution.miss is None


def test_never_converged_never_moves():
    execution = fly(turning(), from_s=1e9)
    assert rules_of(execution) == ["not_converged"]
    assert execution.actions[-1][1] == "stand_still"


def test_latency_is_flown_on_the_current_segment():
    truth = turning()
    guidance = Guidance(PlanParams(latency_s=0.7), Supervisor(PARAMS))
    positions = []
    for known, memory in guidance.fly(inputs(truth)):
        positions.append(memory.segment.at(known.t_ns)[0])
        if memory.captured_ns is not None:
            break
    at_converged = round(5.0 / 0.2)
    assert np.all(
        np.array(positions[: at_converged + 4]) == 0.0
    )  # the first plan's thrust begins 0.7 s later
    jumps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert jumps.max() < 0.05 * 0.2 * 25  # no faster than thrust allows: the path is continuous
    execution = closed_loop(guidance, inputs(truth), true_scene(truth), 0)
    assert execution.miss.distance_m < 1e-6


def test_a_violated_limit_makes_the_robot_retreat():
    truth = turning()
    guidance = Guidance(PlanParams(), Supervisor(PARAMS))
    for known, memory in guidance.fly(inputs(truth)):
        if known.t_ns > 12e9:  # a speed limit that the plan in force does not know
            guidance.limits = Limits(speed_max_mps=0.2)
        if memory.decision.rule == "constraint_broken":
            break
    assert memory.decision.action is Action.RETREAT
    speed = [
        np.linalg.norm(memory.segment.at(known.t_ns + round(s * 1e9))[1]) for s in (0.0, 2.0, 4.0)
    ]
    assert speed[0] > speed[1] > speed[2]


def test_latency_leaves_a_costate_that_flies_the_plan():
    truth = turning()
    guidance = Guidance(PlanParams(latency_s=0.7), Supervisor(PARAMS))
    for known, memory in guidance.fly(inputs(truth)):  # noqa: B007
        if memory.plan is not None:
            break
    flight = CostatePath.of(
        memory.plan, np.zeros(3), np.zeros(3)
    )  # at rest the current segment is a coast
    assert flight.terminal_errors(known.scene.goal)[0] < 1e-8
    assert memory.segment.end_ns == pytest.approx(known.t_ns + flight.t_go_s * 1e9, abs=2)


def test_hindsight_of_a_plan_that_was_right_is_zero():
    truth = turning()
    goal = lambda t: truth(t + 3.0)[:2]  # noqa: E731
    plan = rendezvous(goal, np.zeros(3), np.zeros(3))
    q = truth(np.array([3.0 + plan.t_go_s]))[2][0]
    found = miss(CostatePath.of(plan, np.zeros(3), np.zeros(3)), 3.0, truth, q)
    assert found.distance_m < 1e-8
    assert found.speed_mps < 1e-8
    assert found.angle_deg < 1e-5
    assert found.lead_s == plan.t_go_s


def test_recorded_poses_become_a_motion():
    truth, times = turning(), np.arange(0.0, 60.0, 0.2)
    position, _, attitude = truth(times)
    motion = interpolated(times, [Pose(q, t) for q, t in zip(attitude, position, strict=True)])
    at = np.array([7.31, 20.0, 33.33])
    for got, expected, bound in zip(motion(at)[:2], truth(at)[:2], (1e-8, 1e-6), strict=True):
        assert np.abs(got - expected).max() < bound
    turn = np.abs(np.sum(motion(at)[2] * truth(at)[2], axis=1))
    assert np.all(turn > 1 - 1e-9)
    assert np.isnan(motion(np.array([60.5]))[0]).all()
    with pytest.raises(ValueError, match="3 poses"):
        interpolated(times[:3], [Pose(IDENTITY_QUAT, np.zeros(3))] * 3)


@pytest.mark.parametrize("times", [[0.0, 1.0, 1.0, 2.0], [0.0, 2.0, 1.0, 3.0], [0.0, 1.0, 2.0]])
def test_poses_at_equal_or_descending_instants_or_fewer_than_four_are_no_motion(times) -> None:
    with pytest.raises(ValueError, match="ascending instants"):
        interpolated(np.array(times), [Pose.identity()] * len(times))
