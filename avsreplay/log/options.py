"""What may be asked of a source, and what it says of itself and of what it lost."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from avsreplay.settings import Settings, setting


class ClockChoice(Enum):
    """Which clock ``Scan.t_ns`` is on."""

    HEADER = "header"  # the stamp in the message, judged against the recorder's clock
    LOG = "log"  # when the recorder received the message
    PUBLISH = "publish"  # when the sender published it, where the recorder kept that


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceOptions(Settings):
    """How to read a source: topics, frames, the part that is replayed, and clock."""

    topic: str | None = setting(None, "Topic of the clouds.", unset="the only one")
    truth_topic: str | None = setting(
        None,
        "Topic of the true poses: PoseStamped, PoseWithCovarianceStamped, Odometry or TransformStamped.",
        unset="/truth/pose",
    )
    truth_frame: str | None = setting(
        None, "Frame whose pose, by the log's /tf tree and in the clouds' (or the fixed) frame, is the true pose."
    )
    truth_file: Path | None = setting(None, "File of true poses beside the log (TUM, KITTI, EuRoC, Stanford .conf).")
    truth_gap_s: float = setting(
        1.0, "Widest gap between two true poses that is interpolated across.", unit="s", low=0.0
    )
    model: Path | None = setting(None, "Model file.", unset="the log's own model")
    cloud_model: bool = setting(False, "The model may be a point cloud without faces.")
    clock: ClockChoice = setting(ClockChoice.HEADER, "Clock of the scans' times.")
    start_s: float | None = setting(None, "Begin, after the first scan.", unit="s")
    start_offset_s: float | None = setting(None, "The same as start_s.", unit="s")
    end_s: float | None = setting(None, "End (not included), after the first scan.", unit="s", unset="the last scan")
    duration_s: float | None = setting(None, "Length of the part that is replayed.", unit="s", unset="up to the end")
    n_scans: int | None = setting(None, "Largest number of scans.", low=1, unset="all")
    every: int = setting(1, "Take every n-th scan, each at its own time.", low=1)
    crop_box: tuple[float, float, float, float, float, float] | None = setting(
        None,
        "Keep points within (xmin, ymin, zmin, xmax, ymax, zmax) of the cloud's frame.",
        unit="m",
        infinite=True,
    )
    crop_range: tuple[float, float] | None = setting(
        None, "Keep points whose distance from the origin is within (min, max).", unit="m", low=0.0, infinite=True
    )
    fixed_frame: str | None = setting(
        None, "Frame into which the clouds are transformed by the log's /tf tree at each scan's time."
    )
    sensor_topic: str | None = setting(
        None, "Topic of the sensor's pose, with which the clouds are transformed into the fixed frame."
    )
    rate_hz: float = setting(1.0, "Scan rate of a folder of scans.", unit="Hz", above=0.0, high=1e6)
    strict: bool = setting(False, "Any loss of data is an error (exit code 3).")
    max_message_mib: int = setting(
        128, "Largest message, chunk or attachment that is read.", unit="MiB", low=1, high=4096
    )

    def check(self) -> None:
        """Raise ValueError where a crop keeps nothing."""
        box = self.crop_box
        if box is not None and not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
            raise ValueError(f"crop_box {box} is empty")
        if self.crop_range is not None and not self.crop_range[0] < self.crop_range[1]:
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
