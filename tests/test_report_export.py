"""Rows and poses written to files and read back: exact, in order, complete or absent."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import runpy
import sys
import tempfile
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avsreplay.errors import MissingBackend, UnreadableInput, UsageError
from avsreplay.geometry import Pose, exp
from avsreplay.outcome import PlanStatus
from avsreplay.plan.supervisor import Action
from avsreplay.records import AlignStatus, Reason, ScanStatus
from avsreplay.report import export, jsonl
from avsreplay.report.export import (
    FREQUENT_COLUMNS,
    columns_page,
    document_parts,
    row_poses,
    row_schema,
    row_schema_text,
    stamp_text,
    write_csv,
    write_kitti,
    write_parquet,
    write_tum,
)
from avsreplay.report.jsonl import dump_row, parse_row, read_rows, write_rows
from avsreplay.report.summary import Summary
from avsreplay.rows import Row, columns, field_types

ROOT = Path(__file__).parent.parent


def test_rows_are_read_back_bit_for_bit(tmp_path, make_rows):
    rows = make_rows(50, x_m=0.1 + 0.2, t_ns=2**62 + 1)
    assert write_rows(tmp_path / "a.jsonl", rows) == 50
    assert read_rows(tmp_path / "a.jsonl") == rows


def test_keys_stand_in_the_order_of_the_fields(make_rows):
    names = [f.name for f in dataclasses.fields(Row)]
    assert list(json.loads(dump_row(make_rows(1)[0]))) == names == [c.name for c in columns()]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, np.float64("nan")])
def test_what_is_not_finite_is_null(make_rows, value):
    assert json.loads(dump_row(make_rows(1, rms_m=value)[0]))["rms_m"] is None


def test_numpy_scalars_are_plain_numbers(make_rows):
    row = make_rows(1, inliers=np.int64(7), rms_m=np.float64(0.1), converged=np.bool_(True))[0]
    record = json.loads(dump_row(row))
    assert (record["inliers"], record["rms_m"], record["converged"]) == (7, 0.1, True)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_float_reads_back_to_itself(value):
    row = dataclasses.replace(_bare(), rms_m=value)
    back = parse_row(json.loads(dump_row(row)), "x").rms_m
    assert back == value
    assert math.copysign(1, back) == math.copysign(1, value)


def _bare() -> Row:
    blank = {str: "", int: 0, float: 0.0, bool: False}
    return Row(
        **{name: blank[kind] for name, (kind, nullable) in field_types().items() if not nullable}
    )


def test_an_older_result_lacks_words_and_nulls_only(make_rows):
    record = json.loads(dump_row(make_rows(1)[0]))
    del record["action"], record["rms_m"]
    row = parse_row(record, "x")
    assert (row.action, row.rms_m) == ("", None)
    with pytest.raises(UnreadableInput, match="'t_ns' is missing"):
        parse_row({k: v for k, v in record.items() if k != "t_ns"}, "x")
    with pytest.raises(UnreadableInput, match="'action' is missing or null"):
        parse_row(record | {"action": None}, "x")


def test_a_failed_write_keeps_the_old_file(tmp_path, make_rows):
    path = tmp_path / "a.jsonl"
    path.write_text("before")
    with pytest.raises(ZeroDivisionError):
        write_rows(path, (row for row in make_rows(3) if 1 / (2 - row.seq)))
    assert path.read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == ["a.jsonl"]


def test_a_folder_that_is_not_there_is_one_line(tmp_path, make_rows):
    with pytest.raises(UsageError, match="no such folder"):
        write_rows(tmp_path / "no" / "a.jsonl", make_rows(1))


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{", "1: not valid JSON"),
        ("[1]", "1: not a JSON object"),
        ('{"seq": NaN}', "not valid JSON"),
        ("[" * 100_000, "not valid JSON"),
        ('{"nonsense": 1}', "unknown column 'nonsense'"),
        ("{}", "column 'seq' is missing or null"),
        ('{"seq": "0"}', "column 'seq' is '0'; it must be int"),
        ('{"seq": true}', "it must be int"),
    ],
)
def test_bad_rows_are_one_line_with_the_place(tmp_path, text, match):
    path = tmp_path / "a.jsonl"
    path.write_text(text)
    with pytest.raises(UnreadableInput, match=match):
        read_rows(path)


TOKENS = (
    *("null", "true", "-1", "3.0", "1e101", "1e999", "NaN", "9" * 400, "-0.0", "1e-400", "01"),
    *('"x"', "[]", "{}", "", '"\\ud800"', '"\\u0007"', '"=1"', '"\u2028"', "\u2028"),
    *('0, "nonsense": 1', '0}\n{"seq": 9'),
)


@given(
    st.lists(st.tuples(st.integers(0, 4), st.integers(0, 200), st.sampled_from(TOKENS)), max_size=3)
)
def test_blocks_are_read_as_cell_by_cell(changes):
    """Rows checked at once are those that the reader of single cells gives, and so are the
    errors.
    """
    lines = (ROOT / "fixtures" / "tumble.rows.jsonl").read_text(encoding="utf-8").splitlines()[:5]
    for number, place, token in changes:
        cells = lines[number].split(", ")
        name, colon, _ = cells[place % len(cells)].partition(": ")
        cells[place % len(cells)] = f"{name}{colon}{token}"
        lines[number] = ", ".join(cells) if place < 190 else ", ".join(cells[:-1])
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        path = Path(folder) / "a.jsonl"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        at_once = _rows_or_error(path)
        patch.setattr(jsonl, "_decoder", lambda: None)  # as where msgspec is not installed
        assert at_once == _rows_or_error(path)


def _rows_or_error(path: Path) -> list[Row] | str:
    try:
        return read_rows(path)
    except UnreadableInput as error:
        return str(error)


def test_blocks_are_decoded_at_once_and_lines_counted_across_them(tmp_path, monkeypatch):
    text = (ROOT / "fixtures" / "tumble.rows.jsonl").read_bytes()
    one_by_one = [parse_row(json.loads(line), "") for line in text.splitlines()]
    assert read_rows(ROOT / "fixtures" / "tumble.rows.jsonl") == one_by_one
    monkeypatch.setattr(jsonl, "_READ_BYTES", 5000)  # about one row
    assert read_rows(ROOT / "fixtures" / "tumble.rows.jsonl") == one_by_one
    lines = text.splitlines()
    lines[20] = lines[20].replace(b'"seq": 20', b'"seq": 19')
    (tmp_path / "a.jsonl").write_bytes(b"\n\n" + b"\n".join(lines))
    with pytest.raises(UnreadableInput, match=r"a\.jsonl:23: scan 19 after scan 19"):
        read_rows(tmp_path / "a.jsonl")


def test_bytes_that_are_not_utf8_are_one_line(tmp_path):
    (tmp_path / "a.jsonl").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UnreadableInput, match="not UTF-8"):
        read_rows(tmp_path / "a.jsonl")
    with pytest.raises(UnreadableInput, match="no such file"):
        read_rows(tmp_path / "b.jsonl")


@given(st.integers(-(2**62), 2**62))
def test_stamps_are_exact(t_ns):
    text = stamp_text(t_ns)
    whole, fraction = text.lstrip("-").split(".")
    assert len(fraction) == 9
    assert (int(whole) * 10**9 + int(fraction)) * (-1 if text.startswith("-") else 1) == t_ns


def test_tum_and_kitti_give_the_poses_back(tmp_path, make_rows):
    poses = [(5 + k, Pose(exp([0.1 * k, -0.2, 0.3]), [k / 3, 2.0, 3.0])) for k in range(5)]
    assert write_tum(tmp_path / "a.tum", poses) == 5
    assert write_kitti(tmp_path / "a.kitti", [pose for _, pose in poses]) == 5
    tum, kitti = np.loadtxt(tmp_path / "a.tum"), np.loadtxt(tmp_path / "a.kitti")
    for k, (_, pose) in enumerate(poses):
        np.testing.assert_array_equal(tum[k, 1:], [*pose.t, *pose.q])
        np.testing.assert_array_equal(kitti[k].reshape(3, 4), pose.matrix[:3])


def test_rows_without_a_registration_give_no_pose(make_rows):
    rows = make_rows(40, blackout=range(10, 16))
    assert len(list(row_poses(rows, "registration"))) == 34
    estimates = list(row_poses(rows, "estimate"))
    assert [t for t, _ in estimates] == [r.t_ns for r in rows]
    np.testing.assert_allclose(estimates[7][1].t, [1.07, 0.2, 5.0])


def test_csv_has_every_column_and_empty_cells_for_null(tmp_path, make_rows):
    rows = make_rows(30)
    write_csv(tmp_path / "a.csv", rows)
    with (tmp_path / "a.csv").open(newline="") as stream:
        table = list(csv.DictReader(stream))
    assert list(table[0]) == [c.name for c in columns()]
    assert (table[22]["rms_m"], table[22]["converged"], table[22]["fault"]) == (
        "",
        "true",
        "full_occlusion",
    )
    assert [float(line["x_m"]) for line in table] == [row.x_m for row in rows]


def test_parquet_keeps_types_units_and_values(tmp_path, make_rows):
    pq = pytest.importorskip("pyarrow.parquet")
    rows = make_rows(30)
    write_parquet(tmp_path / "a.parquet", rows)
    table = pq.read_table(tmp_path / "a.parquet")
    assert table.schema.field("rms_m").metadata[b"unit"] == b"m"
    assert [Row(**record) for record in table.to_pylist()] == rows


def test_parquet_without_its_extra_is_one_line(tmp_path, make_rows, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingBackend, match="avsreplay\\[report\\]"):
        write_parquet(tmp_path / "a.parquet", make_rows(1))


def test_the_document_is_strict_json(make_rows):
    rows = make_rows(30, rms_m=math.nan)
    summary = Summary.fold(rows)
    text = "".join(document_parts(rows, summary, {"seed": 7, "empty": {}}))
    whole = json.loads(text, parse_constant=pytest.fail)
    assert whole["header"] == {"seed": 7, "empty": {}}
    assert whole["summary"]["scans"] == len(rows)
    assert list(whole) == ["format", "verdict", "header", "summary", "rows"]
    assert [parse_row(r, "x") for r in whole["rows"]] == [
        dataclasses.replace(r, rms_m=None) for r in rows
    ]


def test_the_document_of_no_rows_is_json_too():
    assert json.loads("".join(document_parts([], Summary.fold([]))))["rows"] == []


@pytest.mark.parametrize("kind", ["json", "parquet"])
def test_a_run_is_written_in_the_memory_of_some_of_its_rows(tmp_path, make_rows, kind, monkeypatch):
    """What is held beside the rows does not grow with their number."""
    monkeypatch.setattr(export, "GROUP_ROWS", 10)
    peaks = []
    for count in (20, 160):
        rows = make_rows(count)
        summary = Summary.fold(rows)
        tracemalloc.start()
        if kind == "json":
            parts = document_parts(rows, summary)
            next(parts)
            tracemalloc.reset_peak()
            for _ in parts:
                pass
        else:
            pytest.importorskip("pyarrow")
            write_parquet(tmp_path / f"{count}.parquet", rows)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 2.0 * peaks[0] + 100_000


@pytest.mark.parametrize(
    ("words", "name"), [((), "columns.md"), (["--schema"], "rows.schema.json")]
)
def test_the_module_prints_the_page_of_the_columns_and_the_schema(words, name, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["export", *words])
    monkeypatch.delitem(sys.modules, "avsreplay.report.export")
    runpy.run_module("avsreplay.report.export", run_name="__main__")
    assert capsys.readouterr().out == (ROOT / "docs" / name).read_text(encoding="utf-8")


def test_the_column_list_of_the_docs_is_current():
    assert (ROOT / "docs" / "columns.md").read_text(encoding="utf-8") == columns_page()
    assert (ROOT / "docs" / "rows.schema.json").read_text(encoding="utf-8") == row_schema_text()
    assert {name for names in FREQUENT_COLUMNS.values() for name in names} <= {
        c.name for c in columns()
    }


def test_every_column_and_every_word_of_a_column_is_described():
    declared = {c.name: c for c in columns()}
    assert all(c.text.endswith(".") and c.text[0].isalnum() for c in declared.values())
    assert columns()[0].section is not None
    enums = {"reason": Reason, "action": Action, "plan_status": PlanStatus}
    for name, kind in enums.items():
        assert set(declared[name].words) == {member.value for member in kind}
    scans = {member.value for member in ScanStatus} - {"ok"}
    assert set(declared["status"].words) == scans | {member.value for member in AlignStatus}


def test_the_schema_knows_every_column_and_its_type(make_rows):
    schema = row_schema()
    record = json.loads(dump_row(make_rows(1)[0]))
    assert set(schema["required"]) == set(record)
    kinds = {
        "string": str,
        "integer": int,
        "number": (int, float),
        "boolean": bool,
        "null": type(None),
    }
    for name, value in record.items():
        types = schema["properties"][name]["type"]
        assert any(
            isinstance(value, kinds[t]) for t in ([types] if isinstance(types, str) else types)
        )


def test_field_types_are_the_four_that_files_can_hold():
    assert {kind for kind, _ in field_types().values()} == {str, int, float, bool}
