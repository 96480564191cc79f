"""The measurement of a pose and the update of the filter with it.

The model (eq:innovation): z = (rho, deta_v) of a registered pose, its Jacobian H, its noise R. deta
= mu_hat^-1 (x) eta (x) q_hat^-1, in Hamilton's product q_hat^-1 * eta * mu_hat^-1, of the sign with
w >= 0. The errors are zero after each update, so the attitude part of h is zero and H is taken
there.

The constrained update (eq:innovation, eq:K_phi, eq:sigma_bounds): K = gamma beta K^u, in Joseph's
form. beta scales the two sigma rows of the gain (rows 12, 13) so that sigma stays inside its
bounds. A scaled gain is not optimal, hence Joseph's form.

Three sets of estimated parameters on one motion, for the observability of each (the paper's claim
on two ratios): ``two``: the 20 states; ``three``: sigma1, sigma2 and sigma3 independent, 21 states;
``known``: sigma, varrho and mu known, the 12 states of motion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from avsreplay.estimate import _motion
from avsreplay.estimate.driven import DrivenBelief, corrected
from avsreplay.estimate.dynamics import advance, flow, sigma_join, transition
from avsreplay.estimate.error_state import (
    DIM,
    SIGMA,
    Quad,
    boxplus,
    conjugate_quad,
    hamilton,
    rotation,
)
from avsreplay.estimate.pose_noise import scaled_R
from avsreplay.geometry import Array, Pose
from avsreplay.records import BLOCKS, UNLIKELY, Alignment, Belief, Innovation, State

Triple = tuple[float, float, float]
GATE = UNLIKELY[6]  # a pose above it is an outlier


def measurement_jacobian(x: State) -> Array:
    """H (6, 20) at zero error: [-2A(q)[c x] 0 I 0 0 A(q) 0; I 0 0 0 0 0 I]."""
    return _motion.pose_jacobian(x.flat)


def innovation_vector(x: State, T_ac: Pose) -> Array:
    """The innovation alpha (6,) = z - h at zero error: [m in {A}, half-angle vector in {B}]."""
    q = hamilton(hamilton(conjugate_quad(x.q_ab), T_ac.q.tolist()), conjugate_quad(x.q_bc))
    return _difference(T_ac.t.tolist(), _fixture(x), q)


def residual(posterior: State, prior: State, alpha: Array) -> Array:
    """Z - h(x+) (6,) of the pose whose innovation at the prior is ``alpha``."""
    position, deta = _measured(prior, alpha)
    left = hamilton(conjugate_quad(posterior.q_ab), prior.q_ab.tolist())
    right = hamilton(prior.q_bc.tolist(), conjugate_quad(posterior.q_bc))
    return _difference(position, _fixture(posterior), hamilton(hamilton(left, deta), right))


def measured_pose(x: State, alpha: Array) -> Pose:
    """The pose T_ac whose innovation at x is ``alpha``: the inverse of ``innovation_vector``."""
    position, deta = _measured(x, alpha)
    return Pose(
        np.array(hamilton(hamilton(x.q_ab.tolist(), deta), x.q_bc.tolist())), np.array(position)
    )


def registration_noise(alignment: Alignment, x: State, free: tuple[float, float]) -> Array | None:
    """R (6, 6) [m, half-angle] from the registration's covariance of d = [theta; v] in {C}; None if
    it gives none.

    Attitude is A(mu) theta / 2 in {B}, position R_ac v in {A}: both of one sign, so the cross terms
    stay. For a degenerate view the covariance is computed from ``info``, with the standard
    deviations ``free`` (rad, m) along the unobservable directions, so that the observable
    directions of the scan are still used.
    """
    if alignment.covariance is not None:
        C = alignment.covariance
    elif np.any(alignment.info):
        C = _inverse(alignment.info + np.diag(np.repeat(np.asarray(free) ** -2.0, 3)))
    else:
        return None
    return in_camera(C, alignment.T_ac.q, x.q_bc)


def _inverse(info: Array) -> Array:
    """The inverse; if ``info`` is numerically singular, eigenvalues are raised to 1e-15 of
    the largest.
    """
    try:
        return np.asarray(np.linalg.inv(info))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(info)
        return np.asarray((vectors / np.maximum(values, 1e-15 * values[-1])) @ vectors.T)


def in_camera(C: Array, q_ac: Array, q_bc: Array) -> Array:
    """R (6, 6) in metres in {A} and half angles in {B} from C (6, 6) of d = [theta; v] in {C}."""
    J = to_camera(q_ac, q_bc)
    R: Array = J @ C @ J.T
    return 0.5 * (R + R.T)


def in_fixture(R: Array, q_ac: Array, q_bc: Array) -> Array:
    """The inverse of ``in_camera``."""
    J = to_fixture(q_ac, q_bc)
    C: Array = J @ R @ J.T
    return 0.5 * (C + C.T)


def to_camera(q_ac: Array, q_bc: Array) -> Array:
    """J (6, 6) from d = [theta; v] in {C} to metres in {A} and half angles in {B}."""
    J = np.zeros((6, 6))
    J[:3, 3:], J[3:, :3] = rotation(q_ac), 0.5 * rotation(q_bc)
    return J


def to_fixture(q_ac: Array, q_bc: Array) -> Array:
    """The inverse of ``to_camera``."""
    J = np.zeros((6, 6))
    J[:3, 3:], J[3:, :3] = 2.0 * rotation(q_bc).T, rotation(q_ac).T
    return J


def _measured(x: State, alpha: Array) -> tuple[Triple, Quad]:
    """Position and deta of the pose whose innovation at x is ``alpha``."""
    (x0, y0, z0), (dx, dy, dz, vx, vy, vz) = _fixture(x), alpha.tolist()
    w = math.sqrt(max(0.0, 1.0 - vx * vx - vy * vy - vz * vz))
    return (x0 + dx, y0 + dy, z0 + dz), (vx, vy, vz, w)


def _fixture(x: State) -> Triple:
    """Position of the fixture in {A}, r + A(q) c, in scalars: c + w t + v x t with t = 2 v x c."""
    (qx, qy, qz, qw), (cx, cy, cz), (rx, ry, rz) = x.q_ab.tolist(), x.c_b.tolist(), x.r_a.tolist()
    tx, ty, tz = 2.0 * (qy * cz - qz * cy), 2.0 * (qz * cx - qx * cz), 2.0 * (qx * cy - qy * cx)
    return (
        rx + (cx + qw * tx + qy * tz - qz * ty),
        ry + (cy + qw * ty + qz * tx - qx * tz),
        rz + (cz + qw * tz + qx * ty - qy * tx),
    )


def _difference(position: Triple, other: Triple, q: Quad) -> Array:
    """(6,) difference of two positions, and the vector part of q, of the sign with w >= 0."""
    s = 1.0 if q[3] >= 0.0 else -1.0
    dx, dy, dz = position[0] - other[0], position[1] - other[1], position[2] - other[2]
    return np.array((dx, dy, dz, s * q[0], s * q[1], s * q[2]))


# least eigenvalue of a repaired covariance, in units of its variances
_LEAST_REPAIRED_EIGENVALUE = 1e-12


def innovation_of(
    P: Array,
    H: Array,
    alpha: Array,
    R: Array,
    robust: bool = False,
    correlated_share: float = 0.0,
    dof: float = math.inf,
    rms_m: float = math.nan,
    free: Array | None = None,
) -> Innovation:
    """The innovation alpha (6,) with its covariance S = H P H' + R, its NIS and its Cauchy weight.

    Args:
        P: (20, 20) prior covariance.
        H: (6, 20) measurement Jacobian.
        alpha: (6,) innovation [m, half-angle].
        R: (6, 6) measurement noise.
        robust: give a pose whose NIS is above its 99.99 % point the Cauchy weight point / NIS;
            otherwise it is 1.
        correlated_share: the part of R that neighbouring scans have in common.
        dof: degrees of freedom of R as an estimate, inf if it is known.
        rms_m: of the alignment.
        free: directions that it does not determine.
    """
    S, definite, nis = _motion.innovation(P, H, alpha, R)
    if not definite:
        S = _repaired(S, R)
        nis = float(alpha @ np.linalg.solve(S, alpha))
    a, b, c, x, y, z = alpha.tolist()
    distance, half = math.sqrt(a * a + b * b + c * c), min(1.0, math.sqrt(x * x + y * y + z * z))
    of_S = dof_of_sum(dof, R, S)
    chi2, limit = as_chi2(nis, of_S), from_chi2(GATE, of_S)
    weight = limit / nis if robust and nis > limit else 1.0
    angle = 2.0 * math.asin(half)
    return Innovation(
        alpha, S, R, nis, chi2, distance, angle, weight, correlated_share, rms_m, dof, free
    )


def dof_of_sum(dof: float, part: Array, total: Array) -> float:
    """Degrees of freedom of a covariance of which a part is an estimate and the rest is known
    (Welch, Satterthwaite).

    With B = total^-1 part they are dof p (p + 1) / (tr B^2 + (tr B)^2), by Nel and van der Merwe
    (1986), for p = 6.

    Args:
        dof: degrees of freedom of the part, inf if it is known.
        part: (6, 6) the estimated part.
        total: (6, 6) the sum.
    """
    if not math.isfinite(dof):
        return dof
    return dof * 42.0 / max(_motion.squared_traces(part, total), 1e-9)


def as_chi2(square: float, dof: float) -> float:
    """Hotelling's T^2 of six variables, with an estimated covariance, as chi-square with 6 degrees
    of freedom.

    Args:
        square: T^2 >= 0.
        dof: degrees of freedom of the covariance, above 3; inf if it is known.

    Returns:
        (dof - 3) log(1 + T^2 / dof), Bartlett's approximation. At dof = 40, 0.95e-4 exceed the
        99.99 % point.
    """
    return (dof - 3.0) * math.log1p(square / dof) if math.isfinite(dof) else square


def from_chi2(value: float, dof: float) -> float:
    """The inverse of ``as_chi2``: the limit on T^2 for a limit on chi-square.

    Args:
        value: of chi-square with 6 degrees of freedom.
        dof: degrees of freedom of the covariance, above 3; inf if it is known.
    """
    return dof * math.expm1(value / (dof - 3.0)) if math.isfinite(dof) else value


def gate_of(dof: float, part: Array, total: Array) -> float:
    """The 99.99 % point of T^2 in the metric of a sum of which a part is an estimate
    (``dof_of_sum``).
    """
    return from_chi2(GATE, dof_of_sum(dof, part, total))


def _repaired(S: Array, R: Array) -> Array:
    """R plus the positive part of S - R, where rounding of a very large P has made S indefinite."""
    scale = np.sqrt(np.abs(np.diagonal(S)) + np.diagonal(R))
    values, axes = np.linalg.eigh((S - R) / np.outer(scale, scale))
    half = axes * np.sqrt(np.maximum(values, _LEAST_REPAIRED_EIGENVALUE)) * scale[:, None]
    return np.asarray(half @ half.T + R)


def gain(P: Array, H: Array, S: Array) -> Array:
    """The unconstrained gain K^u (20, 6) = P H' S^-1, solved."""
    return np.asarray(np.linalg.solve(S, H @ P).T, dtype=np.float64)


