"""Bodies under a random torque: does the estimate allow for it? ``python
tests/benchmarks/estimate_disturbed.py``.

Random bodies at 0.1 rad/s, pushed between the scans, seen at 2 Hz with 5 mm and 0.3 deg of white
noise. The estimator is told the torque's root density. NEES per degree of freedom at 50, 100 and
150 s, median and largest; 1 is right.
"""

from __future__ import annotations

import argparse

import numpy as np
import tumbling

from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.chart import nees
from avsreplay.estimate.params import Start

HZ, SECONDS, MARKS = 2.0, 150.0, (50.0, 100.0, 150.0)


def one(seed: int, torque: float, start: Start) -> list[float]:
    """NEES per degree of freedom at the marks."""
    world = tumbling.pushed(seed, torque, seconds=SECONDS, hz=HZ)
    rng, given = (
        np.random.Generator(np.random.PCG64([seed, 7])),
        tumbling.near(world.states[0], seed),
    )
    params = EstimatorParams(torque_noise_radps15=torque, start=start, correlated_share=0.0)
    estimator = Estimator(params, given if start is Start.NEAR else None, 2.0)
    track, found = estimator.initial(0, world.states[0].T_ac), []
    for t, x in zip(world.times, world.states, strict=True):
        prediction = estimator.predict(track, round(t * 1e9))
        seen = estimator.innovate(
            prediction, tumbling.alignment(x.T_ac, rng, 0.005, np.radians(0.3))
        )
        track = estimator.update(track, prediction, seen, 1)
        if t in MARKS:
            found.append(nees(track.belief, x) / 20)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="2 bodies instead of 8")
    seeds = range(2 if parser.parse_args().quick else 8)
    for torque in (1e-6, 1e-5, 1e-4):
        for start in (Start.NEAR, Start.COLD):
            found = np.array([one(seed, torque, start) for seed in seeds])
            middle, largest = np.median(found, axis=0).round(2), found.max(axis=0).round(1)
            print(
                f"{torque:.0e} rad/s^1.5  {start.value:4s}  median {middle}  largest {largest}",
                flush=True,
            )


if __name__ == "__main__":
    main()
