"""Older scans of a window combined into points, so that a window of many scans costs little more
than one of few.

A step of the velocity displaces the target in proportion to the time since, and the error of a mean
of poses falls with their number. At a high scan rate a step is therefore found after many scans, of
which the older ones need not be distinguished: the instant of a step is known to a share of its age
at best. The poses of neighbouring scans are replaced by their mean, weighted by information. The
combination is linear, so that the effect of any change on it is exact, also of one between two
scans of a point.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.estimate.track import Epoch
from avsreplay.geometry import Array

FEWEST_KEPT = 12  # accepted scans that are kept at least, and up to which none are combined
# accepted scans that are kept: those within this time, so many at most
_KEPT_SCANS_S = 5.0
_MOST_KEPT = 64
# latest accepted scans that are not combined; of the older points two each have 2, 4, 8 ... scans
_SINGLE = 4


@value_class
class ScanPoints:
    """n scans that are combined into p points.

    Attributes:
        first: (p,) index of the first scan of each point.
        point: (n,) index of the point of each scan.
        weights: (n, 6, 6) of the poses in their points; the sum over each point is the identity.
    """

    first: NDArray[np.int64]
    point: NDArray[np.int64]
    weights: Array

    @property
    def single(self) -> bool:
        """Whether no scans are combined."""
        return len(self.first) == len(self.point)

    def combined(self, values: Array) -> Array:
        """Return the values (p, 6, ...) of the points from those of the scans (n, 6, ...)."""
        if self.single:
            return values
        flat = self.weights @ values.reshape(len(values), 6, -1)
        return np.asarray(np.add.reduceat(flat, self.first)).reshape(
            len(self.first), *values.shape[1:]
        )

    def covariance(self, C: Array) -> Array:
        """Return the covariance (p, 6, p, 6) of the points from that of the scans (n, 6, n, 6)."""
        return (
            C
            if self.single
            else self.combined(self.combined(C).transpose(2, 3, 0, 1)).transpose(2, 3, 0, 1)
        )

    def since_each(self, whiten: Array, columns: Array) -> Array:
        """Columns (n, 6p, m) of the whitened innovations by what acts on each scan and later ones.

        The sum over the scans begins with the last.

        Args:
            whiten: (6p, 6p) inverse of the Cholesky factor of the covariance of the points.
            columns: (n, 6, m) effect on each scan.
        """
        by_point = whiten.reshape(len(whiten), -1, 6).transpose(1, 0, 2)
        by_scan = (
            by_point @ columns if self.single else by_point[self.point] @ (self.weights @ columns)
        )
        return np.asarray(np.cumsum(by_scan[::-1], axis=0)[::-1])

    def before(self, scan: int) -> int:
        """Number of points before a scan that begins a point."""
        return int(np.searchsorted(self.first, scan))


def scan_points(R: Sequence[Array], accepted: int) -> ScanPoints:
    """Return the points of scans in the order of time, of which the last ones are not combined.

    Args:
        R: (6, 6) noise of each scan.
        accepted: number of scans before the doubtful ones, which are not combined.
    """
    first, size, left = list(range(len(R))), 2, accepted - _SINGLE
    if accepted > FEWEST_KEPT:
        older = []
        while left > 0:
            for _ in range(2):
                left = max(left - size, 0)
                older.append(left)
            size *= 2
        first = [*sorted(set(older)), *first[accepted - _SINGLE :]]
    begin = np.array(first, dtype=np.int64)
    point = np.repeat(np.arange(len(begin)), np.diff(begin, append=len(R)))
    if len(begin) == len(R):
        return ScanPoints(begin, point, np.broadcast_to(np.eye(6), (len(R), 6, 6)))
    info = np.linalg.inv(np.array(R))
    total = np.add.reduceat(info, begin)
    return ScanPoints(
        begin, point, np.asarray(np.linalg.solve(total[point], info), dtype=np.float64)
    )


def latest(scans: tuple[Epoch, ...]) -> tuple[Epoch, ...]:
    """Return the accepted scans that are kept: the last ``FEWEST_KEPT``, or all within some seconds
    where these are more.
    """
    since_ns = scans[-1].prediction.belief.t_ns - round(1e9 * _KEPT_SCANS_S)
    first = max(0, len(scans) - _MOST_KEPT)
    while first < len(scans) - FEWEST_KEPT and scans[first].prediction.belief.t_ns < since_ns:
        first += 1
    return scans[first:]
