"""The loop over hypotheses: draws them from generators, registers the best of each to the whole
scan, and measures its evidence.

The work of a scan is bounded, because every generator yields a limited number of hypotheses.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus
from avsreplay.register.backend import Backend, Target
from avsreplay.register.decision import ACCEPTED, Decision
from avsreplay.register.generators.displaced import Displaced
from avsreplay.register.generators.guess import NEARER, Guess, WithinNoise
from avsreplay.register.generators.search import SearchRound, SearchTools
from avsreplay.register.generators.turns import NearestImage, Turns, TurnsOfGuess
from avsreplay.register.generators.weak_directions import WeakDirections
from avsreplay.register.grading import FAR_RAD, POOR_OF_GATE, Grader
from avsreplay.register.hypotheses import Candidate, Case, Generator, Hypothesis, Refine
from avsreplay.register.near_symmetry import LEAST_OFF_MODEL, NearSymmetry, prepared
from avsreplay.register.params import RegisterParams
from avsreplay.register.plausibility import PlausibilityTest
from avsreplay.register.poses import ONE_MINIMUM, Sameness
from avsreplay.register.quality import LEAST_RATIO
from avsreplay.register.sampling import MOST_ATTEMPTS, attempts, without_scattered_points
from avsreplay.register.screening import Screen, Screened

# with more inliers too few points are left that could continue beyond an edge of the model
COMPLETE = 0.985
LEAST_BEYOND = 10  # of 1,000 points well off the model, from which a close fit is judged
# rotation from the guess above which a pose of a model with near-symmetries is far
TURNED_RAD = np.radians(12.0)
LEFT = "the back end ends at another pose than the search, although it begins there"


class Loop:
    """Registers scans to one target."""

    def __init__(
        self, target: Target, params: RegisterParams, backend: Backend, folder: Path | None
    ) -> None:
        """``folder``: where what a search needs of the model is kept; None: nowhere."""
        self._target, self._params, self._folder = target, params, folder
        self._gate, self._extent = target.limits.gate_m, target.surface.extent
        self.test = PlausibilityTest(target)
        self.screen = Screen(target, self.test)
        self.poses = Sameness(target.surface)
        self.grader = Grader(target, params, backend, self.screen)
        self.decision = Decision(
            target, params.acquire, self.test, self.screen, self.poses, lambda: self.symmetry
        )
        self._guess, self._within_noise = Guess(), WithinNoise(target, self.screen)
        self._weak = WeakDirections(target, self.test, self.screen, self.poses)

    @cached_property
    def symmetry(self) -> NearSymmetry:
        """Return the near-symmetries of the model and its search, prepared when a scan needs them
        for the first time.
        """
        return prepared(self._target, self.test, self._params.acquire, self.poses, self._folder)

    @cached_property
    def _tools(self) -> SearchTools:
        return SearchTools(
            self._target, self._params.acquire, self.test, self.screen, self.symmetry
        )

    @cached_property
    def _displaced(self) -> Displaced:
        return Displaced(self._target, self.test, self.symmetry)

    @cached_property
    def _turns(self) -> Turns:
        return Turns(self.symmetry)

    # The loop itself

    def _draw(self, case: Case, generator: Generator) -> None:
        """Draw the hypotheses of a generator; the best becomes the candidate of the case where it
        is better than the one before.
        """
        found = list(generator.hypotheses(case))
        if found and generator.examined and not case.at.examined:
            self._examine(case)
        best, case.current = generator.compared(case, found)
        if best is None:
            return
        self._register(case, best, generator.refine)
        if generator.refine is not Refine.BACKEND:
            self._examine(case)

    # Registration of a hypothesis to the whole scan, and its evidence

    def _register(self, case: Case, hypothesis: Hypothesis, refine: Refine) -> None:
        """Register a hypothesis to the whole scan: it becomes the candidate."""
        by_backend = refine is Refine.BACKEND and self._hopeful(case, hypothesis.T_ca)
        if refine is Refine.BACKEND:
            found = self._graded(case, hypothesis.T_ca, by_backend=by_backend, rough=True)
        else:
            found = self._within(case, hypothesis)
        if refine is Refine.BOTH:
            wide = self._graded(case, hypothesis.T_ca)
            same = self.poses.same(wide.T_ac.inverse(), found.T_ac.inverse(), ONE_MINIMUM)
            found = wide if same else self._nearest(case, [found, wide], self._gate)
        self._replace(case, found, by_backend)

    def _hopeful(self, case: Case, T_ca: Pose) -> bool:
        """Whether a back end of another library is called at a pose: few points confirm it."""
        return not self.grader.foreign or self.screen.confirms(case.points, T_ca.inverse())

    def _replace(self, case: Case, found: Alignment, by_backend: bool) -> None:
        """An alignment becomes the candidate; what is known of other poses stays."""
        at = case.current or Candidate(found)
        at = replace(at, found=found, by_backend=by_backend, evidence=None, examined=False)
        case.current = replace(at, reason="", images=None)

    def _finish(self, case: Case) -> None:
        """Register an accepted pose that the own method found by the back end, and measure its
        evidence again. A back end that leaves the pose is not converged.
        """
        at = case.at
        if not self.grader.foreign or at.by_backend:
            return
        found = self._graded(case, at.T_ca, by_backend=True)
        failed = found.status is AlignStatus.FAILED
        if not failed and not self.poses.same(found.T_ac.inverse(), at.T_ca):
            status = AlignStatus.NOT_CONVERGED
            found = replace(found, status=status, covariance=None, message=LEFT)
            self._replace(case, found, by_backend=True)
            return
        self._replace(case, found, by_backend=True)
        self._examine(case)
        if at.searched:
            self._size(case)

    def _graded(
        self, case: Case, T_ca: Pose, width_m: float | None = None, **how: bool
    ) -> Alignment:
        return self.grader.graded(case, T_ca.inverse(), width_m, **how)

    def _measured(self, case: Case, T_ca: Pose) -> Screened:
        return self.screen.measure(case.few, T_ca)

    def _within(self, case: Case, hypothesis: Hypothesis) -> Alignment:
        """An alignment with a rejection distance that follows the noise."""
        at = hypothesis.at or self._measured(case, hypothesis.T_ca)
        return self._graded(case, hypothesis.T_ca, self.screen.width(at))

    def _nearest(self, case: Case, found: list[Alignment], width_m: float) -> Alignment:
        """The second alignment if the points, none farther than ``width_m``, are nearer to the
        model there.
        """
        cost = [self._measured(case, each.T_ac.inverse()).cost(width_m) for each in found]
        return found[cost[1] < NEARER * cost[0]]

    def _examine(self, case: Case) -> None:
        """Measure the evidence of the candidate."""
        at = case.at
        if at.examined or not at.found.measured:
            return
        evidence, reason = self.test.judged(case.seen, at.T_ca, case.guess)
        case.current = replace(
            at,
            evidence=evidence,
            examined=True,
            reason=reason,
            doubtful=evidence is None or evidence.doubtful,
        )

    # With a guess

    def from_guess(self, case: Case) -> Alignment:
        """Return the decision on a scan with a guess."""
        self._draw(case, self._guess)
        if case.at.found.status is AlignStatus.FAILED:
            return self._decided(case)
        if not self._settled_at_once(case):
            self._recover(case)
        if not case.at.reason and not case.at.searched:
            if self._far(case):
                self._searched(case, MOST_ATTEMPTS, always=True)
            else:
                self._compare(case)
        return self._decided(case)

    def _settled_at_once(self, case: Case) -> bool:
        """Whether the first alignment is a close fit; where points are well off the model, also by
        its evidence.
        """
        found = case.at.found
        close = self.grader.close(found)
        if not close or found.inlier_ratio >= COMPLETE or found.well_off < LEAST_BEYOND:
            return close
        self._examine(case)
        return not case.at.reason

    def _recover(self, case: Case) -> None:
        """Draw further hypotheses until the candidate leaves no doubt."""
        overlap = case.at.found.status is not AlignStatus.NO_OVERLAP  # without: another object
        self._draw_both(case)
        self._examine(case)
        if overlap and self._open(case):
            self._searched(case, 1)

    def _draw_both(self, case: Case) -> None:
        """Register the first result and the guess within the noise."""
        tried = []
        for hypothesis in self._within_noise.hypotheses(case):
            self._register(case, hypothesis, self._within_noise.refine)
            tried.append(case.at)
        if len(tried) == 2:
            best = self._nearest(case, [each.found for each in tried], self._gate)
            case.current = tried[best is tried[1].found]

    def _open(self, case: Case) -> bool:
        """Whether the candidate may be a local minimum: after a failure, against its evidence, or
        away from the guess with a poor fit whose evidence leaves a doubt.
        """
        at, found = case.at, case.at.found
        if at.reason or found.status is AlignStatus.FAILED or not found.inliers:
            return True
        if found.rms_m <= POOR_OF_GATE * self._gate:
            return False
        assert case.guess is not None
        moved = at.T_ca.apply(case.few) - case.guess.inverse().apply(case.few)
        near = float(np.linalg.norm(moved, axis=1).mean()) <= self._gate
        if found.inlier_ratio >= LEAST_RATIO and near:
            return False
        return not at.examined or at.doubtful

    def _far(self, case: Case) -> bool:
        """Whether the candidate is so far from the guess that another local minimum may be
        better.
        """
        assert case.guess is not None
        found = case.at.found
        angle = float(geometry.angle_between(case.guess.q, found.T_ac.q))
        if not found.measured or not TURNED_RAD < angle <= FAR_RAD:
            return found.measured and angle > FAR_RAD
        degenerate = found.status is AlignStatus.DEGENERATE
        return not degenerate and len(self.symmetry.search.symmetries) > 0

    def _compare(self, case: Case) -> None:
        """Compare the candidate with the minima near it and with the poses turned by a
        near-symmetry.
        """
        if self._weak.needed(case):
            self._draw(case, self._weak)
        at = case.at
        if at.beside or at.reason or not at.accepted:
            return
        if case.unknown.size or at.found.points - at.found.inliers >= LEAST_OFF_MODEL:
            turns = TurnsOfGuess(self._target, self.symmetry)
            if turns.needed(case):
                self._draw(case, turns)

    def _searched(self, case: Case, rounds: int, always: bool = False) -> bool:
        """Search the whole scan; whether its result is accepted. It then becomes the candidate, at
        that of its equal poses that is nearest to the guess. ``always``: also if it is not.
        """
        known = case.at.T_ca if case.at.found.measured else None
        whole = Case(case.seen, case.seen.points, case.few)
        accepted = self._search(whole, rounds, known).status in ACCEPTED
        if accepted or always:
            case.points, case.few, case.target = whole.points, whole.few, whole.target
            case.current = whole.current
        if accepted:
            self.decision.images(case)
            self._draw(case, NearestImage())
        return accepted

    def _decided(self, case: Case) -> Alignment:
        """The decision, with what the scan says about the size and the covariance."""
        found = self.decision.decide(case)
        if found.status in ACCEPTED:
            self._finish(case)
            found = self.decision.decide(case)
        if case.guess is not None and not case.at.searched:
            found = self.decision.consistent(case.few, case.guess, found)
        return self.decision.stated(self.decision.with_size(case, found))

    # Without a guess

    def turned(self, case: Case) -> Alignment | None:
        """Return the decision on a scan from its guess, after comparison with the poses turned by
        near-symmetries; None if the model has no marks that could decide between them.
        """
        if not self._turns.needed(case):
            return None
        self._draw(case, self._guess)
        self._examine(case)
        if case.at.accepted and not case.at.reason:
            self._draw(case, self._turns)
        return self.decision.decide(case)

    def without_guess(self, case: Case) -> Alignment:
        """Return the decision on a scan without a guess."""
        self._search(case, MOST_ATTEMPTS, None)
        return self.decision.equal(case, self._decided(case))

    def _search(self, case: Case, rounds: int, known: Pose | None) -> Alignment:
        """The best result of the searches becomes the candidate of a case; return the decision on
        it.

        Args:
            case: the scan.
            rounds: most rounds of the search.
            known: a pose T_ca that is compared as well.
        """
        case.target = without_scattered_points(
            np.asarray(case.points, dtype=np.float64), self._extent
        )
        few, tried = self.screen.part(case.target), list[Round]()
        parts = attempts(case.target, self._extent, lambda: tried[0].found.measured)
        for part, number in islice(parts, rounds):
            tried.append(self._round(case, part, number, known, tried))
            if tried[-1].ends:
                break
        best = self._best(few, tried)
        case.current = best.case.current
        case.few = self.screen.part(case.points)
        if best.found.status in ACCEPTED and self._displaced.needed(case):
            self._draw(case, self._displaced)
        return self.decision.decide(case)

    def _round(
        self, case: Case, part: Array, number: int, known: Pose | None, tried: list[Round]
    ) -> Round:
        """Search a part (n, 3) of a scan, and decide on the result."""
        one = Case(case.seen, case.points, self.screen.part(part))
        one.target = part
        whole = [each.search.result for each in tried if each.case.target is part]
        before = whole[-1] if whole else None
        search = SearchRound(self._tools, part, number, before, known)
        self._draw(one, search)
        self._resolve(one)
        return Round(one, search, self.decision.decide(one))

    def _resolve(self, case: Case) -> None:
        """Compare the result of a search with the other side of a panel and with the poses turned
        by a near-symmetry.
        """
        at = case.at
        if not at.found.measured or at.reason or self.decision.too_little(at):
            return
        for generator in (self._weak, self._turns):
            if generator.needed(case):
                self._draw(case, generator)
        self._size(case)

    def _size(self, case: Case) -> None:
        """Fit the size to the result of a search where the scan shows a part of the target."""
        at = case.at
        if at.accepted and not at.rivals and not at.covered:
            case.current = replace(at, found=self.decision.with_size(case, at.found))

    def _best(self, few: NDArray[Any], tried: list[Round]) -> Round:
        """The round whose pose has the least cost; the first if none has a pose."""
        measured = [
            (each, self.screen.measure(few, each.found.T_ac.inverse()))
            for each in tried
            if each.found.measured
        ]
        if not measured:
            return tried[0]
        width = max(self._gate, 3.0 * min(at.noise_m for _, at in measured))
        return min(measured, key=lambda pair: pair[1].cost(width))[0]


@value_class
class Round:
    """One round of the search, and the decision on its result."""

    case: Case
    search: SearchRound
    found: Alignment

    @property
    def unsure(self) -> bool:
        """Return whether another pose may have more evidence."""
        at = self.case.at
        return at.doubtful or bool(at.reason) or not self.found.measured

    @property
    def ends(self) -> bool:
        """Return whether no further round is needed."""
        failed = self.found.status is AlignStatus.FAILED
        return failed or (not self.unsure and self.search.explained(self.case.at))
