"""Reads a result directory: rows, run facts, truth, summary, 3D view.

``rows.jsonl`` is required; ``run.json`` (with ``facts``), ``truth.tum`` and ``view.npz`` are
optional.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from decimal import ROUND_DOWN, Decimal
from pathlib import Path
from typing import Any

import numpy as np

from avsreplay.assessment import Assessment
from avsreplay.binary_files import read_limited
from avsreplay.errors import UnreadableInput, UsageError, value_class
from avsreplay.geometry import Array, Pose, bounding_diagonal
from avsreplay.records import NS_PER_S, STATE_SIZES, Label, State, Surface
from avsreplay.report.export import StampedPose
from avsreplay.report.jsonl import read_json, read_rows, without_garbage_collection
from avsreplay.report.summary import Summary
from avsreplay.report.view import View, read_view
from avsreplay.settings import dump
from avsreplay.spool import LARGEST_STORED
from avsreplay.tables import PoseTable, RowTable

_TABLES = ("log", "model", "clock", "losses", "selection", "config", "versions", "files", "limits")
LOG_SUFFIXES = (".mcap", ".bag", ".db3")
_RUN_AGAIN = "the result is not as a run wrote it: run again"
_MAX_TUM_BYTES = 512 << 20
_LEAST_SIZE_M = 1e-12
_UNIT_NORM_ERROR = 1e-3  # difference of the norm of a stored quaternion from 1
_MAX_TIME_S = 9_000_000_000  # whose nanoseconds have 64 bits


@value_class
class Result:
    """The result of a run as read from its directory.

    Attributes:
        name: name of its folder.
        rows: one per scan.
        summary: the summary of these rows.
        header: the content of ``run.json``, empty if the file does not exist.
        truth: the true state at the last scan; its axes have the order of those of the estimate.
        poses: true poses of {C} in {A}.
        view: model, clouds and paths for the 3D view.
        unverified: why the files could not be compared with run.json; empty if they are as the run
            wrote them.
        whole: whether it is a result directory, not a single file of rows.
    """

    name: str
    rows: RowTable
    summary: Summary
    header: Mapping[str, Any] = field(default_factory=dict)
    truth: State | None = None
    poses: Sequence[StampedPose] = ()
    view: View | None = None
    unverified: str = ""
    whole: bool = False

    @property
    def surface(self) -> Surface | None:
        """The thinned model of the target; None where the result has none."""
        if self.view is None or not len(self.view.vertices):
            return None
        vertices = np.asarray(self.view.vertices, dtype=np.float64)
        return Surface(vertices, np.asarray(self.view.faces, dtype=np.int32), "view.npz", "")

    def extent_m(self, path: Path) -> float:
        """Return the diagonal of the target's bounding box [m].

        Args:
            path: the directory, for the error message.

        Raises:
            UsageError: it is not known.
        """
        stated = self.header.get("model", {}).get("extent_m")
        if stated is not None:
            return float(stated)
        if self.view is None or not len(self.view.vertices):
            raise UsageError(
                "the target's size is not known",
                where=str(path),
                hint="give it with --extent METRES",
            )
        return bounding_diagonal(self.view.vertices)

    @property
    def losses(self) -> int:
        """Return the number of damaged places in the log of the run."""
        found = self.header.get("losses")
        return (
            int(found["count"])
            if isinstance(found, dict) and isinstance(found.get("count"), int)
            else 0
        )

    @property
    def warnings(self) -> list[str]:
        """Return the known defects of this result, one sentence each."""
        out = [f"{self.name}: not verified, {self.unverified}"] if self.unverified else []
        out += [f"{self.name}: its log was damaged at {self.losses} places"] if self.losses else []
        return out + (
            [f"{self.name}: the run was interrupted"] if "interrupted_after" in self.header else []
        )


def facts_record(
    *,
    labels: Sequence[Label] | None = None,
    truth: State | None = None,
    counts: Mapping[str, int] | None = None,
) -> dict[str, Any]:
    """Return what ``Summary.fold`` received beside the rows as JSON values, for the key ``facts``
    of ``run.json``.

    Args:
        labels: labels of the log; None where it has none.
        truth: true state at the last scan.
        counts: further counts by name.
    """
    return {
        "labels": None if labels is None else [_label_record(label) for label in labels],
        "truth": None
        if truth is None
        else {name: getattr(truth, name).tolist() for name in STATE_SIZES},
        "counts": dict(counts or {}),
    }


def _label_record(label: Label) -> dict[str, Any]:
    names = ("kind", "start_ns", "end_ns", "harmful", "strength")
    return {name: getattr(label, name) for name in names}


def write_manifest(folder: Path, record: Mapping[str, Any], rows: int) -> None:
    """Write ``run.json``: ``record``, the number of rows, and size and SHA-256 of every file
    in the folder.
    """
    files = {
        path.name: {"bytes": path.stat().st_size, "sha256": sha256(path)}
        for path in sorted(folder.iterdir())
    }
    text = json.dumps(dump({**record, "rows": rows, "files": files}), indent=1, allow_nan=False)
    (folder / "run.json").write_text(text + "\n", encoding="utf-8")


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file.

    Args:
        path: the file.

    Raises:
        OSError: it cannot be read.
    """
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def result_path(path: Path) -> Path:
    """Return the directory of a result where one of its files other than the rows is named; any
    other path is returned as it is.
    """
    folder = path.parent
    inside = path.is_file() and path.name in ("run.json", "beliefs.npz", "view.npz", "result.mcap")
    return folder if inside and (folder / "rows.jsonl").is_file() else path


