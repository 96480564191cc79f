"""95 % intervals of the difference of two runs, by a bootstrap with a fixed seed.

Few blocks make the percentile interval too narrow; its level is that of the expanded percentile
interval of T. C. Hesterberg, "What Teachers Should Know About the Bootstrap", The American
Statistician 69 (2015), section 4.3.
"""

from __future__ import annotations

import math

import numpy as np

from avsreplay.geometry import Array

_RESAMPLES = 9999


def interval_of_mean(differences: Array, *, correlated: bool = False) -> tuple[float, float]:
    """95 % interval of the mean of differences.

    Args:
        differences: (n,) one for each pair of runs, or for each block of consecutive scans.
        correlated: they are those of successive blocks.

    The half widths for a time series are multiplied by sqrt((1 + r) / (1 - r)), the factor of a
    first-order autoregressive series with the lag-1 autocorrelation r of the differences (r is
    corrected for its bias of -1/n and limited to 0 to 0.8).
    """
    from scipy.stats import bootstrap, norm, t

    n, mean = len(differences), float(np.mean(differences))
    away = differences - mean
    if not away.any():
        return mean, mean
    tail = float(norm.cdf(-math.sqrt(n / (n - 1)) * t.ppf(0.975, n - 1)))
    found = bootstrap(
        (differences,),
        np.mean,
        confidence_level=1.0 - 2.0 * tail,
        n_resamples=_RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    r = float((away[1:] * away[:-1]).sum() / np.square(away).sum()) + 1.0 / n if correlated else 0.0
    factor = math.sqrt((1.0 + min(max(r, 0.0), 0.8)) / (1.0 - min(max(r, 0.0), 0.8)))
    return mean + factor * (float(found.low) - mean), mean + factor * (float(found.high) - mean)


def interval_of_roots(base: Array, other: Array) -> tuple[float, float]:
    """95 % interval of the difference of two root mean squares.

    An error that grows during a run has no typical size, but a typical ratio to that of the other
    run: the logarithms of the ratios of the blocks are averaged. Where a block has no error, or the
    ratio over all scans is outside of the interval because a few blocks determine it, the
    differences of the blocks are averaged instead, with sqrt(other) - sqrt(base) = (other - base) /
    (sqrt(other) + sqrt(base)).

    Args:
        base: (n,) mean squares of the baseline in blocks of consecutive scans.
        other: (n,) mean squares of the other run in the same blocks.
    """
    first, second = math.sqrt(float(base.mean())), math.sqrt(float(other.mean()))
    if base.min() > 0.0 and other.min() > 0.0:
        low, high = (
            math.exp(end) for end in interval_of_mean(0.5 * np.log(other / base), correlated=True)
        )
        if low * first <= second <= high * first:
            return (low - 1.0) * first, (high - 1.0) * first
    return interval_of_mean((other - base) / max(first + second, 1e-300), correlated=True)
