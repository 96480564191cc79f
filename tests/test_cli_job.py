"""Job files: ``info`` writes one, ``run`` replays it, and options on the command line win."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from log_cases import SECOND

from avsreplay.cli.job import job_text, read_job
from avsreplay.errors import UsageError
from avsreplay.log import LogWriter, SourceOptions
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
