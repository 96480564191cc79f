"""The free motion of a rigid body that the poses of the scans follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.estimate.batch import Problem
from avsreplay.estimate.chart import Chart, to_errors
from avsreplay.estimate.dynamics import propagate_state
from avsreplay.estimate.initialise import PoseFix, poses_of, weak_prior
from avsreplay.estimate.params import EstimatorParams
from avsreplay.estimate.reference import reference_fit
from avsreplay.geometry import Array, Pose
from avsreplay.reconstruct.views import Twist
from avsreplay.records import BLOCKS, State

MOTION_POSES = 8  # fewest poses to which free motion is fitted
MOTION_SHARE = 0.7  # share of the poses that must agree with it
MOTION_RMS = 0.01  # largest deviation of these on the surface, as a share of the extent


@dataclass(frozen=True, slots=True, eq=False)
class FreeMotion:
    """One torque-free and force-free motion of a rigid body through poses.

    Attributes:
        state: state at the instant ``epoch_ns``, and covariance (20, 20) of its error states.
        agrees: (n,) whether each pose agrees with the motion.
        rms: of the deviations of the poses that agree: angle [rad] and distance [m].
    """

    state: State
    P: Array
    epoch_ns: int
    agrees: NDArray[np.bool_]
    rms: tuple[float, float]

    def state_at(self, t_ns: int) -> State:
        """The state at an instant."""
        return propagate_state(self.state, (t_ns - self.epoch_ns) * 1e-9)[0]

    def at(self, t_ns: int) -> Pose:
        """The pose T_ac at an instant."""
        return self.state_at(t_ns).T_ac

    def pose_jacobian(
        self, chart: Chart, t_ns: Sequence[int], poses: Sequence[Pose], extent: float
    ) -> tuple[Array, Array]:
        """Derivatives of poses of the motion by its initial values, and the information of the weak prior of these.

        Args:
            chart: initial values at ``epoch_ns``.
            t_ns: instants (n).
            poses: T_ac of the motion at these instants.
            extent: of the target [m].

        Returns:
            (6n, 20) derivative of [theta; v] in {C} [rad, m] by steps of the chart, and (20, 20) information.
        """
        fixes = tuple(PoseFix(at, T, np.eye(6)) for at, T in zip(t_ns, poses, strict=True))
        measured = poses_of(fixes, self.epoch_ns)
        prior = weak_prior(measured, EstimatorParams().resolved(extent))
        _, H = Problem(measured, prior, np.ones(2), chart).core.rows()
        J: Array = (H @ to_errors(chart)).reshape(-1, H.shape[2])
        return J, np.diag(prior.one_sigma**-2.0)

    def twist_at(self, t_ns: int) -> Twist:
        """Pose, rate in {C} and velocity of {C} in {A} at an instant."""
        x = self.state_at(t_ns)
        return Twist(x.T_ac, geometry.matrix(x.q_bc).T @ x.w_b, x.fixture_velocity)

    @property
    def mass_centre_c(self) -> tuple[Array, float]:
        """Position (3,) of the mass centre in {C} [m] and its 1 sigma, the root of the trace [m]."""
        spread = float(np.sqrt(np.trace(self.P[BLOCKS["varrho"], BLOCKS["varrho"]])))
        return -geometry.matrix(self.state.q_bc).T @ self.state.c_b, spread


def free_motion(t_ns: Sequence[int], poses: Sequence[Pose], extent: float) -> FreeMotion | None:
    """Fit the free motion of a rigid body to poses.

    Args:
        t_ns: instants, ascending.
        poses: T_ac at these instants.
        extent: of the target [m].

    Returns:
        The motion, or None if the poses are too few or do not follow one: at least MOTION_SHARE of them must agree, and
        those must deviate by less than MOTION_RMS of the extent on the surface. A turntable that is turned by hand, or
        scans without real instants, do not.
    """
    if len(poses) < MOTION_POSES or np.diff(t_ns).min() <= 0:
        return None
    fitted = reference_fit(t_ns, poses, None, extent).fitted
    agrees = np.asarray(fitted.weights > 0.5)
    if agrees.mean() < MOTION_SHARE:
        return None
    squares = np.square(fitted.d[agrees])
    angle, distance = (float(np.sqrt(squares[:, k].sum(axis=1).mean())) for k in (slice(0, 3), slice(3, 6)))
    if not np.hypot(0.5 * extent * angle, distance) < MOTION_RMS * extent:
        return None
    return FreeMotion(fitted.x, fitted.P, t_ns[0], agrees, (angle, distance))


def twists(t_ns: Sequence[int], poses: dict[int, Pose], motion: FreeMotion | None) -> dict[int, Twist]:
    """Motion of the target at every view that has a pose: of the free motion, else from its neighbours' poses."""
    known = sorted(poses)
    found = {}
    for place, k in enumerate(known):
        if motion is not None:
            found[k] = motion.twist_at(t_ns[k])
            continue
        a, b = known[max(place - 1, 0)], known[min(place + 1, len(known) - 1)]
        span = max((t_ns[b] - t_ns[a]) * 1e-9, 1e-9)
        w_c = geometry.log(geometry.multiply(geometry.conjugate(poses[a].q), poses[b].q)) / span
        found[k] = Twist(poses[k], w_c, (poses[b].t - poses[a].t) / span)
    return found
