"""Coasting through blackouts. ``python tests/benchmarks/estimate_blackout.py [--quick] [--early]``.

Random bodies at 0.1 rad/s, seen at 5 Hz with 5 mm and 0.3 deg of white noise for 80 s from a cold
start; then nothing. For each length: error of the predicted pose at the end, its predicted 1 sigma,
share inside 3 sigma (position and attitude together, chi-square with 6 degrees of freedom at the 3
sigma level of 99.73 %). ``--early``: gaps long before convergence, 24 bodies with 2 mm and 0.1 deg
at 2 Hz: NEES per degree of freedom of a propagation about the mean alone, and of the estimator.
"""

from __future__ import annotations

import argparse

import numpy as np
import tumbling
from scipy.stats import chi2
from watched import fold

from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.chart import nees
from avsreplay.estimate.measurement import innovation_vector, measurement_jacobian
from avsreplay.estimate.params import Start
from avsreplay.monitor.convergence import Convergence, ConvergenceParams

LENGTHS = (5.0, 10.0, 20.0, 30.0, 60.0)
SEEN_S = 80.0
EARLY = (10.0, 12.0), (15.0, 12.0), (20.0, 12.0), (20.0, 30.0)  # time with scans, and without [s]


def one(seed: int) -> tuple[bool, list[tuple[float, float, float, float, float]]]:
    """Is it converged when the light goes out; per length: errors [m, deg], 1 sigma of both,
    chi-square of the pose.
    """
    world = tumbling.draw(seed, seconds=SEEN_S + LENGTHS[-1], hz=5.0)
    seen = int(np.searchsorted(world.times, SEEN_S, side="right"))
    lit = tumbling.World(world.times[:seen], world.states[:seen], world.moments)
    rng = np.random.Generator(np.random.PCG64([seed, 11]))
    estimator = Estimator(EstimatorParams(start=Start.COLD, correlated_share=0.0), None, 2.0)
    tests = [Convergence(ConvergenceParams(), 2.0, (0.005, 0.0025, 0.035))]
    for _, _, track, words in fold(lit, estimator, tests, rng, (0.005, np.radians(0.3))):  # noqa: B007
        pass
    found = []
    for length in LENGTHS:
        ahead = estimator.predict(track, track.belief.t_ns + round(length * 1e9)).belief
        k = int(np.argmin(np.abs(world.times - SEEN_S - length)))
        error, H = innovation_vector(ahead.x, world.states[k].T_ac), measurement_jacobian(ahead.x)
        S = H @ ahead.P @ H.T
        sizes = np.sqrt([np.trace(S[:3, :3]), 4.0 * np.trace(S[3:, 3:])])
        angle = np.degrees(2.0 * np.arcsin(min(1.0, float(np.linalg.norm(error[3:])))))
        found.append(
            (
                float(np.linalg.norm(error[:3])),
                angle,
                sizes[0],
                np.degrees(sizes[1]),
                float(error @ np.linalg.solve(S, error)),
            )
        )
    return words[0].converged, found


def early(seed: int, seen_s: float, gap_s: float) -> tuple[float, float]:
    """NEES per degree of freedom at the end of a gap: of a propagation about the mean alone,
    and of the estimator.
    """
    world = tumbling.draw(seed, seconds=seen_s + gap_s, hz=2.0, sigma_max=0.85)
    seen = int(np.searchsorted(world.times, seen_s, side="right"))
    lit = tumbling.World(world.times[:seen], world.states[:seen], world.moments)
    rng, estimator = (
        np.random.Generator(np.random.PCG64([seed, 12])),
        Estimator(EstimatorParams(), None, 4.0),
    )
    tests = [Convergence(ConvergenceParams(), 4.0, (0.01, 0.005, 0.035))]
    for _, _, track, _ in fold(lit, estimator, tests, rng, (0.002, np.radians(0.1))):  # noqa: B007
        pass
    then_ns = round(world.times[-1] * 1e9)
    beliefs = (
        estimator.batch.propagated(track, track.belief, then_ns)[0],
        estimator.predict(track, then_ns).belief,
    )
    linear, used = (nees(belief, world.states[-1]) / 20.0 for belief in beliefs)
    return linear, used


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="4 bodies instead of 100")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--early", action="store_true", help="gaps long before convergence")
    given = parser.parse_args()
    if given.early:
        for seen_s, gap_s in EARLY:
            found = np.array([early(seed, seen_s, gap_s) for seed in range(1000, 1024)])
            cells = [f"{column.mean():.2f} ({column.max():.1f})" for column in found.T]
            print(
                f"{seen_s:.0f} s of scans, {gap_s:.0f} s without: about the mean {cells[0]}, used"
                f" {cells[1]}",
                flush=True,
            )
        return
    runs = [one(seed) for seed in range(4 if given.quick else given.seeds)]
    sure = [found for converged, found in runs if converged]
    print(f"{len(sure)} of {len(runs)} bodies converged at {SEEN_S:.0f} s")
    print("length  position rms  1 sigma rms  attitude rms  1 sigma rms  inside 3 sigma")
    for k, length in enumerate(LENGTHS):
        values = np.array([found[k] for found in sure])
        rms = np.sqrt(np.mean(values[:, :4] ** 2, axis=0))
        inside = np.mean(values[:, 4] < chi2.ppf(0.9973, 6))
        print(
            f"{length:4.0f} s {1e3 * rms[0]:10.1f} mm {1e3 * rms[2]:8.1f} mm"
            f" {rms[1]:9.2f} deg {rms[3]:8.2f} deg {inside:10.1%} of {len(sure)}"
        )


if __name__ == "__main__":
    main()