def update_noise(innovation: Innovation, inflation: Array) -> Array:
    """The noise (6, 6) with which an update weights a pose: R of a single scan, widened.

    ``inflation`` (2,) multiplies the variances of attitude and position: correlated errors carry
    less information than white ones. The Cauchy weight of an outlier divides both. S of the
    innovation itself is not widened.
    """
    return scaled_R(innovation.R, np.sqrt(inflation / innovation.weight))


def constrained_update(
    prior: Belief, H: Array, innovation: Innovation, margin: float, inflation: Array
) -> tuple[Belief, int]:
    """Posterior of a healthy epoch (gamma 1) by the paper's gain, and how many sigma bounds acted.

    ``inflation`` (2,) of attitude and position is that of ``update_noise``.
    """
    R = update_noise(innovation, inflation)
    K = gain(prior.P, H, innovation.S + (R - innovation.R))
    betas, hits = sigma_bounds(prior.x.sigma, K[SIGMA] @ innovation.alpha, margin)
    if hits:
        K[12] *= betas[0]
        K[13] *= betas[1]
    P = joseph(prior.P, H, K, R)
    return Belief(prior.t_ns, boxplus(prior.x, K @ innovation.alpha), 0.5 * (P + P.T)), hits


def sigma_bounds(sigma: Array, step: Array, margin: float) -> tuple[tuple[float, float], int]:
    """(beta1, beta2) and how many bounds acted, for the step d_i = k_i' e from the prior sigma (2,)
    (eq:sigma_bounds).

    Where |sigma_i + d_i| > 1 - m, beta_i puts the posterior on the bound: (sgn(sigma_i + d_i)(1 -
    m) - sigma_i) / d_i.
    """
    betas = [_beta(s, d, 1.0 - margin) for s, d in zip(sigma.tolist(), step.tolist(), strict=True)]
    return (betas[0], betas[1]), sum(beta != 1.0 for beta in betas)


