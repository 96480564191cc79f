"""The environment of a process does not change its result: closed descriptors, warnings as errors,
modes of the interpreter, missing variables, signals.
"""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time

import pytest

COMMAND = [sys.executable, "-m", "avsreplay"]
posix = pytest.mark.skipif(os.name != "posix", reason="descriptors and signals of POSIX")


@pytest.fixture(scope="module")
def expected(fixtures_folder, tmp_path_factory):
    """The rows of a short run."""
    out = tmp_path_factory.mktemp("expected") / "r"
    log = fixtures_folder / "tumble.mcap"
    subprocess.run([*COMMAND, "run", log, "-o", out, "--n-scans", "2"], check=True)
    return (out / "rows.jsonl").read_bytes()


def rows(words, log, out, **how):
    done = subprocess.run(
        [*words, "run", log, "-o", out, "--n-scans", "2"], capture_output=True, text=True, **how
    )
    assert done.returncode == 0, done.stderr
    return (out / "rows.jsonl").read_bytes()


@pytest.mark.slow
@posix
@pytest.mark.parametrize(
    "closed", [c for n in (1, 2, 3) for c in itertools.combinations((0, 1, 2), n)], ids=str
)
def test_closed_standard_streams(expected, fixtures_folder, tmp_path, closed):
    shell = " ".join(f"{number}>&-" for number in closed)
    words = ["sh", "-c", f'"$@" {shell}', "sh", *COMMAND]
    assert rows(words, fixtures_folder / "tumble.mcap", tmp_path / "r") == expected
    text = b"".join(p.read_bytes() for p in (tmp_path / "r").iterdir())
    assert b"verdict CHECK:" not in text, "what is printed is written to no file"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flags", "variables"),
    [
        ([], {"PYTHONWARNINGS": "error"}),
        (["-W", "error"], {}),
        (["-OO"], {}),
        (["-X", "dev"], {}),
        ([], {"HOME": None, "USER": None, "LANG": None, "TMPDIR": None}),
    ],
    ids=str,
)
def test_modes_of_the_interpreter_and_missing_variables(
    expected, fixtures_folder, tmp_path, flags, variables
):
    env = {k: v for k, v in {**os.environ, **variables}.items() if v is not None}
    words = [sys.executable, *flags, "-m", "avsreplay"]
    assert rows(words, fixtures_folder / "tumble.mcap", tmp_path / "r", env=env) == expected


@pytest.mark.slow
@posix
@pytest.mark.parametrize("descriptors", [6, 8, 12])
def test_too_few_descriptors_are_one_line(fixtures_folder, tmp_path, descriptors):
    shell = f'ulimit -n {descriptors}; "$@"'
    words = ["sh", "-c", shell, "sh", *COMMAND, "run", fixtures_folder / "tumble.mcap"]
    done = subprocess.run(
        [*words, "-o", tmp_path / "r", "--n-scans", "2"], capture_output=True, text=True
    )
    assert done.returncode == 3, done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "r").exists()


@pytest.mark.slow
@posix
@pytest.mark.parametrize("ignored", ["INT", "INT HUP QUIT"])
def test_sigterm_ends_a_command_that_ignores_ctrl_c(fixtures_folder, tmp_path, ignored):
    """The log is still being written, so that the run does not end by itself."""
    log = tmp_path / "part.mcap"
    whole = (fixtures_folder / "tumble.mcap").read_bytes()
    log.write_bytes(whole[: len(whole) // 2])
    words = ["sh", "-c", f"trap '' {ignored}; exec \"$@\"", "sh", *COMMAND, "run", log, "--follow"]
    process = subprocess.Popen([*words, "-o", tmp_path / "r"], stderr=subprocess.PIPE, text=True)
    while len(list(tmp_path.iterdir())) < 2 and process.poll() is None:
        time.sleep(0.05)  # until the run writes its result
    process.send_signal(signal.SIGINT)
    time.sleep(0.2)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    process.communicate()
    assert process.returncode == 143


@pytest.mark.parametrize("name", ["a\x1b[31mred", "a\u202eb", "a\x9bb", "a\rb"])
def test_control_characters_of_names_are_printed_as_escapes(cli, fixtures_folder, tmp_path, name):
    log = fixtures_folder / "tumble.mcap"
    assert cli("run", log, "-o", tmp_path / name, "--n-scans", "2").code == 0
    for words in (("compare", tmp_path / name), ("compare", tmp_path / name, "--markdown")):
        done = cli(*words, tmp_path / name)
        printed = done.out + done.err
        assert done.code == 0
        assert all(c.isprintable() or c in "\n\t" for c in printed)


def test_a_sweep_does_not_write_into_the_folder_of_a_run(cli, fixtures_folder, tmp_path):
    log = fixtures_folder / "tumble.mcap"
    assert cli("run", log, "-o", tmp_path / "r", "--n-scans", "2").code == 0
    before = {p.name: p.read_bytes() for p in (tmp_path / "r").iterdir()}
    campaign = tmp_path / "c.toml"
    campaign.write_text(f'logs = ["{log}"]\n[run]\npolicy = "all"\n', encoding="utf-8")
    done = cli("sweep", campaign, "-o", tmp_path / "r")
    assert done.code == 2, done.err
    assert {p.name: p.read_bytes() for p in (tmp_path / "r").iterdir()} == before


def test_a_result_without_rows_is_compared_with_nothing(cli, fixtures_folder, tmp_path):
    log, empty = fixtures_folder / "tumble.mcap", tmp_path / "empty.jsonl"
    assert cli("run", log, "-o", tmp_path / "r", "--n-scans", "2").code == 0
    empty.write_text("")
    for pair in ((empty, tmp_path / "r"), (tmp_path / "r", empty)):
        done = cli("compare", *pair)
        assert (done.code, done.out) == (3, "")
        assert "has no rows" in done.err
