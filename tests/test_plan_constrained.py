"""Plans under limits: the limits hold between the nodes, and inactive limits do not change a
plan.
"""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from avsreplay.outcome import PlanStatus
from avsreplay.plan._cone import Body
from avsreplay.plan.cone_programme import solve
from avsreplay.plan.constrained import constrained, linearised_s, with_safety
from avsreplay.plan.convexification import Case, warm_reference
from avsreplay.plan.limits import SampledScene, Scene, margin
from avsreplay.plan.path import StepPath, path_of
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.plan.robot import Limits
from avsreplay.plan.withdrawal import KEPT_SHARE, Space, coasting, escapes_at, withdrawal

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from plan_scenes import problems

ORIGIN = np.zeros(3)
PARAMS = PlanParams(a_max_mps2=0.05)
CENTRE = np.array([0.0, 0.0, 5.0])


def body(rate=0.03, arm=1.0, phase=0.5):
    """A target that turns about y at ``rate``; the grasp point lies on an arm along +x of
    {C}, as does the axis.
    """

    def axis(t):
        return np.stack([np.sin(rate * t + phase), 0 * t, -np.cos(rate * t + phase)], 1)

    def turn(t):
        return rate * np.stack([np.cos(rate * t + phase), 0 * t, np.sin(rate * t + phase)], 1)

    def attitude(t):
        x = axis(t)
        y = np.tile([0.0, 1.0, 0.0], (len(t), 1))
        return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=2)).as_quat()

    x = np.array([1.0, 0.0, 0.0])
    return Scene(lambda t: (CENTRE + arm * axis(t), arm * turn(t)), attitude, x, -arm * x)


def axis_of(scene, times):
    return Rotation.from_quat(scene.attitude(times)).apply(scene.axis_c)


def flown(plan, scene, per_second=2000):
    """Times, path, velocity, and the target along a plan."""
    path = path_of(plan, ORIGIN, ORIGIN)
    times = np.linspace(0.0, plan.t_go_s, int(plan.t_go_s * per_second))
    return times, *path.at(times), scene.goal(times)[0], axis_of(scene, times)


def across(r, apex, axis):
    along = np.sum((r - apex) * axis, axis=1)
    return (
        along,
        np.linalg.norm(r - apex - along[:, None] * axis, axis=1),
        np.linalg.norm(r - apex, axis=1),
    )


def test_no_limit_is_the_certified_plan():
    for seed in range(4):
        rng = np.random.default_rng(seed)
        scene = body(rng.uniform(0.02, 0.2), rng.uniform(0.5, 1.5), rng.uniform(0, 6))
        free = rendezvous(scene.goal, ORIGIN, ORIGIN, PARAMS)
        plan = constrained(scene, ORIGIN, ORIGIN, PARAMS, Limits())
        assert plan.status is PlanStatus.OPTIMAL
        assert plan.t_go_s == free.t_go_s
        assert plan.u_max <= PARAMS.a_max_mps2 * (1 + 1e-6)


def test_a_limit_that_does_not_act_changes_nothing():
    plan = constrained(body(), ORIGIN, ORIGIN, PARAMS, Limits(speed_max_mps=5.0))
    free = rendezvous(body().goal, ORIGIN, ORIGIN, PARAMS)
    assert plan.status is PlanStatus.OPTIMAL
    assert plan.t_go_s == pytest.approx(free.t_go_s, abs=1e-3)


def test_speed_limit_from_rest_to_rest_in_closed_form():
    goal = lambda t: (np.tile([5.0, 0, 0], (len(t), 1)), np.zeros((len(t), 3)))  # noqa: E731
    plan = constrained(Scene(goal), ORIGIN, ORIGIN, PARAMS, Limits(speed_max_mps=0.3, nodes=100))
    exact = 5.0 / 0.3 + 0.3 / 0.05  # up, along, down
    assert plan.t_go_s == pytest.approx(exact, abs=5e-3)
    assert plan.t_go_s >= exact - 1e-6
    assert plan.status is PlanStatus.FEASIBLE
    assert np.linalg.norm(path_of(plan, ORIGIN, ORIGIN).nodes()[1], axis=1).max() <= 0.3 * (
        1 + 1e-6
    )


