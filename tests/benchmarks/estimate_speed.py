"""Processor time of the estimator's parts. ``python tests/benchmarks/estimate_speed.py [--quick]``.

Each figure is the least of five repeats, so that other load on the machine matters little.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import tumbling

from avsreplay import geometry
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.arc import arc
from avsreplay.estimate.chart import to_chart
from avsreplay.estimate.cold import prior_of
from avsreplay.estimate.fit import FitParams, Poses, fit
from avsreplay.estimate.params import Start
from avsreplay.records import Belief


def least(run: Callable[[], object], count: int) -> float:
    """Seconds of one run: least mean over five repeats of ``count``."""
    best = np.inf
    for _ in range(5):
        begun = time.process_time()
        for _ in range(count):
            run()
        best = min(best, (time.process_time() - begun) / count)
    return best


def filter_us(count: int) -> dict[str, float]:
    world = tumbling.draw(4, seconds=1.0, hz=5.0)
    x = world.states[0]
    estimator = Estimator(EstimatorParams(start=Start.NEAR), Belief(0, x, np.eye(20) * 1e-6), 2.0)
    track = estimator.initial(0, x.T_ac)
    seen = tumbling.alignment(world.states[1].T_ac, np.random.Generator(np.random.PCG64(0)), 0.005, 0.005)
    prediction = estimator.predict(track, 200_000_000)
    innovation = estimator.innovate(prediction, seen)
    times, many = np.linspace(5.0, 30.0, 6), np.linspace(0.0, 60.0, 100)
    path = estimator.motion(track.belief)
    return {
        "predict": 1e6 * least(lambda: estimator.predict(track, 200_000_000), count),
        "innovate": 1e6 * least(lambda: estimator.innovate(prediction, seen), count),
        "update": 1e6 * least(lambda: estimator.update(track, prediction, innovation, 1), count),
        "forecast 30 s": 1e6 * least(lambda: estimator.forecast(track.belief, times), count // 10),
        "new path": 1e6 * least(lambda: estimator.motion(track.belief)(times[3:4]), count // 10),
        "path, 100 times": 1e6 * least(lambda: path(many), count // 10),
    }


def fit_s(n: int, seconds: float) -> tuple[float, float, int]:
    """Time of one linearisation and of a fit from near, over n poses; its steps."""
    world = tumbling.draw(4, seconds=seconds, hz=(n - 1) / seconds)
    rng = np.random.Generator(np.random.PCG64(1))
    seen = [tumbling.alignment(x.T_ac, rng, 0.01, np.radians(1.0)) for x in world.states]
    poses = Poses(
        world.times,
        np.array([a.T_ac.q for a in seen]),
        np.array([a.T_ac.t for a in seen]),
        np.array([a.covariance for a in seen]),
    )
    prior = prior_of(poses, EstimatorParams().resolved(2.0))
    start = to_chart(world.states[0]).moved(np.repeat([5e-3, 2e-4, 5e-3, 1e-4, 0.05, 0.02], [3, 3, 3, 3, 5, 3]))
    once = least(lambda: arc(world.states[0], world.times), 2)
    begun = time.process_time()
    fitted = fit(poses, start, prior, FitParams())
    off = float(geometry.angle(geometry.multiply(geometry.conjugate(fitted.x.T_ac.q), world.states[0].T_ac.q)))
    if off > 0.05:
        raise SystemExit("the fit did not find the motion")
    return once, time.process_time() - begun, fitted.steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repeats, no fit over 5,000 poses")
    quick = parser.parse_args().quick
    for name, value in filter_us(50 if quick else 400).items():
        print(f"{name:16s} {value:8.0f} us")
    for n, seconds in ((200, 100.0),) if quick else ((200, 100.0), (600, 120.0), (5000, 1000.0)):
        once, whole, steps = fit_s(n, seconds)
        print(f"fit of {n:5d} poses over {seconds:6.0f} s: {whole:6.3f} s, {steps} steps; arc {1e3 * once:.1f} ms")


if __name__ == "__main__":
    main()
