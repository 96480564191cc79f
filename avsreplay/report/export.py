"""Rows, poses and the summary in formats that other tools open: TUM, KITTI, CSV, Parquet, JSON; the
schema of a row.

Time stamps are written from integer nanoseconds, never through a float; values as the shortest text
that reads back as the same float64. Run as a script, it prints docs/columns.md, or
docs/rows.schema.json with ``--schema``, from the declaration of ``Row``.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import Any, Literal

from avsreplay.errors import MissingBackend
from avsreplay.files import output_path, output_text
from avsreplay.geometry import Array, Pose
from avsreplay.records import NS_PER_S
from avsreplay.report.jsonl import plain
from avsreplay.report.summary import Summary
from avsreplay.report.verdict import verdict_of
from avsreplay.rows import Column, Row, columns, field_types
from avsreplay.settings import dump

EXPORT_FORMAT = "avsreplay-run/1"
GROUP_ROWS = 4096  # rows of a group of a Parquet file, which are in memory at once

StampedPose = tuple[int, Pose]
"""(t_ns, T_ac): a time and the pose of {C} in {A} at that time."""

_FORMULA = ("=", "+", "-", "@", "\t", "\r")  # a spreadsheet evaluates text that begins so
_FILE_COLUMNS = {
    "estimate": (("qx", "qy", "qz", "qw"), ("x_m", "y_m", "z_m")),
    "registration": (("reg_qx", "reg_qy", "reg_qz", "reg_qw"), ("reg_x_m", "reg_y_m", "reg_z_m")),
}


def row_pose(row: Row, which: Literal["estimate", "registration"]) -> Pose | None:
    """Return the estimated or the registered pose of a row, None where there is none.

    Args:
        row: the row.
        which: which of the two poses.
    """
    attitude, position = _FILE_COLUMNS[which]
    q, t = [getattr(row, n) for n in attitude], [getattr(row, n) for n in position]
    return None if None in (*q, *t) else Pose(q, t)  # type: ignore[arg-type]


def row_poses(
    rows: Iterable[Row], which: Literal["estimate", "registration"]
) -> Iterator[StampedPose]:
    """Return the estimated or the registered poses of the rows that have one.

    Args:
        rows: the rows of a run.
        which: which of the two poses.
    """
    return ((row.t_ns, pose) for row in rows if (pose := row_pose(row, which)) is not None)


def stamp_text(t_ns: int) -> str:
    """Return a time stamp [ns] as seconds with nine decimals, exactly.

    Args:
        t_ns: the instant [ns].
    """
    sign, t_ns = ("-", -t_ns) if t_ns < 0 else ("", t_ns)
    return f"{sign}{t_ns // NS_PER_S}.{t_ns % NS_PER_S:09d}"


def write_tum(path: str | Path, poses: Iterable[StampedPose]) -> int:
    """Write poses of {C} in {A} as TUM, ``stamp x y z qx qy qz qw`` per line [s, m]; return
    their number.

    Args:
        path: the file.
        poses: T_ac with their stamps.
    """
    return _write_lines(
        path, (f"{stamp_text(t_ns)} {_text(pose.t)} {_text(pose.q)}" for t_ns, pose in poses)
    )


def write_kitti(path: str | Path, poses: Iterable[Pose]) -> int:
    """Write a KITTI trajectory: the upper 3x4 of T_ac row by row on a line per pose [m]; return the
    number of poses.

    Args:
        path: the file.
        poses: T_ac in order.
    """
    return _write_lines(path, (_text(pose.matrix[:3].ravel()) for pose in poses))


def _text(values: Array) -> str:
    return " ".join(map(repr, values.tolist()))


def _write_lines(path: str | Path, lines: Iterable[str]) -> int:
    count = 0
    with output_text(path) as stream:
        for line in lines:
            stream.write(line + "\n")
            count += 1
    return count


def write_csv(path: str | Path, rows: Iterable[Row]) -> None:
    """Write all columns as CSV. The first line has their names, which end with the unit; null is an
    empty cell.

    Args:
        path: the file.
        rows: the rows of a run.
    """
    names = [c.name for c in columns()]
    with output_text(path) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([_cell(plain(getattr(row, name))) for name in names] for row in rows)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, str):
        return f"'{value}" if value.startswith(_FORMULA) else value
    return str(value).lower() if isinstance(value, bool) else str(value)


def write_parquet(path: str | Path, rows: Sequence[Row]) -> None:
    """Write all columns with their types; the metadata of each field have its unit and meaning.

    Args:
        path: the file.
        rows: the rows of a run.

    Raises:
        MissingBackend: pyarrow is not installed.
    """
    try:
        pa: Any = import_module("pyarrow")
        pq: Any = import_module("pyarrow.parquet")
    except ModuleNotFoundError:
        raise MissingBackend(
            "pyarrow is not installed", where="Parquet", hint="install avsreplay[report]"
        ) from None
    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    types = field_types()
    schema = pa.schema(
        [
            pa.field(
                c.name,
                kinds[types[c.name][0]],
                types[c.name][1],
                {"unit": c.unit, "doc": c.text},
            )
            for c in columns()
        ]
    )
    with output_path(path) as part, pq.ParquetWriter(part, schema) as writer:
        left = iter(rows)
        while group := list(islice(left, GROUP_ROWS)):
            table = {name: [plain(getattr(row, name)) for row in group] for name in types}
            writer.write_table(pa.table(table, schema=schema))


def document_parts(
    rows: Sequence[Row], summary: Summary, header: Mapping[str, Any] | None = None
) -> Iterator[str]:
    """Yield the parts of a JSON document of a run, with one line per row and a line end at its end.

    Args:
        rows: one per scan.
        summary: the summary of these rows.
        header: the content of ``run.json``.

    Yields:
        Text; all parts together are one document with the keys ``format``, ``verdict``, ``header``,
        ``summary`` and ``rows``, in which NaN is null.
    """
    whole = {
        "format": EXPORT_FORMAT,
        "verdict": verdict_of(rows, summary, header).record(),
        "header": _strict(dump(dict(header or {}))),
        "summary": summary_record(summary),
    }
    head = json.dumps(whole, ensure_ascii=False, allow_nan=False, indent=1)
    yield f'{head[:-2]},\n "rows": [\n'
    names, end = list(field_types()), ""
    for row in rows:
        values = {name: plain(getattr(row, name)) for name in names}
        yield end + json.dumps(values, ensure_ascii=False, allow_nan=False)
        end = ",\n"
    yield "\n ]\n}\n"


def summary_record(summary: Summary) -> dict[str, Any]:
    """Return a summary as plain JSON values, with the figures that follow from it."""
    record: dict[str, Any] = _strict(dump(summary))
    record["faults"]["false_alarm_rate"] = summary.faults.false_alarm_rate
    record["faults"]["longest_recovery_s"] = summary.faults.longest_recovery_s
    return record


def _strict(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _strict(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(v) for v in value]
    return plain(value)


def write_layout(path: str | Path) -> None:
    """Write the layout with which Foxglove and Lichtblick show ``result.mcap``: 3D view,
    plots, diagnostics.

    Args:
        path: the file.
    """
    with output_text(path) as stream:
        stream.write(
            (files("avsreplay.report") / "assets" / "layout.json").read_text(encoding="utf-8")
        )


_PAGE_HEAD = """# What do the columns of a row mean?

