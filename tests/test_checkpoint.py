"""A continued run gives the bytes of an uninterrupted run; a checkpoint of unknown origin
executes no code.
"""

from __future__ import annotations

import ast
import json
import math
import pickle
import signal
import sys
from collections import Counter
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import avsreplay
from avsreplay.checkpoint import pack, unpack
from avsreplay.cli.run import collect
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import Pose
from avsreplay.log import SourceOptions
from avsreplay.records import ScanStatus
from avsreplay.register.interrupt import request_stop, shielded
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
        if resume:
            writer.resume({"config": run.facts()["config"]})
        for _ in islice(run.rows(writer.listeners), count):
            pass
        record = {**run.facts(), "rows so far": len(run.taken)}
        writer.finish(record, resumable=count is not None)
    return len(run.taken)


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


@pytest.fixture
def stoppable():
    yield
    request_stop(False)


@pytest.mark.usefixtures("stoppable")
@pytest.mark.parametrize("prefetch", [0, 2])
def test_a_run_that_is_ended_within_a_scan_is_continued_with_the_same_bytes(
    fixtures_folder, tmp_path, prefetch
):
    work = replace(job(fixtures_folder / "tumble.mcap", n_scans=12), prefetch=prefetch)
    assert replay(work, tmp_path / "whole") == 12
    rows = []
    with Run(work) as run, ResultWriter(ResultDirectory(tmp_path / "r"), run) as writer:
        found = run.rows(writer.listeners)
        rows += islice(found, 5)
        request_stop()
        with pytest.raises(KeyboardInterrupt):
            rows.extend(found)
        request_stop(False)
        assert 5 <= len(rows) < 12
        assert run.taken == rows
        writer.finish({**run.facts(), "rows so far": len(rows)}, resumable=True)
    assert replay(work, tmp_path / "r", resume=True) == 12
    assert files(tmp_path / "r") == files(tmp_path / "whole")


@pytest.mark.usefixtures("stoppable")
def test_registrations_end_on_request_unless_they_are_shielded(fixtures_folder):
    with Run(job(fixtures_folder / "tumble.mcap", n_scans=2)) as run:
        index = run.registrar.index
        points = np.random.default_rng(1).normal(size=(5000, 3))
        before = index.closest(points)
        request_stop()
        with pytest.raises(KeyboardInterrupt):
            index.closest(points)
        with shielded():
            assert np.array_equal(index.closest(points).id, before.id)
        request_stop(False)
        assert np.array_equal(index.closest(points).id, before.id)


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
            kept.append(row)
            yield row

    kept = []
    handler = signal.getsignal(signal.SIGINT)
    assert collect(rows(), kept)
    assert (len(kept), finished) == (3, ["the work of this scan"])
    assert signal.getsignal(signal.SIGINT) is handler


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


def stored(path, **changes):
    """Write the checkpoint of a small value whose document has these entries instead."""
    path.write_bytes(pack({"a": 1}, {}))
    with np.load(path) as arrays:
        document = json.loads(arrays["state.json"].tobytes()) | changes
    text = np.frombuffer(json.dumps(document).encode(), "u1")
    np.savez(path, **{"state.json": text})
    return path


class Collector:
    """An object of no data class."""

    def __init__(self):
        self.taken = [1, 2]


