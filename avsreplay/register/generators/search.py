"""The best pose of one round of the global search, and the minima around it where a panel can be
matched to its other side.
"""

from __future__ import annotations

from collections.abc import Generator as Steps

from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.records import AlignStatus
from avsreplay.register import quality
from avsreplay.register.backend import Target
from avsreplay.register.generators.restarts import screened
from avsreplay.register.generators.weak_directions import DIRECTIONS, WeakDirections
from avsreplay.register.global_search import SearchResult
from avsreplay.register.hypotheses import Candidate, Case, Generator, Hypothesis
from avsreplay.register.near_symmetry import NearSymmetry
from avsreplay.register.params import AcquireParams
from avsreplay.register.plausibility import NOISE_OF_EXTENT, PlausibilityTest
from avsreplay.register.screening import Screen
from avsreplay.register.work import LAST_WORK, LEAST_RATIO, TEST_WORK

HOPELESS = 1.5 * NOISE_OF_EXTENT  # with more noise over the extent no pose is registered further


@value_class
class SearchTools:
    """What every round of the search of one target needs."""

    target: Target
    params: AcquireParams
    test: PlausibilityTest
    screen: Screen
    symmetry: NearSymmetry
    weak: WeakDirections


class SearchRound(Generator):
    """One round of the search for one scan.

    Attributes:
        result: of the search, after its hypotheses were drawn.
    """

    def __init__(
        self,
        tools: SearchTools,
        part: Array,
        number: int,
        before: SearchResult | None = None,
        known: Pose | None = None,
        kept: int = 0,
    ) -> None:
        """Search a part (n, 3) of a scan in {A} [m]; number, before, known, kept: as of
        ``GlobalSearch.search``.
        """
        self._tools, self._part, self._number = tools, part, number
        self._before, self._known, self._kept = before, known, kept
        self._worth = self._alone = False

    def hypotheses(self, case: Case) -> Steps[Hypothesis, None, int]:
        """Yield the best pose of the search, and where it can be matched to the other side of a
        panel the minima around it.
        """
        tools, extent = self._tools, self._tools.target.surface.extent
        left = case.work.left - tools.symmetry.after_search(len(case.points))
        self.result = tools.symmetry.search.search(
            self._part, self._number, self._before, self._known, left, self._kept
        )
        found = [tools.screen.measure(case.few, self.result.best)]
        yield Hypothesis.of(found[0], self.result.work)
        if not case.work.allows(LAST_WORK):
            return 0
        if tools.weak.possible(case, found[0]):
            for each in tools.weak.around(case, self.result.best, DIRECTIONS, LAST_WORK):
                found += screened([each])
                yield each
        best, ratio = tools.screen.least(found), self.result.inlier_ratio
        width = max(tools.target.limits.gate_m, 3.0 * best.noise_m)
        self._alone = tools.target.visibility.sided and best.separate(width)
        self._worth = best.noise_m <= HOPELESS * extent and ratio >= tools.params.least_separate
        if not self._worth or self._alone or ratio >= tools.params.least_ratio:
            return 0
        at = tools.test.check(case.seen, self.result.best)
        self._worth = at is not None and at.covered
        return TEST_WORK

    def compared(
        self, case: Case, found: list[Hypothesis]
    ) -> tuple[Hypothesis | None, Candidate | None]:
        """Return the best minimum, if it may be the pose of the target."""
        result, none = self.result, AlignStatus.NO_OVERLAP
        at = Candidate(
            quality.not_measured(len(case.points), none, result.best.inverse()),
            doubtful=True,
            rivals=result.rivals,
            share=result.inlier_ratio,
            alone=self._alone,
            searched=True,
        )
        best = self._tools.screen.least(screened(found))
        return (Hypothesis.of(best) if self._worth else None), at

    def explained(self, at: Candidate) -> bool:
        """Return whether little of the scan is left to explain by a further round."""
        alone = at.alone or at.covered
        sure = self.result.inlier_ratio >= LEAST_RATIO or (alone and not self.result.rivals)
        return sure and self.result.width_m <= self._tools.target.limits.gate_m
