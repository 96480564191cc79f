"""Errors that all measured poses have in common, which no innovation shows and later poses do not
reduce.

- The position along the line of sight: the same offset of all poses is the same motion elsewhere. -
A constant motion d of the model in {C}: it only renames the fixture. Its covariance is a share of
the systematic part
  of the covariances of the registered poses, which comes from errors of the model and of the
  ranges.
- A wrong size. Scans of a target that is 1 + delta times as large as the model are explained by
  that size, or by ranges that are too long by the same factor; the poses are then too far away by
  delta times the distance.

The systematic part of one scan is an estimate of variances that are not negative, and the noise of
points near edges is a part of it. Its share in the covariance is therefore 0.1 to 0.25 in scans
without such errors, and up to 0.45 with noise of 0.004 of the extent
(``tests/benchmarks/model_errors.py``). Only a larger mean share over a run counts.
"""

from __future__ import annotations

import math
from dataclasses import field, replace

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.error_state import DMU, VARRHO
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Alignment

# variance of an error that all views have in common over that of the common errors
_LINE_OF_SIGHT = 0.5
_ALL_VIEWS = 0.5  # the same for the systematic part of the covariance of a pose
# mean share up to which it does not count, and from which it counts in full
_FROM_NOISE = 0.3
_ALL_SYSTEMATIC = 0.5
_RANGES = 0.5  # probability that the ranges of the sensor, and not the model, have the wrong size
# error of size that noise causes, over (rms / extent)^2: 30 to 500 on five meshes
_SIZE_OF_NOISE = 500.0
_SIZE_1S = 1e-3  # standard error of the size from one scan that is added to the stated one
# scans that show errors; neighbours that count as one; significance
_LEAST_SCANS = 12
_ALIKE_NEIGHBOURS = 4.0
_SIGMAS = 4.0
_NO_MATRIX = frozen(np.zeros((6, 6)))


@value_class
class ModelErrors:
    """Sums over the healthy scans of a run.

    Attributes:
        scans, share: number of covariances, and sum of the shares of their systematic parts.
        systematic: (6, 6) sum of the systematic parts, of d in {C}.
        sizes: sums of weight, weight times error of size, weight times its square, and (rms /
            extent)^2; their number.
        sensor: (3,) position of the sensor in {A} at the last scan [m].
        kept: the sums are kept; the paper's method has none.
    """

    scans: int = 0
    share: float = 0.0
    systematic: Array = field(default_factory=lambda: _NO_MATRIX)
    sizes: tuple[float, float, float, float, int] = (0.0, 0.0, 0.0, 0.0, 0)
    sensor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    kept: bool = True

    def with_scan(
        self, alignment: Alignment | None, extent_m: float, sensor: Pose | None
    ) -> ModelErrors:
        """Return the sums with one more scan.

        Args:
            alignment: of the scan, in {C}; None where it was not used.
            extent_m: diagonal of the model's bounding box.
            sensor: its pose in {A}; None if {A} is its own frame.
        """
        if not self.kept:
            return self
        x, y, z = (0.0, 0.0, 0.0) if sensor is None else sensor.t.tolist()
        if alignment is None or alignment.covariance is None or alignment.systematic is None:
            return replace(self, sensor=(x, y, z))
        part, share = alignment.systematic, systematic_share(alignment)
        sizes = self._with_size(alignment.size, alignment.rms_m / extent_m)
        return ModelErrors(
            self.scans + 1, self.share + share, self.systematic + part, sizes, (x, y, z)
        )

    def _with_size(
        self, size: tuple[float, float] | None, noise: float
    ) -> tuple[float, float, float, float, int]:
        if size is None or not math.isfinite(size[1]):
            return self.sizes
        delta, sigma = size
        w = 1.0 / (sigma * sigma + _SIZE_1S**2)
        a, b, c, squares, n = self.sizes
        return a + w, b + w * delta, c + w * delta * delta, squares + noise * noise, n + 1

    @property
    def size_error(self) -> float:
        """The error of size that noise does not explain: the root of what its square exceeds;
        0 for too few scans.
        """
        weight, first, second, squares, n = self.sizes
        if n < _LEAST_SCANS:
            return 0.0
        mean = first / weight
        variance = _ALIKE_NEIGHBOURS * max(second / weight - mean * mean, 0.0) / n
        return math.sqrt(
            max(mean * mean - _SIGMAS**2 * variance - (_SIZE_OF_NOISE * squares / n) ** 2, 0.0)
        )

    @property
    def counted(self) -> float:
        """How far systematic errors count, from 0 to 1, by their mean share in the covariances."""
        if self.scans < _LEAST_SCANS:
            return 0.0
        share = self.share / self.scans
        return min(max((share - _FROM_NOISE) / (_ALL_SYSTEMATIC - _FROM_NOISE), 0.0), 1.0)

    @property
    def motions(self) -> Array:
        """Motions d (6, k) of {C}, each with a 1 sigma, that all poses may have in common;
        (6, 0) for none.
        """
        if not (counted := self.counted):
            return np.zeros((6, 0))
        values, axes = np.linalg.eigh(self.systematic / self.scans)
        return np.asarray(axes * np.sqrt(counted * _ALL_VIEWS * np.maximum(values, 0.0)))


NO_MODEL_ERRORS = ModelErrors()


def systematic_share(alignment: Alignment) -> float:
    """Return the share of systematic errors in the covariance of a pose, from 0 to 1; 0 where
    there is none.
    """
    if alignment.covariance is None or alignment.systematic is None:
        return 0.0
    return _motion.trace_of_ratio(alignment.systematic, alignment.covariance) / 6.0


def line_of_sight_1s(r_a: Array, common_m2: Array, errors: ModelErrors) -> Array:
    """Return the 1 sigma (3,) in {A} [m] of the error of the position along the line of sight that
    all poses have.

    Args:
        r_a: (3,) position of the target in {A} [m].
        common_m2: (3, 3) covariance of the error of a measured position in {A} that near views have
            in common [m^2].
        errors: of the model and of the ranges.
    """
    away = r_a - np.array(errors.sensor)
    distance = float(np.linalg.norm(away))
    if distance == 0.0:
        return np.zeros(3)
    u = away / distance
    variance = _LINE_OF_SIGHT * float(u @ common_m2 @ u)
    return np.asarray(u * math.sqrt(variance + _RANGES * (errors.size_error * distance) ** 2))


def motion_covariance(d: Array, q_bc: Array) -> Array:
    """Return the covariance (20, 20) of the state for independent motions d (6, k) of {C}, each
    with 1 sigma.
    """
    R_bc, E = geometry.matrix(q_bc), np.zeros((20, d.shape[1]))
    E[VARRHO], E[DMU] = R_bc @ d[3:], 0.5 * R_bc @ d[:3]
    return np.asarray(E @ E.T)
