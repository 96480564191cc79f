"""The page of one planned flight in the fixture's frame {C}: 3D view with a slider, and its figures over time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array
from avsreplay.records import Surface
from avsreplay.report.charts import flight_charts, pack
from avsreplay.report.page import build_html
from avsreplay.report.table import facts_table
from avsreplay.report.view import View, scene, thin_surface

RING = 48  # lines of a cone


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """A planned flight in {C}.

    Attributes:
        t_s: (n,) instants [s after the instant of planning].
        position_c: (n, 3) position of the gripper [m]; the grasp point is the origin.
        figures: Names of columns (see ``flight_charts``) and their values (n,).
        axis_c: (3,) outward axis of the fixture, unit.
        cones: Half-angle [deg] and length [m] of each approach cone that is required.
        mouth_m: Radius of the cones at the grasp point.
        surface: Model of the target in {C}; None where the result has none.
    """

    t_s: Array
    position_c: Array
    figures: Mapping[str, Array]
    axis_c: Array
    cones: Sequence[tuple[float, float]] = ()
    mouth_m: float = 0.0
    surface: Surface | None = None


def cone_lines(axis: Array, degrees: float, length: float, mouth: float) -> Array:
    """Return line segments (2 n, 3) of a cone about an axis: its rim, the rim of its mouth, and lines between them.

    The rim lies where the cone meets the ball of radius ``length`` about the grasp point.

    Args:
        axis: (3,) unit.
        degrees: Half-angle.
        length: Distance of the rim from the grasp point [m].
        mouth: Radius at the grasp point [m].
    """
    side = geometry.across(axis)
    turn = np.linspace(0.0, 2.0 * math.pi, RING + 1)
    ring = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side)
    slope = math.tan(math.radians(degrees))
    a, b = 1.0 + slope * slope, slope * mouth  # along^2 + (mouth + slope along)^2 = length^2
    along = (math.sqrt(max(b * b - a * (mouth * mouth - length * length), 0.0)) - b) / a
    rim, inner = along * axis + (mouth + slope * along) * ring, mouth * ring
    around = [np.stack([r[:-1], r[1:]], axis=1).reshape(-1, 3) for r in (rim, inner)]
    return np.concatenate([*around, np.stack([inner[:-1:6], rim[:-1:6]], axis=1).reshape(-1, 3)])


def build_flight_page(title: str, lines: Sequence[str], flight: Flight, facts: Iterable[tuple[str, str]]) -> str:
    """Return the page of a flight as text; the same arguments give the same bytes.

    Args:
        title: Of the page.
        lines: Under the title, the verdict first.
        flight: The flight.
        facts: Figures of the plan, as names and texts.
    """
    columns = {name: np.asarray(values, dtype=np.float64) for name, values in flight.figures.items()}
    data = {
        "runs": [
            {"name": title, "t": pack(flight.t_s, "f8"), "columns": {k: pack(v, "f4") for k, v in columns.items()}}
        ],
        "charts": flight_charts(columns),
        "spans": [],
        "marks": [],
        "states": None,
        "scene": _scene(flight),
    }
    note = (
        "3D view: frame of the fixture {C}, in which the target is at rest. Time counts from the instant of planning."
    )
    return build_html(title, [*lines, note], [facts_table("Plan", facts)], data)


def _scene(flight: Flight) -> dict[str, Any]:
    """Data for ``scene.js``: the model at rest, the path in {C}, the gripper at every instant, the cones."""
    view = None if flight.surface is None else View(*thin_surface(flight.surface))
    still = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(flight.t_s), 1))
    cones = [cone_lines(flight.axis_c, *cone, flight.mouth_m) for cone in flight.cones]
    nearest = min((length for _, length in flight.cones), default=0.5)
    return scene([], {}, view) | {
        "estimate": pack(still, "f4"),
        "truth": pack(np.full_like(still, np.nan), "f4"),
        "paths": [{"t_s": 0.0, "points": pack(flight.position_c, "f4"), "miss_m": None}],
        "flight": {
            "axis": flight.axis_c.tolist(),
            "cones": pack(np.concatenate([np.zeros((0, 3)), *cones]), "f4"),
            "near_m": nearest,
        },
    }
