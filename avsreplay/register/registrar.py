"""Registration of one scan from a guess, or without one; the only place where T_ac is
converted to T_ca and back.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus, Surface
from avsreplay.register import index_cache, quality
from avsreplay.register.backend import Target, create_backend, load_backend
from avsreplay.register.decision import ACCEPTED
from avsreplay.register.evidence import Observed
from avsreplay.register.hypotheses import Case
from avsreplay.register.loop import Loop
from avsreplay.register.params import RegisterParams
from avsreplay.register.sampling import usable_points
from avsreplay.register.shown import POSTPONED, Effort
from avsreplay.register.surface_index import SurfaceIndex
from avsreplay.register.visibility import Visibility


class Registrar:
    """Registers scans to one surface with one back end. Built once, used for every scan of a log.

    Attributes:
        params, index: the parameters as given; the index of the model.
        target, backend: what is registered to; the back end that aligns.
        loop: what proposes poses, tests them and decides.
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
        cache_dir = index_cache.folder_for(surface) if self.params.index_cache else None
        self._visibility = Visibility(surface, self.params.camera, cache_dir)
        surface, self.sided = self._visibility.surface, self._visibility.sided
        self.index = SurfaceIndex.build(
            surface, self.limits.reach_m, threads=self.params.threads, cache_dir=cache_dir
        )
        self.target = Target(surface, self.index, self.limits, self._visibility)
        self.backend = create_backend(self.params, factory, self.target)
        self.loop = Loop(self.target, self.params, self.backend, cache_dir)

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
        if refused := self.loop.test.refused(whole, len(points), guess):
            return refused
        scan = self.loop.test.around(whole, guess)
        if effort is Effort.GUESS and not self.loop.screen.confirms(scan, guess):
            status = AlignStatus.POSTPONED
            return replace(quality.not_measured(len(scan), status, guess), message=POSTPONED)
        few, halves = self.loop.screen.part(scan), seq % self.params.split_every == 0
        case = Case(Observed(whole), scan, few, guess, carried, halves, unknown)
        found = self.loop.from_guess(case)
        return found if found.points == len(whole) else replace(found, points=len(whole))

    def acquire(
        self,
        points: NDArray[Any],
        effort: Effort = Effort.FULL,
        ambiguous: Pose | None = None,
    ) -> Alignment:
        """Find the pose without a guess: register the scan from the best pose of a search over all
        attitudes.

        Args:
            points: as for :meth:`register`.
            effort: what is done for the scan; only with the full effort it is searched.
            ambiguous: T_ac of a scan shortly before that was AMBIGUOUS; None for none. As long as
                the same turned poses explain the scan there as well, they are the result. If they
                do no longer, the scan is searched with any effort.

        Returns:
            The pose T_ac with its quality. The status is NO_OVERLAP if no pose explains enough of
            the scan, and AMBIGUOUS if a second, different pose explains it as well:
            ``free_directions`` names the rotation to it. A motion of a DEGENERATE view along its
            unobservable directions is not a different pose.
        """
        scan = usable_points(points, self.params.subsample_m)
        if refused := self.loop.test.refused(scan, len(points)):
            return refused
        few, seen = self.loop.screen.part(scan), Observed(scan)
        found = None
        if ambiguous is not None:
            found = self.loop.turned(Case(seen, scan, few, ambiguous))
        if found is not None and found.status is AlignStatus.AMBIGUOUS:
            return found
        if effort is not Effort.FULL and (found is None or found.status not in ACCEPTED):
            return replace(
                quality.not_measured(len(points), AlignStatus.POSTPONED), message=POSTPONED
            )
        return self.loop.without_guess(Case(seen, scan, few))

    def images(self, T_ac: Pose) -> list[Pose]:
        """Return the poses that no scan can tell from a pose, because an exact symmetry of the
        model carries it onto itself; the pose itself is the first.

        Args:
            T_ac: the pose.
        """
        return [T_ac, *(each.inverse() for each in self.loop.symmetry.images(T_ac.inverse()))]

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
