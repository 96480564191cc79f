"""Fuzz campaign on every input of every command: ``python tests/benchmarks/fuzz_commands.py
[--quick] [--inputs N]``.

The inputs are listed from the options and arguments of the commands: a new one without a seed here
ends the campaign. One input of a command is mutated and the command is run. It must succeed or end
in one error line: an internal error, a warning on the terminal, more than 20 s of processor time,
more than 512 MiB, a crash of the interpreter or a file outside the requested output is a finding.
Mutation i depends only on (campaign, i): ``--campaign S --only i`` repeats it.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import json
import os
import re
import shutil
import sys
import tempfile
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import click
import numpy as np
from fuzz_inputs import in_place, mutate
from fuzz_workers import Campaign, Check, report, run_campaign

from avsreplay import log
from avsreplay.cli.main import SUMMARIES, group
from avsreplay.errors import AvsError
from avsreplay.log import GrowingLog, growing
from avsreplay.report.result import write_manifest
from avsreplay.simulate import scenario

LIMIT_S, LIMIT_MIB = 20, 512
ROOT = Path(__file__).resolve().parents[2]
OUTPUTS = {"output", "update_golden", "junit", "export", "mesh", "poses", "animate", "job_file"}
NUMBERS = (
    b"0",
    b"-1",
    b"1e999",
    b"-1e308",
    b"1e20",
    b"1e-320",
    b"9" * 400,
    b"9223372036854775807",
    b"nan",
    b"inf",
    b"-0.0",
    b"1e15",
    b"0.5",
    b"2",
    b"1e6",
)
WORDS = (
    b"true",
    b"null",
    b'"x"',
    b'"\\ud800"',
    b'"\\u001b[31m"',
    b"[]",
    b"{}",
    b"",
    b"1970-01-01",
    b"[[1]]",
)
SCENARIO = """name = "tiny"
seed = 1
duration_s = 2.5
rate_hz = 2.0
[target]
shape = "bracket"
[motion]
position_m = [0.1, 0.0, 3.0]
rate_radps = [0.06, 0.064, -0.048]
[scanner]
fov_deg = [30.0, 30.0]
rays = [40, 40]
noise_m = 0.008
[[fault]]
kind = "occlusion"
start_s = 1.9
duration_s = 0.3
"""
CAMPAIGN = """name = "tiny"
scenario = "SCENARIO"
[[grid]]
key = "scenario.scanner.noise_m"
values = [0.004, 0.008]
[[draw]]
key = "scenario.motion.attitude_xyzw"
kind = "attitude"
"""
RULES = '[[rule]]\nmetric = "pose_pos_rmse_m"\nmax = 0.5\nmax_ratio = 1.5\noptional = true\n'
ROBOT = (
    "[robot]\nmass_kg = 80.0\nthrust_axes_n = [6.0, 4.0, 4.0]\nreach_max_m = 9.0\ndelay_s ="
    " 0.2\nthrust_noise = 0.01\n"
)
POSES = ("truth.tum", "truth.kitti", "truth.csv", "truth.txt")
LOGS = (
    "log.mcap",
    "log.mcap",
    "zstd.mcap",
    "ros0.bag",
    "ros1.bag",
    "ros2.db3",
    "scans",
    "flat.mcap",
    "clouds",
)
MODELS = ("model.ply", "model.obj", "model.stl", "model.ascii.stl", "model.off", "model.glb")
RUN = ("--init", "truth", "--n-scans", "2", "--json")
NO_MODEL = ("--model", "model.ply", "--init", "0,0,3,0,0,0,1", "--n-scans", "2", "--json")
SEEN = ("--n-scans", "4", "--init", "truth")
ONE_SCAN = ("--n-scans", "1", "--backend", "horn", "--workers", "0")
MEASURED = ("--backend", "poses", "--extent", "2", "--n-scans", "3", "--json")
# (command, input) -> (arguments, seeds); IN is the mutated input, OUT an output, the other words
# name intact seeds or are values. One of several lines of arguments is drawn.
Lines = tuple[tuple[str, ...], ...]
CASES: dict[tuple[str, str], tuple[Lines, tuple[str, ...]]] = {
    ("record", "source"): ((("IN", "-o", "OUT.mcap"),), ("scenario.toml", *LOGS)),
    ("record", "model"): ((("scans", "--model", "IN", "-o", "OUT.mcap"),), MODELS),
    ("record", "truth_file"): ((("scans", "--truth", "IN", "-o", "OUT.mcap"),), POSES),
    ("run", "log"): ((("IN", *RUN), ("IN", *RUN[:-1]), ("IN", *NO_MODEL)), LOGS),
    ("run", "config_file"): ((("log.mcap", "--config", "IN", *RUN),), ("config.toml",)),
    ("run", "model"): ((("log.mcap", "--model", "IN", *RUN),), MODELS),
    ("run", "truth_file"): ((("scans", "--model", "model.ply", "--truth", "IN", *RUN),), POSES),
    ("run", "robot_file"): ((("log.mcap", "--robot", "IN", *RUN),), ("robot.toml",)),
    ("run", "task_file"): ((("log.mcap", "--task", "IN", *RUN),), ("task.toml",)),
    ("run", "golden"): ((("log.mcap", "--golden", "IN", *RUN),), ("result/rows.jsonl",)),
    ("info", "source"): ((("IN",), ("IN", "--model", "model.ply")), LOGS),
    ("info", "model"): ((("log.mcap", "--model", "IN"),), MODELS),
    ("info", "truth_file"): ((("scans", "--truth", "IN"),), POSES),
    ("doctor", "source"): (
        (("IN", "--repair", "OUT.mcap"),),
        ("log.mcap", "zstd.mcap", "ros1.bag", "ros2.db3"),
    ),
    ("bench", "log"): (
        (("IN", "--n-scans", "1", "--backends", "horn"),),
        ("log.mcap", "zstd.mcap"),
    ),
    ("bench", "model"): (
        (("log.mcap", "--model", "IN", "--n-scans", "1", "--backends", "horn"),),
        MODELS,
    ),
    ("observability", "log"): ((("IN", *SEEN),), ("log.mcap", "zstd.mcap")),
    ("observability", "model"): ((("log.mcap", "--model", "IN", *SEEN),), MODELS),
    ("observability", "truth_file"): ((("log.mcap", "--truth", "IN", *SEEN),), POSES),
    ("plan", "result"): ((("IN", "--at", "0", "--samples", "2", "--every", "1"),), ("result",)),
    ("plan", "robot_file"): (
        (("result", "--robot", "IN", "--at", "0", "--samples", "2"),),
        ("robot.toml",),
    ),
    ("odometry", "log"): (
        (("IN", "-o", "OUT.tum", "--n-scans", "4"),),
        ("log.mcap", "zstd.mcap", "scans"),
    ),
    ("report", "result"): ((("IN", "-o", "OUT.html"),), ("result", "interrupted")),
    ("export", "result"): (
        tuple(
            ("IN", "--to", kind, "-o", f"OUT.{kind}") for kind in ("csv", "tum", "kitti", "parquet")
        ),
        ("result",),
    ),
    ("compare", "results"): (
        (("result", "IN", "-o", "OUT.html"),),
        ("result", "result/rows.jsonl", "interrupted"),
    ),
    ("compare", "gate"): (
        (("result", "result", "--gate", "IN", "--junit", "OUT.xml"),),
        ("rules.toml",),
    ),
    ("sweep", "campaign"): (
        (("IN", "--plan"), ("IN", "-o", "OUT", "--limit", "1", "--workers", "0")),
        ("campaign.toml",),
    ),
    ("sweep", "output"): (
        (("campaign.toml", "-o", "IN", "--limit", "0", "--workers", "0"),),
        ("sweep",),
    ),
    ("model", "log"): ((("IN", "-o", "OUT.ply", "--n-scans", "4"),), ("dense.mcap",)),
    ("model", "against"): (
        (("dense.mcap", "--against", "IN", "-o", "OUT.ply", "--n-scans", "4"),),
        MODELS,
    ),
    ("benchmark", "data"): (
        (("--only", "real-turntable", "--data", "IN", "-o", "OUT", *ONE_SCAN),),
        ("scans",),
    ),
    ("config", "log"): ((("IN",),), ("log.mcap", "zstd.mcap")),
    ("config", "config_file"): ((("--config", "IN"),), ("config.toml",)),
    ("config", "robot_file"): ((("--robot", "IN"),), ("robot.toml",)),
    ("config", "task_file"): ((("--task", "IN"),), ("task.toml",)),
    # Inputs without an option of their own.
    ("run", "measured poses"): (
        (("IN", *MEASURED), ("IN", *MEASURED[:-1])),
        ("truth.tum", "truth.csv", "poses.mcap"),
    ),
    ("run", "standard input"): ((("-", *RUN),), ("log.mcap", "zstd.mcap", "scans.mcap")),
    ("run", "followed file"): (
        (("IN", "--follow", *RUN), ("IN", "--follow", *NO_MODEL)),
        ("log.mcap", "zstd.mcap", "flat.mcap"),
    ),
    ("run", "interrupted"): (
        (("log.mcap", "--init", "truth", "-o", "IN", "--resume", "--json"),),
        ("interrupted",),
    ),
    ("run", "cached index"): ((("log.mcap", *RUN),), ("cache",)),
    ("info", "measured poses"): ((("IN", "--poses"),), ("truth.tum", "truth.csv", "poses.mcap")),
}
WHOLE = (
    "run",
    "observability",
    "bench",
    "model",
)  # commands that replay scans are drawn less often
CHEAP = 40
WITHOUT_OPTION = {case for case in CASES if " " in case[1] or case[1] == "interrupted"}


def listed() -> list[tuple[str, str]]:
    """Every input of every command.

    Raises SystemExit if one has no case here, or a case names none.
    """
    found = [("sweep", "output")]
    for name in SUMMARIES:
        command = group.get_command(click.Context(group), name)
        for param in command.params if command else ():
            if isinstance(param.type, click.Path) and param.name not in OUTPUTS:
                found.append((name, str(param.name)))
    missing, stale = (
        [c for c in found if c not in CASES],
        CASES.keys() - set(found) - WITHOUT_OPTION,
    )
    if missing or stale:
        raise SystemExit(f"no seed for {missing}: add it to CASES; no such input: {sorted(stale)}")
    return found + sorted(WITHOUT_OPTION)


class WrittenLog(GrowingLog):
    """A log that is written while it is followed: longer by a piece at each look; one in ten is
    shortened once.

    Sizes and order of the pieces depend on the bytes alone. When all are written, nothing more is
    waited for, as after Ctrl-C: a damaged file may have no end.
    """

    def __init__(self, path: Path, feed: BinaryIO | None = None) -> None:
        self._rest: list[bytes] = []
        if feed is None and path.is_file():
            data = path.read_bytes()
            rng = np.random.default_rng(zlib.crc32(data))
            cuts = sorted(int(cut) for cut in rng.integers(0, len(data) + 1, size=5))
            self._rest = [data[a:b] for a, b in itertools.pairwise([0, *cuts, len(data)])]
            if rng.random() < 0.1:
                self._rest.insert(3, b"")
            path.write_bytes(self._rest.pop(0) if rng.random() < 0.9 else b"")
        super().__init__(path, feed)

    def advance(self) -> bool:
        if self._rest:
            piece = self._rest.pop(0)
            with self.path.open("r+b") as file:
                file.seek(0, os.SEEK_END)
                if not piece:  # the writer begins anew in the same file
                    file.truncate(file.tell() // 2)
                    file.seek(0, os.SEEK_END)
                file.write(piece)
        elif not self._fed:
            self.stop()
        return super().advance()


def call(*args: object) -> None:
    group.main([str(a) for a in args], standalone_mode=False, prog_name="avsreplay")


def build(folder: Path) -> None:
    """The intact seeds."""
    from avsreplay.cli import backends
    from avsreplay.cli import run as run_command

    scenario.MAX_SCANS = (
        2000  # more are refused as those above the limit are, not recorded for hours
    )
    log.GrowingLog, growing._POLL_S, growing._OPENING_DURATIONS = WrittenLog, 0.0, 0.0
    backends._peak_mib = lambda *_: None  # no process of its own for each measurement of memory
    texts = {
        "scenario.toml": SCENARIO,
        "rules.toml": RULES,
        "robot.toml": ROBOT,
        "task.toml": "[task]\ngrasp_m = [0.0, 0.0, 0.0]\nangle_deg = 2.0\n",
        "dense.toml": SCENARIO.replace("[40, 40]", "[80, 80]"),
        "campaign.toml": CAMPAIGN.replace("SCENARIO", str(folder / "scenario.toml")),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    collect = run_command.collect
    with (
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()),
    ):
        call("config")
        (folder / "config.toml").write_text(out.getvalue(), encoding="utf-8")
        call("record", folder / "scenario.toml", "-o", folder / "log.mcap", "--compression", "none")
        call(
            "record", folder / "scenario.toml", "-o", folder / "zstd.mcap", "--compression", "zstd"
        )
        call("record", folder / "dense.toml", "-o", folder / "dense.mcap")
        with cached(folder / "cache"):
            call("run", folder / "log.mcap", "--init", "truth", "-o", folder / "result")
        run_command.collect = lambda found, *_, **__: bool(next(found))
        with contextlib.suppress(click.Abort, KeyboardInterrupt):
            call("run", folder / "log.mcap", "--init", "truth", "-o", folder / "interrupted")
        run_command.collect = collect
        call("sweep", folder / "campaign.toml", "-o", folder / "sweep", "--workers", "0")
    _files(folder)


@contextlib.contextmanager
def cached(folder: Path) -> Iterator[None]:
    """Keep also the index of a small model on disk, in this folder."""
    from avsreplay.register import index_cache

    least, index_cache.LEAST_PRIMITIVES = index_cache.LEAST_PRIMITIVES, 0
    os.environ["XDG_CACHE_HOME"] = str(folder)
    yield
    index_cache.LEAST_PRIMITIVES = least
    del os.environ["XDG_CACHE_HOME"]


def _files(folder: Path) -> None:
    """The same scans, model and poses in other formats."""
    from fuzz_inputs import seeds
    from mcap.writer import Writer

    from avsreplay.log import open_source
    from avsreplay.log.cdr import pose_stamped
    from avsreplay.log.header import surface_bytes

    others = seeds()
    with open_source(folder / "log.mcap") as source:
        assert source.header.surface is not None
        (folder / "model.ply").write_bytes(surface_bytes(source.header.surface))
        for name in ("scans", "clouds"):
            (folder / name).mkdir()
        for scan in source.scans():
            np.save(folder / "scans" / f"s_{scan.seq}.npy", scan.points)
        poses = [(scan.t_ns, source.truth_of(scan).pose) for scan in source.scans()]
    for name in ("little.ply", "ascii.ply", "big.ply", "binary.pcd", "packed.pcd", "ascii.pcd"):
        (folder / "clouds" / name).write_bytes(others[name])
    for name in (
        "ros0.bag",
        "ros1.bag",
        "ros2.db3",
        "flat.mcap",
        "model.stl",
        "model.ascii.stl",
        "model.obj",
        "model.off",
        "model.glb",
    ):
        (folder / name).write_bytes(others[name])
    tum, kitti, euroc, mcap = [], [], ["#t,p"], (folder / "poses.mcap").open("wb")
    with mcap:
        writer = Writer(mcap)
        writer.start("ros2")
        channel = writer.register_channel(
            "/pose", "cdr", writer.register_schema("geometry_msgs/msg/PoseStamped", "ros2msg", b"")
        )
        for t_ns, pose in poses:
            assert pose is not None
            x, y, z, w = pose.q.tolist()
            tum.append(" ".join(map(repr, [t_ns * 1e-9, *pose.t.tolist(), x, y, z, w])))
            kitti.append(" ".join(map(repr, pose.matrix[:3].ravel().tolist())))
            euroc.append(",".join(map(repr, [t_ns, *pose.t.tolist(), w, x, y, z])))
            writer.add_message(channel, t_ns, pose_stamped(t_ns, "tracker", pose), t_ns)
        writer.finish()
    for name, lines in (
        ("truth.tum", tum),
        ("truth.kitti", kitti),
        ("truth.csv", euroc),
        ("truth.txt", tum),
    ):
        (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "scans.mcap").write_bytes((folder / "log.mcap").read_bytes())


def number_changed(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace one number of a text by an extreme one, rarely by a word."""
    places = list(
        re.finditer(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])", data[: 1 << 18])
    )
    if not places:
        return data
    place, choices = (
        places[int(rng.integers(len(places)))],
        NUMBERS if rng.random() < 0.8 else WORDS,
    )
    return data[: place.start()] + choices[int(rng.integers(len(choices)))] + data[place.end() :]


