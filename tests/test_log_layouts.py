"""Layouts of the clouds of drivers, generated: what is inferred from their values.

docs/drivers.md has the same table; a test compares the two.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from test_log_canonical import EPOCH, Sensor, expected, field, meaning_of, written

from avsreplay.binary_files import BadFile
from avsreplay.log.canonical import canonical
from avsreplay.log.point_times import TimedCloud
from avsreplay.log.raw_cloud import of_points
from avsreplay.log.scan_files import bin_columns

PAGE = Path(__file__).parents[1] / "docs" / "drivers.md"
SIDE = {"intensity": "f4", "ring": "u2"}


class Layout(NamedTuple):
    """Fields of a driver besides x, y and z; ``time``: name, type, unit, origin of the times;
    ``code``: missing returns.
    """

    driver: str
    others: dict[str, str]
    time: tuple[str, str, str, str] | None = None
    code: str = ""


LAYOUTS = (
    Layout(
        "Livox CustomMsg (Avia, Mid-360)",
        {"reflectivity": "u1", "tag": "u1", "line": "u1"},
        ("offset_time", "u4", "ns", "stamp"),
        "0,0,0",
    ),
    Layout(
        "livox_ros_driver2 PointXYZRTLT",
        {"intensity": "f4", "tag": "u1", "line": "u1"},
        ("timestamp", "f8", "ns", "clock"),
        "0,0,0",
    ),
    Layout("livox_ros_driver PointXYZRTL", {"intensity": "f4", "tag": "u1", "line": "u1"}),
    Layout(
        "Ouster",
        {"intensity": "f4", "reflectivity": "u2", "ring": "u2", "ambient": "u2", "range": "u4"},
        ("t", "u4", "ns", "stamp"),
        "0,0,0",
    ),
    Layout("MulRan, Newer College (Ouster)", SIDE, ("t", "u4", "ns", "stamp"), "0,0,0"),
    Layout("Velodyne PointXYZIRT", SIDE, ("time", "f4", "s", "stamp"), "nan"),
    Layout("Velodyne, stamp of the last packet", SIDE, ("time", "f4", "s", "end")),
    Layout("Hesai", SIDE, ("timestamp", "f8", "s", "clock"), "nan"),
    Layout("Hesai, clock since start", SIDE, ("timestamp", "f8", "s", "boot")),
    Layout(
        "RoboSense XYZIRT",
        {"intensity": "u1", "ring": "u2"},
        ("timestamp", "f8", "s", "clock"),
        "nan",
    ),
    Layout("RoboSense XYZI", {"intensity": "u1"}, None, "nan"),
    Layout("LeiShen, single precision", SIDE, ("time", "f4", "s", "stamp")),
    Layout("LeiShen, double precision", SIDE, ("time", "f8", "s", "stamp")),
    Layout("Aeva", {"velocity": "f4"}, ("time_offset_ns", "i4", "ns", "stamp")),
    Layout(
        "Nebula PointXYZVIRCAEDT (Aeva)",
        {
            "v": "f4",
            "intensity": "u1",
            "return_type": "u1",
            "channel": "u2",
            "azimuth": "f4",
            "elevation": "f4",
            "distance": "f4",
        },
        ("time_stamp", "u4", "ns", "stamp"),
    ),
    Layout(
        "Autoware PointXYZIRCAEDT",
        {
            "intensity": "u1",
            "return_type": "u1",
            "channel": "u2",
            "azimuth": "f4",
            "elevation": "f4",
            "distance": "f4",
        },
        ("time_stamp", "u4", "ns", "stamp"),
    ),
    Layout(
        "Nebula PointXYZIRADT",
        {"intensity": "f4", "ring": "u2", "azimuth": "f4", "distance": "f4", "return_type": "u1"},
        ("time_stamp", "f8", "s", "clock"),
    ),
    Layout("Unitree L1", SIDE, ("time", "f4", "s", "stamp")),
    Layout("Seyond", {"intensity": "f4"}, ("timestamp", "f8", "s", "clock")),
    Layout("SICK multiScan", {"i": "f4", "ring": "i1"}, ("t", "u4", "ns", "stamp")),
    Layout("SICK multiScan, field ts", {"i": "f4"}, ("ts", "f4", "s", "stamp")),
    Layout("microseconds", {"i": "f4", "ring": "i1"}, ("t", "u4", "us", "stamp")),
    Layout("RealSense", {"rgb": "f4"}, None, "0,0,0"),
    Layout("Azure Kinect", {"rgb": "f4"}, None, "nan"),
    Layout("Zivid", {"rgba": "u4"}, None, "nan"),
    Layout("Photoneo", {"normal_x": "f4", "normal_y": "f4", "normal_z": "f4"}, None, "0,0,0"),
    Layout("depth camera of 16 bits in mm", {}, None, "z=65.535"),
    Layout("KITTI", {"intensity": "f4"}),
    Layout("CARLA", {"intensity": "f4"}),
    Layout("Gazebo", SIDE, None, "inf"),
    Layout("simulated sensor of 30 m range", {}, None, "range=30"),
)


def log(layout: Layout) -> tuple[list[TimedCloud], list[np.ndarray]]:  # type: ignore[type-arg]
    """A log of this driver, and which points are returns."""
    sample, returns = [], []
    origin = layout.time[3] if layout.time else ""
    for stamp, points, after in Sensor().clouds():
        rng = np.random.Generator(np.random.PCG64(stamp % 1000))
        missing = (np.arange(len(points)) % 4 == 3) & bool(layout.code)
        coded = _coded(points.copy(), missing, layout.code).astype(np.float32)
        columns = {
            name: rng.integers(0, 100, len(points)).astype(kind)
            for name, kind in layout.others.items()
        }
        stamped = stamp + (int(after.max()) if origin == "end" else 0)
        if layout.time:
            name, kind, unit, _ = layout.time
            columns[name] = field(written(after, stamp, origin), unit, kind)
        sample.append(TimedCloud(of_points(coded, stamped, "lidar", **columns), stamped))
        returns.append(~missing)
    return sample, returns


def _coded(points: np.ndarray, missing: np.ndarray, code: str) -> np.ndarray:  # type: ignore[type-arg]
    if code.startswith("range="):
        away = np.linalg.norm(points[missing], axis=1)[:, None]
        points[missing] *= float(code[6:]) / away
    elif code.startswith("z="):
        points[missing] *= float(code[2:]) / points[missing, 2:]
    elif code:
        points[missing] = [float(word) for word in code.split(",")] * (1 if "," in code else 3)
    return points


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.driver)
def test_the_layout_of_a_driver_is_read(layout: Layout) -> None:
    sample, returns = log(layout)
    meaning = meaning_of(sample, 0.1)
    assert meaning.refused is None
    assert (meaning.time is None) == (layout.time is None)
    wanted = expected(Sensor(), layout.time[3] if layout.time else "")
    for one, kept, after in zip(sample, returns, wanted, strict=True):
        cloud = canonical(one.raw, meaning, one.stamp_ns)
        assert cloud.dropped == np.count_nonzero(~kept)
        np.testing.assert_array_equal(
            cloud.points, np.stack([one.raw.column(axis) for axis in "xyz"], axis=1)[kept]
        )
        if layout.time:
            assert meaning.time is not None
            assert meaning.time.unit.value == layout.time[2]
            np.testing.assert_allclose(cloud.times_s, after[kept], rtol=0.0, atol=2e-6)


def test_the_page_of_drivers_has_every_layout() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for layout in LAYOUTS:
        assert f"| {layout.driver} |" in text
        if layout.time:
            assert f"`{layout.time[0]}` {layout.time[1]}" in text
    assert EPOCH > 0


@pytest.mark.parametrize("columns", [4, 5])
def test_the_columns_of_a_bin_file_are_inferred(columns: int) -> None:
    """KITTI has four; sweeps of nuScenes have five, the last one the ring."""
    rng = np.random.Generator(np.random.PCG64(columns))
    turn = np.linspace(0.0, 6.2, 1600)
    table = np.stack(
        [
            10.0 * np.cos(turn),
            10.0 * np.sin(turn),
            rng.normal(size=1600) * 0.3,
            rng.uniform(0.0, 255.0 if columns == 5 else 1.0, 1600),
            np.arange(1600) % 32,
        ],
        axis=1,
    )[:, :columns].astype("<f4")
    assert bin_columns(table.tobytes()) == columns
    with pytest.raises(BadFile):
        bin_columns(table.tobytes()[:-3])
