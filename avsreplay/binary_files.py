"""Binary files of unknown origin, read with checks: arrays of numpy.

The sizes of arrays are compared with the size of the file before memory is allocated.
"""

from __future__ import annotations

import io
import math
import re
import stat
import zipfile
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import UnreadableInput
from avsreplay.read_budget import BadFile, ReadBudget, check_declared

_MAX_NPY_HEADER = 4096
_NPY_HEADER = re.compile(
    r"\{\s*'descr':\s*'(?P<descr>[^']{1,8})',\s*'fortran_order':\s*(?P<fortran>True|False),"
    r"\s*'shape':\s*\((?P<shape>(?:\s*\d{1,18}\s*,?){0,8})\s*\),?\s*\}"
)
_NPY_TYPE = re.compile(r"[<>|=]?(?:f[248]|[iu][1248])")
_ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    NotImplementedError,
    RuntimeError,
    EOFError,
    OSError,
    ValueError,
)


def read_limited(path: Path, limit: int, hint: str, *, pipe: bool = False) -> bytes:
    """Return the bytes of a regular file; a device may have no end.

    Args:
        path: the file.
        limit: largest size that is accepted [bytes].
        hint: what the error message advises.
        pipe: whether a pipe is read as well.

    Raises:
        UnreadableInput: it is not a regular file, is larger, or cannot be read.
    """
    try:
        found = path.stat()
        regular = stat.S_ISREG(found.st_mode)
        if not regular and not (pipe and stat.S_ISFIFO(found.st_mode)):
            raise UnreadableInput("is not a regular file", where=str(path), hint=hint)
        with path.open("rb") as stream:
            # read(n) allocates n bytes, which is 16 GiB for a checkpoint
            data = (
                b""
                if found.st_size > limit
                else stream.read()
                if regular
                else stream.read(limit + 1)
            )
        if max(found.st_size, len(data)) > limit:
            raise UnreadableInput(f"larger than {limit >> 20} MiB", where=str(path), hint=hint)
        return data
    except OSError as error:
        if isinstance(error, FileNotFoundError):
            raise UnreadableInput("no such file", where=str(path), hint="check the path") from None
        raise UnreadableInput(
            error.strerror or "cannot be read", where=str(path), hint=hint
        ) from None


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
    check_declared(count, dtype.itemsize, len(data) - start - size, "numbers")
    array = np.frombuffer(data, dtype, count, start + size)
    return array.reshape(shape, order="F" if header["fortran"] == "True" else "C")


def read_members(data: bytes, budget: ReadBudget) -> dict[str, bytes]:
    """Return the members of a zip archive by name.

    Args:
        data: the bytes of the archive.
        budget: what the members may take; their declared sizes are taken from it before any is
            decompressed.

    Raises:
        BadFile: the archive is malformed, or its members are larger than they declare.
        OverBudget: there are too many members, or they are too large.
    """
    out: dict[str, bytes] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            found = archive.infolist()
            budget.take_records(len(found), "arrays")
            budget.take_bytes(sum(info.file_size for info in found), "arrays")
            for info in found:
                with archive.open(info) as member:
                    out[info.filename] = member.read(info.file_size + 1)
                if len(out[info.filename]) > info.file_size:
                    raise BadFile(f"the array '{info.filename[:40]}' is larger than it declares")
    except BadFile:
        raise
    except _ZIP_ERRORS as error:
        raise BadFile(f"not a valid npz file: {str(error)[:80]}") from None
    return out


def read_npz(
    path: Path,
    shapes: Mapping[str, tuple[str, tuple[int | None, ...]]],
    *,
    limit: int,
    hint: str,
    optional: Collection[str] = (),
) -> dict[str, NDArray[Any]]:
    """Read a numpy archive of declared content.

    Args:
        path: the file.
        shapes: for each array the kind of its numbers ("f" or "i") and its shape; None is any
            length.
        limit: largest size of the file [bytes].
        hint: what to do about an unusable file.
        optional: arrays that a file may lack.

    Returns:
        The arrays by name, as float64 or int64.

    Raises:
        UnreadableInput: the file is missing, damaged, too large, or an array has another type or
            shape.
    """
    data = read_limited(path, limit, hint)
    try:
        members = read_members(data, ReadBudget(len(data)))
        wanted = [name for name in shapes if name not in optional or f"{name}.npy" in members]
        return {name: _declared(members, name, *shapes[name]) for name in wanted}
    except BadFile as error:
        raise UnreadableInput(str(error), where=str(path), hint=hint) from None


def _declared(
    members: Mapping[str, bytes], name: str, kind: str, shape: tuple[int | None, ...]
) -> NDArray[Any]:
    if f"{name}.npy" not in members:
        raise BadFile(f"the array '{name}' is missing")
    array = parse_npy(members[f"{name}.npy"])
    fits = array.ndim == len(shape) and all(
        n in (None, m) for n, m in zip(shape, array.shape, strict=True)
    )
    if array.dtype.kind != kind or not fits:
        raise BadFile(f"the array '{name}' has the type {array.dtype} and the shape {array.shape}")
    return array.astype(np.int64 if kind == "i" else np.float64)
