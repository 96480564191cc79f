"""Memory against the number of scans: ``python tests/benchmarks/memory.py [--scans 1500 6000 20000
60000] [--only NAME ...]``.

A log of poses of a tumbling body, seeded, is replayed, and its result is read by other commands.
Each command is a process of its own, which reports its largest resident memory (VmHWM) when it
ends: that of this process does not count. Prints a line per command and the growth per scan.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avsreplay.arithmetic import PINS

PERIOD_S = 0.1
PROGRAM = """import sys
from pathlib import Path
from avsreplay.__main__ import main
code = 0
try:
    main()
except SystemExit as leaving:
    code = leaving.code
finally:
    lines = Path("/proc/self/status").read_text().splitlines()
    Path(sys.argv.pop(0) + ".peak").write_text(next(x for x in lines if x.startswith("VmHWM")))
sys.exit(code)
"""
POSES = ("--backend", "poses", "--extent", "2")
COMMANDS: dict[str, tuple[str, ...]] = {
    "run": ("run", "LOG", *POSES),
    "run -o": ("run", "LOG", *POSES, "-o", "RESULT"),
    "run --json": ("run", "LOG", *POSES, "--json"),
    "run --reference fit": ("run", "LOG", *POSES, "--reference", "fit"),
    "report": ("report", "RESULT", "-o", "OUT.html"),
    "export parquet": ("export", "RESULT", "--to", "parquet", "-o", "OUT.parquet"),
    "export csv": ("export", "RESULT", "--to", "csv", "-o", "OUT.csv"),
    "compare": ("compare", "RESULT", "RESULT"),
    "compare page": ("compare", "RESULT", "RESULT", "-o", "OUT2.html"),
    "plan": ("plan", "RESULT", "--samples", "2"),
}


def write_poses(path: Path, count: int, seed: int = 1) -> None:
    """A TUM file of a body that turns about a fixed axis, with 2 mm and 0.2 deg of noise (1 sigma).

    Args:
        path: the file.
        count: number of poses.
        seed: of the noise.
    """
    rng = np.random.default_rng(seed)
    t_s = np.arange(count) * PERIOD_S
    turn = Rotation.from_rotvec(t_s[:, None] * np.array([0.02, 0.05, 0.03]))
    noise = Rotation.from_rotvec(rng.normal(0.0, np.radians(0.2), (count, 3)))
    t_m = np.array([0.1, 0.0, 5.0]) + rng.normal(0.0, 0.002, (count, 3))
    table = np.column_stack([t_s, t_m, (turn * noise).as_quat()])
    np.savetxt(path, table, fmt="%.9f")


def peak_mb(args: tuple[str, ...], place: Path) -> float:
    """The largest resident memory of a command [MB of 1e6 bytes]. Raises RuntimeError if it fails.

    Args:
        args: its arguments.
        place: a folder, its working directory.
    """
    env = {**os.environ, **PINS, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.replace("sys.argv.pop(0)", repr(str(place / "x"))), *args],
        cwd=place,
        env=env,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{args}: exit {done.returncode}: {done.stderr}")
    return int((place / "x.peak").read_text().split()[1]) * 1024 / 1e6


def main() -> int:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, nargs="+", default=[1500, 6000, 20000, 60000])
    parser.add_argument("--only", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    options = parser.parse_args()
    found: dict[str, list[float]] = {name: [] for name in options.only}
    with tempfile.TemporaryDirectory() as folder:
        for count in options.scans:
            place = Path(folder) / str(count)
            place.mkdir()
            write_poses(place / "poses.tum", count)
            words = {"LOG": "poses.tum", "RESULT": "result"}
            if "run -o" not in found:
                peak_mb(("run", "poses.tum", *POSES, "-o", "result"), place)
            for name in found:
                args = tuple(words.get(word, word) for word in COMMANDS[name])
                found[name].append(peak_mb(args, place))
                print(f"{count:6d} {name:20s} {found[name][-1]:6.0f} MB", flush=True)
    scans = options.scans
    for name, peaks in found.items():
        each = (peaks[-1] - peaks[0]) * 1e6 / 1024 / max(scans[-1] - scans[0], 1)
        line = ", ".join(f"{peak:.0f}" for peak in peaks)
        print(f"{name}: {line} MB at {', '.join(map(str, scans))} scans; {each:.2f} KiB a scan")
    return 0


if __name__ == "__main__":
    sys.exit(main())
