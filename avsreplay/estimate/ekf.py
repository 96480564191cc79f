"""The constrained update (eq:innovation, eq:K_phi): K = gamma beta K^u, in Joseph's form as beta spoils optimality."""

from __future__ import annotations

import numpy as np

from avsreplay.estimate.chart import retract
from avsreplay.estimate.constrain import shrink
from avsreplay.estimate.layout import SIGMA, boxplus
from avsreplay.geometry import Array
from avsreplay.records import Belief, Innovation

__all__ = ["gain", "innovate", "update", "update_in_chart"]


def innovate(P: Array, H: Array, alpha: Array, R: Array) -> Innovation:
    """The innovation's covariance S = H P H' + R and its sizes."""
    seen = H @ P @ H.T + R
    S = np.asarray(0.5 * (seen + seen.T), dtype=np.float64)
    half = min(1.0, float(np.sqrt(alpha[3:] @ alpha[3:])))
    distance = float(np.sqrt(alpha[:3] @ alpha[:3]))
    return Innovation(alpha, S, R, float(alpha @ np.linalg.solve(S, alpha)), distance, 2.0 * float(np.arcsin(half)))


def gain(P: Array, H: Array, S: Array) -> Array:
    """K^u (20, 6) = P H' S^-1, solved."""
    return np.asarray(np.linalg.solve(S, H @ P).T, dtype=np.float64)


def update(prior: Belief, H: Array, seen: Innovation, margin: float) -> tuple[Belief, int]:
    """Posterior of a healthy epoch (gamma 1), and how many sigma bounds acted."""
    K = gain(prior.P, H, seen.S)
    betas, hits = shrink(prior.x.sigma, K[SIGMA] @ seen.alpha, margin)
    if hits:
        K[12] *= betas[0]
        K[13] *= betas[1]
    L = -K @ H
    L.flat[::21] += 1.0
    P = L @ prior.P @ L.T + K @ seen.R @ K.T
    return Belief(prior.t_ns, boxplus(prior.x, K @ seen.alpha), 0.5 * (P + P.T)), hits


def update_in_chart(prior: Belief, H: Array, seen: Innovation) -> Belief:
    """The same update displaced through the chart, where inertia cannot leave its bounds and beta has nothing to do."""
    K = gain(prior.P, H, seen.S)
    L = -K @ H
    L.flat[::21] += 1.0
    x, P = retract(prior.x, L @ prior.P @ L.T + K @ seen.R @ K.T, K @ seen.alpha)
    return Belief(prior.t_ns, x, P)
