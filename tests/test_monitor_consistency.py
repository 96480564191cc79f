"""Chi-square bands that contain a consistent filter and not an inconsistent one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, norm

from avsreplay.monitor.convergence import (
    Consistency,
    ConsistencyParams,
    ConsistencyTrack,
    mean_band,
    violations,
)
from avsreplay.records import Belief, Innovation, State

STRICT = ConsistencyParams(slack=1.0)


def watch(alphas: np.ndarray, S: np.ndarray, params: ConsistencyParams = STRICT, gammas=None):
    watcher = Consistency(params)
    track = watcher.initial()
    for k, alpha in enumerate(alphas):
        nis = float(alpha @ np.linalg.solve(S, alpha))
        seen = Innovation(alpha, S, S, nis, nis, 0.0, 0.0)
        track = watcher.observe(track, seen, 1 if gammas is None else gammas[k])
    return watcher.judge(track)


def draws(seed: int, n: int = 60, factor: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.Generator(np.random.PCG64(seed))
    root = rng.normal(size=(6, 6)) * np.geomspace(1e-3, 1, 6)[:, None]
    return factor * rng.normal(size=(n, 6)) @ root.T, root @ root.T


def test_band_is_the_chi_square_of_the_sum() -> None:
    low, high = mean_band(6, 30, 0.99)
    assert (low, high) == pytest.approx(tuple(chi2.ppf([0.005, 0.995], 180) / 30))


def test_a_right_filter_stays_in_its_band() -> None:
    inside, white, half_width = 0, 0, norm.ppf(0.5 * (1.0 + STRICT.level)) / np.sqrt(6 * 59)
    for seed in range(200):
        verdict = watch(*draws(seed))
        inside += verdict.band[0] < verdict.nis_mean < verdict.band[1]
        white += abs(verdict.autocorrelation) < half_width
        assert verdict.consistent or verdict.nis_mean > verdict.band[1]
    assert inside >= 198
    assert white >= 198


def test_an_over_confident_filter_is_detected_and_a_conservative_one_is_accepted() -> None:
    assert not any(watch(*draws(seed, factor=1.6)).consistent for seed in range(50))
    cautious = watch(*draws(0, factor=0.5))
    assert cautious.consistent
    assert cautious.nis_mean < cautious.band[0]


def test_a_small_error_that_all_innovations_share_is_inconsistent() -> None:
    """0.8 standard deviations along one axis: the mean NIS is 6.6, inside its band, the sum
    of 50 is 5.7 of its own.
    """
    shifted, held = 0, 0
    for seed in range(40):
        alphas, S = draws(seed)
        off = 0.8 * np.linalg.cholesky(S)[:, 0]
        verdict = watch(alphas + off, S)
        shifted += verdict.nis_mean < verdict.band[1] and not verdict.consistent
        held += bool(watch(alphas, S).consistent)
    assert shifted >= 20
    assert held == 40


def test_errors_common_to_near_views_shift_the_innovations_without_an_error_of_the_estimate() -> (
    None
):
    wrong, allowed, n, share = 0, 0, 50, 0.1
    for seed in range(40):
        alphas, S = draws(seed, n=n + 1)
        alphas = np.sqrt(1.0 - share) * alphas[1:] + np.sqrt(share) * alphas[0]
        track = ConsistencyTrack(np.linalg.solve(np.linalg.cholesky(S), alphas.T).T, share)
        wrong += Consistency(STRICT).judge(track, 0.0).consistent is False
        allowed += Consistency(STRICT).judge(track).consistent is not False
    assert wrong > 5
    assert allowed >= 39


def test_correlated_innovations_are_seen() -> None:
    white, S = draws(1)
    red = white.copy()
    for k in range(1, len(red)):
        red[k] = 0.8 * red[k - 1] + 0.6 * white[k]
    assert watch(red, S).autocorrelation > 0.5
    assert abs(watch(white, S).autocorrelation) < 0.3


def test_the_test_needs_enough_healthy_scans() -> None:
    alphas, S = draws(2, n=20)
    assert watch(alphas[:14], S).consistent is None
    assert watch(alphas, S, gammas=[0] * 20).consistent is None
    assert watch(alphas[:15], S).consistent is True


def test_params_refuse() -> None:
    with pytest.raises(ValueError, match="window"):
        ConsistencyParams(window=5, least=9)
    with pytest.raises(ValueError, match="slack"):
        ConsistencyParams(slack=0.5)


def belief_of(P: np.ndarray, sigma: tuple[float, float] = (0.1, 0.2)) -> Belief:
    return Belief(
        0, State([0, 0, 0, 1.0], *[np.zeros(3)] * 3, sigma, np.zeros(3), [0, 0, 0, 1.0]), P
    )


def test_each_check_of_the_estimate_fails_where_it_should() -> None:
    R, good, none = 1e-4 * np.eye(6), 1e-4 * np.eye(20), np.ones(2)
    pose = 0.5 * R
    assert violations(belief_of(good), True, pose, np.zeros(6), R, none, 27.86) == ()
    assert violations(belief_of(good), False, pose, np.zeros(6), R, none, 27.86) == ("covariance",)
    assert violations(belief_of(good, (1.2, 0.0)), True, pose, np.zeros(6), R, none, 27.86) == (
        "sigma",
    )
    assert violations(belief_of(good), True, 1.3 * R, np.zeros(6), R, none, 27.86) == (
        "worse_than_measured",
    )
    assert violations(belief_of(good), True, 1.3 * R, np.zeros(6), R, 2.0 * none, 27.86) == ()
    assert violations(belief_of(good), True, pose, np.full(6, 0.1), R, none, 27.86) == (
        "outside_gate",
    )
