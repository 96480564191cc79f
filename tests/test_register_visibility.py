"""Which faces the camera can have measured, and the alignments that follow from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from avsreplay import geometry
from avsreplay.estimate.measurement import from_chi2
from avsreplay.geometry import Pose, exp
from avsreplay.records import AlignStatus, Fit, Surface
from avsreplay.register.contract import boxes, example_pose, view
from avsreplay.register.params import Camera
from avsreplay.register.registrar import Registrar
from avsreplay.register.surface_index import SurfaceIndex
from avsreplay.register.visibility import Visibility, seen_sides
from avsreplay.simulate.target import box

RNG_SEED = 11


def _rng() -> np.random.Generator:
    return np.random.default_rng(RNG_SEED)


def _box_and_panel() -> Surface:
    """A box with a panel whose thickness is that of the noise of a scan."""
    parts = [box([-1.0, -0.8, -0.6], [1.0, 0.8, 0.6]), box([1.0, -0.5, 0.1], [4.0, 0.5, 0.12])]
    vertices = np.concatenate([part.vertices for part in parts])
    return Surface(
        vertices, np.concatenate([parts[0].faces, parts[1].faces + 8]), "box and panel", ""
    )


def test_only_meshes_with_closed_parts_are_sided(surface: Surface) -> None:
    assert Visibility(surface).sided
    assert not Visibility(replace(surface, faces=surface.faces[::2])).sided
    assert not Visibility(replace(surface, faces=np.empty((0, 3), dtype=np.int32))).sided


@pytest.mark.parametrize("reversed_faces", [slice(None), slice(None, None, 3)], ids=["all", "some"])
def test_faces_that_are_not_wound_outwards_give_the_same_poses(
    surface: Surface, scan: np.ndarray, reversed_faces: slice
) -> None:
    faces = surface.faces.copy()
    faces[reversed_faces] = faces[reversed_faces, ::-1]
    made = Surface(surface.vertices, faces, surface.name, "")
    guess = example_pose() @ Pose(geometry.exp([0.02, -0.03, 0.01]), np.array([0.01, 0.0, 0.02]))
    found, expected = (Registrar(each).register(scan, guess) for each in (made, surface))
    np.testing.assert_array_equal(found.T_ac.matrix, expected.T_ac.matrix)
    np.testing.assert_array_equal(found.covariance, expected.covariance)


def test_the_camera_is_the_origin_where_it_can_be(surface: Surface, scan: np.ndarray) -> None:
    model, T_ca = SurfaceIndex.build(surface, 0.5), example_pose().inverse()
    np.testing.assert_array_equal(Visibility(surface).camera_c(model, scan, T_ca), T_ca.t)
    np.testing.assert_array_equal(
        Visibility(surface, Camera.ORIGIN).camera_c(model, scan, T_ca), T_ca.t
    )
    assert Visibility(surface, Camera.NONE).camera_c(model, scan, T_ca) is None


def test_an_origin_inside_the_model_or_behind_the_measured_sides_is_no_camera(
    surface: Surface,
) -> None:
    model, T_ca = SurfaceIndex.build(surface, 0.5), example_pose().inverse()
    near = view(surface, 3000, T_ca.t)
    assert Visibility(surface).camera_c(model, near, Pose.identity()) is None
    behind = view(surface, 3000, -T_ca.t)  # the sides that a camera on the other side would see
    assert Visibility(surface).camera_c(model, example_pose().apply(behind), T_ca) is None


@pytest.mark.parametrize("distance", [0.3, 0.8])
def test_a_camera_beside_the_target_sees_one_side_of_a_panel(distance: float) -> None:
    """With both sides of it, noise as large as the panel is thick would move the pose towards its
    middle.
    """
    surface = _box_and_panel()
    eye = np.array([2.0, -1.8, 0.6 + distance])
    ideal, rng, chi2 = view(surface, 9000, eye) - eye, _rng(), []
    for _ in range(4):
        scan = ideal * (
            1.0
            + rng.normal(0, 0.02, (len(ideal), 1)) / np.linalg.norm(ideal, axis=1, keepdims=True)
        )
        found = Registrar(surface).register(scan, Pose(geometry.IDENTITY_QUAT, -eye))
        error = found.T_ac.inverse() @ Pose(geometry.IDENTITY_QUAT, -eye)
        d = np.concatenate([geometry.log(error.q), error.t])
        chi2.append(d @ np.linalg.solve(found.covariance, d))
    assert sum(chi2) < 58.61  # 99.99 % point of chi-square with 24 degrees of freedom


def test_a_camera_beside_the_target_may_have_a_poor_guess() -> None:
    """At a guess several degrees off it is not decided which faces were measured; at the
    result it is.
    """
    surface, rng = _box_and_panel(), _rng()
    registrar, visibility, undecided = Registrar(surface), Visibility(surface), 0
    middle = 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0))
    for _ in range(12):
        eye = np.array(
            [rng.uniform(1.2, 2.5), -rng.uniform(0.8, 1.6), 0.12 + rng.uniform(0.3, 0.6)]
        )
        ideal = view(surface, 6000, eye) - eye
        scan = ideal * (
            1.0
            + rng.normal(0, 0.005, (len(ideal), 1)) / np.linalg.norm(ideal, axis=1, keepdims=True)
        )
        truth, axis = Pose(geometry.IDENTITY_QUAT, -eye), rng.standard_normal(3)
        turn = exp(np.radians(6.0) * axis / np.linalg.norm(axis))
        guess = truth @ Pose(
            turn, middle - geometry.matrix(turn) @ middle + 0.05 * rng.standard_normal(3)
        )
        undecided += visibility.camera_c(registrar.index, scan, guess.inverse()) is None
        found = registrar.register(scan, guess)
        assert found.status is AlignStatus.ALIGNED, found.message
        error = found.T_ac.inverse() @ truth
        d = np.concatenate([geometry.log(error.q), error.t])
        assert d @ np.linalg.solve(found.covariance, d) < from_chi2(
            27.86, found.dof
        )  # 99.99 % point
    assert undecided > 1


def _fits(
    visibility: Visibility,
    model: SurfaceIndex,
    scan: np.ndarray,
    guess: Pose,
    results: dict[bool, Pose],
):
    """What `consistent` returns where an alignment with or without the test ends at these poses,
    and what it made.
    """
    made = []

    def align(start: Pose, facing: bool) -> Fit:
        made.append((start, facing))
        return Fit(results[facing], 2, True)

    return visibility.consistent(model, scan, guess, align), made


def test_the_choice_of_faces_holds_at_the_result() -> None:
    """Clear of the model one alignment is made where the test holds; next to it, up to three,
    counted together.
    """
    surface = _box_and_panel()
    model, visibility = SurfaceIndex.build(surface, 0.6), Visibility(surface)
    far, near = np.array([2.0, -9.0, 9.0]), np.array([2.0, -1.8, 0.9])
    inside = Pose(
        geometry.IDENTITY_QUAT, np.array([2.0, -0.3, -0.3])
    )  # below the panel and beside the box
    for eye, poor in ((far, False), (near, False), (near, True), (far, True)):
        scan, truth = view(surface, 6000, eye) - eye, Pose(geometry.IDENTITY_QUAT, eye)
        fit, made = _fits(
            visibility, model, scan, inside if poor else truth, {True: truth, False: inside}
        )
        assert [facing for _, facing in made] == [True]
        assert fit.iterations == 2
    scan, truth = view(surface, 6000, near) - near, Pose(geometry.IDENTITY_QUAT, near)
    fit, made = _fits(visibility, model, scan, inside, {True: inside, False: truth})
    assert [facing for _, facing in made] == [True, False, True]
    assert made[1][0] is inside
    assert made[2][0] is truth
    assert fit.iterations == 6
    fit, made = _fits(visibility, model, scan, inside, {True: inside, False: inside})
    assert [facing for _, facing in made] == [True, False]


def test_sight_points_from_the_scan_to_the_camera(surface: Surface, scan: np.ndarray) -> None:
    sight = Visibility(surface).direction_to_camera(scan)
    assert sight @ (-example_pose().t / np.linalg.norm(example_pose().t)) > 0.95
    assert Visibility(surface).direction_to_camera(example_pose().inverse().apply(scan)) is None
    assert Visibility(surface, Camera.NONE).direction_to_camera(scan) is None


@pytest.mark.parametrize("offset", [0.06, -0.06])
def test_a_thin_panel_is_not_matched_to_its_reverse_side(offset: float) -> None:
    """Half a panel's thickness off along the sight, either way: only one side of it can have
    been measured.
    """
    surface = boxes()
    T_ac = example_pose()
    scan = T_ac.apply(view(surface, 6000, T_ac.inverse().t)) + _rng().normal(0, 0.004, (1, 3))
    sight = T_ac.t / np.linalg.norm(T_ac.t)
    found = Registrar(surface).register(scan, Pose(T_ac.q, T_ac.t + offset * sight))
    assert np.linalg.norm(found.T_ac.t - T_ac.t) < 0.01


def _patches(rng: np.random.Generator, joined: bool) -> Surface:
    """Convex bodies whose faces are single patches, each wound at random; some of the patches
    are left unsplit.
    """
    vertices, faces, count = [], [], 0
    for _ in range(3):
        hull = trimesh.convex.convex_hull(rng.normal(size=(9, 3)))
        hull.apply_translation(2.5 * rng.normal(size=3))
        for corners in hull.triangles:
            a, b, c = corners
            middle = 0.5 * (
                a + b
            )  # a vertex on the edge of a face that its neighbour does not have
            split = [(a, middle, c), (middle, b, c)] if rng.random() < 0.5 else [(a, b, c)]
            turned = -1 if rng.random() < 0.5 and not joined else 1
            for triangle in split:
                vertices += list(np.array(triangle)[::turned])
                faces.append([count, count + 1, count + 2])
                count += 3
    return Surface(np.array(vertices), np.array(faces, dtype=np.int32), "patches", "")


def _seen(surface: Surface, rng: np.random.Generator) -> np.ndarray:
    """Slope of the first face on rays from outside, below 0 if it faces the eye; of faces
    there the least.
    """
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    middle = surface.vertices.mean(axis=0)
    eyes = middle + 2.0 * surface.extent * np.array(
        [v / np.linalg.norm(v) for v in rng.normal(size=(400, 3))]
    )
    rays = mesh.triangles_center[rng.integers(len(mesh.faces), size=400)] - eyes
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    at, ray, face = mesh.ray.intersects_location(eyes, rays, multiple_hits=True)
    distance, slope = (
        np.linalg.norm(at - eyes[ray], axis=1),
        np.einsum("ij,ij->i", mesh.face_normals[face], rays[ray]),
    )
    first = np.full(400, np.inf)
    np.minimum.at(first, ray, distance)
    found = np.full(400, np.inf)
    same = distance < first[ray] + 1e-6 * surface.extent
    np.minimum.at(found, ray[same], slope[same])
    return found[np.isfinite(found)]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("joined", [False, True])
def test_patches_that_no_edge_connects_face_the_cameras_that_see_them(
    seed: int, joined: bool
) -> None:
    """No two patches have an edge in common, so that only what cameras see tells the outer side of
    each.
    """
    rng = np.random.default_rng(seed)
    surface = _patches(rng, joined)
    found, outward = seen_sides(surface)
    assert outward
    slopes = _seen(found, rng)
    assert len(slopes) > 100
    assert (slopes < 0.0).mean() > 0.99
    assert len(found.faces) < 1.1 * len(surface.faces)


@pytest.mark.parametrize("subdivisions", [2, 4])
@pytest.mark.parametrize("turned", [False, True])
def test_both_sides_of_a_bowl_are_matched_and_one_of_a_body(
    subdivisions: int, turned: bool
) -> None:
    """A bowl without thickness beside a box: finely meshed it has few open edges, and its
    sides are still two.
    """
    bowl, body = (
        trimesh.creation.icosphere(subdivisions=subdivisions),
        trimesh.creation.box((1.0, 0.8, 0.6)),
    )
    bowl.update_faces(bowl.triangles_center[:, 2] < -0.3)
    body.apply_translation((0.2, 0.1, -2.0))
    faces = np.concatenate(
        [bowl.faces[:, ::-1] if turned else bowl.faces, body.faces + len(bowl.vertices)]
    )
    surface = Surface(
        np.concatenate([bowl.vertices, body.vertices]), faces.astype(np.int32), "bowl and body", ""
    )
    found, outward = seen_sides(surface)
    assert outward
    assert len(found.faces) == 2 * len(bowl.faces) + 12
    registrar, rng = Registrar(surface), np.random.default_rng(7)
    for side in (0.7, -0.7):  # into the bowl, and at its back
        turn = exp([0.3, np.arcsin(side) if side > 0 else np.pi - np.arcsin(-side), 0.2])
        T_ac = Pose(turn, np.array([0.1, -0.2, 7.0]))
        rays = np.column_stack([rng.uniform(-0.3, 0.3, (6000, 2)), np.ones(6000)])
        shape = trimesh.Trimesh(T_ac.apply(surface.vertices), surface.faces, process=False)
        scan = shape.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)[0]
        found_pose = registrar.register(
            scan, T_ac @ Pose(exp([0.03, -0.02, 0.02]), np.array([0.05, -0.03, 0.04]))
        )
        assert found_pose.status is AlignStatus.ALIGNED
        step = T_ac.inverse() @ found_pose.T_ac
        assert float(geometry.angle(step.q)) < np.radians(0.05)
        assert float(np.linalg.norm(step.t)) < 0.002 * surface.extent


def test_the_sides_are_kept(tmp_path) -> None:
    surface = _patches(np.random.default_rng(0), False)
    found = seen_sides(surface, tmp_path)[0].faces
    assert len(list(tmp_path.iterdir())) == 1
    np.testing.assert_array_equal(seen_sides(surface, tmp_path)[0].faces, found)
    np.testing.assert_array_equal(seen_sides(surface)[0].faces, found)
