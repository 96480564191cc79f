"""Job files: ``info`` writes one, ``run`` replays it, and options on the command line win."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from log_cases import SECOND
from mcap.writer import Writer

from avsreplay.errors import UsageError
from avsreplay.geometry import Pose
from avsreplay.job_file import job_text, read_job
from avsreplay.log import LogWriter, SourceOptions
from avsreplay.log.cdr import point_cloud2, pose_stamped, schema_text, transform
from avsreplay.log.header import surface_bytes
from avsreplay.log.options import Unit
from avsreplay.records import LogHeader, Scan
from avsreplay.register.contract import boxes, example_pose, view


@pytest.fixture(scope="module")
def millimetres(tmp_path_factory) -> Path:  # type: ignore[no-untyped-def]
    """A log of clouds in millimetres, and its model in metres beside it."""
    folder, surface, pose = tmp_path_factory.mktemp("job"), boxes(), example_pose()
    (folder / "model.ply").write_bytes(surface_bytes(surface))
    with LogWriter(folder / "scans.mcap", LogHeader()) as writer:
        for k in range(4):
            rng = np.random.Generator(np.random.PCG64(k))
            seen = pose.apply(view(surface, 1500, pose.inverse().t))
            points = 1000.0 * (seen + rng.normal(scale=0.002, size=seen.shape))
            t_ns = SECOND * (k + 1)
            writer.write(Scan(k, t_ns, points.astype(np.float32), log_ns=t_ns))
            writer.write_truth(t_ns, t_ns, pose)
    return folder


def test_a_job_file_is_read_back(tmp_path: Path) -> None:
    options = SourceOptions(
        model=tmp_path / "m.stl",
        scan_unit=Unit.MM,
        crop_range=(1.0, 2.5),
        point_time="t:us:stamp",
        fixed_frame='an "odd" frame',
    )
    text = job_text(
        tmp_path / "a.bag", options, ["init=cold"], {"scan_unit": "two\nlines"}, tmp_path / "jobs"
    )
    (tmp_path / "jobs").mkdir()
    (tmp_path / "jobs" / "job.toml").write_text(text)
    job = read_job(tmp_path / "jobs" / "job.toml")
    assert job is not None
    assert job.log.resolve() == tmp_path / "a.bag"
    assert job.assignments == ("init=cold",)
    given = dict(job.given)
    assert given.pop("model").resolve() == tmp_path / "m.stl"
    assert SourceOptions(**given, model=tmp_path / "m.stl") == options
    assert "# two lines" in text


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ('log = "a"\nlogs = 1', "unknown key 'logs'"),
        ('log = "a"\nset = "x=1"', "list of texts"),
        ('log = "a"\n[input]\nscan_units = "mm"', "scan_unit"),
        ('log = "a"\n[input]\nevery = -3', "job.toml:3"),
    ],
)
def test_a_wrong_job_file_is_refused_with_its_line(tmp_path: Path, text: str, word: str) -> None:
    (tmp_path / "job.toml").write_text(text)
    with pytest.raises(UsageError) as found:
        read_job(tmp_path / "job.toml")
    assert word in str(found.value)


@pytest.mark.slow
def test_info_tries_its_advice_and_run_replays_the_job(cli, millimetres, tmp_path) -> None:  # type: ignore[no-untyped-def]
    job = tmp_path / "job.toml"
    log, model = millimetres / "scans.mcap", millimetres / "model.ply"
    done = cli("info", log, "--model", model, "--write", job, "--json")
    assert done.code == 0, done.err
    checks = {check["about"]: check for check in json.loads(done.out)["checks"]}
    assert checks["unit"]["option"] == "--scan-unit mm"
    assert checks["replay"]["text"].startswith("4 of the first 4 scans are used")
    table = tomllib.loads(job.read_text())
    assert table["input"]["scan_unit"] == "mm"
    replayed = cli("run", job, "--json")
    assert replayed.code == 0, replayed.err
    assert all(row["gamma"] for row in json.loads(replayed.out)["rows"])
    kept = tmp_path / "kept"
    assert cli("run", job, "-o", kept).code == 0
    record = json.loads((kept / "run.json").read_text())
    assert record["clouds"]["unit_m"] == 0.001
    wins = cli("run", job, "--json", "--n-scans", "2", "--scan-unit", "m")
    rows = json.loads(wins.out)["rows"]
    assert len(rows) == 2
    assert not any(row["gamma"] for row in rows)
    assert cli("info", log, "--model", model, "--write", job).code == 2, "the file exists"


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["lidar", "map"])
def test_a_fixed_frame_is_advised_only_where_the_true_poses_are_in_it(cli, tmp_path, frame) -> None:  # type: ignore[no-untyped-def]
    """The sensor stands in ``map``, as a recording of /tf states; the truth is in either frame."""
    surface, seen_at, in_map = boxes(), example_pose(), Pose(np.eye(4)[3], [1.0, -2.0, 0.5])
    (tmp_path / "model.ply").write_bytes(surface_bytes(surface))
    truth = seen_at if frame == "lidar" else in_map @ seen_at
    with (tmp_path / "scans.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        channels = {
            topic: writer.register_channel(
                topic, "cdr", writer.register_schema(kind, "ros2msg", schema_text(kind))
            )
            for topic, kind in (
                ("/points", "sensor_msgs/msg/PointCloud2"),
                ("/true", "geometry_msgs/msg/PoseStamped"),
                ("/tf", "tf2_msgs/msg/TFMessage"),
            )
        }
        for k in range(4):
            rng, t_ns = np.random.Generator(np.random.PCG64(k)), SECOND * (k + 1)
            points = seen_at.apply(view(surface, 1500, seen_at.inverse().t))
            points += rng.normal(scale=0.002, size=points.shape)
            for topic, message in (
                ("/tf", transform(t_ns, "map", "lidar", in_map)),
                ("/true", pose_stamped(t_ns, frame, truth)),
                ("/points", point_cloud2(t_ns, "lidar", points, None)),
            ):
                writer.add_message(channels[topic], t_ns, message, t_ns)
        writer.finish()
    options = ("--model", tmp_path / "model.ply", "--truth-topic", "/true")
    done = cli(
        "info", tmp_path / "scans.mcap", *options, "--write", tmp_path / "job.toml", "--json"
    )
    assert done.code == 0, done.err
    advised = tomllib.loads((tmp_path / "job.toml").read_text())["input"].get("fixed_frame")
    assert advised == (None if frame == "lidar" else "map")
    replay = [check for check in json.loads(done.out)["checks"] if check["about"] == "replay"]
    assert [check["grade"] for check in replay] == ["ok"]
