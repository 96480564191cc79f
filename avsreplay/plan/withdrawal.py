"""The withdrawal: what the robot flies in a hold, a retreat and an abort, and how far from the body
it remains.

A withdrawal is either a brake, the largest acceleration against the velocity relative to the centre
of mass, or an escape: the largest acceleration in a constant direction until the robot recedes
outside the sphere that contains the target in every attitude, and then a brake. The direction is
the one with the largest margin: the best of many (``Space.directions``), improved. A plan carries
escapes for ranges of its instants, found by ``certified``, which bounds their margins over time and
start instant; ``escapes_at`` gives the one for an instant. The stated margin is that of the escapes
that the plan carries. Guidance flies ``withdrawal``, which chooses among these and its own.

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
from avsreplay.plan import _cone
from avsreplay.plan.limits import (
    SampledScene,
)
from avsreplay.plan.path import MOTION_FACTOR, BurnPath, RobotPath, StepPath
from avsreplay.plan.robot import Limits

COAST_S = 30.0  # time after a cut of the thrust over which the coasting robot is checked
ENOUGH_OF_EXTENT = 0.025  # margin that counts as enough: no larger one is looked for or stated
RESOLUTION_OF_EXTENT = 5e-4  # uncertainty of a certified margin, and reserve of plans for it
RANGES = 48  # ranges of start instants of a path whose thrust is not constant over intervals
DENSITY_POWER = 1.3  # power of the share of a manoeuvre: instants are denser at the begin
EVALUATED_INSTANTS = 32  # instants at which margins of an escape are evaluated for the planner
HALVINGS = 16  # largest number of halvings of a range of start instants
COAST_HALVINGS = 6  # the same for coasting, whose margin is only stated
MOST_RANGES = 4000  # of start instants; more are bounded without being halved
KEPT_SHARE = 0.4  # of the distance to the surface that a withdrawal from the corridor keeps
PLANNED_SHARE = 0.5  # the share at which plans aim
STARTS = 32  # instants of a path from which withdrawals are tried in every iteration
FIELDS = ("t", "half", "r", "v", "push", "span", "other", "most")  # of ``Manoeuvres``, in the
# order of the extension


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

    @property
    def table(self) -> Array:
        """The fields side by side (m, 14)."""
        return np.column_stack([getattr(self, name) for name in FIELDS])


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

    @property
    def escapes(self) -> Array:
        """Begins of the ranges [s], ascending, and directions in {A} of the manoeuvres (m, 4)."""
        push, begins = self.worst.push, self.worst.t - self.worst.half
        d = push / np.maximum(np.linalg.norm(push, axis=1, keepdims=True), 1e-12)
        return np.column_stack([begins, d])[np.argsort(begins, kind="stable")]


def escapes_at(escapes: Array, times: Array) -> Array:
    """Return the directions in {A} (n, 3) of the escapes from instants of a path.

    Args:
        escapes: (m, 4) begins of ranges of start instants [s], ascending, and the direction in
            each; the last range ends with the path.
        times: (n,) instants [s].
    """
    k = np.searchsorted(escapes[:, 0], times, side="right") - 1
    return np.asarray(escapes[np.maximum(k, 0), 1:])


@value_class
class Safety:
    """What is certified of the robot that leaves a path at any of its instants.

    Attributes:
        margin_m: Lower bound of the smallest margin of the withdrawals [m].
        passive_margin_m: The same of coasting after a cut of the thrust [m].
        passive_safe_s: Instant of the path up to which a cut is safe [s]; infinite: all of it.
    """

    margin_m: float
    passive_margin_m: float
    passive_safe_s: float


def safety(space: Space, path: RobotPath, begin_s: float, escapes: Array | None) -> Safety:
    """Return the margins of the escapes that a path carries, and of coasting.

    Args:
        space: The target.
        path: The path.
        begin_s: Begin of its thrust [s after its begin].
        escapes: What it carries, see ``escapes_at``; None: they are searched.
    """
    active = certified(space, path, begin_s, escapes, search=escapes is None)
    passive = coasting(space, path, begin_s)
    return Safety(active.margin_m, passive.margin_m, passive.safe_s)


class Space:
    """The target after an instant as a withdrawal sees it."""

    def __init__(
        self,
        sampled: SampledScene,
        limits: Limits,
        a_max: float,
        extent_m: float,
        planned: bool = False,
    ) -> None:
        """Create it.

        Args:
            sampled: The target.
            limits: Resolved limits: clearance, corridor and sigmas.
            a_max: Acceleration that the robot has in every direction [m/s2].
            extent_m: Diagonal of the target's bounding box [m].
            planned: Require of withdrawals from the corridor what plans aim at: more than what is
                stated.
        """
        self.sampled, self.a_max = sampled, a_max
        self.enough_m = ENOUGH_OF_EXTENT * extent_m
        self.resolution_m = RESOLUTION_OF_EXTENT * extent_m
        self.limits = replace(limits, clearance_m=limits.kept_m or None)
        self.kept_share = PLANNED_SHARE if planned else KEPT_SHARE
        scene = sampled.scene
        self.centre_c = np.zeros(3) if scene.centre_c is None else scene.centre_c
        self.radius_m = scene.radius_m
        self._kernel, self._end_s = self._made(), -1.0

    def _made(self) -> _cone.Space:
        """The target for the extension."""
        scene, limits = self.sampled.scene, self.limits
        axis_c = np.array([1.0, 0.0, 0.0]) if scene.axis_c is None else scene.axis_c
        corridor = (math.nan, 0.0, 0.0)
        tangent = math.tan(math.radians(limits.final_deg or 0.0))
        if scene.axis_c is not None and limits.final_deg is not None:
            corridor = (tangent, limits.mouth_m or 0.0, limits.final_range_m or 0.0)
        # the corridor's margin changes by at most this factor times the change of the position
        slope = math.hypot(1.0, tangent)
        kernel = _cone.Space(
            scene.surface,
            clearance_m=limits.clearance_m or 0.0,
            sigmas=limits.clearance_sigmas,
            axis_c=_triple(axis_c),
            corridor=corridor,
            centre_c=_triple(self.centre_c),
            radius_m=self.radius_m,
            enough_m=self.enough_m,
            rates=(slope, *self._rates()),
            a_max=self.a_max,
            coast_s=COAST_S,
            kept_share=self.kept_share,
        )
        if (table := self.sampled.sigma_table) is not None:
            grid, position, attitude = table
            kernel.set_sigma(float(grid[-1]), position, attitude)
        return kernel

    def _rates(self) -> tuple[float, float, float]:
        """Bounds of the angular rate [rad/s], of its change [rad/s2] and of the acceleration of
        the grasp point [m/s2].
        """
        times = np.linspace(0.0, COAST_S, 121)
        drho, dR = self.sampled.at(times, 1)
        step = times[1] - times[0]

        def largest(values: Array) -> float:
            return float(np.sqrt((values**2).sum(axis=-1)).max(initial=0.0))

        turn = largest(dR.reshape(-1, 9)) / math.sqrt(2.0) * 1.05
        bend = MOTION_FACTOR * largest(np.diff(dR, axis=0).reshape(-1, 9)) / step
        return turn, bend, MOTION_FACTOR * largest(np.diff(drho, axis=0)) / step

    def kernel(self, last_s: float) -> _cone.Space:
        """Return the target for the extension, with its motion until ``last_s``."""
        if last_s > self._end_s:
            c, x = self.sampled.pieces(last_s)
            self._kernel.set_motion(c, x)
            self._end_s = float(x[-1])
        return self._kernel

    def gradient(self, y: Array, times: Array, most: Array) -> Array:
        """Return the gradients (n, 3) in {C} of the margin at points (n, 3) in {C}."""
        return self._kernel.gradient(y, times, most)

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
        lower, upper, at = self.kernel(_last_s(m)).least(m.table, target_m).T.copy()
        return lower, upper, at

    def escapes(
        self, t: Array, half: Array, path: tuple[Array, Array, Array], d: Array
    ) -> Manoeuvres:
        """Return escapes in directions d (m, 3), each ended where the robot recedes outside the
        sphere.

        From then on the distance to the centre of mass grows, under the same acceleration and in
        the brake that follows.

        Args:
            t: (m,) start instants, the middles of ranges [s].
            half: (m,) half widths of the ranges [s].
            path: Position, velocity and acceleration of the path there, each (m, 3).
            d: (m, 3) directions in {A}, unit.
        """
        r, v, u = path
        push = self.a_max * d
        other = np.linalg.norm(u - push, axis=1)
        kernel = self.kernel(float(t.max()))
        span = kernel.span(t, r, v)
        return self.ended(Manoeuvres(t, half, r, v, push, span, other, kernel.most(t, r)))

    def ended(self, m: Manoeuvres) -> Manoeuvres:
        """Return the manoeuvres, each ended where the robot recedes outside the sphere."""
        return replace(m, span=self.kernel(_last_s(m)).ended(m.table))

    def margins(self, m: Manoeuvres, below_m: float) -> tuple[Array, Array]:
        """Return margins (m, n) at n instants of manoeuvres, denser at the begin, and the times
        after it (m, n); a margin above ``below_m`` may be a lower bound [m].
        """
        share = np.linspace(0.0, 1.0, EVALUATED_INSTANTS + 1) ** DENSITY_POWER
        tau = m.span[:, None] * share
        found: Array = self.kernel(_last_s(m)).margins(m.table, tau, below_m)
        return found, tau

    def directions(
        self, t: Array, r: Array, v: Array, before: Array, wanted_m: float = math.inf
    ) -> Array:
        """Return of each start the direction (m, 3) in {A} of the escape with the largest margin of
        those compared.

        Args:
            t: (m,) start instants [s].
            r: (m, 3) positions in {A} there [m].
            v: (m, 3) velocities [m/s].
            before: (m, 3) directions that are known to be good; NaN: none. They are improved; where
                the margin is negative all directions are compared.
            wanted_m: Margin from which no better direction is looked for [m].
        """
        span = self.kernel(float(t.max())).span(t, r, v)
        kernel = self.kernel(float((t + span).max()))
        found: Array = kernel.search(t, r, v, before, wanted_m)[0]
        return found


def _triple(x: Array) -> tuple[float, float, float]:
    a, b, c = (float(value) for value in x)
    return a, b, c


def _last_s(m: Manoeuvres) -> float:
    """Last instant of manoeuvres [s]."""
    return float((m.t + m.half + m.span).max())


def joined(parts: Sequence[Manoeuvres]) -> Manoeuvres:
    """Return all manoeuvres of several sets."""
    return Manoeuvres(*(np.concatenate([getattr(m, f) for m in parts]) for f in FIELDS))


def certified(
    space: Space,
    path: RobotPath,
    begin_s: float,
    escapes: Array | None = None,
    least_m: float | None = None,
    search: bool = True,
) -> Certificate:
    """Bound the smallest margin of the withdrawals from every instant of a path.

    Args:
        space: The target.
        path: The path.
        begin_s: First start instant [s after the instant of planning].
        escapes: Escapes that are known to be good, see ``escapes_at``; NaN or None: none.
        least_m: Prove that the margin is at least this, and end where it is not [m]; None: bound
            the smallest margin to within ``Space.resolution_m``.
        search: Other directions are compared where the margin is short; else those of ``escapes``
            are bounded.
    """
    low, high, u = _ranges(path, begin_s, None if escapes is None else escapes[:, 0])
    d = np.full((len(low), 3), math.nan)
    if escapes is not None:
        d = escapes_at(escapes, 0.5 * (low + high))
    done = list[_Done]()
    goal = space.enough_m - space.resolution_m if least_m is None else least_m
    for halving in range(HALVINGS):
        t, half = 0.5 * (low + high), 0.5 * (high - low)
        m, lower, upper, at = _chosen(space, path, t, half, u, d, goal, search)
        worst = float(upper.min())
        if least_m is None and worst - space.resolution_m < goal:
            # whether the margin is negative is decided first
            goal = 0.0 if 0.0 < worst < space.resolution_m else worst - space.resolution_m
            lower, upper, at = space.least(m, goal)
        last = halving == HALVINGS - 1 or len(t) > MOST_RANGES or worst < goal
        kept = (lower >= goal) | last
        done.append((0.5 * (low + high)[kept], lower[kept], m.of(kept), at[kept], upper[kept]))
        if kept.all():
            break
        low, high, u, d = _halved(low, high, u, m.push / space.a_max, ~kept)
    return _certificate(space, done, worst < goal)


def _chosen(
    space: Space,
    path: RobotPath,
    t: Array,
    half: Array,
    u: Array,
    d: Array,
    goal: float,
    search: bool,
) -> tuple[Manoeuvres, Array, Array, Array]:
    """Escapes for ranges of start instants with the bounds of ``Space.least``, in the directions d
    (m, 3); where one does not reach the goal all directions are compared, with ``search``.
    """
    r, v = path.at(t)
    unknown = np.isnan(d[:, 0])
    if unknown.any():
        d = d.copy()
        d[unknown] = space.directions(t[unknown], r[unknown], v[unknown], d[unknown])

    def bounded(k: NDArray[np.integer], d: Array) -> tuple[Manoeuvres, Array, Array, Array]:
        m = _bounded(space.escapes(t[k], half[k], (r[k], v[k], u[k]), d), path)
        return m, *space.least(m, goal)

    m, lower, upper, at = bounded(np.arange(len(t)), d)
    poor = np.flatnonzero(upper < goal)
    if not search or not len(poor):
        return m, lower, upper, at
    other = bounded(poor, space.directions(t[poor], r[poor], v[poor], d[poor]))
    better = other[2] > upper[poor]
    k = poor[better]
    for values, found in zip((lower, upper, at), other[1:], strict=True):
        values[k] = found[better]
    order = np.r_[np.delete(np.arange(len(t)), k), k]
    m = joined([m.of(order[: len(t) - len(k)]), other[0].of(better)]).of(np.argsort(order))
    return m, lower, upper, at


def coasting(space: Space, path: RobotPath, begin_s: float) -> Certificate:
    """Bound the smallest margin of the robot that coasts for ``COAST_S`` after its thrust is cut at
    any instant of a path.

    Args:
        space: The target.
        path: The path.
        begin_s: First start instant [s after the instant of planning].
    """
    low, high, u = _ranges(path, begin_s, None)
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


def _ranges(path: RobotPath, begin_s: float, begins: Array | None) -> tuple[Array, Array, Array]:
    """Ranges of start instants of a path: begins, ends, and the thrust (m, 3), constant over a
    range; NaN where it is not. Ranges begin also at the instants ``begins``.
    """
    n = len(path.u) if isinstance(path, StepPath) else RANGES
    first = path.latency_s if isinstance(path, StepPath) else begin_s
    edges = first + (path.t_go_s - first) * np.arange(n + 1) / n
    if begins is not None:
        edges = np.union1d(edges, begins)
    edges = np.r_[begin_s, edges[(edges > begin_s) & (edges < path.t_go_s)], path.t_go_s]
    low, high = edges[:-1], edges[1:]
    if isinstance(path, StepPath):
        return low, high, path.thrust(0.5 * (low + high))
    return low, high, np.full((len(low), 3), math.nan)


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
        reserve: (m,) margin that the programme requires of each [m]: it grows by what is found to
            be missing, as the margins are not linear in the path.
    """

    share: Array
    d: Array
    reserve: Array

    @classmethod
    def first(cls, reserve_m: float) -> Tried:
        """Return ``STARTS`` instants, denser towards the end, where the robot is near.

        Args:
            reserve_m: Margin that is required at first [m].
        """
        share = 1.0 - (1.0 - np.arange(STARTS) / STARTS) ** 1.7
        return cls(share, np.full((STARTS, 3), math.nan), np.full(STARTS, reserve_m))

    @classmethod
    def near(cls, escapes: Array | None, begin_s: float, end_s: float, reserve_m: float) -> Tried:
        """Return the first instants of a part of a path with the escapes that it carries."""
        first = cls.first(reserve_m)
        if escapes is None:
            return first
        d = escapes_at(escapes, begin_s + (end_s - begin_s) * first.share)
        return replace(first, d=d)

    def escapes(self, begin_s: float, end_s: float) -> Array:
        """Return the escapes for the ranges between the instants, see ``escapes_at``."""
        order = np.argsort(self.share, kind="stable")
        share = self.share[order]
        begins = begin_s + (end_s - begin_s) * 0.5 * (share + np.r_[share[:1], share[:-1]])
        return np.column_stack([begins, self.d[order]])

    def also(self, share: Array, d: Array, short_m: Array) -> Tried:
        """Return these instants and others (n,) with their directions (n, 3); the reserve there, or
        that of an instant nearby, is larger by what is missing ``short_m`` (n,) [m].
        """
        distance = np.abs(share[:, None] - self.share)
        near, apart = distance.argmin(axis=1), distance.min(axis=1) > 0.1 / STARTS
        more = np.zeros(len(self.share))
        np.maximum.at(more, near[~apart], short_m[~apart])
        _, new = np.unique(np.round(share[apart] * STARTS * 5.0), return_index=True)
        return Tried(
            np.r_[self.share, share[apart][new]],
            np.r_[self.d, d[apart][new]],
            np.r_[self.reserve + more, self.reserve.min() + short_m[apart][new]],
        )

    def tightened(self, found: Certificate, owner: NDArray[np.integer], least_m: float) -> Tried:
        """Return the instants with a larger reserve where the margin is below ``least_m``.

        Args:
            found: Margins of the withdrawals.
            owner: (n,) number of the instant of each.
            least_m: Margin that is required [m].
        """
        margin = np.full(len(self.share), math.inf)
        np.minimum.at(margin, owner, found.margins_m)
        return replace(self, reserve=self.reserve + np.maximum(least_m - margin, 0.0))

    def loosened(self, slack_m: float) -> Tried:
        """Return the instants with reserves that are smaller by a slack that the programme
        needs [m].
        """
        return replace(self, reserve=np.maximum(self.reserve - slack_m, 0.0))


