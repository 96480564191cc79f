"""Motions that carry most of a model onto itself: turns of gears, of bodies of revolution,
and finite groups.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from avsreplay import geometry
from avsreplay.geometry import Array, Pose, exp
from avsreplay.records import AlignStatus, Surface
from avsreplay.register.registrar import Registrar
from avsreplay.register.sampling import sample
from avsreplay.register.symmetry import TURNS, near_symmetries


def prism(outline: Array, height: float) -> trimesh.Trimesh:
    """A prism over an outline (n, 2) that is star-shaped about the origin; its parts end at z
    = 0 and the height.
    """
    n = len(outline)
    low, high = (np.column_stack([outline, np.full(n, z)]) for z in (0.0, height))
    vertices = np.vstack([low, high, [[0.0, 0.0, 0.0], [0.0, 0.0, height]]])
    k, after = np.arange(n), (np.arange(n) + 1) % n
    sides = np.vstack(
        [np.column_stack([k, after, after + n]), np.column_stack([k, after + n, k + n])]
    )
    ends = np.vstack(
        [
            np.column_stack([after, k, np.full(n, 2 * n)]),
            np.column_stack([k + n, after + n, np.full(n, 2 * n + 1)]),
        ]
    )
    return trimesh.Trimesh(vertices, np.vstack([sides, ends]), process=False)


def gear(teeth: int, depth: float, key: bool = True) -> Surface:
    """A gear of radius 1 with trapezoidal teeth, a hub on one side, and a key on the hub."""
    at = 2.0 * np.pi * (np.arange(teeth)[:, None] + [0.0, 0.25, 0.35, 0.6, 0.75]) / teeth
    radius = np.where(np.isin(np.arange(5), [2, 3]), 1.0, 1.0 - depth) * np.ones((teeth, 1))
    parts = [
        prism(np.column_stack([(radius * np.cos(at)).ravel(), (radius * np.sin(at)).ravel()]), 0.3)
    ]
    hub = trimesh.creation.cylinder(0.4, 0.3, sections=10 * teeth)
    hub.apply_translation((0.0, 0.0, 0.45))
    parts.append(hub)
    if key:
        box = trimesh.creation.box((0.25, 0.15, 0.25))
        box.apply_translation((0.4, 0.0, 0.45))
        parts.append(box)
    mesh = trimesh.util.concatenate(parts)
    moved = trimesh.transformations.rotation_matrix(
        0.9, (0.3, -0.5, 0.7), (0.2, -0.4, 0.1)
    )  # the axis is none of {C}
    mesh.apply_transform(moved)
    return Surface(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int32), "gear", "")


def turns_deg(motions: Array) -> Array:
    return np.sort([float(np.degrees(geometry.angle(Pose.from_matrix(T).q))) for T in motions])


def found_in(surface: Surface):
    registrar = Registrar(surface)
    return near_symmetries(registrar.loop.symmetry.search, registrar.index, *sample(surface, 4000))


@pytest.mark.parametrize(("teeth", "depth"), [(11, 0.2), (17, 0.2), (24, 0.15), (38, 0.12)])
def test_the_turns_of_a_gear_are_those_of_its_teeth(teeth: int, depth: float) -> None:
    found = found_in(gear(teeth, depth))
    k = np.arange(1, teeth)
    expected = np.sort(np.minimum(k, teeth - k) * 360.0 / teeth)
    np.testing.assert_allclose(turns_deg(found.kinds[0]), expected, atol=0.2)
    assert np.degrees(found.least_rad) == pytest.approx(360.0 / teeth, abs=0.2)


@pytest.mark.parametrize("sides", [48, 96])
def test_any_turn_carries_a_body_of_revolution_onto_itself(sides: int) -> None:
    tank = trimesh.creation.cylinder(0.5, 2.5, sections=sides)
    cone = trimesh.creation.cone(0.4, 0.8, sections=sides)
    cone.apply_translation((0.0, 0.0, -1.75))
    mesh = trimesh.util.concatenate([tank, cone])
    found = found_in(
        Surface(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int32), "stage", "")
    )
    assert len(found.kinds[0]) == TURNS - 1
    assert np.isinf(found.least_rad)


def test_products_complete_the_group_of_a_cube() -> None:
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    found = found_in(
        Surface(np.array(cube.vertices), np.array(cube.faces, dtype=np.int32), "cube", "")
    )
    angles = turns_deg(np.concatenate(found.kinds))
    np.testing.assert_allclose(angles, [90.0] * 6 + [120.0] * 8 + [180.0] * 9, atol=1.0)


@pytest.mark.parametrize("teeth", [17, 38])
def test_no_pose_of_a_gear_is_accepted_that_is_turned_by_teeth(teeth: int) -> None:
    """With the key in sight one tooth is right; with the key on the other side none is told
    from the others.
    """
    surface, rng, accepted = gear(teeth, 0.15), np.random.default_rng(teeth), 0
    registrar = Registrar(surface)
    middle = 0.5 * (surface.vertices.max(axis=0) + surface.vertices.min(axis=0))
    for _ in range(12):
        turn = exp(Rotation.random(random_state=int(rng.integers(1 << 30))).as_rotvec())
        T_ac = Pose(turn, np.array([0.1, -0.1, 6.0]) - geometry.matrix(turn) @ middle)
        rays = np.column_stack([rng.uniform(-0.22, 0.22, (6000, 2)), np.ones(6000)])
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        shape = trimesh.Trimesh(T_ac.apply(surface.vertices), surface.faces, process=False)
        at = shape.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)[0]
        found = registrar.acquire(at * (1.0 + 0.0005 * rng.standard_normal((len(at), 1))))
        if found.status is AlignStatus.ALIGNED:
            accepted += 1
            assert float(np.degrees(geometry.angle((T_ac.inverse() @ found.T_ac).q))) < 2.0
    assert accepted >= 2
