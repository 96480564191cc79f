"""Comparison with golden rows in both directions: numbers within their column's tolerance, flags and states exactly.

A value passes where ``|got - expected| <= atol + rtol |expected|``. A row or a column that is missing on one side is a
difference; so is null against a value.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from avsreplay.errors import CheckFailed, UnreadableInput
from avsreplay.report.jsonl import plain, read_records, write_rows
from avsreplay.report.table import Table, number
from avsreplay.rows import Column, Row, columns

ABSENT = "(absent)"


@dataclass(frozen=True, slots=True)
class Difference:
    """One cell that differs; ``column`` is "row" where a whole row is missing.

    Attributes:
        seq: the scan, None where a column is missing from every row.
        expected, got: the values, or ``ABSENT``.  tolerance: largest allowed difference, None where they must be equal.
    """

    seq: int | None
    column: str
    expected: Any
    got: Any
    tolerance: float | None = None


@dataclass(frozen=True, slots=True)
class GoldenResult:
    """Result of a comparison.

    Attributes:
        rows: rows on both sides.  differences: the first ones, in order of scan and column.
        count: of all differences.  by_column: the same, column by column.
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
        """Raise CheckFailed if they differ; ``where`` names the golden file."""
        if not self.ok:
            first = self.differences[0]
            at = "every scan" if first.seq is None else f"scan {first.seq}"
            what = f"{self.count} differences from the golden rows, the first at {at}, column {first.column}"
            raise CheckFailed(what, where=where, hint="if the new rows are right, write them with --update-golden")


def compare_golden(expected_path: str | Path, rows: Iterable[Row], *, first: int = 20) -> GoldenResult:
    """Compare rows with a golden file; ``first`` differences are kept, all are counted.

    Raises:
        UnreadableInput: the file does not exist, or does not hold rows.
    """
    path = Path(expected_path)
    if not path.is_file():
        raise UnreadableInput("no such golden file", where=str(path), hint="--update-golden writes it")
    expected = _by_seq(read_records(path))
    names = [c.name for c in columns()]
    got = {row.seq: {name: plain(getattr(row, name)) for name in names} for row in rows}
    return compare_records(expected, got, first=first)


def _by_seq(records: Iterable[tuple[str, dict[str, Any]]]) -> dict[int, dict[str, Any]]:
    out: dict[int, dict[str, Any]] = {}
    for where, record in records:
        seq = record.get("seq")
        if not isinstance(seq, int) or isinstance(seq, bool):
            raise UnreadableInput("a row without a whole number 'seq'", where=where, hint="name a rows.jsonl file")
        if seq in out:
            raise UnreadableInput(
                f"scan {seq} occurs twice", where=where, hint="write the file again with --update-golden"
            )
        out[seq] = record
    return out


def compare_records(
    expected: Mapping[int, Mapping[str, Any]], got: Mapping[int, Mapping[str, Any]], *, first: int = 20
) -> GoldenResult:
    """Compare two sets of rows (scan number -> column -> value)."""
    kept: list[Difference] = []
    by_column: dict[str, int] = {}
    for difference in _differences(expected, got):
        by_column[difference.column] = by_column.get(difference.column, 0) + 1
        if len(kept) < first:
            kept.append(difference)
    shared = len(expected.keys() & got.keys())
    return GoldenResult(shared, tuple(kept), sum(by_column.values()), by_column)


def _differences(
    expected: Mapping[int, Mapping[str, Any]], got: Mapping[int, Mapping[str, Any]]
) -> Iterator[Difference]:
    declared = {c.name: c for c in columns()}
    lacking = [n for n in declared if any(n not in r for r in (*expected.values(), *got.values()))]
    yield from (_lacking(name, expected, got) for name in lacking)
    for seq in sorted(expected.keys() | got.keys()):
        if seq not in got:
            yield Difference(seq, "row", "present", ABSENT)
        elif seq not in expected:
            yield Difference(seq, "row", ABSENT, "present")
        else:
            yield from _row_differences(seq, expected[seq], got[seq], declared)


def _lacking(name: str, expected: Mapping[int, Mapping[str, Any]], got: Mapping[int, Mapping[str, Any]]) -> Difference:
    left, right = (ABSENT if any(name not in row for row in side.values()) else "present" for side in (expected, got))
    return Difference(None, name, left, right)


def _row_differences(
    seq: int, expected: Mapping[str, Any], got: Mapping[str, Any], declared: Mapping[str, Column]
) -> Iterator[Difference]:
    extra = sorted((expected.keys() | got.keys()) - declared.keys())
    for name in extra:
        yield Difference(seq, name, expected.get(name, ABSENT), got.get(name, ABSENT))
    for name, column in declared.items():
        if name in expected and name in got:
            difference = _cell(seq, column, expected[name], got[name])
            if difference is not None:
                yield difference


def _cell(seq: int, column: Column, expected: Any, got: Any) -> Difference | None:
    tolerance = None
    if _is_number(expected) and (column.rtol or column.atol):
        tolerance = column.atol + column.rtol * abs(expected)
    if _agree(expected, got, tolerance):
        return None
    return Difference(seq, column.name, expected, got, tolerance)


def _agree(expected: Any, got: Any, tolerance: float | None) -> bool:
    if _is_number(expected) and _is_number(got):
        return bool(abs(got - expected) <= (tolerance or 0.0))
    return type(expected) is type(got) and bool(expected == got)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def update_golden(path: str | Path, rows: Iterable[Row], *, first: int = 20) -> GoldenResult | None:
    """Replace the golden file and return the differences from the previous one (None if there was none)."""
    rows = list(rows)
    former = compare_golden(path, rows, first=first) if Path(path).is_file() else None
    write_rows(path, rows)
    return former


def divergence_line(baseline: str, other: str, found: GoldenResult) -> str:
    """Where the rows of two runs first differ, in one line."""
    if found.ok:
        return f"{other}: all {found.rows} rows agree with {baseline} within the columns' tolerances"
    first = found.differences[0]
    scan = "every scan" if first.seq is None else f"scan {first.seq}"
    line = f"{other}: {found.count} cells differ from {baseline}, first at {scan}, column {first.column}"
    return f"{line} ({first.expected} against {first.got})"


def golden_table(result: GoldenResult) -> Table:
    """The first differences from a golden file, and in the note how many there are in each column."""
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
