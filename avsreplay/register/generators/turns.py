"""The pose turned by the motions that carry most of the model onto itself: by near-symmetries,
compared by the rays to the marks of the model, and by exact symmetries, which are not registered
because that could only move them away.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array
from avsreplay.register.backend import Target
from avsreplay.register.degenerate import motions_outside
from avsreplay.register.hypotheses import Candidate, Case, Generator, Hypothesis, Refine
from avsreplay.register.near_symmetry import LEAST_OFF_MODEL, NearSymmetry
from avsreplay.register.poses import ONE_MINIMUM

# share of points off the model from which bodies with large marks are compared with their turned
# poses
MANY_OFF = 0.1


class Turns(Generator):
    """Poses turned by near-symmetries, for the result of a search."""

    examined = True

    def __init__(self, symmetry: NearSymmetry) -> None:
        self._symmetry = symmetry

    def needed(self, case: Case) -> bool:  # noqa: ARG002 (that of a guess depends on the scan)
        """Return whether a mark alone distinguishes the turned copies of the model."""
        return self._symmetry.marked

    def hypotheses(self, case: Case) -> Iterator[Hypothesis]:
        """Yield the different poses that are known to explain the scan, and the turned ones."""
        for each in case.at.rivals:
            yield Hypothesis(each)
        yield from self._turned(case, False)

    def _turned(self, case: Case, better: bool) -> Iterator[Hypothesis]:
        """The turned poses."""
        rays = self._symmetry.rays(case.target)
        if not len(rays.points):
            return
        for each in self._symmetry.turned_poses(rays, case.at.T_ca, better):
            yield Hypothesis(each)

    def compared(
        self, case: Case, found: list[Hypothesis]
    ) -> tuple[Hypothesis | None, Candidate | None]:
        """Return the pose for which the rays decide."""
        at, rays = case.at, self._symmetry.rays(case.target)
        if not len(rays.points):
            return None, at
        measured = [self._symmetry.measured(rays, T) for T in (at.T_ca, *(h.T_ca for h in found))]
        best, _, rivals = self._symmetry.decided(measured, at.covered)
        moved = not self._symmetry.poses.same(best.T_ca, at.T_ca, ONE_MINIMUM)
        kept = replace(at, rivals=tuple(each.T_ca for each in rivals))
        return (Hypothesis(best.T_ca) if moved else None), kept


class TurnsOfGuess(Turns):
    """The same for a pose that was registered from a guess: only where points off the model can
    decide, and only poses that explain more of them.

    Where the guess has no information of some motions, all turned poses are compared.
    """

    refine = Refine.BOTH

    def __init__(self, target: Target, symmetry: NearSymmetry) -> None:
        super().__init__(symmetry)
        self._extent = target.surface.extent

    def needed(self, case: Case) -> bool:
        """Return whether enough points are off the model, or some motion is not known."""
        found, near = case.at.found, self._symmetry.near
        least = LEAST_OFF_MODEL if near else max(LEAST_OFF_MODEL, MANY_OFF * found.points)
        off = found.points - found.inliers >= least
        return case.at.accepted and (self._open(case).size > 0 or off) and self._symmetry.turned

    def _open(self, case: Case) -> Array:
        """The motions (6, k) that neither guess nor view determine."""
        return motions_outside(case.unknown, case.at.found.free, self._extent)

    def hypotheses(self, case: Case) -> Iterator[Hypothesis]:
        """Yield the turned poses."""
        if self._open(case).size:
            yield from super().hypotheses(case)
        else:
            yield from self._turned(case, True)

    def compared(
        self, case: Case, found: list[Hypothesis]
    ) -> tuple[Hypothesis | None, Candidate | None]:
        """Return the pose for which the rays decide; the others leave only motions open of which
        the guess has no information.
        """
        chosen, kept = super().compared(case, found)
        assert kept is not None
        motions = self._open(case)
        undetermined = motions if motions.size and kept.rivals else None
        return chosen, replace(kept, rivals=(), undetermined=undetermined)


class NearestImage(Generator):
    """Of the poses that no scan can tell from the result of a search, the one nearest to a
    guess.
    """

    def hypotheses(self, case: Case) -> Iterator[Hypothesis]:
        """Yield these poses unmoved."""
        for each in case.at.images or ():
            yield Hypothesis(each)

    def compared(
        self, case: Case, found: list[Hypothesis]
    ) -> tuple[Hypothesis | None, Candidate | None]:
        """Return the nearest one."""
        assert case.guess is not None
        guess = case.guess.q
        poses = [case.at.T_ca, *(each.T_ca for each in found)]
        turned = [float(geometry.angle_between(each.inverse().q, guess)) for each in poses]
        best = int(np.argmin(turned))
        return (found[best - 1] if best else None), case.current
