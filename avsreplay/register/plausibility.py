"""Test that a registered pose must pass before it is called aligned, beyond the inlier ratio.

A pose can be wrong and still have many inliers: in a local minimum, among outliers, on a wall, or
shifted along a direction that few points determine. One score compares what supports a pose with
what contradicts it, in the direction of motion in which the pose is supported least. It does not
use the guess, so it also holds after a global search.

Support
    The points on the model, within w: three standard deviations of the noise, at least the gate.
Contradictions Points beside the model, between w and 2 w. Outliers, and a surface that crosses the
    model, give as many of them as points on the model by chance. Free space: model surface that
    should be visible, but lies where rays of the scan passed through, because the points measured
    in that direction are behind it. Missing surface: model surface in directions without any point,
    up to the number of points off the model. A field of view that ends gives the first alone, a
    second object the second alone.

Each of them has the information J'J, J = [p x n, n], of its points. The score is the largest
generalized eigenvalue of the information of the contradictions and of that of everything without
the points beside the model, because as many are on it by chance. Model surface counts with as many
points as the same area that is in the scan has. Free space and missing surface are known only if
the position of the camera is (``Visibility.camera_c``).

Two more contradictions do not depend on a direction. A surface of the scan that continues beyond an
edge of the model, in the plane of its face, belongs to another object or to one of another size. A
pose that matches most points to faces that face away from the camera is accepted only if nearly all
points are on the model, as the camera may be elsewhere.

The noise is the robust standard deviation of the distances to the model, from their smaller
quantiles: correct for up to 60 % of outliers. A wrong pose spreads the distances, and above a limit
no pose is accepted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus, Surface
from avsreplay.register.quality import WELL_OFF, not_measured
from avsreplay.register.sampling import EMPTY, SPACED, Rays, sample
from avsreplay.register.size import normal_jacobian
from avsreplay.register.surface_index import Closest, SurfaceIndex, kernel_module
from avsreplay.register.visibility import Visibility

SURFACE_POINTS = 1500
LEVELS = np.array([0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])  # quantiles of |distance|
NORMAL_QUANTILES = np.array(
    [0.38532, 0.52440, 0.67449, 0.84162, 1.03643, 1.28155, 1.64485]
)  # for a standard normal
REFINEMENTS = 2
NOISE_OF_EXTENT = 0.012  # with more noise than this no pose is accepted
MOST_CONTRADICTED, DOUBTFUL = (
    0.4,
    0.3,
)  # largest score of a pose that is accepted; that ends a search
# share of the points on the model, spread over all directions, that is added to the support
CHANCE = 0.01
MOST_MISSING = 0.1  # largest share of the visible surface that is missing in a complete scan
CONTRADICTIONS = (
    "points beside the model",
    "rays that pass through it",
    "surface that is not in the scan",
)
LEAST_SCAN_OF_EXTENT = (
    0.05  # a smaller scan is about as large as the rejection distance, and any face explains it
)
SIZED_POINTS = 200  # points of the scan that nearly always suffice to show that it is larger
# share on the model of the points that do not hide it: missing surface is then hidden, not
# elsewhere
LEAST_ALONE = 0.9
BEFORE_OF_EXTENT = (
    0.25  # a point that hides the model is this much nearer; a part of the model is less, as a rule
)
# a pose whose surface is in the mean within so many gates of the predicted one agrees with it
PREDICTED = 1.0
NEAR_OF_EXTENT, MOST_HIDDEN = (
    0.05,
    0.5,
)  # where fewer points are nearer, the noise at a predicted pose is theirs
# a scan narrower than so much of the model, in one of four directions of the image, shows a part of
# it
PARTIAL = 0.8
LEAST_COMPARED = 30  # with fewer surface points the test has no power
LEAST_COSINE = (
    0.25  # a surface point is expected in the scan if the cosine of its incidence is larger
)
HIDDEN_OF_EXTENT = 0.05  # a surface point this much behind the nearest of its cell is hidden
POINTS_PER_CELL = 8.0
IN_FRONT, LEAST_FACING = (
    0.34,
    0.02,
)  # least cosines: 70 deg from the middle of the scan, faces seen from the side
BEYOND, MIRRORED = (
    (WELL_OFF, 5.0),
    2.0,
)  # a point beyond an edge is so many widths away, and its image so many sigmas
LEAST_BEYOND, MOST_CONTINUED = (
    10,
    0.5,
)  # a surface continues beyond an edge with so many points, and this share of them
LEAST_IMAGE = 0.1  # least distance of an image from the face that counts as on it, in gates
CONTINUED = (
    "the surface in the scan continues beyond the edges of the model, as that of another or a"
    " larger object"
)
Numbers = NDArray[np.int64]
TURNED_AWAY = "most points are on faces that face away from the camera"


@dataclass(frozen=True, slots=True)
class Plausibility:
    """What the test found at a pose.

    Attributes:
        noise_m: robust standard deviation of the distances to the model [m].
        contradicted: the score, between 0 and about 1.
        covered: enough of the model surface was compared, and little of it is missing.
        reason: why the pose is rejected, "" if it is plausible.
    """

    noise_m: float
    contradicted: float
    covered: bool
    reason: str

    @property
    def doubtful(self) -> bool:
        """Whether a search goes on: of a body with a repeated pattern, a displaced pose can
        have so high a score.
        """
        return self.contradicted > DOUBTFUL


class PlausibilityTest:
    """Tests of whether a scan agrees with a pose of one model."""

    def __init__(
        self, surface: Surface, index: SurfaceIndex, visibility: Visibility, gate_m: float
    ) -> None:
        self._index, self._visibility, self._gate, self._extent = (
            index,
            visibility,
            gate_m,
            surface.extent,
        )
        self._points, self._normals = sample(surface, SURFACE_POINTS)
        self._points = self._points[:: max(1, len(self._points) // SURFACE_POINTS)]
        self._points, self._normals = (
            np.ascontiguousarray(self._points),
            self._normals[: len(self._points)],
        )

    def refused(
        self, scan: NDArray[Any], points: int, guess: Pose | None = None
    ) -> Alignment | None:
        """Return the alignment of a scan that is not registered at all; None for others.

        Args:
            scan: (n, 3) finite points in {A} [m].
            points: of the scan, also those that are not finite.
            guess: T_ac.

        Returns:
            NO_POINTS; or IMPLAUSIBLE for a scan so much smaller than the model that any of its
            faces would explain it.
        """
        if len(scan) == 0:
            return not_measured(points, AlignStatus.NO_POINTS, guess)
        least = LEAST_SCAN_OF_EXTENT * self._extent
        if geometry.bounding_diagonal(scan[:: max(1, len(scan) // SIZED_POINTS)]) >= least:
            return None
        size = geometry.bounding_diagonal(scan)
        if size >= least:
            return None
        text = (
            f"the scan measures {size:.3g} m, the model {self._extent:.3g} m: is --model-unit"
            " right?"
        )
        return replace(not_measured(points, AlignStatus.IMPLAUSIBLE, guess), message=text)

    def noise(self, distance: Array, T_ca: Pose, guess: Pose | None) -> float:
        """Return the robust noise [m] of distances (n,) [m] at a pose; of the smaller ones where
        most are not near.

        The latter only at the predicted pose ``guess``: elsewhere the points near the model may be
        so by chance.
        """
        near = distance[distance < NEAR_OF_EXTENT * self._extent]
        few = LEAST_COMPARED <= len(near) < MOST_HIDDEN * len(distance)
        return robust_noise(near if few and self.predicted(T_ca, guess) else distance)

    def predicted(self, T_ca: Pose, guess: Pose | None) -> bool:
        """Return whether a pose T_ca agrees with the predicted T_ac ``guess``; False where
        the camera is not known.
        """
        if guess is None or not self._visibility.may_be_camera(T_ca):
            return False
        moved = T_ca.inverse().apply(self._points) - guess.apply(self._points)
        return float(np.linalg.norm(moved, axis=1).mean()) < PREDICTED * self._gate

    def partial(self, points: NDArray[Any], T_ca: Pose) -> bool:
        """Return whether the scan (n, 3) in {A} shows only a part of the target: it is narrower in
        some direction.

        Compared in the image, with the whole surface at the pose T_ca; False where the camera is
        not known.
        """
        if not self._visibility.may_be_camera(T_ca):
            return False
        return bool(kernel_module().is_narrower(points, T_ca.matrix, self._points, PARTIAL))

    def turned_away(self, points: NDArray[Any], T_ca: Pose) -> bool:
        """Return whether most points (n, 3) in {A} are on faces that face away from a camera at the
        origin.
        """
        return (
            self._visibility.may_be_camera(T_ca)
            and self._visibility.camera_c(self._index, points, T_ca) is None
        )

    def check(
        self,
        points: NDArray[Any],
        T_ca: Pose,
        scene: NDArray[Any] | None = None,
        guess: Pose | None = None,
    ) -> Plausibility:
        """Test the pose.

        Args:
            points: (n, 3) in {A} [m], n >= 1: the scan, or the part of it that may be the target; a
                few thousand points are enough.
            T_ca: the pose to be tested.
            scene: (m, 3) in {A} [m], the whole scan, for the points beside the model and the rays;
                ``points`` if None.
            guess: predicted T_ac. At a pose that agrees with it, points far from the model are no
                contradictions, and missing surface is none where nearly all points are on the model
                or in front of it and hide it.

        Returns:
            The score and the reason of a rejection.
        """
        camera_c = self._visibility.camera_c(self._index, points, T_ca)
        rays = np.asarray(points if scene is None else scene, dtype=np.float64)
        p, reach = T_ca.apply(rays), self._index.reach_m
        found = self._index.closest(p, camera_c=camera_c, most_m=reach)
        distance = (
            np.minimum(np.sqrt(found.d2), reach) if scene is None else self.measure(points, T_ca)
        )
        noise = self.noise(distance, T_ca, guess)
        width = max(self._gate, 3.0 * noise)
        on = found.d2 < width**2
        if np.count_nonzero(on) < LEAST_COMPARED:
            return Plausibility(
                noise, 1.0, False, f"fewer than {LEAST_COMPARED} of its points are on the model"
            )
        beside = ~on & (found.d2 < (2.0 * width) ** 2)
        jacobian = _Jacobian(p[on])
        support = jacobian.information(p[on], found.normal[on])
        against, covered = [jacobian.information(p[beside], found.normal[beside])], False
        compared = None if camera_c is None else self._compared(Rays(rays), T_ca, noise)
        if compared is not None:
            held, violated, empty = compared
            each = np.count_nonzero(on) / max(
                1, held
            )  # points of the scan for a point of the surface
            paired = min(each, np.count_nonzero(~on) / max(1, len(empty)))
            for weight, k in ((each, violated), (paired, empty)):
                against.append(weight * jacobian.information(self._points[k], self._normals[k]))
            absent = len(violated) + len(empty)
            covered = absent <= MOST_MISSING * (held + absent)
        chance, seen = CHANCE * np.count_nonzero(on), len(against) > 1
        score, kind = _contradicted(support, np.array(against), chance)
        if (
            seen
            and score > MOST_CONTRADICTED
            and self.predicted(T_ca, guess)
            and self._alone(rays, on, T_ca)
        ):
            score, kind = _contradicted(
                support, np.array(against[:2]), chance
            )  # missing surface may be hidden
        reason = ""
        if noise > NOISE_OF_EXTENT * self._extent:
            reason = f"distances to the model spread by {noise:.3g} m"
        elif score > MOST_CONTRADICTED:
            reason = (
                f"in one direction {100.0 * score:.0f} % contradicts the pose:"
                f" {CONTRADICTIONS[kind]}"
            )
        elif camera_c is None:
            away = self._visibility.may_be_camera(T_ca) and np.count_nonzero(
                on
            ) < LEAST_ALONE * len(on)
            reason = TURNED_AWAY if away else ""
        elif self._continued(p, found, noise, camera_c):
            reason = CONTINUED
        return Plausibility(noise, score, covered, reason)

    def continued(self, points: NDArray[Any], T_ca: Pose) -> bool:
        """Return whether the surface in a scan (n, 3) in {A} continues beyond the edges of the
        model at a pose.

        Then the model is of another object or too small. False where the camera is not known.
        """
        camera_c = self._visibility.camera_c(self._index, points, T_ca)
        if camera_c is None:
            return False
        found = self._index.closest(
            p := T_ca.apply(points), camera_c=camera_c, most_m=self._index.reach_m
        )
        return self._continued(
            p, found, robust_noise(np.minimum(np.sqrt(found.d2), self._index.reach_m)), camera_c
        )

    def _continued(self, p: Array, found: Closest, noise: float, camera_c: Array) -> bool:
        """Whether most points (n, 3) in {C} just off the model lie on the continuation of a face
        beyond its edge.

        The image of such a point in the closest point of the model lies on the face. That of a
        point of another object, whose surface has another direction, does not.
        """
        width = max(self._gate, 3.0 * noise)
        near = (found.d2 > (BEYOND[0] * width) ** 2) & (found.d2 < (BEYOND[1] * width) ** 2)
        if np.count_nonzero(near) < LEAST_BEYOND:
            return False
        image = self._index.closest(
            2.0 * found.foot[near] - p[near], camera_c=camera_c, most_m=self._index.reach_m
        )
        on = np.count_nonzero(image.d2 < max(MIRRORED * noise, LEAST_IMAGE * self._gate) ** 2)
        return bool(on >= LEAST_BEYOND and on > MOST_CONTINUED * np.count_nonzero(near))

    def measure(self, points: NDArray[Any], T_ca: Pose) -> Array:
        """Return the distances (n,) [m] of points (n, 3) in {A} to the visible faces, at most the
        reach.
        """
        return self._visibility.distances(self._index, points, T_ca, np.inf)[0]

    def _compared(
        self, rays: Rays, T_ca: Pose, noise: float
    ) -> tuple[int, Numbers, Numbers] | None:
        """How many of the visible surface points the scan has, those in free space, and those where
        it has no point.

        None with too few to compare.
        """
        T_ac, points = T_ca.inverse(), rays.points
        expected = self._expected(points, T_ca)
        if not len(expected):
            return None
        tree = kernel_module().PointTree(points)
        spacing = float(
            np.median(tree.query(points[:: max(1, len(points) // SPACED)].copy(), k=2)[0][:, -1])
        )
        near = max(self._gate, 3.0 * noise, 3.0 * spacing)
        surface = T_ac.apply(self._points[expected])
        supported = tree.query(surface, 1, 1.01 * near)[0][:, 0] < near
        missing = expected[~supported]
        passed, empty = rays.through(surface[~supported], 2.0 * near)
        held = int(np.count_nonzero(supported))
        if held + np.count_nonzero(passed) < LEAST_COMPARED:
            return None
        return held, missing[passed], missing[empty]

    def _alone(self, points: Array, on: NDArray[np.bool_], T_ca: Pose) -> bool:
        """Whether nearly all points (n, 3) in {A} are on the model or hide it, well in front
        of it.
        """
        surface = T_ca.inverse().apply(self._points)
        seen = Rays(surface[self._expected(surface, T_ca)])
        off = Rays(points[~on])
        if seen.tree is None or not len(off.points):
            return bool(on.all())
        angle, k = (each[:, 0] for each in seen.tree.query(off.points / off.ranges[:, None]))
        hiding = (angle < EMPTY * seen.spacing) & (
            off.ranges < seen.ranges[k] - BEFORE_OF_EXTENT * self._extent
        )
        return int(np.count_nonzero(on)) >= LEAST_ALONE * (
            len(points) - int(np.count_nonzero(hiding))
        )

    def _expected(self, scan: Array, T_ca: Pose) -> Numbers:
        """Which surface points the camera should see that looks at points (n, 3) in {A}."""
        rule = (
            IN_FRONT,
            LEAST_FACING,
            LEAST_COSINE,
            HIDDEN_OF_EXTENT * self._extent,
            POINTS_PER_CELL,
        )
        found: Numbers = kernel_module().seen(scan, T_ca.matrix, self._points, self._normals, *rule)
        return found


class _Jacobian:
    """Rows J of points of the model about the centroid of some of them, rotations in units of their
    rms radius.
    """

    def __init__(self, points: Array) -> None:
        self._centre = points.mean(axis=0)
        self._radius = max(
            float(np.sqrt(np.mean((points - self._centre) ** 2) * 3.0)), np.finfo(float).tiny
        )

    def information(self, points: Array, normals: Array) -> Array:
        """Return the sum of J'J (6, 6) over points (n, 3) with normals (n, 3)."""
        J = normal_jacobian((points - self._centre) / self._radius, normals)
        return np.asarray(J.T @ J)


