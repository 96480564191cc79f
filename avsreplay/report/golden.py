"""Comparison with golden rows: numbers agree within the tolerance of their column, flags and states
exactly.

A value agrees where ``|got - expected| <= atol + rtol |expected|``. A row or a column that is
missing on one side is a difference; so is null against a value.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field
from operator import itemgetter
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np

from avsreplay.errors import CheckFailed, UnreadableInput, value_class
from avsreplay.report.jsonl import plain, read_records, write_rows
from avsreplay.report.table import Table, number
from avsreplay.rows import Column, Row, columns
from avsreplay.tables import Columns

ABSENT = "(absent)"
_Cells = Mapping[str, Sequence[Any]]  # column -> its values, ABSENT where a row has none


@value_class(eq=True)
class Difference:
    """One cell that differs; ``column`` is "row" where a whole row is missing.

    Attributes:
        seq: the scan, None where a column is missing from every row.
        expected, got: the values, or ``ABSENT``.
        tolerance: largest allowed difference, None where they must be equal.
    """

    seq: int | None
    column: str
    expected: Any
    got: Any
    tolerance: float | None = None


@value_class(eq=True)
class GoldenResult:
    """Result of a comparison.

    Attributes:
        rows: number of rows on both sides.
        differences: the first differences, in the order of scan and column.
        count: number of all differences.
        by_column: number of differences in each column.
    """

    rows: int
    differences: tuple[Difference, ...]
    count: int
    by_column: Mapping[str, int] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether the two agree."""
        return self.count == 0

    def check(self, where: str) -> None:
        """Raise CheckFailed if the two differ; ``where`` is the golden file, for the message."""
        if not self.ok:
            first = self.differences[0]
            at = "every scan" if first.seq is None else f"scan {first.seq}"
            what = (
                f"{self.count} differences from the golden rows, the first at {at}, column"
                f" {first.column}"
            )
            raise CheckFailed(
                what, where=where, hint="if the new rows are right, write them with --update-golden"
            )


def compare_golden(
    expected_path: str | Path, rows: Sequence[Row], *, first: int = 20
) -> GoldenResult:
    """Compare rows with a golden file.

    Args:
        expected_path: the golden file.
        rows: the rows of the run.
        first: number of differences that are kept; all are counted.

    Raises:
        UnreadableInput: the file does not exist, or does not hold rows.
    """
    expected = read_golden(Path(expected_path))
    names = dict.fromkeys(name for record in expected.values() for name in record)
    table = {name: [record.get(name, ABSENT) for record in expected.values()] for name in names}
    lacking = [c.name for c in columns() if ABSENT in table.get(c.name, [ABSENT] * len(expected))]
    return _compare({**table, "seq": list(expected)}, Columns(rows), first, lacking)


def read_golden(path: Path) -> dict[int, dict[str, Any]]:
    """Return the rows of a golden file by the number of their scan.

    Args:
        path: the file.

    Raises:
        UnreadableInput: the file does not exist, or does not hold rows.
    """
    if not path.exists():
        raise UnreadableInput(
            "no such golden file", where=str(path), hint="--update-golden writes it"
        )
    return _by_seq(read_records(path))


def compare_rows(expected: Sequence[Row], got: Sequence[Row], *, first: int = 20) -> GoldenResult:
    """Compare the rows of two runs by the tolerances of golden files.

    Args:
        expected: the rows of the first run.
        got: the rows of the second run.
        first: number of differences that are kept; all are counted.
    """
    return _compare(Columns(expected), Columns(got), first)


def _by_seq(records: Iterable[tuple[str, dict[str, Any]]]) -> dict[int, dict[str, Any]]:
    out: dict[int, dict[str, Any]] = {}
    for where, record in records:
        seq = record.get("seq")
        if not isinstance(seq, int) or isinstance(seq, bool):
            raise UnreadableInput(
                "a row without a whole number 'seq'", where=where, hint="name a rows.jsonl file"
            )
        if seq in out:
            raise UnreadableInput(
                f"scan {seq} occurs twice",
                where=where,
                hint="write the file again with --update-golden",
            )
        out[seq] = record
    return out


