"""A raster scan of 1 s of a turning target, deskewed or not. ``python
tests/benchmarks/estimate_deskew.py [--quick]``.

The built-in satellite, one scan every 1.2 s, near start; points carried by the filter's own
prediction before registration, or taken as they are. ``carried`` takes the pose for one of the
scan's instant; ``told`` gives the filter the H of the points' own instants
(``with_scan_duration``). NEES is per degree of freedom, 1 is right. The last column is the duration
of a scan that a run finds from the order of the points, as if they had no times.
"""

from __future__ import annotations

import argparse

import numpy as np
from true_scans import true_scans

from avsreplay import geometry, toml_document
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.chart import nees
from avsreplay.estimate.scan_duration import deskew, with_scan_duration
from avsreplay.monitor.fault_detection import FaultDetector, FaultParams
from avsreplay.records import Admission, AlignStatus, Scan
from avsreplay.register.model_check import ModelCheck
from avsreplay.register.params import RegisterParams
from avsreplay.register.registrar import Registrar
from avsreplay.simulate.scenario import scenario_of
from avsreplay.simulate.simulation import simulate
from avsreplay.simulate.target import builtin_surface

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


def errors(rate: float, seconds: float, mode: str) -> tuple[np.ndarray, int, int, str]:
    """Registration's errors and NEES (n, 3) [m, deg, 1] of healthy scans after five; how
    many, of all; duration.
    """
    axis = np.array([0.60, 0.64, -0.48])
    x, y, z = axis / np.linalg.norm(axis) * rate
    surface = builtin_surface()
    run = simulate(
        scenario_of(toml_document.parse(SCENARIO.format(seconds=seconds, x=x, y=y, z=z), "raster")),
        surface,
    )
    registrar = Registrar(surface, RegisterParams())
    estimator = Estimator(EstimatorParams(), run.header.start, surface.extent)
    detector = FaultDetector(FaultParams(), surface.extent)
    track, found, total, check = None, [], 0, ModelCheck(registrar, surface)
    for k, scan in enumerate(true_scans(run)):
        track = track or estimator.initial(scan.t_ns, scan.truth)
        prediction = estimator.predict(track, scan.t_ns)
        points = (
            scan.points if mode == "raw" else deskew(scan.points, scan.times_s, prediction.belief.x)
        )
        alignment = registrar.register(points, prediction.belief.x.T_ac)
        if mode == "told" and alignment.measured:
            prediction = with_scan_duration(
                prediction, registrar.instants(points, scan.times_s, alignment.T_ac), scan.times_s
            )
        if mode == "raw":
            order = np.linspace(0.0, 1.0, len(points), endpoint=False)
            check.add(Scan(scan.seq, scan.t_ns, points, places=order), alignment)
        lost = alignment.status in (
            AlignStatus.NO_OVERLAP,
            AlignStatus.NO_POINTS,
            AlignStatus.FAILED,
        )
        seen = None if lost else estimator.innovate(prediction, alignment)
        examined = detector.examine(scan.status, alignment, seen, prediction.belief)
        gamma = int(examined.admission is Admission.ADMITTED)
        track = estimator.update(track, prediction, seen, gamma)
        if k >= 5:
            total += 1
            off = scan.truth.inverse() @ alignment.T_ac
            if gamma:
                turn = np.degrees(float(geometry.angle(off.q)))
                found.append((np.linalg.norm(off.t), turn, nees(track.belief, scan.body) / 20.0))
    noted = [note for note in check.notes() if "--scan-duration" in note]
    return (
        np.array(found).reshape(-1, 3),
        len(found),
        total,
        noted[0].split(" in ")[1].split(":")[0] if noted else "-",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="24 s instead of 72 s")
    seconds = 24.0 if parser.parse_args().quick else 72.0
    print(
        "rate [rad/s]    points  healthy  position rms [mm]  attitude rms [deg]  median [mm] "
        " median [deg]  NEES median  duration"
    )
    for rate in (0.1, 0.3):
        for mode in ("raw", "carried", "told"):
            found, healthy, total, duration = errors(rate, seconds, mode)
            rms = np.sqrt(np.mean(found**2, axis=0)) if healthy else np.full(3, np.nan)
            middle = np.median(found, axis=0) if healthy else np.full(3, np.nan)
            print(
                f"{rate:8.1f} {mode:>13} {healthy:6d}/{total:<3d} {1e3 * rms[0]:14.2f}"
                f" {rms[1]:19.3f} {1e3 * middle[0]:15.2f} {middle[1]:13.3f} {middle[2]:12.2f} "
                f" {duration}"
            )


if __name__ == "__main__":
    main()
