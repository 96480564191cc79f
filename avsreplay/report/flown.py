"""What the flown approach used of the robot and of its margins, from the rows and the saved plans.

The planned paths are stored as positions at even intervals, so that an acceleration is the mean
over three of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from avsreplay.assessment import Assessment
from avsreplay.geometry import Array
from avsreplay.report.approach import FLOWN
from avsreplay.report.moments import plain
from avsreplay.report.summary_parts import length_text
from avsreplay.report.view import PathView, View
from avsreplay.rows import Row

WITHDRAWN = ("hold", "retreat", "abort")  # actions that end an attempt
LEAST_STEP_S = 0.25  # between positions: below it their rounding shows in the acceleration
LISTED_WITHDRAWALS = 3  # withdrawals that are listed


def flight_facts(
    rows: Sequence[Row],
    view: View | None,
    header: Mapping[str, Any],
    assessment: Assessment | None,
) -> list[tuple[str, str]]:
    """Return facts about the flight as names and texts: contact, margins, largest acceleration,
    distance from the base, withdrawals.

    Args:
        rows: one per scan.
        view: the planned paths; None where they are not known.
        header: the content of ``run.json``.
        assessment: the assessment of the capture; None where there is none.
    """
    found = [*_contact(assessment), *_margins(rows)]
    flown = _flown_paths(rows, view)
    if flown:
        found += [*_acceleration(flown, header), *_distance(flown, header)]
    return [*found, *_withdrawals(rows)]


def _contact(assessment: Assessment | None) -> Iterator[tuple[str, str]]:
    if assessment is None:
        return
    if assessment.at_s is not None:
        yield "instant of contact", f"{assessment.at_s:.2f} s"
    miss, most = assessment.miss, assessment.tolerance
    if miss is not None:
        used = {
            "position": miss.distance_m / most.distance_m,
            "speed": miss.speed_mps / most.speed_mps,
            "angle": miss.angle_deg / most.angle_deg,
        }
        known = {name: share for name, share in used.items() if np.isfinite(share)}
        name = max(known, key=lambda key: known[key], default="")
        if name:
            left = f"{100.0 * (1.0 - known[name]):.0f} % of the tolerance on the {name} is left"
            yield "margin to the tolerance", f"{left}, the least of the three"


def _margins(rows: Sequence[Row]) -> Iterator[tuple[str, str]]:
    """The smallest margins of the plans that were followed."""
    followed = [row for row in rows if row.action in FLOWN and (row.t_go_s or 0.0) > 0.0]
    limits = [row for row in followed if row.plan_margin_m is not None]
    if limits:
        least = min(limits, key=lambda row: row.plan_margin_m or 0.0)
        name = f" to the {plain(least.plan_limit)}" if least.plan_limit else ""
        yield "smallest margin", f"{length_text(least.plan_margin_m or 0.0)}{name}"
    aborts = [row.abort_margin_m for row in followed if row.abort_margin_m is not None]
    if aborts:
        least_m = min(aborts)
        how = "more" if least_m >= 0.0 else "less"
        text = f"{length_text(abs(least_m))} {how} than the required clearance, at worst"
        yield "if it had aborted", text


def _flown_paths(rows: Sequence[Row], view: View | None) -> list[tuple[PathView, float]]:
    """The paths that were followed, with their durations [s]."""
    planned = {row.t_ns: row for row in rows if row.action in FLOWN and (row.t_go_s or 0.0) > 0.0}
    return [
        (path, planned[path.t_ns].t_go_s or 0.0)
        for path in (view.paths if view else ())
        if path.t_ns in planned and len(path.points) > 2
    ]


def _acceleration(
    flown: Sequence[tuple[PathView, float]], header: Mapping[str, Any]
) -> Iterator[tuple[str, str]]:
    largest = 0.0
    for path, t_go_s in flown:
        stride = math.ceil(LEAST_STEP_S * (len(path.points) - 1) / t_go_s)
        points = np.asarray(path.points[::stride], np.float64)
        if len(points) < 3:
            continue
        step_s = stride * t_go_s / (len(path.points) - 1)
        bend = np.linalg.norm(np.diff(points, n=2, axis=0), axis=1)
        largest = max(largest, float(bend.max()) / step_s**2)
    config = header.get("config") or {}
    most = (config.get("plan") or {}).get("a_max_mps2")
    mass = (config.get("robot") or {}).get("mass_kg")
    of = f" of {most:.3g}" if isinstance(most, (int, float)) else ""
    force = f", {mass * largest:.3g} N" if isinstance(mass, (int, float)) else ""
    yield "thrust", f"largest acceleration {largest:.3g}{of} m/s2{force}"


def _distance(
    flown: Sequence[tuple[PathView, float]], header: Mapping[str, Any]
) -> Iterator[tuple[str, str]]:
    """Distance of the gripper from the base during the flight and at its end."""
    limits = header.get("approach") or {}
    base: Array = np.asarray(limits.get("base_m") or (0.0, 0.0, 0.0), np.float64)
    last = flown[-1][0].points
    at_end = float(np.linalg.norm(last[-1] - base))
    farthest = max(float(np.linalg.norm(path.points - base, axis=1).max()) for path, _ in flown)
    most = limits.get("reach_max_m")
    of = f" of {most:.3g} m" if isinstance(most, (int, float)) else ", no limit"
    text = f"{at_end:.3g} m from the base at the contact, at most {farthest:.3g} m{of}"
    yield "reach", text


def _withdrawals(rows: Sequence[Row]) -> Iterator[tuple[str, str]]:
    """When and by which rule the approach was withdrawn."""
    moved, found = False, list[str]()
    for action, group in groupby(rows, key=lambda row: row.action):
        first = next(group)
        if moved and action in WITHDRAWN:
            rule = plain(getattr(first, "supervisor_rule", None) or "no rule")
            found.append(f"{plain(action)} at {first.t_s:.1f} s ({rule})")
        moved = moved or action in FLOWN
    if found:
        more = len(found) - LISTED_WITHDRAWALS
        last = f"; {more} more" if more > 0 else ""
        yield "withdrawals", "; ".join(found[:LISTED_WITHDRAWALS]) + last
