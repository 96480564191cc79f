"""Targets and mass properties: closed forms, trimesh as reference, properties of the axis order."""

import hashlib

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from avsreplay import geometry
from avsreplay.errors import UsageError
from avsreplay.mesh import is_closed
from avsreplay.records import Surface
from avsreplay.simulate.inertia import body_of, principal
from avsreplay.simulate.target import (
    Shape,
    TargetParams,
    body,
    box,
    builtin_surface,
    extrusion,
    frustum,
    join,
    shell,
)

RNG = np.random.Generator(np.random.PCG64(5))
CUBE_TURNS = [  # all 24, some more than once, by another hand
    geometry.quaternion(
        trimesh.transformations.euler_matrix(*(np.pi / 2 * np.array(quarters)))[:3, :3]
    )
    for quarters in np.ndindex(4, 4, 4)
]


def surface_of(solid, vertices=None):
    return Surface(solid.vertices if vertices is None else vertices, solid.faces, "test", "")


@pytest.mark.parametrize("shape", list(Shape))
def test_builtin_targets_are_closed_outward_and_without_slivers(shape):
    surface = builtin_surface(shape)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert all(part.volume > 0 for part in mesh.split())
    assert mesh.area_faces.min() > 1e-6


@pytest.mark.parametrize("shape", list(Shape))
def test_the_attachment_reads_back_as_the_surface(shape):
    surface = builtin_surface(shape)
    read = trimesh.load(trimesh.util.wrap_as_stream(surface.data), file_type="ply", process=False)
    assert np.array_equal(read.vertices, surface.vertices)
    assert np.array_equal(read.faces, surface.faces)
    assert (
        surface.sha256 == hashlib.sha256(surface.data).hexdigest() == builtin_surface(shape).sha256
    )


def test_touching_parts_of_the_satellite_do_not_overlap():
    """Otherwise its volume, and its inertia, would count material twice: sampled points lie
    in one part at most.
    """
    surface = builtin_surface()
    parts = trimesh.Trimesh(surface.vertices, surface.faces, process=False).split()
    boxes = np.array([part.bounds for part in parts])
    for i, part in enumerate(parts):
        points = part.triangles_center * (1 - 1e-4) + part.center_mass * 1e-4
        for j, other in enumerate(parts):
            near = np.all((points > boxes[j, 0]) & (points < boxes[j, 1]), axis=1)
            if i != j and near.any():
                winding = _winding(other, points[near])
                assert np.all(winding < 0.5), (i, j)


def _winding(mesh, points):
    a, b, c = (mesh.triangles[:, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    numerator = np.einsum("...i,...i", a, np.cross(b, c))
    dots = [np.einsum("...i,...i", x, y) for x, y in ((a, b), (b, c), (c, a))]
    denominator = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return np.sum(2 * np.arctan2(numerator, denominator), axis=1) / (4 * np.pi)


def test_mass_properties_of_a_box_are_the_closed_form():
    low, high = np.array([-0.3, 1.0, -2.0]), np.array([0.9, 1.7, 0.5])
    found = body_of(surface_of(box(low, high)))
    x, y, z = (high - low) ** 2
    assert_allclose(found.centre_c, 0.5 * (low + high), atol=1e-14)
    assert_allclose(found.inertia_c, np.diag([y + z, x + z, x + y]) / 12, atol=1e-14)
    assert_allclose(found.moments, np.diag(found.inertia_c), atol=1e-14)
    assert geometry.angle(found.q_bc) < 1e-12


def test_a_tall_prism_has_the_inertia_of_its_cylinder():
    r, h, n = 0.4, 1.5, 400
    found = body_of(surface_of(frustum(0.0, r, h, r, n)))
    assert_allclose(found.centre_c, [h / 2, 0, 0], atol=1e-13)
    assert_allclose(
        np.diag(found.inertia_c),
        [r**2 / 2, (3 * r**2 + h**2) / 12, (3 * r**2 + h**2) / 12],
        rtol=1e-4,
    )


def test_an_open_mesh_is_a_thin_shell():
    solid = box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    lidless = Surface(solid.vertices, solid.faces[2:], "open", "")
    found = body_of(lidless)
    assert not is_closed(lidless.vertices, lidless.faces)
    assert is_closed(solid.vertices, solid.faces)
    assert_allclose(
        found.centre_c, [0.1, 0, 0], atol=1e-14
    )  # five unit squares, the one at x = -1/2 missing
    assert_allclose(found.inertia_c[0, 0], (4 * (1 / 4 + 1 / 12) + 1 / 6) / 5, rtol=1e-12)


def test_a_body_without_thickness_is_refused():
    corners = np.array([[-1.0, -0.5, 0.0], [1.0, -0.5, 0.0], [1.0, 0.5, 0.0], [-1.0, 0.5, 0.0]])
    plate = Surface(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), "plate.obj", "")
    with pytest.raises(UsageError, match="no thickness") as error:
        body(TargetParams(), plate)
    assert "moments_m2" in error.value.hint
    given = TargetParams(moments_m2=(0.1, 0.3, 0.39), axes_xyzw=(0.0, 0.0, 0.0, 1.0))
    assert np.abs(body(given, plate).sigma).max() < 1.0
    thin = box((-1.0, -0.5, -1e-3), (1.0, 0.5, 1e-3))
    assert 0.99 < np.abs(body(TargetParams(), surface_of(thin)).sigma).max() < 1.0


def test_mass_properties_agree_with_trimesh_for_every_shape():
    for shape in Shape:
        surface = builtin_surface(shape)
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
        found = body_of(surface)
        assert_allclose(found.centre_c, mesh.center_mass, atol=1e-12)
        assert_allclose(found.inertia_c, mesh.moment_inertia / mesh.volume, atol=1e-12)


def test_repeated_vertices_as_in_stl_change_nothing():
    surface = builtin_surface(Shape.BRACKET)
    corners = surface.vertices[surface.faces].reshape(-1, 3)
    soup = Surface(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3), "soup", "")
    assert_allclose(body_of(soup).inertia_c, body_of(surface).inertia_c, atol=1e-15)


