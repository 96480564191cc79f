"""Scans stored as files: PLY, PCD, KITTI ``.bin``, ``.npy``, ``.npz``, ``.las`` and ``.laz``; the
reader of PCD.

PCD files (ascii, binary and binary_compressed by LZF, with any fields) are not read by a library.
Every size that they declare is compared with the bytes of the file before memory is allocated, also
inside the compressed part.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.binary_files import parse_npy, read_members
from avsreplay.errors import MissingBackend, UnreadableInput, value_class
from avsreplay.log.bytes_io import shown
from avsreplay.log.ply import read_ply
from avsreplay.read_budget import BadFile, ReadBudget


@np.errstate(invalid="ignore", over="ignore")  # any bytes may stand where a number is expected
def read_points(path: Path, limit: int) -> NDArray[Any]:
    """Return the (n, 3) points of a file [m], float32 or float64, NaN where the sensor had no
    return.

    Args:
        path: the file; its extension selects the format.
        limit: largest array that is decompressed [bytes].

    Raises:
        BadFile: the content does not match the extension.
        OSError: the file cannot be read.
        MissingBackend: the library for the format is not installed.
    """
    data = path.read_bytes()
    return _READERS[path.suffix.lower()](data, ReadBudget(len(data), most_bytes=limit))


def _floats(points: NDArray[Any]) -> NDArray[Any]:
    return points if points.dtype in (np.float32, np.float64) else points.astype(np.float64)


def _ply(data: bytes, budget: ReadBudget) -> NDArray[Any]:
    return _floats(read_ply(data, budget).points())


def _pcd(data: bytes, budget: ReadBudget) -> NDArray[Any]:
    return read_pcd(data, budget)


_BIN_COLUMNS = (4, 5, 6, 3, 7, 8)  # values of a point, in the order in which they are tried
_FAR_BETTER = 1.3  # ratio of variances from which another number than the first is taken


def _kitti(data: bytes, _budget: ReadBudget) -> NDArray[Any]:
    return np.frombuffer(data, "<f4").reshape(-1, bin_columns(data))[:, :3]


def bin_columns(data: bytes) -> int:
    """Return the number of float32 values of a point of a ``.bin`` file, which does not state it.

    The values of a column are alike, so that with the right number the variance within the columns
    is least. Four (KITTI) is taken unless another number explains the values far better.

    Args:
        data: the file.

    Raises:
        BadFile: no number of values divides it.
    """
    if not data:
        return _BIN_COLUMNS[0]
    fitting = [n for n in _BIN_COLUMNS if len(data) % (4 * n) == 0]
    if not fitting:
        raise BadFile(f"{len(data)} bytes are not whole KITTI points of 16, or others up to 32")
    values = np.nan_to_num(np.frombuffer(data, "<f4").astype(np.float64), posinf=0.0, neginf=0.0)
    values = np.clip(values, -1e6, 1e6)
    within = {n: float(values.reshape(-1, n).var(axis=0).mean()) for n in fitting}
    least = _FAR_BETTER * min(within.values())
    return next(n for n in fitting if within[n] <= least or n == fitting[-1])


def _npy(data: bytes, _budget: ReadBudget) -> NDArray[Any]:
    return _columns(parse_npy(data))


def _columns(array: NDArray[Any]) -> NDArray[Any]:
    """Reduce an array (..., k >= 3) to its first three columns (n, 3)."""
    if array.ndim < 2 or array.shape[-1] < 3:
        raise BadFile(f"an array of shape {array.shape}, not (n, 3)")
    flat = array.reshape(-1, array.shape[-1])[:, :3]
    return _floats(flat.astype(flat.dtype.newbyteorder("="), copy=False))


def _npz(data: bytes, budget: ReadBudget) -> NDArray[Any]:
    members = {
        name: member for name, member in read_members(data, budget).items() if name.endswith(".npy")
    }
    named = [name for name in members if name in ("points.npy", "xyz.npy")] or list(members)
    if len(named) != 1:
        raise BadFile(f"{len(members)} arrays; name one of them 'points'")
    return _npy(members[named[0]], budget)


def _las(data: bytes, budget: ReadBudget) -> NDArray[Any]:
    try:
        import laspy
    except ImportError:
        raise MissingBackend(
            "LAS needs laspy", where=".las", hint="pip install 'avsreplay[las]'"
        ) from None
    module: Any = laspy  # its type stubs are incomplete
    try:
        with module.open(io.BytesIO(data)) as reader:
            budget.take_bytes(reader.header.point_count * 24, "points")
            return np.asarray(reader.read().xyz, dtype=np.float64)
    except (
        laspy.errors.LaspyException,
        OSError,
        ValueError,
        RuntimeError,
        LookupError,
        MemoryError,
    ) as error:
        raise BadFile(f"not a readable LAS: {str(error)[:80]}") from None


_READERS: dict[str, Callable[[bytes, ReadBudget], NDArray[Any]]] = {
    ".ply": _ply,
    ".pcd": _pcd,
    ".bin": _kitti,
    ".npy": _npy,
    ".npz": _npz,
    ".las": _las,
    ".laz": _las,
}
SCAN_FORMATS = tuple(_READERS)
DEPTH_FORMAT = ".png"  # a folder of depth images, where it has no other scans
LOG_FORMATS = (".mcap", ".bag", ".db3")
LISTED_LOGS = 3  # logs that a message names


_NUMBER = re.compile(r"\d+")


def scan_files(folder: Path, names: Sequence[str] = (), model: Path | None = None) -> list[Path]:
    """Return the scans of a folder, sorted by the numbers in their names, then by name.

    Args:
        folder: the folder.
        names: the files to use; if empty, all files of the most frequent known format.
        model: file of the model, which is not a scan if it lies in the folder and ``names`` is
            empty.

    Raises:
        UnreadableInput: there are no scans, or a named file does not exist.
    """
    if names:
        return _named(folder, names)
    files = [p for p in folder.iterdir() if p.is_file()]
    if model is not None and model.exists():
        files = [p for p in files if not p.samefile(model)]
    by_format = {
        suffix: [p for p in files if p.suffix.lower() == suffix]
        for suffix in (*SCAN_FORMATS, DEPTH_FORMAT)
    }
    depth = by_format.pop(DEPTH_FORMAT)  # pictures beside clouds are not scans
    found = max(by_format.values(), key=len) or depth
    if not found:
        raise _no_scans(folder)
    return sorted(found, key=lambda p: by_number(p.name))


def _named(folder: Path, names: Sequence[str]) -> list[Path]:
    """The named scans of a folder, in order."""
    missing = [n for n in names if not (folder / n).is_file() or Path(n).name != n]
    if missing:
        raise UnreadableInput(
            f"the pose file names the scan '{shown(missing[0])}', which does not exist",
            where=shown(folder),
            hint="remove its line or add the file",
        )
    return sorted((folder / n for n in names), key=lambda p: by_number(p.name))


def _no_scans(folder: Path) -> UnreadableInput:
    """What is said of a folder without scans."""
    logs = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in LOG_FORMATS)
    kinds = f"{', '.join(SCAN_FORMATS)} or depth {DEPTH_FORMAT} files"
    hint = f"scans are {kinds}; a log is an MCAP or a ROS bag"
    if logs:
        more = ", ..." if len(logs) > LISTED_LOGS else ""
        hint = f"it holds logs, name one of them: {', '.join(map(shown, logs[:LISTED_LOGS]))}{more}"
    return UnreadableInput("no scans in this folder", where=shown(folder), hint=hint)


def by_number(name: str) -> tuple[tuple[int, ...], str]:
    """Return a sort key that puts ``s_9`` before ``s_10``."""
    return tuple(int(n) for n in _NUMBER.findall(name)), name


_PCD_KINDS = {"F": "f", "I": "i", "U": "u"}
_MAX_PCD_HEADER_BYTES = 1 << 16
_MAX_EXPANSION_RATIO = 256  # three bytes of LZF decompress to at most 264


@value_class(eq=True)
class _Header:
    names: tuple[str, ...]
    kinds: tuple[str, ...]
    counts: tuple[int, ...]
    points: int
    form: str
    data_at: int

    @property
    def row(self) -> np.dtype[Any]:
        """Return the numpy type of one point of a binary file."""
        fields = [
            (
                f"{name}_{i}" if name not in "xyz" else name,
                "<" + kind,
                (count,) if count > 1 else (),
            )
            for i, (name, kind, count) in enumerate(
                zip(self.names, self.kinds, self.counts, strict=True)
            )
        ]
        return np.dtype([(n, k, s) for n, k, s in fields])


def read_pcd(data: bytes, budget: ReadBudget | None = None) -> NDArray[Any]:
    """Return the (n, 3) points of a PCD file, float32 or float64, NaN where the sensor had no
    return.

    Args:
        data: the bytes of the file.
        budget: what its content may take; None for the default of a file of this size.

    Raises:
        BadFile: the file is malformed; the text states why.
        OverBudget: its points would take too much memory.
    """
    header, budget = _header(data), budget or ReadBudget(len(data))
    budget.take_bytes(header.points * header.row.itemsize, "points")
    for axis in "xyz":
        if header.names.count(axis) != 1 or header.counts[header.names.index(axis)] != 1:
            raise BadFile(f"its points have no single '{axis}'")
    columns = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}[header.form](
        data, header
    )
    kind = np.float32 if all(c.dtype == np.float32 for c in columns) else np.float64
    return np.stack(columns, axis=1).astype(kind, copy=False)


def _header(data: bytes) -> _Header:
    found: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in found:
        end = data.find(b"\n", at, _MAX_PCD_HEADER_BYTES)
        if end < 0:
            raise BadFile("no PCD header")
        words = data[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            found.setdefault(words[0].upper(), words[1:])
    names = tuple(found.get("FIELDS") or found.get("COLUMNS") or ())
    sizes, types = found.get("SIZE", []), found.get("TYPE", [])
    counts = found.get("COUNT") or ["1"] * len(names)
    if not names or not len(names) == len(sizes) == len(types) == len(counts) <= 1024:
        raise BadFile("FIELDS, SIZE, TYPE and COUNT do not match")
    kinds = tuple(_kind(t, s) for t, s in zip(types, sizes, strict=True))
    form = (found["DATA"] or [""])[0]
    if form not in ("ascii", "binary", "binary_compressed"):
        raise BadFile(f"DATA is '{form}', not ascii, binary or binary_compressed")
    return _Header(names, kinds, tuple(_count(c) for c in counts), _points(found), form, at)


def _kind(type_: str, size: str) -> str:
    kind = f"{_PCD_KINDS.get(type_, '?')}{size}"
    if kind not in ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"):
        raise BadFile(f"a field of TYPE {type_} and SIZE {size}")
    return kind


def _count(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text[:9]) < 1 << 20 or len(text) > 9:
        raise BadFile(f"a COUNT or size of '{text[:40]}'")
    return int(text)


def _points(found: dict[str, list[str]]) -> int:
    numbers = {}
    for key in ("POINTS", "WIDTH", "HEIGHT"):
        text = (found.get(key) or [""])[0]
        if text and (not text.isdecimal() or len(text) > 18):
            raise BadFile(f"{key} is '{text[:40]}'")
        numbers[key] = int(text) if text else None
    width, height = numbers["WIDTH"], numbers["HEIGHT"]
    product = width * height if width is not None and height is not None else None
    points = numbers["POINTS"] if numbers["POINTS"] is not None else product
    if points is None or (product is not None and product != points):
        raise BadFile("WIDTH, HEIGHT and POINTS do not match")
    return points


def _ascii(data: bytes, header: _Header) -> list[NDArray[Any]]:
    words = data[header.data_at :].split()
    width = sum(header.counts)
    if len(words) != header.points * width:
        raise BadFile(
            f"{len(words)} numbers where {header.points} points of {width} need"
            f" {header.points * width}"
        )
    out = []
    for axis in "xyz":
        place = header.names.index(axis)
        column = words[sum(header.counts[:place]) :: width]
        try:
            out.append(np.array(column, dtype=np.float64).astype(_float(header.kinds[place])))
        except ValueError:
            raise BadFile("a point that is not a number") from None
    return out


def _binary(data: bytes, header: _Header) -> list[NDArray[Any]]:
    row = header.row
    if header.points * row.itemsize > len(data) - header.data_at:
        raise BadFile(
            f"{header.points} points of {row.itemsize} bytes in {len(data) - header.data_at} bytes"
        )
    table = np.frombuffer(data, row, header.points, header.data_at)
    return [table[axis].astype(_float(table[axis].dtype.str[1:])) for axis in "xyz"]


def _compressed(data: bytes, header: _Header) -> list[NDArray[Any]]:
    at = header.data_at
    if len(data) < at + 8:
        raise BadFile("ends inside the sizes of its compressed part")
    packed, size = (int.from_bytes(data[at + i : at + i + 4], "little") for i in (0, 4))
    if packed > len(data) - at - 8:
        raise BadFile(f"a compressed part of {packed} bytes in {len(data) - at - 8} bytes")
    if size != header.points * header.row.itemsize or size > packed * _MAX_EXPANSION_RATIO:
        raise BadFile(f"a compressed part that declares {size} bytes")
    raw = unpack_lzf(data[at + 8 : at + 8 + packed], size)
    out, start = [], dict[str, int]()
    place = 0
    for name, kind, count in zip(header.names, header.kinds, header.counts, strict=True):
        start[name] = place  # the values are stored field by field, not point by point
        place += header.points * count * int(kind[1:])
    for axis in "xyz":
        kind = header.kinds[header.names.index(axis)]
        out.append(np.frombuffer(raw, "<" + kind, header.points, start[axis]).astype(_float(kind)))
    return out


def _float(kind: str) -> str:
    return "f4" if kind == "f4" else "f8"


def unpack_lzf(packed: bytes, size: int) -> bytes:
    """Decompress LZF data to exactly ``size`` bytes. Raises BadFile if the data is malformed."""
    out = bytearray()
    at, end = 0, len(packed)
    while at < end:
        control = packed[at]
        at += 1
        if control < 32:  # a sequence of literal bytes
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7 and at < end:
            length += packed[at]
            at += 1
        if at >= end:
            raise BadFile("a compressed part that ends inside a reference")
        back = ((control & 0x1F) << 8 | packed[at]) + 1
        at += 1
        _repeat(out, back, length + 2)
        if len(out) > size:
            break
    if len(out) != size or at > end:
        raise BadFile(f"a compressed part that does not decompress to the {size} bytes it declares")
    return bytes(out)


def _repeat(out: bytearray, back: int, length: int) -> None:
    start = len(out) - back
    if start < 0:
        raise BadFile("a compressed part that refers before its start")
    if back >= length:
        out += out[start : start + length]
    else:
        out += (out[start:] * (length // back + 1))[:length]
