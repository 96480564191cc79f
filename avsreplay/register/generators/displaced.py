"""Other poses that explain the points of the result of a search as well, which the starts of the
search did not reach.

A body with a repeated pattern, of which a part is measured, has many poses that are far apart and
equally good. Another object beside the target displaces the starts of a search, which then reaches
one of several poses that the sides of a box-like body give. Such poses are the result turned and
displaced. The turns are the near-symmetries of the model and the rotations of a cube along the two
main directions of its faces; the displacements are in the plane of the scan.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from itertools import permutations, product

import numpy as np

from avsreplay.geometry import Array, Pose
from avsreplay.register.backend import Target
from avsreplay.register.global_search import (
    COARSE_OF_EXTENT,
    FINE_POINTS,
    FIRST_PASSES,
    GATE_FALL,
    MIDDLE_OF_EXTENT,
    MIDDLE_POINTS,
    MODEL_POINTS,
    RIVAL_AFTER,
    best_of,
)
from avsreplay.register.hypotheses import Candidate, Case, Generator, Hypothesis
from avsreplay.register.near_symmetry import NearSymmetry
from avsreplay.register.plausibility import PlausibilityTest
from avsreplay.register.poses import SAME_RAD
from avsreplay.register.quality import LEAST_RATIO
from avsreplay.register.sampling import sample_evenly, thin_to

# of displaced starts: points, their distance, and steps each way
START_POINTS = 50
STEP_OF_EXTENT = 0.06
STEPS_EACH_WAY = 12
# rejection distances over the extent
FIRST_GATE = 0.15
SECOND_GATE = 0.075
MOST = (
    150,
    80,
)  # starts that are kept after the first passes: those turned by near-symmetries, and the others
MOST_STARTS = 1200  # with more of them their distance is larger
# passes with the distance SECOND_GATE, and of the best with more points
SECOND = 4
LAST = 6
# poses that are compared with more points, and that are registered to the model
COMPARED_FIRST = 16
REGISTERED_STARTS = 4
# cosines of normals at right angles and parallel; share of the surface
SQUARE = 0.1
ALONG = 0.98
LEAST_FACES = 0.05
ALIKE = 0.5  # starts turned by less than this share of SAME_RAD are one


class Displaced(Generator):
    """The result of a search turned and displaced, where the scan shows a part of the target or
    another object.
    """

    def __init__(self, target: Target, test: PlausibilityTest, symmetry: NearSymmetry) -> None:
        self._target, self._test, self._symmetry = target, test, symmetry
        self._search, self._extent = symmetry.search, target.surface.extent
        self._gate = target.limits.gate_m

    def needed(self, case: Case) -> bool:
        """Return whether such poses are possible."""
        near = case.at.found.inliers >= LEAST_RATIO * len(case.target)
        return self._partial(case) or not (near or self._symmetry.marked)

    def _partial(self, case: Case) -> bool:
        return self._test.partial(case.target, case.at.T_ca)

    def hypotheses(self, case: Case) -> Iterator[Hypothesis]:
        """Yield at most ``REGISTERED_STARTS`` poses that explain the points on the model nearly
        as well.
        """
        rays, T_ca = self._symmetry.rays(case.points), case.at.T_ca
        on = self._test.measure(rays.points, T_ca) < self._gate
        for each in self._poses(rays.points[on], T_ca, self._partial(case)):
            yield Hypothesis(each)

    def compared(
        self, case: Case, found: list[Hypothesis]
    ) -> tuple[Hypothesis | None, Candidate | None]:
        """Return the pose for which the rays decide, by the points on the model at one of them."""
        at, partial = case.at, self._partial(case)
        rays = self._symmetry.rays(case.points)
        measured = [self._symmetry.measured(rays, T) for T in (at.T_ca, *(h.T_ca for h in found))]
        on = np.min([each.distance for each in measured], axis=0) < self._symmetry.width(measured)
        measured = [replace(each, distance=each.distance[on]) for each in measured]
        best, as_near, open_ = self._symmetry.decided(measured, not partial)
        # there may be more of them, which were not compared
        rivals = as_near if len(as_near) >= REGISTERED_STARTS else open_
        kept = replace(at, rivals=tuple(each.T_ca for each in rivals))
        moved = not self._symmetry.poses.same(best.T_ca, at.T_ca)
        return (Hypothesis(best.T_ca) if moved else None), kept

    def _poses(self, points: Array, T_ca: Pose, partial: bool) -> list[Pose]:
        """Other poses that explain points (n, 3) in {A} on the model nearly as well."""
        search = self._search
        L, width = self._extent, MIDDLE_OF_EXTENT * self._extent
        threads = self._target.limits.threads
        few, some, fine = (
            np.ascontiguousarray(thin_to(points, n))
            for n in (START_POINTS, MIDDLE_POINTS, FINE_POINTS)
        )
        sight = self._target.visibility.direction_to_camera(points)
        facing = self._target.visibility.sided and sight is not None
        starts = self._displaced(few, T_ca, sight, STEPS_EACH_WAY if partial else 1)
        rule = (GATE_FALL, COARSE_OF_EXTENT * L, COARSE_OF_EXTENT * L, facing, threads)
        kept = []
        for each, most in zip(starts, MOST, strict=True):
            poses, costs = search.field.refine(
                few[::2].copy(), each, FIRST_PASSES, FIRST_GATE * L, *rule
            )
            kept.append(search.poses.different(best_of(poses, costs, len(poses)), most, 0.3))
        poses = np.concatenate(kept)
        poses, costs = search.field.refine(few, poses, SECOND, SECOND_GATE * L, *rule)
        poses = search.poses.different(best_of(poses, costs, len(poses)), sum(MOST), 0.3)
        moved = few @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
        d2 = self._target.index.closest(moved.reshape(-1, 3), most_m=width).d2.reshape(
            len(poses), -1
        )
        costs = np.minimum(d2 / width**2, 1.0).mean(axis=1)
        poses = search.poses.different(best_of(poses, costs, len(poses)), COMPARED_FIRST, 0.5)
        rule = (GATE_FALL, 0.01 * L, width, facing, threads)
        poses, _ = search.field.refine(some, poses, LAST, 2.0 * width, *rule)
        first, *found = [
            search.measured(some, each, MIDDLE_OF_EXTENT)
            for each in (T_ca, *map(Pose.from_matrix, poses))
        ]
        ranked = sorted(found, key=lambda each: float(each.unexplained(width).mean()))
        dearest = float(first.unexplained(width).mean()) + RIVAL_AFTER
        near = [
            T_ca.matrix,
            *(each.T_ca.matrix for each in ranked if each.unexplained(width).mean() < dearest),
        ]
        others = [
            Pose.from_matrix(T)
            for T in search.poses.different(np.stack(near), 1 + REGISTERED_STARTS, 0.5)[1:]
        ]
        ended = search.to_the_end(fine, others, width)[0]
        return [each.T_ca for each in ended]

    def _displaced(
        self, few: Array, T_ca: Pose, sight: Array | None, most: int
    ) -> tuple[Array, Array]:
        """A pose turned and displaced where the centroid of points (n, 3) is inside the box of the
        model.

        ``sight``: direction to the camera, ``most``: steps each way in the plane of the points.
        Those turned by the near-symmetries, (k, 4, 4), and those turned otherwise.
        """
        turns: list[Array] = []
        alike = (np.eye(3), *self._search.symmetries[:, :3, :3])
        for R in (*alike, *self._square):
            if not any(
                np.trace(R.T @ other) > 1.0 + 2.0 * np.cos(ALIKE * SAME_RAD) for other in turns
            ):
                turns.append(R)
        rotations, near = (
            np.stack([turn @ T_ca.R for turn in turns]),
            sum(any(R is x for x in alike) for R in turns),
        )
        starts = self._placed(few, rotations, sight, STEP_OF_EXTENT, most)
        wider = np.sqrt(sum(map(len, starts)) / MOST_STARTS)
        starts = (
            starts
            if wider <= 1.0
            else self._placed(few, rotations, sight, wider * STEP_OF_EXTENT, most)
        )
        return np.concatenate(starts[:near]), np.concatenate([np.zeros((0, 4, 4)), *starts[near:]])

    def _placed(
        self, few: Array, rotations: Array, sight: Array | None, step: float, most: int
    ) -> list[Array]:
        """The starts with each of the rotations (k, 3, 3), so many extents apart."""
        k, L, vertices = (
            step * np.arange(-most, most + 1),
            self._extent,
            self._target.surface.vertices,
        )
        axes = np.linalg.svd(few - (centroid := few.mean(axis=0)), full_matrices=False)[2]
        steps = L * (k[:, None, None] * axes[0] + k[None, :, None] * axes[1]).reshape(-1, 3)
        low, high = (
            vertices.min(axis=0) - MIDDLE_OF_EXTENT * L,
            vertices.max(axis=0) + MIDDLE_OF_EXTENT * L,
        )
        starts = []
        for R in rotations:
            middle = (
                self._search.middle if sight is None else self._search.centroids.of(R @ sight)
            ) + steps @ R.T
            inside = ((middle > low) & (middle < high)).all(axis=1)
            T = np.tile(np.eye(4), (int(inside.sum()), 1, 1))
            T[:, :3, :3], T[:, :3, 3] = R, middle[inside] - R @ centroid
            starts.append(T)
        return starts

    @cached_property
    def _square(self) -> Array:
        """The rotations (24, 3, 3) of a cube along two directions of most of the faces; none
        if they are not square.
        """
        normals = sample_evenly(self._target.surface, MODEL_POINTS // 3)[1]
        along = (np.abs(normals @ normals.T) > ALONG).sum(axis=1)
        first = normals[np.argmax(along)]
        across = np.where(np.abs(normals @ first) < SQUARE, along, 0)
        if across.max() < LEAST_FACES * len(normals):
            return np.zeros((0, 3, 3))
        second = normals[np.argmax(across)] - first * (normals[np.argmax(across)] @ first)
        second /= np.linalg.norm(second)
        frame = np.stack([first, second, np.cross(first, second)], axis=1)
        return np.asarray(frame @ cube_rotations() @ frame.T)


def cube_rotations() -> Array:
    """Return the 24 rotations (24, 3, 3) of a cube along the axes."""
    signed = [
        np.diag(signs)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return np.stack([R for R in signed if np.linalg.det(R) > 0.0])
