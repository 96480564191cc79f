"""A continued run gives the bytes of an uninterrupted run; a checkpoint of unknown origin
executes no code.
"""

from __future__ import annotations

import json
import pickle
import signal
from itertools import islice

import numpy as np
import pytest

from avsreplay.binary_files import pack_state, read_limited, unpack
from avsreplay.cli.run import _collect
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import Pose
from avsreplay.log import SourceOptions
from avsreplay.report.result import write_manifest
from avsreplay.result_dir import CHECKPOINT, ResultDirectory, ResultWriter
from avsreplay.run import Job, Run


def job(log, *assignments, **options):
    return Job(source=log, options=SourceOptions(**options), assignments=assignments)


def replay(work, folder, count=None, resume=False):
    """Replay ``count`` scans (None: all that are left) into a result directory; return the
    number of rows in it.
    """
    with Run(work) as run, ResultWriter(ResultDirectory(folder, overwrite=resume), run) as writer:
        rows = writer.resume({"config": run.facts()["config"]}) if resume else []
        rows += islice(run.rows(writer.listeners), count)
        writer.finish(rows, {**run.facts(), "rows so far": len(rows)}, resumable=count is not None)
    return len(rows)


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("assignments", "stops"),
    [((), (1, 20)), (("reference=fit", "estimator.start=cold"), (12,)), (("init=auto",), (2,))],
)
def test_a_continued_run_has_the_bytes_of_a_run_without_interruption(
    fixtures_folder, tmp_path, assignments, stops
):
    work = job(fixtures_folder / "tumble.mcap", *assignments, n_scans=26)
    assert replay(work, tmp_path / "whole") == 26
    done = 0
    for k, stop in enumerate(stops):
        done += stop
        assert replay(work, tmp_path / "parts", stop, resume=k > 0) == done
        assert (tmp_path / "parts" / CHECKPOINT).is_file()
    assert replay(work, tmp_path / "parts", resume=True) == 26
    assert files(tmp_path / "parts") == files(tmp_path / "whole")


def test_other_settings_are_refused(fixtures_folder, tmp_path):
    replay(job(fixtures_folder / "tumble.mcap", n_scans=4), tmp_path / "r", 2)
    before = files(tmp_path / "r")
    with pytest.raises(UsageError, match="differs in: config"):
        replay(
            job(fixtures_folder / "tumble.mcap", "faults.policy=all", n_scans=4),
            tmp_path / "r",
            resume=True,
        )
    assert files(tmp_path / "r") == before


def test_a_finished_run_cannot_be_resumed(fixtures_folder, tmp_path):
    work = job(fixtures_folder / "tumble.mcap", n_scans=2)
    replay(work, tmp_path / "r")
    with pytest.raises(UsageError, match="no interrupted run"):
        replay(work, tmp_path / "r", resume=True)


def test_ctrl_c_takes_effect_between_two_scans(make_rows):
    finished = []

    def rows():
        for k, row in enumerate(make_rows(5)):
            if k == 2:
                signal.raise_signal(signal.SIGINT)
                finished.append("the work of this scan")
            yield row

    kept = []
    handler = signal.getsignal(signal.SIGINT)
    assert _collect(rows(), kept)
    assert (len(kept), finished) == (3, ["the work of this scan"])
    assert signal.getsignal(signal.SIGINT) is handler


