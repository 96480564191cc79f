"""Statistics over runs, against exact distributions and independent formulas; faults by kind,
against sums by hand.
"""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import estimate_faults
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from avsreplay import settings, toml_document
from avsreplay.report.episodes import Episode, Peak
from avsreplay.simulate.scenario import load_scenario
from avsreplay.sweep.campaign import RunResult, load_campaign
from avsreplay.sweep.expansion import expand
from avsreplay.sweep.journal import Journal
from avsreplay.sweep.statistics import (
    EPISODE_COLUMNS,
    FaultKinds,
    ScoreHistogram,
    Typical,
    consistency,
    episode_lines,
    quantiles,
    rate,
    typical,
)


def test_wilson_intervals_cover_as_they_promise():
    """Exact coverage over all outcomes of 50 runs at several true shares: near 95 % on
    average, never far below.
    """
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
    from avsreplay.sweep.summary import without_infinities

    assert json.dumps(
        without_infinities({"a": [math.inf, math.nan, 1.0], "b": {"c": -math.inf}}), allow_nan=False
    )


CAMPAIGN = Path(__file__).parent.parent / "docs" / "campaigns" / "faults.toml"


def kinds_of_fault(lines, metrics):
    """The windows as one run's, then the metrics as those of runs without a window."""
    kinds = FaultKinds()
    kinds.add(lines, {})
    for each in metrics:
        kinds.add([], each)
    return kinds.result()


def episode(kind="frozen", **changes):
    plain = {
        "harmful": True,
        "start_s": 2.0,
        "end_s": 4.0,
        "scans": 4,
        "flagged": 4,
        "detected": True,
    }
    return Episode(kind, **{**plain, "recover_scans": 0, "recover_s": 0.0, **changes})


def account(unlabelled=100, false_alarms=1, known=True, used=0.01):
    named = {"known": known, "unlabelled": unlabelled, "false_alarms": false_alarms}
    peaks = {"peak_used.pos_err_m": used, "peak_used.rot_err_deg": 1.0}
    return {f"faults.{k}": v for k, v in {**named, **peaks}.items()} | {
        "faults.peak_flagged.pos_err_m": None,
        "faults.peak_flagged.rot_err_deg": None,
    }


EPISODES = (
    episode(delay_s=0.0, delay_scans=0, peak_flagged=Peak(0.1, 5.0), peak_after=Peak(0.2, 1.0)),
    episode(
        flagged=1, delay_s=1.5, delay_scans=3, peak_flagged=Peak(0.3, 2.0), peak_used=Peak(0.4, 3.0)
    ),
    episode(
        flagged=0,
        detected=False,
        recover_s=None,
        recover_scans=None,
        lost=True,
        end_s=8.0,
        scans=12,
    ),
    episode(
        "clutter",
        harmful=False,
        flagged=0,
        detected=False,
        recover_s=None,
        recover_scans=None,
        strength=0.5,
    ),
    episode(
        "dropped", scans=0, flagged=0, recover_s=1.0, recover_scans=2, peak_after=Peak(0.5, 0.5)
    ),
)


def test_kinds_are_summed_over_their_windows():
    kinds = kinds_of_fault(
        episode_lines(EPISODES), [account(), account(50, 2, used=0.02), account(10, 9, known=False)]
    )
    assert list(kinds) == ["clutter", "dropped", "frozen", "none"]
    frozen = kinds["frozen"]
    assert (frozen.episodes, frozen.scans, frozen.lost, frozen.lengths_s) == (3, 20, 1, (2.0, 6.0))
    assert (frozen.flagged.successes, frozen.flagged.count) == (5, 20)
    assert (frozen.detected.successes, frozen.detected.count) == (2, 3)
    assert (frozen.delay_s, frozen.delay_scans) == (Typical(2, 0.75, 1.5), Typical(2, 1.5, 3.0))
    assert frozen.recovery_s == Typical(2, 0.0, 0.0)
    assert (frozen.peak_flagged, frozen.peak_used, frozen.peak_after) == (
        Peak(0.3, 5.0),
        Peak(0.4, 3.0),
        Peak(0.2, 1.0),
    )
    assert (kinds["clutter"].harmful, kinds["clutter"].strengths) == (False, (0.5,))
    none = kinds["none"]
    assert (none.flagged.successes, none.flagged.count, none.episodes) == (3, 150, 0)
    assert (none.peak_used, none.peak_flagged) == (Peak(0.02, 1.0), Peak())


