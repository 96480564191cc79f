"""A raster scan of 1 s of a turning target, deskewed or not. ``python tests/benchmarks/estimate_deskew.py [--quick]``.

The built-in satellite, one scan every 1.2 s, near start; points carried by the filter's own prediction before
registration, or taken as they are.
"""

from __future__ import annotations

import argparse

import numpy as np

from avsreplay import geometry, settings
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.deskew import deskew
from avsreplay.monitor.faults import FaultDetector, FaultParams
from avsreplay.records import AlignStatus
from avsreplay.register import RegisterParams, Registrar
from avsreplay.simulate import builtin_surface, scenario_of, simulate

SCENARIO = """
name = "raster"
seed = 3
duration_s = {seconds}
rate_hz = 0.8333333
[target]
shape = "satellite"
[motion]
attitude_xyzw = [0.1, 0.7, -0.1, 0.7]
rate_radps = [{x}, {y}, {z}]
position_m = [0.15, -0.10, 5.0]
velocity_mps = [-0.002, 0.001, 0.001]
[scanner]
pattern = "raster"
scan_s = 1.0
fov_deg = [48.0, 48.0]
rays = [120, 120]
noise_m = 0.008
outlier_ratio = 0.02
[start]
rate_std_radps = 0.002
sigma_std = 0.02
varrho_std_m = 0.02
mu_std_deg = 0.5
position_std_m = 0.01
velocity_std_mps = 0.002
attitude_std_deg = 0.5
"""


def errors(rate: float, seconds: float, carried: bool) -> tuple[np.ndarray, int, int]:
    """Registration's errors (n, 2) [m, deg] of the healthy scans after the first five, how many, of how many."""
    axis = np.array([0.60, 0.64, -0.48])
    x, y, z = axis / np.linalg.norm(axis) * rate
    surface = builtin_surface()
    run = simulate(scenario_of(settings.parse(SCENARIO.format(seconds=seconds, x=x, y=y, z=z), "raster")), surface)
    registrar = Registrar(surface, RegisterParams())
    estimator = Estimator(EstimatorParams(), run.header.start, surface.extent)
    detector = FaultDetector(FaultParams(), surface.extent)
    track, found, total = None, [], 0
    for k, scan in enumerate(run.scans()):
        track = track or estimator.initial(scan.t_ns, scan.truth)
        prediction = estimator.predict(track, scan.t_ns)
        points = deskew(scan.points, scan.times_s, prediction) if carried else scan.points
        alignment = registrar.register(points, prediction.belief.x.T_ac)
        lost = alignment.status in (AlignStatus.NO_OVERLAP, AlignStatus.NO_POINTS, AlignStatus.FAILED)
        seen = None if lost else estimator.innovate(prediction, alignment)
        gamma = detector.judge(scan.status, alignment, seen, prediction.belief).gamma
        track = estimator.update(track, prediction, seen, gamma)
        if k >= 5:
            total += 1
            off = scan.truth.inverse() @ alignment.T_ac
            if gamma:
                found.append((np.linalg.norm(off.t), np.degrees(float(geometry.angle(off.q)))))
    return np.array(found).reshape(-1, 2), len(found), total


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="24 s instead of 72 s")
    seconds = 24.0 if parser.parse_args().quick else 72.0
    print("rate [rad/s]  deskewed  healthy  position rms [mm]  attitude rms [deg]  median [mm]  median [deg]")
    for rate in (0.1, 0.3):
        for carried in (False, True):
            found, healthy, total = errors(rate, seconds, carried)
            rms = np.sqrt(np.mean(found**2, axis=0)) if healthy else np.full(2, np.nan)
            middle = np.median(found, axis=0) if healthy else np.full(2, np.nan)
            print(
                f"{rate:8.1f} {'yes' if carried else 'no':>12} {healthy:6d}/{total:<3d} {1e3 * rms[0]:14.2f}"
                f" {rms[1]:19.3f} {1e3 * middle[0]:15.2f} {middle[1]:13.3f}"
            )


if __name__ == "__main__":
    main()
