"""The constrained update (eq:innovation, eq:K_phi, eq:sigma_bounds): K = gamma beta K^u, in Joseph's form.

beta scales the two sigma rows of the gain (rows 12, 13) so that sigma stays inside its bounds. A scaled gain is not
optimal, hence Joseph's form.
"""

from __future__ import annotations

import math

import numpy as np

from avsreplay.estimate import _motion
from avsreplay.estimate.error_state import SIGMA, boxplus
from avsreplay.estimate.noise import GATE
from avsreplay.geometry import Array
from avsreplay.records import Belief, Innovation, State

_LEAST = 1e-12  # least eigenvalue of a repaired covariance, in units of its variances


def innovation_of(
    P: Array, H: Array, alpha: Array, R: Array, robust: bool = False, correlated_share: float = 0.0
) -> Innovation:
    """The innovation alpha (6,) with its covariance S = H P H' + R, its NIS and its Cauchy weight.

    Args:
        P: (20, 20) prior covariance.
        H: (6, 20) measurement Jacobian.
        alpha: (6,) innovation [m, half-angle].
        R: (6, 6) measurement noise.
        robust: give a pose whose NIS is above the 99.99 % point the Cauchy weight GATE / NIS; otherwise it is 1.
        correlated_share: the part of R that neighbouring scans have in common.
    """
    unsymmetric = H @ P @ H.T + R
    S = _definite(np.asarray(0.5 * (unsymmetric + unsymmetric.T), dtype=np.float64), R)
    half = min(1.0, float(np.sqrt(alpha[3:] @ alpha[3:])))
    distance = float(np.sqrt(alpha[:3] @ alpha[:3]))
    nis = float(alpha @ np.linalg.solve(S, alpha))
    weight = GATE / nis if robust and nis > GATE else 1.0
    return Innovation(alpha, S, R, nis, distance, 2.0 * float(np.arcsin(half)), weight, correlated_share)


def _definite(S: Array, R: Array) -> Array:
    """S, or, where rounding of a very large P has made it indefinite, R plus the positive part of S - R."""
    try:
        np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        scale = np.sqrt(np.abs(np.diagonal(S)) + np.diagonal(R))
        values, axes = np.linalg.eigh((S - R) / np.outer(scale, scale))
        half = axes * np.sqrt(np.maximum(values, _LEAST)) * scale[:, None]
        S = half @ half.T + R
    return S


def gain(P: Array, H: Array, S: Array) -> Array:
    """The unconstrained gain K^u (20, 6) = P H' S^-1, solved."""
    return np.asarray(np.linalg.solve(S, H @ P).T, dtype=np.float64)


def constrained_update(
    prior: Belief, H: Array, innovation: Innovation, margin: float, inflation: Array
) -> tuple[Belief, int]:
    """Posterior of a healthy epoch (gamma 1) by the paper's gain, and how many sigma bounds acted.

    ``inflation`` (2,) of attitude and position is that of ``inflated``.
    """
    R = inflated(innovation.R, inflation / innovation.weight)
    K = gain(prior.P, H, innovation.S + (R - innovation.R))
    betas, hits = sigma_bounds(prior.x.sigma, K[SIGMA] @ innovation.alpha, margin)
    if hits:
        K[12] *= betas[0]
        K[13] *= betas[1]
    P = joseph(prior.P, H, K, R)
    return Belief(prior.t_ns, boxplus(prior.x, K @ innovation.alpha), 0.5 * (P + P.T)), hits


def sigma_bounds(sigma: Array, step: Array, margin: float) -> tuple[tuple[float, float], int]:
    """(beta1, beta2) and how many bounds acted, for the step d_i = k_i' e from the prior sigma (2,) (eq:sigma_bounds).

    Where |sigma_i + d_i| > 1 - m, beta_i puts the posterior on the bound: (sgn(sigma_i + d_i)(1 - m) - sigma_i) / d_i.
    """
    betas = [_beta(s, d, 1.0 - margin) for s, d in zip(sigma.tolist(), step.tolist(), strict=True)]
    return (betas[0], betas[1]), sum(beta != 1.0 for beta in betas)


def _beta(sigma: float, d: float, bound: float) -> float:
    free = sigma + d
    return 1.0 if abs(free) <= bound or d == 0.0 else (math.copysign(bound, free) - sigma) / d


def chart_update(prior: Belief, H: Array, innovation: Innovation, inflation: Array) -> Belief:
    """The same update with the state displaced through the chart, where inertia has no bounds and beta is not needed.

    Gain, Joseph's form and the displacement of mean and P by the chart's Jacobians are one call of the extension.
    """
    x, factors = prior.x, inflation / innovation.weight
    alpha, S, R = innovation.alpha, innovation.S, innovation.R
    *mean, P = _motion.correct(
        x.q_ab, x.w_b, x.r_a, x.v_a, x.sigma, x.c_b, x.q_bc, prior.P, H, alpha, S, R, factors.tolist()
    )
    return Belief(prior.t_ns, State(*mean), P)


def joseph(P: Array, H: Array, K: Array, R: Array) -> Array:
    """(I - KH) P (I - KH)' + K R K', the posterior covariance under any gain."""
    L = -K @ H
    L.flat[::21] += 1.0
    out: Array = L @ P @ L.T + K @ R @ K.T
    return out


def inflated(R: Array, inflation: Array) -> Array:
    """R times ``inflation`` (2,), of attitude and position: correlated errors carry less information than white ones.

    S of the innovation itself is not inflated: a single scan has the noise R.
    """
    c = np.sqrt(np.repeat(inflation[::-1], 3))
    return np.asarray(R * np.outer(c, c))
