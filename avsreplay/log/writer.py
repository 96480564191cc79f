"""Writing of a log: MCAP, profile ros2, CDR only, in small chunks with checksums, with the model
and the scenario.

The bytes depend only on what is written: no clock, path or library version is in the file.
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, cast

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.files import STDOUT, check_output, is_stream
from avsreplay.geometry import Pose
from avsreplay.locks import open_alone
from avsreplay.log.cdr import (
    diagnostic,
    odometry,
    point_cloud2,
    pose_stamped,
    schema_text,
    transform,
)
from avsreplay.log.header import HEADER_RECORD, encode_header, surface_bytes
from avsreplay.log.index import MAX_NS
from avsreplay.records import Label, LogHeader, Scan, State

CLOUD_TOPIC = "/points"
TRUTH_TOPIC = "/truth/pose"
BODY_TOPIC = "/truth/body"
FAULT_TOPIC = "/faults"
CAMERA_TOPIC = "/camera/pose"
CAMERA_FRAME = "camera"
TARGET_FRAME = "target"
BODY_FRAME = "target_body"
ROOT_FRAME = "map"
LIBRARY = "avsreplay"
_TOPIC_TYPES = {
    CLOUD_TOPIC: "sensor_msgs/msg/PointCloud2",
    TRUTH_TOPIC: "geometry_msgs/msg/PoseStamped",
    BODY_TOPIC: "nav_msgs/msg/Odometry",
    FAULT_TOPIC: "diagnostic_msgs/msg/DiagnosticArray",
    CAMERA_TOPIC: "geometry_msgs/msg/PoseStamped",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
}
_INFINITE = "{sec: 9223372036, nsec: 854775807}"
_LATCHED = (  # keep last, reliable, transient local; complete, because readers require every key
    f"- {{history: 1, depth: 1, reliability: 1, durability: 1, deadline: {_INFINITE}, lifespan:"
    f" {_INFINITE}, liveliness: 1, liveliness_lease_duration: {_INFINITE},"
    " avoid_ros_namespace_conventions: false}\n"
)


class _Pipe(io.BufferedIOBase):
    """A pipe, FIFO or device, which has no position; each write passes through at once."""

    def __init__(self, raw: BinaryIO) -> None:
        self._raw, self._at = raw, 0

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._raw.write(data)
        self._at += len(data)
        return len(data)

    def tell(self) -> int:
        return self._at

    def flush(self) -> None:
        if not self.closed:
            self._raw.flush()

    def close(self) -> None:
        if not self.closed:
            super().close()
            self._raw.close()


class LogWriter:
    """Writer of one log; a context manager.

    The file is written under ``<name>.partial`` and renamed when it is complete. An exception
    inside the ``with`` removes it. If the disk is full, the complete chunks are kept under the
    partial name and the error states this. A pipe receives each chunk when it is complete.

    Attributes:
        bytes: number of bytes written so far.
    """

    def __init__(
        self,
        path: str | Path,
        header: LogHeader,
        *,
        overwrite: bool = False,
        compression: str = "zstd",
        chunk_bytes: int = 4 << 20,
        chunk_s: float = 1.0,
        streaming: bool = False,
        point_type: str = "float32",
    ) -> None:
        """Open the output and write the header.

        Args:
            path: the output; ``-`` is standard output.
            header: scenario, seed, labels and model; the model is attached. If it names a fixed
                frame, the log holds no static transform of the camera, and ``write_camera`` gives
                its poses.
            overwrite: replace an existing output.
            compression: ``zstd``, ``lz4`` or ``none``.
            chunk_bytes: a chunk is written when it reaches this size.
            chunk_s: a chunk is also written when it reaches this span of the log clock [s].
            streaming: write under the final name from the first byte, for a reader that follows the
                file.
            point_type: type of the stored coordinates, ``float32`` or ``float64``.

        Raises:
            UsageError: the output exists, or its folder does not.
            UnreadableInput: the output cannot be written.
            ValueError: an argument is out of range.
        """
        if compression not in ("zstd", "lz4", "none"):
            raise ValueError(f"compression is {compression!r}, not zstd, lz4 or none")
        if chunk_bytes < 1 or chunk_s <= 0.0:
            raise ValueError(f"chunk_bytes {chunk_bytes} and chunk_s {chunk_s} must be positive")
        check_output(Path(path), overwrite=overwrite)
        self._stdout = Path(path) == STDOUT
        # a symbolic link is followed, never replaced
        self._path, self._overwrite = STDOUT if self._stdout else Path(path).resolve(), overwrite
        self._pipe = is_stream(self._path)
        self._direct = streaming or self._pipe
        self._partial = (
            self._path if self._direct else self._path.with_name(self._path.name + ".partial")
        )
        self._point_type, self._chunk_bytes, self._chunk_ns = (
            point_type,
            chunk_bytes,
            round(chunk_s * 1e9),
        )
        self._labels = sorted(_edges(header.labels), key=lambda edge: (edge[0], edge[1]))
        self._root = header.fixed_frame or CAMERA_FRAME
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._chunk_start_ns: int | None = None
        self._pending_bytes = self._complete = self._last_ns = self.bytes = 0
        self._stream = self._create()
        self._begin(header, compression)

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        elif not self._stream.closed:
            self._discard()

    def write(self, scan: Scan) -> None:
        """Append the cloud of a scan with the stamp ``scan.t_ns`` at the log time ``scan.log_ns``.

        Args:
            scan: its points in the camera frame {A} [m], and the times of the points [s] if it has
                them, are stored.

        Raises:
            UnreadableInput: the output cannot be written, or a time is outside the range of a log.
        """
        payload = point_cloud2(
            scan.t_ns, CAMERA_FRAME, scan.points, scan.times_s, self._point_type, scan.intensities
        )
        self._message(CLOUD_TOPIC, scan.log_ns, payload)

    def write_truth(self, log_ns: int, t_ns: int, pose: Pose, body: State | None = None) -> None:
        """Append the true pose.

        Args:
            log_ns: time on the log clock [ns].
            t_ns: time of the pose [ns].
            pose: T_ac.
            body: full state of {B} in {A}, if known.

        Raises:
            UnreadableInput: the output cannot be written, or a time is outside the range of a log.
        """
        self._message(TRUTH_TOPIC, log_ns, pose_stamped(t_ns, self._root, pose))
        if body is not None:
            self._message(BODY_TOPIC, log_ns, odometry(t_ns, self._root, BODY_FRAME, body))

    def write_camera(self, log_ns: int, t_ns: int, pose: Pose) -> None:
        """Append the pose of a moving camera in the fixed frame, as a pose topic and as a
        transform.

        Args:
            log_ns: time on the log clock [ns].
            t_ns: time of the pose [ns].
            pose: T_wa.

        Raises:
            UnreadableInput: the output cannot be written, or a time is outside the range of a log.
        """
        self._message(CAMERA_TOPIC, log_ns, pose_stamped(t_ns, self._root, pose))
        self._message("/tf", log_ns, transform(t_ns, self._root, CAMERA_FRAME, pose))

    def close(self) -> None:
        """Finish and rename the file. Raises UnreadableInput if it cannot be written."""
        if self._stream.closed:
            return
        if not self._counts:
            self._guarded(lambda: self._static(0))
        self._labels_until(None)
        self._guarded(self._finish)
        try:
            if self._partial != self._path:
                if self._path.exists() and not self._overwrite:
                    raise UsageError(
                        "appeared while recording",
                        where=str(self._path),
                        hint=f"see {self._partial}",
                    )
                if os.name == "nt":  # Windows does not rename a file that is open
                    self._stream.close()
                self._partial.replace(self._path)  # before the lock ends
        finally:
            self._stream.close()

    def _create(self) -> BinaryIO:
        if not self._direct and self._partial.exists() and not self._overwrite:
            raise UsageError(
                "already exists",
                where=str(self._partial),
                hint="choose another name, or add --overwrite",
            )
        try:
            if self._pipe:
                return cast(
                    BinaryIO,
                    _Pipe(os.fdopen(os.dup(1), "wb") if self._stdout else self._partial.open("wb")),
                )
            return open_alone(self._partial)
        except OSError as error:
            raise UnreadableInput(
                f"cannot be written: {error.strerror}",
                where=str(self._path),
                hint="name another output",
            ) from None

    def _begin(self, header: LogHeader, compression: str) -> None:
        from mcap.writer import CompressionType, Writer

        kinds = {
            "zstd": CompressionType.ZSTD,
            "lz4": CompressionType.LZ4,
            "none": CompressionType.NONE,
        }
        # The library closes a chunk only after it exceeds its size; sizes and spans are therefore
        # checked here.
        self._writer: Any = Writer(self._stream, 1 << 62, kinds[compression], enable_data_crcs=True)

        try:
            record = encode_header(header)
        except ValueError:
            self._discard()
            hint = "check the numbers of the scenario"
            raise UsageError(
                "a state of the scenario is not finite", where=str(self._path), hint=hint
            ) from None

        def begin() -> None:
            self._writer.start(profile="ros2", library=LIBRARY)
            self._writer.add_metadata(HEADER_RECORD, record)
            if header.surface is not None:
                data = surface_bytes(header.surface)
                self._writer.add_attachment(
                    0, 0, header.surface.name, "application/octet-stream", data
                )
            self._stream.flush()

        self._guarded(begin)
        self._complete = self._stream.tell()

    def _message(self, topic: str, log_ns: int, payload: bytes) -> None:
        if not 0 <= log_ns < 2**63:
            hint = "the clock of a log begins at 0; give later times"
            raise UnreadableInput(
                f"a time of {log_ns * 1e-9:g} s cannot be recorded",
                where=str(self._path),
                hint=hint,
            )
        self._guarded(lambda: self._append_with_labels(topic, log_ns, payload))

    def _append_with_labels(self, topic: str, log_ns: int, payload: bytes) -> None:
        if not self._counts:
            self._static(log_ns)
        self._labels_until(log_ns)
        self._append(topic, log_ns, payload)

    def _static(self, log_ns: int) -> None:
        if self._root != CAMERA_FRAME:
            return
        self._append(
            "/tf_static", log_ns, transform(log_ns, ROOT_FRAME, CAMERA_FRAME, Pose.identity())
        )

    def _labels_until(self, log_ns: int | None) -> None:
        while self._labels and (log_ns is None or self._labels[0][0] <= log_ns):
            at_ns, place, label = self._labels.pop(0)
            written_ns = (
                at_ns if log_ns is not None else min(at_ns, self._last_ns)
            )  # a fault may last longer than the log
            stamp_ns = min(
                max(at_ns, 0), MAX_NS
            )  # the header record of a foreign log may state any time
            written_ns = min(max(written_ns, 0), MAX_NS)
            self._guarded(
                partial(
                    self._append,
                    FAULT_TOPIC,
                    written_ns,
                    diagnostic(stamp_ns, label, place % 2 == 0),
                )
            )

    def _append(self, topic: str, log_ns: int, payload: bytes) -> None:
        start = self._chunk_start_ns
        full = self._pending_bytes + len(payload) > self._chunk_bytes
        if start is not None and (full or abs(log_ns - start) >= self._chunk_ns):
            self._flush()
        self._chunk_start_ns = log_ns if self._chunk_start_ns is None else self._chunk_start_ns
        sequence = self._counts.get(topic, 0)
        self._writer.add_message(self._channel(topic), log_ns, payload, log_ns, sequence)
        self._counts[topic] = sequence + 1
        self._pending_bytes += len(payload)
        self._last_ns = max(self._last_ns, log_ns)

    def _flush(self) -> None:
        self._writer.flush()
        if self._direct:
            self._stream.flush()
        self._complete = self.bytes = self._stream.tell()
        self._chunk_start_ns, self._pending_bytes = None, 0

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            kind = _TOPIC_TYPES[topic]
            schema = self._writer.register_schema(kind, "ros2msg", schema_text(kind))
            qos = {"offered_qos_profiles": _LATCHED if topic == "/tf_static" else ""}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema, qos)
        return self._channels[topic]

    def _finish(self) -> None:
        self._writer.finish()
        self._stream.flush()
        self.bytes = self._stream.tell()
        if not self._pipe:
            os.fsync(self._stream.fileno())

    def _guarded(self, action: Callable[[], None]) -> None:
        try:
            action()
        except BrokenPipeError:
            if self._stdout:  # the reader of standard output has ended
                raise
            self._broken("Broken pipe")
        except OSError as error:
            self._broken(error.strerror or "the output failed")

    def _broken(self, why: str) -> None:
        self._keep_complete()
        kept = (
            f"{self._complete} complete bytes are kept in {self._partial}"
            if self._complete
            else "nothing is kept"
        )
        hint = "check its reader" if self._pipe else kept
        raise UnreadableInput(
            f"cannot be written: {why}", where=str(self._path), hint=hint
        ) from None

    def _keep_complete(self) -> None:
        """Keep the file up to its last complete chunk."""
        with contextlib.suppress(
            OSError
        ):  # the buffered bytes cannot be written either; the file is closed nevertheless
            self._stream.close()
        if not self._pipe and self._partial.is_file():
            os.truncate(self._partial, min(self._complete, self._partial.stat().st_size))
            if not self._complete and not self._direct:
                self._partial.unlink()

    def _discard(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.close()
        if not self._pipe and self._partial.is_file():
            self._partial.unlink()


def _edges(labels: tuple[Label, ...]) -> list[tuple[int, int, Label]]:
    """Return (time, number, label) of the begin (even number) and end (odd number) of every
    label.
    """
    ends = [(max(label.start_ns, 0), 2 * i, label) for i, label in enumerate(labels)]
    return ends + [(max(label.end_ns, 0), 2 * i + 1, label) for i, label in enumerate(labels)]
