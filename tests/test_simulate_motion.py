"""The true motion against DOP853, its conserved quantities, and the paper's ratio form of the same
dynamics.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from avsreplay import geometry
from avsreplay.simulate.inertia import principal, with_axes
from avsreplay.simulate.motion import Load, Motion, MotionParams, Push

SPAN = 120.0
PARAMS = MotionParams(
    attitude_xyzw=tuple(geometry.exp([0.3, 1.2, -0.4])),
    rate_radps=(0.06, 0.064, -0.048),
    position_m=(0.1, -0.2, 5.0),
    velocity_mps=(0.002, -0.001, 0.003),
)
BODY = principal([[1.1, 0.2, -0.1], [0.2, 0.8, 0.05], [-0.1, 0.05, 0.9]], [-0.6, 0.1, 0.2])
TIMES = np.linspace(0.0, SPAN, 241)


def rng(seed=0):
    return np.random.Generator(np.random.PCG64(seed))


@pytest.fixture(scope="module")
def motion():
    return Motion(BODY, PARAMS, SPAN, rng())


@pytest.fixture(scope="module")
def oracle():
    inertia, inverse = BODY.inertia_c, np.linalg.inv(BODY.inertia_c)

    def rates(_t, y):
        q, w = y[:4], y[4:]
        return np.r_[0.5 * geometry.multiply(q, [*w, 0.0]), inverse @ -np.cross(w, inertia @ w)]

    start = np.r_[PARAMS.attitude_xyzw, PARAMS.rate_radps]
    return solve_ivp(
        rates, (0, SPAN), start, method="DOP853", rtol=1e-13, atol=1e-14, t_eval=TIMES
    ).y.T


def test_attitude_and_rate_agree_with_dop853_to_1e_10(motion, oracle):
    q, w, _, _ = motion.states(TIMES)
    turn = geometry.angle(geometry.multiply(geometry.conjugate(q), oracle[:, :4]))
    assert np.max(turn) < 1e-10
    assert_allclose(w, oracle[:, 4:], atol=1e-11)


def test_energy_and_angular_momentum_are_conserved_to_1e_10(motion):
    q, w, _, _ = motion.states(TIMES)
    momentum = np.einsum("nij,nj->ni", geometry.matrix(q), w @ BODY.inertia_c)
    energy = 0.5 * np.einsum("ni,ij,nj->n", w, BODY.inertia_c, w)
    assert_allclose(
        momentum,
        np.broadcast_to(momentum[0], momentum.shape),
        rtol=0,
        atol=1e-10 * np.linalg.norm(momentum[0]),
    )
    assert_allclose(energy, energy[0], rtol=1e-10)


def test_the_ratio_form_of_the_dynamics_gives_the_same_motion(motion):
    """The paper's phi(w, sigma) in {B}, integrated by itself, against the full tensor in {C}."""
    first = motion.state(0.0)
    s1, s2 = first.sigma
    ratios = np.array([s1, s2, -(s1 + s2) / (1 + s1 * s2)])

    def rates(_t, y):
        q, w = y[:4], y[4:]
        return np.r_[
            0.5 * geometry.multiply(q, [*w, 0.0]),
            ratios * np.array([w[1] * w[2], w[0] * w[2], w[0] * w[1]]),
        ]

    ends = solve_ivp(
        rates, (0, SPAN), np.r_[first.q_ab, first.w_b], method="DOP853", rtol=1e-13, atol=1e-14
    ).y[:, -1]
    last = motion.state(SPAN)
    assert geometry.angle(geometry.multiply(geometry.conjugate(last.q_ab), ends[:4])) < 1e-10
    assert_allclose(last.w_b, ends[4:], atol=1e-11)


def test_the_fixture_is_fixed_to_the_body(motion):
    """T_ac from the state equals the mass centre carried by the model's own coordinates;
    velocity is its slope.
    """
    for t in (0.0, 7.3, 61.0):
        R_ac, t_ac = motion.poses([t])
        state = motion.state(t)
        assert_allclose(state.T_ac.R, R_ac[0], atol=1e-13)
        assert_allclose(state.T_ac.t, t_ac[0], atol=1e-13)
        h = 1e-4
        _, around = motion.poses([max(t - h, 0.0), t + h])
        span = t + h - max(t - h, 0.0)
        assert_allclose(state.fixture_velocity, (around[1] - around[0]) / span, atol=1e-6)


def test_the_mass_centre_drifts_straight(motion):
    _, _, centre, velocity = motion.states(TIMES)
    assert_allclose(
        centre, np.array(PARAMS.position_m) + TIMES[:, None] * PARAMS.velocity_mps, atol=1e-12
    )
    assert_allclose(velocity, np.broadcast_to(PARAMS.velocity_mps, velocity.shape), atol=1e-15)


