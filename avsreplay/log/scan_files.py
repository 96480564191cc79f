"""Scans stored as files: PLY, PCD, KITTI ``.bin``, ``.npy``, ``.npz``, ``.las`` and ``.laz``."""

from __future__ import annotations

import io
import math
import re
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import MissingBackend, UnreadableInput
from avsreplay.log.bytes_io import BadFile, shown
from avsreplay.log.pcd import read_pcd
from avsreplay.log.ply import read_ply

_MAX_NPY_HEADER = 4096
_NPY_HEADER = re.compile(
    r"\{\s*'descr':\s*'(?P<descr>[^']{1,8})',\s*'fortran_order':\s*(?P<fortran>True|False),"
    r"\s*'shape':\s*\((?P<shape>(?:\s*\d{1,18}\s*,?){0,8})\s*\),?\s*\}"
)
_NPY_KIND = re.compile(r"[<>|=]?(?:f[248]|[iu][1248])")


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
    """Parse the npy format; numpy's own reader allocates the sizes in the header and may unpickle."""
    wide = data[6:7] in (b"\x02", b"\x03")
    start = 12 if wide else 10
    size = int.from_bytes(data[8:start], "little")
    if data[:6] != b"\x93NUMPY" or size > _MAX_NPY_HEADER or len(data) < start + size:
        raise BadFile("not a valid npy file")
    header = _NPY_HEADER.fullmatch(data[start : start + size].decode("latin-1").strip())
    if header is None or not _NPY_KIND.fullmatch(header["descr"]):
        raise BadFile("an npy file that is not an array of numbers")
    shape = tuple(int(n) for n in header["shape"].split(",") if n.strip())
    descr, fortran = header["descr"], header["fortran"] == "True"
    dtype, count = np.dtype(descr), math.prod(shape)
    if count * dtype.itemsize > len(data) - start - size:
        raise BadFile(f"an array of shape {str(shape)[:60]}, which its bytes do not hold")
    array = np.frombuffer(data, dtype, count, start + size)
    return _columns(array.reshape(shape, order="F" if fortran else "C"))


def _columns(array: NDArray[Any]) -> NDArray[Any]:
    """Reduce an array (..., k >= 3) to its first three columns (n, 3)."""
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


def scan_files(folder: Path, names: Sequence[str] = ()) -> list[Path]:
    """Return the scans of a folder, sorted by the numbers in their names, then by name.

    Args:
        folder: the folder.
        names: the files to use; if empty, all files of the most frequent known format.

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
    if not found:
        hint = f"scans are {', '.join(SCAN_FORMATS)} files; a log is an MCAP or a ROS bag"
        raise UnreadableInput("no scans in this folder", where=shown(folder), hint=hint)
    counts = {s: sum(p.suffix.lower() == s for p in found) for s in SCAN_FORMATS}
    common = max(SCAN_FORMATS, key=lambda s: counts[s])
    return sorted((p for p in found if p.suffix.lower() == common), key=lambda p: by_number(p.name))


def by_number(name: str) -> tuple[tuple[int, ...], str]:
    """Return a sort key that puts ``s_9`` before ``s_10``."""
    return tuple(int(n) for n in _NUMBER.findall(name)), name