def line_changed(data: bytes, rng: np.random.Generator) -> bytes:
    """Remove, repeat or move one line of a text."""
    lines = data.splitlines(keepends=True)
    if not lines:
        return data
    line = lines.pop(int(rng.integers(len(lines))))
    for _ in range(int(rng.integers(3))):
        lines.insert(int(rng.integers(len(lines) + 1)), line)
    return b"".join(lines)


def damaged(data: bytes, name: str, rng: np.random.Generator) -> bytes:
    """One mutated file: half of the time a valid one with other values, as far as that is
    possible.
    """
    text = name.endswith(
        (".toml", ".jsonl", ".json", ".tum", ".kitti", ".csv", ".txt", ".obj", ".off", ".ascii.stl")
    )
    if text and rng.random() < 0.7:
        change = line_changed if rng.random() < 0.2 else number_changed
        for _ in range(int(rng.integers(1, 3))):
            data = change(data, rng)
        return data
    if name.endswith(".avsindex") and rng.random() < 0.8:
        from avsreplay.register.index_cache import HEADER, header
        from avsreplay.register.surface_index import kernel_module

        payload = in_place(data[HEADER:], rng)
        return header(payload, kernel_module().checksum) + payload
    return in_place(data, rng) if rng.random() < 0.6 else mutate(data, rng, [data])