def test_the_dense_output_is_smooth_across_steps(motion):
    for edge in motion.step_starts_s[1:6]:
        for before, after in zip(
            motion.states([edge - 1e-9]), motion.states([edge + 1e-9]), strict=True
        ):
            assert_allclose(before, after, atol=1e-8)


def test_a_body_at_rest_stays_at_rest():
    q, w, _, _ = Motion(BODY, MotionParams(rate_radps=(0, 0, 0)), 50.0, rng()).states(
        [0.0, 25.0, 50.0]
    )
    assert_allclose(q, np.broadcast_to([0, 0, 0, 1], q.shape))
    assert_allclose(w, 0)


@pytest.mark.parametrize(
    "moments", [(1.0, 1.0, 1.0), (0.3, 0.98, 0.98), (0.02, 1.0, 1.0), (0.9, 1.0, 1.0999)]
)
def test_symmetric_and_slender_bodies_keep_their_momentum(moments):
    body = with_axes(moments, geometry.exp([0.2, 0.5, -1.0]), np.zeros(3))
    motion = Motion(body, MotionParams(rate_radps=(0.3, 0.2, -0.1)), 30.0, rng())
    q, w, _, _ = motion.states(np.linspace(0, 30, 31))
    momentum = np.einsum("nij,nj->ni", geometry.matrix(q), w @ body.inertia_c)
    assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), atol=1e-11)


def test_disturbances_move_the_velocity_as_their_level_says():
    """Over n held steps the velocity walks by std step sqrt(n): a chi-square over 40 seeds
    and 3 axes.
    """
    std, step, span = 1e-3, 0.5, 20.0
    params = MotionParams(force_std_mps2=std, disturbance_step_s=step)
    ends = [Motion(BODY, params, span, rng(seed)).states([span])[3][0] for seed in range(40)]
    chi2 = np.sum(np.square(ends)) / (std * step) ** 2 / (span / step)
    assert 80 < chi2 < 168  # 99.9 % band of 120 degrees of freedom


def test_a_disturbance_torque_changes_the_rate_by_its_share():
    """Over one short step I dw = tr(I) eps dt."""
    params = MotionParams(rate_radps=(0, 0, 0), torque_std_radps2=1e-3, disturbance_step_s=0.1)
    motion = Motion(BODY, params, 0.1, rng(3))
    eps = 1e-3 * rng(3).standard_normal(3)
    _, w, _, _ = motion.states([0.1])
    assert_allclose(
        w[0], np.linalg.solve(BODY.inertia_c, np.trace(BODY.inertia_c) * eps) * 0.1, rtol=1e-4
    )


def test_disturbed_motion_is_continuous_and_repeats():
    params = MotionParams(rate_radps=(0.1, 0.05, 0), torque_std_radps2=1e-4, force_std_mps2=1e-3)
    one, two = (Motion(BODY, params, 20.0, rng(9)) for _ in range(2))
    assert all(
        np.array_equal(a, b)
        for a, b in zip(one.states(TIMES / 6), two.states(TIMES / 6), strict=True)
    )
    for edge in (1.0, 2.0, 13.0):
        for before, after in zip(one.states([edge - 1e-9]), one.states([edge + 1e-9]), strict=True):
            assert_allclose(before, after, atol=1e-8)


def test_a_push_changes_rate_and_velocity_at_its_instant_and_nothing_else():
    push = Push(at_s=7.0, velocity_mps=(0.01, 0.0, -0.02), rate_radps=(0.0, 0.03, 0.0))
    pushed = Motion(BODY, replace(PARAMS, push=(push,)), 20.0, rng())
    free = Motion(BODY, PARAMS, 20.0, rng())
    early, at = np.linspace(0.0, 6.999, 20), [7.0]
    for one, other in zip(pushed.states(early), free.states(early), strict=True):
        assert_allclose(one, other, atol=1e-12)
    changes = [a - b for a, b in zip(pushed.states(at), free.states(at), strict=True)]
    for change, wanted in zip(changes, (0.0, push.rate_radps, 0.0, push.velocity_mps), strict=True):
        assert_allclose(change[0], np.broadcast_to(wanted, change[0].shape), atol=1e-12)
    q, w, centre, velocity = pushed.states(at)
    later = replace(
        PARAMS,
        attitude_xyzw=tuple(q[0]),
        rate_radps=tuple(w[0]),
        position_m=tuple(centre[0]),
        velocity_mps=tuple(velocity[0]),
    )
    rest = Motion(BODY, later, 13.0, rng())
    for one, other in zip(pushed.states([19.0]), rest.states([12.0]), strict=True):
        assert_allclose(one, other, atol=1e-10)


