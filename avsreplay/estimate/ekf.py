"""The constrained update (eq:innovation, eq:K_phi): K = gamma beta K^u, in Joseph's form as beta spoils optimality."""

from __future__ import annotations

import numpy as np

from avsreplay.estimate import _motion
from avsreplay.estimate.constrain import shrink
from avsreplay.estimate.layout import SIGMA, boxplus
from avsreplay.estimate.robust import GATE
from avsreplay.geometry import Array
from avsreplay.records import Belief, Innovation, State

__all__ = ["gain", "innovate", "joseph", "update", "update_in_chart", "widened"]


def innovate(P: Array, H: Array, alpha: Array, R: Array, robust: bool = False, share: float = 0.0) -> Innovation:
    """The innovation's covariance S = H P H' + R and its sizes.

    ``robust`` weighs a pose down whose NIS is beyond the 99.99 % point, by Cauchy's weight, as the fit does.
    ``share``: of R, what neighbouring scans have in common.
    """
    seen = H @ P @ H.T + R
    S = np.asarray(0.5 * (seen + seen.T), dtype=np.float64)
    half = min(1.0, float(np.sqrt(alpha[3:] @ alpha[3:])))
    distance = float(np.sqrt(alpha[:3] @ alpha[:3]))
    nis = float(alpha @ np.linalg.solve(S, alpha))
    weight = GATE / nis if robust and nis > GATE else 1.0
    return Innovation(alpha, S, R, nis, distance, 2.0 * float(np.arcsin(half)), weight, share)


def gain(P: Array, H: Array, S: Array) -> Array:
    """K^u (20, 6) = P H' S^-1, solved."""
    return np.asarray(np.linalg.solve(S, H @ P).T, dtype=np.float64)


def update(prior: Belief, H: Array, seen: Innovation, margin: float, colour: Array) -> tuple[Belief, int]:
    """Posterior of a healthy epoch (gamma 1), and how many sigma bounds acted. ``colour`` (2,) as in ``widened``."""
    R = widened(seen.R, colour / seen.weight)
    K = gain(prior.P, H, seen.S + (R - seen.R))
    betas, hits = shrink(prior.x.sigma, K[SIGMA] @ seen.alpha, margin)
    if hits:
        K[12] *= betas[0]
        K[13] *= betas[1]
    P = joseph(prior.P, H, K, R)
    return Belief(prior.t_ns, boxplus(prior.x, K @ seen.alpha), 0.5 * (P + P.T)), hits


def update_in_chart(prior: Belief, H: Array, seen: Innovation, colour: Array) -> Belief:
    """The same update displaced through the chart, where inertia cannot leave its bounds and beta has nothing to do.

    Gain, Joseph's form and the displacement, mean and P by the chart's derivatives, are one call of the extension.
    """
    x, say = prior.x, colour / seen.weight
    *mean, P = _motion.correct(
        x.q_ab, x.w_b, x.r_a, x.v_a, x.sigma, x.c_b, x.q_bc, prior.P, H, seen.alpha, seen.S, seen.R, say.tolist()
    )
    return Belief(prior.t_ns, State(*mean), P)


def joseph(P: Array, H: Array, K: Array, R: Array) -> Array:
    """(I - KH) P (I - KH)' + K R K', the posterior covariance under any gain."""
    L = -K @ H
    L.flat[::21] += 1.0
    out: Array = L @ P @ L.T + K @ R @ K.T
    return out


def widened(R: Array, colour: Array) -> Array:
    """R times ``colour`` (2,), of attitude and position: errors that stay from scan to scan say less than white ones.

    The innovation's own S is not widened: it is as wide as one scan is.
    """
    c = np.sqrt(np.repeat(colour[::-1], 3))
    return np.asarray(R * np.outer(c, c))
