"""Statistics over runs, against exact distributions and independent formulas."""

import json
import math

import numpy as np
from numpy.testing import assert_allclose
from scipy import stats

from avsreplay.sweep.statistics import ScoreHistogram, consistency, quantiles, rate


def test_wilson_intervals_cover_as_they_promise():
    """Exact coverage over all outcomes of 50 runs at several true shares: near 95 % on average, never far below."""
    covered = []
    for p in (0.02, 0.1, 0.5, 0.9, 0.98):
        inside = [rate(k, 50).low <= p <= rate(k, 50).high for k in range(51)]
        covered.append(np.sum(stats.binom(50, p).pmf(np.arange(51)) * inside))
    assert min(covered) > 0.9
    assert 0.93 < np.mean(covered) < 0.98
    assert rate(0, 0) is None
    assert (rate(0, 3).low, rate(3, 3).high) == (0.0, 1.0)
    assert_allclose([rate(3, 3).low], [3 / (3 + 1.959963984540054**2)], rtol=1e-12)


def test_quantiles_and_the_median_interval():
    rng = np.random.Generator(np.random.PCG64(1))
    found = quantiles(list(range(101)))
    assert (found.q05, found.median, found.q95) == (5.0, 50.0, 95.0)
    covered = 0
    for _ in range(400):
        q = quantiles(rng.normal(size=40))
        covered += q.median_low <= 0.0 <= q.median_high
    assert stats.binomtest(covered, 400, 0.96).pvalue > 1e-3
    assert quantiles([]) is None


def test_an_interval_is_given_only_where_it_has_its_coverage():
    """The interval of the median exists from 6 runs on: 1 - 2 / 2^n is at least 0.95."""
    for n in range(1, 12):
        found = quantiles([float(k) for k in range(n)])
        assert (found.median_low is not None) == (1 - 2 * 0.5**n >= 0.95)
        assert (found.median_low is None) == (found.median_high is None)
    assert (rate(1, 1).low, rate(1, 1).high, rate(1, 1).share) == (None, None, 1.0)
    assert rate(1, 2).low is not None


def test_the_consistency_band_holds_consistent_runs():
    rng = np.random.Generator(np.random.PCG64(2))
    inside = 0
    for _ in range(200):
        c = consistency(list(rng.chisquare(20, size=30)), 20)
        inside += c.low < c.mean_per_dof < c.high
    assert stats.binomtest(inside, 200, 0.95).pvalue > 1e-3


def test_a_roc_is_that_of_its_scores():
    """Against the exact area (Mann and Whitney) and exact shares, to the width of a bin."""
    rng = np.random.Generator(np.random.PCG64(3))
    good, bad = np.exp(rng.normal(-4, 0.7, 3000)), np.exp(rng.normal(-2.5, 0.7, 800))
    histogram = ScoreHistogram()
    for score in good:
        histogram.add(float(score), False)
    for score in bad:
        histogram.add(float(score), True)
    roc = histogram.roc()
    exact = stats.mannwhitneyu(bad, good).statistic / (len(bad) * len(good))
    assert abs(roc.area - exact) < 2e-3
    threshold, detected = roc.at_one_percent
    assert np.mean(good >= threshold) <= 0.01
    assert abs(np.mean(bad >= threshold) - detected) < 1e-12
    assert np.mean(good >= threshold / 1.05) > 0.008  # and it is the lowest such threshold
    assert np.all(np.diff(roc.thresholds) < 0)
    assert np.all(np.diff(roc.detected) >= 0)


def test_scans_without_a_measurement_are_flagged_at_every_threshold():
    histogram = ScoreHistogram()
    for _ in range(10):
        histogram.add(None, True)
        histogram.add(0.01, False)
    roc = histogram.roc()
    assert roc.area == 1.0
    assert roc.at_one_percent[1] == 1.0
    histogram.add(None, False)
    assert histogram.roc().false[0] == 1 / 11
    assert ScoreHistogram().roc() is None


def test_a_summary_holds_no_number_that_json_cannot_say():
    from avsreplay.sweep.summary import _finite

    assert json.dumps(_finite({"a": [math.inf, math.nan, 1.0], "b": {"c": -math.inf}}), allow_nan=False)
