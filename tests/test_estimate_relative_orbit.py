"""A relative orbit in propagation, transition matrix and fit, against an integration of the
equations of motion.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tumbling
from scipy.integrate import solve_ivp
from state_errors import boxminus
from test_register_poses import rows, tum

from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.dynamics import pose_rows, propagate, propagate_state
from avsreplay.estimate.error_state import RHO, VEL, boxplus
from avsreplay.estimate.reference import free_fit
from avsreplay.estimate.relative_orbit import RelativeOrbit
from avsreplay.geometry import Pose
from avsreplay.records import Belief, State

N = 0.00113  # mean motion at an altitude of 400 km
RADIAL, NORMAL = np.array([0.0, 0.6, 0.8]), np.array([1.0, 0.0, 0.0])
SETTINGS = {
    "orbit_rate_radps": N,
    "orbit_radial_a": tuple(RADIAL.tolist()),
    "orbit_normal_a": tuple(NORMAL.tolist()),
}
EPOCH_NS = 3_000_000_000


def orbit(n: float = N) -> RelativeOrbit:
    found = RelativeOrbit.of(EstimatorParams(**{**SETTINGS, "orbit_rate_radps": n}), EPOCH_NS)
    assert found is not None
    return found


def integrated(
    r: np.ndarray, v: np.ndarray, start_s: float, times_s: np.ndarray, n: float = N
) -> np.ndarray:
    """Centre and velocity (n, 6) in {A}: the equations in turning axes, integrated, and turned back
    by rotations.

    x'' = 3 n^2 x + 2 n y', y'' = -2 n x', z'' = -n^2 z (Clohessy and Wiltshire); x radial, y along
    the track.
    """
    along = np.cross(NORMAL, RADIAL)

    def axes(t: float) -> np.ndarray:
        o = math.cos(n * t) * RADIAL + math.sin(n * t) * along
        return np.array([o, np.cross(NORMAL, o), NORMAL])

    def slope(_: float, s: np.ndarray) -> list[float]:
        return [s[3], s[4], s[5], 3 * n * n * s[0] + 2 * n * s[4], -2 * n * s[3], -n * n * s[2]]

    turn, spin = axes(start_s), n * NORMAL
    begin = np.concatenate([turn @ r, turn @ (v - np.cross(spin, r))])
    ends = sorted({0.0, *times_s.tolist()})
    found = solve_ivp(
        slope, (ends[0], ends[-1]), begin, t_eval=ends, method="DOP853", rtol=1e-12, atol=1e-14
    )
    out = []
    for t in times_s:
        s = found.y[:, ends.index(t)]
        back = axes(start_s + t).T
        position = back @ s[:3]
        out.append(np.concatenate([position, back @ s[3:] + np.cross(spin, position)]))
    return np.array(out)


@pytest.mark.parametrize("n", [N, 0.02])
@pytest.mark.parametrize("start_s", [0.0, 400.0])
def test_the_transition_is_that_of_the_integrated_equations(n: float, start_s: float) -> None:
    times = np.array([0.2, 1.0, 60.0, 600.0])
    r, v = np.array([1.0, -2.0, 5.0]), np.array([0.01, 0.02, -0.005])
    arc = orbit(n).at(EPOCH_NS + round(start_s * 1e9))
    found = arc.transitions(times) @ np.concatenate([r, v])
    np.testing.assert_allclose(found, integrated(r, v, start_s, times, n), rtol=1e-9, atol=1e-9)
    back = arc.shifted(60.0).transitions(np.array([-60.0]))[0] @ found[2]
    np.testing.assert_allclose(back, np.concatenate([r, v]), atol=1e-10)


def test_a_slow_orbit_is_free_motion() -> None:
    M = orbit(1e-9).at(EPOCH_NS).transitions(np.array([30.0]))[0]
    free = np.block([[np.eye(3), 30.0 * np.eye(3)], [np.zeros((3, 3)), np.eye(3)]])
    np.testing.assert_allclose(M, free, atol=1e-5)


def test_mean_and_phi_of_a_step_are_those_of_the_orbit() -> None:
    """The state after the step against the integration, Phi against differences, the attitude as in
    free motion.
    """
    x, at_ns, h = tumbling.draw(5, seconds=1.0).states[0], EPOCH_NS + 200_000_000_000, 40.0
    belief = Belief(at_ns, x, np.eye(20) * 1e-6)
    there, Phi = propagate(belief, at_ns + round(h * 1e9), 0.0, 0.0, orbit())
    free, plain = propagate(belief, at_ns + round(h * 1e9), 0.0, 0.0)
    true = integrated(x.r_a, x.v_a, 200.0, np.array([h]))[0]
    np.testing.assert_allclose(np.concatenate([there.x.r_a, there.x.v_a]), true, atol=1e-9)
    assert np.linalg.norm(there.x.r_a - free.x.r_a) > 1e-3
    np.testing.assert_array_equal(there.x.q_ab, free.x.q_ab)
    np.testing.assert_array_equal(
        np.delete(Phi, np.r_[6:12], axis=1), np.delete(plain, np.r_[6:12], axis=1)
    )
    arc = orbit().at(at_ns)
    for k in (*range(20)[RHO], *range(20)[VEL]):
        d = np.zeros(20)
        d[k] = 1e-3
        slope = boxminus(propagate_state(boxplus(x, d), h, arc)[0], there.x) / 1e-3
        np.testing.assert_allclose(Phi[:, k], slope, atol=1e-8)
    seen = pose_rows(x, np.array([h]), arc)[0]
    np.testing.assert_allclose(seen[:3, 6:12], Phi[6:9, 6:12], atol=1e-12)


def orbiting(
    seed: int, seconds: float, hz: float
) -> tuple[tumbling.World, list[State], list[Pose]]:
    """A tumbling body on the orbit: true states and measured poses (2 mm, 0.003 rad)."""
    world = tumbling.draw(seed, seconds=seconds, hz=hz, rate=0.1)
    rng = np.random.Generator(np.random.PCG64([seed, 9]))
    first = world.states[0]
    moved = integrated(first.r_a + np.array([0.0, 0.0, 6.0]), first.v_a, 0.0, world.times)
    states = [replace(x, r_a=m[:3], v_a=m[3:]) for x, m in zip(world.states, moved, strict=True)]
    poses = [tumbling.alignment(x.T_ac, rng, 0.002, 0.003).T_ac for x in states]
    return world, states, poses


def test_the_fit_finds_the_motion_over_600_s() -> None:
    """Its residuals are the noise, and its initial values the truth; a fit of free motion
    leaves decimetres.
    """
    world, states, poses = orbiting(2, 600.0, 0.5)
    t_ns = [EPOCH_NS + round(t * 1e9) for t in world.times]
    on_orbit = free_fit(t_ns, poses, None, 2.0, EstimatorParams(**SETTINGS))
    free = free_fit(t_ns, poses, None, 2.0)
    assert on_orbit.rms[1] < 0.004
    assert free.rms[1] > 0.1
    arc = orbit().at(t_ns[0])
    for k in (0, 150, 299):
        found = propagate_state(on_orbit.x, (t_ns[k] - t_ns[0]) * 1e-9, arc)[0]
        assert np.linalg.norm(found.T_ac.t - states[k].T_ac.t) < 0.003
        assert np.linalg.norm(found.v_a - states[k].v_a) < 1e-4


def test_the_estimator_follows_the_orbit(tmp_path: Path) -> None:
    """A run over 600 s: errors within the claims with the orbit; without it they are several
    times as large.
    """
    world, states, poses = orbiting(4, 600.0, 0.5)
    times = [EPOCH_NS + round(t * 1e9) for t in world.times]
    log = tum(tmp_path / "orbit.tum", times, poses)
    truth = tum(tmp_path / "truth.tum", times, [x.T_ac for x in states])
    given = [
        f"estimator.{key}={list(v) if isinstance(v, tuple) else v}" for key, v in SETTINGS.items()
    ]
    known, _ = rows(log, *given, extent_m=2.0, truth_file=truth)
    unknown, _ = rows(log, extent_m=2.0, truth_file=truth)
    settled = known[50:]
    assert max(row.manoeuvres for row in known) == 0
    assert sum(row.gamma for row in settled) == len(settled)
    assert max(row.pos_err_m for row in settled) < 0.005
    assert np.mean([row.nis for row in settled]) == pytest.approx(6.0, rel=0.15)
    with_claims = [row.pos_err_m / row.pos_1s_m for row in settled]
    assert np.mean(np.square(with_claims)) < 3.0 * 1.3  # at most the three axes
    rms = [
        math.sqrt(np.mean([row.pos_err_m**2 for row in found[50:]])) for found in (known, unknown)
    ]
    assert rms[1] > 2.0 * rms[0]


def test_predictions_follow_the_orbit() -> None:
    x = tumbling.draw(1, seconds=1.0).states[0]
    belief = Belief(EPOCH_NS + 100_000_000_000, x, np.eye(20) * 1e-6)
    found = Estimator(EstimatorParams(**SETTINGS), belief, 2.0, EPOCH_NS).motion(belief)
    free = Estimator(EstimatorParams(), belief, 2.0, EPOCH_NS).motion(belief)
    times = np.array([0.0, 10.0, 120.0])
    true, straight = integrated(x.r_a, x.v_a, 100.0, times), x.r_a + times[:, None] * x.v_a
    np.testing.assert_allclose(found(times)[0] - free(times)[0], true[:, :3] - straight, atol=1e-9)
    np.testing.assert_allclose(found(times)[1] - free(times)[1], true[:, 3:] - x.v_a, atol=1e-9)


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"orbit_normal_a": (0.0, 0.6, 0.8)}, "right angles"),
        ({"orbit_radial_a": (0.0, 0.6, 0.9)}, "unit vectors"),
        ({"acceleration_mps2": (0.0, 0.0, -9.8)}, "cannot be combined"),
        ({"fit_acceleration": True}, "cannot be combined"),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(wrong: dict[str, object], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        EstimatorParams(**{**SETTINGS, **wrong})
