"""Reference paths, the linearisation of the constraints about one, and the check of the true
constraints.
"""

from __future__ import annotations

import math
from dataclasses import field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.outcome import Plan
from avsreplay.plan import _cone
from avsreplay.plan.cone_programme import Index, PointRows, Subproblem
from avsreplay.plan.limits import (
    CONSTRAINTS,
    Margins,
    SampledScene,
    Scene,
    in_fixture_axes,
    largest_acceleration,
    margins,
    narrowing,
)
from avsreplay.plan.path import RobotPath, StepPath, path_of
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.plan.robot import Limits
from avsreplay.plan.withdrawal import (
    DENSITY_POWER,
    EVALUATED_INSTANTS,
    STARTS,
    Certificate,
    Space,
    Tried,
    certified,
    escapes_at,
    sampled,
)

COARSE_NODES = 16  # least number of thrust intervals while initial paths are compared
COARSE_TURN_RAD = 0.25  # largest turn of the target in one of them
MOST_TURN_RAD = 0.5  # the target may turn by this much between two iterations
BETWEEN = 16  # instants of every interval at which the true constraints are checked
# margin at the checked instants in units of the buffer, for the instants between them
RESERVE = 3.0
# a constraint with a larger margin at the reference, in units of the buffer, is left out of the
# programme
FAR = 2e4
# slack of the withdrawals in units of that of the other constraints: they are corrected later
SOFT = 1.0
# margin of withdrawals that the programme requires, in resolutions of their certificate
RESERVE_RESOLUTIONS = 0.5
BUFFER_OF_EXTENT = 1e-5  # length below which an excess is rounding
# share of a_max used by the cone programme; the rest corrects the terminal errors
THRUST_SHARE = 1.0 - 1e-5
TOWARD_AXIS = 2.0  # weight of the fixture's axis in the direction away from the grasp point
LEAD_BACK = 0.3  # a constraint violated at the start is restored within this fraction of the flight


@value_class
class Case:
    """Everything that does not change with the reference.

    Attributes:
        entry: Fractions of the flight from which the cone and the corridor are required; None: the
            reference decides.
        begin_c: (3,) position in {C} where the thrust begins.
        start: (5,) margins there.
        space: What a programme keeps withdrawals clear of; None where no clearance is required.
        stated: What they keep clear of in every plan that is found, and by its stated margin.
    """

    sampled: SampledScene
    limits: Limits
    params: PlanParams
    r0: Array
    v0: Array
    buffer_m: float
    coarse: bool = False
    earliest_s: float = 0.0
    entry: tuple[float, float] | None = None
    begin_c: Array = field(init=False)
    start: Array = field(init=False)
    space: Space | None = field(init=False)
    stated: Space | None = field(init=False)

    def __post_init__(self) -> None:
        at, r = np.array([self.params.latency_s]), (self.r0 + self.params.latency_s * self.v0)[None]
        y = self.sampled.coordinates(at, r)
        object.__setattr__(self, "begin_c", y[0])
        found = margins(self.scene, self.limits, y, r, self.sampled.sigma(at))
        object.__setattr__(self, "start", found.values[0])
        space = stated = None
        if self.limits.clearance_m is not None and self.scene.surface is not None:
            of = self.sampled, self.limits, self.params.a_max_mps2, self.extent_m
            space, stated = Space(*of, planned=True), Space(*of)
        object.__setattr__(self, "stated", stated)
        object.__setattr__(self, "space", space)

    @property
    def extent_m(self) -> float:
        """Diagonal of the target's bounding box [m]."""
        return self.buffer_m / BUFFER_OF_EXTENT

    @property
    def wait_s(self) -> float:
        """Coasting time before the thrust [s]."""
        return self.params.latency_s

    @property
    def reserve_m(self) -> float:
        """Margin that the programme requires of withdrawals; its slack may use it up [m]."""
        return 0.0 if self.space is None else RESERVE_RESOLUTIONS * self.space.resolution_m

    @property
    def allowed_slack_m(self) -> float:
        """Slack of the programme up to which a path is checked [m]."""
        return self.buffer_m if self.space is None else 2.0 * self.space.resolution_m

    @property
    def a_max(self) -> float:
        """Largest acceleration in any direction [m/s2]."""
        return largest_acceleration(self.limits, self.params)

    @property
    def axes(self) -> Array | None:
        """Rows (3, 3) whose product with the acceleration in {A} lies within 1 in each
        component; None without.
        """
        bounds = self.limits.accel_axes_mps2
        return (
            None
            if bounds is None
            else self.limits.base_axes.T / (THRUST_SHARE * np.array(bounds))[:, None]
        )

    def within_axes(self, u: Array) -> bool:
        """Return whether accelerations (n, 3) in {A} are within the bounds of every axis of the
        base.
        """
        bounds = self.limits.accel_axes_mps2
        return bounds is None or bool(np.all(np.abs(u @ self.limits.base_axes) <= bounds))

    @property
    def scene(self) -> Scene:
        """The target."""
        return self.sampled.scene