def test_a_kind_without_scans_has_a_row():
    dropped = kinds_of_fault(episode_lines(EPISODES), [])["dropped"]
    assert (dropped.scans, dropped.flagged, dropped.episodes, dropped.detected.share) == (
        0,
        None,
        1,
        1.0,
    )
    assert (dropped.delay_s, dropped.recovery_s, dropped.recovery_scans) == (
        None,
        Typical(1, 1.0, 1.0),
        Typical(1, 2, 2),
    )


def test_the_order_of_the_runs_does_not_matter():
    lines, expected = episode_lines(EPISODES), kinds_of_fault(episode_lines(EPISODES), [account()])
    rng = np.random.default_rng(0)
    for order in (rng.permutation(len(lines)) for _ in range(20)):
        assert kinds_of_fault([lines[k] for k in order], [account()]) == expected


def test_without_labels_nothing_is_called_a_false_alarm():
    assert kinds_of_fault([], [account(known=False)]) == {}


def test_the_median_of_an_even_count_lies_between():
    assert typical([]) is None
    assert typical([3.0]) == Typical(1, 3.0, 3.0)
    assert typical([4.0, 1.0, 2.0, 9.0]) == Typical(4, 3.0, 9.0)


def test_windows_survive_the_journal(tmp_path):
    lines = episode_lines(EPISODES)
    assert {len(line) for line in lines} == {len(EPISODE_COLUMNS)}
    with Journal(tmp_path) as journal:
        journal.add(RunResult("ab", "ok", None, {}, (), lines))
    assert Journal(tmp_path).result("ab").episodes == lines


def test_the_campaign_of_faults_has_every_kind_at_three_strengths():
    tasks = [point.task for point in expand(load_campaign(CAMPAIGN)).points() if point.repeat == 0]
    how: dict[str, set] = {}
    for task in tasks:
        for fault in toml_document.parse(task.scenario, "scenario").table["fault"]:
            strength = fault.get("strength")
            how.setdefault(fault["kind"], set()).add(
                fault["duration_s"] if strength is None else strength
            )
    assert len(how) == 9
    assert {len(found) for found in how.values()} == {3}


@pytest.mark.parametrize("name", ["weak", "medium", "strong"])
def test_windows_of_the_campaign_do_not_overlap(name):
    params = load_scenario(CAMPAIGN.parent.parent / "scenarios" / f"faults-{name}.toml").params
    ends = [(f.start_s, f.start_s + f.duration_s) for f in params.fault]
    assert all(a[1] + 4.0 < b[0] for a, b in itertools.pairwise(ends))
    assert ends[-1][1] + 4.0 < params.duration_s


def test_the_table_for_the_docs_has_a_line_a_kind_and_strength():
    kinds = settings.dump(kinds_of_fault(episode_lines(EPISODES), [account()]))
    cells = [
        {
            "values": {"scenario": f"s/faults-{name}.toml", "run.faults.policy": policy},
            "runs": 2,
            "kinds": kinds,
        }
        for name in ("weak", "strong")
        for policy in ("any", "all")
    ]
    said = estimate_faults.tables(json.loads(json.dumps({"cells": cells})))
    assert [line for line in said.splitlines() if line.startswith("`")] == [
        f"`faults.policy = {policy}`, runs of each strength: 2:" for policy in ("any", "all")
    ]
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in said.splitlines()
        if line.startswith("| ")
    ]
    assert {len(row) for row in rows} == {len(estimate_faults.HEADS)}
    assert [row[:2] for row in rows[2:10]] == [
        *(["none (false alarms)", name] for name in ("weak", "strong")),
        *(["clutter (harmless)", f"{name}: 0.5, 2 s"] for name in ("weak", "strong")),
        *(["dropped", f"{name}: 2 s"] for name in ("weak", "strong")),
        *(["frozen", f"{name}: 2 s, 6 s"] for name in ("weak", "strong")),
    ]
    assert rows[8][2:] == [
        "5 of 20 (25 %)",
        "2 of 3",
        "0.75 (1.5), 1.5 (3)",
        "0 (0), 0 (0)",
        "1",
        "300 mm, 5°",
        "400 mm, 3°",
        "200 mm, 1°",
    ]
