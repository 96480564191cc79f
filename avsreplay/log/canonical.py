"""Canonical scans: metres, seconds after the instant of the scan, and real returns only.

A decoder returns the fields of a cloud as they are declared (``raw_cloud``). What they mean is
inferred here from a sample of the clouds of a log, once: byte order, unit of the coordinates, times
of the points, and the codes of missing returns. Each inference has its evidence, which ``info``,
``doctor`` and ``run`` print, and an option that overrides it; what the values do not decide is
an error. What comes after this layer need not test the values of a scan again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import MeasuredPose, Pose
from avsreplay.log.bytes_io import BadMessage, shown
from avsreplay.log.options import ByteOrder, SourceOptions, Unit
from avsreplay.log.point_times import (
    PointTime,
    Reading,
    TimedCloud,
    TimeOrigin,
    best_reading,
    parse_point_time,
    read_times,
    relative_s,
)
from avsreplay.log.raw_cloud import RawCloud
from avsreplay.log.returns import (
    MAX_COORDINATE_M,
    Missing,
    NoReturn,
    count,
    find_codes,
    parse_no_return,
    valid,
)

INFERENCE_CLOUDS = 9  # clouds, spread over the log, from which meanings are inferred
_SENSOR_POSE_INSTANTS = 17  # instants of a scan at which the pose of a moving sensor is looked up
_INTENSITY_NAMES = ("intensity", "intensities", "i", "reflectivity")
_ORDINARY = 1e-5, 1e7  # magnitudes that coordinates have in any unit
_WRONG_ORDER_SHARE = 0.6  # largest share of ordinary coordinates in the wrong byte order
_RIGHT_ORDER_SHARE = 0.9  # least share of ordinary coordinates in the right byte order
# share of points without a valid instant from which on a cloud is not used
_MAX_UNTIMED_SHARE = 0.5


def spread(count: int, most: int) -> list[int]:
    """Return at most ``most`` of the numbers below ``count``, spread evenly, with both ends.

    Args:
        count: how many there are.
        most: how many are chosen.
    """
    if count <= most:
        return list(range(count))
    return sorted({k * (count - 1) // (most - 1) for k in range(most)})


@value_class(eq=True)
class Inference:
    """One finding about the meaning of the clouds of a log.

    Attributes:
        about: "byte order", "unit", "point times" or "missing returns".
        finding: what was found, in words.
        evidence: the values from which it follows, or that it was given.
        option: option with which it is set or overridden.
        grade: "ok", "check" (the user should look at it) or "fail" (the values do not decide).
    """

    about: str
    finding: str
    evidence: str
    option: str = ""
    grade: str = "ok"

    @property
    def sentence(self) -> str:
        """Finding and evidence in one sentence."""
        return f"{self.finding} ({self.evidence})" if self.evidence else self.finding


@value_class(eq=True)
class Meaning:
    """The meaning of the numbers in the clouds of a log.

    Attributes:
        swapped: whether the bytes of each value are in the other order than declared.
        unit_m: one unit of the coordinates [m].
        time: how the instants of the points are read; None if the points have none.
        codes: values that stand for missing returns.
        inferences: the findings from which this follows.
    """

    swapped: bool = False
    unit_m: float = 1.0
    time: PointTime | None = None
    codes: NoReturn = NoReturn()
    inferences: tuple[Inference, ...] = ()

    @property
    def decided(self) -> tuple[Any, ...]:
        """Everything except the evidence and the limit of the times, for a comparison."""
        time = None if self.time is None else replace(self.time, limit_s=0.0)
        return self.swapped, self.unit_m, time, self.codes

    def record(self) -> dict[str, Any]:
        """Return what ``run.json`` states about it."""
        return {
            "byte_order": "reversed" if self.swapped else "declared",
            "unit_m": self.unit_m,
            "point_time": None if self.time is None else self.time.text,
            "no_return": self.codes.text,
            "inferred": [
                {"about": each.about, "found": each.finding, "evidence": each.evidence}
                for each in self.inferences
            ],
        }

    @property
    def refused(self) -> Inference | None:
        """The first finding that the values do not decide; None if all are decided."""
        return next((each for each in self.inferences if each.grade == "fail"), None)


@value_class
class Cloud:
    """A canonical cloud.

    Attributes:
        points: (n, 3) returns in ``frame`` [m].
        times_s: (n,) their times after the stamp [s], or None.
        intensities: (n,) their intensities, or None.
        places: (n,) share of the message that precedes each point, for points without times.
        dropped: number of points that were no return.
        pose: measured pose in place of points, where the source has poses.
    """

    stamp_ns: int
    frame: str
    points: NDArray[Any]
    times_s: NDArray[np.float32] | None
    dropped: int
    pose: MeasuredPose | None = None
    intensities: NDArray[np.float32] | None = None
    places: NDArray[np.float32] | None = None

    def keep(self, kept: NDArray[np.bool_]) -> Cloud:
        """Return the cloud with some of its points."""
        each = (self.times_s, self.intensities, self.places)
        times, seen, places = (None if column is None else column[kept] for column in each)
        return replace(
            self, points=self.points[kept], times_s=times, intensities=seen, places=places
        )


@np.errstate(invalid="ignore", over="ignore")  # any bytes may stand where a number is expected
def infer(sample: Sequence[TimedCloud], period_s: float | None, options: SourceOptions) -> Meaning:
    """Infer what the numbers of the clouds of a log mean.

    Args:
        sample: some clouds, spread over the log, in the order of their stamps.
        period_s: time between two scans [s]; None if it is unknown.
        options: what the user has set.
    """
    sample = [one for one in sample if len(one.raw)]
    if not sample:
        return replace(_stated(options), inferences=())
    swapped, order = _byte_order(sample, options)
    if swapped:
        sample = [replace(one, raw=one.raw.in_other_byte_order()) for one in sample]
    unit_m, unit = _unit(sample, options)
    time, times = _times(sample, period_s, options)
    codes, missing = _missing(sample, unit_m, options)
    return Meaning(swapped, unit_m, time, codes, (*order, *unit, *times, *missing))


@np.errstate(invalid="ignore", over="ignore")
def canonical(raw: RawCloud, meaning: Meaning, reference_ns: int | None = None) -> Cloud:
    """Return a cloud in metres, with its returns only and their times after its stamp.

    Args:
        raw: as decoded.
        meaning: of the clouds of this log.
        reference_ns: stamp of the cloud on the clock of the headers [ns]; 0: it has none, so that
            times count from its first point; None: ``raw.stamp_ns``.

    Raises:
        BadMessage: it lacks a field, or most of its points have no valid time.
    """
    if raw.pose is not None:
        return Cloud(raw.stamp_ns, raw.frame, np.zeros((0, 3), np.float32), None, 0, raw.pose)
    for name in (*"xyz", *(meaning.time.fields if meaning.time else ())):
        if name not in raw.fields:
            known = ", ".join(map(shown, raw.fields)) or "none"
            raise BadMessage(f"no field '{shown(name)}' among {known}")
    if not len(raw):
        return Cloud(raw.stamp_ns, raw.frame, np.zeros((0, 3), np.float32), None, 0)
    if meaning.swapped:
        raw = raw.in_other_byte_order()
    stored = coordinates(raw)
    kept = valid(stored, meaning.codes, MAX_COORDINATE_M / meaning.unit_m)
    times, places = None, None
    if meaning.time is None:
        places = np.arange(len(stored), dtype=np.float32) / np.float32(len(stored))
    else:
        times, kept = _timed(raw, meaning.time, reference_ns, kept)
    points = stored if meaning.unit_m == 1.0 else stored * stored.dtype.type(meaning.unit_m)
    cloud = Cloud(
        raw.stamp_ns, raw.frame, points, times, 0, intensities=_intensities(raw), places=places
    )
    if kept is None:
        return cloud
    return replace(cloud.keep(kept), dropped=len(points) - int(np.count_nonzero(kept)))


def _timed(
    raw: RawCloud, time: PointTime, reference_ns: int | None, kept: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.bool_] | None]:
    """Times of the points [s], and which points are returns with a valid time."""
    if reference_ns == 0 and time.origin is not TimeOrigin.STAMP:
        time = replace(time, origin=TimeOrigin.FIRST)
    stamp_ns = raw.stamp_ns if reference_ns is None else reference_ns
    times = relative_s(raw, time, stamp_ns)
    timed = np.isfinite(times)
    if not timed.all():
        returns = timed if kept is None else timed & kept
        expected = len(times) if kept is None else int(np.count_nonzero(kept))
        if np.count_nonzero(returns) < _MAX_UNTIMED_SHARE * expected:
            raise BadMessage(
                f"the times of its points ('{shown(time.text)}') are not near its stamp"
            )
        kept = returns
    return times.astype(np.float32), kept


def coordinates(raw: RawCloud) -> NDArray[Any]:
    """Return the points (n, 3) as stored, float32 or float64; a view if x, y and z are adjacent
    in memory and in native byte order.
    """
    x, y, z = (raw.column(axis) for axis in "xyz")
    same = x.dtype == y.dtype == z.dtype and x.strides == y.strides == z.strides
    if same and x.dtype.kind == "f" and x.dtype.isnative and x.dtype.itemsize >= 4:
        size = x.dtype.itemsize
        at = [column.__array_interface__["data"][0] for column in (x, y, z)]
        if at[1] - at[0] == at[2] - at[1] == size:
            # an explicit byte order, although it is the native one, is not that of plain floats
            native = x.view(np.float32 if size == 4 else np.float64)
            return np.lib.stride_tricks.as_strided(
                native, (len(x), 3), (x.strides[0], size), writeable=False
            )
    kinds = [column.dtype for column in (x, y, z)]
    kind = np.float32 if all(k.kind == "f" and k.itemsize <= 4 for k in kinds) else np.float64
    return np.stack((x, y, z), axis=1).astype(kind)


def _intensities(raw: RawCloud) -> NDArray[np.float32] | None:
    """The intensity (n,) of each point in the sensor's own unit."""
    name = next((name for name in raw.fields if name in _INTENSITY_NAMES), None)
    return None if name is None else raw.column(name).astype(np.float32)