def _contradicted(support: Array, against: Array, chance: float) -> tuple[float, int]:
    """The largest generalized eigenvalue, and which of the contradictions (k, 6, 6) has the largest
    part in it.
    """
    both = support + against[1:].sum(axis=0) + chance * np.eye(6)
    W = np.linalg.inv(np.linalg.cholesky(both))
    values, vectors = np.linalg.eigh(W @ against.sum(axis=0) @ W.T)
    u = W.T @ vectors[:, -1]
    return float(values[-1]), int(np.argmax(u @ against @ u))


def robust_noise(distance: Array) -> float:
    """Return the standard deviation of a normal error with magnitudes ``distance`` (n,), outliers
    among them.

    The first estimate is the least of those from the 30 % to the 90 % quantile; outliers only raise
    them, by a factor of three if they are 60 %. The result uses the median of the magnitudes within
    three standard deviations.
    """
    ordered = np.sort(distance)
    noise = float(
        np.min(
            np.interp(LEVELS * (len(ordered) - 1), np.arange(len(ordered)), ordered)
            / NORMAL_QUANTILES
        )
    )
    for _ in range(REFINEMENTS):
        if near := int(np.searchsorted(ordered, 3.0 * noise)):
            middle = 0.5 * float(ordered[(near - 1) // 2] + ordered[near // 2])
            noise = min(noise, middle / NORMAL_QUANTILES[2])
    return noise
