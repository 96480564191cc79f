"""Decision between poses that differ by a near-symmetry of the model, by the rays that contradict
each of them.

A nearly symmetric body differs from its turned copies only by its marks: the parts that no
near-symmetry carries onto the surface. Three kinds of rays decide between two poses. Some points
are on the model at one pose and well off it at the other. Some rays pass through a mark of one
pose, because the point measured in that direction lies behind it. In some directions a mark should
be visible and nothing was measured; they count if the visible side of the model is complete in the
scan.

With a share e of rays that contradict the true pose (other objects, errors of the model), a ray
that contradicts one pose only has the log likelihood ratio log((1 - e) / e). Poses whose sum is
below ``LEAST_LIKELIHOOD`` stay rivals.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import mesh
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus
from avsreplay.register import index_cache
from avsreplay.register.backend import Target
from avsreplay.register.budget import TEST_WORK, healthy_work
from avsreplay.register.degenerate import turn_words
from avsreplay.register.elsewhere import COMPARED, OFF, Contradicted, Search, decides
from avsreplay.register.global_search import FINE_PASSES, as_good
from avsreplay.register.grading import FAR_RAD
from avsreplay.register.params import AcquireParams
from avsreplay.register.plausibility import PlausibilityTest
from avsreplay.register.quality import view_directions
from avsreplay.register.sampling import EMPTY, Rays, sample
from avsreplay.register.surface_index import kernel_module
from avsreplay.register.symmetry import FINALISTS, NONE, distances, near_symmetries

VERSION = 11  # version of the kept data of a model
SAMPLES, DENSE, MOST_MARKS = 4000, 20_000, 500  # points: to find marks, around marks, and kept
MOST_MARKED = 0.15  # share of the surface; a body with more marks is not nearly symmetric
TRIED = 16  # motions of a kind by which the marks are found
AROUND = 2.0  # more points are sampled within so many spacings of a point on a mark
# a point within this (over the extent), or within three sigma of the noise, is on the model
NEAR = 0.004
TURNED_RAD = np.radians(
    12.0
)  # rotation from the guess above which a pose is far, with near-symmetries
NOT_VERIFIED = (
    f"rotated by more than {np.degrees(FAR_RAD):.0f} deg from the guess, and no work left for a"
    " search"
)
NOT_TURNED = "the model is nearly symmetric, and no work is left to compare its turned poses"
LEAST_COSINE = 0.25  # a mark is expected in the scan if the cosine of its incidence is larger
SCREEN_SIGMAS = 2.0  # standard errors of the cost of a turned pose by few points
# an exact symmetry carries all but this share of the surface to within this of it, over the extent
EXACT_OF_EXTENT, MOST_INEXACT = 5e-4, 5e-4
MOST_NAMED = 4  # turned poses that are named in words
LEAST_RAYS = 8  # fewer points off the model decide nothing
SCREENED_MARKS = 100  # marks with which all motions are compared
RAY_WORK = 3  # cost of the ray to a mark in the mean: many of them face away
MOST_POINTS, SCREENED = (
    6000,
    150,
)  # points of the scan; those on and off the model with which all motions are compared


class NearSymmetry:
    """The motions that carry most of a model onto itself, and its marks.

    Attributes:
        search: the global search of the same target.
    """

    def __init__(
        self, target: Target, test: PlausibilityTest, search: Search, kept: dict[str, Array]
    ) -> None:
        """Find the axis of revolution, if there is one, and sample the marks; or take both
        from ``kept``.
        """
        self._target, self._test, self.search, self._gate = (
            target,
            test,
            search,
            target.limits.gate_m,
        )
        surface = target.surface
        if "kinds" not in kept:
            found = (
                near_symmetries(search, target.index, *sample(surface, SAMPLES))
                if len(surface.faces)
                else NONE
            )
            kept["kinds"] = np.concatenate([np.zeros((0, 4, 4)), *found.kinds])
            kept["ends"] = np.cumsum([len(motions) for motions in found.kinds], dtype=np.int64)
            kept["least"] = np.array(found.least_rad)
        self._kinds = np.split(kept["kinds"], kept["ends"])[:-1]
        search.same_rad = min(search.same_rad, 0.5 * float(kept["least"]))
        if "exact" not in kept:
            kept["exact"] = self._exact_ones()
        self._exact = kept["exact"]
        if "marks" not in kept:
            kept["marks"], kept["marked"] = self._found()
        self._marks, self._normals = kept["marks"]
        self._share, self._area = (float(x) for x in kept["marked"])

    def _exact_ones(self) -> Array:
        """The near-symmetries (k, 4, 4) that carry all of the surface onto itself."""
        motions = np.concatenate([np.zeros((0, 4, 4)), *self._kinds])
        if not len(motions):
            return motions
        width = EXACT_OF_EXTENT * self._target.index.extent_m
        points = sample(self._target.surface, SAMPLES)[0]
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
        points, _ = sample(surface, SAMPLES)
        moved = self._carried_off(points, MOST_MARKED)
        normals = mesh.normals(surface.vertices, surface.faces)
        share, area = float(moved.mean()), 0.5 * float(np.linalg.norm(normals, axis=1).sum())
        if not moved.any() or share >= MOST_MARKED:
            return none, np.array([share, 0.0])
        dense, normals = sample(surface, DENSE)
        apart = kernel_module().PointTree(points[moved]).query(dense)[0][:, 0]
        around = np.flatnonzero(apart < AROUND * np.sqrt(area / SAMPLES))
        marks = around[self._carried_off(dense[around], 1.0)]
        stride = max(1, -(-len(marks) // MOST_MARKS))
        found = np.stack([dense[marks[::stride]], normals[marks[::stride]]])
        return found, np.array([len(marks) / DENSE, stride * area / DENSE])

    def _carried_off(self, points: Array, most: float) -> NDArray[np.bool_]:
        """Which points some near-symmetry does not carry onto the surface; ends when this
        share of them is exceeded.
        """
        moved, width = np.zeros(len(points), dtype=bool), OFF * self._gate
        for motions in self._kinds:
            for T in motions[:: max(1, len(motions) // TRIED)]:
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

    @property
    def turning_work(self) -> int:
        """The usual cost of :meth:`better` in point searches, where no pose is better."""
        return 2 * SCREENED * sum(len(motions) for motions in self._kinds)

    def work(self, points: int, others: int = 0) -> int:
        """Return the usual cost of a decision between so many other poses and the turned ones in
        point searches.
        """
        finalists = FINALISTS * len(self._kinds)
        rays = RAY_WORK * len(self._marks)
        measured = (1 + others + finalists) * (min(points, MOST_POINTS) + rays)
        return (
            self.turning_work + finalists * (FINE_PASSES * 2 * SCREENED + self._ray_work) + measured
        )

    def elsewhere_work(self, points: int, measured: int, partial: bool) -> int:
        """Return the usual cost of :meth:`elsewhere` for a scan with so many points on the model,
        and in all.
        """
        return self.search.elsewhere_work(points, partial) + self._compared_work(measured)

    def _compared_work(self, points: int) -> int:
        return (1 + COMPARED) * (min(points, MOST_POINTS) + RAY_WORK * len(self._marks))

    def after_search(self, points: int) -> int:
        """Return the usual cost of what follows a search for a scan of so many points, in point
        searches.
        """
        turned = self.work(points, FINALISTS) if self.marked else 0
        return TEST_WORK + healthy_work(points, self._target.near_work) + turned

    def search_work(self, points: int, number: int) -> int:
        """Return the usual cost of round ``number`` of the search and of registering its result."""
        return (
            self.search.work(points, number)
            + TEST_WORK
            + healthy_work(points, self._target.near_work)
        )

    def better(self, scan: NDArray[np.floating], T_ca: Pose) -> tuple[list[Pose], int]:
        """Return the poses turned by a near-symmetry that explain more of a scan (n, 3) in {A}, and
        the work.
        """
        turned, tested = self._turned(self._rays(scan), T_ca, True)
        return turned, self.turning_work + (1 + tested) * self._ray_work

    def _rays(self, scan: NDArray[np.floating]) -> Rays:
        return Rays(np.asarray(scan[:: max(1, len(scan) // MOST_POINTS)], dtype=np.float64))

    def decided(
        self,
        scan: NDArray[np.floating],
        T_ca: Pose,
        others: list[Pose],
        complete: bool,
        turned: list[Pose] | None = None,
    ) -> tuple[Pose, list[Pose], int]:
        """Return the pose for which the rays decide, the others that explain the scan as well, and
        extra work.

        The extra work is what the comparison took beyond ``work``, because the rays spoke against
        many motions.

        Args:
            scan: (n, 3) in {A} [m].
            T_ca: registered pose.
            others: other poses that explain the scan.
            complete: the visible side of the model is complete in the scan, so that empty
                directions count.
            turned: poses turned by a near-symmetry; None: the best ones.
        """
        rays = self._rays(scan)
        if not len(rays.points):
            return T_ca, others, 0
        extra = 0
        if turned is None:
            turned, tested = self._turned(rays, T_ca, False)
            extra = max(0, tested - FINALISTS * len(self._kinds)) * self._ray_work
        found = [self._measured(rays, pose) for pose in (T_ca, *others, *turned)]
        noise, best = self.search.noise_of(found), found[0]
        width = max(NEAR * self._target.index.extent_m, 3.0 * noise)
        for each in found[1:]:
            best = each if decides(each, best, width, complete) else best
        margin = self.search.margin(noise)
        rivals = [
            each.T_ca
            for each in found
            if not self.search.same(best.T_ca, each.T_ca)
            and as_good(best, each, max(self._gate, width), margin)
            and not decides(best, each, width, complete)
        ]
        return best.T_ca, rivals, extra

    def images(self, T_ca: Pose) -> list[Pose]:
        """Return the poses onto which the exact symmetries of the model carry a pose, where they
        carry it.

        No scan can tell them apart. Each is a different pose. A registration could only move it
        away.
        """
        found = list[Pose]()
        for T in self._exact:
            turned = Pose.from_matrix(T) @ T_ca
            if not any(self.search.same(turned, each) for each in (T_ca, *found)):
                found.append(turned)
        return found

    def elsewhere(
        self, scan: NDArray[np.floating], T_ca: Pose, partial: bool, left: int
    ) -> tuple[Pose, list[Pose], int]:
        """Return the pose for which the rays decide among those far from a result that explain its
        points as well.

        Args:
            scan: (n, 3) in {A} [m].
            T_ca: the result of a search.
            partial: the scan shows a part of the target, so that displaced poses are tried as well.
            left: work that is left.

        Returns:
            The pose, the others that explain the points on the model as well, and the work in point
            searches.
        """
        rays, gate = self._rays(scan), self._gate
        on, compared = (
            self._test.measure(rays.points, T_ca) < gate,
            self._compared_work(len(rays.points)),
        )
        poses, work = self.search.elsewhere(rays.points[on], T_ca, partial, left - compared)
        found = [self._measured(rays, each) for each in (T_ca, *poses)]
        width = max(NEAR * self._target.index.extent_m, 3.0 * self.search.noise_of(found))
        on = np.min([each.distance for each in found], axis=0) < max(gate, width)
        found = [replace(each, distance=each.distance[on]) for each in found]
        best = found[0]
        for each in found[1:]:
            best = each if decides(each, best, width, not partial) else best
        margin = self.search.margin(width / 3.0)
        others = [each for each in found if not self.search.same(best.T_ca, each.T_ca)]
        as_near = [each for each in others if as_good(best, each, max(gate, width), margin)]
        repeated = len(as_near) >= COMPARED  # there may be more of them, which were not compared
        rivals = [
            each.T_ca for each in as_near if repeated or not decides(best, each, width, not partial)
        ]
        return best.T_ca, rivals, work + compared

    def rivalled(self, scan: NDArray[Any], found: Alignment, rivals: list[Pose]) -> Alignment:
        """Return the alignment; AMBIGUOUS with rivals that differ not only along its
        unobservable directions, and by no exact symmetry.
        """
        images, same = self.images(found.T_ac.inverse()), self.search.same
        rivals = [each for each in rivals if not any(same(each, image) for image in images)]
        rivals = self._apart(scan, found, rivals)
        return self._named(found, rivals) if rivals else found

    def equal(self, scan: NDArray[Any], found: Alignment) -> Alignment:
        """Return the alignment; AMBIGUOUS with its images by the exact symmetries of the model,
        which no scan can tell apart.
        """
        images = self._apart(scan, found, self.images(found.T_ac.inverse()))
        return replace(self._named(found, images), equal=True) if images else found

    def revolved(self, scan: NDArray[Any], found: Alignment) -> bool:
        """Return whether the only unobservable direction of a result is a turn that carries the
        model onto itself.
        """
        free = found.free if found.status is AlignStatus.DEGENERATE else None
        if free is None or free.shape[1] != 1:
            return False
        images = self.images(found.T_ac.inverse())
        return len(images) > 0 and not self._apart(scan, found, images)

    def _apart(self, scan: NDArray[Any], found: Alignment, others: list[Pose]) -> list[Pose]:
        """Those of other poses T_ca that differ from a result not only along its unobservable
        directions.
        """
        at, target = found.T_ac.inverse(), self._target
        if others and found.status is AlignStatus.DEGENERATE:
            free = view_directions(target.index, target.visibility, scan, at, self._gate)
            others = [T_ca for T_ca in others if not self.search.same(T_ca, free.nearest(at, T_ca))]
        return others

    def _named(self, found: Alignment, others: list[Pose]) -> Alignment:
        """The alignment as one of several poses that explain the scan."""
        words = dict.fromkeys(turn_words(found.T_ac.inverse() @ each.inverse()) for each in others)
        return replace(
            found,
            status=AlignStatus.AMBIGUOUS,
            covariance=None,
            free_directions=", ".join([*words][:MOST_NAMED]),
            members=(found.T_ac, *(each.inverse() for each in others)),
        )

    def _distances(self, points: Array, motions: Array, most_m: float) -> Array:
        return distances(self._target.index, points, motions, most_m)

    def _turned(self, rays: Rays, T_ca: Pose, better: bool) -> tuple[list[Pose], int]:
        """The best poses that the near-symmetries give, registered, and at how many of them the
        marks were tested.

        Of equal ones those are taken at which fewer than ``LEAST_RAYS`` rays more than at the pose
        pass through a mark. ``better``: only poses that explain more rays, by ``LEAST_RAYS`` at
        least; also those turned by a few degrees, because a body of revolution with marks has a
        minimum wherever a mark of the model meets some of the points.
        """
        stride, tested = self._stride, 0
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
                most_cost = passed - LEAST_RAYS
                cost -= SCREEN_SIGMAS * np.sqrt(excess**2 @ weights**2) * (passed > LEAST_RAYS)
            order = np.argsort(cost, kind="stable")
            for k in order[cost[order] < most_cost]:
                start = Pose.from_matrix(motions[k]) @ T_ca
                if any(
                    self.search.same(start, other) for other in (kept if better else (T_ca, *kept))
                ):
                    continue
                tested += 1
                if self._passed(rays, start, stride)[0] < min(
                    passed + LEAST_RAYS, most_cost - cost[k]
                ):
                    kept.append(start)
                if len(kept) == most:
                    break
        evenly = np.ascontiguousarray(rays.points[:: max(1, len(rays.points) // len(part))])
        return [self.search.refined(evenly, start, width) for start in kept], tested

    def _measured(self, rays: Rays, T_ca: Pose) -> Contradicted:
        return Contradicted(T_ca, self._test.measure(rays.points, T_ca), *self._passed(rays, T_ca))

    @property
    def _stride(self) -> int:
        """The marks of which one in so many is tested where all motions are compared."""
        return max(1, -(-len(self._marks) // SCREENED_MARKS))

    @property
    def _ray_work(self) -> int:
        """Cost of the rays to these marks in point searches."""
        return RAY_WORK * -(-len(self._marks) // self._stride)

    def _passed(self, rays: Rays, T_ca: Pose, stride: int = 1) -> tuple[float, float]:
        """Rays that passed through marks that should be visible at a pose, and those expected where
        nothing is.

        Only one in ``stride`` of the marks is tested, and counts for so many.
        """
        seen = self._visible(T_ca, stride)
        if not len(seen) or rays.tree is None:
            return 0.0, 0.0
        marks = T_ca.inverse().apply(self._marks[seen])
        far = np.linalg.norm(marks, axis=1)
        cosine = -np.einsum("ij,ij->i", self._normals[seen] @ T_ca.R, marks) / far
        expected = stride * self._area * cosine / (far * rays.spacing) ** 2
        angle, nearest = (each[:, 0] for each in rays.tree.query(marks / far[:, None]))
        empty = angle > EMPTY * rays.spacing
        passed = ~empty & (rays.ranges[nearest] > far + OFF * self._gate)
        return float(expected[passed].sum()), float(expected[empty].sum())

    def _visible(self, T_ca: Pose, stride: int) -> NDArray[np.intp]:
        """One in ``stride`` of the marks, if they face the camera and no other part of the model
        hides them.

        None if the camera is unknown.
        """
        if not self._target.visibility.may_be_camera(T_ca):
            return np.empty(0, dtype=np.intp)
        away = self._marks[::stride] - T_ca.t
        far = np.linalg.norm(away, axis=1)
        away /= far[:, None]
        seen = np.flatnonzero(np.einsum("ij,ij->i", away, self._normals[::stride]) < -LEAST_COSINE)
        first = self._target.index.cast(T_ca.t, away[seen])[0]
        return np.asarray(stride * seen[first > far[seen] - OFF * self._gate], dtype=np.intp)


def prepared(
    target: Target, test: PlausibilityTest, params: AcquireParams, folder: Path | None
) -> NearSymmetry:
    """Return the near-symmetries of a target with its search. They are kept in a folder where one
    is given.

    Args:
        target: what is searched.
        test: tests of poses of this target.
        params: of the search.
        folder: cache folder; the file is named by all that its content depends on.
    """
    kernel, surface, limits, path = kernel_module(), target.surface, target.limits, None
    if folder is not None:
        layout = (
            f"{kernel.LAYOUT} {VERSION} {target.visibility.sided} {params.starts}"
            f" {limits.gate_m.hex()}"
        )
        path = index_cache.cache_path(
            folder, layout, surface.vertices, surface.faces, limits.reach_m
        )
    kept = index_cache.read_arrays(path, kernel.checksum)
    known = len(kept)
    search = Search(target, params, kept)
    symmetry = NearSymmetry(target, test, search, kept)
    if len(kept) > known:
        index_cache.write_arrays(path, kept, kernel.checksum)
    return symmetry
