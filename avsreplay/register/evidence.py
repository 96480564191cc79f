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
from avsreplay.register.sampling import Rays, sample_evenly
from avsreplay.register.surface_index import kernel_module

RAYS = 2000  # of a scan, with which poses are compared
PATCH_OF_EXTENT = 0.03  # side of the cubes of the model whose rays are one observation
NEAR_OF_EXTENT, BESIDE_OF_EXTENT = 0.05, 0.04  # distances that are measured, and that are beside
# width over the extent over which the points of a wrong minimum are spread, and the least spread of
# a right one
WRONG_OF_EXTENT, RIGHT_OF_EXTENT = 0.006, 0.001
CONTRADICTING = 0.03  # share of the patches of the right pose that contradict it
SHARES = 0.3  # weight of the shares of patches that are on the model, hidden, and not measured
CONTINUES = 0.02  # share of the edges of the right pose beyond which the surface continues
LEAST_NOISE, MOST_NOISE = 0.0006, 0.012  # noise over the extent
THROUGH, THROUGH_OF_EXTENT = 4.0, 0.012  # a ray passed through: so many sigmas, and at least
ISOLATED, ISOLATED_OF_EXTENT, SPACINGS = 2, 0.03, 2.5  # near neighbours of a return, and how near
HOLE = 1.4  # a direction has no return if none is within so many spacings of the rays
PIXELS = 70  # of the image of the model at most, along its longer side
LEAST_COSINE = 0.2  # of the incidence at which a return is expected
LEAST_RAYS = 20  # near the model; with fewer a pose is not measured
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

    @property
    def total(self) -> float:
        """Return the log likelihood ratio against another minimum, which compares poses of one
        scan.
        """
        on = float(self.on.sum())
        spread = np.hypot(self.spread_m / self.extent_m, RIGHT_OF_EXTENT)
        shares = np.array([on, self.hidden, self.absent])
        known = max(float(shares.sum()), np.finfo(float).tiny)
        likely = float(shares @ np.log(np.maximum(shares, 0.5) / known))
        tail = 4.0 * float(self.on[2]) + 9.0 * float(self.on[3])
        against = (self.beside + self.through) * np.log(CONTRADICTING)
        return float(
            on * np.log(WRONG_OF_EXTENT / spread) + SHARES * (likely - 0.5 * tail) + against
        )

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


class Observed:
    """The returns of a scan that are not isolated, by their directions.

    Attributes:
        rays: of the scan.
        points, ranges, directions: of the returns in {A}.
        pitch: angle between neighbouring rays [rad].
    """

    def __init__(self, scan: NDArray[Any], extent_m: float) -> None:
        """Thin the scan (n, 3) in {A} [m] and leave out its isolated returns."""
        few = scan[np.linspace(0, len(scan) - 1, min(RAYS, len(scan))).astype(np.intp)]
        rays = Rays(np.ascontiguousarray(few, dtype=np.float64))
        self.pitch = rays.spacing
        self.rays, kept = rays, np.ones(len(rays.points), dtype=bool)
        if rays.tree is not None:
            directions = rays.points / rays.ranges[:, None]
            nearest = rays.tree.query(directions, min(9, len(directions)))[1][:, 1:]
            apart = np.linalg.norm(rays.points[:, None] - rays.points[nearest], axis=2)
            near = np.maximum(ISOLATED_OF_EXTENT * extent_m, SPACINGS * self.pitch * rays.ranges)
            kept = (apart < near[:, None]).sum(axis=1) >= ISOLATED
        self.points: Array = np.ascontiguousarray(rays.points[kept])
        self.ranges: Array = rays.ranges[kept]
        self.directions: Array = np.ascontiguousarray(self.points / self.ranges[:, None])
        self.tree = kernel_module().PointTree(self.directions)

    @cached_property
    def axes(self) -> Array:
        """Return the axes (3, 3) of the image plane and the mean direction."""
        z = self.directions.mean(axis=0)
        z /= np.linalg.norm(z)
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
        x /= np.linalg.norm(x)
        return np.stack([x, np.cross(z, x), z])


