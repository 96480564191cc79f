"""Shared parts of the commands: options, progress without a terminal, interruption, a reader
that stops reading.
"""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from avsreplay.cli import options as shared
from avsreplay.cli.main import group
from avsreplay.cli.options import read_options, source_options
from avsreplay.cli.run import collect
from avsreplay.errors import AvsError, UnreadableInput, UsageError
from avsreplay.log import SourceOptions


@pytest.fixture
def parse():
    seen: dict[str, object] = {}

    @click.command()
    @source_options
    def command(**flags: object) -> None:
        seen.update(flags)

    def run(*args: str) -> tuple[int, dict[str, object]]:
        return CliRunner().invoke(command, list(args)).exit_code, seen

    return run


def test_each_option_is_a_field_of_source_options_and_off_by_default(parse):
    code, seen = parse()
    assert code == 0
    assert set(seen) <= {f.name for f in dataclasses.fields(SourceOptions)}
    assert not any(seen.values())
    assert read_options(seen) == SourceOptions()


def test_values_reach_the_source(parse):
    args = [
        "--crop-box",
        "-1,-2,-3,1,2,3",
        "--crop-range",
        "0.5,9",
        "--fixed-frame",
        "map",
        "--truth-gap",
        "0.3",
    ]
    code, seen = parse(*args, "--clock", "log")
    options = read_options(seen)
    assert code == 0
    assert options.crop_box == (-1.0, -2.0, -3.0, 1.0, 2.0, 3.0)
    assert (options.truth_gap_s, options.fixed_frame, options.clock.value) == (0.3, "map", "log")


def test_a_wrong_count_of_numbers_is_a_usage_error(parse):
    assert parse("--crop-range", "1,2,3")[0] == 2


def test_a_value_the_reader_refuses_is_one_line():
    with pytest.raises(UsageError, match="crop_range"):
        read_options({"crop_range": (2.0, 1.0)})


def test_off_a_terminal_a_line_appears_every_period(monkeypatch, capsys):
    clock = iter(range(0, 1000, 20))
    monkeypatch.setattr(shared.time, "monotonic", lambda: float(next(clock)))
    assert list(shared.tracked(range(6), 6, "replaying")) == list(range(6))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "avsreplay: replaying: 2 of 6 after 40 s, about 80 s left"
    assert len(lines) == 3


def test_a_quick_run_prints_no_progress(capsys):
    assert list(shared.tracked(range(3), 0, "x")) == [0, 1, 2]
    assert capsys.readouterr().err == ""


def _interrupted(rows, kept):
    """A run that keeps each row and yields it, until the user interrupts."""
    for row in rows:
        kept.append(row)
        yield row
    raise KeyboardInterrupt


def test_an_interrupt_keeps_the_rows_so_far(make_rows):
    kept = []
    assert collect(_interrupted(make_rows(3), kept), kept)
    assert [row.seq for row in kept] == [0, 1, 2]
    assert not collect((row for row in make_rows(2)), [])


