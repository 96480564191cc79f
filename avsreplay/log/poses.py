"""Pose messages: PoseStamped, PoseWithCovarianceStamped, Odometry, TransformStamped and TFMessage."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from avsreplay.log.cursor import BadMessage, Cursor

__all__ = ["POSE_TYPES", "Transform", "checked", "read_pose", "read_transforms"]

_MAX_TRANSFORMS = 4096


@dataclass(frozen=True, slots=True)
class Transform:
    """A stamped pose of ``child`` in ``parent``: seven numbers x y z qx qy qz qw, and a twist where there is one."""

    t_ns: int
    parent: str
    child: str
    pose: tuple[float, ...]
    twist: tuple[float, ...] | None = None


def read_pose(kind: str, payload: bytes | memoryview, encoding: str = "cdr") -> Transform:
    """A pose of one of ``POSE_TYPES``. Raises BadMessage where it is cut, not finite, or no unit quaternion."""
    return checked(POSE_TYPES[kind](Cursor(payload, encoding)))


def checked(out: Transform) -> Transform:
    """The transform itself. Raises BadMessage where it is not finite or its quaternion not of unit length."""
    if not all(map(math.isfinite, out.pose)) or not 0.5 < math.hypot(*out.pose[3:]) < 2.0:
        raise BadMessage("a pose that is no pose")
    return out


def read_transforms(payload: bytes | memoryview, encoding: str = "cdr") -> list[Transform]:
    """The transforms of a TFMessage. Raises BadMessage."""
    cursor = Cursor(payload, encoding)
    count = cursor.u32()
    if count > _MAX_TRANSFORMS:
        raise BadMessage(f"{count} transforms in one message")
    return [_transform(cursor) for _ in range(count)]


def _pose(cursor: Cursor) -> Transform:
    t_ns, frame = cursor.header()
    return Transform(t_ns, frame, "", cursor.f64s(7))


def _odometry(cursor: Cursor) -> Transform:
    t_ns, frame = cursor.header()
    child = cursor.string()
    pose = cursor.f64s(7)
    cursor.f64s(36)
    return Transform(t_ns, frame, child, pose, cursor.f64s(6))


def _transform(cursor: Cursor) -> Transform:
    t_ns, frame = cursor.header()
    child = cursor.string()
    return Transform(t_ns, frame, child, cursor.f64s(7))


POSE_TYPES: dict[str, Callable[[Cursor], Transform]] = {
    "geometry_msgs/msg/PoseStamped": _pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose,
    "nav_msgs/msg/Odometry": _odometry,
    "geometry_msgs/msg/TransformStamped": _transform,
}
