"""Accuracy of reconstructed models: poses against ground truth, surface against the CAD model, processor time.

    python tests/benchmarks/reconstruction.py                 # the built-in scenario and the scans of ../shared/data
    python tests/benchmarks/reconstruction.py LOG --every 4   # a log that carries model and ground truth

The ground truth is used for the comparison only. The frames are related by the mean of the constant transformations
between true and reconstructed poses.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from avsreplay import geometry
from avsreplay.errors import AvsError
from avsreplay.geometry import Pose
from avsreplay.log import SourceOptions, open_source
from avsreplay.reconstruct import reconstruct
from avsreplay.register.surface_index import SurfaceIndex

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", nargs="?", type=Path)
    parser.add_argument("--every", type=int, default=4, help="take every N-th scan of a simulated log")
    parser.add_argument("--scans", type=int, default=60, help="at most so many")
    options = parser.parse_args()
    if options.log:
        report(options.log, SourceOptions(every=options.every, n_scans=options.scans))
        return
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "built-in.mcap"
        subprocess.run([sys.executable, "-m", "avsreplay", "record", "-o", log], check=True, capture_output=True)
        report(log, SourceOptions(every=options.every, n_scans=options.scans))
    for name, model in (("stanford-dragon", "dragon_vrip_res3.ply"), ("stanford-bunny", "bun_zipper.ply")):
        if (DATA / name).is_dir():
            report(DATA / name, SourceOptions(model=DATA / name / model))
        else:
            print(f"{name}: not here")


def report(log: Path, options: SourceOptions) -> None:
    """Build the model of one log and print one line."""
    with open_source(log, options) as source:
        surface = source.header.surface
        scans = list(source.scans())
        truth = {scan.t_ns: source.truth_of(scan).pose for scan in scans}
    begun = time.process_time()
    try:
        made = reconstruct(lambda: scans)
    except AvsError as error:
        print(f"{log.name}: {error}")
        return
    spent = time.process_time() - begun
    pairs = [(truth[t_ns], T) for t_ns, T in made.poses if truth[t_ns] is not None]
    X = mean_pose([T.inverse() @ true for true, T in pairs])
    errors = np.array([distance(T @ X, true) for true, T in pairs])
    reach = 0.1 * surface.extent
    d2 = SurfaceIndex.build(surface, reach).closest(X.inverse().apply(made.points)).d2
    surface_m = np.sqrt(np.minimum(d2, reach**2))
    rms = np.sqrt(np.mean(errors**2, axis=0))
    print(
        f"{log.name}: {made.used} of {made.offered} scans, {made.searches} searches, pose rms {1e3 * rms[0]:.2f} mm "
        f"{rms[1]:.3f} deg, surface median {1e3 * np.median(surface_m):.2f} mm, "
        f"95 % {1e3 * np.quantile(surface_m, 0.95):.2f} mm, "
        f"coverage {100 * made.coverage:.0f} %, {spent:.1f} s"
    )


def mean_pose(poses: list[Pose]) -> Pose:
    """The mean of poses that are close to one another."""
    q = np.array([pose.q for pose in poses])
    q = (q * np.sign(q @ q[0])[:, None]).mean(axis=0)
    return Pose(q / np.linalg.norm(q), np.mean([pose.t for pose in poses], axis=0))


def distance(a: Pose, b: Pose) -> tuple[float, float]:
    """Distance [m] and angle [deg] between two poses."""
    turn = geometry.angle(geometry.multiply(geometry.conjugate(b.q), a.q))
    return float(np.linalg.norm(a.t - b.t)), float(np.degrees(turn))


if __name__ == "__main__":
    main()