def _stated(options: SourceOptions) -> Meaning:
    """What the options state, where nothing can be inferred."""
    time = None if options.point_time is None else parse_point_time(options.point_time)
    codes = NoReturn() if options.no_return is None else parse_no_return(options.no_return)
    unit_m = 1.0 if options.scan_unit is None else options.scan_unit.metres
    return Meaning(unit_m=unit_m, time=time, codes=codes)


def _byte_order(
    sample: Sequence[TimedCloud], options: SourceOptions
) -> tuple[bool, list[Inference]]:
    """Whether the bytes are in the other order than declared."""
    declared = np.mean([_ordinary(one.raw) for one in sample])
    other = np.mean([_ordinary(one.raw.in_other_byte_order()) for one in sample])
    text = (
        f"{100 * declared:.0f} % of the coordinates have an ordinary magnitude as declared,"
        f" {100 * other:.0f} % with their bytes reversed"
    )
    if options.byte_order is not None:
        swapped = options.byte_order is ByteOrder.REVERSED
        return swapped, [Inference("byte order", options.byte_order.value, "given")]
    if declared < _WRONG_ORDER_SHARE and other > _RIGHT_ORDER_SHARE:
        found = "the bytes of the values are in the other order than declared, and are reversed"
        return True, [Inference("byte order", found, text, "--byte-order reversed", grade="check")]
    return False, []


