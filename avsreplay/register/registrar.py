"""Registration of one scan from a guess, or without one; the only place where T_ac is converted to T_ca and back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus, Fit, Surface
from avsreplay.register import index_cache, quality
from avsreplay.register.backend import Target, create_backend, load_backend
from avsreplay.register.global_search import GlobalSearch, SearchResult
from avsreplay.register.horn import HornBackend
from avsreplay.register.params import RegisterParams
from avsreplay.register.plausibility import PlausibilityTest
from avsreplay.register.restarts import Budget, Restart, Restarter
from avsreplay.register.sampling import LARGER, segments, thin, without_scattered_points
from avsreplay.register.surface_index import SurfaceIndex
from avsreplay.register.visibility import Visibility

LEAST_RATIO, POOR_OF_GATE = 0.9, 0.3  # with more inliers and a smaller rms (in units of the gate) a fit is close
FAR_RAD = np.radians(30.0)  # a result rotated by more from its guess is verified by the global search
TURNED_RAD = np.radians(12.0)  # the same for a model with near-symmetries
MOST_SEGMENTS = 3
MOST_ROUNDS = MOST_SEGMENTS + 3
LEAST_TO_TURN = 0.2  # with fewer inliers turned starts have no prospect
SURE_RATIO = 0.9  # a search with fewer inliers is followed by another
MESSAGE_LENGTH = 200  # an error message is cut to this number of characters


class Registrar:
    """Registers scans to one surface with one back end. Built once, used for every scan of a log.

    Attributes:
        params: the parameters as given.
        limits: the same with every automatic length resolved for this surface.
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
        factory = load_backend(self.params.backend)  # before the index, so that a wrong name is reported at once
        self._index = _indexed(surface, self.limits.reach_m, self.params)
        self._visibility = Visibility(surface, self.params.camera)
        self._target = Target(surface, self._index, self.limits, self._visibility)
        self._accuracy: tuple[float, float] = getattr(factory, "accuracy", quality.ACCURACY)
        self._backend = create_backend(self.params.backend, factory, self._target)
        self._test = PlausibilityTest(surface, self._index, self._visibility, self.limits.gate_m)
        self._restarter = Restarter(self._target, self._test)

    def register(self, points: NDArray[Any], guess: Pose, seq: int = 0, carried: bool = False) -> Alignment:
        """Register a scan from a guess (eq:ICP).

        Args:
            points: (n, 3) in {A} [m], float32 or float64, possibly strided; points that are not finite are left out.
            guess: predicted T_ac. ICP aligns the scan to the model, so its inverse goes in and the inverse comes out.
            seq: number of the scan; two halves of it are compared if ``split_every`` divides it.
            carried: the points were carried to one instant by the predicted motion. An error of this motion distorts
                the scan like a systematic error, but the estimator models it (``Alignment.instants``): the covariance
                then leaves it out, so that it is not counted twice.

        Returns:
            The pose T_ac with its quality. A failure is reported as its status, never as an exception. Where nothing
            was measured T_ac is the guess.
        """
        scan = self._scan(points)
        if len(scan) == 0:
            return quality.not_measured(len(points), AlignStatus.NO_POINTS, guess)
        first = self._graded(scan, guess, halves=seq % self.params.split_every == 0, carried=carried)
        if first.status is AlignStatus.FAILED:
            return first
        found, searched = (first, False) if self._healthy(first) else self._recovered(scan, guess, first, carried)
        return self._searched(scan, found, carried) if self._far(guess, found) and not searched else found

    def acquire(self, points: NDArray[Any]) -> Alignment:
        """Find the pose without a guess: register the scan from the best pose of a search over all attitudes.

        Args:
            points: as for :meth:`register`.

        Returns:
            The pose T_ac with its quality. The status is NO_OVERLAP if no pose explains enough of the scan, and
            AMBIGUOUS if a second, different pose explains it as well: ``free_directions`` then names the rotation to
            that pose. ``search`` gives both poses.
        """
        scan = self._scan(points)
        if len(scan) == 0:
            return quality.not_measured(len(points), AlignStatus.NO_POINTS)
        return self._acquire(scan, Budget(len(scan)))

    def _acquire(
        self, scan: NDArray[Any], budget: Budget, carried: bool = False, rounds: int = MOST_ROUNDS
    ) -> Alignment:
        """The best plausible result of the searches that the budget allows; the first is always made."""
        target = without_scattered_points(np.asarray(scan, dtype=np.float64))
        few = self._restarter.part(target)
        whole: SearchResult | None = None
        results: list[Alignment] = []
        for part, number in islice(self._attempts(target), rounds):
            work = self._global.work(len(part), number)
            if results and not budget.allows(work):
                break
            budget.spend(work)
            search = self._global.search(part, number, whole if part is target else None)
            whole = search if part is target else whole
            results.append(self._acquired(scan, part, search, carried))
            if results[-1].status is AlignStatus.FAILED:
                return results[-1]
            if results[-1].measured and self._sure(part, search):
                break
        measured = [(each, self._restarter.measure(few, each.T_ac.inverse())) for each in results if each.measured]
        if measured:
            width = max(self.limits.gate_m, 3.0 * min(restart.noise_m for _, restart in measured))
            return min(measured, key=lambda each: each[1].cost(width))[0]
        first = results[0]
        if not budget.exhausted:
            return first
        message = "no pose of the model explains the scan, and no work is left for a longer search"
        return replace(first, status=AlignStatus.BUDGET_EXHAUSTED, covariance=None, message=message)

    def _sure(self, part: Array, search: SearchResult) -> bool:
        """Whether no other round can find a better pose: what is not on the model is little, or another object."""
        if search.width_m > self.limits.gate_m:
            return False
        return search.inlier_ratio >= SURE_RATIO or (not search.ambiguous and self._beside(part, search))

    def _beside(self, part: Array, search: SearchResult) -> bool:
        """Whether the points off the model are another object's, as far as free space can tell."""
        at = self._restarter.measure(self._restarter.part(part), search.best)
        return self._visibility.sided and at.separate(max(self.limits.gate_m, 3.0 * at.noise_m))

    def _attempts(self, target: Array) -> Iterator[tuple[Array, int]]:
        """What is searched and by which round: the whole scan, its parts, then the whole scan with other starts."""
        extent = self._target.surface.extent
        small = geometry.bounding_diagonal(target) <= LARGER * extent  # probably the target alone
        yield target, 0
        if small:
            yield target, 1
        for part in islice(segments(target, extent), MOST_SEGMENTS):
            yield part, 0
        if not small:
            yield target, 1
        yield target, 2

    def _acquired(self, scan: NDArray[Any], part: Array, search: SearchResult, carried: bool) -> Alignment:
        """Register the result of a search of part of the scan on the whole scan, and test it."""
        few = self._restarter.part(part)
        start = self._restarter.measure(few, search.best)
        width = max(self.limits.gate_m, 3.0 * start.noise_m)
        found = self._graded(scan, search.best.inverse(), width, carried=carried)
        if found.status is AlignStatus.FAILED:
            return found
        p = self.params.acquire
        least = p.least_separate if self._visibility.sided and start.separate(width) else p.least_ratio
        if search.inlier_ratio < least or not found.measured:
            return replace(found, status=AlignStatus.NO_OVERLAP, covariance=None)
        reason = self._test.check(few, found.T_ac.inverse(), self._restarter.part(scan)).reason
        if reason:
            return replace(found, status=AlignStatus.IMPLAUSIBLE, covariance=None, message=reason)
        if search.ambiguous and search.second is not None:
            words = quality.turn_words(search.best @ search.second.inverse())
            return replace(found, status=AlignStatus.AMBIGUOUS, covariance=None, free_directions=words)
        return found

    def instants(self, points: NDArray[Any], times_s: NDArray[Any], T_ac: Pose) -> Array:
        """Return the effective measurement time of each direction, (6, 6) [s], see ``quality.instants``.

        Args:
            points: (n, 3) finite, in {A} [m], motion-compensated to one instant.
            times_s: (n,) measurement time of each point relative to that instant [s].
            T_ac: the registered pose.
        """
        return quality.instants(self._index, self._visibility, points, times_s, T_ac.inverse(), self.limits.gate_m)

    def distance(self, points: NDArray[Any], T_ac: Pose, most_m: float) -> Array:
        """Return the distances (n,) of points to the model [m].

        Args:
            points: (n, 3) in {A} [m].
            T_ac: pose of the model.
            most_m: larger distances are limited to this value [m]; it is at most the reach of the index.
        """
        most_m = min(most_m, self._index.reach_m)
        d2 = self._index.closest(T_ac.inverse().apply(points), most_m=most_m).d2
        return np.asarray(np.sqrt(np.minimum(d2, most_m**2)))

    def scale_error(self, p: Array, camera_c: Array, width_m: float, rounds: int) -> tuple[float, float] | None:
        """Return delta (target over model, less 1) from points of a registered scan, and the information on it.

        Args:
            p: (n, 3) points in {C} [m], at the registered pose.
            camera_c: (3,) camera position in {C} [m].
            width_m: residuals beyond this distance are not used.
            rounds: times the points are matched again.

        Returns:
            delta, and the share of n . p that no pose explains; None with fewer than 50 residuals.
        """
        camera = camera_c if self._visibility.sided else None
        return quality.scale_error(self._index, p, camera, width_m, rounds)

    def search(self, points: NDArray[Any]) -> SearchResult:
        """Return the best and the second best pose of a scan by the global search.

        Args:
            points: (n, 3) finite, n >= 1, in {A} [m].
        """
        return self._global.search(points)

    @cached_property
    def _global(self) -> GlobalSearch:
        return GlobalSearch(self._target, self.params.acquire)

    def _scan(self, points: NDArray[Any]) -> NDArray[Any]:
        finite = np.isfinite(points)
        scan = points if finite.all() else points[finite.all(axis=1)]
        return thin(scan, self.params.subsample_m) if self.params.subsample_m > 0.0 else scan

    def _healthy(self, found: Alignment) -> bool:
        """A close fit of nearly all points needs no further test."""
        return found.inlier_ratio >= LEAST_RATIO and found.rms_m <= POOR_OF_GATE * self.limits.gate_m

    def _far(self, guess: Pose, found: Alignment) -> bool:
        """A measured pose so far from the guess that another local minimum may be better."""
        angle = float(geometry.angle((guess.inverse() @ found.T_ac).q))
        if not found.measured or found.status is AlignStatus.DEGENERATE or angle < TURNED_RAD:
            return False
        return angle > FAR_RAD or self._global.near_symmetric

    def _searched(self, scan: NDArray[Any], found: Alignment, carried: bool) -> Alignment:
        """The result of the global search if the budget allows it; otherwise the pose is not accepted."""
        budget = Budget(len(scan), found.iterations * len(scan))
        if budget.allows(self._global.work(len(scan), 0)):
            return self._acquire(scan, budget, carried)
        far = f"rotated by more than {np.degrees(FAR_RAD):.0f} deg from the guess, and no work left for a global search"
        return replace(found, status=AlignStatus.BUDGET_EXHAUSTED, covariance=None, message=far)

    def _doubtful(self, points: NDArray[Any], guess: Pose, found: Alignment) -> bool:
        """A failure, or a poor fit away from the guess: possibly a local minimum next to the true pose."""
        if found.status is AlignStatus.FAILED or not found.inliers:
            return True
        moved = found.T_ac.inverse().apply(points) - guess.inverse().apply(points)
        far = float(np.linalg.norm(moved, axis=1).mean()) > self.limits.gate_m
        return far and found.rms_m > POOR_OF_GATE * self.limits.gate_m

    def _recovered(self, scan: NDArray[Any], guess: Pose, first: Alignment, carried: bool) -> tuple[Alignment, bool]:
        """Test a pose with a poor fit and restart if it is implausible; whether the result is of a global search."""
        few = self._restarter.part(scan)
        budget = Budget(len(scan), spent=first.iterations * len(scan))
        kept = self._restarter.measure(few, first.T_ac.inverse())
        final, reason = first, self._test.check(few, kept.T_ca).reason if first.measured else ""
        if not (self._doubtful(few, guess, first) or reason):
            return self._regraded(scan, kept, first, carried), False
        before: Restart | None = None
        for _ in range(2):
            kept = self._restarter.best(few, guess.inverse(), first.T_ac.inverse(), budget, before)
            final = self._regraded(scan, kept, first, carried)
            reason = self._test.check(few, final.T_ac.inverse()).reason if final.measured else ""
            if final.measured and not reason:
                return final, False
            overlap = first.status is not AlignStatus.NO_OVERLAP  # without, the scan may show something else
            if before is None and overlap and budget.allows(self._global.work(len(scan), 0)):
                found = self._acquire(scan, budget, carried, rounds=1)
                if found.status is AlignStatus.ALIGNED:
                    return found, True
            before = kept
            if np.mean(kept.distance < self.limits.gate_m) < LEAST_TO_TURN:
                break
        if not reason:
            return final, False
        status = AlignStatus.BUDGET_EXHAUSTED if budget.exhausted else AlignStatus.IMPLAUSIBLE
        return replace(final, status=status, covariance=None, free_directions="", message=reason), False

    def _regraded(self, scan: NDArray[Any], kept: Restart, first: Alignment, carried: bool) -> Alignment:
        """Register from the pose of a restart with a rejection distance that follows the noise."""
        width = max(self.limits.gate_m, 3.0 * kept.noise_m)
        same = kept.T_ca.t.tobytes() == first.T_ac.inverse().t.tobytes() and width == self.limits.gate_m
        return first if same else self._graded(scan, kept.T_ca.inverse(), width, carried=carried)

    def _graded(
        self, scan: NDArray[Any], guess: Pose, width_m: float | None = None, halves: bool = True, carried: bool = False
    ) -> Alignment:
        """Register and measure the quality; ``width_m``: rejection distance from the first pass on, and of inliers."""
        start = guess.inverse()
        fit = self._align(scan, start, width_m)
        if isinstance(fit, str):
            return replace(quality.not_measured(len(scan), AlignStatus.FAILED, guess), message=fit)
        limits = self.limits if width_m is None else replace(self.limits, gate_m=width_m)
        found = quality.grade(
            self._index, self._visibility, scan, fit, limits, self.params, halves, self._accuracy, not carried, start
        )
        if found.status is AlignStatus.DEGENERATE:
            at = (self._index, self._visibility, scan, fit.T_ca, limits.gate_m)
            found = replace(found, T_ac=quality.with_free_directions_of(start, *at).inverse())
        if found.status is AlignStatus.FAILED:
            found = replace(found, T_ac=guess, message=f"back end '{self.params.backend}' {found.message}")
        return found

    def _align(self, scan: NDArray[Any], guess: Pose, width_m: float | None) -> Fit | str:
        """Run the back end; what it raises, or a result of another type, becomes the status FAILED with this text."""
        name = f"back end '{self.params.backend}'"
        try:
            if width_m is not None and isinstance(self._backend, HornBackend):
                fit = self._backend.align_within(scan, guess, width_m)
            else:
                fit = self._backend.align(scan, guess)
            if not isinstance(fit, Fit):
                return f"{name} returned {type(fit).__name__}, not Fit"
            finite = bool(np.isfinite(fit.T_ca.matrix).all())
        except Exception as error:  # an error of a library is a status of this scan, not the end of a replay
            return f"{name} failed: {type(error).__name__}: {error}".splitlines()[0][:MESSAGE_LENGTH]
        return fit if finite else f"{name} returned a pose that is not finite"


def _indexed(surface: Surface, reach_m: float, params: RegisterParams) -> SurfaceIndex:
    large = max(len(surface.vertices), len(surface.faces)) >= index_cache.LEAST_PRIMITIVES
    cache_dir = index_cache.user_folder() if params.index_cache and large else None
    return SurfaceIndex.build(surface, reach_m, threads=params.threads, cache_dir=cache_dir)
