"""Whole flights in a closed loop: replanning, errors of the thrust, the delay of the planner, and a true target."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array
from avsreplay.plan.evaluation import Miss, Tolerance, wilson
from avsreplay.plan.guidance import Guidance, GuidanceState, PlannerInput, Segment
from avsreplay.plan.limits import Scene, margins
from avsreplay.plan.path import CostatePath, StepPath
from avsreplay.plan.robot import Limits
from avsreplay.plan.supervisor import Action


@dataclass(frozen=True, slots=True)
class Flights:
    """Results of whole flights with replanning.

    Attributes:
        count: Number of flights.
        captured: Number of captures inside the tolerance.
        outside: Number of captures outside it.
        aborted: Number of flights that ended in an abort.
        touched: Number of flights in which the end-effector touched the body outside the corridor.
    """

    count: int
    captured: int
    outside: int
    aborted: int
    touched: int

    def share(self, name: str) -> tuple[float, float, float]:
        """Return a fraction of the flights and its Wilson 95 % interval.

        Args:
            name: Name of one of the numbers.
        """
        number = int(getattr(self, name))
        return (number / self.count, *wilson(number, self.count))

    def described(self) -> list[tuple[str, str]]:
        """Return the figures as a name and a text."""
        parts = []
        for name in ("captured", "outside", "aborted", "touched"):
            share, low, high = self.share(name)
            parts.append(f"{name} {share:.3f} (95 % {low:.3f} to {high:.3f})")
        return [(f"{self.count} whole flights", "; ".join(parts))]


def pushed(segment: Segment, t_ns: int, dr: Array, dv: Array) -> Segment:
    """Return the segment of a robot that has left its path: from t_ns on it flies the same thrust from its own state.

    Args:
        segment: What the robot flies.
        t_ns: Instant of the deviation.
        dr: (3,) deviation of the position [m].
        dv: (3,) deviation of the velocity [m/s].
    """
    since_s = (t_ns - segment.t_ns) * 1e-9
    r0, v0 = segment.r0 + dr - since_s * dv, segment.v0 + dv
    path = segment.path
    if isinstance(path, (CostatePath, StepPath)):
        path = replace(path, r0=r0, v0=v0)
    previous = None if segment.previous is None else pushed(segment.previous, t_ns, dr, dv)
    return replace(segment, r0=r0, v0=v0, path=path, previous=previous)


def with_thrust_error(
    segment: Segment, t_ns: int, span_s: float, sigma_mps2: float, rng: np.random.Generator
) -> Segment:
    """Return the segment of a robot whose thrust was wrong since the last scan; a coasting robot has no error.

    Args:
        segment: What the robot flies.
        t_ns: Instant of the present scan.
        span_s: Time since the last one [s], during which the error was constant.
        sigma_mps2: 1 sigma of the error of each axis, as its mean over 1 s [m/s2].
        rng: Random generator.
    """
    if segment.path is None or sigma_mps2 == 0.0 or span_s <= 0.0:
        return segment
    u = sigma_mps2 / math.sqrt(span_s) * rng.standard_normal(3)
    return pushed(segment, t_ns, 0.5 * span_s * span_s * u, span_s * u)


def closed_loop(
    guidance: Guidance,
    inputs: Iterable[PlannerInput],
    target: Scene,
    start_ns: int,
    tolerance: Tolerance,
    noise_mps2: float = 0.0,
    rng: np.random.Generator | None = None,
    body: Limits | None = None,
) -> tuple[str, bool]:
    """Fly one approach with replanning, errors of the thrust and the delay of the planner.

    Args:
        guidance: Guidance of the robot.
        inputs: What is known after each scan, in the order of the scans.
        target: The true target.
        start_ns: Instant from which its times count.
        tolerance: Largest errors of a capture.
        noise_mps2: 1 sigma of the acceleration error of each axis, as its mean over 1 s [m/s2]; it is constant between
            two scans and independent from one interval to the next.
        rng: Random generator of these errors; needed where they are not zero.
        body: Limits whose clearance is the radius of the end-effector; None: contact is not checked.

    Returns:
        ``captured``, ``outside`` or the last action, and whether the end-effector touched the body.

    Raises:
        ValueError: There is no scan.
    """
    state: GuidanceState | None = None
    aimed: Array | None = None
    last_ns, touched = start_ns, False
    for known in inputs:
        if state is None:
            state, last_ns = guidance.initial(known.t_ns), known.t_ns
        span = (known.t_ns - last_ns) * 1e-9
        touched |= body is not None and _touched(target, body, state.segment, start_ns, last_ns, known.t_ns)
        if rng is not None:
            state = replace(state, segment=with_thrust_error(state.segment, known.t_ns, span, noise_mps2, rng))
        state, last_ns = guidance.step(state, known), known.t_ns
        if state.decision.action is Action.CAPTURE and aimed is None and known.scene.attitude is not None:
            aimed = known.scene.attitude(np.array([(state.segment.end_ns - known.t_ns) * 1e-9]))[0]
        if state.captured_ns is not None or state.decision.action is Action.ABORT:
            break
    if state is None:
        raise ValueError("there is no scan")
    if state.captured_ns is None:
        return state.decision.action.value, touched
    end_s = (state.segment.end_ns - start_ns) * 1e-9
    r, v = state.segment.at(state.segment.end_ns)
    rho, rate = target.goal(np.array([end_s]))
    turn = math.nan
    if aimed is not None and target.attitude is not None:
        true = geometry.conjugate(target.attitude(np.array([end_s]))[0])
        turn = math.degrees(float(geometry.angle(geometry.multiply(true, aimed))))
    found = Miss(0.0, end_s, float(np.linalg.norm(rho[0] - r)), float(np.linalg.norm(rate[0] - v)), turn)
    return ("captured" if found.inside(tolerance) else "outside"), touched


def _touched(scene: Scene, body: Limits, segment: Segment, start_ns: int, begin_ns: int, end_ns: int) -> bool:
    """Return whether the end-effector touches the body outside the corridor between two scans, at ten instants."""
    instants = np.linspace(begin_ns, end_ns, 10, endpoint=False).astype(np.int64)
    r = np.array([segment.at(int(t))[0] for t in instants if segment.path is None or t <= segment.end_ns])
    if not len(r) or scene.attitude is None or scene.surface is None:
        return False
    times = np.asarray((instants[: len(r)] - start_ns) * 1e-9, dtype=np.float64)
    R = geometry.matrix(scene.attitude(times))
    y = np.einsum("nij,ni->nj", R, r - scene.goal(times)[0])
    return bool(margins(scene, body, y, r).values[:, 3].min() < 0.0)