def test_a_load_accelerates_between_its_begin_and_its_end():
    """The force as in free fall; the torque by the change of the angular momentum."""
    force, torque = (0.0, 2e-3, 0.0), (1e-4, 0.0, 5e-5)
    load = Load(start_s=4.0, duration_s=6.0, force_mps2=force, torque_radps2=torque)
    still = MotionParams(rate_radps=(0.0, 0.0, 0.0), load=(load,))
    q, w, centre, velocity = Motion(BODY, still, 20.0, rng()).states([4.0, 4.1, 10.0, 15.0])
    assert_allclose(velocity, np.outer([0.0, 0.1, 6.0, 6.0], force), atol=1e-12)
    assert_allclose((centre - centre[0])[2], 18.0 * np.array(force), atol=1e-12)
    trace = np.trace(BODY.inertia_c)
    assert_allclose(w[1] @ BODY.inertia_c, 0.1 * trace * np.array(torque), rtol=1e-4, atol=1e-9)
    momentum = np.einsum("nij,nj->ni", geometry.matrix(q), w @ BODY.inertia_c)
    assert_allclose(momentum[2], momentum[3], atol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        {"attitude_xyzw": (1, 1, 0, 0)},
        {"torque_std_radps2": -1.0},
        {"force_std_mps2": float("nan")},
        {"disturbance_step_s": 0.0},
    ],
)
def test_invalid_motions_are_refused_by_name(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        MotionParams(**wrong)


def _clohessy_wiltshire(n, t, r, v):
    """Closed form in the rotating frame: x radial, y along-track, z along the normal; (3,) each."""
    c, s = np.cos(n * t), np.sin(n * t)
    x, y, z = r
    vx, vy, vz = v
    return np.array(
        [
            (4 - 3 * c) * x + s / n * vx + 2 / n * (1 - c) * vy,
            6 * (s - n * t) * x + y - 2 / n * (1 - c) * vx + (4 * s - 3 * n * t) / n * vy,
            c * z + s / n * vz,
        ]
    )


@pytest.mark.parametrize("n", [0.00113, 0.02])
def test_the_relative_orbit_is_that_of_clohessy_and_wiltshire(n):
    """In the inertial axes of {A}, against the closed form in rotating axes, over 600 s."""
    radial, normal = np.array([0.6, 0.0, 0.8]), np.array([0.0, -1.0, 0.0])
    along = np.cross(normal, radial)
    r0, v0 = np.array(PARAMS.position_m), np.array(PARAMS.velocity_mps)
    params = replace(
        PARAMS, orbit_rate_radps=n, radial_a=tuple(radial), orbit_normal_a=tuple(normal)
    )
    path = Motion(BODY, params, 600.0, rng())
    axes = np.stack([radial, along, normal])
    v_rotating = axes @ (v0 - n * np.cross(normal, r0))
    times = np.linspace(0.0, 600.0, 61)
    _, _, centre, velocity = path.states(times)
    for t, r in zip(times, centre, strict=True):
        c, s = np.cos(n * t), np.sin(n * t)
        now = np.stack([c * radial + s * along, -s * radial + c * along, normal])
        expected = _clohessy_wiltshire(n, t, axes @ r0, v_rotating) @ now
        assert_allclose(r, expected, atol=1e-9 * max(1.0, np.abs(expected).max()))
    numeric = (path.states(times[1:-1] + 1e-3)[2] - path.states(times[1:-1] - 1e-3)[2]) / 2e-3
    assert_allclose(velocity[1:-1], numeric, atol=1e-5 * np.abs(velocity).max())
    free = Motion(BODY, PARAMS, 600.0, rng()).states([600.0])[2][0]
    assert (
        np.linalg.norm(free - centre[-1]) > 0.5
    )  # the approximation of free motion is off by that


def test_an_orbit_does_not_change_the_attitude():
    moving = Motion(BODY, replace(PARAMS, orbit_rate_radps=0.00113), SPAN, rng())
    assert_allclose(
        moving.states(TIMES)[0], Motion(BODY, PARAMS, SPAN, rng()).states(TIMES)[0], atol=1e-12
    )


def test_axes_of_an_orbit_must_be_orthonormal():
    with pytest.raises(ValueError, match="right angles"):
        replace(PARAMS, radial_a=(1.0, 0.0, 0.0), orbit_normal_a=(0.8, 0.6, 0.0))
