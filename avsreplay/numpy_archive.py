"""Reading of numpy archives: sizes are checked against the bytes that are there before anything is allocated."""

from __future__ import annotations

import io
import math
import re
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import UnreadableInput
from avsreplay.files import BadFile, read_limited

_MAX_NPY_HEADER = 4096
_LEAST_ARRAYS, _MAX_RATIO = 96 << 20, 8  # arrays may take 96 MiB, or eight times the size of their archive
_NPY_HEADER = re.compile(
    r"\{\s*'descr':\s*'(?P<descr>[^']{1,8})',\s*'fortran_order':\s*(?P<fortran>True|False),"
    r"\s*'shape':\s*\((?P<shape>(?:\s*\d{1,18}\s*,?){0,8})\s*\),?\s*\}"
)
_NPY_TYPE = re.compile(r"[<>|=]?(?:f[248]|[iu][1248])")
_ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError, ValueError)


def parse_npy(data: bytes) -> NDArray[Any]:
    """Return the array of numbers in a npy file.

    numpy's own reader allocates the sizes in the header, evaluates the header and may unpickle.

    Args:
        data: the bytes of the file.

    Raises:
        BadFile: the file is malformed, or is not an array of integers or floats.
    """
    start = 12 if data[6:7] in (b"\x02", b"\x03") else 10
    size = int.from_bytes(data[8:start], "little")
    if data[:6] != b"\x93NUMPY" or size > _MAX_NPY_HEADER or len(data) < start + size:
        raise BadFile("not a valid npy file")
    header = _NPY_HEADER.fullmatch(data[start : start + size].decode("latin-1").strip())
    if header is None or not _NPY_TYPE.fullmatch(header["descr"]):
        raise BadFile("an npy file that is not an array of numbers")
    shape = tuple(int(n) for n in header["shape"].split(",") if n.strip())
    dtype, count = np.dtype(header["descr"]), math.prod(shape)
    if count * dtype.itemsize > len(data) - start - size:
        raise BadFile(f"an array of shape {str(shape)[:60]}, which its bytes do not contain")
    array = np.frombuffer(data, dtype, count, start + size)
    return array.reshape(shape, order="F" if header["fortran"] == "True" else "C")


def read_members(data: bytes, limit: int) -> dict[str, bytes]:
    """Return the members of a zip archive by name.

    Args:
        data: the bytes of the archive.
        limit: largest total size of the members after decompression [bytes].

    Raises:
        BadFile: the archive is malformed, or its members are larger.
    """
    out: dict[str, bytes] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for info in archive.infolist():
                with archive.open(info) as member:
                    out[info.filename] = member.read(limit + 1)
                limit -= len(out[info.filename])
                if limit < 0:
                    raise BadFile("its arrays are over the size limit")
    except BadFile:
        raise
    except _ZIP_ERRORS as error:
        raise BadFile(f"not a valid npz file: {str(error)[:80]}") from None
    return out


def read_npz(
    path: Path, shapes: Mapping[str, tuple[str, tuple[int | None, ...]]], *, limit: int, hint: str
) -> dict[str, NDArray[Any]]:
    """Read a numpy archive of declared content.

    Args:
        path: the file.
        shapes: for each array the kind of its numbers ("f" or "i") and its shape; None is any length.
        limit: largest size of the file [bytes].
        hint: what to do about an unusable file.

    Returns:
        The arrays by name, as float64 or int64.

    Raises:
        UnreadableInput: the file is missing, damaged, too large, or an array has another type or shape.
    """
    data = read_limited(path, limit, hint)
    try:
        members = read_members(data, max(_LEAST_ARRAYS, _MAX_RATIO * len(data)))
        return {name: _declared(members, name, *shapes[name]) for name in shapes}
    except BadFile as error:
        raise UnreadableInput(str(error), where=str(path), hint=hint) from None


def _declared(members: Mapping[str, bytes], name: str, kind: str, shape: tuple[int | None, ...]) -> NDArray[Any]:
    if f"{name}.npy" not in members:
        raise BadFile(f"the array '{name}' is missing")
    array = parse_npy(members[f"{name}.npy"])
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if array.dtype.kind != kind or not fits:
        raise BadFile(f"the array '{name}' has the type {array.dtype} and the shape {array.shape}")
    return array.astype(np.int64 if kind == "i" else np.float64)
