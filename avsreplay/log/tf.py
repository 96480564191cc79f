"""Chains of transforms from /tf and /tf_static, looked up at an instant."""

from __future__ import annotations

from avsreplay.geometry import Pose
from avsreplay.log.cursor import BadMessage
from avsreplay.log.poses import Transform, checked, read_transforms
from avsreplay.log.recording import Sink
from avsreplay.log.truth import PoseTrack

__all__ = ["TfBuffer"]

TF_TYPE = "tf2_msgs/msg/TFMessage"
_TF_TYPES = (TF_TYPE, "tf/msg/tfMessage")


class TfBuffer:
    """The transforms of a log.

    Args:
        gap_s: widest gap between two transforms that is interpolated across.  by_log: times are the log clock's.
    """

    def __init__(self, gap_s: float, by_log: bool = False) -> None:
        self._gap_s, self._by_log = gap_s, by_log
        self._parents: dict[str, str] = {}
        self._static: dict[str, Pose] = {}
        self._moving: dict[str, PoseTrack] = {}
        self.damaged = 0

    def sink(self, static: bool) -> Sink:
        """Who takes the messages of /tf (or, ``static``, of /tf_static)."""

        def take(kind: str, encoding: str, log_ns: int, payload: bytes | memoryview) -> None:
            if kind not in _TF_TYPES:
                return
            try:
                found = [checked(t) for t in read_transforms(payload, encoding)]
            except BadMessage:
                self.damaged += 1
                return
            for transform in found:
                self._add(transform, log_ns, static)

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
        """Every frame that a transform names."""
        return sorted({*self._parents, *self._parents.values()})

    def pose(self, parent: str, child: str, t_ns: int) -> Pose | None:
        """T_parent_child at an instant, None where the frames are not joined or the gap is too wide."""
        up, down = self._to_root(parent.lstrip("/"), t_ns), self._to_root(child.lstrip("/"), t_ns)
        for frame, to_frame in up:
            for other, from_frame in down:
                if frame == other:
                    return to_frame.inverse() @ from_frame
        return None

    def _to_root(self, frame: str, t_ns: int) -> list[tuple[str, Pose]]:
        """(ancestor, T_ancestor_frame) from the frame itself up to its root, or to where the chain breaks."""
        out, pose = [(frame, Pose.identity())], Pose.identity()
        while frame in self._parents and len(out) <= len(self._parents):
            step = self._static[frame] if frame in self._static else self._moving[frame].pose(t_ns)
            if step is None:
                break
            pose, frame = step @ pose, self._parents[frame]
            out.append((frame, pose))
        return out
