"""A back end that fails: every scan has a row with the message, and the verdict repeats it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from avsreplay.geometry import IDENTITY_QUAT, Pose
from avsreplay.log import SourceOptions
from avsreplay.records import Fit
from avsreplay.register import registrar
from avsreplay.register.backend import Backend
from avsreplay.register.registrar import POSTPONED
from avsreplay.report.summary import Summary
from avsreplay.report.verdict import Grade, verdict_of
from avsreplay.run import Job, Run

LOG = Path(__file__).parents[1] / "fixtures" / "tumble.mcap"


def _raises(points, guess):
    raise RuntimeError("no licence\nsecond line")


def _not_finite(points, guess):
    fit = Fit(Pose(IDENTITY_QUAT, np.zeros(3)), 1, True)
    object.__setattr__(fit.T_ca, "t", np.full(3, np.nan))
    return fit


CASES = {
    "back end 'horn' failed: RuntimeError: no licence": _raises,
    "back end 'horn' returned tuple, not Fit": lambda points, guess: (guess, 3, True),
    "back end 'horn' returned NoneType, not Fit": lambda points, guess: None,
    "back end 'horn' returned a pose that is not finite": _not_finite,
}


def _replace_backend(monkeypatch, align):
    """Let every registration of a run use ``align`` in place of the back end."""
    backend = type("Other", (Backend,), {"align": staticmethod(align)})(None)
    monkeypatch.setattr(registrar, "create_backend", lambda *_: backend)


@pytest.mark.parametrize("message", CASES)
def test_a_back_end_that_fails_is_named_in_every_row_and_in_the_verdict(monkeypatch, message):
    _replace_backend(monkeypatch, CASES[message])
    with Run(Job(source=LOG, options=SourceOptions(n_scans=2))) as run:
        rows = list(run.rows())
    assert [(row.status, row.gamma, row.message) for row in rows] == [("failed", 0, message)] * 2
    verdict = verdict_of(rows, Summary.fold(rows))
    assert verdict.grade is Grade.FAIL
    assert any(message in reason.text for reason in verdict.reasons)


def test_a_back_end_that_returns_its_guess_is_no_sensor(monkeypatch):
    """The first pose is that of the global search; the later ones would be those of the
    filter itself, with NIS 0.
    """
    _replace_backend(monkeypatch, lambda points, guess: Fit(guess, 1, True))
    with Run(Job(source=LOG, options=SourceOptions(n_scans=4))) as run:
        rows = list(run.rows())
    message = "back end 'horn' returned its guess unchanged, although the residuals require a step"
    assert not any(row.gamma for row in rows[1:])
    assert (rows[1].status, rows[1].message) == ("failed", message)
    verdict = verdict_of(rows, Summary.fold(rows))
    assert verdict.grade is Grade.FAIL
    assert any(message in reason.text for reason in verdict.reasons)


def test_a_healthy_scan_has_no_message():
    with Run(Job(source=LOG, options=SourceOptions(n_scans=2))) as run:
        assert [row.message for row in run.rows()] == [None] * 2


def test_a_wrong_model_is_searched_where_the_scans_show_something_else(tmp_path):
    """Without a pose of the log; the rows say so."""
    model = tmp_path / "other.ply"
    trimesh.creation.torus(1.5, 0.5).export(model)
    with Run(Job(source=LOG, options=SourceOptions(n_scans=24, model=model))) as run:
        run.stages = replace(run.stages, initialise=lambda scan: (None, "acquired"))
        rows = list(run.rows())
    points = [row for row in rows if row.points]
    postponed = [row for row in points if row.message == POSTPONED]
    assert not any(row.gamma for row in rows)
    assert 1 <= len(points) - len(postponed) <= 9  # these were searched
    assert {row.status for row in postponed} == {"postponed"}
    assert "postponed" not in {row.status for row in points if row.message != POSTPONED}
