"""The result directory of a run: written scan by scan, complete or not at all; beliefs are read
back here.

``rows.jsonl``, ``estimate.tum``, ``smoothed.tum``, ``registration.tum``, ``truth.tum``,
``beliefs.npz``, ``view.npz`` and ``result.mcap`` depend on the input alone, byte for byte;
``run.json`` also names the versions.
An interrupted run also leaves its checkpoint, ``resume.npz``.
"""

from __future__ import annotations

import json
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, overload

import numpy as np

from avsreplay.binary_files import read_npz
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.estimate.driven import DrivenBelief
from avsreplay.files import check_output, output_folder
from avsreplay.geometry import Array
from avsreplay.records import STATE_SIZES, Belief, State, Surface
from avsreplay.report.export import row_poses, write_layout, write_tum
from avsreplay.report.jsonl import write_rows
from avsreplay.report.result import load_result, write_manifest
from avsreplay.report.view import (
    CloudTable,
    CloudView,
    PathView,
    View,
    thin_cloud,
    thin_surface,
    write_view,
)
from avsreplay.rows import Row
from avsreplay.run import Listener, ReplayedScan, Run
from avsreplay.settings import dump
from avsreplay.spool import LARGEST_STORED, Spool, SpoolFile, write_npz
from avsreplay.tables import PoseTable, column_of
from avsreplay.viewers import NewPaths, ResultLogWriter, shown_cloud

CHECKPOINT = "resume.npz"  # checkpoint of an interrupted run
OWN_FILES = frozenset(
    {
        "rows.jsonl",
        "estimate.tum",
        "registration.tum",
        "truth.tum",
        "smoothed.tum",
        "beliefs.npz",
        "view.npz",
        "run.json",
        "result.mcap",
        "result.layout.json",
        "report.html",
        CHECKPOINT,
    }
)
_MAX_BELIEF_BYTES = 1 << 30
MEAN_COLUMNS = tuple(f"{name}[{k}]" for name, size in STATE_SIZES.items() for k in range(size))
_DRIVEN = (
    "driven",
    "u",
    "P_u",
    "cross",
)  # arrays of beliefs.npz about beliefs with a constant acceleration
_SHAPES: dict[str, tuple[str, tuple[int, ...]]] = {
    "t_ns": ("i8", ()),
    "x": ("f8", (len(MEAN_COLUMNS),)),
    "P": ("f8", (20, 20)),
    "driven": ("i8", ()),
    "u": ("f8", (6,)),
    "P_u": ("f8", (6, 6)),
    "cross": ("f8", (20, 6)),
}


def mean_vector(x: State) -> Array:
    """Return the mean as one vector (22,) in the order of ``MEAN_COLUMNS``.

    Args:
        x: the mean of a belief.
    """
    return x.flat


