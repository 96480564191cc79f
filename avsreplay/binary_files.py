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
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import UnreadableInput, value_class
from avsreplay.read_budget import BadFile, ReadBudget, check_declared
from avsreplay.spool import SPOOL_BLOCK_BYTES, Spool, SpoolFile

_MAX_NPY_HEADER_BYTES = 4096
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
    header = _npy_header(data)
    check_declared(header.count, header.dtype.itemsize, len(data) - header.start, "numbers")
    array = np.frombuffer(data, header.dtype, header.count, header.start)
    return array.reshape(header.shape, order=header.order)


@value_class
class _NpyHeader:
    """What the first bytes of a npy file state; ``start`` is the offset of the numbers."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    order: Literal["C", "F"]
    start: int

    @property
    def count(self) -> int:
        return math.prod(self.shape)


def _npy_header(data: bytes) -> _NpyHeader:
    start = 12 if data[6:7] in (b"\x02", b"\x03") else 10
    size = int.from_bytes(data[8:start], "little")
    if data[:6] != b"\x93NUMPY" or size > _MAX_NPY_HEADER_BYTES or len(data) < start + size:
        raise BadFile("not a valid npy file")
    header = _NPY_HEADER.fullmatch(data[start : start + size].decode("latin-1").strip())
    if header is None or not _NPY_TYPE.fullmatch(header["descr"]):
        raise BadFile("an npy file that is not an array of numbers")
    shape = tuple(int(n) for n in header["shape"].split(",") if n.strip())
    order: Literal["C", "F"] = "F" if header["fortran"] == "True" else "C"
    return _NpyHeader(np.dtype(header["descr"]), shape, order, start + size)


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
    shapes: Mapping[str, tuple[str, tuple[int, ...]]],
    *,
    limit: int,
    hint: str,
    optional: Collection[str] = (),
) -> dict[str, Spool]:
    """Read a numpy archive of declared content, block by block.

    Args:
        path: the file.
        shapes: for each array the type of its numbers and the shape of each of its records; an
            array of the same kind of numbers ("f" or "i") is converted.
        limit: largest size of the file [bytes].
        hint: what to do about an unusable file.
        optional: arrays that a file may lack.

    Returns:
        The arrays by name.

    Raises:
        UnreadableInput: the file is missing, damaged, too large, or an array has another type or
            shape.
    """
    size, file = _regular_size(path, limit, hint), SpoolFile()
    try:
        with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
            found = {info.filename: info for info in archive.infolist()}
            budget = ReadBudget(size)
            budget.take_records(len(archive.infolist()), "arrays")
            budget.take_bytes(sum(info.file_size for info in archive.infolist()), "arrays")
            wanted = [name for name in shapes if name not in optional or f"{name}.npy" in found]
            out: dict[str, Spool] = {}
            for name in wanted:
                if f"{name}.npy" not in found:
                    raise BadFile(f"the array '{name}' is missing")
                info, dtype, shape = found[f"{name}.npy"], *shapes[name]
                with archive.open(info) as member:
                    out[name] = Spool(dtype, shape, file)
                    _read_array(member, info.file_size, name, out[name])
            return out
    except BadFile as error:
        raise UnreadableInput(str(error), where=str(path), hint=hint) from None
    except _ZIP_ERRORS as error:
        what = f"not a valid npz file: {str(error)[:80]}"
        raise UnreadableInput(what, where=str(path), hint=hint) from None


def _regular_size(path: Path, limit: int, hint: str) -> int:
    """The size of a regular file."""
    try:
        found = path.stat()
    except FileNotFoundError:
        raise UnreadableInput("no such file", where=str(path), hint="check the path") from None
    except OSError as error:
        what = error.strerror or "cannot be read"
        raise UnreadableInput(what, where=str(path), hint=hint) from None
    if not stat.S_ISREG(found.st_mode):
        raise UnreadableInput("is not a regular file", where=str(path), hint=hint)
    if found.st_size > limit:
        raise UnreadableInput(f"larger than {limit >> 20} MiB", where=str(path), hint=hint)
    return found.st_size


def _read_array(member: IO[bytes], size: int, name: str, out: Spool) -> None:
    """Append the records of a member of an archive, which declares a size [bytes]."""
    head = member.read(_MAX_NPY_HEADER_BYTES + 12)
    header = _npy_header(head)
    same_kind = header.dtype.kind == out.dtype.kind
    ordered = header.order == "C" or len(header.shape) == 1
    if not (same_kind and ordered and header.shape[1:] == out.shape and header.shape):
        raise BadFile(
            f"the array '{name}' has the type {header.dtype} and the shape {header.shape}"
        )
    check_declared(header.count, header.dtype.itemsize, size - header.start, "numbers")
    each = header.dtype.itemsize * math.prod(out.shape)
    left, data = header.count * header.dtype.itemsize, head[header.start :]
    while left:
        whole = min(len(data) // each * each, left)
        numbers = np.frombuffer(data[:whole], header.dtype).reshape(-1, *out.shape)
        out.extend(numbers.astype(out.dtype))
        left, data = left - whole, data[whole:]
        if left:
            more = member.read(SPOOL_BLOCK_BYTES)
            if not more:
                raise BadFile(f"the array '{name}' is shorter than it declares")
            data += more
    while member.read(SPOOL_BLOCK_BYTES):  # the checksum is compared at the end
        pass
