"""Constraints of the approach: margins of the alternatives, the workspace, and the limits in
the rows of a run.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avsreplay import geometry, replay
from avsreplay.build import target_geometry
from avsreplay.plan.constrained import constrained
from avsreplay.plan.limits import Scene, axis_blocked, margins
from avsreplay.plan.path import path_of
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.plan.robot import Limits, RobotParams
from avsreplay.records import Surface
from avsreplay.simulate.target import Shape, builtin_surface

X = np.array([1.0, 0.0, 0.0])
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
TUMBLE = Path(__file__).parents[1] / "fixtures" / "tumble.mcap"


def still(**more):
    """A target at rest 5 m away whose fixture faces the robot."""
    goal = lambda t: (np.tile([0.0, 0.0, 5.0], (len(t), 1)), np.zeros((len(t), 3)))  # noqa: E731
    half_turn = np.array([0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)])  # x of {C} along -z of {A}
    return Scene(goal, lambda t: np.tile(half_turn, (len(t), 1)), X, -X, **more)


def test_the_cone_holds_inside_its_range_only():
    limits = Limits(cone_deg=45.0, cone_range_m=2.0, mouth_m=0.01)
    y = np.array([[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [-1.0, 0.0, 0.0], [-3.0, 0.0, 0.0]])
    found = margins(still(), limits, y, y).values[:, 0]
    assert found == pytest.approx([1.0 + 0.01 - 0.5, 0.5 + 0.01 - 1.0, -1.0 + 0.01, 1.0])


def test_a_change_of_alternative_between_two_points_is_seen():
    """Outside the range at one point, inside the cone at the next; in between neither holds."""
    limits = Limits(cone_deg=30.0, cone_range_m=2.0, mouth_m=0.01)
    y = np.array([[1.5, 1.5, 0.0], [1.5, 0.8, 0.0]])
    found = margins(still(), limits, y, y)
    assert found.values[:, 0].min() > 0.0
    t = np.linspace(0.0, 1.0, 1001)[:, None]
    dense = (
        margins(still(), limits, y[0] + t * (y[1] - y[0]), np.zeros((1001, 3))).values[:, 0].min()
    )
    assert dense < 0.0
    assert found.between[0, 0] == pytest.approx(dense, abs=0.05)


def test_signed_distance_of_the_built_in_target():
    surface = builtin_surface()
    target = target_geometry(surface, (1.0, 0.0, 0.0))
    inside, outside = np.array([[-0.8, 0.0, 0.0]]), np.array([[2.0, 0.0, 0.0]])
    assert target.surface(inside)[1][0] < 0.0
    foot, distance = target.surface(outside)
    assert distance[0] == pytest.approx(np.linalg.norm(outside - foot))
    furthest = np.linalg.norm(
        surface.vertices + X, axis=1
    ).max()  # from the centre of mass of ``still``
    assert still(hull_c=target.hull_c).radius_m == pytest.approx(furthest)


def boxes(*of):
    """A mesh of boxes (low corner, high corner), each closed and wound outwards."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    vertices = [np.array(low) + corners * (np.array(high) - np.array(low)) for low, high in of]
    numbered = np.concatenate([faces + 8 * k for k in range(len(of))])
    return Surface(np.concatenate(vertices), numbered, "boxes", "")


def test_inside_and_outside_of_parts_that_overlap():
    """The nearest face of a point in one part may be the side of another that lies in the first."""
    lows, highs = [[-1, -1, -1], [-0.2, -0.3, -0.3]], [[1, 1, 1], [3, 0.3, 0.3]]
    distance = target_geometry(boxes(*zip(lows, highs, strict=True)), (1.0, 0.0, 0.0)).surface
    y = np.random.default_rng(0).uniform([-1.5, -1.5, -1.5], [3.5, 1.5, 1.5], (4000, 3))
    within = [np.all((y > low) & (y < high), axis=1) for low, high in zip(lows, highs, strict=True)]
    truth = within[0] | within[1]
    assert np.array_equal(distance(y)[1] < 0.0, truth)
    outside = y[~truth]
    exact = np.min(
        [
            np.linalg.norm(np.maximum(np.maximum(low - outside, outside - high), 0.0), axis=1)
            for low, high in zip(np.array(lows), np.array(highs), strict=True)
        ],
        axis=0,
    )
    assert distance(outside)[1] == pytest.approx(exact, abs=1e-6)


