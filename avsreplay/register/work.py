"""The work that one scan may cost, counted in point searches, so that results do not depend on the
machine.
"""

from __future__ import annotations

import numpy as np

from avsreplay.geometry import Pose
from avsreplay.records import Alignment, AlignStatus, Fit, Surface
from avsreplay.register.backend import LEAST_BUDGET_POINTS
from avsreplay.register.sampling import sample
from avsreplay.register.surface_index import SurfaceIndex

# an ordinary registration: work, and searches (per point)
HEALTHY_FIXED = (4200, 0.8)
HEALTHY_SEARCHED = (7000, 1.3)
# the quality of a pose: point searches in all, and points of which each takes one
GRADE_WORK = 8000
POINTS_GRADED = 2
# points with the noise of an ordinary scan that show the cost of a search
NEAR_POINTS = 500
ORDINARY_NOISE_OF_EXTENT = 0.002
SIMULATED_WORK = (
    1000,
    2,
)  # cost of the simulation of the noise: point searches in all, and of each point
MOST_SIMULATED = 3000  # points that are simulated, at most
# share of the points on the model, from which a fit is close and little is left to explain
LEAST_RATIO = 0.9
# searches per point of a pass while less than this share of the points is on the model
FAR_WORK = 2
LEAST_NEAR = 0.5
SCATTER_WORK = (
    3,
    7,
)  # cost per point of finding whether points are scattered, and of leaving them out
# cost of a test of a pose, and of fitting the size [point searches]
TEST_WORK = 15_000
SIZE_WORK = 15_000
FREE_WORK = 8000  # cost of free directions
# cost in the interpreter of a stage of a restart, and of measuring a pose
STAGE_WORK = 1200
CALL_WORK = 600
# cost of registering a scan once more from its pose, and of the test of the result
LAST_WORK = 30_000
HEALTHY_SCANS = 20  # most work for one scan in units of an ordinary registration
NOT_COMPARED = "no work is left to compare the poses near this one"
LAST_STEP = 0.5  # of it, kept because a last step can take more than its usual work


def healthy_work(points: int, near: float) -> int:
    """Return the work of an ordinary registration of a scan, in point searches.

    Args:
        points: of the scan.
        near: cost of a search near the model, see ``near_work``.
    """
    n, (fixed, each), (searches, passes) = (
        max(points, LEAST_BUDGET_POINTS),
        HEALTHY_FIXED,
        HEALTHY_SEARCHED,
    )
    return int(fixed + each * n + near * (searches + passes * n))


def near_work(surface: Surface, index: SurfaceIndex) -> float:
    """Return the cost of a search near a surface, in units of an ordinary one: it depends on the
    size of the faces.

    Args:
        surface: mesh or cloud.
        index: of it.
    """
    points, normals = sample(surface, NEAR_POINTS)
    points = points[:: max(1, len(points) // NEAR_POINTS)]
    near = points + ORDINARY_NOISE_OF_EXTENT * index.extent_m * normals[: len(points)]
    return index.distances(near, Pose.identity(), np.inf, False, 1, 0.0)[1] / len(near)


def grade_work(points: int, noisy: bool = False) -> int:
    """Return the work of the quality of a pose of a scan of so many points, in point
    searches; of one with noise.
    """
    simulated = SIMULATED_WORK[0] + SIMULATED_WORK[1] * min(points, MOST_SIMULATED) if noisy else 0
    return GRADE_WORK + points // POINTS_GRADED + simulated


def alignment_work(fit: Fit, found: Alignment, graded: int, noisy: bool) -> int:
    """Return the work of an alignment, estimated if not counted, and of its quality.

    Args:
        fit: of the back end.
        found: the alignment.
        graded: points by which its quality was measured.
        noisy: its noise was simulated.
    """
    share = FAR_WORK if found.inlier_ratio < LEAST_NEAR else 1
    free = FREE_WORK + found.points if found.status is AlignStatus.DEGENERATE else 0
    aligned = fit.work or fit.iterations * found.points * share
    return aligned + grade_work(graded, noisy) + free


class Work:
    """Point searches left for one scan: counted work, so that results do not depend on the machine.

    Only the loop over hypotheses has one. The work of fitting the size, which follows the last
    pose, is kept.

    Args:
        healthy: work of an ordinary registration of the scan.

    Attributes:
        healthy: as given.
        left: searches that are left besides what is kept, negative by what follows the last pose.
        exhausted: a step was not made for want of work.
    """

    def __init__(self, healthy: int) -> None:
        self.healthy = healthy
        self.left = int((HEALTHY_SCANS - LAST_STEP) * healthy) - SIZE_WORK
        self.exhausted = False

    def spend(self, searches: int) -> None:
        """Subtract work that was done."""
        self.left -= searches

    def allows(self, searches: int, kept: int = 0) -> bool:
        """Return whether this much work is left besides ``kept`` for a later step; without
        any, it is exhausted.
        """
        self.exhausted = self.exhausted or searches > self.left
        return not self.exhausted and searches + kept <= self.left
