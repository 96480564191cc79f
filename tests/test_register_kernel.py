"""The C++ kernel: exact against independent searches, the same bits for any thread count and
instruction set.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.closest_point import OracleIndex

from avsreplay import register
from avsreplay.geometry import Array, Pose, exp
from avsreplay.records import Surface
from avsreplay.register.params import RegisterParams
from avsreplay.register.surface_index import IcpParams, SurfaceIndex, kernel_module

kernel = pytest.importorskip("avsreplay.register._kernel", reason="the C++ kernel is not built")
scipy_spatial = pytest.importorskip("scipy.spatial")

NO_FACES = np.zeros((0, 3), dtype=np.int32)


def surface(vertices: Array, faces: object = NO_FACES) -> Surface:
    return Surface(
        np.asarray(vertices, dtype=np.float64),
        np.asarray(faces, dtype=np.int32).reshape(-1, 3),
        "test",
        "",
    )


def rng(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


def soup(n: int, seed: int, size: float = 0.3) -> Surface:
    """n triangles anywhere in a box, of sizes over two decades, some of them slivers."""
    r = rng(seed)
    corners = r.uniform(-1, 1, (n, 1, 3)) + size * r.standard_normal((n, 3, 3)) * 10 ** r.uniform(
        -2, 0, (n, 1, 1)
    )
    thin = r.random(n) < 0.2
    along = corners[thin, 0] + 0.7 * (corners[thin, 1] - corners[thin, 0])
    corners[thin, 2] = along + 1e-7 * r.standard_normal(along.shape)
    return surface(corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3))


def distances(q: Array, corners: Array) -> Array:
    """Distance from q (3,) to each triangle (m, 3, 3), by barycentric coordinates and the sides, in
    long double.
    """
    a, b, c, q = (x.astype(np.longdouble) for x in (corners[:, 0], corners[:, 1], corners[:, 2], q))
    sides = np.min([_to_side(q, a, b), _to_side(q, b, c), _to_side(q, c, a)], axis=0)
    ab, ac, aq = b - a, c - a, q - a
    m = np.cross(ab, ac)
    v, w = _dot(np.cross(aq, ac), m) / _dot(m, m), _dot(np.cross(ab, aq), m) / _dot(m, m)
    inside = (v >= 0) & (w >= 0) & (v + w <= 1)
    return np.where(
        inside, np.minimum(sides, np.abs(_dot(aq, m)) / np.sqrt(_dot(m, m))), sides
    ).astype(np.float64)


def _dot(u: Array, v: Array) -> Array:
    return np.sum(u * v, axis=-1)


def _to_side(q: Array, u: Array, v: Array) -> Array:
    t = np.clip(_dot(q - u, v - u) / np.maximum(_dot(v - u, v - u), 1e-300), 0, 1)
    return np.linalg.norm(u + t[:, None] * (v - u) - q, axis=1)


def adversarial(vertices: Array, seed: int, n: int) -> Array:
    """Queries where a search goes wrong if it can: on vertices, halfway between them, a
    rounding beside, far off.
    """
    r = rng(seed)
    i, j = r.integers(len(vertices), size=(2, n))
    t = r.random((n, 1))
    return np.concatenate(
        [
            vertices[i],
            0.5 * (vertices[i] + vertices[j]),
            np.nextafter(vertices[i], np.inf),
            vertices[i] + 1e-9 * r.standard_normal((n, 3)),
            (1 - t) * vertices[i] + t * vertices[j],
            vertices[i] + 10 ** r.uniform(-6, 1, (n, 1)) * r.standard_normal((n, 3)),
            np.round(vertices[i], 1),
        ]
    )


def clouds() -> dict[str, Array]:
    r = rng(1)
    sphere = r.standard_normal((4000, 3))
    lattice = np.stack(np.meshgrid(*[np.arange(12.0)] * 3), -1).reshape(-1, 3)
    angle = np.linspace(0, 2 * np.pi, 3000, endpoint=False)
    return {
        "sphere, its middle equally far from all": sphere
        / np.linalg.norm(sphere, axis=1, keepdims=True),
        "lattice, ties everywhere": lattice,
        "ring, a whole axis of ties": np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]),
        "one point": np.array([[0.1, 0.2, 0.3]]),
        "doubled points": np.repeat(r.standard_normal((300, 3)), 5, axis=0),
        "flat": np.column_stack([r.random((2000, 2)), np.zeros(2000)]),
        "far from the origin": 1e4 + r.standard_normal((2000, 3)),
        "two scales": np.concatenate(
            [1e-3 * r.standard_normal((2000, 3)), 5 + r.standard_normal((500, 3))]
        ),
    }


@pytest.mark.parametrize("name", clouds())
def test_nearest_point_is_that_of_a_kd_tree(name: str) -> None:
    points = clouds()[name]
    extent = max(float(np.linalg.norm(np.ptp(points, axis=0))), 0.1)
    reach = 0.4 * extent
    model = SurfaceIndex.build(surface(points), reach)
    low, high = points.min(0) - 1.2 * reach, points.max(0) + 1.2 * reach
    q = np.concatenate([rng(2).uniform(low, high, (8000, 3)), adversarial(points, 3, 300)])
    found = model.closest(q)
    d, _ = scipy_spatial.cKDTree(points).query(q)
    sure = np.abs(d - reach) > 1e-9 * extent
    assert np.array_equal((found.id >= 0)[sure], (d < reach)[sure])
    near = found.id >= 0
    assert np.allclose(np.sqrt(found.d2[near]), d[near], rtol=1e-14, atol=0)
    assert np.array_equal(found.foot[near], points[found.id[near]])


@pytest.mark.parametrize("count", [0, 1, 3, 700])
def test_the_tree_of_points_has_the_distances_of_another_kd_tree(count: int) -> None:
    points = rng(6).standard_normal((count, 3)) * [1.0, 1.0, 0.01]
    points[: count // 3] = points[:1]  # more equal points than a leaf holds
    q = np.concatenate([rng(7).standard_normal((300, 3)), points])
    for k in (1, 2, 9):
        distance, number = kernel_module().PointTree(points).query(q, k)
        assert np.array_equal(
            distance, scipy_spatial.cKDTree(points).query(q, k=range(1, k + 1))[0]
        )
        known = number < count
        assert np.array_equal(known, np.isfinite(distance))
        between = np.linalg.norm(
            q[:, None, :] - np.append(points, np.zeros((1, 3)), axis=0)[number], axis=2
        )
        assert np.allclose(between[known], distance[known], rtol=1e-14, atol=0)
        assert all(len(set(row[row < count])) == np.sum(row < count) for row in number)


@pytest.mark.parametrize("count", [0, 1, 40, 700])
def test_groups_of_points_are_numbered_in_the_order_of_their_first_points(count: int) -> None:
    points = rng(8).uniform(0.0, 1.0, (count, 3)) * [1.0, 1.0, 0.01]
    for most in (0.001, 0.03, 0.05, 0.2):
        near = scipy_spatial.distance.cdist(points, points) <= most
        own, expected = np.full(count, -1), 0
        for k in range(count):
            if own[k] < 0:
                reached = np.arange(count) == k
                while (more := near[reached].any(axis=0)).sum() > reached.sum():
                    reached = more
                own[reached], expected = expected, expected + 1
        assert np.array_equal(kernel_module().PointTree(points).groups(most), own)


def test_the_tree_of_points_refuses_other_shapes() -> None:
    with pytest.raises(ValueError, match="points must be"):
        kernel_module().PointTree(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="k from 1"):
        kernel_module().PointTree(np.zeros((3, 3))).query(np.zeros((3, 3)), 0)


def test_the_lower_index_wins_a_tie() -> None:
    points = np.repeat(rng(4).standard_normal((500, 3)), 3, axis=0)[rng(5).permutation(1500)]
    found = SurfaceIndex.build(surface(points), 1.0).closest(points)
    first = np.array([np.flatnonzero((points == p).all(1))[0] for p in points])
    assert np.array_equal(found.id, first)


@pytest.mark.parametrize(("n", "size"), [(1, 1.0), (7, 0.5), (300, 0.3), (1500, 0.05)])
def test_nearest_triangle_is_that_of_a_full_search(n: int, size: float) -> None:
    mesh = soup(n, seed=n, size=size)
    reach = 0.35
    model = SurfaceIndex.build(mesh, reach)
    corners = mesh.vertices[mesh.faces]
    q = np.concatenate([rng(6).uniform(-1.6, 1.6, (300, 3)), adversarial(mesh.vertices, 7, 60)])
    found = model.closest(q)
    for k, query in enumerate(q):
        each = distances(query, corners)
        d = each.min()
        if abs(d - reach) < 1e-9:
            continue
        assert (found.id[k] >= 0) == (d < reach)
        if d < reach:
            assert np.sqrt(found.d2[k]) == pytest.approx(d, abs=1e-9)
            assert each[found.id[k]] == pytest.approx(d, abs=1e-9)
            assert np.linalg.norm(found.foot[k] - query) == pytest.approx(d, abs=1e-9)


def test_the_foot_is_on_its_triangle_and_nowhere_nearer_point_is_found() -> None:
    """Optimality: no random convex combination of any triangle's corners is nearer."""
    mesh = soup(200, seed=8)
    model = SurfaceIndex.build(mesh, 1.0)
    q = rng(9).uniform(-1.5, 1.5, (300, 3))
    found = model.closest(q)
    inside = rng(10).dirichlet(np.ones(3), size=(200, 50))
    spread = np.einsum("tpk,tki->tpi", inside, mesh.vertices[mesh.faces]).reshape(-1, 3)
    near = np.flatnonzero(found.id >= 0)
    assert len(near) > 200
    least = scipy_spatial.cKDTree(spread).query(q[near])[0]
    assert (np.sqrt(found.d2[near]) <= least + 1e-12).all()


