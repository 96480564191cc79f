"""Time-optimal rendezvous under constraints by successive convexification.

Each iteration linearises the constraints about a reference path and solves a second-order cone
programme with free end time. Most constraints are alternatives (inside the cone, or outside its
range); the reference decides which one holds at an instant. Several initial paths with different
arrival times and sides lead to different local minima; the earliest capture is kept. Withdrawals
are then required of the path that was found without them. A plan is accepted only after the true
constraints hold at sixteen instants of every interval.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from operator import attrgetter

import numpy as np

from avsreplay.geometry import Array
from avsreplay.outcome import Plan, PlanStatus
from avsreplay.plan.cone_programme import solve
from avsreplay.plan.convexification import (
    BETWEEN,
    BUFFER_OF_EXTENT,
    Case,
    ReferencePath,
    Withdrawn,
    coarse_nodes,
    convex_subproblem,
    entry_fractions,
    excess,
    expected_s,
    feasible,
    initial_references,
    interval_fractions,
    largest_change,
    margins_at,
    proven,
    shortened,
    warm_reference,
    withdrawn,
    worst_margin,
)
from avsreplay.plan.limits import CONSTRAINTS, SampledScene, Scene, largest_acceleration
from avsreplay.plan.path import MOTION_FACTOR, RobotPath, StepPath, path_of
from avsreplay.plan.rendezvous import PlanParams, finer, no_plan, rendezvous
from avsreplay.plan.robot import Limits
from avsreplay.plan.withdrawal import COAST_S, Space, Tried, certified, safety

MOST_ITERATIONS = 14  # largest number of iterations of one initial path
TIME_TOLERANCE_S = 2e-3  # change of the end time that ends the iterations
RELATIVE_TOLERANCE = 2e-4  # the same as a fraction of the end time
# the same while initial paths are compared, and where an earlier plan is renewed
ROUGH_TOLERANCE = 2e-3
SAME_PATH = 5e-3  # drafts whose end times differ by less, relative to them, have the same minimum
# time to spare over the time to go of a path from which another one is searched, until its
# withdrawals keep the margins; where a renewed plan needs more all initial paths are searched
SPARE = (0.0, 5e-3, 2e-2)
# relative change of the end time below which the excess tightens the constraints
NEAR_REFERENCE = 0.02
HOPELESS = 1.2  # an iteration this much later than the best path ends its initial path
SAME_TIME_S = 1e-3  # a plan this close to the lower bound is optimal
IMPROVED = 2  # drafts whose entry is moved
MOVES = 6  # largest number of moves of the entry in one direction
# initial paths nearest to the earliest draft, tried on the fine grid where no draft can be refined
RETRIED = 3
TRUST = 0.25  # largest relative change of the end time between two iterations
CAREFUL = 0.03  # the same from a draft whose first refinement ended later or without a path
SHORT_S_PER_M = 20.0  # time that a shortage of withdrawals costs when paths are compared
IDLE = 3  # the iterations end when the best path has not become better in as many
# from this iteration on an initial path without a plan ends where the slack does not shrink
STUCK = 4


def constrained(
    scene: Scene,
    r0: Array,
    v0: Array,
    params: PlanParams,
    limits: Limits,
    t_ns: int = 0,
    extent_m: float = 8.0,
    warm: tuple[RobotPath, float] | None = None,
    earliest_s: float = 0.0,
) -> Plan:
    """Plan a rendezvous under constraints.

    Args:
        scene: The target after t_ns.
        r0: (3,) position of the robot in {A} at t_ns [m].
        v0: (3,) its velocity [m/s].
        params: Thrust, horizon, latency and grid.
        limits: The constraints; lengths that are not set are taken from the target's extent.
        t_ns: Instant of planning.
        extent_m: Diagonal of the target's bounding box [m].
        warm: A path planned earlier and the time since its begin [s]; it is the first initial path.
        earliest_s: Earliest capture allowed [s after t_ns].

    Returns:
        A plan with status ``optimal`` (within ``gap_s`` of the certified lower bound, which is the
        least time without constraints), ``feasible`` (all constraints hold, a local minimum),
        ``none_found`` (no plan was found, but one may exist) or ``infeasible_within_horizon``
        (certified).

    Raises:
        ValueError: A value is not valid, or the scene lacks what a constraint needs.
    """
    limits, params = limits.resolved(extent_m), finer(params, scene.goal)
    scene.check(limits)
    strongest = replace(params, a_max_mps2=largest_acceleration(limits, params))
    unbound = free = rendezvous(scene.goal, r0, v0, strongest, t_ns)
    if free.found and earliest_s > free.t_go_s:
        free = rendezvous(scene.goal, r0, v0, strongest, t_ns, earliest_s)
    else:  # no capture is earlier in any case
        earliest_s = 0.0
    if not free.found or not limits.any or free.t_go_s <= params.latency_s:
        return free
    r0, v0 = np.asarray(r0, float), np.asarray(v0, float)
    free = _necessary(scene, free, r0, params, limits)
    if not free.found:
        return free
    span_s = 1.5 * unbound.t_go_s + (0.0 if limits.clearance_m is None else COAST_S)
    sampled = SampledScene(scene, params.horizon_s, params.grid_s, span_s)
    buffer_m = BUFFER_OF_EXTENT * extent_m
    case = Case(sampled, limits, params, r0, v0, buffer_m, earliest_s=earliest_s)
    return _free_plan(case, free) or _graded(
        case, free, _best_path(case, free, unbound, warm), t_ns
    )


def linearised_s(
    scene: Scene, path: StepPath, params: PlanParams, limits: Limits, extent_m: float
) -> float:
    """Return the time to go for a target that differs little from that of a plan: the solution of
    one convex subproblem about its path [s]; NaN where that has none.

    Args:
        scene: The target.
        path: The path of the plan, whose escapes are kept.
        params: Thrust, horizon, latency and grid.
        limits: The constraints.
        extent_m: Diagonal of the target's bounding box [m].
    """
    limits, params = limits.resolved(extent_m), finer(params, scene.goal)
    n, end_s = len(path.u), path.t_go_s
    sampled = SampledScene(scene, params.horizon_s, params.grid_s, 1.5 * end_s + COAST_S)
    limits = replace(limits, nodes=n)
    case = Case(sampled, limits, params, path.r0, path.v0, BUFFER_OF_EXTENT * extent_m)
    tried = Tried.near(path.escapes, case.wait_s, end_s, case.reserve_m)
    away = withdrawn(case, path, tried, improve=False)
    reference = warm_reference(case, path, 0.0)
    change, off = largest_change(case, reference, TRUST), np.zeros((2 * n, len(CONSTRAINTS)))
    found = solve(convex_subproblem(case, reference, off, change, away.rows))
    return math.nan if found is None else case.wait_s + n * found.h


def with_safety(
    scene: Scene,
    plan: Plan,
    path: RobotPath,
    params: PlanParams,
    limits: Limits,
    extent_m: float,
    after_s: float = 0.0,
) -> Plan:
    """Return a plan with the margins of a robot that withdraws or coasts from any of its instants;
    the same plan without one or without a clearance.

    Args:
        scene: The target after the begin of the path.
        plan: The plan.
        path: Its path.
        params: Thrust, horizon and grid.
        limits: Resolved limits.
        extent_m: Diagonal of the target's bounding box [m].
        after_s: Begin of the path [s after the instant of planning].
    """
    if not plan.found or limits.clearance_m is None or scene.surface is None:
        return plan
    grid_s = finer(params, scene.goal).grid_s
    sampled = SampledScene(scene, params.horizon_s, grid_s, path.t_go_s + 1.5 * COAST_S)
    space = Space(sampled, limits, params.a_max_mps2, extent_m)
    found = safety(space, path, plan.latency_s - after_s, plan.escapes)
    return replace(
        plan,
        abort_margin_m=found.margin_m,
        passive_margin_m=found.passive_margin_m,
        passive_safe_s=after_s + min(found.passive_safe_s, path.t_go_s),
    )


def _necessary(scene: Scene, free: Plan, r0: Array, params: PlanParams, limits: Limits) -> Plan:
    """Raise the certified lower bound to the first time at which necessary conditions of a capture
    hold.

    The distance can be covered at the largest speed, and the grasp point is inside the workspace.
    Between two samples the goal moves by at most half the spacing times its largest speed, times
    1.5. Where no time remains the problem is proven infeasible.
    """
    proven = no_plan(free.t_ns, PlanStatus.INFEASIBLE, free.a_max, params.horizon_s)
    if _closed_off(scene, r0, limits):
        return proven
    if limits.speed_max_mps is None and limits.reach_max_m is None and limits.reach_min_m is None:
        return free
    times = np.linspace(0.0, params.horizon_s, math.ceil(params.horizon_s / params.grid_s) + 1)
    rho, rate = scene.goal(times)
    sag = 0.5 * times[1] * MOTION_FACTOR * float(np.linalg.norm(rate, axis=1).max())

    def least(x: Array) -> Array:
        return np.asarray(np.minimum(x[1:], x[:-1]) - sag)

    from_base = np.linalg.norm(rho - np.array(limits.base_m), axis=1)
    possible = times[1:] >= free.lower_bound_s
    possible &= (
        least(np.linalg.norm(rho - r0, axis=1)) <= (limits.speed_max_mps or math.inf) * times[1:]
    )
    possible &= least(from_base) <= (limits.reach_max_m or math.inf)
    possible &= least(-from_base) <= -(limits.reach_min_m or 0.0)
    if not possible.any():
        return proven
    return replace(
        free, lower_bound_s=max(free.lower_bound_s, float(times[int(possible.argmax())]))
    )


def _closed_off(scene: Scene, r0: Array, limits: Limits) -> bool:
    """Return whether every point of the corridor is closer to the surface than the clearance, so
    that none leads in.

    The distance to the surface changes by at most the distance between two points, and the corridor
    lies within its range of the grasp point.
    """
    if limits.clearance_m is None or scene.surface is None:
        return False
    length = limits.final_range_m or 0.0
    outside = float(np.linalg.norm(r0 - scene.goal(np.zeros(1))[0][0])) > length
    return outside and limits.clearance_m > float(scene.surface(np.zeros((1, 3)))[1][0]) + length


def _free_plan(case: Case, free: Plan) -> Plan | None:
    """Return the plan without constraints where it satisfies all of them; None where it does
    not.
    """
    path, limits = path_of(free, case.r0, case.v0), case.limits
    times = np.linspace(case.wait_s, path.t_go_s, BETWEEN * limits.nodes + 1)
    if (
        margins_at(case, path, times[::BETWEEN]).values.min() < 0.0
    ):  # few instants show most violations
        return None
    if limits.accel_axes_mps2 is not None and not case.within_axes(path.thrust(times)):
        return None
    speed = limits.speed_max_mps
    if speed is not None and float(np.linalg.norm(path.at(times)[1], axis=1).max()) > speed:
        return None
    if limits.contact_accel_mps2 is not None:
        rate = case.scene.goal(np.array([path.t_go_s, path.t_go_s - 1e-4]))[1]
        relative = path.thrust(times[-1:])[0] - (rate[0] - rate[1]) / 1e-4
        if float(np.linalg.norm(relative)) > limits.contact_accel_mps2:
            return None
    worst, name = worst_margin(case, path)
    if worst < 0.0:
        return None
    away = proven(case, path, withdrawn(case, path))
    if away.short_m > 0.0:
        return None
    return replace(free, violation_m=0.0, margin_m=worst, binding=name, escapes=away.escapes)


def _graded(case: Case, free: Plan, found: StepPath | None, t_ns: int) -> Plan:
    if found is None:
        return no_plan(t_ns, PlanStatus.NOT_FOUND, free.a_max, free.lower_bound_s)
    position, velocity = found.terminal_errors(case.scene.goal)
    worst, name = worst_margin(case, found)
    escapes = found.escapes
    if found.short_m > 0.0 and case.stated is not None:  # the search ended at the first short ones
        escapes = certified(case.stated, found, case.wait_s, escapes).escapes
    return Plan(
        t_ns=t_ns,
        status=PlanStatus.OPTIMAL
        if found.t_go_s - free.lower_bound_s <= SAME_TIME_S
        else PlanStatus.FEASIBLE,
        t_go_s=found.t_go_s,
        costate=np.full(6, math.nan),
        a_max=case.a_max,
        lower_bound_s=free.lower_bound_s,
        position_error_m=position,
        velocity_error_mps=velocity,
        u_max=found.u_max(),
        latency_s=found.latency_s,
        thrust=found.u,
        violation_m=max(-worst, 0.0),
        margin_m=worst,
        binding=name,
        escapes=escapes,
    )


def _best_path(
    case: Case, free: Plan, unbound: Plan, warm: tuple[RobotPath, float] | None
) -> StepPath | None:
    """Return the best capture found: from the rest of an earlier path at its end time, or little
    later where withdrawals need it.

    Otherwise all initial paths are searched. Where the earliest capture allowed is before that of
    every draft, the search without this bound, from the unconstrained plan ``unbound``, has the
    better initial paths.
    """
    best: StepPath | None = None
    if warm is not None:
        path, since_s = warm
        expected = max(expected_s(case, path, since_s), case.earliest_s)
        # a robot that has left the path needs at least the time of the plan without constraints
        since_s = max(min(since_s, path.t_go_s - free.t_go_s), 0.0)
        again, least_s = shortened(case, path, since_s), max(path.t_go_s - since_s, free.t_go_s)
        best = _safest_of(_unhurried(again, path, since_s, least_s))
        longest = 1.0 + SPARE[-1] + ROUGH_TOLERANCE
        if best is not None and best.t_go_s <= longest * expected + TIME_TOLERANCE_S:
            return best
    coarse = replace(
        case, limits=replace(case.limits, nodes=coarse_nodes(case, free.t_go_s)), coarse=True
    )
    drafts = _drafts(coarse, free)
    if case.earliest_s > 0.0 and (not drafts or drafts[0].t_go_s > case.earliest_s + SAME_TIME_S):
        other = _best_path(
            replace(case, earliest_s=0.0, sampled=case.sampled.anew()), unbound, unbound, None
        )
        if other is not None and other.t_go_s >= case.earliest_s:
            return other
    plain = replace(case, limits=replace(case.limits, abort=False))
    near = _near(case, free, drafts)
    found = _improved(plain, coarse, drafts)
    for reference in near if found is None else ():
        found = found or _converged(plain, reference)
    if found is None:
        return best
    found = _moved(plain, found)
    if case.space is None or not case.limits.abort:
        return found if best is None else min(best, found, key=_safest)
    away = proven(case, found, withdrawn(case, found))
    found = replace(found, escapes=away.escapes, short_m=away.short_m)
    paths = chain((best, found), _unhurried(case, found, 0.0, found.t_go_s))
    return _safest_of(paths, case.reserve_m)


def _safest_of(paths: Iterable[StepPath | None], enough_m: float = 0.0) -> StepPath | None:
    """Return the first path whose withdrawals miss at most ``enough_m``; without one, the path that
    is the best by what it misses and its time.
    """
    best: StepPath | None = None
    for path in filter(None, paths):
        best = path if best is None else min(best, path, key=_safest)
        if best.short_m <= enough_m:
            break
    return best


def _near(case: Case, free: Plan, drafts: list[StepPath]) -> list[ReferencePath]:
    """Return the initial paths whose end times are nearest to that of the earliest draft."""
    if not drafts:
        return []
    references = initial_references(case, free)
    references.sort(key=lambda reference: abs(reference.t - drafts[0].t_go_s))
    return references[:RETRIED]


def _unhurried(
    case: Case, path: RobotPath, since_s: float, earliest_s: float
) -> Iterator[StepPath | None]:
    """Refine the rest of a path for a capture not before ``earliest_s``, then with time to spare,
    with which margins can be kept that the earliest path misses.
    """
    reference, away = _rest(case, path, since_s)
    for spare in SPARE:
        later = replace(case, earliest_s=max(case.earliest_s, (1.0 + spare) * earliest_s))
        yield _converged(later, reference, away=away, first=True)


def _drafts(coarse: Case, free: Plan) -> list[StepPath]:
    """Return the different captures found on the coarse grid from the initial paths, in the order
    of their arrival.
    """
    drafts, earliest_s = list[StepPath](), math.inf
    for reference in initial_references(coarse, free):
        draft = _converged(coarse, reference, 1.1 * earliest_s)
        if draft is not None:
            drafts.append(draft)
            earliest_s = min(earliest_s, draft.t_go_s)
        if reference.t > 1.5 * earliest_s or earliest_s <= coarse.earliest_s + SAME_TIME_S:
            break
    return _different(drafts)


def _improved(case: Case, coarse: Case, drafts: list[StepPath]) -> StepPath | None:
    """Return the earliest of the drafts, which are refined in the order of their arrival."""
    drafts[:IMPROVED] = [_moved(coarse, draft) for draft in drafts[:IMPROVED]]
    best: StepPath | None = None
    for draft in _different(drafts):
        for trust in (TRUST, CAREFUL):
            if best is None or (trust == TRUST and best.t_go_s > draft.t_go_s):
                found = filter(None, (best, _refined(case, draft, trust=trust)))
                best = min(found, key=_duration, default=None)
    return best


_duration = attrgetter("t_go_s")


def _safest(path: StepPath) -> tuple[bool, float]:
    """Paths whose withdrawals keep what is required come first, then the earliest; a withdrawal
    that misses it costs time.
    """
    return path.short_m > 0.0, path.t_go_s + SHORT_S_PER_M * path.short_m


def _different(drafts: list[StepPath]) -> list[StepPath]:
    """Return the drafts in the order of their end times without those that are the same local
    minimum.
    """
    out: list[StepPath] = []
    for draft in sorted(drafts, key=_duration):
        if not out or draft.t_go_s - out[-1].t_go_s > SAME_PATH * draft.t_go_s:
            out.append(draft)
    return out


def _moved(case: Case, path: StepPath) -> StepPath:
    """Return a path with the entry into cone or corridor moved as long as the capture becomes
    earlier.

    The alternative that is required at an instant follows from the reference, so that the
    iterations alone cannot move the entry by more than they move the path.
    """
    at_bound = path.t_go_s <= case.earliest_s + SAME_TIME_S
    if at_bound or (case.limits.cone_deg is None and case.limits.final_deg is None):
        return path
    which, step = 0 if case.limits.cone_deg is not None else 1, 0.5 / case.limits.nodes
    best, start = path, entry_fractions(case, path)
    for direction in (-step, step):
        for count in range(1, MOVES + 1):
            entry = list(start)
            entry[which] += count * direction
            moved = replace(case, entry=(entry[0], entry[1]))
            trial = _refined(moved, best, latest_s=best.t_go_s)
            if trial is None or trial.t_go_s > best.t_go_s - TIME_TOLERANCE_S:
                break
            if trial.short_m > best.short_m:
                break
            best = trial
        if best is not path:
            break
    return best


def _refined(
    case: Case, path: RobotPath, latest_s: float = math.inf, trust: float = TRUST
) -> StepPath | None:
    """Iterate from an earlier path, whose withdrawals the first iteration requires."""
    reference, away = _rest(case, path, 0.0)
    return _converged(case, reference, latest_s, trust, away)


def _rest(case: Case, path: RobotPath, since_s: float) -> tuple[ReferencePath, Withdrawn]:
    """The rest of an earlier path as a reference, and its withdrawals."""
    known = path.escapes if isinstance(path, StepPath) else None
    tried = Tried.near(known, since_s + case.wait_s, path.t_go_s, case.reserve_m)
    return warm_reference(case, path, since_s), withdrawn(case, path, tried, since_s)


@dataclass
class _Search:
    """What the iterations from one reference have found.

    Attributes:
        best: The best path.
        away: Withdrawals from the latest path.
        off: (2 n, 4) tightening of the constraints.
        gain: Share of an excess by which they are tightened, doubled where an excess remains: it
            reacts weakly.
        slack: Slack of the latest programme [m].
        idle: Iterations since the best path became better.
    """

    away: Withdrawn
    off: Array
    best: StepPath | None = None
    gain: Array = field(default_factory=lambda: np.array(0.6))
    slack: float = math.inf
    idle: int = 0

    def take(self, path: StepPath, tolerance_s: float) -> None:
        """Take a path that satisfies the constraints."""
        best = self.best
        if best is None or _safest(path) < _safest(best):
            better = best is None or _safest(path)[1] < _safest(best)[1] - tolerance_s
            self.best, self.idle = (
                path,
                0 if better or best is None or path.short_m < best.short_m else self.idle,
            )

    def done(self, settled: bool, first: bool) -> bool:
        """Return whether the best path is safe and the ``first`` one is enough, or it is the latest
        one and moves no more, or has not become better in ``IDLE`` iterations.
        """
        if self.best is None or self.best.short_m > 0.0:
            return False
        return first or self.idle >= IDLE or (settled and self.idle == 0)

    def tighten(self, over: Array, buffer_m: float, near: bool) -> None:
        """Subtract the excess ``over`` from the constraints where the path is near its reference;
        less where the programme cannot keep as much although all hold.
        """
        if self.slack > buffer_m and over.max() == 0.0:
            self.off *= 0.5
        elif near:
            self.gain = np.where(over > 0.0, np.minimum(2.0 * self.gain, 4.8), 0.6)
            self.off += self.gain * over + np.where(over > 0.0, buffer_m, 0.0)


def _accepted(case: Case, path: StepPath, over: Array, search: _Search) -> None:
    """Take the path without terminal errors where the other constraints hold, with its
    withdrawals, which are proven where it would be the best path.
    """
    allowed = (case.limits.mouth_m or 0.0) if case.coarse else 0.0
    if not feasible(case, path, over.max(), allowed):
        return
    best = search.best
    if best is None or best.short_m > 0.0 or path.t_go_s < best.t_go_s:
        search.away = proven(case, path, search.away)
    elif search.away.short_m == 0.0:
        return
    away = search.away
    search.take(replace(path, escapes=away.escapes, short_m=away.short_m), TIME_TOLERANCE_S)


def _converged(
    case: Case,
    reference: ReferencePath,
    latest_s: float = math.inf,
    trust: float = TRUST,
    away: Withdrawn | None = None,
    first: bool = False,
) -> StepPath | None:
    """Iterate from a reference until the best feasible path seen no longer becomes better, and
    return it.

    The iterations end without a result where the end time remains later than ``latest_s``, and with
    the first safe path where ``first``. The first iteration requires ``away``, the
    withdrawals of an earlier path.
    """
    n = case.limits.nodes
    tolerance = ROUGH_TOLERANCE if case.coarse or first else RELATIVE_TOLERANCE
    reference = replace(reference, t=max(reference.t, case.earliest_s - case.wait_s))
    rows = () if away is None else away.rows
    search = _Search(Withdrawn(rows=rows), np.zeros((2 * n, len(CONSTRAINTS))))
    change = largest_change(case, reference, trust)
    last: StepPath | None = None
    for iteration in range(MOST_ITERATIONS):
        problem = convex_subproblem(case, reference, search.off, change, search.away.rows)
        if (found := solve(problem)) is None:
            break
        t = n * found.h
        path = StepPath(case.r0, case.v0, found.u, case.wait_s, case.wait_s + t)
        stuck, search.slack = found.slack > 0.9 * search.slack, found.slack
        path = last = _damped(case, path.ending_at(case.scene.goal), last, search)
        t, over = path.t_go_s - case.wait_s, excess(case, path)
        search.idle += 1
        if found.slack <= case.allowed_slack_m:
            _accepted(case, path, over, search)
        moved = abs(t - reference.t)
        if search.done(moved <= max(TIME_TOLERANCE_S, tolerance * t), first):
            break
        if _hopeless(case, search, path, iteration, latest_s, stuck):
            break
        search.tighten(over, case.buffer_m, moved <= NEAR_REFERENCE * t)
        reference = ReferencePath(t, path.at(case.wait_s + t * interval_fractions(n))[0])
        small = iteration >= 6
        change = max(0.5 * change, 1e-3) if small else largest_change(case, reference, trust)
    return search.best


def _damped(case: Case, path: StepPath, last: StepPath | None, search: _Search) -> StepPath:
    """Find the withdrawals from the solution of a programme, and return it, or its mean with the
    path of the last iteration where more of what is required is missing than from this mean.

    The margins of withdrawals are not linear in the path, so that the solutions alternate about
    paths that keep them.
    """
    tried = search.away.tried
    lacks = search.slack > case.buffer_m  # the programme cannot keep as much
    if lacks and tried is not None:
        tried = tried.loosened(search.slack)
    kept = tried is not None and not lacks
    search.away = withdrawn(case, path, tried, improve=lacks, kept=kept)
    if last is None or search.away.short_m <= 0.0:
        return path
    mean = StepPath(
        case.r0, case.v0, 0.5 * (path.u + last.u), case.wait_s, 0.5 * (path.t_go_s + last.t_go_s)
    ).ending_at(case.scene.goal)
    away = withdrawn(case, mean, tried, improve=False)
    if away.short_m >= search.away.short_m:
        return path
    search.away = away
    return mean


def _hopeless(
    case: Case,
    search: _Search,
    path: StepPath,
    iteration: int,
    latest_s: float,
    stuck: bool,
) -> bool:
    """Return whether the iterations end because the path remains too late or without a plan."""
    kept = search.slack <= case.buffer_m
    if case.entry is not None and kept and path.t_go_s - case.wait_s > latest_s:
        return True
    if path.t_go_s > case.params.horizon_s:
        return True
    late = path.t_go_s > (latest_s if iteration >= 3 else HOPELESS * latest_s)
    return iteration >= 1 and (late or (stuck and search.best is None and iteration >= STUCK))