def load_result(path: str | Path) -> Result:
    """Read a result directory, or a single ``rows.jsonl``, and verify its files against
    ``run.json``.

    Args:
        path: the directory or the rows.

    Returns:
        The result. ``unverified`` states why it could not be verified; it is empty if all files are
        as the run wrote them.

    Raises:
        UnreadableInput: a file is missing, damaged, or differs from the size, SHA-256 or number of
            rows in run.json.
    """
    path = result_path(Path(path))
    if path.is_file() and path.suffix.lower() in LOG_SUFFIXES:
        hint = f"replay it first: avsreplay run {shlex.quote(str(path))} -o results/"
        raise UnreadableInput("is a log, not a result", where=str(path), hint=hint)
    rows_path = path / "rows.jsonl" if path.is_dir() else path
    if path.is_dir() and not rows_path.is_file():
        raise UnreadableInput(
            "holds no rows.jsonl",
            where=str(path),
            hint="name the directory that 'avsreplay run LOG -o DIR' writes",
        )
    beside = rows_path.parent
    whole = path.is_dir() or (path.name == "rows.jsonl" and (beside / "run.json").is_file())
    header, unverified = dict[str, Any](), "it is a single file of rows without run.json"
    if whole:
        header = _header(beside / "run.json")
        unverified = _verify(beside, header, None if path.is_dir() else ("rows.jsonl",))
    with without_garbage_collection():
        rows = _rows(rows_path, None if unverified else header.get("rows", 0))
        labels, truth, counts = _facts(header.get("facts") or {}, str(path))
        summary = Summary.fold(rows, labels=labels, truth=truth, counts=counts)
        summary = replace(summary, assessment=_assessment(header, str(path)))
    if not path.is_dir():
        name = path.name.removesuffix(".jsonl").removesuffix(".rows")
        return Result(name, rows, summary, header, truth, [], None, unverified, whole)
    truth_tum, view_npz = path / "truth.tum", path / "view.npz"
    poses = read_tum(truth_tum) if truth_tum.is_file() else []
    view = read_view(view_npz) if view_npz.is_file() else None
    name = path.resolve().name
    return Result(name, rows, summary, header, truth, poses, view, unverified, whole)


def _rows(path: Path, stated: int | None) -> RowTable:
    """Read rows, and compare their number with the stated one, None where none is stated."""
    rows = read_rows(path)
    if not len(rows):
        raise UnreadableInput("has no rows", where=str(path), hint=_RUN_AGAIN)
    if stated is not None and len(rows) != stated:
        what = f"{len(rows)} rows, run.json states {stated}"
        raise UnreadableInput(what, where=str(path), hint=_RUN_AGAIN)
    return rows