class BeliefTable(Sequence[Belief]):
    """A sequence of beliefs, of which only the last ones are in memory."""

    def __init__(self, arrays: Mapping[str, Spool] | None = None) -> None:
        """Start without beliefs.

        Args:
            arrays: those of ``beliefs.npz`` in place of empty ones.
        """
        file = SpoolFile()
        self._parts = {name: Spool(*kind, file) for name, kind in _SHAPES.items()}
        self._parts |= arrays or {}

    def __len__(self) -> int:
        return len(self._parts["t_ns"])

    @overload
    def __getitem__(self, place: int) -> Belief: ...
    @overload
    def __getitem__(self, place: slice) -> Sequence[Belief]: ...
    def __getitem__(self, place: int | slice) -> Belief | Sequence[Belief]:
        """Return a belief, or a list of some."""
        if isinstance(place, slice):
            return [self[k] for k in range(*place.indices(len(self)))]
        t_ns, x, P = (self._parts[name][place] for name in ("t_ns", "x", "P"))
        ends = np.cumsum([0, *STATE_SIZES.values()])
        plain = Belief(int(t_ns), State(*(x[a:b] for a, b in pairwise(ends))), P)
        driven, at = self._parts["driven"], range(len(self))[place]
        k = bisect_left(range(len(driven)), at, key=lambda each: int(driven[each]))
        if k == len(driven) or driven[k] != at:
            return plain
        return DrivenBelief(
            plain.t_ns, plain.x, plain.P, *(self._parts[name][k] for name in _DRIVEN[1:])
        )

    def append(self, belief: Belief) -> None:
        """Append a belief.

        Args:
            belief: the belief.
        """
        if isinstance(belief, DrivenBelief):
            self._parts["driven"].append(len(self))
            for name in _DRIVEN[1:]:
                self._parts[name].append(getattr(belief, name))
        self._parts["t_ns"].append(belief.t_ns)
        self._parts["x"].append(mean_vector(belief.x))
        self._parts["P"].append(belief.P)

    def check(self) -> None:
        """Raise ValueError where the arrays are not those of beliefs."""
        parts = self._parts
        if len({len(parts[name]) for name in ("t_ns", "x", "P")}) > 1:
            raise ValueError("its arrays differ in length")
        if len({len(parts[name]) for name in _DRIVEN}) > 1:
            raise ValueError("its arrays differ in length")
        before = -1
        for block in parts["driven"].blocks():
            for at in block.tolist():
                if not before < at < len(self):
                    raise ValueError(f"it has no belief {at}, to which an acceleration belongs")
                before = at
        for k, belief in enumerate(self):
            if defect := _defect(belief):
                raise ValueError(f"the belief after scan {k} {defect}")

    def write(self, path: Path) -> None:
        """Write ``beliefs.npz``: t_ns (n,), x (n, 22), P (n, 20, 20), and of those with a constant
        acceleration more.

        For k scans with one: driven (k,) their numbers, u (k, 6), P_u (k, 6, 6) and cross (k, 20,
        6), see :class:`~avsreplay.estimate.driven.DrivenBelief`.

        Args:
            path: the file.
        """
        names = ("t_ns", "x", "P", *(_DRIVEN if len(self._parts["driven"]) else ()))
        write_npz(path, {name: self._parts[name] for name in names})


def read_beliefs(path: Path) -> BeliefTable:
    """Read ``beliefs.npz`` of a result directory.

    Args:
        path: the file.

    Raises:
        UnreadableInput: the file is missing or not as a run writes it.
    """
    hint = "name a directory written by run -o"
    arrays = read_npz(path, _SHAPES, limit=_MAX_BELIEF_BYTES, hint=hint, optional=_DRIVEN)
    found = BeliefTable(arrays)
    try:
        found.check()
    except ValueError as error:
        raise UnreadableInput(str(error), where=str(path), hint=hint) from None
    return found


def _defect(belief: Belief) -> str:
    """Return what is wrong with a belief, an empty string if nothing is."""
    x, P = belief.x, belief.P
    numbers = np.concatenate([mean_vector(x), P.ravel()])
    if isinstance(belief, DrivenBelief):
        numbers = np.concatenate([numbers, belief.u, belief.P_u.ravel(), belief.cross.ravel()])
    if not (np.isfinite(numbers).all() and np.abs(numbers).max() < LARGEST_STORED):
        return "is not finite"
    if any(abs(np.linalg.norm(q) - 1.0) > 1e-6 for q in (x.q_ab, x.q_bc)):
        return "has a quaternion that is not of unit length"
    if np.abs(x.sigma).max() >= 1.0:
        return "has an inertia ratio that is not below 1"
    if P.diagonal().min() < 0.0:
        return f"has a covariance that is not positive (a variance of {P.diagonal().min():.3g})"
    return (
        "has a covariance that is not symmetric"
        if np.abs(P - P.T).max() > 1e-9 * np.abs(P).max()
        else ""
    )


class Beliefs:
    """A listener that keeps the belief after each scan, and the true poses."""

    def __init__(self, beliefs: BeliefTable | None = None) -> None:
        """Start without scans.

        Args:
            beliefs: those of the scans before; None: there are none.
        """
        self.table, self.truth = beliefs or BeliefTable(), PoseTable()

    def __call__(self, scan: ReplayedScan) -> None:
        """Take one scan of a run."""
        self.table.append(scan.outcome.belief)
        if scan.truth.pose is not None:
            self.truth.append(scan.row.t_ns, scan.truth.pose)


