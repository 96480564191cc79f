"""Linearisation of the constraints about a reference path, and the check of the true constraints."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array
from avsreplay.plan.cone_programme import Index, PointRows, Subproblem
from avsreplay.plan.initial_paths import ReferencePath, interval_fractions
from avsreplay.plan.limits import CONSTRAINTS, THRUST_SHARE, Case, Margins, in_fixture_axes, margins
from avsreplay.plan.path import RobotPath, StepPath

BETWEEN = 16  # instants of every interval at which the true constraints are checked
RESERVE = 3.0  # margin at the checked instants in units of the buffer, for the instants between them
FAR = 2e4  # a constraint with a larger margin at the reference, in units of the buffer, is left out of the programme
COARSE_NODES = 16  # thrust intervals while initial paths are compared
ABORT_S = 30.0  # duration of an abort
ABORTS = 16  # instants at which an abort is tried
_WITH_RADIUS = np.concatenate([np.zeros((1, 3)), np.eye(3)])  # rows of a ball: its radius, then the coordinates
TOWARD_AXIS = 2.0  # weight of the fixture's axis in the direction away from the grasp point
LEAD_BACK = 0.3  # a constraint violated at the start is restored within this fraction of the flight


def dense_margins(case: Case, path: RobotPath) -> tuple[Array, Margins]:
    """Return the instants of the check and the margins there."""
    times = np.linspace(case.wait_s, path.t_go_s, BETWEEN * case.limits.nodes + 1)
    return times, margins_at(case, path, times)


def margins_at(case: Case, path: RobotPath, times: Array) -> Margins:
    """Return the margins at instants (n,) of a path [s]; its end is the grasp point itself."""
    r = path.at(times)[0]
    y = case.sampled.coordinates(times, r)
    y[times >= path.t_go_s] = 0.0
    return margins(case.scene, case.limits, y, r, case.sampled.sigma(times))


def excess(case: Case, path: StepPath) -> Array:
    """Return the largest violation near the middle and the end of every interval (2 n, 4) [m]."""
    n = len(path.u)
    if not case.limits.geometric:
        return np.zeros((2 * n, len(CONSTRAINTS)))
    times, found = dense_margins(case, path)
    fraction = (times[1:] - times[0]) / (times[-1] - times[0])
    over = np.maximum(RESERVE * case.buffer_m - found.between - allowed(case.start, fraction), 0.0)
    half = over.reshape(2 * n, BETWEEN // 2, -1).max(axis=1)
    after = np.concatenate([half[1:], half[-1:]])
    return np.asarray(np.maximum(half, after))


def worst_margin(case: Case, path: RobotPath) -> tuple[float, str]:
    """Return the smallest margin along a path and the constraint that has it, "" without geometric constraints."""
    if not case.limits.geometric:
        return math.inf, ""
    values = dense_margins(case, path)[1].between
    least = values.min(axis=0)
    return float(least.min()), CONSTRAINTS[int(least.argmin())] if np.isfinite(least).any() else ""


def feasible(case: Case, path: StepPath, over: float, allowed: float) -> bool:
    """Return whether a path ends at the grasp point in time and its excess ``over`` is allowed [m]."""
    position, velocity = path.terminal_errors(case.scene.goal)
    short = path.t_go_s <= case.params.horizon_s
    exact = position <= 1e-8 and velocity <= 1e-8 and path.u_max() <= case.a_max and case.within_axes(path.u)
    return bool(short and exact and over <= allowed)


@dataclass(frozen=True, slots=True, eq=False)
class Abort:
    """Aborts from instants of a path outside the corridor: the largest acceleration away from the centre of mass.

    Attributes:
        margin: Smallest margin of the clearance during these aborts [m]; NaN without a clearance.
        short: By how much it is negative, less what the start itself lacks; 0 where aborts are not required [m].
        rows: Rows that require the margin; empty where they are not needed.
    """

    margin: float = math.nan
    short: float = 0.0
    rows: tuple[PointRows, ...] = ()


def aborted(case: Case, path: RobotPath, since_s: float = 0.0) -> Abort:
    """Return the aborts from instants of a path later than ``since_s`` after its begin, each with its worst moment."""
    limits, scene = case.limits, case.scene
    if limits.clearance_m is None or scene.surface is None:
        return Abort()
    begin = np.linspace(case.wait_s, path.t_go_s - since_s, ABORTS, endpoint=False)
    r, v = path.at(since_s + begin)
    rho, R = case.sampled.at(begin)
    outside = np.linalg.norm(r - rho, axis=1) > (limits.final_range_m or 0.0)
    if not outside.any():
        return Abort()
    begin, r, v = begin[outside], r[outside], v[outside]
    away = r - rho[outside] - R[outside] @ (np.zeros(3) if scene.centre_c is None else scene.centre_c)
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    after = np.linspace(0.0, ABORT_S, 3 * ABORTS)[None, :, None]
    positions = r[:, None] + v[:, None] * after + 0.5 * case.params.a_max_mps2 * away[:, None] * after**2
    times = (begin[:, None] + after[0, :, 0]).ravel()
    rho, R = case.sampled.at(times)
    y = in_fixture_axes(R, positions.reshape(-1, 3) - rho)
    foot, gap = scene.surface(y)
    k = gap.reshape(len(begin), -1).argmin(axis=1) + np.arange(len(begin)) * after.size
    margins_m = gap[k] - limits.clearance_m
    short = max(-float(margins_m.min()) - max(-float(margins_m[0]), 0.0), 0.0) if limits.abort else 0.0
    if not limits.abort:
        return Abort(float(margins_m.min()), short)
    normal = (y[k] - foot[k]) / np.where(np.abs(gap[k]) > 1e-9, gap[k], 1e-9)[:, None]
    in_a = (R[k] @ normal[:, :, None])[:, :, 0]
    lead = times[k] - begin
    part = (begin - case.wait_s) * limits.nodes / (path.t_go_s - since_s - case.wait_s)
    interval = np.minimum(part.astype(np.int64), limits.nodes - 1)
    offset = margins_m - RESERVE * case.buffer_m - np.sum(in_a * (r + lead[:, None] * v), axis=1)
    rate = -lead * np.sum(in_a * v, axis=1)  # the velocity for given h v changes with h
    on = margins_m < FAR * case.buffer_m
    ones = np.ones(int(on.sum()))
    rows = PointRows(interval[on], (part - interval)[on], in_a[on], offset[on], rate[on], ones, lead[on])
    return Abort(float(margins_m.min()), short, (rows,))


def allowed(start: Array, fraction: Array) -> Array:
    """Return the violation that is accepted while the robot returns from a violation at the start."""
    shrinking = np.maximum(1.0 - fraction / LEAD_BACK, 0.0)
    return np.asarray(np.maximum(-start, 0.0)[None, :] * shrinking[:, None])


def convex_subproblem(
    case: Case, reference: ReferencePath, off: Array, change: float, aborts: tuple[PointRows, ...] = ()
) -> Subproblem:
    """Return the convex subproblem at a reference, with the rows of aborts from paths near it."""
    n, t = case.limits.nodes, reference.t
    rho, rate = case.scene.goal(np.array([case.wait_s + t, case.wait_s + t - 1e-4]))
    problem = Subproblem(
        n=n,
        h=t / n,
        r0=case.r0 + case.wait_s * case.v0,
        v0=case.v0,
        rho=rho[0],
        rate=rate[0],
        acceleration=(rate[0] - rate[1]) / 1e-4,
        a_max=case.a_max * THRUST_SHARE,
        change=change,
        speed=case.limits.speed_max_mps,
        contact=case.limits.contact_accel_mps2,
        axes=case.axes,
        earliest=(case.earliest_s - case.wait_s) / n,
        planes=aborts,
    )
    if not case.limits.geometric:
        return problem
    rows = _RowMaker(case, reference)
    return rows.added(problem, off + rows.sag[:, None] - allowed(case.start, interval_fractions(n)))


class _RowMaker:
    """Rows of the geometric constraints at the middle and the end of every interval."""

    def __init__(self, case: Case, reference: ReferencePath) -> None:
        n = case.limits.nodes
        s = interval_fractions(n)
        times = case.wait_s + reference.t * s
        self.limits, self.scene = case.limits, case.scene
        self.far_m = FAR * case.buffer_m
        self.rho, self.R = case.sampled.at(times)
        drho, dR = case.sampled.at(times, 1)
        self.y = in_fixture_axes(self.R, reference.r - self.rho)
        dy = in_fixture_axes(dR, reference.r - self.rho) - in_fixture_axes(self.R, drho)
        self.dy = dy * (reference.t * s)[:, None]  # change with the relative change of the end time
        bend = np.linalg.norm(np.diff(np.concatenate([case.begin_c[None], self.y]), 2, axis=0), axis=1) / 8.0
        self.sag = np.concatenate([bend, bend[-1:]])  # distance of the path in {C} from its chord between two points
        self.interval = np.arange(2 * n) // 2
        self.fraction = np.where(np.arange(2 * n) % 2 == 0, 0.5, 1.0)
        self.r = reference.r
        self.found = margins(case.scene, case.limits, self.y, reference.r, case.sampled.sigma(times))
        self.inside = self.found.inside
        if case.entry is not None:
            self.inside[:, 0] = s >= case.entry[0] - 1e-9
            self.inside[:, 1] = self.inside[:, 3] = s >= case.entry[1] - 1e-9
        self.near = np.ones(2 * n, dtype=bool)
        self.near[-1] = False  # the grasp point itself is the end condition

    def rows(self, k: Index, vectors: Array, constant: Array | float) -> PointRows:
        """Return g rows vector.y for each point k, the first with constant and slack; vectors (m or 1, g, 3) in {C}."""
        vectors = np.broadcast_to(vectors, (len(k), *vectors.shape[1:]))
        in_a = vectors @ self.R[k].transpose(0, 2, 1)
        offset = -(in_a @ self.rho[k][:, :, None])[:, :, 0]
        rate = (vectors @ self.dy[k][:, :, None])[:, :, 0]
        return self.grouped(k, in_a, offset, rate, constant)

    def grouped(self, k: Index, in_a: Array, offset: Array, rate: Array, constant: Array | float) -> PointRows:
        """Return rows (m, g) ordered point by point; the first of each point has the constant and the slack."""
        g = in_a.shape[1]
        offset[:, 0] += constant
        slack = np.tile(np.eye(1, g)[0], len(k))
        interval, fraction = np.repeat(self.interval[k], g), np.repeat(self.fraction[k], g)
        return PointRows(interval, fraction, in_a.reshape(-1, 3), offset.ravel(), rate.ravel(), slack)

    def added(self, problem: Subproblem, off: Array) -> Subproblem:
        """Return the subproblem with the rows of all constraints."""
        planes = list(problem.planes)
        cones: list[tuple[int, PointRows]] = []
        limits, y, inside = self.limits, self.y, self.inside
        chosen = np.where(inside, self.found.first, self.found.second)
        on = (chosen < self.far_m) & self.near[:, None]
        for i, degrees, length in (
            (0, limits.cone_deg, limits.cone_range_m),
            (1, limits.final_deg, limits.final_range_m),
        ):
            if degrees is not None:
                k = np.flatnonzero(on[:, i] & inside[:, i])
                cones.append(self.cone(k, degrees, off[k, i]))
                k = np.flatnonzero(on[:, i] & ~inside[:, i])
                planes.append(self.rows(k, self.outward(k, length or 0.0)[:, None], -(length or 0.0) - off[k, i]))
        if limits.keepout_m is not None and self.scene.centre_c is not None:
            k = np.flatnonzero(on[:, 2] & inside[:, 2])
            cones.append(self.ball(k, (limits.keepout_release_m or 0.0) - off[k, 2]))
            k = np.flatnonzero(on[:, 2] & ~inside[:, 2])
            out = y[k] - self.scene.centre_c
            normal = out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
            planes.append(self.rows(k, normal[:, None], -normal @ self.scene.centre_c - limits.keepout_m - off[k, 2]))
        if limits.clearance_m is not None:
            self._body(planes, cones, on[:, 3], off[:, 3])
        self._workspace(planes, cones, np.flatnonzero(self.near), off[:, 4])
        return replace(
            problem,
            planes=tuple(p for p in planes if len(p.interval)),
            cones=tuple(c for c in cones if len(c[1].interval)),
        )

    def outward(self, k: Index, length: float) -> Array:
        """Return unit vectors (m, 3) in {C} along which the points k have to be at least ``length`` away.

        They point to the reference, and towards the entry of the cone where the reference is too near.
        """
        distance = np.maximum(np.linalg.norm(self.y[k], axis=1, keepdims=True), 1e-9)
        missing = np.sqrt(np.maximum(1.0 - distance / max(length, 1e-9), 0.0))
        out = self.y[k] / distance + TOWARD_AXIS * missing * np.asarray(self.scene.axis_c)
        return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9))

    def _body(
        self, planes: list[PointRows], cones: list[tuple[int, PointRows]], on: NDArray[np.bool_], off: Array
    ) -> None:
        """Add the clearance to the surface, or the corridor with its range where the reference is inside it."""
        found, limits = self.found, self.limits
        k = np.flatnonzero(on & self.inside[:, 3])
        cones.append(self.cone(k, limits.final_deg or 0.0, off[k]))
        cones.append(self.ball(k, (limits.final_range_m or 0.0) - off[k]))
        k = np.flatnonzero(on & ~self.inside[:, 3])
        foot = found.foot[k]
        gap = found.distance[k]
        normal = (self.y[k] - foot) / np.where(np.abs(gap) > 1e-9, gap, 1e-9)[:, None]
        planes.append(self.rows(k, normal[:, None], -np.sum(normal * foot, axis=1) - found.clearance[k] - off[k]))

    def _workspace(self, planes: list[PointRows], cones: list[tuple[int, PointRows]], k: Index, off: Array) -> None:
        """Add the shell around the robot's base, which is fixed in {A}."""
        limits, base, m = self.limits, np.array(self.limits.base_m), len(k)

        def rows(vectors: Array, constant: Array) -> PointRows:
            return self.grouped(k, vectors, -(vectors @ base), np.zeros(vectors.shape[:2]), constant)

        if limits.reach_max_m is not None:
            cones.append((4, rows(np.tile(_WITH_RADIUS, (m, 1, 1)), limits.reach_max_m - off[k])))
        if limits.reach_min_m is not None:
            out = self.r[k] - base
            normal = out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
            planes.append(rows(normal[:, None], -limits.reach_min_m - off[k]))

    def cone(self, k: Index, degrees: float, off: Array) -> tuple[int, PointRows]:
        """Return |across| <= tan(degrees) along + mouth - off at the points k."""
        vectors = _cone_rows(tuple(np.asarray(self.scene.axis_c).tolist()), degrees)
        return 3, self.rows(k, vectors, (self.limits.mouth_m or 0.0) - off)

    def ball(self, k: Index, radius: Array) -> tuple[int, PointRows]:
        """Return |y| <= radius at the points k."""
        return 4, self.rows(k, _WITH_RADIUS[None], radius)


@lru_cache(maxsize=16)
def _cone_rows(axis: tuple[float, float, float], degrees: float) -> Array:
    """Return the rows (1, 3, 3) of a cone about an axis in {C}: its radius, and the coordinates across the axis."""
    e = np.array(axis)
    side = geometry.across(e)
    return np.stack([math.tan(math.radians(degrees)) * e, side, np.cross(e, side)])[None]
