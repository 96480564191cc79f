"""Progress off a terminal, an interrupted replay, and a reader that stops reading."""

from __future__ import annotations

import json
import signal
import subprocess
import sys

import pytest

from avsreplay.cli import progress
from avsreplay.cli.run import _collect


def test_off_a_terminal_a_line_appears_every_period(monkeypatch, capsys):
    clock = iter(range(0, 1000, 20))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(clock)))
    assert list(progress.tracked(range(6), 6, "replaying")) == list(range(6))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "avsreplay: replaying: 2 of 6 after 40 s, about 80 s left"
    assert len(lines) == 3


def test_a_quick_run_prints_no_progress(capsys):
    assert list(progress.tracked(range(3), 0, "x")) == [0, 1, 2]
    assert capsys.readouterr().err == ""


def _interrupted(rows):
    yield from rows
    raise KeyboardInterrupt


def test_an_interrupt_keeps_the_rows_so_far(make_rows):
    kept = []
    assert _collect(_interrupted(make_rows(3)), kept)
    assert [row.seq for row in kept] == [0, 1, 2]
    assert not _collect((row for row in make_rows(2)), [])


def test_an_interrupt_before_the_first_row_ends_the_run():
    with pytest.raises(KeyboardInterrupt):
        _collect(_interrupted([]), [])


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
def test_a_closed_pipe_is_not_a_failed_check(fixtures_folder):
    shell = "{} -m avsreplay run {} --json | true; exit ${{PIPESTATUS[0]}}"
    command = shell.format(sys.executable, fixtures_folder / "tumble.mcap")
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 141, done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
def test_a_log_goes_through_a_pipe(fixtures_folder, tmp_path, cli):
    program, log = f"{sys.executable} -m avsreplay", fixtures_folder / "tumble.mcap"
    pipe = f"{program} record {log} -o - --n-scans 6 | {program} run - -o {tmp_path / 'piped'}"
    done = subprocess.run(["bash", "-c", f"set -o pipefail; {pipe}"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "-: 6 scans" in done.stderr
    assert cli("record", log, "-o", tmp_path / "log.mcap", "--n-scans", 6).code == 0
    assert cli("run", tmp_path / "log.mcap", "-o", tmp_path / "direct").code == 0
    piped, direct = ((tmp_path / name / "rows.jsonl").read_bytes() for name in ("piped", "direct"))
    assert piped == direct


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_an_interrupt_keeps_the_scans_of_a_log_that_is_still_written(fixtures_folder, tmp_path):
    """Ctrl-C neither starts a second replay nor reports the open end of the file as damage."""
    whole = (fixtures_folder / "tumble.mcap").read_bytes()
    log, result = tmp_path / "growing.mcap", tmp_path / "result"
    log.write_bytes(whole[: len(whole) * 9 // 10])
    command = [sys.executable, "-m", "avsreplay", "run", str(log), "--follow", "-o", str(result)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        seen = []
        for line in process.stdout:  # ends only if the replay did
            seen.append(line)
            if line.split()[:1] == ["28"]:  # plans exist from scan 22 on
                process.send_signal(signal.SIGINT)
                break
        out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "once more" not in err
    assert "damaged" not in err + out
    assert "--resume" not in err
    rows = (result / "rows.jsonl").read_text().splitlines()
    header = json.loads((result / "run.json").read_text())
    assert header["interrupted_after"] == len(rows) >= 28
    assert not (result / "resume.bin").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
def test_a_pipe_without_data_is_named(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "avsreplay", "run", "-"], input="", capture_output=True, text=True, check=False
    )
    assert done.returncode == 3
    assert done.stderr.startswith("avsreplay: standard input: no data; ")


def test_a_terminal_gets_no_binary_log(monkeypatch):
    from pathlib import Path

    from avsreplay.cli.options import check_binary_output
    from avsreplay.errors import UsageError

    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    with pytest.raises(UsageError, match="binary"):
        check_binary_output(Path("-"))
