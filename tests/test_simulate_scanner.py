"""Rays against the mesh, range noise against its distribution, scans of finite duration against the
true motion.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from scipy import stats

from avsreplay import geometry
from avsreplay.errors import MissingBackend
from avsreplay.records import Surface
from avsreplay.simulate import rays
from avsreplay.simulate.motion import Motion, MotionParams
from avsreplay.simulate.rays import Engine, FieldOfView, Pattern, RayCaster, ScannerParams
from avsreplay.simulate.scanner import Scanner
from avsreplay.simulate.target import Shape, TargetParams, body, builtin_surface

needs_embree = pytest.mark.skipif(
    not rays.importlib.util.find_spec("embreex"), reason="embreex is not installed"
)
SURFACE = builtin_surface()
MESH = trimesh.Trimesh(SURFACE.vertices, SURFACE.faces, process=False)
CLEAN = ScannerParams(rays=(40, 40), noise_m=0.0, outlier_ratio=0.0)
SPIN = MotionParams(
    attitude_xyzw=tuple(geometry.exp([0.1, 1.4, 0.2])),
    rate_radps=(0.1, 0.2, -0.2),
    velocity_mps=(0.02, 0, 0),
)


def rng(seed=0):
    return np.random.Generator(np.random.PCG64(seed))


def scanner(params=CLEAN, motion=SPIN, surface=SURFACE):
    return Scanner(params, surface, Motion(body(TargetParams(), surface), motion, 10.0, rng()))


def distance_to_mesh(points):
    return trimesh.proximity.closest_point(MESH, points)[1]


@pytest.mark.parametrize("engine", [pytest.param(Engine.EMBREE, marks=needs_embree), Engine.EXACT])
def test_every_return_lies_on_the_mesh(engine):
    scan = scanner(replace(CLEAN, engine=engine))
    for t in (0.0, 3.3):
        returns = scan.cast(t)
        R_ac, t_ac = scan.motion.poses([t])
        points_c = (returns.directions * returns.ranges[:, None] - t_ac) @ R_ac[0]
        assert len(points_c) > 200
        assert distance_to_mesh(points_c).max() < 1e-6


@needs_embree
def test_both_engines_give_the_same_returns():
    a, b = (scanner(replace(CLEAN, engine=e)).cast(1.0) for e in (Engine.EMBREE, Engine.EXACT))
    assert abs(len(a.ranges) - len(b.ranges)) <= 2
    both = {tuple(d): r for d, r in zip(a.directions, a.ranges, strict=True)}
    gap = [
        abs(both[tuple(d)] - r)
        for d, r in zip(b.directions, b.ranges, strict=True)
        if tuple(d) in both
    ]
    assert np.mean(np.array(gap) < 1e-9) > 0.999


def test_nothing_stands_in_front_of_a_return():
    """Self-occlusion: between the camera and each return the exact caster finds no other face."""
    scan = scanner(replace(CLEAN, rays=(24, 24)))
    returns = scan.cast(0.0)
    R_ac, t_ac = scan.motion.poses([0.0])
    origin, towards = (-t_ac @ R_ac[0]), returns.directions @ R_ac[0]
    located, ray, _ = MESH.ray.intersects_location(
        np.repeat(origin, len(towards), 0), towards, multiple_hits=True
    )
    nearest = np.full(len(towards), np.inf)
    np.minimum.at(nearest, ray, np.linalg.norm(located - origin, axis=1))
    assert_allclose(returns.ranges, nearest, atol=1e-5)


def test_a_wall_is_seen_at_its_distance():
    wall = Surface(
        np.array([[-9.0, -9, 0], [9, -9, 0], [0, 18, 0]]),
        np.array([[0, 1, 2]], np.int32),
        "wall",
        "",
    )
    for engine in (Engine.EXACT, Engine.AUTO):
        towards = geometry.normalise(np.array([[0.0, 0, 0, 1]]))[:, [0, 1, 3]]
        ranges, cosine, faces = RayCaster(wall, engine).ranges(
            np.array([[0.1, 0.2, -3.0]]), towards
        )
        assert_allclose(ranges, 3.0, atol=1e-12)
        assert_allclose(cosine, 1.0)
        assert (faces >= 0).all()
        missed, _, none = RayCaster(wall, engine).ranges(np.array([[0.1, 0.2, -3.0]]), -towards)
        assert np.isinf(missed).all()
        assert (none == -1).all()


def test_a_triangle_without_area_is_never_hit():
    vertices = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 2, 0], [0, 0, -1], [0, 0, -1]])
    faces = np.array([[3, 4, 3], [0, 1, 2]], np.int32)
    ranges, _, face = RayCaster(Surface(vertices, faces, "x", "")).ranges(
        np.array([[0.0, 0, -3]]), np.array([[0.0, 0, 1]])
    )
    assert_allclose(ranges, 3.0)
    assert face.tolist() == [1]  # the index in the mesh, the degenerate triangle counted


@needs_embree
def test_without_embree_the_exact_engine_takes_over(monkeypatch):
    monkeypatch.setattr(rays.importlib.util, "find_spec", lambda name: None)
    assert RayCaster(SURFACE).engine is Engine.EXACT
    with pytest.raises(MissingBackend, match=r"embreex is not installed.*exact"):
        RayCaster(SURFACE, Engine.EMBREE)


def test_range_noise_is_white_and_of_its_level():
    params = replace(CLEAN, noise_m=0.01, rays=(80, 80))
    scan = scanner(params)
    clean = scan.cast(0.0)
    errors = (
        np.concatenate([scan.disturb(clean, rng(k)).ranges - clean.ranges for k in range(5)]) / 0.01
    )
    low, high = stats.chi2(len(errors)).ppf([5e-4, 1 - 5e-4])
    assert low < np.sum(errors**2) < high
    assert abs(np.mean(errors)) < 3.3 / np.sqrt(len(errors))
    assert stats.kstest(errors, "norm").pvalue > 1e-3


def test_noise_runs_along_the_ray():
    scan = scanner(replace(CLEAN, noise_m=0.05))
    clean = scan.cast(0.0)
    noisy = scan.disturb(clean, rng(1))
    assert np.array_equal(noisy.directions, clean.directions)
    assert_allclose(np.linalg.norm(noisy.points, axis=1), noisy.ranges, rtol=1e-6)


def test_outliers_and_dropouts_have_their_share():
    params = replace(CLEAN, outlier_ratio=0.1, dropout_ratio=0.2, rays=(100, 100))
    scan = scanner(params)
    clean = scan.cast(0.0)
    kept = scan.disturb(clean, rng(2))
    n = len(clean.ranges)
    assert stats.binomtest(n - len(kept.ranges), n, 0.2).pvalue > 1e-3
    truth = {tuple(d): r for d, r in zip(clean.directions, clean.ranges, strict=True)}
    wrong = np.array(
        [
            r
            for d, r in zip(kept.directions, kept.ranges, strict=True)
            if abs(truth[tuple(d)] - r) > 1e-12
        ]
    )
    assert stats.binomtest(len(wrong), len(kept.ranges), 0.1).pvalue > 1e-3
    window = (params.range_min_m, params.range_max_m - params.range_min_m)
    assert stats.kstest(wrong, "uniform", window).pvalue > 1e-3


def test_points_of_a_rolling_scan_put_back_by_their_own_pose_lie_on_the_mesh():
    params = replace(CLEAN, pattern=Pattern.RASTER, scan_s=1.0)
    scan = scanner(params)
    returns = scan.cast(2.0)
    R_ac, t_ac = scan.motion.poses(2.0 + returns.times_s)
    points_c = np.einsum("nji,nj->ni", R_ac, returns.directions * returns.ranges[:, None] - t_ac)
    assert distance_to_mesh(points_c).max() < 1e-6
    R_0, t_0 = scan.motion.poses([2.0])
    as_one = (returns.directions * returns.ranges[:, None] - t_0) @ R_0[0]
    assert (
        distance_to_mesh(as_one).max() > 0.05
    )  # by the pose at the stamp they do not: the target turned 0.3 rad
    assert np.all(np.diff(returns.times_s) > 0)
    assert 0 <= returns.times_s[0] < returns.times_s[-1] < 1.0


def test_a_raster_of_a_still_target_is_a_flash_of_the_same_rays():
    still = MotionParams(attitude_xyzw=SPIN.attitude_xyzw, rate_radps=(0, 0, 0))
    raster = scanner(replace(CLEAN, pattern=Pattern.RASTER, scan_s=1.0), still)
    flash = scanner(CLEAN, still)
    flash.rays = raster.rays
    assert_allclose(raster.cast(0.0).ranges, flash.cast(0.0).ranges, atol=1e-9)


@pytest.mark.parametrize("view", list(FieldOfView))
@pytest.mark.parametrize("pattern", list(Pattern))
def test_the_field_of_view_bounds_every_ray(view, pattern):
    params = replace(
        CLEAN,
        fov_deg=(20.0, 10.0),
        view=view,
        pattern=pattern,
        scan_s=float(pattern is not Pattern.FLASH),
    )
    d = scanner(params).rays[0]
    across, down = (
        np.degrees(np.arctan2(d[:, 0], d[:, 2])),
        np.degrees(np.arctan2(d[:, 1], d[:, 2])),
    )
    assert np.abs(across).max() < 10
    assert np.abs(down).max() < 5
    assert np.abs(across).max() > 9.5
    assert np.abs(down).max() > 4.7
    if view is FieldOfView.CONE:
        assert np.all(np.hypot(across / 10, down / 5) < 1.01)
    assert_allclose(np.linalg.norm(d, axis=1), 1.0, atol=1e-15)


def test_range_gate_and_grazing_returns():
    flat = replace(CLEAN, max_incidence_deg=90.0)
    assert len(scanner(replace(CLEAN, max_incidence_deg=60.0)).cast(0.0).ranges) < len(
        scanner(flat).cast(0.0).ranges
    )
    near = scanner(replace(flat, range_max_m=5.0)).cast(0.0)
    assert 0 < len(near.ranges) < len(scanner(flat).cast(0.0).ranges)
    assert near.ranges.max() <= 5.0
    assert len(scanner(replace(flat, range_min_m=0.1, range_max_m=1.0)).cast(0.0).ranges) == 0


def test_culling_loses_no_return():
    scan = scanner(replace(CLEAN, fov_deg=(90.0, 90.0)))
    culled = scan.cast(0.0)
    scan.radius_m = 100.0
    assert np.array_equal(scan.cast(0.0).ranges, culled.ranges)


def test_a_small_target_is_scanned_as_well():
    small = builtin_surface(Shape.BRACKET)
    small = Surface(small.vertices * 0.1, small.faces, "small", "")
    params = replace(CLEAN, fov_deg=(30.0, 30.0), range_min_m=0.05, range_max_m=1.0)
    motion = MotionParams(position_m=(0, 0, 0.3), rate_radps=(0.1, 0, 0))
    scan = scanner(params, motion, small)
    returns = scan.cast(0.0)
    R_ac, t_ac = scan.motion.poses([0.0])
    back = (returns.directions * returns.ranges[:, None] - t_ac) @ R_ac[0]
    mesh = trimesh.Trimesh(small.vertices, small.faces, process=False)
    assert len(back) > 100
    assert trimesh.proximity.closest_point(mesh, back)[1].max() < 1e-7


@pytest.mark.parametrize(
    "wrong",
    [
        {"fov_deg": (0.0, 30.0)},
        {"rays": (0, 10)},
        {"outlier_ratio": 1.5},
        {"noise_m": -1.0},
        {"range_min_m": 20.0},
        {"max_incidence_deg": 0.0},
        {"scan_s": 0.5},
        {"pattern": Pattern.RASTER},
    ],
)
def test_invalid_scanners_are_refused_by_name(wrong):
    with pytest.raises(ValueError, match="scan_s" if "pattern" in wrong else next(iter(wrong))):
        ScannerParams(**wrong)
