"""Outputs of every command: every kind of file node, full disks, two writers at once, and kill -9
at random moments.

``python tests/benchmarks/outputs.py [--quick] [--kills N] [--seed S] [--only COMMAND]``. The
outputs are listed from the options of the commands: a new one without a case here ends the
campaign. A node must keep its kind, an output must be complete, old or absent, nothing else may be
left behind, and the same command must succeed afterwards.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import socket
import stat
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
from fuzz_commands import ONE_SCAN, OUTPUTS, build
from fuzz_workers import Command, Done

from avsreplay.cli.main import SUMMARIES, group
from avsreplay.errors import AvsError
from avsreplay.log import open_source
from avsreplay.log.header import read_surface
from avsreplay.report.result import load_result

REAL = ("--only", "real-turntable", "--data", "scans", *ONE_SCAN)
RUN = ("log.mcap", "--init", "truth", "--n-scans", "2")
# (command, output) -> arguments; OUT is the output, the other words name intact inputs.
CASES: dict[tuple[str, str], tuple[str, ...]] = {
    ("record", "output"): ("scenario.toml", "-o", "OUT", "--overwrite"),
    ("info", "job_file"): ("log.mcap", "--write", "OUT", "--overwrite"),
    ("run", "output"): (*RUN, "-o", "OUT", "--overwrite"),
    ("run", "update_golden"): (*RUN, "--update-golden", "OUT"),
    ("doctor", "output"): ("log.mcap", "--repair", "OUT", "--overwrite"),
    ("plan", "export"): (
        "result",
        "--at",
        "0",
        "--samples",
        "1",
        "--every",
        "1",
        "--export",
        "OUT",
        "--overwrite",
    ),
    ("plan", "animate"): (
        "result",
        "--at",
        "0",
        "--samples",
        "1",
        "--every",
        "1",
        "--animate",
        "OUT",
        "--overwrite",
    ),
    ("report", "output"): ("result", "-o", "OUT", "--overwrite"),
    ("export", "output"): ("result", "--to", "csv", "-o", "OUT", "--overwrite"),
    ("compare", "output"): ("result", "result", "-o", "OUT", "--overwrite"),
    ("compare", "junit"): ("result", "result", "--gate", "rules.toml", "--junit", "OUT"),
    ("model", "output"): ("log.mcap", "-o", "OUT", "--overwrite"),
    ("model", "mesh"): ("log.mcap", "-o", "other.ply", "--mesh", "OUT", "--overwrite"),
    ("model", "poses"): ("log.mcap", "-o", "other.ply", "--poses", "OUT", "--overwrite"),
    ("odometry", "output"): ("log.mcap", "-o", "OUT", "--overwrite", "--n-scans", "3"),
    ("sweep", "output"): ("campaign.toml", "-o", "OUT", "--workers", "0"),
    ("benchmark", "output"): (*REAL, "-o", "OUT"),
}
FOLDERS = {("run", "output"), ("sweep", "output"), ("benchmark", "output")}
NODES = (
    "file",
    "null",
    "full",
    "fifo",
    "socket",
    "folder",
    "link to a file",
    "link to null",
    "link to a folder",
    "dangling link",
    "loop of links",
    "missing folder",
    "long name",
    "empty name",
    "dot",
    "root",
)


def listed() -> list[tuple[str, str]]:
    """Every output of every command. Raises SystemExit if one has no case here."""
    found = []
    for name in SUMMARIES:
        command = group.get_command(click.Context(group), name)
        for param in command.params if command else ():
            if isinstance(param.type, click.Path) and param.name in OUTPUTS:
                found.append((name, str(param.name)))
    missing = [case for case in found if case not in CASES]
    if missing:
        raise SystemExit(f"no case for {missing}: add it to CASES")
    return found


def command_line(case: tuple[str, str], seeds: Path, output: str) -> list[str]:
    """The arguments of a case."""
    words = (
        output if w == "OUT" else str(seeds / w) if (seeds / w).exists() else w for w in CASES[case]
    )
    return [case[0], *words]


def node(kind: str, place: Path) -> str:
    """Create a file node in an empty folder; the output to name."""
    path, other = place / "out", place / "other"
    if kind == "file":
        path.write_text("old")
    elif kind in ("null", "full"):
        return f"/dev/{kind}"
    elif kind == "fifo":
        os.mkfifo(path)
        threading.Thread(target=path.read_bytes, daemon=True).start()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind(str(path))
    elif kind == "folder":
        path.mkdir()
        (path / "mine").touch()
    elif kind.startswith(("link", "dangling", "loop")):
        other.write_text("old") if kind == "link to a file" else None
        other.mkdir() if kind == "link to a folder" else None
        path.symlink_to({"link to null": Path("/dev/null"), "loop of links": path}.get(kind, other))
    names = {
        "missing folder": "missing/out",
        "long name": "x" * 300,
        "empty name": "",
        "dot": ".",
        "root": "/",
    }
    if kind in ("empty name", "dot", "root"):
        return names[kind]
    return str(place / names.get(kind, "out"))


def kinds(place: Path) -> dict[str, int]:
    """The kind of every node in a folder, without following links."""
    return {str(p.relative_to(place)): stat.S_IFMT(p.lstat().st_mode) for p in place.rglob("*")}


def errors(done: Done) -> list[str]:
    """The error lines of a command, without its warnings and findings on the log."""
    lines = [line for line in done.stderr.splitlines() if line.startswith("avsreplay: ")]
    return [
        line
        for line in lines
        if "warning" not in line and not line.startswith("avsreplay: background: ")
    ]


def try_node(case: tuple[str, str], kind: str, seeds: Path, root: Path) -> str:
    """Write one output to one node; a finding, or the exit code."""
    place = Path(tempfile.mkdtemp(dir=root))
    output = node(kind, place)
    before = kinds(place)
    done = Command(command_line(case, seeds, output), place, limit_s=120).wait()
    after = kinds(place)
    lines = errors(done)
    if (
        "Traceback" in done.stderr
        or done.returncode in (1, 70)
        or (done.returncode and len(lines) != 1)
    ):
        return f"FINDING {case} {kind}: exit {done.returncode}: {done.stderr[-300:]}"
    changed = [name for name, what in before.items() if after.get(name) != what]
    allowed = (
        "out",
        "other",
        "report.html",
        *(("missing",) if case in FOLDERS else ()),
    )  # their parents are created
    extra = [name for name in after.keys() - before.keys() if not name.startswith(allowed)]
    if changed or extra or any(".part" in name for name in after):
        return f"FINDING {case} {kind}: changed {changed}, left {extra}"
    if not all(stat.S_ISCHR(Path(f"/dev/{name}").stat().st_mode) for name in ("null", "full")):
        return f"FINDING {case} {kind}: a device was replaced"
    return f"exit {done.returncode}"


def is_complete(case: tuple[str, str], path: Path) -> bool:
    """Whether an output is what its command writes when it is not disturbed."""
    try:
        if case == ("sweep", "output"):
            return (path / "summary.json").read_text(encoding="utf-8").endswith("}\n")
        if case == ("run", "output"):
            return not load_result(path).unverified
        if path.suffix == ".ply":
            return bool(len(read_surface(path, cloud_ok=True).vertices))
        if path.suffix == ".mcap":
            with open_source(path) as source:
                return not source.losses
    except AvsError:
        return False
    text = path.read_text(encoding="utf-8", errors="replace")
    ends = {".html": "</html>", ".xml": "</testsuites>", ".csv": "\n", ".jsonl": "\n"}
    return text.rstrip(" ").endswith(ends[path.suffix]) or text.rstrip().endswith(ends[path.suffix])


SUFFIX = {
    "record": ".mcap",
    "doctor": ".mcap",
    "report": ".html",
    "export": ".csv",
    "plan": ".csv",
    "model": ".ply",
    "odometry": ".tum",
}


def output_of(case: tuple[str, str], place: Path) -> Path:
    """Name of an output in a folder."""
    suffixes = {
        ("compare", "output"): ".html",
        ("compare", "junit"): ".xml",
        ("run", "update_golden"): ".jsonl",
        ("info", "job_file"): ".toml",
        ("plan", "animate"): ".html",
    }
    return place / f"out{'' if case in FOLDERS else suffixes.get(case) or SUFFIX[case[0]]}"


def finished(line: list[str], place: Path, file_bytes: int | None = None) -> Done:
    """Run a command to its end; with ``file_bytes`` no file may become larger, as on a full
    disk.
    """
    return Command(line, place, file_bytes).wait()


def beside(path: Path, *kept: Path) -> list[str]:
    """What stands in the folder of an output, without the second output of a command."""
    return sorted(
        p.name for p in path.parent.iterdir() if p not in (path, *kept) and p.name != "other.ply"
    )


def contents(path: Path) -> dict[str, bytes]:
    """The bytes of a file, or of every file of a folder."""
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    return {str(p.relative_to(path.parent)): p.read_bytes() for p in files}


def full_disk(case: tuple[str, str], seeds: Path, root: Path) -> Iterator[str]:
    """Write an output where no file may become larger than it, in steps; the old output must
    stay as it is.
    """
    place = Path(tempfile.mkdtemp(dir=root))
    path = output_of(case, place)
    line = command_line(case, seeds, str(path))
    finished(line, place)
    old, partial = contents(path), path.with_name(f"{path.name}.partial")
    largest = max(len(data) for data in old.values())
    for share in (0.0, 0.02, 0.5, 0.97):
        done = finished(line, place, int(share * largest))
        lines = errors(done)
        if done.returncode != 3 or len(lines) != 1 or "Traceback" in done.stderr:
            yield f"FINDING {case} full disk: exit {done.returncode}: {done.stderr[-300:]}"
        elif case != ("sweep", "output") and contents(path) != old:
            yield f"FINDING {case} full disk: the old output has changed"
        elif extra := beside(path, partial):
            yield f"FINDING {case} full disk: left {extra}"
        else:
            yield "full disk"
        partial.unlink(missing_ok=True)


def two_writers(case: tuple[str, str], seeds: Path, root: Path) -> str:
    """Two processes write the same output at the same time; it must be complete, and nothing
    else may be left.
    """
    place = Path(tempfile.mkdtemp(dir=root))
    path = output_of(case, place)
    line = command_line(case, seeds, str(path))
    both = [writer.wait() for writer in [Command(line, place) for _ in range(2)]]
    errors, codes = [writer.stderr for writer in both], sorted(writer.returncode for writer in both)
    if codes[0] or codes[1] not in (0, 2, 3) or any("Traceback" in text for text in errors):
        return f"FINDING {case} two writers: exits {codes}: {errors}"
    if not is_complete(case, path) or beside(path):
        return f"FINDING {case} two writers: left {beside(path)}"
    return "two writers"


def kill(
    case: tuple[str, str], seeds: Path, root: Path, kills: int, rng: np.random.Generator
) -> Iterator[str]:
    """Write an output, then kill ``kills`` further writers at random moments; every fifth time one
    may finish.

    A campaign continues where it was killed and must have the summary of one without a disturbance
    when it is complete; then it begins anew.
    """
    place = Path(tempfile.mkdtemp(dir=root))
    path = output_of(case, place)
    line = command_line(case, seeds, str(path))
    start = time.monotonic()
    finished(line, place)
    seconds = time.monotonic() - start
    campaign = case == ("sweep", "output")
    summary = (path / "summary.json").read_bytes() if campaign else b""
    number = hits = 0
    while hits < kills and number < 5 * kills:
        number += 1
        writer = Command(line, place)
        time.sleep(float(rng.uniform(0.0, 1.0)) * seconds)
        killed = writer.kill()
        hits += killed
        if campaign and not killed:
            if (path / "summary.json").read_bytes() != summary:
                yield f"FINDING {case}: another summary after kill -9"
            shutil.rmtree(path)
        if not campaign and not is_complete(case, path):
            yield f"FINDING {case}: after kill -9 the output is neither the old nor the new one"
        elif number % 5 == 4 and (problem := _again(case, line, path)):
            yield problem
        else:
            yield "killed" if killed else "finished before"


def _again(case: tuple[str, str], line: list[str], path: Path) -> str:
    again = finished(line, path.parent)
    if again.returncode:
        return f"FINDING {case}: after kill -9 the command fails: {again.stderr[-200:]}"
    return f"FINDING {case}: left behind: {beside(path)}" if beside(path) else ""


def main() -> int:
    """Run and print one JSON document; exit 1 on any finding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200, help="per output")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--quick", action="store_true", help="no kills, and only the first node of each output"
    )
    parser.add_argument("--only", help="one command")
    asked = parser.parse_args()
    rng = np.random.Generator(np.random.PCG64(asked.seed))
    cases = [case for case in listed() if asked.only in (None, case[0])]
    found: list[str] = []
    killed: list[str] = []
    with tempfile.TemporaryDirectory() as seeds, tempfile.TemporaryDirectory() as root:
        build(Path(seeds))
        for case in cases:
            kept = contents(Path(seeds))
            found += [
                try_node(case, kind, Path(seeds), Path(root))
                for kind in NODES[: 2 if asked.quick else None]
            ]
            if not asked.quick:
                found += [
                    *full_disk(case, Path(seeds), Path(root)),
                    two_writers(case, Path(seeds), Path(root)),
                ]
                killed += kill(case, Path(seeds), Path(root), asked.kills, rng)
            if contents(Path(seeds)) != kept:
                found.append(f"FINDING {case}: an input has changed")
            print(
                case,
                dict(Counter(text[:15] for text in (*found, *killed))),
                file=sys.stderr,
                flush=True,
            )
    findings = [text for text in (*found, *killed) if text.startswith("FINDING")]
    outcomes = {
        "nodes, full disks, two writers": dict(Counter(t.split(":")[0][:11] for t in found)),
        "kills": dict(Counter(t[:15] for t in killed)),
    }
    print(json.dumps({"outputs": len(cases), **outcomes, "findings": findings}, indent=1))
    return 1 if findings else 0


if __name__ == "__main__":
    raise SystemExit(main())
