"""Which faces of a model the camera can have measured, and the alignments that follow from it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import mesh
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Fit, Surface
from avsreplay.register import index_cache
from avsreplay.register.params import Camera
from avsreplay.register.sampling import directions, sample_faces
from avsreplay.register.surface_index import SurfaceIndex, kernel_module

CLEARANCE_OF_EXTENT = 0.25
LEAST_FACING = 0.4
# share of points so near to a face towards a camera close to the model
LEAST_SEEN = 0.85
NEAR_FACE_OF_EXTENT = 0.01
# if the median of a scan is this far from the origin, the camera was at the origin
FAR_OF_EXTENT = 0.6
TESTED_POINTS = 200
# cameras that look at points of open parts, so many extents away
VIEWS = 24
SIDE_POINTS = 2000
VIEWED_FROM = 2.0
# side of a patch; least cosine of a ray
PATCH_OF_EXTENT = 0.05
LEAST_INCIDENCE = 0.05
# share of the views of a patch; share of the area with one side
FROM_BEHIND = 0.05
LEAST_ONE_SIDED = 0.2
FRONT = 1
BACK = 2
BOTH = 3
CENTROID_CELL = 0.02  # of the image in which the nearest points are seen, over the extent
SIDES_VERSION = 2  # of the rule for the sides of open parts, for the cache


class Visibility:
    """The facing test for one surface: which faces the camera can have measured, those that face
    it.

    Without this test a scan point of a thin panel can be matched to the wrong side. If the guess is
    off by half the thickness of the panel, the measured front is next to the back of the model, and
    plain ICP converges there: on the built-in target, started 3 deg and 5 cm off, in every third
    view.

    AUTO applies it if the outer sides are known. If fewer than 40 % of the closest faces of the
    scan face the origin of {A}, the camera was elsewhere and both sides are matched. Nearer to the
    bounding box than a quarter of the extent, 85 % of the points must also be near a face that
    faces the origin.

    Attributes:
        sided: the faces of this surface have a known outer side.
        surface: the surface with its closed parts wound outwards; where it is sided, faces of open
            parts towards the side that is seen, or with both sides.
    """

    def __init__(
        self, surface: Surface, camera: Camera = Camera.AUTO, cache_dir: Path | None = None
    ) -> None:
        low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
        clear = CLEARANCE_OF_EXTENT * surface.extent if camera is Camera.AUTO else -np.inf
        self._sides, self._clear = list(zip(low.tolist(), high.tolist(), strict=True)), clear
        self._extent, self._known = surface.extent, camera is not Camera.NONE
        self.sided, self.surface = False, surface
        if camera is Camera.NONE:
            return
        self.surface = surface = wound(surface)
        found, outward = seen_sides(surface, cache_dir)
        self.sided = camera is Camera.ORIGIN or outward
        if self.sided:
            self.surface = found

    def camera_c(self, index: SurfaceIndex, points: NDArray[Any], T_ca: Pose) -> Array | None:
        """Return the camera position (3,) in {C} [m] if the test applies to this scan (n, 3) and
        pose, else None.
        """
        faces = self.faced(index, points, T_ca) and index.faces_camera(
            points, T_ca, TESTED_POINTS, LEAST_FACING
        )
        return T_ca.t if faces else None

    def distances(
        self, index: SurfaceIndex, points: NDArray[Any], T_ca: Pose, most_m: float
    ) -> Array:
        """Return the distances (n,) [m] of a scan to the faces that the camera sees, at most
        ``most_m``.
        """
        return index.distances(
            points, T_ca, most_m, self.faced(index, points, T_ca), TESTED_POINTS, LEAST_FACING
        )[0]

    def may_be_camera(self, T_ca: Pose) -> bool:
        """Return whether the outer sides are known, and the origin of {A} is clear of the bounding
        box of the model.
        """
        outside = [
            max(a - x, x - b, 0.0) for x, (a, b) in zip(T_ca.t.tolist(), self._sides, strict=True)
        ]
        return self.sided and math.hypot(*outside) >= self._clear

    def faced(self, index: SurfaceIndex, points: NDArray[Any], T_ca: Pose) -> bool:
        """Return whether the test can apply to a scan (n, 3): ``may_be_camera``, or nearly
        all its faces are seen.
        """
        if not self.sided or self.may_be_camera(T_ca):
            return self.sided
        few, near = (
            T_ca.apply(points[:: max(1, len(points) // TESTED_POINTS)]),
            NEAR_FACE_OF_EXTENT * self._extent,
        )
        every, seen = (np.sqrt(index.closest(few, camera_c=eye).d2) for eye in (None, T_ca.t))
        on = every < index.reach_m
        return int(np.count_nonzero(seen[on] < every[on] + near)) >= LEAST_SEEN * max(
            1, int(np.count_nonzero(on))
        )

    def consistent(
        self,
        index: SurfaceIndex,
        points: NDArray[Any],
        guess: Pose,
        align: Callable[[Pose, bool], Fit],
    ) -> Fit:
        """Return an alignment that begins at the guess and whose choice of faces holds at its
        result.

        Clear of the model the guess decides. Next to it the test depends on the pose, and a guess a
        few degrees off can fail it although the camera is at the origin; without it a thin part is
        matched to both of its sides, and the wrong pose fails it as well. There the test is assumed
        first. If it does not hold at the result, the scan is aligned without it, and from the
        result of that with it, if it holds there.

        Args:
            index: of the surface.
            points: (n, 3) in {A} [m].
            guess: T_ca to begin with.
            align: aligns the scan from a T_ca, with or without the faces that face away from the
                camera left out.

        Returns:
            The result, with the passes of all alignments made, three at most.
        """
        if not self.sided or self.may_be_camera(guess):
            return align(guess, self.camera_c(index, points, guess) is not None)
        made = [align(guess, True)]
        if self.camera_c(index, points, made[0].T_ca) is None:
            made.append(align(guess, False))
            if self.camera_c(index, points, made[1].T_ca) is not None:
                made.append(align(made[1].T_ca, True))
        return replace(made[-1], iterations=sum(fit.iterations for fit in made))

    def direction_to_camera(self, points: NDArray[Any]) -> Array | None:
        """Return the unit direction (3,) from a scan (n, 3) in {A} to the origin; None if the
        camera is not there.
        """
        centre = np.median(points, axis=0).astype(np.float64)
        distance = float(np.linalg.norm(centre))
        if not self._known or distance < FAR_OF_EXTENT * self._extent:
            return None
        return frozen(-centre / distance)


def wound(surface: Surface) -> Surface:
    """Return a surface with its closed parts wound outwards, as a reader of models winds them.

    Args:
        surface: from a reader (``Surface.reversed`` is known), or made otherwise. One of a reader
            is wound again only if its faces enclose a negative volume.
    """
    examined = surface.reversed is not None
    if examined and mesh.signed_volume(surface.vertices, surface.faces) >= 0.0:
        return surface
    faces, count = mesh.outward(surface.vertices, surface.faces)
    return replace(surface, faces=faces, reversed=count)


def seen_sides(surface: Surface, cache_dir: Path | None = None) -> tuple[Surface, bool]:
    """Wind the faces of parts with openings towards the sides from which cameras outside of the
    model see them.

    A patch that is seen from both sides, as that of a bowl or of a sheet, gets faces with both
    windings. Closed parts stay as they are.

    Args:
        surface: closed parts outwards.
        cache_dir: folder where the sides are kept.

    Returns:
        The surface, and whether the outer sides of its faces are known: a closed surface encloses a
        positive volume; of one with openings enough is seen from one side only.
    """
    kernel, path = kernel_module(), None
    if cache_dir is not None and len(surface.faces):
        layout = f"{kernel.LAYOUT} sides {SIDES_VERSION}"
        path = index_cache.cache_path(
            cache_dir, layout, surface.vertices, surface.faces, surface.extent
        )
    kept = index_cache.read_arrays(path, kernel.checksum)
    if "faces" not in kept:
        faces, known = _towards_cameras(surface)
        kept = {"faces": faces, "known": np.array([float(known)])}
        index_cache.write_arrays(path, kept, kernel.checksum)
    return replace(surface, faces=kept["faces"]), bool(kept["known"][0])


def _towards_cameras(surface: Surface) -> tuple[NDArray[np.int32], bool]:
    """The faces and whether their outer sides are known, as ``seen_sides`` returns them."""
    distinct, part = mesh.open_parts(surface.vertices, surface.faces)
    if not (part >= 0).any():
        return surface.faces, mesh.signed_volume(surface.vertices, surface.faces) > 0.0
    faces = surface.faces[distinct]
    closed, opened = faces[part < 0], faces[part >= 0]
    sides = _sides(replace(surface, faces=faces), opened, part[part >= 0])
    wound = np.concatenate([closed, opened[sides != BACK], opened[sides != FRONT][:, ::-1]])
    area = mesh.lengths(mesh.normals(surface.vertices, faces))
    both = area[part >= 0][sides == BOTH].sum()
    return np.ascontiguousarray(wound), bool(both <= (1.0 - LEAST_ONE_SIDED) * area.sum())


def _sides(
    surface: Surface, faces: NDArray[np.int32], part: NDArray[np.int64]
) -> NDArray[np.float64]:
    """The sides (m,) of faces (m, 3) that are seen: ``FRONT``, ``BACK`` or ``BOTH``; ``FRONT``
    where neither is.

    A patch is the faces of one part in one cube of the space whose normals are nearest to one axis.
    """
    v, extent = surface.vertices, surface.extent
    points, normals, of = sample_faces(v, faces, SIDE_POINTS)
    middle = 0.5 * (v.min(axis=0) + v.max(axis=0))
    index = SurfaceIndex.build(surface, 0.05 * extent, clearances=False)
    front, back = np.zeros(len(points)), np.zeros(len(points))
    for direction in directions(VIEWS):
        rays = points - (eye := middle + VIEWED_FROM * extent * direction)
        length = np.linalg.norm(rays, axis=1)
        rays /= length[:, None]
        seen = index.cast(eye, rays)[0] > length - 1e-5 * extent
        slope = np.einsum("ij,ij->i", rays, normals)
        front += seen & (slope < -LEAST_INCIDENCE)
        back += seen & (slope > LEAST_INCIDENCE)
    corners, normal = v[faces], mesh.normals(v, faces)
    axis = np.argmax(np.abs(normal), axis=1)
    towards = 2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0.0)
    cube = np.floor((corners.mean(axis=1) - middle) / (PATCH_OF_EXTENT * extent))
    patch = mesh.distinct_rows(np.column_stack([part, towards, cube]))[1]
    of_part = np.unique(part, return_inverse=True)[1]
    seen = _counts(patch, of, front, back)
    seen = np.where(seen.sum(axis=0) > 0.0, seen, _counts(of_part, of, front, back))
    share = seen[1] / np.maximum(seen.sum(axis=0), 1.0)
    return np.where(
        share <= FROM_BEHIND, FRONT, np.where(share >= 1.0 - FROM_BEHIND, BACK, BOTH)
    ).astype(np.float64)


def _counts(group: NDArray[np.int64], of: NDArray[np.int64], *views: Array) -> Array:
    """Sums (k, m) of the views (n,) of the points on faces ``of`` (n,) over the group (m,) of each
    face.
    """
    return np.stack([np.bincount(group[of], each, int(group.max()) + 1)[group] for each in views])


class VisibleCentroids:
    """Centroid of the part of a model that a distant camera sees, tabulated for ``count``
    directions.
    """

    def __init__(self, points: Array, normals: Array, extent_m: float, count: int = 80) -> None:
        """Build it from points sampled on the surface, (n, 3) in {C} [m]; zero normals: visible
        from all sides.

        The centroid is that of the points that face the camera and are the nearest of their pixel,
        within a cell.
        """
        self._directions, cell = directions(count), CENTROID_CELL * extent_m
        cosine = normals @ self._directions.T if normals.any() else np.ones((len(points), count))
        depth = points @ self._directions.T
        u = np.cross(self._directions, np.eye(3)[np.argmin(np.abs(self._directions), axis=1)])
        u /= np.linalg.norm(u, axis=1)[:, None]
        x, y = (
            np.floor(points @ axes.T / cell).astype(np.int64)
            for axes in (u, np.cross(self._directions, u))
        )
        x, y = x - x.min(axis=0), y - y.min(axis=0)
        wide, high = int(x.max()) + 1, int(y.max()) + 1
        pixel = (x + wide * y) + wide * high * np.arange(count)
        nearest = np.full(count * wide * high, -np.inf)
        facing = cosine > LEAST_INCIDENCE
        np.maximum.at(nearest, pixel[facing], depth[facing])
        weight = np.where(facing & (depth > nearest[pixel] - cell), cosine, 0.0)
        total = weight.sum(axis=0)
        seen = total > 0.0
        self._centroids = np.where(
            seen[:, None],
            np.einsum("nk,nj->kj", weight, points) / np.where(seen, total, 1.0)[:, None],
            points.mean(axis=0),
        )

    def of(self, direction_c: Array) -> Array:
        """Return the centroid (..., 3) in {C} [m] for directions (..., 3) to the camera in {C}."""
        centroid: Array = self._centroids[np.argmax(direction_c @ self._directions.T, axis=-1)]
        return centroid
