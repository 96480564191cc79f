"""The surface index and its numpy reference: recovery, invariance, meaning of the sums,
invalid input.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from oracles.closest_point import OracleIndex, cloud_normals

from avsreplay.errors import UsageError
from avsreplay.geometry import Array, Pose, exp, skew
from avsreplay.records import Surface
from avsreplay.register.surface_index import IcpParams, SurfaceIndex

NO_FACES = np.zeros((0, 3), dtype=np.int32)
MOVE = Pose(exp([0.05, -0.08, 0.06]), [0.03, -0.02, 0.04])


Build = Callable[
    [Surface, float], Any
]  # of a SurfaceIndex or an OracleIndex, which have the same methods


@pytest.fixture(
    params=[SurfaceIndex.build, pytest.param(OracleIndex, marks=pytest.mark.slow)],
    ids=["kernel", "oracle"],
)
def build(request: pytest.FixtureRequest) -> Build:
    return request.param


def rng(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


def shape() -> Surface:
    """Three boxes in a heap without symmetry: 36 triangles, wound outwards."""
    vertices, faces = [], []
    for centre, size in (
        ((0, 0, 0), (1.0, 0.7, 0.4)),
        ((0.6, 0.2, 0.3), (0.5, 0.2, 0.3)),
        ((-0.3, 0.5, 0.1), (0.2, 0.6, 0.5)),
    ):
        corner = (
            np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            * np.array(size)
            / 2
        )
        quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        faces += [
            [len(vertices) * 8 + q[k] for k in t] for q in quads for t in ((0, 1, 2), (0, 2, 3))
        ]
        vertices.append(corner + np.array(centre))
    return Surface(np.concatenate(vertices), np.array(faces, dtype=np.int32), "boxes", "")


def on(mesh: Surface, n: int, seed: int) -> Array:
    r = rng(seed)
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    pick = corners[r.choice(len(corners), n, p=area / area.sum())]
    return np.einsum("nk,nki->ni", r.dirichlet(np.ones(3), size=n), pick)


def test_a_moved_surface_is_brought_back_exactly(build: Build) -> None:
    mesh = shape()
    model = build(mesh, 0.5)
    r = model.icp(MOVE.apply(on(mesh, 1500, 1)), Pose.identity(), IcpParams(n_plane=6))
    assert r.converged
    assert np.abs(r.T_ca - MOVE.inverse().matrix).max() < 1e-6
    assert r.inliers == 1500
    assert r.rms_m < 1e-6


def test_a_moved_cloud_is_brought_back_exactly(build: Build) -> None:
    points = on(shape(), 3000, 2)
    small = Pose(exp([0.004, -0.006, 0.005]), [0.002, -0.003, 0.001])
    model = build(Surface(points, NO_FACES, "cloud", ""), 0.3)
    r = model.icp(small.apply(points), Pose.identity(), IcpParams(n_max=300))
    assert r.converged
    assert np.abs(r.T_ca - small.inverse().matrix).max() < 1e-9


def test_moving_scan_and_guess_together_moves_the_answer(build: Build) -> None:
    mesh = shape()
    model = build(mesh, 0.5)
    scan = on(mesh, 1000, 3) + 0.004 * rng(4).standard_normal((1000, 3))
    other = Pose(exp([1.0, -2.0, 0.5]), [3.0, -4.0, 5.0])
    a = model.icp(MOVE.apply(scan), Pose.identity())
    b = model.icp((other @ MOVE).apply(scan), other.inverse())
    assert np.abs(b.T_ca @ other.matrix - a.T_ca).max() < 2e-5


def test_the_order_of_the_points_does_not_matter(build: Build) -> None:
    mesh = shape()
    model = build(mesh, 0.5)
    scan = MOVE.apply(on(mesh, 1200, 5) + 0.004 * rng(6).standard_normal((1200, 3)))
    a, b = (
        model.icp(scan, Pose.identity()),
        model.icp(scan[rng(7).permutation(1200)], Pose.identity()),
    )
    assert np.abs(a.T_ca - b.T_ca).max() < 1e-9


def test_outliers_are_rejected_by_the_shrinking_gate(build: Build) -> None:
    mesh = shape()
    model = build(mesh, 0.5)
    r = rng(8)
    scan = on(mesh, 1500, 9) + 0.003 * r.standard_normal((1500, 3))
    scan = np.concatenate([scan, r.uniform(-1.2, 1.2, (300, 3))])
    free, tight = (
        model.icp(MOVE.apply(scan), Pose.identity(), IcpParams(n_max=200, tighten=t))
        for t in (0.0, 3.0)
    )
    wrong = [np.abs(x.T_ca - MOVE.inverse().matrix).max() for x in (free, tight)]
    assert wrong[1] < 2e-3 < wrong[0]
    assert tight.gate_m < 0.02
    assert free.gate_m == 0.5


def test_the_gate_never_grows_nor_passes_its_floor(build: Build) -> None:
    mesh = shape()
    model = build(mesh, 0.5)
    scan = MOVE.apply(on(mesh, 800, 10) + 0.004 * rng(11).standard_normal((800, 3)))
    gates = [
        model.icp(scan, Pose.identity(), IcpParams(n_max=n, n_plane=min(n, 6), floor_m=0.02)).gate_m
        for n in range(1, 12)
    ]
    assert all(a >= b for a, b in pairwise(gates))
    assert gates[-1] == 0.02


@pytest.mark.slow
def test_kernel_and_oracle_make_the_same_steps() -> None:
    mesh = shape()
    scan = MOVE.apply(on(mesh, 1000, 12) + 0.004 * rng(13).standard_normal((1000, 3)))
    plain = {"newton": False, "n_plane": 6}
    for rule in (
        IcpParams(**plain),
        IcpParams(newton=False, n_plane=0),
        IcpParams(**plain, n_max=9, tighten=0.0, gate_m=0.1),
    ):
        a, b = (
            index(mesh, 0.5).icp(scan, Pose.identity(), rule)
            for index in (SurfaceIndex.build, OracleIndex)
        )
        assert np.abs(a.T_ca - b.T_ca).max() < 1e-9
        assert (a.iterations, a.converged, a.inliers) == (b.iterations, b.converged, b.inliers)
        assert a.rms_m == pytest.approx(b.rms_m, rel=1e-9)
        assert a.gate_m == pytest.approx(b.gate_m, rel=1e-9)


def test_horn_passes_lower_the_rms_every_time(build: Build) -> None:
    """With the gate held wide enough to take every point, a pass of ICP never raises the mean
    square.
    """
    mesh = shape()
    model = build(mesh, 2.0)
    scan = MOVE.apply(on(mesh, 600, 14) + 0.004 * rng(15).standard_normal((600, 3)))
    rms = [
        model.icp(
            scan, Pose.identity(), IcpParams(n_max=n, n_plane=0, tighten=0.0, newton=False)
        ).rms_m
        for n in range(1, 25)
    ]
    assert all(b <= a * (1 + 1e-12) for a, b in pairwise(rms))


def test_information_is_the_residuals_curvature(build: Build) -> None:
    """J = de/dd for T_ac_true = T_ac Exp(d): the residual at the moved pose, feet and normals
    held, against J d.
    """
    mesh = shape()
    model = build(mesh, 0.5)
    T_ca = MOVE.inverse()
    scan = MOVE.apply(on(mesh, 500, 16) + 0.01 * rng(17).standard_normal((500, 3)))
    got = model.normal_equations(scan, T_ca)
    found = model.closest(T_ca.apply(scan))

    def residual(d: Array) -> Array:
        E = np.eye(4)
        E[:3, :3], E[:3, 3] = np.eye(3) + skew(d[:3]), d[3:]
        p = T_ca.apply(scan) @ np.linalg.inv(E)[:3, :3].T + np.linalg.inv(E)[:3, 3]
        return np.sum((found.foot - p) * found.normal, axis=1)

    h = 1e-6
    J = np.column_stack([(residual(h * u) - residual(-h * u)) / (2 * h) for u in np.eye(6)])
    e = residual(np.zeros(6))
    assert got.info == pytest.approx(J.T @ J, rel=1e-6, abs=1e-6)
    assert got.gradient == pytest.approx(J.T @ e, rel=1e-6, abs=1e-6)
    assert got.sum_e2 == pytest.approx(e @ e)
    assert got.sum_d2 == pytest.approx(found.d2.sum())
    assert (got.inliers, got.points, got.ignored) == (500, 500, 0)
    assert np.array_equal(got.info, got.info.T)


def test_the_gate_counts_inliers(build: Build) -> None:
    mesh = shape()
    model = build(mesh, 0.5)
    scan = on(mesh, 400, 18) + 0.05 * rng(19).standard_normal((400, 3))
    d2 = model.closest(scan).d2
    for gate in (0.0, 0.01, 0.03, 10.0):
        assert model.normal_equations(scan, np.eye(4), gate).inliers == np.sum(
            d2 < min(gate, 0.5) ** 2
        )


def test_normals_look_out_of_the_face(build: Build) -> None:
    mesh = shape()
    model = build(mesh, 0.5)
    found = model.closest(np.array([[0.0, 0.0, -0.5], [-0.7, 0.0, 0.0]]))
    assert found.normal == pytest.approx(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]))
    assert found.foot == pytest.approx(np.array([[0.0, 0.0, -0.2], [-0.5, 0.0, 0.0]]))


def test_ids_are_those_of_the_given_faces_where_some_have_no_area(build: Build) -> None:
    mesh = shape()
    faces = np.insert(mesh.faces, [0, 5, 20], [[0, 0, 1], [2, 2, 2], [3, 4, 3]], axis=0).astype(
        np.int32
    )
    plain = build(mesh, 0.5)
    model = build(dataclasses.replace(mesh, faces=faces), 0.5)
    q = rng(20).uniform(-1, 1, (300, 3))
    a, b = plain.closest(q), model.closest(q)
    if build == SurfaceIndex.build:
        assert (model.dropped, model.primitives) == (3, 36)
    near = a.id >= 0
    assert np.array_equal(mesh.faces[a.id[near]], faces[b.id[near]])


def test_oracle_cloud_normals_of_a_sphere() -> None:
    p = rng(21).standard_normal((5000, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    assert np.abs(np.sum(cloud_normals(p) * p, axis=1)).min() > 0.99


BAD = {
    "no point": Surface(np.zeros((0, 3)), NO_FACES, "m", ""),
    "not finite": Surface(np.array([[0.0, 0.0, np.nan]]), NO_FACES, "m", ""),
    "missing vertex": Surface(np.eye(3), np.array([[0, 1, 3]], dtype=np.int32), "m", ""),
    "no face has an area": Surface(np.eye(3), np.array([[0, 1, 1]], dtype=np.int32), "m", ""),
}


@pytest.mark.parametrize("what", BAD)
def test_an_invalid_surface_is_refused(what: str) -> None:
    with pytest.raises(UsageError, match=what):
        SurfaceIndex.build(BAD[what], 0.5)


@pytest.mark.parametrize("reach", [0.0, -1.0, np.nan, np.inf, 1e9])
def test_a_reach_must_be_positive_and_not_exceed_the_model_by_far(reach: float) -> None:
    with pytest.raises(UsageError, match="reach"):
        SurfaceIndex.build(shape(), reach)


@pytest.mark.parametrize(
    "wrong",
    [
        {"n_max": 0},
        {"n_plane": -1},
        {"n_plane": 101},
        {"gate_m": -1.0},
        {"tighten": np.nan},
        {"threads": 0},
        {"eps_m": np.inf},
    ],
)
def test_parameters_are_checked(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        IcpParams(**wrong)  # type: ignore[arg-type]


def test_only_faces_that_look_at_the_camera_count(build: Build) -> None:
    mesh = shape()
    camera = np.array([3.0, -2.0, 4.0])
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    seen = np.sum((camera - corners[:, 0]) * normals, axis=1) > 0
    q = rng(30).uniform(-1, 1, (800, 3))
    found = build(mesh, 0.5).closest(q, camera_c=camera)
    alone = build(dataclasses.replace(mesh, faces=mesh.faces[seen]), 0.5).closest(q)
    near = found.id >= 0
    assert seen[found.id[near]].all()
    assert np.array_equal(near, alone.id >= 0)
    assert found.d2[near] == pytest.approx(alone.d2[near], abs=1e-14)


def test_a_thin_plate_is_not_pulled_to_its_far_side(build: Build) -> None:
    """Half the noise of the near side lies nearer to the far one: all faces bias the pose,
    those seen do not.
    """
    mesh = shape()
    thin = dataclasses.replace(mesh, vertices=mesh.vertices * [1, 1, 0.02])
    r = rng(31)
    camera = Pose(exp([0.0, 0.0, 0.3]), [0.0, 0.0, 5.0])
    corners = thin.vertices[thin.faces]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 1e-9
    scan = camera.inverse().apply(on(dataclasses.replace(thin, faces=thin.faces[up]), 3000, 32))
    scan += [0, 0, 1] * (0.006 * r.standard_normal((3000, 1)))
    model = build(thin, 0.3)
    z = [
        model.icp(scan, camera, IcpParams(facing=f, tighten=0.0)).T_ca[2, 3] - 5.0
        for f in (True, False)
    ]
    sums = model.normal_equations(scan, camera, facing=True)
    assert abs(z[0]) < 2e-4
    assert abs(z[1]) > 5 * abs(z[0])
    assert sums.inliers == 3000
    assert np.sqrt(sums.sum_e2 / 3000) == pytest.approx(0.006, rel=0.1)


@pytest.mark.parametrize("size", [1e10, 1e20, 1e30, 1e100])
def test_a_stray_vertex_is_named_as_too_large(size: float) -> None:
    mesh = shape()
    vertices = mesh.vertices.copy()
    vertices[3, 1] = size
    with pytest.raises(UsageError, match="too large"):
        SurfaceIndex.build(Surface(vertices, mesh.faces, "boxes", ""), 0.5)


@pytest.mark.parametrize("size", [1e3, 1e6, 1e9])
def test_a_stray_vertex_within_the_limit_is_indexed(size: float) -> None:
    mesh = shape()
    vertices = np.vstack([mesh.vertices, [0.0, size, 0.0], [1.0, size, 0.0]])
    faces = np.vstack([mesh.faces, [[0, len(vertices) - 2, len(vertices) - 1]]])
    index = SurfaceIndex.build(Surface(vertices, faces, "boxes", ""), 0.5)
    q = on(mesh, 50, 30)
    assert np.sqrt(index.closest(q).d2).max() < 1e-9 * size


def test_closest_point_on_a_dense_mesh() -> None:
    """A point beyond a face of a convex surface, along the normal at the centroid, has that
    centroid as its foot.

    The mesh is so fine that the first grid of the index has too many entries and a narrower one is
    built.
    """
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=7)
    surface = Surface(
        np.asarray(ball.vertices, float), np.asarray(ball.faces, np.int32), "ball", ""
    )
    index = SurfaceIndex.build(surface, 0.3)
    chosen = np.arange(0, len(surface.faces), 97)
    middle = surface.vertices[surface.faces[chosen]].mean(axis=1)
    normal = np.asarray(ball.face_normals)[chosen]
    for height in (1e-4, 0.004, 0.02, 0.1):
        found = index.closest(middle + height * normal)
        np.testing.assert_array_equal(found.id, chosen)
        np.testing.assert_allclose(found.foot, middle, atol=1e-9)
        np.testing.assert_allclose(found.d2, height**2, rtol=1e-6)
    assert not np.any(index.closest(middle + 0.31 * normal).id >= 0)


def test_a_ray_ends_at_the_first_face_that_it_meets() -> None:
    """A point p of a face has (p - eye) . n = range * ray . n there, and no other face is met
    before it.
    """
    surface, eye = shape(), np.array([3.0, 2.0, 2.5])
    index = SurfaceIndex.build(surface, 1.0)
    rays = 0.5 * rng(8).standard_normal((400, 3)) - eye
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ranges, work = index.cast(eye, rays)
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    expected = np.full(len(rays), np.inf)
    for k, ray in enumerate(rays):
        M = np.stack([np.broadcast_to(-ray, a.shape), b - a, c - a], axis=-1)
        t, u, v = np.linalg.solve(M, (eye - a)[..., None])[..., 0].T
        expected[k] = np.min(t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)], initial=np.inf)
    assert 100 < np.isfinite(expected).sum() < 400
    assert np.array_equal(np.isfinite(ranges), np.isfinite(expected))
    assert np.allclose(ranges, expected, rtol=1e-12)
    assert work > 0
    still, _ = index.cast(eye, np.eye(3)[:1])  # away from the model, with components that are zero
    assert np.isinf(still).all()
