"""Contact of the end-effector with the body, always by the model of the target.

The end-effector is a ball about its centre. At the grasp point the gripper encloses what is
narrower than its opening: there, in a cylinder about the axis of the approach, a part of the path
is no contact if it enters the cylinder through its mouth, and leaves it through its mouth if it
leaves it.
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
        """Return (m, n): whether the gripper encloses the body there: a position inside the
        cylinder of the grasp, on a part of the path that enters it, and leaves it if it does,
        through its mouth.

        Args:
            y: (m, n, 3) positions from the grasp point in {C} [m], in the order of time.
        """
        along = y @ self.axis_c
        across = np.linalg.norm(y - along[..., None] * self.axis_c, axis=-1)
        most = self.mouth_m + self.radius_m + self.half_m
        inside = (across <= self.half_m + self.radius_m) & (along >= -self.half_m) & (along <= most)
        past_mouth = along >= ENTRY * self.mouth_m
        entered = _at_first_of_runs(inside, past_mouth)
        at_end = past_mouth.copy()
        at_end[:, -1:] = True  # the path ends there
        left = _at_first_of_runs(inside[:, ::-1], at_end[:, ::-1])[:, ::-1]
        return np.asarray(inside & entered & left)


def _at_first_of_runs(inside: NDArray[np.bool_], flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (m, n): for each position inside, the flag of the first one of its run; the value
    outside has no meaning.
    """
    columns = np.arange(inside.shape[1])
    begins = inside.copy()
    begins[:, 1:] &= ~inside[:, :-1]
    first = np.maximum.accumulate(np.where(begins, columns, 0), axis=1)
    return np.take_along_axis(flags, first, axis=1)
