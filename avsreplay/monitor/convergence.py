"""When the estimate may be relied on: t_1, by the covariance's blocks or by the grasp point's predicted 1 sigma.

``covariance`` is the paper's test: every parameter and motion block below its limit. ``predictive`` asks for
what the capture needs: position, velocity and attitude of the grasp point over the planner's horizon; a body whose
parameters can never be told apart may still pass. Either must hold for the dwell, and only while the
innovations are consistent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from avsreplay.geometry import Array
from avsreplay.records import BLOCKS, Belief, Forecast

__all__ = ["Convergence", "ConvergenceParams", "ConvergenceTrack", "Criterion", "block_1s"]


class Criterion(Enum):
    """Which test decides."""

    COVARIANCE = "covariance"
    PREDICTIVE = "predictive"


@dataclass(frozen=True, slots=True)
class ConvergenceParams:
    """Limits on 1 sigma, each the root of the block's trace, and how long they must hold."""

    # which test decides
    criterion: Criterion = Criterion.PREDICTIVE
    # how long the test must hold without a break [s]
    dwell_s: float = 2.0
    # predictive: how far ahead the grasp point is predicted [s]
    horizon_s: float = 30.0
    # predictive: instants over the horizon
    horizon_steps: int = 6
    # predictive: position of the grasp point [m]; auto: 0.01 of the extent
    grasp_pos_m: float | None = None
    # predictive: its velocity [m/s]; auto: 0.002 of the extent per second
    grasp_vel_mps: float | None = None
    # predictive: its attitude [deg]
    grasp_rot_deg: float = 3.0
    # covariance: attitude of {B} [deg]
    attitude_deg: float = 3.0
    # covariance: angular rate [rad/s]
    rate_radps: float = 0.003
    # covariance: centre of mass [m]; auto: 0.01 of the extent
    position_m: float | None = None
    # covariance: its velocity [m/s]; auto: 0.001 of the extent per second
    velocity_mps: float | None = None
    # covariance: the two inertia ratios
    sigma: float = 0.05
    # covariance: fixture in {B} [m]; auto: 0.01 of the extent
    varrho_m: float | None = None
    # covariance: misalignment of the fixture [deg]
    mu_deg: float = 3.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if isinstance(value, (int, float)) and not 0.0 <= value < math.inf:
                raise ValueError(f"{name} is {value}, must be finite and not negative")
        if self.horizon_steps < 1:
            raise ValueError(f"horizon_steps is {self.horizon_steps}, must be 1 at least")

    def resolved(self, extent_m: float) -> ConvergenceParams:
        """The same with every auto value filled in from the target's extent [m]."""
        if not 0.0 < extent_m < math.inf:
            raise ValueError(f"extent_m is {extent_m}, must be positive and finite")
        fractions = {"grasp_pos_m": 0.01, "grasp_vel_mps": 0.002, "position_m": 0.01, "velocity_mps": 0.001}
        fractions["varrho_m"] = 0.01
        filled: dict[str, Any] = {
            k: f * extent_m if getattr(self, k) is None else getattr(self, k) for k, f in fractions.items()
        }
        return replace(self, **filled)

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
            "position": _given(self.position_m),
            "velocity": _given(self.velocity_mps),
            "sigma": self.sigma,
            "varrho": _given(self.varrho_m),
            "mu": half * self.mu_deg,
        }


def _given(value: float | None) -> float:
    if value is None:
        raise ValueError("auto value not filled in: call resolved(extent_m) first")
    return value


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
        covariance_holds, predictive_holds: the two tests at this epoch, before the dwell.
        unknown: blocks above their covariance limit.
    """

    converged: bool = False
    t1_ns: int | None = None
    since_ns: int | None = None
    covariance_holds: bool = False
    predictive_holds: bool = False
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
        limits = (_given(p.grasp_pos_m), _given(p.grasp_vel_mps), math.radians(p.grasp_rot_deg))
        seen = (forecast.pos_1s_m, forecast.vel_1s_mps, forecast.rot_1s_rad)
        return all(bool(np.all(values <= limit)) for values, limit in zip(seen, limits, strict=True))