class EvidenceModel:
    """Evidence of scans for poses of one target."""

    def __init__(self, target: Target) -> None:
        self._target, self._extent = target, target.surface.extent
        self._points = sample_evenly(target.surface, 800)[0]

    def at(self, seen: Observed, T_ca: Pose) -> Evidence | None:
        """Return what the rays of a scan say of a pose; None with fewer than ``LEAST_RAYS`` near
        the model.
        """
        target, L, index = self._target, self._extent, self._target.index
        sees = target.visibility.may_be_camera(T_ca)
        p = T_ca.apply(seen.points)
        most = min(NEAR_OF_EXTENT * L, index.reach_m)
        camera = T_ca.t if sees else None
        found = index.closest(p, camera_c=camera, most_m=most)
        distance = np.sqrt(np.minimum(found.d2, most**2))
        near = found.d2 < most**2
        if np.count_nonzero(near) < LEAST_RAYS:
            return None
        noise = float(np.clip(_noise(distance[near]), LEAST_NOISE * L, MOST_NOISE * L))
        z = distance / noise
        D = seen.directions @ T_ca.R.T
        e = np.einsum("ij,ij->i", p - found.foot, found.normal)
        if sees:
            ranges, cosine, _ = self._cast(T_ca.t, D)
            hit = np.isfinite(ranges)
            width = np.maximum(
                THROUGH * noise / np.maximum(cosine, LEAST_COSINE), THROUGH_OF_EXTENT * L
            )
            through = hit & (seen.ranges - ranges > width)
        else:
            ranges, hit = np.full(len(p), np.inf), np.zeros(len(p), dtype=bool)
            through = hit
        on = ~through & near & (z < PLANES[-1])
        beside = ~through & ~on & (distance < BESIDE_OF_EXTENT * L)
        hidden = hit & ~through & ~on & ~beside
        kind = np.full(len(p), -1)
        kind[on] = np.searchsorted(PLANES[:-1], z[on], side="right")
        kind[beside], kind[hidden], kind[through] = 4, 5, 6
        at = np.where(
            (on | beside)[:, None], found.foot, T_ca.t + D * np.where(hit, ranges, 0.0)[:, None]
        )
        missing, weight, edges = np.empty((0, 3)), 1.0, (0.0, 0.0)
        if sees:
            missing, weight, edges = self._image(seen, T_ca, noise, ranges)
        known = kind >= 0
        counts = _by_patch(
            np.concatenate([at[known], missing]),
            np.concatenate([kind[known], np.full(len(missing), 7)]),
            np.concatenate([np.ones(int(known.sum())), np.full(len(missing), weight)]),
            PATCH_OF_EXTENT * L,
        )
        spread = _shared(seen, e, found.foot, on & (z < 3.0), 0.1 * L)
        return Evidence(counts[:4], counts[4], counts[6], counts[5], counts[7], *edges, noise, spread, L)

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
        self, seen: Observed, T_ca: Pose, noise: float, measured: Array
    ) -> tuple[Array, float, tuple[float, float]]:
        """Places (k, 3) in {C} of the model in directions without a return, the rays for which
        each counts, and the patches of silhouettes beyond which the surface continues, and does
        not.
        """
        none = np.empty((0, 3)), 1.0, (0.0, 0.0)
        q = T_ca.inverse().apply(self._points) @ seen.axes.T
        q = q[q[:, 2] > 0.1 * np.linalg.norm(q, axis=1)]
        if len(q) < LEAST_RAYS:
            return none
        uv = q[:, :2] / q[:, 2:]
        low, high = uv.min(axis=0), uv.max(axis=0)
        pitch = max(seen.pitch, float((high - low).max()) / PIXELS)
        u, v = (np.arange(a - 3 * pitch, b + 4 * pitch, pitch) for a, b in zip(low, high, strict=True))
        shape = (len(u), len(v))
        grid = np.stack([*np.meshgrid(u, v, indexing="ij"), np.ones(shape)], axis=-1).reshape(-1, 3)
        G = grid @ seen.axes
        G /= np.linalg.norm(G, axis=1)[:, None]
        D = np.ascontiguousarray(G @ T_ca.R.T)
        ranges, cosine, normal = self._cast(T_ca.t, D)
        hit = np.isfinite(ranges)
        angle, nearest = (each[:, 0] for each in seen.tree.query(np.ascontiguousarray(G), 1))
        empty = angle > HOLE * seen.pitch
        missing = hit & empty & (cosine > LEAST_COSINE)
        places = T_ca.t + D[missing] * ranges[missing, None]
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
        L = self._extent
        a, b = pairs.T
        edge = hit[a] & (cosine[a] > 0.3) & ~(ranges[b] < ranges[a] + 0.05 * L) & ~empty[a]
        a, b = a[edge], b[edge]
        slope = pitch * ranges[a] * np.sqrt(np.maximum(1.0 - cosine[a] ** 2, 0.0))
        close = np.abs(seen.ranges[nearest[a]] - ranges[a]) * cosine[a] < 4.0 * noise + 0.5 * slope
        a, b = a[close], b[close]
        if not len(a):
            return places, (pitch / seen.pitch) ** 2, (0.0, 0.0)
        ray = nearest[b]
        down = np.einsum("ij,ij->i", normal[a], seen.directions[ray] @ T_ca.R.T)
        down = np.where(np.abs(down) < 0.1, 0.1, down)
        plane = np.einsum("ij,ij->i", normal[a], D[a]) * ranges[a] / down
        goes_on = (
            ~empty[b]
            & (angle[b] < 0.7 * pitch)
            & ~(measured[ray] < ranges[a] + 0.05 * L)
            & (np.abs(seen.ranges[ray] - plane) * np.abs(down) < 4.0 * noise)
        )
        counts = _by_patch(
            T_ca.t + D[a] * ranges[a, None], goes_on.astype(np.intp), np.ones(len(a)), PATCH_OF_EXTENT * L, 2
        )
        return places, (pitch / seen.pitch) ** 2, (float(counts[1]), float(counts[0]))


