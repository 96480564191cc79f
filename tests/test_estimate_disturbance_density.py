"""The density that stands for all densities of a random disturbance, on linear motions drawn from
the model.
"""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
import pytest

from avsreplay.estimate.disturbance_density import (
    DENSITIES,
    Marginal,
    Residuals,
    divided,
    marginal,
    mean_square,
    posterior,
    probability_beside,
)

TIMES, SIGMA = np.arange(0.0, 40.0, 1.0), 0.002
MIDDLE, ROOT = 0.5 * (TIMES[1:] + TIMES[:-1]), np.sqrt(np.diff(TIMES))
LATE = np.maximum(TIMES[:, None] - MIDDLE, 0.0) * ROOT / SIGMA
EFFECTS = -np.kron(LATE, np.eye(3))
INITIAL = -np.kron(np.stack([np.ones_like(TIMES), TIMES], axis=1) / SIGMA, np.eye(3))
# the present velocity by the initial values and by the impulses
BY_INITIAL, BY_IMPULSES = np.kron([[0.0, 1.0]], np.eye(3)), np.kron(ROOT[None], np.eye(3))
INFO = np.diag(np.repeat([1.0, 10.0], 3))
V = np.eye(3 * len(TIMES))


def drawn(density: float, rng: np.random.Generator) -> tuple[Marginal, Residuals, np.ndarray]:
    """The likelihood of measured positions, their residuals about zero motion, and the true present
    velocity.
    """
    y, u = (
        rng.normal(size=6) / np.sqrt(np.diagonal(INFO)),
        density * rng.normal(size=3 * len(MIDDLE)),
    )
    e = -(INITIAL @ y + EFFECTS @ u) + rng.normal(size=len(V))
    data = Residuals(e, INITIAL, np.sqrt(INFO), np.zeros(6))
    return marginal(V, EFFECTS, data), data, BY_INITIAL @ y + BY_IMPULSES @ u


