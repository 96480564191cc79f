"""Keeping sigma inside its bounds (eq:sigma_bounds): beta scales the two sigma rows of the gain (rows 12, 13)."""

from __future__ import annotations

import math

from avsreplay.geometry import Array

__all__ = ["shrink"]


def shrink(sigma: Array, step: Array, margin: float) -> tuple[tuple[float, float], int]:
    """(beta1, beta2) and how many bounds acted, for the step d_i = k_i' e from the prior sigma (2,).

    Where |sigma_i + d_i| > 1 - m, beta_i puts the posterior on the bound: (sgn(sigma_i + d_i)(1 - m) - sigma_i) / d_i.
    """
    betas = [_beta(s, d, 1.0 - margin) for s, d in zip(sigma.tolist(), step.tolist(), strict=True)]
    return (betas[0], betas[1]), sum(beta != 1.0 for beta in betas)


def _beta(sigma: float, d: float, bound: float) -> float:
    free = sigma + d
    return 1.0 if abs(free) <= bound or d == 0.0 else (math.copysign(bound, free) - sigma) / d
