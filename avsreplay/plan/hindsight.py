"""What the capture would have been: plans and flights held against where the grasp point really was.

``Motion`` is the truth, or a reference fitted to the whole log, as a function of the instant; nothing here is known to
the pilot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array
from avsreplay.plan.flight import Path
from avsreplay.plan.pilot import Pilot, PilotMemory, Sight
from avsreplay.plan.supervisor import Action

__all__ = ["Execution", "Miss", "Motion", "Tolerance", "closed_miss", "execute", "interpolated", "miss"]

Motion = Callable[[Array], tuple[Array, Array, Array]]
"""Instants (n,) [s, on the log's clock] -> positions (n, 3), velocities (n, 3), attitudes (n, 4) of {C} in {A}."""


@dataclass(frozen=True, slots=True)
class Tolerance:
    """What still counts as a capture."""

    position_m: float = 0.02
    speed_mps: float = 0.01
    angle_deg: float = 2.0

    def __post_init__(self) -> None:
        for name in ("position_m", "speed_mps", "angle_deg"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}, must be a finite number above 0")


@dataclass(frozen=True, slots=True)
class Miss:
    """One plan against the truth at its planned instant.

    Attributes:
        lead_s: how early the plan was made.  at_s: the planned instant.
        distance_m, speed_mps: of robot and true grasp point.  angle_deg: planned against true attitude, NaN without.
    """

    lead_s: float
    at_s: float
    distance_m: float
    speed_mps: float
    angle_deg: float

    def inside(self, tolerance: Tolerance) -> bool:
        """Would it have been a capture? An unknown angle does not speak against it."""
        angle = math.isnan(self.angle_deg) or self.angle_deg <= tolerance.angle_deg
        return self.distance_m <= tolerance.position_m and self.speed_mps <= tolerance.speed_mps and angle


@dataclass(frozen=True, slots=True, eq=False)
class Execution:
    """A simulated execution.

    Attributes:
        captured: did the gripper close.  miss: against the truth when it did.
        actions: (t_s, action, rule) at every change.  ended: last action.
    """

    captured: bool
    miss: Miss | None
    actions: tuple[tuple[float, str, str], ...]
    ended: Action

    def outcome(self, tolerance: Tolerance) -> str:
        """In one word: ``captured``, ``outside`` (closed outside the tolerance), or the last action."""
        if self.captured and self.miss is not None:
            return "captured" if self.miss.inside(tolerance) else "outside"
        return self.ended.value


def miss(flight: Path, t_s: float, truth: Motion, attitude: Array | None = None) -> Miss:
    """A flight begun at ``t_s`` against the truth at its end; ``attitude`` (4,) is the planned q_ac there."""
    position, velocity = flight.at(np.array([flight.t_go_s]))
    return _miss_at(t_s + flight.t_go_s, flight.t_go_s, position[0], velocity[0], truth, attitude)


def _miss_at(at_s: float, lead_s: float, r: Array, v: Array, truth: Motion, attitude: Array | None) -> Miss:
    rho, rate, q = truth(np.array([at_s]))
    turn = math.nan
    if attitude is not None:
        turn = math.degrees(float(geometry.angle(geometry.multiply(geometry.conjugate(q[0]), attitude))))
    return Miss(lead_s, at_s, float(np.linalg.norm(rho[0] - r)), float(np.linalg.norm(rate[0] - v)), turn)


def closed_miss(memory: PilotMemory, since_ns: int, truth: Motion, attitude: Array | None = None) -> Miss:
    """The miss when the gripper closes, at the end of the leg that was committed to.

    Args:
        memory: of a pilot whose action is ``capture``.
        since_ns: instant that the truth counts its seconds from.
        truth: where the grasp point really was.
        attitude: (4,) q_ac that the gripper is turned to.
    """
    end_ns = memory.leg.end_ns
    made_ns = end_ns if memory.plan is None else memory.plan.t_ns
    r, v = memory.leg.at(end_ns)
    return _miss_at((end_ns - since_ns) * 1e-9, (end_ns - made_ns) * 1e-9, r, v, truth, attitude)


def execute(
    pilot: Pilot,
    sights: Iterable[Sight],
    truth: Motion,
    attitude: Callable[[Sight, float], Array] | None = None,
    since_ns: int = 0,
) -> Execution:
    """Fly the log: the pilot sees one sight after another, the truth judges the end.

    Args:
        pilot: who flies.
        sights: what was known after each scan.
        truth: where the grasp point really was.
        attitude: the q_ac (4,) a sight predicts for a time after it [s]; what the gripper is turned to.
        since_ns: instant that the truth counts its seconds from.

    Raises:
        ValueError: there is no sight.
    """
    changes: list[tuple[float, str, str]] = []
    memory: PilotMemory | None = None
    committed: Sight | None = None
    for sight, memory in pilot.fly(sights):
        decided = (memory.decision.action.value, memory.decision.rule)
        if not changes or changes[-1][1:] != decided:
            changes.append(((sight.t_ns - since_ns) * 1e-9, *decided))
        if memory.decision.action is Action.CAPTURE and committed is None:
            committed = sight
        if memory.captured_ns is not None:
            break
    if memory is None:
        raise ValueError("there is no scan to fly by")
    action = memory.decision.action
    if committed is None or action is not Action.CAPTURE:
        return Execution(False, None, tuple(changes), action)
    turned = attitude(committed, (memory.leg.end_ns - committed.t_ns) * 1e-9) if attitude else None
    return Execution(True, closed_miss(memory, since_ns, truth, turned), tuple(changes), action)


def interpolated(times_s: Array, poses: Sequence[geometry.Pose]) -> Motion:
    """A motion through recorded poses: a cubic spline and its derivative, turns at constant rate between.

    Args:
        times_s: (n,) ascending instants [s], n >= 4.
        poses: n poses T_ac.

    Raises:
        ValueError: too few poses, or instants that do not ascend.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, Slerp

    times = np.asarray(times_s, dtype=np.float64)
    if len(times) < 4 or len(times) != len(poses) or np.any(np.diff(times) <= 0.0):
        raise ValueError(f"{len(poses)} poses at {len(times)} instants, must be at least 4 at ascending instants")
    line = CubicSpline(times, np.array([p.t for p in poses]))
    turn = Slerp(times, Rotation.from_quat(np.array([p.q for p in poses])))

    def at(instants: Array) -> tuple[Array, Array, Array]:
        inside = (instants >= times[0]) & (instants <= times[-1])
        position, velocity = line(instants), line(instants, 1)
        attitude = turn(np.clip(instants, times[0], times[-1])).as_quat()
        for values in (position, velocity, attitude):
            values[~inside] = np.nan
        return position, velocity, attitude

    return at
