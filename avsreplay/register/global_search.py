"""Global search: the pose from one scan alone, without a guess, for any attitude; and whether it is
unique.

The search goes from coarse to fine. A start is an attitude with the centroid of the scan on the
centroid of the surface visible from there. It is refined by a few point-to-plane passes with few
points against points sampled from the model, which are looked up in a grid. The best starts are
refined with more points. The last few, all different poses, are registered to the model itself and
ranked by the truncated distances that remain. If no pose explains the scan, more starts follow:
shifted ones for a target that is partly hidden, and other positions of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry, mesh
from avsreplay.geometry import Array, Pose
from avsreplay.records import Surface
from avsreplay.register.backend import HornBackend, Target
from avsreplay.register.comparison import Measured, as_good, least_noise
from avsreplay.register.evidence import MEASURED_OF_EXTENT
from avsreplay.register.params import AcquireParams
from avsreplay.register.plausibility import NOISE_OF_EXTENT
from avsreplay.register.poses import Sameness
from avsreplay.register.sampling import (
    NORMAL_NEIGHBOURS,
    SIGHT_POINTS,
    attitudes,
    fitted_normals,
    line_of_sight,
    sample_evenly,
    scan_axes,
    thin_to,
    without_sparse_points,
)
from avsreplay.register.surface_index import kernel_module
from avsreplay.register.visibility import VisibleCentroids

# points: first and second selection, final ranking
COARSE_POINTS = 100
MIDDLE_POINTS = 300
FINE_POINTS = 1500
# point-to-plane iterations for each attitude in the two selections
COARSE_PASSES = 8
MIDDLE_PASSES = 12
# attitudes kept for the second selection, and poses registered on the model
MIDDLE_STARTS = 50
FINE_STARTS = 10
# sampled from the model; cells of the grid along its diagonal
MODEL_POINTS = 3000
CELLS = 40
# distances of unexplained points
COARSE_OF_EXTENT = 0.03
MIDDLE_OF_EXTENT = 0.02
# rejection distance of the first pass, and its factor from pass to pass
FIRST_GATE_OF_EXTENT = 0.3
GATE_FALL = 0.7
# after two passes with part of the points one start in three is kept
FIRST_PASSES = 2
KEPT_AFTER_FIRST = 3
# after two more passes with all of them one start in eight is kept
SECOND_PASSES = 2
KEPT_AFTER_SECOND = 8
# passes with every second point, after which so many are left
MIDDLE_FIRST = 4
MIDDLE_STRIDE = 2
KEPT_IN_MIDDLE = 20
# every n-th point, and every n-th attitude, by the round
FIRST_STRIDES = (2, 3, 3)
THINNED = (1, 2, 2)
# largest unexplained share of the surface turned onto itself; most motions tried
SYMMETRIC = 0.3
SYMMETRIES = 6
# a point that an exact symmetry carries is this near the surface; share of points that may not be
CARRIED_OF_EXTENT = 0.002
MOST_UNCARRIED = 0.02
TURNED_PASSES = 6
TURNED_RIVALS = 2
# poses that are registered to the end: share of unexplained points over the least
RIVALS = 6
RIVAL_WITHIN = 0.15
# noise over the extent lowers the cost of a wrong pose near more surface by up to this factor
FAVOURED = 5.0
LAST_FINE_POINTS = 500  # fine points with which the last poses are registered
# a pass that moves the pose by less ends a registration, as poses are compared
ENDED_RAD = 1e-4
ENDED_OF_EXTENT = 1e-4
# passes of all poses, then of the best ones; from a wrong pose hundreds can be needed
FIRST_FINE = 5
FINE_PASSES = 15
# poses that are registered to the end, as RIVAL_WITHIN, and how many at most
RIVAL_AFTER = 0.05
MOST_RIVALS = 4
# number and size of the shifts of the starts across the direction to the camera
SHIFTS = 6
SHIFT_OF_EXTENT = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Result of a global search.

    Attributes:
        best: the best pose T_ca.
        rivals: other poses, more than 10 deg or 0.05 of the extent from the best one, that explain
            the scan as well, within the statistical error of these points.
        width_m: distance beyond which a point is not on the model; it follows the noise.
        inlier_ratio: share of the points of the scan on the model at the best pose.
        candidates: all poses that were registered to the end, for a further round.
    """

    best: Pose
    rivals: tuple[Pose, ...]
    width_m: float
    inlier_ratio: float
    candidates: tuple[Measured, ...]


