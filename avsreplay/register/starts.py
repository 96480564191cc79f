"""Where an acquisition may begin: attitudes spread evenly, and the middle of what each side of a model shows."""

from __future__ import annotations

import numpy as np

from avsreplay.geometry import Array

__all__ = ["VisibleCentres", "attitudes", "directions"]

PSI = 1.533751168755204288118041  # the positive root of psi^4 = psi + 4 (super-Fibonacci spirals)
CELL_OF_EXTENT = 0.02
LEAST_COSINE = 0.05


def attitudes(count: int) -> Array:
    """(count, 4) unit quaternions [x y z w], a super-Fibonacci spiral (Alexa 2022): even over all rotations."""
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    a, b = 2.0 * np.pi * s / np.sqrt(2.0), 2.0 * np.pi * s / PSI
    return np.stack([inner * np.sin(a), inner * np.cos(a), outer * np.sin(b), outer * np.cos(b)], axis=1)


def directions(count: int) -> Array:
    """(count, 3) unit vectors, a Fibonacci spiral: even over the sphere."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


class VisibleCentres:
    """The centroid of what a far camera sees of a model, for any direction: looked up among ``count`` of them."""

    def __init__(self, points: Array, normals: Array, extent_m: float, count: int = 200) -> None:
        """From points drawn evenly over the surface, (n, 3) in {C} [m]; zero normals: a cloud, seen from all round."""
        self._directions = directions(count)
        cell = CELL_OF_EXTENT * extent_m
        self._centres = np.stack([_visible_centre(points, normals, u, cell) for u in self._directions])

    def of(self, towards_camera_c: Array) -> Array:
        """(3,) [m] for the direction to the camera in {C}."""
        centre: Array = self._centres[int(np.argmax(self._directions @ towards_camera_c))]
        return centre


def _visible_centre(points: Array, normals: Array, towards: Array, cell_m: float) -> Array:
    """Centroid over the image of the camera-facing points that are the nearest of their pixel, to within a cell."""
    sided = normals.any()
    cosine = normals @ towards if sided else np.ones(len(points))
    facing = cosine > LEAST_COSINE
    p, weight, depth = points[facing], cosine[facing], points[facing] @ towards
    across = np.linalg.svd(towards[None])[2][1:]
    pixels = np.floor(p @ across.T / cell_m).astype(np.int64)
    _, pixel = np.unique(pixels, axis=0, return_inverse=True)
    nearest = np.full(pixel.max(initial=-1) + 1, -np.inf)
    np.maximum.at(nearest, pixel.reshape(-1), depth)
    weight = weight * (depth > nearest[pixel.reshape(-1)] - cell_m)
    if not weight.sum() > 0.0:
        return np.asarray(points.mean(axis=0))
    return np.asarray((p * weight[:, None]).sum(axis=0) / weight.sum())
