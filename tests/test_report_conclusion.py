"""The conclusion of a comparison: directions, lost values, intervals, settings, pairs."""

from __future__ import annotations

import dataclasses
import io
import json
from dataclasses import dataclass, field

import numpy as np
import pytest
from click.testing import CliRunner

from avsreplay.cli.compare import compare_command
from avsreplay.errors import UsageError
from avsreplay.report.compare import METRICS
from avsreplay.report.conclusion import COMPARED_METRICS, changes_table, conclude, settings_table
from avsreplay.report.intervals import interval_of_roots
from avsreplay.report.jsonl import write_rows
from avsreplay.report.summary import Summary
from avsreplay.report.table import make_console, print_table


@dataclass
class Saved:
    name: str
    rows: list
    header: dict = field(default_factory=dict)

    @property
    def summary(self):
        return Summary.fold(self.rows)


def _noisy(rows, factor, seed=5):
    """Errors drawn anew around ``factor`` times 10 mm: independent from scan to scan."""
    rng = np.random.default_rng(seed)
    return [
        dataclasses.replace(r, pos_err_m=float(factor * 0.01 * abs(1 + 0.3 * rng.normal())))
        for r in rows
    ]


def _changes(found):
    return {change.metric: change for change in found.changes}


def test_the_same_rows_are_the_same(make_rows):
    found = conclude("b", [(Saved("a", make_rows(60)), Saved("b", make_rows(60)))])
    assert found.word == "same"
    assert {change.word for change in found.changes} == {"equal"}


def test_larger_errors_are_worse_and_smaller_ones_better(make_rows):
    base, other = (
        Saved("a", _noisy(make_rows(200), 1.0)),
        Saved("b", _noisy(make_rows(200), 1.5, seed=6)),
    )
    worse, better = (
        _changes(conclude("x", [pair]))["all_pos_rmse_m"] for pair in ((base, other), (other, base))
    )
    assert (worse.word, better.word) == ("worse", "better")
    assert worse.low < worse.other - worse.base < worse.high
    assert 1.0 + worse.low / worse.base == pytest.approx(
        1.0 / (1.0 + better.high / better.base)
    )  # of the ratio


def _with_errors(rows, errors):
    return [dataclasses.replace(r, pos_err_m=float(e)) for r, e in zip(rows, errors, strict=True)]


@pytest.mark.parametrize("slope", [2.0, 10.0, 100.0])
def test_an_error_that_grows_during_the_run_is_worse(make_rows, slope):
    """Larger in every block of scans; the differences of the mean squares spread over powers
    of ten.
    """
    rows, base = make_rows(200), [r.pos_err_m for r in _noisy(make_rows(200), 1.0)]
    other = [
        e * (1.0 + slope * k / 200.0)
        for k, e in enumerate(r.pos_err_m for r in _noisy(rows, 1.0, seed=6))
    ]
    change = _changes(
        conclude(
            "b", [(Saved("a", _with_errors(rows, base)), Saved("b", _with_errors(rows, other)))]
        )
    )
    assert change["all_pos_rmse_m"].word == "worse"
    assert change["all_pos_rmse_m"].low > 0.0


def test_an_error_in_a_few_scans_is_no_evidence(make_rows):
    """Smaller in nine blocks of ten and much larger in one: the rms is larger, but by chance
    in one place.
    """
    rows = make_rows(200)
    base = np.array([r.pos_err_m for r in _noisy(rows, 1.0)])
    other = 0.9 * base
    other[100:103] *= 100.0
    change = _changes(
        conclude(
            "b", [(Saved("a", _with_errors(rows, base)), Saved("b", _with_errors(rows, other)))]
        )
    )
    assert change["all_pos_rmse_m"].other > change["all_pos_rmse_m"].base
    assert change["all_pos_rmse_m"].word == "no evidence"


def test_a_block_without_an_error_has_an_interval():
    """Where a ratio does not exist, the differences of the mean squares decide."""
    low, high = interval_of_roots(
        np.array([0.0, 1.0, 4.0, 1.0, 1.0]), np.array([9.0, 9.0, 16.0, 9.0, 9.0])
    )
    assert 0.0 < low < np.sqrt(10.4) - np.sqrt(1.4) < high


def test_errors_that_differ_by_chance_are_no_evidence(make_rows):
    words = [
        _changes(
            conclude(
                "b",
                [
                    (
                        Saved("a", _noisy(make_rows(200), 1.0, k)),
                        Saved("b", _noisy(make_rows(200), 1.0, 100 + k)),
                    )
                ],
            )
        )["all_pos_rmse_m"].word
        for k in range(20)
    ]
    assert (
        words.count("no evidence") >= 16
    )  # 95 % intervals: one in twenty is expected to exclude 0


def _series(rng, count, phi):
    """A first-order autoregressive series of unit variance."""
    out = [rng.normal()]
    for _ in range(count - 1):
        out.append(phi * out[-1] + np.sqrt(1 - phi**2) * rng.normal())
    return np.array(out)