def test_kernel_and_oracle_find_the_same_closest_points_on_the_built_in_like_mesh() -> None:
    mesh = soup(400, seed=11)
    q = np.concatenate([rng(12).uniform(-1.5, 1.5, (3000, 3)), adversarial(mesh.vertices, 13, 100)])
    ours, plain = (index(mesh, 0.5).closest(q) for index in (SurfaceIndex.build, OracleIndex))
    near = (ours.id >= 0) & (plain.id >= 0)
    unsure = np.abs(np.sqrt(np.minimum(ours.d2, plain.d2)) - 0.5) < 1e-9
    assert np.array_equal((ours.id >= 0) | unsure, (plain.id >= 0) | unsure)
    assert (
        np.abs(np.sqrt(ours.d2[near]) - np.sqrt(plain.d2[near])).max() < 1e-7
    )  # the slivers' normals
    assert np.median(np.abs(np.sqrt(ours.d2[near]) - np.sqrt(plain.d2[near]))) < 1e-15


def hard_meshes() -> dict[str, Surface]:
    """Meshes that are not closed, single and outer: what a display model of a spacecraft is
    made of.
    """
    trimesh = pytest.importorskip("trimesh")
    r = rng(20)
    ball = trimesh.creation.icosphere(3, 1.0)
    box = trimesh.creation.box((0.9, 0.7, 0.5))
    panel = trimesh.creation.box((2.5, 0.8, 0.004))
    inside = trimesh.util.concatenate([ball, box, panel])  # parts that intersect: interior faces
    half = ball.triangles_center[:, 2] < 0.3
    twice = np.concatenate([box.faces, box.faces, box.faces[::2, [1, 2, 0]], box.faces[:3, ::-1]])
    fine = trimesh.creation.torus(0.7, 0.3, major_sections=60, minor_sections=32)
    return {
        "interior faces": surface(inside.vertices, inside.faces),
        "open": surface(ball.vertices, ball.faces[half]),
        "duplicated, some turned over": surface(box.vertices, twice),
        "fine": surface(fine.vertices, fine.faces),
        "single faces in any order": soup(600, seed=21, size=0.2),
        "one face of a large model": surface(100.0 * r.standard_normal((3, 3)), [[0, 1, 2]]),
    }


