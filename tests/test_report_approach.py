"""The picture of the approach in the frame of the fixture."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from avsreplay.report.approach import approach_picture, flown_parts
from avsreplay.report.view import PathView, View
from avsreplay.rows import Row

HALF = float(np.sqrt(0.5))
SQUARE = np.array([[0.0, -1.0, -1.0], [0.0, 1.0, -1.0], [0.0, 1.0, 1.0]], np.float32)


def rows(action: str = "approach") -> list[Row]:
    """A target at (0, 0, 5) m whose {C} is {A} turned by 90 degrees about z; a plan of 10 s
    is made at the scan 2.
    """
    place = {"x_m": 0.0, "y_m": 0.0, "z_m": 5.0, "qx": 0.0, "qy": 0.0, "qz": HALF, "qw": HALF}
    made = [
        Row(t_ns=k * 10**9, action="stand_still" if k < 2 else action, **place) for k in range(15)
    ]
    made[2] = replace(made[2], t_go_s=10.0)
    return made


def view() -> View:
    line = np.linspace([4.0, 0.0, 5.0], [0.0, 0.0, 5.0], 41).astype(np.float32)
    return View(SQUARE, np.array([[0, 1, 2]], np.int32), (), (PathView(2 * 10**9, line, None),))


def test_the_path_is_shown_in_the_frame_of_the_fixture() -> None:
    ((first, part),) = flown_parts(rows(), view())
    assert rows()[first].t_ns == view().paths[0].t_ns
    assert part[0] == pytest.approx([0.0, -4.0, 0.0], abs=1e-6)  # x of {A} is -y of {C}
    assert part[-1] == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    assert len(part) == 11


def test_a_path_that_is_not_followed_is_left_out() -> None:
    held = [replace(row, action="hold") if 5 <= k < 8 else row for k, row in enumerate(rows())]
    (_, before), (first, after) = flown_parts(held, view())
    assert first == 8
    assert before[-1][1] == pytest.approx(-3.2, abs=1e-6)
    assert after[0][1] == pytest.approx(-1.6, abs=1e-6)
    assert flown_parts(rows("hold"), view()) == []


def test_the_next_path_replaces_the_former() -> None:
    made = rows()
    made[4] = replace(made[4], t_go_s=5.0)
    later = PathView(4 * 10**9, np.tile(np.float32([2.0, 0.0, 5.0]), (41, 1)), None)
    ((_, part),) = flown_parts(made, replace(view(), paths=(*view().paths, later)))
    assert part[1][1] == pytest.approx(-3.6, abs=1e-6)
    assert part[2:, 1] == pytest.approx(np.full(len(part) - 2, -2.0), abs=1e-6)


def test_the_picture_shows_path_begin_cone_and_body_to_scale() -> None:
    header = {
        "approach": {"final_deg": 15.0, "final_range_m": 0.5},
        "task": {"axis": [0.0, -1.0, 0.0]},
    }
    shown = approach_picture(rows(), view(), header)
    assert shown is not None
    metre = shown["bar"] / float(shown["bar_text"].split()[0])
    for panel in shown["panels"]:
        assert panel["start"][0] - panel["grasp"][0] == pytest.approx(4.0 * metre, abs=0.3)
        assert len(panel["cones"]) == 1
        assert panel["body"].count("M") <= 1  # seen from the edge it has no area
    assert any(panel["body"] for panel in shown["panels"])


def test_without_a_flown_plan_there_is_no_picture() -> None:
    assert approach_picture(rows("stand_still"), view(), {}) is None
    assert approach_picture(rows(), None, {}) is None
    assert approach_picture(rows(), replace(view(), paths=()), {}) is None


@pytest.mark.parametrize(("degrees", "mouth"), [(15.0, 0.0), (30.0, 1.0), (10.0, 1.5)])
def test_the_rim_of_a_cone_is_at_its_range_and_on_its_side(degrees: float, mouth: float) -> None:
    header = {
        "approach": {"final_deg": degrees, "final_range_m": 3.0, "mouth_m": mouth},
        "task": {"axis": [0.0, -1.0, 0.0]},
    }
    shown = approach_picture(rows(), view(), header)
    assert shown is not None
    metre = shown["bar"] / float(shown["bar_text"].split()[0])
    for panel in shown["panels"]:
        corners = np.array(re.findall(r"(-?[\d.]+)[ ,](-?[\d.]+)", panel["cones"][0]), float)
        along, across = ((corners - panel["grasp"]) / metre).T
        rim = along > 0.1
        half_pixel = 0.5 / metre
        assert rim.sum() >= 3
        assert np.hypot(along, across)[rim] == pytest.approx(3.0, abs=half_pixel)
        edge = np.abs(across).argmax()
        side = mouth + np.tan(np.radians(degrees)) * along[edge]
        assert np.abs(across[edge]) == pytest.approx(side, abs=half_pixel)
