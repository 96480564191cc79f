"""A scan and a guess in, a graded pose out: the one place where T_ac and T_ca meet."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus, Fit, Surface
from avsreplay.register.acquire import Acquirer, Acquisition
from avsreplay.register.assess import assess, instants, nothing
from avsreplay.register.facing import View
from avsreplay.register.freedom import turn_words
from avsreplay.register.params import RegisterParams
from avsreplay.register.port import Target, build, load
from avsreplay.register.sampling import thin
from avsreplay.register.second_look import look_again
from avsreplay.register.surface_index import SurfaceIndex

__all__ = ["Registrar"]


class Registrar:
    """Registers scans against one surface with one back end. Built once, used for every scan of a log."""

    def __init__(self, surface: Surface, params: RegisterParams | None = None) -> None:
        """Index the surface and build the back end.

        Raises:
            UsageError: an unknown back end, or a surface that cannot be indexed.  MissingBackend: not installed.
        """
        self.params = params or RegisterParams()
        self.limits = self.params.limits(surface.extent)
        factory = load(self.params.backend)  # before the index: a wrong name is said at once
        self._model = SurfaceIndex.build(surface, self.limits.reach_m)
        self._view = View(surface, self.params.camera)
        self._target = Target(surface, self._model, self.limits, self._view)
        self._backend = build(self.params.backend, factory, self._target)
        self._acquirer: Acquirer | None = None

    def register(self, points: NDArray[Any], guess: Pose) -> Alignment:
        """The pose of the model in the camera.

        Args:
            points: (n, 3) in {A} [m], float32 or float64, possibly strided; points that are not finite are left out.
            guess: predicted T_ac. ICP aligns scan to model, so its inverse goes in and the result's inverse comes out.

        Returns:
            The graded pose; what went wrong is its status, never an exception. Where nothing was measured T_ac is
            the guess.
        """
        scan = self._scan(points)
        if len(scan) == 0:
            return nothing(len(points), AlignStatus.NO_POINTS, guess)
        first = self._graded(scan, guess)
        return look_again(first, guess, scan, self.limits.gate_m, lambda other: self._graded(scan, other))

    def acquire(self, points: NDArray[Any]) -> Alignment:
        """The pose without a guess: the best of a search over all attitudes, then registered and graded as any other.

        The status is NO_OVERLAP where no pose explains enough of the scan, and AMBIGUOUS where a second, different pose
        explains it as well: ``weakest`` then says which turn leads there. ``search`` gives both poses.
        """
        scan = self._scan(points)
        if len(scan) == 0:
            return nothing(len(points), AlignStatus.NO_POINTS)
        search = self.search(scan)
        found = self.register(scan, search.best.T_ca.inverse())
        if not search.found:
            return replace(found, status=AlignStatus.NO_OVERLAP, covariance=None)
        if search.ambiguous and search.second is not None:
            words = turn_words(search.best.T_ca @ search.second.T_ca.inverse())
            return replace(found, status=AlignStatus.AMBIGUOUS, covariance=None, weakest=words)
        return found

    def instants(self, points: NDArray[Any], times_s: NDArray[Any], T_ac: Pose) -> Array:
        """When points that have each their own time saw the target, by direction: (6, 6) [s], see ``assess.instants``.

        Args:
            points: (n, 3) finite, in {A} [m], carried to one instant.
            times_s: (n,) their own instants, from that one [s].
            T_ac: the pose they were registered at.
        """
        return instants(self._model, self._view, points, times_s, T_ac.inverse(), self.limits.gate_m)

    def distance(self, points: NDArray[Any], T_ac: Pose, most_m: float) -> Array:
        """Distance (n,) [m] of points (n, 3) in {A} to the model at a pose, ``most_m`` or the reach at most."""
        d2 = self._model.closest(T_ac.inverse().apply(points)).d2
        return np.asarray(np.sqrt(np.minimum(d2, min(most_m, self._model.reach_m) ** 2)))

    def search(self, points: NDArray[Any]) -> Acquisition:
        """Best and second best pose of a scan (n, 3) in {A} [m], finite, n >= 1, and what can be said of them."""
        if self._acquirer is None:
            self._acquirer = Acquirer(self._target, self.params.acquire)
        return self._acquirer.search(points)

    def _scan(self, points: NDArray[Any]) -> NDArray[Any]:
        finite = np.isfinite(points).all(axis=1)
        scan = points if finite.all() else points[finite]
        return thin(scan, self.params.subsample_m) if self.params.subsample_m > 0.0 else scan

    def _graded(self, scan: NDArray[Any], guess: Pose) -> Alignment:
        fit = self._align(scan, guess.inverse())
        if fit is None:
            return nothing(len(scan), AlignStatus.FAILED, guess)
        return assess(self._model, self._view, scan, fit, self.limits, self.params)

    def _align(self, scan: NDArray[Any], guess: Pose) -> Fit | None:
        """The wall: whatever a back end raises stops here and becomes FAILED."""
        try:
            fit = self._backend.align(scan, guess)
            finite = bool(np.isfinite(fit.T_ca.matrix).all())
        except Exception:  # the one place that may: a library's trouble is a status, not the end of a replay
            return None
        return fit if finite else None
