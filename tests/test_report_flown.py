"""What the page says about the flown approach."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avsreplay.assessment import Assessment, Chance
from avsreplay.outcome import CaptureError
from avsreplay.report.flown import flight_facts
from avsreplay.report.view import PathView, View

ACCEL_MPS2, T_S = 0.04, 10.0
HEADER = {
    "approach": {"base_m": [0.0, 0.0, 0.0], "reach_max_m": 3.0},
    "config": {"plan": {"a_max_mps2": 0.05}, "robot": {"mass_kg": 10.0}},
}


def facts(rows, view=None, assessment=None):
    return dict(flight_facts(rows, view, HEADER, assessment))


@pytest.fixture
def flown(make_rows):
    rows = [
        replace(row, action="approach", t_go_s=T_S, plan_margin_m=0.02 + k, plan_limit="cone")
        for k, row in enumerate(make_rows(20))
    ]
    t = np.linspace(0.0, T_S, 101)
    line = np.outer(0.5 * ACCEL_MPS2 * t**2, [1.0, 0.0, 0.0]).astype(np.float32)
    empty = np.zeros((0, 3), np.float32)
    return rows, View(empty, np.zeros((0, 3), np.int32), (), (PathView(rows[0].t_ns, line),))


def test_thrust_and_reach_are_those_of_the_path(flown):
    said = facts(*flown)
    assert said["thrust"] == "largest acceleration 0.04 of 0.05 m/s2, 0.4 N"
    assert said["reach"] == "2 m from the base at the contact, at most 2 m of 3 m"
    assert said["smallest margin"] == "20 mm to the cone"
    assert "withdrawals" not in said


def test_a_plan_that_is_not_flown_has_no_thrust(flown, make_rows):
    _, view = flown
    said = facts(make_rows(20), view)
    assert not {"thrust", "reach"} & set(said)


def test_the_reason_of_each_withdrawal_is_named(flown):
    rows, view = flown
    rows = [
        replace(row, action="abort", supervisor_rule="too_many_attempts") if row.seq >= 15 else row
        for row in rows
    ]
    assert facts(rows, view)["withdrawals"] == f"abort at {rows[15].t_s:.1f} s (too many attempts)"


def test_the_margin_is_that_of_the_error_nearest_to_its_tolerance(make_rows):
    assessment = Assessment(
        chance=Chance.LIKELY,
        at_s=12.3,
        tolerance=CaptureError(0.01, 0.01, 2.0),
        miss=CaptureError(0.001, 0.008, 0.2),
    )
    said = facts(make_rows(5), None, assessment)
    assert said["instant of contact"] == "12.30 s"
    assert said["margin to the tolerance"].startswith("20 % of the tolerance on the speed")
