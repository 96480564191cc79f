"""Registration of one scan from a guess, or without one; the only place where T_ac is
converted to T_ca and back.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus, Surface
from avsreplay.register import index_cache, quality, restarts
from avsreplay.register.backend import Target, create_backend, load_backend
from avsreplay.register.budget import (
    LAST_WORK,
    LEAST_RATIO,
    SCATTER_WORK,
    TEST_WORK,
    Budget,
    healthy_work,
    near_work,
)
from avsreplay.register.degenerate import motions_outside
from avsreplay.register.evidence import TOO_FEW, Observed
from avsreplay.register.global_search import SearchResult
from avsreplay.register.grading import FAR_RAD, Grader
from avsreplay.register.neighbourhood import NOT_COMPARED, NOT_FOUND, POSTPONED, Neighbourhood
from avsreplay.register.params import RegisterParams
from avsreplay.register.plausibility import NOISE_OF_EXTENT, PlausibilityTest
from avsreplay.register.rivals import (
    LEAST_RAYS,
    NOT_TURNED,
    NOT_VERIFIED,
    TURNED_RAD,
    NearSymmetry,
    prepared,
)
from avsreplay.register.sampling import (
    MOST_ATTEMPTS,
    attempts,
    usable_points,
    without_scattered_points,
)
from avsreplay.register.shown import Effort
from avsreplay.register.surface_index import SurfaceIndex
from avsreplay.register.visibility import Visibility

ACCEPTED = (AlignStatus.ALIGNED, AlignStatus.DEGENERATE)
LAST_SCANS, LEAST_TO_TURN, SURE_RATIO = (
    2,
    0.2,
    0.9,
)  # work kept, in ordinary scans; inliers: least, sure
# share of points off the model from which bodies with large marks are compared with their turned
# poses
MANY_OFF = 0.1


class Registrar:
    """Registers scans to one surface with one back end. Built once, used for every scan of a log.

    Attributes:
        params, index: the parameters as given; the index of the model.
        limits: the same with every automatic length resolved for this surface.
        sided: the outer side of the faces is known.
    """

    def __init__(self, surface: Surface, params: RegisterParams | None = None) -> None:
        """Index the surface and build the back end.

        Args:
            surface: model of the target, vertices in {C} [m].
            params: parameters; the defaults if None.

        Raises:
            UsageError: an unknown back end, or a surface that cannot be indexed.
            MissingBackend: the library of the back end is not installed.
        """
        self.params = params or RegisterParams()
        self.limits = self.params.limits(surface.extent)
        factory = load_backend(
            self.params.backend
        )  # before the index, so that a wrong name is reported at once
        self._cache_dir = cache_dir = (
            index_cache.folder_for(surface) if self.params.index_cache else None
        )
        self._visibility = Visibility(surface, self.params.camera, cache_dir)
        surface, self.sided = self._visibility.surface, self._visibility.sided
        self.index = SurfaceIndex.build(
            surface, self.limits.reach_m, threads=self.params.threads, cache_dir=cache_dir
        )
        near = near_work(surface, self.index)
        self._target = Target(surface, self.index, self.limits, self._visibility, near)
        self._backend = create_backend(self.params, factory, self._target)
        self._test = PlausibilityTest(self._target)
        self._restarter = restarts.Restarter(self._target, self._test)
        self._grader = Grader(self._target, self.params, self._backend, self._restarter)
        self._neighbourhood = Neighbourhood(self._target, self._test, self._restarter, self._grader)

    def register(
        self,
        points: NDArray[Any],
        guess: Pose,
        seq: int = 0,
        carried: bool = False,
        effort: Effort = Effort.FULL,
        unknown: Array | None = None,
    ) -> Alignment:
        """Register a scan from a guess (eq:ICP).

        Args:
            points: (n, 3) in {A} [m], float32 or float64, possibly strided; points that are not
                finite are left out.
            guess: predicted T_ac. ICP aligns the scan to the model: it receives the inverse and
                gives the inverse.
            seq: number of the scan; two halves of it are compared if ``split_every`` divides it.
            carried: the points were carried to one instant by the predicted motion. Its error
                distorts the scan, but the estimator models this (``Alignment.instants``), so that
                the covariance leaves it out.
            effort: what is done for the scan; without an accepted pose of the run it is limited.
            unknown: (6, k) motions d of the model of which the guess has no information; None for
                no motion. The scan determines them only if no pose turned by a near-symmetry of the
                model explains it as well.

        Returns:
            The pose T_ac with its quality. A failure is its status, never an exception; T_ac is
            then the guess.
        """
        whole = usable_points(points, self.params.subsample_m)
        if refused := self._test.refused(whole, len(points), guess):
            return refused
        seen, scan = Observed(whole), self._test.around(whole, guess)
        found = self._registered(seen, scan, guess, seq, carried, effort, unknown)
        return found if found.points == len(whole) else replace(found, points=len(whole))

    def _registered(
        self,
        seen: Observed,
        scan: NDArray[Any],
        guess: Pose,
        seq: int,
        carried: bool,
        effort: Effort,
        unknown: Array | None,
    ) -> Alignment:
        """Register the part of a scan around its guess; the whole scan is searched where that
        fails.
        """
        halves, budget = (
            seq % self.params.split_every == 0,
            Budget(healthy_work(len(scan), self._target.near_work)),
        )
        if effort is Effort.GUESS and not self._restarter.hopeful(scan, guess, budget):
            return replace(
                quality.not_measured(len(scan), AlignStatus.BUDGET_EXHAUSTED, guess),
                message=POSTPONED,
            )
        first = self._grader.graded(scan, guess, budget, None, halves, carried, rough=True)
        if first.status is AlignStatus.FAILED:
            return first
        sound = self._restarter.sound(seen, first, budget)
        found, searched = (
            (first, False)
            if sound
            else self._recovered(seen, scan, guess, first, halves, carried, budget)
        )
        if self._far(guess, found) and not searched:
            found = self._searched(seen.points, found, carried, budget)
            found = self._at_image(scan, found, guess, budget, halves, carried)
        elif not searched:
            found = self._unique(scan, guess, found, budget, halves, carried)
            found = self._settled(scan, found, budget, halves, carried, unknown)
        return self._neighbourhood.finished(scan, found, budget)

    def acquire(self, points: NDArray[Any], effort: Effort = Effort.FULL) -> Alignment:
        """Find the pose without a guess: register the scan from the best pose of a search over all
        attitudes.

        Args:
            points: as for :meth:`register`.
            effort: what is done for the scan; only with the full effort it is searched.

        Returns:
            The pose T_ac with its quality. The status is NO_OVERLAP if no pose explains enough of
            the scan, and AMBIGUOUS if a second, different pose explains it as well:
            ``free_directions`` names the rotation to it. A motion of a DEGENERATE view along its
            unobservable directions is not a different pose.
        """
        scan = usable_points(points, self.params.subsample_m)
        if refused := self._test.refused(scan, len(points)):
            return refused
        if effort is not Effort.FULL:
            return replace(
                quality.not_measured(len(points), AlignStatus.BUDGET_EXHAUSTED), message=POSTPONED
            )
        budget = Budget(healthy_work(len(scan), self._target.near_work))
        found = self._neighbourhood.finished(scan, self._acquire(scan, budget, False), budget)
        return self._symmetry.equal(scan, found) if found.status in ACCEPTED else found

    def images(self, T_ac: Pose) -> list[Pose]:
        """Return the poses that no scan can tell from a pose, because an exact symmetry of the
        model carries it onto itself; the pose itself is the first.

        Args:
            T_ac: the pose.
        """
        return [T_ac, *(each.inverse() for each in self._symmetry.images(T_ac.inverse()))]

    def _acquire(
        self,
        scan: NDArray[Any],
        budget: Budget,
        carried: bool,
        rounds: int = MOST_ATTEMPTS,
        known: Pose | None = None,
    ) -> Alignment:
        """The best plausible result of the searches that the budget allows, the first in any
        case; ``known``: T_ca.
        """
        target = without_scattered_points(np.asarray(scan, dtype=np.float64))
        budget.spend(sum(SCATTER_WORK[: 2 if len(target) < len(scan) else 1]) * len(scan))
        few, results, doubt = self._restarter.part(target), list[Alignment](), list[bool]()
        seen = Observed(scan)
        none = quality.not_measured(
            len(scan), AlignStatus.NO_OVERLAP, None if known is None else known.inverse()
        )
        whole, more = None, True
        for part, number in islice(
            attempts(target, self.index.extent_m, lambda: results[0].measured), rounds
        ):
            kept = self._symmetry.elsewhere_work(len(part), len(scan), True)
            compared = any(
                each.status in ACCEPTED and not unsure
                for each, unsure in zip(results, doubt, strict=True)
            )
            if not (
                more := budget.allows(
                    self._symmetry.search_work(len(part), number), kept if compared else 0
                )
            ):
                break
            left = budget.left - self._symmetry.after_search(len(scan)), kept if number == 1 else 0
            search = self._symmetry.search.search(
                part, number, whole if part is target else None, known, *left
            )
            budget.spend(search.work)
            whole = search if part is target else whole
            found, alone, doubtful = self._acquired(seen, part, search, budget, carried)
            results.append(found)
            doubt.append(doubtful)
            if found.status is AlignStatus.FAILED:
                return found
            fits = alone and not search.rivals
            little = search.inlier_ratio >= SURE_RATIO or fits  # little is left to explain
            if found.measured and little and not doubtful and search.width_m <= self.limits.gate_m:
                break
        poses = (each for each in results if each.measured)
        measured = [
            (each, self._restarter.measure(few, each.T_ac.inverse(), budget)) for each in poses
        ]
        width = max(
            self.limits.gate_m, 3.0 * min((restart.noise_m for _, restart in measured), default=0.0)
        )
        best = (
            min(measured, key=lambda each: each[1].cost(width))[0]
            if measured
            else (results or [none])[0]
        )
        sure = measured and not doubt[results.index(best)]
        if best.status in ACCEPTED:
            best = self._verified(scan, target, best, budget, carried)
        ambiguous = best.status is AlignStatus.AMBIGUOUS  # which no longer search changes
        if (more and not budget.exhausted) or sure or ambiguous:
            return best
        return replace(
            best, status=AlignStatus.BUDGET_EXHAUSTED, covariance=None, message=NOT_FOUND
        )

    def _acquired(
        self, seen: Observed, part: Array, search: SearchResult, budget: Budget, carried: bool
    ) -> tuple[Alignment, bool, bool]:
        """Register the result of a search of a part on the whole scan, and test it.

        Also: whether the points off the model are another object's (far away, or nothing is
            missing); if doubtful.
        """
        scan = seen.points
        if not budget.allows(LAST_WORK):
            return (
                quality.not_measured(len(scan), AlignStatus.NO_OVERLAP, search.best.inverse()),
                False,
                True,
            )
        start = self._neighbourhood.of_both_sides(
            few := self._restarter.part(part), search.best, budget
        )
        away = self._visibility.sided and start.separate(
            max(self.limits.gate_m, 3.0 * start.noise_m)
        )
        sure, p = (
            away or search.inlier_ratio >= self.params.acquire.least_ratio,
            self.params.acquire,
        )
        spread = (
            start.noise_m > restarts.HOPELESS * self.index.extent_m
            or search.inlier_ratio < p.least_separate
        )
        budget.spend(0 if spread or sure else TEST_WORK)
        if spread or not (sure or ((at := self._test.check(seen, search.best)) and at.covered)):
            return (
                quality.not_measured(len(scan), AlignStatus.NO_OVERLAP, search.best.inverse()),
                False,
                True,
            )
        found = self._neighbourhood.regraded(scan, few, start, budget, True, carried)
        if found.status is AlignStatus.FAILED:
            return found, False, True
        budget.spend(TEST_WORK)
        at = self._test.check(seen, found.T_ac.inverse())
        covered = at is not None and at.covered
        alone = away or covered
        if (
            search.inlier_ratio < (p.least_separate if alone else p.least_ratio)
            or not found.measured
        ):
            return replace(found, status=AlignStatus.NO_OVERLAP, covariance=None), False, True
        reason = TOO_FEW if at is None else at.reason()
        if at is None or reason:
            return (
                replace(found, status=AlignStatus.IMPLAUSIBLE, covariance=None, message=reason),
                False,
                True,
            )
        marked = self._symmetry.marked
        rivals = list(search.rivals)
        decided = marked and budget.allows(self._symmetry.work(len(part), len(rivals)))
        if marked and not decided and not rivals:
            status = AlignStatus.BUDGET_EXHAUSTED
            return replace(found, status=status, covariance=None, message=NOT_TURNED), alone, True
        if decided:
            work = self._symmetry.work(len(part), len(rivals))
            best, rivals, extra = self._symmetry.decided(
                part, found.T_ac.inverse(), rivals, covered
            )
            budget.spend(work + extra)
            if not self._symmetry.search.same(best, found.T_ac.inverse()):
                found = self._neighbourhood.regraded(scan, few, best, budget, True, carried)
        return self._unrivalled(scan, found, rivals, covered, budget), alone, at.doubtful

    def _verified(
        self, scan: NDArray[Any], target: Array, found: Alignment, budget: Budget, carried: bool
    ) -> Alignment:
        """The result of a search; AMBIGUOUS if a pose that it did not try explains the points
        on the model as well.
        """
        symmetry, T_ca = self._symmetry, found.T_ac.inverse()
        partial = self._test.partial(target, T_ca)
        if not partial and (found.inliers >= LEAST_RATIO * len(target) or symmetry.marked):
            return found
        if symmetry.elsewhere_work(found.inliers, len(scan), partial) > budget.left:
            return replace(
                found, status=AlignStatus.BUDGET_EXHAUSTED, covariance=None, message=NOT_COMPARED
            )
        best, rivals, work = symmetry.elsewhere(scan, T_ca, partial, budget.left)
        budget.spend(work)
        if not symmetry.search.same(best, T_ca):
            found = self._neighbourhood.replaced(scan, found, best, budget, carried)
        return symmetry.rivalled(scan, found, rivals) if found.status in ACCEPTED else found

    def _unrivalled(
        self,
        scan: NDArray[Any],
        found: Alignment,
        rivals: list[Pose],
        covered: bool,
        budget: Budget,
    ) -> Alignment:
        """The result of a search; AMBIGUOUS with rivals, not accepted where the view shows
        faces of many bodies.
        """
        found = self._symmetry.rivalled(scan, found, rivals)
        if found.status is AlignStatus.AMBIGUOUS or covered or not self._visibility.sided:
            return found
        if self._symmetry.revolved(scan, found):  # no other body is meant by the free turn
            return found
        one = self._neighbourhood.of_one(scan, found, budget)
        if one.status not in ACCEPTED and (said := self._symmetry.equal(scan, found)).members:
            return replace(said, equal=False)
        return one

    def instants(self, points: NDArray[Any], times_s: NDArray[Any], T_ac: Pose) -> Array:
        """Return the effective measurement time of each direction, (6, 6) [s], see
        ``quality.instants``.

        Args:
            points: (n, 3) finite, in {A} [m], motion-compensated to one instant.
            times_s: (n,) measurement time of each point relative to that instant [s].
            T_ac: the registered pose.
        """
        return quality.instants(
            self.index, self._visibility, points, times_s, T_ac.inverse(), self.limits.gate_m
        )

    def distance(self, points: NDArray[Any], T_ac: Pose, most_m: float) -> Array:
        """Return the distances (n,) of points to the model [m].

        Args:
            points: (n, 3) in {A} [m].
            T_ac: pose of the model.
            most_m: larger distances are limited to this value, at most the reach of the index [m].
        """
        return self.index.distances(points, T_ac.inverse(), most_m, False, 1, 0.0)[0]

    @cached_property
    def _symmetry(self) -> NearSymmetry:
        """The near-symmetries of the model and its search, prepared when a scan needs them for the
        first time.
        """
        return prepared(self._target, self._test, self.params.acquire, self._cache_dir)

    def _settled(
        self,
        scan: NDArray[Any],
        found: Alignment,
        budget: Budget,
        halves: bool,
        carried: bool,
        unknown: Array | None,
    ) -> Alignment:
        """The pose turned by a near-symmetry, if the points off the model decide for it;
        DEGENERATE as of the guess.
        """
        unknown = motions_outside(
            np.zeros((6, 0)) if unknown is None else unknown, found.free, self.index.extent_m
        )
        unsure, accepted = unknown.size > 0, found.status in ACCEPTED
        least = LEAST_RAYS if self._symmetry.near else max(LEAST_RAYS, MANY_OFF * found.points)
        if (
            not accepted
            or not (unsure or found.points - found.inliers >= least)
            or not self._symmetry.turned
        ):
            return found
        T_ca = found.T_ac.inverse()
        none = replace(
            found, status=AlignStatus.BUDGET_EXHAUSTED, covariance=None, message=NOT_TURNED
        )
        if not budget.allows(self._symmetry.turning_work):
            return none
        turned, screened = (None, 0) if unsure else self._symmetry.better(scan, T_ca)
        if turned == [] or not budget.allows(work := self._symmetry.work(len(scan)) + TEST_WORK):
            budget.spend(screened)
            return found if turned == [] else none
        best, rivals, extra = self._symmetry.decided(
            scan,
            T_ca,
            [],
            (at := self._test.check(Observed(scan), T_ca)) is not None and at.covered,
            turned,
        )
        budget.spend(work + extra)
        if best is not T_ca:  # the rays contradict the pose, whatever the status of the turned one
            found = self._neighbourhood.at_pose(scan, best, budget, halves, carried)
        return quality.left_undetermined(found, unknown) if unsure and rivals else found

    def _unique(
        self,
        scan: NDArray[Any],
        guess: Pose,
        found: Alignment,
        budget: Budget,
        halves: bool,
        carried: bool,
    ) -> Alignment:
        """The best of the minima around a pose of a part of the target; not accepted if
        another is as good.
        """
        best, status, doubt = self._neighbourhood.best(scan, guess, found, budget)
        if best is not None:
            found = self._neighbourhood.regraded(
                scan, self._restarter.part(scan), best, budget, halves, carried
            )
        return replace(found, status=status, covariance=None, message=doubt) if doubt else found

    def _far(self, guess: Pose, found: Alignment) -> bool:
        """A measured pose so far from the guess that another local minimum may be better."""
        angle = float(geometry.angle_between(guess.q, found.T_ac.q))
        if not found.measured or angle <= TURNED_RAD or angle > FAR_RAD:
            return found.measured and angle > FAR_RAD
        return (
            found.status is not AlignStatus.DEGENERATE and len(self._symmetry.search.symmetries) > 0
        )

    def _searched(
        self, scan: NDArray[Any], found: Alignment, carried: bool, budget: Budget
    ) -> Alignment:
        """The result of the global search if the budget allows it; otherwise the pose is not
        accepted.
        """
        if budget.allows(self._symmetry.search_work(len(scan), 0) + sum(SCATTER_WORK) * len(scan)):
            return self._acquire(scan, budget, carried, known=found.T_ac.inverse())
        return replace(
            found, status=AlignStatus.BUDGET_EXHAUSTED, covariance=None, message=NOT_VERIFIED
        )

    def _at_image(
        self,
        scan: NDArray[Any],
        found: Alignment,
        guess: Pose,
        budget: Budget,
        halves: bool,
        carried: bool,
    ) -> Alignment:
        """The result of a search at that of its equal poses which is nearest to the guess."""
        if found.status not in ACCEPTED:
            return found
        poses = (found.T_ac, *self._symmetry.equal(scan, found).members)
        best = min(poses, key=lambda T_ac: float(geometry.angle_between(T_ac.q, guess.q)))
        if best is found.T_ac:
            return found
        few = self._restarter.part(scan)
        return self._neighbourhood.regraded(scan, few, best.inverse(), budget, halves, carried)

    def _recovered(
        self,
        seen: Observed,
        scan: NDArray[Any],
        guess: Pose,
        first: Alignment,
        halves: bool,
        carried: bool,
        budget: Budget,
    ) -> tuple[Alignment, bool]:
        """Register again within a distance that follows the noise; restart if implausible.

        Whether it was searched.
        """
        few = self._restarter.part(scan)
        starts = self._restarter.starts(few, first, guess, budget)
        near = [
            at
            for at in starts
            if first.measured and at.noise_m <= NOISE_OF_EXTENT * self.index.extent_m
        ]
        tried = [
            self._neighbourhood.regraded(scan, few, at, budget, halves, carried) for at in near
        ] or [first]
        hopeful = bool(near)
        final = (
            tried[0]
            if len(tried) == 1
            else self._restarter.nearest(few, tried, self.limits.gate_m, budget)
        )
        reason = self._restarter.reason(seen, final, budget, guess)
        if not (reason or self._restarter.doubtful(few, seen, guess, final, budget)):
            return self._restarter.consistent(few, guess, final, budget), False
        before, overlap = (
            None,
            first.status is not AlignStatus.NO_OVERLAP,
        )  # without: another object
        restart = not overlap or (
            hopeful and not self._far(guess, final)
        )  # a far pose is always verified by a search
        steps = ("restart", "search", "turn") if restart else ("search", "restart", "turn")
        work = self._symmetry.search_work(len(scan), 0) if overlap else 0
        for step in steps:
            if step == "search":
                known = final.T_ac.inverse() if final.measured else None
                if (
                    overlap
                    and (found := self._acquire(seen.points, budget, carried, 1, known)).status
                    in ACCEPTED
                ):
                    return self._at_image(scan, found, guess, budget, halves, carried), True
                continue
            if before and np.mean(before.distance < self.limits.gate_m) < LEAST_TO_TURN:
                break
            kept = LAST_SCANS * budget.healthy + (
                work if reason and step == "restart" and restart else 0
            )
            before = self._restarter.best(
                few, seen, guess.inverse(), final.T_ac.inverse(), budget, before, kept
            )
            if before.T_ca.matrix.tobytes() != final.T_ac.inverse().matrix.tobytes():
                final = self._neighbourhood.regraded(scan, few, before, budget, halves, carried)
                reason = self._restarter.reason(seen, final, budget, guess)
            if final.measured and not reason:
                return self._restarter.consistent(few, guess, final, budget), False
        if not reason:
            return final, False
        status = AlignStatus.BUDGET_EXHAUSTED if budget.exhausted else AlignStatus.IMPLAUSIBLE
        return replace(
            final, status=status, covariance=None, free_directions="", message=reason
        ), False