def _header(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    header = read_json(path, hint=_RUN_AGAIN)
    if not isinstance(header, dict):
        raise UnreadableInput("not a JSON object", where=str(path), hint=_RUN_AGAIN)
    for key in _TABLES:
        if not isinstance(header.get(key, {}), dict):
            raise UnreadableInput(f"'{key}' is not a JSON object", where=str(path), hint=_RUN_AGAIN)
    drawn = [
        header.get("limits", {}).get(name) for name in ("rms_max_m", "alpha_max_m", "length_m")
    ]
    if not all(
        v is None or (type(v) in (int, float) and _LEAST_SIZE_M <= v < LARGEST_STORED)
        for v in drawn
    ):
        raise UnreadableInput("'limits' are not positive numbers", where=str(path), hint=_RUN_AGAIN)
    return header


def _verify(folder: Path, header: Mapping[str, Any], names: Sequence[str] | None) -> str:
    """Compare files with size and SHA-256 in run.json; return why this is not possible, or an
    empty string.
    """
    files = header.get("files")
    if not isinstance(files, dict) or "rows.jsonl" not in files:
        return "run.json lists no files" if header else "there is no run.json"
    for name, entry in files.items():
        if names is not None and name not in names:
            continue
        path, entry = folder / name, entry if isinstance(entry, dict) else {}
        if Path(name).name != name or not path.is_file():
            raise UnreadableInput(f"'{name}' is missing", where=str(folder), hint=_RUN_AGAIN)
        try:
            same = path.stat().st_size == entry.get("bytes") and sha256(path) == entry.get("sha256")
        except OSError as error:
            raise UnreadableInput(
                error.strerror or "cannot be read", where=str(path), hint=_RUN_AGAIN
            ) from None
        if not same:
            raise UnreadableInput(
                "differs from its SHA-256 in run.json", where=str(path), hint=_RUN_AGAIN
            )
    return ""


def _facts(record: Any, where: str) -> tuple[list[Label] | None, State | None, dict[str, int]]:
    try:
        labels, truth = record.get("labels"), record.get("truth")
        counts = {str(k): int(v) for k, v in (record.get("counts") or {}).items()}
        known = None if labels is None else [_label(label) for label in labels]
        return known, None if truth is None else _state(truth), counts
    except (TypeError, ValueError, AttributeError, KeyError):
        raise UnreadableInput(
            "'facts' in run.json are not as written by a run", where=where, hint=_RUN_AGAIN
        ) from None


def _assessment(header: Mapping[str, Any], where: str) -> Assessment | None:
    try:
        return Assessment.of_record(header.get("capture"))
    except (TypeError, ValueError, AttributeError, KeyError, IndexError):
        raise UnreadableInput(
            "'capture' in run.json is not as written by a run", where=where, hint=_RUN_AGAIN
        ) from None


def _label(values: Mapping[str, Any]) -> Label:
    label = Label(**values)
    times = (label.start_ns, label.end_ns)
    if (
        not all(type(t) is int and -(2**63) <= t < 2**63 for t in times)
        or type(label.harmful) is not bool
    ):
        raise ValueError("a label of the wrong type")
    if not isinstance(label.kind, str) or not label.kind.isprintable():
        raise ValueError("a label without a name")
    if not isinstance(label.strength, (int, float, type(None))):
        raise ValueError("a label without a strength")
    return label


def _state(values: Mapping[str, Any]) -> State:
    arrays = {name: np.array(values[name], dtype=np.float64) for name in STATE_SIZES}
    sizes_match = all(arrays[name].shape == (size,) for name, size in STATE_SIZES.items())
    if not sizes_match or not all((np.abs(a) < LARGEST_STORED).all() for a in arrays.values()):
        raise ValueError("a state of another shape")
    if any(abs(np.linalg.norm(arrays[name]) - 1.0) > _UNIT_NORM_ERROR for name in ("q_ab", "q_bc")):
        raise ValueError("a quaternion that is not of unit length")
    if np.abs(arrays["sigma"]).max() >= 1.0:
        raise ValueError("an inertia ratio that is not below 1")
    return State(**arrays)


def read_tum(path: str | Path) -> PoseTable:
    """Read a TUM file.

    Args:
        path: the file.

    Returns:
        The time of each pose, exact to the nanosecond, and the pose.

    Raises:
        UnreadableInput: the file cannot be read, or a line is no pose; the message names the line.
    """
    hint = "name a TUM trajectory"
    text = read_limited(Path(path), _MAX_TUM_BYTES, hint).decode("utf-8", "backslashreplace")
    out = PoseTable()
    for number, line in enumerate(io.StringIO(text), 1):
        if line.strip() and not line.startswith("#"):
            out.append(*_stamped(line, f"{path}:{number}"))
    return out


def motion_samples(poses: Sequence[StampedPose], since_ns: int) -> tuple[Array, list[Pose]]:
    """Return the times [s] after ``since_ns`` and the poses, ascending, without those within 10 us
    of an earlier one.

    Args:
        poses: times and poses in any order.
        since_ns: instant from which the times count [ns].
    """
    kept: list[tuple[float, Pose]] = []
    for t_ns, pose in sorted(poses, key=lambda each: each[0]):
        t_s = (t_ns - since_ns) * 1e-9
        if not kept or t_s > kept[-1][0] + 1e-5:
            kept.append((t_s, pose))
    return np.array([t_s for t_s, _ in kept]), [pose for _, pose in kept]


def _stamped(line: str, where: str) -> StampedPose:
    try:
        stamp, *words = line.split()
        x, y, z, *q = values = [float(v) for v in words]
        seconds = Decimal(stamp)
        if (
            not abs(seconds) < _MAX_TIME_S
            or len(q) != 4
            or not all(abs(v) < LARGEST_STORED for v in values)
        ):
            raise ValueError("a pose out of range")
        t_ns = int((seconds * NS_PER_S).to_integral_value(ROUND_DOWN))
        if not abs(math.hypot(*q) - 1.0) <= _UNIT_NORM_ERROR:
            raise ValueError("not a unit quaternion")
        return t_ns, Pose(q, [x, y, z])  # type: ignore[arg-type]
    except (ValueError, ArithmeticError):
        raise UnreadableInput(
            "not 'stamp x y z qx qy qz qw'", where=where, hint="name a TUM trajectory"
        ) from None
