"""Global search without a guess at any attitude: unique where possible, ambiguous for a
symmetric target.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
import trimesh
from scipy.spatial import cKDTree

from avsreplay import geometry
from avsreplay.geometry import Array, Pose, exp, matrix
from avsreplay.log import read_surface
from avsreplay.log.ply import read_ply
from avsreplay.records import AlignStatus, Surface
from avsreplay.register import global_search
from avsreplay.register.comparison import Measured
from avsreplay.register.contract import boxes, example_pose, view
from avsreplay.register.global_search import (
    GlobalSearch,
    SearchResult,
    VisibleCentroids,
)
from avsreplay.register.params import AcquireParams, Camera, RegisterParams
from avsreplay.register.registrar import Registrar
from avsreplay.register.sampling import (
    MOST_ATTEMPTS,
    attempts,
    attitudes,
    directions,
    fitted_normals,
    line_of_sight,
    sample,
    thin_to,
    without_sparse_points,
)
from avsreplay.register.surface_index import IcpResult, SurfaceIndex, kernel_module
from avsreplay.simulate.target import builtin_surface

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SEED = 5


def _scan(surface: Surface, T_ac: Pose, rng: np.random.Generator, sigma: float = 0.008) -> Array:
    """Faces towards the camera, noise along the ray, 2 % strays; faces do not hide each other."""
    points = T_ac.apply(view(surface, 9000, T_ac.inverse().t))
    ranges = 1.0 + rng.normal(0.0, sigma, (len(points), 1)) / np.linalg.norm(
        points, axis=1, keepdims=True
    )
    ranges[rng.random(len(points)) < 0.02] *= rng.uniform(0.5, 1.5)
    return points * ranges


def _any_pose(rng: np.random.Generator) -> Pose:
    q = rng.normal(size=4)
    return Pose(q / np.linalg.norm(q), rng.normal(0.0, 0.2, 3) + np.array([0.0, 0.0, 8.0]))


@pytest.fixture(scope="module")
def registrar() -> Registrar:
    return Registrar(boxes())


@pytest.mark.slow
def test_any_attitude_is_found_without_a_guess(registrar: Registrar) -> None:
    rng = np.random.default_rng(SEED)
    for _ in range(10):
        truth = _any_pose(rng)
        found = registrar.acquire(_scan(boxes(), truth, rng))
        assert found.status is AlignStatus.ALIGNED
        step = truth.inverse() @ found.T_ac
        assert np.degrees(geometry.angle(step.q)) < 0.5
        assert np.linalg.norm(step.t) < 0.02


def test_a_search_repeats_bit_for_bit(registrar: Registrar) -> None:
    scan = _scan(boxes(), _any_pose(np.random.default_rng(1)), np.random.default_rng(2))
    first, again = registrar.acquire(scan), Registrar(boxes()).acquire(scan)
    assert first.T_ac.matrix.tobytes() == again.T_ac.matrix.tobytes()


def _box(size: tuple[float, float, float]) -> Surface:
    whole = boxes()
    vertices = whole.vertices[:8] / np.array([2.0, 1.6, 2.4]) * np.array(size)
    return replace(whole, vertices=vertices, faces=whole.faces[:12], name="box")


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1.0, 1.0, 1.0), (2.0, 1.0, 0.6)], ids=["cube", "brick"])
def test_a_symmetric_target_is_said_to_be_ambiguous(size: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(SEED)
    registrar = Registrar(_box(size))
    results = [registrar.acquire(_scan(_box(size), _any_pose(rng), rng)) for _ in range(4)]
    assert all(each.covariance is None for each in results)  # none is accepted as the pose
    said = [each for each in results if each.status is AlignStatus.AMBIGUOUS]
    assert len(said) >= 3  # the search of one view of the brick ends at a pose that slides along it
    assert all(each.free_directions.startswith("turned ") for each in said)


@pytest.mark.slow
def test_another_object_is_not_found(registrar: Registrar) -> None:
    rng = np.random.default_rng(SEED)
    cloud = rng.normal(size=(3000, 3))
    sphere = 2.5 * cloud / np.linalg.norm(cloud, axis=1, keepdims=True) + np.array([0.0, 0.0, 9.0])
    assert registrar.acquire(sphere).status is AlignStatus.NO_OVERLAP


def test_an_empty_scan_and_a_handful_of_points_are_answered(registrar: Registrar) -> None:
    assert registrar.acquire(np.empty((0, 3))).status is AlignStatus.NO_POINTS
    assert registrar.acquire(np.full((3, 3), np.nan)).status is AlignStatus.NO_POINTS
    few = np.array([[0.0, 0.0, 5.0], [0.1, 0.0, 5.0]])
    assert registrar.acquire(few).status is not AlignStatus.ALIGNED


def test_a_scan_in_another_frame_than_the_cameras_is_found() -> None:
    """The scan moved into a frame whose origin lies in the target: that is no camera, and
    nothing says where it was.
    """
    rng = np.random.default_rng(SEED)
    registrar = Registrar(boxes())
    truth = _any_pose(rng)
    scan = _scan(boxes(), truth, rng)
    motion = Pose(np.array([0.5, 0.1, -0.4, 0.7]), np.zeros(3)) @ Pose(
        geometry.IDENTITY_QUAT, -truth.t
    )
    found = registrar.acquire(motion.apply(scan))
    step = (motion @ truth).inverse() @ found.T_ac
    assert np.degrees(geometry.angle(step.q)) < 0.5


@pytest.mark.parametrize("seed", range(4))
def test_the_normals_of_a_scan_show_the_line_of_sight(seed: int) -> None:
    """Up to its sign, of rays of even density."""
    seen = scenes.view(boxes(), 3000, seed).points
    sight = seen.mean(axis=0) / np.linalg.norm(seen.mean(axis=0))
    line = line_of_sight(fitted_normals(seen, seen))
    assert abs(line @ sight) > np.cos(np.radians(40.0))


def test_a_target_of_which_a_third_is_in_the_scan_is_found(registrar: Registrar) -> None:
    rng = np.random.default_rng(SEED)
    for k in range(4):
        truth = _any_pose(rng)
        scan = _scan(boxes(), truth, rng, sigma=0.004)
        across = scan[:, :2] @ np.array([np.cos(1.7 * k), np.sin(1.7 * k)])
        found = registrar.acquire(scan[across < np.quantile(across, 0.35)])
        if found.status is AlignStatus.ALIGNED:
            assert _off_deg(truth, found.T_ac) < 1.0
        assert found.status in (AlignStatus.ALIGNED, AlignStatus.AMBIGUOUS, AlignStatus.DEGENERATE)


def test_a_scan_that_shows_no_target_is_searched_a_limited_number_of_times(
    registrar: Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By no more rounds than there are parts of the scan and kinds of starts, and no registration
    of its result has more passes than an ordinary one.
    """
    rng = np.random.default_rng(SEED)
    scan = rng.uniform([-2.0, -2.0, 7.0], [2.0, 2.0, 11.0], (800, 3))
    search, icp, rounds, passes = GlobalSearch.search, SurfaceIndex.icp, [], []

    def searched(self: GlobalSearch, *given: object) -> SearchResult:
        rounds.append(1)
        return search(self, *given)

    def registered(self: SurfaceIndex, *given: object) -> IcpResult:
        found = icp(self, *given)
        passes.append(found.iterations)
        return found

    monkeypatch.setattr(GlobalSearch, "search", searched)
    monkeypatch.setattr(SurfaceIndex, "icp", registered)
    found = registrar.acquire(scan)
    assert not found.measured
    assert found.status is AlignStatus.NO_OVERLAP
    assert 0 < len(rounds) <= MOST_ATTEMPTS
    assert max(passes) <= registrar.limits.n_max
    assert len(passes) < 40 * len(rounds)


