"""Covariance and observable directions of a registered pose from the patches of the model."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles import covariance as oracle_of
from oracles.covariance import difference_covariance
from oracles.residuals import summed
from scipy.stats import chi2, f

from avsreplay import geometry
from avsreplay.register.covariance import (
    Evidence,
    registration_covariance,
    sandwich_covariance,
    split_nis,
    systematic_errors,
    without_dominant_patches,
)
from avsreplay.register.degenerate import unbounded_directions
from avsreplay.register.registrar import Registrar
from avsreplay.simulate.target import builtin_surface

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
import registration_noise
import scenes


@pytest.mark.parametrize("patches", [5, 8, 9, 30, 122])
def test_the_sandwich_of_any_number_of_patches_is_that_of_their_eigenvalues(patches: int) -> None:
    """Patches with little and with much leverage in any order: four of them are computed
    together.
    """
    rng = np.random.default_rng(patches)
    for _ in range(20):
        J = rng.normal(size=(patches, 5, 6)) * 10.0 ** rng.uniform(-1.0, 0.5, (patches, 1, 1))
        normals, gradients = np.einsum("mki,mkj->mij", J, J), rng.normal(size=(patches, 6))
        P, dof = sandwich_covariance(normals, gradients)
        expected, expected_dof = oracle_of.sandwich_covariance(normals, gradients)
        np.testing.assert_allclose(P, expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())
        assert dof == pytest.approx(expected_dof, rel=1e-6)


def test_covariance_of_an_ideal_plane_fit_is_the_textbook_one() -> None:
    """White noise across the surface: the sandwich must agree with s^2 (J'J)^-1."""
    rng = np.random.default_rng(11)
    J = rng.normal(size=(20000, 6))
    e = rng.normal(0.0, 0.3, 20000)
    P = _sandwich(summed(J, e, np.arange(20000)))
    oracle = 0.09 * np.linalg.inv(J.T @ J)
    np.testing.assert_allclose(P, oracle, atol=0.1 * oracle[0, 0])


PATCH = np.arange(600) // 20


def _sandwich(found: Evidence) -> np.ndarray:
    return sandwich_covariance(found.normals, found.gradients)[0]


def _rows(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(600, 6)), rng.normal(0.0, 0.3, 600)


@pytest.mark.parametrize("count", [600, 30, 12])
def test_covariance_is_right_in_the_mean_for_independent_noise(count: int) -> None:
    """Of patches of unequal size, the largest with a third of the points; the delete-one
    jackknife claims too much.
    """
    rng, total = np.random.default_rng(3), np.zeros((6, 6))
    J = rng.normal(size=(600, 6))
    patch = np.sort(np.minimum(rng.integers(0, int(1.5 * count), 600), count - 1))
    exact = 0.09 * np.linalg.inv(J.T @ J)
    for _ in range(300):
        e = rng.normal(0.0, 0.3, 600)
        total += _sandwich(summed(J, e - J @ np.linalg.lstsq(J, e, rcond=None)[0], patch)) / 300
    assert np.trace(np.linalg.solve(exact, total)) / 6.0 == pytest.approx(1.0, abs=0.05)
    assert np.all(np.abs(np.diag(np.linalg.solve(exact, total)) - 1.0) < 0.1)


def _normalised_errors(per_patch: float) -> np.ndarray:
    """Squared errors of 400 fits over their covariance; noise of unit variance, ``per_patch``
    of it in common.
    """
    rng, values = np.random.default_rng(12), []
    for _ in range(400):
        J = rng.normal(size=(600, 6)) + 0.7 * rng.normal(size=(30, 6))[PATCH]
        noise = (
            np.sqrt(1.0 - per_patch) * rng.normal(size=600)
            + np.sqrt(per_patch) * rng.normal(size=30)[PATCH]
        )
        d = np.linalg.lstsq(J, noise, rcond=None)[0]
        values.append(d @ np.linalg.solve(_sandwich(summed(J, noise - J @ d, PATCH)), d))
    return np.array(values)


@pytest.mark.parametrize("per_patch", [0.0, 0.3])
def test_few_patches_do_not_make_the_covariance_too_small_in_some_direction(
    per_patch: float,
) -> None:
    """Thirty patches do not determine 21 variances: without shrinkage the 99 % point is that
    of Hotelling's T^2, 28.
    """
    values = _normalised_errors(per_patch)
    assert 0.85 < values.mean() / 6.0 < 1.15
    assert (
        np.quantile(values, 0.99) < 1.3 * 16.8
    )  # 99 % point of chi-square with 6 degrees of freedom


def test_a_motion_that_one_patch_alone_determines_is_not_counted() -> None:
    """Nothing but patch 7 sees the last motion: it is left out, and the motion is free;
    without it nothing is lone.
    """
    J, e = _rows(4)
    found = summed(J, e, PATCH)
    assert without_dominant_patches(found) is found
    J[PATCH != 7, 5] = 0.0
    left = without_dominant_patches(summed(J, e, PATCH))
    assert left.counts.sum() == 580
    assert np.all(left.normals[:, 5] == 0.0)
    assert len(left.normals) == len(left.gradients) == 29


def test_patches_are_left_out_until_none_determines_a_motion_alone() -> None:
    """Patch 7 holds the last motion, 8 what is left of it without 7, 9 the rest: all three
    go, one after the other.
    """
    J, e = _rows(4)
    for patch in range(30):
        J[patch == PATCH, 5] *= {7: 1.0, 8: 1e-2, 9: 1e-4}.get(patch, 0.0)
    left = without_dominant_patches(summed(J, e, PATCH))
    assert np.all(left.normals[:, 5] == 0.0)
    assert left.counts.sum() == 540


def test_a_motion_known_no_better_than_the_targets_size_is_loose() -> None:
    P = np.diag([1e-8, 1e-8, 4.0, 1e-8, 1e12, 1e-8])
    words, motions = unbounded_directions(P, 3.0)
    assert words == ("turns about z", "slides along y")
    assert np.abs(motions[[2, 4]]).max(axis=1) == pytest.approx([1.0, 3.0])
    assert np.count_nonzero(np.abs(motions) > 1e-9) == 2
    assert unbounded_directions(P, 3e6)[0] == ("turns about z",)
    assert unbounded_directions(np.eye(6) * 1e-6, 3.0)[0] == ()


def _ellipsoid(rng: np.random.Generator, count: int = 6000) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of the near side of an ellipsoid with bumps, about 2 m across."""
    u = rng.normal(size=(count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    u[:, 2] = np.abs(u[:, 2])
    axes = np.array([1.0, 0.7, 0.5])
    p, n = u * axes, u / axes
    n = n / np.linalg.norm(n, axis=1, keepdims=True) + 0.4 * np.sin(5.0 * p[:, [1, 2, 0]])
    return p, n / np.linalg.norm(n, axis=1, keepdims=True)


CAMERA = np.array([0.5, -0.3, 5.0])


def _scan(
    rng: np.random.Generator, strain: float, noise: float = 0.003, ranges: float = 0.0
) -> Evidence:
    """Sums at the least-squares pose of a scan whose surface is strained at random."""
    return _moved_scan(rng, strain, noise, ranges)[0]


def _moved_scan(
    rng: np.random.Generator, strain: float, noise: float = 0.003, ranges: float = 0.0
) -> tuple[Evidence, np.ndarray]:
    """The same, with an error of the ranges that varies over the image, and the error (6,) of the
    pose that both cause.
    """
    p, n = _ellipsoid(rng)
    S = strain * rng.normal(size=(3, 3))
    e = np.sum(n * (p @ (S + S.T)), axis=1) + rng.normal(0.0, noise, len(p))
    waves, phase = rng.uniform(-3.0, 3.0, (5, 2)), rng.uniform(0.0, 2.0 * np.pi, 5)
    rays = p - CAMERA
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    along = np.cos(p[:, :2] @ waves.T + phase) @ rng.normal(size=5) * np.sqrt(2.0 / 5.0)
    e += ranges * along * np.sum(n * rays, axis=1)
    J = np.hstack([np.cross(p, n), n])
    d = np.linalg.lstsq(J, e, rcond=None)[0]
    patch = np.unique(np.floor(p / 0.1), axis=0, return_inverse=True)[1].reshape(-1)
    return replace(summed(J, e - J @ d, patch, p=p), camera_c=CAMERA), d


def _nis(strain: float) -> tuple[float, float, float]:
    """Mean over scans of the squared difference of halves over 6, and shares of it with the
    sandwich alone.
    """
    rng, values, bare, sigma = np.random.default_rng(5), [], [], []
    for _ in range(25):
        found = _scan(rng, strain)
        errors = systematic_errors(found, 2.0, 0.1)
        none = replace(
            errors, block_m2=0.0, smooth_m2=np.zeros(17), amplitudes=np.zeros(17), fit=np.zeros(6)
        )
        values.append(split_nis(found, errors, np.eye(3)[:1]))
        bare.append(split_nis(found, none, np.eye(3)[:1]))
        sandwich, _ = sandwich_covariance(found.normals, found.gradients)
        sigma.append(np.trace(registration_covariance(found, errors)[0]) / np.trace(sandwich))
    return float(np.mean(values)) / 6.0, float(np.mean(bare)) / 6.0, float(np.median(sigma))


def test_halves_of_a_strained_target_differ_as_the_covariance_says() -> None:
    """The sandwich over patches takes the strain for independent errors of patches and claims too
    little.
    """
    nis, bare, sigma = _nis(0.004)
    assert 0.6 < nis < 1.6
    assert bare > 2.5
    assert sigma > 2.0


def test_white_noise_adds_little_to_the_sandwich() -> None:
    nis, bare, sigma = _nis(0.0)
    assert 0.6 < nis < 1.3
    assert 0.6 < bare < 1.4
    assert 0.8 < sigma < 1.3


def test_halves_that_disagree_beyond_all_errors_have_a_large_nis() -> None:
    """One half of the scan is displaced as a whole, as a body with a joint is, and the covariance
    does not cover it.
    """
    found = _scan(np.random.default_rng(8), 0.0)
    moved = np.where(found.places[:, 0] < 0.0, 0.02, -0.02)
    gradients = found.gradients + moved[:, None] * found.normals[:, :, 5]
    errors = systematic_errors(found, 2.0, 0.1)
    assert split_nis(replace(found, gradients=gradients), errors, np.eye(3)[:1]) > 60.0
    assert split_nis(found, errors, np.eye(3)[:1]) < 60.0
    assert split_nis(found.only(found.places[:, 0] < -0.93), errors, np.eye(3)[:1]) is None


def test_an_error_of_the_ranges_that_varies_over_the_image_is_in_the_covariance() -> None:
    """Without the position of the camera it is not known, and the covariance is too small."""
    squared = []
    for seed in range(25):
        found, d = _moved_scan(np.random.default_rng(seed), 0.0, ranges=0.003)
        each = (found, replace(found, camera_c=None))
        P = [registration_covariance(f, systematic_errors(f, 2.0, 0.1))[0] for f in each]
        squared.append([d @ np.linalg.solve(C, d) / 6.0 for C in P])
    known, unknown = np.mean(squared, axis=0)
    assert 0.5 < known < 2.0
    assert unknown > 4.0


@pytest.mark.slow
def test_claims_hold_for_scans_whose_ranges_err_as_much_over_the_image_as_by_noise() -> None:
    """Faces in few directions: an error of the ranges must not pass for noise in them."""
    surface = builtin_surface()
    registrar, squared = Registrar(surface), []
    for seed in range(273, 1473, 100):
        v = scenes.view(surface, 4000, seed)
        points = v.points + scenes.NOISE * surface.extent * registration_noise.waves(v)
        found = registrar.register(points, scenes.off(v, 0.5, 0.002))
        error = found.T_ac.inverse() @ v.T_ac
        d = np.concatenate([geometry.log(error.q), error.t])
        assert found.covariance is not None
        squared.append(d @ np.linalg.solve(found.covariance, d) / 6.0)
    assert 0.6 < np.mean(squared) < 2.0


@pytest.mark.parametrize("ranges", [0.0, 0.003])
@pytest.mark.parametrize("strain", [0.0, 0.004])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_covariance_and_test_of_halves_are_those_of_the_oracle(
    ranges: float, strain: float, seed: int
) -> None:
    """The sums in C++ against the same formulas in numpy."""
    found = _scan(np.random.default_rng(seed), strain, ranges=ranges)
    if seed == 3:  # a view of a narrow part, where not every amplitude is observable
        found = found.only(found.places[:, 2] > 0.35)
    errors, oracle = (
        systematic_errors(found, 2.0, 0.1),
        oracle_of.systematic_errors(found, 2.0, 0.1),
    )
    for name in ("block_m2", "smooth_m2", "amplitudes", "fit"):
        np.testing.assert_allclose(
            getattr(errors, name), getattr(oracle, name), rtol=1e-7, atol=1e-12
        )
    (P, dof), (Q, expected) = (
        registration_covariance(found, errors),
        oracle_of.registration_covariance(found, oracle),
    )
    np.testing.assert_allclose(P, Q, rtol=1e-7, atol=1e-9 * np.abs(Q).max())
    assert dof == pytest.approx(expected, rel=1e-6)
    across = np.eye(3)[:2]
    np.testing.assert_allclose(
        split_nis(found, errors, across), oracle_of.split_nis(found, oracle, across), rtol=1e-7
    )


def test_parts_of_the_same_patches_have_only_their_own_errors() -> None:
    """What two random halves of the points have in common does not move them apart."""
    rng = np.random.default_rng(9)
    values = []
    for _ in range(20):
        p, n = _ellipsoid(rng)
        J = np.hstack([np.cross(p, n), n])
        e = 0.01 * p[:, 0] * n[:, 0] + rng.normal(0.0, 0.003, len(p))
        e = e - J @ np.linalg.lstsq(J, e, rcond=None)[0]
        patch = np.unique(np.floor(p / 0.1), axis=0, return_inverse=True)[1].reshape(-1)
        errors = systematic_errors(summed(J, e, patch, p=p), 2.0, 0.1)
        half = rng.random(len(p)) < 0.5
        parts = [
            summed(J[k], e[k], np.unique(patch[k], return_inverse=True)[1].reshape(-1), p=p[k])
            for k in (half, ~half)
        ]
        d = [np.linalg.lstsq(J[k], e[k], rcond=None)[0] for k in (half, ~half)]
        step = d[1] - d[0]
        values.append(step @ np.linalg.solve(difference_covariance(*parts, errors), step) / 6.0)
    assert 0.6 < np.mean(values) < 1.5


def test_degrees_of_freedom_give_the_gate_its_false_alarm_rate() -> None:
    """Hotelling's T^2 of 3,000 fits with errors common to a patch, whose size differs from patch to
    patch by half.

    Taken for chi-square, the squared error exceeds the 95 % and 99 % points too often.
    """
    rng, values, squares = np.random.default_rng(4), [], []
    for _ in range(3000):
        size = np.exp(0.5 * rng.normal(size=60))[:, None]
        J = rng.normal(size=(60, 6, 6)) + 5.0 * rng.normal(size=(60, 1, 6))
        e = size * (
            np.sqrt(0.1) * rng.normal(size=(60, 6)) + np.sqrt(0.9) * rng.normal(size=(60, 1))
        )
        d = np.linalg.lstsq(J.reshape(-1, 6), e.reshape(-1), rcond=None)[0]
        normals, gradients = np.einsum("pki,pkj->pij", J, J), np.einsum("pk,pki->pi", e - J @ d, J)
        P, dof = sandwich_covariance(normals, gradients)
        squares.append(d @ np.linalg.solve(P, d))
        values.append((squares[-1], dof))
    taken = [f.sf(square * (dof - 5.0) / (6.0 * dof), 6, dof - 5.0) for square, dof in values]
    for probability in (0.05, 0.01):
        spread = np.sqrt(probability / 3000)
        assert np.mean(np.array(taken) < probability) == pytest.approx(
            probability, abs=3.0 * spread
        )
        assert np.mean(np.array(squares) > chi2.isf(probability, 6)) > probability + 3.0 * spread
