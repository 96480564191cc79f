"""Poses with errors far larger than they state: the estimate stays one that can be predicted."""

import numpy as np
import pytest

from avsreplay.aliasing import MAX_SHOWN_TURN_RAD
from avsreplay.estimate.estimator import Estimator
from avsreplay.estimate.params import EstimatorParams, NoiseSource
from avsreplay.geometry import Pose, exp
from avsreplay.records import Alignment, AlignStatus


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "seed"), [(0.02, 0), (0.02, 1), (0.1, 1), (0.5, 0)])
def test_errors_ten_thousand_times_as_large_as_stated_end_no_run(noise, seed):
    """As metres that are given as millimetres: no fit follows such poses, and some diverge."""
    rng = np.random.default_rng(seed)
    given = EstimatorParams(noise=NoiseSource.R0, r0_pos_m=2e-6, r0_rot_deg=0.001)
    estimator, step_ns = Estimator(given, None, 4.0), 500_000_000
    track = estimator.initial(0, Pose(np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, 5.0])))
    for k in range(1, 60):
        prior = estimator.predict(track, k * step_ns)
        turn = np.array([0.015 * k, 0.01 * k, 0.02 * k]) + noise * rng.normal(size=3)
        pose = Pose(exp(turn), np.array([0.0, 0.0, 5.0]) + noise * rng.normal(size=3))
        quality = 1, True, 1000, 1000, 0.0, np.eye(6), AlignStatus.ALIGNED
        innovation = estimator.innovate(prior, Alignment(pose, *quality))
        track = estimator.update(track, prior, innovation, 1, False)
        found = track.belief
        assert np.isfinite(found.P).all()
        assert 0.5 * np.linalg.norm(found.x.w_b) <= MAX_SHOWN_TURN_RAD
