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
from array import array
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import overload

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

    poses: Sequence[MeasuredPose | str]
    t_ns: Sequence[int] | None


class _Numbers(Sequence[MeasuredPose | str]):
    """The poses of the lines of a file, of which only the numbers are in memory: seven of a line,
    or twelve of KITTI.
    """

    def __init__(self) -> None:
        self._numbers, self._width = array("d"), 0
        self._reasons = dict[int, str]()  # of the lines without a pose

    def __len__(self) -> int:
        return len(self._numbers) // max(self._width, 1)

    def add(self, numbers: list[float]) -> MeasuredPose | str:
        """Append the numbers of a line and return its pose. Raises ValueError for another form."""
        self._width = self._width or len(numbers)
        if len(numbers) != self._width:
            raise ValueError
        pose = _pose(numbers)
        if isinstance(pose, str):
            self._reasons[len(self)] = pose
        self._numbers.extend(numbers)
        return pose

    @overload
    def __getitem__(self, at: int) -> MeasuredPose | str: ...
    @overload
    def __getitem__(self, at: slice) -> list[MeasuredPose | str]: ...
    def __getitem__(self, at: int | slice) -> MeasuredPose | str | list[MeasuredPose | str]:
        """Return one pose or several, made from the numbers."""
        if isinstance(at, slice):
            return [self[k] for k in range(*at.indices(len(self)))]
        place = range(len(self))[at]
        begin = place * self._width
        return self._reasons.get(place) or _pose(
            self._numbers[begin : begin + self._width].tolist()
        )


def _pose(numbers: list[float]) -> MeasuredPose | str:
    """The pose of seven numbers, or of twelve of KITTI, or why there is none.

    Raises ValueError for another count or a matrix that is no pose.
    """
    if len(numbers) == 12:
        finite = all(map(math.isfinite, numbers))
        return MeasuredPose(_from_rows(numbers)) if finite else "a pose that is not finite"
    if len(numbers) != 7:
        raise ValueError
    try:
        return pose_of_numbers(numbers)
    except BadMessage as error:
        return str(error)


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
    poses, times, first, any_valid = _Numbers(), array("q"), "", False
    columns: _Columns | None = None
    for where, words, commas in _lines(path):
        if columns is None and not poses and len(words) > 1 and not _is_number(words[0]):
            columns = _columns(words, where)
            continue
        try:
            t_ns, numbers = columns.read(words, where) if columns else _line(words, commas)
            pose = poses.add(numbers)
        except (ValueError, OverflowError):
            raise UnreadableInput("not a pose line", where=where, hint=_FORMATS_HELP) from None
        if isinstance(pose, str) and not first:
            first = f"; the first: {pose} ({where})"
        any_valid = any_valid or isinstance(pose, MeasuredPose)
        if t_ns is not None:
            times.append(t_ns)
    if not any_valid:
        raise UnreadableInput(
            f"no valid pose in this file{first}", where=shown(path), hint=_FORMATS_HELP
        )
    return TimedPoses(poses, times or None)


@value_class(eq=True)
class _Columns:
    """Where a CSV with a header has time and pose; the exponent of its unit of time, and its
    unit of length [m].
    """

    time: int
    exponent: str
    pose: tuple[int, ...]
    metres: float

    def read(self, words: list[str], where: str) -> tuple[int, list[float]]:
        """Time [ns] and the seven numbers of a line.

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
        return t_ns, [*(self.metres * v for v in values[:3]), *values[3:]]


def _columns(names: list[str], where: str) -> _Columns:
    """The columns that a header line names; of several times the first.

    Raises UnreadableInput if one of the eight is missing, if one of the pose is named twice, or if
    the coordinates differ in their unit.
    """
    found: dict[str, tuple[int, str]] = {}  # place and unit of each
    problem = ""
    for place, name in enumerate(_NOT_A_NAME.sub("_", n.lower()).strip("_") for n in names):
        if time := _TIME_HEADING.match(name):
            found.setdefault("t", (place, time[1] or "s"))
            continue
        if position := _POSITION.match(name):
            key, unit = f"p{position[1]}", position[2] or "m"
        elif turn := _QUATERNION_HEADING.match(name):
            key, unit = f"q{turn[1]}", ""
        else:
            continue
        if key in found:
            problem = f"two columns for {key}"
        found[key] = place, unit
    missing = [key for key in ("t", *_POSE_NAMES) if key not in found]
    if missing:
        problem = f"no column for {', '.join(missing)}"
    elif len({found[key][1] for key in _POSE_NAMES[:3]}) > 1:
        problem = "coordinates in different units"
    if problem:
        raise UnreadableInput(problem, where=where, hint=_FORMATS_HELP)
    place, unit = found["t"]
    pose = tuple(found[key][0] for key in _POSE_NAMES)
    return _Columns(place, _EXPONENTS.get(unit[0], ""), pose, _METRES[found["px"][1]])


def _line(words: list[str], commas: bool) -> tuple[int | None, list[float]]:
    """Time and numbers of a line without named columns; its number of columns determines the
    format.

    Raises ValueError or OverflowError where it has none.
    """
    if commas:
        x, y, z, qw, *q = (_number(w) for w in words[1:8])
        return _whole_ns(words[0]), [x, y, z, *q, qw]
    if len(words) == 12:
        return None, [_number(w) for w in words]
    t_ns = seconds_to_ns(words[0])
    if t_ns is None or len(words) != 8:
        raise ValueError
    return t_ns, [_number(w) for w in words[1:]]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _number(word: str) -> float:
    """A number; NaN for an empty field. Raises ValueError for other text."""
    return float(word) if word else math.nan
