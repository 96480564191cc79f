"""Accuracy of reconstructed models: poses against ground truth, surface against the CAD model,
processor time.

    python tests/benchmarks/reconstruction.py                 # the built-in scenario and the scans
    of ../shared/data python tests/benchmarks/reconstruction.py LOG --every 4   # a log that carries
    model and ground truth python tests/benchmarks/reconstruction.py LOG --beside    # KISS-ICP and
    small_gicp odometry, and replays, beside it

The ground truth is used for the comparison only. The frames are related by the mean of the constant
transformations between true and reconstructed poses.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from avsreplay import geometry
from avsreplay.errors import AvsError
from avsreplay.geometry import Pose
from avsreplay.log import SourceOptions, open_source
from avsreplay.reconstruct.reconstruction import reconstruct
from avsreplay.reconstruct.views import extent_of
from avsreplay.record import RecordOptions, record
from avsreplay.register.surface_index import SurfaceIndex
from avsreplay.run import Job, ReplayedScan, Run

SPACECRAFT = """
name = "spacecraft"
seed = 26
duration_s = 75.0
rate_hz = 1.0
[motion]
attitude_xyzw = [0.1, 0.7, -0.1, 0.7]
rate_radps = [0.060, 0.064, -0.048]
position_m = [0.0, 0.0, {distance_m}]
[scanner]
fov_deg = [40.0, 40.0]
noise_m = {noise_m}
range_min_m = 2.0
range_max_m = 60.0
"""
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("log", nargs="?", type=Path)
    parser.add_argument(
        "--every", type=int, default=4, help="take every N-th scan of a simulated log"
    )
    parser.add_argument("--scans", type=int, default=60, help="at most so many")
    parser.add_argument(
        "--beside", action="store_true", help="also odometry alone, and replays with both models"
    )
    parser.add_argument("--model", type=Path, help="CAD model, for a log that carries none")
    options = parser.parse_args()
    if options.log:
        reading = SourceOptions(every=options.every, n_scans=options.scans, model=options.model)
        report(options.log, reading)
        if options.beside:
            beside(options.log, reading)
        return
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "built-in.mcap"
        subprocess.run(
            [sys.executable, "-m", "avsreplay", "record", "-o", log],
            check=True,
            capture_output=True,
        )
        report(log, SourceOptions(every=options.every, n_scans=options.scans))
        for name, distance_m, noise_m in (("HST", 22.0, 0.02), ("Kepler", 8.0, 0.01)):
            mesh = DATA / "spacecraft-meshes" / f"{name}.obj"
            if mesh.is_file():
                scenario, log = Path(folder) / f"{name}.toml", Path(folder) / f"{name}.mcap"
                scenario.write_text(SPACECRAFT.format(distance_m=distance_m, noise_m=noise_m))
                record(scenario, log, options=RecordOptions(model=mesh))
                report(log, SourceOptions(n_scans=options.scans))
    for name, model in (
        ("stanford-dragon", "dragon_vrip_res3.ply"),
        ("stanford-bunny", "bun_zipper.ply"),
    ):
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
        f"{log.name}: {made.used} of {made.offered} scans, {made.searches} searches, pose rms"
        f" {1e3 * rms[0]:.2f} mm {rms[1]:.3f} deg, surface median {1e3 * np.median(surface_m):.2f}"
        f" mm, 95 % {1e3 * np.quantile(surface_m, 0.95):.2f} mm, coverage {100 * made.coverage:.0f}"
        f" %, {spent:.1f} s"
    )


def beside(log: Path, options: SourceOptions) -> None:
    """Print the pose errors of two odometries on the same scans, and of replays with the CAD model
    and without it.
    """
    with open_source(log, options) as source:
        scans = [scan for scan in source.scans() if len(scan.points) >= 100]
        truth = [source.truth_of(scan).pose for scan in scans]
    clouds = [np.asarray(scan.points, dtype=np.float64) for scan in scans]
    extent = float(np.median([extent_of(cloud[:: max(1, len(cloud) // 3000)]) for cloud in clouds]))
    for name, odometry in (("KISS-ICP", kiss_poses), ("small_gicp, scan to scan", gicp_poses)):
        pairs = zip(truth, odometry(clouds, extent), strict=True)
        print(f"  {name}: {_errors([(true, T) for true, T in pairs if true is not None])}")
    for name, model in (("CAD model", options.model), ("model auto", Path("auto"))):
        begun = time.process_time()
        with Run(Job(source=log, options=replace(options, model=model))) as run:
            found: list[tuple[Pose, Pose]] = []

            def healthy(scan: ReplayedScan, found: list[tuple[Pose, Pose]] = found) -> None:
                if (
                    scan.row.gamma
                    and scan.truth.pose is not None
                    and scan.outcome.alignment is not None
                ):
                    found.append((scan.truth.pose, scan.outcome.alignment.T_ac))

            count = sum(1 for _ in run.rows([healthy]))
        spent = (time.process_time() - begun) / max(count, 1)
        print(
            f"  replay, {name}: {len(found)} of {count} healthy, {_errors(found)},"
            f" {1e3 * spent:.0f} ms a scan"
        )


def _errors(pairs: list[tuple[Pose, Pose]]) -> str:
    """Root mean squares after the best constant transformation."""
    X = mean_pose([T.inverse() @ true for true, T in pairs])
    rms = np.sqrt(np.mean(np.square([distance(T @ X, true) for true, T in pairs]), axis=0))
    return f"pose rms {1e3 * rms[0]:.2f} mm {rms[1]:.3f} deg"


def kiss_poses(clouds: list[np.ndarray], extent: float) -> list[Pose]:
    """Poses T_ac by KISS-ICP with its adaptive threshold and its voxel map, the target taken as the
    world.
    """
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.deskew, config.data.min_range, config.data.max_range = False, 0.0, 1e3
    config.mapping.voxel_size = extent / 100.0
    odometry, poses = KissICP(config), []
    for cloud in clouds:
        odometry.register_frame(cloud - clouds[0].mean(axis=0), np.zeros(len(cloud)))
        poses.append(_pose(np.linalg.inv(odometry.last_pose)))
    shift = Pose(geometry.IDENTITY_QUAT, clouds[0].mean(axis=0))
    return [shift @ pose for pose in poses]


def gicp_poses(clouds: list[np.ndarray], extent: float) -> list[Pose]:
    """Poses T_ac by small_gicp, each scan registered to the one before from a constant motion."""
    import small_gicp

    centre, moved, T = clouds[0].mean(axis=0), np.eye(4), np.eye(4)
    poses = [Pose(geometry.IDENTITY_QUAT, centre)]
    for before, cloud in pairwise(clouds):
        found = small_gicp.align(
            before - centre,
            cloud - centre,
            moved,
            registration_type="GICP",
            downsampling_resolution=extent / 100.0,
            max_correspondence_distance=0.06 * extent,
            num_threads=1,
        )
        moved = found.T_target_source
        T = T @ moved
        poses.append(Pose(geometry.IDENTITY_QUAT, centre) @ _pose(np.linalg.inv(T)))
    return poses


def _pose(T: np.ndarray) -> Pose:
    return Pose(geometry.quaternion(T[:3, :3]), T[:3, 3])


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
