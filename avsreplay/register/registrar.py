"""Registration of one scan from a guess, or without one; the only place where T_ac is converted to T_ca and back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus, Fit, Surface
from avsreplay.register import quality
from avsreplay.register.backend import Target, build, load
from avsreplay.register.global_search import GlobalSearch, SearchResult
from avsreplay.register.params import RegisterParams
from avsreplay.register.restarts import restart_if_doubtful
from avsreplay.register.sampling import thin
from avsreplay.register.surface_index import SurfaceIndex
from avsreplay.register.visibility import Visibility


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
        factory = load(self.params.backend)  # before the index, so that a wrong name is reported at once
        self._index = SurfaceIndex.build(surface, self.limits.reach_m)
        self._visibility = Visibility(surface, self.params.camera)
        self._target = Target(surface, self._index, self.limits, self._visibility)
        self._backend = build(self.params.backend, factory, self._target)
        self._search: GlobalSearch | None = None

    def register(self, points: NDArray[Any], guess: Pose) -> Alignment:
        """Register a scan from a guess (eq:ICP).

        Args:
            points: (n, 3) in {A} [m], float32 or float64, possibly strided; points that are not finite are left out.
            guess: predicted T_ac. ICP aligns the scan to the model, so its inverse goes in and the inverse comes out.

        Returns:
            The pose T_ac with its quality. A failure is reported as its status, never as an exception. Where nothing
            was measured T_ac is the guess.
        """
        scan = self._scan(points)
        if len(scan) == 0:
            return quality.not_measured(len(points), AlignStatus.NO_POINTS, guess)
        first = self._graded(scan, guess)
        return restart_if_doubtful(first, guess, scan, self.limits.gate_m, lambda other: self._graded(scan, other))

    def acquire(self, points: NDArray[Any]) -> Alignment:
        """Find the pose without a guess: the best of a search over all attitudes, then registered as any other.

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
        search = self.search(scan)
        found = self.register(scan, search.best.T_ca.inverse())
        if not search.found:
            return replace(found, status=AlignStatus.NO_OVERLAP, covariance=None)
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
        """Return the distance (n,) [m] of points (n, 3) in {A} to the model at a pose, limited to ``most_m``."""
        d2 = self._index.closest(T_ac.inverse().apply(points)).d2
        return np.asarray(np.sqrt(np.minimum(d2, min(most_m, self._index.reach_m) ** 2)))

    def search(self, points: NDArray[Any]) -> SearchResult:
        """Return the best and second best pose of a scan (n, 3) in {A} [m], finite, n >= 1."""
        if self._search is None:
            self._search = GlobalSearch(self._target, self.params.acquire)
        return self._search.search(points)

    def _scan(self, points: NDArray[Any]) -> NDArray[Any]:
        finite = np.isfinite(points).all(axis=1)
        scan = points if finite.all() else points[finite]
        return thin(scan, self.params.subsample_m) if self.params.subsample_m > 0.0 else scan

    def _graded(self, scan: NDArray[Any], guess: Pose) -> Alignment:
        fit = self._align(scan, guess.inverse())
        if fit is None:
            return quality.not_measured(len(scan), AlignStatus.FAILED, guess)
        return quality.grade(self._index, self._visibility, scan, fit, self.limits, self.params)

    def _align(self, scan: NDArray[Any], guess: Pose) -> Fit | None:
        """Run the back end; whatever it raises becomes the status FAILED."""
        try:
            fit = self._backend.align(scan, guess)
            finite = bool(np.isfinite(fit.T_ca.matrix).all())
        except Exception:  # an error of a library is a status of this scan, not the end of a replay
            return None
        return fit if finite else None
