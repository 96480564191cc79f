"""Size of the target from one scan: reported if it is wrong, not if noise or another error
has a similar effect.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from oracles.residuals import summed

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import AlignStatus, Surface
from avsreplay.register import size as size_module
from avsreplay.register.contract import boxes, view
from avsreplay.register.covariance import patch_size
from avsreplay.register.registrar import Registrar
from avsreplay.register.size import SizeError, fitted_size, noise_bias, normal_jacobian
from avsreplay.register.surface_index import SurfaceIndex
from avsreplay.simulate.target import builtin_surface


def scan_of(surface: Surface, seed: int, noise: float, count: int = 3000) -> tuple[Array, Pose]:
    """A view from a random side at three extents, noise in units of the extent along the ray;
    and T_ac.
    """
    rng = np.random.default_rng(seed)
    q = rng.standard_normal(4)
    T_ac = Pose(q / np.linalg.norm(q), np.array([0.0, 0.0, 3.0 * surface.extent]))
    points = T_ac.apply(view(surface, count, T_ac.inverse().t))
    ranges = np.linalg.norm(points, axis=1, keepdims=True)
    return points * (
        1.0 + noise * surface.extent * rng.standard_normal(ranges.shape) / ranges
    ), T_ac


def remarks(model: Surface, measured: Surface, noise: float, seeds: range) -> list[str]:
    """Messages of the accepted scans."""
    registrar = Registrar(model)
    found = (registrar.register(*scan_of(measured, seed, noise)) for seed in seeds)
    return [each.message for each in found if each.status is AlignStatus.ALIGNED]


def fits(model: Surface, noise: float, seeds: range) -> list[tuple[SizeError, float]]:
    """Fit of the size and the bias of the noise, at the true pose."""
    index, out = SurfaceIndex.build(model, 0.15 * model.extent), []
    for seed in seeds:
        points, T_ac = scan_of(model, seed, noise)
        p, camera_c = T_ac.inverse().apply(points[::4]), T_ac.inverse().t
        found = fitted_size(index, p, camera_c)
        assert found is not None
        out.append((found, noise_bias(index, p, camera_c)))
    return out


@pytest.mark.parametrize("known", [True, False])
def test_the_step_of_the_extension_is_that_of_the_rows(known: bool) -> None:
    model = boxes()
    index = SurfaceIndex.build(model, 0.15 * model.extent)
    points, T_ac = scan_of(model, 4, 0.002)
    p, camera_c = 1.02 * T_ac.inverse().apply(points[::4]), T_ac.inverse().t if known else None
    rows, d, centre = size_module.least_squares(index, p, camera_c)
    rule = (
        size_module.USED_OF_EXTENT * index.extent_m,
        size_module.LEAST_RESIDUALS,
        size_module.NORMAL_QUANTILE,
        size_module.CAUCHY,
        size_module.LEAST_INFORMATION,
    )
    delta, of_pose, about = index.size_step(p, camera_c, *rule)
    assert delta == pytest.approx(rows.delta, abs=1e-12)
    np.testing.assert_allclose(of_pose, d, atol=1e-11)
    np.testing.assert_allclose(about, centre, atol=1e-11)
    assert abs(delta) > 0.01
    far = p + 10.0 * model.extent
    assert (
        index.size_step(far, camera_c, *rule)
        is size_module.least_squares(index, far, camera_c)
        is None
    )


def test_faces_in_coordinate_planes_do_not_enlarge_the_standard_error() -> None:
    """Patches of the measured points would divide such a face by the sign of its noise."""
    model, sigmas = boxes(), []
    for shift in (
        (1.0, 0.8, 1.2),
        (0.13, 0.21, 0.37),
    ):  # three faces of the largest box are in coordinate planes, or none
        moved = replace(model, vertices=model.vertices + np.array(shift))
        sigmas.append(np.array([found.sigma for found, _ in fits(moved, 0.0005, range(20))]))
    assert np.median(sigmas[0] / sigmas[1]) < 1.15


def test_patch_sums_give_the_size_of_least_squares_over_points() -> None:
    """Every patch a point: the fit is exact, and the standard error the cluster-robust one."""
    rng = np.random.default_rng(5)
    p, n = rng.uniform(-1.0, 1.0, (400, 3)), rng.standard_normal((400, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    J = normal_jacobian(p, n)
    a = np.einsum("ij,ij->i", n, p - p.mean(axis=0))
    e = 0.03 * a + J @ rng.normal(0.0, 0.01, 6) + rng.normal(0.0, 0.005, 400)
    found = summed(J, e, np.arange(400), p=p)
    delta, sigma = patch_size(found, 4.0, 0.2)
    X = np.column_stack([J, a])
    fit = np.linalg.lstsq(X, e, rcond=None)[0]
    free = a - J @ np.linalg.lstsq(J, a, rcond=None)[0]
    left = (e - X @ fit) / (1.0 - free**2 / (free @ free))
    assert delta == pytest.approx(fit[6], rel=1e-9)
    assert sigma == pytest.approx(np.sqrt(np.sum((free * left) ** 2)) / (free @ free), rel=1e-9)


@pytest.mark.parametrize("noise", [0.008, 0.015])
def test_noise_is_not_called_an_error_of_size(noise: float) -> None:
    """Thin panels appear thicker: the bias is up to four standard errors, and is subtracted."""
    assert not any(remarks(builtin_surface(), builtin_surface(), noise, range(8, 20)))


@pytest.mark.parametrize("factor", [0.95, 1.02, 1.05])
def test_another_size_is_always_said(factor: float) -> None:
    model = boxes()
    found = remarks(model, replace(model, vertices=factor * model.vertices), 0.002, range(8))
    assert len(found) >= 6
    for message in found:
        percent = 100.0 * (factor - 1.0)
        assert message.endswith(f"% {'larger' if factor > 1.0 else 'smaller'} than the model")
        assert float(message.split()[5]) == pytest.approx(abs(percent), abs=0.6)


def test_standard_error_of_the_size_is_right() -> None:
    """The errors over many views, without the bias, in units of the standard error."""
    z = [(found.delta - bias) / found.sigma for found, bias in fits(boxes(), 0.004, range(60))]
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.6


def test_the_bias_of_noise_is_that_of_repeated_scans() -> None:
    model = builtin_surface()
    both = [(found.delta, bias, found.sigma) for found, bias in fits(model, 0.008, range(24))]
    delta, bias, sigma = np.array(both).T
    assert delta.mean() > 4.0 * sigma.mean() / np.sqrt(len(both))  # there is a bias
    assert abs(np.mean(delta - bias)) < 0.4 * delta.mean()


def test_an_error_of_aspect_is_not_called_an_error_of_size() -> None:
    """Along one axis alone: the sign of the isotropic fit depends on the view, and its
    standard error includes that.
    """
    model = boxes()
    stretched = replace(model, vertices=model.vertices * [1.0, 1.0, 1.012])
    assert not any(remarks(model, stretched, 0.002, range(8)))


@pytest.mark.slow
def test_three_faces_of_a_box_tell_no_size() -> None:
    """Points on three planes fit a box of any size; only a face behind the others would tell."""
    planes = [np.random.default_rng(k).uniform(0.1, 0.9, (200, 2)) for k in range(3)]
    corner = np.vstack([np.insert(plane, k, 1.0, axis=1) for k, plane in enumerate(planes)])
    vertices = np.array(
        [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64
    )
    index = SurfaceIndex.build(Surface(vertices, cube_faces(), "cube", ""), 0.3)
    assert fitted_size(index, 1.03 * corner - 0.03, np.array([5.0, 5.0, 5.0])) is None


def cube_faces() -> np.ndarray:
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], dtype=np.int32)


@pytest.mark.slow
def test_three_faces_of_a_box_do_not_show_its_size_and_the_row_says_so():
    shape = trimesh.creation.box((2.0, 1.0, 0.6))
    box = Surface(np.array(shape.vertices), np.array(shape.faces, dtype=np.int32), "box", "")
    said = remarks(box, box, 0.002, range(3))
    assert said
    assert all("does not show an error of the size" in each for each in said)
    assert not any(remarks(boxes(), boxes(), 0.002, range(3)))


@pytest.mark.slow
def test_a_box_larger_than_the_model_continues_beyond_its_edges():
    shape = trimesh.creation.box((2.0, 1.0, 0.6))
    box = Surface(np.array(shape.vertices), np.array(shape.faces, dtype=np.int32), "box", "")
    larger, registrar = replace(box, vertices=1.05 * box.vertices), Registrar(box)
    for seed in range(3):
        found = registrar.register(*scan_of(larger, seed, 0.002))
        assert found.status is not AlignStatus.ALIGNED
        assert "continues beyond the edges" in found.message


def test_a_step_of_size_and_pose_is_a_motion_and_then_a_scaling_about_its_centre() -> None:
    """Points p of a target 1 + delta times as large are p / (1 + delta) in the model's size."""
    rng = np.random.default_rng(8)
    for _ in range(20):
        p, centre, d = rng.normal(size=(9, 3)), rng.normal(size=3), 0.1 * rng.normal(size=6)
        delta, step = 0.1 * rng.normal(size=2)
        q = rng.normal(size=4)
        moved = Pose(q / np.linalg.norm(q), rng.normal(size=3))
        before = moved.apply(p) / (1.0 + delta)
        larger, after = size_module.joined(delta, moved, step, d, centre)
        turn = geometry.matrix(geometry.exp(-d[:3]))
        there = (before - centre) @ turn.T - d[3:]
        np.testing.assert_allclose(
            after.apply(p) / (1.0 + larger), centre + there / (1.0 + step), atol=1e-12
        )
        assert 1.0 + larger == pytest.approx((1.0 + delta) * (1.0 + step))