@pytest.mark.parametrize(
    "value",
    [
        [1, 2.5, "text", None, True, 1 << 80, math.inf, -0.0],
        (1.0, 2.0, math.pi),
        [1, 2, 1 << 70],
        {"a": [1], 2: (3, "x"), (4, 5): {6, 7}},
        frozenset({1}),
        Counter("abca"),
        np.float64(0.1),
        np.bool_(True),
        np.array(7),
        np.zeros((0, 3), np.float32),
        np.array([True, False]),
        Pose.identity(),
        ScanStatus.OK,
        [ScanStatus.OK, Pose.identity()],
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_value_is_read_as_it_was(tmp_path, value):
    path = tmp_path / "c"
    path.write_bytes(pack(value, {}))
    again = unpack(path, {})
    assert type(again) is type(value)
    assert repr(again) == repr(value)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("writeable", [True, False])
def test_arrays_keep_bits_order_and_protection(tmp_path, order, writeable):
    array = np.array(np.random.default_rng(1).normal(size=(3, 4, 5)), order=order)
    array[0, 0, 0], array.flags.writeable = np.nan, writeable
    (tmp_path / "c").write_bytes(pack([array, array], {}))
    one, two = unpack(tmp_path / "c", {})
    assert one is two
    assert one.tobytes("A") == array.tobytes("A")
    assert (one.strides, one.flags.writeable) == (array.strides, writeable)


def test_objects_of_the_run_are_named_and_not_stored(tmp_path):
    owner, pose = object(), Pose(np.array([0.0, 0.0, 0.0, 1.0]), np.arange(3.0))
    path = tmp_path / "c"
    path.write_bytes(pack((owner, pose, {"a": [1.5]}), {"owner": owner}))
    replaced, again, rest = unpack(path, {"owner": 7})
    assert (replaced, rest) == (7, {"a": [1.5]})
    assert np.array_equal(again.matrix, pose.matrix)


@pytest.mark.parametrize("value", [object(), lambda: 1, open, Collector(), np.array([None])])
def test_what_is_no_data_is_not_stored(value):
    with pytest.raises(TypeError, match="cannot be stored"):
        pack([value], {})


def test_a_value_that_contains_itself_is_not_stored():
    circle = []
    circle.append(circle)
    with pytest.raises(TypeError, match="contains itself"):
        pack(circle, {})


@pytest.mark.parametrize(
    "node",
    [
        ["object", "os:unlink", {}],
        ["object", "avsreplay.log.result_log:ResultLog", {"path": "victim"}],
        ["object", "avsreplay.files:is_stream", {}],
        ["object", "avsreplay.log.writer:os", {}],
        ["object", "avsreplay.__main__:main", {}],
        ["object", "avsreplay.geometry:Pose", {}],
        ["object", "avsreplay.geometry:Pose", {"q_xyzw": 1, "t": 2, "more": 3}],
        ["object", "avsreplay.nothing:Pose", {}],
        ["enum", "avsreplay.geometry:Pose", "x"],
        ["enum", "avsreplay.records:ScanStatus", "nothing"],
        ["named", "owner"],
        ["array", "f8", 0, [1 << 60], "C", True],
        ["array", "f8", 0, [-1], "C", True],
        ["array", "O", 0, [1], "C", True],
        ["call", "print"],
        ["list", [5]],
        ["list", [0]],
        ["float", []],
        ["dict", 1],
        [],
        3,
    ],
    ids=str,
)
def test_a_document_that_no_run_writes_is_refused(tmp_path, node):
    with pytest.raises(UnreadableInput, match="the checkpoint cannot be read"):
        unpack(stored(tmp_path / "c.npz", nodes=[node], root=[0]), {})


@pytest.mark.parametrize("change", [{"version": 0}, {"more": 1}, {"root": [9]}, {"root": [-1]}])
def test_another_version_or_root_is_refused(tmp_path, change):
    with pytest.raises(UnreadableInput, match="the checkpoint cannot be read"):
        unpack(stored(tmp_path / "c.npz", **change), {})


def test_a_field_of_another_type_is_refused(tmp_path):
    path = stored(
        tmp_path / "c.npz",
        nodes=[["object", "avsreplay.geometry:Pose", {"q_xyzw": "one", "t": "two"}]],
        root=[0],
    )
    with pytest.raises(UnreadableInput, match=r"Pose"):
        unpack(path, {})


@pytest.mark.parametrize("name", ["_unmatched", "_captured_ns", "_known"])
def test_a_checkpoint_with_another_attribute_is_one_line(fixtures_folder, tmp_path, name):
    """The bytes of one name are changed, and the SHA-256 of the file is made to fit."""
    work = job(fixtures_folder / "tumble.mcap", n_scans=4)
    replay(work, tmp_path / "r", 2)
    path = tmp_path / "r" / CHECKPOINT
    with np.load(path) as found:
        arrays = dict(found)
    text = arrays["state.json"].tobytes()
    assert f'"{name}":'.encode() in text
    changed = text.replace(f'"{name}":'.encode(), f'"{name}X":'.encode())
    np.savez(path, **(arrays | {"state.json": np.frombuffer(changed, "u1")}))
    record = json.loads((tmp_path / "r" / "run.json").read_text())
    (tmp_path / "r" / "run.json").unlink()
    write_manifest(tmp_path / "r", record, 2)
    with pytest.raises(UnreadableInput, match="the checkpoint cannot be read"):
        replay(work, tmp_path / "r", resume=True)


@pytest.mark.parametrize("cut", [0, 1, 20, -1])
def test_a_damaged_checkpoint_is_one_line(tmp_path, cut):
    data = pack({"a": np.arange(10.0), "b": Pose.identity()}, {})
    path = tmp_path / "c"
    path.write_bytes(data[:cut])
    with pytest.raises(UnreadableInput):
        unpack(path, {})


def test_a_pickle_is_no_checkpoint(tmp_path):
    path = tmp_path / "c"
    path.write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(UnreadableInput):
        unpack(path, {})


CODE_FROM_BYTES = {
    "pickle",
    "_pickle",
    "cPickle",
    "dill",
    "cloudpickle",
    "marshal",
    "shelve",
    "joblib",
}


def test_no_module_of_the_package_reads_code_from_bytes():
    package = Path(avsreplay.__file__).parent
    found = []
    for path in sorted(package.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_bytes())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                names += [node.func.id] if node.func.id in ("eval", "exec", "compile") else []
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
                names += [] if getattr(node.value, "value", None) is False else ["pickle"]
            if any(name.partition(".")[0] in {*CODE_FROM_BYTES, "eval", "exec"} for name in names):
                found.append(f"{path.name}:{node.lineno}")
    assert found == []


@pytest.mark.usefixtures("stoppable")
@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
@pytest.mark.parametrize("place", ["a listener", "the pipeline"])
def test_a_second_ctrl_c_leaves_no_part_of_a_scan(fixtures_folder, tmp_path, monkeypatch, place):
    """Wherever it arrives, the rows are those of whole scans, and the run continues from them."""
    work = job(fixtures_folder / "tumble.mcap", n_scans=8)
    assert replay(work, tmp_path / "whole") == 8

    def twice(*_):
        if len(run.taken) == 4:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    with Run(work) as run, ResultWriter(ResultDirectory(tmp_path / "r"), run) as writer:
        listeners = writer.listeners
        if place == "a listener":
            listeners = listeners[0], twice, *listeners[1:]
        else:
            published = run.estimator.published
            monkeypatch.setattr(
                type(run.estimator), "published", lambda _, track: twice() or published(track)
            )
        rows = run.taken
        assert collect(run.rows(listeners), rows)
        assert len(rows) == (5 if place == "a listener" else 4)
        monkeypatch.undo()
        writer.finish({**run.facts(), "rows so far": len(rows)}, resumable=True)
    assert replay(work, tmp_path / "r", resume=True) == 8
    assert files(tmp_path / "r") == files(tmp_path / "whole")
