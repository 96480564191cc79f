"""One scan from one file: PLY, PCD, KITTI ``.bin``, ``.npy``, ``.npz``, ``.las``, ``.laz``."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import MissingBackend
from avsreplay.log.pcd import read_pcd
from avsreplay.log.ply import BadFile, read_ply

__all__ = ["SCAN_FORMATS", "read_points"]


def read_points(path: Path, limit: int) -> NDArray[Any]:
    """(n, 3) points of a file as they stand in it, float32 or float64, NaN where there is no return.

    Raises BadFile where the bytes are not what the ending says, OSError where they cannot be read, MissingBackend
    where the reader of the format is not installed.
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
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(stream)
    except (ValueError, EOFError, SyntaxError, MemoryError, RecursionError, TypeError) as error:
        raise BadFile(f"not a readable npy: {str(error)[:80]}") from None
    count = int(np.prod([int(n) for n in shape], dtype=object)) if shape else 1
    if dtype.hasobject or dtype.kind not in "fiu" or count * dtype.itemsize > len(data) - stream.tell():
        raise BadFile(f"an array of {dtype} and shape {shape}, which its bytes do not hold")
    array = np.frombuffer(data, dtype, count, stream.tell()).reshape(shape, order="F" if fortran else "C")
    return _columns(array)


def _columns(array: NDArray[Any]) -> NDArray[Any]:
    """(..., >= 3) to (n, 3)."""
    if array.ndim < 2 or array.shape[-1] < 3:
        raise BadFile(f"an array of shape {array.shape}, not (n, 3)")
    flat = array.reshape(-1, array.shape[-1])[:, :3]
    return _floats(flat.astype(flat.dtype.newbyteorder("="), copy=False))


def _npz(data: bytes, limit: int) -> NDArray[Any]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [m for m in archive.infolist() if m.filename.endswith(".npy")]
            named = [m for m in members if m.filename in ("points.npy", "xyz.npy")] or members
            if len(named) != 1:
                raise BadFile(f"{len(members)} arrays; name one of them 'points'")
            with archive.open(named[0]) as member:
                inner = member.read(limit + 1)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError, ValueError) as error:
        raise BadFile(f"not a readable npz: {str(error)[:80]}") from None
    if len(inner) > limit:
        raise BadFile(f"an array over the limit of {limit} bytes")
    return _npy(inner, limit)


def _las(data: bytes, limit: int) -> NDArray[Any]:
    try:
        import laspy
    except ImportError:
        raise MissingBackend("LAS needs laspy", where=".las", hint="pip install 'avsreplay[las]'") from None
    try:
        with laspy.open(io.BytesIO(data)) as reader:
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
