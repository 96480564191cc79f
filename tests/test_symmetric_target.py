"""A target that an exact symmetry carries onto itself: a run follows one of its equal poses."""

from __future__ import annotations

import json
from itertools import islice

import numpy as np
import pytest
import trimesh
from trimesh.transformations import rotation_matrix

from avsreplay.log import SourceOptions
from avsreplay.result_dir import CHECKPOINT, ResultDirectory, ResultWriter
from avsreplay.run import Job, Run

SCENARIO = """
duration_s = 3.0
[target]
model = "two.ply"
[motion]
rate_radps = [0.08, -0.11, 0.05]
attitude_xyzw = [0.3, 0.5, -0.1, 0.8062]
"""


def _two_fold():
    """A box with two pairs of smaller ones; each pair is one part and itself turned by 180 deg
    about z.
    """
    parts = [trimesh.creation.box([1.0, 0.6, 0.4])]
    turned = rotation_matrix(np.pi, [0.0, 0.0, 1.0])
    for size, at in (
        ((0.3, 0.15, 0.3), (0.45, 0.3, 0.3)),
        ((0.5, 0.1, 0.2), (0.1, 0.4, -0.2)),
    ):
        part = trimesh.creation.box(size)
        part.apply_translation(at)
        parts += [part, part.copy().apply_transform(turned)]
    return trimesh.util.concatenate(parts)


@pytest.fixture(scope="module")
def symmetric_log(tmp_path_factory, cli):
    folder = tmp_path_factory.mktemp("symmetric")
    _two_fold().export(folder / "two.ply")
    (folder / "two.toml").write_text(SCENARIO)
    assert cli("record", folder / "two.toml", "-o", folder / "two.mcap").code == 0
    return folder / "two.mcap"


@pytest.mark.slow
def test_a_run_follows_one_of_two_equal_poses_and_names_the_other(cli, symmetric_log):
    rows = json.loads(cli("run", symmetric_log, "--init", "auto", "--json").out)["rows"]
    assert all(row["gamma"] == 1 for row in rows)
    assert max(row["rot_err_deg"] for row in rows) < 1.0  # of the pose that is followed
    assert max(row["pos_err_m"] for row in rows) < 0.005
    other = rows[0]["message"].split("--init ")[1]
    again = json.loads(cli("run", symmetric_log, "--init", other, "--json").out)["rows"]
    assert max(row["rot_err_deg"] for row in again) < 1.0
    first, second = ([row[f"q{x}"] for x in "xyzw"] for row in (rows[-1], again[-1]))
    assert abs(np.dot(first, second)) < 0.02  # they differ by half a turn


@pytest.mark.slow
def test_a_continued_run_follows_the_same_pose(symmetric_log, tmp_path):
    job = Job(source=symmetric_log, options=SourceOptions(), assignments=("init=auto",))
    for name, stop in (("whole", None), ("parts", 5), ("parts", None)):
        folder = ResultDirectory(tmp_path / name, overwrite=(tmp_path / name).exists())
        with Run(job) as run, ResultWriter(folder, run) as writer:
            if (tmp_path / name / CHECKPOINT).exists():
                writer.resume({"config": run.facts()["config"]})
            for _ in islice(run.rows(writer.listeners), stop):
                pass
            writer.finish(run.facts(), resumable=stop is not None)
    files = [(tmp_path / name / "rows.jsonl").read_bytes() for name in ("whole", "parts")]
    assert files[0] == files[1]
