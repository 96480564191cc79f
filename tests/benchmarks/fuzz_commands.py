"""Fuzz campaign on every input of every command: ``python tests/benchmarks/fuzz_commands.py [--quick] [--inputs N]``.

The inputs are listed from the options and arguments of the commands: a new one without a seed here ends the campaign.
One input of a command is mutated and the command is run. It must succeed or end in one error line: an internal error,
a warning on the terminal, more than 20 s of processor time, more than 512 MiB, a crash of the interpreter or a file
outside the requested output is a finding. Mutation i depends only on (campaign, i): ``--campaign S --only i``
repeats it.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import shutil
import tempfile
import warnings
from pathlib import Path

import click
import numpy as np
from fuzz_inputs import mutate
from fuzz_workers import Campaign, Check, report, run_campaign

from avsreplay.cli import SUMMARIES, group
from avsreplay.errors import AvsError
from avsreplay.report.result import write_manifest

LIMIT_S, LIMIT_MIB = 20, 512
ROOT = Path(__file__).resolve().parents[2]
OUTPUTS = {"output", "update_golden", "junit", "export", "mesh"}
NUMBERS = (b"0", b"-1", b"1e999", b"-1e308", b"1e20", b"1e-320", b"9" * 400, b"9223372036854775807", b"nan", b"inf",
           b"true", b"null", b'"x"', b'"\\ud800"', b'"\\u001b[31m"', b"[]", b"{}", b"")  # fmt: skip
SCENARIO = """name = "tiny"
seed = 1
duration_s = 0.5
rate_hz = 4.0
[target]
shape = "satellite"
[motion]
position_m = [0.1, 0.0, 5.0]
rate_radps = [0.06, 0.064, -0.048]
[scanner]
fov_deg = [48.0, 48.0]
rays = [32, 32]
noise_m = 0.008
[[fault]]
kind = "occlusion"
start_s = 0.2
duration_s = 0.2
"""
CAMPAIGN = """name = "tiny"
scenario = "scenario.toml"
[[grid]]
key = "scenario.scanner.noise_m"
values = [0.004, 0.008]
[[draw]]
key = "scenario.motion.attitude_xyzw"
kind = "attitude"
"""
RULES = '[[rule]]\nmetric = "pose_pos_rmse_m"\nmax = 0.5\nmax_ratio = 1.5\noptional = true\n'
ROBOT = (
    "[robot]\nmass_kg = 80.0\nthrust_axes_n = [6.0, 4.0, 4.0]\nreach_max_m = 9.0\ndelay_s = 0.2\nthrust_noise = 0.01\n"
)
RUN = ("--init", "truth", "--n-scans", "2")
# (command, input) -> arguments; IN is the mutated input, the other words name intact seeds or outputs.
CASES: dict[tuple[str, str], tuple[str, ...]] = {
    ("record", "source"): ("IN", "-o", "OUT.mcap"),
    ("record", "model"): ("scans", "--model", "IN", "-o", "OUT.mcap"),
    ("record", "truth_file"): ("scans", "--truth", "IN", "-o", "OUT.mcap"),
    ("run", "log"): ("IN", *RUN),
    ("run", "config_file"): ("log.mcap", "--config", "IN", *RUN),
    ("run", "model"): ("log.mcap", "--model", "IN", *RUN),
    ("run", "truth_file"): ("log.mcap", "--truth", "IN", *RUN),
    ("run", "robot_file"): ("log.mcap", "--robot", "IN", *RUN),
    ("run", "golden"): ("log.mcap", "--golden", "IN", *RUN),
    ("info", "source"): ("IN",),
    ("info", "model"): ("log.mcap", "--model", "IN"),
    ("info", "truth_file"): ("log.mcap", "--truth", "IN"),
    ("doctor", "source"): ("IN", "--repair", "OUT.mcap"),
    ("bench", "log"): ("IN", "--scans", "1"),
    ("bench", "model"): ("log.mcap", "--model", "IN", "--scans", "1"),
    ("observability", "log"): ("IN", "--n-scans", "2"),
    ("observability", "model"): ("log.mcap", "--model", "IN", "--n-scans", "2"),
    ("observability", "truth_file"): ("log.mcap", "--truth", "IN", "--n-scans", "2"),
    ("plan", "result"): ("IN", "--at", "0", "--samples", "2", "--every", "1"),
    ("plan", "robot_file"): ("result", "--robot", "IN", "--at", "0", "--samples", "2", "--every", "1"),
    ("report", "result"): ("IN", "-o", "OUT.html"),
    ("export", "result"): ("IN", "--to", "csv", "-o", "OUT.csv"),
    ("compare", "results"): ("result", "IN", "-o", "OUT.html"),
    ("compare", "gate"): ("result", "result", "--gate", "IN", "--junit", "OUT.xml"),
    ("sweep", "campaign"): ("IN", "--plan"),
    ("sweep", "output"): ("campaign.toml", "-o", "IN", "--limit", "0", "--workers", "0"),
    ("model", "log"): ("IN", "-o", "OUT.ply"),
    ("model", "against"): ("log.mcap", "--against", "IN", "-o", "OUT.ply"),
    ("model", "model"): ("log.mcap", "--model", "IN", "-o", "OUT.ply"),
    ("model", "truth_file"): ("log.mcap", "--truth", "IN", "-o", "OUT.ply"),
    ("config", "log"): ("IN",),
    ("config", "config_file"): ("--config", "IN"),
    ("config", "robot_file"): ("--robot", "IN"),
}
SEEDS: dict[str, tuple[str, ...]] = {
    "source": ("log.mcap", "log.mcap", "scenario.toml", "scans"), "log": ("log.mcap",), "against": ("model.ply",),
    "model": ("model.ply", "model.obj"),
    "truth_file": ("result/truth.tum",), "config_file": ("config.toml",), "golden": ("result/rows.jsonl",),
    "result": ("result",), "results": ("result",), "gate": ("rules.toml",), "robot_file": ("robot.toml",),
     "campaign": ("campaign.toml",),
    "output": ("sweep",),
}  # fmt: skip


def listed() -> list[tuple[str, str]]:
    """Every input of every command. Raises SystemExit if one has no case here."""
    found = [("sweep", "output")]
    for name in SUMMARIES:
        command = group.get_command(click.Context(group), name)
        for param in command.params if command else ():
            if isinstance(param.type, click.Path) and param.name not in OUTPUTS:
                found.append((name, str(param.name)))
    missing = [case for case in found if case not in CASES]
    if missing:
        raise SystemExit(f"no seed for {missing}: add it to CASES")
    return found


def call(*args: object) -> None:
    group.main([str(a) for a in args], standalone_mode=False, prog_name="avsreplay")


def build(folder: Path) -> None:
    """The intact seeds."""
    from avsreplay.log import open_source
    from avsreplay.log.surface import surface_bytes

    texts = {"scenario.toml": SCENARIO, "campaign.toml": CAMPAIGN, "rules.toml": RULES, "robot.toml": ROBOT}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()):
        call("config")
        (folder / "config.toml").write_text(out.getvalue(), encoding="utf-8")
        call("record", folder / "scenario.toml", "-o", folder / "log.mcap", "--compression", "none")
        call("run", folder / "log.mcap", "--init", "truth", "-o", folder / "result")
        call("sweep", folder / "campaign.toml", "-o", folder / "sweep", "--workers", "0")
    with open_source(folder / "log.mcap") as source:
        assert source.header.surface is not None
        vertices, faces = source.header.surface.vertices, source.header.surface.faces
        (folder / "model.ply").write_bytes(surface_bytes(source.header.surface))
        (folder / "scans").mkdir()
        for scan in source.scans():
            np.save(folder / "scans" / f"s_{scan.seq}.npy", scan.points)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    (folder / "model.obj").write_text("\n".join(lines) + "\n")


def number_changed(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace one number of a text by an extreme one."""
    import re

    places = list(re.finditer(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?", data[: 1 << 18]))
    if not places:
        return data
    place = places[int(rng.integers(len(places)))]
    return data[: place.start()] + NUMBERS[int(rng.integers(len(NUMBERS)))] + data[place.end() :]


def damaged(data: bytes, name: str, rng: np.random.Generator) -> bytes:
    """One mutated file."""
    if name.endswith((".toml", ".jsonl", ".json", ".tum", ".obj")) and rng.random() < 0.6:
        for _ in range(int(rng.integers(1, 4))):
            data = number_changed(data, rng)
        return data
    return mutate(data, rng, [data])


def prepare(seed: str, seeds: Path, place: Path, rng: np.random.Generator) -> Path:
    """Copy a seed to ``place`` and damage it, or one of its files; the manifest of a result is renewed mostly."""
    path = place / f"in-{Path(seed).name}"
    if (seeds / seed).is_file():
        path.write_bytes(damaged((seeds / seed).read_bytes(), seed, rng))
        return path
    shutil.copytree(seeds / seed, path)
    files = sorted(p for p in path.rglob("*") if p.is_file() and p.suffix not in (".html", ".mcap"))
    chosen = files[int(rng.integers(len(files)))]
    chosen.write_bytes(damaged(chosen.read_bytes(), chosen.name, rng))
    if seed == "result" and chosen.name != "run.json" and rng.random() < 0.8:
        record = json.loads((path / "run.json").read_text(encoding="utf-8"))
        (path / "run.json").unlink()
        count = len([line for line in (path / "rows.jsonl").read_bytes().splitlines() if line.strip()])
        write_manifest(path, record, count)
    return path


def check(case: tuple[str, str], seeds: Path, place: Path, rng: np.random.Generator) -> str:
    """Run one command on one damaged input; one word about the outcome. Raises on a finding."""
    command, param = case
    choices = SEEDS[param]
    seed = choices[int(rng.integers(len(choices)))]
    damaged_input = prepare(seed, seeds, place, rng)
    before = {p for p in place.rglob("*")}
    args = [damaged_input if w == "IN" else place / w if w.startswith("OUT") else w for w in CASES[case]]
    args = [seeds / a if isinstance(a, str) and (seeds / a).exists() and a not in ("0", "1", "2") else a for a in args]
    outcome, err = _run(command, args)
    left = {p for p in place.rglob("*")} - before - {place / str(w) for w in CASES[case] if w.startswith("OUT")}
    left = {p for p in left if damaged_input not in p.parents}
    if left:
        raise AssertionError(f"files outside the output: {sorted(left)}")
    for line in err.splitlines():
        if "Warning" in line or "Traceback" in line or "\x1b" in line:
            raise AssertionError(f"on the terminal: {line!r}")
    return outcome


def _run(command: str, args: list[object]) -> tuple[str, str]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # as main does
        try:
            call(command, *args)
        except AvsError as error:
            return f"exit {error.exit_code}", _line(str(error)) + err.getvalue()
        except click.ClickException as error:
            return f"exit {error.exit_code}", err.getvalue()
    return "exit 0", err.getvalue()


def _line(text: str) -> str:
    if "\n" in text or "\x1b" in text:
        raise AssertionError(f"an error of more than one line, or with control characters: {text!r}")
    return text + "\n"


def campaign(number: int, inputs: list[int], seeds: Path, cases: list[tuple[str, str]], batch: int = 200) -> Campaign:
    """Run the mutations of a campaign in batches."""

    def task(at: int) -> tuple[str, Check]:
        rng, which = np.random.default_rng([number, at]), cases[at % len(cases)]
        return " ".join(which), lambda folder: check(which, seeds, folder, rng)

    return run_campaign(inputs, task, LIMIT_S, LIMIT_MIB, batch)


def main() -> int:
    """Run and print one JSON document; exit 1 on any finding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--campaign", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", type=int)
    parser.add_argument("--commands", nargs="*", default=list(SUMMARIES), help="only these commands")
    parser.add_argument("--quick", action="store_true", help="500 mutations")
    asked = parser.parse_args()
    cases = [case for case in listed() if case[0] in asked.commands]
    count = 500 if asked.quick else asked.inputs
    inputs = [asked.only] if asked.only is not None else list(range(asked.first, asked.first + count))
    with tempfile.TemporaryDirectory() as folder:
        build(Path(folder))
        return report(asked.campaign, len(inputs), campaign(asked.campaign, inputs, Path(folder), cases))


if __name__ == "__main__":
    raise SystemExit(main())
