"""A campaign whose scheduler or own process is killed: ``python tests/benchmarks/sweep_kill.py
[--quick] [--runs 200] [--kills 5] [--seed 1]``.

The runs are made on one worker of a Dask scheduler. SIGKILL ends the scheduler or the command after
drawn numbers of finished runs, at last while the results are written; the same command continues.
At the end every file must have the bytes of an undisturbed campaign of one process, no other file
may be left, and after the end of a scheduler the command must end with exit code 3 and one line.
Exit code 1 if any differs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from avsreplay.arithmetic import PINS
from avsreplay.sweep.journal import Journal

CAMPAIGN = """name = "killed"
seed = 5
repeats = {repeats}
[set]
"scenario.duration_s" = 1.5
"scenario.rate_hz" = 2.0
"scenario.scanner.rays" = [24, 24]
"run.plan.enabled" = false
[[grid]]
key = "scenario.scanner.noise_m"
values = [0.004, 0.016]
"""
LINE = "avsreplay: Dask scheduler: it ended before"
STOPPED = ("killed", "3")  # how a command ends that is stopped: by the signal, or with this code


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a campaign but the lock; of the journal without the order of its
    lines.
    """
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p.name != "lock"):
        data = path.read_bytes()
        if path.name == "journal.txt":
            data = b"".join(sorted(data.splitlines(keepends=True)))
        found[str(path.relative_to(folder))] = hashlib.sha256(data).hexdigest()
    return found


@contextmanager
def cluster(place: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Address and process of a scheduler with one worker."""
    known = place / "scheduler.json"
    known.unlink(missing_ok=True)
    start = [sys.executable, "-m"]
    options = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": place}
    listed = ["--port", "0", "--no-dashboard", "--scheduler-file", str(known)]
    scheduler = subprocess.Popen([*start, "distributed.cli.dask_scheduler", *listed], **options)
    processes = [scheduler]
    try:
        while not known.exists():
            time.sleep(0.05)
        address = json.loads(known.read_text(encoding="utf-8"))["address"]
        worker = [*start, "distributed.cli.dask_worker", address, "--nthreads", "1"]
        processes.append(subprocess.Popen([*worker, "--no-dashboard", "--no-nanny"], **options))
        yield address, scheduler
    finally:
        for each in processes:
            each.kill()
            each.wait()


def stopped(
    campaign: Path, out: Path, address: str, scheduler: subprocess.Popen[bytes] | None, after: int
) -> tuple[str, str]:
    """Start the command and kill the scheduler, or without one the command, after a number of
    finished runs; how the command ended, and what it wrote.
    """
    words = ["sweep", str(campaign), "-o", str(out), "--scheduler", address]
    command = subprocess.Popen(
        [sys.executable, "-m", "avsreplay", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    journal = out / "journal.txt"
    while command.poll() is None and not (
        journal.is_file() and journal.read_bytes().count(b"\n") >= after
    ):
        time.sleep(0.005)
    (scheduler or command).send_signal(signal.SIGKILL)
    _, err = command.communicate()
    code = command.returncode
    return ("killed" if code == -signal.SIGKILL else str(code)), err


def disturbed(
    campaign: Path, place: Path, kills: list[int], *, of_scheduler: bool
) -> tuple[Path, list[str]]:
    """A campaign that is stopped again and again, and then finished; its folder, and what was
    wrong.
    """
    out, wrong = place / ("scheduler" if of_scheduler else "command"), list[str]()
    for after in kills:
        with cluster(place) as (address, scheduler):
            victim = scheduler if of_scheduler else None
            how, err = stopped(campaign, out, address, victim, after)
        done = len(Journal(out).status)
        print(f"{out.name} killed after {after} runs: {done} kept, ended {how}", flush=True)
        last = (err.splitlines() or [""])[-1]
        if how not in (*STOPPED, "0") or (how == "3" and not last.startswith(LINE)):
            wrong.append(f"{out.name} after {after} runs: {how}: {err[-300:]!r}")
        if done < after:
            wrong.append(f"{out.name}: {done} runs are kept of {after}")
    finished = [sys.executable, "-m", "avsreplay", "sweep", str(campaign), "-o", str(out)]
    subprocess.run([*finished, "--workers", "0"], check=True, stdout=subprocess.DEVNULL)
    return out, wrong


def main() -> int:
    """Run the campaigns and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="20 runs, 2 instants")
    asked = parser.parse_args()
    runs, kills = (20, 2) if asked.quick else (asked.runs, asked.kills)
    rng = random.Random(asked.seed)
    os.environ |= {**PINS, "OMP_NUM_THREADS": "1"}  # workers have the arithmetic of the command
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        campaign = place / "c.toml"
        campaign.write_text(CAMPAIGN.format(repeats=runs // 2), encoding="utf-8")
        start = [sys.executable, "-m", "avsreplay", "sweep", str(campaign), "--workers", "0"]
        whole = place / "whole"
        subprocess.run([*start, "-o", str(whole)], check=True, stdout=subprocess.DEVNULL)
        expected, wrong = digests(whole), list[str]()
        print(f"{runs} runs, {len(expected)} files", flush=True)
        for of_scheduler in (True, False):
            instants = [*sorted(rng.randrange(runs) for _ in range(kills - 1)), runs]
            out, found = disturbed(campaign, place, instants, of_scheduler=of_scheduler)
            wrong += found
            ended = digests(out)
            wrong += [
                f"{out.name}: {name} differs, is missing or is left"
                for name in sorted(expected.keys() | ended.keys())
                if expected.get(name) != ended.get(name)
            ]
            shutil.rmtree(out)
    print("\n".join(wrong) or "every file has the bytes of the undisturbed campaign")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