def test_objects_of_the_run_are_named_and_not_stored(tmp_path):
    owner, pose = object(), Pose(np.array([0.0, 0.0, 0.0, 1.0]), np.arange(3.0))
    path = tmp_path / "c"
    path.write_bytes(pack_state((owner, pose, {"a": [1.5]}), {"owner": owner}))
    replaced, again, rest = unpack(path, {"owner": 7})
    assert (replaced, rest) == (7, {"a": [1.5]})
    assert np.array_equal(again.matrix, pose.matrix)


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("os", "unlink"),
        ("avsreplay.files", "is_stream"),
        ("avsreplay.log.writer", "os.unlink"),
        ("builtins", "eval"),
    ],
)
def test_a_checkpoint_from_elsewhere_runs_no_code(tmp_path, module, name):
    path, victim = tmp_path / "c", tmp_path / "victim"
    victim.write_text("x")
    path.write_bytes(
        f"c{module}\n{name}\n(V{victim}\ntR.".encode()
    )  # protocol 0: call it with the path
    with pytest.raises(UnreadableInput, match="cannot be read"):
        unpack(path, {})
    assert victim.exists()
    head = pickle.PROTO + b"\x05"
    words = [
        b"\x8c" + bytes([len(word)]) + word.encode() for word in (module, name, str(victim)[-200:])
    ]
    path.write_bytes(
        head
        + words[0]
        + words[1]
        + pickle.STACK_GLOBAL
        + words[2]
        + pickle.TUPLE1
        + pickle.REDUCE
        + b"."
    )
    with pytest.raises(UnreadableInput, match="not allowed"):
        unpack(path, {})
    assert victim.exists()


def test_classes_that_act_when_created_are_refused(tmp_path):
    path, victim = tmp_path / "c", tmp_path / "victim"
    victim.write_text("x")
    path.write_bytes(f"cavsreplay.log.result_log\nResultLog\n(V{victim}\nNtR.".encode())
    with pytest.raises(UnreadableInput, match="not allowed"):
        unpack(path, {})
    assert victim.read_text() == "x"


@pytest.mark.parametrize("name", [b"_taken", b"_unmatched", b"_captured_ns", b"_clouds", b"_known"])
def test_a_checkpoint_with_another_attribute_is_one_line(fixtures_folder, tmp_path, name):
    """The bytes of one name are changed, and the SHA-256 of the file is made to fit."""
    work = job(fixtures_folder / "tumble.mcap", n_scans=4)
    replay(work, tmp_path / "r", 2)
    path = tmp_path / "r" / CHECKPOINT
    data = path.read_bytes()
    assert name in data
    path.write_bytes(data.replace(name, name[:-1] + b"X"))
    record = json.loads((tmp_path / "r" / "run.json").read_text())
    (tmp_path / "r" / "run.json").unlink()
    write_manifest(tmp_path / "r", record, 2)
    with pytest.raises(UnreadableInput, match="the checkpoint cannot be read"):
        replay(work, tmp_path / "r", resume=True)


def test_a_damaged_log_of_an_interrupted_run_is_one_line(fixtures_folder, tmp_path):
    """A text in a record is no longer UTF-8, and the SHA-256 of the file is made to fit."""
    work = job(fixtures_folder / "tumble.mcap", n_scans=4)
    replay(work, tmp_path / "r", 2)
    path = tmp_path / "r" / "result.mcap"
    data = path.read_bytes()
    assert b"/pose" in data[:200_000]
    path.write_bytes(data.replace(b"tf2_msgs", b"tf2\x80msgs"))
    record = json.loads((tmp_path / "r" / "run.json").read_text())
    (tmp_path / "r" / "run.json").unlink()
    write_manifest(tmp_path / "r", record, 2)
    before = sorted(p.name for p in tmp_path.iterdir())
    with pytest.raises(UnreadableInput, match="is damaged"):
        replay(work, tmp_path / "r", resume=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == before


@pytest.mark.parametrize("cut", [0, 1, 20, -1])
def test_a_damaged_checkpoint_is_one_line(tmp_path, cut):
    data = pack_state({"a": np.arange(10.0), "b": Pose.identity()}, {})
    path = tmp_path / "c"
    path.write_bytes(data[:cut])
    with pytest.raises(UnreadableInput):
        unpack(path, {})


def test_reading_a_file_allocates_its_size_and_not_the_limit(tmp_path):
    """``read(n)`` allocates n bytes; Windows refuses 16 GiB, the limit of a checkpoint."""
    path = tmp_path / "file"
    path.write_bytes(b"seven")
    assert read_limited(path, 1 << 62, "") == b"seven"
    with pytest.raises(UnreadableInput, match="larger than 0 MiB"):
        read_limited(path, 4, "")
