"""Acquisition: the pose from a scan alone, no guess, any attitude; and how sure that is.

From coarse to fine: every start (an attitude, and the scan's middle laid on the middle of what the model would show) is
run a few plane passes with few points against points drawn from the model; the best go on with more points; the last
few, all different poses, are registered on the model itself and ranked by the share of the scan they leave unexplained.
A scan taken from an unknown place is tried with six sights. Where nothing explains the scan, more starts follow.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Surface
from avsreplay.register.horn import HornBackend
from avsreplay.register.params import AcquireParams
from avsreplay.register.port import Target
from avsreplay.register.sampling import even, sample, without_strays
from avsreplay.register.starts import VisibleCentres, attitudes
from avsreplay.register.surface_index import IcpParams, SurfaceIndex

__all__ = ["Acquirer", "Acquisition", "Candidate"]

MODEL_POINTS = 3000
REACH_OF_EXTENT = 0.5
COARSE_OF_EXTENT, MIDDLE_OF_EXTENT = 0.03, 0.02  # distances beyond which a point counts as unexplained
SAME_RAD, SAME_OF_EXTENT = np.radians(10.0), 0.05  # nearer than that two poses are one
SIGMAS = 5.0
FINE_PASSES = 40  # a pose that is not right may creep for hundreds


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pose T_ca, the share of the scan it leaves unexplained, and the share of points on the model."""

    T_ca: Pose
    unexplained: float
    inlier_ratio: float


@dataclass(frozen=True, slots=True, eq=False)
class Acquisition:
    """What a search found.

    Attributes:
        best, second: the two best poses that differ by more than 10 deg or 0.05 of the extent; second may be None.
        found: the best explains enough of the scan.
        ambiguous: the second explains it as well, as far as these points can tell.
        starts: how many were tried.
    """

    best: Candidate
    second: Candidate | None
    found: bool
    ambiguous: bool
    starts: int


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    T_ca: Array  # (4, 4)
    cost: float

    @property
    def pose(self) -> Pose:
        return Pose.from_matrix(self.T_ca)


