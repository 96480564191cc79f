"""The instants of the points of a cloud: which field holds them, in which unit, and from which
origin they count.

Drivers agree neither on names nor on units: the same name stands for seconds after the stamp,
nanoseconds since 1970 or microseconds since the start of the sensor. A name (or a value next to the
stamp) only proposes a field. Its meaning follows from values over several scans:

* An absolute time advances from scan to scan as the stamps do. This fixes its unit; its distance
  from the stamps tells whether it is of their clock or of another one.
* Some devices count within a cycle (an hour, 2^32 ticks): the same, apart from whole cycles.
* A time relative to the stamp does not advance. Its unit is the one in which the points of a scan
  fill a plausible part of the time between two scans.

A field whose values are all equal says nothing. What the values leave open is not guessed:
``Reading.refused`` holds the reason.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.log.raw_cloud import RawCloud

_MAX_REACH_PERIODS = 1.6  # reach of the times of a scan over the time between two scans
_OTHER_CLOCK_PERIODS = 1.2  # an origin farther than this from the stamps is that of another clock
_USUAL_REACH_PERIODS = 0.3  # from here on the reach is an ordinary part of the period
_USUAL_S = 1e-3, 3.0  # ordinary durations of a scan
_MAX_DURATION_S = 30.0  # longest duration where the period is unknown
_MARGIN_DECADES = 0.9  # decades by which a unit must be more plausible than any other
_MAX_INSTANTS_PER_S = 1e8  # more distinct instants per second than any scanner has
_COARSE_PERIODS = 0.02  # of the period: a field that resolves less cannot place a point
_ADVANCE_PERIODS = 2.5  # stamps must differ by so much before an advance is tested
_ADVANCE_TOLERANCE = 0.2  # of that difference
_LEAST_AGREEING_SHARE = 0.85  # share of the scans that agree; the others may have a wrong stamp
_CYCLES_S = 1.0, 60.0, 3600.0, 86400.0
_NAMED_UNIT_DECADES = 3.0  # that a unit in the name of the field counts
_USUAL_UNIT_DECADES = 1.4  # that the usual unit of a type counts


class TimeUnit(Enum):
    """Unit of the values of a field of times."""

    S = "s"
    MS = "ms"
    US = "us"
    NS = "ns"

    @property
    def ns(self) -> int:
        """Return one unit in nanoseconds."""
        return {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}[self.value]

    @property
    def seconds(self) -> float:
        """Return one unit in seconds."""
        return {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[self.value]


class TimeOrigin(Enum):
    """From what the values of a field of times count."""

    STAMP = "stamp"  # the stamp of the cloud
    CLOCK = "clock"  # the origin of the clock of the stamps
    OTHER = "other"  # the origin of another clock, at a constant distance from that of the stamps
    FIRST = "first"  # unknown: the first point of each cloud is measured at its stamp
    LAST = "last"  # unknown: the last point of each cloud is measured at its stamp


_UNIT_WORDS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), TimeUnit.S),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), TimeUnit.MS),
    **dict.fromkeys(("us", "usec", "micros", "microseconds"), TimeUnit.US),
    **dict.fromkeys(("ns", "nsec", "nanosec", "nanos", "nanosecond", "nanoseconds"), TimeUnit.NS),
}
_TIME_WORDS = frozenset(
    [
        "t",
        "time",
        "times",
        "timestamp",
        "timestamps",
        "timeoffset",
        "stamp",
        "ts",
        "dt",
        "toffset",
        "tstamp",
        "gpstime",
    ]
)
_OTHER_WORDS = frozenset(["exposure", "integration", "flight", "width", "tof", "period"])
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")


@value_class(eq=True)
class PointTime:
    """How the instants of the points are read.

    Attributes:
        fields: name of the field, or of the fields of seconds and of their fraction.
        unit: unit of the values, or of the fraction if there are two fields.
        origin: the instant from which the values count.
        offset_ns: time of another clock minus that of the stamps [ns].
        cycle_ns: the values repeat after this time [ns]; 0 if they do not.
        limit_s: an instant farther than this from the stamp is not valid [s].
    """

    fields: tuple[str, ...]
    unit: TimeUnit
    origin: TimeOrigin
    offset_ns: int = 0
    cycle_ns: int = 0
    limit_s: float = float("inf")

    @property
    def text(self) -> str:
        """Return the reading as the argument of ``--point-time``."""
        offset = f"{self.offset_ns * 1e-9:.7f}".rstrip("0").rstrip(".")
        origin = offset if self.origin is TimeOrigin.OTHER else self.origin.value
        return f"{'+'.join(self.fields)}:{self.unit.value}:{origin}"

    @property
    def words(self) -> str:
        """Return the reading in words."""
        names = " and ".join(f"'{name}'" for name in self.fields)
        after = {
            TimeOrigin.STAMP: "after the stamp",
            TimeOrigin.CLOCK: "on the clock of the stamps",
            TimeOrigin.OTHER: (
                f"on a clock {self.offset_ns * 1e-9:+.3f} s from that of the stamps, so that the"
                " first point of a scan is measured at its stamp"
            ),
            TimeOrigin.FIRST: "after the first point, which is measured at the stamp",
            TimeOrigin.LAST: "before the last point, which is measured at the stamp",
        }[self.origin]
        cycle = f" within {self.cycle_ns * 1e-9:.6g} s" if self.cycle_ns else ""
        return f"{names} in {self.unit.value}{cycle} {after}"


@value_class
class TimedCloud:
    """A cloud of the sample from which meanings are inferred.

    Attributes:
        raw: the cloud.
        stamp_ns: its stamp, or the time of its reception where the stamp is not set [ns].
    """

    raw: RawCloud
    stamp_ns: int


@value_class(eq=True)
class Reading:
    """What the values of one field show about times.

    Attributes:
        name: name of the field or fields.
        time: how it is read; None if it does not hold times.
        evidence: the values from which this follows.
        refused: why the values leave it undecided, "" if they decide it.
        step_s: smallest difference of two instants that it resolves [s].
    """

    name: str
    time: PointTime | None = None
    evidence: str = ""
    refused: str = ""
    step_s: float = float("inf")


def parse_point_time(text: str) -> PointTime | None:
    """Return the reading that ``--point-time`` states, None for "none".

    Args:
        text: ``FIELD:UNIT:ORIGIN``; two fields (seconds and their fraction) are joined by ``+``.

    Raises:
        ValueError: it has another form; the text says which forms there are.
    """
    if text == "none":
        return None
    parts = text.rsplit(":", 2)
    units, origins = [u.value for u in TimeUnit], ["stamp", "clock", "first", "last"]
    if len(parts) == 3 and parts[0] and parts[1] in units:
        fields, unit = tuple(parts[0].split("+")), TimeUnit(parts[1])
        if parts[2] in origins:
            return PointTime(fields, unit, TimeOrigin(parts[2]))
        try:
            return PointTime(fields, unit, TimeOrigin.OTHER, round(float(parts[2]) * 1e9))
        except (ValueError, OverflowError):
            pass
    raise ValueError(
        f"'{text}' is not FIELD:UNIT:ORIGIN with a unit of {', '.join(units)} and an origin of"
        f" {', '.join(origins)} or the offset of another clock in seconds; 'none' ignores the"
        " times"
    )


def relative_s(raw: RawCloud, time: PointTime, stamp_ns: int) -> NDArray[np.float64]:
    """Return the instants (n,) of the points after the stamp [s], NaN where there is none.

    Args:
        raw: the cloud.
        time: how its field is read.
        stamp_ns: its stamp on the clock of the header [ns].
    """
    ticks = _ticks(raw, time.fields, time.unit)
    finite = np.isfinite(ticks)
    if not finite.any():
        return np.full(len(ticks), np.nan)
    if time.origin is TimeOrigin.STAMP:
        return _bounded(ticks * time.unit.seconds, time.limit_s)
    if time.origin in (TimeOrigin.FIRST, TimeOrigin.LAST):
        lowest = time.origin is TimeOrigin.FIRST
        zero = ticks[finite].min() if lowest else ticks[finite].max()
        return _bounded((ticks - zero) * time.unit.seconds, time.limit_s)
    # absolute: subtracted in the unit of the field and in whole nanoseconds, so that nothing is
    # rounded but the difference
    zero = ticks[finite][0] if ticks.dtype.kind == "f" else int(ticks[0])
    apart_ns = _ns(zero, time.unit) - stamp_ns - time.offset_ns
    if time.cycle_ns:
        apart_ns = _within(apart_ns, time.cycle_ns)
    after = (ticks - zero) * time.unit.seconds + apart_ns * 1e-9
    if time.cycle_ns:  # the cycle may end within the scan
        cycle_s = time.cycle_ns * 1e-9
        after -= cycle_s * np.round(after / cycle_s)
    return _bounded(after, time.limit_s)


def _bounded(times: Array, limit_s: float) -> Array:
    return np.where(np.abs(times) <= limit_s, times, np.nan)


def _within(value_ns: int, cycle_ns: int) -> int:
    """The value without whole cycles, within half a cycle of zero."""
    return (value_ns + cycle_ns // 2) % cycle_ns - cycle_ns // 2


def _ns(ticks: float | int, unit: TimeUnit) -> int:
    return round(ticks * unit.ns) if unit is not TimeUnit.NS else round(ticks)


def _ticks(raw: RawCloud, fields: Sequence[str], unit: TimeUnit) -> NDArray[Any]:
    """Values (n,) of a field as int64 or float64; of two fields in units of the second one."""
    columns = [
        column.astype(np.int64 if column.dtype.kind in "iu" else np.float64)
        for column in map(raw.column, fields)
    ]
    if len(columns) == 1:
        return columns[0]
    per_second: int = TimeUnit.S.ns // unit.ns
    return columns[0] * per_second + columns[1]


def read_times(sample: Sequence[TimedCloud], period_s: float | None) -> list[Reading]:
    """Return what each field that may hold times says, in the order of the fields.

    Args:
        sample: clouds with points, in the order of their stamps, at least one.
        period_s: time between two scans [s]; None: unknown.
    """
    first = sample[0]
    same = [one for one in sample if set(first.raw.fields) <= set(one.raw.fields)]
    return [_Candidate(fields, same, period_s).reading() for fields in _proposed(first)]


def best_reading(found: Sequence[Reading]) -> Reading | None:
    """Return the reading with the finest resolution, the first of equal ones; None if no field
    holds times.
    """
    decided = [reading for reading in found if reading.time is not None]
    return min(decided, key=lambda reading: reading.step_s) if decided else None


def _words(name: str) -> list[str]:
    return [word.lower() for word in _WORD.findall(name)]


def _is_time(name: str) -> bool:
    words = _words(name)
    return any(word in _TIME_WORDS or word.startswith("time") for word in words) and not (
        _OTHER_WORDS & set(words)
    )


def _proposed(first: TimedCloud) -> Iterator[tuple[str, ...]]:
    """Names of the fields that may hold times: pairs of seconds and their fraction, fields named
    after a time, and fields of which a value is next to the stamp.
    """
    fields = first.raw.fields
    pairs = list(_pairs(fields))
    paired = {name for pair in pairs for name in pair}
    yield from pairs
    for name, values in fields.items():
        if name in paired or name in ("x", "y", "z") or values.dtype.kind not in "iuf":
            continue
        if _is_time(name) or _next_to(values.reshape(-1), first.stamp_ns):
            yield (name,)


def _pairs(fields: Mapping[str, NDArray[Any]]) -> Iterator[tuple[str, str]]:
    """Pairs of integers such as time_sec and time_nsec."""
    named: dict[tuple[str, ...], dict[TimeUnit, str]] = {}
    for name, values in fields.items():
        words = [re.sub(r"^time(?=sec|nano|micro)", "", word) for word in _words(name)]
        units = [_UNIT_WORDS[word] for word in words if word in _UNIT_WORDS]
        if values.dtype.kind in "iu" and len(units) == 1:
            stem = tuple(word for word in words if word not in _UNIT_WORDS)
            named.setdefault(stem, {})[units[0]] = name
    for units_of in named.values():
        for fraction in (TimeUnit.NS, TimeUnit.US):
            if TimeUnit.S in units_of and fraction in units_of:
                yield units_of[TimeUnit.S], units_of[fraction]
                break


def _next_to(values: NDArray[Any], stamp_ns: int) -> bool:
    """Whether a field of another name holds the time of day: a value within an hour of a stamp
    after 1973.
    """
    if stamp_ns < 10**17 or values.dtype.itemsize < 4 or not len(values):
        return False
    value = float(values[0])
    return any(abs(value * unit.ns - stamp_ns) < 3600e9 for unit in TimeUnit)


class _Candidate:
    """One field over the clouds of a sample."""

    def __init__(
        self, fields: tuple[str, ...], sample: Sequence[TimedCloud], period_s: float | None
    ) -> None:
        self.name, self._fields, self._period = "+".join(fields), fields, period_s
        self._fraction = self._fraction_unit()
        kinds = [sample[0].raw.fields[name].dtype for name in fields]
        self._float32 = kinds[0].kind == "f" and kinds[0].itemsize == 4
        self._integer, self._bits = kinds[0].kind in "iu", 8 * kinds[0].itemsize
        columns = [(_core(_ticks(one.raw, fields, self._fraction)), one) for one in sample]
        self._columns = [column for column, _ in columns if len(column)]
        stamps = [one.stamp_ns for column, one in columns if len(column)]
        self._stamps = np.array([stamp - stamps[0] for stamp in stamps]) * 1e-9 if stamps else None
        self._first_ns = stamps[0] if stamps else 0
        self._stamp_ns = stamps

    def _fraction_unit(self) -> TimeUnit:
        words = _words(self._fields[-1])
        words += [re.sub(r"^time", "", word) for word in words]
        return next((_UNIT_WORDS[word] for word in words if word in _UNIT_WORDS), TimeUnit.NS)

    @property
    def _units(self) -> list[TimeUnit]:
        return list(TimeUnit) if len(self._fields) == 1 else [self._fraction]

    def reading(self) -> Reading:
        """Return what the values say."""
        if not self._columns:
            return Reading(self.name, evidence="none of its values is finite")
        self._low = [column.min() for column in self._columns]
        self._high = [column.max() for column in self._columns]
        self._middle = [_median(column) for column in self._columns]
        spans = [float(h - low) for low, h in zip(self._low, self._high, strict=True)]
        self._span = max(spans) and float(_median(np.array(spans)))
        self._step = self._resolution()
        if found := self._coarse():
            return found
        if not self._span > 0.0:
            value = float(self._low[0])
            return Reading(
                self.name,
                evidence=f"all its values of a scan are equal, such as {value:.10g}",
            )
        return self._absolute() or self._relative()

    def _resolution(self) -> float:
        """Smallest step of the field [ticks]."""
        if not self._float32:
            return (
                1.0 if self._integer else float(np.spacing(max(abs(float(h)) for h in self._high)))
            )
        return float(np.spacing(np.float32(max(abs(float(h)) for h in self._high))))

    def _coarse(self) -> Reading | None:
        """A time of day whose type does not resolve the points of a scan."""
        if not self._float32:
            return None
        for unit in self._units:
            near = abs(float(self._low[0]) * unit.ns - self._first_ns) < max(
                3600e9, 2.0 * self._step * unit.ns
            )
            step_s = self._step * unit.seconds
            if (
                self._first_ns > 10**17
                and near
                and step_s > _COARSE_PERIODS * (self._period or 0.1)
            ):
                text = (
                    f"it holds the time of day in {unit.value} as float32, which resolves"
                    f" {step_s:.3g} s: the instants of the points are lost"
                )
                return Reading(self.name, refused=text)
        return None

    def _absolute(self) -> Reading | None:
        """The reading of values that advance with the stamps, or are next to the only one."""
        for unit in self._units:
            residual = self._residual(unit)
            if self._advances(residual, unit) and self._plausible(unit):
                plain = self._steady(residual, unit)
                cycles = [(self._steady(residual, unit, c), c) for c in self._cycles(unit)]
                best = max(cycles, default=(0.0, 0))
                return self._of_clock(unit, best[1] if best[0] > plain else 0)
        if len(self._columns) > 1 and not self._fits_relative():
            for unit in self._units:
                for cycle_ns in self._cycles(unit):
                    if self._steady(self._residual(unit), unit, cycle_ns) > _LEAST_AGREEING_SHARE:
                        return self._of_clock(unit, cycle_ns)
        unit_by_value = self._by_value()
        return None if unit_by_value is None else self._of_clock(unit_by_value, 0)

    def _plausible(self, unit: TimeUnit) -> bool:
        most_s = (
            _MAX_DURATION_S if self._period is None else 2.0 * _MAX_REACH_PERIODS * self._period
        )
        return self._span * unit.seconds <= most_s

    def _fits_relative(self) -> bool:
        return any(self._score(unit) > -_NAMED_UNIT_DECADES for unit in self._units)

    def _cycles(self, unit: TimeUnit) -> Iterator[int]:
        most_ns = self._reach * unit.ns
        if self._integer and self._bits == 32 and self._reach > 1 << 30:
            yield (1 << 32) * unit.ns
        if min(float(low) for low in self._low) < 0.0:
            return
        for cycle_s in _CYCLES_S:
            if most_ns <= cycle_s * 1e9 and self._span * unit.seconds <= cycle_s:
                yield round(cycle_s * 1e9)

    def _residual(self, unit: TimeUnit) -> Array:
        """Advance of the middle of the points minus that of the stamp, of each scan [s]."""
        advance = [float(value - self._middle[0]) * unit.seconds for value in self._middle]
        return np.array(advance) - self._stamps

    def _steady(self, residual: Array, unit: TimeUnit, cycle_ns: int = 0) -> float:
        """Share of the scans whose residuals are equal within a scan, apart from whole cycles."""
        within = 0.6 * (self._period or 0.0) + 1.5 * self._span * unit.seconds
        if cycle_ns:
            cycle_s = cycle_ns * 1e-9
            residual = residual - cycle_s * np.round(residual / cycle_s)
            if within > 0.25 * cycle_s or not self._plausible(unit):
                return 0.0  # nearly any residual would be within
        return float(np.mean(np.abs(residual - _median(residual)) <= within))

    def _advances(self, residual: Array, unit: TimeUnit) -> bool:
        stamps = self._stamps
        if stamps is None or len(stamps) < 2:
            return False
        apart = float(np.ptp(stamps))
        span_s = max(self._span * unit.seconds, self._period or 0.0)
        if apart <= 0.0 or len(stamps) < 3 or apart < _ADVANCE_PERIODS * span_s:
            # two scans: an advance by the difference of the stamps, and no relative time that fits
            advance = float(self._middle[-1] - self._middle[0]) * unit.seconds
            near = abs(advance - float(stamps[-1])) < _ADVANCE_TOLERANCE * apart
            return near and not self._fits_relative()
        near_middle = np.abs(residual - _median(residual)) < _ADVANCE_TOLERANCE * apart
        return float(np.mean(near_middle)) > _LEAST_AGREEING_SHARE

    def _by_value(self) -> TimeUnit | None:
        """The unit in which the values of a single scan are next to its stamp."""
        for unit in self._units:
            apart_s = abs(_ns(self._low[0], unit) - self._first_ns) * 1e-9
            if self._first_ns > 10**17 and apart_s < 60.0 and self._plausible(unit):
                return unit
        return None

    def _of_clock(self, unit: TimeUnit, cycle_ns: int) -> Reading:
        offsets = sorted(
            _ns(low, unit) - stamp for low, stamp in zip(self._low, self._stamp_ns, strict=True)
        )
        if cycle_ns:
            offsets = sorted(_within(each, cycle_ns) for each in offsets)
        offset_ns = offsets[len(offsets) // 2]
        span_s = self._span * unit.seconds
        near_s = _OTHER_CLOCK_PERIODS * max(self._period or 0.0, span_s, 1e-3)
        same = abs(offset_ns) * 1e-9 <= near_s
        limit_s = 2.0 * near_s + span_s
        if self._step * unit.seconds > _COARSE_PERIODS * max(self._period or 0.0, span_s):
            text = f"it resolves {self._step * unit.seconds:.3g} s, too little for its scans"
            return Reading(self.name, refused=text)
        origin = TimeOrigin.CLOCK if same else TimeOrigin.OTHER
        time = PointTime(self._fields, unit, origin, 0 if same else offset_ns, cycle_ns, limit_s)
        how = (
            f"its values advance with the stamps of {len(self._low)} scans"
            if len(self._low) > 1
            else "its values are next to the stamp"
        )
        evidence = f"{how} and differ by {span_s:.4g} s within a scan"
        if not same:
            evidence += (
                "; one delay of all instants stays unknown: up to"
                f" {span_s:.3g} s if the stamp is that of another point, and more by the delay of"
                " the stamp if it is a time of reception"
            )
        return Reading(self.name, time, evidence, step_s=self._step * unit.seconds)

    def _relative(self) -> Reading:
        scores = sorted(((self._score(unit), unit) for unit in self._units), key=lambda s: -s[0])
        (best, unit), second = scores[0], scores[1][0] if scores[1:] else -np.inf
        reach = self._reach * unit.seconds
        of = "" if self._period is None else f" of the {self._period:.4g} s between two scans"
        if not np.isfinite(best) or best - second < _MARGIN_DECADES:
            low, high = min(map(float, self._low)), max(map(float, self._high))
            text = (
                f"its values from {low:.10g} to {high:.10g} do not tell the unit or the origin"
                f" of its times"
            )
            return Reading(self.name, refused=text)
        limit_s = 2.0 * max(self._period or 0.0, reach)
        time = PointTime(self._fields, unit, TimeOrigin.STAMP, limit_s=limit_s)
        evidence = f"its values do not advance, and reach {reach:.4g} s{of}"
        return Reading(self.name, time, evidence, step_s=self._step * unit.seconds)

    @property
    def _reach(self) -> float:
        return max(max(abs(float(v)) for v in self._low), max(abs(float(v)) for v in self._high))

    def _score(self, unit: TimeUnit) -> float:
        """How plausible a unit is for times relative to the stamp [decades], 0 at best."""
        reach_s = self._reach * unit.seconds
        if reach_s > (
            _MAX_DURATION_S if self._period is None else _MAX_REACH_PERIODS * self._period
        ):
            return float(-np.inf)
        score = -_decades(_USUAL_S[0], reach_s) - _decades(reach_s, _USUAL_S[1])
        if self._period is not None:
            score -= _decades(_USUAL_REACH_PERIODS * self._period, reach_s)
        if self._distinct / max(self._span * unit.seconds, 1e-12) > _MAX_INSTANTS_PER_S:
            score -= 1.0
        hint = next((_UNIT_WORDS[w] for w in _words(self.name) if w in _UNIT_WORDS), None)
        if hint is not None:
            return score + (_NAMED_UNIT_DECADES if hint is unit else 0.0)
        if self._integer and unit is TimeUnit.S:
            return (
                score - _NAMED_UNIT_DECADES
            )  # whole seconds cannot tell the points of a scan apart
        usual = TimeUnit.NS if self._integer else TimeUnit.S
        return score + (_USUAL_UNIT_DECADES if unit is usual else 0.0)

    @property
    def _distinct(self) -> int:
        column = np.sort(self._columns[0])
        return 1 + int(np.count_nonzero(column[1:] != column[:-1]))


def _decades(low: float, high: float) -> float:
    """Decades from ``high`` up to ``low``, 0 if it is not below."""
    return float(np.log10(low / high)) if 0.0 < high < low else 0.0


def _median(values: NDArray[Any]) -> Any:
    """The upper median, without numpy's, which loads more modules."""
    return values[np.argpartition(values, len(values) // 2)[len(values) // 2]]


def _core(ticks: NDArray[Any]) -> NDArray[Any]:
    """Values without those that are not finite, and without those that are far from the others,
    such as the zeros of missing returns beside times of day.
    """
    if ticks.dtype.kind == "f":
        ticks = ticks[np.isfinite(ticks)]
    nonzero = ticks[ticks != 0]
    if not len(nonzero):
        return ticks
    middle = _median(nonzero)
    far = np.abs(nonzero - middle) > 0.5 * abs(middle)
    return nonzero[~far] if np.count_nonzero(far) <= 0.1 * len(far) and len(far) > 3 else ticks
