"""The evidence of the rays of a scan at a pose, and what it decides in the results."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from avsreplay import geometry
from avsreplay.geometry import Array, Pose, exp
from avsreplay.records import AlignStatus, Surface
from avsreplay.register.contract import boxes, example_pose
from avsreplay.register.evidence import EvidenceModel, Observed
from avsreplay.register.registrar import Registrar

SEED = 5
NOISE = 0.002  # of the extent, along the rays


@pytest.fixture(scope="module")
def registrar() -> Registrar:
    return Registrar(boxes())


def cast(surface: Surface, T_ac: Pose, directions: Array) -> Array:
    """Ranges (n,) of the first face on rays (n, 3) from the origin, by trimesh; inf: none."""
    mesh = trimesh.Trimesh(T_ac.apply(surface.vertices), surface.faces, process=False)
    at, ray, _ = mesh.ray.intersects_location(
        np.zeros_like(directions), directions, multiple_hits=False
    )
    ranges = np.full(len(directions), np.inf)
    np.minimum.at(ranges, ray, np.linalg.norm(at, axis=1))
    return ranges


def scan_of(
    surface: Surface, T_ac: Pose, rng: np.random.Generator, across: int = 70, margin: float = 0.05
) -> tuple[Array, Array]:
    """Directions (n, 3) of a grid over the image of a target, with a margin around it, and
    measured ranges (n,).
    """
    image = T_ac.apply(surface.vertices)
    image = image[:, :2] / image[:, 2:]
    low, high = image.min(axis=0), image.max(axis=0)
    wide = margin * (high - low)
    x, y = (np.linspace(a, b, across) for a, b in zip(low - wide, high + wide, strict=True))
    grid = np.stack([*np.meshgrid(x, y, indexing="ij"), np.ones((across, across))], axis=-1)
    directions = grid.reshape(-1, 3) / np.linalg.norm(grid.reshape(-1, 3), axis=1)[:, None]
    ranges = cast(surface, T_ac, directions)
    return directions, ranges + NOISE * surface.extent * rng.standard_normal(len(ranges))


def points_of(directions: Array, ranges: Array) -> Array:
    hit = np.isfinite(ranges)
    return directions[hit] * ranges[hit, None]


def off(T_ac: Pose, degrees: float, shift_m: float) -> Pose:
    axis = np.array([0.48, -0.6, 0.64])
    return T_ac @ Pose(exp(np.radians(degrees) * axis), shift_m * np.array([0.6, 0.8, 0.0]))


@pytest.mark.parametrize("outliers", [0.0, 0.6])
@pytest.mark.parametrize("noise", [0.0, 0.006])
def test_only_the_right_pose_is_accepted(
    registrar: Registrar, outliers: float, noise: float
) -> None:
    """More noise and outliers do not change it: they are independent from ray to ray."""
    surface, T_ac, rng = boxes(), example_pose(), np.random.default_rng(SEED)
    p = points_of(*scan_of(surface, T_ac, rng))
    p *= 1.0 + noise * surface.extent * rng.standard_normal((len(p), 1)) / np.linalg.norm(
        p, axis=1, keepdims=True
    )
    wrong = rng.random(len(p)) < outliers
    p[wrong] = p.mean(axis=0) + 0.4 * surface.extent * rng.uniform(-1.0, 1.0, (wrong.sum(), 3))
    model, scan = EvidenceModel(registrar.target), Observed(p)
    right = model.at(scan, T_ac.inverse())
    assert right is not None
    assert right.reason() == ""
    for degrees, shift in ((12.0, 0.0), (40.0, 0.0), (90.0, 0.0), (180.0, 0.0), (0.0, 0.1)):
        other = model.at(scan, off(T_ac, degrees, shift * surface.extent).inverse())
        assert other is None or (other.reason() and other.total < right.total - 20.0)


def test_evidence_says_what_speaks_against_a_pose(registrar: Registrar) -> None:
    """A model that is moved towards the sensor is where the rays passed through."""
    surface, T_ac = boxes(), example_pose()
    scan = Observed(points_of(*scan_of(surface, T_ac, np.random.default_rng(SEED))))
    nearer = Pose(T_ac.q, T_ac.t - 0.06 * surface.extent * T_ac.t / np.linalg.norm(T_ac.t))
    found = EvidenceModel(registrar.target).at(scan, nearer.inverse())
    assert found is not None
    right = EvidenceModel(registrar.target).at(scan, T_ac.inverse())
    assert right is not None
    assert found.through > 0.2 * found.patches
    assert right.through < 0.05 * right.patches
    assert found.reason()


def test_a_visible_side_with_gaps_is_not_covered(registrar: Registrar) -> None:
    surface, T_ac = boxes(), example_pose()
    p = points_of(*scan_of(surface, T_ac, np.random.default_rng(SEED)))
    model = EvidenceModel(registrar.target)
    whole = model.at(Observed(p), T_ac.inverse())
    part = model.at(Observed(p[p[:, 0] < np.quantile(p[:, 0], 0.7)]), T_ac.inverse())
    assert whole is not None
    assert part is not None
    assert (whole.covered, part.covered) == (True, False)
    assert part.absent > 5.0 * max(whole.absent, 1.0)


@pytest.mark.parametrize("margin", [1.2, 2.0])
def test_a_target_before_a_wall_that_has_nearly_all_points_is_registered(
    registrar: Registrar, margin: float
) -> None:
    surface, T_ac, rng = boxes(), example_pose(), np.random.default_rng(SEED)
    directions, ranges = scan_of(surface, T_ac, rng, 180, margin)
    n, at = np.array([0.2, -0.1, -1.0]), 1.7 * T_ac.t
    wall = (n @ at) / (directions @ n)
    p = directions * np.minimum(ranges, wall)[:, None]
    assert np.mean(ranges < wall) < 0.05
    found = registrar.register(p, off(T_ac, 1.0, 0.005 * surface.extent))
    step = T_ac.inverse() @ found.T_ac
    assert found.status is AlignStatus.ALIGNED
    assert found.points == len(p)
    assert np.degrees(geometry.angle(step.q)) < 1.0
    assert np.linalg.norm(step.t) < 0.01 * surface.extent


@pytest.mark.parametrize("jitter", [0.0, 5e-5])
def test_a_body_with_an_exact_symmetry_is_ambiguous_and_its_poses_are_listed(
    jitter: float,
) -> None:
    """Two-fold, to 1e-4 of the extent; the members are the true pose and the turned one."""
    rng = np.random.default_rng(SEED)
    half = [trimesh.creation.box((1.6, 1.0, 0.8))]
    for size, place in (((0.5, 0.2, 0.9), (0.7, 0.4, 0.3)), ((0.3, 0.8, 0.3), (-0.5, 0.6, -0.3))):
        part = trimesh.creation.box(size)
        part.apply_transform(trimesh.transformations.rotation_matrix(0.4, (1, 2, 3)))
        half.append(part.apply_translation(place))
    turn = trimesh.transformations.rotation_matrix(np.pi, (0, 0, 1))
    mesh = trimesh.util.concatenate(half + [each.copy().apply_transform(turn) for each in half])
    mesh.apply_translation((0.2, -0.1, 0.3))
    vertices = np.array(mesh.vertices)
    vertices += (
        jitter * np.linalg.norm(np.ptp(vertices, axis=0)) * rng.uniform(-1.0, 1.0, vertices.shape)
    )
    surface = Surface(vertices, np.array(mesh.faces, dtype=np.int32), "two halves", "")
    registrar = Registrar(surface)
    axis = np.array([0.2, -0.1, 0.0])
    turned = Pose(np.array([0.0, 0.0, 1.0, 0.0]), 2.0 * axis)
    for k in range(3):
        q = rng.standard_normal(4)
        T_ac = Pose(q / np.linalg.norm(q), np.array([0.1, -0.2, 8.0]))
        found = registrar.acquire(points_of(*scan_of(surface, T_ac, rng, 45)))
        assert found.status is AlignStatus.AMBIGUOUS, k
        assert found.free_directions.startswith("turned 180 deg")
        assert len(found.members) == 2
        np.testing.assert_array_equal(found.members[0].matrix, found.T_ac.matrix)
        for truth in (T_ac, T_ac @ turned):
            errors = [
                np.degrees(geometry.angle((truth.inverse() @ each).q)) for each in found.members
            ]
            assert min(errors) < 0.5


def test_half_turns_of_a_surface_are_about_its_principal_axes() -> None:
    """The triangles' own moments, not those of samples: exact for a box of any position."""
    from avsreplay.register.global_search import principal_turns

    made = trimesh.creation.box((3.0, 2.0, 1.0))
    made.apply_transform(trimesh.transformations.rotation_matrix(0.7, (1, 1, 0.3)))
    made.apply_translation((4.0, -2.0, 1.0))
    surface = Surface(np.array(made.vertices), np.array(made.faces, dtype=np.int32), "box", "")
    corners = {tuple(np.round(v, 9)) for v in surface.vertices}
    for T in principal_turns(surface):
        moved = surface.vertices @ T[:3, :3].T + T[:3, 3]
        assert {tuple(np.round(v, 9)) for v in moved} == corners
