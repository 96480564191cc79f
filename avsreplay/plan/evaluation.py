"""Evaluation of plans and of whole approaches against ground truth.

``Motion`` is the ground truth, or a reference fitted to the whole log, as a function of time. Guidance has no access
to it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array
from avsreplay.plan.guidance import Guidance, GuidanceState, PlannerInput
from avsreplay.plan.path import RobotPath
from avsreplay.plan.supervisor import Action

Motion = Callable[[Array], tuple[Array, Array, Array]]
"""Instants (n,) [s, on the log's clock] -> positions (n, 3), velocities (n, 3), attitudes (n, 4) of {C} in {A}."""


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Largest position error, relative speed and attitude error of a successful capture."""

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
    """Error of a plan at its planned end against ground truth.

    Attributes:
        lead_s: Time between planning and the planned end [s].
        at_s: Planned end [s].
        distance_m, speed_mps: Distance and relative speed between robot and true grasp point.
        angle_deg: Angle between predicted and true attitude of the fixture, NaN where unknown.
    """

    lead_s: float
    at_s: float
    distance_m: float
    speed_mps: float
    angle_deg: float

    def inside(self, tolerance: Tolerance) -> bool:
        """Return whether the errors are within the tolerance; an unknown angle is accepted.

        Args:
            tolerance: Largest errors of a successful capture.
        """
        angle = math.isnan(self.angle_deg) or self.angle_deg <= tolerance.angle_deg
        return self.distance_m <= tolerance.position_m and self.speed_mps <= tolerance.speed_mps and angle


@dataclass(frozen=True, slots=True, eq=False)
class Execution:
    """Result of a simulated approach.

    Attributes:
        captured: Whether the gripper closed.
        miss: Error against ground truth when it closed.
        actions: (t_s, action, rule) at every change.
        ended: Last action.
    """

    captured: bool
    miss: Miss | None
    actions: tuple[tuple[float, str, str], ...]
    ended: Action

    def outcome(self, tolerance: Tolerance) -> str:
        """Return ``captured``, ``outside`` (closed outside the tolerance) or the last action.

        Args:
            tolerance: Largest errors of a successful capture.
        """
        if self.captured and self.miss is not None:
            return "captured" if self.miss.inside(tolerance) else "outside"
        return self.ended.value


def miss(path: RobotPath, t_s: float, truth: Motion, attitude: Array | None = None) -> Miss:
    """Compare the end of a path with ground truth.

    Args:
        path: Path of the robot.
        t_s: Begin of the path on the clock of ``truth`` [s].
        truth: True motion of the fixture.
        attitude: (4,) predicted q_ac at the end, None where unknown.
    """
    position, velocity = path.at(np.array([path.t_go_s]))
    return _miss_at(t_s + path.t_go_s, path.t_go_s, position[0], velocity[0], truth, attitude)


def _miss_at(at_s: float, lead_s: float, r: Array, v: Array, truth: Motion, attitude: Array | None) -> Miss:
    rho, rate, q = truth(np.array([at_s]))
    turn = math.nan
    if attitude is not None:
        turn = math.degrees(float(geometry.angle(geometry.multiply(geometry.conjugate(q[0]), attitude))))
    return Miss(lead_s, at_s, float(np.linalg.norm(rho[0] - r)), float(np.linalg.norm(rate[0] - v)), turn)


def closed_miss(state: GuidanceState, since_ns: int, truth: Motion, attitude: Array | None = None) -> Miss:
    """Return the error when the gripper closes, at the end of the current segment.

    Args:
        state: State of a guidance whose action is ``capture``.
        since_ns: Instant from which ``truth`` counts its seconds.
        truth: True motion of the fixture.
        attitude: (4,) q_ac of the gripper.
    """
    end_ns = state.segment.end_ns
    made_ns = end_ns if state.plan is None else state.plan.t_ns
    r, v = state.segment.at(end_ns)
    return _miss_at((end_ns - since_ns) * 1e-9, (end_ns - made_ns) * 1e-9, r, v, truth, attitude)


def execute(
    guidance: Guidance,
    inputs: Iterable[PlannerInput],
    truth: Motion,
    attitude: Callable[[PlannerInput, float], Array] | None = None,
    since_ns: int = 0,
) -> Execution:
    """Simulate an approach: guidance receives one input after the other, ground truth decides the result.

    Args:
        guidance: Guidance of the robot.
        inputs: What was known after each scan.
        truth: True motion of the fixture.
        attitude: Returns the q_ac (4,) that an input predicts for a time after it [s], the attitude of the gripper.
        since_ns: Instant from which ``truth`` counts its seconds.

    Raises:
        ValueError: There is no input.
    """
    changes: list[tuple[float, str, str]] = []
    state: GuidanceState | None = None
    committed: PlannerInput | None = None
    for known, state in guidance.fly(inputs):
        decided = (state.decision.action.value, state.decision.rule)
        if not changes or changes[-1][1:] != decided:
            changes.append(((known.t_ns - since_ns) * 1e-9, *decided))
        if state.decision.action is Action.CAPTURE and committed is None:
            committed = known
        if state.captured_ns is not None:
            break
    if state is None:
        raise ValueError("the log contains no scan")
    action = state.decision.action
    if committed is None or action is not Action.CAPTURE:
        return Execution(False, None, tuple(changes), action)
    turned = attitude(committed, (state.segment.end_ns - committed.t_ns) * 1e-9) if attitude else None
    return Execution(True, closed_miss(state, since_ns, truth, turned), tuple(changes), action)


def interpolated(times_s: Array, poses: Sequence[geometry.Pose]) -> Motion:
    """Interpolate recorded poses: cubic spline for the position, constant angular rate between attitudes.

    Args:
        times_s: (n,) ascending times [s], n >= 4.
        poses: n poses T_ac.

    Returns:
        A motion that is NaN outside the recorded times.

    Raises:
        ValueError: There are too few poses, or the times do not ascend.
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


def wilson(successes: int, count: int) -> tuple[float, float]:
    """Return the Wilson 95 % interval of a fraction.

    Args:
        successes: Number of successes.
        count: Number of trials, at least 1.
    """
    z2 = 1.96**2
    centre = (successes + 0.5 * z2) / (count + z2)
    half = 1.96 / (count + z2) * math.sqrt(successes * (count - successes) / count + 0.25 * z2)
    return max(centre - half, 0.0), min(centre + half, 1.0)
