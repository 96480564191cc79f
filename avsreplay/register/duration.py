"""Duration of scans whose points have no times, from the residuals of registered scans of a run.

A target that moves while its points are measured one after the other is deformed. If k is the share
of the scan before a point, and u the velocity of the target there, the residual at a point p with
normal n is

    n . (p - c) = J d + delta n . p + T (k - 1/2) n . u

with the pose error d, the error delta of the size, and the duration T. Robust least squares give
all three, so that a wrong size is not taken for a duration. The standard error of a scan is that of
the size (``size``): correlated residuals of a patch, and errors of model and ranges that vary
slowly over the target.

Along a run the scans are spread over the whole log. Their mean has a standard error from the
differences between six blocks of consecutive scans (jackknife), because neighbouring scans show the
same side and have the same errors, and that of the slowly varying errors, which all scans may
share. The bias of the noise is found as that of the size, on a few of the scans; it is subtracted,
and half of it counts as a standard error.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.register.size import (
    LARGEST_ERROR,
    MATCH_ROUNDS,
    PATCHES_OF_EXTENT,
    SIZE_SIGMAS,
    Rows,
    clustered,
    joined,
    least_squares,
    noisy_points,
    spread_of,
    systematic,
)
from avsreplay.register.surface_index import SurfaceIndex

# aligned scans of which one is measured at first; measured scans
MEASURED_EVERY = 2
MOST_MEASURED = 24
LEAST_SCANS = 8
# scans for the bias of the noise, and blocks of the jackknife
BIAS_SCANS = 4
JACKKNIFE_BLOCKS = 6
MOST_WEIGHT = 4.0  # largest weight of a scan for the size, in units of the median weight
LEAST_OF_PERIOD = 0.02  # least duration that is reported, over the period


@value_class
class ScanDuration:
    """Duration and size that were fitted to one scan.

    Attributes:
        duration_s: negative if the last point is measured first [s].
        sigma_s: standard error of the duration by the noise [s].
        systematic_s: its standard error by errors of model and ranges that vary slowly over the
            target [s].
        delta: size of the target over that of the model, less 1, fitted with the duration.
        weight: inverse variance of delta, without the slowly varying errors.
    """

    duration_s: float
    sigma_s: float
    systematic_s: float
    delta: float
    weight: float


@value_class
class Duration:
    """Duration of a scan [s] along a run, the size of the target over that of the model, and their
    standard errors.
    """

    duration_s: float
    sigma_s: float
    size: float
    size_1s: float


@value_class
class OrderedScan:
    """Points of a registered scan without times.

    Attributes:
        points: (n, 3) in {C} [m], at the registered pose.
        motion: (n, 3) velocity of the target at each point [m/s], in {C}, times the share of the
            scan before the point.
        camera_c: (3,) camera position in {C} [m], or None: both sides of a face are matched.
        period_s: time since the last aligned scan [s].
    """

    points: Array
    motion: Array
    camera_c: Array | None
    period_s: float


@dataclass(slots=True)
class Durations:
    """The durations measured along a run."""

    measured: list[tuple[OrderedScan, ScanDuration]] = field(default_factory=list)
    offered: int = 0
    stride: int = MEASURED_EVERY
    open: bool = True

    def wanted(self) -> bool:
        """Count one more aligned scan; return whether it is to be measured."""
        self.offered += 1
        return self.open and self.offered % self.stride == 0

    def add(self, index: SurfaceIndex, scan: OrderedScan) -> None:
        """Measure a scan. No more are wanted once a duration that would be reported is excluded."""
        found = scan_duration(index, scan)
        if found is None or found.sigma_s <= 0.0:
            return
        self.measured.append((scan, found))
        if len(self.measured) >= LEAST_SCANS:
            mean, sigma, period = self._mean()
            self.open = abs(mean) + SIZE_SIGMAS * sigma > LEAST_OF_PERIOD * period
        if len(self.measured) == MOST_MEASURED:
            self.measured, self.stride = self.measured[::2], 2 * self.stride

    def result(self, index: SurfaceIndex) -> Duration | None:
        """Return the duration if it is significant, with the size that was fitted with it;
        else None.
        """
        if len(self.measured) < LEAST_SCANS or not self._significant(*self._mean()):
            return None
        tried = np.linspace(0, len(self.measured) - 1, BIAS_SCANS).astype(np.intp)
        bias, of_size = np.mean([noise_biases(index, self.measured[k][0]) for k in tried], axis=0)
        mean, sigma, period = self._mean()
        mean, sigma = mean - bias, float(np.hypot(sigma, 0.5 * bias))
        if not self._significant(mean, sigma, period):
            return None
        delta, weight = np.array([(found.delta, found.weight) for _, found in self.measured]).T
        size, size_1s = _mean_of(delta, np.minimum(weight, MOST_WEIGHT * np.median(weight)))
        return Duration(mean, sigma, 1.0 + size - of_size, float(np.hypot(size_1s, 0.5 * of_size)))

    @staticmethod
    def _significant(mean: float, sigma: float, period: float) -> bool:
        return abs(mean) >= max(LEAST_OF_PERIOD * period, SIZE_SIGMAS * sigma)

    def _mean(self) -> tuple[float, float, float]:
        """The mean duration weighted by its variance, its standard error, and the period [s]."""
        values = [
            (found.duration_s, found.sigma_s, found.systematic_s) for _, found in self.measured
        ]
        duration, sigma, shared = np.array(values).T
        weight = 1.0 / (sigma**2 + shared**2)
        mean, spread = _mean_of(duration, weight)
        period = float(np.median([scan.period_s for scan, _ in self.measured]))
        return mean, float(np.hypot(spread, weight @ shared / weight.sum())), period


def _mean_of(values: Array, weight: Array) -> tuple[float, float]:
    """Weighted mean of values (n,), and its standard error by the jackknife over blocks."""
    block = np.arange(len(values)) * JACKKNIFE_BLOCKS // len(values)
    without = [
        float(weight[block != k] @ values[block != k] / weight[block != k].sum())
        for k in range(JACKKNIFE_BLOCKS)
    ]
    return float(weight @ values / weight.sum()), spread_of(np.array(without))


def scan_duration(index: SurfaceIndex, scan: OrderedScan) -> ScanDuration | None:
    """Fit pose, size and duration of a scan whose points were measured one after the other while
    the target moved.

    Args:
        index: of the model.
        scan: the registered points.

    Returns:
        The duration, negative if the last point is measured first; None with fewer than 50
        residuals, or if pose and size explain any duration.
    """
    if (found := _fitted(index, scan.points, scan.camera_c, scan.motion)) is None:
        return None
    duration, delta, rows = found
    sigma = max(clustered(rows, side * index.extent_m) for side in PATCHES_OF_EXTENT)
    others, of_size = np.column_stack([rows.J[:, :6], rows.free]), rows.J[:, 6]
    free = of_size - others @ np.linalg.lstsq(others, of_size, rcond=1e-6)[0]
    weight = float(free @ free) / rows.noise_m**2
    return ScanDuration(duration, sigma, systematic(rows, index.extent_m), delta, weight)


def noise_biases(index: SurfaceIndex, scan: OrderedScan) -> tuple[float, float]:
    """Return the duration [s] and the size less 1 that the noise of a scan makes a still target
    appear to have.

    As ``size.noise_bias``, with the arguments of :func:`scan_duration`.
    """
    if (found := _fitted(index, scan.points, scan.camera_c, scan.motion)) is None:
        return 0.0, 0.0
    rows = found[2]
    both = [
        _fitted(index, noisy, scan.camera_c, scan.motion[rows.used])
        for noisy in noisy_points(rows, scan.camera_c)
    ]
    duration, size = np.mean([(found if each is None else each)[:2] for each in both], axis=0)
    return float(duration), float(size)


def _fitted(
    index: SurfaceIndex, p: Array, camera_c: Array | None, motion: Array
) -> tuple[float, float, Rows] | None:
    """Duration, size less 1, and rows of the last round."""
    duration, delta, moved, rows = 0.0, 0.0, Pose.identity(), None
    for _ in range(MATCH_ROUNDS):
        q = moved.apply(p - duration * motion) / (1.0 + delta)
        if (found := least_squares(index, q, camera_c, motion)) is None:
            return None
        rows, d, centre = found
        duration += rows.delta
        delta, moved = joined(delta, moved, float(d[6]), d[:6], centre)
        if abs(delta) > LARGEST_ERROR:
            return None
    return None if rows is None else (duration, delta, rows)
