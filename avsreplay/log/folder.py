"""A folder of scans, one file a scan, in the order of the numbers in their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import UnreadableInput
from avsreplay.log.cursor import BadMessage
from avsreplay.log.formats import SCAN_FORMATS, read_points
from avsreplay.log.options import Loss, TopicInfo
from avsreplay.log.point_cloud2 import Cloud
from avsreplay.log.text import shown

__all__ = ["FolderFeed", "scan_files"]

_NUMBER = re.compile(r"\d+")
EPOCH_NS = 1_000_000_000  # the first scan's stamp: a stamp of zero means "unset"


class FolderFeed:
    """Scans of a folder at a steady rate; a Feed.

    Args:
        files: in order.  rate_hz: scans a second.  limit: most bytes of one file.
        times_ns: an instant for each file, in place of the rate.
    """

    kind = "folder"
    topic: str | None = None
    losses: Sequence[Loss] = ()

    def __init__(self, files: list[Path], rate_hz: float, limit: int, times_ns: list[int] | None = None) -> None:
        self._files, self._limit = files, limit
        steady = [EPOCH_NS + round(i * 1e9 / rate_hz) for i in range(len(files))]
        self.log_ns: list[int] = times_ns or steady
        self.publish_ns: list[int] = self.log_ns
        self.header_ns: list[int] = self.log_ns

    def load(self, place: int) -> Cloud:
        """Read one file. Raises BadMessage where it cannot be decoded."""
        path = self._files[place]
        try:
            size = path.stat().st_size
            if size > self._limit:
                raise BadMessage(f"{shown(path.name)}: {size} bytes are over the limit of {self._limit}")
            points = read_points(path, self._limit)
        except OSError as error:
            raise BadMessage(f"{shown(path.name)}: {error.strerror}") from None
        except ValueError as error:
            raise BadMessage(f"{shown(path.name)}: {error}") from None
        return _cloud(self.header_ns[place], points)

    def payload(self, place: int) -> None:
        """A folder has files, not messages."""

    def topics(self) -> list[TopicInfo]:
        """A folder has files, not topics."""
        return []

    def close(self) -> None:
        """Nothing is held open."""


def _cloud(stamp_ns: int, points: NDArray[Any]) -> Cloud:
    finite = np.isfinite(points).all(axis=1)
    kept = points if finite.all() else points[finite]
    return Cloud(stamp_ns, "", kept, None, len(points) - len(kept))


def scan_files(folder: Path, names: Sequence[str] = ()) -> list[Path]:
    """The scans of a folder: those named, else every file of the commonest known format; sorted by number, then name.

    Raises UnreadableInput where there are none, or a named one is not there.
    """
    if names:
        missing = [n for n in names if not (folder / n).is_file() or Path(n).name != n]
        if missing:
            hint = "remove its line or add the file"
            raise UnreadableInput(f"scan '{shown(missing[0])}' of the pose file", where=shown(folder), hint=hint)
        return sorted((folder / n for n in names), key=lambda p: by_number(p.name))
    found = [p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in SCAN_FORMATS]
    if not found:
        hint = f"scans are {', '.join(SCAN_FORMATS)} files; a log is an MCAP or a ROS bag"
        raise UnreadableInput("no scans in this folder", where=shown(folder), hint=hint)
    counts = {s: sum(p.suffix.lower() == s for p in found) for s in SCAN_FORMATS}
    common = max(SCAN_FORMATS, key=lambda s: counts[s])
    return sorted((p for p in found if p.suffix.lower() == common), key=lambda p: by_number(p.name))


def by_number(name: str) -> tuple[tuple[int, ...], str]:
    """Sorts ``s_9`` before ``s_10``."""
    return tuple(int(n) for n in _NUMBER.findall(name)), name