# --- the parts


def test_a_looked_up_distance_is_that_to_the_sampled_surface(registrar: Registrar) -> None:
    """Exact points cost almost nothing, points five cells away cost all; neither depends on
    the number of threads.
    """
    surface = boxes()
    points, normals = sample(surface, 3000)
    field = kernel_module().Field(points, normals, 40)
    still = np.eye(4)[None]
    rule = (0, 1.0, 0.7, 1.0, 0.02 * surface.extent, False)
    assert field.refine(points, still, *rule)[1][0] < 0.05
    away = np.tile(np.eye(4), (50, 1, 1))
    away[:, :3, 3] = 0.6 * surface.extent * directions(50)
    costs = [field.refine(points, away, *rule, threads)[1] for threads in (1, 2)]
    assert (costs[0] > 0.9).all()
    assert costs[0].tobytes() == costs[1].tobytes()


def test_a_body_with_a_near_symmetry_is_known_to_have_it() -> None:
    search = Registrar(_box((2.0, 1.0, 0.6))).loop.symmetry.search
    turns = [float(np.degrees(geometry.angle(Pose.from_matrix(T).q))) for T in search.symmetries]
    assert turns
    assert all(angle > 175.0 for angle in turns)
    tree = cKDTree(sample(_box((2.0, 1.0, 0.6)), 20_000)[0])
    moved = [
        Pose.from_matrix(T).apply(sample(_box((2.0, 1.0, 0.6)), 1000)[0]) for T in search.symmetries
    ]
    assert all((tree.query(points)[0] < 0.1).mean() > 0.9 for points in moved)


