"""Wrong poses are rejected, correct ones are not: noise, contradictions, and the work that a
scan may cost.
"""

from __future__ import annotations

import numpy as np
import pytest

from avsreplay import geometry, mesh
from avsreplay.geometry import Array, Pose, exp
from avsreplay.records import AlignStatus, Surface
from avsreplay.register.contract import example_pose, view
from avsreplay.register.plausibility import robust_noise
from avsreplay.register.registrar import Registrar
from avsreplay.register.sampling import segments, without_scattered_points
from avsreplay.register.shown import Effort, effort_for, shown
from avsreplay.register.surface_index import kernel_module
from avsreplay.register.visibility import Visibility

SEED = 7


@pytest.fixture(scope="module")
def registrar(surface: Surface) -> Registrar:
    return Registrar(surface)


def hidden_view(
    surface: Surface, T_ac: Pose, count: int, rng: np.random.Generator, sigma: float = 0.01
) -> Array:
    """Points of the visible surface only: of all facing points in a direction, the nearest."""
    points = T_ac.apply(view(surface, 12 * count, T_ac.inverse().t))
    cell = np.floor(points[:, :2] / points[:, 2:] / 0.012).astype(int)
    order = np.lexsort((points[:, 2], cell[:, 1], cell[:, 0]))
    _, first = np.unique(cell[order], axis=0, return_index=True)
    seen = points[order[first]]
    return seen * (
        1.0
        + sigma * rng.standard_normal((len(seen), 1)) / np.linalg.norm(seen, axis=1, keepdims=True)
    )


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
def test_the_noise_is_found_among_outliers(share: float) -> None:
    rng = np.random.default_rng(SEED)
    distance = np.abs(rng.normal(0.0, 0.02, 20000))
    distance[: int(share * 20000)] = rng.uniform(0.0, 2.0, int(share * 20000))
    assert 0.018 < robust_noise(distance) < 0.026
    assert robust_noise(7.0 * distance) == pytest.approx(7.0 * robust_noise(distance))


@pytest.mark.parametrize("count", [700, 5000])
def test_points_well_off_the_model_are_counted_as_their_distances_say(
    registrar: Registrar, count: int
) -> None:
    """Among 1,000 points of the scan: two gates off or more, but within the reach of the index."""
    T_ac, rng = example_pose(), np.random.default_rng(SEED)
    scan = hidden_view(registrar.target.surface, T_ac, count, rng)
    stray = rng.random(len(scan)) < 0.07
    scan[stray] += rng.uniform(-1.0, 1.0, (stray.sum(), 3)) * registrar.limits.reach_m
    found = registrar.register(scan, T_ac)
    few = scan[np.linspace(0, len(scan) - 1, 1000).astype(int)] if len(scan) > 1000 else scan
    distance = registrar.loop.test.measure(few, found.T_ac.inverse())
    off = (distance > 2.0 * registrar.limits.gate_m) & (distance < registrar.index.reach_m)
    assert found.inlier_ratio > 0.9
    assert found.well_off == np.count_nonzero(off) > 10


@pytest.mark.parametrize("guess_deg", [0.1, 3.0])
def test_most_points_outliers(registrar: Registrar, surface: Surface, guess_deg: float) -> None:
    rng, T_ac = np.random.default_rng(SEED), example_pose()
    scan = hidden_view(surface, T_ac, 3000, rng)
    wrong = rng.random(len(scan)) < 0.6
    scan[wrong] = rng.uniform(scan.min(0) - 0.5, scan.max(0) + 0.5, (wrong.sum(), 3))
    found = registrar.register(
        scan, T_ac @ Pose(exp(np.radians(guess_deg) * np.array([0.6, 0.0, 0.8])), np.zeros(3))
    )
    step = T_ac.inverse() @ found.T_ac
    assert found.status is AlignStatus.ALIGNED
    assert np.degrees(geometry.angle(step.q)) < 0.5


@pytest.mark.parametrize("guess_deg", [20.0, 60.0, 120.0, 180.0])
def test_what_is_called_aligned_is_right(
    registrar: Registrar, surface: Surface, guess_deg: float
) -> None:
    rng, T_ac = np.random.default_rng(SEED), example_pose()
    scan = hidden_view(surface, T_ac, 3000, rng)
    for axis in np.vstack([np.eye(3), rng.standard_normal((3, 3))]):
        turn = exp(np.radians(guess_deg) * axis / np.linalg.norm(axis))
        found = registrar.register(scan, T_ac @ Pose(turn, np.zeros(3)))
        right = np.degrees(geometry.angle((T_ac.inverse() @ found.T_ac).q)) < 0.5
        assert right or found.status is not AlignStatus.ALIGNED


def _searched(scans: list[Array]) -> list[int]:
    """The numbers of the scans that are searched if no search finds a pose."""
    failed, searched = tuple[Array, ...](), list[int]()
    for k, scan in enumerate(scans):
        seen = shown(scan)
        if effort_for(seen, failed) is Effort.FULL:
            searched.append(k)
            failed += () if seen is None else (seen,)
    return searched


def test_a_scan_is_searched_again_where_it_shows_something_else() -> None:
    """Not after a number of scans: the same view is searched once, and again when it is no
    longer hidden, or nearer.
    """
    rng = np.random.default_rng(SEED)
    scan = rng.normal(size=(1000, 3)) * [1.0, 0.6, 0.2] + [0.0, 0.0, 9.0]
    turned = exp([0.0, 0.0, 0.7])
    same = [Pose(turned, np.zeros(3)).apply(scan) for _ in range(50)]
    assert _searched([scan, *same]) == [0]
    part = scan[scan[:, 0] < -0.3]
    assert _searched([part, *[part] * 20, scan, *same]) == [0, 21]
    nearer = [scan[: int(30 * 1.05**k)] for k in range(70)]
    found = _searched(nearer)
    assert 5 <= len(found) <= 25
    assert found[-1] > 50


