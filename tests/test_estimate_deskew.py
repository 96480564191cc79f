"""Points of a moving target, each seen at its own instant, brought to one."""

from __future__ import annotations

import numpy as np
import pytest
import tumbling

from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.deskew import deskew
from avsreplay.records import Belief


def skewed(rate: float, span: float, at: float):
    """Points on the body in {C}, what a scanner sees of them over ``span`` s around ``at``, and the true cloud then."""
    times = np.sort(np.random.Generator(np.random.PCG64(0)).uniform(-span / 2, span / 2, 500))
    world = tumbling.draw(3, rate=rate, seconds=1.0)
    states = tumbling.follow(
        np.append(at + times, at)[np.argsort(np.append(at + times, at))], world.moments, world.states[0]
    )
    order = int(np.searchsorted(times, 0.0))
    now = states.pop(order)
    body = np.random.Generator(np.random.PCG64(1)).normal(size=(500, 3))
    seen = np.array([x.T_ac.apply(p) for x, p in zip(states, body, strict=True)])
    return seen, times, now, now.T_ac.apply(body)


def predict(now, t_ns: int = 0):
    estimator = Estimator(EstimatorParams(), Belief(0, now, np.eye(20) * 1e-6), 2.0)
    return estimator.predict(estimator.initial(0, now.T_ac), t_ns)


@pytest.mark.parametrize("rate", [0.1, 0.3])
@pytest.mark.parametrize("span", [0.2, 1.0])
def test_points_come_back_to_one_instant(rate: float, span: float) -> None:
    seen, times, now, whole = skewed(rate, span, 2.0)
    assert np.abs(seen - whole).max() > 0.2 * rate * span
    assert np.abs(deskew(seen, times, predict(now)) - whole).max() < 3e-5


def test_float32_points_and_one_instant() -> None:
    seen, times, now, whole = skewed(0.1, 1.0, 2.0)
    assert np.abs(deskew(seen.astype(np.float32), times.astype(np.float32), predict(now)) - whole).max() < 1e-4
    assert np.array_equal(deskew(seen, np.zeros(500), predict(now)), seen)
    assert deskew(np.zeros((0, 3)), np.zeros(0), predict(now)).shape == (0, 3)


def test_what_does_not_fit_is_refused() -> None:
    seen, times, now, _ = skewed(0.1, 1.0, 2.0)
    with pytest.raises(ValueError, match="do not fit"):
        deskew(seen, times[1:], predict(now))
    with pytest.raises(ValueError, match="not finite"):
        deskew(seen, np.full(500, np.nan), predict(now))
