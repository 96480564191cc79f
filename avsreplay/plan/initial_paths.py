"""Reference paths from which a constrained plan is iterated: initial paths, and an earlier plan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array
from avsreplay.outcome import Plan
from avsreplay.plan.limits import Case
from avsreplay.plan.path import RobotPath, path_of

COARSE_NODES = 16  # least number of thrust intervals while initial paths are compared
COARSE_TURN_RAD = 0.25  # largest turn of the target in one of them
TURN_RAD = 0.5  # the target may turn by this much between two iterations


@dataclass(frozen=True, slots=True, eq=False)
class ReferencePath:
    """A path to linearise about: thrust time t [s] and positions (2 n, 3) at the middle and end of every interval."""

    t: float
    r: Array


def interval_fractions(n: int) -> Array:
    """Middle and end of every interval, as fractions of the flight (2 n,)."""
    return np.arange(1, 2 * n + 1) / (2.0 * n)


def turn_rate(case: Case, t: float) -> float:
    """Return the angular rate of the target [rad/s]."""
    rate = case.sampled.at(np.array([t]), 1)[1]
    return float(np.linalg.norm(rate)) / math.sqrt(2.0)


def coarse_nodes(case: Case, least_s: float) -> int:
    """Return the number of intervals while initial paths are compared, for flights of at least a time [s]."""
    t = max(least_s, case.earliest_s)
    return min(max(COARSE_NODES, math.ceil(turn_rate(case, t) * t / COARSE_TURN_RAD)), case.limits.nodes)


def initial_references(case: Case, free: Plan) -> list[ReferencePath]:
    """Initial paths: the free plan, then flights to a point on the fixture's axis and along the axis, ever later."""
    s, wait, least = interval_fractions(case.limits.nodes), case.wait_s, free.t_go_s - case.wait_s
    out = [ReferencePath(least, path_of(free, case.r0, case.v0).at(wait + least * s)[0])]
    if not case.limits.geometric:
        return out
    turn = turn_rate(case, wait + least)
    t, end = 1.1 * least, case.params.horizon_s - wait
    step = min(max(0.15 * least, 0.9 / max(turn, 1e-6)), 0.5 * least)
    while t <= end and len(out) < 9:
        out.append(ReferencePath(t, _via_axis(case, t, s)))
        t += step
    return out


def _via_axis(case: Case, t: float, s: Array) -> Array:
    """Positions (2 n, 3) of a flight around the target to the fixture's axis, then along it to the goal."""
    scene, limits = case.scene, case.limits
    axis = np.array([1.0, 0.0, 0.0]) if scene.axis_c is None else scene.axis_c
    ranges = [limits.cone_range_m if limits.cone_deg else 0.0, limits.final_range_m if limits.final_deg else 0.0]
    length = 1.05 * max(*(r or 0.0 for r in ranges), limits.mouth_m or 0.0)
    last_s = min(1.4 * math.sqrt(2.0 * length / case.params.a_max_mps2), 0.6 * t)
    times = case.wait_s + t * s
    rho, R = case.sampled.at(times)
    entry = np.array([case.wait_s + t - last_s])
    rho_e, R_e = case.sampled.at(entry)
    x = np.clip(s * t / max(t - last_s, 1e-9), 0.0, 1.0)[:, None]
    start = case.r0 + case.wait_s * case.v0
    blend = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
    r = start + blend * (rho_e[0] + length * (R_e[0] @ axis) - start)
    left = np.clip((1.0 - s) * t / last_s, 0.0, 1.0)[:, None]
    along = rho + length * left**2 * (R @ axis)
    r = np.where(s[:, None] * t >= t - last_s, along, r)
    return _around(case, r, rho, R, s * t < t - last_s)


def _around(case: Case, r: Array, rho: Array, R: Array, free: NDArray[np.bool_]) -> Array:
    """Move the points (n, 3) that lie inside the sphere around the target outward onto it, where ``free``."""
    limits, scene = case.limits, case.scene
    centre_c = np.zeros(3) if scene.centre_c is None else scene.centre_c
    radius = limits.keepout_m or 0.0
    if limits.clearance_m is not None or limits.cone_deg is not None:
        radius = max(radius, float(np.linalg.norm(centre_c)) + (limits.clearance_m or 0.0))
    centre = rho + R @ centre_c
    away = r - centre
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    inside = free[:, None] & (distance < radius)
    return np.where(inside, centre + away / np.maximum(distance, 1e-9) * radius, r)


def warm_reference(case: Case, path: RobotPath, since_s: float) -> ReferencePath:
    """Return the rest of an earlier path from ``since_s`` after its begin on as a reference.

    Its end is moved to the grasp point, as the estimate has changed since, and its begin to the robot.
    """
    t, s = max(path.t_go_s - since_s - case.wait_s, 1e-3), interval_fractions(case.limits.nodes)
    r = path.at(since_s + case.wait_s + t * np.concatenate([[0.0], s]))[0]
    first = case.r0 + case.wait_s * case.v0 - r[0]
    last = case.sampled.at(np.array([case.wait_s + t]))[0][0] - r[-1]
    return ReferencePath(t, r[1:] + first + (s * s)[:, None] * (last - first))


def largest_change(case: Case, reference: ReferencePath, most: float) -> float:
    """Return the largest relative change of the end time, at most ``most``: the target may turn by TURN_RAD."""
    turn = turn_rate(case, case.wait_s + reference.t) * reference.t
    return float(min(most, TURN_RAD / max(turn, 1e-9)))