def _compare(
    expected: _Cells, got: _Cells, first: int, lacking: Sequence[str] = ()
) -> GoldenResult:
    """Compare two tables column by column; ``got`` has every column, and ``expected`` has those
    that are lacking not in every row.

    The differences of the first scans are kept.
    """
    left, right = ({seq: k for k, seq in enumerate(side["seq"])} for side in (expected, got))
    shared = sorted(left.keys() & right.keys())
    places: list[Sequence[int]] = [[side[seq] for seq in shared] for side in (left, right)]
    if shared == list(left) == list(right):
        places = [range(len(shared))] * 2
    alone = sorted(left.keys() ^ right.keys())
    declared = {c.name: c for c in columns()}
    counts = {"row": len(alone)} | dict.fromkeys(lacking, 1)
    kept = [(seq, 0, Difference(seq, "row", *_stated(seq in left))) for seq in alone[:first]]
    for order, name in enumerate((*sorted(expected.keys() - declared.keys()), *declared), 1):
        column = declared.get(name)
        a, b = (_picked(side, name, at) for side, at in zip((expected, got), places, strict=True))
        found = _differing(column, a, b)
        if name in lacking:
            found = [k for k in found if a[k] is not ABSENT]
        counts[name] = counts.get(name, 0) + len(found)
        kept += [
            (shared[k], order, _difference(column, shared[k], name, a[k], b[k]))
            for k in found[:first]
        ]
    whole = [Difference(None, name, *_stated(False)) for name in lacking]
    listed = [*whole, *(difference for *_, difference in sorted(kept, key=itemgetter(0, 1)))]
    by_column = {name: count for name, count in counts.items() if count}
    return GoldenResult(len(shared), tuple(listed[:first]), sum(by_column.values()), by_column)


def _picked(side: _Cells, name: str, places: Sequence[int]) -> Sequence[Any]:
    column = side.get(name) or [ABSENT] * len(side["seq"])
    return column if places == range(len(column)) else [column[k] for k in places]


def _stated(expected: bool) -> tuple[str, str]:
    return ("present", ABSENT) if expected else (ABSENT, "present")


def _differing(column: Column | None, expected: Sequence[Any], got: Sequence[Any]) -> Sequence[int]:
    """The places at which two columns differ."""
    kinds = {*map(type, expected), *map(type, got)}
    if column and (column.rtol or column.atol) and kinds <= {float, int, NoneType}:
        a, b = (np.array(side, dtype=np.float64) for side in (expected, got))
        near = np.abs(b - a) <= column.atol + column.rtol * np.abs(a)
        known = np.isfinite(a), np.isfinite(b)
        return np.flatnonzero(~np.where(known[0] & known[1], near, known[0] == known[1])).tolist()
    pairs = enumerate(zip(expected, got, strict=True))
    if any(kinds <= {kind, NoneType} for kind in (str, int, bool)):
        return [k for k, (a, b) in pairs if a != b]
    return [k for k, (a, b) in pairs if not _agree(plain(a), plain(b), _tolerance(column, a))]


def _difference(column: Column | None, seq: int, name: str, expected: Any, got: Any) -> Difference:
    expected, got = plain(expected), plain(got)
    return Difference(seq, name, expected, got, _tolerance(column, expected))


def _tolerance(column: Column | None, expected: Any) -> float | None:
    if column and (column.rtol or column.atol) and _is_number(expected):
        return float(column.atol + column.rtol * abs(expected))
    return None


def _agree(expected: Any, got: Any, tolerance: float | None) -> bool:
    if _is_number(expected) and _is_number(got):
        return bool(abs(got - expected) <= (tolerance or 0.0))
    return type(expected) is type(got) and bool(expected == got)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def update_golden(path: str | Path, rows: Sequence[Row], *, first: int = 20) -> GoldenResult | None:
    """Replace the golden file and return the differences from the previous one (None if there was
    none).

    Args:
        path: the golden file.
        rows: the rows of a run.
        first: largest number of differences that are listed.
    """
    former = compare_golden(path, rows, first=first) if Path(path).is_file() else None
    write_rows(path, rows)
    return former


def divergence_line(baseline: str, other: str, found: GoldenResult) -> str:
    """Return in one line where the rows of two runs first differ.

    Args:
        baseline: name of the first run.
        other: name of the second run.
        found: their differences.
    """
    first = found.differences[0]
    scan = "every scan" if first.seq is None else f"scan {first.seq}"
    line = (
        f"{other}: {found.count} cells differ from {baseline}, first at {scan}, column"
        f" {first.column}"
    )
    return f"{line} ({first.expected} against {first.got})"


def golden_table(result: GoldenResult) -> Table:
    """Return the table of the first differences from a golden file; its note has the number of
    differences in each column.

    Args:
        result: the differences.
    """
    counts = sorted(result.by_column.items(), key=lambda item: (-item[1], item[0]))
    more = f", and {len(counts) - 12} further columns" if len(counts) > 12 else ""
    return Table(
        f"Golden: first {len(result.differences)} of {result.count} differences",
        ("scan", "column", "expected", "got", "tolerance"),
        tuple(
            (
                "all" if d.seq is None else str(d.seq),
                d.column,
                "null" if d.expected is None else str(d.expected),
                "null" if d.got is None else str(d.got),
                number(d.tolerance, ".3g", "exact"),
            )
            for d in result.differences
        ),
        align="rlrrr",
        note="by column: " + ", ".join(f"{name} {count}" for name, count in counts[:12]) + more,
    )