@pytest.mark.parametrize(("count", "phi", "least"), [(35, 0.0, 0.86), (100, 0.8, 0.82)])
def test_intervals_cover_zero_where_the_runs_do_not_differ(make_rows, count, phi, least):
    """Errors of equal size, correlated from scan to scan: 3 sigma of 60 trials below 95 % and
    91 %.
    """
    rng, rows, inside = np.random.default_rng(7), make_rows(count), 0
    for _ in range(60):
        runs = [
            Saved(
                name,
                [
                    dataclasses.replace(r, pos_err_m=abs(float(0.01 + 0.003 * v)))
                    for r, v in zip(rows, _series(rng, count, phi), strict=True)
                ],
            )
            for name in "ab"
        ]
        change = _changes(conclude("b", [tuple(runs)]))["all_pos_rmse_m"]
        inside += change.low <= 0.0 <= change.high
    assert inside / 60 >= least


def test_a_figure_without_an_interval_is_changed_and_mentioned(make_rows):
    base = make_rows(35)
    first = next(k for k, r in enumerate(base) if r.converged)
    later = [
        dataclasses.replace(r, converged=r.converged and k >= first + 8) for k, r in enumerate(base)
    ]
    found = conclude("b", [(Saved("a", base), Saved("b", later))])
    assert _changes(found)["t1_s"].word == "changed"
    assert found.word == "no evidence"
    assert "changed, without an interval: time of convergence" in found.sentence


def test_a_median_of_one_pair_is_neither_better_nor_worse(make_rows):
    pair = Saved("a", _noisy(make_rows(35), 1.0)), Saved("b", _noisy(make_rows(35), 1.04, seed=6))
    found = _changes(conclude("b", [pair]))
    assert {found[f"{kind}_pos_median_m"].word for kind in ("all", "pose", "coast")} == {"changed"}


def test_four_percent_on_35_scans_are_no_evidence(make_rows):
    """Errors that are correlated from scan to scan, as those of a filter: 20 pairs, two of
    which may be decided.
    """
    words = []
    for k in range(20):
        rng, base = np.random.default_rng(k), make_rows(35)
        sizes = (scale * np.abs(1 + 0.3 * _series(rng, 35, 0.5)) for scale in (0.01, 0.0096))
        runs = [
            Saved(
                "x",
                [
                    dataclasses.replace(r, pos_err_m=float(e))
                    for r, e in zip(base, size, strict=True)
                ],
            )
            for size in sizes
        ]
        words.append(_changes(conclude("b", [tuple(runs)]))["all_pos_rmse_m"].word)
    assert words.count("no evidence") >= 18


def test_a_title_is_longer_than_its_table(make_rows):
    found = conclude(
        "a_long_name_of_a_run", [(Saved("a", make_rows(60)), Saved("b", make_rows(60)))]
    )
    stream = io.StringIO()
    print_table(make_console(stream, plain_width=80), settings_table(found))
    assert (
        stream.getvalue().splitlines()[0].strip() == "Settings of a_long_name_of_a_run that differ"
    )


def test_metric_names_are_not_broken_at_80_columns(make_rows):
    pair = Saved("a", _noisy(make_rows(60), 1.0)), Saved("b", _noisy(make_rows(60), 3.0, seed=6))
    out = io.StringIO()
    print_table(
        make_console(out, width=80), changes_table("a", conclude("b", [pair]), show_all=False)
    )
    lines = out.getvalue().splitlines()
    names = {
        line.split()[0]
        for line in lines[3:]
        if line.strip() and "metrics are not shown" not in line
    }
    assert names <= {m.name for m in METRICS}


def test_errors_of_coasting_scans_count(make_rows):
    base = make_rows(100)
    other = [dataclasses.replace(r, pos_err_m=1.0) if r.gamma == 0 else r for r in base]
    found = _changes(conclude("b", [(Saved("a", base), Saved("b", other))]))
    assert found["pose_pos_rmse_m"].word == "equal"
    assert found["all_pos_rmse_m"].other > 0.2


def test_one_used_scan_of_35_is_worse_not_better(make_rows):
    """Errors of healthy scans alone would call this an improvement."""
    base = make_rows(35)
    other = [
        dataclasses.replace(
            r,
            gamma=int(k == 0),
            reason="fit_error",
            pos_err_m=0.0005 if k == 0 else 0.5,
            converged=False,
        )
        for k, r in enumerate(base)
    ]
    found = conclude("b", [(Saved("a", base), Saved("b", other))])
    changes = _changes(found)
    assert changes["pose_pos_rmse_m"].other < changes["pose_pos_rmse_m"].base
    assert found.word == "worse"
    for name in ("healthy_ratio", "all_pos_rmse_m", "t1_s"):
        assert changes[name].word == "worse", name
    assert changes["t1_s"].note == "lost"
    assert "time of convergence (lost)" in found.sentence