@value_class
class ReferencePath:
    """A path to linearise about: thrust time t [s] and positions (2 n, 3) at the middle and
    end of every interval.
    """

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
    """Return the number of intervals while initial paths are compared, for flights of at least a
    time [s].
    """
    t = max(least_s, case.earliest_s)
    return min(
        max(COARSE_NODES, math.ceil(turn_rate(case, t) * t / COARSE_TURN_RAD)), case.limits.nodes
    )


def initial_references(case: Case, free: Plan) -> list[ReferencePath]:
    """Initial paths: the free plan, then flights to a point on the fixture's axis and along
    the axis, ever later.
    """
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
    """Positions (2 n, 3) of a flight around the target to the fixture's axis, then along it to the
    goal.
    """
    scene, limits = case.scene, case.limits
    axis = np.array([1.0, 0.0, 0.0]) if scene.axis_c is None else scene.axis_c
    ranges = [
        limits.cone_range_m if limits.cone_deg else 0.0,
        limits.final_range_m if limits.final_deg else 0.0,
    ]
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
    """Move the points (n, 3) that lie inside the sphere around the target outward onto it, where
    ``free``.
    """
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

    Its end is moved to the grasp point, as the estimate has changed since, and its begin to the
    robot.
    """
    t, s = max(path.t_go_s - since_s - case.wait_s, 1e-3), interval_fractions(case.limits.nodes)
    r = path.at(since_s + case.wait_s + t * np.concatenate([[0.0], s]))[0]
    first = case.r0 + case.wait_s * case.v0 - r[0]
    last = case.sampled.at(np.array([case.wait_s + t]))[0][0] - r[-1]
    return ReferencePath(t, r[1:] + first + (s * s)[:, None] * (last - first))


def shortened(case: Case, path: RobotPath, since_s: float) -> Case:
    """Return the case with the interval length of an earlier path: the rest of its flight
    needs fewer intervals.
    """
    if not isinstance(path, StepPath):
        return case
    left = math.ceil((path.t_go_s - since_s - case.wait_s) / path.step_s)
    n = min(max(left, COARSE_NODES), case.limits.nodes)
    return replace(case, limits=replace(case.limits, nodes=n))


def expected_s(case: Case, path: RobotPath, since_s: float) -> float:
    """Return the time to go expected from an earlier path: what is left of it, all of it for
    a robot off it.
    """
    away = float(np.linalg.norm(path.at(np.array([since_s]))[0][0] - case.r0))
    return path.t_go_s - (since_s if away <= (case.limits.mouth_m or 0.0) else 0.0)


def largest_change(case: Case, reference: ReferencePath, most: float) -> float:
    """Return the largest relative change of the end time, at most ``most``: the target may
    turn by MOST_TURN_RAD.
    """
    turn = turn_rate(case, case.wait_s + reference.t) * reference.t
    return float(min(most, MOST_TURN_RAD / max(turn, 1e-9)))


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


def entry_fractions(case: Case, path: RobotPath) -> tuple[float, float]:
    """Return the fractions of a flight from which it stays inside the cone and the corridor, each
    from its range on.
    """
    s = interval_fractions(case.limits.nodes)
    times = case.wait_s + (path.t_go_s - case.wait_s) * s
    inside = margins_at(case, path, times).inside
    found = []
    for column in (0, 1):
        outside = np.flatnonzero(~inside[:-1, column])
        found.append(float(s[outside[-1] + 1]) if len(outside) else 0.0)
    return found[0], found[1]


def excess(case: Case, path: StepPath) -> Array:
    """Return the largest violation near the middle and the end of every interval (2 n, 4) [m]."""
    n = len(path.u)
    if not case.limits.geometric:
        return np.zeros((2 * n, len(CONSTRAINTS)))
    times, found = dense_margins(case, path)
    begin = (times[:-1] - times[0]) / (times[-1] - times[0])
    reserve = RESERVE * case.buffer_m
    accepted = allowed(case.start - reserve, begin)
    over = np.maximum(reserve - found.between - accepted, 0.0)
    half = over.reshape(2 * n, BETWEEN // 2, -1).max(axis=1)
    after = np.concatenate([half[1:], half[-1:]])
    return np.asarray(np.maximum(half, after))


def worst_margin(case: Case, path: RobotPath) -> tuple[float, str]:
    """Return the smallest margin along a path and the constraint that has it, "" without geometric
    constraints.
    """
    if not case.limits.geometric:
        return math.inf, ""
    values = dense_margins(case, path)[1].between
    least = values.min(axis=0)
    return float(least.min()), CONSTRAINTS[int(least.argmin())] if np.isfinite(least).any() else ""


def feasible(case: Case, path: StepPath, over: float, allowed: float) -> bool:
    """Return whether a path ends at the grasp point in time and its excess ``over`` is
    allowed [m].
    """
    position, velocity = path.terminal_errors(case.scene.goal)
    short = path.t_go_s <= case.params.horizon_s
    exact = (
        position <= 1e-8
        and velocity <= 1e-8
        and path.u_max() <= case.a_max
        and case.within_axes(path.u)
    )
    return bool(short and exact and over <= allowed)


@value_class
class Withdrawn:
    """Withdrawals from instants of a path.

    Attributes:
        margin_m: Smallest margin of the clearance during them [m]; NaN without a clearance.
        short_m: What is missing, less what the withdrawal from the start itself lacks; 0 where
            withdrawals are not required [m].
        rows: Rows that require the margin; empty where they are not needed.
        tried: The instants; None where withdrawals are not required.
        escapes: (m, 4) start instants [s] in time order and directions of the withdrawals; None
            where they are not known.
    """

    margin_m: float = math.nan
    short_m: float = 0.0
    rows: tuple[PointRows, ...] = ()
    tried: Tried | None = None
    escapes: Array | None = None


def withdrawn(
    case: Case,
    path: RobotPath,
    tried: Tried | None = None,
    since_s: float = 0.0,
    improve: bool = True,
    kept: bool = False,
) -> Withdrawn:
    """Return the withdrawals from some instants of a path.

    Args:
        case: The problem; withdrawals are left out on the coarse grid.
        path: The path.
        tried: The instants; None: the first ones.
        since_s: Time between its begin and the instant of planning [s].
        improve: Search better directions where the margin is negative.
        kept: The path is the solution of a programme that required the margin at these instants:
            what is missing is added to their reserves.
    """
    if case.space is None or case.coarse or not case.limits.abort:
        return Withdrawn()
    below, tried = FAR * case.buffer_m, tried or Tried.first(case.reserve_m)
    found, tried, owner = sampled(case.space, path, tried, case.wait_s, since_s, improve, below)
    least = _accepted(case.space, found)
    short = max(least - found.margin_m, 0.0)
    if kept:
        tried = tried.tightened(found, owner, least)
    rows = _withdrawal_rows(
        case, case.space, path.t_go_s - since_s, found, least + tried.reserve[owner]
    )
    return Withdrawn(found.margin_m, short, (rows,), tried, found.escapes)


def proven(case: Case, path: RobotPath, away: Withdrawn) -> Withdrawn:
    """Return whether withdrawals from every instant keep the stated margin, and otherwise rows that
    also contain those from the worst instants, which are tried from then on.

    Args:
        case: The problem; on the coarse grid nothing is proven.
        path: The path.
        away: Withdrawals from some instants of about the same path.
    """
    if (space := case.stated) is None or away.tried is None:
        return away
    if away.short_m > case.reserve_m:  # far from what is stated
        return away
    start = Tried(away.tried.share[:1], away.tried.d[:1], away.tried.reserve[:1])
    least = _accepted(space, sampled(space, path, start, case.wait_s)[0])
    escapes = away.tried.escapes(case.wait_s, path.t_go_s)
    found = certified(space, path, case.wait_s, escapes, least)
    short, length = max(least - found.margin_m, 0.0), path.t_go_s - case.wait_s
    poor = found.margins_m < least + case.reserve_m
    if short <= 0.0:
        return replace(away, margin_m=found.margin_m, short_m=0.0, escapes=found.escapes)
    at = found.worst.t[poor]
    missing = least + case.reserve_m - found.margins_m[poor]
    tried = away.tried.also((at - case.wait_s) / length, escapes_at(escapes, at), missing)
    return replace(
        withdrawn(case, path, tried, improve=False),
        short_m=short,
        margin_m=found.margin_m,
        escapes=found.escapes,
    )


def _accepted(space: Space, found: Certificate) -> float:
    """The margin that is required: what the withdrawal from the start itself lacks is accepted."""
    first = float(found.margins_m[found.worst.t == found.worst.t.min()].min())
    return 0.0 if first >= 0.0 else first - space.resolution_m


def _withdrawal_rows(
    case: Case, space: Space, end_s: float, found: Certificate, required: Array
) -> PointRows:
    """Rows that keep withdrawals at the margins ``required`` (m,); of those from about the same
    instant and about the same time after it the worst.
    """
    limits, length = case.limits, end_s - case.wait_s
    # what is missing is gained by moves of the path that also reduce larger margins
    far = space.enough_m + 2.0 * float(np.maximum(required - found.margins_m, 0.0).max(initial=0.0))
    near = np.flatnonzero(found.margins_m < required + far)
    part = np.floor((found.worst.t[near] - case.wait_s) * (2.0 * STARTS / length))
    after = np.maximum(found.at[near] / found.worst.span[near], 0.0)
    late = np.round(after ** (1.0 / DENSITY_POWER) * EVALUATED_INSTANTS)
    order = np.lexsort((found.margins_m[near], late, part))
    key = ((EVALUATED_INSTANTS + 1.0) * part + late)[order]
    k = near[order][np.r_[True, np.diff(key) > 0.0]] if len(order) else near
    m, lead = found.worst.of(k), found.at[k]
    t, r, v = m.t + lead, m.r, m.v
    if not len(k):
        t, r, v, lead = np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    rho, R = case.sampled.at(t)
    drho, dR = case.sampled.at(t, 1)
    q = r + lead[:, None] * (v + 0.5 * lead[:, None] * m.push) - rho
    slope = space.gradient(in_fixture_axes(R, q), t, m.most)
    turned = np.sum(slope * (in_fixture_axes(dR, q) - in_fixture_axes(R, drho)), axis=1)
    in_a = (R @ slope[:, :, None])[:, :, 0]
    at = (m.t - case.wait_s) * limits.nodes / length
    interval = np.clip(at.astype(np.int64), 0, limits.nodes - 1)
    coast = np.sum(in_a * (r + lead[:, None] * v), axis=1)
    # the velocity for given h v changes with h, and the target turns until the later instant
    rate = (m.t - case.wait_s) * turned - lead * np.sum(in_a * v, axis=1)
    return PointRows(
        interval,
        np.clip(at - interval, 0.0, 1.0),
        in_a,
        found.margins_m[k] - required[k] - coast,
        rate,
        np.full(len(k), SOFT),
        lead,
    )


def allowed(start: Array, fraction: Array) -> Array:
    """Return the violation (n, 5) that is accepted while the robot returns from a violation at the
    start: a robot at rest gains the way with the square of the time.

    Args:
        start: (5,) margins at the start [m].
        fraction: (n,) of the flight.
    """
    shrinking = np.maximum(1.0 - (fraction / LEAD_BACK) ** 2, 0.0)
    return np.asarray(np.maximum(-start, 0.0)[None, :] * shrinking[:, None])


def convex_subproblem(
    case: Case,
    reference: ReferencePath,
    off: Array,
    change: float,
    aborts: tuple[PointRows, ...] = (),
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
    planes, cones, sizes = _geometric(case, reference, off)
    return replace(problem, planes=(*aborts, planes), cones=((sizes, cones),))


def _geometric(
    case: Case, reference: ReferencePath, off: Array
) -> tuple[PointRows, PointRows, Index]:
    """Return the rows of the geometric constraints at the middle and the end of every interval,
    tightened by ``off``.

    They are planes, and cones with the sizes of their groups. ``off`` grows by the distance of the
    path in {C} from its chord between two points, less the violation that is accepted at the begin.
    """
    n, limits, scene = case.limits.nodes, case.limits, case.scene
    s = interval_fractions(n)
    times = case.wait_s + reference.t * s
    rho, R = case.sampled.at(times)
    drho, dR = case.sampled.at(times, 1)
    y = in_fixture_axes(R, reference.r - rho)
    dy = in_fixture_axes(dR, reference.r - rho) - in_fixture_axes(R, drho)
    dy *= (reference.t * s)[:, None]  # change with the relative change of the end time
    bend = np.linalg.norm(np.diff(np.concatenate([case.begin_c[None], y]), 2, axis=0), axis=1) / 8.0
    off = off + np.concatenate([bend, bend[-1:]])[:, None] - allowed(case.start, s)
    sigma = case.sampled.sigma(times)
    found = margins(scene, limits, y, reference.r, sigma)
    off[:, :2] += narrowing(scene, limits, y, sigma)
    inside = found.inside
    if case.entry is not None:
        inside[:, 0] = s >= case.entry[0] - 1e-9
        inside[:, 1] = inside[:, 3] = s >= case.entry[1] - 1e-9
    arrays = (
        y,
        dy,
        reference.r,
        rho,
        R,
        found.first,
        found.second,
        off,
        found.foot,
        found.distance,
        found.clearance,
    )
    values = (
        *_constraint_values(limits, scene.centre_c is not None),
        FAR * case.buffer_m,
        TOWARD_AXIS,
    )
    planes, cones = _cone.rows(*arrays, inside, _frame(scene, limits), values)
    return PointRows(*planes[:-1]), PointRows(*cones[:-1]), cones[-1]


def _constraint_values(limits: Limits, centred: bool) -> tuple[float, ...]:
    """Return the limits in the order of the extension; NaN where a constraint is not set."""
    tangents = (
        math.nan if a is None else math.tan(math.radians(a))
        for a in (limits.cone_deg, limits.final_deg)
    )
    lengths = (limits.cone_range_m, limits.final_range_m, limits.mouth_m)
    keepout = limits.keepout_m if centred else None
    others = (
        keepout,
        limits.keepout_release_m,
        limits.clearance_m,
        limits.reach_max_m,
        limits.reach_min_m,
    )
    return (
        *tangents,
        *(x or 0.0 for x in lengths),
        *(math.nan if x is None else x for x in others),
    )


def _frame(scene: Scene, limits: Limits) -> Array:
    """Return the fixture's axis and two directions across it, the centre of mass in {C}, and the
    base in {A} (5, 3).
    """
    axis = (1.0, 0.0, 0.0) if scene.axis_c is None else tuple(np.asarray(scene.axis_c).tolist())
    centre = np.zeros(3) if scene.centre_c is None else scene.centre_c
    return np.concatenate([_axes(axis), [centre, limits.base_m]])


@lru_cache(maxsize=16)
def _axes(axis: tuple[float, float, float]) -> Array:
    """Return an axis in {C} and two directions across it (3, 3)."""
    side = geometry.across(np.array(axis))
    return np.stack([np.array(axis), side, np.cross(axis, side)])