def test_the_symmetries_of_a_body_are_exact_so_that_a_turned_part_of_it_still_fits() -> None:
    parts = [
        trimesh.creation.cylinder(radius=r, height=h, sections=8)
        for r, h in ((1.8, 0.3), (0.6, 0.2))
    ]
    parts[1].apply_translation((0.0, 0.0, 0.25))
    body = trimesh.util.concatenate(parts)
    registrar = Registrar(_mesh(body))
    points, _ = sample(_mesh(body), 500)
    motions = [
        T for T in registrar.loop.symmetry.search.symmetries if T[2, 2] > 0.5
    ]  # about z: the body has a top
    assert motions
    for T in motions:
        assert (
            registrar.distance(points, Pose.from_matrix(T), 1.0).max()
            < 1e-4 * registrar.index.extent_m
        )


def test_attitudes_near_the_identity_that_return_to_it_are_no_symmetries(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A box turned by 12 deg still covers most of itself, and is registered back to where it
    was.
    """
    box = _box((2.0, 1.6, 1.8))
    search = Registrar(box).loop.symmetry.search
    half_turn = Pose.from_matrix(search.symmetries[0])
    near = [Pose(exp(np.radians(12.0) * np.eye(3)[k]), np.zeros(3)) for k in range(3)]
    starts = [*near, half_turn, half_turn @ near[0]]
    monkeypatch.setattr(GlobalSearch, "_selected", lambda *_: starts)
    monkeypatch.setattr(global_search, "SYMMETRIC", 1.0)
    monkeypatch.setattr(global_search, "principal_turns", lambda _: np.empty((0, 4, 4)))
    found = [Pose.from_matrix(T) for T in Registrar(box).loop.symmetry.search.symmetries]
    assert any(search.poses.same(each, half_turn) for each in found)
    poses = [Pose.identity(), *found]
    assert not any(
        search.poses.same(one, other) for k, one in enumerate(poses) for other in poses[:k]
    )


def test_attitudes_cover_all_rotations() -> None:
    """Every rotation is within 30 deg, less than a plane start's basin, of one of 600."""
    quaternions = attitudes(600)
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1.0)
    asked = np.random.default_rng(SEED).normal(size=(2000, 4))
    asked /= np.linalg.norm(asked, axis=1, keepdims=True)
    nearest = 2.0 * np.arccos(np.clip(np.abs(asked @ quaternions.T).max(axis=1), 0.0, 1.0))
    assert np.degrees(nearest.max()) < 30.0


