"""``info`` and ``doctor`` through the real command line, and what ``doctor --repair`` writes."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from log_cases import SECOND, header, scans, write
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader

from avsreplay.cli.main import entry_point
from avsreplay.log import open_source
from avsreplay.log.cdr import point_cloud2, schema_text
from avsreplay.log.doctor import Severity, examine, repair
from avsreplay.records import LogHeader, Scan

CLOUDS = scans(20, 100)
CLOUD = "sensor_msgs/msg/PointCloud2"


def run(*args: object) -> subprocess.CompletedProcess[str]:
    """The command line's own entry point, in this process: the output and the exit code."""
    out, err, before = io.StringIO(), io.StringIO(), sys.argv
    sys.argv = ["avsreplay", *map(str, args)]
    try:
        with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as ended:
            entry_point()
    finally:
        sys.argv = before
    return subprocess.CompletedProcess(
        sys.argv, int(ended.value.code or 0), out.getvalue(), err.getvalue()
    )


def test_the_command_itself(whole: Path) -> None:
    args = [sys.executable, "-m", "avsreplay", "info", str(whole)]
    done = subprocess.run(args, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == run("info", whole).stdout
    assert done.stderr == ""


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    write(tmp_path / "whole.mcap", header(np.random.Generator(np.random.PCG64(1))), CLOUDS)
    return tmp_path / "whole.mcap"


@pytest.fixture
def damaged(whole: Path) -> Path:
    """A flipped bit in the middle and a cut end."""
    data = bytearray(whole.read_bytes())
    with open_source(whole) as source:
        assert len(source) == 20
    data[len(data) // 2] ^= 1
    path = whole.with_name("damaged.mcap")
    path.write_bytes(data[: int(0.8 * len(data))])
    return path


def about(path: Path) -> dict[str, list[tuple[Severity, str]]]:
    out: dict[str, list[tuple[Severity, str]]] = {}
    for finding in examine(path)[1]:
        out.setdefault(finding.about, []).append((finding.severity, finding.text))
    return out


def test_info_describes_a_log(whole: Path) -> None:
    done = run("info", whole)
    assert done.returncode == 0
    for word in (
        "/points",
        "part.ply",
        "seed 7",
        "occlusion",
        "20 on /points",
        "median period 0.5000 s",
    ):
        assert word in done.stdout
    told = json.loads(run("info", whole, "--json").stdout)
    assert told["scans"] == 20
    assert [f["kind"] for f in told["faults"]] == ["occlusion", "dropped", "bias"]
    assert told["topics"][1]["rate_hz"] == pytest.approx(2.0)
    with whole.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    kinds = {chunk.compression or "uncompressed" for chunk in summary.chunk_indexes}
    assert told["chunks"] == f"{len(summary.chunk_indexes)} {kinds.pop()}"
    assert not kinds


def test_info_exits_with_4_on_a_damaged_log_and_3_without_one(damaged: Path) -> None:
    done = run("info", damaged)
    assert done.returncode == 4
    assert "lost:" in done.stdout
    assert "Traceback" not in done.stderr
    assert run("info", damaged.with_name("none.mcap")).returncode == 3


def test_an_intact_log_has_no_finding_worse_than_a_gap(whole: Path) -> None:
    found = examine(whole)[1]
    assert {f.severity for f in found} <= {Severity.OK, Severity.NOTE}
    done = run("doctor", whole)
    assert done.returncode == 0
    assert "all are correct" in done.stdout


def test_every_damaged_place_is_reported(damaged: Path) -> None:
    done = run("doctor", damaged, "--json")
    assert done.returncode == 4
    findings = json.loads(done.stdout)["findings"]
    errors = [f for f in findings if f["severity"] == "error"]
    assert len(errors) >= 2
    assert all(f["about"] == "damage" for f in errors)
    assert run("doctor", damaged, "--strict").returncode == 3


def test_a_repaired_log_opens_in_other_readers_with_all_intact_records(damaged: Path) -> None:
    out = damaged.with_name("clean.mcap")
    done = run("doctor", damaged, "--repair", out)
    assert done.returncode == 4, "the log that was examined is still damaged"
    assert run("doctor", out).returncode == 0
    with open_source(damaged) as source:
        kept = [(s.t_ns, s.points.tobytes()) for s in source.scans()]
        labels = [label.kind for label in source.header.labels]
    with open_source(out) as source:
        assert [(s.t_ns, s.points.tobytes()) for s in source.scans()] == kept
        assert [label.kind for label in source.header.labels] == labels
        assert source.header.surface is not None
    with AnyReader([out]) as reader:
        assert sum(c.topic == "/points" for c, _, _ in reader.messages()) == len(kept)
    with out.open("rb") as file:
        reader2 = make_reader(file, validate_crcs=True)
        assert reader2.get_summary().statistics.message_count == sum(
            1 for _ in reader2.iter_messages()
        )


def test_repair_does_not_overwrite_and_rejects_other_formats(damaged: Path) -> None:
    assert run("doctor", damaged, "--repair", damaged).returncode == 2
    other = damaged.with_name("other.mcap")
    other.write_bytes(b"mine")
    assert run("doctor", damaged, "--repair", other).returncode == 2
    assert other.read_bytes() == b"mine"
    assert run("doctor", damaged, "--repair", other, "--overwrite").returncode == 4
    assert run("doctor", other).returncode == 0
    assert run("doctor", damaged, "--repair", damaged.parent / "no" / "x.mcap").returncode in (2, 3)
    assert not list(damaged.parent.glob("*.partial"))


def test_clouds_that_cannot_be_decoded_are_left_out_of_a_repair(tmp_path: Path) -> None:
    stream = io.BytesIO()
    writer = McapWriter(stream)
    writer.start("ros2")
    channel = writer.register_channel(
        "/p", "cdr", writer.register_schema(CLOUD, "ros2msg", schema_text(CLOUD))
    )
    for c in CLOUDS:
        payload = point_cloud2(c.t_ns, "s", c.points, None)
        writer.add_message(channel, c.log_ns, payload[:100] if c.seq == 3 else payload, c.log_ns)
    writer.finish()
    path = tmp_path / "a.mcap"
    path.write_bytes(stream.getvalue())
    assert any("cannot be decoded" in text for _, text in about(path)["scans"])
    done = repair(path, tmp_path / "b.mcap")
    assert (done.messages, len(done.dropped)) == (19, 1)
    assert "scans" not in about(tmp_path / "b.mcap")


def test_gaps_duplicates_points_clocks_and_layouts_are_reported(tmp_path: Path) -> None:
    clouds = []
    for i, c in enumerate(CLOUDS):
        points = CLOUDS[5].points if i == 6 else c.points.copy()
        if i == 8:
            points = np.full((10, 3), np.nan, np.float32)
        if i == 9:
            points = points.copy()
            points[0] = np.nan
        t_ns = c.t_ns + (20 * SECOND if i > 14 else 0)
        times = np.zeros(len(points), np.float32) if i == 12 else None
        stamp = t_ns + (50 * SECOND if i == 11 else 0)
        clouds.append(Scan(i, stamp, points, times_s=times, log_ns=t_ns))
    write(tmp_path / "a.mcap", LogHeader(), clouds)
    found = about(tmp_path / "a.mcap")
    assert found["gaps"][0][0] is Severity.WARNING
    assert "the widest 20.5" in found["gaps"][0][1]
    assert found["duplicates"] == [(Severity.WARNING, "1 are identical to the previous scan")]
    assert "1 of 20 have no finite point" in found["scans"][0][1]
    assert "0.58 % no returns" in found["points"][0][1]
    assert found["clock"][0] == (Severity.WARNING, "1 stamps jump")
    assert len(found["layout"]) == 2
    assert found["model"][0][0] is Severity.NOTE


def test_an_invalid_summary_is_an_error(whole: Path) -> None:
    data = bytearray(whole.read_bytes())
    data[-60] ^= 1
    whole.write_bytes(data)
    found = about(whole)
    assert found["summary"][0][0] is Severity.ERROR
    repair(whole, whole.with_name("b.mcap"))
    assert "summary" not in about(whole.with_name("b.mcap"))


def test_damage_outside_chunks_is_found_by_the_data_checksum(whole: Path) -> None:
    data = bytearray(whole.read_bytes())
    at = data.index(b"application/octet-stream")
    data[at - 30] ^= 0x20  # a time in the head of the attachment: its own checksum holds it
    whole.write_bytes(data)
    assert any(
        severity is Severity.ERROR for texts in about(whole).values() for severity, _ in texts
    )


def test_control_characters_in_names_are_escaped(tmp_path: Path) -> None:
    nasty = "/p\x1b]0;owned\x07\x1b[31m\u202egnp\n"
    stream = io.BytesIO()
    writer = McapWriter(stream)
    writer.start("ros2\x1b[2J")
    channel = writer.register_channel(
        nasty, "cdr", writer.register_schema(CLOUD, "ros2msg", schema_text(CLOUD))
    )
    for c in CLOUDS[:3]:
        writer.add_message(
            channel, c.log_ns, point_cloud2(c.t_ns, "f\x1b[1m", c.points, None), c.log_ns
        )
    writer.finish()
    (tmp_path / "a.mcap").write_bytes(stream.getvalue())
    for args in (
        ("info", tmp_path / "a.mcap"),
        ("doctor", tmp_path / "a.mcap"),
        ("info", "--topic", nasty + "x", tmp_path / "a.mcap"),
    ):
        done = run(*args)
        assert "\x1b" not in done.stdout + done.stderr
        assert "\u202e" not in done.stdout + done.stderr
        assert "\x07" not in done.stdout + done.stderr
    assert "\\x1b" in run("info", tmp_path / "a.mcap").stdout


def test_an_attachment_with_a_parent_path_writes_nothing_outside(tmp_path: Path) -> None:
    stream = io.BytesIO()
    writer = McapWriter(stream)
    writer.start("ros2")
    writer.add_attachment(
        0, 0, "../../evil.ply", "x", b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n"
    )
    channel = writer.register_channel(
        "/p", "cdr", writer.register_schema(CLOUD, "ros2msg", schema_text(CLOUD))
    )
    writer.add_message(channel, 5, point_cloud2(5, "c", CLOUDS[0].points, None), 5)
    writer.finish()
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    (inner / "a.mcap").write_bytes(stream.getvalue())
    for args in (("info",), ("doctor",), ("doctor", "--repair", inner / "out.mcap")):
        done = run(args[0], inner / "a.mcap", *args[1:])
        assert "Traceback" not in done.stderr
    assert sorted(p.name for p in tmp_path.rglob("*") if p.is_file()) in (
        ["a.mcap"],
        ["a.mcap", "out.mcap"],
    )