def test_principal_axes_diagonalise_and_lie_nearest_the_model_frame():
    for _ in range(50):
        half = RNG.standard_normal((3, 3))
        second = half @ half.T
        inertia = np.eye(3) * np.trace(second) - second
        found = principal(inertia, RNG.standard_normal(3))
        R_bc = geometry.matrix(found.q_bc)
        assert_allclose(R_bc @ inertia @ R_bc.T, np.diag(found.moments), atol=1e-12)
        assert_allclose(sorted(found.moments), np.linalg.eigvalsh(inertia), atol=1e-12)
        assert_allclose(R_bc @ found.centre_c + found.c_b, 0, atol=1e-12)
        least = min(float(geometry.angle(geometry.multiply(q, found.q_bc))) for q in CUBE_TURNS)
        assert geometry.angle(found.q_bc) < least + 1e-9


def test_mass_properties_follow_the_body_when_the_model_is_moved():
    surface = builtin_surface()
    pose = geometry.Pose(geometry.exp([0.4, -0.2, 0.9]), np.array([0.3, -1.0, 2.0]))
    moved = Surface(pose.apply(surface.vertices), surface.faces, "moved", "")
    a, b = body_of(surface), body_of(moved)
    assert_allclose(b.centre_c, pose.apply(a.centre_c), atol=1e-12)
    assert_allclose(b.inertia_c, pose.R @ a.inertia_c @ pose.R.T, atol=1e-12)
    assert_allclose(sorted(a.moments), sorted(b.moments), atol=1e-12)


def test_the_scenario_may_give_the_body():
    q = tuple(geometry.exp([0.1, 0.2, -0.3]))
    params = TargetParams(moments_m2=(1.0, 1.2, 0.9), axes_xyzw=q, mass_centre_m=(0.1, 0.2, 0.3))
    cloud = Surface(np.zeros((4, 3)), np.empty((0, 3), np.int32), "cloud.ply", "")
    found = body(params, cloud)
    assert_allclose(found.moments, [1.0, 1.2, 0.9])
    assert_allclose(np.linalg.eigvalsh(found.inertia_c), [0.9, 1.0, 1.2], atol=1e-12)
    with pytest.raises(UsageError, match="a cloud has no mass"):
        body(TargetParams(), cloud)


def test_inside_out_and_impossible_bodies_are_refused():
    solid = box((0, 0, 0), (1, 1, 1))
    with pytest.raises(UsageError, match="no volume"):
        body_of(Surface(solid.vertices, np.ascontiguousarray(solid.faces[:, ::-1]), "out.stl", ""))
    with pytest.raises(ValueError, match="moments_m2"):
        TargetParams(moments_m2=(1.0, 1.0, 2.5), axes_xyzw=(0, 0, 0, 1))
    with pytest.raises(ValueError, match="together"):
        TargetParams(moments_m2=(1.0, 1.0, 1.5))


def test_solids_are_closed_whatever_their_rings():
    parts = [
        extrusion([(0, 0), (2, 0), (1, 1)], -1, 1),
        frustum(0, 1, 2, 0.5, 7),
        shell(0.0, 0.5, 1.0, 0.8, 0.1, 0.2, 9),
        box((0, 0, 0), (1, 2, 3)),
    ]
    for solid in [*parts, join(parts)]:
        assert is_closed(solid.vertices, solid.faces)
        assert trimesh.Trimesh(solid.vertices, solid.faces, process=False).volume > 0
