"""The region that follows a target: an approach over ground, beside a wall and a neighbour."""

from __future__ import annotations

import json

import numpy as np
import pytest

from avsreplay.config import RunConfig
from avsreplay.geometry import Pose, exp
from avsreplay.region import Region
from avsreplay.settings import SettingError

SIZE = np.array([4.0, 1.8, 1.6])  # of a box about its origin, on wheels: 0.3 m above the ground


def box(rng, count, size=SIZE):
    """Points on the surface of a box."""
    p = rng.uniform(-0.5, 0.5, (count, 3))
    side = rng.integers(3, size=count)
    p[np.arange(count), side] = np.sign(p[np.arange(count), side]) * 0.5
    return p * size


def scene(seed, distance, count):
    """Points, which of them are of the target, and its pose, for a target at a distance."""
    rng = np.random.Generator(np.random.PCG64(seed))
    T = Pose(exp([0.0, 0.0, 0.3]), [distance, 0.5, 0.0])
    target = T.apply(box(rng, count))
    ground = rng.uniform([distance - 8, -7, 0], [distance + 8, 7, 0], (4 * count, 3))
    ground[:, 2] = -1.1 + rng.normal(0.0, 0.02, len(ground))
    wall = rng.uniform([distance - 8, 5.0, -1.1], [distance + 8, 5.05, 2.0], (2 * count, 3))
    near = T.apply(box(rng, count) + np.array([0.0, -4.0, 0.0]))
    points = np.concatenate([target, ground, wall, near]).astype(np.float32)
    return points, np.arange(len(points)) < count, T


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_target_is_followed_and_ground_wall_and_neighbour_are_removed(seed):
    region = Region(scene(seed, 40.0, 60)[2].t, -0.5 * SIZE, 0.5 * SIZE)
    followed, kept = None, None
    for k in range(50):
        distance = 40.0 - 0.7 * k
        points, target, T = scene(100 * seed + k, distance, 150 + 20 * k)
        kept, followed = region.cut(points, k * 100_000_000, followed, None)
        assert np.count_nonzero(kept & target) > 0.9 * np.count_nonzero(target), k
        assert np.count_nonzero(kept & ~target) < 0.15 * np.count_nonzero(kept), k
        assert np.linalg.norm(followed.centre - T.t) < 0.5
    assert followed.velocity == pytest.approx([-7.0, 0.0, 0.0], abs=1.0)


def test_a_known_pose_cuts_its_box_and_a_wrong_one_is_not_trusted():
    points, target, T = scene(1, 12.0, 800)
    region = Region(T.t, -0.5 * SIZE, 0.5 * SIZE)
    exact, _ = region.cut(points, 0, None, T)
    assert np.count_nonzero(exact & target) > 0.9 * np.count_nonzero(target)
    assert np.count_nonzero(exact & ~target) < 0.02 * np.count_nonzero(exact)
    wrong = Pose(T.q, T.t + np.array([0.0, 30.0, 0.0]))
    far, _ = region.cut(points, 0, None, wrong)
    alone, _ = region.cut(points, 0, None, None)
    np.testing.assert_array_equal(far, alone)


def test_the_target_is_found_again_after_scans_without_it():
    region, followed = Region(scene(0, 30.0, 200)[2].t, -0.5 * SIZE, 0.5 * SIZE), None
    for k in range(12):
        points, target, _ = scene(k, 30.0 - 0.5 * k, 200)
        points = points if k not in (6, 7) else points[:0]
        kept, followed = region.cut(points, k * 100_000_000, followed, None)
    assert np.count_nonzero(kept & target) > 0.9 * np.count_nonzero(target)


@pytest.mark.parametrize("text", ["1,2", "a,b,c", "1,2,nan", "1,2,1e9"])
def test_a_region_that_is_no_point_is_refused(text):
    with pytest.raises(SettingError, match="region"):
        RunConfig(region=text)


@pytest.mark.slow
def test_a_region_from_the_command_line_leaves_the_scans_of_a_target_alone_unchanged(
    cli, fixtures_folder
):
    """Where only the target is seen, the region removes few points and the errors stay."""
    log = fixtures_folder / "tumble.mcap"
    first = json.loads(cli("run", log, "--n-scans", 1, "--json").out)["rows"][0]
    at = ",".join(str(first[name]) for name in ("x_m", "y_m", "z_m"))
    used = {}
    for name, more in (("all", ()), ("region", (f"--region={at}",))):
        done = cli("run", log, "--n-scans", 20, "--json", *more)
        assert done.code in (0, 1), done.err
        used[name] = sum(row["gamma"] for row in json.loads(done.out)["rows"])
    assert used["region"] >= used["all"] - 2
