"""What the estimator may be told. Lengths left out are fractions of the target's extent, so that any size runs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from avsreplay.geometry import Array

__all__ = ["Adaptation", "Constraint", "EstimatorParams", "NoiseSource", "Start"]

_MOST_ALIKE = 50.0  # scans: a view that does not turn would never say anything new
_EDGE_LEAN = 20.0  # by tests/benchmarks/estimate_noise.py: 9 to 33 on five meshes
_POSITIVE = (
    "torque_noise_radps15",
    "force_noise_mps15",
    "r0_pos_m",
    "r0_rot_deg",
    "r_floor",
    "start_pos_1s_m",
    "start_rot_1s_deg",
    "start_rate_1s_radps",
    "start_vel_1s_mps",
    "start_sigma_1s",
    "start_log_inertia_1s",
    "start_varrho_1s_m",
    "start_mu_1s_deg",
)


class NoiseSource(Enum):
    """What the base of R is."""

    REGISTRATION = "registration"  # the alignment's own covariance, R0 where it has none
    R0 = "r0"


class Start(Enum):
    """Where the first belief comes from."""

    AUTO = "auto"  # near where the log or the caller gives one, else cold
    NEAR = "near"  # the given belief
    COLD = "cold"  # rate from the first poses, then the fit over all of them
    PAPER = "paper"  # the plain filter from zero, everything wide


class Constraint(Enum):
    """What keeps sigma inside its bounds, and where the filter begins from a given belief."""

    CHART = "chart"  # coordinates that have no bounds; a fit with the given belief as its prior comes first
    GAIN = "gain"  # the paper's beta on the gain; the filter begins at once


class Adaptation(Enum):
    """What residuals do to R."""

    SCALE = "scale"  # a factor for position and one for attitude
    MATRIX = "matrix"  # the paper's whole matrix, from R0
    OFF = "off"


@dataclass(frozen=True, slots=True)
class EstimatorParams:
    """Noise, adaptation and start of the filter."""

    # root density of the angular disturbance eps_tau [rad/s^1.5]
    torque_noise_radps15: float = 1e-6
    # root density of the linear disturbance eps_f [m/s^1.5]; auto: 1e-6 of the extent
    force_noise_mps15: float | None = None
    # what the measurement noise is taken from: the registration's covariance, or the fixed R0
    noise: NoiseSource = NoiseSource.REGISTRATION
    # how residuals change it: two factors, the paper's whole matrix (over R0), or not at all
    adapt: Adaptation = Adaptation.SCALE
    # healthy epochs in the noise window
    window: int = 30
    # R0: 1 sigma of the measured position [m]; auto: 0.002 of the extent
    r0_pos_m: float | None = None
    # R0: 1 sigma of the measured attitude about each axis [deg]
    r0_rot_deg: float = 0.5
    # least eigenvalue of R in units of R0
    r_floor: float = 1e-6
    # what keeps sigma inside its bounds: coordinates without bounds (chart), or the paper's beta, until a fit speaks
    constraint: Constraint = Constraint.CHART
    # gain: |sigma| stays below 1 minus this
    sigma_margin: float = 0.01
    # share of a registration's error that stays while the view turns little, its variance over the whole; auto: by its
    # inliers and their rms, as points near edges lean one way (docs/estimation.md, Noise)
    correlated_share: float | None = None
    # how far the view turns until that share has changed [rad]
    correlated_rad: float = 0.4
    # how it begins: a given belief (near), the fit (cold), the paper's filter from zero (paper); auto: near where given
    start: Start = Start.AUTO
    # until a fit's likelihood is normal it is repeated when the healthy poses have grown by this share
    refit_growth: float = 0.05
    # how many healthy poses the filter is set against a fit to them; 0: never
    audit_poses: int = 1000
    # give a healthy pose less say the further its NIS is beyond the 99.99 % point; the paper's start never does
    robust: bool = True
    # 1 sigma of the pose that is handed in before any scan [m]; auto: 0.05 of the extent
    start_pos_1s_m: float | None = None
    # the same, attitude about each axis [deg]
    start_rot_1s_deg: float = 10.0
    # 1 sigma of the unknown rate about each axis [rad/s]
    start_rate_1s_radps: float = 0.5
    # 1 sigma of the unknown velocity [m/s]; auto: 0.05 of the extent per second
    start_vel_1s_mps: float | None = None
    # paper: 1 sigma of each unknown inertia ratio
    start_sigma_1s: float = 0.5
    # cold: 1 sigma of each of the five numbers of the logarithm of the mass moments
    start_log_inertia_1s: float = 1.0
    # 1 sigma of the unknown fixture position in {B} [m]; auto: 0.25 of the extent
    start_varrho_1s_m: float | None = None
    # paper: 1 sigma of the unknown misalignment about each axis [deg]
    start_mu_1s_deg: float = 20.0

    def __post_init__(self) -> None:
        for name in _POSITIVE:
            value = getattr(self, name)
            if value is not None and not (0.0 < value < math.inf):
                raise ValueError(f"{name} is {value}, must be positive and finite")
        if not 0.0 < self.sigma_margin < 0.5:
            raise ValueError(f"sigma_margin is {self.sigma_margin}, must be in (0, 0.5)")
        if not (0.0 <= (self.correlated_share or 0.0) <= 1.0 and 0.0 <= self.correlated_rad < math.inf):
            raise ValueError(f"correlated_share is {self.correlated_share}, correlated_rad is {self.correlated_rad}")
        if self.audit_poses < 0:
            raise ValueError(f"audit_poses is {self.audit_poses}, must not be negative")
        if self.window < 6 or not 0.0 <= self.refit_growth <= 1.0:
            raise ValueError(f"window is {self.window} (6 at least), refit_growth is {self.refit_growth} (0 to 1)")

    def resolved(self, extent_m: float) -> EstimatorParams:
        """The same with every auto value filled in from the target's extent [m]."""
        if not 0.0 < extent_m < math.inf:
            raise ValueError(f"extent_m is {extent_m}, must be positive and finite")
        auto: dict[str, Any] = {
            "force_noise_mps15": 1e-6,
            "r0_pos_m": 0.002,
            "start_pos_1s_m": 0.05,
            "start_vel_1s_mps": 0.05,
            "start_varrho_1s_m": 0.25,
        }
        return replace(self, **{k: f * extent_m for k, f in auto.items() if getattr(self, k) is None})

    def share(self, inliers: int, rms_of_extent: float) -> float:
        """Share of a registered pose's variance that its neighbours have in common.

        White error falls with the inliers, the lean of those within the noise of an edge does not: its variance over
        the white one's is K inliers (rms / extent)^2, whatever the target's size.
        """
        if self.correlated_share is not None:
            return self.correlated_share
        lean = _EDGE_LEAN * inliers * rms_of_extent**2
        return lean / (1.0 + lean)

    def colour(self, turn_rad: float, share: float) -> float:
        """How many times less than white ones poses say whose view turns by ``turn_rad`` from one to the next.

        Neighbours have ``share`` of their variance in common over ``correlated_rad``: 1 + 2 sum of correlations.
        """
        scans = self.correlated_rad / max(turn_rad, self.correlated_rad / _MOST_ALIKE)
        return 1.0 + 2.0 * share * scans

    @property
    def R0(self) -> Array:
        """(6, 6) noise for (metres, half angle); auto values must be filled in."""
        return np.diag(np.repeat([_given(self.r0_pos_m), 0.5 * math.radians(self.r0_rot_deg)], 3) ** 2)

    @property
    def by_gain(self) -> bool:
        """Is the filter the paper's, its gain constrained; always so from the paper's start."""
        return self.constraint is Constraint.GAIN or self.start is Start.PAPER

    def length(self, name: str) -> float:
        """An auto length, filled in."""
        return _given(getattr(self, name))

    @property
    def force(self) -> float:
        """Root density of eps_f, filled in."""
        return _given(self.force_noise_mps15)

    @property
    def start_1s(self) -> Array:
        """(20,) standard deviations of a start from a guessed pose alone."""
        half = 0.5 * math.radians(self.start_rot_1s_deg), 0.5 * math.radians(self.start_mu_1s_deg)
        return np.repeat(
            [
                half[0],
                self.start_rate_1s_radps,
                _given(self.start_pos_1s_m),
                _given(self.start_vel_1s_mps),
                self.start_sigma_1s,
                _given(self.start_varrho_1s_m),
                half[1],
            ],
            [3, 3, 3, 3, 2, 3, 3],
        )


def _given(value: float | None) -> float:
    if value is None:
        raise ValueError("auto value not filled in: call resolved(extent_m) first")
    return value