def test_directions_are_even() -> None:
    found = directions(200)
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=1e-2)
    np.testing.assert_allclose(found.T @ found / 200, np.eye(3) / 3.0, atol=1e-2)


def test_the_visible_centre_of_a_sphere_is_towards_the_camera() -> None:
    """Of a sphere seen from afar the image's centroid lies 2/3 of the radius nearer: mean
    cosine over a disc.
    """
    normals = directions(8000)
    centres = VisibleCentroids(2.0 * normals, normals, 4.0, count=30)
    for towards in directions(30)[::5]:
        np.testing.assert_allclose(centres.of(towards), 4.0 / 3.0 * towards, atol=0.15)


def test_isolated_points_are_removed_before_thinning() -> None:
    rng = np.random.default_rng(SEED)
    surface = np.concatenate([rng.uniform(-1, 1, (4000, 2)), np.zeros((4000, 1))], axis=1)
    strays = rng.uniform(-10, 10, (80, 3))
    kept = without_sparse_points(np.concatenate([surface, strays]))
    assert (np.abs(kept).max(axis=1) <= 1.0).mean() > 0.995
    assert len(kept) > 3800
    assert 120 <= len(thin_to(kept, 150)) <= 190


@pytest.mark.parametrize(("key", "value"), [("starts", 0), ("least_ratio", 1.5), ("margin", -0.1)])
def test_a_value_that_cannot_be_right_is_named(key: str, value: float) -> None:
    with pytest.raises(ValueError, match=key):
        AcquireParams(**{key: value})


# --- real scans


def _real(folder: str, conf: str) -> list[tuple[str, Array, Pose]]:
    """Scans and given poses T_ac: p_model = R(q)' p_scan + t (the folder's README)."""
    if not DATA.is_dir():
        pytest.skip("../shared/data is not here")
    found = []
    for line in (DATA / folder / conf).read_text().splitlines():
        words = line.split()
        if words and words[0] == "bmesh":
            q = np.array(words[5:9], dtype=float)
            T_ca = Pose(geometry.conjugate(q), np.array(words[2:5], dtype=float))
            points = read_ply((DATA / folder / words[1]).read_bytes()).points()
            found.append((words[1], points, T_ca.inverse()))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("camera", [Camera.AUTO, Camera.NONE])
def test_every_scan_of_the_statuette_is_found_though_its_frame_is_not_that_of_the_sensor(
    camera: Camera,
) -> None:
    scans = _real("stanford-dragon", "dragonStandRight.conf")
    surface = read_surface(DATA / "stanford-dragon" / "dragon_vrip_res3.ply")
    registrar = Registrar(surface, RegisterParams(camera=camera))
    for name, points, truth in scans:
        found = registrar.acquire(points)
        assert found.status is AlignStatus.ALIGNED, (name, found.message)
        assert _off_deg(truth, found.T_ac) < 0.5, name


def _off_deg(truth: Pose, found: Pose) -> float:
    return float(np.degrees(geometry.angle((truth.inverse() @ found).q)))


@pytest.mark.slow
def test_bunny_comes_back_from_24_degrees_and_from_nothing() -> None:
    scans = _real("stanford-bunny", "bun.conf")
    surface = read_surface(DATA / "stanford-bunny" / "bun_zipper_res3.ply")
    registrar = Registrar(surface)
    rng, middle = np.random.default_rng(SEED), surface.vertices.mean(axis=0)
    for name, points, truth in scans:
        axis = rng.normal(size=3)
        for degrees in (5.0, 15.0, 24.0):
            q = geometry.exp(np.radians(degrees) * axis / np.linalg.norm(axis))
            guess = truth @ Pose(q, middle - matrix(q) @ middle)
            assert _off_deg(truth, registrar.register(points[::4], guess).T_ac) < 2.0, (
                name,
                degrees,
            )
    for name, points, truth in scans[::3]:
        assert _off_deg(truth, registrar.acquire(points[::4]).T_ac) < 2.0, name


