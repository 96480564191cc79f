"""The motions that carry most of a model onto itself, and the marks that distinguish its turned
copies.

A nearly symmetric body differs from its turned copies only by its marks: the parts that no
near-symmetry carries onto the surface.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avsreplay import mesh
from avsreplay.geometry import Array, Pose
from avsreplay.register import index_cache
from avsreplay.register.backend import LEAST_GATE_OF_EXTENT, Target
from avsreplay.register.comparison import OFF, Measured, decided, least_noise
from avsreplay.register.global_search import GlobalSearch
from avsreplay.register.params import AcquireParams
from avsreplay.register.plausibility import PlausibilityTest
from avsreplay.register.poses import Sameness
from avsreplay.register.sampling import EMPTY, Rays, sample
from avsreplay.register.surface_index import kernel_module
from avsreplay.register.symmetry import FINALISTS, NONE, distances, near_symmetries

MARKS_VERSION = 12  # version of the kept data of a model
# points to find marks, times as many around them, kept
SAMPLES = 4000
MARK_DENSITY = 5
MOST_MARKS = 500
# Most work of a search of all samples [point searches]: of a model with long thin faces, at which
# a search costs up to a hundred times as much, fewer points are sampled, which misses small marks.
SAMPLES_WORK = 40_000
# points with the noise of an ordinary scan that show the cost of a search
NEAR_POINTS = 500
ORDINARY_NOISE_OF_EXTENT = 0.002
MOST_MARKED = 0.15  # share of the surface; a body with more marks is not nearly symmetric
TRIED_MOTIONS = 16  # motions of a kind by which the marks are found
MARK_SPACINGS = 2.0  # more points are sampled within so many spacings of a point on a mark
MARK_COSINE = 0.25  # a mark is expected in the scan if the cosine of its incidence is larger
SCREEN_SIGMAS = 2.0  # standard errors of the cost of a turned pose by few points
# an exact symmetry carries all but this share of the surface to within this of it, over the extent
EXACT_OF_EXTENT = 5e-4
MOST_INEXACT = 5e-4
LEAST_OFF_MODEL = 8  # fewer points off the model decide nothing
SCREENED_MARKS = 100  # marks with which all motions are compared
# points of the scan; those on and off the model with which all motions are compared
MOST_COMPARED_POINTS = 6000
SCREENED = 150


class NearSymmetry:
    """The motions that carry most of a model onto itself, and its marks.

    Attributes:
        search: the global search of the same target.
        poses: says when two poses are the same.
        marks, normals: (n, 3) points on the marks in {C} [m], and the normals of their faces.
    """

    def __init__(
        self, target: Target, test: PlausibilityTest, search: GlobalSearch, kept: dict[str, Array]
    ) -> None:
        """Find the axis of revolution, if there is one, and sample the marks; or take both
        from ``kept``.
        """
        self._target, self._test, self.search = target, test, search
        self.poses, self._gate = search.poses, target.limits.gate_m
        surface = target.surface
        self._samples = min(SAMPLES, int(SAMPLES_WORK / _near_work(target)))
        if "kinds" not in kept:
            found = (
                near_symmetries(search, target.index, *sample(surface, self._samples))
                if len(surface.faces)
                else NONE
            )
            kept["kinds"] = np.concatenate([np.zeros((0, 4, 4)), *found.kinds])
            kept["ends"] = np.cumsum([len(motions) for motions in found.kinds], dtype=np.int64)
            kept["least"] = np.array(found.least_rad)
        self._kinds = np.split(kept["kinds"], kept["ends"])[:-1]
        self.poses.same_rad = min(self.poses.same_rad, 0.5 * float(kept["least"]))
        if "exact" not in kept:
            kept["exact"] = self._exact_ones()
        self._exact = kept["exact"]
        if "marks" not in kept:
            kept["marks"], kept["marked"] = self._found()
        self.marks, self.normals = kept["marks"]
        self._share, self._area = (float(x) for x in kept["marked"])

    def _exact_ones(self) -> Array:
        """The near-symmetries (k, 4, 4) that carry all of the surface onto itself."""
        motions = np.concatenate([np.zeros((0, 4, 4)), *self._kinds])
        if not len(motions):
            return motions
        width = EXACT_OF_EXTENT * self._target.index.extent_m
        points = sample(self._target.surface, self._samples)[0]
        off = [self._distances(points, T[None], width)[0] >= width for T in motions]
        return motions[[float(each.mean()) <= MOST_INEXACT for each in off]]

    def _found(self) -> tuple[Array, Array]:
        """Points on the marks and their normals (2, n, 3); the share of the surface that they have,
        and a point's area.

        Few points show which parts are marks and how large they are together; more are then sampled
        around these.
        """
        surface, none = self._target.surface, np.zeros((2, 0, 3))
        if not len(self._kinds):
            return none, np.zeros(2)
        points, _ = sample(surface, self._samples)
        moved = self._carried_off(points, MOST_MARKED)
        normals = mesh.normals(surface.vertices, surface.faces)
        share, area = float(moved.mean()), 0.5 * float(np.linalg.norm(normals, axis=1).sum())
        if not moved.any() or share >= MOST_MARKED:
            return none, np.array([share, 0.0])
        dense, normals = sample(surface, MARK_DENSITY * self._samples)
        apart = kernel_module().PointTree(points[moved]).query(dense)[0][:, 0]
        around = np.flatnonzero(apart < MARK_SPACINGS * np.sqrt(area / self._samples))
        marks = around[self._carried_off(dense[around], 1.0)]
        stride = max(1, -(-len(marks) // MOST_MARKS))
        found = np.stack([dense[marks[::stride]], normals[marks[::stride]]])
        return found, np.array([len(marks) / len(dense), stride * area / len(dense)])

    def _carried_off(self, points: Array, most: float) -> NDArray[np.bool_]:
        """Which points some near-symmetry does not carry onto the surface; ends when this
        share of them is exceeded.
        """
        moved, width = np.zeros(len(points), dtype=bool), OFF * self._gate
        for motions in self._kinds:
            for T in motions[:: max(1, len(motions) // TRIED_MOTIONS)]:
                if moved.mean() >= most:
                    return moved
                moved[~moved] = self._distances(points[~moved], T[None], width)[0] >= width
        return moved

    @property
    def turned(self) -> bool:
        """Whether some motion carries most of the model onto itself."""
        return len(self._kinds) > 0

    @property
    def near(self) -> bool:
        """Whether turned copies of the model differ from it by a mark at most."""
        return self.turned and self._share < MOST_MARKED

    @property
    def marked(self) -> bool:
        """Whether a mark distinguishes the turned copies of the model, and nothing else does."""
        return self.near and self._share > 0.0

    def rays(self, scan: NDArray[np.floating]) -> Rays:
        """Return the rays of at most about ``MOST_COMPARED_POINTS`` points of a scan (n, 3) in
        {A}.
        """
        return Rays(
            np.asarray(scan[:: max(1, len(scan) // MOST_COMPARED_POINTS)], dtype=np.float64)
        )

    def decided(
        self, found: list[Measured], complete: bool
    ) -> tuple[Measured, list[Measured], list[Measured]]:
        """Return the pose for which the rays decide, see ``comparison.decided``.

        Args:
            found: poses measured on the same points, see :meth:`measured`.
            complete: the visible side of the model is complete in the scan.
        """
        noise = least_noise(found)
        near, width = self._near(noise), max(self._gate, self._near(noise))
        margin = self.search.margin(noise)
        return decided(found, self.poses.same, (near, width), margin, complete)

    def width(self, found: list[Measured]) -> float:
        """Return the width of the costs of poses [m], which follows the least noise."""
        return max(self._gate, self._near(least_noise(found)))

    def _near(self, noise_m: float) -> float:
        return max(LEAST_GATE_OF_EXTENT * self._target.index.extent_m, 3.0 * noise_m)

    def images(self, T_ca: Pose) -> list[Pose]:
        """Return the poses onto which the exact symmetries of the model carry a pose, where they
        carry it.

        No scan can tell them apart. Each is a different pose. A registration could only move it
        away.
        """
        return [motion @ T_ca for motion in self._images]

    @cached_property
    def _images(self) -> list[Pose]:
        """The exact symmetries that give different poses: whether they do is the same for all
        poses.
        """
        found = [Pose.identity()]
        for T in map(Pose.from_matrix, self._exact):
            if not self.poses.among(T, found):
                found.append(T)
        return found[1:]

    def _distances(self, points: Array, motions: Array, most_m: float) -> Array:
        return distances(self._target.index, points, motions, most_m)

    def turned_poses(self, rays: Rays, T_ca: Pose, better: bool) -> list[Pose]:
        """Return the best poses that the near-symmetries give, registered.

        Of equal ones those are taken at which fewer than ``LEAST_OFF_MODEL`` rays more than at the
        pose pass through a mark. ``better``: only poses that explain more rays, by
        ``LEAST_OFF_MODEL`` at least; also those turned by a few degrees, because a body of
        revolution with marks has a minimum wherever a mark of the model meets some of the points.
        """
        # where all motions are compared, one mark in so many is tested
        stride = max(1, -(-len(self.marks) // SCREENED_MARKS))
        passed = self._passed(rays, T_ca, stride)[0]
        distance = self._test.measure(rays.points, T_ca)
        kinds = [np.flatnonzero(mask) for mask in (distance > self._gate, distance <= self._gate)]
        few = [k[:: max(1, -(-len(k) // SCREENED))] for k in kinds]
        weights = np.concatenate(
            [np.full(len(f), len(k) / max(1, len(f))) for k, f in zip(kinds, few, strict=True)]
        )
        part = np.ascontiguousarray(rays.points[np.concatenate(few)])
        width = OFF * self._gate
        kept = list[Pose]()
        here = (self._distances(T_ca.apply(part), np.eye(4)[None], width)[0] / width) ** 2
        for motions in self._kinds:
            excess = (self._distances(T_ca.apply(part), motions, width) / width) ** 2 - here
            cost, most, most_cost = excess @ weights, len(kept) + FINALISTS, np.inf
            if (
                better
            ):  # where rays pass through marks, also poses that the few points do not exclude
                most_cost = passed - LEAST_OFF_MODEL
                cost -= SCREEN_SIGMAS * np.sqrt(excess**2 @ weights**2) * (passed > LEAST_OFF_MODEL)
            order = np.argsort(cost, kind="stable")
            for k in order[cost[order] < most_cost]:
                start = Pose.from_matrix(motions[k]) @ T_ca
                if self.poses.among(start, kept if better else [T_ca, *kept]):
                    continue
                if self._passed(rays, start, stride)[0] < min(
                    passed + LEAST_OFF_MODEL, most_cost - cost[k]
                ):
                    kept.append(start)
                if len(kept) == most:
                    break
        evenly = np.ascontiguousarray(rays.points[:: max(1, len(rays.points) // len(part))])
        return [self.search.refined(evenly, start, width) for start in kept]

    def measured(self, rays: Rays, T_ca: Pose) -> Measured:
        """Return the distances of the points of rays at a pose, and what contradicts it."""
        return Measured(T_ca, self._test.measure(rays.points, T_ca), *self._passed(rays, T_ca))

    def _passed(self, rays: Rays, T_ca: Pose, stride: int = 1) -> tuple[float, float]:
        """Rays that passed through marks that should be visible at a pose, and those expected where
        nothing is.

        Only one in ``stride`` of the marks is tested, and counts for so many.
        """
        seen = self.visible(T_ca, stride)
        if not len(seen) or rays.tree is None:
            return 0.0, 0.0
        marks = T_ca.inverse().apply(self.marks[seen])
        far = np.linalg.norm(marks, axis=1)
        cosine = -np.einsum("ij,ij->i", self.normals[seen] @ T_ca.R, marks) / far
        expected = stride * self._area * cosine / (far * rays.spacing) ** 2
        angle, nearest = (each[:, 0] for each in rays.tree.query(marks / far[:, None]))
        empty = angle > EMPTY * rays.spacing
        passed = ~empty & (rays.ranges[nearest] > far + OFF * self._gate)
        return float(expected[passed].sum()), float(expected[empty].sum())

    def visible(self, T_ca: Pose, stride: int) -> NDArray[np.intp]:
        """Return the numbers of the marks that face the camera and that no other part of the model
        hides; none if the camera is unknown.

        Args:
            T_ca: the pose.
            stride: one in so many of the marks is tested.
        """
        if not self._target.visibility.may_be_camera(T_ca):
            return np.empty(0, dtype=np.intp)
        away = self.marks[::stride] - T_ca.t
        far = np.linalg.norm(away, axis=1)
        away /= far[:, None]
        seen = np.flatnonzero(np.einsum("ij,ij->i", away, self.normals[::stride]) < -MARK_COSINE)
        first = self._target.index.cast(T_ca.t, away[seen])[0]
        return np.asarray(stride * seen[first > far[seen] - OFF * self._gate], dtype=np.intp)


def _near_work(target: Target) -> float:
    """The cost of a search near a surface, in units of an ordinary one: it depends on the size of
    the faces.
    """
    points, normals = sample(target.surface, NEAR_POINTS)
    points = points[:: max(1, len(points) // NEAR_POINTS)]
    near = points + ORDINARY_NOISE_OF_EXTENT * target.index.extent_m * normals[: len(points)]
    return target.index.distances(near, Pose.identity(), np.inf, False, 1, 0.0)[1] / len(near)


def prepared(
    target: Target,
    test: PlausibilityTest,
    params: AcquireParams,
    poses: Sameness,
    folder: Path | None,
) -> NearSymmetry:
    """Return the near-symmetries of a target with its search. They are kept in a folder where one
    is given.

    Args:
        target: what is searched.
        test: tests of poses of this target.
        params: of the search.
        poses: says when two poses are the same.
        folder: cache folder; the file is named by all that its content depends on.
    """
    kernel, surface, limits, path = kernel_module(), target.surface, target.limits, None
    if folder is not None:
        layout = (
            f"{kernel.LAYOUT} {MARKS_VERSION} {target.visibility.sided} {params.starts}"
            f" {limits.gate_m.hex()}"
        )
        path = index_cache.cache_path(
            folder, layout, surface.vertices, surface.faces, limits.reach_m
        )
    kept = index_cache.read_arrays(path, kernel.checksum)
    known = len(kept)
    search = GlobalSearch(target, params, poses, kept)
    symmetry = NearSymmetry(target, test, search, kept)
    if len(kept) > known:
        index_cache.write_arrays(path, kept, kernel.checksum)
    return symmetry