class Acquirer:
    """Searches for one target. Built once; a search changes nothing in it.

    The first effort takes the camera for {A}'s origin where the scan allows it (``View.sight``); the second does not
    rely on that.
    """

    def __init__(self, target: Target, params: AcquireParams) -> None:
        self._target, self._params = target, params
        self._extent = target.surface.extent
        self._points, self._normals = _drawn(target.surface)
        cloud = Surface(self._points, np.empty((0, 3), dtype=np.int32), target.surface.name, "")
        self._cloud = SurfaceIndex.build(cloud, REACH_OF_EXTENT * self._extent)
        self._sided = target.view.sided
        self._centres = VisibleCentres(self._points, self._normals, self._extent)
        self._middle = self._points.mean(axis=0)
        brief = replace(target.limits, n_max=min(FINE_PASSES, target.limits.n_max))
        self._refine = HornBackend(replace(target, limits=brief))
        self._settle = HornBackend(target)

    def search(self, points: NDArray[Any]) -> Acquisition:
        """The best poses for a scan (n, 3) in {A} [m], finite, n >= 1."""
        scan = without_strays(np.asarray(points, dtype=np.float64))
        p = self._params
        few, some, fine = (even(scan, count) for count in (p.coarse_points, p.middle_points, p.fine_points))
        sight = self._target.view.sight(scan)
        finals: list[Candidate] = []
        tried = 0
        for sights, sided in (([sight], sight is not None), ([sight, *_axes(few)], False)):
            starts = list(self._starts(few.mean(axis=0), sights))
            finals += self._refined(fine, self._selected(few, some, starts, sided))
            tried += len(starts)
            if max((final.inlier_ratio for final in finals), default=0.0) >= p.enough_ratio:
                break
        return self._verdict(fine, finals, tried)

    def _starts(self, centre_a: Array, sights: Sequence[Array | None]) -> Iterator[Pose]:
        """Every attitude with every sight: the scan's middle laid on the middle of what the model would show."""
        quaternions = attitudes(self._params.starts)
        for q, R_ca in zip(quaternions, geometry.matrix(quaternions), strict=True):
            for sight in sights:
                middle = self._middle if sight is None else self._centres.of(R_ca @ sight)
                yield Pose(q, middle - R_ca @ centre_a)

    def _selected(self, few: Array, some: Array, starts: list[Pose], sided: bool) -> list[Pose]:
        """The best starts after plane passes with few points, then the best of these, all different, with more."""
        p, extent = self._params, self._extent
        coarse = IcpParams(
            n_max=p.coarse_passes,
            n_plane=p.coarse_passes,
            floor_m=COARSE_OF_EXTENT * extent,
            eps_rad=1e-3,
            eps_m=1e-3 * extent,
        )
        middle = IcpParams(
            n_max=p.middle_passes,
            n_plane=p.middle_passes,
            gate_m=0.15 * extent,
            floor_m=0.01 * extent,
            eps_rad=1e-4,
            eps_m=1e-4 * extent,
        )
        trials = [self._trial(few, T_ca, coarse, COARSE_OF_EXTENT, sided) for T_ca in starts]
        best = sorted(trials, key=lambda trial: trial.cost)[: p.middle_starts]
        return self._different([self._trial(some, t.pose, middle, MIDDLE_OF_EXTENT, sided) for t in best])

    def _trial(self, points: Array, T_ca: Pose, rule: IcpParams, beyond: float, sided: bool) -> _Trial:
        end = self._cloud.icp(points, T_ca, rule).T_ca
        found = self._cloud.closest(points @ end[:3, :3].T + end[:3, 3])
        cost = np.minimum(found.d2 / (beyond * self._extent) ** 2, 1.0)
        if sided and self._sided:  # the drawn points keep their face's outward normal: their back cannot be seen
            away = np.einsum("ij,ij->i", self._normals[found.id], end[:3, 3] - self._points[found.id]) <= 0.0
            cost[away] = 1.0
        return _Trial(end, float(cost.mean()))

    def _different(self, trials: list[_Trial]) -> list[Pose]:
        """The best few that are not the same pose, best first."""
        kept: list[Pose] = []
        for trial in sorted(trials, key=lambda trial: trial.cost):
            pose = trial.pose
            if all(not self._same(pose, other, 0.5) for other in kept):
                kept.append(pose)
            if len(kept) == self._params.fine_starts:
                break
        return kept

    def _refined(self, fine: Array, poses: list[Pose]) -> list[Candidate]:
        return [self._graded(fine, self._refine.align(fine, T_ca).T_ca) for T_ca in poses]

    def _graded(self, points: Array, T_ca: Pose) -> Candidate:
        cost = self._unexplained(points, T_ca)
        return Candidate(T_ca, float(cost.mean()), float(np.mean(cost < 1.0)))

    def _unexplained(self, points: Array, T_ca: Pose) -> Array:
        """(n,) min(1, squared distance to the model in units of the gate), on the side the camera sees."""
        target = self._target
        camera_c = target.view.camera_c(target.model, points, T_ca)
        found = target.model.closest(T_ca.apply(points), camera_c=camera_c)
        return np.minimum(found.d2 / target.limits.gate_m**2, 1.0)

    def _verdict(self, fine: Array, finals: list[Candidate], starts: int) -> Acquisition:
        ranked = sorted(finals, key=lambda final: final.unexplained)
        second = next((other for other in ranked[1:] if not self._same(ranked[0].T_ca, other.T_ca, 1.0)), None)
        rivals = [ranked[0], *([second] if second else [])]  # compared only once both have settled
        rivals = [self._graded(fine, self._settle.align(fine, rival.T_ca).T_ca) for rival in rivals]
        best, *rest = sorted(rivals, key=lambda rival: rival.unexplained)
        second = rest[0] if rest and not self._same(best.T_ca, rest[0].T_ca, 1.0) else None
        found = best.inlier_ratio >= self._params.least_ratio
        return Acquisition(best, second, found, second is not None and self._as_good(fine, best, second), starts)

    def _as_good(self, fine: Array, best: Candidate, second: Candidate) -> bool:
        """Is the second's excess, point by point, within 5 sigma of its mean or under the least margin?"""
        excess = self._unexplained(fine, second.T_ca) - self._unexplained(fine, best.T_ca)
        doubt = SIGMAS * float(excess.std()) / np.sqrt(len(fine))
        return bool(excess.mean() < max(self._params.margin, doubt))

    def _same(self, first: Pose, other: Pose, scale: float) -> bool:
        step = first @ other.inverse()  # in {C}
        shift = float(np.linalg.norm(step.apply(self._middle) - self._middle))
        return float(geometry.angle(step.q)) < scale * SAME_RAD and shift < scale * SAME_OF_EXTENT * self._extent


def _axes(points: Array) -> list[Array]:
    """The six ends of a scan's principal axes: one of them is not far from where it was seen from."""
    axes = np.linalg.eigh(np.cov(points.T))[1].T if len(points) > 3 else np.eye(3)
    return [*axes, *-axes]


def _drawn(surface: Surface) -> tuple[Array, Array]:
    points, normals = sample(surface, MODEL_POINTS)
    if len(surface.faces):
        return points, normals
    thinned = even(points, MODEL_POINTS)
    return thinned, np.zeros_like(thinned)
