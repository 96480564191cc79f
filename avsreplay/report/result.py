"""Reads a result directory: rows, run facts, truth, summary, 3D view.

``rows.jsonl`` is required; ``run.json`` (with ``facts``), ``truth.tum`` and ``view.npz`` are optional.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from decimal import ROUND_DOWN, Decimal
from pathlib import Path
from typing import Any

from avsreplay.errors import UnreadableInput
from avsreplay.geometry import Pose
from avsreplay.records import Label, State
from avsreplay.report.export import StampedPose
from avsreplay.report.jsonl import read_rows
from avsreplay.report.summary import Summary
from avsreplay.report.view import View, read_view
from avsreplay.rows import Row

_STATE = ("q_ab", "w_b", "r_a", "v_a", "sigma", "c_b", "q_bc")


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """What a run left behind.

    Attributes:
        name: of its folder.  header: ``run.json`` as it stands, empty where there is none.
        truth: the true state at the last scan, its axes named as the estimate's.  poses: true poses of {C} in {A}.
    """

    name: str
    rows: list[Row]
    summary: Summary
    header: Mapping[str, Any] = field(default_factory=dict)
    truth: State | None = None
    poses: Sequence[StampedPose] = ()
    view: View | None = None


def facts_record(
    *, labels: Sequence[Label] | None = None, truth: State | None = None, counts: Mapping[str, int] | None = None
) -> dict[str, Any]:
    """What ``Summary.fold`` was told beside the rows, as JSON values to stand under ``facts`` in ``run.json``."""
    return {
        "labels": None if labels is None else [_label_record(label) for label in labels],
        "truth": None if truth is None else {name: getattr(truth, name).tolist() for name in _STATE},
        "counts": dict(counts or {}),
    }


def _label_record(label: Label) -> dict[str, Any]:
    names = ("kind", "start_ns", "end_ns", "harmful", "strength")
    return {name: getattr(label, name) for name in names}


def load_result(path: str | Path) -> Result:
    """Read a result directory, or a lone ``rows.jsonl``.

    Raises UnreadableInput where there are no rows, or where a file that is there is not what it says.
    """
    path = Path(path)
    folder, rows_path = (path, path / "rows.jsonl") if path.is_dir() else (None, path)
    rows = read_rows(rows_path)
    header = _header(folder / "run.json") if folder else {}
    labels, truth, counts = _facts(header.get("facts") or {}, str(path))
    summary = Summary.fold(rows, labels=labels, truth=truth, counts=counts)
    poses = read_tum(folder / "truth.tum") if folder and (folder / "truth.tum").is_file() else []
    view = read_view(folder / "view.npz") if folder and (folder / "view.npz").is_file() else None
    name = path.resolve().name if folder else path.name.removesuffix(".jsonl").removesuffix(".rows")
    return Result(name, rows, summary, header, truth, poses, view)


def _header(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        header = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        raise UnreadableInput("not valid JSON", where=str(path), hint="run again") from None
    if not isinstance(header, dict):
        raise UnreadableInput("not a JSON object", where=str(path), hint="run again")
    return header


def _facts(record: Mapping[str, Any], where: str) -> tuple[list[Label] | None, State | None, dict[str, int]]:
    try:
        labels = record.get("labels")
        truth = record.get("truth")
        counts = {str(k): int(v) for k, v in (record.get("counts") or {}).items()}
        known = None if labels is None else [Label(**label) for label in labels]
        return known, None if truth is None else State(**truth), counts
    except (TypeError, ValueError, AttributeError):
        raise UnreadableInput(
            "'facts' in run.json are not as written by a run", where=where, hint="run again"
        ) from None


def read_tum(path: str | Path) -> list[StampedPose]:
    """Poses of a TUM file, stamps to the nanosecond. Raises UnreadableInput with the line."""
    out: list[StampedPose] = []
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        raise UnreadableInput("cannot be read", where=str(path), hint="name a TUM trajectory") from None
    for number, line in enumerate(lines, 1):
        if line.strip() and not line.startswith("#"):
            out.append(_stamped(line, f"{path}:{number}"))
    return out


def _stamped(line: str, where: str) -> StampedPose:
    try:
        stamp, *values = line.split()
        x, y, z, *q = (float(v) for v in values)
        return int((Decimal(stamp) * 1_000_000_000).to_integral_value(ROUND_DOWN)), Pose(q, [x, y, z])  # type: ignore[arg-type]
    except (ValueError, ArithmeticError):
        raise UnreadableInput("not 'stamp x y z qx qy qz qw'", where=where, hint="name a TUM trajectory") from None