def _beta(sigma: float, d: float, bound: float) -> float:
    free = sigma + d
    return 1.0 if abs(free) <= bound or d == 0.0 else (math.copysign(bound, free) - sigma) / d


def chart_update(prior: Belief, H: Array, innovation: Innovation, inflation: Array) -> Belief:
    """The same update with the state displaced through the chart, where inertia has no bounds and
    beta is not needed.

    Gain, Joseph's form and the displacement of mean and P by the chart's Jacobians are one call of
    the extension.
    """
    x, alpha, S, R = prior.x, innovation.alpha, innovation.S, innovation.R
    noise = update_noise(innovation, inflation)
    mean, P = _motion.correct(x.flat, prior.P, H, alpha, S, R, noise)
    then = Belief(prior.t_ns, State.of(mean), P)
    if not isinstance(prior, DrivenBelief):
        return then
    return corrected(prior, then, H, S + noise - R, alpha)


def joseph(P: Array, H: Array, K: Array, R: Array) -> Array:
    """(I - KH) P (I - KH)' + K R K', the posterior covariance under any gain."""
    L = -K @ H
    L.flat[::21] += 1.0
    out: Array = L @ P @ L.T + K @ R @ K.T
    return out


_MOTION = 12
_THREE = {"sigma": slice(12, 15), "varrho": slice(15, 18), "mu": slice(18, 21)}
BLOCKS_OF: Mapping[str, Mapping[str, slice]] = MappingProxyType(
    {
        "two": BLOCKS,
        "three": MappingProxyType(
            {name: _THREE.get(name, where) for name, where in BLOCKS.items()}
        ),
        "known": MappingProxyType(
            {name: where for name, where in BLOCKS.items() if where.stop <= _MOTION}
        ),
    }
)


