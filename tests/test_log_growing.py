"""A growing log: scans are replayed when they are complete, and the rows are those of the
whole log.
"""

from __future__ import annotations

import dataclasses
import errno
import io
import os
import shutil
import sys
import threading

import numpy as np
import pytest

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.log import GrowingLog, LogWriter, SourceOptions, open_source
from avsreplay.records import LogHeader, Scan
from avsreplay.result_dir import ResultDirectory, ResultWriter
from avsreplay.run import Job, Run

OPTIONS = SourceOptions(n_scans=9)


class Pieces(io.RawIOBase):
    """A stream that gives its bytes in pieces."""

    def __init__(self, data, sizes):
        self.data, self.sizes, self.at = data, sizes, 0

    def read1(self, _most):
        size = next(self.sizes)
        piece, self.at = self.data[self.at : self.at + size], self.at + size
        return piece


def sizes(seed, most):
    rng = np.random.default_rng(seed)
    while True:
        yield int(rng.integers(1, most))


def grown(log, tmp_path, step):
    return GrowingLog(tmp_path / "stream", Pieces(log.read_bytes(), sizes(step, step)))


@pytest.fixture
def log(tmp_path, fixtures_folder):
    """Nine scans of the short recording, in small chunks."""
    path = tmp_path / "log.mcap"
    with open_source(fixtures_folder / "tumble.mcap", OPTIONS) as source:
        header = dataclasses.replace(source.header, labels=())
        with LogWriter(path, header, chunk_bytes=1) as writer:
            for scan in source.scans():
                writer.write(scan)
                truth = source.truth_of(scan)
                writer.write_truth(scan.log_ns, scan.t_ns, truth.pose, truth.state)
    return path


@pytest.mark.parametrize("step", [700, 20_000, 10_000_000])
def test_a_stream_gives_the_rows_of_the_whole_log(log, tmp_path, step):
    with Run(Job(source=log)) as run:
        expected, record = list(run.rows()), run.facts()
    growing = grown(log, tmp_path, step)
    with Run(Job(source=growing.path, growing=growing)) as run:
        rows = list(run.rows())
        assert not growing.outdated()
        facts = run.facts()
    assert rows == expected
    assert facts["log"]["sha256"] == record["log"]["sha256"]
    assert facts["losses"]["count"] == 0


def test_a_scan_is_given_while_the_file_is_still_written(log, tmp_path):
    data, path = log.read_bytes(), tmp_path / "growing.mcap"
    there = data.rindex(b"/truth/pose") - 40_000  # several scans before the summary
    path.write_bytes(data[:there])
    growing = GrowingLog(path)
    growing.open(SourceOptions())
    scans = growing.scans()
    count = len(growing.source) - 1
    assert count >= 1
    first = [next(scans) for _ in range(count)]
    assert [scan.seq for scan in first] == list(range(count))
    assert not growing.finished
    with path.open("ab") as file:
        file.write(data[there:])
    rest = list(scans)
    assert growing.finished
    with open_source(log) as source:
        for scan, whole in zip([*first, *rest], source.scans(), strict=True):
            assert (scan.t_ns, scan.points.tobytes()) == (whole.t_ns, whole.points.tobytes())


def test_stop_ends_a_file_that_is_never_closed(log, tmp_path):
    path = tmp_path / "open.mcap"
    path.write_bytes(log.read_bytes()[:-2000])
    growing = GrowingLog(path)
    growing.open(SourceOptions())
    threading.Timer(0.2, growing.stop).start()
    count = len(list(growing.scans()))
    assert count == len(growing.source) >= 1


def test_a_clock_that_steps_later_makes_the_rows_outdated(tmp_path):
    def stamp(k):
        return (10 + k) * 10**9 + (40 * 10**9 if k >= 9 else 0)

    path = tmp_path / "steps.mcap"
    rng = np.random.default_rng(1)
    with LogWriter(path, LogHeader(), chunk_bytes=1) as writer:
        for k in range(12):
            points = rng.standard_normal((50, 3)).astype(np.float32)
            writer.write(Scan(k, 0 if k < 3 else stamp(k), points, log_ns=(10 + k) * 10**9))
    growing = grown(path, tmp_path, 300)
    first = growing.open(SourceOptions())
    clock, used = (first.first_ns, first.clock.period_s), []
    for scan in growing.scans():
        used.append(scan.t_ns)
        growing.take(scan, growing.source.truth_of(scan))
    outdated = growing.outdated()
    with open_source(path) as whole:
        same = [scan.t_ns for scan in whole.scans()] == used
        # the stages were made from the scans of the first opening, whose number depends on the
        # writer
        same = same and clock == (whole.first_ns, whole.clock.period_s)
    assert outdated != same


