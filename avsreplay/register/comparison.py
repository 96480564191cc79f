"""Comparison of two poses by the same points of a scan.

A pose explains the scan as well as another one if its cost, point by point, is not larger by more
than the statistical error of the difference. Where turned or displaced copies of a model differ by
a few parts only, the rays decide. Three kinds of rays count: points that are on the model at one
pose and well off it at the other; rays that pass through a mark of one pose, because the point
measured in that direction lies behind it; and directions in which a mark should be visible and
nothing was measured, which count if the visible side of the model is complete in the scan.

With a share e of rays that contradict the true pose (other objects, errors of the model), a ray
that contradicts one pose only has the log likelihood ratio log((1 - e) / e).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.register.evidence import robust_noise

# A difference of the mean costs below so many standard errors is due to chance. A smaller value
# accepts more poses that have a rival.
CHANCE_SIGMAS = 5.0
OFF = 2.0  # a point farther from the model than this many widths is off it
CONTRADICTING_SHARE = 0.1  # of the rays that contradict the true pose, at least
DECIDING_LOG_RATIO = 20.0  # log likelihood ratio that decides
MOST_AGAINST = 0.25  # rays against the better pose over those for it, at most


@value_class
class Measured:
    """A pose T_ca, and the distances (k,) [m] of points of the scan from the faces that the camera
    sees.

    Attributes:
        passed: rays that passed through a mark that should be visible.
        empty: rays expected on marks in directions in which nothing was measured.
    """

    T_ca: Pose
    distance: Array
    passed: float = 0.0
    empty: float = 0.0

    def unexplained(self, width_m: float) -> Array:
        """Return min(1, squared distance in units of the width) of each point."""
        return np.asarray(np.minimum(self.distance / width_m, 1.0) ** 2)


def least_noise(found: Sequence[Measured]) -> float:
    """Return the least robust noise [m] of the poses."""
    return min(robust_noise(each.distance) for each in found)


def as_good(best: Array, other: Array, margin: float, sigmas: float = CHANCE_SIGMAS) -> bool:
    """Return whether the mean excess of the costs (n,) of another pose over those of the best one
    is below so many standard errors, or below the margin.
    """
    excess = other - best
    error = sigmas * float(excess.std()) / np.sqrt(len(excess))
    return bool(excess.mean() < max(margin, error))


def decides(better: Measured, other: Measured, width_m: float, complete: bool) -> bool:
    """Return whether the rays decide for one pose against another.

    Args:
        better: the pose that is to be decided for.
        other: the other pose, measured on the same points.
        width_m: distance within which a point is on the model [m].
        complete: the visible side of the model is complete in the scan, so that empty directions
            count.
    """
    a, b, off = better.distance, other.distance, OFF * width_m
    share = max(CONTRADICTING_SHARE, float(np.mean((a > width_m) & (b > width_m))))
    if share >= 0.5:
        return False
    rays_for = (
        np.count_nonzero((a < width_m) & (b > off))
        + other.passed
        + (other.empty if complete else 0.0)
    )
    against = (
        np.count_nonzero((b < width_m) & (a > off))
        + better.passed
        + (better.empty if complete else 0.0)
    )
    enough = (rays_for - against) * np.log((1.0 - share) / share) >= DECIDING_LOG_RATIO
    return bool(enough and against <= MOST_AGAINST * rays_for)


def decided(
    found: Sequence[Measured],
    same: Callable[[Pose, Pose], bool],
    width_m: tuple[float, float],
    margin: float,
    complete: bool,
) -> tuple[Measured, list[Measured], list[Measured]]:
    """Return the pose for which the rays decide, the different ones that explain the scan as well,
    and those of them against which the rays do not decide.

    Args:
        found: poses measured on the same points; the first is kept unless the rays decide for
            another one.
        same: whether two poses are the same.
        width_m: distance within which a point is on the model, and the width of the costs [m].
        margin: share of the scan by which a unique pose explains more than any other one.
        complete: as of ``decides``.
    """
    best, (near, width) = found[0], width_m
    for each in found[1:]:
        best = each if decides(each, best, near, complete) else best
    costs = best.unexplained(width)
    as_near = [
        each
        for each in found
        if not same(best.T_ca, each.T_ca) and as_good(costs, each.unexplained(width), margin)
    ]
    return best, as_near, [each for each in as_near if not decides(best, each, near, complete)]
