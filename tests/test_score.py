"""Ground truth affects the score of a run and no other column."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from avsreplay import geometry
from avsreplay.geometry import Pose
from avsreplay.log import SourceOptions
from avsreplay.log.source import Source
from avsreplay.records import Truth
from avsreplay.run import Job, Run

LOG = Path(__file__).parents[1] / "fixtures" / "tumble.mcap"
SCORED = ("pos_err", "rot_err", "reg_pos_err", "reg_rot_err", "nees", "capture_miss", "plan_miss")


def _rows(**selection):
    with Run(Job(source=LOG, options=SourceOptions(**selection))) as run:
        return list(run.rows())


def _unscored(row):
    fields = dataclasses.asdict(row)
    return {
        k: v
        for k, v in fields.items()
        if not k.startswith(SCORED) and k not in ("fault", "reference")
    }


def test_a_wrong_truth_changes_the_score_and_no_other_column(monkeypatch):
    honest = _rows(n_scans=12)
    away = Pose(geometry.exp([0.0, 0.1, 0.0]), np.array([1.0, 2.0, 3.0]))
    right = Source.truth_of

    def wrong(source, scan):
        truth = right(source, scan)
        return Truth(away @ truth.pose, None, "occlusion")

    monkeypatch.setattr(Source, "truth_of", wrong)
    monkeypatch.setattr(Source, "truth_poses", lambda source: [])
    misled = _rows(n_scans=12)
    assert [_unscored(row) for row in misled] == [_unscored(row) for row in honest]
    assert all(
        row.fault == "occlusion" and row.pos_err_m > 1.0 and row.nees is None for row in misled
    )


def test_errors_are_distances_to_the_truth_of_the_scan():
    with Run(Job(source=LOG, options=SourceOptions(n_scans=5))) as run:
        heard = []
        rows = list(run.rows([heard.append]))
    assert [scan.row for scan in heard] == rows
    for scan in heard:
        estimate, truth = np.array([scan.row.x_m, scan.row.y_m, scan.row.z_m]), scan.truth.pose
        assert scan.row.pos_err_m == pytest.approx(np.linalg.norm(estimate - truth.t), abs=1e-12)
        cosine = abs(float(scan.outcome.pose.q @ truth.q))
        assert scan.row.rot_err_deg == pytest.approx(
            np.degrees(2.0 * np.arccos(min(cosine, 1.0))), abs=1e-5
        )


def test_a_reference_is_fitted_when_asked_for_and_not_in_the_constructor(monkeypatch):
    passes = []
    scans = Source.scans
    monkeypatch.setattr(
        Source, "scans", lambda source, *args: passes.append(1) or scans(source, *args)
    )
    with Run(
        Job(source=LOG, options=SourceOptions(n_scans=12), assignments=("reference=fit",))
    ) as run:
        assert passes == []
        shown = []
        run.fit_reference(lambda items, count, what: shown.append((count, what)) or items)
        assert (shown, passes) == ([(12, "fitting")], [1])
        rows = list(run.rows())
    assert passes == [1, 1]
    inside = [row for row in rows if row.reference == "fit"]
    assert inside
    assert all(row.pos_err_m is not None and row.nees is None for row in inside)
