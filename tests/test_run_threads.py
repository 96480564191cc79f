"""Decoding, the pipeline and the writing overlap on threads; the results do not depend on it."""

from __future__ import annotations

import filecmp
import threading
from pathlib import Path

import pytest

from avsreplay import pipeline
from avsreplay.log import SourceOptions
from avsreplay.result_dir import ResultDirectory, ResultWriter
from avsreplay.run import Job, Run

LOG = Path(__file__).parents[1] / "fixtures" / "tumble.mcap"
FILES = (
    "rows.jsonl",
    "estimate.tum",
    "registration.tum",
    "truth.tum",
    "beliefs.npz",
    "result.mcap",
    "view.npz",
)


def _write(out, prefetch, n_scans=15):
    with Run(Job(source=LOG, options=SourceOptions(n_scans=n_scans), prefetch=prefetch)) as run:
        writer = ResultWriter(ResultDirectory(out), run)
        with writer:
            assert len(list(run.rows(writer.listeners))) == n_scans
            writer.finish({})


def test_one_thread_and_three_write_the_same_bytes(tmp_path):
    _write(tmp_path / "one", prefetch=0)
    _write(tmp_path / "three", prefetch=2)
    same, differ, missing = filecmp.cmpfiles(
        tmp_path / "one", tmp_path / "three", FILES, shallow=False
    )
    assert (sorted(same), differ, missing) == (sorted(FILES), [], [])


def test_the_pipeline_runs_beside_the_listeners():
    threads = set()
    step = pipeline.step

    def noted(*args):
        threads.add(threading.current_thread())
        return step(*args)

    job = Job(source=LOG, options=SourceOptions(n_scans=3), prefetch=1)
    with pytest.MonkeyPatch.context() as patch, Run(job) as run:
        patch.setattr(pipeline, "step", noted)
        assert len(list(run.rows())) == 3
    assert threading.current_thread() not in threads


def test_an_error_of_the_pipeline_is_raised_where_the_rows_are_taken(monkeypatch):
    def broken(*args):
        raise ZeroDivisionError("in the pipeline")

    monkeypatch.setattr(pipeline, "step", broken)
    before = set(threading.enumerate())
    with (
        Run(Job(source=LOG, prefetch=2)) as run,
        pytest.raises(ZeroDivisionError, match="in the pipeline"),
    ):
        list(run.rows())
    assert set(threading.enumerate()) <= before


def test_an_interrupted_replay_leaves_no_thread():
    before = set(threading.enumerate())
    with Run(Job(source=LOG, prefetch=2)) as run:
        rows = run.rows()
        next(rows)
        rows.close()
        assert set(threading.enumerate()) <= before
