"""A tumbling body through estimator and monitors, scan by scan as in the pipeline, for the
campaigns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import tumbling

from avsreplay.estimate import Estimator, Track
from avsreplay.monitor.convergence import (
    Consistency,
    ConsistencyParams,
    Convergence,
    ConvergenceTrack,
)
from avsreplay.records import State

AHEAD_S = 10.0  # after a scan: the instant for which the error of the capture is predicted


def fold(
    world: tumbling.World,
    estimator: Estimator,
    tests: Sequence[Convergence],
    rng: np.random.Generator,
    noise: tuple[float, float],
) -> Iterator[tuple[float, State, Track, list[ConvergenceTrack]]]:
    """Every scan healthy, with white noise [m, rad]: instant, truth, track, each test's word;
    the first one decides.
    """
    watch, words = Consistency(ConsistencyParams()), [test.initial() for test in tests]
    seen_so_far = watch.initial()
    track = estimator.initial(0, world.states[0].T_ac)
    for t, x in zip(world.times, world.states, strict=True):
        prediction = estimator.predict(track, round(t * 1e9))
        seen = estimator.innovate(prediction, tumbling.alignment(x.T_ac, rng, *noise))
        track = estimator.update(track, prediction, seen, 1, words[0].converged)
        seen_so_far = watch.observe(seen_so_far, seen, 1)
        honest = watch.judge(seen_so_far).consistent is True and not track.window.many_outliers
        forecast = estimator.track_forecast(track, np.array([AHEAD_S]))
        words = [
            test.judge(word, track.belief, forecast, honest)
            for test, word in zip(tests, words, strict=True)
        ]
        yield t, x, track, words
