"""Which reader a log file or a ROS 2 bag's folder wants."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from avsreplay.errors import UnreadableInput
from avsreplay.log.db3_file import SQLITE_MAGIC, Db3File
from avsreplay.log.folder import by_number
from avsreplay.log.mcap_file import McapFile
from avsreplay.log.mcap_records import MAGIC
from avsreplay.log.merged import Merged
from avsreplay.log.options import Loss
from avsreplay.log.recording import Recording, Sink
from avsreplay.log.ros1_bag import ROS1_MAGIC, Ros1Bag
from avsreplay.log.text import shown

__all__ = ["is_bag_folder", "open_recording"]

_STORAGE = (".mcap", ".db3")
_LISTED = re.compile(r"^\s*-\s*(?:path:\s*)?[\"']?([^\"'\n]+?\.(?:mcap|db3)(?:\.zstd)?)[\"']?\s*$", re.MULTILINE)
_MAX_METADATA = 4 << 20


def is_bag_folder(path: Path) -> bool:
    """Does a folder hold a ROS 2 bag rather than scans?"""
    return path.is_dir() and any(p.suffix in (*_STORAGE, ".zstd") for p in path.iterdir())


def open_recording(path: Path, limit: int, sinks: Mapping[str, Sink]) -> Recording:
    """Survey a log file by its first bytes, or all files of a bag's folder.

    Raises UnreadableInput where it is not there, empty or no log.
    """
    return _folder(path, limit, sinks) if path.is_dir() else _file(path, limit, sinks)


def _file(path: Path, limit: int, sinks: Mapping[str, Sink]) -> Recording:
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise UnreadableInput(error.strerror or "cannot be read", where=shown(path), hint="check the path") from None
    if head.startswith(ROS1_MAGIC):
        return Ros1Bag(path, limit, sinks)
    if head == SQLITE_MAGIC:
        return Db3File(path, limit, sinks)
    if head.startswith(b"#ROSBAG"):
        raise UnreadableInput("a ROS bag older than format 2.0", where=shown(path), hint="migrate it with rosbag fix")
    if head.startswith(b"\x28\xb5\x2f\xfd"):
        raise UnreadableInput("a zstd-compressed file", where=shown(path), hint="unpack it first: zstd -d")
    if not head.startswith(MAGIC) and path.suffix.lower() in (".ply", ".pcd", ".bin", ".npy", ".npz"):
        raise UnreadableInput("one scan, not a log", where=shown(path), hint="give the folder it is in")
    return McapFile(path, limit, sinks)


def _folder(path: Path, limit: int, sinks: Mapping[str, Sink]) -> Recording:
    files, losses = _files(path)
    parts: list[Recording] = []
    try:
        parts.extend(_file(file, limit, sinks) for file in files)
    except BaseException:
        for part in parts:
            part.close()
        raise
    if not parts:
        raise UnreadableInput("none of the bag's files is there", where=shown(path), hint="check its metadata.yaml")
    return Merged(parts, "ros2 bag", losses)


def _files(path: Path) -> tuple[list[Path], list[Loss]]:
    """The bag's files in order, and a loss for each that its metadata names and that is not there."""
    there = sorted((p for p in path.iterdir() if p.suffix in _STORAGE), key=lambda p: by_number(p.name))
    metadata = path / "metadata.yaml"
    if not metadata.is_file():
        return there, []
    text = metadata.read_bytes()[:_MAX_METADATA].decode("utf-8", "backslashreplace")
    listed = list(dict.fromkeys(Path(name).name for name in _LISTED.findall(text)))
    losses = [
        Loss("a file that the bag's metadata names is not there", 0, 0, file=name)
        for name in listed
        if not (path / name).is_file()
    ]
    packed = [name for name in listed if name.endswith(".zstd") and (path / name).is_file()]
    if packed:
        raise UnreadableInput("a zstd-compressed bag file", where=shown(path / packed[0]), hint="unpack it: zstd -d")
    named = [path / name for name in listed if (path / name).is_file()]
    return (named or there), losses