def _ordinary(raw: RawCloud) -> float:
    """Share of the coordinates with an ordinary magnitude, among those that are numbers."""
    if any(name not in raw.fields for name in "xyz"):
        return 1.0
    low, high = _ORDINARY
    seen = good = 0
    for axis in "xyz":
        values = raw.column(axis)
        if values.dtype.kind != "f":
            return 1.0
        size = np.abs(values[np.isfinite(values)].astype(np.float64))
        size = size[size > 0.0]
        seen, good = seen + len(size), good + int(np.count_nonzero((size > low) & (size < high)))
    return good / seen if seen else 1.0


def _unit(sample: Sequence[TimedCloud], options: SourceOptions) -> tuple[float, list[Inference]]:
    """Unit of the coordinates [m]."""
    if options.scan_unit is not None:
        return options.scan_unit.metres, [Inference("unit", options.scan_unit.value, "given")]
    raw = sample[0].raw
    if raw.unit_m is not None:
        return raw.unit_m, []
    if all(name in raw.fields and raw.fields[name].dtype.kind in "iu" for name in "xyz"):
        text = "the coordinates are whole numbers"
        option = f"--scan-unit {Unit.MM.value}"
        return 1e-3, [Inference("unit", "millimetres", text, option, grade="check")]
    return 1.0, []


def _times(
    sample: Sequence[TimedCloud], period_s: float | None, options: SourceOptions
) -> tuple[PointTime | None, list[Inference]]:
    """How the times of the points are read."""
    if options.point_time is not None:
        given = parse_point_time(options.point_time)
        words = "none" if given is None else given.words
        return given, [Inference("point times", words, "given")]
    found = read_times(sample, period_s)
    best, refused = best_reading(found), [each for each in found if each.refused]
    silent = [each for each in found if each.time is None and not each.refused]
    if best is not None and best.time is not None:
        about = [_besides(each, best, sample) for each in found if each is not best]
        evidence = "; ".join([best.evidence, *filter(None, about)])
        grade = "check" if best.time.origin is TimeOrigin.OTHER else "ok"
        option = f"--point-time {best.time.text}"
        return best.time, [Inference("point times", best.time.words, evidence, option, grade)]
    if refused:
        text = f"field '{shown(refused[0].name)}': {refused[0].refused}"
        option = "--point-time FIELD:UNIT:ORIGIN or --point-time none"
        return None, [Inference("point times", text, "", option, grade="fail")]
    if silent:
        text = "; ".join(f"field '{shown(each.name)}': {each.evidence}" for each in silent)
        return None, [Inference("point times", "the points have no times", text)]
    return None, []


