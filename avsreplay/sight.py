"""Between estimate and pilot: what is known after a scan, as a sight; flights held against the truth in hindsight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from avsreplay import geometry
from avsreplay.estimate import Estimator, Track
from avsreplay.geometry import Array, Pose
from avsreplay.plan import GuidanceState, Miss, Motion, PlannerInput, interpolated, miss
from avsreplay.plan.guidance import Segment
from avsreplay.records import Trajectory

__all__ = ["Aim", "Hindsight", "aim_columns", "plan_columns", "see"]


def see(estimator: Estimator, track: Track, t_ns: int, gamma: int, converged: bool, standoff_c: Array) -> PlannerInput:
    """What the pilot may know: never the truth. ``standoff_c`` (3,) is the approach point in {C} [m]."""
    belief = track.belief

    @cache
    def standoff() -> Trajectory:
        x = belief.x
        away = replace(x, c_b=x.c_b + geometry.matrix(x.q_bc) @ standoff_c)
        return estimator.motion(replace(belief, x=away))

    return PlannerInput(
        t_ns=t_ns,
        gamma=gamma,
        converged=converged,
        goal=estimator.motion(belief),
        forecast=lambda times_s: estimator.forecast(belief, times_s),
        standoff=lambda times_s: standoff()(times_s),
    )


class Hindsight:
    """Where the grasp point really was: the truth of the log, or a reference fitted to the whole of it."""

    def __init__(self, poses: Sequence[tuple[int, Pose]]) -> None:
        """Take true poses T_ac by instant, ascending; fewer than four tell nothing."""
        self._since_ns = poses[0][0] if poses else 0
        self._truth: Motion | None = None
        if len(poses) >= 4:
            times = np.array([(t_ns - self._since_ns) * 1e-9 for t_ns, _ in poses])
            self._truth = interpolated(times, [pose for _, pose in poses])

    def judge(self, leg: Segment, attitude: Array) -> Miss | None:
        """A leg against the truth at its end; ``attitude`` (4,) is the q_ac predicted for it. None beyond the truth."""
        if self._truth is None or leg.path is None:
            return None
        found = miss(leg.path, (leg.t_ns - self._since_ns) * 1e-9, self._truth, attitude)
        return found if np.isfinite(found.distance_m) else None


@dataclass(frozen=True, slots=True, eq=False)
class Aim:
    """The leg that closes in on the target, and what hindsight says of it."""

    leg: Segment | None = None
    miss: Miss | None = None

    def follow(self, pilot: GuidanceState, estimator: Estimator, track: Track, hindsight: Hindsight) -> Aim:
        """The aim after a scan: judged anew when the pilot has set out on another leg to the grasp point."""
        leg, plan = pilot.segment, pilot.plan
        if leg is self.leg or leg.path is None or plan is None or plan.t_ns != track.belief.t_ns:
            return self
        predicted = estimator.predict(track, leg.end_ns).belief.x.T_ac.q
        return Aim(leg, hindsight.judge(leg, predicted))


def plan_columns(pilot: GuidanceState, since_ns: int, t_ns: int) -> dict[str, Any]:
    """The row's columns on plan and supervisor."""
    fields: dict[str, Any] = {"action": pilot.decision.action.value, "rule": pilot.decision.rule}
    plan = pilot.plan
    if plan is None:
        return fields
    made_s = (plan.t_ns - since_ns) * 1e-9
    fields |= {"plan_status": plan.status.value, "plan_bound_s": made_s + plan.lower_bound_s}
    if plan.found:
        fields |= {"capture_time_s": made_s + plan.t_go_s, "t_go_s": plan.t_go_s - (t_ns - plan.t_ns) * 1e-9}
    return fields


def aim_columns(before: Aim, after: Aim, closed: bool) -> dict[str, Any]:
    """Hindsight on a leg set out on at this scan, and on the capture where the gripper has closed since the last."""
    fields: dict[str, Any] = {}
    if after is not before and after.miss is not None:
        fields |= _named("hindsight", after.miss)
    if closed and before.miss is not None:
        fields |= _named("capture_miss", before.miss)
    return fields


def _named(prefix: str, found: Miss) -> dict[str, float]:
    values = {"m": found.distance_m, "mps": found.speed_mps, "deg": found.angle_deg}
    return {f"{prefix}_{unit}": float(value) for unit, value in values.items() if np.isfinite(value)}