def test_cone_holds_between_nodes_and_costs_time():
    scene, limits = body(), Limits(cone_deg=25.0, cone_range_m=2.0, mouth_m=0.01)
    plan = constrained(scene, ORIGIN, ORIGIN, PARAMS, limits)
    free = rendezvous(scene.goal, ORIGIN, ORIGIN, PARAMS)
    assert plan.status is PlanStatus.FEASIBLE
    assert plan.t_go_s > free.t_go_s + 0.1
    assert plan.lower_bound_s == pytest.approx(free.lower_bound_s)
    assert plan.binding == "cone"
    _, r, _, apex, axis = flown(plan, scene)
    along, off, distance = across(r, apex, axis)
    near = distance <= 2.0
    assert near.sum() > 100
    assert np.max((off - math.tan(math.radians(25.0)) * along - 0.01)[near]) <= 1e-6


@pytest.mark.parametrize("towards", [-1.0, 1.0])
def test_the_linearised_time_to_go_follows_that_of_new_plans(towards):
    """A target that is displaced along the way by 4 cm."""
    scene, limits = body(), Limits(cone_deg=25.0, cone_range_m=2.0, mouth_m=0.01)
    shift = np.array([0.0, 0.0, 0.04 * towards])

    def goal(t):
        position, velocity = scene.goal(t)
        return position + shift, velocity

    moved = replace(scene, goal=goal)
    plan, other = (constrained(s, ORIGIN, ORIGIN, PARAMS, limits) for s in (scene, moved))
    own = path_of(plan, ORIGIN, ORIGIN), PARAMS, limits, 8.0
    found = linearised_s(moved, *own) - linearised_s(scene, *own)
    assert found == pytest.approx(other.t_go_s - plan.t_go_s, rel=0.15)


def test_last_metres_go_along_the_axis():
    scene = body()
    limits = Limits(cone_deg=40.0, final_deg=5.0, final_range_m=0.6, mouth_m=0.01)
    plan = constrained(scene, ORIGIN, ORIGIN, PARAMS, limits)
    _, r, _, apex, axis = flown(plan, scene)
    along, off, distance = across(r, apex, axis)
    last = distance <= 0.6
    assert np.max((off - math.tan(math.radians(5.0)) * along - 0.01)[last]) <= 1e-6


def test_contact_is_smooth():
    scene, bound = body(0.1), 0.02
    plan = constrained(scene, ORIGIN, ORIGIN, PARAMS, Limits(contact_accel_mps2=bound))
    end, e = plan.t_go_s, 1e-3
    pull = (scene.goal(np.array([end]))[1] - scene.goal(np.array([end - e]))[1])[0] / e
    u = path_of(plan, ORIGIN, ORIGIN).thrust(np.array([end]))[0]
    assert np.linalg.norm(u - pull) <= bound + 1e-5
    assert plan.velocity_error_mps < 1e-8
    assert plan.position_error_m < 1e-8


def test_sphere_is_kept_out_of_and_only_claimed_feasible():
    scene = body(0.03, phase=2.6)  # the grasp point is on the far side
    limits = Limits(keepout_m=1.2, keepout_release_m=0.5)
    plan = constrained(scene, ORIGIN, ORIGIN, PARAMS, limits)
    assert plan.status is PlanStatus.FEASIBLE
    _, r, _, apex, _ = flown(plan, scene)
    away = np.linalg.norm(r - apex, axis=1) > 0.5
    assert np.linalg.norm(r - CENTRE, axis=1)[away].min() >= 1.2 - 1e-6
    free = path_of(rendezvous(scene.goal, ORIGIN, ORIGIN, PARAMS), ORIGIN, ORIGIN)
    through = free.at(np.linspace(0, free.t_go_s, 500))[0]
    assert (
        np.linalg.norm(through - CENTRE, axis=1).min() < 1.1
    )  # without the limit it would have gone through


