"""Registration of one scan from a guess, or without one; the only place where T_ac is converted to T_ca and back."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from itertools import chain, islice
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
from avsreplay.register.restarts import Budget, Restarter
from avsreplay.register.sampling import thin
from avsreplay.register.segments import segments, without_scattered_points
from avsreplay.register.surface_index import SurfaceIndex
from avsreplay.register.visibility import Visibility

LEAST_RATIO, POOR_OF_GATE = 0.9, 0.3  # with more inliers and a smaller rms (in units of the gate) a fit is close
FAR_RAD = np.radians(30.0)  # a result rotated by more from its guess is verified by the global search
SEARCH_WORK = 2_000_000  # approximate number of point searches in the first round of the global search
MOST_SEGMENTS = 3
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
        found = first if self._healthy(first) else self._recovered(scan, guess, first)
        return self._searched(scan, found) if self._far(guess, found) else found

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
        target = without_scattered_points(np.asarray(scan, dtype=np.float64))
        attempts = chain(
            [(target, 0, 0)],
            ((part, 0, 0) for part in islice(segments(target, self._target.surface.extent), MOST_SEGMENTS)),
            [(target, 1, 2)],
        )
        results: list[Alignment] = []
        for part, first, last in attempts:
            results.append(self._acquired(scan, part, self._global.search(part, first, last)))
            if results[-1].measured or results[-1].status is AlignStatus.FAILED:
                return results[-1]
        return results[0]

    def _acquired(self, scan: NDArray[Any], part: Array, search: SearchResult) -> Alignment:
        """Register the result of a search of part of the scan on the whole scan, and test it."""
        T_ca, few = search.best.T_ca, self._restarter.part(part)
        width = max(self.limits.gate_m, 3.0 * self._restarter.measure(few, T_ca).noise_m)
        found = self._graded(scan, T_ca.inverse(), width)
        if found.status is AlignStatus.FAILED:
            return found
        if not search.found or not found.measured:
            return replace(found, status=AlignStatus.NO_OVERLAP, covariance=None)
        reason = self._test.check(few, found.T_ac.inverse(), self._restarter.part(scan)).reason
        if reason:
            return replace(found, status=AlignStatus.IMPLAUSIBLE, covariance=None, message=reason)
        if search.ambiguous and search.second is not None:
            words = quality.turn_words(search.best.T_ca @ search.second.T_ca.inverse())
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
        return found.measured and found.status is not AlignStatus.DEGENERATE and angle > FAR_RAD

    def _searched(self, scan: NDArray[Any], found: Alignment) -> Alignment:
        """The result of the global search if the budget allows it; otherwise the pose is not accepted."""
        if Budget(len(scan), found.iterations * len(scan)).allows(SEARCH_WORK):
            return self.acquire(scan)
        far = f"rotated by more than {np.degrees(FAR_RAD):.0f} deg from the guess, and no work left for a global search"
        return replace(found, status=AlignStatus.BUDGET_EXHAUSTED, covariance=None, message=far)

    def _doubtful(self, points: NDArray[Any], guess: Pose, found: Alignment) -> bool:
        """A failure, or a poor fit away from the guess: possibly a local minimum next to the true pose."""
        if found.status is AlignStatus.FAILED or not found.inliers:
            return True
        moved = found.T_ac.inverse().apply(points) - guess.inverse().apply(points)
        far = float(np.linalg.norm(moved, axis=1).mean()) > self.limits.gate_m
        return far and found.rms_m > POOR_OF_GATE * self.limits.gate_m

    def _recovered(self, scan: NDArray[Any], guess: Pose, first: Alignment) -> Alignment:
        """Test a pose with a poor fit; restart if it is implausible, and report what remains implausible."""
        few = self._restarter.part(scan)
        budget = Budget(len(scan), spent=first.iterations * len(scan))
        kept = self._restarter.measure(few, first.T_ac.inverse())
        suspect = self._doubtful(few, guess, first) or bool(self._test.check(few, kept.T_ca).reason)
        if suspect:
            kept = self._restarter.best(few, guess.inverse(), first.T_ac.inverse(), budget)
        width = max(self.limits.gate_m, 3.0 * kept.noise_m)
        unchanged = kept.T_ca.t.tobytes() == first.T_ac.inverse().t.tobytes() and width == self.limits.gate_m
        final = first if unchanged else self._graded(scan, kept.T_ca.inverse(), width)
        reason = self._test.check(few, final.T_ac.inverse()).reason if final.measured else ""
        if not reason:
            return final
        status = AlignStatus.BUDGET_EXHAUSTED if budget.exhausted else AlignStatus.IMPLAUSIBLE
        return replace(final, status=status, covariance=None, free_directions="", message=reason)

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
