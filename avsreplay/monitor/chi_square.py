"""Quantiles of chi-square distributions, without SciPy, whose import takes 0.3 s."""

from __future__ import annotations

import math


def mean_band(dof: int, count: int, level: float) -> tuple[float, float]:
    """Two-sided band of the mean of ``count`` > 2 / ``dof`` chi-square values of ``dof`` degrees of
    freedom each.

    Args:
        dof: degrees of freedom of each value.
        count: number of values, above 2 / ``dof``.
        level: probability inside of the band.
    """
    a, tail = 0.5 * dof * count, 0.5 * (1.0 - level)
    return 2.0 * _gamma_quantile(a, tail) / count, 2.0 * _gamma_quantile(a, 1.0 - tail) / count


def _gamma_quantile(a: float, p: float) -> float:
    """The x with P(a, x) = p, a > 1, P the regularised incomplete gamma function by its series.

    Newton's method from the mode, the point of inflection, approaches x from one side.
    """
    x, step = a - 1.0, math.inf
    while abs(step) > 1e-9 * x:  # the error of the next x is of second order
        k, term, total = a, 1.0 / a, 1.0 / a
        while term > 1e-17 * total:
            k += 1.0
            term *= x / k
            total += term
        density = math.exp((a - 1.0) * math.log(x) - x - math.lgamma(a))
        step = p / density - x * total
        x += step
    return x
