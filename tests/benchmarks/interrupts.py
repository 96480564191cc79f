"""How long a signal takes to end each command: ``python tests/benchmarks/interrupts.py [--instants
N] [--only NAME]``.

Every case is a command with one long part: a scan of a million points, a model of a million
triangles, a search without a guess, a reconstruction, a plan, a large cloud as the model. It is
started ``--instants`` times, SIGINT or SIGTERM is sent at instants that are spread evenly over its
duration, and the elapsed and the processor time until its end are measured. A line states the
longest of both and at which instant; the table ends with the commands that took longer than
``LIMIT_S``, ended with another code than that of the signal, or left a traceback.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avsreplay.log.header import surface_bytes
from avsreplay.records import Surface

LIMIT_S = 2.0  # within which a signal takes effect
START_S = 0.3  # of the interpreter, which handles signals in its own way
SCENARIO = """name = "dense"
seed = 1
duration_s = {seconds}
rate_hz = 2.0
[target]
shape = "bracket"
[motion]
position_m = [0.1, 0.0, 3.0]
rate_radps = [0.06, 0.064, -0.048]
[scanner]
fov_deg = [{fov}, {fov}]
rays = [{rays}, {rays}]
noise_m = 0.004
"""
COMMAND = [sys.executable, "-m", "avsreplay"]


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes:
        code: its exit code.
        elapsed_s: from the signal to its end; from its start without a signal.
        processor_s: of this time.
        peak_mib: largest resident memory.
        said: what it wrote to standard error.
        signalled: whether the signal was sent before its end.
    """

    code: int
    elapsed_s: float
    processor_s: float
    peak_mib: float
    said: str
    signalled: bool


def processor_s(pid: int) -> float | None:
    """Processor time of a child and of its finished children until now; None if it has ended."""
    parts = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    if parts[0] == "Z":
        return None
    return sum(map(int, parts[11:15])) / os.sysconf("SC_CLK_TCK")


def ended(args: list[str], folder: Path, number: int = 0, after_s: float = 0.0) -> Ended:
    """Run a command in a new output folder; send it a signal after some processor time.

    Args:
        args: its arguments; OUT is the output.
        folder: working directory.
        number: of the signal, 0 for none.
        after_s: processor time of the command at the signal [s].
    """
    with tempfile.TemporaryDirectory(dir=folder) as out, tempfile.TemporaryFile() as errors:
        named = [arg.replace("OUT", f"{out}/out") for arg in args]
        environment = {**os.environ, "XDG_CACHE_HOME": out}
        begun, spent = time.monotonic(), 0.0
        process = subprocess.Popen(
            [*COMMAND, *named],
            cwd=folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            stdin=subprocess.DEVNULL,
        )
        while number and (used_s := processor_s(process.pid)) is not None:
            if used_s >= after_s:
                begun, spent = time.monotonic(), used_s
                process.send_signal(number)
                break
            time.sleep(0.01)
        _, status, used = os.wait4(process.pid, 0)
        elapsed = time.monotonic() - begun
        process.returncode = os.waitstatus_to_exitcode(status)
        errors.seek(0)
        said = errors.read().decode(errors="replace")
    total = used.ru_utime + used.ru_stime
    return Ended(process.returncode, elapsed, total - spent, used.ru_maxrss / 1024, said, spent > 0)


def sphere(rings: int) -> Surface:
    """A body with dents, so that it has no symmetry: two triangles for each cell of a grid."""
    polar, around = np.meshgrid(
        np.linspace(0.02, np.pi - 0.02, rings), np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    )
    radius = 0.5 + 0.1 * np.sin(3 * polar + 1) * np.cos(2 * around) + 0.07 * np.cos(polar + around)
    points = np.stack(
        [
            radius * np.sin(polar) * np.cos(around),
            1.3 * radius * np.sin(polar) * np.sin(around),
            0.8 * radius * np.cos(polar),
        ],
        axis=-1,
    ).reshape(-1, 3)
    a, b = np.meshgrid(np.arange(2 * rings), np.arange(rings - 1), indexing="ij")
    here, beside = a * rings + b, (a + 1) % (2 * rings) * rings + b
    faces = np.concatenate(
        [
            np.stack([here, here + 1, beside], axis=-1).reshape(-1, 3),
            np.stack([beside, here + 1, beside + 1], axis=-1).reshape(-1, 3),
        ]
    )
    return Surface(points, faces.astype(np.int32), "body", "")


