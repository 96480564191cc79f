"""The Gramian's fold against its sum, ranks that can be known by hand, and words for what is not seen."""

from __future__ import annotations

import numpy as np
import pytest

from avsreplay.monitor.observability import gramian, measure, observe, weakest


def chain(seed: int, n: int = 6, steps: int = 9):
    rng = np.random.Generator(np.random.PCG64(seed))
    return [(np.eye(n) + 0.3 * rng.normal(size=(n, n)), rng.normal(size=(2, n))) for _ in range(steps)]


def test_the_fold_is_the_sum() -> None:
    """W = sum Phi_j0' H' H Phi_j0 with the newest factor on the left."""
    state, Phi_k0, W = gramian(np.ones(6)), np.eye(6), np.zeros((6, 6))
    for Phi, H in chain(0):
        state = observe(state, Phi, H, 1)
        Phi_k0 = Phi @ Phi_k0
        W += Phi_k0.T @ H.T @ H @ Phi_k0
    assert np.abs(state.root.T @ state.root - W).max() < 1e-10 * np.abs(W).max()
    assert measure(state).log10_cond == pytest.approx(np.log10(np.linalg.cond(W)), abs=1e-6)
    D = np.diag(np.geomspace(1.0, 1e-3, 6))
    scaled = measure(type(state)(state.root, state.Phi_k0, np.diag(D)))
    assert scaled.log10_cond_scaled == pytest.approx(np.log10(np.linalg.cond(D @ W @ D)), abs=1e-5)


def test_scale_takes_the_units_away() -> None:
    """Millimetres instead of metres in half of the states change the raw condition and not the scaled one."""
    units = np.array([1.0, 1.0, 1.0, 1e3, 1e3, 1e3])
    plain, scaled = gramian(np.ones(6)), gramian(units)
    for Phi, H in chain(1):
        plain = observe(plain, Phi, H, 1)
        scaled = observe(scaled, Phi * units[:, None] / units, H / units, 1)
    assert measure(scaled).log10_cond_scaled == pytest.approx(measure(plain).log10_cond_scaled, abs=1e-8)
    assert measure(scaled).log10_cond > measure(plain).log10_cond + 3


def test_rank_grows_scan_by_scan_and_no_condition_is_said_below_full_rank() -> None:
    state, ranks = gramian(np.ones(6)), []
    for Phi, H in chain(2)[:4]:
        state = observe(state, Phi, H, 1)
        found = measure(state)
        ranks.append(found.rank)
        assert (found.log10_cond is None) == (found.rank < 6)
        assert (found.log10_cond_scaled is None) == (found.rank < 6)
    assert ranks == [2, 4, 6, 6]
    assert measure(gramian(np.ones(6))).rank == 0


def test_a_faulty_scan_moves_time_but_adds_nothing() -> None:
    (Phi, H), (Phi2, H2) = chain(3)[:2]
    state = observe(observe(gramian(np.ones(6)), Phi, H, 0), Phi2, H2, 1)
    W = (H2 @ Phi2 @ Phi).T @ (H2 @ Phi2 @ Phi)
    assert np.abs(state.root.T @ state.root - W).max() < 1e-12


def test_a_condition_beyond_double_precision_is_still_told() -> None:
    """10^24 in W: its root holds it, a summed W would not."""
    H = np.diag([1.0, 1e-6])
    state = observe(gramian(np.ones(2)), np.eye(2), H, 1)
    state = observe(state, np.eye(2), np.array([[1.0, 1e-6]]), 1)
    assert measure(state).log10_cond == pytest.approx(12.0, abs=0.3)
    deep = observe(gramian(np.array([1.0, 1.0])), np.eye(2), np.diag([1.0, 1e-10]), 1)
    assert measure(deep).log10_cond == pytest.approx(20.0, abs=1e-6)


def test_weakest_direction_in_words() -> None:
    H = np.eye(20)
    H[14, 14] = 1e-4  # one direction of varrho
    state = observe(gramian(np.ones(20)), np.eye(20), H, 1)
    assert weakest(state, 1) == ("fixture position in the body (100%)",)
    H[14, 14], H[0, 0], H[17, 17] = 1.0, 1e-3, 1e-3
    H[0, 17] = H[17, 0] = 0.0
    twins = observe(gramian(np.ones(20)), np.eye(20), H, 1)
    assert all("attitude" in w or "misalignment" in w for w in weakest(twins, 2))


def test_prior_must_be_positive() -> None:
    with pytest.raises(ValueError, match="positive"):
        gramian(np.zeros(3))