def test_an_interrupt_before_the_first_row_ends_the_run():
    with pytest.raises(KeyboardInterrupt):
        collect(_interrupted([], []), [])


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
def test_a_log_goes_through_a_pipe(fixtures_folder, tmp_path, cli):
    program, log = f"{sys.executable} -m avsreplay", fixtures_folder / "tumble.mcap"
    pipe = f"{program} record {log} -o - --n-scans 6 | {program} run - -o {tmp_path / 'piped'}"
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {pipe}"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "-: 6 scans" in done.stderr
    assert cli("record", log, "-o", tmp_path / "log.mcap", "--n-scans", 6).code == 0
    assert cli("run", tmp_path / "log.mcap", "-o", tmp_path / "direct").code == 0
    piped, direct = ((tmp_path / name / "rows.jsonl").read_bytes() for name in ("piped", "direct"))
    assert piped == direct


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
def test_a_pipe_without_data_is_named(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "avsreplay", "run", "-"],
        input="",
        capture_output=True,
        text=True,
        check=False,
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


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_an_interrupt_keeps_the_scans_of_a_log_that_is_still_written(fixtures_folder, tmp_path):
    """Ctrl-C neither starts a second replay nor reports the open end of the file as damage."""
    whole = (fixtures_folder / "tumble.mcap").read_bytes()
    log, result = tmp_path / "growing.mcap", tmp_path / "result"
    log.write_bytes(whole[: len(whole) * 9 // 10])
    command = [sys.executable, "-m", "avsreplay", "run", str(log), "--follow", "-o", str(result)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        seen = []
        for line in process.stdout:  # ends only if the replay did
            seen.append(line)
            if line.split()[:1] == ["28"]:  # plans exist from scan 22 on
                process.send_signal(signal.SIGINT)
                break
        out, err = process.communicate()
    assert process.returncode == 130, err
    assert "once more" not in err
    assert "damaged" not in err + out
    assert "--resume" not in err
    rows = (result / "rows.jsonl").read_text().splitlines()
    header = json.loads((result / "run.json").read_text())
    assert header["interrupted_after"] == len(rows) >= 28
    assert not (result / "resume.npz").exists()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_sigterm_keeps_the_scans_so_far_and_leaves_no_temporary_file(fixtures_folder, tmp_path):
    """The log is still being written, so that the run does not end by itself."""
    whole = (fixtures_folder / "spin-raster.mcap").read_bytes()
    log, result = tmp_path / "growing.mcap", tmp_path / "result"
    log.write_bytes(whole[: len(whole) * 9 // 10])
    command = [sys.executable, "-m", "avsreplay", "run", str(log), "--follow", "-o", str(result)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        while process.poll() is None and not any(tmp_path.glob(".result.*.part/result.mcap")):
            time.sleep(0.01)
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate()
    assert process.returncode == 143, err
    assert err.splitlines()[-1] == "avsreplay: interrupted"
    left = {path.name for path in tmp_path.iterdir()} - {log.name}
    assert left in (set(), {"result"})  # nothing before the first scan
    if result.exists():
        assert json.loads((result / "run.json").read_text())["interrupted_after"] >= 1


def test_a_closed_standard_input_is_one_line(monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)  # as Python sets it where the descriptor is closed
    with (
        pytest.raises(UnreadableInput, match="standard input: it is closed"),
        shared.log_file(Path("-")),
    ):
        pass


CAMPAIGN = 'name = "c"\nseed = 1\nrepeats = 1\n'
FIRST_CHECKS = {  # what each command with an output is given, and the package that is not installed
    "record": [("missing.toml", None), ("damaged", None)],
    "run": [("missing.mcap", None), ("damaged", None), ("{fixtures}/tumble.mcap --init x", None)],
    "model": [("missing.mcap", None), ("damaged", None)],
    "odometry": [("missing.mcap", None), ("damaged", None)],
    "report": [("missing", None), ("damaged", None)],
    "export": [("missing", None), ("damaged", None)],
    "compare": [("missing missing", None), ("damaged damaged", None)],
    "sweep": [
        ("missing.toml", None),
        ("damaged", None),
        ("campaign.toml", "distributed"),
        ("campaign.toml --workers 0", "pyarrow"),
        ("campaign.toml --scheduler tcp://127.0.0.1:9", None),
        ("campaign.toml --run 7", None),
    ],
    "benchmark": [
        ("--suite none", None),
        ("--only none", None),
        ("--backend none", None),
        ("--quick", "distributed"),
    ],
}


def test_the_first_checks_are_listed_for_each_command_with_an_output():
    context = click.Context(group)
    commands = {name: group.get_command(context, name) for name in group.list_commands(context)}
    assert set(FIRST_CHECKS) == {
        name for name, command in commands.items() if any("-o" in p.opts for p in command.params)
    }


@pytest.mark.parametrize(
    ("command", "words", "absent"),
    [(name, *each) for name, checks in FIRST_CHECKS.items() for each in checks],
)
def test_a_command_that_fails_at_its_first_check_leaves_nothing(
    command, words, absent, tmp_path, fixtures_folder, monkeypatch
):
    (tmp_path / "damaged").write_bytes(b"\x89MCAP0\r\n\x00\x00")
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    if "--scheduler" in words:
        execute = pytest.importorskip("avsreplay.sweep.execute")
        pytest.importorskip("distributed", reason="Dask is not installed")
        monkeypatch.setattr(execute, "CONNECT_TIMEOUT_S", 0.1)
    if absent:
        monkeypatch.setitem(sys.modules, absent, None)
    asked = [command, *words.format(fixtures=fixtures_folder).split(), "-o", "new/deep/out"]
    done = CliRunner().invoke(group, asked)
    assert done.exit_code
    assert isinstance(done.exception, AvsError | click.ClickException | SystemExit)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["", ".", "..", "a/.."])
@pytest.mark.parametrize("command", ["run", "sweep", "benchmark"])
def test_no_command_writes_its_folder_in_place_of_a_present_one(
    command, name, tmp_path, fixtures_folder, monkeypatch
):
    """An empty name is that of a variable of the shell that is not set."""
    (tmp_path / "a").mkdir()
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    log = str(fixtures_folder / "tumble.mcap")
    words = {"run": [log], "sweep": ["campaign.toml"], "benchmark": ["--quick"]}[command]
    done = CliRunner().invoke(group, [command, *words, "-o", name])
    assert isinstance(done.exception, UsageError)
    assert sorted(tmp_path.rglob("*")) == before
