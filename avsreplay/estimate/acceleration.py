"""A constant acceleration of the centre of mass in {A} (gravity, thrust): known, or fitted to
measured poses.

Known. The estimator works in a frame that falls with the target (``frame.py``), in which the motion
is free.

Fitted. With measured attitudes R_k the position of the origin of {C} is linear in the unknowns,

    t_k = c0 + v tau_k + a tau_k^2 / 2 + R_k arm,

with arm the vector from the centre of mass to that origin, in {C}. Generalised least squares give a
and its covariance (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, section 3.4). The errors of the attitudes enter the noise of the equations, times
the arm. They also bias the arm towards zero, which is neglected: this is right if their part is not
larger than the noise of the positions. The fit grows pose by pose and ends before the first poses
that contradict it, so that an impact after a free flight has no effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from avsreplay.errors import UsageError, value_class
from avsreplay.estimate.params import EstimatorParams
from avsreplay.estimate.reference import r0_covariance
from avsreplay.geometry import Array, Pose
from avsreplay.records import UNLIKELY, Alignment, Trajectory
from avsreplay.settings import given

_FEWEST_POSES = 8  # poses of the first fit; the noise is estimated from its residuals
_CONFIRM = 3  # successive poses that contradict the fit end it
# the gate is wider with few degrees of freedom of the noise, as the F distribution is
_GATE_WIDENING = 12.0
# 1 sigma of the prior of all but the arm, in lengths of the arm over the duration of the poses
_UNKNOWN = 1e3
_FIT_PASSES = 4


def accelerated(free: Trajectory, acceleration: Array) -> Trajectory:
    """Return a free trajectory with a constant acceleration (3,) [m/s2] in {A} added from its
    beginning.
    """

    def at(times: Array) -> tuple[Array, Array]:
        position, velocity = free(times)
        tau = np.asarray(times, dtype=np.float64)[:, None]
        return position + 0.5 * tau * tau * acceleration, velocity + tau * acceleration

    return at


@value_class
class AccelerationFit:
    """A fitted acceleration.

    Attributes:
        mean: (3,) in {A} [m/s2].
        P: (3, 3) its covariance.
        poses: number of poses from the first on.
        span_s: their duration [s].
        noise: factor on the stated standard deviations of the positions, estimated from the
            residuals.
    """

    mean: Array
    P: Array
    poses: int
    span_s: float
    noise: float

    def record(self) -> dict[str, Any]:
        """Plain values for JSON."""
        sigma = np.sqrt(np.diagonal(self.P)).tolist()
        values = {
            "mean_mps2": self.mean.tolist(),
            "one_sigma_mps2": sigma,
            "covariance": self.P.tolist(),
        }
        return {**values, "poses": self.poses, "span_s": self.span_s, "noise_factor": self.noise}

    @property
    def text(self) -> str:
        """Value with 1 sigma and the data it comes from, in words."""
        values = ", ".join(f"{v:.4g}" for v in self.mean)
        sigma = ", ".join(f"{v:.2g}" for v in np.sqrt(np.diagonal(self.P)))
        return (
            f"({values}) m/s2, 1 sigma ({sigma}), fitted to the first {self.poses} poses"
            f" ({self.span_s:.3g} s)"
        )


def acceleration_text(params: EstimatorParams, fitted: AccelerationFit | None) -> str | None:
    """Return the acceleration in words; None where there is none.

    Args:
        params: of the estimator.
        fitted: the fit that gave it, None where it is given.
    """
    known = params.acceleration_mps2
    if fitted is not None:
        return fitted.text
    return "({:.4g}, {:.4g}, {:.4g}) m/s2, given".format(*known) if any(known) else None


def fit_acceleration(
    measured: Sequence[tuple[int, Alignment]], params: EstimatorParams
) -> AccelerationFit:
    """Fit a constant acceleration to the first poses of a free motion.

    Args:
        measured: instants [ns], ascending, with their poses; R0 applies to a pose without
            covariance.
        params: of the estimator, with auto values resolved.

    Returns:
        The acceleration over the first poses up to a contradiction.

    Raises:
        UsageError: fewer than eight poses.
    """
    measured = [(t_ns, found) for t_ns, found in measured if found.measured]
    if len(measured) < _FEWEST_POSES:
        what = f"only {len(measured)} poses to fit an acceleration to"
        raise UsageError(
            what,
            where="estimator.fit_acceleration",
            hint=f"{_FEWEST_POSES} poses at least are needed",
        )
    times = np.array([(t_ns - measured[0][0]) * 1e-9 for t_ns, _ in measured])
    poses = [found.T_ac for _, found in measured]
    covariances = [
        r0_covariance(params) if found.covariance is None else found.covariance
        for _, found in measured
    ]
    arm_1s_m = given(params.start_varrho_1s_m)
    count = _consistent(times, poses, covariances, arm_1s_m)
    mean, P, noise = _System(times[:count], poses[:count], covariances[:count], arm_1s_m).solved()
    return AccelerationFit(mean[6:9], P[6:9, 6:9], count, float(times[count - 1]), noise)


def _consistent(
    times: Array, poses: Sequence[Pose], covariances: Sequence[Array], arm_1s_m: float
) -> int:
    """How many poses from the first on agree with one acceleration: sequential least squares
    with a gate.
    """
    first = _System(
        times[:_FEWEST_POSES], poses[:_FEWEST_POSES], covariances[:_FEWEST_POSES], arm_1s_m
    )
    mean, P, noise = first.solved()
    square, freedom = noise**2 * first.freedom, first.freedom
    outside = 0
    for k in range(_FEWEST_POSES, len(poses)):
        H, C = (
            _row(times[k] - times[0], poses[k]),
            _position_noise(poses[k], covariances[k], mean[9:]),
        )
        scale = square / freedom
        error = poses[k].t - H @ mean
        S = H @ P @ H.T + scale * C
        nis = float(error @ np.linalg.solve(S, error))
        outside = outside + 1 if nis > UNLIKELY[3] * (1.0 + _GATE_WIDENING / freedom) else 0
        if outside == _CONFIRM:
            return k + 1 - _CONFIRM
        if outside:
            continue
        gain = np.linalg.solve(S, H @ P).T
        mean, P = mean + gain @ error, P - gain @ H @ P
        square, freedom = square + scale * nis, freedom + 3.0
    return len(poses) - outside


class _System:
    """The linear equations of some poses, with a prior that leaves all but the arm free."""

    def __init__(
        self, times: Array, poses: Sequence[Pose], covariances: Sequence[Array], arm_1s_m: float
    ) -> None:
        self.t0, span = times[0], float(times[-1] - times[0])
        self.poses, self.covariances = poses, covariances
        self.H = np.array([_row(t - self.t0, pose) for t, pose in zip(times, poses, strict=True)])
        self.centre = poses[0].t  # reduces cancellation; added to c0 again
        wide = _UNKNOWN * arm_1s_m
        widths = [wide, wide / span, wide / span**2, arm_1s_m]
        self.prior = np.repeat(widths, 3) ** -2.0
        self.freedom = max(3.0 * len(poses) - 12.0, 3.0)

    def solved(self) -> tuple[Array, Array, float]:
        """Unknowns (12,), covariance (12, 12), and the factor on the stated noise by the
        residuals.
        """
        y = np.array([pose.t for pose in self.poses]) - self.centre
        mean, scale = np.zeros(12), 1.0
        for _ in range(_FIT_PASSES):  # the effect of the attitude's noise depends on the arm
            C = [
                _position_noise(p, c, mean[9:])
                for p, c in zip(self.poses, self.covariances, strict=True)
            ]
            W = np.linalg.inv(np.array(C))
            info = np.einsum("nij,nik,nkl->jl", self.H, W, self.H) / scale + np.diag(self.prior)
            P = np.linalg.inv(info)
            mean = P @ np.einsum("nij,nik,nk->j", self.H, W, y) / scale
            left = y - self.H @ mean
            scale = max(float(np.einsum("ni,nij,nj->", left, W, left)) / self.freedom, 1e-12)
        mean[:3] += self.centre
        return mean, 0.5 * (P + P.T), float(np.sqrt(scale))


def _row(tau: float, pose: Pose) -> Array:
    """(3, 12) derivative of a position with respect to (c0, v, a, arm)."""
    return np.hstack([np.eye(3), tau * np.eye(3), 0.5 * tau * tau * np.eye(3), pose.R])


def _position_noise(pose: Pose, C: Array, arm: Array) -> Array:
    """(3, 3) noise of t - R arm in {A}: with d = [theta; v], R (v - theta x arm)."""
    J = np.hstack(
        [np.array([[0, -arm[2], arm[1]], [arm[2], 0, -arm[0]], [-arm[1], arm[0], 0]]), np.eye(3)]
    )
    N = pose.R @ J @ C @ J.T @ pose.R.T
    return np.asarray(0.5 * (N + N.T))
