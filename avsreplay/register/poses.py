"""When two poses of one model are the same."""

from __future__ import annotations

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Surface
from avsreplay.register.surface_index import kernel_module

# Poses that differ by less are the same: rotation, and displacement of the middle of the model over
# its extent. A larger value hides a second pose that explains a scan; a smaller one takes two
# registrations that end beside each other for two poses.
SAME_RAD = np.radians(10.0)
SAME_OF_EXTENT = 0.05
# Share of these, within which two registrations have ended at one minimum: 2 deg, 0.01 extents.
ONE_MINIMUM = 0.2


class Sameness:
    """Compares poses T_ca of one model.

    Attributes:
        same_rad: rotation below which two poses nearly at one place are the same; less than
            ``SAME_RAD`` for a model with teeth, which turns by less onto itself.
    """

    def __init__(self, surface: Surface) -> None:
        vertices = surface.vertices
        self._middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        self._extent, self.same_rad = surface.extent, float(SAME_RAD)

    def same(self, first: Pose, other: Pose, scale: float = 1.0) -> bool:
        """Return whether two poses are the same.

        Args:
            first: a pose T_ca.
            other: a pose T_ca.
            scale: factor on the differences that are allowed; below 1 of ``SAME_RAD``.
        """
        step = first @ other.inverse()  # in {C}
        near = self.shift(step) < scale * SAME_OF_EXTENT * self._extent
        rad = self.same_rad if scale >= 1.0 else scale * SAME_RAD
        return near and float(geometry.angle(step.q)) < rad

    def among(self, pose: Pose, others: list[Pose]) -> bool:
        """Return whether a pose is the same as one of others."""
        return any(self.same(pose, each) for each in others)

    def different(self, poses: Array, most: int, scale: float) -> Array:
        """Return the first few of poses (k, 4, 4) that are different, in their order; ``scale``: as
        of ``same``, about ``SAME_RAD``.
        """
        trace, near = 1.0 + 2.0 * np.cos(scale * SAME_RAD), scale * SAME_OF_EXTENT * self._extent
        return np.ascontiguousarray(
            poses[kernel_module().different(poses, self._middle, most, trace, near)]
        )

    def shift(self, step: Pose) -> float:
        """Return by how much a motion in {C} moves the middle of the model [m]."""
        return float(np.linalg.norm(step.apply(self._middle) - self._middle))
