"""The result directory: rows, run facts, trajectories and beliefs, whole or not at all.

``rows.jsonl``, ``estimate.tum``, ``registration.tum``, ``truth.tum`` and ``beliefs.npz`` depend on the input alone,
byte for byte; ``run.json`` also names the versions.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from avsreplay.chain import Memory
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import Array, Pose
from avsreplay.records import Belief, Scan, State
from avsreplay.report import row_poses, write_rows, write_tum
from avsreplay.rows import Row

__all__ = ["MEAN_COLUMNS", "Beliefs", "ResultDirectory", "belief_of", "mean_vector", "read_beliefs"]

_BLOCKS = (("q_ab", 4), ("w_b", 3), ("r_a", 3), ("v_a", 3), ("sigma", 2), ("c_b", 3), ("q_bc", 4))
MEAN_COLUMNS = tuple(f"{name}[{k}]" for name, size in _BLOCKS for k in range(size))


def belief_of(memory: Memory) -> Belief:
    """The belief after a scan."""
    if memory.track is None:
        raise RuntimeError("nothing was replayed yet")
    return memory.track.belief


def mean_vector(x: State) -> Array:
    """(22,) the mean in the order of ``MEAN_COLUMNS``."""
    return np.concatenate([getattr(x, name) for name, _ in _BLOCKS])


class Beliefs:
    """Listens to a run and keeps, for each scan, the belief after it, and the true poses."""

    def __init__(self) -> None:
        self.t_ns: list[int] = []
        self.x: list[Array] = []
        self.P: list[Array] = []
        self.truth: list[tuple[int, Pose]] = []

    def __call__(self, scan: Scan, memory: Memory, row: Row) -> None:  # noqa: ARG002 (a listener's form)
        """Take one scan and what is remembered after it."""
        belief = belief_of(memory)
        self.t_ns.append(belief.t_ns)
        self.x.append(mean_vector(belief.x))
        self.P.append(belief.P)
        if scan.truth is not None:
            self.truth.append((scan.t_ns, scan.truth))

    def write(self, path: Path) -> None:
        """``beliefs.npz``: t_ns (n,), x (n, 22), P (n, 20, 20)."""
        np.savez(path, t_ns=np.array(self.t_ns, np.int64), x=np.array(self.x), P=np.array(self.P))


def read_beliefs(path: Path) -> list[Belief]:
    """The beliefs of a result directory. Raises UnreadableInput where they are not there or not as written."""
    try:
        with np.load(path, allow_pickle=False) as data:
            stamps, means, covariances = data["t_ns"], data["x"], data["P"]
        ends = np.cumsum([0, *(size for _, size in _BLOCKS)])
        return [
            Belief(int(t), State(*(x[a:b] for a, b in pairwise(ends))), P)
            for t, x, P in zip(stamps, means, covariances, strict=True)
        ]
    except FileNotFoundError:
        raise UnreadableInput("no such file", where=str(path), hint="name a directory written by run -o") from None
    except (OSError, ValueError, KeyError, EOFError):
        raise UnreadableInput("not beliefs as a run writes them", where=str(path), hint="run again") from None


class ResultDirectory:
    """A directory that appears when the ``with`` block ends well, and not otherwise."""

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        """Check that it may be written.

        Raises:
            UsageError: something is there and ``overwrite`` is False, or it is no result directory.
        """
        self.path = path
        self._part = path.with_name(f".{path.name}.{os.getpid()}.part")
        if path.exists() and not overwrite:
            raise UsageError("is already there", where=str(path), hint="name another, or add --overwrite")
        if path.exists() and not _replaceable(path):
            raise UsageError("is not a result directory", where=str(path), hint="name another; it is left alone")

    def __enter__(self) -> ResultDirectory:
        try:
            self._part.mkdir(parents=True)
        except OSError as error:
            what = error.strerror or "cannot be written"
            raise UnreadableInput(what, where=str(self.path), hint="check the folder and its rights") from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is not None:
            shutil.rmtree(self._part, ignore_errors=True)
            return
        if self.path.exists():
            shutil.rmtree(self.path)
        self._part.rename(self.path)

    def write(self, rows: Sequence[Row], beliefs: Beliefs, record: Mapping[str, Any]) -> None:
        """Everything a run leaves behind; ``record`` is ``run.json``."""
        write_rows(self._part / "rows.jsonl", rows)
        write_tum(self._part / "estimate.tum", row_poses(rows, "estimate"))
        write_tum(self._part / "registration.tum", row_poses(rows, "registration"))
        if beliefs.truth:
            write_tum(self._part / "truth.tum", beliefs.truth)
        beliefs.write(self._part / "beliefs.npz")
        text = json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False)
        (self._part / "run.json").write_text(text + "\n", encoding="utf-8")

    def file(self, name: str) -> Path:
        """Where a further file of the result is to be written, inside the ``with`` block."""
        return self._part / name


def _replaceable(path: Path) -> bool:
    return path.is_dir() and ((path / "rows.jsonl").is_file() or not any(path.iterdir()))
