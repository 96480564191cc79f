"""The withdrawal: what the robot flies in a hold, a retreat and an abort, and how far from the body
it remains.

A withdrawal is either a brake, the largest acceleration against the velocity relative to the centre
of mass, or an escape: the largest acceleration in a constant direction until the robot recedes
outside the sphere that contains the target in every attitude, and then a brake. The direction is
the one with the largest margin: the best of many (``Space.directions``), improved. A plan carries
the escapes from its instants, found by ``certified``, which bounds their margins over time and
start instant. Guidance flies ``withdrawal``, which chooses among these and its own. Planning,
margins and guidance evaluate the same manoeuvres with the same bound.

Between two instants the distance changes by at most the path length in the axes of the fixture,
which follows from the speeds at both instants and a bound on the acceleration. Escapes that begin
up to ``half`` earlier or later with the same acceleration differ at the same instant s by at most
half |u - push| (s - t), as d r(s) / dt = (u(t) - push) (s - t). Intervals and ranges of start
instants are halved where the bound is below what has to be proven.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.plan.limits import (
    SampledScene,
    corridor_margin,
    in_fixture_axes,
    required_clearance,
)
from avsreplay.plan.path import MOTION_FACTOR, BurnPath, RobotPath, StepPath
from avsreplay.plan.robot import Limits

COAST_S = 30.0  # time after a cut of the thrust over which the coasting robot is checked
ENOUGH_OF_EXTENT = 0.025  # margin that counts as enough: no larger one is looked for or stated
RESOLUTION_OF_EXTENT = 5e-4  # uncertainty of a certified margin, and reserve of plans for it
TILTS_RAD = tuple(math.radians(tilt) for tilt in (20.0, 40.0, 60.0))  # around the fixture's axis
# tilts that improve a direction, one after the other
REFINED_RAD = (math.radians(10.0), math.radians(5.0), math.radians(2.0))
RANGES = 48  # ranges of start instants of a path whose thrust is not constant over intervals
COMPARED = 24  # instants at which the directions of an escape are compared
INTERVALS = 6  # intervals of a manoeuvre at the begin
HALVINGS = 16  # largest number of halvings of an interval, and of a range of start instants
COAST_HALVINGS = 6  # the same for coasting, whose margin is only stated
MOST_RANGES = 4000  # of start instants; more are bounded without being halved
KEPT_SHARE = 0.4  # of the distance to the surface that a withdrawal from the corridor keeps
STARTS = 32  # instants of a path from which withdrawals are tried in every iteration
FIELDS = ("t", "half", "r", "v", "push", "span", "other", "most")  # of ``Manoeuvres``
# towards the faces and the corners of a cube
_CUBE = np.array([d for d in np.ndindex(3, 3, 3) if abs(np.array(d) - 1).sum() in (1, 3)]) - 1.0
DIRECTIONS = _CUBE / np.linalg.norm(_CUBE, axis=1, keepdims=True)
_SIDES = np.array([(math.cos(k * math.pi / 3.0), math.sin(k * math.pi / 3.0)) for k in range(6)])


def _tilted(d: Array, angle: float) -> Array:
    """Directions (m, 7, 3): those of d (m, 3) and six around each, tilted by an angle [rad]."""
    side = np.cross(d, np.eye(3)[np.abs(d).argmin(axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    sides = np.einsum("kj,mji->mki", _SIDES, np.stack([side, np.cross(d, side)], axis=1))
    around = math.cos(angle) * d[:, None] + math.sin(angle) * sides
    return np.concatenate([d[:, None], around], axis=1)


@value_class
class Manoeuvres:
    """m manoeuvres of constant acceleration, each for a range of start instants.

    Attributes:
        t, half: (m,) middle and half width of the range [s after the instant of planning].
        r, v: (m, 3) position [m] and velocity [m/s] in {A} in the middle.
        push: (m, 3) acceleration [m/s2].
        span: (m,) duration [s].
        other: (m,) largest difference of ``push`` and the acceleration of the path [m/s2].
        most: (m,) largest distance to the surface that is required [m]: of manoeuvres that begin in
            the corridor ``KEPT_SHARE`` of the distance there.
    """

    t: Array
    half: Array
    r: Array
    v: Array
    push: Array
    span: Array
    other: Array
    most: Array

    def of(self, k: NDArray[np.integer] | NDArray[np.bool_]) -> Manoeuvres:
        """Return those with the numbers ``k``."""
        return Manoeuvres(*(getattr(self, name)[k] for name in FIELDS))

    def strayed(self, k: NDArray[np.integer], tau: Array) -> tuple[Array, Array]:
        """Return by how much position [m] and velocity [m/s] at most differ over the range, each
        (n,).

        Args:
            k: (n,) number of the manoeuvre.
            tau: (n,) time after the middle of its range [s].
        """
        half, other = self.half[k], self.other[k]
        return half * other * (np.abs(tau) + half), half * other


@value_class
class Withdrawal:
    """A manoeuvre.

    Attributes:
        path: Path from its begin on.
        margin_m: Lower bound of its smallest margin [m], at most ``Space.enough_m``.
        continued: Whether it is the rest of the withdrawal that the robot already flies.
    """

    path: BurnPath
    margin_m: float
    continued: bool = False


@value_class
class Certificate:
    """Manoeuvres from every instant of a path.

    Attributes:
        margin_m: Lower bound of their smallest margin [m], at most ``Space.enough_m``.
        worst: The manoeuvres, each for a range of start instants.
        at: (m,) time of the smallest margin after the begin of each [s].
        margins_m: (m,) these margins [m].
        safe_s: Start instant up to which every manoeuvre keeps the margin [s].
    """

    margin_m: float
    worst: Manoeuvres
    at: Array
    margins_m: Array
    safe_s: float


class Space:
    """The target after an instant as a withdrawal sees it."""

    def __init__(
        self, sampled: SampledScene, limits: Limits, a_max: float, extent_m: float
    ) -> None:
        """Create it.

        Args:
            sampled: The target.
            limits: Resolved limits: clearance, corridor and sigmas.
            a_max: Acceleration that the robot has in every direction [m/s2].
            extent_m: Diagonal of the target's bounding box [m].
        """
        self.sampled, self.a_max = sampled, a_max
        self.limits = replace(limits, clearance_m=limits.kept_m or None)
        self.enough_m = ENOUGH_OF_EXTENT * extent_m
        self.resolution_m = RESOLUTION_OF_EXTENT * extent_m
        scene = sampled.scene
        self.centre_c = np.zeros(3) if scene.centre_c is None else scene.centre_c
        self.radius_m = scene.radius_m
        # the corridor's margin changes by at most this factor times the change of the position
        self.slope = 1.0 / math.cos(math.radians(limits.final_deg or 0.0))
        times = np.linspace(0.0, COAST_S, 121)
        (_, dR), (drho, _) = sampled.at(times, 1), sampled.at(times, 1)
        step = times[1] - times[0]

        def largest(values: Array) -> float:
            return MOTION_FACTOR * float(np.sqrt((values**2).sum(axis=-1)).max(initial=0.0))

        self.turn = largest(dR.reshape(-1, 9)) / MOTION_FACTOR / math.sqrt(2.0) * 1.05
        self.bend = largest(np.diff(dR, axis=0).reshape(-1, 9)) / step
        self.pull = largest(np.diff(drho, axis=0)) / step

    @property
    def known(self) -> bool:
        """Whether the body is known at all."""
        return self.sampled.scene.surface is not None or self.radius_m > 0.0

    def required(self, y: Array, times: Array) -> Array:
        """Return the required distance to the surface (n,) [m] at points (n, 3) in {C}."""
        sigma = self.sampled.sigma(times)
        return required_clearance(self.limits, np.linalg.norm(y, axis=1), sigma)

    def margin(self, y: Array, times: Array, most: Array | float) -> tuple[Array, Array]:
        """Return margins (n,) of points (n, 3) in {C} at times (n,), and the required distances, at
        most ``most`` (n,) [m].

        A margin is that of the corridor inside it, else the distance to the surface less the
        required one. Far from the target it is a lower bound: from the sphere.
        """
        required = np.minimum(self.required(y, times), most)
        gap = self.gap(y, required)
        side, end = corridor_margin(self.sampled.scene, self.limits, y)
        return np.maximum(gap - required, np.minimum(side, end)), required

    def most(self, y: Array, times: Array) -> Array:
        """Return the largest distance to the surface (n,) [m] that is required of manoeuvres from
        points (n, 3) in {C}.
        """
        side, end = corridor_margin(self.sampled.scene, self.limits, y)
        inside = np.flatnonzero(np.minimum(side, end) > 0.0)
        out = np.full(len(y), math.inf)
        if len(inside):
            required = self.required(y[inside], times[inside])
            out[inside] = KEPT_SHARE * np.maximum(self.gap(y[inside], required), 0.0)
        return out

    def gap(self, y: Array, required: Array) -> Array:
        """Return the distances to the surface (n,) [m] of points (n, 3) in {C}, those to the sphere
        where the required ones are exceeded by enough.
        """
        gap = np.linalg.norm(y - self.centre_c, axis=1) - self.radius_m
        surface = self.sampled.scene.surface
        if surface is not None:
            near = (gap - required < self.enough_m) | (self.radius_m == 0.0)
            gap[near] = surface(y[near])[1]
        return np.asarray(gap)

    def gradient(self, y: Array, times: Array, most: Array) -> Array:
        """Return the gradients (n, 3) in {C} of the margin at points (n, 3) in {C}."""
        scene = self.sampled.scene
        size = np.maximum(np.linalg.norm(y, axis=1, keepdims=True), 1e-9)
        out = y - self.centre_c
        if scene.surface is not None:
            foot, gap = scene.surface(y)
            away = (y - foot) / np.where(np.abs(gap) > 1e-9, gap, 1e-9)[:, None]
            out = np.where(np.isfinite(gap)[:, None], away, out)
        else:
            gap = np.linalg.norm(out, axis=1) - self.radius_m
        out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
        side, end = corridor_margin(scene, self.limits, y)
        inside = np.minimum(side, end) > gap - np.minimum(self.required(y, times), most)
        if scene.axis_c is None or not inside.any():
            return out
        along = (y @ scene.axis_c)[:, None] * scene.axis_c
        lateral = (y - along) / np.maximum(np.linalg.norm(y - along, axis=1, keepdims=True), 1e-9)
        wall = math.tan(math.radians(self.limits.final_deg or 0.0)) * scene.axis_c - lateral
        corridor = np.where((side < end)[:, None], wall, -y / size)
        return np.where(inside[:, None], corridor, out)

    def relative(self, times: Array, r: Array, v: Array) -> tuple[Array, Array]:
        """Return position and velocity (n, 3) in {A} relative to the centre of mass."""
        rho, R = self.sampled.at(times)
        drho, dR = self.sampled.at(times, 1)
        return r - rho - R @ self.centre_c, v - drho - dR @ self.centre_c

    def least(self, m: Manoeuvres, target_m: float) -> tuple[Array, Array, Array]:
        """Bound the smallest margin of manoeuvres.

        Args:
            m: The manoeuvres.
            target_m: What has to be proven [m]; where more is proven nothing is refined.

        Returns:
            Lower bounds (m,) over the ranges of start instants, the smallest margins (m,) found in
            the middle, and their times (m,).
        """
        count = len(m.t)
        share = np.linspace(0.0, 1.0, INTERVALS + 1)
        nodes = -m.half[:, None] + (m.half + m.span)[:, None] * share
        k = np.repeat(np.arange(count), INTERVALS)
        ends = np.stack([nodes[:, :-1].ravel(), nodes[:, 1:].ravel()])
        found = self._nodes(m, np.repeat(np.arange(count), INTERVALS + 1), nodes.ravel())
        values = found.reshape(len(found), count, INTERVALS + 1)
        a = values[:, :, :-1].reshape(len(found), -1)
        b = values[:, :, 1:].reshape(len(found), -1)
        first = values[0].argmin(axis=1)
        upper = values[0][np.arange(count), first]
        at, lower = nodes[np.arange(count), first], np.full(count, math.inf)
        for halving in range(HALVINGS):
            bound, strayed = self._between(m, k, ends, a, b)
            refined = (bound < target_m) & (np.minimum(a[0], b[0]) - strayed >= target_m)
            refined &= upper[k] >= target_m
            if halving == HALVINGS - 1:
                refined[:] = False
            np.minimum.at(lower, k[~refined], bound[~refined])
            if not refined.any():
                break
            k, ends, a, b = k[refined], ends[:, refined], a[:, refined], b[:, refined]
            middle = ends.mean(axis=0)
            c = self._nodes(m, k, middle)
            better = np.lexsort((c[0], k))
            better = better[np.r_[True, np.diff(k[better]) > 0]]
            better = better[c[0][better] < upper[k[better]]]
            upper[k[better]], at[k[better]] = c[0][better], middle[better]
            k = np.r_[k, k]
            ends = np.stack([np.r_[ends[0], middle], np.r_[middle, ends[1]]])
            a, b = np.c_[a, c], np.c_[c, b]
        return np.minimum(lower, upper), upper, at

    def _nodes(self, m: Manoeuvres, k: NDArray[np.integer], tau: Array) -> Array:
        """Margin [m], required distance [m], speed [m/s] and bound of the acceleration [m/s2] in
        {C} (4, n).
        """
        t = tau[:, None]
        r = m.r[k] + t * m.v[k] + 0.5 * t * t * m.push[k]
        v, times = m.v[k] + t * m.push[k], m.t[k] + tau
        rho, R = self.sampled.at(times)
        drho, dR = self.sampled.at(times, 1)
        q, w = r - rho, v - drho
        margin, required = self.margin(in_fixture_axes(R, q), times, m.most[k])
        speed = np.linalg.norm(in_fixture_axes(R, w) + in_fixture_axes(dR, q), axis=1)
        away, slip = np.linalg.norm(q, axis=1), np.linalg.norm(w, axis=1)
        bend = np.linalg.norm(m.push[k], axis=1) + self.pull + 2.0 * self.turn * slip
        bend += (self.turn**2 + self.bend) * away
        return np.stack([margin, required, speed, bend])

    def _between(
        self, m: Manoeuvres, k: NDArray[np.integer], ends: Array, a: Array, b: Array
    ) -> tuple[Array, Array]:
        """Lower bounds (n,) of the margin between instants with the values a, b (4, n), and what
        the range of start instants takes from them.
        """
        h = ends[1] - ends[0]
        length = 0.5 * h * (a[2] + b[2]) + 0.25 * MOTION_FACTOR * h * h * np.maximum(a[3], b[3])
        strayed = self.slope * m.strayed(k, np.abs(ends).max(axis=0))[0]
        lower = 0.5 * (a[0] + b[0] - self.slope * length - np.abs(a[1] - b[1]))
        return lower - strayed, strayed

    def escapes(
        self, t: Array, half: Array, path: tuple[Array, Array, Array], d: Array
    ) -> Manoeuvres:
        """Return escapes in directions d (m, c, 3), m * c of them, of each start one after the
        other.

        Args:
            t: (m,) start instants, the middles of ranges [s].
            half: (m,) half widths of the ranges [s].
            path: Position, velocity and acceleration of the path there, each (m, 3).
            d: (m, c, 3) directions in {A}, unit.
        """
        r, v, u = path
        count, push = d.shape[1], self.a_max * d
        other = np.linalg.norm(u[:, None] - push, axis=2)
        span = np.full(len(t), COAST_S)
        if self.radius_m > 0.0:
            speed = np.linalg.norm(self.relative(t, r, v)[1], axis=1)
            least = 2.0 * (self.radius_m + (self.limits.clearance_m or 0.0) + self.enough_m)
            span = (speed + np.sqrt(2.0 * speed**2 + 4.0 * self.a_max * least)) / self.a_max
        most = self.most(self.sampled.coordinates(t, r), t)
        t, half, r, v, span, most = (
            np.repeat(x, count, axis=0) for x in (t, half, r, v, span, most)
        )
        return Manoeuvres(t, half, r, v, push.reshape(-1, 3), span, other.ravel(), most)

    def directions(self, t: Array, path: tuple[Array, Array, Array]) -> Array:
        """Return directions (m, c, 3) in {A} that are compared for starts without a known one:
        away from the centre of mass, to all sides, and around the fixture's axis.
        """
        q, _ = self.relative(t, path[0], path[1])
        outward = q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-9)
        fixed = np.broadcast_to(DIRECTIONS, (len(t), *DIRECTIONS.shape))
        axis_c = self.sampled.scene.axis_c
        along = outward if axis_c is None else self.sampled.at(t)[1] @ axis_c
        tilted = [_tilted(along, tilt)[:, 1:] for tilt in TILTS_RAD]
        return np.concatenate([outward[:, None], fixed, along[:, None], *tilted], axis=1)

    def ended(self, m: Manoeuvres) -> Manoeuvres:
        """Return the manoeuvres, each ended where the robot recedes outside the sphere.

        From then on the distance to the centre of mass grows, under the same acceleration and in
        the brake that follows.
        """
        if self.radius_m == 0.0:
            return m
        share = np.linspace(0.0, 1.0, COMPARED + 1)[1:]
        tau = m.span[:, None] * share
        k = np.repeat(np.arange(len(m.t)), len(share))
        free = self._free(m, k, tau.ravel()).reshape(tau.shape)
        first = free.argmax(axis=1)
        span = np.where(free.any(axis=1), tau[np.arange(len(tau)), first], m.span)
        return replace(m, span=span)

    def _free(self, m: Manoeuvres, k: NDArray[np.integer], tau: Array) -> NDArray[np.bool_]:
        """Whether the robot recedes outside the sphere (n,)."""
        t, push = tau[:, None], m.push[k]
        times = m.t[k] + tau
        q, w = self.relative(times, m.r[k] + t * m.v[k] + 0.5 * t * t * push, m.v[k] + t * push)
        dr, dv = m.strayed(k, tau)
        distance = np.linalg.norm(q, axis=1)
        required = np.minimum(self.required(q, times), m.most[k]) + self.enough_m
        a = np.linalg.norm(push, axis=1)
        out = distance - dr >= self.radius_m + required
        out &= np.sum(q * w, axis=1) >= distance * dv + np.linalg.norm(w, axis=1) * dr
        out &= (np.sum(w * push, axis=1) >= a * dv) & (np.sum(q * push, axis=1) >= a * dr)
        return np.asarray(out)

    def compared(self, m: Manoeuvres) -> tuple[Array, Array]:
        """Return about the smallest margin (m,) of each manoeuvre after its begin, at most
        ``enough_m``, and its time.
        """
        share = np.linspace(0.0, 1.0, COMPARED + 1)[1:] ** 1.7
        least, at = self.at_instants(m, m.span[:, None] * share)
        return np.minimum(least, self.enough_m), at

    def at_instants(
        self, m: Manoeuvres, tau: Array, apart: Array | None = None
    ) -> tuple[Array, Array]:
        """Return the smallest margins (m,) at times (m, n) of manoeuvres, and their times; only
        those far from the times ``apart`` (m,) where given.
        """
        k = np.repeat(np.arange(len(m.t)), tau.shape[1])
        t, times = tau.ravel()[:, None], m.t[k] + tau.ravel()
        y = self.sampled.coordinates(times, m.r[k] + t * m.v[k] + 0.5 * t * t * m.push[k])
        values = self.margin(y, times, m.most[k])[0].reshape(tau.shape)
        if apart is not None:
            values[np.abs(tau - apart[:, None]) < 2.0 * m.span[:, None] / COMPARED] = math.inf
        first = values.argmin(axis=1)
        row = np.arange(len(tau))
        return values[row, first], tau[row, first]

    def chosen(
        self, t: Array, half: Array, path: tuple[Array, Array, Array], before: Array
    ) -> Manoeuvres:
        """Return of each start the escape with the largest margin of those compared.

        Args:
            t: (m,) start instants, the middles of ranges [s].
            half: (m,) half widths of the ranges [s].
            path: Position, velocity and acceleration of the path there, each (m, 3).
            before: (m, 3) directions that are known to be good; NaN: none. They are improved; where
                the margin is negative all directions are compared.
        """
        d, values = before.copy(), np.full(len(t), -math.inf)
        self._improve(t, path, d, values, np.flatnonzero(~np.isnan(before[:, 0])))
        poor = np.flatnonzero(values < 0.0)
        if len(poor):
            some = path[0][poor], path[1][poor], path[2][poor]
            every = self.directions(t[poor], some)
            found = self._compared(t[poor], some, every)
            first, better = found.argmax(axis=1), found.max(axis=1) > values[poor]
            d[poor[better]] = every[np.arange(len(poor)), first][better]
            values[poor] = np.maximum(values[poor], found.max(axis=1))
            self._improve(t, path, d, values, poor[better & (values[poor] < self.enough_m)])
        return self.ended(self.escapes(t, half, path, d[:, None]))

    def _improve(
        self,
        t: Array,
        path: tuple[Array, Array, Array],
        d: Array,
        values: Array,
        k: NDArray[np.integer],
    ) -> None:
        """Improve the directions d (m, 3) with the numbers k where their margin is not enough, and
        set their margins in ``values`` (m,).
        """
        for tilt in REFINED_RAD:
            if len(k):
                some = path[0][k], path[1][k], path[2][k]
                every = _tilted(d[k], tilt)
                found = self._compared(t[k], some, every)
                d[k] = every[np.arange(len(k)), found.argmax(axis=1)]
                values[k] = found.max(axis=1)
                k = k[values[k] < self.enough_m]

    def _compared(self, t: Array, path: tuple[Array, Array, Array], d: Array) -> Array:
        """About the smallest margins (m, c) of escapes in directions d (m, c, 3)."""
        every = self.escapes(t, np.zeros(len(t)), path, d)
        return self.compared(every)[0].reshape(d.shape[:2])


def _replaced(m: Manoeuvres, k: NDArray[np.bool_], other: Manoeuvres) -> Manoeuvres:
    fields = {name: getattr(m, name).copy() for name in FIELDS}
    for name, field in fields.items():
        field[k] = getattr(other, name)
    return Manoeuvres(**fields)


def joined(parts: Sequence[Manoeuvres]) -> Manoeuvres:
    """Return all manoeuvres of several sets."""
    return Manoeuvres(*(np.concatenate([getattr(m, f) for m in parts]) for f in FIELDS))


def certified(
    space: Space,
    path: RobotPath,
    begin_s: float,
    tried: Tried | None = None,
    least_m: float | None = None,
) -> Certificate:
    """Bound the smallest margin of the withdrawals from every instant of a path.

    Args:
        space: The target.
        path: The path.
        begin_s: First start instant [s after the instant of planning].
        tried: Escapes that are known to be good.
        least_m: Prove that the margin is at least this, and end where it is not [m]; None: bound
            the smallest margin to within ``Space.resolution_m``.
    """
    low, high, u = _ranges(path, begin_s)
    d = np.full((len(low), 3), math.nan)
    if tried is not None:
        share = (0.5 * (low + high) - begin_s) / (path.t_go_s - begin_s)
        d = tried.d[np.abs(share[:, None] - tried.share).argmin(axis=1)]
    done = list[_Done]()
    goal = space.enough_m - space.resolution_m if least_m is None else least_m
    for halving in range(HALVINGS):
        t, half = 0.5 * (low + high), 0.5 * (high - low)
        m = _bounded(space.chosen(t, half, (*path.at(t), u), d), path)
        lower, upper, at = space.least(m, goal)
        worst = float(upper.min())
        if least_m is None and worst - space.resolution_m < goal:
            goal = worst - space.resolution_m
            lower, upper, at = space.least(m, goal)
        last = halving == HALVINGS - 1 or len(t) > MOST_RANGES or worst < goal
        kept = (lower >= goal) | last
        done.append((0.5 * (low + high)[kept], lower[kept], m.of(kept), at[kept], upper[kept]))
        if kept.all():
            break
        low, high, u, d = _halved(low, high, u, m.push / space.a_max, ~kept)
    return _certificate(space, done, worst < goal)


def coasting(space: Space, path: RobotPath, begin_s: float) -> Certificate:
    """Bound the smallest margin of the robot that coasts for ``COAST_S`` after its thrust is cut at
    any instant of a path.

    Args:
        space: The target.
        path: The path.
        begin_s: First start instant [s after the instant of planning].
    """
    low, high, u = _ranges(path, begin_s)
    done = list[_Done]()
    for halving in range(COAST_HALVINGS):
        t, half, none = 0.5 * (low + high), 0.5 * (high - low), np.zeros(len(low))
        push, speed = np.zeros((len(t), 3)), np.linalg.norm(u, axis=1)
        m = Manoeuvres(t, half, *path.at(t), push, none + COAST_S, speed, none + math.inf)
        m = space.ended(_bounded(m, path))
        lower, upper, at = space.least(m, 0.0)
        kept = (lower >= 0.0) | (upper < 0.0) | (halving == COAST_HALVINGS - 1)
        done.append((low[kept], lower[kept], m.of(kept), at[kept], upper[kept]))
        if kept.all():
            break
        low, high, u, _ = _halved(low, high, u, u, ~kept)
    return _certificate(space, done)


_Done = tuple[Array, Array, Manoeuvres, Array, Array]
"""Begins of ranges, lower bounds, manoeuvres, times and values of the smallest margins."""


def _certificate(space: Space, done: list[_Done], rejected: bool = False) -> Certificate:
    """The certificate of all ranges; of rejected ones what was found, as their bounds are loose."""
    begins, lower, at, upper = (np.concatenate([d[i] for d in done]) for i in (0, 1, 3, 4))
    return Certificate(
        min(float((upper if rejected else lower).min()), space.enough_m),
        joined([d[2] for d in done]),
        at,
        upper,
        safe_s=float(np.where(lower < 0.0, begins, math.inf).min()),
    )


def _ranges(path: RobotPath, begin_s: float) -> tuple[Array, Array, Array]:
    """Ranges of start instants of a path: begins, ends, and the thrust (m, 3), constant over a
    range; NaN where it is not.
    """
    if isinstance(path, StepPath):
        n = len(path.u)
        edges = path.latency_s + (path.t_go_s - path.latency_s) * np.arange(n + 1) / n
        on = edges[1:] > begin_s
        return np.maximum(edges[:-1][on], begin_s), edges[1:][on], path.u[on]
    edges = np.linspace(begin_s, path.t_go_s, RANGES + 1)
    return edges[:-1], edges[1:], np.full((RANGES, 3), math.nan)


def _bounded(m: Manoeuvres, path: RobotPath) -> Manoeuvres:
    """Bound the difference of the accelerations where that of the path is not constant."""
    if not np.isnan(m.other).any():
        return m
    largest = np.linalg.norm(m.push, axis=1) + path.u_max()
    return replace(m, other=np.where(np.isnan(m.other), largest, m.other))


def _halved(
    low: Array, high: Array, u: Array, d: Array, rest: NDArray[np.bool_]
) -> tuple[Array, Array, Array, Array]:
    low, high = low[rest], high[rest]
    middle = 0.5 * (low + high)
    return (
        np.stack([low, middle], axis=1).ravel(),
        np.stack([middle, high], axis=1).ravel(),
        np.repeat(u[rest], 2, axis=0),
        np.repeat(d[rest], 2, axis=0),
    )


@value_class
class Tried:
    """Instants of a flight from which withdrawals are tried, and the escapes chosen there.

    Attributes:
        share: (m,) instants as fractions of the flight.
        d: (m, 3) directions of the escapes in {A}; NaN: none yet.
        reserve_m: Margin that is required there besides, for the instants between [m].
    """

    share: Array
    d: Array
    reserve_m: float = 0.0

    @classmethod
    def first(cls) -> Tried:
        """Return ``STARTS`` instants, denser towards the end, where the robot is near."""
        share = 1.0 - (1.0 - np.arange(STARTS) / STARTS) ** 1.7
        return cls(share, np.full((STARTS, 3), math.nan))

    def table(self, begin_s: float, end_s: float) -> Array:
        """Return the start instants [s] and directions in time order (m, 4).

        Args:
            begin_s: Begin of the flight [s after the instant of planning].
            end_s: Its end [s].
        """
        t = begin_s + (end_s - begin_s) * self.share
        return np.column_stack([t, self.d])[np.argsort(t, kind="stable")]

    @classmethod
    def of(cls, table: Array | None, begin_s: float, end_s: float) -> Tried:
        """Return the instants of a table; the first ones where there is none."""
        if table is None:
            return cls.first()
        return cls((table[:, 0] - begin_s) / max(end_s - begin_s, 1e-9), table[:, 1:])

    def also(self, share: Array, d: Array, short_m: float) -> Tried:
        """Return these instants and others (n,) with their directions (n, 3), where the margin was
        short.
        """
        apart = np.abs(share[:, None] - self.share).min(axis=1) > 0.1 / STARTS
        _, new = np.unique(np.round(share[apart] * STARTS * 5.0), return_index=True)
        share, d = np.r_[self.share, share[apart][new]], np.r_[self.d, d[apart][new]]
        return Tried(share, d, self.reserve_m + short_m)


def sampled(
    space: Space,
    path: RobotPath,
    tried: Tried,
    begin_s: float,
    since_s: float = 0.0,
    improve: bool = True,
) -> tuple[Certificate, Tried]:
    """Return the withdrawals from instants of a path, with their smallest margins at instants only.

    Each escape is listed with its worst moment and with the worst one far from it.

    Args:
        space: The target.
        path: The path; it begins ``since_s`` before the instant of planning.
        tried: Start instants, with the directions from which the search begins.
        begin_s: Begin of the thrust [s after the instant of planning].
        since_s: Time between the begin of the path and the instant of planning [s].
        improve: Search better directions where the margin is negative; else only at new instants.
    """
    t = begin_s + (path.t_go_s - since_s - begin_s) * tried.share
    r, v = path.at(since_s + t)
    every = r, v, np.zeros_like(r)
    d = tried.d.copy()
    new = np.isnan(d[:, 0])
    m = space.ended(
        space.escapes(t, np.zeros(len(t)), every, np.where(new[:, None], r, d)[:, None])
    )
    if improve:
        new |= space.compared(m)[0] < 0.0
    if new.any():
        some = r[new], v[new], every[2][new]
        m = _replaced(m, new, space.chosen(t[new], np.zeros(int(new.sum())), some, d[new]))
    at = space.compared(m)[1]
    near = m.span[:, None] * np.linspace(-1.0, 1.0, 9) / COMPARED
    tau = np.c_[np.zeros(len(t)), np.clip(at[:, None] + near, 0.0, m.span[:, None])]
    margins, at = space.at_instants(m, tau)
    coarse = m.span[:, None] * np.linspace(0.0, 1.0, COMPARED + 1)
    others, other_at = space.at_instants(m, coarse, apart=at)
    found = Certificate(
        float(margins.min()), joined([m, m]), np.r_[at, other_at], np.r_[margins, others], math.inf
    )
    return found, replace(tried, d=m.push / space.a_max)


def withdrawal(
    space: Space,
    r: Array,
    v: Array,
    least_m: float,
    current: BurnPath | None = None,
    planned: Array | None = None,
) -> Withdrawal:
    """Return what the robot flies to withdraw, and its smallest margin.

    Args:
        space: The target after the begin of the withdrawal.
        r: (3,) position of the robot in {A} [m].
        v: (3,) its velocity [m/s].
        least_m: Smallest distance at its end to the sphere that contains the target [m].
        current: The rest of the withdrawal that the robot already flies; it is continued where no
            other one keeps a larger margin.
        planned: (3,) direction of the escape that the plan in force has for this instant; None: no
            plan.
    """
    zero = np.zeros(1)
    (q,), (w,) = space.relative(zero, r[None], v[None])
    paths = [] if current is None else [current]
    brake = _braked(space, r, v, w, np.zeros((0, 3)), np.zeros(0))
    rest = q + 0.5 * brake.t_go_s * w
    if np.linalg.norm(rest) >= space.radius_m + least_m:
        paths.append(brake)
    path, unknown = (r[None], v[None], np.zeros((1, 3))), np.full((1, 3), math.nan)
    every = [space.chosen(zero, zero, path, unknown)]
    if planned is not None:
        every.append(space.ended(space.escapes(zero, zero, path, planned[None, None])))
    escapes = joined(every)
    for push, span in zip(escapes.push, escapes.span, strict=True):
        burn = _burn_s(space, q, w, push, span if space.radius_m > 0.0 else 0.0, least_m)
        after = r + burn * v + 0.5 * burn**2 * push, v + burn * push
        paths.append(
            _braked(space, *after, w + burn * push, push[None], np.array([burn]), start=(r, v))
        )
    found = _largest(space, paths)
    return replace(found, continued=found.path is current)


def _braked(
    space: Space,
    r: Array,
    v: Array,
    w: Array,
    u: Array,
    ends: Array,
    start: tuple[Array, Array] | None = None,
) -> BurnPath:
    """Return the path that ends with the largest acceleration against the relative velocity w."""
    speed = float(np.linalg.norm(w))
    if speed > 1e-9:
        u = np.concatenate([u, -space.a_max * w[None] / speed])
        ends = np.r_[ends, (ends[-1] if len(ends) else 0.0) + speed / space.a_max]
    return BurnPath(*(start or (r, v)), u, ends)


def _burn_s(space: Space, q: Array, w: Array, push: Array, free_s: float, least_m: float) -> float:
    """Return the duration of an escape whose brake ends far enough away [s]."""
    step = max(0.25 * free_s, math.sqrt(least_m / space.a_max) / 4.0)
    for count in range(64):
        t = free_s + count * step
        at, speed = q + t * w + 0.5 * t * t * push, w + t * push
        rest = at + speed * np.linalg.norm(speed) / (2.0 * space.a_max)
        if at @ speed >= 0.0 and np.linalg.norm(rest) >= space.radius_m + least_m:
            return t
    return free_s


def _largest(space: Space, paths: list[BurnPath]) -> Withdrawal:
    """Return the path with the largest margin, the first of equal ones."""
    every = [_pieces(space, path) for path in paths]
    owner = np.repeat(np.arange(len(every)), [len(m.t) for m in every])
    m = joined(every)
    rough = np.full(len(paths), space.enough_m)
    np.minimum.at(rough, owner, space.compared(m)[0])
    goal = float(rough.max()) - space.resolution_m
    lower = np.full(len(paths), goal)
    np.minimum.at(lower, owner, space.least(m, goal)[0])
    first = int(lower.argmax())
    return Withdrawal(paths[first], float(lower[first]))


def _pieces(space: Space, path: BurnPath) -> Manoeuvres:
    """The path as manoeuvres of constant acceleration; at its end the robot is at rest."""
    begins = np.r_[0.0, path.ends[:-1]] if len(path.ends) else np.zeros(1)
    ends = path.ends if len(path.ends) else np.full(1, 1e-3)
    u = path.u if len(path.u) else np.zeros((1, 3))
    r, v = path.at(begins)
    none, zero = np.zeros(len(begins)), np.zeros(1)
    most = none + space.most(space.sampled.coordinates(zero, r[:1]), zero)
    return Manoeuvres(begins, none, r, v, u, np.maximum(ends - begins, 0.0), none, most)