def test_steps_are_flown_as_an_integrator_would():
    rng = np.random.default_rng(4)
    u, r0, v0 = 0.05 * rng.normal(size=(12, 3)), rng.normal(size=3), 0.1 * rng.normal(size=3)
    flight = StepPath(r0, v0, u, 0.7, 6.7)
    y, at = np.r_[r0, v0], 0.0
    for stop in (0.7, *(0.7 + 0.5 * (k + 1) for k in range(12)), 8.0):
        push = flight.thrust(np.array([0.5 * (at + stop)]))[0]
        y = solve_ivp(
            lambda t, y, push=push: np.r_[y[3:], push], [at, stop], y, method="DOP853", rtol=1e-12
        ).y[:, -1]
        at = stop
        got = np.concatenate([x[0] for x in flight.at(np.array([stop]))])
        assert np.allclose(got, y, atol=1e-12)


def test_latency_coasts_first():
    v0 = np.array([0.02, 0.0, 0.03])
    plan = constrained(body(), ORIGIN, v0, PlanParams(latency_s=2.0), Limits(speed_max_mps=0.4))
    path = path_of(plan, ORIGIN, v0)
    assert np.allclose(path.at(np.array([1.5]))[0][0], 1.5 * v0)
    assert plan.position_error_m < 1e-8


def test_what_is_proven_impossible_is_infeasible():
    plan = constrained(
        body(0.1), ORIGIN, ORIGIN, PlanParams(horizon_s=30.0), Limits(speed_max_mps=0.05)
    )
    assert plan.status is PlanStatus.INFEASIBLE
    assert not plan.found
    assert math.isnan(plan.t_go_s)


def test_margin_is_positive_along_a_plan_and_negative_off_it():
    scene = body()
    limits = Limits(cone_deg=25.0, cone_range_m=2.0, mouth_m=0.01, speed_max_mps=0.4).resolved(8.0)
    plan = constrained(scene, ORIGIN, ORIGIN, PARAMS, limits)
    path = path_of(plan, ORIGIN, ORIGIN)
    for t in np.linspace(0.0, plan.t_go_s, 25):
        then = scene.after(t)
        r, v = (x[0] for x in path.at(np.array([t])))
        assert margin(then, limits, r, v) > 0.0
        assert margin(then, limits, r, v + np.array([1.0, 0, 0])) < 0.0
    apex, axis = scene.goal(np.zeros(1))[0][0], axis_of(scene, np.zeros(1))[0]
    assert margin(scene, limits, apex - 0.5 * axis, ORIGIN) < 0.0
    wide = Limits(cone_deg=25.0).resolved(8.0)
    assert margin(scene, wide, apex - 5.0 * axis, ORIGIN) == pytest.approx(3.0 + wide.mouth_m)


def test_a_search_that_fails_does_not_claim_impossibility():
    """A very narrow cone on a fast target: no plan is found; nothing proves that there is none."""
    limits = Limits(cone_deg=0.1, cone_range_m=4.0, mouth_m=1e-4)
    plan = constrained(body(0.5), ORIGIN, ORIGIN, PARAMS, limits)
    free = rendezvous(body(0.5).goal, ORIGIN, ORIGIN, PARAMS)
    assert plan.status is PlanStatus.NOT_FOUND
    assert plan.lower_bound_s == free.lower_bound_s


def test_a_corridor_inside_the_clearance_is_proven_impossible():
    point = trimesh.creation.box([1e-4, 1e-4, 1e-4])  # the body is nearly a point
    scene = replace(body(), surface=Body(point.vertices, np.asarray(point.faces, np.int32)))
    shut = constrained(
        scene, ORIGIN, ORIGIN, PARAMS, Limits(clearance_m=0.6, final_deg=15.0, final_range_m=0.5)
    )
    assert shut.status is PlanStatus.INFEASIBLE
    assert constrained(
        scene, ORIGIN, ORIGIN, PARAMS, Limits(clearance_m=0.4, final_deg=15.0, final_range_m=0.5)
    ).found


