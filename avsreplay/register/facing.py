"""Which matches the camera can have made: a point it measured lies on a side of the model that faces it.

Without this a thin panel has two sides to fall on. A guess off by half its thickness puts the measured front next to
the model's back, and plain ICP settles there: on the built-in target begun 3 deg and 5 cm off, on every third view.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array, Pose
from avsreplay.records import Surface
from avsreplay.register.surface_index import SurfaceIndex

__all__ = ["Camera", "View", "is_outward"]

CLEARANCE_OF_EXTENT = 0.25
LEAST_FACING = 0.4
PAIRED_EDGES = 0.95
FAR_OF_EXTENT = 0.6  # a scan's middle this far from the origin was taken from there
ASKED_POINTS = 500


class Camera(Enum):
    """Where the scans were taken from."""

    AUTO = "auto"  # {A}'s origin, where the model says which side is out and the origin is well clear of it
    ORIGIN = "origin"  # {A}'s origin
    NONE = "none"  # not known: both sides of a face count


class View:
    """The facing test for one surface.

    AUTO applies it where the mesh is closed and wound outwards (19 of 20 edges paired, volume positive) and the origin
    of {A} is a quarter of the extent or more outside the model's box. Where under 40 % of the scan's plain closest
    faces look at the origin, the camera is taken to have been elsewhere and both sides count.
    """

    def __init__(self, surface: Surface, camera: Camera = Camera.AUTO) -> None:
        low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
        clear = CLEARANCE_OF_EXTENT * surface.extent if camera is Camera.AUTO else -np.inf
        self._box = (low, high, clear)
        self._extent = surface.extent
        self.sided = camera is Camera.ORIGIN or (camera is Camera.AUTO and is_outward(surface))

    def camera_c(self, model: SurfaceIndex, points: NDArray[Any], T_ca: Pose) -> Array | None:
        """(3,) the camera in {C} [m] where the test applies to this scan (n, 3) in {A} at this pose, else None."""
        if not (self.sided and self._clear(T_ca.t)):
            return None
        few = points[:: max(1, len(points) // ASKED_POINTS)]
        found = model.closest(T_ca.apply(few))
        foot = found.id >= 0
        faces = np.einsum("ij,ij->i", found.normal[foot], T_ca.t - found.foot[foot]) > 0.0
        return T_ca.t if faces.sum() >= LEAST_FACING * foot.sum() else None

    def sight(self, points: NDArray[Any]) -> Array | None:
        """(3,) unit direction from a scan (n, 3) in {A} to the camera; None where the camera's place is not known."""
        centre = np.median(points, axis=0).astype(np.float64)
        distance = float(np.linalg.norm(centre))
        if not self.sided or distance < FAR_OF_EXTENT * self._extent:
            return None
        towards: Array = -centre / distance
        return towards

    def _clear(self, camera_c: Array) -> bool:
        low, high, clear = self._box
        outside = np.maximum(np.maximum(low - camera_c, camera_c - high), 0.0)
        return float(np.linalg.norm(outside)) >= clear


def is_outward(surface: Surface) -> bool:
    """Is the mesh closed and wound outwards? Vertices at the same place count as one, so a triangle soup may be."""
    if len(surface.faces) == 0:
        return False
    _, merged = np.unique(surface.vertices, axis=0, return_inverse=True)
    faces = merged.reshape(-1)[surface.faces].astype(np.int64)
    start, end = faces[:, (0, 1, 2)].ravel(), faces[:, (1, 2, 0)].ravel()
    forward, back = np.sort(start * (merged.max() + 1) + end), end * (merged.max() + 1) + start
    paired = np.searchsorted(forward, back, side="right") - np.searchsorted(forward, back, side="left") == 1
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    return float(paired.mean()) >= PAIRED_EDGES and float(np.einsum("ij,ij->", a, np.cross(b, c))) > 0.0