def test_searches_of_a_tumbling_body_with_a_wrong_model_end() -> None:
    """The difference that is required grows with the number of failed searches."""
    rng = np.random.default_rng(SEED)
    scans = [
        rng.normal(size=(int(800 * s), 3)) * [1.0, s, 0.2 * s] + [0.0, 0.0, 9.0]
        for s in 0.75 + 0.25 * np.sin(0.4 * np.arange(250))
    ]
    assert len(_searched(scans)) < 20


@pytest.mark.parametrize("noise", [0.002, 0.006])
def test_a_guess_that_few_points_confirm_gets_the_full_effort(
    registrar: Registrar, surface: Surface, noise: float
) -> None:
    """As at the end of an occlusion at the start of a run; another body costs no registration
    of the whole scan.
    """
    rng, T_ac = np.random.default_rng(SEED), example_pose()
    scan = hidden_view(surface, T_ac, 3000, rng, noise * surface.extent)
    guess = T_ac @ Pose(exp([0.04, -0.03, 0.05]), np.array([0.05, 0.05, -0.05]))
    found = registrar.register(scan, guess, effort=Effort.GUESS)
    assert found.status is AlignStatus.ALIGNED
    assert np.degrees(geometry.angle((T_ac.inverse() @ found.T_ac).q)) < 1.0
    ball = rng.standard_normal((3000, 3))
    ball *= 0.3 * surface.extent / np.linalg.norm(ball, axis=1)[:, None]
    ball = ball[ball[:, 2] < 0.0] + T_ac.apply(surface.vertices).mean(axis=0)
    other = registrar.register(ball, guess, effort=Effort.GUESS)
    assert other.status is AlignStatus.POSTPONED
    assert not other.measured


def test_without_the_full_effort_nothing_is_searched(registrar: Registrar) -> None:
    scan = np.random.default_rng(SEED).normal(size=(2000, 3)) + np.array([0.0, 0.0, 9.0])
    found = registrar.acquire(scan, effort=Effort.GUESS)
    assert found.status is AlignStatus.POSTPONED
    assert not found.measured
    assert registrar.register(
        scan, Pose(np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, 9.0])), effort=Effort.GUESS
    ).status not in (
        AlignStatus.ALIGNED,
        AlignStatus.MEASURED,
    )


def test_scattered_points_are_left_out_and_a_clean_scan_is_not_changed() -> None:
    rng = np.random.default_rng(SEED)
    plane = np.column_stack([rng.uniform(-1, 1, (1000, 2)), np.zeros(1000)])
    scattered = rng.uniform(-1.5, 1.5, (1500, 3))
    kept = without_scattered_points(np.vstack([plane, scattered]), 3.0)
    near = np.abs(kept[:, 2]) < 0.1
    assert near.mean() > 0.9
    assert near.sum() > 800
    assert len(without_scattered_points(plane, 3.0)) == len(plane)


def test_a_body_is_separated_from_the_wall_behind_it(surface: Surface) -> None:
    rng, T_ac = np.random.default_rng(SEED), example_pose()
    body = hidden_view(surface, T_ac, 3000, rng)
    u = rng.uniform(-8.0, 8.0, (4000, 2))
    wall = np.column_stack([u, np.full(4000, float(body[:, 2].max()) + 0.3)])
    parts = list(segments(np.vstack([body, wall]), surface.extent))
    assert len(parts[0]) == pytest.approx(len(body), rel=0.15)
    assert parts[0][:, 2].max() <= body[:, 2].max() + 1e-9
    assert list(segments(body, surface.extent)) == []


def test_a_mesh_whose_sheets_touch_at_edges_is_closed() -> None:
    """Two tetrahedra with a common edge: four faces meet there, and both are closed with
    outward faces.
    """
    apex = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)
    opposite = apex * [1.0, -1.0, -1.0]  # a half turn about the common edge
    both = Surface(
        np.vstack([apex, opposite]), np.vstack([faces, faces + 4]).astype(np.int32), "two", ""
    )
    assert Visibility(both).sided
    assert not Visibility(Surface(apex, faces[:3], "open", "")).sided
    inwards = np.vstack([faces, faces[:, ::-1] + 4]).astype(np.int32)
    found, reversed_ = mesh.outward(both.vertices, inwards)
    assert reversed_ == 4
    np.testing.assert_array_equal(found[4:, ::-1], inwards[4:])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_scan_cut_along_any_direction_of_its_image_is_narrower(dtype):
    rng = np.random.default_rng(7)
    model = rng.uniform(-1.0, 1.0, (400, 3))
    T_ca = Pose(geometry.exp([0.3, -1.1, 0.4]), np.array([4.0, 9.0, -6.0]))
    scan = T_ca.inverse().apply(model).astype(dtype)
    narrower = kernel_module().is_narrower
    assert not narrower(scan, T_ca.matrix, model, 0.99)
    assert narrower(scan, T_ca.matrix, model, 1.01)
    towards = np.median(scan, axis=0) / np.linalg.norm(np.median(scan, axis=0))
    image = scan / (scan @ towards)[:, None]
    for turn in np.radians([0.0, 37.0, 90.0, 141.0]):
        x = np.cross(towards, [1.0, 0.0, 0.0])
        along = image @ (np.cos(turn) * x + np.sin(turn) * np.cross(towards, x))
        cut = scan[along < np.median(along)]
        assert narrower(cut, T_ca.matrix, model, 0.8)
        assert narrower(np.repeat(cut, 2, axis=0)[::2], T_ca.matrix, model, 0.8)
