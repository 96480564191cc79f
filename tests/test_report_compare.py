"""Comparison of runs: metrics, first difference, gate rules, and the formats for CI."""

from __future__ import annotations

import dataclasses
import io
import json
import shutil
import xml.etree.ElementTree as ET

import pytest
from click.testing import CliRunner
from rich.console import Console

from avsreplay.cli.compare import compare_command
from avsreplay.config import RunConfig, load_config
from avsreplay.errors import AvsError, CheckFailed, UnreadableInput, UsageError
from avsreplay.log import SourceOptions
from avsreplay.log.options import ClockChoice, Unit
from avsreplay.records import Label
from avsreplay.report.compare import METRICS, changed_settings, metrics
from avsreplay.report.gate import (
    GateRule,
    RuleOutcome,
    check_gate,
    github_lines,
    judge,
    junit,
    load_rules,
)
from avsreplay.report.golden import compare_rows
from avsreplay.report.jsonl import write_rows
from avsreplay.report.page import build_comparison
from avsreplay.report.result import load_result, write_manifest
from avsreplay.report.summary import Summary
from avsreplay.report.table import print_sparks, spark


def _summary(rows):
    return Summary.fold(rows, labels=[Label("full_occlusion", rows[20].t_ns, rows[25].t_ns)])


def test_every_metric_has_a_value_or_none(make_rows):
    figures = metrics(_summary(make_rows(40)))
    assert list(figures) == [m.name for m in METRICS]
    assert len(set(figures)) == len(METRICS)
    assert all(v is None or isinstance(v, (int, float)) for v in figures.values())


def test_figures_are_the_summarys(make_rows):
    rows = make_rows(40)
    summary, figures = _summary(rows), metrics(_summary(rows))
    assert figures["pose_pos_rmse_m"] == summary.pose_healthy.position_m.rmse
    assert figures["coast_rot_max_deg"] == summary.pose_coasting.rotation_deg.max
    assert figures["coast_end_pos_m"] == rows[25].pos_err_m
    assert (figures["scans"], figures["healthy"], figures["faults_missed"]) == (40, 34, 0)


def test_no_rows_have_no_figures_and_no_zeros(make_rows):
    figures = metrics(Summary.fold([]))
    assert figures["pose_pos_rmse_m"] is None
    assert figures["false_alarms"] is None
    assert figures["healthy_ratio"] is None


def test_the_first_divergence_is_the_first_scan_beyond_tolerance(make_rows):
    rows = make_rows(40)
    other = [dataclasses.replace(r, x_m=r.x_m + (1e-9 if r.seq < 17 else 0.01)) for r in rows]
    found = compare_rows(rows, other)
    assert (found.differences[0].seq, found.differences[0].column, found.count) == (17, "x_m", 23)
    assert compare_rows(rows, rows).ok


BASE = {"pose_pos_rmse_m": 0.004, "false_alarms": 0.0, "t1_s": None, "healthy": 100.0}


@pytest.mark.parametrize(
    ("limits", "value", "ok"),
    [
        ({"max": 0.005}, 0.005, True),
        ({"max": 0.005}, 0.0051, False),
        ({"min": 0.001}, 0.0009, False),
        ({"max_ratio": 1.1}, 0.0044, True),
        ({"max_ratio": 1.1}, 0.00441, False),
        ({"min_ratio": 0.5}, 0.0019, False),
        ({"max_increase": 0.001}, 0.005, True),
        ({"max_increase": 0.001}, 0.0051, False),
        ({"max_decrease": 0.001}, 0.0029, False),
        ({"max": 0.01, "max_ratio": 1.1}, 0.009, False),
    ],
)
def test_each_limit_holds_up_to_its_edge(limits, value, ok):
    rule = GateRule("pose_pos_rmse_m", **limits)
    (outcome,) = judge([rule], [("base", BASE), ("new", BASE | {"pose_pos_rmse_m": value})])
    assert (outcome.run, outcome.ok) == ("new", ok)
    assert ok == (outcome.why == "")