class Written(GrowingLog):
    """A file that is longer by a piece at each look."""

    def __init__(self, path, data, count):
        self.pieces = [
            bytes(piece) for piece in np.array_split(np.frombuffer(data, np.uint8), count)
        ]
        path.write_bytes(self.pieces.pop(0))
        super().__init__(path)

    def advance(self):
        if self.pieces:
            with self.path.open("ab") as file:
                file.write(self.pieces.pop(0))
        return super().advance()


def test_plans_are_scored_with_the_true_poses_after_them_without_a_second_replay(
    fixtures_folder, tmp_path
):
    """A strong robot arrives before the log ends; the true poses at its arrival come after
    the plan.
    """
    log, settings = fixtures_folder / "tumble.mcap", ("plan.a_max_mps2=5",)
    growing = Written(tmp_path / "log.mcap", log.read_bytes(), 20)
    job = Job(source=log, assignments=settings)
    folders = {}
    for name, wanted in (("whole", job), ("grown", dataclasses.replace(job, growing=growing))):
        folders[name] = tmp_path / name
        with Run(wanted) as run, ResultWriter(ResultDirectory(folders[name]), run) as writer:
            rows = list(run.rows(writer.listeners))
            missed = [row.plan_miss_m for row in rows]
            if run.job.growing:
                assert not run.job.growing.outdated()
                changed = run.rescore()
                rows = list(run.taken)
                assert [row.plan_miss_m for row in rows] != missed
                writer.correct(rows, changed)
            summary = dataclasses.asdict(run.summary())
            writer.finish({"summary": repr(summary)})
    files = {path.name: path.read_bytes() for path in folders["whole"].iterdir()}
    assert {path.name: path.read_bytes() for path in folders["grown"].iterdir()} == files
    assert any(row.capture_miss_m is not None for row in rows)


@pytest.mark.parametrize("content", [b"", b"not a log at all, but long enough"])
def test_a_stream_that_is_no_log_is_one_line(tmp_path, content):
    growing = GrowingLog(tmp_path / "stream", io.BytesIO(content))
    with pytest.raises(UnreadableInput):
        growing.open(SourceOptions())


def test_only_an_mcap_file_can_be_followed(tmp_path):
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    for name in ("a.bag", "none.mcap", "."):
        with pytest.raises(UsageError, match="--follow"):
            GrowingLog(tmp_path / name)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs FIFOs")
def test_a_log_written_to_a_pipe_has_the_bytes_of_a_file(tmp_path):
    def write(path):
        with LogWriter(path, LogHeader()) as writer:
            for k in range(5):
                writer.write(
                    Scan(k, (k + 1) * 10**9, np.ones((9, 3), np.float32), log_ns=(k + 1) * 10**9)
                )
        return writer.bytes

    fifo, got = tmp_path / "fifo", []
    os.mkfifo(fifo)
    reader = threading.Thread(target=lambda: got.append(fifo.read_bytes()))
    reader.start()
    size = write(fifo)
    reader.join()
    assert write(tmp_path / "file") == size == len(got[0])
    assert got[0] == (tmp_path / "file").read_bytes()


class Broken(Pieces):
    """A stream that cannot be read any more after some bytes."""

    def read1(self, most):
        if self.at >= len(self.data):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return super().read1(most)


def test_a_stream_that_breaks_off_is_a_loss_and_never_taken_for_the_end(log, tmp_path):
    data = log.read_bytes()
    growing = GrowingLog(tmp_path / "stream", Broken(data[: 2 * len(data) // 3], sizes(1, 5000)))
    with Run(Job(source=growing.path, growing=growing)) as run:
        count = len(list(run.rows()))
        assert any(
            "broke off" in loss.what and "Input/output error" in loss.what
            for loss in run.source.losses
        )
    with open_source(log) as source:
        assert 1 < count < len(source)


def test_a_stream_that_breaks_off_before_a_scan_states_the_cause(tmp_path):
    growing = GrowingLog(tmp_path / "stream", Broken(b"", sizes(1, 5)))
    with pytest.raises(UnreadableInput, match="broke off: Input/output error"):
        growing.open(SourceOptions())


@pytest.mark.skipif(sys.platform == "win32", reason="an open file cannot be removed there")
def test_a_stream_whose_folder_is_removed_at_once_writes_nothing_to_the_terminal(
    tmp_path, monkeypatch, capfd
):
    """A command may end with an error and remove its folder before the thread that copies the
    stream has begun.
    """
    begun = []
    monkeypatch.setattr(threading.Thread, "start", lambda thread: begun.append(thread))
    folder = tmp_path / "folder"
    folder.mkdir()
    GrowingLog(folder / "stream", io.BytesIO(b"x" * 1000))
    shutil.rmtree(folder)
    begun[0].run()
    assert capfd.readouterr().err == ""
