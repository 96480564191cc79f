"""NEES of the estimate along tumbles of the built-in target, with poses registered from simulated
scans.

``python tests/benchmarks/estimate_builtin.py [--seeds FIRST END] [--seconds S] [--hz HZ]
[--free]``.

Registration begins at the true pose, the estimate is cold. Printed: mean NEES per degree of freedom
at six instants, by blocks in coordinates that do not depend on the order of the axes, and the
number of scans that were flagged.
"""

from __future__ import annotations

import argparse

import numpy as np
from estimate_surprises import nees_of
from registration_noise import scenario
from true_scans import true_scans

from avsreplay import toml_document
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.monitor.fault_detection import FaultDetector, FaultParams
from avsreplay.records import ScanStatus
from avsreplay.register.registrar import Registrar
from avsreplay.simulate.scenario import scenario_of
from avsreplay.simulate.simulation import simulate
from avsreplay.simulate.target import builtin_surface

INSTANTS = 6
BLOCKS = "all, attitude, rate, inertia, arm, position, velocity"


def run(registrar: Registrar, text: str, params: EstimatorParams) -> tuple[np.ndarray, int, int]:
    """(instants, blocks) NEES per degree of freedom, the number of scans and that of flagged
    ones.
    """
    surface = builtin_surface()
    scans = list(true_scans(simulate(scenario_of(toml_document.parse(text, "builtin")), surface)))
    estimator, detector = (
        Estimator(params, None, surface.extent),
        FaultDetector(FaultParams(), surface.extent),
    )
    marks = np.linspace(0, len(scans) - 1, INSTANTS + 1).round().astype(int)[1:]
    track, found, flagged = None, [], 0
    for k, scan in enumerate(scans):
        alignment = registrar.register(scan.points, scan.truth)
        track = track or estimator.initial(scan.t_ns, alignment.T_ac)
        prediction = estimator.predict(track, scan.t_ns)
        innovation = estimator.innovate(prediction, alignment) if alignment.measured else None
        examined = detector.examine(ScanStatus.OK, alignment, innovation, prediction.belief)
        track, finding = estimator.step(track, prediction, innovation, examined.admission, True)
        flagged += not finding.used
        if k in marks:
            found.append(nees_of(estimator.published(track), scan.body))
    return np.array(found), len(scans), flagged


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 8))
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--hz", type=float, default=2.0)
    parser.add_argument(
        "--free", action="store_true", help="the estimator is told that there are no disturbances"
    )
    given = parser.parse_args()
    none = {"torque_noise_radps15": 0.0, "force_noise_mps15": 0.0} if given.free else {}
    registrar, texts = (
        Registrar(builtin_surface()),
        [scenario(s, given.seconds, given.hz) for s in range(*given.seeds)],
    )
    runs = [run(registrar, text, EstimatorParams(**none)) for text in texts]
    print(f"NEES per degree of freedom: {BLOCKS}")
    every = np.array([nees for nees, _, _ in runs])
    for k, row in enumerate(every.mean(axis=0)):
        print(f"{given.seconds * (k + 1) / INSTANTS:7.1f} s  " + ", ".join(f"{v:.2f}" for v in row))
    print("     mean  " + ", ".join(f"{v:.2f}" for v in every.mean(axis=(0, 1))))
    print(f"flagged {sum(n for _, _, n in runs)} of {sum(n for _, n, _ in runs)} scans")


if __name__ == "__main__":
    main()
