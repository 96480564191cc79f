"""The work that one scan may cost, counted in point searches, so that results do not depend on the machine."""

from __future__ import annotations

from enum import Enum

from avsreplay.records import Alignment, Fit
from avsreplay.register.backend import FIXED_WORK, healthy_work

LEAST_RATIO = 0.9  # with fewer inliers a fit is not close
FAR_WORK, LEAST_NEAR = 2, 0.5  # searches per point of a pass while less than this share of the points is on the model
SCATTER_WORK = 10  # cost per point of leaving out scattered points
TEST_WORK = SIZE_WORK = 23_000  # cost of a test of a pose, and of fitting the size
PASS_WORK, MEASURED_WORK = 1500, 4  # cost of a stage of a restart, and of a point measured at a pose [searches]
HEALTHY_SCANS = 20  # most work for one scan in units of an ordinary registration
SPARED = 50  # after so many scans without an accepted pose, the guess is tested on every second scan, and so on


class Effort(Enum):
    """What is done for a scan of a run without an accepted pose."""

    FULL = "registration, restarts and searches"
    GUESS = "the same if few points confirm the guess"
    NONE = "nothing"


def effort_after(failed: int) -> Effort:
    """Return what is done for a scan before the first accepted pose.

    Restarts and searches are made on the first five scans and then after delays of at most half of the scans so far.
    On the scans between the guess is tested, after n scans on one in 1 + n / ``SPARED`` of them. The total work
    therefore stays small with a wrong model, of which no pose explains any scan.

    Args:
        failed: scans before this one on which no pose was accepted.
    """
    due = 0
    while due < failed:
        due += max(1, due // 2)
    if due == failed:
        return Effort.FULL
    return Effort.NONE if failed % (1 + failed // SPARED) else Effort.GUESS


class Budget:
    """Point searches left for one scan: counted work, so that results do not depend on the machine.

    Args:
        points: points of the scan.
    """

    def __init__(self, points: int) -> None:
        self.left = HEALTHY_SCANS * healthy_work(points)
        self.exhausted = False

    def spend(self, searches: int) -> None:
        """Subtract work that was done."""
        self.left -= searches

    def registered(self, fit: Fit, found: Alignment) -> None:
        """Subtract the work of an alignment and of its quality; that of back ends that do not count is estimated."""
        share = FAR_WORK if found.inlier_ratio < LEAST_NEAR else 1
        self.spend((fit.work or fit.iterations * found.points * share) + FIXED_WORK)

    def allows(self, searches: int, kept: int = 0) -> bool:
        """Return whether this much work is left besides ``kept`` for a later step; without any, it is exhausted."""
        self.exhausted = self.exhausted or searches > self.left
        return not self.exhausted and searches + kept <= self.left
