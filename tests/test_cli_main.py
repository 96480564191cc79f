"""Errors at the end of a command: closed pipes, a full standard output, unexpected exceptions."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from avsreplay import arithmetic
from avsreplay.__main__ import main
from avsreplay.cli import main as cli

posix = pytest.mark.skipif(os.name != "posix", reason="devices and pipes of POSIX")
AVSREPLAY = [sys.executable, "-m", "avsreplay"]


def with_stdout(handle: int, *args: object) -> tuple[int, str]:
    done = subprocess.run(
        [*AVSREPLAY, *map(str, args)], stdout=handle, stderr=subprocess.PIPE, text=True, check=False
    )
    return done.returncode, done.stderr


def with_closed_pipe(*args: object) -> tuple[int, str]:
    reader, writer = os.pipe()
    os.close(reader)
    try:
        return with_stdout(writer, *args)
    finally:
        os.close(writer)


@posix
@pytest.mark.parametrize(
    "args",
    [
        ("run", "tumble.mcap", "--n-scans", 3),
        ("run", "tumble.mcap", "--n-scans", 3, "--json"),
        ("info", "tumble.mcap"),
        ("record", "tumble.mcap", "-o", "-"),
    ],
)
def test_a_closed_pipe_is_not_a_failed_check(
    args: tuple[object, ...], fixtures_folder: Path
) -> None:
    code, err = with_closed_pipe(args[0], fixtures_folder / str(args[1]), *args[2:])
    assert code == 141
    assert "Traceback" not in err
    assert "Exception ignored" not in err


@posix
def test_a_closed_pipe_loses_no_output(fixtures_folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")  # for the campaign
    log, result = fixtures_folder / "tumble.mcap", tmp_path / "result"
    whole, campaign = tmp_path / "whole", tmp_path / "campaign.toml"
    campaign.write_text('[set]\n"scenario.duration_s" = 1.0\n', encoding="utf-8")
    assert (
        with_stdout(subprocess.DEVNULL, "run", log, "--n-scans", 3, "-o", whole, "--report")[0] == 0
    )
    outputs = {
        result / "report.html": ("run", log, "--n-scans", 3, "-o", result, "--report"),
        tmp_path / "page.html": ("report", whole, "-o", tmp_path / "page.html"),
        tmp_path / "compared.html": ("compare", whole, whole, "-o", tmp_path / "compared.html"),
        tmp_path / "rows.csv": ("export", whole, "--to", "csv", "-o", tmp_path / "rows.csv"),
        tmp_path / "model.ply": ("model", log, "-o", tmp_path / "model.ply"),
        tmp_path / "swept" / "report.html": (
            "sweep",
            campaign,
            "-o",
            tmp_path / "swept",
            "--workers",
            0,
        ),
    }
    for output, command in outputs.items():
        code, err = with_closed_pipe(*command)
        assert code == 141, err
        assert output.stat().st_size > 0, err
    assert (result / "rows.jsonl").read_bytes() == (whole / "rows.jsonl").read_bytes()


@posix
def test_a_failed_check_is_reported_though_the_pipe_is_closed(fixtures_folder: Path) -> None:
    golden = fixtures_folder / "spin-raster.rows.jsonl"
    code, _ = with_closed_pipe(
        "run", fixtures_folder / "tumble.mcap", "--n-scans", 3, "--golden", golden
    )
    assert code == 1


@posix
def test_standard_output_that_the_shell_has_closed(fixtures_folder: Path) -> None:
    words = " ".join([*AVSREPLAY, "info", str(fixtures_folder / "tumble.mcap")])
    done = subprocess.run(["sh", "-c", f"{words} >&-"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@posix
def test_results_are_complete_though_standard_output_is_full(
    fixtures_folder: Path, tmp_path: Path
) -> None:
    log, page = fixtures_folder / "tumble.mcap", tmp_path / "report.html"
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        code, err = with_stdout(
            full.fileno(), "run", log, "--n-scans", 3, "-o", tmp_path, "--overwrite", "--report"
        )
    assert code == 3
    assert err.strip().endswith("avsreplay: standard output: No space left on device")
    assert page.stat().st_size > 0


@posix
def test_a_full_standard_output_is_one_line(fixtures_folder: Path) -> None:
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        code, err = with_stdout(full.fileno(), "info", fixtures_folder / "tumble.mcap")
    assert code == 3
    assert err.strip() == "avsreplay: standard output: No space left on device"


def test_an_unexpected_error_is_one_line_and_a_report(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def broken(**_: object) -> None:
        raise ZeroDivisionError("a \x1b[31mdefect\udcff")

    monkeypatch.setattr(cli.group, "main", broken)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(SystemExit) as left:
        cli.entry_point()
    assert left.value.code == 70
    err = capsys.readouterr().err
    assert len(err.strip().splitlines()) == 1
    assert "\x1b" not in err
    (report,) = tmp_path.iterdir()
    assert str(report) in err
    assert "ZeroDivisionError" in report.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "error", [MemoryError(), RecursionError("deep"), OSError(28, "No space left on device", "x")]
)
def test_no_error_exits_with_the_code_of_a_failed_check(
    error: Exception, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def broken(**_: object) -> None:
        raise error

    monkeypatch.setattr(cli.group, "main", broken)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(SystemExit) as left:
        cli.entry_point()
    assert left.value.code in (3, 70)


@pytest.mark.parametrize("encoding", ["cp1252", "ascii"])
def test_characters_that_the_output_cannot_encode_are_escaped(
    cli, fixtures_folder, tmp_path, encoding
):
    """As on Windows, whose standard output has a code page where it is not a terminal."""
    log = tmp_path / "π.mcap"
    log.write_bytes((fixtures_folder / "tumble.mcap").read_bytes())
    done = cli("info", log, env={"PYTHONIOENCODING": encoding})
    assert (done.code, done.err) == (0, "")
    assert "\\u03c0.mcap" in done.out


def test_ctrl_c_while_the_command_is_loaded_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(arithmetic, "pin", interrupted)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130
    assert capsys.readouterr().err == "avsreplay: interrupted\n"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_an_interrupt_within_code_from_a_text_ends_with_the_exit_code_of_the_command(tmp_path):
    """As one that arrives while a data class is imported: "python -m" would end with a signal."""
    (tmp_path / "interrupted.py").write_text(
        "from avsreplay.cli import main\n"
        "main.group.main = lambda **_: exec('raise KeyboardInterrupt')\n"
        "main.entry_point()\n"
    )
    command = [sys.executable, "-m", "interrupted"]
    env = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "avsreplay: interrupted\n")