@pytest.mark.parametrize("name", hard_meshes())
def test_nearest_face_that_faces_the_camera_is_that_of_a_full_search(name: str) -> None:
    mesh = hard_meshes()[name]
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    model = SurfaceIndex.build(mesh, 0.3 * mesh.extent)
    r = rng(22)
    on = np.einsum(
        "nk,nki->ni", r.dirichlet(np.ones(3), 120), corners[r.integers(len(corners), size=120)]
    )
    away = 10 ** r.uniform(-6, -0.5, (120, 1)) * mesh.extent * r.standard_normal((120, 3))
    q = np.concatenate([on + 0.01 * away, on + away, adversarial(mesh.vertices, 23, 12)])
    for eye in (
        np.array([0.3, 5.0, 2.0]) * mesh.extent,
        np.array([-0.02, 0.05, 0.1]) * mesh.extent,
    ):
        faces = np.sum((eye - corners[:, 0]) * normals, axis=1) > 0.0
        found = model.closest(q, camera_c=eye)
        assert faces[found.id[found.id >= 0]].all()
        least = np.array([distances(query, corners[faces]).min(initial=np.inf) for query in q])
        sure = np.abs(least - model.reach_m) > 1e-9 * mesh.extent
        assert np.array_equal((found.id >= 0)[sure], (least < model.reach_m)[sure])
        near = found.id >= 0
        assert np.abs(np.sqrt(found.d2[near]) - least[near]).max(initial=0.0) < 1e-9 * mesh.extent


@pytest.mark.parametrize("name", ["interior faces", "open", "fine"])
@pytest.mark.parametrize("facing", [True, False])
def test_neighbours_kept_over_many_passes_are_those_of_a_search(name: str, facing: bool) -> None:
    """The camera passes over many faces' edges while the pose settles, so faces begin and cease to
    face it.
    """
    mesh = hard_meshes()[name]
    model = SurfaceIndex.build(mesh, 0.3 * mesh.extent)
    corners = mesh.vertices[mesh.faces]
    r = rng(24)
    eye = np.array([0.5, 6.0, 2.0])
    seen = corners[
        np.sum(
            (eye - corners[:, 0])
            * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
            axis=1,
        )
        > 0
    ]
    p = np.einsum(
        "nk,nki->ni", r.dirichlet(np.ones(3), 3000), seen[r.integers(len(seen), size=3000)]
    )
    start = Pose(exp([0.06, -0.04, 0.05]), eye)
    scan = start.inverse().apply(p + 0.002 * r.standard_normal(p.shape))
    for n in (3, 8, 30):
        rule = IcpParams(n_max=n, n_plane=2, eps_rad=0.0, eps_m=0.0, facing=facing)
        guess = Pose(exp([0.02, 0.03, -0.02]), np.array([0.01, -0.01, 0.02])) @ start
        kept, plain = (model.icp(scan, guess, replace(rule, keep=keep)) for keep in (True, False))
        assert kept.T_ca.tobytes() == plain.T_ca.tobytes()
        assert kept.rms_m == plain.rms_m < 0.1
    assert kept.searched < plain.searched