def test_a_ratio_to_zero_allows_no_increase():
    rule = GateRule("false_alarms", max_ratio=2.0)
    outcomes = judge([rule], [("a", BASE), ("b", BASE), ("c", BASE | {"false_alarms": 1.0})])
    assert [o.ok for o in outcomes] == [True, False]


def test_a_missing_figure_breaks_the_rule_unless_optional():
    runs = [("a", BASE), ("b", BASE)]
    assert [
        o.ok
        for o in judge([GateRule("t1_s", max=10), GateRule("t1_s", max=10, optional=True)], runs)
    ] == [
        False,
        True,
    ]
    assert not judge([GateRule("t1_s", max_ratio=2)], [("a", BASE), ("b", BASE | {"t1_s": 3.0})])[
        0
    ].ok


def test_an_optional_rule_does_not_skip_a_lost_value():
    rules = [
        GateRule("t1_s", max_increase=2.0, optional=True),
        GateRule("capture_s", max=40.0, optional=True),
    ]
    base = BASE | {"t1_s": 8.0, "capture_s": 29.0}
    outcomes = judge(rules, [("base", base), ("new", base | {"t1_s": None, "capture_s": None})])
    assert [o.ok for o in outcomes] == [False, False]
    assert outcomes[0].why == "the run has lost the value (baseline 8)"


def test_a_run_that_used_no_scan_cannot_pass(make_rows):
    rows = make_rows(30, gamma=0, reason="not_aligned", nis=None)
    figures = metrics(Summary.fold(rows))
    outcomes = judge(
        [GateRule("false_alarms", max=1000.0, optional=True)], [("run", figures)], baseline=False
    )
    assert outcomes[-1].why == "the run used no scan"
    with pytest.raises(CheckFailed):
        check_gate(outcomes)


def test_one_run_is_judged_by_absolute_rules_only():
    assert judge([GateRule("healthy", min=90)], [("a", BASE)])[0].ok
    with pytest.raises(UsageError, match="needs a baseline"):
        judge([GateRule("healthy", min_ratio=0.9)], [("a", BASE)])


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", r"no \[\[rule\]\]"),
        ('[[rule]]\nmetric = "nope"\nmax = 1', "unknown metric 'nope'"),
        ('[[rule]]\nmetric = "t1_s"', "has no limit"),
        (
            '[[rule]]\nmetric = "t1_s"\nmx = 1',
            r"rules\.toml:3: unknown key 'rule\.0\.mx'; did you mean 'rule\.0\.max'",
        ),
        ('[[rule]]\nmetric = "t1_s"\nmax = "1"', r":3: 'rule\.0\.max' must be a number"),
        ("[[rule", "not valid TOML"),
    ],
)
def test_bad_rules_are_one_line_with_the_place(tmp_path, text, match):
    path = tmp_path / "rules.toml"
    path.write_text(text)
    with pytest.raises(UsageError, match=match):
        load_rules(path)
    with pytest.raises(UnreadableInput):
        load_rules(tmp_path / "none.toml")


EVIL = 'a<b> & "c":,%\n::error::d'


def _outcomes():
    return [
        RuleOutcome("run", GateRule("t1_s", max=10), 5.0, True),
        RuleOutcome(
            EVIL, GateRule("t1_s", max=10, note="later is useless"), 11.0, False, "11 > 10, max 10"
        ),
    ]


def test_junit_is_well_formed_counts_and_has_no_clock():
    root = ET.fromstring(junit(_outcomes()))
    suites = root.findall("testsuite")
    assert [(s.get("tests"), s.get("failures")) for s in suites] == [("1", "0"), ("1", "1")]
    failure = suites[1].find("testcase/failure")
    assert (failure.get("message"), failure.text) == ("11 > 10, max 10", "later is useless")
    assert junit(_outcomes()) == junit(_outcomes())
    assert "time" not in junit(_outcomes()).replace("t1_s", "")


