"""The source of the first pose of a replay: not the ground truth, unless the configuration
names it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avsreplay import build
from avsreplay.config import RunConfig
from avsreplay.errors import UsageError
from avsreplay.geometry import IDENTITY_QUAT, Pose
from avsreplay.log import SourceOptions
from avsreplay.records import LogHeader, Scan, Truth
from avsreplay.run import Job, Run

LOG = Path(__file__).parents[1] / "fixtures" / "tumble.mcap"
SCAN = Scan(0, 0, np.zeros((0, 3)))
TRUE = Pose(IDENTITY_QUAT, np.array([1.0, 2.0, 3.0]))


def _first_pose(init, truth):
    return build.first_pose_source(RunConfig(init=init), LogHeader(), lambda scan: Truth(truth))(
        SCAN
    )


def test_a_true_pose_in_the_log_does_not_begin_the_replay():
    assert _first_pose("log", TRUE) == (None, "acquired")


def test_the_true_pose_begins_the_replay_where_it_is_asked_for():
    assert _first_pose("truth", TRUE) == (TRUE, "truth")
    with pytest.raises(UsageError, match="no true pose at its first scan"):
        _first_pose("truth", None)


def test_a_given_pose_begins_the_replay():
    pose, origin = _first_pose("0,0,5,0,0,0,1", TRUE)
    assert origin == "given"
    np.testing.assert_array_equal(pose.t, [0.0, 0.0, 5.0])


def test_a_log_without_a_start_is_searched_and_the_rows_say_so():
    """The fixture without its initial state, with its true poses: the same as a search
    without a guess.
    """
    rows = {}
    for init in ("log", "auto"):
        with Run(
            Job(source=LOG, options=SourceOptions(n_scans=1), assignments=(f"init={init}",))
        ) as run:
            header = replace(run.source.header, start=None)
            run.stages = build.stages(
                run.config,
                header,
                run.surface,
                run.registrar,
                run.source.truth_of,
                build.task_and_target(
                    run.config,
                    run.surface,
                    build.target_geometry(run.surface, run.config.fixture_axis_c),
                ),
            )
            (rows[init],) = run.rows()
    assert rows["log"] == rows["auto"]
    assert rows["log"].guess == "acquired"
    assert rows["log"].pos_err_m is not None
