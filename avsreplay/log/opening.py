"""Opening of a source: detects the format, selects the topic of clouds or poses, attaches
ground truth and model.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from avsreplay.errors import AvsError, UnreadableInput, UsageError
from avsreplay.files import refuse_pointer
from avsreplay.geometry import MeasuredPose, Pose
from avsreplay.log import streams
from avsreplay.log.bytes_io import ROS1_MAGIC, SQLITE_MAGIC, BadMessage, shown
from avsreplay.log.camera import find_camera, stated_camera
from avsreplay.log.depth_image import IMAGE_TYPES
from avsreplay.log.depth_stream import DepthImages
from avsreplay.log.header import (
    HEADER_RECORD,
    decode_header,
    in_metres,
    octahedron,
    parse_surface,
    read_surface,
)
from avsreplay.log.index import Merged, MessageClouds, Recording, Sink
from avsreplay.log.mcap_file import McapFile
from avsreplay.log.mcap_format import MCAP_MAGIC
from avsreplay.log.options import Loss, SourceOptions
from avsreplay.log.pose_files import TimedPoses, read_conf, read_poses, read_times, seconds_to_ns
from avsreplay.log.result_log import RUN_RECORD
from avsreplay.log.scan_files import DEPTH_FORMAT, by_number, scan_files
from avsreplay.log.source import Source, refuse_losses
from avsreplay.log.topics import chosen_topic, optional_topic
from avsreplay.log.writer import TRUTH_TOPIC
from avsreplay.records import LogHeader, Surface

RESULT_SUFFIXES = (".json", ".jsonl", ".npz", ".html")  # of files of a result, but of no log


def open_source(
    path: str | Path,
    options: SourceOptions | None = None,
    *,
    inspect: bool = False,
    upto: int | None = None,
) -> Source:
    """Open an MCAP file, a ROS 1 or 2 bag or a folder of scans.

    Args:
        path: the file or folder.
        options: how it is read.
        inspect: also open a log without a cloud topic, or with several of which none was chosen; it
            then has no scans.
        upto: number of bytes that are read of an MCAP file that still grows; None reads all.

    Returns:
        The source; close it after use.

    Raises:
        UnreadableInput: it does not exist, is of no known format, has no cloud topic, or
            (``strict``) is damaged.
        UsageError: there are several cloud topics and none was chosen, a requested topic or frame
            does not exist, or the values of the clouds do not show what they mean.
    """
    path, options = Path(path), options or SourceOptions()
    if path.name == BAG_METADATA and path.is_file():  # of a bag, whose folder is meant
        path = path.parent
    try:
        source = _opened(path, options, inspect, upto)
    except OSError as error:
        raise UnreadableInput(
            error.strerror or "cannot be read", where=shown(path), hint="check the path"
        ) from None
    if upto is None:
        source.watch()
    try:
        if not inspect:
            _refuse_undecided(source)
        if options.strict:
            refuse_losses(source)
    except AvsError:
        source.close()
        raise
    return source


def _refuse_undecided(source: Source) -> None:
    """Raise UsageError if the values of the clouds leave open what they mean."""
    if refused := source.meaning.refused:
        raise UsageError(
            f"{refused.about}: {refused.sentence}",
            where=shown(source.path),
            hint=f"state it: {refused.option}",
        )


def _opened(path: Path, options: SourceOptions, inspect: bool, upto: int | None) -> Source:
    if not path.exists():
        raise UnreadableInput("no such file", where=shown(path), hint="check the path")
    if _is_result(path):
        raise _no_log(path)
    if options.poses and path.is_file() and not _is_log(path):
        return _open_pose_file(path, options)
    if path.is_dir() and not _is_bag_folder(path):
        return _open_folder(path, options)
    if not path.is_dir() and not path.is_file():
        raise UnreadableInput(
            "neither a file nor a folder", where=shown(path), hint="give a log or a folder of scans"
        )
    return _messages(path, options, inspect, upto)


def _is_result(path: Path) -> bool:
    """Whether a path is the directory of a result, or one of its files that can be no log."""
    folder = path.parent if path.suffix in RESULT_SUFFIXES else path
    return (folder / "run.json").is_file()


def _no_log(path: Path) -> UnreadableInput:
    hint = "name the log that was replayed; 'avsreplay report' and 'plan' read results"
    return UnreadableInput("is the result of a run, not a log", where=shown(path), hint=hint)


def _messages(
    path: Path, options: SourceOptions, inspect: bool, upto: int | None, stated: str = ""
) -> Source:
    """Open a log of messages; ``stated``: the fixed frame of its header, used where the
    options name none.
    """
    if options.rate_hz is not None:
        hint = "leave out --rate; --every-scan N takes every N-th scan"
        raise UsageError(
            "the messages of a log have times of their own", where=shown(path), hint=hint
        )
    collector = streams.TruthCollector(options)
    recording = _open_recording(
        path, options.max_message_mib << 20, collector.sinks(transforms=inspect), upto
    )
    try:
        topics = recording.topics()
        collector.check(topics, shown(path), stated)
        topic = (
            optional_topic(recording, options, path)
            if inspect
            else chosen_topic(recording, options, path)
        )
        if RUN_RECORD in recording.metadata and not inspect:
            raise _no_log(path)
        header, lost = _header(recording, options)
        if header.fixed_frame and options.fixed_frame is None and options.sensor_topic is None:
            # read once more, because the first reading did not collect the transforms
            recording.close()
            fixed = header.fixed_frame
            return _messages(path, replace(options, fixed_frame=fixed), inspect, upto, fixed)
        ground_truth = collector.ground_truth()
        if collector.damaged:
            left = f"{collector.damaged} left out: not finite, without a unit quaternion, or cut"
            header = replace(header, notes={**header.notes, "poses or transforms": left})
        if options.poses:
            clouds: MessageClouds = streams.PoseMessages(recording, topic)
            header = _pose_header(header, options)
            if topic == (options.truth_topic or TRUTH_TOPIC):  # a measurement is not its own truth
                ground_truth = replace(ground_truth, truth=None, track=None)
        else:
            clouds = _clouds(recording, topic, options)
    except BaseException:
        recording.close()
        raise
    stored = ", ".join(f"{count} {name}" for name, count in sorted(recording.chunks().items()))
    extra = {"profile": recording.profile, "library": recording.library, "chunks": stored}
    files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    return Source(
        path, clouds, header, options, ground_truth, files=files, extra=extra, losses=lost
    )


def _clouds(recording: Recording, topic: str | None, options: SourceOptions) -> MessageClouds:
    """Return the clouds or depth images of a topic."""
    kind = next((t.type for t in recording.topics() if t.name == topic), "")
    if topic is None or kind not in IMAGE_TYPES:
        return MessageClouds(recording, topic)
    stated = None if options.intrinsics is None else stated_camera(options.intrinsics)
    return DepthImages(recording, topic, options.max_message_mib << 20, stated)


def _header(recording: Recording, options: SourceOptions) -> tuple[LogHeader, tuple[Loss, ...]]:
    lost, header = list[Loss](), LogHeader()
    if HEADER_RECORD in recording.metadata:
        try:
            header = decode_header(recording.metadata[HEADER_RECORD])
        except ValueError as error:
            lost.append(Loss(shown(error), 0, 0))
    carried, trouble = (None, []) if options.model is not None else _carried(recording)
    return replace(header, surface=_model(options, carried)), tuple(lost + trouble)


def _model(options: SourceOptions, carried: Surface | None = None) -> Surface | None:
    """The model that the user gives or else that of the log, in metres."""
    surface = carried if options.model is None else read_surface(options.model, options.cloud_model)
    return surface and in_metres(surface, options.model_factor, options.model_mirror)


def _carried(recording: Recording) -> tuple[Surface | None, list[Loss]]:
    """Return the model in the log; if it cannot be read it is a loss, and another model can
    be given.
    """
    try:
        found = recording.attachment()
        return (None if found is None else parse_surface(found[1], found[0])), []
    except (UnreadableInput, BadMessage) as error:
        return None, [Loss(f"the model in the log cannot be read: {shown(error)}", 0, 0)]


def _pose_header(header: LogHeader, options: SourceOptions) -> LogHeader:
    """The header of a source of measured poses; without a model an octahedron of the stated
    extent is the target.
    """
    return (
        replace(header, surface=octahedron(options.extent_m)) if header.surface is None else header
    )


_HEAD_BYTES = 64


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError as error:
        raise UnreadableInput(
            error.strerror or "cannot be read", where=shown(path), hint="check the path"
        ) from None


def _is_log(path: Path) -> bool:
    """Return whether a file starts like a log."""
    return _head(path).startswith((MCAP_MAGIC, b"#ROSBAG", b"\x28\xb5\x2f\xfd", SQLITE_MAGIC))


def _open_pose_file(path: Path, options: SourceOptions) -> Source:
    """Open a file of measured poses.

    Raises:
        UnreadableInput: it is not a pose file, or has no valid pose.
        UsageError: a topic was requested.
    """
    _refuse_topics("a pose file", path, options)
    poses = streams.PoseFile(path, options.scan_rate_hz)
    header = LogHeader(
        surface=_model(options),
        notes={"source": "pose file", "times": options.times_note(poses.timed)},
    )
    truth = streams.GroundTruth()
    if options.truth_file is not None:
        truth = streams.GroundTruth(
            *streams.file_truth(read_poses(options.truth_file), options.truth_gap_s)
        )
    return Source(path, poses, _pose_header(header, options), options, truth, files=[path])


def _refuse_topics(what: str, path: Path, options: SourceOptions) -> None:
    for flag, value in (("--topic", options.topic), ("--truth-topic", options.truth_topic)):
        if value is not None:
            raise UsageError(
                f"{what} has no topics", where=f"{shown(path)}, {flag}", hint="leave it out"
            )


_STORAGE = (".mcap", ".db3")
BAG_METADATA = "metadata.yaml"
_NUMBERED = re.compile(r"_\d+(?=\.)")  # of the parts of a bag: drive_0.mcap, drive_1.mcap
_LISTED = re.compile(
    r"^\s*-\s*(?:path:\s*)?[\"']?([^\"'\n]+?\.(?:mcap|db3)(?:\.zstd)?)[\"']?\s*$", re.MULTILINE
)


def _is_bag_folder(path: Path) -> bool:
    """Return whether a folder contains a ROS 2 bag."""
    return path.is_dir() and any(p.suffix in (*_STORAGE, ".zstd") for p in path.iterdir())


def _open_recording(
    path: Path, limit: int, sinks: dict[str, Sink], upto: int | None = None
) -> Recording:
    """Open a log file, whose first bytes tell the format, or all files of the folder of a bag.

    Raises UnreadableInput if it does not exist, is empty or is not a log.
    """
    return _folder(path, limit, sinks) if path.is_dir() else _file(path, limit, sinks, upto)


def _file(path: Path, limit: int, sinks: dict[str, Sink], upto: int | None = None) -> Recording:
    head = _head(path)
    refuse_pointer(head, shown(path))
    if head.startswith(ROS1_MAGIC):
        from avsreplay.log.ros1_bag import Ros1Bag

        return Ros1Bag(path, limit, sinks)
    if head.startswith(SQLITE_MAGIC):
        from avsreplay.log.db3_file import Db3File

        return Db3File(path, limit, sinks)
    if head.startswith(b"#ROSBAG"):
        raise UnreadableInput(
            "a ROS bag older than format 2.0", where=shown(path), hint="migrate it with rosbag fix"
        )
    if head.startswith(b"\x28\xb5\x2f\xfd"):
        raise UnreadableInput(
            "a zstd-compressed file", where=shown(path), hint="unpack it first: zstd -d"
        )
    if not head.startswith(MCAP_MAGIC) and path.suffix.lower() in (
        ".ply",
        ".pcd",
        ".bin",
        ".npy",
        ".npz",
        DEPTH_FORMAT,
    ):
        raise UnreadableInput(
            "a single scan, not a log", where=shown(path), hint="give the folder it is in"
        )
    if not head.startswith(MCAP_MAGIC) and path.suffix == ".toml":
        raise UnreadableInput(
            "a scenario, not a log", where=shown(path), hint="make a log of it: avsreplay record"
        )
    return McapFile(path, limit, sinks, upto=upto)


def _folder(path: Path, limit: int, sinks: dict[str, Sink]) -> Recording:
    files, losses = _files(path)
    parts: list[Recording] = []
    try:
        parts.extend(_file(file, limit, sinks) for file in files)
    except BaseException:
        for part in parts:
            part.close()
        raise
    if not parts:
        raise UnreadableInput(
            "none of the files of the bag exists", where=shown(path), hint="check its metadata.yaml"
        )
    return Merged(parts, "ros2 bag", losses)


def _files(path: Path) -> tuple[list[Path], list[Loss]]:
    """Return the files of a bag in order, and a loss for each file in its metadata that is
    missing.

    Raises UnreadableInput for files that no metadata join and whose names differ in more than a
    number.
    """
    there = sorted(
        (p for p in path.iterdir() if p.suffix in _STORAGE), key=lambda p: by_number(p.name)
    )
    metadata = path / BAG_METADATA
    if not metadata.is_file():
        if len({_NUMBERED.sub("", file.name) for file in there}) > 1:
            first = ", ".join(shown(file.name) for file in there[:3])
            raise UnreadableInput(
                f"{len(there)} logs that are not parts of one bag: {first}",
                where=shown(path),
                hint="name one of them",
            )
        return there, []
    text = metadata.read_bytes()[: 4 << 20].decode("utf-8", "backslashreplace")
    listed = list(dict.fromkeys(Path(name).name for name in _LISTED.findall(text)))
    named = [path / name for name in listed if (path / name).is_file()]
    missing = [name for name in listed if path / name not in named]
    losses = [
        Loss("a file named in the metadata of the bag is missing", 0, 0, file=name)
        for name in missing
    ]
    if packed := [file for file in named if file.suffix == ".zstd"]:
        raise UnreadableInput(
            "a zstd-compressed bag file", where=shown(packed[0]), hint="unpack it: zstd -d"
        )
    return (named or there), losses


_TIME_FILE = "times.txt"
_STAMP_NAME = re.compile(r"^\d{9,10}\.\d+$|^\d{16,19}$")


def _open_folder(path: Path, options: SourceOptions) -> Source:
    """Open a folder of scans.

    Scans are ordered by the numbers in their names; with a ``.conf`` file only those that it names
    are used. Their times are taken from the first of: ``times.txt`` (one time [s] per line), file
    names that are times, a pose file with one line per scan, ``rate_hz``.

    Raises:
        UnreadableInput: there are no scans, or a pose or time file cannot be read.
        UsageError: a topic was requested, or there are several pose files and none was chosen.
    """
    _refuse_topics("a folder of scans", path, options)
    pose_file = options.truth_file or _pose_file(path)
    by_name = read_conf(pose_file) if pose_file is not None and pose_file.suffix == ".conf" else {}
    found = read_poses(pose_file) if pose_file is not None and not by_name else None
    files = scan_files(path, tuple(by_name), options.model)
    times = _times(path, files, found)
    depths = files[0].suffix.lower() == DEPTH_FORMAT
    clouds = streams.FolderClouds(
        files,
        options.scan_rate_hz,
        options.max_message_mib << 20,
        times,
        find_camera(path, options.intrinsics) if depths else None,
    )
    surface = _model(options)
    ground_truth = _ground_truth(files, clouds.header_ns, by_name, found, options)
    besides = [
        p
        for p in (pose_file, path / _TIME_FILE)
        if p is not None and p.is_file() and p.is_relative_to(path)
    ]
    header = LogHeader(
        surface=surface, notes={"source": "folder", "times": options.times_note(times is not None)}
    )
    return Source(path, clouds, header, options, ground_truth, files=[*files, *besides])


def _pose_file(path: Path) -> Path | None:
    found = sorted(
        {
            p
            for pattern in ("*.conf", "*.tum", "poses.txt")
            for p in path.glob(pattern)
            if p.is_file()
        }
    )
    if len(found) > 1:
        names = ", ".join(shown(p.name) for p in found)
        raise UsageError(
            f"several pose files: {names}", where=shown(path), hint="choose one with --truth"
        )
    return found[0] if found else None


def _times(path: Path, files: list[Path], found: TimedPoses | None) -> list[int] | None:
    listed = path / _TIME_FILE
    if listed.is_file():
        times = read_times(listed)
        if len(times) != len(files):
            what = f"{len(times)} times for {len(files)} scans"
            raise UnreadableInput(what, where=shown(listed), hint="one line a scan")
        return times
    if all(_STAMP_NAME.match(p.stem) for p in files):
        stamps = [seconds_to_ns(p.stem if "." in p.stem else f"{p.stem}e-9") for p in files]
        return [t_ns or 0 for t_ns in stamps] if None not in stamps else None
    return (
        list(found.t_ns)
        if found is not None and found.t_ns is not None and len(found.t_ns) == len(files)
        else None
    )


def _ground_truth(
    files: list[Path],
    times: list[int],
    by_name: dict[str, Pose],
    found: TimedPoses | None,
    options: SourceOptions,
) -> streams.GroundTruth:
    if found is None and by_name:
        named = [(t, MeasuredPose(by_name[f.name])) for t, f in zip(times, files, strict=True)]
        found = TimedPoses(tuple(pose for _, pose in named), tuple(t for t, _ in named))
    if found is None:
        return streams.GroundTruth()
    return streams.GroundTruth(*streams.file_truth(found, options.truth_gap_s))