def velocity(data: Residuals, density: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the present velocity with this density, by the normal equations of all
    unknowns.
    """
    J = np.hstack([data.J, density * EFFECTS])
    info = np.zeros((J.shape[1], J.shape[1]))
    info[:6, :6], info[6:, 6:] = INFO, np.eye(J.shape[1] - 6)
    C = np.linalg.inv(J.T @ J + info)
    reach = np.hstack([BY_INITIAL, density * BY_IMPULSES])
    return -reach @ C @ J.T @ data.e, reach @ C @ reach.T


def nees(data: Residuals, density: float, truth: np.ndarray) -> float:
    mean, P = velocity(data, density)
    return float((mean - truth) @ np.linalg.solve(P, mean - truth)) / 3.0


def power_mean(found: Marginal) -> float:
    """The power 2/3 of the mean of q^1.5, to which the variance of a velocity that is long tracked
    is proportional.
    """
    return float(posterior(found, 0.5)[1:] @ DENSITIES**1.5) ** (2.0 / 3.0)


def test_a_velocity_is_claimed_right_in_the_mean_over_the_prior_of_the_density() -> None:
    rng, ours, powers = np.random.Generator(np.random.PCG64(3)), [], []
    for k in range(240):
        density = 0.0 if k % 2 else float(DENSITIES[rng.integers(len(DENSITIES))])
        found, data, truth = drawn(density, rng)
        ours.append(nees(data, np.sqrt(mean_square(found)), truth))
        powers.append(nees(data, power_mean(found), truth))
    assert 0.75 < np.mean(ours) < 1.2
    assert np.mean(ours) < 0.9 * np.mean(powers)


def test_the_density_in_use_is_zero_or_the_true_one_where_the_poses_determine_it() -> None:
    rng = np.random.Generator(np.random.PCG64(4))
    strong = drawn(1e-2, rng)[0]
    assert np.sqrt(mean_square(strong)) == pytest.approx(1e-2, rel=0.5)
    assert strong.likeliest[0] == pytest.approx(1e-2, rel=0.5)
    quiet = drawn(0.0, rng)[0]
    assert np.sqrt(mean_square(quiet)) < 1e-4
    assert quiet.excluded < 1e-2 < strong.excluded
    assert (quiet.log_odds[quiet.excluded <= DENSITIES] <= np.log(0.01)).all()
    assert mean_square(quiet, 0.1) < mean_square(quiet, 0.5) < mean_square(quiet, 0.9)
    assert mean_square(quiet, 1e-300) < 1e-18


def test_what_the_poses_exclude_has_no_part_of_the_prior() -> None:
    """Poses that exclude all but the weakest disturbances say little about those: their probability
    is then nearly that before the poses, whatever else was excluded.
    """
    rng = np.random.Generator(np.random.PCG64(8))
    quiet, probability = drawn(0.0, rng)[0], 0.3
    found = posterior(quiet, probability)
    assert found.sum() == pytest.approx(1.0)
    assert (found[1:][quiet.excluded <= DENSITIES] == 0.0).all()
    weak = quiet.log_odds[0]  # of the least density: the poses cannot tell it from none
    assert weak == pytest.approx(0.0, abs=0.01)
    possible = int(np.count_nonzero(quiet.excluded > DENSITIES))
    odds = found[1] / found[0]
    assert odds == pytest.approx(probability / (1.0 - probability) / possible, rel=0.01)


def log_likelihood(S: np.ndarray, e: np.ndarray) -> float:
    """Of e ~ N(0, S) without its constant, in 40 digits: the condition number of S is 5e8."""
    with localcontext() as context:
        context.prec = 40
        exact = np.vectorize(Decimal, otypes=[object])
        A, b = exact(S), exact(e)
        twice = Decimal(0)
        for k in range(
            len(b)
        ):  # Cholesky's decomposition from left to right, and forward substitution
            root = A[k, k].sqrt()
            column = A[k:, k] / root
            A[k + 1 :, k + 1 :] -= column[1:, None] * column[1:]
            b[k] /= root
            b[k + 1 :] -= column[1:] * b[k]
            twice += b[k] ** 2 + 2 * root.ln()
        return float(-twice / 2)


def test_the_likelihood_of_a_density_is_that_of_the_whole_covariance() -> None:
    rng = np.random.Generator(np.random.PCG64(6))
    found, data, _ = drawn(1e-3, rng)
    prior = INITIAL @ np.linalg.inv(INFO) @ INITIAL.T
    values = []
    for density in (0.0, float(DENSITIES[40])):
        S = V + prior + density**2 * EFFECTS @ EFFECTS.T
        values.append(log_likelihood(S, data.e))
    assert found.log_odds[40] == pytest.approx(values[1] - values[0], abs=1e-6)
    best, likelihood = found.likeliest
    assert likelihood - found.none == pytest.approx(max(0.0, found.log_odds.max()))
    assert best in (0.0, *DENSITIES.tolist())


@pytest.mark.parametrize("size", [1.0, 1e4, 1e8])
def test_a_disturbance_explains_at_most_all_residuals_however_large_its_effects_are(
    size: float,
) -> None:
    """Impulses in an unstable spin have large effects over minutes, nearly those of other initial
    values.
    """
    rng = np.random.Generator(np.random.PCG64(42))
    e, J = rng.normal(size=144), rng.normal(size=(144, 20))
    effects = rng.normal(size=(144, 69)) + size * J @ rng.normal(size=(20, 69))
    found = marginal(np.eye(144), effects, Residuals(e, J, 1e-6 * np.eye(20), np.zeros(20)))
    assert found.log_odds.max() <= 0.5 * float(e @ e)


def test_a_further_disturbance_as_an_unknown_is_a_part_of_the_covariance() -> None:
    rng = np.random.Generator(np.random.PCG64(8))
    _, data, _ = drawn(1e-3, rng)
    other, nothing = 0.3 * rng.normal(size=(len(V), 9)), np.zeros((len(V), 0))
    found = marginal(V, nothing, data.extended(other, np.zeros(9))).none
    prior = INITIAL @ np.linalg.inv(INFO) @ INITIAL.T
    with_it, without = (log_likelihood(V + prior + S, data.e) for S in (other @ other.T, 0.0 * V))
    assert found - marginal(V, nothing, data).none == pytest.approx(with_it - without, abs=1e-6)


@pytest.mark.parametrize("size", [1e6, 1e12, 1e20])
def test_a_further_disturbance_of_any_size_leaves_a_likelihood(size: float) -> None:
    """Over a long log a random torque turns the body by more than any pose error squared in double
    precision.
    """
    rng = np.random.Generator(np.random.PCG64(9))
    found, data, _ = drawn(1e-3, rng)
    beside = marginal(V, EFFECTS, data.extended(size * rng.normal(size=(len(V), 9)), np.zeros(9)))
    assert np.isfinite(beside.none)
    assert np.isfinite(mean_square(beside))
    assert beside.likeliest[0] == pytest.approx(found.likeliest[0], rel=0.5)


def test_torque_and_force_come_together() -> None:
    assert probability_beside(0.0) == pytest.approx(0.5)
    assert probability_beside(1e6) == pytest.approx(0.9)
    assert probability_beside(-1e6) == pytest.approx(0.1)
    assert np.all(np.diff([probability_beside(x) for x in np.linspace(-9.0, 9.0, 19)]) > 0.0)


@pytest.mark.parametrize("n", [1, 36, 37, 144])
def test_a_triangular_system_is_solved_by_halves(n: int) -> None:
    rng = np.random.default_rng(n)
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, 5))
    L = np.linalg.cholesky(A @ A.T + np.eye(n))
    assert np.abs(divided(L, B) - np.linalg.solve(L, B)).max() < 1e-12


def test_the_prior_of_a_disturbance_is_shared_by_the_densities_that_the_poses_allow() -> None:
    """Impulses that are seen ever better, of which none is: the larger densities are excluded one
    after the other, down to the last.
    """
    counts = set()
    for information in np.logspace(-2.0, 20.0, 150):
        found = Marginal(0.0, np.full(20, information), np.zeros(20))
        possible = found.excluded > DENSITIES
        counts.add(count := int(np.count_nonzero(possible)))
        none, *each = posterior(found, 0.2)
        odds = 0.25 / max(count, 1) * np.exp(found.log_odds)
        np.testing.assert_allclose(np.array(each) / none, np.where(possible, odds, 0.0), rtol=1e-9)
        assert none + sum(each) == pytest.approx(1.0)
    assert {1, 2, len(DENSITIES)} <= counts
