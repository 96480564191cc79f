"""When the estimate may be relied on: t_1, by the covariance's blocks or by the grasp point's predicted 1 sigma.

``covariance`` is the paper's test: every parameter and motion block below its limit. ``predictive`` asks for
what the capture needs: position, velocity and attitude of the grasp point over the planner's horizon; a body whose
parameters can never be told apart may still pass. Either must hold for the dwell, and only while the
innovations are consistent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from avsreplay.geometry import Array
from avsreplay.records import BLOCKS, Belief, Forecast
from avsreplay.settings import Settings, given, setting

__all__ = ["Convergence", "ConvergenceParams", "ConvergenceTrack", "Criterion", "block_1s"]


class Criterion(Enum):
    """Which test decides."""

    COVARIANCE = "covariance"
    PREDICTIVE = "predictive"


@dataclass(frozen=True, slots=True)
class ConvergenceParams(Settings):
    """Limits on the 1 sigma of each block (root of its trace), and how long they must hold."""

    criterion: Criterion = setting(
        Criterion.PREDICTIVE,
        "Test that decides: the covariance of every block, as in the paper (covariance), or the predicted 1 sigma of"
        " the grasp point over the horizon (predictive).",
    )
    dwell_s: float = setting(2.0, "Time for which the test must hold without interruption.", unit="s", low=0.0)
    horizon_s: float = setting(30.0, "predictive: How far ahead the grasp point is predicted.", unit="s", low=0.0)
    horizon_steps: int = setting(6, "predictive: Number of instants over the horizon.", low=1)
    grasp_pos_m: float | None = setting(
        None, "predictive: Limit on the grasp point's position.", unit="m", low=0.0, of_extent=0.01
    )
    grasp_vel_mps: float | None = setting(
        None, "predictive: Limit on the grasp point's velocity.", unit="m/s", low=0.0, of_extent=0.002
    )
    grasp_rot_deg: float = setting(3.0, "predictive: Limit on the grasp point's attitude.", unit="deg", low=0.0)
    attitude_deg: float = setting(3.0, "covariance: Limit on the attitude of {B}.", unit="deg", low=0.0)
    rate_radps: float = setting(0.003, "covariance: Limit on the angular rate.", unit="rad/s", low=0.0)
    position_m: float | None = setting(
        None, "covariance: Limit on the position of the mass centre.", unit="m", low=0.0, of_extent=0.01
    )
    velocity_mps: float | None = setting(
        None, "covariance: Limit on the velocity of the mass centre.", unit="m/s", low=0.0, of_extent=0.001
    )
    sigma: float = setting(0.05, "covariance: Limit on the two inertia ratios.", low=0.0)
    varrho_m: float | None = setting(
        None, "covariance: Limit on the fixture's position in {B}.", unit="m", low=0.0, of_extent=0.01
    )
    mu_deg: float = setting(3.0, "covariance: Limit on the misalignment of the fixture.", unit="deg", low=0.0)

    @property
    def times_s(self) -> Array:
        """Instants (n,) after now at which the grasp point is predicted, ascending to the horizon [s]."""
        return np.linspace(0.0, self.horizon_s, self.horizon_steps + 1)[1:]

    @property
    def block_limits(self) -> dict[str, float]:
        """Limit of each block in the covariance's own units (half angles); auto values must be filled in."""
        half = math.radians(0.5)
        return {
            "attitude": half * self.attitude_deg,
            "rate": self.rate_radps,
            "position": given(self.position_m),
            "velocity": given(self.velocity_mps),
            "sigma": self.sigma,
            "varrho": given(self.varrho_m),
            "mu": half * self.mu_deg,
        }


def block_1s(P: Array) -> dict[str, float]:
    """Root of the trace of each block of P (20, 20), in its own units (half angles)."""
    variances = np.diagonal(P)
    return {name: float(np.sqrt(np.maximum(variances[where].sum(), 0.0))) for name, where in BLOCKS.items()}


@dataclass(frozen=True, slots=True)
class ConvergenceTrack:
    """The fold's state.

    Attributes:
        converged: may the planner rely on the estimate now.  t1_ns: the epoch from which it first held, None before.
        since_ns: start of the present unbroken stretch, None outside one.
        covariance_converged, predictive_converged: the two tests at this epoch, before the dwell.
        unknown: blocks above their covariance limit.
    """

    converged: bool = False
    t1_ns: int | None = None
    since_ns: int | None = None
    covariance_converged: bool = False
    predictive_converged: bool = False
    unknown: tuple[str, ...] = ()


class Convergence:
    """Decides t_1.

    Args:
        params: limits; those left out are taken from ``extent_m``, the target's bounding diagonal [m].
    """

    def __init__(self, params: ConvergenceParams, extent_m: float) -> None:
        self.params = params.resolved(extent_m)
        self._limits = self.params.block_limits

    def initial(self) -> ConvergenceTrack:
        """Nothing has held yet."""
        return ConvergenceTrack()

    def judge(
        self, track: ConvergenceTrack, belief: Belief, forecast: Forecast | None = None, consistent: bool = True
    ) -> ConvergenceTrack:
        """One epoch on. A belief that is not ``consistent`` is not converged, however small its covariance."""
        spread = block_1s(belief.P)
        unknown = tuple(name for name, limit in self._limits.items() if not spread[name] <= limit)
        predictive = forecast is not None and self._predicted(forecast)
        holds = predictive if self.params.criterion is Criterion.PREDICTIVE else not unknown
        if not (holds and consistent):
            return ConvergenceTrack(False, track.t1_ns, None, not unknown, predictive, unknown)
        since = belief.t_ns if track.since_ns is None else track.since_ns
        converged = (belief.t_ns - since) * 1e-9 >= self.params.dwell_s
        t1 = since if converged and track.t1_ns is None else track.t1_ns
        return ConvergenceTrack(converged, t1, since, not unknown, predictive, unknown)

    def _predicted(self, forecast: Forecast) -> bool:
        p = self.params
        limits = (given(p.grasp_pos_m), given(p.grasp_vel_mps), math.radians(p.grasp_rot_deg))
        seen = (forecast.pos_1s_m, forecast.vel_1s_mps, forecast.rot_1s_rad)
        return all(bool(np.all(values <= limit)) for values, limit in zip(seen, limits, strict=True))
