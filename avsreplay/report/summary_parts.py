"""Parts of the summary of a run: statistics of numbers, manoeuvres, planning.

Sums are correctly rounded, so that a statistic does not depend on the order of its values.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field
from itertools import groupby
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from avsreplay.errors import value_class
from avsreplay.rows import Row
from avsreplay.tables import column_of

# changes of the velocity from which a motion is not called free: a free target is pushed, or
# manoeuvres, once or twice in a log; one that is towed, on a cable or in strong drag changes always
_LEAST_DRIVEN_CHANGES = 3
SAME_EVENT_S = 2.0  # between the time of a manoeuvre in the rows and by all poses


@value_class(eq=True)
class VelocityChange:
    """A manoeuvre of the target as last reported: instant since the first scan and size, with 1
    sigma.

    Attributes:
        reported_s: instant of the first scan that reports it, since the first scan.
    """

    reported_s: float
    t_s: float
    t_1s_s: float
    velocity_mps: float
    velocity_1s_mps: float
    rate_radps: float
    rate_1s_radps: float

    COLUMNS: ClassVar = (
        *("manoeuvres", "t_s", "manoeuvre_s", "manoeuvre_1s_s"),
        *("manoeuvre_mps", "manoeuvre_1s_mps", "manoeuvre_radps", "manoeuvre_1s_radps"),
    )

    @classmethod
    def of(cls, taken: Mapping[str, Sequence[Any]]) -> tuple[VelocityChange, ...]:
        """Return the manoeuvres that the rows of a run report: each row counts them and describes
        the last one.

        Args:
            taken: the values of ``COLUMNS`` in all rows.
        """
        found: list[tuple[int, int]] = []  # the first and the last row that describe each manoeuvre
        for k, (count, instant) in enumerate(
            zip(taken["manoeuvres"], taken["manoeuvre_s"], strict=True)
        ):
            if count and instant is not None:
                found[count - 1 :] = [(found[count - 1][0] if len(found) >= count else k, k)]
            else:
                del found[count or 0 :]
        columns = [taken[name] for name in cls.COLUMNS[2:]]
        return tuple(
            cls(taken["t_s"][first], *(column[last] or 0.0 for column in columns))
            for first, last in found
        )

    @property
    def significance(self) -> float:
        """Return the larger of the two changes in standard deviations."""
        sizes = ((self.velocity_mps, self.velocity_1s_mps), (self.rate_radps, self.rate_1s_radps))
        return max(
            value / sigma if sigma > 0.0 else math.inf * value if value else 0.0
            for value, sigma in sizes
        )

    def __str__(self) -> str:
        sizes = (
            (1000.0 * self.velocity_mps, 1000.0 * self.velocity_1s_mps, "mm/s"),
            (math.degrees(self.rate_radps), math.degrees(self.rate_1s_radps), "deg/s"),
        )
        clear = [size for size in sizes if size[0] > 3.0 * size[1]] or sizes
        return " and ".join(f"{value:.3g} +- {sigma:.2g} {unit}" for value, sigma, unit in clear)


@value_class(eq=True)
class Drifting:
    """A constant torque or force on the target: onset since the first scan and accelerations,
    with 1 sigma.
    """

    onset_s: float
    onset_1s_s: float
    force_mps2: float
    force_1s_mps2: float
    torque_radps2: float
    torque_1s_radps2: float

    @classmethod
    def of(cls, row: Row) -> Drifting | None:
        """Return the drift known at a row; None where there is none that exceeds 2 standard
        deviations.

        Args:
            row: the last row of a run.
        """
        if row.drift_s is None:
            return None
        found = (
            row.drift_1s_s,
            row.drift_mps2,
            row.drift_1s_mps2,
            row.drift_radps2,
            row.drift_1s_radps2,
        )
        drift = cls(row.drift_s, *(value or 0.0 for value in found))
        force, torque = (
            drift.force_mps2 > 2.0 * drift.force_1s_mps2,
            drift.torque_radps2 > 2.0 * drift.torque_1s_radps2,
        )
        return drift if force or torque else None

    def __str__(self) -> str:
        parts = [
            f"{value:.3g} +- {sigma:.2g} {unit}"
            for value, sigma, unit in (
                (self.torque_radps2, self.torque_1s_radps2, "rad/s2"),
                (self.force_mps2, self.force_1s_mps2, "m/s2"),
            )
            if value
        ]
        return f"{' and '.join(parts)} since {self.onset_s:.0f} +- {self.onset_1s_s:.0f} s"


def length_text(metres: float) -> str:
    """Return a length [m] as text in millimetres, from 1 m on in metres."""
    return f"{metres:.3g} m" if abs(metres) >= 1.0 else f"{1000 * metres:.3g} mm"


def times(count: int) -> str:
    """Return a number of events in words: never, once, 2 times.

    Args:
        count: the number.
    """
    return {0: "never", 1: "once"}.get(count, f"{count} times")


def of_motion(
    rows: Sequence[Row], manoeuvres: Sequence[VelocityChange], drift: Drifting | None
) -> Iterator[str]:
    """Yield what the rows state of the target's motion, in words: manoeuvres, torques and forces.

    Args:
        rows: all rows of the run.
        manoeuvres: those of the target.
        drift: the drift of the target, None where there is none.
    """
    if manoeuvres:
        clearest = max(manoeuvres, key=lambda m: m.significance)
        count = "" if len(manoeuvres) == 1 else f" {times(len(manoeuvres))}, most significantly"
        often = len(manoeuvres) >= _LEAST_DRIVEN_CHANGES
        whose = "the target does not move freely: its" if often else "the target's"
        yield f"{whose} velocity changed{count} at {clearest.t_s:.1f} s by {clearest}"
    if drift is not None:
        yield f"a constant torque or force acts on the target: {drift}"
    yield from _disturbed(rows)


def of_sensor(rows: Sequence[Row]) -> Iterator[str]:
    """Yield what the rows state of errors of the sensor, in words.

    Args:
        rows: all rows of the run.
    """
    stated = list(zip(column_of(rows, "t_s"), column_of(rows, "reason"), strict=True))
    if biased := [t_s for t_s, reason in stated if reason == "sensor_bias"]:
        yield f"the sensor had a bias in {len(biased)} scans, first at {biased[0]:.1f} s"
    if frozen := [t_s for t_s, reason in stated if reason == "frozen"]:
        yield f"the sensor repeated a scan {times(len(frozen))}, first at {frozen[0]:.1f} s"


def of_driving(rows: Sequence[Row]) -> Iterator[str]:
    """Yield that no free motion explains the poses, in words.

    Args:
        rows: all rows of the run.
    """
    moved = zip(column_of(rows, "t_s"), column_of(rows, "motion"), strict=True)
    if driven := [t_s for t_s, motion in moved if motion == "driven"]:
        scans = f"{len(driven)} of {len(rows)} scans, first at {driven[0]:.1f} s"
        yield f"the target does not move freely: no free motion explains the poses of {scans}"


def _disturbed(rows: Sequence[Row]) -> Iterator[str]:
    """That random torques or forces explain the poses at the end."""
    moved = column_of(rows, "motion")
    if moved and moved[-1] == "disturbed" and "driven" not in moved:
        last = rows[-1]
        sizes = [
            f"{value:.2g} {unit}"
            for value, unit in (
                (last.torque_noise_radps15, "rad/s^1.5"),
                (last.force_noise_mps15, "m/s^1.5"),
            )
            if value
        ]
        what = f"random torques or forces act, {' and '.join(sizes)}"
        yield f"the target does not move freely: {what}"


@value_class(eq=True)
class Statistics:
    """Root mean square, mean, median, standard deviation (over n), smallest and largest of
    ``count`` values.
    """

    count: int
    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @classmethod
    def of(cls, values: ArrayLike) -> Statistics | None:
        """Return the statistics of ``values`` (n,); None without any value."""
        array = np.asarray(values, dtype=np.float64)
        n = len(array)
        if not n:
            return None
        mean = math.fsum(array.tolist()) / n
        rmse, std = (
            math.sqrt(math.fsum((part * part).tolist()) / n) for part in (array, array - mean)
        )
        return cls(n, rmse, mean, median(array), std, float(array.min()), float(array.max()))

    @property
    def sse(self) -> float:
        """Sum of the squares."""
        return self.count * self.rmse**2


def median(values: ArrayLike) -> float:
    """Return the middle value of ``values`` (n,), or the mean of the two middle values; there must
    be at least one.
    """
    ordered: list[float] = np.sort(np.asarray(values)).tolist()
    half = len(ordered) // 2
    return ordered[half] if len(ordered) % 2 else 0.5 * (ordered[half - 1] + ordered[half])


@value_class(eq=True)
class CaptureMiss:
    """Distance, relative speed and attitude error of the gripper to the true grasp point when it
    closed.
    """

    position_m: float
    speed_mps: float | None
    rotation_deg: float | None


@value_class(eq=True)
class Capture:
    """Planned instants of capture in seconds since the first scan. A replan is a row whose plan
    differs from the one before.

    Attributes:
        last_s, first_s: planned instants of the last and the first plan.
        std_s, range_s: standard deviation and range over all replans.
        status: status of the last plan.
        plan_miss_m: distance to the true grasp point at the end of each plan, flown without
            replanning.
        miss: errors when the gripper closed; None where it never closed, or without truth.
        actions: number of scans under each action of the supervisor.
    """

    replans: int
    first_s: float | None
    last_s: float | None
    std_s: float | None
    range_s: float | None
    status: str | None
    plan_miss_m: Statistics | None = None
    miss: CaptureMiss | None = None
    actions: Mapping[str, int] = field(default_factory=dict)

    COLUMNS: ClassVar = (
        *("plan_status", "capture_time_s", "plan_miss_m", "action"),
        *("capture_miss_m", "capture_miss_mps", "capture_miss_deg"),
    )

    @classmethod
    def of(cls, taken: Mapping[str, Sequence[Any]]) -> Capture:
        """Return the captures that the rows of a run plan.

        Args:
            taken: the values of ``COLUMNS`` in all rows.
        """
        planned = zip(taken["plan_status"], taken["capture_time_s"], strict=True)
        plans = [plan for plan, _ in groupby(plan for plan in planned if plan != (None, None))]
        instants = [t for _, t in plans if t is not None]
        spread = Statistics.of(instants)
        misses = zip(*(taken[name] for name in cls.COLUMNS[4:]), strict=True)
        miss = next((found for found in reversed(list(misses)) if found[0] is not None), None)
        return cls(
            replans=len(instants),
            first_s=instants[0] if instants else None,
            last_s=instants[-1] if instants else None,
            std_s=spread.std if spread else None,
            range_s=spread.max - spread.min if spread else None,
            status=plans[-1][0] if plans else None,
            plan_miss_m=Statistics.of(
                [miss_m for miss_m in taken["plan_miss_m"] if miss_m is not None]
            ),
            miss=None if miss is None else CaptureMiss(*miss),
            actions=dict(sorted(Counter(filter(None, taken["action"])).items())),
        )