def sampled(
    space: Space,
    path: RobotPath,
    tried: Tried,
    begin_s: float,
    since_s: float = 0.0,
    improve: bool = True,
    below_m: float = 0.0,
) -> tuple[Certificate, Tried, NDArray[np.integer]]:
    """Return the withdrawals from instants of a path, with their margins at instants and the
    smallest one of each, the instants, and the number of the instant of each manoeuvre.

    Args:
        space: The target.
        path: The path; it begins ``since_s`` before the instant of planning.
        tried: Start instants, with the directions from which the search begins.
        begin_s: Begin of the thrust [s after the instant of planning].
        since_s: Time between the begin of the path and the instant of planning [s].
        improve: Search better directions where the margin is negative; else only at new instants.
        below_m: Margins below this are listed, and the smallest one of every withdrawal [m].
    """
    t = begin_s + (path.t_go_s - since_s - begin_s) * tried.share
    r, v = path.at(since_s + t)
    d, new = tried.d.copy(), np.isnan(tried.d[:, 0])
    if new.any():
        d[new] = space.directions(t[new], r[new], v[new], d[new])
    if improve:
        d = space.directions(t, r, v, d, 0.0)
    m = space.escapes(t, np.zeros(len(t)), (r, v, np.zeros_like(r)), d)
    margins, tau = space.margins(m, below_m)
    _, least, at = space.least(m, space.resolution_m)
    k, i = np.nonzero(margins < below_m)
    owner = np.r_[k, np.arange(len(t))]
    found = Certificate(
        min(float(least.min()), float(margins.min())),
        m.of(owner),
        np.r_[tau[k, i], at],
        np.r_[margins[k, i], least],
        math.inf,
    )
    return found, replace(tried, d=m.push / space.a_max), owner


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
    path = r[None], v[None], np.zeros((1, 3))
    d = space.directions(zero, r[None], v[None], np.full((1, 3), math.nan))
    escapes = space.escapes(zero, zero, path, d)
    if planned is not None:
        escapes = joined([escapes, space.escapes(zero, zero, path, planned[None])])
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
    upper = np.full(len(paths), space.enough_m)
    np.minimum.at(upper, owner, space.margins(m, space.enough_m)[0].min(axis=1))
    for _ in range(HALVINGS):  # a smaller margin is found where the largest one is not proven
        goal = float(upper.max()) - space.resolution_m
        lower = np.full(len(paths), goal)
        bound, found = space.least(m, goal)[:2]
        np.minimum.at(lower, owner, bound)
        np.minimum.at(upper, owner, found)
        if lower.max() >= goal:
            break
    first = int(lower.argmax())
    return Withdrawal(paths[first], float(lower[first]))


def _pieces(space: Space, path: BurnPath) -> Manoeuvres:
    """The path as manoeuvres of constant acceleration; at its end the robot is at rest."""
    begins = np.r_[0.0, path.ends[:-1]] if len(path.ends) else np.zeros(1)
    ends = path.ends if len(path.ends) else np.full(1, 1e-3)
    u = path.u if len(path.u) else np.zeros((1, 3))
    r, v = path.at(begins)
    none, zero = np.zeros(len(begins)), np.zeros(1)
    most = none + space.kernel(0.0).most(zero, r[:1])
    return Manoeuvres(begins, none, r, v, u, np.maximum(ends - begins, 0.0), none, most)