def test_an_open_sheet_has_no_inside():
    sheet = np.array([[0, 0, 0], [0, 2, 0], [0, 2, 2], [0, 0, 2]], float)
    surface = Surface(sheet, np.array([[0, 1, 2], [0, 2, 3]], np.int32), "sheet", "")
    y = np.array([[s * d, 1.1, 0.7] for s in (-1, 1) for d in (1e-3, 0.1, 0.5)])
    assert target_geometry(surface, (1.0, 0.0, 0.0)).surface(y)[1] == pytest.approx(np.abs(y[:, 0]))


def test_the_workspace_is_a_shell_about_the_base():
    limits = Limits(reach_max_m=6.0, reach_min_m=2.0, base_m=(0.0, 3.0, 0.0))
    plan = constrained(still(), np.zeros(3), np.array([0.0, 0.12, 0.0]), PlanParams(), limits)
    assert plan.found
    path = path_of(plan, np.zeros(3), np.array([0.0, 0.12, 0.0]))
    away = np.linalg.norm(
        path.at(np.linspace(0.0, plan.t_go_s, 4001))[0] - np.array([0.0, 3.0, 0.0]), axis=1
    )
    assert away.max() <= 6.0
    assert away.min() >= 2.0
    far = constrained(still(), np.zeros(3), np.zeros(3), PlanParams(), Limits(reach_max_m=4.0))
    assert not far.found  # the grasp point itself is out of reach


def test_a_robot_at_its_base_is_inside_a_workspace_without_a_smallest_reach():
    limits = Limits(reach_max_m=20.0, base_m=(1.0, 2.0, 3.0))
    at_base = margins(still(), limits, np.array([[4.0, 0.0, 0.0]]), np.array([[1.0, 2.0, 3.0]]))
    assert at_base.values[0, 4] == pytest.approx(20.0)


def test_thrust_and_size_of_the_robot():
    robot = RobotParams(mass_kg=80.0, thrust_max_n=2.0, radius_m=0.15)
    assert robot.applied(PlanParams()).a_max_mps2 == pytest.approx(0.025)
    assert robot.limited(Limits(final_deg=10.0, clearance_m=0.1)).clearance_m == pytest.approx(0.25)
    assert robot.limited(Limits(final_deg=10.0)).clearance_m == pytest.approx(0.15)
    assert robot.limited(Limits()) == Limits()
    assert "80 kg, at most 0.025 m/s2, attitude not planned, radius 0.15 m" in robot.described(
        PlanParams(), Limits()
    )
    with pytest.raises(ValueError, match="together"):
        RobotParams(mass_kg=80.0)


def test_a_robot_takes_precedence_over_plan_and_limits():
    robot = RobotParams(
        accel_axes_mps2=(0.04, 0.02, 0.03),
        start_position_m=(1.0, 0.0, 0.0),
        start_velocity_mps=(0.0, 0.1, 0.0),
        base_position_m=(0.0, 2.0, 0.0),
        reach_min_m=0.5,
        reach_max_m=7.0,
        delay_s=0.3,
    )
    params, limits = (
        robot.applied(PlanParams()),
        robot.limited(Limits(reach_max_m=9.0, base_m=(5.0, 0.0, 0.0))),
    )
    assert (params.a_max_mps2, params.latency_s) == (0.02, 0.3)
    assert (params.robot_position_m, params.robot_velocity_mps) == (
        (1.0, 0.0, 0.0),
        (0.0, 0.1, 0.0),
    )
    assert (limits.base_m, limits.reach_min_m, limits.reach_max_m) == ((0.0, 2.0, 0.0), 0.5, 7.0)
    line = robot.described(PlanParams(), Limits())
    for part in (
        "(0.04, 0.02, 0.03) m/s2 per axis",
        "from (1, 0, 0) m",
        "0.5 to 7 m from the base",
        "delay 0.3 s",
    ):
        assert part in line
    assert RobotParams().applied(PlanParams()) == PlanParams()
    with pytest.raises(ValueError, match="exclude"):
        RobotParams(accel_max_mps2=0.1, accel_axes_mps2=(0.1, 0.1, 0.1))
    with pytest.raises(ValueError, match="unit length"):
        RobotParams(base_attitude_xyzw=(0.0, 0.0, 0.0, 2.0))
    with pytest.raises(ValueError, match="reach_min_m"):
        RobotParams(reach_min_m=2.0, reach_max_m=1.0)