@pytest.mark.parametrize("seed", range(6))
def test_newton_steps_end_at_the_fixed_point_of_horns_iteration(seed: int) -> None:
    """Horn's passes alone, continued to 1e-10, stay where Newton's ended; they need many
    times more passes.
    """
    trimesh = pytest.importorskip("trimesh")
    parts = [
        trimesh.creation.box((1.0, 0.7, 0.4)),
        trimesh.creation.box((0.5, 0.2, 0.9)),
        trimesh.creation.icosphere(2, 0.4),
    ]
    parts[1].apply_translation((0.6, 0.2, 0.3)), parts[2].apply_translation((-0.5, 0.3, 0.2))
    body = trimesh.util.concatenate(parts)
    mesh = surface(body.vertices, body.faces)
    scan = scan_of(mesh, 3000, seed, noise=0.004)
    model = SurfaceIndex.build(mesh, 0.3)
    found = model.icp(scan, GUESS, IcpParams(n_max=200))
    horn = IcpParams(
        n_max=3000,
        n_plane=0,
        gate_m=found.gate_m,
        tighten=0.0,
        eps_rad=1e-10,
        eps_m=1e-10,
        newton=False,
    )
    on = model.icp(scan, found.T_ca, horn)
    assert found.converged
    assert found.iterations <= 12
    assert np.abs(found.T_ca - on.T_ca).max() < 2e-5
    slow = model.icp(
        scan, GUESS, IcpParams(n_max=3000, newton=False, n_plane=0, eps_rad=1e-8, eps_m=1e-8)
    )
    assert slow.iterations > 2 * found.iterations


def test_a_view_along_a_plate_ends_although_newton_steps_fail_there() -> None:
    """A direction that a few points next to edges determine: full Newton steps leave the region in
    which these points have the same faces, and Horn's steps alone need hundreds of passes."""
    trimesh = pytest.importorskip("trimesh")
    body = trimesh.util.concatenate(
        [
            trimesh.creation.box(size).apply_translation(at)
            for size, at in (
                ((0.30, 0.10, 0.02), (0, 0, 0)),
                ((0.02, 0.10, 0.20), (-0.14, 0, 0.11)),
                ((0.08, 0.02, 0.08), (-0.09, 0.03, 0.05)),
            )
        ]
        + [trimesh.creation.cylinder(0.02, 0.08, sections=32).apply_translation((0.08, 0.02, 0.05))]
    )
    model = SurfaceIndex.build(surface(body.vertices, body.faces), 0.05)
    attitude = np.array([-0.05857033, 0.04744796, 0.72315495, 0.68656036])
    T_ac = Pose(attitude, np.array([0.03254935, -0.01001189, 1.61113644]))
    across = np.tan(np.radians(15.0)) * (np.arange(100) - 49.5) / 50.0
    rays = np.stack([*np.meshgrid(across, across), np.ones((100, 100))], -1).reshape(-1, 3)
    rays = rays[np.linalg.norm(rays[:, :2], axis=1) < 0.13]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    eye = np.tile(T_ac.inverse().t, (len(rays), 1))
    hits, seen, _ = body.ray.intersects_location(eye, rays @ T_ac.R, multiple_hits=False)
    ranges = np.linalg.norm(hits - eye[0], axis=1)
    rule = IcpParams(gate_m=0.05, floor_m=0.0015, n_max=200, eps_m=4e-7, facing=True)
    for seed in (*range(10), 158, 190, 194, 201, 283):
        r = rng(seed)
        scan = (ranges + 1e-3 * r.standard_normal(len(ranges)))[:, None] * rays[seen]
        guess = Pose(exp(1e-3 * r.standard_normal(3)), 3e-4 * r.standard_normal(3)) @ T_ac.inverse()
        assert model.icp(scan, guess, rule).converged