def prepare(folder: Path) -> None:
    """The inputs of the cases."""
    for name, rays, fov, seconds in (("small", 60, 30.0, 8.0), ("dense", 1600, 20.0, 1.0)):
        text = SCENARIO.format(rays=rays, fov=fov, seconds=seconds)
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
        done = ended(["record", f"{name}.toml", "-o", f"{name}.mcap"], folder)
        assert done.code == 0, done.said
    assert ended(["run", "small.mcap", "-o", "result"], folder).code == 0
    (folder / "fine.ply").write_bytes(surface_bytes(sphere(710)))  # a million triangles
    (folder / "coarse.ply").write_bytes(surface_bytes(sphere(100)))
    rng = np.random.default_rng(5)
    points = sphere(110).vertices[rng.permutation(24200)][:20000]
    ground = rng.uniform([-6, -6, -1.5], [6, 6, -1.45], size=(25_792, 3))
    cloud = np.concatenate([points, ground])  # a model with background
    whole = Surface(cloud, np.empty((0, 3), np.int32), "cloud", "")
    (folder / "cloud.ply").write_bytes(surface_bytes(whole))
    (folder / "scans").mkdir()
    for k in range(4):
        scan = np.concatenate([points[points[:, 2] < 0.1], ground[::2]])
        scan += np.array([0.0, 0.0, 8 + 0.01 * k])
        np.save(folder / "scans" / f"scan_{k}.npy", scan.astype(np.float32))


CASES = {
    "scan of a million points": ["run", "dense.mcap", "-o", "OUT"],
    "model of a million triangles": ["run", "scans", "--model", "fine.ply", "-o", "OUT"],
    "info on this model": ["info", "scans", "--model", "fine.ply"],
    "search without a guess": ["run", "scans", "--model", "coarse.ply", "-o", "OUT"],
    "cloud as the model": ["run", "scans", "--model", "cloud.ply", "--cloud-model", "-o", "OUT"],
    "reconstruction": ["model", "small.mcap", "-o", "OUT.ply"],
    "odometry": ["odometry", "small.mcap", "-o", "OUT.tum"],
    "plan": ["plan", "result", "--at", "4"],
    "record": ["record", "dense.toml", "-o", "OUT.mcap"],
    "built-in scenario": ["run", "small.mcap", "-o", "OUT"],
    "observability": ["observability", "small.mcap"],
    "report": ["report", "result", "-o", "OUT.html"],
    "sweep": ["sweep", "campaign.toml", "-o", "OUT", "--workers", "1"],
}


def main() -> int:
    """Run the campaign; return 1 if a signal took too long or was not what ended a command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--instants", type=int, default=8, help="signals for each command")
    parser.add_argument("--most", type=float, default=40, help="processor time of a command [s]")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--folder", type=Path, help="where the inputs are kept")
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # not ignored by the commands, either
    late = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        if not (folder / "scans").is_dir():
            folder.mkdir(exist_ok=True)
            prepare(folder)
            text = f'name = "c"\nscenario = "{folder}/small.toml"\n[[grid]]\nkey = '
            text += '"scenario.scanner.noise_m"\nvalues = [0.004, 0.008]\n'
            (folder / "campaign.toml").write_text(text, encoding="utf-8")
        print("case                           whole_s  MiB  longest_s  processor_s  at_s  code")
        for name, args in CASES.items():
            if options.only not in name:
                continue
            whole = ended(args, folder, signal.SIGKILL, options.most)
            longest = whole.processor_s + options.most * (whole.code == -signal.SIGKILL)
            found = []
            for k in range(options.instants):
                at = START_S + (longest - START_S) * (k + 0.5) / options.instants
                number = (signal.SIGINT, signal.SIGTERM)[k % 2]
                done = ended(args, folder, number, at)
                if not done.signalled:  # it took less time than the first one
                    continue
                found.append((done.processor_s, done.elapsed_s, at, done.code))
                right = done.code in (128 + number, -number)  # a shell reports both in the same way
                if done.processor_s > LIMIT_S or not right or "Trace" in done.said:
                    late.append(f"{name} at {at:.1f} s: {done}")
            spent, elapsed, at, code = max(found, default=(0, 0, 0, 0))
            print(
                f"{name:30} {longest:7.1f} {whole.peak_mib:4.0f} {elapsed:10.2f}"
                f" {spent:12.2f} {at:5.1f} {code:5}",
                flush=True,
            )
    print("\n".join(late) or "every signal took effect in time")
    return 1 if late else 0


if __name__ == "__main__":
    sys.exit(main())
