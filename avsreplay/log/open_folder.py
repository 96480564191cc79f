"""Opening of a folder of scans: their order, their times, their poses."""

from __future__ import annotations

import re
from pathlib import Path

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import Pose
from avsreplay.log.conf import read_conf
from avsreplay.log.folder import FolderFeed, scan_files
from avsreplay.log.guides import Guides, file_truth
from avsreplay.log.options import SourceOptions
from avsreplay.log.pose_files import TimedPoses, read_poses, read_times, seconds_to_ns
from avsreplay.log.source import Source
from avsreplay.log.surface import read_surface
from avsreplay.log.text import shown
from avsreplay.records import LogHeader

__all__ = ["open_folder"]

_POSE_FILES = ("*.conf", "*.tum", "poses.txt")
_TIME_FILE = "times.txt"
_STAMPED = re.compile(r"^\d{9,10}\.\d+$|^\d{16,19}$")


def open_folder(path: Path, options: SourceOptions) -> Source:
    """A folder of scans as a source.

    Scans are in the order of the numbers in their names; with a ``.conf`` only those it names. Their times are, the
    first that is there: ``times.txt`` (a time [s] a line), names that are times, the times of a pose file with one
    line a scan, else ``rate_hz``.

    Raises:
        UnreadableInput: no scans, or a pose or time file that cannot be read.
        UsageError: a topic was asked for, or several pose files are there and none was named.
    """
    for flag, value in (("--topic", options.topic), ("--truth-topic", options.truth_topic)):
        if value is not None:
            raise UsageError("a folder of scans has no topics", where=f"{shown(path)}, {flag}", hint="leave it out")
    pose_file = options.truth_file or _pose_file(path)
    by_name = read_conf(pose_file) if pose_file is not None and pose_file.suffix == ".conf" else {}
    found = read_poses(pose_file) if pose_file is not None and not by_name else None
    files = scan_files(path, tuple(by_name))
    times = _times(path, files, found)
    feed = FolderFeed(files, options.rate_hz, options.max_message_mib << 20, times)
    surface = None if options.model is None else read_surface(options.model, options.cloud_model)
    notes = {"source": "folder", "times": "given" if times else f"steady at {options.rate_hz!r} Hz"}
    guides = _guides(files, feed.header_ns, by_name, found, options)
    besides = [p for p in (pose_file, path / _TIME_FILE) if p is not None and p.is_file() and p.is_relative_to(path)]
    return Source(path, feed, LogHeader(surface=surface, notes=notes), options, guides, files=[*files, *besides])


def _pose_file(path: Path) -> Path | None:
    found = sorted({p for pattern in _POSE_FILES for p in path.glob(pattern) if p.is_file()})
    if len(found) > 1:
        names = ", ".join(shown(p.name) for p in found)
        raise UsageError(f"several pose files: {names}", where=shown(path), hint="choose one with --truth-file")
    return found[0] if found else None


def _times(path: Path, files: list[Path], found: TimedPoses | None) -> list[int] | None:
    listed = path / _TIME_FILE
    if listed.is_file():
        times = read_times(listed)
        if len(times) != len(files):
            what = f"{len(times)} times for {len(files)} scans"
            raise UnreadableInput(what, where=shown(listed), hint="one line a scan")
        return times
    if all(_STAMPED.match(p.stem) for p in files):
        return [int(p.stem) if "." not in p.stem else seconds_to_ns(p.stem) or 0 for p in files]
    return list(found.t_ns) if found is not None and found.t_ns is not None and len(found.t_ns) == len(files) else None


def _guides(
    files: list[Path], times: list[int], by_name: dict[str, Pose], found: TimedPoses | None, options: SourceOptions
) -> Guides:
    if found is None and by_name:
        named = [(t, by_name[f.name]) for t, f in zip(times, files, strict=True)]
        found = TimedPoses(tuple(pose for _, pose in named), tuple(t for t, _ in named))
    return Guides() if found is None else Guides(*file_truth(found, options.truth_gap_s))
