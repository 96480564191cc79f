"""Other local minima near a pose, along the directions of motion that the scan determines least,
and the other side of a panel.

A scan that shows a small part of the target has several minima, and nearly all points can be near
the model at a wrong one; the scan is then registered again from poses displaced along these
directions. A scan of a panel can be matched to its other side; it is registered again from a pose
that is displaced towards the camera.
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
from avsreplay.records import AlignStatus
from avsreplay.register.backend import LEAST_GATE_OF_EXTENT, RADIUS_OF_EXTENT, Target
from avsreplay.register.comparison import as_good
from avsreplay.register.degenerate import scaled_information
from avsreplay.register.hypotheses import Candidate, Case, Generator, Hypothesis
from avsreplay.register.plausibility import PlausibilityTest
from avsreplay.register.poses import ONE_MINIMUM, Sameness
from avsreplay.register.screening import Screen, Screened

DISPLACED_POINTS = 300  # points that are registered from displaced poses
DIRECTIONS = 3  # weak directions, each both ways
DISPLACED_OF_EXTENT = 0.03  # rms displacement of the points of the scan
# As ``comparison.CHANCE_SIGMAS``, for minima beside the pose, of which the guess excludes most.
# With that value a right pose of a scan that shows 30 % of a target was not accepted.
BESIDE_SIGMAS = 4.0
LEAST_INLIERS = 6  # which determine a pose
UNMOVED = 0.25  # a pose nearer to its guess, in gates, is not compared


@value_class
class Weak:
    """The motions that a scan determines least at a pose.

    Attributes:
        centre, radius_m: (3,) mean and rms radius of the inliers in {C} [m].
        motions: (k, 6) displacements x = [L theta; u] [m] with the radius L about the centre.
        at: the distances at the pose.
    """

    centre: Array
    radius_m: float
    motions: Array
    at: Screened

    def displaced(self, x: Array) -> Pose:
        """Return the pose moved by x (6,)."""
        turn = geometry.exp(x[:3] / self.radius_m)
        shift = self.centre + x[3:] - geometry.matrix(turn) @ self.centre
        return Pose(turn, shift) @ self.at.T_ca


def weak_motions(
    target: Target, screen: Screen, few: NDArray[Any], T_ca: Pose, count: int
) -> Weak | None:
    """Return the ``count`` motions that points (n, 3) in {A} determine least at a pose.

    None with fewer than ``LEAST_INLIERS`` on the model, which do not determine a pose.
    """
    gate, at = target.limits.gate_m, screen.measure(few, T_ca)
    camera_c = target.visibility.camera_c(target.index, few, T_ca)
    on = at.distance < gate
    sums = target.index.normal_equations(few, T_ca, gate, facing=camera_c is not None)
    if min(sums.inliers, int(on.sum())) < LEAST_INLIERS:
        return None
    centre = T_ca.apply(few[on]).mean(axis=0)
    info, radius = scaled_information(sums.info, sums.inliers, centre)
    motions = np.linalg.eigh(info)[1][:, :count].T
    return Weak(centre, radius, motions, at)


class WeakDirections(Generator):
    """Poses registered again after displacements along weak directions and towards the camera."""

    def __init__(
        self, target: Target, test: PlausibilityTest, screen: Screen, poses: Sameness
    ) -> None:
        self._target, self._test, self._screen, self._poses = target, test, screen, poses
        self._extent = target.surface.extent

    def needed(self, case: Case) -> bool:
        """Return whether other minima near the candidate are possible: not at the predicted pose,
        and not where the scan shows all of the target on faces that face the camera. Of the result
        of a search, whether a panel can be matched to its other side.
        """
        at, target = case.at, self._target
        if case.guess is None:
            return target.visibility.camera_c(target.index, case.few, at.T_ca) is None
        if not at.accepted or not self._moved(at.T_ca, case.guess):
            return False
        aligned = at.found.status is AlignStatus.ALIGNED
        return self._test.turned_away(case.few, at.T_ca) or (
            aligned and self._test.partial(case.few, at.T_ca)
        )

    def _moved(self, T_ca: Pose, guess: Pose) -> bool:
        """Whether a pose differs from the predicted T_ac ``guess``."""
        step = T_ca @ guess  # in {C}
        turned = float(geometry.angle(step.q)) * RADIUS_OF_EXTENT * self._extent
        return turned + self._poses.shift(step) > UNMOVED * self._target.limits.gate_m

    def hypotheses(self, case: Case) -> Iterator[Hypothesis]:
        """Yield the candidate so far, and the minima to which displacements towards the camera and
        along the weak directions both ways lead; of a degenerate view only the other side of a
        panel, because the others differ by motions that the view leaves free anyway.
        """
        aligned, T_ca = case.at.found.status is AlignStatus.ALIGNED, case.at.T_ca
        few = case.few[:: max(1, len(case.few) // DISPLACED_POINTS)]
        weak = weak_motions(self._target, self._screen, few, T_ca, DIRECTIONS if aligned else 0)
        yield Hypothesis.of(self._screen.measure(case.few, T_ca))
        if weak is None:
            return
        towards = T_ca.t - weak.centre
        nearer = np.concatenate([np.zeros(3), towards])[None] / np.linalg.norm(towards)
        moves = np.concatenate([nearer, weak.motions, -weak.motions])
        for x in DISPLACED_OF_EXTENT * self._extent * moves:
            ended = self._screen.graduated(few, weak.displaced(x), self._screen.narrow_m)
            yield Hypothesis.of(self._screen.measure(case.few, ended.T_ca))

    def compared(
        self, case: Case, found: list[Hypothesis]
    ) -> tuple[Hypothesis | None, Candidate | None]:
        """Return a clearly better minimum; the candidate is doubted if another explains the scan
        as well.
        """
        minima, at = [each.at for each in found if each.at is not None], case.at
        best, width = self._screen.least(minima), 3.0 * min(each.noise_m for each in minima)
        width = max(LEAST_GATE_OF_EXTENT * self._extent, width)
        others = (e for e in minima if not self._poses.same(best.T_ca, e.T_ca, ONE_MINIMUM))
        aligned = at.found.status is AlignStatus.ALIGNED
        beside = aligned and any(
            as_good(best.costs(width), each.costs(width), 0.0, BESIDE_SIGMAS) for each in others
        )
        chosen = None if best is minima[0] else Hypothesis.of(best)
        return chosen, replace(at, beside=beside)
