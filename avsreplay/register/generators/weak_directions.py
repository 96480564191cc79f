"""Other local minima near a pose, along the directions of motion that the scan determines least,
and the other side of a panel.

A scan that shows a small part of the target has several minima, and nearly all points can be near
the model at a wrong one; the scan is then registered again from poses displaced along these
directions. A scan of a panel can be matched to its other side; it is registered again from a pose
that is displaced towards the camera.
"""

from __future__ import annotations

from collections.abc import Generator as Steps
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
from avsreplay.register.generators.restarts import screened
from avsreplay.register.hypotheses import Candidate, Case, Generator, Hypothesis
from avsreplay.register.plausibility import NOISE_OF_EXTENT, PlausibilityTest
from avsreplay.register.poses import ONE_MINIMUM, Sameness
from avsreplay.register.screening import Screen, Screened
from avsreplay.register.work import FAR_WORK, LAST_WORK, NOT_COMPARED

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
        camera_c: (3,) the camera in {C} if only faces towards it are matched.
    """

    centre: Array
    radius_m: float
    motions: Array
    at: Screened
    camera_c: Array | None

    def displaced(self, x: Array) -> Pose:
        """Return the pose moved by x (6,)."""
        turn = geometry.exp(x[:3] / self.radius_m)
        shift = self.centre + x[3:] - geometry.matrix(turn) @ self.centre
        return Pose(turn, shift) @ self.at.T_ca


def weak_motions(
    target: Target, screen: Screen, few: NDArray[Any], T_ca: Pose, count: int
) -> tuple[Weak | None, int]:
    """Return the ``count`` motions that points (n, 3) in {A} determine least at a pose; and the
    work.

    None with fewer than ``LEAST_INLIERS`` on the model, which do not determine a pose.
    """
    gate, at = target.limits.gate_m, screen.measure(few, T_ca)
    camera_c = target.visibility.camera_c(target.index, few, T_ca)
    on = at.distance < gate
    sums = target.index.normal_equations(few, T_ca, gate, facing=camera_c is not None)
    if min(sums.inliers, int(on.sum())) < LEAST_INLIERS:
        return None, at.work
    centre = T_ca.apply(few[on]).mean(axis=0)
    info, radius = scaled_information(sums.info, sums.inliers, centre)
    motions = np.linalg.eigh(info)[1][:, :count].T
    return Weak(centre, radius, motions, at, camera_c), at.work


class WeakDirections(Generator):
    """Poses registered again after displacements along weak directions and towards the camera."""

    missing = NOT_COMPARED

    def __init__(
        self, target: Target, test: PlausibilityTest, screen: Screen, poses: Sameness
    ) -> None:
        self._target, self._test, self._screen, self._poses = target, test, screen, poses
        self._extent = target.surface.extent
        self._complete = True

    def needed(self, case: Case) -> bool:
        """Return whether other minima near the candidate are possible: not at the predicted pose,
        and not where the scan shows all of the target on faces that face the camera.
        """
        assert case.guess is not None
        at = case.at
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

    def work(self, case: Case | None = None) -> int:  # noqa: ARG002
        """Return the usual cost of the minima around a pose."""
        passes = self._screen.passes(self._screen.narrow_m)
        return int((1 + 2 * DIRECTIONS) * FAR_WORK * passes * DISPLACED_POINTS)

    def hypotheses(self, case: Case) -> Steps[Hypothesis, None, int]:
        """Yield the candidate so far and the minima around it; of a degenerate view only the other
        side of a panel, because the others differ by motions that the view leaves free anyway.
        """
        aligned = case.at.found.status is AlignStatus.ALIGNED
        return self.around(case, case.at.T_ca, DIRECTIONS if aligned else 0)

    def around(
        self, case: Case, T_ca: Pose, count: int, kept: int = 0
    ) -> Steps[Hypothesis, None, int]:
        """Yield a pose, and those registered after a displacement towards the camera and along
        ``count`` directions both ways, while the work besides ``kept`` allows it.
        """
        few = case.few[:: max(1, len(case.few) // DISPLACED_POINTS)]
        weak, work = weak_motions(self._target, self._screen, few, T_ca, count)
        yield Hypothesis.of(self._screen.measure(case.few, T_ca), work)
        self._complete, dearest = True, 0  # work of one registration so far
        if weak is None:
            return 0
        towards = T_ca.t - weak.centre
        nearer = np.concatenate([np.zeros(3), towards])[None] / np.linalg.norm(towards)
        moves = np.concatenate([nearer, weak.motions, -weak.motions])
        for x in DISPLACED_OF_EXTENT * self._extent * moves:
            if dearest + kept > case.work.left:
                self._complete = False
                break
            ended = self._screen.graduated(few, weak.displaced(x), self._screen.narrow_m)
            at = self._screen.measure(case.few, ended.T_ca)
            dearest = max(dearest, at.work + ended.work)
            yield Hypothesis.of(at, ended.work)
        return 0

    def possible(self, case: Case, at: Screened) -> bool:
        """Return whether the result of a search can be matched to the other side of a panel, and
        can be accepted.
        """
        target = self._target
        known = target.visibility.camera_c(target.index, case.few, at.T_ca) is not None
        hopeless = at.noise_m > NOISE_OF_EXTENT * self._extent
        return not known and not hopeless and self.work() + LAST_WORK <= case.work.left

    def compared(
        self, case: Case, found: list[Hypothesis]
    ) -> tuple[Hypothesis | None, Candidate | None]:
        """Return a clearly better minimum; the candidate is doubted if another explains the scan
        as well.
        """
        minima, at = screened(found), case.at
        if not self._complete:
            return None, replace(at, missing=NOT_COMPARED)
        best, width = self._screen.least(minima), 3.0 * min(each.noise_m for each in minima)
        width = max(LEAST_GATE_OF_EXTENT * self._extent, width)
        others = (e for e in minima if not self._poses.same(best.T_ca, e.T_ca, ONE_MINIMUM))
        aligned = at.found.status is AlignStatus.ALIGNED
        beside = aligned and any(
            as_good(best.costs(width), each.costs(width), 0.0, BESIDE_SIGMAS) for each in others
        )
        chosen = None if best is minima[0] else Hypothesis(best.T_ca, at=best)
        return chosen, replace(at, beside=beside)
