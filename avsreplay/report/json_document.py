"""One JSON document of a run: its header, its summary, its rows."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from typing import Any

from avsreplay.report.jsonl import plain
from avsreplay.report.summary import Summary
from avsreplay.rows import Row
from avsreplay.settings import dump

__all__ = ["FORMAT", "document", "dump_document", "summary_record"]

FORMAT = "avsreplay-run/1"


def document(rows: Iterable[Row], summary: Summary, header: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """``{"format", "header", "summary", "rows"}``; nothing in it that JSON cannot say (NaN is null)."""
    names = [f.name for f in dataclasses.fields(Row)]
    return {
        "format": FORMAT,
        "header": _strict(dump(dict(header or {}))),
        "summary": summary_record(summary),
        "rows": [{name: plain(getattr(row, name)) for name in names} for row in rows],
    }


def summary_record(summary: Summary) -> dict[str, Any]:
    """The summary as plain JSON values, with the derived figures people ask for."""
    record: dict[str, Any] = _strict(dump(summary))
    record["faults"]["false_alarm_rate"] = summary.faults.false_alarm_rate
    record["faults"]["longest_recovery_s"] = summary.faults.longest_recovery_s
    return record


def dump_document(rows: Iterable[Row], summary: Summary, header: Mapping[str, Any] | None = None) -> str:
    """The document as text, one line a row, ending in a line end."""
    whole = document(rows, summary, header)
    lines = ",\n".join(json.dumps(row, ensure_ascii=False, allow_nan=False) for row in whole.pop("rows"))
    head = json.dumps(whole, ensure_ascii=False, allow_nan=False, indent=1)
    return f'{head[:-2]},\n "rows": [\n{lines}\n ]\n}}\n'


def _strict(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _strict(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(v) for v in value]
    return plain(value)
