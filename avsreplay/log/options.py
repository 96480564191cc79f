"""What may be asked of a source, and what it says of itself and of what it lost."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path


class ClockChoice(Enum):
    """Which clock ``Scan.t_ns`` is on."""

    HEADER = "header"  # the stamp in the message, judged against the recorder's clock
    LOG = "log"  # when the recorder received the message
    PUBLISH = "publish"  # when the sender published it, where the recorder kept that


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceOptions:
    """How to read a source. Every field has a default; None is "not asked for".

    Attributes:
        topic: the cloud topic; None picks the only one.
        truth_topic: PoseStamped, PoseWithCovarianceStamped, Odometry, TransformStamped; None: ``/truth/pose``.
        truth_frame: truth is the pose of this frame by the log's /tf chain, in the cloud's (or the fixed) frame.
        truth_file: poses beside the log (TUM, KITTI, EuRoC, Stanford ``.conf``).
        truth_gap_s: widest gap between two truth poses that is interpolated across.
        model: a model file, in place of the log's own.  cloud_model: it may be without faces.
        clock: see ClockChoice.
        start_s, end_s: window after the first scan [s), duration_s: its length, start_offset_s: the same as start_s.
        n_scans: at most so many.  every: every n-th scan, each with its own time.
        crop_box: keep points within (xmin, ymin, zmin, xmax, ymax, zmax) [m] of the cloud's frame.
        crop_range: keep points whose distance from the origin lies within (min, max) [m].
        fixed_frame: take clouds to this frame by the log's /tf chain at each scan's time.
        sensor_topic: take clouds to the fixed frame by this topic's pose of the sensor at each scan's time.
        rate_hz: scans a second of a folder.  strict: any loss is an error (exit 3).
        max_message_mib: largest message, chunk or attachment read.
    """

    topic: str | None = None
    truth_topic: str | None = None
    truth_frame: str | None = None
    truth_file: Path | None = None
    truth_gap_s: float = 1.0
    model: Path | None = None
    cloud_model: bool = False
    clock: ClockChoice = ClockChoice.HEADER
    start_s: float | None = None
    start_offset_s: float | None = None
    end_s: float | None = None
    duration_s: float | None = None
    n_scans: int | None = None
    every: int = 1
    crop_box: tuple[float, float, float, float, float, float] | None = None
    crop_range: tuple[float, float] | None = None
    fixed_frame: str | None = None
    sensor_topic: str | None = None
    rate_hz: float = 1.0
    strict: bool = False
    max_message_mib: int = 128

    def __post_init__(self) -> None:
        if self.every < 1:
            raise ValueError(f"every is {self.every}, must be 1 or more")
        if self.n_scans is not None and self.n_scans < 1:
            raise ValueError(f"n_scans is {self.n_scans}, must be 1 or more")
        if not 0.0 < self.rate_hz <= 1e6:
            raise ValueError(f"rate_hz is {self.rate_hz}, must be above 0 and at most 1e6")
        if self.truth_gap_s < 0.0:
            raise ValueError(f"truth_gap_s is {self.truth_gap_s}, must not be negative")
        if not 1 <= self.max_message_mib <= 4096:
            raise ValueError(f"max_message_mib is {self.max_message_mib}, must be 1 to 4096")
        box = self.crop_box
        if box is not None and not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
            raise ValueError(f"crop_box {box} is empty")
        if self.crop_range is not None and not 0.0 <= self.crop_range[0] < self.crop_range[1]:
            raise ValueError(f"crop_range {self.crop_range} is empty")

    @property
    def window_s(self) -> tuple[float, float]:
        """[start, end) after the first scan [s]."""
        start = self.start_s if self.start_s is not None else (self.start_offset_s or 0.0)
        end = float("inf") if self.end_s is None else self.end_s
        return start, min(end, start + self.duration_s) if self.duration_s is not None else end


@dataclass(frozen=True, slots=True)
class Loss:
    """A part of a log that could not be read.

    Attributes:
        what: one clause.  offset: byte of the file it begins at.  bytes: how many are lost.
        chunks: chunks lost.  messages: messages lost, None where nothing tells.
        start_ns, end_ns: span of the log clock, None where nothing tells.  file: name, where there are several.
    """

    what: str
    offset: int
    bytes: int
    chunks: int = 0
    messages: int | None = None
    start_ns: int | None = None
    end_ns: int | None = None
    file: str = ""


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a log: name, message type, encoding, how many messages, first and last on the log clock [ns]."""

    name: str
    type: str
    encoding: str
    count: int
    first_ns: int | None = None
    last_ns: int | None = None

    @property
    def rate_hz(self) -> float | None:
        """Mean rate over the topic's span, None below two messages or without a span."""
        if self.count < 2 or self.first_ns is None or self.last_ns is None or self.last_ns <= self.first_ns:
            return None
        return (self.count - 1) / ((self.last_ns - self.first_ns) * 1e-9)


@dataclass(frozen=True, slots=True)
class ClockSummary:
    """How the scans' instants were found.

    Attributes:
        clock: the clock of ``Scan.t_ns``.  scans: scans judged.
        offset_s: median of header minus log clock.  period_s: median spacing.
        unset, jumps, equal, back: scans placed by the log's clock, by cause.
        header_steps, log_steps: lasting steps of either clock that were followed.
    """

    clock: str
    scans: int = 0
    offset_s: float = 0.0
    period_s: float = 0.0
    unset: int = 0
    jumps: int = 0
    equal: int = 0
    back: int = 0
    header_steps: int = 0
    log_steps: int = 0
    note: str = ""

    @property
    def placed(self) -> int:
        """Scans whose own stamp was not used."""
        return self.unset + self.jumps + self.equal + self.back


@dataclass(frozen=True, slots=True)
class LogInfo:
    """What ``avsreplay info`` prints.

    Attributes:
        kind: mcap, ros2 bag, ros1 bag, folder.  profile, library: what an MCAP file says of its writer.
        faults: (kind, start [s], end [s], harmful), times after the log's start.
    """

    path: str
    kind: str
    bytes: int
    topics: tuple[TopicInfo, ...]
    start_ns: int | None
    end_ns: int | None
    cloud_topic: str | None = None
    scans: int = 0
    profile: str = ""
    library: str = ""
    model: str | None = None
    model_vertices: int = 0
    model_faces: int = 0
    model_extent_m: float | None = None
    scenario: bool = False
    seed: int | None = None
    truth: bool = False
    faults: tuple[tuple[str, float, float, bool], ...] = ()
    clock: ClockSummary | None = None
    losses: tuple[Loss, ...] = ()
    notes: dict[str, str] = field(default_factory=dict)

    @property
    def span_s(self) -> float | None:
        """Length of the log [s]."""
        if self.start_ns is None or self.end_ns is None:
            return None
        return (self.end_ns - self.start_ns) * 1e-9
