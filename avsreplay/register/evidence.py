"""How well a pose of the model explains the rays of a scan: one log likelihood, summed over patches
of the model.

Every ray that meets the model, or ends near it, says one of five things at a pose: its point is on
the model, beside it, in front of it (something hides the model), behind it (the ray passed through
the model), or the model is expected in a direction in which nothing was measured. Rays of one patch
are not independent, because errors of a pose or of a model are alike for them. A patch is therefore
one observation: it counts by the shares of its rays.

The alternative is another minimum of the distances, not the absence of the target. At a wrong
minimum points on the model are spread over a width that is a share of the extent, and neighbouring
residuals are alike; at the right pose they are as near as the noise, and independent. A patch on
the model therefore counts log(D / s), with s the part of the residuals that neighbours share. One
beside the model, or with rays through it, counts log e. Where the measured surface continues in
the plane of a face beyond its edge, the face is not the one that was measured.

Isolated returns (outliers, mixed pixels) are left out before: no pose explains them.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.register.backend import Target
from avsreplay.register.quality import LEAST_RATIO
from avsreplay.register.sampling import Rays, sample_evenly
from avsreplay.register.surface_index import kernel_module

RAYS = 2000  # of a scan, with which poses are compared
OBSERVATION_OF_EXTENT = 0.03  # side of the cubes of the model whose rays are one observation
# distances that are measured, and that are beside
MEASURED_OF_EXTENT = 0.05
BESIDE_OF_EXTENT = 0.04
# width over the extent over which the points of a wrong minimum are spread, and the least spread of
# a right one
WRONG_SPREAD_OF_EXTENT = 0.006
RIGHT_SPREAD_OF_EXTENT = 0.001
CONTRADICTING_PATCHES = 0.03  # share of the patches of the right pose that contradict it
SHARES = 0.3  # weight of the shares of patches that are on the model, hidden, and not measured
CONTINUES = 0.02  # share of the edges of the right pose beyond which the surface continues
LEVELS = np.array([0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])  # quantiles of |distance|
NORMAL_QUANTILES = np.array(
    [0.38532, 0.52440, 0.67449, 0.84162, 1.03643, 1.28155, 1.64485]
)  # for a standard normal
REFINEMENTS = 2
# noise over the extent
LEAST_NOISE = 0.0006
MOST_NOISE = 0.012
# a ray passed through: so many sigmas, and at least
THROUGH = 4.0
THROUGH_OF_EXTENT = 0.012
NEIGHBOURS = 8  # returns next to one in the image, of which so many
# are near it, and how near
ISOLATED = 2
ISOLATED_OF_EXTENT = 0.03
SPACINGS = 2.5
# extents around the middle of the model, and between such places
REGION_OF_EXTENT = 0.75
SAME_PLACE = 0.1
HOLE = 1.4  # a direction has no return if none is within so many spacings of the rays
PIXELS = 70  # of the image of the model at most, along its longer side
EXPECTED_COSINE = 0.2  # of the incidence at which a return is expected
LEAST_RAYS_NEAR = 20  # near the model; with fewer a pose is not measured
NEIGHBOUR_OF_EXTENT = 0.1  # neighbouring rays whose points on the model are nearer share an error
BEFORE_OF_EXTENT = 0.25  # a return that hides the model is this much nearer, as a rule
IMAGE_POINTS = 800  # of the model, which bound its image
# of the log likelihood ratio per patch: accepted, ends a search
LEAST_MEAN = 0.8
LEAST_SURE = 1.0
MOST_MISSING = 0.1  # largest share of the visible surface that is missing in a complete scan
# Log likelihood ratio of the edges of the model below which another surface was measured. The
# right poses of held-out bodies have 18 or more; a box that is 5 % larger has -61 or less.
LEAST_OF_EDGES = 0.0
GOES_ON = (
    "the surface in the scan continues beyond the edges of the model, as that of another or a"
    " larger object"
)
CONTRADICTED = "the scan contradicts the pose: "
ELSEWHERE = "is the sensor at the origin of the clouds? If not, see --sensor-at"
TURNED_AWAY = f"most points are on faces that face away from the camera; {ELSEWHERE}"
THROUGH_IT = f"rays that pass through it; {ELSEWHERE}"
TOO_FEW = f"fewer than {LEAST_RAYS_NEAR} of its points are near the model"
PLANES = (1.0, 2.0, 3.0, 5.0)  # standard deviations between the classes of points on the model


@value_class
class Evidence:
    """What the rays of a scan say of a pose.

    Attributes:
        on: (4,) patches whose points are within 1, 2, 3 and 5 standard deviations of the model.
        beside, through: patches that contradict the pose.
        hidden, absent: patches that another object hides, and that were not measured.
        continued, ended: silhouettes beyond which the measured surface continues, and does not.
        noise_m: robust standard deviation of the distances [m].
        spread_m: part of the residuals that neighbouring rays share [m].
        extent_m: of the model.
        away: most points are on faces that face away from the origin, where the sensor may be.
        share: of the returns around the model that are on it.
        elsewhere: patches that were not measured, up to as many as have returns near the model that
            are not on it: the surface may be there instead.
    """

    on: Array
    beside: float
    through: float
    hidden: float
    absent: float
    continued: float
    ended: float
    noise_m: float
    spread_m: float
    extent_m: float
    away: bool
    share: float
    elsewhere: float

    @property
    def total(self) -> float:
        """Return the log likelihood ratio against another minimum, which compares poses of one
        scan.
        """
        on = float(self.on.sum())
        spread = np.hypot(self.spread_m / self.extent_m, RIGHT_SPREAD_OF_EXTENT)
        tail = 4.0 * float(self.on[2]) + 9.0 * float(self.on[3])
        against = (self.beside + self.through + self.elsewhere) * np.log(CONTRADICTING_PATCHES)
        return float(
            on * np.log(WRONG_SPREAD_OF_EXTENT / spread)
            + SHARES * (self._shares - 0.5 * tail)
            + against
        )

    @property
    def _shares(self) -> float:
        """The log likelihood of the shares of the patches that are on the model, hidden, and not
        measured.
        """
        shares = np.array([float(self.on.sum()), self.hidden, self.absent])
        known = max(float(shares.sum()), np.finfo(float).tiny)
        return float(shares @ np.log(np.maximum(shares, 0.5) / known))

    @property
    def silhouettes(self) -> float:
        """Return the log likelihood ratio of the edges of the model."""
        return float(
            self.continued * np.log(CONTINUES / 0.5) + self.ended * np.log((1.0 - CONTINUES) / 0.5)
        )

    @property
    def patches(self) -> float:
        """Return the number of patches that the scan shows."""
        return float(max(5.0, self.on.sum() + self.beside + self.through))

    @property
    def mean(self) -> float:
        """Return the log likelihood ratio per patch, by which a pose is accepted."""
        return (self.total + self.silhouettes) / self.patches

    @property
    def covered(self) -> bool:
        """Return whether the visible side of the model is in the scan, up to ``MOST_MISSING``."""
        missing = self.absent + self.through
        return not self.away and missing <= MOST_MISSING * (float(self.on.sum()) + missing)

    @property
    def doubtful(self) -> bool:
        """Return whether a search goes on, because another pose may have more evidence.

        That a part of the target is hidden or outside of the scan is no such doubt.
        """
        return self.mean - SHARES * self._shares / self.patches < LEAST_SURE

    def reason(self, predicted: bool = False) -> str:
        """Return why a pose is not accepted, "" if it is: the term that is most against it.

        Args:
            predicted: the pose is the predicted one, so that surface which is hidden or outside of
                the scan says nothing, unless it may be where points off the model are.
        """
        if self.away and self.share < LEAST_RATIO:
            return TURNED_AWAY
        if self.silhouettes < LEAST_OF_EDGES:
            return CONTRADICTED + GOES_ON
        hidden = predicted and self.elsewhere <= MOST_MISSING * self.patches
        allowed = -SHARES * self._shares / self.patches if hidden else 0.0
        if self.mean + allowed >= LEAST_MEAN:
            return ""
        on, spread = (
            float(self.on.sum()),
            np.hypot(self.spread_m / self.extent_m, RIGHT_SPREAD_OF_EXTENT),
        )
        against = {
            "neighbouring points have the same distance from it": on
            * np.log(spread / RIGHT_SPREAD_OF_EXTENT),
            "points beside the model": -self.beside * np.log(CONTRADICTING_PATCHES),
            "surface that is not in the scan, and points off the model": -self.elsewhere
            * np.log(CONTRADICTING_PATCHES),
            THROUGH_IT: -self.through * np.log(CONTRADICTING_PATCHES),
            GOES_ON: -self.continued * np.log(CONTINUES / 0.5),
            f"distances to the model spread by {self.noise_m:.3g} m": 0.5
            * SHARES
            * (4.0 * float(self.on[2]) + 9.0 * float(self.on[3])),
        }
        return CONTRADICTED + max(against, key=lambda term: against[term])


class Region:
    """The returns of a scan around a place, by their directions.

    Attributes:
        points, ranges, directions: (n, 3), (n,), (n, 3) in {A} of the returns that are not
            isolated.
        places: (n, 3) by which returns are neighbours: their directions, or the points where the
            position of the sensor is not known.
        pitch: angle between neighbouring rays [rad].
    """

    def __init__(self, points: Array, extent_m: float, sees: bool) -> None:
        """Leave out isolated returns of points (n, 3) in {A} [m]; ``sees``: the sensor is at the
        origin.
        """
        few = points[np.linspace(0, len(points) - 1, min(RAYS, len(points))).astype(np.intp)]
        rays = Rays(np.ascontiguousarray(few, dtype=np.float64))
        kept = np.ones(len(rays.points), dtype=bool)
        self.pitch, self.sees = rays.spacing, sees
        if sees and rays.tree is not None:
            directions = rays.points / rays.ranges[:, None]
            nearest = rays.tree.query(directions, min(1 + NEIGHBOURS, len(directions)))[1][:, 1:]
            apart = np.linalg.norm(rays.points[:, None] - rays.points[nearest], axis=2)
            near = np.maximum(ISOLATED_OF_EXTENT * extent_m, SPACINGS * self.pitch * rays.ranges)
            kept = (apart < near[:, None]).sum(axis=1) >= ISOLATED
        self.points: Array = np.ascontiguousarray(rays.points[kept])
        self.ranges: Array = rays.ranges[kept]
        self.directions: Array = np.ascontiguousarray(self.points / self.ranges[:, None])
        self.places: Array = self.directions if sees else self.points

    @cached_property
    def tree(self) -> Any:
        """Return the tree of the directions."""
        return kernel_module().PointTree(self.directions)

    @cached_property
    def axes(self) -> Array:
        """Return the axes (3, 3) of the image plane and the mean direction."""
        z = self.directions.mean(axis=0)
        z /= np.linalg.norm(z)
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
        x /= np.linalg.norm(x)
        return np.stack([x, np.cross(z, x), z])


class Observed:
    """A scan, of which the rays around the places of poses are prepared when they are needed.

    Attributes:
        points: (n, 3) in {A} [m].
    """

    def __init__(self, points: NDArray[Any]) -> None:
        self.points = points
        self._regions: list[tuple[Array, bool, Region]] = []

    def around(self, middle: Array, extent_m: float, sees: bool) -> Region:
        """Return the returns near the model, and where ``sees`` those of all rays towards it.

        Args:
            middle: (3,) of the model in {A} [m].
            extent_m: of the model.
            sees: the sensor is at the origin of {A}.
        """
        for place, seen, region in self._regions:
            if seen is sees and np.linalg.norm(place - middle) < SAME_PLACE * extent_m:
                return region
        p, radius = np.asarray(self.points, dtype=np.float64), REGION_OF_EXTENT * extent_m
        within = np.einsum("ij,ij->i", p - middle, p - middle) < radius**2
        away = float(np.linalg.norm(middle))
        if sees and away > radius:
            along = p @ (middle / away)
            within |= along > np.linalg.norm(p, axis=1) * np.sqrt(1.0 - (radius / away) ** 2)
        region = Region(p if within.all() else p[within], extent_m, sees)
        self._regions.append((middle, sees, region))
        return region


class EvidenceModel:
    """Evidence of scans for poses of one target."""

    def __init__(self, target: Target) -> None:
        self._target, self._extent = target, target.surface.extent
        vertices = target.surface.vertices
        self._middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        self._points = sample_evenly(target.surface, IMAGE_POINTS)[0]

    def at(self, scan: Observed, T_ca: Pose) -> Evidence | None:
        """Return what the rays of a scan say of a pose; None with fewer than ``LEAST_RAYS_NEAR``
        near the model.
        """
        target, L, index = self._target, self._extent, self._target.index
        middle = T_ca.inverse().apply(self._middle[None])[0]
        may_be = target.visibility.may_be_camera(T_ca)
        seen = scan.around(middle, L, may_be)
        p = T_ca.apply(seen.points)
        most = min(MEASURED_OF_EXTENT * L, index.reach_m)
        near = np.flatnonzero(index.distances(seen.points, T_ca, most, False, 1, 0.0)[0] < most)
        if len(near) < LEAST_RAYS_NEAR:
            return None
        camera = target.visibility.camera_c(index, seen.points[near], T_ca)
        found = index.closest(p, camera_c=camera, most_m=most)
        distance = np.sqrt(np.minimum(found.d2, most**2))
        close = found.d2 < most**2
        if np.count_nonzero(close) < LEAST_RAYS_NEAR:
            return None
        noise = float(np.clip(robust_noise(distance[close]), LEAST_NOISE * L, MOST_NOISE * L))
        z = distance / noise
        D = seen.directions @ T_ca.R.T
        hit, ranges = np.zeros(len(p), dtype=bool), np.full(len(p), np.inf)
        through = hit
        if camera is not None:
            ranges, cosine, _ = self._cast(T_ca.t, D)
            hit = np.isfinite(ranges)
            slant = THROUGH * noise / np.maximum(cosine, EXPECTED_COSINE)
            through = hit & (seen.ranges - ranges > np.maximum(slant, THROUGH_OF_EXTENT * L))
        on = ~through & close & (z < PLANES[-1])
        beside = ~through & ~on & (distance < BESIDE_OF_EXTENT * L)
        hidden = hit & ~through & ~on & ~beside
        # returns near the model that do not explain its absence elsewhere by hiding it
        around = (
            np.einsum("ij,ij->i", p - self._middle, p - self._middle) < (REGION_OF_EXTENT * L) ** 2
        )
        stray = around & ~(on | beside | through)
        stray &= ~hidden | (ranges - seen.ranges < BEFORE_OF_EXTENT * L)
        rays = max(1, int(np.count_nonzero(on | beside | through)))
        kind = np.full(len(p), -1)
        kind[on] = np.searchsorted(PLANES[:-1], z[on], side="right")
        kind[beside], kind[hidden], kind[through] = 4, 5, 6
        behind = T_ca.t + D * np.where(hit, ranges, 0.0)[:, None]
        at = np.where((on | beside)[:, None], found.foot, behind)
        missing, weight, edges = np.empty((0, 3)), 1.0, (0.0, 0.0)
        if camera is not None:
            missing, weight, edges = self._image(seen, T_ca, noise, ranges)
        known = kind >= 0
        counts = _by_patch(
            np.concatenate([at[known], missing]),
            np.concatenate([kind[known], np.full(len(missing), 7)]),
            np.concatenate([np.ones(int(known.sum())), np.full(len(missing), weight)]),
            OBSERVATION_OF_EXTENT * L,
        )
        spread = 0.0
        if len(target.surface.faces):
            e = np.einsum("ij,ij->i", p - found.foot, found.normal)
            spread = _shared(seen, e, found.foot, on & (z < PLANES[2]), NEIGHBOUR_OF_EXTENT * L)
        return Evidence(
            on=counts[:4],
            beside=float(counts[4]),
            through=float(counts[6]),
            hidden=float(counts[5]),
            absent=float(counts[7]),
            continued=edges[0],
            ended=edges[1],
            noise_m=noise,
            spread_m=spread,
            extent_m=L,
            away=may_be and camera is None,
            share=float(np.mean(on)),
            elsewhere=min(
                float(counts[7]),
                float(counts[:5].sum() + counts[6]) * np.count_nonzero(stray) / rays,
            ),
        )

    def _cast(self, eye: Array, D: Array) -> tuple[Array, Array, Array]:
        """Ranges (n,) [m] of the model along directions (n, 3), cosines of incidence and
        normals.
        """
        index = self._target.index
        ranges = index.cast(eye, D)[0]
        hit = np.isfinite(ranges)
        normal, cosine = np.zeros_like(D), np.zeros(len(D))
        found = index.closest(eye + D[hit] * ranges[hit, None], most_m=0.01 * self._extent)
        normal[hit] = found.normal
        cosine[hit] = np.abs(np.einsum("ij,ij->i", found.normal, D[hit]))
        return ranges, cosine, normal

    def _image(
        self, seen: Region, T_ca: Pose, noise: float, measured: Array
    ) -> tuple[Array, float, tuple[float, float]]:
        """Places (k, 3) in {C} of the model in directions without a return, the rays for which
        each counts, and the patches of silhouettes beyond which the surface continues, and does
        not.
        """
        none = np.empty((0, 3)), 1.0, (0.0, 0.0)
        q = T_ca.inverse().apply(self._points) @ seen.axes.T
        q = q[q[:, 2] > 0.1 * np.linalg.norm(q, axis=1)]
        if len(q) < LEAST_RAYS_NEAR:
            return none
        uv = q[:, :2] / q[:, 2:]
        low, high = uv.min(axis=0), uv.max(axis=0)
        pitch = max(seen.pitch, float((high - low).max()) / PIXELS)
        u, v = (
            np.arange(a - 3 * pitch, b + 4 * pitch, pitch) for a, b in zip(low, high, strict=True)
        )
        shape = (len(u), len(v))
        grid = np.stack([*np.meshgrid(u, v, indexing="ij"), np.ones(shape)], axis=-1).reshape(-1, 3)
        G = grid @ seen.axes
        G /= np.linalg.norm(G, axis=1)[:, None]
        D = np.ascontiguousarray(G @ T_ca.R.T)
        ranges, cosine, normal = self._cast(T_ca.t, D)
        hit = np.isfinite(ranges)
        I = np.arange(len(G)).reshape(shape)
        pairs = np.concatenate(
            [
                np.stack([a.ravel(), b.ravel()], axis=1)
                for a, b in (
                    (I[2:], I[:-2]),
                    (I[:-2], I[2:]),
                    (I[:, 2:], I[:, :-2]),
                    (I[:, :-2], I[:, 2:]),
                )
            ]
        )
        a, b = pairs[hit[pairs[:, 0]]].T
        asked = hit.copy()  # the nearest return of other directions is not needed
        asked[b] = True
        angle, nearest = np.full(len(G), np.inf), np.zeros(len(G), dtype=np.intp)
        angle[asked], nearest[asked] = (each[:, 0] for each in seen.tree.query(G[asked], 1))
        empty = angle > HOLE * seen.pitch
        missing = hit & empty & (cosine > EXPECTED_COSINE)
        places = T_ca.t + D[missing] * ranges[missing, None]
        L = self._extent
        # An edge: no face of the model is near the plane of the face at a, also of a steep one.
        on_plane = _to_plane(normal[a], D[a], ranges[a], D[b])
        behind = ranges[b] < np.maximum(on_plane, ranges[a]) + 0.05 * L
        edge = (cosine[a] > 0.3) & ~behind & ~empty[a]
        a, b = a[edge], b[edge]
        slope = pitch * ranges[a] * np.sqrt(np.maximum(1.0 - cosine[a] ** 2, 0.0))
        close = np.abs(seen.ranges[nearest[a]] - ranges[a]) * cosine[a] < 4.0 * noise + 0.5 * slope
        a, b = a[close], b[close]
        if not len(a):
            return places, (pitch / seen.pitch) ** 2, (0.0, 0.0)
        ray = nearest[b]
        towards = seen.directions[ray] @ T_ca.R.T
        plane = _to_plane(normal[a], D[a], ranges[a], towards)
        down = np.abs(np.einsum("ij,ij->i", normal[a], towards))
        goes_on = (
            ~empty[b]
            & (angle[b] < 0.7 * pitch)
            & ~(measured[ray] < np.maximum(plane, ranges[a]) + 0.05 * L)
            & (np.abs(seen.ranges[ray] - plane) * down < 4.0 * noise)
        )
        counts = _by_patch(
            T_ca.t + D[a] * ranges[a, None],
            goes_on.astype(np.intp),
            np.ones(len(a)),
            OBSERVATION_OF_EXTENT * L,
            2,
        )
        return places, (pitch / seen.pitch) ** 2, (float(counts[1]), float(counts[0]))


def _to_plane(normal: Array, sight: Array, ranges: Array, towards: Array) -> Array:
    """Ranges (n,) in directions (n, 3) to the planes of faces that are seen along others (n, 3).

    Args:
        normal: (n, 3) of the faces.
        sight: (n, 3) directions in which the faces are seen.
        ranges: (n,) of the faces in these directions [m].
        towards: (n, 3) directions of the planes; those in the plane of a face get the largest
            range.
    """
    height = np.einsum("ij,ij->i", normal, sight)
    down = np.einsum("ij,ij->i", normal, towards) * np.sign(height)
    return np.asarray(ranges * np.abs(height) / np.maximum(down, 0.1))


def _by_patch(
    at: Array, kind: NDArray[np.intp], weight: Array, side_m: float, kinds: int = 8
) -> Array:
    """The sum (kinds,) over the patches of the shares of each kind of ray."""
    if not len(at):
        return np.zeros(kinds)
    cell = np.floor(at / side_m).astype(np.int64)
    cell -= cell.min(axis=0)
    span = cell.max(axis=0) + 1
    patch = np.unique(
        (cell[:, 0] * span[1] + cell[:, 1]) * span[2] + cell[:, 2], return_inverse=True
    )[1]
    sums = np.bincount(patch * kinds + kind, weight, (int(patch.max()) + 1) * kinds).reshape(
        -1, kinds
    )
    return np.asarray((sums / np.maximum(sums.sum(axis=1), 1.0)[:, None]).sum(axis=0))


def _shared(seen: Region, e: Array, foot: Array, on: NDArray[np.bool_], near_m: float) -> float:
    """The rms [m] of the part of the residuals (n,) that neighbouring rays on the model share."""
    k = np.flatnonzero(on)
    if len(k) <= LEAST_RAYS_NEAR:
        return 0.0
    d = np.ascontiguousarray(seen.places[k])
    other = kernel_module().PointTree(d).query(d, min(4, len(k)))[1][:, 1:]
    near = np.linalg.norm(foot[k][:, None] - foot[k][other], axis=2) < near_m
    products = (e[k][:, None] * e[k][other])[near]
    shared = float(np.mean(products)) if len(products) > LEAST_RAYS_NEAR else 0.0
    return float(np.sqrt(max(shared, 0.0)))


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