class ViewWriter:
    """Collects the thinned model, thinned clouds and planned paths that the report page shows."""

    def __init__(self, surface: Surface, before: View | None = None) -> None:
        """Start without scans.

        Args:
            surface: model of the target.
            before: what the scans before gave; None: there are none.
        """
        self._surface = surface
        clouds = () if before is None else before.clouds
        self._clouds = clouds if isinstance(clouds, CloudTable) else CloudTable(clouds)
        self._plans: list[PathView] = [] if before is None else list(before.paths)

    def take(self, scan: ReplayedScan, cloud: CloudView, path: tuple[Array, Array] | None) -> None:
        """Take one scan: the points that are shown; times and positions of a new flight, if any.

        Args:
            scan: the scan with its row.
            cloud: the points of the scan that are shown, with their residuals.
            path: times (n,) [s] and positions (n, 3) in {A} [m] of a new flight; None where there
                is none.
        """
        self._clouds.append(thin_cloud(cloud.seq, cloud.points, cloud.residual_m, cloud.intensity))
        if path is not None:
            self._plans.append(
                PathView(scan.row.t_ns, np.asarray(path[1], np.float32), scan.row.plan_miss_m)
            )

    def correct(self, rows: Sequence[Row]) -> None:
        """Take the errors of the plans from corrected rows."""
        misses = dict(zip(column_of(rows, "t_ns"), column_of(rows, "plan_miss_m"), strict=True))
        self._plans = [replace(plan, miss_m=misses[plan.t_ns]) for plan in self._plans]

    def view(self) -> View:
        """Return everything kept so far."""
        vertices, faces = thin_surface(self._surface)
        return View(vertices, faces, self._clouds, tuple(self._plans))


class ResultDirectory:
    """The folder of a result; it appears when the ``with`` block ends without an error, and
    not otherwise.
    """

    def __init__(self, path: Path, *, overwrite: bool = False, inputs: Iterable[Path] = ()) -> None:
        """Check that the folder can be written.

        Args:
            path: the folder.
            overwrite: whether an existing result may be replaced; files that are not ``OWN_FILES``
                are kept.
            inputs: files that the run reads; none of them may be a file of the result.

        Raises:
            UsageError: the folder exists, is not a result, contains an input, or its name cannot be
                used.
        """
        self.path, self._stack = path, ExitStack()
        check_output(path, folder=True)
        if path.exists() and not overwrite and any(path.iterdir()):
            raise UsageError(
                "already exists", where=str(path), hint="choose another name, or add --overwrite"
            )
        if path.exists() and not _replaceable(path):
            raise UsageError(
                "is not a result directory", where=str(path), hint="name another; it is left alone"
            )
        for each in inputs:
            if each.resolve().parent == path.resolve() and each.name in OWN_FILES:
                raise UsageError(
                    "contains an input of this run", where=str(path), hint="name another output"
                )

    def __enter__(self) -> ResultDirectory:
        self._part = self._stack.enter_context(output_folder(self.path, OWN_FILES))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stack.__exit__(kind, error, traceback)

    def write(self, rows: Sequence[Row], beliefs: Beliefs) -> None:
        """Write rows, trajectories and beliefs.

        Args:
            rows: one per scan.
            beliefs: collected during the run.
        """
        write_rows(self._part / "rows.jsonl", rows)
        write_tum(self._part / "estimate.tum", row_poses(rows, "estimate"))
        write_tum(self._part / "registration.tum", row_poses(rows, "registration"))
        if len(beliefs.truth):
            write_tum(self._part / "truth.tum", beliefs.truth)
        beliefs.table.write(self._part / "beliefs.npz")

    def file(self, name: str) -> Path:
        """Return where a further file of the result is to be written, inside the ``with`` block.

        Args:
            name: its name.
        """
        return self._part / name


def _replaceable(path: Path) -> bool:
    return path.is_dir() and ((path / "rows.jsonl").is_file() or not any(path.iterdir()))