def prepare(seed: str, seeds: Path, place: Path, rng: np.random.Generator) -> Path:
    """Copy a seed to ``place`` and damage it, or one of its files; the manifest of a result
    is renewed mostly.
    """
    path = place / f"in-{Path(seed).name}"
    if (seeds / seed).is_file():
        path.write_bytes(damaged((seeds / seed).read_bytes(), seed, rng))
        return path
    shutil.copytree(seeds / seed, path)
    files = sorted(p for p in path.rglob("*") if p.is_file() and p.suffix not in (".html", ".mcap"))
    chosen = files[int(rng.integers(len(files)))]
    chosen.write_bytes(damaged(chosen.read_bytes(), chosen.name, rng))
    if seed in ("result", "interrupted") and chosen.name != "run.json" and rng.random() < 0.8:
        record = json.loads((path / "run.json").read_text(encoding="utf-8"))
        (path / "run.json").unlink()
        count = len(
            [line for line in (path / "rows.jsonl").read_bytes().splitlines() if line.strip()]
        )
        write_manifest(path, record, count)
    return path


def check(case: tuple[str, str], seeds: Path, place: Path, rng: np.random.Generator) -> str:
    """Run one command on one damaged input; one word about the outcome. Raises on a finding."""
    lines, choices = CASES[case]
    words, seed = lines[int(rng.integers(len(lines)))], choices[int(rng.integers(len(choices)))]
    damaged_input = prepare(seed, seeds, place, rng)
    before = {p for p in place.rglob("*")}
    outcome, err = invoke(case[0], words, damaged_input, seeds, place, cache=seed == "cache")
    allowed = {damaged_input, *(place / w for w in words if w.startswith("OUT"))}
    left = {p for p in place.rglob("*") if p not in before and not allowed & {p, *p.parents}}
    if left:
        raise AssertionError(f"files outside the output: {sorted(left)}")
    for line in err.splitlines():
        if "Warning" in line or "Traceback" in line or "\x1b" in line:
            raise AssertionError(f"on the terminal: {line!r}")
    return outcome


