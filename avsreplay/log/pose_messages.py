"""Pose messages, pose tracks over time and transform trees (/tf, /tf_static)."""

from __future__ import annotations

import math
import struct
from array import array
from bisect import bisect_left
from collections.abc import Callable, Sequence

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array, MeasuredPose, Pose, frozen
from avsreplay.log.bytes_io import BadMessage
from avsreplay.log.cdr import Cursor
from avsreplay.log.index import POSE_NAMES, Sink
from avsreplay.records import State

_MAX_TRANSFORMS = 4096  # of one message
_MAX_MAGNITUDE = 1e9  # of the numbers of a pose
_ROW = struct.Struct("13d")  # pose and twist of a track


@value_class(eq=True)
class Transform:
    """A stamped pose of ``child`` in ``parent``: x y z [m] qx qy qz qw, and the twist of an
    Odometry message.

    ``covariance`` holds 36 numbers by row, of position in ``parent`` [m] and rotation about its
    axes [rad].
    """

    t_ns: int
    parent: str
    child: str
    pose: tuple[float, ...]
    twist: tuple[float, ...] | None = None
    covariance: tuple[float, ...] | None = None


def read_pose(kind: str, payload: bytes | memoryview, encoding: str = "cdr") -> Transform:
    """Decode a message of ``POSE_TYPES``. Raises BadMessage if it is cut or is not a valid pose."""
    return checked(POSE_TYPES[kind](Cursor(payload, encoding)))


def checked(out: Transform) -> Transform:
    """Return the transform.

    Raises BadMessage if it is not finite or its quaternion is far from unit length.
    """
    if (
        not all(abs(v) < _MAX_MAGNITUDE for v in out.pose)
        or not 0.5 < math.hypot(*out.pose[3:]) < 2.0
    ):
        raise BadMessage("a pose that is not finite or has no unit quaternion")
    return out


def read_transforms(payload: bytes | memoryview, encoding: str = "cdr") -> list[Transform]:
    """Return the transforms of a TFMessage. Raises BadMessage if it is malformed."""
    cursor = Cursor(payload, encoding)
    count = cursor.u32()
    if count > _MAX_TRANSFORMS:
        raise BadMessage(f"{count} transforms in one message")
    return [_transform(cursor) for _ in range(count)]


def _pose(cursor: Cursor) -> Transform:
    t_ns, frame = cursor.header()
    return Transform(t_ns, frame, "", cursor.f64s(7))


def _with_covariance(cursor: Cursor) -> Transform:
    t_ns, frame = cursor.header()
    return Transform(t_ns, frame, "", cursor.f64s(7), None, cursor.f64s(36))


def _odometry(cursor: Cursor) -> Transform:
    t_ns, frame = cursor.header()
    child = cursor.string()
    pose = cursor.f64s(7)
    covariance = cursor.f64s(36)
    return Transform(t_ns, frame, child, pose, cursor.f64s(6), covariance)


def _transform(cursor: Cursor) -> Transform:
    t_ns, frame = cursor.header()
    child = cursor.string()
    return Transform(t_ns, frame, child, cursor.f64s(7))


POSE_TYPES: dict[str, Callable[[Cursor], Transform]] = dict(
    zip(POSE_NAMES, (_pose, _with_covariance, _odometry, _transform), strict=True)
)
# a measured quaternion whose length is off by more is not a rounded unit quaternion
_UNIT_LENGTH_ERROR = 0.01


def decode_measured(
    kind: str, payload: bytes | memoryview, encoding: str = "cdr"
) -> tuple[int, str, MeasuredPose]:
    """Decode a pose message as a measurement.

    Args:
        kind: its type, of ``POSE_TYPES``.
        payload: the serialised message.
        encoding: ``cdr`` or ``ros1``.

    Returns:
        Header stamp [ns], header frame, and the pose with the covariance of the message; a
        covariance that is zero, negative or not positive definite states nothing, as is usual in
        ROS.

    Raises:
        BadMessage: the message is cut, or its pose is not finite or has no unit quaternion.
    """
    found = POSE_TYPES[kind](Cursor(payload, encoding))
    pose = pose_of_numbers(found.pose)
    if found.covariance is None:
        return found.t_ns, found.parent, pose
    return (
        found.t_ns,
        found.parent,
        MeasuredPose(pose.T_ac, _in_fixture(found.covariance, pose.T_ac)),
    )