class ResultWriter:
    """Writes everything a run leaves in a result directory; a context manager around the replay.

    The directory appears when the block ends without an error, after ``finish``, and not otherwise.
    """

    def __init__(self, directory: ResultDirectory, run: Run) -> None:
        """Start without results.

        Args:
            directory: where to write.
            run: the open run.
        """
        self._directory, self._run = directory, run
        self._beliefs, self._view, self._paths = Beliefs(), ViewWriter(run.surface), NewPaths()

    def __enter__(self) -> ResultWriter:
        self._directory.__enter__()
        self._log = ResultLogWriter(self._directory.file("result.mcap"), self._run)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with suppress(OSError):  # reported by ``finish``; after an error the folder is removed
            self._log.close()
        self._directory.__exit__(kind, error, traceback)

    @property
    def listeners(self) -> tuple[Listener, ...]:
        """The listeners that must take every scan."""
        return self._beliefs, self._take

    def _take(self, scan: ReplayedScan) -> None:
        shown = shown_cloud(self._run, scan), self._paths.of(scan.state)
        self._view.take(scan, *shown)
        self._log.take(scan, *shown)

    def resume(self, facts: Mapping[str, Any]) -> None:
        """Continue the interrupted run whose result the directory holds, with its files.

        Args:
            facts: what ``run.json`` must state: the same log, model, settings and versions.

        Raises:
            UnreadableInput: the directory holds no interrupted run, or it is damaged.
            UsageError: it was made from another input or with other settings.
        """
        folder = self._directory.path
        if not (folder / CHECKPOINT).is_file():
            hint = "leave out --resume; only a run that was interrupted can be resumed"
            raise UsageError("no interrupted run", where=f"--resume {folder}", hint=hint)
        found = load_result(folder)
        record = found.header
        different = [
            name
            for name, value in facts.items()
            if record.get(name) != json.loads(json.dumps(dump(value)))
        ]
        if different:
            hint = "give the same options as at first, or start anew with --overwrite"
            what = f"the interrupted run differs in: {', '.join(different)}"
            raise UsageError(what, where=f"--resume {folder}", hint=hint)
        stamps, poses = PoseTable().arrays()
        more: Any = (stamps, poses, self._paths)
        stamps, poses, self._paths = self._run.restore(folder / CHECKPOINT, found.rows, more)
        self._beliefs = Beliefs(read_beliefs(folder / "beliefs.npz"))
        self._beliefs.truth.extend(stamps, poses)
        self._view = ViewWriter(self._run.surface, found.view)
        if not len(found.rows) == len(self._beliefs.table) == self._run.done:
            hint = "start the run anew with --overwrite"
            raise UnreadableInput("its files hold other scans", where=str(folder), hint=hint)
        self._log.take_over(folder / "result.mcap", found.rows)

    def correct(self, rows: Sequence[Row], changed: Sequence[int]) -> None:
        """Replace rows whose scans were taken before the true poses after them were recorded.

        Args:
            rows: all rows.
            changed: indices of those that have other values than the scans that were taken.
        """
        self._log.close()
        first = self._directory.file("result.mcap").rename(
            self._directory.file("result.first.mcap")
        )
        self._log = ResultLogWriter(self._directory.file("result.mcap"), self._run)
        self._log.take_over(first, rows, changed)
        first.unlink()
        self._view.correct(rows)

    def finish(self, record: Mapping[str, Any], *, resumable: bool = False) -> None:
        """Write what needs the whole run.

        Args:
            record: content of ``run.json``.
            resumable: the run was interrupted: write the checkpoint, too, from which ``resume``
                continues.
        """
        self._log.close()
        self._directory.write(self._run.taken, self._beliefs)
        if (motion := self._run.smoothed()) is not None:
            poses = (
                (t_ns, motion.at(t_ns).T_ac)
                for t_ns in column_of(self._run.taken, "t_ns")
                if motion.epoch_ns <= t_ns <= motion.end_ns
            )
            write_tum(self._directory.file("smoothed.tum"), poses)
        write_view(self._directory.file("view.npz"), self._view.view())
        write_layout(self._directory.file("result.layout.json"))
        if resumable:
            more = (*self._beliefs.truth.arrays(), self._paths)
            self._directory.file(CHECKPOINT).write_bytes(self._run.checkpoint(more))
        write_manifest(self._directory.file("run.json").parent, record, self._run.done)
