"""Which faces of the model the camera can have measured: those that face it.

Without this test a scan point of a thin panel can be matched to the wrong side. If the guess is off by half the
thickness of the panel, the measured front is next to the back of the model, and plain ICP converges there: on the
built-in target, started 3 deg and 5 cm off, in every third view.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array, Pose
from avsreplay.records import Surface
from avsreplay.register.surface_index import SurfaceIndex

CLEARANCE_OF_EXTENT = 0.25
LEAST_FACING = 0.4
PAIRED_EDGES = 0.95
FAR_OF_EXTENT = 0.6  # if the median of a scan is this far from the origin, the camera was at the origin
TESTED_POINTS = 200


class Camera(Enum):
    """Where the scans were taken from."""

    AUTO = "auto"  # origin of {A}, if the mesh has outward faces and the origin is well outside the model
    ORIGIN = "origin"  # origin of {A}
    NONE = "none"  # unknown: both sides of a face are matched


class Visibility:
    """The facing test for one surface.

    AUTO applies it if the mesh is closed with outward faces (19 of 20 edges used as often in one
    direction as in the other, positive volume) and the origin of
    {A} is at least a quarter of the extent outside the bounding box of the model. If fewer than 40 % of the closest
    faces of the scan face the origin, the camera was elsewhere and both sides are matched.

    Attributes:
        sided: the faces of this surface have a known outer side.
    """

    def __init__(self, surface: Surface, camera: Camera = Camera.AUTO) -> None:
        low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
        clear = CLEARANCE_OF_EXTENT * surface.extent if camera is Camera.AUTO else -np.inf
        self._box = (low, high, clear)
        self._extent, self._known = surface.extent, camera is not Camera.NONE
        self.sided = camera is Camera.ORIGIN or (camera is Camera.AUTO and is_outward(surface))

    def camera_c(self, index: SurfaceIndex, points: NDArray[Any], T_ca: Pose) -> Array | None:
        """Return the camera position (3,) in {C} [m] if the test applies to this scan (n, 3) and pose, else None."""
        if not self.may_be_camera(T_ca):
            return None
        matched, facing = index.looks(points, T_ca, max(1, len(points) // TESTED_POINTS))
        return T_ca.t if facing >= LEAST_FACING * matched else None

    def may_be_camera(self, T_ca: Pose) -> bool:
        """Return whether the test can apply: the outer sides are known, and the origin of {A} is clear of the model."""
        return self.sided and self._clear(T_ca.t)

    def direction_to_camera(self, points: NDArray[Any]) -> Array | None:
        """Return the unit direction (3,) from a scan (n, 3) in {A} to the origin; None if the camera is not there."""
        centre = np.median(points, axis=0).astype(np.float64)
        distance = float(np.linalg.norm(centre))
        if not self._known or distance < FAR_OF_EXTENT * self._extent:
            return None
        direction: Array = -centre / distance
        return direction

    def _clear(self, camera_c: Array) -> bool:
        low, high, clear = self._box
        outside = np.maximum(np.maximum(low - camera_c, camera_c - high), 0.0)
        return float(np.linalg.norm(outside)) >= clear


def is_outward(surface: Surface) -> bool:
    """Test whether the mesh is closed with outward faces. Vertices at the same position are merged first."""
    if len(surface.faces) == 0:
        return False
    _, merged = np.unique(surface.vertices, axis=0, return_inverse=True)
    faces = merged.reshape(-1)[surface.faces].astype(np.int64)
    start, end = faces[:, (0, 1, 2)].ravel(), faces[:, (1, 2, 0)].ravel()
    there, back = start * (merged.max() + 1) + end, end * (merged.max() + 1) + start
    ordered = np.sort(there)
    uses, opposite = (
        np.searchsorted(ordered, edge, side="right") - np.searchsorted(ordered, edge, side="left")
        for edge in (there, back)
    )
    paired = uses == opposite  # more than one where surfaces touch at an edge
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    return float(paired.mean()) >= PAIRED_EDGES and float(np.einsum("ij,ij->", a, np.cross(b, c))) > 0.0
