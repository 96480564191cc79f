"""Campaign files, their unrolling, TOML text, the journal and the statistics: no run is made here."""

import json
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import stats

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.simulate import load_scenario
from avsreplay.sweep import Journal, expand, load_campaign
from avsreplay.sweep.statistics import ScoreHistogram, consistency, quantiles, rate
from avsreplay.sweep.toml_text import toml_text, toml_value
from avsreplay.sweep.worker import Outcome

BASE = """
name = "test"
seed = 4
repeats = 3
[set]
"scenario.duration_s" = 4.0
[[grid]]
key = "scenario.scanner.noise_m"
values = [0.004, 0.008]
[[grid]]
key = "run.faults.policy"
values = ["any", "all"]
"""


def plan_of(tmp_path, text):
    path = tmp_path / "c.toml"
    path.write_text(text)
    return expand(load_campaign(path))


def tables(plan):
    return [tomllib.loads(point.task.scenario) for point in plan.points()]


def test_a_grid_is_every_combination_and_every_repeat(tmp_path):
    plan = plan_of(tmp_path, BASE)
    points = list(plan.points())
    assert len(plan) == len(points) == 12
    assert [p.index for p in points] == list(range(12))
    assert {(p.cell, p.repeat) for p in points} == {(c, r) for c in range(4) for r in range(3)}
    assert len({p.task.id for p in points}) == 12
    assert {p.task.assignments for p in points} == {('faults.policy="any"',), ('faults.policy="all"',)}
    for point, table in zip(points, tables(plan), strict=True):
        assert table["scanner"]["noise_m"] == point.values["scenario.scanner.noise_m"]
        assert table["duration_s"] == 4.0


def test_what_is_not_set_is_as_the_scenario_has_it(tmp_path):
    table = tables(plan_of(tmp_path, BASE))[0]
    base = tomllib.loads(load_scenario().text)
    for key in ("motion", "fault", "start", "target", "rate_hz"):
        assert table[key] == base[key]
    assert {**table["scanner"], "noise_m": 0.008} == {**base["scanner"], "noise_m": 0.008}


def test_combinations_of_one_repeat_share_their_seed_and_repeats_do_not(tmp_path):
    plan = plan_of(tmp_path, BASE)
    seeds = {(p.repeat, t["seed"]) for p, t in zip(plan.points(), tables(plan), strict=True)}
    assert len(seeds) == 3
    assert len({seed for _, seed in seeds}) == 3


def test_a_run_keeps_its_name_when_the_campaign_grows(tmp_path):
    names = {p.task.id for p in plan_of(tmp_path, BASE).points()}
    grown = BASE.replace("repeats = 3", "repeats = 5").replace("[0.004, 0.008]", "[0.004, 0.008, 0.016]")
    assert names < {p.task.id for p in plan_of(tmp_path, grown).points()}
    assert names.isdisjoint(p.task.id for p in plan_of(tmp_path, BASE.replace("seed = 4", "seed = 5")).points())


def test_cases_are_alternatives(tmp_path):
    text = """
[[case]]
name = "near"
[[case]]
name = "noisy"
set = { "scenario.scanner.noise_m" = 0.05, "scenario.fault.0.start_s" = 3.0 }
"""
    near, noisy = tables(plan_of(tmp_path, text))
    assert (near["scanner"]["noise_m"], noisy["scanner"]["noise_m"]) == (0.008, 0.05)
    assert (near["fault"][0]["start_s"], noisy["fault"][0]["start_s"]) == (22.0, 3.0)
    assert near["fault"][1:] == noisy["fault"][1:]


