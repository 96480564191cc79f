"""Poses measured and registered by part of a scan, cheaply enough for many hypotheses.

A graduated registration takes point-to-plane passes while the rejection distance falls
geometrically from ``SCREEN_START_OF_EXTENT`` (or the reach) to ``LEAST_GATE_OF_EXTENT`` of the
extent. The falling distance rejects outliers, which the rms rule of the normal alignment cannot do
if they are the majority. Poses are compared by truncated squared distances at a common width.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.register.backend import LEAST_GATE_OF_EXTENT, Target
from avsreplay.register.plausibility import NOISE_OF_EXTENT, PlausibilityTest
from avsreplay.register.quality import PART
from avsreplay.register.surface_index import IcpParams
from avsreplay.register.work import CALL_WORK, LEAST_RATIO, STAGE_WORK

POINTS = PART  # points of the scan by which hypotheses are screened
HOPEFUL_POINTS = 150  # points that show whether a guess is hopeful
# first rejection distance over the extent
SCREEN_START_OF_EXTENT = 0.05
# factor on the rejection distance per stage, and passes per stage
SCREEN_FALL = 0.6
PASSES = 4
# A pose replaces the first of several with a cost below this share of its cost. Nearer to 1, poses
# are exchanged by the chance of noise.
BETTER_THAN = 0.9
# points nearer than so many widths are near; a rest is another object if nearly all of these are on
NEAR_WIDTHS = 5.0


@value_class
class Screened:
    """A pose T_ca, the distances (k,) [m] of the points used, their robust noise [m], and the work
    in point searches that it took.
    """

    T_ca: Pose
    distance: Array
    noise_m: float
    work: int = 0

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
            int(np.count_nonzero(self.distance < factor * width_m)) for factor in (1.0, NEAR_WIDTHS)
        )
        return on >= LEAST_RATIO * near


class Screen:
    """Measures and registers poses of one target by part of a scan.

    Attributes:
        narrow_m, wide_m: rejection distances from which graduated registrations begin [m].
    """

    def __init__(self, target: Target, test: PlausibilityTest) -> None:
        self._target, self._test = target, test
        self._extent = target.surface.extent
        self.narrow_m = SCREEN_START_OF_EXTENT * self._extent
        self.wide_m = max(target.limits.reach_m, self.narrow_m)
        self._stages = {start: self._stages_from(start) for start in (self.narrow_m, self.wide_m)}

    def _stages_from(self, start_m: float) -> list[dict[bool, IcpParams]]:
        """The rules of the stages with falling rejection distance, without and with the facing
        test.
        """
        gates, gate = [], start_m
        while gate > LEAST_GATE_OF_EXTENT * self._extent:
            gates.append(gate)
            gate *= SCREEN_FALL
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

    def measure(self, points: NDArray[Any], T_ca: Pose, guess: Pose | None = None) -> Screened:
        """Return the distances of ``points`` (n, 3) in {A} at a pose; ``guess``: as of
        ``PlausibilityTest.noise``.
        """
        at, work = self._target.visibility.distances(self._target.index, points, T_ca, np.inf)
        return Screened(T_ca, at, self._test.noise(at, T_ca, guess), work + CALL_WORK)

    def graduated(self, points: NDArray[Any], T_ca: Pose, start_m: float) -> Screened:
        """Return the pose after passes with a falling rejection distance, from ``start_m``
        [m] on.
        """
        index, work = self._target.index, 0
        for rules in self._stages[start_m]:
            facing = self._target.visibility.camera_c(index, points, T_ca) is not None
            found = index.icp(points, T_ca, rules[facing])
            T_ca = Pose.from_matrix(found.T_ca)
            work += found.work + STAGE_WORK
        at = self.measure(points, T_ca)
        return replace(at, work=at.work + work)

    def passes(self, start_m: float) -> int:
        """Return the largest number of passes of one graduated registration."""
        return PASSES * len(self._stages[start_m])

    def confirms(self, scan: NDArray[Any], guess: Pose) -> tuple[bool, int]:
        """Return whether few points of a scan (n, 3) in {A}, registered from a guess T_ac, are
        mostly on the model; and the work.
        """
        few = scan[:: max(1, len(scan) // HOPEFUL_POINTS)]
        found = self.graduated(few, guess.inverse(), self.wide_m)
        width = max(self._target.limits.gate_m, 3.0 * found.noise_m)
        on = float(np.mean(found.distance < width))
        return found.noise_m <= NOISE_OF_EXTENT * self._extent and on >= LEAST_RATIO, found.work

    def width(self, at: Screened) -> float:
        """Return the rejection distance [m] for a scan that is not clean: three standard deviations
        of its noise.

        A larger distance would include points of other objects next to the surface, which bias the
        pose.
        """
        noise = min(at.noise_m, NOISE_OF_EXTENT * self._extent)
        return max(
            min(self._target.limits.gate_m, LEAST_GATE_OF_EXTENT * self._extent), 3.0 * noise
        )

    def least(self, found: list[Screened]) -> Screened:
        """Return the pose of least cost, but the first one if none has a clearly lower cost."""
        width = max(self._target.limits.gate_m, 3.0 * min(each.noise_m for each in found))
        least = min(found, key=lambda each: each.cost(width))
        return least if least.cost(width) < BETTER_THAN * found[0].cost(width) else found[0]
