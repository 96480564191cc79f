"""The journal of a campaign: one line per finished run, appended as runs finish, and the scans of
each run.

A line is ``checksum id status values``; the scans of a run are a Parquet file of their own, written
before its line. A line that is damaged (a changed byte, or the end cut off by a kill) is moved to
``journal.damaged`` and its run is made again; all other lines are kept. Lines are in the order of
completion; results are sorted elsewhere.
"""

from __future__ import annotations

import importlib
import json
import os
import socket
import sys
import zlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, TypeVar

from avsreplay.errors import MissingBackend, UnreadableInput, UsageError
from avsreplay.files import kept_if_used, output_path
from avsreplay.locks import in_place
from avsreplay.result_dir import OWN_FILES
from avsreplay.sweep.campaign import SCAN_COLUMNS, RunResult


def arrow() -> tuple[Any, Any]:
    """The modules pyarrow and pyarrow.parquet.

    Raises MissingBackend where pyarrow is not installed.
    """
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError:
        hint = "pip install 'avsreplay[sweep]'"
        raise MissingBackend("pyarrow is not installed", where="sweep", hint=hint) from None


def scan_schema() -> Any:
    """Columns of a file of scans: the run's id, then SCAN_COLUMNS."""
    pa, _ = arrow()
    types = {"seq": pa.int64(), "fault": pa.string(), "harmful": pa.bool_(), "gamma": pa.int64()}
    return pa.schema(
        [("id", pa.string()), *((name, types.get(name, pa.float64())) for name in SCAN_COLUMNS)]
    )


def write_scans(path: Path, rows: Sequence[tuple[Any, ...]]) -> None:
    """Write the scans of one run.

    Args:
        path: The Parquet file; its folder is created.
        rows: One tuple per scan in the order of SCAN_COLUMNS.

    Raises:
        UnreadableInput: The folder cannot be created or the file cannot be written.
    """
    schema = scan_schema().remove(0)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnreadableInput(
            error.strerror or "cannot be made", where=str(path.parent), hint="check it"
        ) from None
    write_batches(path, schema, [rows])


def write_batches(path: Path, schema: Any, batches: Iterable[Sequence[tuple[Any, ...]]]) -> None:
    """Write rows in batches to a file that appears once it is complete.

    Args:
        path: the file.
        schema: the pyarrow schema of a row.
        batches: rows as tuples in the order of the schema.
    """
    pa, pq = arrow()
    with (
        output_path(path) as part,
        pq.ParquetWriter(part, schema, compression="zstd", write_page_checksum=True) as writer,
    ):
        for rows in batches:
            columns = zip(*rows, strict=True) if rows else ([] for _ in schema)
            arrays = [
                pa.array(column, field.type) for column, field in zip(columns, schema, strict=True)
            ]
            writer.write_table(pa.table(arrays, schema))


def read_scans(path: Path) -> list[tuple[Any, ...]]:
    """The scans of one run. Raises UnreadableInput where the file is damaged."""
    pa, pq = arrow()
    try:
        table = pq.read_table(path, page_checksum_verification=True)
        if table.schema != scan_schema().remove(0):
            raise ValueError("its columns are not those of a campaign's scans")
        return list(zip(*(column.to_pylist() for column in table.columns), strict=True))
    except (
        OSError,
        ValueError,
        pa.ArrowException,
    ) as error:  # ValueError: also a name that is not UTF-8
        what = str(error).splitlines()[0]
        raise UnreadableInput(what, where=str(path), hint="run the campaign again") from None


T = TypeVar("T")
RESULTS = (
    "results.parquet",
    "scans.parquet",
    "summary.json",
    "report.html",
)  # written from a journal