def test_github_annotations_are_escaped():
    assert github_lines(_outcomes()[:1]) == ["::notice title=avsreplay gate::1 rules hold"]
    (line,) = github_lines(_outcomes())
    assert "\n" not in line
    assert line.startswith("::error title=avsreplay gate%3A a<b>")
    assert line.count("::") == 2
    assert line.endswith("::t1_s: 11 > 10, max 10")


def test_the_gate_names_the_first_broken_rule():
    check_gate(_outcomes()[:1])
    with pytest.raises(
        CheckFailed, match=r"(?s)1 of 2 rules broken, .*t1_s: 11 > 10.*later is useless"
    ):
        check_gate(_outcomes())


def test_a_setting_of_the_log_is_not_called_the_users():
    of_log = load_config(None, {"faults": {"policy": "all"}}, ["register.gate_m=0.2"])
    stated = changed_settings(load_config(None, {}, ["register.gate_m=0.2"]))
    by_user, by_log = sorted(changed_settings(of_log, stated=stated), reverse=True)
    assert by_user in stated
    assert by_log == 'faults.policy = "all" (default "any"; by the log)'


def test_every_reading_option_that_is_given_is_stated():
    assert changed_settings(SourceOptions(), RunConfig()) == []
    examples = {bool: True, int: 7, float: 7.5, tuple: (1.0, 2.0), type(None): "x", Unit: Unit.MM}
    special = {
        "crop_box": (0.0, 0.0, 0.0, 1.0, 2.0, 3.0),
        "clock": ClockChoice.LOG,
        "grasp": (1.0, 2.0, 3.0),
        "point_time": "t:ns:stamp",
        "no_return": "0,0,0",
    }
    for field in dataclasses.fields(SourceOptions):
        value = special.get(field.name, examples.get(type(field.default)))
        if field.name in (
            "start_s",
            "end_s",
            "duration_s",
            "rate_hz",
            "n_scans",
            "pose_sigma",
            "crop_range",
        ):
            value = {"n_scans": 3, "pose_sigma": (1.0, 2.0), "crop_range": (1.0, 2.0)}.get(
                field.name, 2.5
            )
        (line,) = changed_settings(SourceOptions(**{field.name: value}), RunConfig())
        assert line.startswith(f"{field.name} = "), line
        assert " (default " in line
        assert "(default null" not in line


# ---- the command


@pytest.fixture
def runs(tmp_path, make_rows):
    worse = [dataclasses.replace(r, pos_err_m=2 * r.pos_err_m) for r in make_rows(40)]
    for name, rows in (("base", make_rows(40)), ("same", make_rows(40)), ("worse", worse)):
        (tmp_path / name).mkdir()
        write_rows(tmp_path / name / "rows.jsonl", rows)
        write_manifest(tmp_path / name, {}, len(rows))
    (tmp_path / "rules.toml").write_text(
        '[[rule]]\nmetric = "pose_pos_rmse_m"\nmax_ratio = 1.5\nnote = "no regress"\n'
    )
    return tmp_path


def _run(*arguments):
    return CliRunner().invoke(compare_command, [str(a) for a in arguments])


def test_the_table_shows_changes_and_the_compare_rows(runs):
    done = _run(runs / "base", runs / "same", runs / "worse")
    assert done.exit_code == 0, done.output
    assert "+100.0 %" in done.output
    assert "worse: worse in rms position error of all scans (" in done.output
    assert "same: no difference; all 40 rows agree" in done.output
    assert "worse: 40 cells differ from base, first at scan 0, column pos_err_m" in done.output
    assert (
        max(
            len(line)
            for line in done.output.splitlines()
            if "cells" not in line and "agree" not in line
        )
        <= 80
    )


def test_the_gate_fails_with_its_own_code_and_writes_for_ci(runs):
    good = _run(runs / "base", runs / "same", "--gate", runs / "rules.toml", "--github")
    assert good.exit_code == 0
    assert "::notice" in good.output
    bad = _run(
        runs / "base",
        runs / "worse",
        "--gate",
        runs / "rules.toml",
        "--junit",
        runs / "g.xml",
        "--github",
    )
    assert isinstance(bad.exception, CheckFailed)
    assert bad.exception.exit_code == 1
    assert "::error title=avsreplay gate%3A worse::pose_pos_rmse_m: " in bad.output
    assert ET.parse(runs / "g.xml").getroot().find("testsuite").get("failures") == "1"