def step_of_sets(x: State, h: float) -> tuple[State, dict[str, tuple[Array, Array]]]:
    """The state h seconds later, and Phi (n, n) and H (6, n) of each set over that step."""
    moved = flow(x.w_b, x.sigma, h)
    then = advance(x, moved, h)
    Phi, H = transition(moved, x.sigma, h), measurement_jacobian(then)
    wide = np.eye(DIM + 1)
    wide[:_MOTION, :_MOTION] = Phi[:_MOTION, :_MOTION]
    wide[:6, _THREE["sigma"]] = moved.S[:, 6:]
    H_wide = np.insert(H, SIGMA.stop, 0.0, axis=1)
    return then, {
        "two": (Phi, H),
        "three": (wide, H_wide),
        "known": (Phi[:_MOTION, :_MOTION], H[:, :_MOTION]),
    }


def prior_1s(one_sigma: Array, sigma: Array) -> dict[str, Array]:
    """Prior standard deviations (n,) of each set from the 20; that of sigma3 follows from
    sigma1 and sigma2.
    """
    third = np.sqrt(np.sum((sigma_join(sigma)[2] * one_sigma[SIGMA]) ** 2))
    return {
        "two": one_sigma,
        "three": np.insert(one_sigma, SIGMA.stop, third),
        "known": one_sigma[:_MOTION],
    }
