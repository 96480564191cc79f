"""Cold start against the paper's: consistency over seeds. ``python
tests/benchmarks/estimate_cold.py [--quick]``.

Each seed is a random body (inertia over the whole triangle, mu up to 15 deg, varrho up to 0.3 m)
tumbling at 0.1 rad/s, seen at 2 Hz with 1 cm and 1 deg of white noise for 100 s (so
correlated_share is 0). NEES is per degree of freedom, 1 is right.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
import tumbling
from scipy.stats import chi2
from watched import fold

from avsreplay import geometry
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.chart import nees
from avsreplay.estimate.measurement import measurement_jacobian
from avsreplay.estimate.params import Start
from avsreplay.monitor.convergence import Convergence, ConvergenceParams, Criterion
from avsreplay.records import Belief

EXTENT = 2.0
MARKS = (20.0, 40.0, 70.0, 100.0)


@dataclass(frozen=True, slots=True)
class Outcome:
    """One seed: NEES at the marks, claims there by criterion, errors at the end, the mode,
    seconds spent.
    """

    nees: tuple[float, ...]
    claimed: tuple[bool, ...]
    known: tuple[bool, ...]
    position_m: float
    rotation_deg: float
    predicted: tuple[float, float]
    mode: str
    t1_s: float
    seconds: float


def one(seed: int, start: Start) -> Outcome:
    world = tumbling.draw(seed)
    rng = np.random.Generator(np.random.PCG64([seed, 7]))
    estimator = Estimator(EstimatorParams(start=start, correlated_share=0.0), None, EXTENT)
    tests = [
        Convergence(
            ConvergenceParams(criterion=c),
            EXTENT,
            (0.0025 * EXTENT, 0.00125 * EXTENT, 0.035),
        )
        for c in (Criterion.PREDICTIVE, Criterion.COVARIANCE)
    ]
    marks, begun = [], time.perf_counter()
    for t, x, track, words in fold(world, estimator, tests, rng, (0.01, np.radians(1.0))):
        if t in MARKS:
            marks.append((nees(track.belief, x) / 20, words[0].converged, words[1].converged))
    pose, truth = track.belief.x.T_ac, world.states[-1].T_ac
    turn = geometry.multiply(geometry.conjugate(truth.q), pose.q)
    return Outcome(
        *(tuple(column) for column in zip(*marks, strict=True)),
        float(np.linalg.norm(pose.t - truth.t)),
        float(np.degrees(geometry.angle(turn))),
        _predicted(track.belief),
        track.mode,
        (words[0].t1_ns or -1) * 1e-9,
        time.perf_counter() - begun,
    )


def _predicted(belief: Belief) -> tuple[float, float]:
    """1 sigma of the pose: position [m], attitude [deg]."""
    H = measurement_jacobian(belief.x)
    S = H @ belief.P @ H.T
    return float(np.sqrt(np.trace(S[:3, :3]))), float(
        np.degrees(2.0 * np.sqrt(np.trace(S[3:, 3:])))
    )


def table(name: str, outcomes: list[Outcome]) -> None:
    band = chi2.ppf([0.0005, 0.9995], 20) / 20
    print(
        f"\nstart {name}: {len(outcomes)} seeds, {np.median([o.seconds for o in outcomes]):.2f} s a"
        " run (median)"
    )
    print(
        "  at      all: mean  median    max | claimed (prediction): n  mean  outside 99.9 % |"
        " claimed (parameters): n  mean  outside 99.9 %"
    )
    for k, mark in enumerate(MARKS):
        every = np.array([o.nees[k] for o in outcomes])
        claimed = np.array([o.nees[k] for o in outcomes if o.claimed[k]])
        known = np.array([o.nees[k] for o in outcomes if o.known[k]])
        outside, apart = (
            int(np.sum((found < band[0]) | (found > band[1]))) for found in (claimed, known)
        )
        print(
            f"{mark:5.0f} s {every.mean():12.2f} {np.median(every):7.2f} {every.max():6.1f} |"
            f" {len(claimed):24d} {_mean(claimed)} {outside:15d} | {len(known):22d} {_mean(known)}"
            f" {apart:15d}"
        )
    print(
        f"  at the end: pose error median {1e3 * np.median([o.position_m for o in outcomes]):.2f}"
        f" mm, {np.median([o.rotation_deg for o in outcomes]):.3f} deg; predicted 1 sigma median"
        f" {1e3 * np.median([o.predicted[0] for o in outcomes]):.2f} mm,"
        f" {np.median([o.predicted[1] for o in outcomes]):.3f} deg; mode"
        f" { ({m: sum(o.mode == m for o in outcomes) for m in ('fit', 'filter')}) }"
    )
    worst = sorted(range(len(outcomes)), key=lambda s: -outcomes[s].nees[-1])[:5]
    print(
        "  largest NEES at the end: "
        + ", ".join(f"seed {s} {outcomes[s].nees[-1]:.1f}" for s in worst)
    )


def _mean(values: np.ndarray) -> str:
    return f"{values.mean():5.2f}" if len(values) else "    -"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="10 seeds instead of 100")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--starts", default="cold,paper")
    given = parser.parse_args()
    count = 10 if given.quick else given.seeds
    for name in given.starts.split(","):
        table(name, [one(seed, Start(name)) for seed in range(count)])


if __name__ == "__main__":
    main()
