"""Comparison of poses, and a target with few of the points of a scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avsreplay import geometry
from avsreplay.geometry import Pose, exp
from avsreplay.records import AlignStatus
from avsreplay.register.comparison import Measured, decided
from avsreplay.register.contract import boxes, example_pose, view
from avsreplay.register.evidence import Observed
from avsreplay.register.generators.weak_directions import WeakDirections
from avsreplay.register.hypotheses import Candidate, Case
from avsreplay.register.poses import SAME_OF_EXTENT, Sameness
from avsreplay.register.registrar import Registrar


def _pose(rng: np.random.Generator, degrees: float, shift_m: float) -> Pose:
    axis, away = rng.standard_normal((2, 3))
    return Pose(
        exp(np.radians(degrees) * axis / np.linalg.norm(axis)),
        shift_m * away / np.linalg.norm(away),
    )


@pytest.mark.parametrize("scale", [0.2, 1.0])
def test_sameness_is_symmetric_and_the_same_for_all_scans(scale: float) -> None:
    """The frame of the scan is arbitrary: T_ca and T_ca moved with it are compared alike."""
    surface, rng, found = boxes(), np.random.default_rng(3), []
    poses = Sameness(surface)
    for _ in range(60):
        first, frame = _pose(rng, 170.0, 3.0), _pose(rng, 120.0, 5.0)
        other = _pose(rng, rng.uniform(0.0, 15.0 * scale), 0.0) @ first
        same = poses.same(first, other, scale)
        assert poses.same(other, first, scale) is same
        assert poses.same(first @ frame, other @ frame, scale) is same
        found.append(same)
    assert 0.2 < np.mean(found) < 0.9
    moved = Pose(Pose.identity().q, np.array([0.0, 0.0, 1.1 * SAME_OF_EXTENT * surface.extent]))
    assert not poses.same(moved, Pose.identity())


def test_the_decision_between_poses_does_not_depend_on_their_order() -> None:
    """Of three poses one explains all points, one nearly all, and one a half."""
    rng = np.random.default_rng(4)
    near = np.abs(rng.normal(0.0, 0.01, 2000))
    turns = [Pose(exp([0.0, 0.0, angle]), np.zeros(3)) for angle in (0.0, 1.0, 2.0)]
    off = near.copy()
    off[:1000] = 1.0
    like = near[rng.permutation(2000)]
    found = [Measured(T, d) for T, d in zip(turns, (near, like, off), strict=True)]
    same = Sameness(boxes()).same
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
        best, as_near, rivals = decided(
            [found[k] for k in order], same, (0.03, 0.03), 0.01, complete=True
        )
        assert best is not found[2]
        assert len(as_near) == len(rivals) == 1
        assert rivals[0] is not found[2]


def test_a_target_with_few_of_the_points_of_a_scan_is_accepted() -> None:
    """A wall far behind it has 97 % of them."""
    surface, T_ac, rng = boxes(), example_pose(), np.random.default_rng(6)
    points = T_ac.apply(view(surface, 700, T_ac.inverse().t))
    points *= 1.0 + 5e-4 * rng.standard_normal((len(points), 1))
    wall = 6.0 * surface.extent * rng.uniform(-1.0, 1.0, (30 * len(points), 3)) + T_ac.t
    wall[:, 2] = T_ac.t[2] + 1.5 * surface.extent
    middle = points.mean(axis=0)
    cosine = wall @ middle / np.linalg.norm(wall, axis=1) / np.linalg.norm(middle)
    clear = np.arccos(cosine) > 0.7 * surface.extent / np.linalg.norm(middle)
    scan = rng.permutation(np.concatenate([points, wall[clear]]))
    assert len(points) < 0.06 * len(scan)
    turn = Pose(exp(np.radians([1.0, -1.0, 0.5])), np.zeros(3))
    found = Registrar(surface).register(scan, T_ac @ turn)
    assert found.status is AlignStatus.ALIGNED
    assert np.degrees(geometry.angle((T_ac.inverse() @ found.T_ac).q)) < 0.5


@pytest.mark.parametrize(
    ("degrees", "shift_of_gate", "needed"),
    [(0.0, 0.0, False), (0.2, 0.0, False), (1.2, 0.0, True), (0.0, 0.1, False), (0.0, 0.5, True)],
)
def test_a_part_of_the_target_is_compared_where_its_pose_left_the_guess(
    degrees: float, shift_of_gate: float, needed: bool
) -> None:
    """By more than a quarter of the rejection distance, turned about its middle or moved."""
    surface, T_ac = boxes(), example_pose()
    registrar = Registrar(surface)
    scan = T_ac.apply(view(surface, 1500, T_ac.inverse().t))
    scan = scan[scan[:, 0] < np.median(scan[:, 0])]
    middle = 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0))
    q = exp(np.radians(degrees) * np.array([0.6, 0.0, 0.8]))
    away = np.array([0.0, shift_of_gate * registrar.limits.gate_m, 0.0])
    guess = T_ac @ Pose(q, middle - geometry.matrix(q) @ middle + away)
    found = replace(registrar.register(scan, T_ac), T_ac=T_ac, status=AlignStatus.ALIGNED)
    case = Case(Observed(scan), scan, scan, guess)
    case.current = Candidate(found)
    loop = registrar.loop
    generator = WeakDirections(registrar.target, loop.test, loop.screen, loop.poses)
    assert generator.needed(case) is needed