class Journal:
    """Journal of the finished runs of a campaign in one folder; a context manager while runs are
    added.

    Entering the context locks the folder, so that two campaigns cannot write to it at the same
    time. An error before the first run is finished leaves no file, nor a folder, that was not there
    before.

    Attributes:
        folder: The folder.
        path: The file ``journal.txt`` in the folder.
        status: Status of every finished run, by its id.
        damaged: Lines that were set aside, except a last line that is incomplete because the
            process was killed.

    Raises:
        UsageError: On entering the context, another process uses the folder; the message names the
            folder.
    """

    def __init__(self, folder: Path) -> None:
        """Read the journal of a folder, if there is one.

        Args:
            folder: Folder of the campaign; it is created on entering the context.

        Raises:
            UnreadableInput: The journal cannot be read.
            UsageError: The folder has no journal, but a file that a campaign would replace.
        """
        self.folder = folder
        self.path = folder / "journal.txt"
        self.status: dict[str, str] = {}
        self.damaged: list[bytes] = []
        self._places: dict[str, tuple[int, int]] = {}
        self._stream: BinaryIO | None = None
        self._stack = ExitStack()
        self._guarded(self._read)
        foreign = [name for name in (*RESULTS, *sorted(OWN_FILES)) if (folder / name).exists()]
        if foreign and not self.path.exists():
            hint = "name another directory; it is left alone"
            raise UsageError(
                f"contains '{foreign[0]}', but no journal", where=str(folder), hint=hint
            )

    def __enter__(self) -> Journal:
        with ExitStack() as stack:
            self._stream = self._guarded(lambda: self._begin(stack))
            self._stack = stack.pop_all()
        return self

    def _begin(self, stack: ExitStack) -> BinaryIO:
        """Create and lock the folder, and open the journal for appending."""
        stack.enter_context(kept_if_used(self.folder))
        stack.enter_context(_locked(self.folder / "lock"))
        stack.push(self._leave_nothing)
        self._read()  # another process may have written it before this one had the lock
        if self.damaged or self._torn:
            self._set_aside()
        return self.path.open("ab")

    def _leave_nothing(self, kind: type[BaseException] | None, *_: object) -> None:
        """After an error, remove a journal without runs, and its lock."""
        kept = kind is None or self.status or any((self.folder / each).exists() for each in RESULTS)
        with suppress(OSError):
            if not kept:
                self.path.unlink(missing_ok=True)
                (self.folder / "lock").unlink()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._stream is not None:
            self._stream.close()
        self._stream = None
        self._stack.__exit__(kind, error, traceback)

    def __contains__(self, run_id: str) -> bool:
        return run_id in self.status

    def add(self, result: RunResult) -> None:
        """Append a result and flush it; a run that is already in the journal is ignored.

        Args:
            result: The result of a finished run; its scans, if any, are written to a file of their
                own.

        Raises:
            RuntimeError: The journal is used outside its context.
            UnreadableInput: A file cannot be written.
        """
        stream = self._stream
        if stream is None:
            raise RuntimeError("the journal is not open")
        if result.id in self.status:
            return
        if result.scans:
            write_scans(self._part(result.id), result.scans)
        line = _line(result)

        def append() -> None:
            stream.write(line)
            stream.flush()

        self._guarded(append)
        self._note(result.id, result.status, len(line))

    def result(self, run_id: str) -> RunResult:
        """Return the result of a run without its scans.

        Args:
            run_id: Identifier of the run's task.

        Raises:
            KeyError: The run is not finished.
            UnreadableInput: The journal cannot be read.
        """
        start, size = self._places[run_id]

        def read() -> bytes:
            with self.path.open("rb") as stream:
                stream.seek(start)
                return stream.read(size)

        return _result(self._guarded(read))

    def scans(self, run_id: str) -> list[tuple[Any, ...]]:
        """Return the scans of a run in the order of SCAN_COLUMNS; an empty list if none are kept.

        Args:
            run_id: Identifier of the run's task.

        Raises:
            UnreadableInput: The file of the scans is damaged.
        """
        part = self._part(run_id)
        return read_scans(part) if part.exists() else []

    def check_scans(self) -> int:
        """Forget every run whose scans are missing or damaged, so that it is made again;
        return their number.
        """
        bad = []
        for run_id in self.status:
            count = self.result(run_id).scan_count
            try:
                if count and len(self.scans(run_id)) != count:
                    bad.append(run_id)
            except UnreadableInput:
                bad.append(run_id)
        if bad:
            self._keep([run_id for run_id in self.status if run_id not in set(bad)])
        return len(bad)

    def forget(self, statuses: tuple[str, ...]) -> None:
        """Remove the runs with given statuses from the journal, so that they are made again.

        Args:
            statuses: The statuses, for example "failed" and "crashed".
        """
        self._keep([run_id for run_id, status in self.status.items() if status not in statuses])

    def _part(self, run_id: str) -> Path:
        return self.folder / "scans" / run_id[:2] / f"{run_id}.parquet"

    def _keep(self, run_ids: Sequence[str]) -> None:
        if len(run_ids) == len(self.status):
            return

        kept = [self._places[run_id] for run_id in run_ids]
        writing = self._stream is not None
        if self._stream is not None:
            self._stream.close()
        self._copy(kept)
        self._places, self.status, self._end = {}, {}, 0
        self._guarded(self._index)
        if writing:
            self._stream = self._guarded(lambda: self.path.open("ab"))

    def _copy(self, places: Sequence[tuple[int, int]]) -> None:
        """Replace the journal by these of its lines."""
        with self.path.open("rb") as source, output_path(self.path) as part:
            with part.open("wb") as target:
                for start, size in places:
                    source.seek(start)
                    target.write(source.read(size))
            source.close()  # Windows does not replace an open file

    def _read(self) -> None:
        self.status, self.damaged, self._places = {}, [], {}
        self._end, self._torn = 0, b""
        if self.path.exists():
            self._index()

    def _index(self) -> None:
        """Read place and status of every intact line; the other lines are collected separately."""
        place = 0
        with self.path.open("rb") as stream:
            for line in stream:
                parts = line[9:-1].split(b" ", 2)
                if (
                    line[-1:] == b"\n"
                    and line[:9] == b"%08x " % zlib.crc32(line[9:-1])
                    and len(parts) == 3
                ):
                    self._end = place
                    self._note(parts[0].decode(), parts[1].decode(), len(line))
                elif line[-1:] == b"\n":
                    self.damaged.append(line)
                else:
                    self._torn = line
                place += len(line)

    def _set_aside(self) -> None:
        """Move lines that are not whole out of the journal."""
        if self.damaged:
            with (self.folder / "journal.damaged").open("ab") as stream:
                stream.write(b"".join(self.damaged))
        places = self._places
        self._copy(list(places.values()))
        self._end, self._torn, self._places = 0, b"", {}
        for run_id, (_, size) in places.items():
            self._note(run_id, self.status[run_id], size)

    def _note(self, run_id: str, status: str, size: int) -> None:
        self._places[run_id] = (self._end, size)
        self.status[run_id] = status
        self._end += size

    def _guarded(self, act: Callable[[], T]) -> T:
        try:
            return act()
        except OSError as error:
            what = error.strerror or "cannot be used"
            raise UnreadableInput(
                what, where=str(self.path), hint="check the folder, then run it again"
            ) from None