def invoke(
    command: str, words: tuple[str, ...], given: Path, seeds: Path, place: Path, *, cache: bool
) -> tuple[str, str]:
    """Run a command on an input; its outcome and what it wrote to standard error."""
    args = [given if w == "IN" else place / w if w.startswith("OUT") else w for w in words]
    args = [seeds / a if isinstance(a, str) and (seeds / a).exists() else a for a in args]
    feed = given.open("rb") if "-" in words else None
    with cached(given) if cache else contextlib.nullcontext():
        return _run(command, args, feed)


def check_seeds(seeds: Path, cases: list[tuple[str, str]]) -> None:
    """Run every command on its intact inputs, so that later failures are due to a mutation.

    Raises SystemExit.
    """
    for case in cases:
        lines, choices = CASES[case]
        for words in lines:
            with tempfile.TemporaryDirectory() as place:
                copied = Path(place) / f"in-{Path(choices[0]).name}"
                (shutil.copytree if (seeds / choices[0]).is_dir() else shutil.copyfile)(
                    seeds / choices[0], copied
                )
                code, err = invoke(
                    case[0], words, copied, seeds, Path(place), cache=choices[0] == "cache"
                )
            unfit = case == ("model", "against") and "does not fit the CAD model" in err
            if code not in ("exit 0", "exit 1") and not unfit:  # of four scans of one side
                raise SystemExit(f"{case} {words}: {code} with an intact input: {err}")