def test_a_target_that_never_enters_the_workspace_is_proven_impossible():
    least, most = 4.0, 6.0  # distance of the grasp point from the origin
    free = rendezvous(body().goal, ORIGIN, ORIGIN, PARAMS)
    for limits in (Limits(reach_max_m=least - 0.1), Limits(reach_min_m=most + 0.1)):
        plan = constrained(body(), ORIGIN, ORIGIN, PARAMS, limits)
        assert plan.status is PlanStatus.INFEASIBLE
    inside = constrained(body(), ORIGIN, ORIGIN, PARAMS, Limits(reach_max_m=most + 0.1))
    assert inside.found
    assert inside.t_go_s == pytest.approx(free.t_go_s, abs=1e-3)
    # 26 - 10 cos(0.03 t + 0.5) is the squared distance of the grasp point; it reaches 5.5 m at 50.3
    # s
    late = constrained(body(), ORIGIN, ORIGIN, PARAMS, Limits(reach_min_m=5.5))
    exact = (math.acos((26.0 - 5.5**2) / 10.0) - 0.5) / 0.03
    assert exact - 0.5 <= late.lower_bound_s <= exact


def test_a_warm_start_solves_few_programmes(monkeypatch):
    module = sys.modules["avsreplay.plan.constrained"]
    scene, limits = (
        replace(body(0.05, phase=1.8), surface=ball),
        Limits(final_deg=15.0, clearance_m=0.3),
    )
    plan = constrained(scene, ORIGIN, ORIGIN, PARAMS, limits)
    path, solved = path_of(plan, ORIGIN, ORIGIN), []
    monkeypatch.setattr(module, "solve", lambda p: solved.append(p.n) or solve(p))
    for since_s in np.arange(1.0, plan.t_go_s - 3.0, 2.0):
        solved.clear()
        r, v = (x[0] for x in path.at(np.array([since_s])))
        later = constrained(scene.after(since_s), r, v, PARAMS, limits, warm=(path, since_s))
        assert later.t_go_s + since_s == pytest.approx(plan.t_go_s, abs=0.1)
        assert len(solved) <= 6
        assert max(solved, default=0) <= limits.nodes


def test_a_warm_start_gives_the_same_plan():
    scene, limits = body(), Limits(cone_deg=25.0, cone_range_m=2.0, mouth_m=0.01)
    plan = constrained(scene, ORIGIN, ORIGIN, PARAMS, limits)
    path = path_of(plan, ORIGIN, ORIGIN)
    r, v = (x[0] for x in path.at(np.array([2.0])))
    later = constrained(scene.after(2.0), r, v, PARAMS, limits, warm=(path, 2.0))
    assert later.t_go_s + 2.0 == pytest.approx(plan.t_go_s, abs=0.1)
    assert later.violation_m == 0.0


@pytest.mark.parametrize("latency_s", [0.0, 0.7])
@pytest.mark.parametrize("since_s", [0.0, 3.0])
def test_the_rest_of_a_path_ends_at_the_target_when_the_path_does(latency_s, since_s):
    """A robot on its path has its path for a reference. Beside it, and with another target, the
    reference begins at the robot and ends at the grasp point.
    """
    scene, params = body(), replace(PARAMS, latency_s=latency_s)
    path = path_of(rendezvous(scene.goal, ORIGIN, ORIGIN, params), ORIGIN, ORIGIN)
    left_s, r, v = path.t_go_s - since_s, *(x[0] for x in path.at(np.array([since_s])))
    shift, off = np.array([0.02, -0.05, 0.03]), np.array([0.3, 0.2, -0.1])
    moved = Scene(lambda t: (scene.goal(t)[0] + shift, scene.goal(t)[1])).after(since_s)
    limits = Limits(nodes=30)
    for target, begin in ((scene.after(since_s), r), (moved, r + off)):
        sampled = SampledScene(target, params.horizon_s, params.grid_s, params.horizon_s)
        found = warm_reference(Case(sampled, limits, params, begin, v, 0.01), path, since_s)
        s = found.t * np.arange(1, 61) / 60.0
        assert found.t == pytest.approx(left_s - latency_s, rel=1e-12)
        assert found.r[-1] == pytest.approx(target.goal(np.array([left_s]))[0][0], abs=1e-6)
        along = path.at(since_s + latency_s + s)[0]
        shifts = found.r - along  # from the robot's to the grasp point's
        if latency_s == 0.0 and begin is r:
            assert np.abs(shifts).max() < 1e-6
        if begin is not r:
            first = begin + latency_s * v - path.at(np.array([since_s + latency_s]))[0][0]
            assert shifts[0] == pytest.approx(first, abs=1e-3)