def pose_of_numbers(values: Sequence[float]) -> MeasuredPose:
    """Return a measured pose from x y z [m] qx qy qz qw.

    Raises:
        BadMessage: a value is not finite, or the quaternion is not of unit length within 1 %.
    """
    if not all(abs(v) < _MAX_MAGNITUDE for v in values):
        raise BadMessage("a pose that is not finite")
    length = math.hypot(*values[3:])
    if abs(length - 1.0) > _UNIT_LENGTH_ERROR:
        raise BadMessage(f"a quaternion of length {length:.4g}, not 1")
    return MeasuredPose(Pose(np.array(values[3:]) / length, np.array(values[:3])))


def _in_fixture(covariance: tuple[float, ...], T_ac: Pose) -> Array | None:
    """Covariance of d = [theta; v] in {C} from that of (position, rotation vector) in {A};
    None where it is not one.
    """
    given = np.array(covariance).reshape(6, 6)
    if not np.isfinite(given).all():
        return None
    turn, J = T_ac.R.T, np.zeros((6, 6))
    J[:3, 3:], J[3:, :3] = turn, turn  # theta = R' theta_a, v = R' dt_a
    C = J @ (0.5 * (given + given.T)) @ J.T
    try:
        np.linalg.cholesky(C)
    except np.linalg.LinAlgError:
        return None
    return frozen(C, 6, 6)


class PoseTrack:
    """Poses and, if known, twists by time; exact at the stamps, interpolated within a maximum gap,
    None elsewhere.

    Args:
        gap_s: widest gap between two poses across which is interpolated [s].
        by_log: use the times of the log clock instead of the stamps.
    """

    def __init__(self, gap_s: float, by_log: bool = False) -> None:
        self._gap_ns, self._by_log = round(gap_s * 1e9), by_log
        self._times, self._values = array("q"), array("d")
        self._order: list[int] | None = None
        self._sorted: list[int] = []
        self.damaged = 0
        self.frame = ""  # in which the poses are given, by the first message

    def __len__(self) -> int:
        return len(self._times)

    def uncovered(self, times_ns: Sequence[int]) -> tuple[str, bool]:
        """Return why none of some times has a pose, and whether that is the width of the gaps
        between the poses.

        Args:
            times_ns: at least one time without a pose [ns], ascending.
        """
        if not self._times:
            return "", False
        first, last = min(self._times), max(self._times)
        if any(first <= t_ns <= last for t_ns in times_ns):
            return f": gaps between the true poses exceed {self._gap_ns * 1e-9:g} s", True
        if first > times_ns[0]:
            return (
                f": they begin {(first - times_ns[0]) * 1e-9:.6g} s after the first of them",
                False,
            )
        return f": they end {(times_ns[0] - last) * 1e-9:.6g} s before the first of them", False

    def take(self, kind: str, encoding: str, log_ns: int, payload: bytes | memoryview) -> None:
        """Add a pose message (a Sink); one that cannot be decoded is counted in ``damaged``."""
        try:
            found = read_pose(kind, payload, encoding)
        except BadMessage:
            self.damaged += 1
            return
        self.frame = self.frame or found.parent
        unset = found.t_ns == 0 and log_ns > self._gap_ns
        self.add(log_ns if self._by_log or unset else found.t_ns, found.pose, found.twist)

    def add(
        self, t_ns: int, pose: tuple[float, ...], twist: tuple[float, ...] | None = None
    ) -> None:
        """Add a pose x y z qx qy qz qw and, if known, a twist (linear, angular)."""
        self._times.append(t_ns)
        self._values.extend((*pose, *(twist or (float("nan"),) * 6)))
        self._order = None

    def pose(self, t_ns: int) -> Pose | None:
        """Return the pose at ``t_ns``, None outside the track or inside too wide a gap."""
        row = self._at(t_ns)
        return None if row is None else Pose(row[3:7], row[:3])

    def at_scan(self, t_ns: int, _place: int, _frame: str) -> Pose | None:
        """Return the pose at the instant of a scan, whatever its number and frame."""
        return self.pose(t_ns)

    def body(self, t_ns: int, constants: State) -> State | None:
        """Return the full state from poses of {B} in {A} and twists in {B}; ``constants``
        gives sigma, c_b and q_bc.
        """
        row = self._at(t_ns)
        if row is None or not (np.abs(row[7:]) < _MAX_MAGNITUDE).all():
            return None
        q_ab = row[3:7]
        v_a = geometry.matrix(q_ab) @ row[7:10]
        return State(q_ab, row[10:13], row[:3], v_a, constants.sigma, constants.c_b, constants.q_bc)

    def _row(self, place: int) -> Array:
        row = np.array(_ROW.unpack_from(self._values, _ROW.size * self._index()[place]))
        row[3:7] = geometry.normalise(row[3:7])
        return row

    def _index(self) -> list[int]:
        if self._order is None:
            self._order = sorted(range(len(self._times)), key=self._times.__getitem__)
            self._sorted = [self._times[i] for i in self._order]
        return self._order

    def _at(self, t_ns: int) -> Array | None:
        self._index()
        right = bisect_left(self._sorted, t_ns)
        if right < len(self._sorted) and self._sorted[right] == t_ns:
            return self._row(right)
        if right in (0, len(self._sorted)):
            return None
        before, after = self._sorted[right - 1], self._sorted[right]
        if after - before > self._gap_ns:
            return None
        a, b, fraction = self._row(right - 1), self._row(right), (t_ns - before) / (after - before)
        out = a + fraction * (b - a)
        turn = geometry.multiply(geometry.conjugate(a[3:7]), b[3:7])
        out[3:7] = geometry.normalise(
            geometry.multiply(a[3:7], geometry.exp(fraction * geometry.log(turn)))
        )
        return out


