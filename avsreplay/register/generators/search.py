"""The best pose of one round of the global search."""

from __future__ import annotations

from collections.abc import Iterator

from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.records import AlignStatus
from avsreplay.register import quality
from avsreplay.register.backend import Target
from avsreplay.register.global_search import SearchResult
from avsreplay.register.hypotheses import Candidate, Case, Generator, Hypothesis
from avsreplay.register.near_symmetry import NearSymmetry
from avsreplay.register.params import AcquireParams
from avsreplay.register.plausibility import NOISE_OF_EXTENT, PlausibilityTest
from avsreplay.register.screening import Screen

HOPELESS = 1.5 * NOISE_OF_EXTENT  # with more noise over the extent no pose is registered further


@value_class
class SearchTools:
    """What every round of the search of one target needs."""

    target: Target
    params: AcquireParams
    test: PlausibilityTest
    screen: Screen
    symmetry: NearSymmetry


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
    ) -> None:
        """Search a part (n, 3) of a scan in {A} [m]; number, before, known: as of
        ``GlobalSearch.search``.
        """
        self._tools, self._part, self._number = tools, part, number
        self._before, self._known = before, known
        self._worth = self._alone = False

    def hypotheses(self, case: Case) -> Iterator[Hypothesis]:
        """Yield the best pose of the search."""
        tools, extent = self._tools, self._tools.target.surface.extent
        self.result = tools.symmetry.search.search(
            self._part, self._number, self._before, self._known
        )
        best, ratio = tools.screen.measure(case.few, self.result.best), self.result.inlier_ratio
        yield Hypothesis.of(best)
        width = max(tools.target.limits.gate_m, 3.0 * best.noise_m)
        self._alone = tools.target.visibility.sided and best.separate(width)
        self._worth = best.noise_m <= HOPELESS * extent and ratio >= tools.params.least_separate
        if self._worth and not self._alone and ratio < tools.params.least_ratio:
            at = tools.test.check(case.seen, self.result.best)
            self._worth = at is not None and at.covered

    def compared(
        self, case: Case, found: list[Hypothesis]
    ) -> tuple[Hypothesis | None, Candidate | None]:
        """Return this pose, if it may be that of the target."""
        result, none = self.result, AlignStatus.NO_OVERLAP
        at = Candidate(
            quality.not_measured(len(case.points), none, result.best.inverse()),
            doubtful=True,
            rivals=result.rivals,
            share=result.inlier_ratio,
            alone=self._alone,
            searched=True,
        )
        return (found[-1] if self._worth else None), at

    def explained(self, at: Candidate) -> bool:
        """Return whether little of the scan is left to explain by a further round."""
        alone = at.alone or at.covered
        sure = self.result.inlier_ratio >= quality.LEAST_RATIO or (alone and not self.result.rivals)
        return sure and self.result.width_m <= self._tools.target.limits.gate_m