def _ball():
    """A mesh about a ball of 0.8 m, 1 m behind the grasp point: it contains the ball and is at most
    0.2 mm away from it.
    """
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    mesh.apply_scale(0.8 / np.sum(mesh.face_normals * mesh.triangles[:, 0], axis=1).min())
    return Body(mesh.vertices - np.array([1.0, 0, 0]), np.asarray(mesh.faces, np.int32))


ball = _ball()
ball_hull = trimesh.creation.icosphere(subdivisions=1, radius=0.9).vertices - [1.0, 0.0, 0.0]


@pytest.mark.slow
@pytest.mark.parametrize("left_s", [0.7, -1.0])
def test_a_robot_off_its_path_asks_for_the_target_within_the_horizon_only(left_s):
    """It withdrew while its path came to the end: a path in what is left of the time needs a
    speed without bound, from which a withdrawal would last for days.
    """
    scene, limits = (
        replace(body(0.05, phase=1.8), surface=ball, hull_c=ball_hull),
        Limits(final_deg=15.0, clearance_m=0.3, nodes=24),
    )
    plan, asked = constrained(scene, ORIGIN, ORIGIN, PARAMS, limits), []
    since_s = plan.t_go_s - left_s
    later, warm = scene.after(since_s), (path_of(plan, ORIGIN, ORIGIN), since_s)
    seen = replace(later, goal=lambda t: asked.append(t.max(initial=0.0)) or later.goal(t))
    again = constrained(seen, ORIGIN, ORIGIN, PARAMS, limits, warm=warm)
    assert again.found
    assert max(asked) <= 2.0 * PARAMS.horizon_s


@pytest.mark.parametrize("phase", [0.5, 1.8, 3.1, 4.5])
def test_the_robot_keeps_clear_of_the_body_and_arrives_from_outside(phase):
    scene = replace(body(0.05, phase=phase), surface=ball)
    limits = Limits(final_deg=15.0, final_range_m=0.5, mouth_m=0.01, clearance_m=0.3)
    plan = constrained(scene, ORIGIN, ORIGIN, PARAMS, limits)
    assert plan.found
    assert plan.violation_m == 0.0
    _, r, _, apex, axis = flown(plan, scene)
    along, off, distance = across(r, apex, axis)
    corridor = (off <= math.tan(math.radians(15.0)) * along + 0.01 + 1e-6) & (
        distance <= 0.5 + 1e-6
    )
    gap = np.linalg.norm(r - CENTRE, axis=1) - 0.8
    assert np.all(corridor | (gap >= 0.3 - 1e-6))
    before = distance > 0.02
    assert along[before][-1] > 0.0


def ball_margin(limits, y):
    """Margin of a withdrawal at points in {C}: of the corridor, else to the ball."""
    along = y[:, 0]
    side = (
        math.tan(math.radians(limits.final_deg)) * along
        + limits.mouth_m
        - np.linalg.norm(y[:, 1:], axis=1)
    )
    corridor = np.minimum(side, limits.final_range_m - np.linalg.norm(y, axis=1))
    gap = np.linalg.norm(y + np.array([1.0, 0, 0]), axis=1) - 0.8
    required = limits.kept_m
    if corridor[0] > 0.0:
        required = min(required, KEPT_SHARE * gap[0])
    return np.maximum(gap - required, corridor).min()