def _run(command: str, args: list[object], feed: BinaryIO | None) -> tuple[str, str]:
    out, err = io.StringIO(), io.StringIO()
    sys.stdin = io.TextIOWrapper(feed, encoding="utf-8") if feed else sys.__stdin__
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")  # as main does
        try:
            call(command, *args)
        except AvsError as error:
            return f"exit {error.exit_code}", _line(str(error)) + err.getvalue()
        except click.ClickException as error:
            return f"exit {error.exit_code}", err.getvalue()
    return "exit 0", err.getvalue()


def _line(text: str) -> str:
    """The line on the terminal; the command writes control characters as escapes."""
    if len(text) > 2000:
        raise AssertionError(f"an error of {len(text)} characters: {text[:200]!r}")
    return text.encode("unicode_escape").decode() + "\n"


def campaign(
    number: int, inputs: list[int], seeds: Path, cases: list[tuple[str, str]], batch: int = 100
) -> Campaign:
    """Run the mutations of a campaign in batches."""

    weights = np.array([1.0 if name in WHOLE else CHEAP for name, _ in cases])

    def task(at: int) -> tuple[str, Check]:
        rng = np.random.default_rng([number, at])
        which = cases[int(rng.choice(len(cases), p=weights / weights.sum()))]
        return " ".join(which), lambda folder: check(which, seeds, folder, rng)

    return run_campaign(inputs, task, LIMIT_S, LIMIT_MIB, batch)


def main() -> int:
    """Run and print one JSON document; exit 1 on any finding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--campaign", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", type=int)
    parser.add_argument(
        "--commands", nargs="*", default=list(SUMMARIES), help="only these commands"
    )
    parser.add_argument(
        "--cases", nargs="*", help='only these inputs, for example "run followed file"'
    )
    parser.add_argument("--quick", action="store_true", help="500 mutations")
    asked = parser.parse_args()
    cases = [case for case in listed() if case[0] in asked.commands]
    cases = [case for case in cases if not asked.cases or " ".join(case) in asked.cases]
    count = 500 if asked.quick else asked.inputs
    inputs = (
        [asked.only] if asked.only is not None else list(range(asked.first, asked.first + count))
    )
    with tempfile.TemporaryDirectory() as folder:
        build(Path(folder))
        check_seeds(Path(folder), cases)
        return report(
            asked.campaign, len(inputs), campaign(asked.campaign, inputs, Path(folder), cases)
        )


if __name__ == "__main__":
    raise SystemExit(main())
