"""Tables fit the width, name the columns that are left out, and need no colour."""

from __future__ import annotations

import dataclasses
import io
import re
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from avsreplay.records import Label
from avsreplay.report.summary import Summary
from avsreplay.report.summary_tables import print_tables
from avsreplay.report.table import (
    Table,
    choose_rows,
    decimals,
    head,
    make_console,
    print_line,
    print_table,
    state_cell,
)
from avsreplay.rows import columns


def _printed(rows, *, width=None, encoding="utf-8", **flags) -> str:
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding=encoding, newline="\n")
    summary = Summary.fold(rows, labels=flags.pop("labels", None))
    print_tables(make_console(stream, width=width), rows, summary, **flags)
    stream.flush()
    return raw.getvalue().decode(encoding)


def test_off_a_terminal_it_is_80_wide_whatever_the_environment_says(make_rows, monkeypatch):
    plain = _printed(make_rows(600))
    monkeypatch.setenv("COLUMNS", "200")
    assert _printed(make_rows(600)) == plain
    assert max(len(line) for line in plain.splitlines()) <= 80


def test_no_cell_is_cut_at_80(make_rows):
    for n in (5, 600, 6000):
        assert "…" not in _printed(make_rows(n))


def test_every_parameter_is_named_at_80(make_rows):
    known = {
        "ixx": 0.4,
        "iyy": 0.3,
        "izz": 0.3,
        "ixy": 0.0051,
        "ixz": -0.0123,
        "iyz": -0.0451,
        "inertia_1s": 0.01,
    }
    text = _printed(make_rows(5, **known))
    for name, value in zip(
        ("xx", "yy", "zz", "xy", "xz", "yz"), list(known.values())[:6], strict=True
    ):
        line = next(
            line
            for line in text.splitlines()
            if line.startswith(f"inertia / trace in {{C}} {name}")
        )
        assert f"{value:.4f}" in line


def test_no_escape_codes_off_a_terminal(make_rows):
    assert "\x1b" not in _printed(make_rows(30))


@pytest.mark.parametrize("width", [70, 80, 100, 160, 250])
def test_every_width_is_kept_and_what_is_left_out_is_named(make_rows, width):
    text = _printed(make_rows(30), width=width)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= width
    assert ("not shown at this width" in text) == (width < 160)


def test_units_are_in_the_headings(make_rows):
    text = _printed(make_rows(30), width=200)
    for unit in ("[mm]", "[deg]", "[s]"):
        assert unit in text.split("Errors")[0]


def test_lengths_are_in_metres_from_1_m_on_and_in_millimetres_below(make_rows):
    for error, cell, unit in ((0.0123, "12.3", "[mm]"), (1.25, "1.2500", "[m]")):
        text = _printed(make_rows(3, pos_err_m=error, rms_m=0.5), width=200).split("Errors")[0]
        heads, rows = (
            text.split("scan ")[0] + text.split("scan ")[1].split("\n")[0],
            text.split("\n"),
        )
        assert unit in heads
        assert any(f" {cell} " in row for row in rows), text


def test_headings_omit_the_suffix_and_keep_the_unit():
    heads = {c.name: head(c) for c in columns()}
    assert heads["rms_m"] == "rms\n[m]"
    assert heads["wx_radps"] == "wx\n[rad/s]"
    assert all((f"[{c.unit}]" in heads[c.name]) == bool(c.unit) for c in columns())


def test_a_log_of_600_is_decimated_and_keeps_the_turns(make_rows):
    rows = make_rows(600, blackout=range(301, 361))
    chosen, words = choose_rows(rows)
    assert [r.seq for r in chosen if r.gamma == 0] == [301, 325, 350]
    assert 361 in [r.seq for r in chosen]
    assert (chosen[0].seq, chosen[-1].seq) == (0, 599)
    assert words == "every 25th of 600 scans and where gamma changes"


def test_every_and_all(make_rows):
    rows = make_rows(100)
    assert [r.seq for r in choose_rows(rows, every=40)[0]] == [0, 40, 80]
    assert choose_rows(rows, every=40)[1] == "every 40th of 100 scans"
    assert len(choose_rows(rows, show_all=True)[0]) == 100


def test_a_flickering_detector_does_not_flood_the_table(make_rows):
    rows = [dataclasses.replace(r, gamma=r.seq % 2) for r in make_rows(600)]
    assert len(choose_rows(rows)[0]) <= 26


