"""Reading of PCD files: ascii, binary and binary_compressed (LZF), with any fields.

No library is used because every declared size must be checked against the bytes of the file before memory is
allocated, also inside the compressed part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.files import BadFile

_KINDS = {"F": "f", "I": "i", "U": "u"}
_MAX_HEADER = 1 << 16
_MAX_RATIO = 256  # three bytes of LZF decompress to at most 264


@dataclass(frozen=True, slots=True)
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
            (f"{name}_{i}" if name not in "xyz" else name, "<" + kind, (count,) if count > 1 else ())
            for i, (name, kind, count) in enumerate(zip(self.names, self.kinds, self.counts, strict=True))
        ]
        return np.dtype([(n, k, s) for n, k, s in fields])


def read_pcd(data: bytes) -> NDArray[Any]:
    """Return the (n, 3) points of a PCD file, float32 or float64, NaN where the sensor had no return.

    Raises BadFile if the file is malformed; the text states why.
    """
    header = _header(data)
    for axis in "xyz":
        if header.names.count(axis) != 1 or header.counts[header.names.index(axis)] != 1:
            raise BadFile(f"its points have no single '{axis}'")
    columns = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}[header.form](data, header)
    kind = np.float32 if all(c.dtype == np.float32 for c in columns) else np.float64
    return np.stack(columns, axis=1).astype(kind, copy=False)


def _header(data: bytes) -> _Header:
    found: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in found:
        end = data.find(b"\n", at, _MAX_HEADER)
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
    kind = f"{_KINDS.get(type_, '?')}{size}"
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
        raise BadFile(f"{len(words)} numbers where {header.points} points of {width} need {header.points * width}")
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
        raise BadFile(f"{header.points} points of {row.itemsize} bytes in {len(data) - header.data_at} bytes")
    table = np.frombuffer(data, row, header.points, header.data_at)
    return [table[axis].astype(_float(table[axis].dtype.str[1:])) for axis in "xyz"]


def _compressed(data: bytes, header: _Header) -> list[NDArray[Any]]:
    at = header.data_at
    if len(data) < at + 8:
        raise BadFile("ends inside the sizes of its compressed part")
    packed, size = (int.from_bytes(data[at + i : at + i + 4], "little") for i in (0, 4))
    if packed > len(data) - at - 8:
        raise BadFile(f"a compressed part of {packed} bytes in {len(data) - at - 8} bytes")
    if size != header.points * header.row.itemsize or size > packed * _MAX_RATIO:
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