Each scan gives one row in `rows.jsonl`, CSV, Parquet and `--json`. These are the columns that
people use; all follow by subject.

{frequent}

A column whose type ends with ? is null where it does not apply, for example an error without ground
truth. [Conventions](conventions.md) defines frames and units, the [glossary](glossary.md) terms.
± is the tolerance of a [golden file](ci.md): absolute/relative to the expected value; ± alone is
1e-06/0.01%, and columns without it are equal. [rows.schema.json](rows.schema.json) is the JSON
schema of a row.
`python -m avsreplay.report.export` makes this page, with `--schema` the schema.
"""

FREQUENT_COLUMNS = {
    "which scan": ("seq", "t_s"),
    "was it used, and why not": ("gamma", "reason", "status", "message"),
    "pose of the target": ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
    "how certain it is": ("pos_1s_m", "rot_1s_deg", "converged"),
    "errors against ground truth": ("pos_err_m", "rot_err_deg"),
    "does the covariance fit the errors": ("nis", "nees"),
    "plan and action": ("capture_time_s", "action"),
}  # what people look for: the columns that have it


_USUAL = "1e-06/0.01%"


def columns_page() -> str:
    """Return the text of docs/columns.md."""
    lines = ["| question | columns |", "|---|---|"]
    lines += [
        f"| {what} | {', '.join(f'`{n}`' for n in names)} |"
        for what, names in FREQUENT_COLUMNS.items()
    ]
    parts = [_PAGE_HEAD.replace("{frequent}", "\n".join(lines))]
    words: list[str] = []
    for each in columns():
        if each.section is not None:
            parts += [*words, f"\n## {each.section.title}\n\n"]
            parts += [f"{each.section.text}\n\n"] if each.section.text else []
            words = []
        parts.append(_line(each, *field_types()[each.name]))
        if each.words:
            words.append(f"\nValues of `{each.name}`:\n\n")
            words += [f"- `{word}`: {meaning}\n" for word, meaning in each.words.items()]
    return "".join([*parts, *words])


def _line(column: Column, kind: type, nullable: bool) -> str:
    tolerance = "/".join(
        text
        for value, text in (
            (column.atol, f"{column.atol:g}"),
            (column.rtol, f"{100 * column.rtol:g}%"),
        )
        if value
    )
    word = kind.__name__ + ("?" if nullable else "") + (f" {column.unit}" if column.unit else "")
    kinds = f"{word} ±{tolerance.replace(_USUAL, '')}" if tolerance else word
    return f"- `{column.name}` ({kinds}): {column.text}\n"


def row_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of one line of ``rows.jsonl``."""
    names = {str: "string", int: "integer", float: "number", bool: "boolean"}
    properties = {}
    for column in columns():
        kind, nullable = field_types()[column.name]
        properties[column.name] = {
            "type": [names[kind], "null"] if nullable else names[kind],
            "description": column.text + (f" [{column.unit}]" if column.unit else ""),
        }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "avsreplay row",
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def row_schema_text() -> str:
    """Return the schema as text."""
    return json.dumps(row_schema(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    import sys

    sys.stdout.write(row_schema_text() if "--schema" in sys.argv else columns_page())
