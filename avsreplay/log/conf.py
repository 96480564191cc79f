"""Stanford's ``.conf``: a ``bmesh`` line a scan, ``name tx ty tz qx qy qz qw``.

The quaternion is conjugate to the usual reading: ``p_model = R(q)' p_scan + t``; the pose of the model in the scan's
frame is T_ac = (R(q), -R(q) t).
"""

from __future__ import annotations

import math
from pathlib import Path

from avsreplay.errors import UnreadableInput
from avsreplay.geometry import Pose, matrix, normalise
from avsreplay.log.text import shown

__all__ = ["read_conf"]

_MAX_BYTES = 16 << 20


def read_conf(path: Path) -> dict[str, Pose]:
    """T_ac of each scan by file name. Raises UnreadableInput for a line that cannot be read."""
    try:
        raw = path.read_bytes()[: _MAX_BYTES + 1]
    except OSError as error:
        raise UnreadableInput(error.strerror or "cannot be read", where=shown(path), hint="check the path") from None
    if len(raw) > _MAX_BYTES:
        raise UnreadableInput("larger than 16 MiB, not a pose file", where=shown(path), hint="check the file")
    poses: dict[str, Pose] = {}
    for number, line in enumerate(raw.decode("utf-8", "backslashreplace").splitlines(), 1):
        words = line.split()
        if words[:1] == ["bmesh"]:
            poses[words[1] if len(words) > 1 else ""] = _pose(words, f"{shown(path)}:{number}")
    return poses


def _pose(words: list[str], where: str) -> Pose:
    try:
        values = [float(w) for w in words[2:9]]
    except ValueError:
        values = []
    if len(values) != 7 or not all(map(math.isfinite, values)) or math.hypot(*values[3:]) < 0.5:
        hint = "write: bmesh name tx ty tz qx qy qz qw"
        raise UnreadableInput("not a bmesh line", where=where, hint=hint)
    q_ac = normalise(values[3:])
    return Pose(q_ac, -matrix(q_ac) @ values[:3])
