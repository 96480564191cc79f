"""Covariances of poses of which a view does not determine a direction."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import tumbling

from avsreplay import geometry
from avsreplay.estimate.batch import Poses, Prior, Problem
from avsreplay.estimate.chart import to_chart
from avsreplay.estimate.normal_points import normal_points
from avsreplay.estimate.pose_noise import scaled, scaled_R
from avsreplay.geometry import Array, Pose

FREE_RAD = 1.0
ATTITUDE_RAD, POSITION_M = 3e-4, 1e-4


def undetermined(axis: Array, place: Array) -> Array:
    """The direction d (6,) of a turn about an axis through a place, of 1 rad."""
    return np.concatenate([axis, np.cross(place, axis)])


def covariance_along(d: Array) -> Array:
    """Of a pose that leaves the direction d undetermined."""
    own = np.repeat([ATTITUDE_RAD, POSITION_M], 3) ** 2
    return np.diag(own) + FREE_RAD**2 * np.outer(d, d)


def some_covariance(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return covariance_along(undetermined(axis / np.linalg.norm(axis), rng.normal(size=3)))


@pytest.mark.parametrize("seed", range(8))
def test_factors_on_the_noise_change_no_information_by_more_than_themselves(seed: int) -> None:
    """Along no direction, whatever it does to attitude and position together."""
    rng, C = np.random.default_rng([seed, 1]), some_covariance(seed)
    factors = rng.uniform(0.5, 2.0, size=2)
    before, after = np.linalg.inv(C), np.linalg.inv(scaled(C, factors))
    ratios = np.linalg.eigvals(np.linalg.solve(before, after)).real
    assert ratios.min() > factors.max() ** -2.0 * (1.0 - 1e-3)
    assert ratios.max() < factors.min() ** -2.0 * (1.0 + 1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_factors_are_on_the_attitude_and_on_the_position_given_it(seed: int) -> None:
    C, factors = some_covariance(seed), np.array([1.3, 0.7])
    found = scaled(C, factors)
    np.testing.assert_allclose(found[:3, :3], 1.3**2 * C[:3, :3], rtol=1e-9)
    given = [np.linalg.inv(np.linalg.inv(S)[3:, 3:]) for S in (C, found)]
    np.testing.assert_allclose(given[1], 0.7**2 * given[0], rtol=1e-3)
    np.testing.assert_allclose(scaled(found, 1.0 / factors), C, rtol=1e-9)
    np.testing.assert_allclose(scaled(C, np.full(2, 3.0)), 9.0 * C, rtol=1e-15)
    exchanged = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
    np.testing.assert_allclose(scaled_R(C[exchanged], factors)[exchanged], found, rtol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_normal_points_have_the_cost_of_poses_with_different_undetermined_turns(seed: int) -> None:
    """Noise turns the undetermined directions of neighbouring views by a milliradian, so that
    their mean may lie far from all of them. The cost differs by a constant.
    """
    rng = np.random.default_rng(seed)
    world = tumbling.draw(seed, seconds=30.0, hz=5.0)
    axis, place = np.array([0.0, 0.0, 1.0]), np.array([0.5, -0.2, 0.0])
    T, C = [], []
    for x in world.states:
        turned = axis + 1e-3 * rng.normal(size=3)
        C.append(covariance_along(undetermined(turned / np.linalg.norm(turned), place)))
        T.append(moved(x.T_ac, np.repeat([ATTITUDE_RAD, POSITION_M], 3) * rng.normal(size=6)))
    poses = Poses(world.times, np.array([t.q for t in T]), np.array([t.t for t in T]), np.array(C))
    reference, ones = to_chart(world.states[0]), np.ones(2)
    points = normal_points(poses, reference, ones, 40)
    assert len(points) < 0.5 * len(poses)
    prior = Prior(reference, np.eye(20))
    every, few = (Problem(some, prior, ones) for some in (poses, points))
    sizes = np.repeat([3e-5, 1e-6, 3e-5, 1e-6, 1e-4, 1e-5], [3, 3, 3, 3, 5, 3])
    charts = [reference, *(reference.moved(sizes * rng.normal(size=20)) for _ in range(20))]
    whole = np.array([every.misfit(chart) for chart in charts])
    fewer = np.array([few.misfit(chart) for chart in charts])
    assert fewer[0] < whole[0]
    rises = whole - whole[0]
    assert np.abs(rises).max() > 10.0
    assert fewer - fewer[0] == pytest.approx(rises, rel=0.05, abs=0.5)


def moved(T: Pose, d: Array) -> Pose:
    """T with an error d in its own axes."""
    return Pose(geometry.multiply(T.q, geometry.exp(d[:3])), T.t + T.R @ d[3:])


SCENARIO = """
seed = 4008
duration_s = 22.0
rate_hz = 4.0
[target]
model = "stage.ply"
[motion]
attitude_xyzw = [0.8780, 0.3210, -0.2561, 0.2459]
rate_radps = [0.3862, -0.2895, 0.1307]
position_m = [0.1, 0.0, 10.1]
velocity_mps = [0.001, 0.003, -0.002]
[scanner]
pattern = "spinning"
scan_s = 0.1
fov_deg = [44.0, 44.0]
rays = [110, 110]
noise_m = 0.0043
outlier_ratio = 0.02
"""


@pytest.mark.slow
def test_views_of_a_stage_that_leave_its_turn_undetermined_are_used_at_their_worth(
    cli: Any, tmp_path: Path
) -> None:
    """The boom of a body of revolution is hidden for seconds. Two factors on rows and columns of
    the covariance state the position of such views far too well: errors of 0.5 m, a quarter of the
    scans rejected, and random torques that do not act.
    """
    create = trimesh.creation
    parts = [
        create.cylinder(0.8, 3.0, sections=64),
        create.cone(0.8, 0.7, sections=64).apply_translation((0.0, 0.0, 1.5)),
        create.box((0.1, 2.2, 0.1)).apply_translation((0.0, 1.5, -0.9)),
    ]
    trimesh.util.concatenate(parts).export(tmp_path / "stage.ply")
    (tmp_path / "stage.toml").write_text(SCENARIO)
    log = tmp_path / "stage.mcap"
    assert cli("record", tmp_path / "stage.toml", "-o", log).code == 0
    rows = json.loads(cli("run", log, "--json", "--set", "plan.enabled=false").out)["rows"]
    assert sum(row["status"] == "degenerate" for row in rows) > 10
    assert sum(row["gamma"] == 0 for row in rows) < 0.1 * len(rows)
    assert {row["motion"] for row in rows} <= {"free", None}
    late = [row for row in rows if row["t_s"] > 5.0]
    assert max(row["pos_err_m"] for row in late) < 2e-3
    assert max(row["pos_err_m"] / row["pos_1s_m"] for row in late) < 5.0