@pytest.mark.parametrize(("gamma", "reason"), [(1, "ok"), (0, "no_scan"), (0, "pose_jump")])
def test_the_three_states_differ_without_colour(gamma, reason):
    signs = {state_cell(g, r).signed()[0] for g, r in ((1, "ok"), (0, "no_scan"), (0, "pose_jump"))}
    assert len(signs) == 3
    assert reason in state_cell(gamma, reason).signed()


def test_an_ascii_stream_gets_ascii(make_rows):
    text = _printed(make_rows(40), encoding="ascii")
    assert "o ok" in text
    assert "~ no_scan" in text


def test_small_targets_get_their_figures():
    assert decimals([0.00004, 0.00005], 4) == 7
    assert decimals([0.5], 4) == 4
    assert decimals([0.0], 4) == 4
    assert decimals([1e-30], 4) == 8


def test_the_fault_table_says_detected_missed_and_harmless(make_rows):
    rows = [
        dataclasses.replace(r, fault={30: "range_bias", 35: "clutter"}.get(r.seq, r.fault))
        for r in make_rows(40)
    ]
    labels = [
        Label("full_occlusion", rows[20].t_ns, rows[25].t_ns),
        Label("range_bias", rows[30].t_ns, rows[30].t_ns),
        Label("clutter", rows[35].t_ns, rows[35].t_ns, harmful=False),
    ]
    text = _printed(rows, labels=labels)
    for pattern in (
        r"full_occlusion .* 6/6 .*detected +0\.00 +0\.00",
        r"range_bias .* 0/1 .*missed +\S +\S$",
        r"clutter .* 0/1 .*usable, used",
        r"2 injected, 1 detected, 1 missed; 6 of 7 unusable scans",
    ):
        assert re.search(pattern, text, re.MULTILINE), pattern


def test_the_fault_table_shows_the_detection_time_and_a_track_that_is_not_recovered(make_rows):
    rows = [dataclasses.replace(r, gamma=1, reason="ok", fault=None) for r in make_rows(40)]
    rows = [
        dataclasses.replace(r, fault="partial_occlusion") if 10 <= r.seq < 30 else r for r in rows
    ]
    rows = [dataclasses.replace(r, gamma=0, reason="fit_error") if r.seq >= 12 else r for r in rows]
    window = (rows[10].t_ns, rows[29].t_ns)
    labels = [Label("partial_occlusion", *window), Label("dropped", rows[35].t_ns, rows[36].t_ns)]
    text = _printed([r for r in rows if r.seq not in (35, 36)], labels=labels)
    assert re.search(r"partial_occlusion .* 18/20 .*detected +0\.40 +never", text)
    assert re.search(r"dropped .* 0/0 .*detected as a gap +\S+ +never", text)
    assert "…" not in text


def test_speed_is_in_the_table_only(make_rows):
    assert "speed" not in _printed(make_rows(3))
    assert "123.4 scans/s" in _printed(make_rows(3), scans_per_s=123.4)


def test_no_rows_print_a_summary():
    assert "scans" in _printed([])


def test_brackets_in_a_cell_are_text(make_rows):
    assert "[bold]" in _printed(make_rows(3, reason="[bold]", gamma=0, fault=None), width=120)


def test_importing_the_report_loads_no_heavy_library():
    code = (
        "import avsreplay.report, sys; print([m for m in ('rich', 'plotly', 'pyarrow') if m in"
        " sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("tight", [False, True])
@given(
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=6),
    st.integers(20, 90),
)
def test_no_number_and_no_name_is_cut_at_any_width(
    tight: bool, values: list[float], width: int
) -> None:
    stream = io.StringIO()
    texts = [f"{value:.5g}" for value in values]
    rows = tuple(
        (f"name_of_a_long_metric_{k}", "some words that can wrap", t, t)
        for k, t in enumerate(texts)
    )
    table = Table("title", ("metric", "meaning", "baseline", "this"), rows, align="nlr")
    print_table(make_console(stream, width=width), table, tight=tight)
    lines = stream.getvalue().splitlines()
    for k, text in enumerate(texts):
        line = next(line for line in lines if f"name_of_a_long_metric_{k} " in line)
        assert line.split()[-2:] == [text, text]


@pytest.mark.parametrize("width", [20, 40, 79])
def test_text_without_a_table_keeps_to_the_width_of_the_console(width: int) -> None:
    stream = io.StringIO()
    print_line(make_console(stream, width=width), "The word and the number 12345 of a row. " * 6)
    lines = stream.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    assert (
        " ".join(" ".join(lines).split())
        == ("The word and the number 12345 of a row. " * 6).strip()
    )
