"""Options for reading a source, and the description of a source and of its losses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from avsreplay.errors import counted, value_class
from avsreplay.log.point_times import parse_point_time
from avsreplay.log.returns import parse_no_return
from avsreplay.settings import Settings, setting

ASSUMED_HZ = 1.0  # rate of scans or poses without times
NO_TIMES = "no time stamps in the files"


class ClockChoice(Enum):
    """The clock of ``Scan.t_ns``."""

    HEADER = "header"  # the stamp in the message, checked against the clock of the recorder
    LOG = "log"  # time of reception by the recorder
    PUBLISH = "publish"  # time of publication, if the recorder stored it


class Unit(Enum):
    """Unit of the coordinates of a model file."""

    M = "m"
    CM = "cm"
    MM = "mm"
    INCH = "inch"

    @property
    def metres(self) -> float:
        """Return one unit in metres."""
        return {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}[self.value]


class ByteOrder(Enum):
    """Order of the bytes of the values of a cloud."""

    DECLARED = "declared"
    REVERSED = "reversed"  # the other order than declared


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceOptions(Settings):
    """How to read a source: topics, frames, the part that is replayed, and clock."""

    topic: str | None = setting(
        None, "Topic of the clouds, or of the measured poses.", unset="the only one"
    )
    poses: bool = setting(
        False, "The source holds measured poses in place of clouds; '--backend poses' sets this."
    )
    pose_sigma: tuple[float, float] | None = setting(
        None,
        "1 sigma of a measured pose: position along each axis [mm] and attitude about each axis"
        " [deg]; it replaces the covariance of the messages.",
        above=0.0,
        unset=(
            "the covariance of the message, else estimator.r0_pos_m and r0_rot_deg, adapted to the"
            " residuals"
        ),
    )
    grasp: tuple[float, float, float] | None = setting(
        None,
        "Grasp point in the frame of the model, or of the measured poses. It becomes the origin of"
        " {C}; true poses are moved with it, and a start in the log is not used.",
        unit="m",
        unset="the origin of that frame",
    )
    extent_m: float = setting(
        1.0,
        "Size of the target (bounding diagonal) for measured poses without a model.",
        unit="m",
        above=0.0,
    )
    truth_topic: str | None = setting(
        None,
        "Topic of the true poses: PoseStamped, PoseWithCovarianceStamped, Odometry or"
        " TransformStamped.",
        unset="/truth/pose",
    )
    truth_frame: str | None = setting(
        None,
        "Frame of the /tf tree whose pose in the frame of the clouds (or in the fixed frame) is the"
        " true pose.",
    )
    truth_file: Path | None = setting(
        None, "File of true poses beside the log (TUM, KITTI, EuRoC, Stanford .conf)."
    )
    truth_gap_s: float = setting(
        1.0,
        "Largest gap between two true poses over which the pose is interpolated.",
        unit="s",
        low=0.0,
        high=1e6,
    )
    model: Path | None = setting(
        None,
        "Model file; 'auto' builds the model from the scans of the log.",
        unset="the log's own model",
    )
    cloud_model: bool = setting(False, "Accept a point cloud without faces as the model.")
    model_unit: Unit = setting(Unit.M, "Unit of the coordinates of the model.")
    model_scale: float = setting(
        1.0,
        "Factor on the size of the model, in addition to its unit: 1.01 for a model that is 1 % too"
        " small.",
        above=0.0,
    )
    model_mirror: bool = setting(
        False,
        "Use the mirror image of the model: the x coordinates change their sign, and the faces"
        " their winding.",
    )
    clock: ClockChoice = setting(
        ClockChoice.HEADER,
        "Clock of the scans: stamps of the messages (header), reception by the recorder (log) or"
        " publication.",
    )
    start_s: float | None = setting(None, "Begin at this time after the first scan.", unit="s")
    end_s: float | None = setting(
        None, "End before this time after the first scan.", unit="s", unset="the last scan"
    )
    duration_s: float | None = setting(
        None, "Length of the part that is used.", unit="s", unset="up to the end"
    )
    n_scans: int | None = setting(None, "Largest number of scans.", low=1, unset="all")
    every: int = setting(1, "Take every n-th scan, each at its own time.", low=1)
    crop_box: tuple[float, float, float, float, float, float] | None = setting(
        None,
        "Keep the points within this box in the frame of the cloud.",
        unit="m",
        infinite=True,
    )
    crop_range: tuple[float, float] | None = setting(
        None,
        "Keep the points between these two distances from the origin of the cloud's frame.",
        unit="m",
        low=0.0,
        infinite=True,
    )
    scan_duration_s: float | None = setting(
        None,
        "Time in which the points of a cloud are measured, in their order and from the stamp on,"
        " where they have no times; negative if the last one is measured first.",
        unit="s",
        low=-1e3,
        high=1e3,
        unset="the points of a cloud belong to one instant",
    )
    scan_unit: Unit | None = setting(
        None,
        "Unit of the coordinates of the clouds.",
        unset="metres, for whole numbers millimetres",
    )
    point_time: str | None = setting(
        None,
        "Times of the points as FIELD:UNIT:ORIGIN: a unit of s, ms, us or ns, and an origin of"
        " stamp, clock (that of the stamps), first or last (point, at the stamp), or the offset of"
        " another clock in seconds; 'none' ignores them.",
        unset="inferred from the values",
    )
    no_return: str | None = setting(
        None,
        "Codes of missing returns, separated by semicolons: X,Y,Z, z=VALUE or range=VALUE; 'none'"
        " for no code.",
        unset="inferred from the values",
    )
    byte_order: ByteOrder | None = setting(
        None,
        "Order of the bytes of the values of a cloud, against what its message declares.",
        unset="inferred from the values",
    )
    fixed_frame: str | None = setting(
        None, "Frame of the /tf tree into which each cloud is transformed at its own time."
    )
    sensor_topic: str | None = setting(
        None,
        "Topic of the sensor's pose, with which the clouds are transformed into the fixed frame.",
    )
    sensor_m: tuple[float, float, float] | None = setting(
        None,
        "Position of the sensor in the frame of the clouds, from which it measured all points.",
        unit="m",
        unset="the origin of that frame",
    )
    intrinsics: str | None = setting(
        None,
        "Camera of depth images: FX,FY,CX,CY [pixel], or a file with the matrix, the YAML of a ROS"
        " calibration or the JSON of Open3D.",
        unset="the CameraInfo of the log, or a file of intrinsics in the folder or above it",
    )
    rate_hz: float | None = setting(
        None,
        "Rate of scans or poses whose files hold no times; 1 Hz is assumed if it is not given.",
        unit="Hz",
        low=1e-4,
        high=1e6,
    )
    strict: bool = setting(
        False,
        "Treat any loss of data, also a scan that cannot be decoded, as an error (exit code 3).",
    )
    max_message_mib: int = setting(
        128, "Largest message, chunk or attachment that is read.", unit="MiB", low=1, high=4096
    )

    def check(self) -> None:
        """Raise ValueError if a crop is empty, or a text has another form than stated."""
        box = self.crop_box
        if box is not None and not all(
            low < high for low, high in zip(box[:3], box[3:], strict=True)
        ):
            raise ValueError(f"crop_box {box} is empty")
        if self.crop_range is not None and not self.crop_range[0] < self.crop_range[1]:
            raise ValueError(f"crop_range {self.crop_range} is empty")
        for name, parse in (("point_time", parse_point_time), ("no_return", parse_no_return)):
            if (text := getattr(self, name)) is not None:
                try:
                    parse(text)
                except ValueError as error:
                    raise ValueError(f"{name} {error}") from None

    @property
    def scan_rate_hz(self) -> float:
        """Return the rate of scans without times [Hz]."""
        return self.rate_hz or ASSUMED_HZ

    def times_note(self, given: bool) -> str:
        """Return where the times of a log without a clock come from.

        Args:
            given: whether its files state them.
        """
        if given:
            return "of the files"
        return (
            f"{NO_TIMES}: {ASSUMED_HZ:g} Hz is assumed"
            if self.rate_hz is None
            else f"{self.rate_hz:g} Hz, as given"
        )

    @property
    def model_factor(self) -> float:
        """Return the factor from the coordinates of the model to metres."""
        return self.model_unit.metres * self.model_scale

    @property
    def window_s(self) -> tuple[float, float]:
        """Return the window [start, end) after the first scan [s]."""
        start = self.start_s or 0.0
        end = float("inf") if self.end_s is None else self.end_s
        return start, min(end, start + self.duration_s) if self.duration_s is not None else end


@value_class(eq=True)
class Loss:
    """A part of a log that could not be read.

    Attributes:
        what: the cause.
        offset: offset in the file at which the loss begins.
        bytes: number of bytes lost.
        chunks: number of chunks lost.
        messages: number of messages lost, None if unknown.
        start_ns, end_ns: time span on the log clock, None if unknown.
        file: name of the file, if there are several.
    """

    what: str
    offset: int
    bytes: int
    chunks: int = 0
    messages: int | None = None
    start_ns: int | None = None
    end_ns: int | None = None
    file: str = ""


@value_class(eq=True)
class TopicInfo:
    """A topic of a log with its message type, encoding and count, and its first and last time on
    the log clock [ns].
    """

    name: str
    type: str
    encoding: str
    count: int
    first_ns: int | None = None
    last_ns: int | None = None

    @property
    def rate_hz(self) -> float | None:
        """Return the mean rate [Hz], None with fewer than two messages or no time span."""
        if (
            self.count < 2
            or self.first_ns is None
            or self.last_ns is None
            or self.last_ns <= self.first_ns
        ):
            return None
        return (self.count - 1) / ((self.last_ns - self.first_ns) * 1e-9)


@value_class(eq=True)
class ClockSummary:
    """How the times of the scans were determined.

    Attributes:
        clock: the clock of ``Scan.t_ns``.
        scans: number of scans.
        offset_s: median of header clock minus log clock [s].
        period_s: median time between scans [s].
        unset, jumps, equal, back: number of scans whose time was taken from the log clock, by
            cause.
        header_steps, log_steps: number of permanent steps of either clock that were compensated.
        note: a remark on the choice of the clock.
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
        """Return the number of scans whose own stamp was not used."""
        return self.unset + self.jumps + self.equal + self.back


