"""Restarts of a registration whose fit is poor or whose pose is implausible, within a budget of
point searches.

A restart is a graduated registration of part of the scan: point-to-plane passes while the rejection
distance falls geometrically from ``START_OF_EXTENT`` (or the reach) to ``STOP_OF_EXTENT`` of the
extent. The falling distance rejects outliers, which the rms rule of the normal loop cannot do if
they are the majority. Starts: the guess and the first result, then rotations about them. The best
pose is found by truncated squared distances at a common width.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus
from avsreplay.register.backend import Target
from avsreplay.register.budget import (
    CALL_WORK,
    FAR_WORK,
    LEAST_RATIO,
    STAGE_WORK,
    TEST_WORK,
    Budget,
)
from avsreplay.register.evidence import Observed
from avsreplay.register.plausibility import NOISE_OF_EXTENT, PlausibilityTest
from avsreplay.register.quality import PART
from avsreplay.register.surface_index import IcpParams

# with at least LEAST_RATIO of inliers and a smaller rms (in units of the gate) a fit is close
POOR_OF_GATE = 0.3
POINTS, FEW = (
    PART,
    150,
)  # points of the scan used by restarts, and those that show whether a guess is hopeful
START_OF_EXTENT, STOP_OF_EXTENT = 0.05, 0.004
FALL, PASSES = 0.6, 4  # factor on the rejection distance per stage, and passes per stage
TURN_RAD = np.radians(4.0)
# with more inliers too few points are left that could continue beyond an edge of the model
COMPLETE = 0.985
LEAST_BEYOND = 10  # of 1,000 points well off the model, from which a close fit is judged
BETTER_THAN, NEARER = (
    0.9,
    0.999,
)  # a restart, or a second alignment, replaces the first with a cost below this share
SAME_POSE = 1e-9  # two poses with entries nearer than this (lengths: times the extent) are one
NEAR, MOSTLY = (
    5.0,
    0.9,
)  # a rest is another object if this share of points nearer than so many widths is on the model
HOPELESS = (
    1.5 * NOISE_OF_EXTENT
)  # with more noise at the result of a search it is not registered to the whole scan


@value_class
class Restart:
    """A pose T_ca, the distances (k,) [m] of the points used, and their robust noise [m]."""

    T_ca: Pose
    distance: Array
    noise_m: float

    def costs(self, width_m: float) -> Array:
        """Return min(1, squared distance in units of the width) of each point."""
        return np.asarray(np.minimum(self.distance / width_m, 1.0) ** 2)

    def cost(self, width_m: float) -> float:
        """Return the mean of :meth:`costs`."""
        return float(np.mean(self.costs(width_m)))

    def separate(self, width_m: float) -> bool:
        """Return whether the points off the model are well away from it, as those of another object
        are.
        """
        on, near = (
            int(np.count_nonzero(self.distance < factor * width_m)) for factor in (1.0, NEAR)
        )
        return on >= MOSTLY * near


class Restarter:
    """Restarts for one target."""

    def __init__(self, target: Target, test: PlausibilityTest) -> None:
        self._target, self._test = target, test
        self._extent = target.surface.extent
        vertices = target.surface.vertices
        self._middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        narrow, wide = START_OF_EXTENT * self._extent, target.limits.reach_m
        self.narrow_m, self._wide = narrow, max(wide, narrow)
        self._stages = {start: self._stages_from(start) for start in (self.narrow_m, self._wide)}

    def _stages_from(self, start_m: float) -> list[dict[bool, IcpParams]]:
        """The rules of the stages with falling rejection distance, without and with the facing
        test.
        """
        gates, gate = [], start_m
        while gate > STOP_OF_EXTENT * self._extent:
            gates.append(gate)
            gate *= FALL
        rule = IcpParams(
            n_max=PASSES, n_plane=PASSES, tighten=0.0, eps_rad=1e-4, eps_m=1e-4 * self._extent
        )
        return [
            {facing: replace(rule, gate_m=gate, facing=facing) for facing in (False, True)}
            for gate in gates
        ]

    def part(self, points: NDArray[Any]) -> NDArray[Any]:
        """Return about ``POINTS`` points of the scan (n, 3), evenly over its order."""
        return (
            points[np.linspace(0, len(points) - 1, POINTS).astype(np.intp)]
            if len(points) > POINTS
            else points
        )

    def measure(
        self, points: NDArray[Any], T_ca: Pose, budget: Budget, guess: Pose | None = None
    ) -> Restart:
        """Return the distances of ``points`` (n, 3) in {A} at a pose; ``guess``: as of
        ``PlausibilityTest.noise``.
        """
        at, work = self._target.visibility.distances(self._target.index, points, T_ca, np.inf)
        budget.spend(work + CALL_WORK)
        return Restart(T_ca, at, self._test.noise(at, T_ca, guess))

    def starts(
        self, points: NDArray[Any], first: Alignment, guess: Pose, budget: Budget
    ) -> list[Restart]:
        """Return a registered pose, and its guess T_ac if part of ``points`` (n, 3) in {A} is off
        and it is as near.

        The wide rejection distance of the first passes can lead away from a good guess on a target
        that is hidden.
        """
        at, before = (
            self.measure(points, T_ac.inverse(), budget, guess) for T_ac in (first.T_ac, guess)
        )
        worse = BETTER_THAN * before.cost(self._target.limits.gate_m) > at.cost(
            self._target.limits.gate_m
        )
        return [at] if worse or first.inlier_ratio >= LEAST_RATIO else [at, before]

    def consistent(
        self, points: NDArray[Any], guess: Pose, found: Alignment, budget: Budget
    ) -> Alignment:
        """Return the alignment with a covariance that is not contradicted by the distances at the
        predicted pose.

        Where little of the target is in the scan, the distances can be nearly as small along a
        curve of poses, far beyond the covariance at its lowest point. With d the step to the
        prediction, x its chi-square by the distances and y that by the covariance P, P + d d' (1 /
        x - 1 / y) has the chi-square x if x < y.

        Args:
            points: (n, 3) in {A} [m], part of the scan.
            guess: predicted T_ac.
            found: the alignment.
            budget: of the scan.
        """
        P = found.covariance
        if (
            P is None
            or found.inlier_ratio >= LEAST_RATIO
            or not self._test.predicted(found.T_ac.inverse(), guess)
        ):
            return found
        at, before = (
            self.measure(points, T_ac.inverse(), budget, guess) for T_ac in (found.T_ac, guess)
        )
        step = found.T_ac.inverse() @ guess
        d = np.concatenate([geometry.log(step.q), step.t])
        width, noise = self.width(at), max(at.noise_m, before.noise_m, np.finfo(float).tiny)
        by_distances = found.points * (before.cost(width) - at.cost(width)) * (width / noise) ** 2
        missing = 1.0 / max(by_distances, 1.0) - 1.0 / max(
            float(d @ np.linalg.solve(P, d)), np.finfo(float).tiny
        )
        if missing <= 0.0:
            return found
        wider = P + missing * np.outer(d, d)
        return replace(
            found, covariance=geometry.frozen(wider), info=geometry.frozen(np.linalg.inv(wider))
        )

    def width(self, at: Restart) -> float:
        """Return the rejection distance [m] for a scan that is not clean: three standard deviations
        of its noise.

        A larger distance would include points of other objects next to the surface, which bias the
        pose.
        """
        noise = min(at.noise_m, NOISE_OF_EXTENT * self._extent)
        return max(min(self._target.limits.gate_m, STOP_OF_EXTENT * self._extent), 3.0 * noise)

    def nearest(
        self, few: NDArray[Any], found: list[Alignment], width_m: float, budget: Budget
    ) -> Alignment:
        """Return the second alignment if the points, none farther than ``width_m``, are nearer to
        the model there.
        """
        cost = [self.measure(few, each.T_ac.inverse(), budget).cost(width_m) for each in found]
        return found[cost[1] < NEARER * cost[0]]

    def reason(self, scan: Observed, found: Alignment, budget: Budget, guess: Pose | None) -> str:
        """Return why a pose is not plausible; "" if it is, or nothing was measured."""
        budget.spend(TEST_WORK)
        return self._test.reason(scan, found.T_ac.inverse(), guess) if found.measured else ""

    def healthy(self, inlier_ratio: float, rms_m: float) -> bool:
        """Return whether an alignment is a close fit of nearly all points, which needs no further
        test.
        """
        return inlier_ratio >= LEAST_RATIO and rms_m <= POOR_OF_GATE * self._target.limits.gate_m

    def sound(self, scan: Observed, found: Alignment, budget: Budget) -> bool:
        """Return whether an alignment of a scan is healthy; where points are well off the
        model, also by its evidence.
        """
        close = self.healthy(found.inlier_ratio, found.rms_m)
        if not close or found.inlier_ratio >= COMPLETE or found.well_off < LEAST_BEYOND:
            return close
        budget.spend(TEST_WORK)
        return not self._test.reason(scan, found.T_ac.inverse())

    def doubtful(
        self,
        points: NDArray[Any],
        scan: Observed,
        guess: Pose,
        found: Alignment,
        budget: Budget,
    ) -> bool:
        """Return whether an alignment may be a local minimum.

        After a failure, a poor fit of a part of the scan, or away from the guess a poor fit of all
        whose evidence leaves a doubt.

        Args:
            points: (n, 3) in {A} [m], part of the scan.
            scan: the scan.
            guess: T_ac from which it was registered.
            found: its result.
            budget: of the scan.
        """
        if found.status is AlignStatus.FAILED or not found.inliers:
            return True
        T_ca, gate = found.T_ac.inverse(), self._target.limits.gate_m
        poor = POOR_OF_GATE * gate
        if found.rms_m <= poor:
            return False
        moved = T_ca.apply(points) - guess.inverse().apply(points)
        if (
            found.inlier_ratio >= LEAST_RATIO
            and float(np.linalg.norm(moved, axis=1).mean()) <= gate
        ):
            return False
        budget.spend(TEST_WORK)
        at = self._test.check(scan, T_ca)
        return at is None or at.doubtful

    def graduated(
        self, points: NDArray[Any], T_ca: Pose, start_m: float, budget: Budget
    ) -> Restart:
        """Return the pose after passes with a falling rejection distance, from ``start_m``
        [m] on.
        """
        index = self._target.index
        for rules in self._stages[start_m]:
            facing = self._target.visibility.camera_c(index, points, T_ca) is not None
            found = index.icp(points, T_ca, rules[facing])
            T_ca = Pose.from_matrix(found.T_ca)
            budget.spend(found.work + STAGE_WORK)
        return self.measure(points, T_ca, budget)

    def hopeful(self, scan: NDArray[Any], guess: Pose, budget: Budget) -> bool:
        """Return whether few points of a scan (n, 3) in {A}, registered from a guess T_ac, are
        mostly on the model.
        """
        few = scan[:: max(1, len(scan) // FEW)]
        found = self.graduated(few, guess.inverse(), self._wide, budget)
        width = max(self._target.limits.gate_m, 3.0 * found.noise_m)
        on = float(np.mean(found.distance < width))
        return found.noise_m <= NOISE_OF_EXTENT * self._extent and on >= LEAST_RATIO

    def best(
        self,
        points: NDArray[Any],
        scan: Observed,
        guess: Pose,
        result: Pose,
        budget: Budget,
        before: Restart | None = None,
        kept: int = 0,
    ) -> Restart:
        """Return the best of the first result and the restarts, all T_ca; ends at the first
        plausible pose.

        Args:
            points: the part of the scan in {A} [m].
            scan: the scan.
            guess: initial pose of the first registration.
            result: its result.
            budget: work that is left.
            before: best of the restarts from guess and result; the starts are then poses turned by
                ``TURN_RAD``.
            kept: work that is kept for a later step.
        """
        found = [self.measure(points, result, budget), *([before] if before else [])]
        tested: Restart | None = None  # the last pose that was tested, and is not plausible
        for T_ca, start in self._starts(guess, result, points.mean(axis=0), before is not None):
            if not budget.allows(self.work(start) * FAR_WORK * len(points), kept):
                break
            found.append(self.graduated(points, T_ca, start, budget))
            best = self.least(found)
            if best is tested or not any(
                self.same(best.T_ca, each.T_ca) for each in found if each is not best
            ):
                continue  # not yet confirmed by a second start
            budget.spend(TEST_WORK)
            if not self._test.reason(scan, best.T_ca):
                break
            tested = best
        return self.least(found)

    def work(self, start_m: float) -> int:
        """Return the largest number of passes of one graduated registration."""
        return PASSES * len(self._stages[start_m])

    def least(self, found: list[Restart]) -> Restart:
        """Return the pose of least cost, but the first one if none has a clearly lower cost."""
        width = max(self._target.limits.gate_m, 3.0 * min(each.noise_m for each in found))
        least = min(found, key=lambda each: each.cost(width))
        return least if least.cost(width) < BETTER_THAN * found[0].cost(width) else found[0]

    def same(self, T_a: Pose, T_b: Pose) -> bool:
        """Return whether two poses T_ca differ by less than 1 deg and 0.01 of the extent."""
        step = T_a @ T_b.inverse()  # in {C}
        if float(geometry.angle(step.q)) >= np.radians(1.0):
            return False
        return self.shift(step) < 0.01 * self._extent

    def shift(self, step: Pose) -> float:
        """Return by how much a motion in {C} moves the middle of the model [m]."""
        return float(np.linalg.norm(step.apply(self._middle) - self._middle))

    def _starts(
        self, guess: Pose, result: Pose, centre_a: Array, turned: bool
    ) -> Iterator[tuple[Pose, float]]:
        """Guess and result with a narrow and a wide start, or both rotated by TURN_RAD about each
        axis of {C}.
        """
        narrow = self.narrow_m
        apart = np.abs(guess.matrix - result.matrix) / np.array([1.0, 1.0, 1.0, self._extent])
        bases = (guess, result) if apart.max() > SAME_POSE else (guess,)
        if not turned:
            yield from ((base, narrow) for base in bases)
            yield guess, self._wide
        for base in bases if turned else ():
            centre = base.apply(centre_a)
            for axis in np.eye(3):
                for sign in (1.0, -1.0):
                    turn = geometry.exp(sign * TURN_RAD * axis)
                    yield Pose(turn, centre - geometry.matrix(turn) @ centre) @ base, narrow
