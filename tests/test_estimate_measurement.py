"""z, h and H: signs, sides and units, each against a finite difference or a sample."""

from __future__ import annotations

import numpy as np
import pytest
import tumbling

from avsreplay import geometry
from avsreplay.estimate import measurement
from avsreplay.estimate.dynamics import grasp_jacobian
from avsreplay.estimate.error_state import boxminus, boxplus
from avsreplay.estimate.measurement import (
    innovation_vector,
    measured_pose,
    measurement_jacobian,
    registration_noise,
    residual,
)
from avsreplay.geometry import Pose
from avsreplay.records import Alignment, AlignStatus, State


@pytest.fixture(params=range(3))
def x(request: pytest.FixtureRequest) -> State:
    return tumbling.draw(request.param, mu_deg=60.0, varrho=1.0, seconds=1.0).states[0]


def test_boxplus_and_boxminus_are_inverse(x: State) -> None:
    d = np.random.Generator(np.random.PCG64(0)).normal(size=20) * 0.2
    assert np.abs(boxminus(boxplus(x, d), x) - d).max() < 1e-14


def test_the_error_is_on_the_side_that_the_paper_uses(x: State) -> None:
    d = np.zeros(20)
    d[:3], d[17:] = [0.1, 0.2, -0.1], [0.05, 0.0, 0.1]
    y = boxplus(x, d)
    dq, dmu = (np.append(v, np.sqrt(1 - v @ v)) for v in (d[:3], d[17:]))
    assert np.allclose(geometry.matrix(y.q_ab), geometry.matrix(x.q_ab) @ geometry.matrix(dq))  # q = dq (x) q_hat
    assert np.allclose(geometry.matrix(y.q_bc), geometry.matrix(dmu) @ geometry.matrix(x.q_bc))  # mu = mu_hat (x) dmu


def test_perfect_pose_has_no_innovation(x: State) -> None:
    assert np.abs(innovation_vector(x, x.T_ac)).max() < 1e-15


def test_sensitivity_is_the_derivative(x: State) -> None:
    H, eps = measurement_jacobian(x), 1e-6
    for k in range(20):
        d = np.zeros(20)
        d[k] = eps
        column = (innovation_vector(x, boxplus(x, d).T_ac) - innovation_vector(x, boxplus(x, -d).T_ac)) / (2 * eps)
        assert np.abs(column - H[:, k]).max() < 1e-9, k


def test_measured_pose_inverts_the_innovation(x: State) -> None:
    pose = x.T_ac @ Pose(geometry.exp([0.5, -1.2, 0.3]), np.array([0.1, 0.2, 0.3]))
    back = measured_pose(x, innovation_vector(x, pose))
    assert np.abs(back.matrix - pose.matrix).max() < 1e-14


def test_half_angle_noise(x: State) -> None:
    one_degree = np.radians(1.0)
    C = np.diag([one_degree**2] * 3 + [0.01**2] * 3)
    R = registration_noise(
        Alignment(x.T_ac, 1, True, 9, 9, 0.0, np.linalg.inv(C), AlignStatus.ALIGNED, C), x, (1.0, 1.0)
    )
    assert np.sqrt(np.diag(R)) == pytest.approx(np.repeat([0.01, one_degree / 2], 3))


def test_noise_is_the_spread_of_innovations(x: State) -> None:
    rng = np.random.Generator(np.random.PCG64(2))
    root = np.linalg.qr(rng.normal(size=(6, 6)))[0] * np.geomspace(1e-4, 3e-3, 6)
    C = root @ root.T
    d = rng.normal(size=(4000, 6)) @ root.T
    noises = [innovation_vector(x, x.T_ac @ Pose(geometry.exp(-e[:3]), -e[3:])) for e in d]  # T_true = T_meas Exp(d)
    R = registration_noise(
        Alignment(x.T_ac, 1, True, 9, 9, 0.0, np.linalg.inv(C), AlignStatus.ALIGNED, C), x, (1.0, 1.0)
    )
    white = np.linalg.solve(np.linalg.cholesky(R), np.transpose(noises))
    assert np.abs(white @ white.T / 4000 - np.eye(6)).max() < 0.1


def test_a_free_direction_is_not_measured(x: State) -> None:
    info = np.diag([1e6, 1e6, 1e6, 0.0, 1e6, 1e6])
    R = registration_noise(Alignment(x.T_ac, 1, True, 9, 9, 0.0, info, AlignStatus.DEGENERATE), x, (1.0, 4.0))
    free = x.T_ac.R[:, 0]
    assert free @ R[:3, :3] @ free == pytest.approx(16.0)
    assert np.linalg.eigvalsh(R[:3, :3])[1] < 1.1e-6
    blind = Alignment(x.T_ac, 1, True, 9, 9, 0.0, np.zeros((6, 6)), AlignStatus.DEGENERATE)
    assert registration_noise(blind, x, (1.0, 4.0)) is None


def test_grasp_rows_are_the_derivative(x: State) -> None:
    J, eps = grasp_jacobian(geometry.matrix(x.q_ab)[None], x.w_b[None], x.c_b)[0], 1e-6

    def seen(y: State) -> np.ndarray:
        turn = geometry.multiply(geometry.multiply(geometry.conjugate(x.q_ab), y.T_ac.q), geometry.conjugate(x.q_bc))
        return np.concatenate([y.T_ac.t, y.fixture_velocity, geometry.normalise(turn)[:3]])

    for k in range(20):
        d = np.zeros(20)
        d[k] = eps
        assert np.abs((seen(boxplus(x, d)) - seen(boxplus(x, -d))) / (2 * eps) - J[:, k]).max() < 1e-9, k


def test_residual_is_the_innovation_at_the_posterior(x: State) -> None:
    pose = x.T_ac @ Pose(geometry.exp([0.02, -0.05, 0.01]), np.array([0.1, 0.2, 0.3]))
    posterior = boxplus(x, np.linspace(-0.02, 0.03, 20))
    assert np.abs(residual(posterior, x, innovation_vector(x, pose)) - innovation_vector(posterior, pose)).max() < 1e-14


def test_an_information_matrix_that_is_numerically_singular_gives_a_finite_covariance(monkeypatch):
    def singular(_):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(np.linalg, "inv", singular)
    v = np.array([1.0, -1.0, 0.5, 2.0, 0.0, 1.0])
    covariance = measurement._inverse(1e20 * np.outer(v, v))
    assert np.isfinite(covariance).all()
    assert v @ covariance @ v / (v @ v) == pytest.approx(1e-20 / (v @ v), rel=1e-2)
    unobservable = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    assert unobservable @ covariance @ unobservable > 1e12 * (v @ covariance @ v)
