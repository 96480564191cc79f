"""Golden comparison: in both directions, each column by its declared tolerance, missing
values included.
"""

from __future__ import annotations

import dataclasses
import io
import json

import pytest

from avsreplay.errors import CheckFailed, UnreadableInput
from avsreplay.report.golden import ABSENT, compare_golden, golden_table, update_golden
from avsreplay.report.jsonl import write_rows
from avsreplay.report.table import make_console, print_table
from avsreplay.rows import columns


@pytest.fixture
def golden(tmp_path, make_rows):
    path = tmp_path / "case.rows.jsonl"
    write_rows(path, make_rows(30))
    return path


def test_the_same_rows_agree(golden, make_rows):
    result = compare_golden(golden, make_rows(30))
    assert result.ok
    assert result.rows == 30
    result.check("x")


def _nudged(rows, name, amount):
    return [
        dataclasses.replace(r, **{name: getattr(r, name) + amount})
        if getattr(r, name) is not None
        else r
        for r in rows
    ]


NUMBERS = [c for c in columns() if c.rtol or c.atol]


@pytest.mark.parametrize("column", NUMBERS, ids=lambda c: c.name)
def test_each_tolerance_is_the_declared_one(tmp_path, make_rows, column):
    value = 3 if column.name == "inliers" else 0.25
    base = make_rows(3, blackout=range(0), **{column.name: value})
    path = tmp_path / "g.jsonl"
    write_rows(path, base)
    limit = column.atol + column.rtol * value
    inside, outside = (limit * 0.99, limit * 1.01) if column.name != "inliers" else (3, 4)
    for sign in (-1, 1):
        assert compare_golden(path, _nudged(base, column.name, sign * inside)).ok
        result = compare_golden(path, _nudged(base, column.name, sign * outside))
        assert result.by_column == {column.name: 3}
        assert result.differences[0].tolerance == pytest.approx(limit)


EXACT = (
    "t_ns",
    "status",
    "gamma",
    "reason",
    "guess",
    "fault",
    "iterations",
    "ogm_rank",
    "converged",
    "sigma_hits",
)


@pytest.mark.parametrize("name", EXACT)
def test_flags_and_states_are_exact(golden, make_rows, name):
    rows = make_rows(30)
    old = getattr(rows[4], name)
    new = (not old) if isinstance(old, bool) else old + 1 if isinstance(old, int) else "other"
    rows[4] = dataclasses.replace(rows[4], **{name: new})
    result = compare_golden(golden, rows)
    assert [(d.seq, d.column, d.expected, d.got, d.tolerance) for d in result.differences] == [
        (4, name, old, new, None)
    ]


@pytest.mark.parametrize("wrong", [True, 1.0])
def test_a_flag_is_not_a_number_nor_a_number_a_flag(golden, make_rows, wrong):
    rows = make_rows(30)
    rows[3] = dataclasses.replace(rows[3], gamma=wrong, converged=0)
    columns_hit = compare_golden(golden, rows).by_column
    assert "converged" in columns_hit
    assert ("gamma" in columns_hit) == (wrong is True)


def test_null_against_a_value_is_a_difference_both_ways(golden, make_rows):
    rows = make_rows(30)
    rows[2] = dataclasses.replace(rows[2], rms_m=None)
    rows[22] = dataclasses.replace(rows[22], rms_m=0.008)
    result = compare_golden(golden, rows)
    assert [(d.seq, d.expected is None, d.got is None) for d in result.differences] == [
        (2, False, True),
        (22, True, False),
    ]


def test_missing_rows_fail_on_either_side(golden, make_rows):
    fewer = compare_golden(golden, make_rows(28))
    assert [(d.seq, d.column, d.got) for d in fewer.differences] == [
        (28, "row", ABSENT),
        (29, "row", ABSENT),
    ]
    more = compare_golden(golden, make_rows(31))
    assert [(d.seq, d.column, d.expected) for d in more.differences] == [(30, "row", ABSENT)]


def test_a_missing_column_fails_on_the_file_side(golden, make_rows):
    records = [json.loads(line) for line in golden.read_text().splitlines()]
    for record in records:
        del record["nis"]
    golden.write_text("".join(json.dumps(r) + "\n" for r in records))
    result = compare_golden(golden, make_rows(30))
    assert [(d.seq, d.column, d.expected, d.got) for d in result.differences] == [
        (None, "nis", ABSENT, "present")
    ]


def test_an_undeclared_column_fails(golden, make_rows):
    records = [json.loads(line) | {"extra": 1} for line in golden.read_text().splitlines()]
    golden.write_text("".join(json.dumps(r) + "\n" for r in records))
    result = compare_golden(golden, make_rows(30))
    assert result.by_column == {"extra": 30}


def test_an_empty_golden_fails_against_rows(golden, make_rows):
    golden.write_text("")
    assert compare_golden(golden, make_rows(5)).count == 5


def test_all_are_counted_and_the_first_kept(golden, make_rows):
    result = compare_golden(golden, _nudged(make_rows(30), "x_m", 1.0), first=4)
    assert (len(result.differences), result.count) == (4, 30)
    with pytest.raises(CheckFailed, match=r"30 differences.*scan 0, column x_m") as caught:
        result.check(str(golden))
    assert caught.value.exit_code == 1


def test_a_missing_golden_file_cannot_be_read(tmp_path, make_rows):
    with pytest.raises(UnreadableInput, match="--update-golden"):
        compare_golden(tmp_path / "none.jsonl", make_rows(2))


@pytest.mark.parametrize("text", ["not json\n", '{"seq": "a"}\n', '{"seq": 1}\n{"seq": 1}\n'])
def test_an_invalid_golden_file_is_one_line(golden, make_rows, text):
    golden.write_text(text)
    with pytest.raises(UnreadableInput):
        compare_golden(golden, make_rows(2))


def test_update_writes_and_says_what_changed(golden, make_rows, tmp_path):
    rows = _nudged(make_rows(30), "x_m", 1.0)
    former = update_golden(golden, rows)
    assert former is not None
    assert former.count == 30
    assert compare_golden(golden, rows).ok
    assert update_golden(tmp_path / "new.jsonl", rows) is None
    assert (tmp_path / "new.jsonl").read_bytes() == golden.read_bytes()


def test_the_table_names_scan_column_values_and_tolerance(golden, make_rows):
    stream = io.StringIO()
    result = compare_golden(golden, _nudged(make_rows(30), "x_m", 0.5))
    print_table(make_console(stream), golden_table(result))
    text = stream.getvalue()
    for word in (
        "scan",
        "column",
        "expected",
        "got",
        "tolerance",
        "x_m",
        "1.1e-05",
        "by column: x_m 30",
        "20 of 30",
    ):
        assert word in text
    assert max(len(line) for line in text.splitlines()) <= 80
