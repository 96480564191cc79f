"""A plain extended Kalman filter over the 20 error states, as a yardstick and as an example.

Every healthy pose is one update with the covariance that its registration states. There is no
adaptation of the noise, no batch fit, no treatment of correlated errors and no event: what the
program's own estimator gains over this one is what these are worth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avsreplay.estimate.dynamics import grasp_forecast, propagate
from avsreplay.estimate.error_state import boxplus
from avsreplay.estimate.measurement import (
    gain,
    in_camera,
    innovation_vector,
    joseph,
    measurement_jacobian,
    sigma_bounds,
)
from avsreplay.estimate.plugin import Context
from avsreplay.geometry import IDENTITY_QUAT, Array, Pose
from avsreplay.records import Belief, Forecast, State
from avsreplay.settings import Settings, setting

SIGMA_MARGIN = 0.01  # |sigma| stays below 1 minus this margin (eq:sigma_bounds)


@dataclass(frozen=True, slots=True)
class EkfParams(Settings):
    """Parameters of the plain filter."""

    torque_radps15: float = setting(
        1e-5,
        "Root density of the angular acceleration; above 0 it keeps the covariance from vanishing.",
        unit="rad/s^1.5",
        low=0.0,
        high=1e6,
    )
    force_mps15: float | None = setting(
        None,
        "Root density of the acceleration.",
        unit="m/s^1.5",
        low=0.0,
        high=1e6,
        of_extent=1e-5,
    )


class Ekf:
    """The error-state filter: propagate, then correct with the gain K = P H' S^-1.

    Args:
        context: extent, start and standard deviations of the run.
    """

    name = "ekf"
    parameters = EkfParams
    about = "extended Kalman filter with the covariance of the registration, without adaptation"

    def __init__(self, context: Context) -> None:
        self._context = context
        given = context.own if isinstance(context.own, EkfParams) else EkfParams()
        own = given.resolved(context.extent_m)
        self._drives = own.torque_radps15, float(own.force_mps15 or 0.0)

    def start(self, t_ns: int, T_ac: Pose) -> Belief:
        """The given belief, else a body at rest at the pose with the standard deviations of the
        settings.
        """
        if self._context.start is not None:
            return self._context.start
        zero = np.zeros(3)
        x = State(T_ac.q, zero, T_ac.t, zero, np.zeros(2), zero, IDENTITY_QUAT)
        return Belief(t_ns, x, np.diag(self._context.start_1s**2))

    def predict(self, state: Belief, t_ns: int) -> Belief:
        """The belief at another instant (eq:state-prop, eq:cov-prop)."""
        return propagate(state, t_ns, *self._drives)[0]

    def update(self, state: Belief, T_ac: Pose, C: Array) -> Belief:
        """The posterior of one pose; sigma stays within its bounds."""
        x = state.x
        H, R, alpha = (
            measurement_jacobian(x),
            in_camera(C, T_ac.q, x.q_bc),
            innovation_vector(x, T_ac),
        )
        K = gain(state.P, H, H @ state.P @ H.T + R)
        betas, _ = sigma_bounds(x.sigma, K[12:14] @ alpha, SIGMA_MARGIN)
        K[12:14] *= np.array(betas)[:, None]
        P = joseph(state.P, H, K, R)
        return Belief(state.t_ns, boxplus(x, K @ alpha), 0.5 * (P + P.T))

    def forecast(self, state: Belief, times_s: Array) -> Forecast:
        """The predicted 1 sigma of the grasp point."""
        return grasp_forecast(state, times_s, *self._drives)

    def belief(self, state: Belief) -> Belief:
        """The state itself."""
        return state