class GlobalSearch:
    """Searches the pose of one target. Built once; a search does not change it.

    Attributes:
        poses: says when two poses are the same.
        symmetries: (k, 4, 4) motions in {C} that carry most of the surface onto itself, without the
            identity.
        field, centroids, middle: sampled points by place, their mean from each side, and of all.
    """

    def __init__(
        self, target: Target, params: AcquireParams, poses: Sameness, kept: dict[str, Array]
    ) -> None:
        """Sample the model and find its near-symmetries, or take both from ``kept``; what is
        missing is added to it.
        """
        self._target, self._params, self.poses = target, params, poses
        self._sided = target.visibility.sided
        self._extent = target.surface.extent
        if "sampled" not in kept:
            kept["sampled"] = np.stack(sample_evenly(target.surface, MODEL_POINTS))
        points, normals = kept["sampled"]
        planes = normals if self._sided else target.index.closest(points).normal
        self.field = kernel_module().Field(points, np.ascontiguousarray(planes), CELLS)
        self.centroids = VisibleCentroids(
            points, normals if self._sided else np.zeros_like(normals), self._extent
        )
        self.middle = points.mean(axis=0)
        coarse = replace(target.limits, eps_rad=ENDED_RAD, eps_m=ENDED_OF_EXTENT * self._extent)
        self._brief, self._refine = (
            HornBackend(replace(target, limits=replace(coarse, n_max=min(passes, coarse.n_max))))
            for passes in (FIRST_FINE, FINE_PASSES)
        )
        if "symmetries" not in kept:
            kept["symmetries"] = self._near_symmetries(thin_to(points, MIDDLE_POINTS))
        self.symmetries = kept["symmetries"]

    def search(
        self,
        points: NDArray[Any],
        number: int = 0,
        before: SearchResult | None = None,
        known: Pose | None = None,
    ) -> SearchResult:
        """Return the best poses for a scan by one round of the search.

        Args:
            points: (n, 3) in {A} [m], finite, n >= 1.
            number: 0 assumes that the whole visible side is in the scan; 1 shifts the starts, for a
                target that is partly outside the scan or hidden; 2 does not assume the position of
                the camera.
            before: result of another round for the same points, whose poses are compared as well.
            known: a pose T_ca that is compared as well: another one is unique only if it explains
                the scan better.
        """
        scan = without_sparse_points(np.asarray(points, dtype=np.float64))
        few, some, fine = (
            np.ascontiguousarray(thin_to(scan, n))
            for n in (COARSE_POINTS, MIDDLE_POINTS, FINE_POINTS)
        )
        sight = self._target.visibility.direction_to_camera(scan)
        sights, shifts, facing = self._rounds(few, scan, sight)[number]
        starts = self._starts(few.mean(axis=0), sights, shifts, THINNED[number])
        selected = self._selected(few, some, starts, facing, FIRST_STRIDES[number])
        found = self._refined(some, fine, selected, facing)
        found = found if known is None else [*found, self.measured(fine, known)]
        return self.verdict([*found, *(before.candidates if before else ())])

    def _rounds(
        self, few: Array, scan: Array, sight: Array | None
    ) -> list[tuple[Sequence[Array | None], Array, bool]]:
        """Camera directions, shifts of the scan (k, 3) in {A} [m], and whether the directions can
        be relied on. Where the camera is not known, its direction follows from the normals of the
        scan, up to the sign.
        """
        none = np.zeros((1, 3))
        axes = np.linalg.svd((few - few.mean(axis=0)) if sight is None else sight[None])[2]
        turn = 2.0 * np.pi * np.arange(SHIFTS)[:, None] / SHIFTS
        u, v = SHIFT_OF_EXTENT * self._extent * (axes[:2] if sight is None else axes[1:])
        known = self._sided and sight is not None
        first: list[Array | None] = [sight]
        if sight is None and len(scan) > NORMAL_NEIGHBOURS:
            part = scan[:: max(1, len(scan) // SIGHT_POINTS)]
            line = line_of_sight(fitted_normals(part, part))
            first += [line, -line]
        return [
            (first, none, known),
            ([sight], np.cos(turn) * u + np.sin(turn) * v, known),
            ([sight, *scan_axes(few)], none, False),
        ]

    def _starts(
        self, centroid_a: Array, sights: Sequence[Array | None], shifts: Array, thinned: int = 1
    ) -> Array:
        """Every attitude with every camera direction and shift: centroid of the scan on that
        of the visible surface.
        """
        R_ca = geometry.matrix(attitudes(max(1, self._params.starts // thinned)))
        starts = np.tile(np.eye(4), (len(sights), len(shifts), len(R_ca), 1, 1))
        starts[..., :3, :3] = R_ca
        for k, sight in enumerate(sights):
            middle = self.middle if sight is None else self.centroids.of(R_ca @ sight)
            for j, shift in enumerate(shifts):
                starts[k, j, :, :3, 3] = middle - R_ca @ (centroid_a + shift)
        return starts.reshape(-1, 4, 4)

    def _selected(
        self, few: Array, some: Array, starts: Array, facing: bool, stride: int = 2
    ) -> list[Pose]:
        """The best starts after passes with few points, then the best of these, all different, with
        more points.
        """
        p, L, threads = self._params, self._extent, self._target.limits.threads
        coarse = (GATE_FALL, COARSE_OF_EXTENT * L, COARSE_OF_EXTENT * L, facing, threads)
        middle = (GATE_FALL, 0.01 * L, MIDDLE_OF_EXTENT * L, facing, threads)
        narrow = FIRST_GATE_OF_EXTENT * GATE_FALL**FIRST_PASSES
        poses, costs = self.field.refine(
            np.ascontiguousarray(few[::stride]),
            starts,
            FIRST_PASSES,
            FIRST_GATE_OF_EXTENT * L,
            *coarse,
        )
        poses = best_of(poses, costs, max(1, p.starts // KEPT_AFTER_FIRST))
        poses, costs = self.field.refine(few, poses, SECOND_PASSES, narrow * L, *coarse)
        poses, narrow = (
            best_of(poses, costs, max(1, p.starts // KEPT_AFTER_SECOND)),
            narrow * GATE_FALL**SECOND_PASSES,
        )
        poses, costs = self.field.refine(
            few, poses, COARSE_PASSES - SECOND_PASSES, narrow * L, *coarse
        )
        poses = self.poses.different(best_of(poses, costs, 2 * MIDDLE_STARTS), MIDDLE_STARTS, 0.3)
        narrow = FIRST_GATE_OF_EXTENT * GATE_FALL**FIRST_PASSES
        poses, costs = self.field.refine(
            some[::MIDDLE_STRIDE].copy(), poses, MIDDLE_FIRST, narrow * L, *middle
        )
        poses, narrow = best_of(poses, costs, KEPT_IN_MIDDLE), narrow * GATE_FALL**MIDDLE_FIRST
        poses, costs = self.field.refine(
            some, poses, MIDDLE_PASSES - MIDDLE_FIRST, narrow * L, *middle
        )
        found = self.poses.different(best_of(poses, costs, MIDDLE_STARTS), FINE_STARTS, 0.5)
        return [Pose.from_matrix(T) for T in found]

    def _refined(self, some: Array, fine: Array, poses: list[Pose], facing: bool) -> list[Measured]:
        """The poses measured on the model; the best, and the very best by a near-symmetry,
        are registered to it.
        """
        width = MIDDLE_OF_EXTENT * self._extent
        found = [self.measured(some, T_ca, MIDDLE_OF_EXTENT) for T_ca in poses]
        ranked = sorted(found, key=lambda each: float(each.unexplained(width).mean()))
        most = float(ranked[0].unexplained(width).mean()) + RIVAL_WITHIN
        best = [
            each.T_ca for each in ranked[:RIVALS] if float(each.unexplained(width).mean()) < most
        ]
        found, least = self.to_the_end(fine, best, width)
        first = min(found, key=lambda each: float(each.unexplained(width).mean())).T_ca
        if not len(self.symmetries):
            return found
        rule = (GATE_FALL, 0.01 * self._extent, width, facing, self._target.limits.threads)
        starts = np.concatenate([first.matrix[None], self.symmetries @ first.matrix])
        turned, costs = self.field.refine(some, starts, TURNED_PASSES, width, *rule)
        near = 1 + np.flatnonzero(costs[1:] < costs[0] + RIVAL_WITHIN)
        others = np.concatenate([starts[:1], best_of(turned[near], costs[near], len(near))])
        rivals = [
            Pose.from_matrix(T) for T in self.poses.different(others, 1 + TURNED_RIVALS, 0.5)[1:]
        ]
        return [*found, *self.to_the_end(fine, rivals, width, least)[0]]

    def to_the_end(
        self, fine: Array, poses: list[Pose], width_m: float, least: float = np.inf
    ) -> tuple[list[Measured], float]:
        """Return the poses registered to the model by a few passes, and to the end those that may
        be as good as the best; and the least cost after the few passes, also of other poses
        (``least``).
        """
        part = np.ascontiguousarray(fine[:: max(1, len(fine) // LAST_FINE_POINTS)])
        brief = [self._ended(self._brief, part, T_ca, width_m) for T_ca in poses]
        found = [self.measured(part, T_ca, MIDDLE_OF_EXTENT) for T_ca in brief]
        costs = np.array([each.unexplained(width_m).mean() for each in found])
        least = min(least, float(costs.min(initial=np.inf)))
        order = [
            k for k in np.argsort(costs, kind="stable") if costs[k] < least + 2.0 * RIVAL_AFTER
        ]
        last = [k for k in order[:MOST_RIVALS] if costs[k] < least + RIVAL_AFTER]
        ended = [self._ended(self._refine, part, found[k].T_ca, width_m, True) for k in last]
        others = [found[k].T_ca for k in order if k not in last]
        return [self.measured(fine, T_ca) for T_ca in (*ended, *others)], least

    def _near_symmetries(self, points: Array) -> Array:
        """Motions (k, 4, 4) in {C} that carry most of the surface onto itself: different
        ones, not the identity.
        """
        starts = self._starts(self.middle, [None], np.zeros((1, 3)))
        few = np.ascontiguousarray(points[:: max(1, len(points) // COARSE_POINTS)])
        poses = np.stack([pose.matrix for pose in self._selected(few, points, starts, False)])
        rule = (GATE_FALL, 0.01 * self._extent, COARSE_OF_EXTENT * self._extent, False, 1)
        poses, costs = self.field.refine(points, poses, 0, self._extent, *rule)
        apart = [not self.poses.same(Pose.identity(), Pose.from_matrix(T)) for T in poses]
        best, width = poses[apart & (costs < SYMMETRIC)], COARSE_OF_EXTENT * self._extent
        ended = [self._ended(self._refine, points, Pose.from_matrix(T), width).matrix for T in best]
        exact = [T for T in principal_turns(self._target.surface) if self._is_exact(points, T)]
        return self.poses.different(np.stack([np.eye(4), *exact, *ended]), 1 + SYMMETRIES, 1.0)[1:]

    def _is_exact(self, points: Array, T: Array) -> bool:
        """Whether a motion (4, 4) carries nearly all points (n, 3) of the surface onto it."""
        moved = np.ascontiguousarray(points @ T[:3, :3].T + T[:3, 3])
        off = self._target.index.closest(moved).d2 > (CARRIED_OF_EXTENT * self._extent) ** 2
        return bool(np.count_nonzero(off) <= MOST_UNCARRIED * len(points))

    def measured(self, points: Array, T_ca: Pose, most: float = MEASURED_OF_EXTENT) -> Measured:
        """Return the distances of points (n, 3) in {A} at a pose, at most ``most`` extents."""
        index, visibility = self._target.index, self._target.visibility
        return Measured(T_ca, visibility.distances(index, points, T_ca, most * self._extent))

    def _ended(
        self, horn: HornBackend, points: Array, T_ca: Pose, width_m: float, near: bool = False
    ) -> Pose:
        """The pose registered to the model."""
        return horn.align_within(points, T_ca, width_m, near).T_ca

    def verdict(self, found: Sequence[Measured]) -> SearchResult:
        """Return which of some poses explains the scan best, and the others that are as good.

        Args:
            found: the poses, measured on the same points.
        """
        noise = least_noise(found)
        width = max(
            self._target.limits.gate_m, min(3.0 * noise, 3.0 * NOISE_OF_EXTENT * self._extent)
        )
        best, *rest = sorted(found, key=lambda each: float(each.unexplained(width).mean()))
        others = (other for other in rest if not self.poses.same(best.T_ca, other.T_ca))
        costs, margin = best.unexplained(width), self.margin(noise)
        good = takewhile(lambda other: as_good(costs, other.unexplained(width), margin), others)
        rivals = tuple(other.T_ca for other in good)
        return SearchResult(
            best.T_ca,
            rivals,
            width,
            float(np.mean(best.distance < width)),
            tuple(found),
        )

    def margin(self, noise_m: float) -> float:
        """Return the share of the scan by which a unique pose explains more than any other one."""
        return max(self._params.margin, FAVOURED * noise_m / self._extent)

    def refined(self, points: Array, T_ca: Pose, width_m: float) -> Pose:
        """Return the pose T_ca registered to the model with ``points`` (n, 3) in {A} nearer than
        ``width_m`` [m].
        """
        return self._refine.align_within(points, T_ca, width_m).T_ca


def principal_turns(surface: Surface) -> Array:
    """Return the half turns (3, 4, 4) about the principal axes of a surface, through its centroid.

    An exact half turn of a surface is one of these, as it carries centroid and principal axes onto
    themselves, unless two of its principal moments are equal.

    Args:
        surface: mesh or cloud.
    """
    if len(surface.faces):
        corners = surface.vertices[surface.faces]
        weight = mesh.lengths(mesh.normals(surface.vertices, surface.faces))
        middle = corners.mean(axis=1)
        total = weight.sum()
        centre = weight @ middle / total
        # of a triangle: (sum over the corners + 9 times that of its middle) / 12
        away = np.concatenate([corners.reshape(-1, 3), middle]) - centre
        weight = np.concatenate([np.repeat(weight, 3), 9.0 * weight])
    else:
        centre = surface.vertices.mean(axis=0)
        away, weight = surface.vertices - centre, np.ones(len(surface.vertices))
    axes = np.linalg.eigh((away * weight[:, None]).T @ away)[1].T
    turns = np.tile(np.eye(4), (3, 1, 1))
    turns[:, :3, :3] = 2.0 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    turns[:, :3, 3] = centre - turns[:, :3, :3] @ centre
    return turns


def best_of(poses: Array, costs: Array, most: int) -> Array:
    """The poses (k, 4, 4) of least cost, best first; of equal costs the first."""
    return np.ascontiguousarray(poses[np.argsort(costs, kind="stable")[:most]])