@pytest.mark.slow
@pytest.mark.parametrize("phase", [0.5, 1.8, 4.5])
def test_a_withdrawal_from_any_instant_keeps_the_stated_margin(phase):
    """What guidance would fly from 300 instants, propagated in steps of 50 ms."""
    hull = 0.8 * np.concatenate([np.eye(3), -np.eye(3)]) - np.array([1.0, 0, 0])
    scene = replace(body(0.05, phase=phase), surface=ball, hull_c=hull)
    limits = Limits(final_deg=15.0, clearance_m=0.3).resolved(2.0)
    plan = constrained(scene, ORIGIN, ORIGIN, PARAMS, limits, extent_m=2.0)
    path = path_of(plan, ORIGIN, ORIGIN)
    plan = with_safety(scene, plan, path, PARAMS, limits, 2.0)
    assert plan.abort_margin_m >= 0.0
    for t in np.linspace(0.0, plan.t_go_s, 300, endpoint=False):
        (r,), (v,) = path.at(np.array([t]))
        later = scene.after(t)
        space = Space(SampledScene(later, 60.0, 0.2, 45.0), limits, PARAMS.a_max_mps2, 2.0)
        (planned,) = escapes_at(path.escapes, np.array([t]))
        away = withdrawal(space, r, v, 1.0, planned=planned).path
        times = np.arange(0.0, away.t_go_s + 0.05, 0.05)
        turn = Rotation.from_quat(later.attitude(times))
        y = turn.inv().apply(away.at(times)[0] - later.goal(times)[0])
        assert ball_margin(limits, y) >= plan.abort_margin_m - space.resolution_m
        rest = away.at(np.array([away.t_go_s + 20.0]))[0][0] - CENTRE
        assert np.linalg.norm(rest) >= 0.8 + 1.0 - 1e-6


@pytest.mark.parametrize("order", [0, 1])
def test_the_sampled_motion_at_no_instant_is_empty(order):
    rho, R = SampledScene(body(0.0), 60.0, 0.2, 45.0).at(np.zeros(0), order)
    assert (rho.shape, R.shape) == ((0, 3), (0, 3, 3))


def test_a_coast_that_passes_the_body_is_bounded_from_below():
    """Straight past a ball at rest: the exact smallest distance, and a bound just below it."""
    scene = replace(body(0.0), surface=ball, hull_c=np.array([[0.0, 0.0, 0.0]]))
    (rho,), (x,) = scene.goal(np.zeros(1))[0], axis_of(scene, np.zeros(1))
    side = np.cross(x, [0.0, 1.0, 0.0])
    centre = rho - x
    start, v = centre + 1.5 * side - 2.0 * np.array([0, 1.0, 0]), np.array([0.0, 0.2, 0.0])
    path = StepPath(start, v, np.zeros((1, 3)), 0.0, 5.0)
    limits = Limits(final_deg=15.0, clearance_m=0.3).resolved(2.0)
    space = Space(SampledScene(scene, 60.0, 0.2, 45.0), limits, 0.05, 2.0)
    found = coasting(space, path, 0.0)
    assert 0.0 <= found.margin_m <= 1.5 - 0.8 - limits.kept_m + 1e-9
    assert found.safe_s == math.inf
    near = coasting(
        Space(space.sampled, replace(limits, withdrawal_clearance_m=0.8), 0.05, 2.0), path, 0.0
    )
    assert near.margin_m < 0.0
    assert near.safe_s == 0.0


def test_the_clearance_grows_with_the_predicted_uncertainty():
    wide = replace(
        body(0.05, phase=1.8),
        surface=ball,
        sigma=lambda t: (np.full(len(t), 0.1), np.zeros(len(t))),
    )
    limits = Limits(final_deg=15.0, final_range_m=0.5, mouth_m=0.01, clearance_m=0.1)
    plan = constrained(wide, ORIGIN, ORIGIN, PARAMS, limits)
    _, r, _, apex, axis = flown(plan, wide)
    along, off, distance = across(r, apex, axis)
    corridor = (off <= math.tan(math.radians(15.0)) * along + 0.01 + 1e-6) & (
        distance <= 0.5 + 1e-6
    )
    gap = np.linalg.norm(r - CENTRE, axis=1) - 0.8
    assert np.all(corridor | (gap >= 0.1 + 3 * 0.1 - 1e-6))


@pytest.mark.parametrize(
    ("limits", "says"),
    [
        ({"cone_deg": 95.0}, "cone_deg is 95"),
        ({"speed_max_mps": 0.0}, "speed_max_mps is 0"),
        ({"nodes": 2}, "nodes is 2"),
        ({"keepout_m": math.nan}, "keepout_m is nan"),
    ],
)
def test_bad_limits_are_named(limits, says):
    with pytest.raises(ValueError, match=says):
        Limits(**limits)


