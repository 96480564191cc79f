"""Contact of the end-effector with the body, always by the model of the target.

The end-effector is a ball about its centre. At the grasp point the gripper encloses what is
narrower than its opening: there, in a cylinder about the axis of the approach, the last part of the
path is no contact if it was entered through the mouth of the cylinder.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array

ENTRY = 0.5  # least share of the length of the cylinder at which it may be entered


@value_class
class Contact:
    """Contact with the body outside the grasp.

    Attributes:
        closest: points (n, 3) from the grasp point in {C} -> closest points and signed distances.
        axis_c: (3,) outward axis of the approach, unit.
        radius_m: of the end-effector.
        half_m: half of the gripper's opening.
        mouth_m: distance along the axis at which the part that the gripper encloses ends.
    """

    closest: Callable[[Array], tuple[Array, Array]]
    axis_c: Array
    radius_m: float
    half_m: float
    mouth_m: float

    def distances(self, y: Array) -> Array:
        """Return the distance (...,) of the end-effector's surface to the body [m].

        Args:
            y: (..., 3) positions of its centre from the grasp point in {C} [m].
        """
        gap = self.closest(np.ascontiguousarray(y.reshape(-1, 3)))[1]
        return np.asarray(gap.reshape(y.shape[:-1]) - self.radius_m)

    def touched(self, y: Array) -> NDArray[np.bool_]:
        """Return for each path (m,) whether the end-effector touches the body outside the grasp.

        Args:
            y: (m, n, 3) positions from the grasp point in {C} [m], in the order of time.
        """
        if not y.shape[1]:
            return np.zeros(len(y), dtype=bool)
        return np.asarray(((self.distances(y) < 0.0) & ~self.enclosed(y)).any(axis=1))

    def enclosed(self, y: Array) -> NDArray[np.bool_]:
        """Return (m, n): whether a position belongs to the last part of a path, inside the
        cylinder of the grasp.

        Args:
            y: (m, n, 3) positions from the grasp point in {C} [m], in the order of time.
        """
        along = y @ self.axis_c
        across = np.linalg.norm(y - along[..., None] * self.axis_c, axis=-1)
        most = self.mouth_m + self.radius_m + self.half_m
        inside = (across <= self.half_m + self.radius_m) & (along >= -self.half_m) & (along <= most)
        last = np.logical_and.accumulate(inside[:, ::-1], axis=1)[:, ::-1]
        first = np.argmax(last, axis=1)
        entry = np.take_along_axis(along, first[:, None], axis=1)[:, 0]
        return np.asarray(last & (entry >= ENTRY * self.mouth_m)[:, None])