TF_TYPE = "tf2_msgs/msg/TFMessage"
_TF_TYPES = (TF_TYPE, "tf/msg/tfMessage")


class TfBuffer:
    """The transform tree of a log.

    Args:
        gap_s: widest gap between two transforms across which is interpolated [s].
        by_log: use the times of the log clock instead of the stamps.
    """

    def __init__(self, gap_s: float, by_log: bool = False) -> None:
        self._gap_s, self._by_log = gap_s, by_log
        self._parents: dict[str, str] = {}
        self._static: dict[str, Pose] = {}
        self._moving: dict[str, PoseTrack] = {}
        self.damaged = 0

    def sink(self, static: bool) -> Sink:
        """Return the sink for the messages of /tf or, if ``static``, of /tf_static."""

        def take(kind: str, encoding: str, log_ns: int, payload: bytes | memoryview) -> None:
            if kind not in _TF_TYPES:
                return
            try:
                found = read_transforms(payload, encoding)
            except BadMessage:
                self.damaged += 1
                return
            for transform in found:
                try:
                    self._add(checked(transform), log_ns, static)
                except BadMessage:  # the other transforms of the message are valid
                    self.damaged += 1

        return take

    def _add(self, transform: Transform, log_ns: int, static: bool) -> None:
        child = transform.child.lstrip("/")
        self._parents[child] = transform.parent.lstrip("/")
        if static:
            self._static[child] = Pose(transform.pose[3:], transform.pose[:3])  # type: ignore[arg-type]
            return
        track = self._moving.setdefault(child, PoseTrack(self._gap_s))
        track.add(log_ns if self._by_log else transform.t_ns, transform.pose)

    def frames(self) -> list[str]:
        """Return the names of all frames."""
        return sorted({*self._parents, *self._parents.values()})

    def connected(self, one: str, two: str) -> bool:
        """Return whether two frames are in one tree, at whatever time."""
        return self._root(one) == self._root(two)

    def moving_beside(self, frame: str) -> list[str]:
        """Return the frames of the tree of a frame that move and are not above it, sorted."""
        above, at = {frame.lstrip("/")}, frame.lstrip("/")
        while at in self._parents and len(above) <= len(self._parents):
            at = self._parents[at]
            above.add(at)
        return sorted(n for n in self._moving if n not in above and self.connected(n, frame))

    def _root(self, frame: str) -> str:
        frame, steps = frame.lstrip("/"), 0
        while frame in self._parents and steps <= len(self._parents):
            frame, steps = self._parents[frame], steps + 1
        return frame

    def moving_in(self, frame: str) -> str | None:
        """Return the root of the tree above a frame if the frame moves in it, else None."""
        frame, moves, steps = frame.lstrip("/"), False, 0
        while frame in self._parents and steps <= len(self._parents):
            moves, frame, steps = moves or frame in self._moving, self._parents[frame], steps + 1
        return frame if moves else None

    def pose(self, parent: str, child: str, t_ns: int) -> Pose | None:
        """Return T_parent_child at ``t_ns``, None if the frames are not connected or the gap is too
        wide.
        """
        up, down = self._to_root(parent.lstrip("/"), t_ns), self._to_root(child.lstrip("/"), t_ns)
        for frame, to_frame in up:
            for other, from_frame in down:
                if frame == other:
                    return to_frame.inverse() @ from_frame
        return None

    def _to_root(self, frame: str, t_ns: int) -> list[tuple[str, Pose]]:
        """Return (ancestor, T_ancestor_frame) from the frame itself to the root, or to the first
        missing transform.
        """
        out, pose = [(frame, Pose.identity())], Pose.identity()
        while frame in self._parents and len(out) <= len(self._parents):
            step = self._static[frame] if frame in self._static else self._moving[frame].pose(t_ns)
            if step is None:
                break
            pose, frame = step @ pose, self._parents[frame]
            out.append((frame, pose))
        return out
