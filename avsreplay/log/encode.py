"""The messages a log holds, as little-endian CDR."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Pose
from avsreplay.log.cursor import Packer
from avsreplay.records import Label, State

__all__ = ["diagnostic", "odometry", "point_cloud2", "pose_stamped", "static_transform"]

_DATATYPE = {"float32": 7, "float64": 8}


def point_cloud2(
    t_ns: int, frame: str, points: NDArray[Any], times_s: NDArray[Any] | None, point_type: str = "float32"
) -> bytes:
    """A cloud of (n, 3) points [m] with, where given, the field ``t``: (n,) float32 [s] after the stamp."""
    names = ["x", "y", "z"]
    formats = [f"<f{4 if point_type == 'float32' else 8}"] * 3
    if times_s is not None:
        names, formats = [*names, "t"], [*formats, "<f4"]
    table = np.empty(len(points), dtype={"names": names, "formats": formats})
    for axis, name in enumerate("xyz"):
        table[name] = points[:, axis]
    if times_s is not None:
        table["t"] = times_s
    packer = Packer().header(t_ns, frame).u32(1).u32(len(points)).u32(len(names))
    for name in names:
        offset = int(table.dtype.fields[name][1]) if table.dtype.fields else 0
        kind = 7 if name == "t" else _DATATYPE[point_type]
        packer.string(name).u32(offset).u8(kind).u32(1)
    step = table.dtype.itemsize
    return packer.u8(0).u32(step).u32(step * len(points)).octets(table.tobytes()).u8(1).bytes()


def pose_stamped(t_ns: int, frame: str, pose: Pose) -> bytes:
    """A geometry_msgs PoseStamped."""
    return Packer().header(t_ns, frame).f64s(*pose.t, *pose.q).bytes()


def odometry(t_ns: int, frame: str, child: str, body: State) -> bytes:
    """A nav_msgs Odometry: the pose of {B} in {A}, the twist in {B} as ROS has it."""
    v_b = geometry.rotate(geometry.matrix(body.q_ab).T, body.v_a)
    zeros = (0.0,) * 36
    packer = Packer().header(t_ns, frame).string(child).f64s(*body.r_a, *body.q_ab, *zeros)
    return packer.f64s(*v_b, *body.w_b, *zeros).bytes()


def static_transform(t_ns: int, parent: str, child: str) -> bytes:
    """A tf2_msgs TFMessage with one identity transform, so that a viewer finds the cloud's frame."""
    packer = Packer().u32(1).header(t_ns, parent).string(child)
    return packer.f64s(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0).bytes()


def diagnostic(t_ns: int, label: Label, begins: bool) -> bytes:
    """A diagnostic_msgs DiagnosticArray saying that an injected fault begins (WARN) or ends (OK)."""
    message = "injected fault begins" if begins else "injected fault ends"
    values = {"start_ns": label.start_ns, "end_ns": label.end_ns, "harmful": label.harmful, "strength": label.strength}
    packer = Packer().header(t_ns, "").u32(1).u8(1 if begins else 0)
    packer.string(label.kind).string(message).string("").u32(len(values))
    for key, value in values.items():
        packer.string(key).string(str(value))
    return packer.bytes()
