"""``avsreplay bench``: every back end on every scan in turn, with errors relative to the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from avsreplay.cli.backends import bench_command, benchmark_backends
from avsreplay.errors import MissingBackend, UnreadableInput, UsageError
from avsreplay.geometry import Pose, exp
from avsreplay.register.contract import boxes, example_pose, view


def _scans(count: int, truth: bool = True) -> list[tuple[np.ndarray, Pose | None]]:
    surface, step = boxes(), Pose(exp([0.004, 0.0, 0.01]), np.zeros(3))
    scans, pose = [], example_pose()
    for _ in range(count):
        points = pose.apply(view(surface, 2000, pose.inverse().t))
        scans.append((points, pose if truth else None))
        pose = pose @ step
    return scans


@pytest.mark.parametrize("truth", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_every_scan_but_the_first_is_counted(monkeypatch: pytest.MonkeyPatch, truth: bool) -> None:
    monkeypatch.setattr("avsreplay.cli.backends._peak_mib", lambda *_: 1.0)
    tallies = benchmark_backends(["horn", "small_gicp"], boxes(), _scans(4, truth))
    for tally in tallies:
        record = tally.summary()
        assert (record["scans"], record["failures"], record["peak_mib"]) == (3, 0, 1.0)
        assert record["median_ms"] > 0.0
        assert (record["rot_err_rms_deg"] is None) == (not truth)
    if truth:
        assert tallies[0].summary()["pos_err_rms_mm"] < 0.1


def test_a_scan_of_nothing_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("avsreplay.cli.backends._peak_mib", lambda *_: None)
    scans = _scans(3)
    away = (scans[-1][0] + 100.0, scans[-1][1])
    (tally,) = benchmark_backends(["horn"], boxes(), [*scans, away])
    assert tally.failures == 1


def test_bad_input_is_one_line(tmp_path: Path) -> None:
    asked = {
        ("nowhere.mcap",): UnreadableInput,
        ("nowhere.mcap", "--backends", " , "): UsageError,
    }
    for arguments, error in asked.items():
        assert isinstance(CliRunner().invoke(bench_command, list(arguments)).exception, error)
    with pytest.raises(UsageError):
        benchmark_backends(["no_such"], boxes(), [])


def test_a_missing_library_is_said_before_anything_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "avsreplay.register.peers.KissBackend.requires", (("no_such_module", "kiss-icp"),)
    )
    with pytest.raises(MissingBackend):
        benchmark_backends(["kiss"], boxes(), _scans(1))


def test_an_unknown_back_end_names_the_option_of_this_command(fixtures_folder: Path) -> None:
    words = [str(fixtures_folder / "tumble.mcap"), "--backends", "horn,nope", "--n-scans", "1"]
    done = CliRunner().invoke(bench_command, words)
    assert isinstance(done.exception, UsageError)
    assert str(done.exception).startswith("--backends: no registration back end is called 'nope'")
