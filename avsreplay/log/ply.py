"""Reading of PLY files: ascii and both binary byte orders; unknown elements and properties are
skipped.

No library is used. The Stanford scans have a ``range_grid`` element that mesh readers do not
support, and every declared count must be compared with the bytes of the file before memory is
allocated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.read_budget import BadFile, ReadBudget

_PLY_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_MAX_PLY_HEADER_BYTES = 1 << 16
_VALUE_BYTES = 8  # memory of a value


@value_class(eq=True)
class _Property:
    name: str
    kind: str
    count: str | None = None  # type of the length, for a list


@dataclass(slots=True)
class _Element:
    name: str
    size: int
    properties: list[_Property]

    @property
    def plain(self) -> bool:
        return all(p.count is None for p in self.properties)


@value_class
class Ply:
    """The content of a PLY file.

    Attributes:
        vertex: one array (n,) for each vertex property, in the type of the file.
        faces: triangles (m, 3) of vertex indices; polygons are split.
    """

    vertex: dict[str, NDArray[Any]]
    faces: NDArray[np.int64]

    def points(self) -> NDArray[Any]:
        """Return the (n, 3) coordinates in the type of the file.

        Raises BadFile if x, y or z is missing.
        """
        missing = [axis for axis in "xyz" if axis not in self.vertex]
        if missing:
            raise BadFile(f"its vertices have no '{missing[0]}'")
        return np.stack([self.vertex[axis] for axis in "xyz"], axis=1)


def read_ply(data: bytes, budget: ReadBudget | None = None) -> Ply:
    """Parse the bytes of a PLY file.

    Args:
        data: the bytes.
        budget: what its content may take; None for the default of a file of this size.

    Raises:
        BadFile: the file is malformed; the text states why.
        OverBudget: it has too many properties, or its content would take too much memory.
    """
    budget = budget or ReadBudget(len(data))
    order, elements, start = _header(data)
    for element in elements:
        budget.take_records(element.size, f"{element.name} elements")
        budget.take_bytes(_VALUE_BYTES * element.size * len(element.properties), "elements")
    vertex: dict[str, NDArray[Any]] = {}
    faces = np.zeros((0, 3), dtype=np.int64)
    body = _Text(data[start:]) if order is None else _Binary(data, start, order)
    wanted = {"vertex", "face"} & {e.name for e in elements}
    for element in elements:
        if not wanted:
            break
        if element.name == "vertex":
            vertex = body.columns(element)
        elif element.name == "face":
            faces = _triangles(body.lists(element))
        else:
            body.skip(element)
        wanted.discard(element.name)
    if not vertex:
        raise BadFile("no vertex element")
    return Ply(vertex, faces)


def _header(data: bytes) -> tuple[str | None, list[_Element], int]:
    end = data.find(b"end_header", 0, _MAX_PLY_HEADER_BYTES)
    if not data.startswith(b"ply") or end < 0:
        raise BadFile("no PLY header")
    line_end = data.find(b"\n", end)
    lines = data[:end].decode("ascii", "replace").split("\n")
    order, elements = "?", list[_Element]()
    orders = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
    chosen: str | None = order
    for line in lines:
        words = line.split()
        if len(words) >= 2 and words[0] == "format":
            if words[1] not in orders:
                raise BadFile(f"unknown PLY format '{words[1]}'")
            chosen = orders[words[1]]
        elif words[:1] == ["element"]:
            elements.append(_element(words, len(data)))
        elif words[:1] == ["property"]:
            if not elements:
                raise BadFile("a property before any element")
            elements[-1].properties.append(_property(words))
    if chosen == "?":
        raise BadFile("no format line")
    return chosen, elements, (line_end + 1 if line_end >= 0 else len(data))


def _element(words: list[str], limit: int) -> _Element:
    if len(words) != 3 or not words[2].isdecimal():
        raise BadFile(f"unreadable line '{' '.join(words)[:60]}'")
    size = int(words[2][:20])
    if size > limit:
        raise BadFile(f"declares {size} {words[1]} elements in a file of {limit} bytes")
    return _Element(words[1], size, [])


def _property(words: list[str]) -> _Property:
    try:
        if words[1] == "list":
            return _Property(words[4], _PLY_TYPES[words[3]], _PLY_TYPES[words[2]])
        return _Property(words[2], _PLY_TYPES[words[1]])
    except (IndexError, KeyError):
        raise BadFile(f"unreadable line '{' '.join(words)[:60]}'") from None


_Lists = NDArray[np.int64] | list[NDArray[np.int64]]
"""Lists of whole numbers, of equal length as rows of one array."""


class _Text:
    """The body of an ascii file."""

    def __init__(self, body: bytes) -> None:
        self._lines = body.splitlines()
        self._at = 0

    def _take(self, element: _Element) -> list[bytes]:
        lines = self._lines[self._at : self._at + element.size]
        if len(lines) < element.size:
            raise BadFile(f"ends after {len(lines)} of {element.size} {element.name} lines")
        self._at += element.size
        return lines

    def skip(self, element: _Element) -> None:
        self._at += element.size

    def columns(self, element: _Element) -> dict[str, NDArray[Any]]:
        lines, width = self._take(element), len(element.properties)
        if not element.plain:
            raise BadFile("lists among the vertex properties of an ascii file are not read")
        words = b" ".join(lines).split()
        if len(words) != width * element.size:
            raise BadFile(f"{len(words)} numbers in {element.size} vertex lines of {width}")
        try:
            table = np.array(words, dtype=np.float64).reshape(element.size, width)
        except ValueError:
            raise BadFile("a vertex line holds something that is not a number") from None
        with np.errstate(all="ignore"):
            return {p.name: table[:, i].astype(p.kind) for i, p in enumerate(element.properties)}

    def lists(self, element: _Element) -> _Lists:
        """Return the first list of each line; lists of equal length, the common case, are
        converted at once.
        """
        lines = self._take(element)
        before = next((i for i, p in enumerate(element.properties) if p.count is not None), None)
        if before is None:
            return []
        rows = [line.split()[before:] for line in lines]
        if not all(
            words and words[0].isdigit() and len(words) > int(words[0][:9]) for words in rows
        ):
            raise BadFile("a face line is shorter than its own count")
        try:
            lists = [words[1 : 1 + int(words[0])] for words in rows]
            if rows and all(words[0] == rows[0][0] for words in rows):
                return np.array(lists, dtype=np.int64)
            return [np.array(each, dtype=np.int64) for each in lists]
        except (ValueError, OverflowError):
            raise BadFile("a face line holds something that is not a number") from None


class _Binary:
    """The body of a binary file."""

    def __init__(self, data: bytes, start: int, order: str) -> None:
        self._data, self._at, self._order = data, start, order

    def _dtype(self, element: _Element) -> np.dtype[Any]:
        try:
            return np.dtype([(p.name, self._order + p.kind) for p in element.properties])
        except ValueError:
            raise BadFile(f"a property name stands twice in '{element.name}'") from None

    def _read(self, dtype: np.dtype[Any], count: int, what: str) -> NDArray[Any]:
        if self._at + count * dtype.itemsize > len(self._data):
            raise BadFile(f"ends inside its {what} elements")
        values = np.frombuffer(self._data, dtype, count, self._at)
        self._at += count * dtype.itemsize
        return values

    def skip(self, element: _Element) -> None:
        if element.plain:
            self._read(self._dtype(element), element.size, element.name)
        else:
            self.lists(element)

    def columns(self, element: _Element) -> dict[str, NDArray[Any]]:
        if not element.plain:
            raise BadFile("lists among the vertex properties are not read")
        table = self._read(self._dtype(element), element.size, element.name)
        return {p.name: table[p.name].astype(p.kind) for p in element.properties}

    def lists(self, element: _Element) -> _Lists:
        """Return the first list of each element; lists of equal length, the common case, are
        read at once.
        """
        same = self._uniform(element)
        if same is not None:
            return same
        out = []
        for _ in range(element.size):
            found: NDArray[np.int64] | None = None
            for p in element.properties:
                count = 1
                if p.count is not None:
                    count = int(self._read(np.dtype(self._order + p.count), 1, element.name)[0])
                    if count < 0:
                        raise BadFile(f"a list of {count} in '{element.name}'")
                values = self._read(np.dtype(self._order + p.kind), count, element.name)
                found = _whole(values) if p.count is not None and found is None else found
            out.append(np.zeros(0, np.int64) if found is None else found)
        return out

    def _uniform(self, element: _Element) -> NDArray[np.int64] | None:
        if element.size == 0 or len(element.properties) != 1 or element.properties[0].count is None:
            return None
        p = element.properties[0]
        head = np.dtype(self._order + str(p.count))
        if self._at + head.itemsize > len(self._data):
            raise BadFile(f"ends inside its {element.name} elements")
        count = int(np.frombuffer(self._data, head, 1, self._at)[0])
        size = element.size * (head.itemsize + count * np.dtype(p.kind).itemsize)
        if not 0 < count < 256 or self._at + size > len(self._data):
            return None
        row = np.dtype([("n", head), ("v", self._order + p.kind, (count,))])
        table = np.frombuffer(self._data, row, element.size, self._at)
        if not np.all(table["n"] == count):
            return None
        self._at += size
        return _whole(table["v"])


def _whole(values: NDArray[Any]) -> NDArray[np.int64]:
    """Whole numbers of values of any type; what none is has no meaning, and is no corner."""
    with np.errstate(all="ignore"):
        return np.asarray(values.astype(np.int64))


def _triangles(lists: _Lists) -> NDArray[np.int64]:
    """Split polygons into fans of triangles."""
    if isinstance(lists, np.ndarray) and lists.shape[1] == 3:
        return lists
    out = [(face[0], face[i], face[i + 1]) for face in lists for i in range(1, len(face) - 1)]
    return np.array(out, dtype=np.int64).reshape(-1, 3)
