"""The mirror image of a model against the model, on accepted scans."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from avsreplay.geometry import Pose
from avsreplay.records import AlignStatus, Scan, Surface
from avsreplay.register.contract import view
from avsreplay.register.mirror import MOST_REFLECTED, from_another_side, reflections
from avsreplay.register.model_check import ModelCheck
from avsreplay.register.registrar import Registrar
from avsreplay.register.surface_index import SurfaceIndex

NOISE = 0.002  # of the extent


def body(*marks: tuple[float, float, float]) -> Surface:
    """A bus with two panels and a dish, symmetric in the plane x = 0, and boxes on its upper side
    at ``marks``.
    """
    parts = [trimesh.creation.box((1.2, 1.0, 1.6))]
    for x in (-1.5, 1.5):
        parts.append(trimesh.creation.box((1.4, 0.05, 0.7)).apply_translation((x, 0.1, 0.2)))
    parts.append(trimesh.creation.cone(0.4, 0.4, sections=24).apply_translation((0.0, 0.2, 0.8)))
    parts += [trimesh.creation.box((0.3, 0.25, 0.35)).apply_translation(at) for at in marks]
    shape = trimesh.util.concatenate(parts)
    return Surface(np.array(shape.vertices), np.array(shape.faces, dtype=np.int32), "body", "")


MARKS = (0.35, 0.6, -0.4), (-0.45, -0.2, 0.95)
DIFFERENT, SYMMETRIC = body(*MARKS), body((0.0, 0.6, -0.4))


def checked(
    model: Surface,
    target: Surface,
    mirrored: bool,
    count: int = 8,
    seed: int = 5,
    again: int = 1,
) -> tuple[ModelCheck, int]:
    """The check of a run, and the number of its accepted scans, which are searched without a
    guess, and each given ``again`` times.
    """
    registrar, rng = Registrar(model), np.random.default_rng(seed)
    check, accepted = ModelCheck(registrar, model), 0
    for k in range(count):
        q = rng.standard_normal(4)
        T_ac = Pose(q / np.linalg.norm(q), np.array([0.0, 0.0, 3.0 * model.extent]))
        points = T_ac.apply(view(target, 3000, T_ac.inverse().t))
        points *= 1.0 + NOISE / 3.0 * rng.standard_normal((len(points), 1))
        points *= [-1.0 if mirrored else 1.0, 1.0, 1.0]
        found = registrar.acquire(points)
        accepted += found.status is AlignStatus.ALIGNED
        for n in range(again):
            check.add(Scan(k, k * 10**9 + n, points), found)
    return check, accepted


@pytest.mark.slow
def test_a_mirrored_model_of_a_nearly_symmetric_object_is_noticed_although_scans_are_accepted() -> (
    None
):
    check, accepted = checked(DIFFERENT, DIFFERENT, mirrored=True)
    assert accepted >= 4
    (note,) = check.notes()
    assert "mirror image of the model explains the scans better" in note
    assert "--model-mirror" in note


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "target", "mirrored"),
    [
        (DIFFERENT, DIFFERENT, False),
        (SYMMETRIC, SYMMETRIC, False),
        (SYMMETRIC, SYMMETRIC, True),
        (
            SYMMETRIC,
            DIFFERENT,
            False,
        ),  # parts that the model lacks, where it and its image are equally wrong
        (
            DIFFERENT,
            body(MARKS[0], (0.2, -0.3, 0.95)),
            False,
        ),  # one of two parts is at another place
    ],
)
def test_the_right_model_and_a_symmetric_one_are_not_called_mirrored(
    model: Surface, target: Surface, mirrored: bool
) -> None:
    check, accepted = checked(model, target, mirrored)
    assert accepted >= 4
    assert not any("mirror" in note for note in check.notes())


@pytest.mark.parametrize("turned", [0.0, 0.7])
def test_the_plane_of_a_symmetric_body_is_found(turned: float) -> None:
    turn = trimesh.transformations.rotation_matrix(turned, (1.0, 2.0, 3.0))[:3, :3]
    vertices = SYMMETRIC.vertices @ turn.T + np.array([0.3, -0.2, 0.1])
    surface = Surface(vertices, SYMMETRIC.faces, "body", "")
    best = reflections(surface, SurfaceIndex.build(surface, 0.15 * surface.extent))[0]
    assert np.linalg.det(best[:3, :3]) == pytest.approx(-1.0)
    expected = np.eye(4)
    expected[:3, :3] -= 2.0 * np.outer(turn[:, 0], turn[:, 0])
    expected[:3, 3] = 2.0 * turn[:, 0] * (turn[:, 0] @ np.array([0.3, -0.2, 0.1]))
    assert best == pytest.approx(expected, abs=0.003)


def test_a_body_without_a_plane_of_symmetry_has_no_reflection() -> None:
    sizes = (2.0, 0.2, 0.2), (0.2, 1.7, 0.2), (0.2, 0.2, 1.5), (0.2, 1.2, 0.2)
    middles = (0.0, 0.0, 0.0), (0.9, 0.8, 0.0), (-0.9, 0.0, 0.7), (-0.9, -0.5, 1.4)
    parts = [
        trimesh.creation.box(size).apply_translation(at)
        for size, at in zip(sizes, middles, strict=True)
    ]
    shape = trimesh.util.concatenate(parts)
    surface = Surface(np.array(shape.vertices), np.array(shape.faces, dtype=np.int32), "body", "")
    assert len(reflections(surface, SurfaceIndex.build(surface, 0.15 * surface.extent))) == 0


def test_scans_of_different_sides_are_kept() -> None:
    check, _ = checked(SYMMETRIC, SYMMETRIC, mirrored=False, count=12, again=2)
    seen = check.seen
    assert len(seen) == MOST_REFLECTED
    middle = 0.5 * (SYMMETRIC.vertices.min(axis=0) + SYMMETRIC.vertices.max(axis=0))
    sights = np.array(
        [(middle - scan.T_cs.t) / np.linalg.norm(middle - scan.T_cs.t) for scan in seen]
    )
    cosines = (sights @ sights.T)[np.triu_indices(len(seen), 1)]
    assert cosines.max() < np.cos(np.radians(30.0))
    assert not from_another_side(seen[0].T_cs, seen, middle)
