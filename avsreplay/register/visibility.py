"""Which faces of a model the camera can have measured, and the alignments that follow from it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import mesh
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Fit, Surface
from avsreplay.register.params import Camera
from avsreplay.register.surface_index import SurfaceIndex

CLEARANCE_OF_EXTENT = 0.25
LEAST_FACING = 0.4
LEAST_SEEN, NEAR_FACE_OF_EXTENT = 0.85, 0.01  # share of points so near to a face towards a camera close to the model
FAR_OF_EXTENT = 0.6  # if the median of a scan is this far from the origin, the camera was at the origin
TESTED_POINTS = 200


class Visibility:
    """The facing test for one surface: which faces the camera can have measured, those that face it.

    Without this test a scan point of a thin panel can be matched to the wrong side. If the guess is off by half the
    thickness of the panel, the measured front is next to the back of the model, and plain ICP converges there: on the
    built-in target, started 3 deg and 5 cm off, in every third view.

    AUTO applies it if the mesh has a closed part and encloses a positive volume. If fewer than 40 % of the closest
    faces of the scan face the origin of {A}, the camera was elsewhere and both sides are matched. Nearer to the
    bounding box than a quarter of the extent, 85 % of the points must also be near a face that faces the origin.

    Attributes:
        sided: the faces of this surface have a known outer side.
        surface: the surface; where it is sided, with the other side of each face that belongs to an open part.
    """

    def __init__(self, surface: Surface, camera: Camera = Camera.AUTO) -> None:
        low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
        clear = CLEARANCE_OF_EXTENT * surface.extent if camera is Camera.AUTO else -np.inf
        self._sides, self._clear = list(zip(low.tolist(), high.tolist(), strict=True)), clear
        self._extent, self._known = surface.extent, camera is not Camera.NONE
        self.sided, self.surface = False, surface
        if camera is Camera.NONE:
            return
        opened = mesh.open_faces(surface.vertices, surface.faces)
        outward = not opened.all() and mesh.signed_volume(surface.vertices, surface.faces) > 0.0
        self.sided = camera is Camera.ORIGIN or outward
        if self.sided and opened.any():
            both = np.concatenate([surface.faces, surface.faces[opened][:, ::-1]])
            self.surface = replace(surface, faces=np.ascontiguousarray(both))

    def camera_c(self, index: SurfaceIndex, points: NDArray[Any], T_ca: Pose) -> Array | None:
        """Return the camera position (3,) in {C} [m] if the test applies to this scan (n, 3) and pose, else None."""
        faces = self.faced(index, points, T_ca) and index.faces_camera(points, T_ca, TESTED_POINTS, LEAST_FACING)
        return T_ca.t if faces else None

    def distances(self, index: SurfaceIndex, points: NDArray[Any], T_ca: Pose, most_m: float) -> tuple[Array, int]:
        """Return the distances (n,) [m] of a scan to the faces that the camera sees, at most ``most_m``; the work."""
        return index.distances(points, T_ca, most_m, self.faced(index, points, T_ca), TESTED_POINTS, LEAST_FACING)

    def may_be_camera(self, T_ca: Pose) -> bool:
        """Return whether the outer sides are known, and the origin of {A} is clear of the bounding box of the model."""
        outside = [max(a - x, x - b, 0.0) for x, (a, b) in zip(T_ca.t.tolist(), self._sides, strict=True)]
        return self.sided and math.hypot(*outside) >= self._clear

    def faced(self, index: SurfaceIndex, points: NDArray[Any], T_ca: Pose) -> bool:
        """Return whether the test can apply to a scan (n, 3): ``may_be_camera``, or nearly all its faces are seen."""
        if not self.sided or self.may_be_camera(T_ca):
            return self.sided
        few, near = T_ca.apply(points[:: max(1, len(points) // TESTED_POINTS)]), NEAR_FACE_OF_EXTENT * self._extent
        every, seen = (np.sqrt(index.closest(few, camera_c=eye).d2) for eye in (None, T_ca.t))
        on = every < index.reach_m
        return int(np.count_nonzero(seen[on] < every[on] + near)) >= LEAST_SEEN * max(1, int(np.count_nonzero(on)))

    def consistent(
        self, index: SurfaceIndex, points: NDArray[Any], guess: Pose, align: Callable[[Pose, bool], Fit]
    ) -> Fit:
        """Return an alignment that begins at the guess and whose choice of faces holds at its result.

        Clear of the model the guess decides. Next to it the test depends on the pose, and a guess a few degrees off
        can fail it although the camera is at the origin; without it a thin part is matched to both of its sides, and
        the wrong pose fails it as well. There the test is assumed first. If it does not hold at the result, the scan is
        aligned without it, and from the result of that with it, if it holds there.

        Args:
            index: of the surface.
            points: (n, 3) in {A} [m].
            guess: T_ca to begin with.
            align: aligns the scan from a T_ca, with or without the faces that face away from the camera left out.

        Returns:
            The result, with the passes and the work of all alignments made, three at most.
        """
        if not self.sided or self.may_be_camera(guess):
            return align(guess, self.camera_c(index, points, guess) is not None)
        made = [align(guess, True)]
        if self.camera_c(index, points, made[0].T_ca) is None:
            made.append(align(guess, False))
            if self.camera_c(index, points, made[1].T_ca) is not None:
                made.append(align(made[1].T_ca, True))
        return replace(made[-1], iterations=sum(fit.iterations for fit in made), work=sum(fit.work for fit in made))

    def direction_to_camera(self, points: NDArray[Any]) -> Array | None:
        """Return the unit direction (3,) from a scan (n, 3) in {A} to the origin; None if the camera is not there."""
        centre = np.median(points, axis=0).astype(np.float64)
        distance = float(np.linalg.norm(centre))
        if not self._known or distance < FAR_OF_EXTENT * self._extent:
            return None
        return frozen(-centre / distance)
