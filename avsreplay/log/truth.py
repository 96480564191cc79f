"""A track of poses over time: exact at its stamps, interpolated within a stated gap, silent elsewhere."""

from __future__ import annotations

from array import array
from bisect import bisect_left

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.log.cursor import BadMessage
from avsreplay.log.poses import read_pose
from avsreplay.records import State

__all__ = ["PoseTrack"]


class PoseTrack:
    """Poses x y z qx qy qz qw, with a twist where there is one, by time.

    Args:
        gap_s: widest gap between two poses that is interpolated across.
        by_log: the instants are the log clock's, not the stamps'.
    """

    def __init__(self, gap_s: float, by_log: bool = False) -> None:
        self._gap_ns, self._by_log = round(gap_s * 1e9), by_log
        self._times, self._values = array("q"), array("d")
        self._order: list[int] | None = None
        self._sorted: list[int] = []
        self.damaged = 0
        self.frames: tuple[str, str] | None = None

    def __len__(self) -> int:
        return len(self._times)

    def take(self, kind: str, encoding: str, log_ns: int, payload: bytes | memoryview) -> None:
        """Add a pose message (a Sink); one that cannot be read is counted in ``damaged``."""
        try:
            found = read_pose(kind, payload, encoding)
        except BadMessage:
            self.damaged += 1
            return
        self.frames = self.frames or (found.parent, found.child)
        unset = found.t_ns == 0 and log_ns > self._gap_ns
        self.add(log_ns if self._by_log or unset else found.t_ns, found.pose, found.twist)

    def add(self, t_ns: int, pose: tuple[float, ...], twist: tuple[float, ...] | None = None) -> None:
        """Add a pose of seven numbers and, where there is one, a twist of six."""
        self._times.append(t_ns)
        self._values.extend((*pose, *(twist or (float("nan"),) * 6)))
        self._order = None

    def pose(self, t_ns: int) -> Pose | None:
        """The pose at an instant, None outside the track or inside too wide a gap."""
        row = self._at(t_ns)
        return None if row is None else Pose(row[3:7], row[:3])

    def body(self, t_ns: int, constants: State) -> State | None:
        """The full state from a track of {B} with twists in {B}; sigma, varrho and mu are ``constants``'."""
        row = self._at(t_ns)
        if row is None or not np.isfinite(row[7:]).all():
            return None
        q_ab = row[3:7]
        v_a = geometry.matrix(q_ab) @ row[7:10]
        return State(q_ab, row[10:13], row[:3], v_a, constants.sigma, constants.c_b, constants.q_bc)

    def _row(self, place: int) -> Array:
        at = 13 * self._index()[place]
        row = np.array(self._values[at : at + 13])
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
        out[3:7] = geometry.slerp(a[3:7], b[3:7], fraction)
        return out
