"""Canonical scans: the meaning of the numbers of a cloud, inferred from clouds of a simulated
sensor whose meaning is known.

The sensor measures points one after another; what a driver writes of it (name, type, unit and
origin of the times, codes of missing returns, byte order) is generated, and what is read must be
the same instants and points, or be refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from avsreplay.log.bytes_io import BadMessage
from avsreplay.log.canonical import Cloud, Meaning, canonical, infer
from avsreplay.log.options import ByteOrder, SourceOptions, Unit
from avsreplay.log.point_times import TimedCloud
from avsreplay.log.raw_cloud import RawCloud, of_points

PER_S = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
EPOCH, SIMULATION = 1_700_000_000_123_456_789, 2_000_000_000


@dataclass(frozen=True)
class Sensor:
    """A scanner; its scans show a part of its view, and each lasts a part of the period."""

    period_s: float = 0.1
    duration_s: float = 0.098
    start_ns: int = EPOCH
    scans: int = 12
    points: int = 60
    seed: int = 0

    def clouds(self) -> list[tuple[int, NDArray[np.float64], NDArray[np.int64]]]:
        """(stamp [ns], points [m], instants after the stamp [ns]) of each scan."""
        rng = np.random.Generator(np.random.PCG64(self.seed))
        out = []
        for k in range(self.scans):
            points = rng.normal(size=(self.points, 3)) * [1.0, 0.7, 0.3] + [0.0, 0.0, 5.0]
            after = np.sort(rng.integers(0, round(self.duration_s * 1e9), self.points))
            after[0] = 0
            out.append((self.start_ns + round(k * self.period_s * 1e9), points, after))
        return out


def written(after_ns: NDArray[np.int64], stamp_ns: int, origin: str) -> NDArray[np.int64]:
    """Instants as a driver writes them [ns]: exact integers, before they get a unit and a type."""
    last = int(after_ns.max())
    zero = {
        "stamp": 0,
        "end": -last,
        "clock": stamp_ns,
        "boot": stamp_ns - EPOCH + 353_300_000_000,
        "hour": stamp_ns % 3_600_000_000_000,
    }[origin]
    return after_ns + zero


def field(values_ns: NDArray[np.int64], unit: str, kind: str) -> NDArray[np.generic]:
    """The values of a field: in whole units for integers, wrapped where the type is too short."""
    ns = 10**9 // PER_S[unit]
    if np.dtype(kind).kind == "f":
        return (values_ns / ns).astype(kind)
    return (values_ns // ns).astype(kind)  # a type that is too short wraps


def log(sensor: Sensor, name: str, unit: str, kind: str, origin: str) -> list[TimedCloud]:
    """The log of a sensor."""
    out = []
    for stamp, points, after in sensor.clouds():
        # a stamp at the end of a scan is that of its last point
        stamped = stamp + (int(after.max()) if origin == "end" else 0)
        values = field(written(after, stamp, origin), unit, kind)
        raw = of_points(points.astype(np.float32), stamped, "lidar", **{name: values})
        out.append(TimedCloud(raw, stamped))
    return out


def expected(sensor: Sensor, origin: str) -> list[NDArray[np.float64]]:
    return [
        1e-9 * (after - (int(after.max()) if origin == "end" else 0))
        for _, _, after in sensor.clouds()
    ]


def read(sample: list[TimedCloud], period_s: float | None, **options: object) -> list[Cloud]:
    meaning = meaning_of(sample, period_s, **options)
    return [canonical(one.raw, meaning, one.stamp_ns) for one in sample]


def meaning_of(sample: list[TimedCloud], period_s: float | None, **options: object) -> Meaning:
    return infer(sample, period_s, SourceOptions(**options))  # type: ignore[arg-type]


def step_s(kind: str, unit: str, largest_ns: float) -> float:
    """What a type resolves in a unit."""
    if np.dtype(kind).kind in "iu":
        return 1.0 / PER_S[unit]
    value = np.array(largest_ns / (10**9 // PER_S[unit]), dtype=kind)
    return float(np.spacing(value)) / PER_S[unit]


NAMES = st.sampled_from(
    ["t", "time", "timestamp", "time_stamp", "offset_time", "timeOffset", "ts", "point_time"]
)


@pytest.mark.slow
@settings(max_examples=150)
@given(
    NAMES,
    st.sampled_from(["f4", "f8", "u4", "i4"]),
    st.sampled_from(["s", "ms", "us", "ns"]),
    st.sampled_from(["stamp", "end", "clock", "boot", "hour"]),
    st.sampled_from([0.05, 0.1, 0.5, 1.0]),
    st.sampled_from([0.1, 0.4, 0.98]),
    st.sampled_from([EPOCH, SIMULATION]),
)
def test_instants_are_read_or_refused_whatever_their_name_type_unit_and_origin(
    name: str, kind: str, unit: str, origin: str, period_s: float, share: float, start_ns: int
) -> None:
    assume(not (origin == "end" and kind[0] == "u"))
    sensor = Sensor(period_s, share * period_s, start_ns)
    sample = log(sensor, name, unit, kind, origin)
    largest = max(int(abs(written(a, stamp, origin)).max()) for stamp, _, a in sensor.clouds())
    resolution = step_s(kind, unit, largest)
    meaning = meaning_of(sample, period_s)
    if meaning.refused or meaning.time is None:
        bits = 8 * np.dtype(kind).itemsize
        wraps = kind[0] in "iu" and largest * PER_S[unit] / 1e9 >= 2.0 ** (bits - 1)
        assert resolution > 0.01 * sensor.duration_s or wraps, (
            f"{meaning.inferences} although the field resolves {resolution} s"
        )
        return
    found = [canonical(one.raw, meaning, one.stamp_ns).times_s for one in sample]
    apart = [a - b for a, b in zip(found, expected(sensor, origin), strict=True) if a is not None]
    assert len(apart) == len(found)
    # the origin of another clock is not known: a constant, by which the points may be displaced
    constant = np.median(apart) if origin in ("boot", "hour") else 0.0
    assert abs(constant) < 1.3 * period_s
    assert np.abs(np.array(apart) - constant).max() < 2.0 * resolution + 1e-6 * period_s


@pytest.mark.parametrize("scans", [1, 2, 3])
@pytest.mark.parametrize(
    ("name", "kind", "unit", "origin"),
    [
        ("t", "u4", "ns", "stamp"),
        ("time", "f4", "s", "stamp"),
        ("timestamp", "f8", "s", "clock"),
        ("timestamp", "f8", "ns", "clock"),
        ("time_offset_ns", "i4", "ns", "stamp"),
    ],
)
def test_few_scans_are_enough_for_the_usual_fields(
    name: str, kind: str, unit: str, origin: str, scans: int
) -> None:
    sensor = Sensor(scans=scans)
    found = read(log(sensor, name, unit, kind, origin), 0.1 if scans > 1 else None)
    for cloud, want in zip(found, expected(sensor, origin), strict=True):
        np.testing.assert_allclose(cloud.times_s, want, atol=3e-7)


@pytest.mark.parametrize("pair", [("time_sec", "time_nsec"), ("timeSecond", "timeNanosecond")])
def test_seconds_and_nanoseconds_are_one_time(pair: tuple[str, str]) -> None:
    sensor, sample = Sensor(), list[TimedCloud]()
    for stamp, points, after in sensor.clouds():
        instants = [stamp + int(a) for a in after]
        columns = {
            pair[0]: np.array([t // 10**9 for t in instants], np.uint32),
            pair[1]: np.array([t % 10**9 for t in instants], np.uint32),
        }
        sample.append(TimedCloud(of_points(points, stamp, "", **columns), stamp))
    for cloud, want in zip(read(sample, 0.1), expected(sensor, "clock"), strict=True):
        np.testing.assert_allclose(cloud.times_s, want, atol=1e-8)


def test_the_field_with_information_is_used() -> None:
    sensor = Sensor()
    sample = [
        replace(
            one,
            raw=replace(one.raw, fields={"time": np.zeros(60, np.float32), **one.raw.fields}),
        )
        for one in log(sensor, "timestamp", "s", "f8", "clock")
    ]
    meaning = meaning_of(sample, 0.1)
    assert meaning.time is not None
    assert meaning.time.fields == ("timestamp",)
    assert any("'time' is not used" in each.evidence for each in meaning.inferences)


@pytest.mark.parametrize(("unit", "step"), [("s", "128 s"), ("ms", "131 s")])
def test_a_unix_time_in_float32_is_refused_by_name(unit: str, step: str) -> None:
    """What it resolves is stated: 2^7 s, or 2^17 ms."""
    meaning = meaning_of(log(Sensor(), "timestamp", unit, "f4", "clock"), 0.1)
    assert meaning.refused is not None
    assert "'timestamp'" in meaning.refused.finding
    assert "--point-time" in meaning.refused.option
    assert f"which resolves {step}" in meaning.refused.finding


@pytest.mark.parametrize(("unit", "step"), [("s", "0.0156 s"), ("ms", "0.016 s")])
def test_a_clock_that_resolves_too_little_is_refused_with_what_it_resolves(
    unit: str, step: str
) -> None:
    """Two days in float32: 2^-6 s, or 2^4 ms."""
    sample = []
    for stamp, points, after in Sensor().clouds():
        days = written(after, stamp, "clock") - EPOCH + 200_000 * 10**9
        raw = of_points(points.astype(np.float32), stamp, "lidar", t=field(days, unit, "f4"))
        sample.append(TimedCloud(raw, stamp))
    meaning = meaning_of(sample, 0.1)
    assert meaning.refused is not None
    assert f"'t': it resolves {step}, too little" in meaning.refused.finding


def test_the_offset_of_another_clock_is_found_and_said() -> None:
    sensor = Sensor()
    meaning = meaning_of(log(sensor, "timestamp", "s", "f8", "boot"), 0.1)
    assert meaning.time is not None
    assert meaning.time.offset_ns == pytest.approx(353_300_000_000 - EPOCH, abs=1e4)
    assert any(each.about == "point times" and each.grade == "check" for each in meaning.inferences)


def test_a_stated_reading_wins() -> None:
    sensor = Sensor()
    sample = log(sensor, "t", "us", "u4", "stamp")
    found = read(sample, 0.1, point_time="t:ns:stamp")
    np.testing.assert_allclose(found[0].times_s, 1e-3 * expected(sensor, "stamp")[0], atol=2e-9)
    assert read(sample, 0.1, point_time="none")[0].times_s is None
    with pytest.raises(BadMessage, match="no field 'absent'"):
        read(sample, 0.1, point_time="absent:ns:stamp")
    with pytest.raises(ValueError, match="FIELD:UNIT:ORIGIN"):
        SourceOptions(point_time="t:weeks:stamp")


@pytest.mark.parametrize("code", [(0.0, 0.0, 0.0), (0.0, 0.0, 65.535), (1.2, 0.0, -0.4)])
def test_a_repeated_point_is_no_return(code: tuple[float, float, float]) -> None:
    sensor = Sensor()
    sample, kept = list[TimedCloud](), list[NDArray[np.float32]]()
    for stamp, points, _ in sensor.clouds():
        coded = points.astype(np.float32)
        coded[::3] = code
        kept.append(coded[np.arange(60) % 3 > 0])
        sample.append(TimedCloud(of_points(coded, stamp), stamp))
    for cloud, want in zip(read(sample, 0.1), kept, strict=True):
        np.testing.assert_array_equal(cloud.points, want)
        assert cloud.dropped == 20
    raw = replace(sample[0].raw)
    stated = read(sample, 0.1, no_return="none")[0]
    assert stated.dropped == (20 if code == (0.0, 0.0, 0.0) else 0), "the origin is no return"
    assert len(raw) == 60
    named = read(sample, 0.1, no_return=",".join(map(str, code)))[0]
    assert named.dropped == 20


@pytest.mark.parametrize("largest", [65.535, 6.5535, 32.767])
def test_the_largest_number_of_a_depth_image_is_no_return(largest: float) -> None:
    sample, dropped = list[TimedCloud](), 15
    for stamp, points, _ in Sensor().clouds():
        coded = points.astype(np.float32) * np.float32(0.3)
        rays = coded[::4] / coded[::4, 2:]
        coded[::4] = rays * np.float32(largest)
        sample.append(TimedCloud(of_points(coded, stamp), stamp))
    for cloud in read(sample, 0.1):
        assert cloud.dropped == dropped
        assert cloud.points[:, 2].max() < 0.5 * largest


def test_the_largest_range_of_a_simulated_sensor_is_no_return() -> None:
    sample = list[TimedCloud]()
    for stamp, points, _ in Sensor().clouds():
        coded = points.copy()
        coded[::5] *= 30.0 / np.linalg.norm(coded[::5], axis=1)[:, None]
        sample.append(TimedCloud(of_points(coded.astype(np.float32), stamp), stamp))
    assert [cloud.dropped for cloud in read(sample, 0.1)] == [12] * 12


@settings(max_examples=20)
@given(st.integers(0, 2**32), st.sampled_from(["noise", "plane", "sampled", "millimetres"]))
def test_returns_are_not_taken_for_codes(seed: int, kind: str) -> None:
    """Points of a plane across the view, in whole millimetres, or drawn with repetition."""
    rng = np.random.Generator(np.random.PCG64(seed))
    sample = list[TimedCloud]()
    for k in range(5):
        points = rng.normal(size=(400, 3)) * 0.5 + [0.0, 0.0, 4.0]
        if kind == "plane":
            points[:, 2] = 4.0
        elif kind == "sampled":
            points = points[rng.integers(0, 50, 400)]
        elif kind == "millimetres":
            points = np.round(points, 3)
        sample.append(TimedCloud(of_points(points.astype(np.float32), k * 10**8), k * 10**8))
    assert [cloud.dropped for cloud in read(sample, 0.1)] == [0] * 5


def test_points_without_a_valid_instant_are_left_out() -> None:
    """Zeros beside times of day are no instants; a cloud without any is damaged."""
    sample = log(Sensor(), "timestamp", "s", "f8", "clock")
    stamps = sample[0].raw.fields["timestamp"].copy()
    stamps[5:9] = 0.0
    fields = {**sample[0].raw.fields, "timestamp": stamps}
    sample[0] = replace(sample[0], raw=replace(sample[0].raw, fields=fields))
    meaning = meaning_of(sample, 0.1)
    assert canonical(sample[0].raw, meaning).dropped == 4
    late = replace(sample[1].raw, stamp_ns=EPOCH + 10**12)
    with pytest.raises(BadMessage, match="times of its points"):
        canonical(late, meaning)


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8", ">f8"])
def test_bytes_in_the_other_order_than_declared_are_found(kind: str) -> None:
    sample, plain = list[TimedCloud](), list[NDArray[np.float64]]()
    for one in log(Sensor(), "t", "ns", "u4", "stamp"):
        fields = {n: v.astype(kind) if n in "xyz" else v for n, v in one.raw.fields.items()}
        raw = RawCloud(one.raw.stamp_ns, "", fields, one.raw.shape)
        plain.append(canonical(raw, Meaning()).points.astype(np.float64))
        adjacent = np.stack([fields[axis] for axis in "xyz"], axis=1).astype(kind).byteswap()
        wrong = {n: v.byteswap() for n, v in fields.items()}
        wrong |= {axis: adjacent[:, k] for k, axis in enumerate("xyz")}
        sample.append(replace(one, raw=replace(raw, fields=wrong)))
    meaning = meaning_of(sample, 0.1)
    assert meaning.swapped
    for one, want in zip(sample, plain, strict=True):
        found = canonical(one.raw, meaning)
        np.testing.assert_array_equal(found.points, want)
        assert memoryview(found.points).format in ("f", "d"), "as compiled code expects it"
        assert found.times_s is not None
    stated = meaning_of(sample, 0.1, byte_order=ByteOrder.DECLARED)
    assert not stated.swapped


def test_units_of_the_clouds() -> None:
    points = np.array([[1000.0, 0.0, 2000.0]] * 3 + [[10.0, 20.0, 30.0]], np.float32)
    raw = of_points(points)
    sample = [TimedCloud(raw, 5)]
    np.testing.assert_allclose(read(sample, None)[0].points, points)
    metres = read(sample, None, scan_unit=Unit.MM)[0].points
    np.testing.assert_allclose(metres, points * 1e-3, rtol=1e-6)
    whole = TimedCloud(of_points(points.astype(np.int32)), 5)
    np.testing.assert_allclose(read([whole], None)[0].points, points * 1e-3, rtol=1e-6)
    far = TimedCloud(of_points(np.array([[2.5e6, 0.0, 1e6], [1.0, 2.0, 3.0]])), 5)
    assert read([far], None)[0].dropped == 1
    assert read([far], None, scan_unit=Unit.MM)[0].dropped == 0, "the limit holds in metres"