@pytest.mark.slow
def test_dragon_is_tracked_over_24_degree_steps_within_half_a_degree_and_half_a_millimetre() -> (
    None
):
    scans = _real("stanford-dragon", "dragonStandRight.conf")
    surface = read_surface(DATA / "stanford-dragon" / "dragon_vrip_res3.ply")
    registrar = Registrar(surface, RegisterParams())
    turn = Pose(geometry.exp(np.radians([0.0, 24.0, 0.0])), np.zeros(3))
    errors = []
    for name, points, truth in scans[::4]:
        found = registrar.register(points[::4], turn @ truth)
        assert found.status is AlignStatus.ALIGNED, name
        errors.append((_off_deg(truth, found.T_ac), np.linalg.norm(found.T_ac.t - truth.t)))
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert rms[0] < 0.5
    assert rms[1] < 0.5e-3


@pytest.mark.parametrize(("noise", "unique"), [(0.001, True), (0.0066, False)])
def test_a_difference_that_noise_alone_can_cause_does_not_make_a_pose_unique(
    registrar: Registrar, noise: float, unique: bool
) -> None:
    """Noise favours a wrong pose with more surface nearby: 3 % more points on the model say
    nothing at large noise.
    """
    extent, rng = registrar.target.surface.extent, np.random.default_rng(6)
    distance = noise * extent * np.abs(rng.standard_normal(1500))
    off = distance.copy()
    off[:45] = 0.1 * extent
    turned = Pose(exp([0.0, 0.0, np.pi]), np.zeros(3))
    found = registrar.loop.symmetry.search.verdict(
        [Measured(turned, off), Measured(Pose.identity(), distance)]
    )
    assert np.array_equal(found.best.matrix, np.eye(4))
    assert bool(found.rivals) is not unique


def test_a_few_returns_far_away_do_not_change_the_result_of_a_search() -> None:
    """Two returns of a hundred lie anywhere up to 35 extents away."""
    block = trimesh.creation.box((0.3, 0.4, 0.5)).apply_translation((0.5, 0.2, 0.3))
    model = _mesh(trimesh.util.concatenate([trimesh.creation.box((2.0, 1.2, 0.1)), block]))
    registrar = Registrar(model)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        q = rng.standard_normal(4)
        T_ac = Pose(q / np.linalg.norm(q), np.array([0.1, -0.2, 2.0 * model.extent]))
        scan = T_ac.apply(view(model, 2000, T_ac.inverse().t))
        count = len(scan) // 50
        rays = np.append(rng.uniform(-0.4, 0.4, (count, 2)), np.ones((count, 1)), axis=1)
        rays *= rng.uniform(1.0, 35.0, (count, 1)) * model.extent
        found = registrar.acquire(np.vstack([scan, rays]))
        assert found.status is registrar.acquire(scan).status
        if found.status is AlignStatus.ALIGNED:
            assert _off_deg(T_ac, found.T_ac) < 0.1


def test_a_known_pose_takes_part_in_a_search(registrar: Registrar) -> None:
    """The result from a guess is ranked with the poses of the search."""
    model, T_ac = boxes(), example_pose()
    scan = T_ac.apply(view(model, 2000, T_ac.inverse().t))
    apart = Pose(exp([0.0, 0.0, 1.0]), np.zeros(3)) @ T_ac.inverse()
    found = registrar.loop.symmetry.search.search(scan, known=apart)
    assert any(np.array_equal(each.T_ca.matrix, apart.matrix) for each in found.candidates)
    assert not found.rivals