def test_a_limit_without_what_it_needs_is_named():
    bare = Scene(body().goal)
    with pytest.raises(ValueError, match="attitude"):
        constrained(bare, ORIGIN, ORIGIN, PARAMS, Limits(cone_deg=20.0))
    with pytest.raises(ValueError, match="axis"):
        constrained(replace(body(), axis_c=None), ORIGIN, ORIGIN, PARAMS, Limits(cone_deg=20.0))
    with pytest.raises(ValueError, match="mass centre"):
        constrained(replace(body(), centre_c=None), ORIGIN, ORIGIN, PARAMS, Limits(keepout_m=0.5))
    with pytest.raises(ValueError, match="surface"):
        constrained(body(), ORIGIN, ORIGIN, PARAMS, Limits(clearance_m=0.2, final_deg=10.0))
    with pytest.raises(ValueError, match=r"keepout_m is 3\.0, must be below"):
        constrained(body(), ORIGIN, ORIGIN, PARAMS, Limits(keepout_m=3.0))


@pytest.mark.parametrize(("number", "known_s"), [(9, 19.776), (19, 28.902), (30, 25.119)])
def test_plans_with_a_clearance_are_near_the_best_known(number, known_s):
    """Times of IPOPT with 200 nodes (tests/benchmarks/plan_limits.py --kind body), whose excess is
    below 1 mm.
    """
    problem = problems(number + 1)[number]
    limits = Limits(final_deg=15.0, clearance_m=0.25, abort=False)
    plan = constrained(
        problem.scene, problem.r0, ORIGIN, PlanParams(a_max_mps2=problem.a_max), limits
    )
    assert plan.found
    assert plan.t_go_s <= known_s + 0.1
    assert plan.violation_m == 0.0


def test_the_number_of_intervals_costs_less_than_a_tenth_of_a_second():
    """Time of IPOPT with 200 nodes: plan_limits.py --kind cone --first 37 --count 1 --seed 71
    --ipopt 38.
    """
    problem = problems(38, 71)[37]
    params = PlanParams(a_max_mps2=problem.a_max)
    plan = constrained(problem.scene, problem.r0, ORIGIN, params, Limits(cone_deg=35.0))
    assert plan.t_go_s <= 31.888 + 0.05


@pytest.mark.parametrize(
    ("number", "earliest_s"),
    [
        (0, 24.016442393),
        (3, 20.0),
        (3, 21.57),
        (3, 15.0),
    ],
)
def test_an_earliest_capture_before_that_of_the_plan_does_not_delay_it(number, earliest_s):
    """Acceleration bounded per axis of a turned base, which makes drafts hard to refine. A later
    path may have better withdrawals and is preferred, so that they are not asked for.
    """
    base = (0.1830127, 0.1830127, 0.6830127, 0.6830127)
    shell = {"base_m": (0.0, 0.0, -1.0), "reach_min_m": 0.5, "reach_max_m": 9.0}
    limits = Limits(
        final_deg=15.0,
        clearance_m=0.25,
        accel_axes_mps2=(0.075, 0.05, 0.0375),
        abort=False,
        **shell,
    )
    limits = replace(limits, base_attitude_xyzw=base).resolved(8.0)
    scene, params = problems(number + 1)[number].scene, PlanParams(a_max_mps2=0.0375, latency_s=0.2)
    alone, bounded = (
        constrained(scene, ORIGIN, ORIGIN, params, limits, earliest_s=e) for e in (0.0, earliest_s)
    )
    assert alone.found
    assert bounded.found
    assert bounded.t_go_s >= earliest_s
    if alone.t_go_s >= earliest_s:
        assert bounded.t_go_s <= alone.t_go_s
    else:
        assert bounded.t_go_s <= earliest_s + 1e-3


def test_a_late_capture_of_a_target_that_turns_far_is_found():
    """The coarse intervals are short enough for the turn of the target until the earliest capture
    that is allowed.
    """
    problem, limits = problems(22, 1)[21], Limits(final_deg=15.0, clearance_m=0.3)
    params = PlanParams(a_max_mps2=0.05, latency_s=0.5)
    plan = constrained(problem.scene, problem.r0, ORIGIN, params, limits, earliest_s=73.245)
    assert plan.found
    assert plan.t_go_s == pytest.approx(73.245, abs=2e-3)