def _besides(reading: Reading, best: Reading, sample: Sequence[TimedCloud]) -> str:
    """What is said about a field that is not used."""
    name = shown(reading.name)
    if reading.time is None or best.time is None:
        return f"'{name}' is not used: {reading.refused or reading.evidence}"
    one = sample[0]
    apart = relative_s(one.raw, reading.time, one.stamp_ns) - relative_s(
        one.raw, best.time, one.stamp_ns
    )
    apart = np.abs(apart[np.isfinite(apart)])
    most = float(apart.max()) if len(apart) else 0.0
    return f"'{name}' is coarser, and differs by up to {most:.2g} s"


def _missing(
    sample: Sequence[TimedCloud], unit_m: float, options: SourceOptions
) -> tuple[NoReturn, list[Inference]]:
    """The codes of missing returns, and how many points there are."""
    clouds = [
        coordinates(one.raw) for one in sample if all(axis in one.raw.fields for axis in "xyz")
    ]
    given = options.no_return is not None
    codes = parse_no_return(options.no_return or "") if given else find_codes(clouds)
    seen = count(clouds, codes, MAX_COORDINATE_M / unit_m)
    return codes, _missing_words(seen, codes, given=given)


def _missing_words(seen: Missing, codes: NoReturn, *, given: bool) -> list[Inference]:
    out = []
    if seen.not_finite:
        out.append(f"{_percent(seen.not_finite, seen.total)} not finite or beyond 1e6 m")
    if seen.at_origin:
        out.append(f"{_percent(seen.at_origin, seen.total)} at the origin")
    if seen.coded:
        named = "" if codes.text == "none" else f" ({codes.text})"
        out.append(f"{_percent(seen.coded, seen.total)} with a repeated code{named}")
    if not out:
        return [Inference("missing returns", codes.text, "given")] if given else []
    text = f"left out: {', '.join(out)}"
    evidence = "given" if given else f"{seen.total} examined points"
    return [Inference("missing returns", text, evidence, f"--no-return '{codes.text}'")]


def _percent(count: int, total: int) -> str:
    return f"{100.0 * count / total:.3g} %"


def selected(cloud: Cloud, options: SourceOptions) -> Cloud:
    """Return a cloud after the crop, with the times of its points if their order and the duration
    of a scan give them.

    Args:
        cloud: a canonical cloud.
        options: how the log is read.
    """
    if options.crop_box is not None or options.crop_range is not None:
        cloud = cloud.keep(inside_crop(cloud.points, options.crop_range, options.crop_box))
    if options.scan_duration_s is None or cloud.places is None:
        return cloud
    return replace(cloud, times_s=np.float32(options.scan_duration_s) * cloud.places, places=None)


def inside_crop(
    points: NDArray[Any], crop_range: Sequence[float] | None, crop_box: Sequence[float] | None
) -> NDArray[np.bool_]:
    """Return which points are inside a crop.

    Args:
        points: (n, 3) points in the frame of the cloud [m].
        crop_range: least and largest distance from the origin [m]; None: any.
        crop_box: least x, y, z and largest x, y, z [m]; None: any.
    """
    inside = np.ones(len(points), dtype=np.bool_)
    if crop_box is not None:
        low, high = np.array(crop_box[:3]), np.array(crop_box[3:])
        inside &= np.all((points >= low) & (points <= high), axis=1)
    if crop_range is not None:
        distance = np.linalg.norm(points.astype(np.float64), axis=1)
        inside &= (distance >= crop_range[0]) & (distance <= crop_range[1])
    return inside


def at_stamp(cloud: Cloud, sensor_at: Callable[[int], Pose]) -> Cloud:
    """Return a cloud in the frame that its sensor has at the stamp; each point is moved from the
    frame at its own time.

    Args:
        cloud: in the frame of the moving sensor.
        sensor_at: the pose of the sensor so many nanoseconds after the stamp.
    """
    if cloud.times_s is None or not cloud.times_s.any():
        return cloud
    times = cloud.times_s.astype(np.float64)
    knots = np.linspace(
        min(float(times.min()), 0.0), max(float(times.max()), 0.0), _SENSOR_POSE_INSTANTS
    )
    T_sa = sensor_at(0).inverse()
    steps = [T_sa @ sensor_at(round(1e9 * after)) for after in knots.tolist()]
    R, t = np.stack([step.R for step in steps]), np.stack([step.t for step in steps])
    return replace(
        cloud, points=geometry.moved_in_time(cloud.points.astype(np.float64), times, knots, R, t)
    )
