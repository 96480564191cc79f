"""Saved results read by the commands: they are verified, and no defect gives an internal
error or passes unnoticed.
"""

from __future__ import annotations

import json
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner, Result

from avsreplay.cli.main import SUMMARIES, group
from avsreplay.errors import AvsError, DataLost, UnreadableInput, UsageError
from avsreplay.log import open_source
from avsreplay.log.header import surface_bytes

READERS = {
    "report": ("report", "RESULT", "-o", "OUT"),
    "export": ("export", "RESULT", "--to", "csv", "-o", "OUT"),
    "compare": ("compare", "RESULT", "--gate", "GATE"),
    "plan": ("plan", "RESULT", "--at", "1", "--samples", "1", "--every", "1"),
}


@pytest.fixture(scope="module")
def saved(fixtures_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("saved") / "result"
    run("run", fixtures_folder / "tumble.mcap", "--n-scans", 12, "-o", path)
    return path


@pytest.fixture
def result(saved: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(saved, tmp_path / "result"))


def run(*args: object) -> Result:
    return CliRunner().invoke(group, [str(a) for a in args])


def read(command: str, result: Path) -> Result:
    gate = result.parent / "gate.toml"
    gate.write_text('[[rule]]\nmetric = "healthy"\nmin = 0.0\noptional = true\n')
    words = {"RESULT": result, "OUT": result.parent / "out", "GATE": gate}
    return run(*(words.get(word, word) for word in READERS[command]))


def rewrite_manifest(result: Path, **changes: object) -> None:
    path = result / "run.json"
    path.write_text(
        json.dumps({**json.loads(path.read_text(encoding="utf-8")), **changes}), encoding="utf-8"
    )


@pytest.mark.parametrize(
    "words",
    [
        ("report", "RESULT", "-o", "RESULT/rows.jsonl", "--overwrite"),
        ("report", "RESULT/rows.jsonl", "-o", "RESULT/rows.jsonl", "--overwrite"),
        ("export", "RESULT", "--to", "csv", "-o", "RESULT/run.json", "--overwrite"),
        ("compare", "RESULT", "RESULT", "-o", "RESULT/truth.tum", "--overwrite"),
        ("compare", "RESULT", "RESULT", "--gate", "GATE", "--junit", "GATE"),
        ("plan", "RESULT", "--export", "RESULT/beliefs.npz", "--overwrite"),
        ("odometry", "RESULT/result.mcap", "-o", "RESULT/result.mcap", "--overwrite"),
    ],
)
def test_an_output_never_replaces_what_the_command_reads(
    words: tuple[str, ...], result: Path
) -> None:
    gate = result.parent / "gate.toml"
    gate.write_text('[[rule]]\nmetric = "healthy"\nmin = 0.0\n')
    files = [gate, *result.iterdir()]
    before = [path.read_bytes() for path in files]
    done = run(*(word.replace("RESULT", str(result)).replace("GATE", str(gate)) for word in words))
    assert isinstance(done.exception, UsageError), done.exception
    assert "is an input, a part of one, or another output" in str(done.exception)
    assert [path.read_bytes() for path in files] == before


OUTPUTS = {"output", "update_golden", "junit", "export", "mesh", "poses", "animate"}
NEEDED = {  # arguments without which a command is refused earlier
    "export": ("--to", "csv"),
    "compare": ("--gate", "FILE"),
    "model": ("-o", "other.ply"),
    "run": ("-o", "other"),
}


def pairs() -> list[tuple[str, str, str]]:
    """Every output file of every command with each other path that the command takes."""
    found = []
    for name in SUMMARIES:
        command = group.get_command(click.Context(group), name)
        paths = [param for param in command.params if isinstance(param.type, click.Path)]
        words = [param.opts[0] if isinstance(param, click.Option) else "" for param in paths]
        outputs = [
            w
            for p, w in zip(paths, words, strict=True)
            if p.name in OUTPUTS and (name, w) not in FOLDERS
        ]
        found += [(name, output, word) for output in outputs for word in words if word != output]
    return found


FOLDERS = {("run", "-o"), ("sweep", "-o"), ("benchmark", "-o")}


@pytest.mark.parametrize(("command", "output", "other"), pairs())
def test_no_output_is_another_path_of_its_command(
    command: str, output: str, other: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / {"record": "a.mcap", "model": "a.ply"}.get(command, "a.file")
    path.write_text("mine")
    if (command, other) == ("run", "-o"):  # a folder is no file
        path.unlink()
    more = [path if word == "FILE" else word for word in NEEDED.get(command, ())]
    if output in more or other in more:
        more = []
    (tmp_path / "source").touch()
    words = [
        command,
        "source" if other else path,
        *more,
        output,
        path,
        *([other, path] if other else []),
    ]
    done = run(*words, *(["--overwrite"] if command != "run" else []))
    assert isinstance(done.exception, UsageError), done.exception
    assert "another output" in str(done.exception) or "exclude each other" in str(done.exception)
    assert not path.exists() or path.read_text() == "mine"


@pytest.fixture
def little_memory() -> Iterator[None]:
    """Limit the memory of the process, so that reading without an end is a MemoryError and does not
    end the machine.
    """
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


ENDLESS = [
    *(
        ("run", "LOG", *more)
        for more in (
            ("--model", "x.ply"),
            ("--config", "x.toml"),
            ("--robot", "x.toml"),
            ("--truth", "x.tum"),
            ("--truth", "x.conf"),
            ("--golden", "x.jsonl"),
        )
    ),
    ("run", "x.mcap"),
    ("run", "x.tum", "--backend", "poses"),
    ("info", "x.bag"),
    ("doctor", "x.db3"),
    ("record", "x.toml", "-o", "a.mcap"),
    ("sweep", "x.toml", "--plan"),
    ("sweep", "campaign.toml", "--plan"),
    ("compare", "nothing", "--gate", "x.toml"),
    ("plan", "nothing", "--robot", "x.toml"),
    ("report", "x.jsonl"),
    ("model", "LOG", "--against", "x.ply", "-o", "a.ply"),
    ("bench", "LOG", "--model", "x.ply"),
]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the test reads /proc")
@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("words", ENDLESS)
def test_an_input_without_an_end_is_one_line(
    words: tuple[str, ...], fixtures_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for word in words:
        if word.startswith("x."):
            Path(word).symlink_to("/dev/zero")
    Path("x.mcap").is_symlink() or Path("x.mcap").symlink_to("/dev/zero")
    Path("campaign.toml").write_text('logs = ["x.mcap"]\n')
    done = run(*(fixtures_folder / "tumble.mcap" if word == "LOG" else word for word in words))
    assert isinstance(done.exception, (UnreadableInput, UsageError)), repr(done.exception)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems have no such names")
def test_a_result_of_a_log_whose_name_is_not_utf_8_can_be_read(
    fixtures_folder: Path, tmp_path: Path
) -> None:
    log, model = (tmp_path / f"x{chr(0xDCFF)}{suffix}" for suffix in (".mcap", ".ply"))
    shutil.copyfile(fixtures_folder / "tumble.mcap", log)
    with open_source(log) as source:
        model.write_bytes(surface_bytes(source.header.surface))
    path = tmp_path / "result"
    assert run("run", log, "--model", model, "--n-scans", 6, "-o", path).exception is None
    for command in ("report", "compare", "plan"):
        done = read(command, path)
        assert done.exception is None, done.exception


@pytest.mark.parametrize("option", ["--golden", "--update-golden"])
def test_an_unusable_golden_file_is_refused_before_the_replay(
    option: str, fixtures_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("avsreplay.run.Run.rows", None)
    golden = tmp_path / "golden.jsonl"
    golden.write_text("[1]\n")
    done = run("run", fixtures_folder / "tumble.mcap", option, golden)
    assert isinstance(done.exception, UnreadableInput), done.exception
    assert golden.read_text() == "[1]\n"


def test_a_folder_as_golden_file_is_not_called_missing(
    fixtures_folder: Path, tmp_path: Path
) -> None:
    done = run("run", fixtures_folder / "tumble.mcap", "--golden", tmp_path)
    assert isinstance(done.exception, UnreadableInput), done.exception
    assert "not a rows.jsonl file" in str(done.exception)


def test_a_result_that_is_replaced_keeps_the_files_of_others(
    fixtures_folder: Path, result: Path
) -> None:
    (result / "notes.txt").write_text("mine")
    (result / "folder").mkdir()
    (result / "folder" / "a.txt").write_text("mine, too")
    (result / "report.html").write_text("a page of the former result")
    words = ("run", fixtures_folder / "tumble.mcap", "--n-scans", 1, "-o", result, "--overwrite")
    refused = run(*words, "--golden", result / "rows.jsonl")
    assert isinstance(refused.exception, UsageError)
    assert "contains an input" in str(refused.exception)
    assert run(*words).exception is None
    assert (result / "notes.txt").read_text() == "mine"
    assert (result / "folder" / "a.txt").read_text() == "mine, too"
    assert not (result / "report.html").exists()
    assert len((result / "rows.jsonl").read_text().splitlines()) == 1
    done = read("compare", result)
    assert "warning" not in done.stderr
    assert sorted(p.name for p in result.parent.iterdir()) == ["gate.toml", "result"]


def test_pages_and_exports_in_the_folder_of_a_result_can_be_made_again(result: Path) -> None:
    for words in (("report", result), ("export", result, "--to", "tum", "-o", result / "mine.tum")):
        for _ in range(2):
            assert run(*words, "--overwrite").exception is None


@pytest.mark.parametrize("command", READERS)
def test_an_intact_result_is_read_without_a_warning(command: str, result: Path) -> None:
    done = read(command, result)
    assert done.exception is None, done.exception
    assert "warning" not in done.stderr


def test_the_manifest_lists_every_file_with_its_sum(result: Path) -> None:
    header = json.loads((result / "run.json").read_text(encoding="utf-8"))
    assert set(header["files"]) == {p.name for p in result.iterdir()} - {"run.json"}
    assert header["rows"] == 12
    assert header["losses"] == {"count": 0, "first": []}


@pytest.mark.parametrize("command", READERS)
def test_cut_rows_cannot_pass(command: str, result: Path) -> None:
    path = result / "rows.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:6]))
    assert isinstance(read(command, result).exception, UnreadableInput)
    done = run("compare", path, "--gate", result.parent / "gate.toml")
    assert isinstance(done.exception, (UnreadableInput, UsageError))


@pytest.mark.parametrize("command", READERS)
@pytest.mark.parametrize("name", ["beliefs.npz", "view.npz", "truth.tum", "result.mcap"])
def test_a_changed_or_missing_file_is_found(command: str, name: str, result: Path) -> None:
    path = result / name
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert isinstance(read(command, result).exception, UnreadableInput)
    path.unlink()
    assert isinstance(read(command, result).exception, UnreadableInput)


def test_a_result_without_a_manifest_passes_no_gate_in_silence(result: Path) -> None:
    (result / "run.json").unlink()
    done = read("compare", result)
    assert isinstance(done.exception, DataLost)
    assert "cannot be verified" in str(done.exception)
    done = read("export", result)
    assert done.exception is None
    assert "not verified" in done.stderr


def test_a_result_of_a_damaged_log_passes_no_gate_in_silence(
    fixtures_folder: Path, tmp_path: Path
) -> None:
    log = tmp_path / "cut.mcap"
    log.write_bytes((fixtures_folder / "tumble.mcap").read_bytes()[:200_000])
    assert isinstance(run("run", log, "-o", tmp_path / "result").exception, DataLost)
    done = read("compare", tmp_path / "result")
    assert isinstance(done.exception, DataLost)
    assert "damaged" in str(done.exception)
    assert "its log was damaged" in read("export", tmp_path / "result").stderr


BAD_JSON = [
    "",
    "{",
    "[]",
    '"a"',
    "NaN",
    "9" * 400,
    '{"facts": 1e999}',
    '{"facts": {"labels": [1]}}',
    '{"config": 3}',
    '{"limits": {"alpha_max_m": "1", "length_m": 1.0}}',
    '{"limits": {"rms_max_m": -1e308}}',
    '{"limits": {"alpha_max_m": 1.0, "length_m": 1e-320}}',
]


@pytest.mark.parametrize("command", READERS)
@pytest.mark.parametrize("text", BAD_JSON)
def test_a_malformed_run_json_is_one_line(command: str, text: str, result: Path) -> None:
    (result / "run.json").write_text(text)
    done = read(command, result)
    assert done.exception is None or isinstance(done.exception, AvsError), repr(done.exception)


BAD_ROWS = [
    ("x_m", "1e999"),
    ("x_m", "9" * 400),
    ("x_m", "1e200"),
    ("seq", "9" * 30),
    ("status", '"\\ud800"'),
    ("status", '"\\u001b[31m"'),
    ("reason", "[1]"),
    ("gamma", "null"),
]


@pytest.mark.parametrize(("column", "value"), BAD_ROWS)
def test_a_value_that_no_run_writes_is_one_line(
    column: str, value: str, result: Path, fixtures_folder: Path
) -> None:
    lines = (result / "rows.jsonl").read_text().splitlines()
    row = json.loads(lines[3])
    row[column] = "HERE"
    lines[3] = json.dumps(row).replace('"HERE"', value)
    (result / "rows.jsonl").write_text("\n".join(lines) + "\n")
    (result / "run.json").unlink()
    for command in ("report", "export", "compare"):
        done = read(command, result)
        assert isinstance(done.exception, UnreadableInput), repr(done.exception)
    done = run(
        "run", fixtures_folder / "tumble.mcap", "--n-scans", 5, "--golden", result / "rows.jsonl"
    )
    assert isinstance(done.exception, AvsError), repr(done.exception)
    assert "\x1b" not in done.output


def test_escape_codes_in_a_golden_file_do_not_reach_the_terminal(
    fixtures_folder: Path, tmp_path: Path
) -> None:
    golden = tmp_path / "golden.jsonl"
    row = json.loads((fixtures_folder / "tumble.rows.jsonl").read_text().splitlines()[0])
    golden.write_text(json.dumps({**row, "\x1b]0;title\x07": 1}) + "\n")
    done = run("run", fixtures_folder / "tumble.mcap", "--n-scans", 1, "--golden", golden)
    assert isinstance(done.exception, UnreadableInput)
    assert "\x1b" not in done.output + str(done.exception)


def test_an_export_of_nothing_keeps_the_old_file(result: Path, tmp_path: Path) -> None:
    (result / "run.json").unlink()
    (result / "truth.tum").unlink()
    old = tmp_path / "poses.tum"
    old.write_text("precious")
    done = run("export", result, "--to", "tum", "--poses", "truth", "-o", old, "--overwrite")
    assert isinstance(done.exception, UsageError)
    assert old.read_text() == "precious"


def test_cells_that_a_spreadsheet_would_evaluate_are_quoted(result: Path, tmp_path: Path) -> None:
    lines = [json.loads(line) for line in (result / "rows.jsonl").read_text().splitlines()]
    lines[0]["fault"] = "=HYPERLINK(1)"
    (result / "rows.jsonl").write_text("".join(json.dumps(row) + "\n" for row in lines))
    (result / "run.json").unlink()
    run("export", result, "--to", "csv", "-o", tmp_path / "rows.csv")
    text = (tmp_path / "rows.csv").read_text()
    assert "'=HYPERLINK(1)" in text
    assert ",=" not in text


def test_devices_as_outputs_stay_devices(
    result: Path, fixtures_folder: Path, tmp_path: Path
) -> None:
    null, link = Path("/dev/null"), tmp_path / "link"
    link.symlink_to(null)
    log = fixtures_folder / "tumble.mcap"
    read("compare", result)  # writes the gate file
    commands = [
        ("export", result, "--to", "csv", "-o", "OUT"),
        ("export", result, "--to", "tum", "-o", "OUT", "--overwrite"),
        ("report", result, "-o", "OUT"),
        ("compare", result, "--gate", result.parent / "gate.toml", "--junit", "OUT"),
        ("compare", result, result, "-o", "OUT"),
        ("plan", result, "--at", "1", "--samples", "1", "--every", "1", "--export", "OUT"),
        ("doctor", log, "--repair", "OUT"),
        ("run", log, "--n-scans", 2, "--update-golden", "OUT"),
        ("record", "--seed", 1, log, "-o", "OUT"),
    ]
    for command in commands:
        for output in (null, link):
            done = run(*(output if word == "OUT" else word for word in command))
            assert done.exception is None or isinstance(done.exception, AvsError), (
                command,
                done.exception,
            )
            assert stat.S_ISCHR(null.stat().st_mode), command
            assert link.is_symlink(), command


@pytest.mark.parametrize("name", ["", ".", "/", "x" * 300, "file", "a\udcff"])
def test_an_unusable_result_directory_is_refused_before_the_replay(
    name: str, fixtures_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    done = run("run", fixtures_folder / "tumble.mcap", "-o", name, "--overwrite")
    assert isinstance(done.exception, UsageError)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.skipif(sys.platform == "win32", reason="the limit is that of POSIX")
@pytest.mark.parametrize("share", [0.0, 0.5, 0.95])
def test_a_disk_that_is_full_during_a_run_keeps_the_old_result(
    share: float, result: Path, fixtures_folder: Path
) -> None:
    import resource

    before = {path.name: path.read_bytes() for path in result.iterdir()}
    limit = int(share * max(map(len, before.values())))
    words = ["run", fixtures_folder / "tumble.mcap", "--n-scans", 12, "-o", result, "--overwrite"]
    done = subprocess.run(
        [sys.executable, "-m", "avsreplay", *map(str, words)],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 3
    assert [line for line in done.stderr.splitlines() if line.startswith("avsreplay: ")] == [
        done.stderr.splitlines()[-1]
    ]
    assert {path.name: path.read_bytes() for path in result.iterdir()} == before
    assert [path.name for path in result.parent.iterdir()] == ["result"]


def test_a_belief_of_another_size_is_one_line(result: Path) -> None:
    (result / "run.json").unlink()
    np.savez(
        result / "beliefs.npz", t_ns=np.arange(3), x=np.zeros((3, 22)), P=np.zeros((3, 20, 21))
    )
    assert isinstance(read("plan", result).exception, UnreadableInput)
