"""Bodies under a random torque: does the estimate allow for it? ``python tests/benchmarks/estimate_disturbed.py``.

Random bodies at 0.1 rad/s, pushed between the scans, seen at 2 Hz with 5 mm and 0.3 deg of white noise. The estimator
is told the torque's root density. NEES per degree of freedom at 50, 100 and 150 s, median and largest; 1 is right.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import tumbling

from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.layout import boxplus
from avsreplay.estimate.motion import disturbance
from avsreplay.estimate.params import Start
from avsreplay.estimate.relabel import nees
from avsreplay.records import Belief

HZ, SECONDS, MARKS = 2.0, 150.0, (50.0, 100.0, 150.0)
START_1S = np.repeat([0.0025, 0.0025, 0.01, 0.001, 0.025, 0.025, 0.005], [3, 3, 3, 3, 2, 3, 3])


def pushed(seed: int, torque: float) -> tumbling.World:
    """Integrated from the full tensor between the pushes."""
    world = tumbling.draw(seed, seconds=1.0, hz=HZ, sigma_max=0.85)
    rng = np.random.Generator(np.random.PCG64([seed, 99]))
    states = [world.states[0]]
    for _ in range(round(SECONDS * HZ)):
        x = tumbling.follow(np.array([0.0, 1.0 / HZ]), world.moments, states[-1])[-1]
        push = np.array(disturbance(x.sigma)) * torque * rng.normal(size=3) / np.sqrt(HZ)
        states.append(replace(x, w_b=x.w_b + push))
    return tumbling.World(np.arange(len(states)) / HZ, states, world.moments)


def one(seed: int, torque: float, start: Start) -> list[float]:
    """NEES per degree of freedom at the marks."""
    world, rng = pushed(seed, torque), np.random.Generator(np.random.PCG64([seed, 7]))
    drawn = START_1S * np.random.Generator(np.random.PCG64([seed, 8])).normal(size=20)
    given = Belief(0, boxplus(world.states[0], drawn), np.diag(START_1S**2))
    params = EstimatorParams(torque_noise_radps15=torque, start=start, correlated_share=0.0)
    estimator = Estimator(params, given if start is Start.NEAR else None, 2.0)
    track, found = estimator.initial(0, world.states[0].T_ac), []
    for t, x in zip(world.times, world.states, strict=True):
        prediction = estimator.predict(track, round(t * 1e9))
        seen = estimator.innovate(prediction, tumbling.alignment(x.T_ac, rng, 0.005, np.radians(0.3)))
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
            print(f"{torque:.0e} rad/s^1.5  {start.value:4s}  median {middle}  largest {largest}", flush=True)


if __name__ == "__main__":
    main()