def test_draws_follow_their_law_and_do_not_disturb_each_other(tmp_path):
    head = "repeats = 300\n[set]\n"
    one = '[[draw]]\nkey = "scenario.scanner.noise_m"\nkind = "uniform"\nlow = 0.01\nhigh = 0.02\n'
    two = '[[draw]]\nkey = "scenario.motion.attitude_xyzw"\nkind = "attitude"\n'
    three = '[[draw]]\nkey = "scenario.motion.rate_radps"\nkind = "direction"\nlow = 0.1\nhigh = 0.1\n'
    alone = [t["scanner"]["noise_m"] for t in tables(plan_of(tmp_path, head + one))]
    together = tables(plan_of(tmp_path, head + two + three + one))
    assert alone == [t["scanner"]["noise_m"] for t in together]
    assert stats.kstest(alone, "uniform", (0.01, 0.01)).pvalue > 1e-3
    q = np.array([t["motion"]["attitude_xyzw"] for t in together])
    assert_allclose(np.linalg.norm(q, axis=1), 1)
    assert stats.kstest(2 * np.arccos(np.abs(q[:, 3])), lambda a: (a - np.sin(a)) / np.pi).pvalue > 1e-3
    w = np.array([t["motion"]["rate_radps"] for t in together])
    assert_allclose(np.linalg.norm(w, axis=1), 0.1)
    assert stats.kstest(w[:, 0] / 0.1, "uniform", (-1, 2)).pvalue > 1e-3


@pytest.mark.parametrize(
    ("kind", "more", "law"),
    [
        ("normal", "low = 0.5\nhigh = 0.1", lambda v: stats.kstest(v, "norm", (0.5, 0.1)).pvalue > 1e-3),
        (
            "log_uniform",
            "low = 0.1\nhigh = 10",
            lambda v: stats.kstest(np.log10(v), "uniform", (-1, 2)).pvalue > 1e-3,
        ),
        ("choice", "values = [0.25, 0.5]", lambda v: set(v) == {0.25, 0.5}),
        ("integer", "low = 1\nhigh = 3", lambda v: set(v) == {1, 2, 3} and all(isinstance(x, int) for x in v)),
    ],
)
def test_kinds_of_draws(tmp_path, kind, more, law):
    text = f'repeats = 200\n[[draw]]\nkey = "scenario.rate_hz"\nkind = "{kind}"\n{more}\n'
    assert law([t["rate_hz"] for t in tables(plan_of(tmp_path, text))])


def test_scenarios_are_an_axis(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "m.ply").write_bytes(b"one")
    (tmp_path / "sub" / "a.toml").write_text('rate_hz = 1.0\n[target]\nmodel = "m.ply"\n')
    (tmp_path / "b.toml").write_text("rate_hz = 2.0\n")
    text = 'scenarios = ["sub/a.toml", "b.toml"]\nrepeats = 2\n[set]\n"scenario.duration_s" = 4.0\n'
    plan = plan_of(tmp_path, text)
    points = list(plan.points())
    assert [p.values["scenario"] for p in points] == ["sub/a.toml", "b.toml"] * 2
    assert [t["rate_hz"] for t in tables(plan)] == [1.0, 2.0] * 2
    assert [Path(p.task.folder).name for p in points[:2]] == ["sub", tmp_path.name]
    before = [p.task.id for p in points]
    (tmp_path / "sub" / "m.ply").write_bytes(b"two")
    after = [p.task.id for p in plan_of(tmp_path, text).points()]
    assert [a == b for a, b in zip(before, after, strict=True)] == [False, True] * 2


