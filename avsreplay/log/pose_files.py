"""Pose files: TUM, KITTI, EuRoC, CSV with a header, and the ``.conf`` of the Stanford scans; each
pose is T_ac.

TUM: ``t tx ty tz qx qy qz qw`` with t in seconds.  KITTI: the twelve numbers of [R | t] by row,
without times. EuRoC: ``t[ns],px,py,pz,qw,qx,qy,qz,...``, scalar first.  ``.conf``: ``bmesh name tx
ty tz qx qy qz qw`` where the quaternion is conjugate to the usual convention, p_model = R(q)'
p_scan + t, so that T_ac = (R(q), -R(q) t).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from avsreplay.binary_files import read_limited
from avsreplay.errors import UnreadableInput, value_class
from avsreplay.geometry import MeasuredPose, Pose, matrix, normalise
from avsreplay.log.bytes_io import BadMessage, shown
from avsreplay.log.pose_messages import pose_of_numbers
from avsreplay.records import MAX_STAMP_S, NS_PER_S

_MAX_POSE_FILE_BYTES = 256 << 20
_MAX_METRES = 1e9


def read_times(path: Path) -> list[int]:
    """Read a file with one time [s] per line; return [ns].

    Raises UnreadableInput with file and line.
    """
    out = []
    for where, words, _ in _lines(path):
        t_ns = seconds_to_ns(words[0])
        if t_ns is None:
            raise UnreadableInput("not a time in seconds", where=where, hint="one number a line")
        out.append(t_ns)
    return out


def seconds_to_ns(text: str) -> int | None:
    """Convert decimal seconds to nanoseconds without rounding to a binary fraction; None if
    it is not a number.
    """
    try:
        value = Decimal(text)
        return int((value * NS_PER_S).to_integral_value()) if abs(value) < MAX_STAMP_S else None
    except (InvalidOperation, ValueError):
        return None


def _whole_ns(word: str) -> int:
    """A time in whole nanoseconds.

    Raises ValueError where it is none, or is beyond what 64 bits can hold.
    """
    t_ns = int(word)
    if abs(t_ns) >= MAX_STAMP_S * NS_PER_S:
        raise ValueError
    return t_ns


def _lines(path: Path) -> Iterator[tuple[str, list[str], bool]]:
    """Yield (file and line, words, whether "," or ";" separates them) of each line that is not
    empty or a comment.
    """
    raw = read_limited(path, _MAX_POSE_FILE_BYTES, "name a file of poses", pipe=True)
    code = "utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    text = raw.decode(code, "backslashreplace")
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            mark = next((mark for mark in ";,\t" if mark in stripped), None)
            words = [word.strip() for word in line.split(mark)]
            if mark == ";":  # the comma is then the decimal point
                words = [word.replace(",", ".") for word in words]
            yield f"{shown(path)}:{number}", words, mark in (";", ",")


def _from_rows(values: list[float]) -> Pose:
    T = np.vstack([np.array(values).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    R = T[:3, :3]
    if (
        not (np.abs(T) < _MAX_METRES).all()
        or np.abs(R @ R.T - np.eye(3)).max() > 1e-2
        or np.linalg.det(R) < 0
    ):
        raise ValueError
    return Pose.from_matrix(T)


_MAX_CONF_BYTES = 16 << 20


def read_conf(path: Path) -> dict[str, Pose]:
    """Read a ``.conf`` file: T_ac of each scan by file name.

    Raises UnreadableInput with file and line.
    """
    raw = read_limited(path, _MAX_CONF_BYTES, "name a file of poses", pipe=True)
    poses: dict[str, Pose] = {}
    for number, line in enumerate(raw.decode("utf-8", "backslashreplace").splitlines(), 1):
        words = line.split()
        if words[:1] == ["bmesh"]:
            poses[words[1] if len(words) > 1 else ""] = _bmesh_pose(
                words, f"{shown(path)}:{number}"
            )
    return poses


def _bmesh_pose(words: list[str], where: str) -> Pose:
    try:
        values = [float(w) for w in words[2:9]]
    except ValueError:
        values = []
    if (
        len(values) != 7
        or not all(abs(v) < _MAX_METRES for v in values)
        or math.hypot(*values[3:]) < 0.5
    ):
        hint = "write: bmesh name tx ty tz qx qy qz qw"
        raise UnreadableInput("not a bmesh line", where=where, hint=hint)
    q_ac = normalise(values[3:])
    return Pose(q_ac, -matrix(q_ac) @ values[:3])


@value_class(eq=True)
class TimedPoses:
    """The poses of a file, in its order.

    Attributes:
        poses: the pose of each line, or the text that says why it has none.
        t_ns: times [ns], None where the format has no times.
    """

    poses: tuple[MeasuredPose | str, ...]
    t_ns: tuple[int, ...] | None


_NOT_A_NAME = re.compile(r"[^a-z0-9]+")
_TIME_HEADING = re.compile(
    r"(?:t|time|timestamp|stamp|secs?|seconds)(?:_?(s|sec|ms|msec|us|usec|ns|nsec))?$"
)
_POSITION = re.compile(r"(?:p|t|pos|position|translation)?_?([xyz])(?:_?(m|cm|mm))?$")
_QUATERNION_HEADING = re.compile(r"(?:q|quat|quaternion|orientation|rot|rotation)_?([xyzw])$")
_EXPONENTS = {"m": "e-3", "u": "e-6", "n": "e-9"}  # by the first letter of a unit of time
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_POSE_NAMES = ("px", "py", "pz", "qx", "qy", "qz", "qw")
_FORMATS_HELP = (
    "TUM: t tx ty tz qx qy qz qw; KITTI: twelve numbers; EuRoC: t[ns],x,y,z,qw,qx,qy,qz;"
    " CSV with a header: t_s (or t_ms, t_ns), x, y, z, qx, qy, qz, qw in any order"
)


def read_poses(path: Path) -> TimedPoses:
    """Read a file of poses: TUM, KITTI, EuRoC, or CSV whose first line names the columns.

    A pose with a missing or invalid value stays in its place with the reason, because trackers
    write such lines while they see too few markers.

    Args:
        path: the file.

    Raises:
        UnreadableInput: the file cannot be read, a line has another form, or no pose is valid; with
            file and line.
    """
    poses, times, first = list[MeasuredPose | str](), list[int](), ""
    columns: _Columns | None = None
    for where, words, commas in _lines(path):
        if columns is None and not poses and len(words) > 1 and not _is_number(words[0]):
            columns = _columns(words, where)
            continue
        t_ns, pose = columns.read(words, where) if columns else _measured_line(words, commas, where)
        if isinstance(pose, str) and not first:
            first = f"; the first: {pose} ({where})"
        poses.append(pose)
        if t_ns is not None:
            times.append(t_ns)
    if not any(isinstance(pose, MeasuredPose) for pose in poses):
        raise UnreadableInput(
            f"no valid pose in this file{first}", where=shown(path), hint=_FORMATS_HELP
        )
    if times and len(times) != len(poses):
        raise UnreadableInput(
            "some lines have a time and others do not", where=shown(path), hint="check the file"
        )
    return TimedPoses(tuple(poses), tuple(times) or None)


@value_class(eq=True)
class _Columns:
    """Where a CSV with a header has time and pose; the exponent of its unit of time, and its
    unit of length [m].
    """

    time: int
    exponent: str
    pose: tuple[int, ...]
    metres: float

    def read(self, words: list[str], where: str) -> tuple[int, MeasuredPose | str]:
        """Time [ns] and pose of a line.

        Raises UnreadableInput if it has no time or too few columns.
        """
        if len(words) <= max(self.time, *self.pose):
            raise UnreadableInput(
                f"only {len(words)} columns", where=where, hint="one value for each named column"
            )
        text = words[self.time]
        t_ns = seconds_to_ns(text + self.exponent)
        if t_ns is None:
            hint = "a column t_s is in seconds, t_ms in milliseconds, t_ns in nanoseconds"
            raise UnreadableInput(f"'{shown(text)}' is not a time", where=where, hint=hint)
        values = [_number(words[k]) for k in self.pose]
        return t_ns, _checked([*(self.metres * v for v in values[:3]), *values[3:]])


def _columns(names: list[str], where: str) -> _Columns:
    """The columns that a header line names.

    Raises UnreadableInput if one of the eight is missing or named twice.
    """
    found: dict[str, tuple[int, str]] = {}  # place and unit of each
    for place, name in enumerate(_NOT_A_NAME.sub("_", n.lower()).strip("_") for n in names):
        if time := _TIME_HEADING.match(name):
            found.setdefault("t", (place, time[1] or "s"))
        elif position := _POSITION.match(name):
            found.setdefault(f"p{position[1]}", (place, position[2] or "m"))
        elif turn := _QUATERNION_HEADING.match(name):
            found.setdefault(f"q{turn[1]}", (place, ""))
    missing = [key for key in ("t", *_POSE_NAMES) if key not in found]
    if missing:
        raise UnreadableInput(
            f"no column for {', '.join(missing)}", where=where, hint=_FORMATS_HELP
        )
    place, unit = found["t"]
    pose = tuple(found[key][0] for key in _POSE_NAMES)
    return _Columns(place, _EXPONENTS.get(unit[0], ""), pose, _METRES[found["px"][1]])


def _measured_line(
    words: list[str], commas: bool, where: str
) -> tuple[int | None, MeasuredPose | str]:
    """A line without named columns; its number of columns determines the format."""
    try:
        if commas:
            x, y, z, qw, *q = (_number(w) for w in words[1:8])
            return _whole_ns(words[0]), _checked([x, y, z, *q, qw])
        if len(words) == 12:
            numbers = [_number(w) for w in words]
            if not all(map(math.isfinite, numbers)):
                return None, "a pose that is not finite"
            return None, MeasuredPose(_from_rows(numbers))
        t_ns = seconds_to_ns(words[0])
        if t_ns is None or len(words) != 8:
            raise ValueError
        return t_ns, _checked([_number(w) for w in words[1:]])
    except (ValueError, OverflowError):
        raise UnreadableInput("not a pose line", where=where, hint=_FORMATS_HELP) from None


def _checked(values: list[float]) -> MeasuredPose | str:
    if len(values) != 7:
        raise ValueError
    try:
        return pose_of_numbers(values)
    except BadMessage as error:
        return str(error)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _number(word: str) -> float:
    """A number; NaN for an empty field. Raises ValueError for other text."""
    return float(word) if word else math.nan
