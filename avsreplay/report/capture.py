"""What came of planning: instants of capture, their spread, hindsight, the closed gripper."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from avsreplay.report.spread import Spread
from avsreplay.rows import Row

__all__ = ["Capture", "CaptureFold", "Miss"]


@dataclass(frozen=True, slots=True)
class Miss:
    """Where the true grasp point was when the gripper closed: distance, relative speed, attitude error."""

    position_m: float
    speed_mps: float | None
    rotation_deg: float | None


@dataclass(frozen=True, slots=True)
class Capture:
    """Planned instants of capture, since the first scan; a replan is a row where the plan differs from the one before.

    Attributes:
        last_s, first_s: of the last and the first plan.  std_s, range_s: over all replans.
        status: the planner's last word.
        hindsight_m: by how much each plan, flown as made, would have missed the true grasp point.
        miss: of the closed gripper, None where it never closed or truth is not known.
        actions: scans under each of the supervisor's actions.
    """

    replans: int
    first_s: float | None
    last_s: float | None
    std_s: float | None
    range_s: float | None
    status: str | None
    hindsight_m: Spread | None = None
    miss: Miss | None = None
    actions: Mapping[str, int] = field(default_factory=dict)


class CaptureFold:
    """Takes rows one by one."""

    def __init__(self) -> None:
        self._plans: list[tuple[str | None, float | None]] = []
        self._hindsight: list[float] = []
        self._actions: Counter[str] = Counter()
        self._miss: Miss | None = None

    def add(self, row: Row) -> None:
        """Take the next row."""
        plan = (row.plan_status, row.capture_time_s)
        if plan != (None, None) and (not self._plans or plan != self._plans[-1]):
            self._plans.append(plan)
        if row.hindsight_m is not None:
            self._hindsight.append(row.hindsight_m)
        if row.action:
            self._actions[row.action] += 1
        if row.capture_miss_m is not None:
            self._miss = Miss(row.capture_miss_m, row.capture_miss_mps, row.capture_miss_deg)

    def result(self) -> Capture:
        """What the rows so far came to."""
        times = [t for _, t in self._plans if t is not None]
        spread = Spread.of(times)
        return Capture(
            replans=len(times),
            first_s=times[0] if times else None,
            last_s=times[-1] if times else None,
            std_s=spread.std if spread else None,
            range_s=spread.max - spread.min if spread else None,
            status=self._plans[-1][0] if self._plans else None,
            hindsight_m=Spread.of(self._hindsight),
            miss=self._miss,
            actions=dict(sorted(self._actions.items())),
        )
