"""Scans stored as files: PLY, PCD, KITTI ``.bin``, ``.npy``, ``.npz``, ``.las`` and ``.laz``."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import MissingBackend, UnreadableInput
from avsreplay.files import BadFile
from avsreplay.log.bytes_io import shown
from avsreplay.log.pcd import read_pcd
from avsreplay.log.ply import read_ply
from avsreplay.numpy_archive import parse_npy, read_members


def read_points(path: Path, limit: int) -> NDArray[Any]:
    """Return the (n, 3) points of a file [m], float32 or float64, NaN where the sensor had no return.

    Args:
        path: the file; its extension selects the format.
        limit: largest array that is decompressed [bytes].

    Raises:
        BadFile: the content does not match the extension.
        OSError: the file cannot be read.
        MissingBackend: the library for the format is not installed.
    """
    return _READERS[path.suffix.lower()](path.read_bytes(), limit)


def _floats(points: NDArray[Any]) -> NDArray[Any]:
    return points if points.dtype in (np.float32, np.float64) else points.astype(np.float64)


def _ply(data: bytes, _limit: int) -> NDArray[Any]:
    return _floats(read_ply(data).points())


def _pcd(data: bytes, _limit: int) -> NDArray[Any]:
    return read_pcd(data)


def _kitti(data: bytes, _limit: int) -> NDArray[Any]:
    if len(data) % 16:
        raise BadFile(f"{len(data)} bytes are not whole KITTI points of 16")
    return np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3]


def _npy(data: bytes, _limit: int) -> NDArray[Any]:
    return _columns(parse_npy(data))


def _columns(array: NDArray[Any]) -> NDArray[Any]:
    """Reduce an array (..., k >= 3) to its first three columns (n, 3)."""
    if array.ndim < 2 or array.shape[-1] < 3:
        raise BadFile(f"an array of shape {array.shape}, not (n, 3)")
    flat = array.reshape(-1, array.shape[-1])[:, :3]
    return _floats(flat.astype(flat.dtype.newbyteorder("="), copy=False))


def _npz(data: bytes, limit: int) -> NDArray[Any]:
    members = {name: member for name, member in read_members(data, limit).items() if name.endswith(".npy")}
    named = [name for name in members if name in ("points.npy", "xyz.npy")] or list(members)
    if len(named) != 1:
        raise BadFile(f"{len(members)} arrays; name one of them 'points'")
    return _npy(members[named[0]], limit)


def _las(data: bytes, limit: int) -> NDArray[Any]:
    try:
        import laspy
    except ImportError:
        raise MissingBackend("LAS needs laspy", where=".las", hint="pip install 'avsreplay[las]'") from None
    module: Any = laspy  # its type stubs are incomplete
    try:
        with module.open(io.BytesIO(data)) as reader:
            if reader.header.point_count * 24 > limit:
                raise BadFile(f"{reader.header.point_count} points are over the limit of {limit} bytes")
            return np.asarray(reader.read().xyz, dtype=np.float64)
    except (laspy.errors.LaspyException, OSError, ValueError, RuntimeError, LookupError, MemoryError) as error:
        raise BadFile(f"not a readable LAS: {str(error)[:80]}") from None


_READERS: dict[str, Callable[[bytes, int], NDArray[Any]]] = {
    ".ply": _ply,
    ".pcd": _pcd,
    ".bin": _kitti,
    ".npy": _npy,
    ".npz": _npz,
    ".las": _las,
    ".laz": _las,
}
SCAN_FORMATS = tuple(_READERS)


_NUMBER = re.compile(r"\d+")


def scan_files(folder: Path, names: Sequence[str] = (), model: Path | None = None) -> list[Path]:
    """Return the scans of a folder, sorted by the numbers in their names, then by name.

    Args:
        folder: the folder.
        names: the files to use; if empty, all files of the most frequent known format.
        model: file of the model, which is not a scan if it lies in the folder and ``names`` is empty.

    Raises:
        UnreadableInput: there are no scans, or a named file does not exist.
    """
    if names:
        missing = [n for n in names if not (folder / n).is_file() or Path(n).name != n]
        if missing:
            hint = "remove its line or add the file"
            raise UnreadableInput(
                f"the pose file names the scan '{shown(missing[0])}', which does not exist",
                where=shown(folder),
                hint=hint,
            )
        return sorted((folder / n for n in names), key=lambda p: by_number(p.name))
    found = [p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in SCAN_FORMATS]
    if model is not None and model.exists():
        found = [p for p in found if not p.samefile(model)]
    if not found:
        hint = f"scans are {', '.join(SCAN_FORMATS)} files; a log is an MCAP or a ROS bag"
        raise UnreadableInput("no scans in this folder", where=shown(folder), hint=hint)
    counts = {s: sum(p.suffix.lower() == s for p in found) for s in SCAN_FORMATS}
    common = max(SCAN_FORMATS, key=lambda s: counts[s])
    return sorted((p for p in found if p.suffix.lower() == common), key=lambda p: by_number(p.name))


def by_number(name: str) -> tuple[tuple[int, ...], str]:
    """Return a sort key that puts ``s_9`` before ``s_10``."""
    return tuple(int(n) for n in _NUMBER.findall(name)), name