def test_a_point_at_the_sensor_has_no_direction_and_is_left_out() -> None:
    """Sensors report a missing return as (0, 0, 0); the choice between nearly symmetric poses
    uses directions.
    """
    surface, T_ac = _box((1.0, 0.8, 0.4)), example_pose()
    points, missing = T_ac.apply(view(surface, 500, T_ac.inverse().t)), np.zeros((5, 3))
    registrar, T_ca = Registrar(surface), T_ac.inverse()
    symmetry = registrar.loop.symmetry
    rays, padded = (symmetry.rays(p) for p in (points, np.concatenate([points, missing])))
    assert len(padded.points) == len(rays.points)
    expected, found = (symmetry.turned_poses(each, T_ca, False) for each in (rays, padded))
    assert [T.matrix.tolist() for T in found] == [T.matrix.tolist() for T in expected]
    assert not len(symmetry.rays(missing).points)
    scan = np.concatenate([points, missing])
    assert registrar.register(scan, T_ac).status is registrar.register(points, T_ac).status


def test_faces_of_many_bodies_must_be_all_that_is_visible() -> None:
    """Two faces of a wedge fit an L-bracket; they determine no size, and other faces of the
    bracket are missing.
    """
    parts = [trimesh.creation.box((2.0, 0.3, 1.0)), trimesh.creation.box((0.3, 1.5, 1.0))]
    parts[1].apply_translation((-0.85, 0.7, 0.0))
    bracket = _mesh(trimesh.util.concatenate(parts))
    corners = [[0, 0, 0], [1.6, 0, 0], [1.6, 1.4, 0], [0, 1.4, 0], [0, 0, 0.8], [0, 1.4, 0.8]]
    wedge = _mesh(trimesh.convex.convex_hull(np.array(corners)))
    registrar = Registrar(bracket)
    for seed in (78600, 78601):
        points = scenes.view(scenes.grown(wedge, bracket.extent / wedge.extent), 2000, seed).points
        found = registrar.acquire(points)
        assert found.inlier_ratio > 0.95
        assert found.status in (
            AlignStatus.IMPLAUSIBLE,
            AlignStatus.AMBIGUOUS,
            AlignStatus.NO_OVERLAP,
        )


def _mesh(body: trimesh.Trimesh) -> Surface:
    return Surface(np.array(body.vertices), np.array(body.faces, dtype=np.int32), "", "")


@pytest.mark.parametrize("seed", [36, 52])
def test_a_panel_is_not_matched_to_its_other_side_where_the_camera_is_not_known(seed: int) -> None:
    """A minimum 1.1 deg off has 99 % of the points within the gate."""
    surface = builtin_surface()
    q = np.random.default_rng(seed).standard_normal(4)
    T_ac = Pose(q / np.linalg.norm(q), np.array([0.0, 0.0, 3.0 * surface.extent]))
    points = T_ac.apply(view(surface, 3000, T_ac.inverse().t))
    found = Registrar(surface, RegisterParams(camera=Camera.NONE)).acquire(points)
    assert found.status is AlignStatus.ALIGNED
    step = T_ac.inverse() @ found.T_ac
    assert float(geometry.angle(step.q)) < 1e-4
    assert np.linalg.norm(step.t) < 1e-4 * surface.extent


@pytest.mark.parametrize(("size", "numbers"), [(0.8, [1, 0, 2]), (0.9, [0, 1, 2])])
def test_a_scan_of_a_part_of_the_target_is_searched_with_shifted_starts_first(
    size: float, numbers: list[int]
) -> None:
    rng = np.random.default_rng(SEED)
    points = rng.uniform(-0.5, 0.5, (2000, 3)) * np.array([size, 0.0, 0.0]) + [0.0, 0.0, 3.0]
    points[:2] = [[-0.5 * size, 0.0, 3.0], [0.5 * size, 0.0, 3.0]]
    assert [
        number for part, number in attempts(points, 1.0, lambda: False) if part is points
    ] == numbers