def test_json_is_all_there_is_on_stdout(runs):
    done = _run(runs / "base", runs / "worse", "--gate", runs / "rules.toml", "--json", "--github")
    whole = json.loads(done.stdout)
    assert [r["name"] for r in whole["results"]] == ["base", "worse"]
    assert whole["results"][1]["conclusion"]["word"] == "worse"
    assert whole["results"][1]["divergence"]["by_column"] == {"pos_err_m": 40}
    assert whole["results"][1]["divergence"]["first"]["seq"] == 0
    assert [o["ok"] for o in whole["gate"]] == [False]


def test_runs_of_one_name_are_distinguished(runs):
    other = runs / "elsewhere"
    other.mkdir()
    shutil.copytree(runs / "worse", other / "base")
    whole = json.loads(_run(runs / "base", other / "base", "--json").stdout)
    assert [r["name"] for r in whole["results"]] == ["base#1", "base#2"]


def test_a_single_run_can_be_gated(runs):
    (runs / "rules.toml").write_text('[[rule]]\nmetric = "pose_pos_rmse_m"\nmax = 0.004\n')
    assert _run(runs / "base", "--gate", runs / "rules.toml").exit_code == 0
    assert isinstance(_run(runs / "worse", "--gate", runs / "rules.toml").exception, CheckFailed)


@pytest.mark.parametrize("arguments", [["--junit", "x.xml"], ["--github"]])
def test_outcomes_without_a_gate_are_a_usage_error(runs, arguments):
    assert isinstance(_run(runs / "base", *arguments).exception, UsageError)


def test_a_missing_result_is_one_line(runs):
    done = _run(runs / "base", runs / "none")
    assert isinstance(done.exception, AvsError)
    assert done.exception.exit_code == 3


def test_metrics_are_listed():
    done = _run("--metrics")
    assert done.exit_code == 0
    assert [line.split()[0] for line in done.output.splitlines()] == [m.name for m in METRICS]


def test_the_page_overlays_the_runs_and_keeps_what_is_there(runs):
    done = _run(runs / "base", runs / "worse", "-o", runs / "c.html")
    assert done.exit_code == 0, done.output
    page = (runs / "c.html").read_text(encoding="utf-8")
    assert "2 runs: base, worse." in page
    assert isinstance(_run(runs / "base", "-o", runs / "c.html").exception, UsageError)
    assert _run(runs / "base", "-o", runs / "c.html", "--overwrite").exit_code == 0


def test_the_page_shows_the_result_of_the_gate(runs):
    results = [load_result(runs / name) for name in ("base", "worse")]
    assert "1 of 2 rules broken" in build_comparison(results, [], _outcomes())
    assert "All 1 rules hold" in build_comparison(results, [], _outcomes()[:1])


# ---- sparklines


def test_a_spark_keeps_extremes_and_shows_blanks():
    values = [0.0] * 1000
    values[517] = 5.0
    line = spark(values, 50)
    assert len(line) == 50
    assert line.index("█") == 25
    assert spark([None, 1.0, None], 10) == " █ "
    assert spark([], 10) == ""
    assert spark([0.0, 0.0], 10) == "▁▁"


def test_sparks_only_on_a_wide_terminal(make_rows):
    def printed(**options):
        stream = io.TextIOWrapper(io.BytesIO(), encoding=options.pop("encoding", "utf-8"))
        print_sparks(Console(file=stream, color_system=None, **options), make_rows(40))
        stream.flush()
        return stream.buffer.getvalue().decode()

    wide = printed(force_terminal=True, width=120)
    assert wide.splitlines()[2].count("✗") == 6
    assert all(len(line) <= 120 for line in wide.splitlines())
    assert printed(force_terminal=True, width=90) == ""
    assert printed(force_terminal=False, width=120) == ""
    assert printed(force_terminal=True, width=120, encoding="ascii") == ""
