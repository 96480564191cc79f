"""What a channel holds whose definition is lost, told by the bytes of its first message.

A definition stands in the first chunk and again in the summary; a recording that was killed and then damaged at its
begin has lost both. Clouds show themselves by their fields; truth only in a log of our own writing, where a message of
just that length can be nothing else.
"""

from __future__ import annotations

from avsreplay.log.cursor import BadMessage, Cursor
from avsreplay.log.mcap_records import Channel
from avsreplay.log.point_cloud2 import read_layout
from avsreplay.log.poses import read_pose
from avsreplay.log.writer import BODY_TOPIC, LIBRARY, TRUTH_TOPIC

__all__ = ["guess_channel"]

_POSE, _ODOMETRY = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry"


def guess_channel(number: int, payload: memoryview, library: str) -> Channel | None:
    """The channel a message seems to be of, None where nothing tells."""
    if _is_cloud(payload):
        return Channel(number, f"/lost/channel_{number}", "sensor_msgs/msg/PointCloud2", "cdr")
    if library == LIBRARY and _is_whole(_POSE, payload, 7):
        return Channel(number, TRUTH_TOPIC, _POSE, "cdr")
    if library == LIBRARY and _is_whole(_ODOMETRY, payload, 7 + 36 + 6 + 36):
        return Channel(number, BODY_TOPIC, _ODOMETRY, "cdr")
    return None


def _is_cloud(payload: memoryview) -> bool:
    try:
        layout = read_layout(payload)
    except BadMessage:
        return False
    return {"x", "y", "z"} <= {field.name for field in layout.fields}


def _is_whole(kind: str, payload: memoryview, doubles: int) -> bool:
    """Does the message read as ``kind`` and end where that type ends?"""
    try:
        read_pose(kind, payload)
        cursor = Cursor(payload)
        cursor.header()
        if kind == _ODOMETRY:
            cursor.string()
        cursor.f64s(doubles)
    except BadMessage:
        return False
    return cursor.pos == len(cursor.data)
