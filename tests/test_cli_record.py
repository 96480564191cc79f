"""A log converted by rosbags to a ROS 1 bag, to sqlite3 and back gives the same scans and the same
rows.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from rosbags.convert.converter import convert
from rosbags.typesys import Stores, get_typestore
from true_scans import true_scans

from avsreplay.log import SourceOptions, open_source
from avsreplay.rows import Row
from avsreplay.run import Job, Run

LOG = Path(__file__).parents[1] / "fixtures" / "tumble.mcap"
FIRST = 10


def converted(source: Path, to: Path, storage: str) -> Path:
    """By rosbags' own converter; ``/faults`` and ``/tf_static`` have no like in ROS 1 and
    stay behind.
    """
    ros2 = get_typestore(Stores.ROS2_HUMBLE)
    target = get_typestore(Stores.ROS1_NOETIC) if to.suffix == ".bag" else ros2
    skipped = ["/faults", "/tf_static"]
    convert([source], to, storage, 9, None, "none", ros2, target, skipped, [], [], [])
    return to


def rows(path: Path, model: Path) -> list[Row]:
    options = SourceOptions(model=model, n_scans=FIRST)
    with Run(
        Job(source=path, options=options, assignments=("init=truth", "estimator.start=paper"))
    ) as run:
        return [dataclasses.replace(row, fault=None) for row in run.rows()]


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("converted")
    with open_source(LOG) as source:
        surface = source.header.surface
    assert surface is not None
    (folder / surface.name).write_bytes(surface.data)
    ros1 = converted(LOG, folder / "a.bag", "")
    sqlite = converted(LOG, folder / "db", "sqlite3")
    back = converted(sqlite, folder / "back", "mcap")
    # A log's first belief and labels do not survive a conversion: the first is taken through one as
    # well.
    plain = converted(LOG, folder / "plain", "mcap")
    return {
        "model": folder / surface.name,
        "plain": plain,
        "ros1": ros1,
        "sqlite": sqlite,
        "back": back,
    }


@pytest.mark.parametrize("name", ["plain", "ros1", "sqlite", "back"])
def test_clouds_are_recorded_bit_for_bit(logs: dict[str, Path], name: str) -> None:
    with open_source(LOG) as source, open_source(logs[name]) as other:
        for one, two in zip(true_scans(source), true_scans(other), strict=True):
            assert one.points.tobytes() == two.points.tobytes()
            assert (one.t_ns, one.log_ns, one.status) == (two.t_ns, two.log_ns, two.status)
            assert (one.truth is None) == (two.truth is None)
            if one.truth is not None and two.truth is not None:
                assert one.truth.matrix.tobytes() == two.truth.matrix.tobytes()


def test_the_same_rows(logs: dict[str, Path]) -> None:
    first = rows(logs["plain"], logs["model"])
    assert len(first) == FIRST
    for name in ("ros1", "sqlite", "back"):
        assert rows(logs[name], logs["model"]) == first, name
