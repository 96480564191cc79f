"""The viewer layout refers only to its own panels and to topics of the result log."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from mcap.reader import make_reader

from avsreplay.geometry import Pose
from avsreplay.log.result_log import ResultFrame, ResultLog
from avsreplay.records import Surface
from avsreplay.report.export import write_layout
from avsreplay.rows import columns


def _leaves(node):
    return [node] if isinstance(node, str) else [*_leaves(node["first"]), *_leaves(node["second"])]


@pytest.fixture
def layout(tmp_path):
    write_layout(tmp_path / "layout.json")
    return json.loads((tmp_path / "layout.json").read_text(encoding="utf-8"))


def test_the_tree_holds_every_panel_once(layout):
    assert sorted(_leaves(layout["layout"])) == sorted(layout["configById"])


def _topics(tmp_path):
    path = tmp_path / "result.mcap"
    surface = Surface(np.eye(3), np.array([[0, 1, 2]], np.int32), "m", "0" * 64)
    names = [column.name for column in columns()]
    log = ResultLog(path, surface, {"version": "1"}, np.eye(3)[[0, 1]], names)
    pose = Pose.identity()
    log.write(
        ResultFrame(
            t_ns=5,
            points=np.eye(3),
            estimate=pose,
            covariance=np.eye(6),
            registration=pose,
            truth=pose,
            path=(np.zeros(2), np.zeros((2, 3))),
            healthy=True,
            message="ok",
            values={"rms_m": 0.1},
            columns=[1.0] * len(names),
        )
    )
    log.close()
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    schemas = summary.schemas.values()
    fields = next(
        schema.data.decode().split() for schema in schemas if schema.name == "avsreplay/msg/Row"
    )
    return {channel.topic for channel in summary.channels.values()} | {
        f"/rows.{name}" for name in fields[1::2]
    }


def test_every_topic_it_names_is_written(layout, tmp_path):
    named = set(re.findall(r'"(/rows[.]\w+|/[a-z0-9_/]+)', json.dumps(layout)))
    assert named
    assert named <= _topics(tmp_path)
    assert {"/plan/cone", "/truth/model", "/rosout", "/rows.nis"} <= named
