"""What a scan shows of the target, which decides what is done for it before the first accepted pose
of a run.

A search that found no pose finds none in a scan that shows the same. It is worth repeating where
the scan shows something else: more points, because the target is nearer or no longer hidden, or
another shape of its visible side. The difference that is required grows with the number of
searches that failed, so that the work stays small with a wrong model, of which no pose explains any
scan.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array

# Relative difference in the number of points, or in a principal standard deviation of their places,
# that calls for another search, for each search that failed. A larger value searches more rarely.
CHANGE = 0.03
# A principal standard deviation counts as at least this share of the largest one, so that the noise
# of a flat view is no change of its shape.
LEAST_OF_LARGEST = 0.05
POSTPONED = (
    "the search for a pose is postponed, because the searches of the scans before found none"
)
SHAPE_POINTS = 2000  # of a scan, from which its shape is measured


class Effort(Enum):
    """What is done for a scan of a run without an accepted pose."""

    FULL = "registration and searches"
    GUESS = "the same if few points confirm the guess"


def shown(points: NDArray[Any]) -> Array | None:
    """Return what a scan shows: logarithms of the number of its points and of the principal
    standard deviations of their places, (4,).

    Args:
        points: (n, 3) [m]; points that are not finite are left out.

    Returns:
        None with fewer than four points.
    """
    part = np.asarray(points[:: max(1, len(points) // SHAPE_POINTS)], dtype=np.float64)
    part = part[np.isfinite(part).all(axis=1)]
    if len(part) < 4:
        return None
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(part.T)), 0.0))
    least = max(LEAST_OF_LARGEST * float(spread[-1]), float(np.finfo(float).tiny))
    return np.asarray(np.log([len(points), *np.maximum(spread, least)]))


def effort_for(seen: Array | None, failed: tuple[Array, ...]) -> Effort:
    """Return what is done for a scan before the first accepted pose.

    Args:
        seen: what it shows, see :func:`shown`.
        failed: what the scans showed whose searches found no pose.
    """
    if seen is None or not failed:
        return Effort.FULL
    change = min(float(np.abs(seen - each).max()) for each in failed)
    return Effort.FULL if change > CHANGE * len(failed) else Effort.GUESS
