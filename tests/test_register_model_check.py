"""Errors of the model are found from a run: size, mirror image, another object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import AlignStatus, Scan, Surface
from avsreplay.register.contract import boxes, view
from avsreplay.register.duration import LEAST_SCANS
from avsreplay.register.model_check import ModelCheck
from avsreplay.register.params import RegisterParams
from avsreplay.register.registrar import Registrar

SEED = 3


def scans(surface: Surface, count: int, sigma: float = 0.01) -> list[tuple[Array, Pose]]:
    """Views of the surface from random sides, with noise along the ray."""
    rng, found = np.random.default_rng(SEED), []
    for _ in range(count):
        q = rng.standard_normal(4)
        T_ac = Pose(q / np.linalg.norm(q), np.array([0.0, 0.0, 3.0 * surface.extent]))
        points = T_ac.apply(view(surface, 3000, T_ac.inverse().t))
        found.append(
            (
                points
                * (1.0 + sigma * rng.standard_normal((len(points), 1)) / (3.0 * surface.extent)),
                T_ac,
            )
        )
    return found


def checked(model: Surface, measured: Surface, count: int = 30) -> ModelCheck:
    registrar = Registrar(model)
    check = ModelCheck(registrar, model)
    for points, T_ac in scans(measured, count):
        check.add(Scan(0, 0, points), registrar.register(points, T_ac))
    return check


@pytest.mark.parametrize(
    "factor",
    [pytest.param(0.98, marks=pytest.mark.slow), 1.01, pytest.param(1.03, marks=pytest.mark.slow)],
)
def test_an_error_of_size_is_measured(factor: float) -> None:
    model = boxes()
    check = checked(model, replace(model, vertices=factor * model.vertices))
    found = check.scale()
    assert found is not None
    assert found[0] == pytest.approx(factor, abs=0.002)
    assert f"multiply --model-scale by {found[0]:.4f}" in check.notes()[0]


@pytest.mark.slow
def test_a_correct_model_raises_no_note() -> None:
    assert checked(boxes(), boxes()).notes() == ()


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "used"), [(1.0, 16), (1.007, 20)])
def test_the_size_is_measured_until_an_error_is_excluded(factor: float, used: int) -> None:
    model = boxes()
    check = checked(model, replace(model, vertices=factor * model.vertices), count=60)
    assert len(check.deltas) == used
    assert bool(check.notes()) == (factor != 1.0)


def tumbling_box(factor: float, acceleration: float, count: int = 100) -> ModelCheck:
    """The check after scans of a tumbling box that is ``factor`` times as large as the model.

    ``acceleration``: of the mass centre [extents/s^2], along x.
    """
    model = box()
    target = replace(model, vertices=factor * model.vertices)
    registrar, rng = Registrar(model), np.random.default_rng(SEED)
    check, extent = ModelCheck(registrar, model), model.extent
    arm, rate = extent * np.array([0.04, -0.02, 0.03]), np.array([0.07, 0.1, -0.05])
    for k in range(count):
        t, q = 0.5 * k, geometry.exp(rate * 0.5 * k)
        centre = extent * np.array([0.5 * acceleration * t**2, 0.001 * t, 3.0 - 0.002 * t])
        T_ac = Pose(q, centre - geometry.rotate(geometry.matrix(q), arm))
        points = T_ac.apply(view(target, 1500, T_ac.inverse().t))
        points = points * (1.0 + 0.0003 * rng.standard_normal((len(points), 1)))
        check.add(Scan(k, round(t * 1e9), points), registrar.register(points, T_ac))
    return check


def box() -> Surface:
    shape = trimesh.creation.box((2.0, 1.4, 1.0))
    return Surface(np.array(shape.vertices), np.array(shape.faces, dtype=np.int32), "box", "")


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.99, 1.01, 1.04])
def test_the_size_of_a_box_follows_from_its_free_motion(factor: float) -> None:
    """No scan shows it: three faces fit a box of any size."""
    check = tumbling_box(factor, 0.0)
    assert len(check.deltas) < LEAST_SCANS
    found = check.scale()
    assert found is not None
    assert found[0] == pytest.approx(factor, abs=max(4.0 * found[1], 0.1 * abs(factor - 1.0)))
    assert "multiply --model-scale by" in check.notes()[0]


@pytest.mark.slow
@pytest.mark.parametrize("acceleration", [0.0, 0.0002, 0.002])
def test_the_motion_of_a_box_of_the_right_size_says_nothing_of_it(acceleration: float) -> None:
    assert tumbling_box(1.0, acceleration).notes() == ()


def moving_scans(
    surface: Surface, duration_s: float, count: int, sigma: float = 0.001
) -> list[tuple[Scan, Pose]]:
    """Scans of a moving target every 0.5 s, point after point from left to right; the poses
    are those in the middle.
    """
    rng, found = np.random.default_rng(SEED), []
    rate, velocity = np.array([0.05, 0.08, -0.04]), np.array([0.004, -0.003, 0.002])
    for k in range(count):
        t = 0.5 * k
        T_ac = Pose(
            geometry.exp(rate * t), np.array([0.0, 0.0, 3.0 * surface.extent]) + velocity * t
        )
        points = T_ac.apply(view(surface, 2000, T_ac.inverse().t))
        points = points[np.argsort(points[:, 0])]
        places = np.arange(len(points)) / len(points)
        moved = np.cross(rate, points - T_ac.t) + velocity
        points = (
            points
            + duration_s * (places - 0.5)[:, None] * moved
            + sigma * rng.standard_normal(points.shape)
        )
        found.append((Scan(k, round(t * 1e9), points, places=places.astype(np.float32)), T_ac))
    return found


@pytest.mark.parametrize("duration_s", [0.3, -0.2])
def test_points_that_are_measured_one_after_the_other_are_noticed(duration_s: float) -> None:
    model = boxes()
    registrar = Registrar(model)
    check, timed = ModelCheck(registrar, model), ModelCheck(registrar, model)
    for scan, T_ac in moving_scans(model, duration_s, 34):
        found = registrar.register(scan.points, T_ac)
        check.add(scan, found)
        timed.add(replace(scan, places=None, times_s=scan.places), found)
    result = check.durations.result(registrar.index)
    mean = result.duration_s
    assert mean == pytest.approx(duration_s, abs=max(4.0 * result.sigma_s, 0.01))
    assert [seen.period_s for seen, _ in check.durations.measured] == pytest.approx([0.5] * 17)
    assert f"--scan-duration {mean:.3g}" in " ".join(check.notes())
    assert "--scan-duration" not in " ".join(timed.notes())


def test_points_with_times_give_the_size_at_the_instant_of_their_scan() -> None:
    model, duration_s = boxes(), 0.4
    registrar = Registrar(model)
    timed, skewed = ModelCheck(registrar, model), ModelCheck(registrar, model)
    for (scan, T_ac), (apart, _) in zip(
        moving_scans(model, 0.0, 30), moving_scans(model, duration_s, 30), strict=True
    ):
        found = registrar.register(scan.points, T_ac)
        times = (duration_s * (apart.places - 0.5)).astype(np.float32)
        timed.add(replace(apart, places=None, times_s=times), found)
        skewed.add(replace(apart, places=None), found)
    assert len(timed.deltas) == len(skewed.deltas) - 1  # the first scan has no motion yet
    assert np.abs(timed.deltas).max() < 3e-4
    assert np.abs(skewed.deltas).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factor", "duration_s", "sigma"),
    [
        (1.02, 0.0, 0.001),
        (0.98, 0.0, 0.001),
        (1.0, 0.0, 0.02),
        (1.02, 0.3, 0.001),
        (0.98, -0.3, 0.001),
    ],
)
def test_an_error_of_size_and_noise_are_not_taken_for_a_duration(
    factor: float, duration_s: float, sigma: float
) -> None:
    model = boxes()
    registrar = Registrar(model)
    check = ModelCheck(registrar, model)
    target = replace(model, vertices=factor * model.vertices)
    for scan, T_ac in moving_scans(target, duration_s, 60, sigma):
        check.add(scan, registrar.register(scan.points, T_ac))
    assert len(check.durations.measured) >= 8
    notes = check.notes()
    assert sum("--model-scale" in note for note in notes) == (factor != 1.0)
    assert sum("--scan-duration" in note for note in notes) == (duration_s != 0.0)
    if duration_s:
        result = check.durations.result(registrar.index)
        assert result.duration_s == pytest.approx(duration_s, abs=max(4.0 * result.sigma_s, 0.03))
        assert result.size == pytest.approx(factor, abs=max(4.0 * result.size_1s, 0.002))


def test_points_of_one_instant_raise_no_note_though_the_target_moves() -> None:
    model = boxes()
    registrar = Registrar(model)
    check = ModelCheck(registrar, model)
    for scan, T_ac in moving_scans(model, 0.0, 20):
        check.add(scan, registrar.register(scan.points, T_ac))
    assert len(check.durations.measured) >= 8
    assert check.notes() == ()


def test_few_scans_say_nothing_of_the_size() -> None:
    check = checked(boxes(), boxes(), count=4)
    assert check.scale() is None
    assert check.notes() == ()


def test_poses_that_did_not_converge_on_the_model_say_nothing_of_its_shape() -> None:
    """The limit of iterations ends the registration with nearly all points on the model."""
    model = boxes()
    registrar = Registrar(model, RegisterParams(n_max=1))
    check = ModelCheck(registrar, model)
    for points, T_ac in scans(model, 3):
        start = Pose(T_ac.q, T_ac.t + 0.003 * model.extent)
        check.add(Scan(0, 0, points), registrar.register(points, start))
    assert check.notes() == ()


@pytest.mark.slow
@pytest.mark.slow
def test_a_mirrored_model_and_another_object_are_told_apart() -> None:
    model = boxes()
    mirrored = replace(
        model, vertices=model.vertices * [-1.0, 1.0, 1.0], faces=model.faces[:, ::-1]
    )
    sphere = np.random.default_rng(SEED).standard_normal((3000, 3)) + np.array([0.0, 0.0, 20.0])
    for points, word in ((scans(mirrored, 1)[0][0], "mirror image"), (sphere, "right model")):
        registrar = Registrar(model)
        check = ModelCheck(registrar, model)
        check.add(Scan(0, 0, points), registrar.acquire(points))
        assert word in check.notes()[0]


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.6, 0.8, 1.3])
def test_a_model_of_another_size_is_not_called_mirrored(factor: float) -> None:
    model = boxes()
    wrong = replace(model, vertices=factor * model.vertices)
    registrar = Registrar(wrong)
    check = ModelCheck(registrar, wrong)
    for points, _ in scans(model, 3):
        check.add(Scan(0, 0, points), registrar.acquire(points))
    note = check.notes()[0]
    assert "mirror" not in note
    corners = wrong.vertices - wrong.vertices[:, None]
    assert f"the model {np.linalg.norm(corners, axis=2).max():.3g} m" in note


@pytest.mark.parametrize("factor", [39.37, 100.0, 1000.0])
def test_a_model_in_another_unit_accepts_no_scan(factor: float) -> None:
    """The scan is as small as the rejection distance, which follows the size of the model."""
    model = boxes()
    registrar = Registrar(replace(model, vertices=factor * model.vertices))
    points, T_ac = scans(model, 1)[0]
    for found in (registrar.register(points, T_ac), registrar.acquire(points)):
        assert found.status is AlignStatus.IMPLAUSIBLE
        assert "--model-unit" in found.message
