"""The picture of the approach in the frame of the fixture {C}: the path that was flown, the
approach cones, the target, where the approach began, and the grasp point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array
from avsreplay.report.view import View
from avsreplay.rows import Row
from avsreplay.tables import column_of, numbers

PANEL_WIDTH_PX = 440
PANEL_HEIGHT_PX = 380
PANEL_BORDER_PX = 26
FLOWN = frozenset(
    ("approach", "approach_on_prediction", "capture")
)  # actions during which the plan is followed
_POSITION_COLUMNS = ("x_m", "y_m", "z_m")
_ATTITUDE_COLUMNS = ("qx", "qy", "qz", "qw")
_BARS_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)


def flown_parts(rows: Sequence[Row], view: View) -> list[tuple[int, Array]]:
    """Return the parts of the planned paths that were flown: index of the first row, and positions
    (n, 3) in {C} at the estimate of each scan [m].

    A path is followed until the next one begins or its end is reached. A part ends where the robot
    follows no plan.

    Args:
        rows: one per scan.
        view: its paths.
    """
    t = np.array(column_of(rows, "t_ns"), np.int64)
    r, q = (
        np.stack([numbers(rows, name) for name in names], axis=1)
        for names in (_POSITION_COLUMNS, _ATTITUDE_COLUMNS)
    )
    y, flown = (
        np.full((len(rows), 3), np.nan),
        np.array([a in FLOWN for a in column_of(rows, "action")]),
    )
    begins = [path.t_ns for path in view.paths[1:]]
    for path, next_ns in zip(view.paths, [*begins, np.iinfo(np.int64).max], strict=False):
        k = int(np.searchsorted(t, path.t_ns))
        t_go_s = rows[k].t_go_s if k < len(rows) and t[k] == path.t_ns else None
        if t_go_s is None:
            continue
        since = (t - path.t_ns) * 1e-9
        on = np.flatnonzero(flown & (since >= 0.0) & (since <= t_go_s) & (t < next_ns))
        planned = np.linspace(0.0, t_go_s, len(path.points))
        at = np.stack([np.interp(since[on], planned, x) for x in path.points.T], axis=1)
        y[on] = geometry.rotate(geometry.matrix(geometry.conjugate(q[on])), at - r[on])
    known = np.isfinite(y).all(axis=1)
    cuts = np.flatnonzero(known[1:] != known[:-1]) + 1
    parts = zip([0, *cuts.tolist()], np.split(y, cuts), strict=True)
    return [(k, part) for k, part in parts if len(part) > 1 and np.isfinite(part).all()]


def _scaled(points: Array) -> tuple[float, Callable[[Array], Array]]:
    """The scale [px/m] at which points (n, 2) fit a panel, and the function that places points of
    the same plane in the panel [px].
    """
    low, high = points.min(axis=0), points.max(axis=0)
    room = np.array([PANEL_WIDTH_PX, PANEL_HEIGHT_PX]) - 2 * PANEL_BORDER_PX
    scale = float(np.min(room / np.maximum(high - low, 1e-6)))

    def place(points: Array) -> Array:
        x, y = (points - 0.5 * (low + high)).T * scale
        return np.round(np.stack([0.5 * PANEL_WIDTH_PX + x, 0.5 * PANEL_HEIGHT_PX - y], axis=1), 1)

    return scale, place


def approach_picture(
    rows: Sequence[Row], view: View | None, header: Mapping[str, Any]
) -> dict[str, Any] | None:
    """Return the values of ``approach.svg``; None where nothing was flown.

    Args:
        rows: one per scan.
        view: model and paths.
        header: ``run.json``: the limits of the approach and the axis of the fixture.
    """
    parts = [] if view is None else flown_parts(rows, view)
    if view is None or not parts:
        return None
    axis = np.array(header.get("task", {}).get("axis", (1.0, 0.0, 0.0)))
    side, grasp = geometry.across(axis), np.array(header.get("task", {}).get("grasp_m", (0, 0, 0)))
    body, corners = np.asarray(view.vertices, np.float64) - grasp, view.faces
    lines = [part - grasp for _, part in parts]
    limits = header.get("approach", {})
    cones = [
        (limits.get(f"{name}_deg"), limits.get(f"{name}_range_m")) for name in ("cone", "final")
    ]
    outlines = [_outline(*cone, limits.get("mouth_m") or 0.0) for cone in cones if None not in cone]
    panels = []
    for name, second in (
        ("from one side", side),
        ("turned by 90° about the axis", np.cross(axis, side)),
    ):
        flat = np.stack([axis, second], axis=1)
        panels.append((name, body @ flat, [line @ flat for line in lines]))
    shown = [part for _, flat_body, flat_lines in panels for part in (flat_body, *flat_lines)]
    scale, place = _scaled(np.concatenate([*shown, *outlines, np.zeros((1, 2))]))
    bar_m = max((b for b in _BARS_M if b * scale <= 0.3 * PANEL_WIDTH_PX), default=_BARS_M[0])
    return {
        "width": PANEL_WIDTH_PX,
        "height": PANEL_HEIGHT_PX,
        "bar": round(bar_m * scale, 1),
        "bar_text": f"{bar_m:g} m",
        "cone_name": "cone or corridor in which the approach stays",
        "note": (
            "Frame of the fixture {C}, in which the target is at rest; the axis of the fixture"
            " points to the right."
            + (
                " The gaps of the path are the times at which the robot did not follow a plan."
                if len(parts) > 1
                else ""
            )
        ),
        "panels": [
            {
                "title": name,
                "body": _triangles(place(flat_body), corners),
                "cones": [_text(place(outline), "M", "L") for outline in outlines],
                "lines": [_text(place(line), "", " ") for line in flat_lines],
                "start": place(flat_lines[0][:1])[0].tolist(),
                "grasp": place(np.zeros((1, 2)))[0].tolist(),
            }
            for name, flat_body, flat_lines in panels
        ],
    }


def _outline(degrees: float, length: float, mouth: float) -> Array:
    """Outline (n, 2) of a cone seen from the side, closed: along and across its axis [m]."""
    tangent = math.tan(math.radians(degrees))
    a, b = 1.0 + tangent**2, tangent * mouth  # along^2 + (mouth + tangent along)^2 = length^2
    along = (math.sqrt(max(b * b - a * (mouth * mouth - length * length), 0.0)) - b) / a
    end = math.atan2(mouth + tangent * along, along)
    arc = np.linspace(-end, end, 13)
    rim = length * np.stack([np.cos(arc), np.sin(arc)], axis=1)
    return np.concatenate([[[0.0, -mouth]], rim, [[0.0, mouth], [0.0, -mouth]]])


def _triangles(points: Array, faces: Any) -> str:
    """The path data of triangles of one orientation, whose fillings join; of small squares
    without faces.
    """
    if not len(faces):
        return "".join(f"M{x:g} {y:g}h2v2h-2z" for x, y in points.tolist())
    corners = points[faces]
    along, across = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    turned = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    corners[turned < 0.0] = corners[turned < 0.0, ::-1]
    shown = corners[turned != 0.0].tolist()
    return "".join("M{:g} {:g}L{:g} {:g}L{:g} {:g}z".format(*a, *b, *c) for a, b, c in shown)


def _text(points: Array, first: str, between: str) -> str:
    return first + between.join(f"{x:g},{y:g}" for x, y in points.tolist())