@pytest.mark.parametrize("seen", ["plate", "side of a cylinder"])
def test_directions_that_cannot_be_observed_are_left_at_the_guess(seen: str) -> None:
    r = rng(25)
    if seen == "plate":
        mesh = surface(
            [[-50.0, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], [[0, 1, 2], [0, 2, 3]]
        )
        p = np.column_stack([r.uniform(-1, 1, (2000, 2)), np.zeros(2000)])
    else:
        trimesh = pytest.importorskip("trimesh")
        tube = trimesh.creation.cylinder(1.0, 100.0, sections=360)
        mesh, angle = surface(tube.vertices, tube.faces), r.uniform(-1.2, 1.2, 2000)
        p = np.column_stack([np.cos(angle), np.sin(angle), r.uniform(-1, 1, 2000)])
    off = Pose(exp([0.01, -0.02, 0.0]), [0.01, 0.02, 0.03])
    found = SurfaceIndex.build(mesh, 1.0).icp(
        off.apply(p + 1e-3 * r.standard_normal(p.shape)), Pose.identity()
    )
    assert np.abs(found.T_ca[:3, 3]).max() < 0.2
    assert found.rms_m < 2e-3


def scan_of(mesh: Surface, n: int, seed: int, noise: float = 0.003) -> Array:
    r = rng(seed)
    corners = mesh.vertices[mesh.faces][r.integers(len(mesh.faces), size=n)]
    return np.einsum(
        "nk,nki->ni", r.dirichlet(np.ones(3), size=n), corners
    ) + noise * r.standard_normal((n, 3))


RULE = IcpParams(n_max=40)
FACING = IcpParams(n_max=40, facing=True)
GUESS = Pose(exp([0.03, -0.02, 0.04]), [0.02, -0.03, 0.01])


def everything(model: SurfaceIndex, scan: Array, rule: IcpParams = RULE) -> bytes:
    """All bits of an alignment and of the sums at its end."""
    r = model.icp(scan, GUESS, rule)
    n = model.normal_equations(scan, r.T_ca, 0.2, threads=rule.threads, facing=rule.facing)
    c = model.closest(scan, threads=rule.threads)
    numbers = [
        r.iterations,
        r.inliers,
        r.rms_m,
        r.gate_m,
        r.step_rad,
        r.step_m,
        n.inliers,
        n.sum_e2,
        n.sum_d2,
    ]
    arrays = [r.T_ca, n.info, n.gradient, c.foot, c.d2, c.normal]
    return np.concatenate(
        [np.array(numbers, dtype=np.float64), *(a.ravel() for a in arrays)]
    ).tobytes()


@pytest.fixture(params=["mesh", "cloud"])
def target(request: pytest.FixtureRequest) -> Surface:
    mesh = soup(600, seed=14)
    return mesh if request.param == "mesh" else surface(scan_of(mesh, 20_000, 15, 0.0))


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_any_number_of_threads_gives_the_same_bits(target: Surface, threads: int) -> None:
    scan = scan_of(soup(600, seed=14), 5003, 16)
    model = SurfaceIndex.build(target, 0.4)
    rule = IcpParams(n_max=40, threads=threads)
    assert everything(model, scan, rule) == everything(model, scan)
    assert everything(model, scan, replace(rule, facing=True)) == everything(model, scan, FACING)


def test_a_number_of_threads_that_no_system_has_is_refused(target: Surface) -> None:
    with pytest.raises(ValueError, match="threads is 1000000, must be at least 1 and at most 1024"):
        IcpParams(threads=1_000_000)
    with pytest.raises(ValueError, match="at most 1024"):
        RegisterParams(threads=1_000_000)


@pytest.mark.skipif(sys.platform != "linux", reason="limits the address space of a process")
def test_threads_that_the_system_refuses_do_not_end_the_process() -> None:
    """Those that start do the work: here the stacks of 1024 threads do not fit in the address
    space.
    """
    code = (
        "import resource\n"
        "import numpy as np\n"
        "from avsreplay.register.surface_index import SurfaceIndex\n"
        "from avsreplay.simulate.target import builtin_surface\n"
        "surface, points = builtin_surface(), np.random.default_rng(1).normal(size=(2000, 3))\n"
        "index = SurfaceIndex.build(surface, 1.0)\n"
        "alone = index.closest(points).d2\n"
        "size = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (size + (256 << 20), resource.RLIM_INFINITY))\n"
        "assert index.closest(points, threads=1024).d2.tobytes() == alone.tobytes()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr


def test_keeping_neighbours_gives_the_same_bits(target: Surface) -> None:
    scan = scan_of(soup(600, seed=14), 5003, 17)
    model = SurfaceIndex.build(target, 0.4)
    kept, searched = (
        model.icp(scan, GUESS, RULE),
        model.icp(scan, GUESS, IcpParams(n_max=40, keep=False)),
    )
    assert everything(model, scan) == everything(model, scan, IcpParams(n_max=40, keep=False))
    assert kept.searched < searched.searched == searched.iterations * len(scan)
    assert everything(model, scan, FACING) == everything(model, scan, replace(FACING, keep=False))


def sheet(n: int) -> Surface:
    """A wavy square of 2 (n - 1)^2 small triangles; their outer side is +z."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, n), np.linspace(-1.0, 1.0, n), indexing="ij")
    z = 0.1 * np.sin(3.0 * x) * np.cos(4.0 * y) + 0.15 * x * y
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = (each.ravel() for each in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return surface(np.column_stack([x.ravel(), y.ravel(), z.ravel()]), faces)


@pytest.mark.parametrize("facing", [False, True])
def test_on_small_triangles_most_searches_are_skipped_with_the_same_bits(facing: bool) -> None:
    """Neighbouring triangles are nearly as near as the nearest: only its block can be kept,
    not the triangle.
    """
    mesh, r = sheet(80), rng(31)
    model = SurfaceIndex.build(mesh, 0.4)
    at = mesh.vertices[r.integers(len(mesh.vertices), size=3000)] + 0.01 * r.standard_normal(
        (3000, 3)
    )
    camera = Pose(exp([0.0, np.pi, 0.0]), np.array([0.0, 0.0, 4.0]))
    scan = camera.inverse().apply(at)
    guess = Pose(exp([0.004, -0.003, 0.002]), np.array([0.004, 0.002, -0.003])) @ camera
    rule = IcpParams(
        n_max=12, n_plane=2, gate_m=0.1, tighten=0.0, eps_rad=0.0, eps_m=0.0, facing=facing
    )
    kept, plain = (model.icp(scan, guess, replace(rule, keep=keep)) for keep in (True, False))
    assert kept.T_ca.tobytes() == plain.T_ca.tobytes()
    assert kept.rms_m == plain.rms_m < 0.02
    assert kept.searched < 0.4 * plain.searched
    found = [
        model.evidence(scan, kept.T_ca, 0.1, 0.2, 24, facing=facing, matches=m)
        for m in (None, kept.matches)
    ]
    assert found[0].gradients.tobytes() == found[1].gradients.tobytes()


@pytest.mark.parametrize("eye", [None, (0.3, -0.2, 4.0)], ids=["both sides", "facing"])
@pytest.mark.parametrize("shape", ["sheet", "soup", "cloud"])
def test_each_point_is_found_as_if_it_were_alone(
    shape: str, eye: tuple[float, float, float] | None
) -> None:
    """The points of a strip are searched together: no point may have the blocks or the
    distances of another one.
    """
    shapes = {
        "sheet": sheet(40),
        "soup": soup(800, seed=41),
        "cloud": surface(rng(42).standard_normal((3000, 3))),
    }
    mesh, r = shapes[shape], rng(43)
    model = SurfaceIndex.build(mesh, 0.4)
    at = adversarial(mesh.vertices, 44, 60)
    at = np.concatenate([at, at + 0.01 * r.standard_normal(at.shape), np.full((3, 3), np.nan)])[
        r.permutation(2 * len(at) + 3)
    ]
    together = model.closest(at, camera_c=eye)
    for k, point in enumerate(at):
        alone = model.closest(point[None], camera_c=eye)
        assert alone.id[0] == together.id[k]
        assert alone.foot.tobytes() == together.foot[k : k + 1].tobytes()
        assert alone.d2.tobytes() == together.d2[k : k + 1].tobytes()


def test_closest_points_beyond_the_largest_distance_are_none(target: Surface) -> None:
    """``most_m`` removes the farther ones and changes no other."""
    model = SurfaceIndex.build(target, 0.4)
    points = rng(32).uniform(-1.5, 1.5, (2000, 3))
    all_of_them, near = model.closest(points), model.closest(points, most_m=0.1)
    inside = all_of_them.d2 < 0.1**2
    assert 0 < np.count_nonzero(inside) < len(points)
    np.testing.assert_array_equal(near.id, np.where(inside, all_of_them.id, -1))
    np.testing.assert_array_equal(near.foot[inside], all_of_them.foot[inside])


@pytest.mark.parametrize(
    "rule", [IcpParams(few=200), IcpParams(few=200, facing=True)], ids=["both sides", "facing"]
)
def test_a_part_of_the_scan_leads_to_the_fixed_point_of_the_whole(
    target: Surface, rule: IcpParams
) -> None:
    """One more pass of Horn's over all points stays, for any number of threads, with and without
    kept neighbours.
    """
    scan = scan_of(soup(600, seed=14), 5003, 20)
    model = SurfaceIndex.build(target, 0.4)
    found = model.icp(scan, GUESS, rule)
    assert found.converged
    assert found.searched < 0.7 * found.iterations * len(scan)
    horn = IcpParams(n_max=1, n_plane=0, newton=False, gate_m=found.gate_m, facing=rule.facing)
    on = model.icp(scan, found.T_ca, horn)
    assert on.step_rad < 1e-5
    assert on.step_m < 1e-6 * model.extent_m
    assert on.inliers == found.inliers  # of the pose that is returned
    assert on.rms_m == pytest.approx(found.rms_m, rel=1e-12)
    again = model.icp(scan, found.T_ca, replace(rule, few=0, n_plane=0, gate_m=found.gate_m))
    assert again.converged
    np.testing.assert_allclose(again.T_ca, found.T_ca, rtol=0, atol=1e-14)  # it stays
    for other in (replace(rule, threads=3), replace(rule, keep=False)):
        assert everything(model, scan, other) == everything(model, scan, rule)


def test_a_part_of_the_scan_without_overlap_is_not_used() -> None:
    """Where the part finds too few inliers all points begin at the guess."""
    mesh = soup(600, seed=14)
    model = SurfaceIndex.build(mesh, 0.4)
    scan = np.full((6000, 3), 50.0)
    inliers = scan_of(mesh, 40, 21)
    scan[7 : 7 + len(inliers)] = inliers
    a, b = model.icp(scan, GUESS, IcpParams(few=6)), model.icp(scan, GUESS)
    np.testing.assert_array_equal(a.T_ca, b.T_ca)


@pytest.mark.parametrize("facing", [False, True])
@pytest.mark.parametrize("gate", [0.05, 0.2, 0.39])
def test_matches_of_the_alignment_do_not_change_the_evidence(
    target: Surface, facing: bool, gate: float
) -> None:
    """Also far from the pose of the alignment, with a wider gate, and for another scan of the same
    length.
    """
    model = SurfaceIndex.build(target, 0.4)
    scan, other = scan_of(soup(600, seed=14), 3000, 23), scan_of(soup(600, seed=14), 3000, 24)
    found = model.icp(scan, GUESS, IcpParams(facing=facing, gate_m=0.2))
    near, far = Pose.from_matrix(found.T_ca), Pose(exp([0.0, 0.05, 0.0]), [0.1, 0.0, 0.0])
    for points, T in ((scan, near), (scan, far @ near), (other, near)):
        plain = model.evidence(points, T, gate, 0.3, 24, facing=facing)
        begun = model.evidence(
            points, T, gate, 0.3, 24, facing=facing, matches=found.matches, threads=2
        )
        for name in (
            "points",
            "inliers",
            "sum_d2",
            "median_m",
            "centre",
            "counts",
            "normals",
            "gradients",
        ):
            assert (
                np.asarray(getattr(plain, name)).tobytes()
                == np.asarray(getattr(begun, name)).tobytes()
            ), name


@pytest.mark.parametrize("beyond", [-0.4, -0.01, 0.01, 0.4])
def test_the_share_of_points_on_faces_towards_the_camera_is_compared_with_the_least(
    target: Surface, beyond: float
) -> None:
    """A quarter of the points decides at 0.4, all of them nearer to their share."""
    model = SurfaceIndex.build(target, 0.4)
    scan, T = scan_of(soup(600, seed=14), 700, 25), Pose(exp([0.1, 0.0, 0.2]), [0.3, -2.0, 0.1])
    found = model.closest(T.apply(scan))
    near = found.id >= 0
    share = np.mean(np.sum(found.normal[near] * (T.t - found.foot[near]), axis=1) > 0.0)
    assert model.faces_camera(scan, T, len(scan), float(share + beyond)) is (beyond < 0.0)


@pytest.mark.parametrize("count", [150, 1000, 1700])
@pytest.mark.parametrize("eye", [(0.0, 0.0, 4.0), (0.0, 0.0, -4.0)])
def test_distances_are_those_of_the_closest_points(
    count: int, eye: tuple[float, float, float]
) -> None:
    """A plate whose upper side alone is there: from below no face faces the camera, and both
    sides count.
    """
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
    plate = SurfaceIndex.build(surface(corners, [[0, 1, 2], [0, 2, 3]]), 0.5)
    points = rng(count).uniform(-1, 1, (count, 3)) * [1.2, 1.2, 0.7]
    points[::50] = np.nan
    T_ca = Pose(np.array([0.0, 0.0, 0.0, 1.0]), np.array(eye))
    found, work = plate.distances(points - eye, T_ca, 0.3, True, 200, 0.4)
    expected = np.sqrt(np.minimum(plate.closest(points).d2, 0.3**2))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert work > count / 3


def test_distances_to_the_faces_towards_the_camera(target: Surface) -> None:
    index, scan = SurfaceIndex.build(target, 0.4), scan_of(soup(600, seed=14), 1003, 18)
    T_ca = Pose(np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.1, 0.2, 5.0]))
    found, _ = index.distances(scan - T_ca.t, T_ca, np.inf, True, 200, 0.0)
    expected = np.sqrt(np.minimum(index.closest(scan, camera_c=T_ca.t).d2, 0.4**2))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_voxels_are_numbered_by_their_first_points() -> None:
    points = rng(5).uniform(-3, 3, (500, 3))
    first, voxel, counts = kernel.voxels(points, 0.7)
    cells = np.floor(points / 0.7)
    assert (np.diff(first) > 0).all()
    np.testing.assert_array_equal(cells[first[voxel]], cells)
    assert len(first) == len(np.unique(cells, axis=0))
    np.testing.assert_array_equal(counts, np.bincount(voxel))


def test_of_equal_poses_the_first_is_different() -> None:
    poses = [
        Pose(exp(np.radians([0.0, 0.0, d])), np.array([x, 0.0, 0.0]))
        for d, x in ((0, 0), (4, 0), (30, 0), (0, 1))
    ]
    T = np.stack([pose.matrix for pose in poses])
    trace = 1.0 + 2.0 * np.cos(np.radians(10.0))
    np.testing.assert_array_equal(kernel.different(T, np.zeros(3), 9, trace, 0.5), [0, 2, 3])
    np.testing.assert_array_equal(kernel.different(T, np.zeros(3), 2, trace, 0.5), [0, 2])


def test_any_instruction_set_gives_the_same_bits(target: Surface) -> None:
    scan = scan_of(soup(600, seed=14), 5003, 18)
    fast, plain = SurfaceIndex.build(target, 0.4), SurfaceIndex.build(target, 0.4, portable=True)
    assert everything(fast, scan) == everything(plain, scan)
    assert everything(fast, scan, FACING) == everything(plain, scan, FACING)


def test_building_twice_gives_the_same_bits(target: Surface) -> None:
    scan = scan_of(soup(600, seed=14), 2000, 19)
    assert everything(SurfaceIndex.build(target, 0.4), scan) == everything(
        SurfaceIndex.build(target, 0.4, threads=3), scan
    )


def test_strided_and_single_precision_views_are_read_where_they_lie(target: Surface) -> None:
    scan = scan_of(soup(600, seed=14), 3000, 20).astype(np.float32)
    model = SurfaceIndex.build(target, 0.4)
    want = everything(model, scan)
    record = np.zeros(
        3000, dtype=[("pad", "u1", 3), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("i", "u2")]
    )
    for k, name in enumerate("xyz"):
        record[name] = scan[:, k]
    offsets = [record.dtype.fields[n][1] for n in "xyz"]
    odd = np.ndarray((3000, 3), "f4", record.data, offsets[0], (record.dtype.itemsize, 4))
    wide = np.zeros((6000, 5), dtype=np.float64)
    wide[::2, 4::-2] = scan
    backwards = np.ascontiguousarray(scan[::-1])[::-1]
    for view in (
        odd,
        wide[::2, 4::-2],
        np.asfortranarray(scan),
        backwards,
        scan.astype(np.float64),
    ):
        assert everything(model, view) == want


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300, -1e300, 1e30])
def test_points_that_are_not_finite_change_nothing(target: Surface, bad: float) -> None:
    scan = scan_of(soup(600, seed=14), 1536, 21)
    model = SurfaceIndex.build(target, 0.4)
    dirty = np.insert(scan, [1536, 1536, 1536], bad, axis=0)
    dirty[-1, 0] = 0.0
    a, b = model.icp(scan, GUESS, RULE), model.icp(dirty, GUESS, RULE)
    assert np.array_equal(a.T_ca, b.T_ca)
    assert b.ignored == (0 if np.isfinite(bad) else 3)
    assert (model.closest(dirty).id[-3:] == -1).all()
    sums = model.normal_equations(dirty, np.eye(4))
    assert (sums.points, sums.ignored) == (len(dirty) - b.ignored, b.ignored)


def test_no_points_at_all(target: Surface) -> None:
    model = SurfaceIndex.build(target, 0.4)
    empty = np.zeros((0, 3), dtype=np.float32)
    r = model.icp(empty, GUESS)
    assert (r.converged, r.inliers, r.iterations) == (False, 0, 1)
    assert np.isnan(r.rms_m)
    assert np.array_equal(r.T_ca, GUESS.matrix)
    assert len(model.closest(empty).id) == 0
    assert model.normal_equations(empty, GUESS).inliers == 0


def test_a_scan_far_away_stays_where_it_is(target: Surface) -> None:
    model = SurfaceIndex.build(target, 0.4)
    r = model.icp(scan_of(soup(600, seed=14), 500, 22) + 100.0, GUESS)
    assert (r.converged, r.inliers) == (False, 0)
    assert np.array_equal(r.T_ca, GUESS.matrix)


def test_many_threads_may_share_a_model(target: Surface) -> None:
    scan = scan_of(soup(600, seed=14), 2000, 23)
    model = SurfaceIndex.build(target, 0.4)
    want, got = everything(model, scan), []
    workers = [
        threading.Thread(target=lambda: got.append(everything(model, scan))) for _ in range(4)
    ]
    for w in workers:
        w.start()
    for w in workers:
        w.join()
    assert got == [want] * 4


def test_input_of_the_wrong_shape_or_type_is_refused() -> None:
    model = SurfaceIndex.build(soup(5, seed=24), 0.5)
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        model.closest(np.zeros((4, 2)))
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        model.closest(np.zeros(3))
    faces = np.array([[0, 1, 2]], dtype=np.int32)
    index = kernel.Index(np.eye(3), faces, np.arange(1), 0.5, 1, False)
    assert len(index.closest(np.zeros((4, 3)), 1, None, np.inf)[0]) == 4
    with pytest.raises((ValueError, TypeError)):
        index.closest(np.zeros((4, 3), dtype=np.int64))
    with pytest.raises((ValueError, TypeError)):
        index.icp(np.zeros((4, 3)), np.zeros((3, 3)), 5, 0, 1.0, 3.0, 0.1, 1e-5, 1e-5)


def stub_arguments(function: ast.FunctionDef) -> list[tuple[str, bool]]:
    """Name of every argument, and whether it has a default."""
    names = [argument.arg for argument in function.args.args]
    required = len(names) - len(function.args.defaults)
    return [(name, k >= required) for k, name in enumerate(names)]


def bound_arguments(text: str) -> list[tuple[str, bool]]:
    """The same from the signature that nanobind writes; a default is ``\0``, ``\1``, and
    types are not in Python.
    """
    while "[" in text:
        text = re.sub(r"\[[^\[\]]*\]", "", text)
    return stub_arguments(ast.parse(text.replace("= \\", "= ") + ": ...").body[0])


def signatures(space: object) -> dict[str, list[list[tuple[str, bool]]]]:
    """The arguments of every bound function of a module or class, of each overload."""
    own = {name: value for name, value in vars(space).items() if hasattr(value, "__nb_signature__")}
    functions = {name: value for name, value in own.items() if not isinstance(value, type)}
    return {
        name: [bound_arguments(each[0]) for each in f.__nb_signature__]
        for name, f in functions.items()
    }


def test_the_stub_states_the_functions_and_arguments_of_the_extension() -> None:
    stub = ast.parse(Path(register.__file__).with_name("_kernel.pyi").read_text())
    spaces = {"": (stub.body, kernel)}
    spaces |= {
        c.name: (c.body, getattr(kernel, c.name)) for c in stub.body if isinstance(c, ast.ClassDef)
    }
    assert set(spaces) == {
        "",
        *(name for name, value in vars(kernel).items() if isinstance(value, type)),
    }
    for name, (body, space) in spaces.items():
        stated: dict[str, list[list[tuple[str, bool]]]] = {}
        properties = set()
        for each in (entry for entry in body if isinstance(entry, ast.FunctionDef)):
            if any(getattr(d, "id", "") == "property" for d in each.decorator_list):
                properties.add(each.name)
            else:
                stated.setdefault(each.name, []).append(stub_arguments(each))
        assert stated == signatures(space), name
        assert properties == {
            key for key, value in vars(space).items() if isinstance(value, property)
        }, name