def test_bounds_per_axis_from_rest_to_rest_in_closed_form():
    """Each axis is independent; the slowest one, 4 m at 0.02 m/s2, determines the time."""
    half = math.radians(45.0)
    turn = (0.0, 0.0, math.sin(half / 2.0), math.cos(half / 2.0))  # of the base about z
    e = geometry.matrix(np.array(turn))
    goal = e @ np.array([3.0, 4.0, 1.0])
    scene = Scene(lambda t: (np.tile(goal, (len(t), 1)), np.zeros((len(t), 3))))
    bounds = np.array([0.04, 0.02, 0.03])
    limits = Limits(accel_axes_mps2=tuple(bounds), base_attitude_xyzw=turn, nodes=60)
    plan = constrained(scene, np.zeros(3), np.zeros(3), PlanParams(a_max_mps2=0.02), limits)
    exact = 2.0 * math.sqrt(4.0 / 0.02)
    assert exact - 1e-6 <= plan.t_go_s <= exact + 0.01
    assert plan.lower_bound_s <= exact
    u = path_of(plan, np.zeros(3), np.zeros(3)).thrust(np.linspace(0.0, plan.t_go_s, 1001))
    assert np.all(np.abs(u @ e) <= bounds)
    assert plan.position_error_m < 1e-8


def test_every_plan_of_a_run_obeys_the_limits():
    """The log is too short for the convergence that the default tolerance requires."""
    soon = ("convergence.sigmas=0.02", "convergence.dwell_s=0.5")
    limits = ("limits.final_deg=15", "limits.clearance_m=0.1", "limits.clearance_sigmas=0")
    rows = [row for row in replay(TUMBLE, *soon, *limits) if row.plan_status is not None]
    planned = [row for row in rows if row.plan_status in ("optimal", "feasible")]
    assert planned
    assert all(
        row.plan_margin_m >= 0.0 and row.plan_limit in ("corridor", "body") for row in planned
    )
    anyhow = replay(TUMBLE, *soon, "task.approach=free")
    free = [row for row in anyhow if row.capture_time_s is not None]
    assert min(r.capture_time_s for r in planned) >= min(r.capture_time_s for r in free) - 1e-6
    assert all(row.plan_margin_m is None for row in free)


def test_a_corridor_that_ends_inside_the_part_at_the_grasp_point_is_named():
    """The pin of the bracket stands at its grasp point; the named length leads out of it."""
    surface = builtin_surface(Shape.BRACKET)
    target = target_geometry(surface, (1.0, 0.0, 0.0))
    scene = still(surface=target.surface)
    limits = Limits(final_deg=15.0, clearance_m=0.06, final_range_m=0.01).resolved(surface.extent)
    name, until_m, short_m = axis_blocked(scene, limits, surface.extent)
    assert name == "body"
    assert until_m > 0.01
    assert short_m > 0.0
    longer = replace(limits, final_range_m=1.05 * until_m)
    assert axis_blocked(scene, longer, surface.extent) is None


@pytest.mark.parametrize("sigma", [0.001, 0.01, 0.1])
def test_an_uncertain_target_narrows_the_corridor_at_most_to_half(sigma):
    limits = Limits(final_deg=15.0, final_range_m=0.5, mouth_m=0.02).resolved(2.0)
    x = np.linspace(0.0, 0.5, 11)
    y = np.column_stack([x, 0.3 * (math.tan(math.radians(15.0)) * x + 0.02), 0.0 * x])
    exact = margins(still(), limits, y, y).first[:, 1]
    known = sigma + 0.0 * x, 0.0 * x
    found = exact - margins(still(), limits, y, y, known).first[:, 1]
    width = math.tan(math.radians(15.0)) * x + 0.02
    assert found == pytest.approx(np.minimum(3.0 * sigma, 0.5 * width))


def test_a_plan_for_an_uncertain_target_stays_inside_the_corridor_of_displaced_targets():
    """Displacements up to what the plan allows for; the plan for an exact target leaves it."""
    limits = Limits(final_deg=12.0, final_range_m=0.6, mouth_m=0.06).resolved(2.0)
    known = replace(still(), sigma=lambda t: (np.full(len(t), 0.01), np.zeros(len(t))))
    start, zero = np.array([4.0, 1.0, 1.0]), np.zeros(3)
    params, shift = PlanParams(a_max_mps2=0.05), 0.029

    def worst(scene):
        plan = constrained(scene, start, zero, params, limits, extent_m=2.0)
        times = np.linspace(0.0, plan.t_go_s, 400)[:-1]
        r = path_of(plan, start, zero).at(times)[0]
        y = (r - scene.goal(times)[0]) @ geometry.matrix(scene.attitude(times)[:1])[0]
        angles = np.linspace(0.0, 2.0 * np.pi, 13)
        moved = [y + shift * np.array([0.0, np.cos(a), np.sin(a)]) for a in angles]
        return min(margins(scene, limits, m, m).values[:, 1].min() for m in moved)

    assert worst(known) >= -1e-3
    assert worst(still()) < -0.01
