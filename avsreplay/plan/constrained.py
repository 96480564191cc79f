"""The least time under limits: fixed end times are cone programmes, the end time is searched for.

The unconstrained least time is a certified lower bound. From it the search goes up by stated steps, on a coarse grid,
to the first end time whose least thrust a*(t) does not pass a_max, and then down into that step by false position on
the fine one. Limits that turn with the target leave no body that shrinks with time, so nothing certifies the times
between two steps: such a plan is ``feasible``, and its ``lower_bound_s`` and ``scan_s`` say how far. Where no limit
acts the two times agree and the plan is ``optimal``.
A plan is checked between its nodes too; what sticks out there is taken off the limit at the nodes around.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from avsreplay.geometry import Array
from avsreplay.plan.cone_programme import ConeConstraint, ConeProgramme, HalfSpaces, solve
from avsreplay.plan.limits import Limits, SampledScene, Scene
from avsreplay.plan.path import StepPath
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.records import Plan, PlanStatus

if TYPE_CHECKING:
    from collections.abc import Sequence

BETWEEN = 8  # instants a thrust interval is checked at
VIOLATION_M = 5e-7  # what may stick out of a limit [m]
PASSES = 8  # solve, check, tighten
COARSE = 4  # the scan's intervals are this many times longer
CLEARLY_SHORT = 1.02  # thrust needed in units of a_max that no further pass can bring below 1
SAME_TIME_S = 1e-3  # closer than this to the lower bound no limit acts: the intervals alone make the difference
THRUST_TOLERANCE = 1e-7  # of a_max
_CONES = np.array([[True], [True], [False]])


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """What one end time teaches the next: which nodes each limit holds at, and how much is taken off there.

    Attributes:
        active: (3, n + 1) cone, last metres, sphere.  off: (3, n + 1) [m].
        slack: what may stick out [m].  path: (n + 1, 3) last positions, None at first.
    """

    active: Array
    off: Array
    slack: float
    path: Array | None = None

    @classmethod
    def nothing(cls, n: int, slack: float) -> _Known:
        """Over n intervals, before anything was tried."""
        return cls(np.zeros((3, n + 1), dtype=bool), np.zeros((3, n + 1)), slack)


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """Everything that does not change with the end time."""

    scene: Scene
    sampled: SampledScene
    limits: Limits
    params: PlanParams
    r0: Array
    v0: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """One end time. ``thrust`` is the least bound, infinite where the limits cannot be met or were not in time."""

    t: float
    thrust: float
    flight: StepPath | None
    known: _Known


def constrained(
    scene: Scene, r0: Array, v0: Array, params: PlanParams, limits: Limits, t_ns: int = 0, extent_m: float = 8.0
) -> Plan:
    """Plan under limits. Lengths left out of them are taken from the target's extent.

    Args:
        scene: grasp point, fixture axis and mass centre after t_ns.
        r0: (3,) robot in {A} at t_ns [m].
        v0: (3,) its velocity [m/s].
        params: see PlanParams.
        limits: see Limits.
        t_ns: instant of planning.
        extent_m: bounding diagonal of the target [m].

    Returns:
        Plan with ``thrust`` (n, 3) and ``violation_m``; its costate is NaN.

    Raises:
        ValueError: naming a value that cannot be right, or what the scene does not know.
    """
    limits = limits.resolved(extent_m)
    scene.check(limits)
    free = rendezvous(scene.goal, r0, v0, params, t_ns)
    if not free.found or free.t_go_s - params.latency_s <= 0.0:
        return free
    case = _Case(scene, SampledScene(scene, params.horizon_s, params.grid_s), limits, params, r0, v0)
    found = _search(case, free.t_go_s - params.latency_s)
    return _plan(case, free, found, t_ns)


def _plan(case: _Case, free: Plan, found: _Trial | None, t_ns: int) -> Plan:
    nan, none = math.nan, np.full(6, math.nan)
    if found is None or found.flight is None:
        status = PlanStatus.INFEASIBLE
        return Plan(t_ns, status, nan, none, free.a_max, free.lower_bound_s, nan, nan, nan)
    path = found.flight
    same = path.t_go_s - free.lower_bound_s <= SAME_TIME_S
    position, velocity = path.terminal_errors(case.scene.goal)
    return Plan(
        t_ns=t_ns,
        status=PlanStatus.OPTIMAL if same and case.limits.keepout_m is None else PlanStatus.FEASIBLE,
        t_go_s=path.t_go_s,
        costate=none,
        a_max=free.a_max,
        lower_bound_s=free.lower_bound_s,
        position_error_m=position,
        velocity_error_mps=velocity,
        u_max=path.u_max(),
        latency_s=path.latency_s,
        thrust=path.u,
        violation_m=float(max(v.max() for v in violations(case.sampled, case.limits, path))),
    )


def _search(case: _Case, t: float) -> _Trial | None:
    """Up from t by steps to the first end time that thrust suffices for, then down into the last step."""
    low = _try(case, t, _Known.nothing(case.limits.nodes, VIOLATION_M))
    if _suffices(case, low):
        return low
    for _ in range(4):  # hardly short: the limits, or the intervals alone, cost little
        if low.thrust >= CLEARLY_SHORT * case.params.a_max_mps2:
            break
        high = _try(case, low.t + _stride(low, case), low.known)
        if _suffices(case, high):
            return _close_in(case, low, high)
        low = high
    below = _scan(case, t)
    return None if below is None else _refine(case, *below, t)


def _suffices(case: _Case, trial: _Trial) -> bool:
    return trial.thrust <= case.params.a_max_mps2 * (1.0 + THRUST_TOLERANCE)


def _scan(case: _Case, t: float) -> tuple[float, float] | None:
    """The first step of the coarse scan that ends with enough thrust: its two ends."""
    end = case.params.horizon_s - case.params.latency_s
    known = _Known.nothing(max(case.limits.nodes // COARSE, 8), 0.5 * (case.limits.mouth_m or 0.0))
    low = _try(case, t, known)
    while low.t < end:
        known = replace(low.known, active=low.known.active * _CONES)  # where one path met the sphere another may not
        high = _try(case, min(low.t + case.limits.scan_s, end), known)
        if _suffices(case, high):
            return low.t, high.t
        low = high
    return None


def _refine(case: _Case, low_t: float, high_t: float, least: float) -> _Trial | None:
    """The same step on the fine grid, moved by whole steps where the two grids do not agree."""
    end, step = case.params.horizon_s - case.params.latency_s, case.limits.scan_s
    high = _try(case, high_t, _Known.nothing(case.limits.nodes, VIOLATION_M))
    while not _suffices(case, high):
        if high.t >= end:
            return None
        low_t, high = high.t, _try(case, min(high.t + step, end), high.known)
    low = _try(case, low_t, high.known)
    while _suffices(case, low) and low.t > least:
        high, low = low, _try(case, max(low.t - step, least), low.known)
    return low if _suffices(case, low) else _close_in(case, low, high)


def _stride(low: _Trial, case: _Case) -> float:
    """At most the stated step; less where a target at rest would be met before (thrust falls as 1/t^2)."""
    if not math.isfinite(low.thrust):
        return case.limits.scan_s
    short = low.thrust / case.params.a_max_mps2 - 1.0
    return min(case.limits.scan_s, max(low.t * short, 1e-4))


def _close_in(case: _Case, low: _Trial, high: _Trial) -> _Trial:
    """False position on log(a*/a_max); ``high`` always suffices."""
    a_max, side = case.params.a_max_mps2, 1.0
    for _ in range(12):
        if high.thrust >= a_max * (1.0 - 1e-5) or high.t - low.t <= 1e-5:
            break
        f_high = math.log(high.thrust / a_max)
        f_low = math.log(low.thrust / a_max) * side if math.isfinite(low.thrust) else -f_high
        share = min(max(f_low / (f_low - f_high), 0.05), 0.98)
        tried = _try(case, low.t + share * (high.t - low.t), high.known)
        if _suffices(case, tried):
            high, side = tried, 0.5 * side
        else:
            low, side = tried, 1.0
    return high


def _try(case: _Case, t: float, known: _Known) -> _Trial:
    """The least thrust for one end time, with nothing sticking out between nodes."""
    wait, n = case.params.latency_s, known.active.shape[1] - 1
    rho, rate = case.scene.goal(np.array([wait + t, wait + t - 1e-4]))
    start = case.r0 + wait * case.v0
    base = ConeProgramme(t, n, start, case.v0, rho[0], rate[0], case.limits.speed_max_mps)
    if case.limits.contact_accel_mps2 is not None:
        base = replace(base, contact=((rate[0] - rate[1]) / 1e-4, case.limits.contact_accel_mps2))
    nodes = case.sampled.at(wait + np.linspace(0.0, t, n + 1))
    for _ in range(PASSES):
        funnels, walls = _limits_at(case.limits, nodes, known)
        found = solve(replace(base, funnels=funnels, walls=walls))
        if found is None:
            return _Trial(t, math.inf, None, known)
        if found[0] > CLEARLY_SHORT * case.params.a_max_mps2:  # a limit added can only ask for more
            return _Trial(t, found[0], None, known)
        flight = StepPath(case.r0, case.v0, found[1], wait, wait + t)
        out = violations(case.sampled, case.limits, flight)
        known = _learn(known, out, flight.nodes()[0])
        if max(v.max() for v in out) <= known.slack:
            return _Trial(t, found[0], flight, known)
    return _Trial(t, math.inf, None, known)


def _limits_at(
    limits: Limits, nodes: tuple[Array, Array, Array], known: _Known
) -> tuple[tuple[ConeConstraint, ...], tuple[HalfSpaces, ...]]:
    apex, axis, centre = nodes
    mouth = limits.mouth_m or 0.0
    funnels = []
    for row, degrees in enumerate((limits.cone_deg, limits.final_deg)):
        k = np.flatnonzero(known.active[row])
        if degrees is not None and len(k):
            slope = math.tan(math.radians(degrees))
            funnels.append(ConeConstraint(k, apex[k], axis[k], slope, mouth - known.off[row, k]))
    k = np.flatnonzero(known.active[2])
    if limits.keepout_m is None or known.path is None or not len(k):
        return tuple(funnels), ()
    out = known.path[k] - centre[k]
    normal = out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)
    offset = limits.keepout_m + known.off[2, k] + np.sum(normal * centre[k], axis=1)
    return tuple(funnels), (HalfSpaces(k, normal, offset),)


def violations(scene: SampledScene, limits: Limits, flight: StepPath) -> Sequence[Array]:
    """What sticks out of cone, last metres and sphere [m], each (n * 8 + 1,) over the flight, 0 inside."""
    n = len(flight.u)
    times = np.linspace(flight.latency_s, flight.t_go_s, BETWEEN * n + 1)
    r, _ = flight.at(times)
    apex, axis, centre = scene.at(times)
    from_apex = r - apex
    distance = np.linalg.norm(from_apex, axis=1)
    stride = float(np.abs(np.diff(distance)).max())  # a limit begins somewhere between two instants: take the earlier
    along = np.sum(from_apex * axis, axis=1)
    across = np.linalg.norm(from_apex - along[:, None] * axis, axis=1)
    zero = np.zeros(len(times))
    out = [zero, zero, zero]
    for i, degrees, reach in ((0, limits.cone_deg, limits.cone_range_m), (1, limits.final_deg, limits.final_range_m)):
        if degrees is not None:
            excess = across - math.tan(math.radians(degrees)) * along - (limits.mouth_m or 0.0)
            out[i] = np.where(distance <= (reach or math.inf) + stride, np.maximum(excess, 0.0), 0.0)
    if limits.keepout_m is not None:
        inside = limits.keepout_m - np.linalg.norm(r - centre, axis=1)
        out[2] = np.where(distance > (limits.keepout_release_m or 0.0) - stride, np.maximum(inside, 0.0), 0.0)
    return out


def _learn(known: _Known, out: Sequence[Array], path: Array) -> _Known:
    """Put the limit on, and take off it what stuck out, at the nodes round every violation."""
    active, off = known.active.copy(), known.off.copy()
    n = active.shape[1] - 1
    for row, values in enumerate(out):
        cell = values[1:].reshape(n, BETWEEN).max(axis=1)
        worst = np.maximum(np.concatenate([cell[:1], cell]), np.concatenate([cell, cell[-1:]]))
        touched = worst > 0.0
        touched[0] = False  # where the robot is when it plans cannot be changed
        bound = np.where(active[row, 1:] & (active[row, :-1] | (np.arange(n) == 0)), cell, 0.0)  # held at both ends
        sag = np.maximum(np.concatenate([bound[:1], bound]), np.concatenate([bound, bound[-1:]]))
        off[row] += np.where(sag > 0.0, 1.2 * sag + 0.2 * known.slack, 0.0)
        active[row] |= touched
    return _Known(active, off, known.slack, path)
