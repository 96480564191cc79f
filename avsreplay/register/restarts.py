"""Restarts of a registration whose fit is poor or whose pose is implausible, within a budget of point searches.

A restart is a graduated registration of part of the scan: point-to-plane passes while the rejection distance falls
geometrically from ``START_OF_EXTENT`` (or the reach) to ``STOP_OF_EXTENT`` of the extent. The falling distance rejects
outliers, which the rms rule of the normal loop cannot do if they are the majority. Starts: the guess and the first
result, then rotations about them. The best pose is found by truncated squared distances at a common width.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.register.backend import Target
from avsreplay.register.plausibility import PlausibilityTest, robust_noise
from avsreplay.register.surface_index import IcpParams

POINTS = 1500  # points of the scan used by restarts
START_OF_EXTENT, STOP_OF_EXTENT = 0.05, 0.004
FALL, PASSES = 0.6, 4  # factor on the rejection distance per stage, and passes per stage
TURN_RAD = np.radians(4.0)
BETTER_THAN = 0.9  # a restart replaces the first result only if its cost is below this share
PASS_WORK = 3000  # what a pass of a restart costs besides its points, in point searches
SAME_POSE = 1e-9  # two poses with entries nearer than this (lengths: times the extent) are one
NEAR, MOSTLY = 5.0, 0.9  # another object: of the points nearer than so many widths this share is on the model
HEALTHY_PASSES = 12  # passes of an ordinary registration, over all points of the scan
FIXED_WORK = 15_000  # what a registration costs besides its points: quality, covariance
HEALTHY_SCANS = 20  # most work for one scan in units of an ordinary registration


class Budget:
    """Point searches left for one scan: counted work, so that results do not depend on the machine.

    Args:
        points: points of the scan.
        spent: point searches made so far.
    """

    def __init__(self, points: int, spent: int = 0) -> None:
        self._left = HEALTHY_SCANS * (HEALTHY_PASSES * points + FIXED_WORK) - spent
        self.exhausted = False

    def spend(self, searches: int) -> None:
        """Subtract work that was done."""
        self._left -= searches

    def allows(self, searches: int) -> bool:
        """Return whether this much work is left; if not, the budget is exhausted."""
        self.exhausted = self.exhausted or searches > self._left
        return not self.exhausted


@dataclass(frozen=True, slots=True, eq=False)
class Restart:
    """A pose T_ca, the distances (k,) [m] of the points used, and their robust noise [m]."""

    T_ca: Pose
    distance: Array
    noise_m: float

    def cost(self, width_m: float) -> float:
        """Return the mean of min(1, squared distance in units of the width)."""
        return float(np.mean(np.minimum(self.distance / width_m, 1.0) ** 2))

    def separate(self, width_m: float) -> bool:
        """Return whether the points off the model are well away from it, as those of another object are."""
        on, near = (int(np.count_nonzero(self.distance < factor * width_m)) for factor in (1.0, NEAR))
        return on >= MOSTLY * near


class Restarter:
    """Restarts for one target."""

    def __init__(self, target: Target, test: PlausibilityTest) -> None:
        self._target, self._test = target, test
        self._extent = target.surface.extent
        vertices = target.surface.vertices
        self._middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        narrow, wide = START_OF_EXTENT * self._extent, target.limits.reach_m
        self._narrow, self._wide = narrow, max(wide, narrow)
        self._stages = {start: self._stages_from(start) for start in (self._narrow, self._wide)}

    def _stages_from(self, start_m: float) -> list[dict[bool, IcpParams]]:
        """The rules of the stages with falling rejection distance, without and with the facing test."""
        gates, gate = [], start_m
        while gate > STOP_OF_EXTENT * self._extent:
            gates.append(gate)
            gate *= FALL
        rule = IcpParams(n_max=PASSES, n_plane=PASSES, tighten=0.0, eps_rad=1e-4, eps_m=1e-4 * self._extent)
        return [{facing: replace(rule, gate_m=gate, facing=facing) for facing in (False, True)} for gate in gates]

    def part(self, points: NDArray[Any]) -> NDArray[Any]:
        """Return about ``POINTS`` points of the scan (n, 3), evenly over its order."""
        return points[np.linspace(0, len(points) - 1, POINTS).astype(np.intp)] if len(points) > POINTS else points

    def measure(self, points: NDArray[Any], T_ca: Pose) -> Restart:
        """Return the distances of ``points`` (n, 3) in {A} at a pose."""
        distance = self._test.measure(points, T_ca)
        return Restart(T_ca, distance, robust_noise(distance))

    def graduated(self, points: NDArray[Any], T_ca: Pose, start_m: float, budget: Budget) -> Restart:
        """Return the pose after passes with a falling rejection distance, from ``start_m`` [m] on."""
        index = self._target.index
        for rules in self._stages[start_m]:
            facing = self._target.visibility.camera_c(index, points, T_ca) is not None
            found = index.icp(points, T_ca, rules[facing])
            T_ca = Pose.from_matrix(found.T_ca)
            budget.spend(found.iterations * (len(points) + PASS_WORK))
        return self.measure(points, T_ca)

    def best(
        self, points: NDArray[Any], guess: Pose, result: Pose, budget: Budget, before: Restart | None = None
    ) -> Restart:
        """Return the best of the first result and the restarts, all T_ca; ends at the first plausible pose.

        Args:
            points: the part of the scan in {A} [m].
            guess: initial pose of the first registration.
            result: its result.
            budget: work that is left.
            before: best of the restarts from guess and result; the starts are then poses turned by ``TURN_RAD``.
        """
        found = [self.measure(points, result), *([before] if before else [])]
        tested: Restart | None = None  # the last pose that was tested, and is not plausible
        for T_ca, start in self._starts(guess, result, points.mean(axis=0), before is not None):
            if not budget.allows(self.work(start) * (len(points) + PASS_WORK)):
                break
            found.append(self.graduated(points, T_ca, start, budget))
            best = self._least(found)
            if best is tested or not self._confirmed(best, found):
                continue
            if not self._test.check(points, best.T_ca).reason:
                break
            tested = best
        return self._least(found)

    def work(self, start_m: float) -> int:
        """Return the largest number of passes of one graduated registration."""
        return PASSES * len(self._stages[start_m])

    def _confirmed(self, best: Restart, found: list[Restart]) -> bool:
        """Whether two starts led to the best pose."""
        same = (self._same(best.T_ca, other.T_ca) for other in found if other is not best)
        return any(same)

    def _least(self, found: list[Restart]) -> Restart:
        width = max(self._target.limits.gate_m, 3.0 * min(each.noise_m for each in found))
        least = min(found, key=lambda each: each.cost(width))
        return least if least.cost(width) < BETTER_THAN * found[0].cost(width) else found[0]

    def _same(self, T_a: Pose, T_b: Pose) -> bool:
        step = T_a @ T_b.inverse()  # in {C}
        if float(geometry.angle(step.q)) >= np.radians(1.0):
            return False
        return float(np.linalg.norm(step.apply(self._middle) - self._middle)) < 0.01 * self._extent

    def _starts(self, guess: Pose, result: Pose, centre_a: Array, turned: bool) -> Iterator[tuple[Pose, float]]:
        """Guess and result with a narrow and a wide start, or both rotated by TURN_RAD about each axis of {C}."""
        narrow = self._narrow
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