def _by_patch(at: Array, kind: NDArray[np.intp], weight: Array, side_m: float, kinds: int = 8) -> Array:
    """The sum (kinds,) over the patches of the shares of each kind of ray."""
    if not len(at):
        return np.zeros(kinds)
    cell = np.floor(at / side_m).astype(np.int64)
    cell -= cell.min(axis=0)
    span = cell.max(axis=0) + 1
    patch = np.unique((cell[:, 0] * span[1] + cell[:, 1]) * span[2] + cell[:, 2], return_inverse=True)[1]
    sums = np.bincount(patch * kinds + kind, weight, (int(patch.max()) + 1) * kinds).reshape(-1, kinds)
    return np.asarray((sums / np.maximum(sums.sum(axis=1), 1.0)[:, None]).sum(axis=0))


def _shared(seen: Observed, e: Array, foot: Array, on: NDArray[np.bool_], near_m: float) -> float:
    """The rms [m] of the part of the residuals (n,) that neighbouring rays on the model share."""
    k = np.flatnonzero(on)
    if len(k) <= LEAST_RAYS:
        return 0.0
    d = np.ascontiguousarray(seen.directions[k])
    other = kernel_module().PointTree(d).query(d, min(4, len(k)))[1][:, 1:]
    near = np.linalg.norm(foot[k][:, None] - foot[k][other], axis=2) < near_m
    products = (e[k][:, None] * e[k][other])[near]
    shared = float(np.mean(products)) if len(products) > LEAST_RAYS else 0.0
    return float(np.sqrt(max(shared, 0.0)))


def _noise(distance: Array) -> float:
    from avsreplay.register.plausibility import robust_noise

    return robust_noise(distance)
