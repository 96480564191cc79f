"""What is beyond belief, how much residuals say, and what their correlation in time takes from them."""

from __future__ import annotations

import numpy as np

from avsreplay.geometry import Array

__all__ = ["BOUND", "GATE", "colour_of", "weigh"]

GATE = 27.86  # chi-square with 6 degrees of freedom, 99.99 %: a pose
BOUND = 52.4  # the same with 20: a state
_LAGS = (5, 10, 20, 40)


def weigh(chi2: Array, redescend: bool) -> tuple[Array, Array]:
    """Weights and costs (n,): plain up to the gate; beyond it Cauchy's logarithm, or Huber's root on the way in."""
    over = np.maximum(chi2 / GATE, 1.0)
    if redescend:
        return 1.0 / over, np.where(over > 1.0, GATE * (1.0 + np.log(over)), chi2)
    return 1.0 / np.sqrt(over), np.where(over > 1.0, GATE * (2.0 * np.sqrt(over) - 1.0), chi2)


def colour_of(e: Array) -> float:
    """1 + 2 sum of autocorrelations of rows e (n, 3), over the lags that show most, where three sigma do."""
    n, e = len(e), np.ascontiguousarray(e).reshape(-1)
    total = float(e @ e)
    lags = [k for k in _LAGS if k <= n // 8]
    rho = [float(e[3 * k :] @ e[: -3 * k]) / total * n / (n - k) for k in range(1, max(lags, default=0) + 1)]
    sums = [(sum(rho[:k]), 3.0 * np.sqrt(k / (3.0 * n))) for k in lags]
    return 1.0 + 2.0 * max((found for found, doubt in sums if found > doubt), default=0.0)
