"""Consistency of the estimate with its covariance, and the instant t_1 from which on the estimate
may be used.

Consistency: NIS of the innovations inside its chi-square band, and checks that hold for every
correct estimate. They need no ground truth. Convergence: ``covariance`` is the paper's test, every
parameter and motion block below its limit. ``predictive`` compares position, velocity and attitude
of the grasp point at the planned capture with the tolerances of the task; a body with unobservable
parameters may pass it. An error that no further scan reduces is compared as it will be when the
gripper closes. Either must hold for the dwell time, with a consistent estimate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array, frozen
from avsreplay.monitor import _root
from avsreplay.monitor.chi_square import mean_band
from avsreplay.records import BLOCKS, UNLIKELY, Belief, Forecast, Innovation, Possible
from avsreplay.settings import Settings, given, setting

ABORT_ERROR_RATIO = 2.0  # a flight goes on up to this multiple of the error with which it may begin
_MAX_SIGMA_RATIO = 1.05  # a posterior 1 sigma may exceed that of the measurement by this factor


@dataclass(frozen=True, slots=True)
class ConsistencyParams(Settings):
    """The innovation test that may withdraw ``converged``."""

    window: int = setting(
        50,
        "Number of the last healthy scans whose mean NIS is tested. A larger value finds smaller"
        " deviations, later.",
        low=2,
    )
    least: int = setting(
        15,
        "Smallest number of healthy scans for which this test is made; with fewer, converged stays"
        " false.",
        low=2,
    )
    level: float = setting(
        0.9999,
        "Probability of the two-sided band in which the mean NIS of a correct filter lies. A larger"
        " value accepts larger deviations.",
        above=0.0,
        below=1.0,
    )
    slack: float = setting(
        2.0,
        "Factor by which the mean NIS may exceed the band, because registration errors are"
        " correlated. A larger value accepts larger deviations.",
        low=1.0,
    )

    def check(self) -> None:
        """Raise ValueError where the test needs more scans than its window holds."""
        if self.least > self.window:
            raise ValueError(f"least is {self.least}, must not exceed window = {self.window}")


class Criterion(Enum):
    """Which test decides."""

    COVARIANCE = "covariance"
    PREDICTIVE = "predictive"


@dataclass(frozen=True, slots=True)
class ConvergenceParams(Settings):
    """Limits on the 1 sigma of each block (root of its trace), and how long they must hold."""

    criterion: Criterion = setting(
        Criterion.PREDICTIVE,
        "Test that decides: the covariance of every block, as in the paper (covariance), or the"
        " grasp point predicted for the planned capture and the consistency of the innovations"
        " (predictive).",
    )
    dwell_s: float = setting(
        2.0,
        "Time for which the test must be met without interruption before converged becomes true.",
        unit="s",
        low=0.0,
    )
    sigmas: float = setting(
        1.0,
        "With predictive: the predicted 1 sigma of the grasp point times this must be within"
        " the tolerances of the task. A larger value requires a more precise estimate.",
        above=0.0,
    )
    attitude_deg: float = setting(
        3.0, "With covariance: largest 1 sigma of the attitude of {B}.", unit="deg", low=0.0
    )
    rate_radps: float = setting(
        0.003, "With covariance: largest 1 sigma of the angular rate.", unit="rad/s", low=0.0
    )
    position_m: float | None = setting(
        None,
        "With covariance: largest 1 sigma of the position of the mass centre.",
        unit="m",
        low=0.0,
        of_extent=0.01,
    )
    velocity_mps: float | None = setting(
        None,
        "With covariance: largest 1 sigma of the velocity of the mass centre.",
        unit="m/s",
        low=0.0,
        of_extent=0.001,
    )
    sigma: float = setting(
        0.05, "With covariance: largest 1 sigma of the two inertia ratios.", low=0.0
    )
    varrho_m: float | None = setting(
        None, "With covariance: largest 1 sigma of varrho.", unit="m", low=0.0, of_extent=0.01
    )
    mu_deg: float = setting(3.0, "With covariance: largest 1 sigma of mu.", unit="deg", low=0.0)

    @property
    def block_limits(self) -> dict[str, float]:
        """Limit of each block in the covariance's own units (half angles); auto values must
        be filled in.
        """
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
    variances = P.diagonal().tolist()
    return {name: math.sqrt(max(sum(variances[where]), 0.0)) for name, where in BLOCKS.items()}


def violations(
    belief: Belief,
    definite: bool,
    pose_covariance: Array,
    residual: Array,
    R: Array,
    inflation: Array,
    gate: float,
) -> tuple[str, ...]:
    """The checks that an estimate after a healthy scan fails; a correct one passes all.

    Args:
        belief: after the update.
        definite: whether its covariance is finite and positive semidefinite within rounding.
        pose_covariance: (6, 6) of its pose, metres in {A} and half angles in {B}.
        residual: (6,) measured minus estimated pose, in the same units.
        R: (6, 6) noise of the measured pose.
        inflation: (2,) factor on R, attitude and position, by which the update allowed for
            correlated errors.
        gate: 99.99 % point of the squared residual in the metric of R plus ``pose_covariance``.

    Returns:
        Names of the failed checks: ``covariance`` (not positive semidefinite, or not finite),
        ``sigma`` (an inertia ratio outside its physical range), ``worse_than_measured`` (1 sigma of
        position or attitude above that of the measurement), ``outside_gate`` (the measurement is an
        outlier for the estimate).
    """
    found = [] if definite else ["covariance"]
    if not all(abs(ratio) < 1.0 for ratio in belief.x.sigma.tolist()):
        found.append("sigma")
    claimed, measured = pose_covariance.diagonal().tolist(), R.diagonal().tolist()
    blocks = (slice(0, 3), float(inflation[1])), (slice(3, 6), float(inflation[0]))
    if not all(
        sum(claimed[b]) <= max(factor, 1.0) * _MAX_SIGMA_RATIO**2 * sum(measured[b])
        for b, factor in blocks
    ):
        found.append("worse_than_measured")
    if not float(residual @ np.linalg.solve(R + pose_covariance, residual)) <= gate:
        found.append("outside_gate")
    return tuple(found)


@value_class
class ConsistencyTrack:
    """Whitened innovations L^-1 alpha of the last healthy epochs, (n, 6), oldest first.

    Each has its Cauchy weight, and the length that its NIS has as a chi-square value. ``share`` is
    the claimed part of the variance of the last pose that near views have in common.
    """

    white: Array
    share: float = 0.0


@value_class(eq=True)
class ConsistencyReport:
    """The window in numbers, None before there are enough scans.

    Attributes:
        consistent: neither the mean NIS nor the sum of the innovations is above its band.
        nis_mean: mean NIS.
        band: its two-sided chi-square band.
        autocorrelation: of the whitened innovations one healthy epoch apart, 0 where white.
    """

    consistent: bool | None
    nis_mean: float | None = None
    band: tuple[float, float] | None = None
    autocorrelation: float | None = None


class Consistency:
    """Tests the innovations of healthy scans.

    Args:
        params: window, level and slack of the test.
    """

    def __init__(self, params: ConsistencyParams) -> None:
        self.params = params
        self._bands: dict[int, tuple[float, float]] = {}

    def initial(self) -> ConsistencyTrack:
        """Return an empty window."""
        return ConsistencyTrack(frozen(np.zeros((0, 6))))

    def observe(
        self, track: ConsistencyTrack, innovation: Innovation | None, gamma: int
    ) -> ConsistencyTrack:
        """Return the window with one more scan; faulty scans are left out.

        Args:
            track: the window so far.
            innovation: None where nothing was measured.
            gamma: 1 for a healthy scan.
        """
        if innovation is None or gamma == 0:
            return track
        share = innovation.weight * (
            innovation.chi2 / innovation.nis if innovation.nis > 0.0 else 1.0
        )
        white = np.sqrt(share) * _root.whitened(innovation.S, innovation.alpha)
        kept = track.white[max(0, len(track.white) + 1 - self.params.window) :]
        return ConsistencyTrack(frozen(np.vstack([kept, white])), innovation.share)

    def judge(self, track: ConsistencyTrack, common: float = 1.0) -> ConsistencyReport:
        """Test the window: a mean NIS above its band (times the slack) is inconsistent.

        A mean below the band results from a covariance that is too large, which is safe. A sum of
        the innovations that is not zero by chance is inconsistent as well: an error of the estimate
        that is small beside that of one pose shifts all innovations alike. Errors that the poses
        have in common enlarge the variance of the sum.

        Args:
            track: the window.
            common: estimated factor on the variance that near views have in common.
        """
        n = len(track.white)
        if n < self.params.least:
            return ConsistencyReport(None)
        band = self._band(n)
        mean = float(np.einsum("ij,ij->", track.white, track.white)) / n
        lag = float(np.einsum("ij,ij->", track.white[1:], track.white[:-1]) / (mean * (n - 1)))
        total, alike = track.white.sum(axis=0), min(common * track.share, 1.0)
        centred = float(total @ total) <= UNLIKELY[6] * n * (1.0 + (n - 1) * alike)
        return ConsistencyReport(centred and mean <= self.params.slack * band[1], mean, band, lag)

    def _band(self, n: int) -> tuple[float, float]:
        if n not in self._bands:
            self._bands[n] = mean_band(6, n, self.params.level)
        return self._bands[n]


@value_class(eq=True)
class ConvergenceTrack:
    """The state of the test.

    Attributes:
        converged: the planner may use the estimate now.
        t1_ns: the epoch from which it first held, None before.
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
    """Determines t_1.

    Args:
        params: limits; those left out are taken from ``extent_m``, the target's bounding diagonal
            [m].
        tolerance: largest errors of a capture: position [m], speed [m/s] and angle [rad].
        closing_sigmas: with this factor the predicted 1 sigma must be within the tolerances when
            the gripper closes.
    """

    def __init__(
        self,
        params: ConvergenceParams,
        extent_m: float,
        tolerance: tuple[float, float, float],
        closing_sigmas: float = 1.0,
    ) -> None:
        self.params, self._closing_sigmas = params.resolved(extent_m), closing_sigmas
        self._limits, self._tolerance = self.params.block_limits, tolerance

    def initial(self) -> ConvergenceTrack:
        """Return the state before the first scan."""
        return ConvergenceTrack()

    def at_capture(
        self, forecast: Callable[[Array], Forecast], after_s: Callable[[], float]
    ) -> Forecast:
        """Return what is predicted for the planned capture, or for now where the error is already
        above the tolerance: then no later one is below it.

        Args:
            forecast: times (n,) [s after now] -> predicted 1 sigma of the grasp point.
            after_s: returns the time to the planned capture [s].
        """
        now = forecast(np.zeros(1))
        return forecast(np.array([after_s()])) if self.ratio(now) <= 1.0 else now

    def judge(
        self,
        track: ConvergenceTrack,
        belief: Belief,
        forecast: Forecast | None = None,
        consistent: bool = True,
        possible: Possible | None = None,
        flown: bool = False,
    ) -> ConvergenceTrack:
        """Return the state after one more scan. By the predictive criterion an inconsistent
        estimate is not converged.

        Args:
            track: the state so far.
            belief: the estimate after the scan.
            forecast: predicted 1 sigma of the grasp point at the planned capture; needed by the
                predictive criterion.
            consistent: of the consistency tests.
            possible: a change that the last scans make possible. While it makes an error above the
                tolerance too likely (``_within``), convergence is not claimed. The dwell goes on:
                once later scans exclude the change, the test has held.
            flown: a plan is flown: further scans will arrive before the capture, so that the
                flight is given up only where the error is ``ABORT_ERROR_RATIO`` times as large.
        """
        one_sigma = block_1s(belief.P)
        unknown = tuple(
            name for name, limit in self._limits.items() if not one_sigma[name] <= limit
        )
        allowed = ABORT_ERROR_RATIO if flown else 1.0
        predictive = forecast is not None and self.ratio(forecast) <= allowed
        printed = (
            self.params.criterion is Criterion.COVARIANCE
        )  # the paper's test looks at the covariance only
        holds = not unknown if printed else predictive and consistent
        if not holds:
            return ConvergenceTrack(False, track.t1_ns, None, not unknown, predictive, unknown)
        since = belief.t_ns if track.since_ns is None else track.since_ns
        within = printed or forecast is None or self._within(forecast, possible, allowed)
        converged = within and (belief.t_ns - since) * 1e-9 >= self.params.dwell_s
        t1 = since if converged and track.t1_ns is None else track.t1_ns
        return ConvergenceTrack(converged, t1, since, not unknown, predictive, unknown)

    def _within(self, forecast: Forecast, possible: Possible | None, allowed: float) -> bool:
        """Return whether an error above ``allowed`` tolerances is no more likely than a 1 sigma at
        the limit makes it.

        A change contributes at most its probability, however large its effect.
        """
        if possible is None:
            return True
        p, unit = possible.probability, allowed * np.array(self._tolerance)[:, None]
        free, changed = (
            np.array([f.pos_1s_m, f.vel_1s_mps, f.rot_1s_rad]) / unit
            for f in (forecast, possible.errors)
        )
        most = _beyond(1.0 / self.params.sigmas)
        return all(
            (1.0 - p) * _beyond(a) + p * _beyond(math.hypot(a, b)) <= most
            for a, b in zip(free.flat, changed.flat, strict=True)
        )

    def ratio(self, forecast: Forecast) -> float:
        """Return the largest predicted error in units of its tolerance.

        Args:
            forecast: predicted 1 sigma of the grasp point.
        """
        predicted = (forecast.pos_1s_m, forecast.vel_1s_mps, forecast.rot_1s_rad)
        now = max(
            float(values.max()) / limit
            for values, limit in zip(predicted, self._tolerance, strict=True)
        )
        position, _, angle = self._tolerance
        lasting = max(forecast.lasting[0] / position, forecast.lasting[1] / angle)
        return max(self.params.sigmas * now, self._closing_sigmas * lasting)


def _beyond(one_sigma: float) -> float:
    """Probability that a normal variable of this 1 sigma is above 1 in magnitude."""
    return math.erfc(math.sqrt(0.5) / one_sigma) if one_sigma else 0.0