def lost_text(
    losses: Sequence[Loss], damaged: Mapping[int, str], scans: int, count: int | None = None
) -> str:
    """Return in words what of a log could not be read, "" if everything could.

    Args:
        losses: parts of its files.
        damaged: number of each scan that cannot be used, with the reason.
        scans: number of selected scans.
        count: number of scans that cannot be used, if ``damaged`` does not have all of them.
    """
    count, found = len(damaged) if count is None else count, []
    if losses:
        found.append(
            f"{counted(len(losses), 'damaged place')} left out, the first: {losses[0].what}"
        )
    if count:
        first = f", the first: scan {min(damaged)}: {damaged[min(damaged)]}" if damaged else ""
        found.append(f"{count} of {counted(scans, 'scan')} cannot be used{first}")
    return "; ".join(found)


@value_class(eq=True)
class LogInfo:
    """The description of a source that ``avsreplay info`` prints.

    Attributes:
        path: path of the source.
        kind: mcap, ros2 bag, ros1 bag or folder.
        bytes: size of its files.
        topics: all topics.
        start_ns, end_ns: first and last time on the log clock.
        cloud_topic, scans: the cloud topic and its number of clouds.
        profile, library: what an MCAP file states about its use and its writer.
        chunks: number of chunks of each compression, in words.
        model, model_vertices, model_faces, model_extent_m: name, size and extent [m] of the model.
        scenario, seed: whether the log was simulated, and the seed.
        truth: whether true poses are known.
        faults: (kind, start, end [s after the start of the log], harmful) of the injected faults.
        clock: how the times of the scans were determined.
        losses: parts that could not be read.
        notes: further remarks by name.
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
    chunks: str = ""
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
        """Return the length of the log [s], None if it has no messages."""
        if self.start_ns is None or self.end_ns is None:
            return None
        return (self.end_ns - self.start_ns) * 1e-9
