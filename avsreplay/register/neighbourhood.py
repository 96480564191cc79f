"""Other local minima near a registered pose, along the directions of motion that the scan
determines least.

Three cases lead to a wrong minimum near the true pose. Points of another object next to the surface
can hold a pose away from the minimum that the surface alone has; the cost is then lower along the
floor of the valley. A scan that shows a small part of the target has several minima, and nearly all
points can be near the model at a wrong one; the scan is then registered again from poses displaced
along these directions. A scan of a panel can be matched to its other side; it is registered again
from a pose that is displaced towards the camera.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus
from avsreplay.register.backend import Target
from avsreplay.register.budget import FAR_WORK, LAST_WORK, LEAST_RATIO, SIZE_WORK, Budget
from avsreplay.register.degenerate import scaled_information
from avsreplay.register.evidence import Observed
from avsreplay.register.grading import Grader
from avsreplay.register.plausibility import NOISE_OF_EXTENT, PlausibilityTest
from avsreplay.register.restarts import STOP_OF_EXTENT, Restart, Restarter
from avsreplay.register.size import SIZE_UNSEEN, size_error, size_remark

VALLEY_STEPS, VALLEY_POINTS = (
    8,
    250,
)  # steps of half a gate each way along the two least certain directions; points
VALLEY_WORK = 16_000  # cost of the search along the valley
POINTS, DIRECTIONS = (
    300,
    3,
)  # points that are registered from displaced poses; directions, each both ways
DISPLACED_OF_EXTENT = 0.03  # rms displacement of the points of the scan
UNMOVED, RADIUS_OF_EXTENT = (
    0.25,
    0.25,
)  # a pose nearer to its guess, in gates, is not compared; usual rms radius
SEVERAL = "the scan shows a part of the target, and another pose near this one explains it as well"
PART_ONLY = (
    "the scan shows too little of the visible surface: without a guess it fits the model in many"
    " places"
)
POSTPONED = (
    "the search for a pose is postponed, because the searches of the scans before found none"
)
NOT_FOUND = "no pose of the model explains the scan, and no work is left for a longer search"
NOT_COMPARED = "no work is left to compare the poses near this one"
UNCERTAIN_RAD = np.radians(
    1.0
)  # a larger standard deviation of the attitude, caused by noise, is stated
# with a smaller rms distance, in gates, the noise is not the cause of an uncertain attitude
NOISY_OF_GATE = 0.2
# a minimum whose excess cost is below so many standard errors of it explains the scan as well
SIGMAS = 4.0


class Neighbourhood:
    """Local minima near registered poses of one target."""

    def __init__(
        self, target: Target, test: PlausibilityTest, restarter: Restarter, grader: Grader
    ) -> None:
        self._target, self._test, self._restarter, self._grader = target, test, restarter, grader
        self._extent = target.surface.extent

    def best(
        self, scan: NDArray[Any], guess: Pose, found: Alignment, budget: Budget
    ) -> tuple[Restart | None, AlignStatus, str]:
        """Return a better minimum around a pose; the status of the better of both, and why it is
        not accepted.

        Nothing is compared at the predicted pose, and where the scan shows all of the target on
        faces that face the camera.

        Args:
            scan: (n, 3) in {A} [m].
            guess: predicted T_ac.
            found: the alignment.
            budget: work that is left.

        Returns:
            None if no minimum is clearly better; "" if no other one explains the scan as well.
        """
        T_ca, aligned = found.T_ac.inverse(), found.status is AlignStatus.ALIGNED
        if not (aligned or found.status is AlignStatus.DEGENERATE) or not self._moved(T_ca, guess):
            return None, found.status, ""
        points = self._restarter.part(scan)
        if not (
            self._test.turned_away(points, T_ca) or (aligned and self._test.partial(points, T_ca))
        ):
            return None, found.status, ""
        if not budget.allows(self._minima_work):
            return None, AlignStatus.BUDGET_EXHAUSTED, NOT_COMPARED
        minima, compared = self._minima(points, T_ca, DIRECTIONS if aligned else 0, budget)
        if not compared:
            return None, AlignStatus.BUDGET_EXHAUSTED, NOT_COMPARED
        best, width = self._restarter.least(minima), 3.0 * min(each.noise_m for each in minima)
        width = max(STOP_OF_EXTENT * self._extent, width)
        others = (each for each in minima if not self._restarter.same(best.T_ca, each.T_ca))
        doubt = SEVERAL if aligned and any(_as_good(best, other, width) for other in others) else ""
        return None if best is minima[0] else best, AlignStatus.AMBIGUOUS, doubt

    def of_both_sides(self, points: NDArray[Any], T_ca: Pose, budget: Budget) -> Restart:
        """Return the best minimum around the result of a search, where a panel can be matched to
        its other side.

        Args:
            points: (n, 3) in {A} [m], part of the scan.
            T_ca: the result.
            budget: work that is left.

        Returns:
            The result itself where only faces towards the camera are matched, where its distances
            are too large for any pose to be accepted, or where no work is left.
        """
        at, target = self._restarter.measure(points, T_ca, budget), self._target
        known = target.visibility.camera_c(target.index, points, T_ca) is not None
        if (
            known
            or at.noise_m > NOISE_OF_EXTENT * self._extent
            or self._minima_work + LAST_WORK > budget.left
        ):
            return at
        return self._restarter.least(self._minima(points, T_ca, DIRECTIONS, budget, LAST_WORK)[0])

    @property
    def _minima_work(self) -> int:
        """The usual cost of the minima around a pose."""
        return int(
            (1 + 2 * DIRECTIONS)
            * FAR_WORK
            * self._restarter.work(self._restarter.narrow_m)
            * POINTS
        )

    def _moved(self, T_ca: Pose, guess: Pose) -> bool:
        """Whether a pose differs from the predicted T_ac ``guess``."""
        step = T_ca @ guess  # in {C}
        turned = float(geometry.angle(step.q)) * RADIUS_OF_EXTENT * self._extent
        return turned + self._restarter.shift(step) > UNMOVED * self._target.limits.gate_m

    def _minima(
        self, points: NDArray[Any], T_ca: Pose, count: int, budget: Budget, kept: int = 0
    ) -> tuple[list[Restart], bool]:
        """The pose, and those registered from poses displaced towards the camera and along
        ``count`` directions.

        Also: whether all were registered; else the work was not enough besides ``kept`` for a later
            step.
        """
        few = points[:: max(1, len(points) // POINTS)]
        found, weak = (
            [self._restarter.measure(points, T_ca, budget)],
            self._weak(few, T_ca, count, budget),
        )
        if weak is None:
            return found, True
        centre, radius, directions = weak[:3]
        dearest = 0  # work of one registration so far
        nearer = np.concatenate([np.zeros(3), T_ca.t - centre])[None] / np.linalg.norm(
            T_ca.t - centre
        )
        for x in (
            DISPLACED_OF_EXTENT * self._extent * np.concatenate([nearer, directions, -directions])
        ):
            start, left = _displaced(T_ca, centre, radius, x), budget.left
            if dearest + kept > left:
                return found, False
            ended = self._restarter.graduated(few, start, self._restarter.narrow_m, budget)
            found.append(self._restarter.measure(points, ended.T_ca, budget))
            dearest = max(dearest, left - budget.left)
        return found, True

    def with_size(self, scan: NDArray[Any], found: Alignment, budget: Budget) -> Alignment:
        """Return an alignment with what its scan (n, 3) in {A} says about the size, if that is
        still to be fitted.

        The covariance is enlarged by the change of the pose that an error of the size of two
        standard errors causes.
        """
        P, part = found.covariance, found.systematic
        if found.size_1s is None or P is None or part is None:
            return found
        budget.spend(SIZE_WORK)
        T_ca, target = found.T_ac.inverse(), self._target
        size = size_error(
            target.index, scan, T_ca, target.visibility.camera_c(target.index, scan, T_ca)
        )
        if size is not None and size.likely:
            P, part = (geometry.frozen(C + np.outer(size.shift, size.shift)) for C in (P, part))
        return replace(
            found,
            covariance=P,
            systematic=part,
            message=size_remark(size, found.size_1s),
            size_1s=None,
        )

    def of_one(self, scan: NDArray[Any], found: Alignment, budget: Budget) -> Alignment:
        """Return the alignment of a scan (n, 3) in {A}, not accepted if the view shows faces of
        many bodies.

        They do not determine the pose, or no error of the size.
        """
        found = self.with_size(scan, found, budget)
        if found.status is not AlignStatus.DEGENERATE and not found.message.startswith(SIZE_UNSEEN):
            return found
        return replace(found, status=AlignStatus.IMPLAUSIBLE, covariance=None, message=PART_ONLY)

    def finished(self, scan: NDArray[Any], found: Alignment, budget: Budget) -> Alignment:
        """Return the alignment with its size; an attitude that noise leaves uncertain is stated if
        nothing else is.

        Args:
            scan: (n, 3) in {A} [m].
            found: the alignment.
            budget: work that is left; it need not suffice.
        """
        found = self.with_size(scan, found, budget)
        P = found.covariance
        if P is None or found.message or found.rms_m <= NOISY_OF_GATE * self._target.limits.gate_m:
            return found
        sigma = float(np.sqrt(np.linalg.eigvalsh(P[:3, :3])[-1]))
        if sigma <= UNCERTAIN_RAD:
            return found
        return replace(
            found,
            message=(
                f"with this noise the attitude is known to {np.degrees(sigma):.1f} deg (1 sigma)"
                " only"
            ),
        )

    def along_valley(self, points: NDArray[Any], T_ca: Pose, budget: Budget) -> Pose | None:
        """Return the best pose along the two directions in which the scan determines it least, or
        the pose itself.

        Args:
            points: (n, 3) in {A} [m].
            T_ca: registered pose.
            budget: work that is left.

        Returns:
            None if the work for the comparison is not left.
        """
        if not budget.allows(VALLEY_WORK + LAST_WORK):
            return None
        budget.spend(VALLEY_WORK)
        few, target = points[:: max(1, len(points) // VALLEY_POINTS)], self._target
        weak = self._weak(few, T_ca, 2, budget)
        if weak is None:
            return T_ca
        centre, radius, floor, at, camera_c = weak
        width = self._restarter.width(at)
        steps = (
            0.5
            * target.limits.gate_m
            * np.delete(np.arange(-VALLEY_STEPS, VALLEY_STEPS + 1), VALLEY_STEPS)
        )
        tried = np.concatenate([np.zeros((1, 6)), np.multiply.outer(steps, floor).reshape(-1, 6)])
        turns = geometry.exp(tried[:, :3] / radius)
        moved = np.einsum("kij,nj->kni", geometry.matrix(turns), T_ca.apply(few) - centre)
        moved += (centre + tried[:, 3:])[:, None]
        d2 = target.index.closest(moved.reshape(-1, 3), camera_c=camera_c, most_m=width).d2.reshape(
            len(tried), -1
        )
        best = int(np.argmin(np.minimum(d2, width**2).mean(axis=1)))
        return _displaced(T_ca, centre, radius, tried[best]) if best else T_ca

    def regraded(
        self,
        scan: NDArray[Any],
        few: NDArray[Any],
        kept: Restart | Pose,
        budget: Budget,
        halves: bool,
        carried: bool,
    ) -> Alignment:
        """Return an alignment with a rejection distance that follows the noise; among other objects
        along the valley.

        Args:
            scan: (n, 3) in {A} [m].
            few: part of it.
            kept: the pose T_ca to begin with, measured or not.
            budget: work that is left.
            halves: as of ``Grader.graded``.
            carried: as well.
        """
        kept = self._restarter.measure(few, kept, budget) if isinstance(kept, Pose) else kept
        width = self._restarter.width(kept)
        found = self._grader.graded(scan, kept.T_ca.inverse(), budget, width, halves, carried)
        if found.status is not AlignStatus.ALIGNED or found.inlier_ratio >= LEAST_RATIO:
            return found
        moved = self.along_valley(few, found.T_ac.inverse(), budget)
        if moved is None:
            return replace(
                found, status=AlignStatus.BUDGET_EXHAUSTED, covariance=None, message=NOT_COMPARED
            )
        if moved.t.tobytes() == found.T_ac.inverse().t.tobytes():
            return found
        again = self._grader.graded(scan, moved.inverse(), budget, width, halves, carried)
        return self._restarter.nearest(few, [found, again], width, budget)

    def replaced(
        self, scan: NDArray[Any], found: Alignment, T_ca: Pose, budget: Budget, carried: bool
    ) -> Alignment:
        """Return the alignment at a pose for which the rays decide against an accepted one;
        IMPLAUSIBLE as tested.

        Args:
            scan: (n, 3) in {A} [m].
            found: the alignment that is contradicted.
            T_ca: the pose.
            budget: work that is left; if it does not suffice, the scan has no accepted pose.
            carried: as of ``Grader.graded``.
        """
        if not budget.allows(LAST_WORK):
            return replace(
                found, status=AlignStatus.BUDGET_EXHAUSTED, covariance=None, message=NOT_COMPARED
            )
        few = self._restarter.part(scan)
        found = self.regraded(scan, few, T_ca, budget, True, carried)
        reason = self._restarter.reason(Observed(scan), found, budget, None)
        return (
            replace(found, status=AlignStatus.IMPLAUSIBLE, covariance=None, message=reason)
            if reason
            else found
        )

    def at_pose(
        self, scan: NDArray[Any], T_ca: Pose, budget: Budget, halves: bool, carried: bool
    ) -> Alignment:
        """Return an alignment of a scan (n, 3) in {A} at a pose that is known to be the best of
        several minima.

        A wide rejection distance can lead to another minimum, and with a narrow one the few points
        of a mark may not determine the pose. Of both the nearer one is returned, and the wide one
        if they end at the same pose.

        Args:
            scan: (n, 3) in {A} [m].
            T_ca: the pose.
            budget: work that is left.
            halves: as of ``Grader.graded``.
            carried: as well.
        """
        few = self._restarter.part(scan)
        found = self.regraded(scan, few, T_ca, budget, halves, carried)
        if not budget.allows(LAST_WORK):
            return found
        wide = self._grader.graded(scan, T_ca.inverse(), budget, None, halves, carried)
        if self._restarter.same(wide.T_ac.inverse(), found.T_ac.inverse()):
            return wide
        return self._restarter.nearest(few, [found, wide], self._target.limits.gate_m, budget)

    def _weak(
        self, few: NDArray[Any], T_ca: Pose, count: int, budget: Budget
    ) -> tuple[Array, float, Array, Restart, Array | None] | None:
        """Centroid and rms radius of the inliers, and the motions x (count, 6) that they determine
        least.

        Also the distances at the pose, and the position of the camera in {C} if only faces towards
        it are matched. None with fewer than six inliers, which do not determine a pose.
        """
        target, gate = self._target, self._target.limits.gate_m
        at = self._restarter.measure(few, T_ca, budget)
        camera_c = target.visibility.camera_c(target.index, few, T_ca)
        on = at.distance < gate
        sums = target.index.normal_equations(few, T_ca, gate, facing=camera_c is not None)
        if min(sums.inliers, int(on.sum())) < 6:
            return None
        centre = T_ca.apply(few[on]).mean(axis=0)
        info, radius = scaled_information(sums.info, sums.inliers, centre)
        return centre, radius, np.linalg.eigh(info)[1][:, :count].T, at, camera_c


def _displaced(T_ca: Pose, centre: Array, radius_m: float, x: Array) -> Pose:
    """The pose moved by x = [L theta; u] (6,) about a centre (3,) in {C} [m], with the rms
    radius L.
    """
    turn = geometry.exp(x[:3] / radius_m)
    return Pose(turn, centre + x[3:] - geometry.matrix(turn) @ centre) @ T_ca


def _as_good(best: Restart, other: Restart, width_m: float) -> bool:
    """Whether the excess cost of the other pose, point by point, is below ``SIGMAS`` standard
    errors of its mean.
    """
    excess = other.costs(width_m) - best.costs(width_m)
    return bool(excess.mean() < SIGMAS * excess.std() / np.sqrt(len(excess)))
