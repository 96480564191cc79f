"""Settings of the estimator; lengths that are not given scale with the target's extent."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from avsreplay.geometry import Array
from avsreplay.parts import ESTIMATORS, OWN
from avsreplay.settings import Settings, Tables, are_orthonormal, given, setting

__all__ = ["Adaptation", "Constraint", "EstimatorParams", "NoiseSource", "Start"]

# largest motion expected between two poses of a tracker: radian, or part of the extent
_PER_POSE = 0.25


class NoiseSource(Enum):
    """Source of the base of R."""

    REGISTRATION = "registration"  # the alignment's own covariance, R0 where it has none
    R0 = "r0"


class Start(Enum):
    """Source of the first belief."""

    AUTO = "auto"  # near where the log or the caller gives one, else cold
    NEAR = "near"  # the given belief
    COLD = "cold"  # rate from the first poses, then the fit over all of them
    PAPER = "paper"  # the paper's filter from zero with large standard deviations


class Constraint(Enum):
    """How sigma stays inside its bounds, and where the filter begins from a given belief."""

    # coordinates that have no bounds; a fit with the given belief as its prior comes first
    CHART = "chart"
    GAIN = "gain"  # the paper's beta on the gain; the filter begins at once


class Adaptation(Enum):
    """How the residuals adapt R."""

    SCALE = "scale"  # a factor for position and one for attitude
    MATRIX = "matrix"  # the paper's whole matrix, from R0
    OFF = "off"


@dataclass(frozen=True, slots=True)
class EstimatorParams(Settings):
    """Settings of the estimator: noise, adaptation and initialisation."""

    method: str = setting(
        OWN,
        "Estimator: the program's own (own), the filter of the paper (paper), or a plug-in"
        " ('avsreplay estimators' lists them) such as a plain extended Kalman filter (ekf),"
        " which uses the settings of the start and of R0.",
    )
    torque_noise_radps15: float | None = setting(
        None,
        "Root spectral density of the angular acceleration noise eps_tau. With a larger value the"
        " estimate follows disturbances faster and has larger standard deviations.",
        unit="rad/s^1.5",
        low=0.0,
        high=1e6,
        unset="estimated from the residuals of the poses",
    )
    force_noise_mps15: float | None = setting(
        None,
        "Root spectral density of the linear acceleration noise eps_f. With a larger value the"
        " estimate follows disturbances faster and has larger standard deviations.",
        unit="m/s^1.5",
        low=0.0,
        unset="estimated from the residuals of the poses",
    )
    acceleration_mps2: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0),
        "Known constant acceleration of the centre of mass in {A}, for example gravity or thrust.",
        unit="m/s2",
    )
    fit_acceleration: bool = setting(
        False,
        "Fit this acceleration in a first pass, to the poses up to the first manoeuvre."
        " acceleration_mps2 is then not used.",
    )
    orbit_rate_radps: float = setting(
        0.0,
        "Mean motion of the camera's circular orbit. The centre of mass moves by the equations of"
        " Clohessy and Wiltshire; 0 means free motion.",
        unit="rad/s",
        low=0.0,
        high=0.1,
    )
    orbit_radial_a: tuple[float, float, float] = setting(
        (1.0, 0.0, 0.0),
        "Unit vector from the centre of the Earth to the camera in {A}, at the first scan.",
    )
    orbit_normal_a: tuple[float, float, float] = setting(
        (0.0, 1.0, 0.0), "Unit normal of the orbit in {A}."
    )
    noise: NoiseSource = setting(
        NoiseSource.REGISTRATION,
        "Source of the measurement noise: the covariance that the registration computes"
        " (registration), or the fixed R0 (r0).",
    )
    adapt: Adaptation = setting(
        Adaptation.SCALE,
        "Adaptation of the measurement noise to the residuals: one factor each for position and"
        " attitude (scale), the paper's whole matrix starting from R0 (matrix), or none (off).",
    )
    window: int = setting(
        30,
        "Number of healthy scans to whose residuals the measurement noise is adapted. A larger"
        " value gives a steadier noise level that follows changes more slowly.",
        low=6,
    )
    r0_pos_m: float | None = setting(
        None,
        "R0: 1 sigma of the measured position.",
        unit="m",
        above=0.0,
        high=1e6,
        of_extent=0.002,
    )
    r0_rot_deg: float = setting(
        0.5, "R0: 1 sigma of the measured attitude about each axis.", unit="deg", above=0.0
    )
    r_floor: float = setting(
        1e-6,
        "Smallest eigenvalue of R in units of R0. A larger value limits the weight of precise"
        " poses.",
        above=0.0,
    )
    constraint: Constraint = setting(
        Constraint.CHART,
        "How the inertia ratios stay within their bounds: coordinates without bounds (chart), or"
        " the paper's scaling beta of the Kalman gain (gain).",
    )
    sigma_margin: float = setting(
        0.01,
        "With constraint gain: |sigma| stays below 1 minus this margin. A larger value excludes"
        " more of the nearly flat or slender bodies.",
        above=0.0,
        below=0.5,
    )
    correlated_share: float | None = setting(
        None,
        "Share of a pose's variance that scans from nearly the same view have in common. A"
        " larger value gives such scans together less weight.",
        low=0.0,
        high=1.0,
        unset=(
            "computed from the number of inliers and their rms residual (docs/estimation.md, Noise)"
        ),
    )
    correlated_rad: float = setting(
        0.4,
        "Rotation of the view over which this common error changes. A larger value gives the scans"
        " of a slowly turning target less weight.",
        unit="rad",
        low=0.0,
    )
    start: Start = setting(
        Start.AUTO,
        "How the estimate begins: from a given belief (near), by a batch fit to the first poses"
        " (cold), or by the paper's filter from zero (paper). auto is near if a belief is given and"
        " cold otherwise.",
    )
    refit_growth: float = setting(
        0.2,
        "The batch fit is repeated when the healthy poses have grown by this share, until its"
        " likelihood is close to Gaussian. A larger value takes less time and leaves more poses"
        " to linear updates.",
        low=0.0,
        high=1.0,
    )
    audit_poses: int = setting(
        1000,
        "Number of healthy poses up to which the filter is compared with a batch fit. A larger"
        " value continues the comparison for longer and takes more time; 0 switches it off.",
        low=0,
    )
    robust: bool = setting(
        True,
        "Test hypotheses about scans with a large innovation, and reduce the weight of a pose"
        " whose NIS exceeds its 99.99 % point. The paper's start switches both off.",
    )
    bias_s: float = setting(
        20.0,
        "Time of consistent poses after which a step of the measured pose counts as the"
        " beginning of a sensor error, where the residuals of the registration do not show it;"
        " an earlier step counts as its end.",
        unit="s",
        low=0.0,
    )
    change_probability: float = setting(
        0.02,
        "Prior probability that rate or velocity changed within the last five intervals between"
        " scans. A larger value enlarges the covariance where the last scans make a change"
        " possible.",
        low=0.0,
        below=1.0,
    )
    start_pos_1s_m: float | None = setting(
        None, "1 sigma of the position of the initial pose.", unit="m", above=0.0, of_extent=0.05
    )
    start_rot_1s_deg: float = setting(
        10.0, "1 sigma of the attitude of the initial pose about each axis.", unit="deg", above=0.0
    )
    start_rate_1s_radps: float = setting(
        0.5,
        "1 sigma of the unknown angular rate about each axis.",
        unit="rad/s",
        above=0.0,
        high=1e3,
    )
    start_vel_1s_mps: float | None = setting(
        None,
        "1 sigma of the unknown velocity along each axis.",
        unit="m/s",
        above=0.0,
        high=1e6,
        of_extent=0.05,
    )
    start_sigma_1s: float = setting(
        0.5, "With start paper: 1 sigma of each unknown inertia ratio.", above=0.0, high=1.0
    )
    start_log_inertia_1s: float = setting(
        1.0,
        "With start cold: 1 sigma of each of the five components of the logarithm of the mass"
        " moments.",
        above=0.0,
        high=10.0,
    )
    start_varrho_1s_m: float | None = setting(
        None, "1 sigma of the unknown fixture position in {B}.", unit="m", above=0.0, of_extent=0.25
    )
    start_mu_1s_deg: float = setting(
        20.0,
        "With start paper: 1 sigma of the unknown misalignment about each axis.",
        unit="deg",
        above=0.0,
    )
    own: Tables = setting(
        Tables, "The parameters of estimators, one table [estimator.NAME] each.", parts=ESTIMATORS
    )

    def with_own(self) -> EstimatorParams:
        """Return the same with the parameters of the estimator that is used, given or default."""
        kind = ESTIMATORS.parameters(self.method)
        return replace(self, own=self.own.with_part(self.method, kind))

    def check(self) -> None:
        """Raise ValueError where the axes of the orbit are not orthonormal, or it has an
        acceleration beside it.
        """
        if not are_orthonormal(self.orbit_radial_a, self.orbit_normal_a):
            raise ValueError(
                "orbit_radial_a and orbit_normal_a must be unit vectors at right angles to each"
                " other"
            )
        if self.orbit_rate_radps > 0.0 and (any(self.acceleration_mps2) or self.fit_acceleration):
            raise ValueError(
                "orbit_rate_radps cannot be combined with acceleration_mps2 or fit_acceleration"
            )

    def at_interval(self, period_s: float, extent_m: float) -> EstimatorParams:
        """Return the settings with start and changes of the motion that fit to poses at short
        intervals.

        Poses need no initial guess, so that any motion may be tracked. The rate and velocity
        expected at the start, and the expected size of a manoeuvre, therefore at least turn the
        target by a quarter of a radian and move it by a quarter of its extent between two poses.
        Settings that differ from their defaults are kept.

        Args:
            period_s: interval between poses [s]; 0 if it is not known.
            extent_m: bounding diagonal of the target [m].
        """
        if period_s <= 0.0:
            return self
        plain, rate, speed = EstimatorParams(), self.start_rate_1s_radps, self.start_vel_1s_mps
        if rate == plain.start_rate_1s_radps:
            rate = max(rate, _PER_POSE / period_s)
        if speed is None:
            speed = max(
                given(plain.resolved(extent_m).start_vel_1s_mps), _PER_POSE * extent_m / period_s
            )
        return replace(self, start_rate_1s_radps=rate, start_vel_1s_mps=speed)

    def as_printed(self) -> EstimatorParams:
        """Return the settings with start, noise and gain as printed in the paper; a near start that
        is requested is kept.
        """
        return replace(
            self,
            start=self.start if self.start is Start.NEAR else Start.PAPER,
            constraint=Constraint.GAIN,
            noise=NoiseSource.R0,
            adapt=Adaptation.MATRIX,
            robust=False,
            audit_poses=0,
        )

    @property
    def R0(self) -> Array:
        """(6, 6) noise for (metres, half angle); auto values must be filled in."""
        return np.diag(
            np.repeat([given(self.r0_pos_m), 0.5 * math.radians(self.r0_rot_deg)], 3) ** 2
        )

    @property
    def by_gain(self) -> bool:
        """Whether the gain is constrained as in the paper; always so with the paper's start."""
        return self.constraint is Constraint.GAIN or self.start is Start.PAPER

    @property
    def disturbances(self) -> tuple[float | None, float | None]:
        """Root densities of torque and force noise that are given; None for one that is
        estimated.
        """
        return self.torque_noise_radps15, self.force_noise_mps15

    @property
    def change_1s(self) -> tuple[float, float]:
        """Prior 1 sigma of a change of the rate [rad/s] and of the velocity [m/s]; auto
        values must be filled in.
        """
        return 0.1 * self.start_rate_1s_radps, 0.2 * given(self.start_vel_1s_mps)

    @property
    def start_1s(self) -> Array:
        """(20,) standard deviations of a start from a guessed pose alone."""
        half = 0.5 * math.radians(self.start_rot_1s_deg), 0.5 * math.radians(self.start_mu_1s_deg)
        return np.repeat(
            [
                half[0],
                self.start_rate_1s_radps,
                given(self.start_pos_1s_m),
                given(self.start_vel_1s_mps),
                self.start_sigma_1s,
                given(self.start_varrho_1s_m),
                half[1],
            ],
            [3, 3, 3, 3, 2, 3, 3],
        )