def _locked(path: Path) -> BinaryIO:
    """The open lock file of a folder; the system releases it when the process ends, however
    it ends.
    """
    stream = path.open("a+b")
    try:
        _lock(stream)
        if not in_place(stream, path):
            stream.close()
            return _locked(path)
    except OSError:
        stream.seek(0)
        owner = stream.read(200).decode("utf-8", "replace").strip() or "another process"
        stream.close()
        hint = "wait for it, or give another directory with -o"
        raise UsageError(
            f"the directory is in use by {owner}", where=str(path.parent), hint=hint
        ) from None
    stream.seek(0)
    stream.truncate()
    stream.write(f"process {os.getpid()} on {socket.gethostname()}\n".encode())
    stream.flush()
    return stream


def _lock(stream: BinaryIO) -> None:
    if sys.platform == "win32":
        import msvcrt

        stream.seek(1 << 20)  # beyond the text, which another process must be able to read
        msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _line(result: RunResult) -> bytes:
    values = {
        "error": result.error,
        "metrics": result.metrics,
        "episodes": result.episodes,
        "scans": len(result.scans) or result.scan_count,
    }
    rest = f"{result.id} {result.status} {json.dumps(values, separators=(',', ':'))}".encode()
    return b"%08x %s\n" % (zlib.crc32(rest), rest)


def _result(line: bytes) -> RunResult:
    run_id, status, body = line[9:-1].split(b" ", 2)
    values: dict[str, Any] = json.loads(body)
    metrics = values["metrics"] and {
        sys.intern(name): value for name, value in values["metrics"].items()
    }
    episodes = tuple(map(tuple, values["episodes"]))
    return RunResult(
        run_id.decode(), status.decode(), values["error"], metrics, (), episodes, values["scans"]
    )