def test_logs_are_an_axis(tmp_path):
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).write_bytes(name.encode())
    text = 'logs = ["a.mcap", "b.mcap"]\n[[grid]]\nkey = "run.register.backend"\nvalues = ["horn", "kiss"]\n'
    points = list(plan_of(tmp_path, text).points())
    assert [p.values["log"] for p in points] == ["a.mcap", "a.mcap", "b.mcap", "b.mcap"]
    assert all(p.task.scenario == "" for p in points)
    before = {p.task.id for p in points}
    (tmp_path / "a.mcap").write_bytes(b"other")
    after = {p.task.id for p in plan_of(tmp_path, text).points()}
    assert len(before & after) == 2  # another content is another run


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[[grid]]\nkey = "scenario.scanner.noize"\nvalues = [1.0]\n', "noise_m"),
        ('[[grid]]\nkey = "scenario.scanner.noise_m"\nvalues = [0.1, -1.0]\n', "noise_m = -1.0"),
        ('[[grid]]\nkey = "run.faults.polcy"\nvalues = ["any"]\n', "policy"),
        ('[[grid]]\nkey = "faults.policy"\nvalues = ["any"]\n', "must begin with"),
        ('[[grid]]\nkey = "scenario.seed"\nvalues = []\n', "not empty"),
        ('[set]\n"scenario.fault.9.start_s" = 1.0\n', "does not lead to a place"),
        ('[set]\n"scenario.name.x" = 1.0\n', "does not lead to a place"),
        ("repeats = 0\n", "repeats"),
        ("repets = 1\n", "repeats"),
        ('logs = ["none.mcap"]\n', "No such file"),
        ('logs = ["x"]\n[set]\n"scenario.seed" = 1\n', "no place where logs"),
        ('[[draw]]\nkey = "scenario.seed"\nkind = "choice"\n', "needs values"),
        ('[[grid]]\nkey = "run.init"\nvalues = ["log"]\n[[draw]]\nkey = "run.init"\nkind = "attitude"\n', "twice"),
    ],
)
def test_wrong_campaigns_are_one_line(tmp_path, text, words):
    with pytest.raises((UsageError, UnreadableInput), match=words) as caught:
        plan_of(tmp_path, text)
    assert "\n" not in str(caught.value)
    assert str(caught.value).count(":") >= 1


plain = st.recursive(
    st.booleans()
    | st.integers(-(2**62), 2**62)
    | st.floats(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"])),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), inner, max_size=4)
    ),
    max_leaves=12,
)


@given(st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), plain, max_size=5))
def test_toml_text_reads_back(table):
    assert tomllib.loads(toml_text(table)) == table


def test_toml_refuses_what_it_cannot_say():
    with pytest.raises(ValueError, match="object"):
        toml_value(object())


def outcome(k, status="ok"):
    return Outcome(
        f"{k:024x}", status, None, {"a.b_m": 0.1 * k, "none": None, "nan": math.inf}, ((0, None, True, 1, 0.5),)
    )


def test_the_journal_remembers(tmp_path):
    with Journal(tmp_path / "d" / "journal.txt") as journal:
        for k in (3, 1, 2, 1):
            journal.add(outcome(k))
    again = Journal(tmp_path / "d" / "journal.txt")
    assert [o.id[-1] for o in again.outcomes()] == ["3", "1", "2"]
    assert again.outcome(outcome(2).id) == outcome(2)
    assert outcome(1).id in again


def test_a_torn_line_is_cut_off_wherever_it_is_torn(tmp_path):
    path = tmp_path / "journal.txt"
    with Journal(path) as journal:
        for k in range(3):
            journal.add(outcome(k))
    whole = path.read_bytes()
    lines = whole.splitlines(keepends=True)
    second_end = len(lines[0]) + len(lines[1])
    for cut in range(second_end, len(whole)):
        path.write_bytes(whole[:cut])
        with Journal(path) as journal:
            assert len(journal.status) == 2
            journal.add(outcome(2))
        assert path.read_bytes() == whole


def test_a_damaged_line_ends_what_is_trusted(tmp_path):
    path = tmp_path / "journal.txt"
    with Journal(path) as journal:
        for k in range(3):
            journal.add(outcome(k))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    assert list(Journal(path).status) == [outcome(0).id]


def test_failed_runs_can_be_forgotten(tmp_path):
    with Journal(tmp_path / "journal.txt") as journal:
        journal.add(outcome(1))
        journal.add(outcome(2, "failed"))
        journal.add(outcome(3))
    journal = Journal(tmp_path / "journal.txt")
    journal.forget(("failed",))
    assert [o.id[-1] for o in journal.outcomes()] == ["1", "3"]
    assert len(Journal(tmp_path / "journal.txt").status) == 2


def test_a_journal_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(UnreadableInput), Journal(tmp_path / "file" / "journal.txt"):
        pass


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


def test_consistency_band_holds_right_runs():
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
