"""Errors of single scans, and noise that rises without a larger claimed covariance:
``estimate/bad_scans.py``.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import estimate_surprises as surprises
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from avsreplay.estimate import bad_scans, noise
from avsreplay.estimate.scan_points import scan_points
from avsreplay.estimate.scan_window import PRIOR_ODDS, ChangePriors, Hypothesis, Window
from avsreplay.geometry import Pose
from avsreplay.records import Innovation

PRIORS, FIRST, SCANS = ChangePriors(0.01, 0.02, 0.2, 0.05), 2, 4


def window(seed: int, *errors: float) -> tuple[Window, np.ndarray]:
    """Scans whose innovations have any covariance, the doubtful ones larger by ``errors`` in
    position and in attitude; whitened innovations.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    A, n = 0.01 * rng.normal(size=(6 * SCANS, 6 * SCANS)), SCANS
    C = A @ A.T + 1e-4 * np.eye(6 * n)
    y = np.linalg.cholesky(C) @ rng.normal(size=6 * n)
    y[6 * FIRST :] *= np.tile(np.repeat(errors, 3), n - FIRST)
    whiten = np.linalg.inv(np.linalg.cholesky(C))
    R = tuple(np.diag(rng.uniform(0.5, 1.0, size=6)) * 1e-4 for _ in range(n))
    poses = tuple(Pose(np.array([0.0, 0.0, 0.0, 1.0]), rng.normal(size=3)) for _ in range(n))
    late = np.zeros((n + 1, 6 * n, 12))
    times, points = np.arange(1.0, n + 1.0), scan_points(R, FIRST)
    return Window(points, times, y, C, whiten, late, poses, R, (np.eye(3),) * n), whiten @ y


# of the pose, its position or its attitude; their errors are 2 to 10 times as large
PARTS = (slice(0, 6), slice(0, 3), slice(3, 6))


def log_density(y: np.ndarray, C: np.ndarray) -> float:
    """Without the constant that the estimator leaves out."""
    return float(multivariate_normal.logpdf(y, np.zeros(len(y)), C)) + 0.5 * len(y) * np.log(
        2.0 * np.pi
    )


@pytest.mark.parametrize("errors", [(4.0, 4.0), (4.0, 1.0), (1.0, 4.0)])
@pytest.mark.parametrize("seed", range(4))
def test_larger_noise_has_the_mean_of_the_densities_with_it(
    seed: int, errors: tuple[float, float]
) -> None:
    scans, white = window(seed, *errors)
    found = bad_scans.noisier(scans, white, FIRST)
    values = {}
    for part, rise in itertools.product(PARTS, np.logspace(np.log10(2.0), 1.0, 5)):
        factor, C = np.ones(6), scans.C.copy()
        factor[part] = rise
        for k in range(FIRST, SCANS):
            block, more = slice(6 * k, 6 * k + 6), np.sqrt(factor**2 - 1.0)
            C[block, block] += np.outer(more, more) * scans.R[k]
        values[tuple(factor)] = log_density(scans.y, C)
    logs = np.array(list(values.values()))
    assert found.log_evidence == pytest.approx(
        np.logaddexp.reduce(logs) - np.log(len(logs)) + PRIOR_ODDS, rel=1e-8
    )
    assert tuple(found.size) == max(values, key=values.__getitem__)
    assert found.hypothesis is Hypothesis.NOISIER


@pytest.mark.parametrize("seed", range(4))
def test_the_last_of_the_bad_scans_may_be_good(seed: int) -> None:
    scans, white = window(seed, 10.0, 10.0)
    found, logs = bad_scans.bad_scans(scans, white, PRIORS, FIRST), []
    for bad in (SCANS, SCANS - 1):
        for size, (columns, sigma) in itertools.product(
            (1.0, 0.1), (("range", 0.2), ("position", 0.2), ("pose", 0.2))
        ):
            C = scans.C.copy()
            for k in range(FIRST, bad):
                u = scans.poses[k].t / np.linalg.norm(scans.poses[k].t)
                one = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) * sigma**2
                if columns == "range":
                    one[:3, :3] = sigma**2 * np.outer(u, u)
                if columns == "pose":
                    one[3:, 3:] = 0.05**2 * np.eye(3)
                block = slice(6 * k, 6 * k + 6)
                C[block, block] += size**2 * one
            logs.append(log_density(scans.y, C) + (bad - FIRST) * np.log(1e-2))
    assert found.log_evidence == pytest.approx(
        np.logaddexp.reduce(logs) - np.log(len(logs)) + PRIOR_ODDS, rel=1e-8
    )


@pytest.mark.parametrize("factor", [3.0, 8.0])
def test_a_rise_lasts_while_the_noise_is_larger_and_ends_soon_after(factor: float) -> None:
    rng = np.random.Generator(np.random.PCG64(round(factor)))
    R = 1e-4 * np.diag(rng.uniform(0.5, 1.0, size=6))
    window, ended = noise.risen(noise.NoiseWindow.empty(), np.full(6, factor)), []
    for k in range(300):
        larger = R * factor**2
        alpha = np.sqrt(np.diag(larger if k < 290 else R)) * rng.normal(size=6)
        window = noise.lasting(window, Innovation(alpha, larger, larger, 6.0, 6.0, 0.0, 0.0))
        ended.append(window.rise is noise.NO_RISE)
    assert not any(ended[:290])
    assert ended.index(True) < 290 + 6


@pytest.mark.parametrize("level", [3.0, 6.0])
@pytest.mark.parametrize("seed", [31, pytest.param(32, marks=pytest.mark.slow)])
def test_noise_that_rises_unannounced_is_no_manoeuvre(
    monkeypatch: pytest.MonkeyPatch, level: float, seed: int
) -> None:
    """The poses keep the covariance that they claim: the scans are used with more noise after
    three of them at most.
    """
    simulated, sigma = surprises.measured, np.repeat([surprises.ROT_RAD, surprises.POS_M], 3)

    def measured(case: surprises.Case, times: list[float], states: list, seed: int) -> list:
        C = np.diag(sigma**2)
        return [
            replace(a, covariance=C, info=np.linalg.inv(C))
            for a in simulated(case, times, states, seed)
        ]

    monkeypatch.setattr(surprises, "measured", measured)
    case = surprises.Case("unannounced", at_s=30.0, until_s=40.0, noise=level, seconds=50.0)
    result = surprises.run(case, seed)
    assert result.track is not None
    assert result.track.manoeuvres == ()
    assert result.track.reinitialised == 0
    assert sum(not g for g in result.gamma) <= 4
    assert not any(
        c and q > surprises.LIMIT for c, q in zip(result.converged, result.pose, strict=True)
    )
    assert result.violations == []
