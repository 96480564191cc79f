"""A constant acceleration: the falling frame changes no statistic; the fit is unbiased and
its 1 sigma correct.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tumbling
from test_register_poses import rows, tum

from avsreplay.errors import UsageError
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.acceleration import fit_acceleration
from avsreplay.geometry import Pose
from avsreplay.records import Belief

GRAVITY = np.array([0.3, -0.2, -9.61])
POS_M, ROT_RAD, HZ = 1e-4, 3e-4, 100.0


def fallen(world: tumbling.World, acceleration: np.ndarray) -> list[Pose]:
    """True poses of the world's body under an acceleration, by their definition."""
    pairs = zip(world.times, world.states, strict=True)
    return [Pose(x.T_ac.q, x.T_ac.t + 0.5 * t * t * acceleration) for t, x in pairs]


def measured(seed: int, acceleration: np.ndarray, seconds: float = 0.4) -> list[tuple[int, object]]:
    world = tumbling.draw(seed, seconds=seconds, hz=HZ, rate=4.0, varrho=0.05)
    rng = np.random.Generator(np.random.PCG64([seed, 3]))
    true = fallen(world, acceleration)
    pairs = zip(world.times, true, strict=True)
    return [(round(t * 1e9), tumbling.alignment(T, rng, POS_M, ROT_RAD)) for t, T in pairs]


PARAMS = EstimatorParams().resolved(0.2)


def test_the_fitted_acceleration_is_unbiased_and_its_covariance_is_right() -> None:
    nees = []
    for seed in range(60):
        found = fit_acceleration(measured(seed, GRAVITY), PARAMS)
        error = found.mean - GRAVITY
        nees.append(float(error @ np.linalg.solve(found.P, error)))
        assert found.poses >= 38
    # chi-square with 180 degrees of freedom over 60: mean 3, 1 sigma 0.32; the estimated noise adds
    # some spread
    assert 2.0 < np.mean(nees) < 4.2


def test_the_fit_ends_before_the_motion_changes() -> None:
    for seed in range(20):
        data = measured(seed, GRAVITY)
        kick = np.array([0.0, 0.0, 2.0])
        hit = 25
        data = [
            (t, replace(a, T_ac=Pose(a.T_ac.q, a.T_ac.t + kick * (t - data[hit][0]) * 1e-9)))
            if k > hit
            else (t, a)
            for k, (t, a) in enumerate(data)
        ]
        found = fit_acceleration(data, PARAMS)
        assert hit - 3 <= found.poses <= hit + 1
        error = found.mean - GRAVITY
        assert error @ np.linalg.solve(found.P, error) < 35.0


def test_too_few_poses_are_refused() -> None:
    with pytest.raises(UsageError, match="only 7 poses"):
        fit_acceleration(measured(0, GRAVITY)[:7], PARAMS)


def test_a_known_acceleration_changes_poses_and_velocities_only(tmp_path: Path) -> None:
    world = tumbling.draw(3, seconds=10.0, hz=3.0, rate=0.3)
    rng = np.random.Generator(np.random.PCG64(4))
    a = np.array([0.01, -0.02, 0.03])
    times = [1_000_000_000 + round(t * 1e9) for t in world.times]
    free = [tumbling.alignment(x.T_ac, rng, 0.002, 0.003).T_ac for x in world.states]
    moved = [Pose(T.q, T.t + 0.5 * t * t * a) for t, T in zip(world.times, free, strict=True)]
    plain, _ = rows(tum(tmp_path / "free.tum", times, free), extent_m=2.0)
    truth = tum(tmp_path / "truth.tum", times, fallen(world, a))
    setting = f"estimator.acceleration_mps2={a.tolist()}"
    under, summary = rows(
        tum(tmp_path / "moved.tum", times, moved), setting, extent_m=2.0, truth_file=truth
    )
    for before, after, t in zip(plain, under, world.times, strict=True):
        assert after.gamma == 1
        assert after.nis == pytest.approx(before.nis, rel=1e-4, abs=1e-6)
        assert [after.x_m, after.y_m, after.z_m] == pytest.approx(
            np.array([before.x_m, before.y_m, before.z_m]) + 0.5 * t * t * a, abs=1e-6
        )
        assert [after.vx_mps, after.vy_mps, after.vz_mps] == pytest.approx(
            np.array([before.vx_mps, before.vy_mps, before.vz_mps]) + t * a, abs=1e-5
        )
        assert (after.sigma1, after.pos_1s_m) == pytest.approx(
            (before.sigma1, before.pos_1s_m), rel=1e-3, abs=1e-6
        )
    assert max(row.pos_err_m for row in under[20:]) < 0.006
    assert summary.acceleration is not None
    assert "given" in summary.acceleration
    ignored, _ = rows(tmp_path / "moved.tum", extent_m=2.0)
    assert ignored[-1].pos_1s_m > 1.5 * under[-1].pos_1s_m  # the poses show a random force


def test_predictions_contain_the_acceleration() -> None:
    x = tumbling.draw(1, seconds=1.0).states[0]
    a = (0.1, 0.2, -0.3)
    belief = Belief(7_000_000_000, x, np.eye(20) * 1e-6)
    free = Estimator(EstimatorParams(), belief, 2.0, 5_000_000_000)
    falling = Estimator(EstimatorParams(acceleration_mps2=a), belief, 2.0, 5_000_000_000)
    track = falling.initial(belief.t_ns, x.T_ac)
    np.testing.assert_allclose(falling.frame.belief_out(track.belief).x.r_a, x.r_a, atol=1e-12)
    h = np.array([0.0, 0.5, 3.0])
    position, velocity = falling.motion(belief)(h)
    plain, steady = free.motion(belief)(h)
    np.testing.assert_allclose(position, plain + 0.5 * h[:, None] ** 2 * a, atol=1e-12)
    np.testing.assert_allclose(velocity, steady + h[:, None] * a, atol=1e-12)
    later = falling.frame.belief_out(falling.predict(track, belief.t_ns + 3_000_000_000).belief)
    np.testing.assert_allclose(later.x.T_ac.t, position[-1], atol=1e-9)


def test_the_run_reports_the_fitted_acceleration(tmp_path: Path) -> None:
    data = measured(2, GRAVITY, 0.3)
    log = tum(tmp_path / "a.tum", [t + 10**9 for t, _ in data], [a.T_ac for _, a in data])
    found, summary = rows(log, "estimator.fit_acceleration=true", extent_m=0.2)
    assert summary.acceleration is not None
    assert "fitted to the first 31 poses" in summary.acceleration
    assert sum(row.gamma for row in found) == len(found)