def test_a_problem_that_disappears_is_not_a_lost_figure(make_rows):
    found = _changes(
        conclude("b", [(Saved("a", make_rows(60)), Saved("b", make_rows(60, blackout=range(0))))])
    )
    assert found["coast_pos_rmse_m"].word == "changed"


def test_headlines_are_metrics():
    assert set(COMPARED_METRICS) <= {m.name for m in METRICS}


def test_settings_that_differ_are_named(make_rows):
    config = {"faults": {"policy": "any"}, "plan": {"a_max_mps2": 0.05}}
    other = {"faults": {"policy": "all"}, "plan": {"a_max_mps2": 0.05}}
    left = Saved("a", make_rows(9), {"config": config, "log": {"name": "x.mcap", "sha256": "1"}})
    right = Saved("b", make_rows(9), {"config": other, "log": {"name": "y.mcap", "sha256": "2"}})
    assert conclude("b", [(left, right)]).settings == (
        "log = y.mcap (baseline x.mcap)",
        'faults.policy = "all" (baseline "any")',
    )


def _of_log(name, rows, sha256):
    return Saved(name, rows, {"log": {"name": f"{name}.mcap", "sha256": sha256}})


def test_runs_of_different_logs_are_not_compared_scan_by_scan(make_rows):
    rows = _noisy(make_rows(200), 1.0), _noisy(make_rows(200), 1.5, seed=6)
    assert conclude("b", [(_of_log("a", rows[0], "1"), _of_log("b", rows[1], "1"))]).word == "worse"
    found = conclude("b", [(_of_log("a", rows[0], "1"), _of_log("b", rows[1], "2"))])
    assert found.sentence.startswith(
        "b: the logs differ ('b.mcap', baseline 'a.mcap'), so that a comparison scan by scan"
    )
    assert "rms position error of all scans (" in found.sentence  # the figures are still named
    assert found.word == "no evidence"
    assert found.divergence is None
    assert {(c.word, c.low) for c in found.changes} == {("equal", None), ("changed", None)}


def test_different_logs_of_many_pairs_are_named_before_the_conclusion(make_rows):
    pairs = [
        (
            _of_log("a", _noisy(make_rows(30), 1.0, k), "1"),
            _of_log("b", _noisy(make_rows(30), 1.5, 50 + k), f"{k}"),
        )
        for k in range(8)
    ]
    found = conclude("g", pairs)
    assert found.sentence.startswith(
        "g: the logs of 7 of 8 pairs differ ('b.mcap', baseline 'a.mcap'): worse in"
    )


def test_groups_of_seeds_get_intervals_and_few_do_not(make_rows):
    def pairs(n, factor):
        return [
            (
                Saved(str(k), _noisy(make_rows(30), 1.0, k)),
                Saved(str(k), _noisy(make_rows(30), factor, 50 + k)),
            )
            for k in range(n)
        ]

    many = _changes(conclude("g", pairs(8, 1.4)))["pose_pos_rmse_m"]
    assert (many.word, many.low > 0.0) == ("worse", True)
    few = _changes(conclude("g", pairs(3, 1.4)))["pose_pos_rmse_m"]
    assert (few.word, few.low) == ("no evidence", None)


def test_runs_without_rows_have_a_conclusion(make_rows):
    assert conclude("b", [(Saved("a", make_rows(3)), Saved("b", []))]).word == "worse"
    assert conclude("b", [(Saved("a", []), Saved("b", []))]).word == "same"


@pytest.fixture
def seeds(tmp_path, make_rows):
    for group, factor in (("base", 1.0), ("other", 1.5)):
        for k in range(6):
            folder = tmp_path / group / f"seed-{k}"
            folder.mkdir(parents=True)
            write_rows(
                folder / "rows.jsonl", _noisy(make_rows(30), factor, k + 10 * (group == "other"))
            )
    return tmp_path


def test_folders_of_runs_are_paired_by_name(seeds):
    done = CliRunner().invoke(
        compare_command, [str(seeds / "base"), str(seeds / "other"), "--json"]
    )
    assert done.exit_code == 0, done.output
    conclusion = json.loads(done.stdout)["results"][1]["conclusion"]
    assert (conclusion["pairs"], conclusion["word"]) == (6, "worse")


def test_a_run_without_a_partner_is_a_usage_error(seeds):
    (seeds / "other" / "seed-5").rename(seeds / "other" / "seed-9")
    done = CliRunner().invoke(compare_command, [str(seeds / "base"), str(seeds / "other")])
    assert isinstance(done.exception, UsageError)
    assert "seed-5, seed-9 without a partner" in str(done.exception)


def test_markdown_is_a_heading_and_tables(seeds):
    done = CliRunner().invoke(
        compare_command,
        [str(seeds / "base" / "seed-0"), str(seeds / "other" / "seed-0"), "--markdown"],
    )
    lines = done.stdout.splitlines()
    assert lines[0].startswith("### ")
    table = [line for line in lines if line.startswith("|")]
    assert all(line.count("|") - line.count("\\|") >= 3 for line in table)
    assert any("all\\_pos\\_rmse\\_m" in line for line in table)
