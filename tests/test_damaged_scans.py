"""A scan that cannot be decoded: the same rule in every command that reads scans
(docs/conventions.md).
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from avsreplay.cli.main import group
from avsreplay.cli.options import report_losses
from avsreplay.errors import AvsError, DataLost
from avsreplay.log import open_source
from avsreplay.log.header import surface_bytes
from avsreplay.log.source import UNKNOWN_SENSOR
from avsreplay.report.jsonl import read_rows

HEAD = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n" + "".join(
    f"property float {axis}\n" for axis in "xyz"
)
BROKEN, SCANS = 5, 12
COMMANDS = {
    "info": ("info", "FOLDER", "--model", "MODEL"),
    "doctor": ("doctor", "FOLDER"),
    "run": ("run", "FOLDER", "--model", "MODEL", "--rate", "3"),
    "record": ("record", "FOLDER", "-o", "OUT.mcap"),
    "odometry": ("odometry", "FOLDER", "-o", "OUT.tum"),
    "observability": ("observability", "FOLDER", "--model", "MODEL", "--rate", "3"),
    "bench": ("bench", "FOLDER", "--model", "MODEL", "--backends", "horn"),
}


@pytest.fixture(scope="module")
def scans(fixtures_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of scans of a tumbling target, one of which is truncated, and beside it the
    model.
    """
    folder = tmp_path_factory.mktemp("damaged")
    (folder / "scans").mkdir()
    with open_source(fixtures_folder / "tumble.mcap") as source:
        assert source.header.surface is not None
        (folder / "model.ply").write_bytes(surface_bytes(source.header.surface))
        full = [scan.points for scan in source.scans() if len(scan.points)][:SCANS]
    for k, points in enumerate(full):
        text = (HEAD.format(len(points)) + "end_header\n").encode() + np.asarray(
            points, "<f4"
        ).tobytes()
        (folder / "scans" / f"{k:02d}.ply").write_bytes(
            text[: len(text) // 2] if k == BROKEN else text
        )
    return folder


def called(scans: Path, out: Path, *words: str) -> Result:
    places = {"FOLDER": scans / "scans", "MODEL": scans / "model.ply"}
    return CliRunner().invoke(
        group, [str(places.get(word, word)).replace("OUT", str(out)) for word in words]
    )


def code_of(done: Result) -> int:
    return done.exception.exit_code if isinstance(done.exception, AvsError) else done.exit_code


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_uses_the_other_scans_and_exits_with_4(
    command: str, scans: Path, tmp_path: Path
) -> None:
    done = called(scans, tmp_path / "out", *COMMANDS[command])
    assert code_of(done) == 4, done.output
    assert f"1 of {SCANS}" in str(done.exception)
    assert "05.ply: ends inside its vertex elements" in str(done.exception)
    assert done.output or list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "command", ["info", "doctor", "run", "record", "odometry", "observability"]
)
def test_strict_is_exit_3_without_an_output(command: str, scans: Path, tmp_path: Path) -> None:
    more = ("-o", str(tmp_path / "result")) if command == "run" else ()
    done = called(scans, tmp_path / "out", *COMMANDS[command], *more, "--strict")
    assert code_of(done) == 3, done.output
    assert "05.ply" in str(done.exception)
    assert not list(tmp_path.iterdir())


def test_the_scan_is_a_row_with_a_status_and_a_reason_of_the_verdict(
    scans: Path, tmp_path: Path
) -> None:
    done = called(scans, tmp_path, *COMMANDS["run"], "-o", str(tmp_path / "result"), "--json")
    rows = list(read_rows(tmp_path / "result" / "rows.jsonl"))
    assert len(rows) == SCANS
    assert [row.seq for row in rows if row.status == "damaged"] == [BROKEN]
    assert (rows[BROKEN].gamma, rows[BROKEN].reason) == (0, "no_scan")
    assert "05.ply" in (rows[BROKEN].message or "")
    reasons = [reason["text"] for reason in json.loads(done.stdout)["verdict"]["reasons"]]
    assert any(
        text.startswith(f"1 of {SCANS} scans cannot be used, the first at 1.7 s: 05.ply")
        for text in reasons
    )


def test_info_and_record_count_it(scans: Path, tmp_path: Path) -> None:
    listed = json.loads(called(scans, tmp_path, *COMMANDS["info"], "--json").stdout)
    assert [each["scan"] for each in listed["damaged_scans"]] == [BROKEN]
    written = json.loads(called(scans, tmp_path / "out", *COMMANDS["record"], "--json").stdout)
    assert (written["scans"], written["damaged"]) == (SCANS - 1, 1)


def test_a_log_that_can_be_read_has_exit_code_0(
    scans: Path, fixtures_folder: Path, tmp_path: Path
) -> None:
    for words in (
        ("info",),
        ("doctor",),
        ("record", "-o", str(tmp_path / "x.mcap"), "--n-scans", "3"),
    ):
        done = called(scans, tmp_path, words[0], str(fixtures_folder / "tumble.mcap"), *words[1:])
        assert code_of(done) == 0, done.output


def test_info_of_a_large_log_names_the_command_that_decodes_all(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("avsreplay.cli.info.DECODED_BYTES", 1000)
    done = called(scans, tmp_path, "info", "FOLDER")
    assert f"{SCANS}; 'avsreplay doctor' tests whether all can be decoded" in done.output
    assert (
        code_of(done) == 4
    )  # one of the five that were decoded, which are spread over the log, is the truncated one


def test_the_hint_is_about_transforms_where_only_these_are_missing(scans: Path) -> None:
    with open_source(scans / "scans") as source:
        report_losses(source)  # nothing was read yet
        source.damaged[3] = UNKNOWN_SENSOR
        with pytest.raises(
            DataLost, match=f"1 of {SCANS} scans cannot be used, the first: scan 3.*see --truth-gap"
        ):
            report_losses(source)
        source.damaged[2] = "3.ply: cut"
        with pytest.raises(
            DataLost,
            match=r"2 of 12 scans .* the first: scan 2: 3\.ply: cut; see 'avsreplay doctor'",
        ):
            report_losses(source)
