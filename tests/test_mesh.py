"""Winding of meshes: properties on random bodies, with trimesh's volume and containment as
oracles.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from avsreplay import mesh
from avsreplay.geometry import Array, Pose
from avsreplay.records import AlignStatus, Surface
from avsreplay.register.contract import boxes, view
from avsreplay.register.registrar import Registrar

SEEDS = st.integers(0, 2**31)


def bodies(rng: np.random.Generator, count: int = 4) -> list[trimesh.Trimesh]:
    """Convex bodies, some of which overlap."""
    found = []
    for _ in range(count):
        part = trimesh.Trimesh(*convex(rng.normal(size=(12, 3))), process=False)
        part.apply_translation(2.0 * rng.normal(size=3))
        found.append(part)
    return found


@pytest.mark.parametrize(("nodes", "edges"), [(1, 0), (40, 15), (40, 60), (3000, 2000)])
def test_components_are_numbered_in_the_order_of_their_first_nodes(nodes: int, edges: int) -> None:
    graph = np.random.default_rng(edges).integers(nodes, size=(2, edges))
    pairs = coo_array((np.ones(edges), tuple(graph)), shape=(nodes, nodes))
    assert np.array_equal(
        mesh.components(nodes, *graph), connected_components(pairs, directed=False)[1]
    )


def convex(points: Array) -> tuple[Array, Array]:
    """The convex hull, its faces outwards."""
    hull = trimesh.convex.convex_hull(points)
    return np.array(hull.vertices), np.array(hull.faces)


def joined(parts: list[trimesh.Trimesh]) -> tuple[Array, mesh.Faces]:
    whole = trimesh.util.concatenate(parts)
    return np.array(whole.vertices), np.array(whole.faces, dtype=np.int32)


def some_reversed(rng: np.random.Generator, faces: mesh.Faces, share: float) -> mesh.Faces:
    """The faces, a share of them with the other winding and each with another first corner."""
    chosen = rng.random(len(faces)) < share
    turned = np.where(chosen[:, None], faces[:, ::-1], faces)
    return np.take_along_axis(
        turned, (rng.integers(3, size=(len(faces), 1)) + np.arange(3)) % 3, axis=1
    )


def opened(vertices: Array, faces: mesh.Faces) -> Array:
    """Which of the faces, all different, belong to parts with openings."""
    first, part = mesh.open_parts(vertices, faces)
    np.testing.assert_array_equal(first, np.arange(len(first)))
    return part >= 0


def normals(vertices: Array, faces: mesh.Faces) -> Array:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


@given(SEEDS)
@settings(max_examples=40)
def test_outward_faces_stay_and_any_reversed_ones_are_restored(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = joined(bodies(rng))
    same, none = mesh.outward(vertices, faces)
    assert none == 0
    np.testing.assert_array_equal(same, faces)
    wrong = some_reversed(rng, faces, rng.uniform())
    found, count = mesh.outward(vertices, wrong)
    np.testing.assert_allclose(normals(vertices, found), normals(vertices, faces), atol=1e-12)
    assert count == int(
        (np.einsum("ij,ij->i", normals(vertices, wrong), normals(vertices, faces)) < 0.0).sum()
    )


@given(SEEDS)
@settings(max_examples=20)
def test_repeated_vertices_and_repeated_faces_change_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = joined(bodies(rng, 2))
    soup = vertices[faces].reshape(-1, 3)
    apart = np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    twice = np.concatenate([apart, apart[: len(apart) // 2]])
    found, _ = mesh.outward(soup, some_reversed(rng, apart, 0.3))
    np.testing.assert_allclose(normals(soup, found), normals(soup, apart), atol=1e-12)
    assert mesh.outward(soup, twice)[1] == 0
    first, part = mesh.open_parts(soup, twice)
    np.testing.assert_array_equal(first, np.arange(len(apart)))
    assert (part < 0).all()


def test_a_single_reversed_part_of_several_is_found() -> None:
    rng = np.random.default_rng(1)
    parts = bodies(rng)
    vertices, right = joined(parts)
    parts[2].invert()
    found, count = mesh.outward(*joined(parts))
    assert count == len(parts[2].faces)
    np.testing.assert_allclose(normals(vertices, found), normals(vertices, right), atol=1e-12)


def test_a_reversed_rod_between_two_bodies_is_no_cavity() -> None:
    """All vertices of the rod are inside the bodies that it joins."""
    boxes_, rod = (
        [trimesh.creation.box((1, 1, 1)) for _ in range(2)],
        trimesh.creation.cylinder(0.03, 2.6, sections=12),
    )
    for box, side in zip(boxes_, (-1.5, 1.5), strict=True):
        box.apply_translation((0, 0, side))
    vertices, right = joined([*boxes_, rod])
    rod.invert()
    found, count = mesh.outward(*joined([*boxes_, rod]))
    assert count == len(rod.faces)
    np.testing.assert_allclose(normals(vertices, found), normals(vertices, right), atol=1e-12)


@pytest.mark.parametrize("inverted", [False, True])
def test_a_cavity_keeps_its_faces_towards_the_hollow(inverted: bool) -> None:
    outer, inner = trimesh.creation.box((2, 2, 2)), trimesh.creation.box((1.8, 1.8, 1.8))
    inner.invert()
    vertices, right = joined([outer, inner])
    given_faces = np.ascontiguousarray(right[:, ::-1]) if inverted else right
    found, count = mesh.outward(vertices, given_faces)
    assert count == (len(right) if inverted else 0)
    np.testing.assert_allclose(normals(vertices, found), normals(vertices, right), atol=1e-12)
    assert trimesh.Trimesh(vertices, found, process=False).volume == pytest.approx(2.0**3 - 1.8**3)


def test_open_parts_are_told_from_closed_ones() -> None:
    box, sheet = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))
    sheet.update_faces(np.arange(12) < 2)
    sheet.apply_translation((3, 0, 0))
    vertices, faces = joined([box, sheet])
    np.testing.assert_array_equal(opened(vertices, faces), np.arange(14) >= 12)
    assert not opened(
        np.where(np.arange(len(vertices))[:, None] < 8, vertices, 0.01 * vertices), faces
    ).any()
    both = np.concatenate(
        [faces, faces[12:, ::-1]]
    )  # the other side of the sheet, as faces of their own
    assert not opened(vertices, both).any()
    assert mesh.outward(vertices, both)[1] == 0


@pytest.mark.parametrize("subdivisions", [1, 3, 5])
@pytest.mark.parametrize(("height", "is_open"), [(0.0, True), (0.995, False), (1.1, False)])
def test_the_openings_of_a_part_do_not_depend_on_its_triangles(
    subdivisions: int, height: float, is_open: bool
) -> None:
    """A sphere without the faces above a height: a bowl, one with a small hole, and a whole one."""
    ball = trimesh.creation.icosphere(
        subdivisions=max(subdivisions, 4) if height == 0.995 else subdivisions
    )
    ball.update_faces(ball.triangles_center[:, 2] < height)
    found = opened(np.array(ball.vertices), np.array(ball.faces, dtype=np.int32))
    assert found.all() if is_open else not found.any()


@given(SEEDS)
@settings(max_examples=20)
def test_corners_that_differ_by_rounding_are_one(seed: int) -> None:
    """An STL file repeats each corner, and exports write 6e-17 in place of 0 for some of the
    faces.
    """
    rng = np.random.default_rng(seed)
    vertices, faces = joined(bodies(rng, 2))
    apart = np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    soup = vertices[faces].reshape(-1, 3)
    rounded = soup * (1.0 + 1e-13 * rng.normal(size=soup.shape)) + 1e-17
    found, _ = mesh.outward(rounded, some_reversed(rng, apart, 0.3))
    np.testing.assert_allclose(normals(rounded, found), normals(soup, apart), atol=1e-9)
    assert not opened(rounded, apart).any()
    assert mesh.is_closed(rounded, apart)


def test_a_sliver_does_not_separate_its_neighbours() -> None:
    """A face whose corners are nearer than the tolerance: the mesh stays closed, and the
    winding is found across it.
    """
    box = trimesh.creation.box((1, 1, 1))
    vertices, faces = np.array(box.vertices), np.array(box.faces, dtype=np.int32)
    a, b, c = faces[0]
    moved = np.vstack([vertices, vertices[b] + 1e-9 * (vertices[c] - vertices[b])])
    split = np.vstack([[a, 8, c], [a, b, 8], faces[1:]]).astype(np.int32)
    assert mesh.is_closed(moved, split)
    assert not opened(moved, split).any()
    wrong = np.where((np.arange(len(split)) == 5)[:, None], split[:, ::-1], split)
    assert mesh.outward(moved, wrong)[1] == 1


@given(SEEDS)
@settings(max_examples=20)
def test_a_body_that_lists_each_face_with_both_windings_is_wound_outwards(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = joined(bodies(rng, 2))
    both = np.concatenate([faces, faces[:, ::-1]])[rng.permutation(2 * len(faces))]
    found, count = mesh.outward(vertices, both)
    assert count == len(faces)
    assert mesh.signed_volume(vertices, found) == pytest.approx(
        2.0 * mesh.signed_volume(vertices, faces)
    )


def test_a_mesh_without_a_volume_is_open() -> None:
    sheet = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    both = np.concatenate([faces, faces[:, ::-1]])
    first, part = mesh.open_parts(sheet, both)
    np.testing.assert_array_equal(first, [0, 1])
    np.testing.assert_array_equal(part, [0, 0])


def test_a_moebius_strip_is_left_as_it_is() -> None:
    """A surface without two sides has no consistent winding."""
    k = np.arange(12)
    angle, half = 2.0 * np.pi * k / 12, np.pi * k / 12
    rim = [
        np.stack(
            [
                (1 + w * np.cos(half)) * np.cos(angle),
                (1 + w * np.cos(half)) * np.sin(angle),
                w * np.sin(half),
            ],
            1,
        )
        for w in (-0.3, 0.3)
    ]
    ahead, other = np.append(k[1:], 12), np.append(k[1:] + 12, 0)
    ahead[-1] = 12  # the strip closes with a half turn: the lower rim continues as the upper one
    faces = np.concatenate(
        [np.stack([k, ahead, k + 12], 1), np.stack([k + 12, ahead, other], 1)]
    ).astype(np.int32)
    assert mesh.outward(np.concatenate(rim), faces)[1] == 0


def test_no_faces() -> None:
    none = np.zeros((0, 3), np.int32)
    assert mesh.outward(np.eye(3), none)[1] == 0
    assert not len(mesh.open_parts(np.eye(3), none)[0])
    assert [len(found) for found in mesh.distinct_rows(np.zeros((0, 3)))] == [0, 0]


@given(SEEDS)
@settings(max_examples=30)
def test_merged_vertices_are_those_of_a_dictionary(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices = rng.integers(-2, 3, size=(40, 3)) * np.array([1.0, -0.5, 0.0])
    first, number = mesh.distinct_rows(vertices)
    seen: dict[tuple[float, ...], int] = {}
    expected = [seen.setdefault(tuple(v), len(seen)) for v in vertices.tolist()]
    np.testing.assert_array_equal(number, expected)
    np.testing.assert_array_equal(vertices[first][number], vertices)


def test_a_sheet_beside_closed_parts_is_registered_from_both_sides() -> None:
    """The points of either side of a panel without thickness are matched; the closed parts
    are matched on one side.
    """
    body = boxes()
    panel = np.array(
        [[-2, -0.6, 0.0], [-0.6, -0.6, 0.0], [-0.6, 0.6, 0.3], [-2, 0.6, 0.3]]
    ) - np.array([1.0, 0.0, 0.0])
    vertices = np.concatenate([body.vertices, panel])
    faces = np.concatenate(
        [body.faces, len(body.vertices) + np.array([[0, 1, 2], [0, 2, 3]], np.int32)]
    )
    model = Surface(vertices, faces.astype(np.int32), "with a sheet", "")
    rng = np.random.default_rng(3)
    for side in (-1.0, 1.0):
        seen = faces if side > 0.0 else np.concatenate([body.faces, faces[-2:, ::-1]])
        camera = np.array([-1.0, -2.0, side * 8.0])
        points = view(Surface(vertices, seen.astype(np.int32), "seen", ""), 4000, camera)
        truth = Pose(rng.normal(size=4), np.array([0.0, 0.0, 0.0]))
        truth = Pose(truth.q, -(truth.R @ camera))  # the camera is the origin of {A}
        found = Registrar(model).register(truth.apply(points), Pose(truth.q, truth.t + 0.02))
        assert found.status is AlignStatus.ALIGNED
        assert found.inlier_ratio > 0.99
        np.testing.assert_allclose(found.T_ac.t, truth.t, atol=2e-3)
