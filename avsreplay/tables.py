"""Tables of one entry per scan, of which only a part is in memory: rows and poses.

A table is a sequence of the objects that were put into it. Its entries are packed into records of
a spool, and made again when they are read; ``column_of`` takes one column of all rows without
making them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from operator import attrgetter
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Pose
from avsreplay.rows import Row, field_types
from avsreplay.spool import Spool, SpoolFile

_COLUMN_TYPES: dict[type, str] = {float: "f8", int: "i8", bool: "?", str: "u4"}
_KNOWN_FIELD = " known"  # field of the flags that say which columns have a value


class _Rows(Sequence[Row]):
    """A sequence of rows that equals any other with the same ones."""

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sequence):
            return NotImplemented
        return len(self) == len(other) and all(map(Row.__eq__, self, other))

    __hash__ = None  # type: ignore[assignment]


class RowTable(_Rows):
    """Rows, packed: numbers as they are, texts by their place in a list of distinct texts."""

    def __init__(self, rows: Iterable[Row] = ()) -> None:
        """Take rows.

        Args:
            rows: the first ones.
        """
        self._records = Spool(_record())
        self._texts: list[str] = []
        self._codes: dict[str, int] = {}
        self.extend(rows)

    def __len__(self) -> int:
        return len(self._records)

    @overload
    def __getitem__(self, place: int) -> Row: ...
    @overload
    def __getitem__(self, place: slice) -> Sequence[Row]: ...
    def __getitem__(self, place: int | slice) -> Row | Sequence[Row]:
        """Return a row, or a sequence that takes its rows from this table."""
        if isinstance(place, slice):
            return _ChosenRows(self, np.arange(len(self))[place])
        return next(self._rows(self._records[place][None]))

    def __setitem__(self, place: int, row: Row) -> None:
        self._records[place] = self._packed(row)

    def __iter__(self) -> Iterator[Row]:
        for block in self._records.blocks():
            yield from self._rows(block)

    def append(self, row: Row) -> None:
        """Append a row.

        Args:
            row: the row.
        """
        self._records.append(self._packed(row))

    def extend(self, rows: Iterable[Row]) -> None:
        """Append rows.

        Args:
            rows: the rows.
        """
        for row in rows:
            self.append(row)

    def column(self, name: str) -> list[Any]:
        """Return the values of a column in all rows.

        Args:
            name: of the column.
        """
        place, kind = _places()[name], field_types()[name][0]
        out: list[Any] = []
        for block in self._records.blocks():
            values = block[name].tolist()
            if kind is str:
                values = [self._texts[code] if code < len(self._texts) else "" for code in values]
            known = block[_KNOWN_FIELD][:, place]
            if not known.all():
                values = [v if k else None for v, k in zip(values, known.tolist(), strict=True)]
            out += values
        return out

    def numbers(self, name: str) -> NDArray[np.float64]:
        """Return the values of a column of numbers in all rows, NaN where there is none.

        Args:
            name: of the column.
        """
        place, out, end = _places()[name], np.empty(len(self)), 0
        for block in self._records.blocks():
            part = out[end : end + len(block)]
            part[:] = block[name]
            part[~block[_KNOWN_FIELD][:, place]] = np.nan
            end += len(block)
        return out

    def _packed(self, row: Row) -> tuple[Any, ...]:
        values = _values(row)
        filled = [0 if value is None else value for value in values]
        for place in _text_places():
            if values[place] is not None:
                filled[place] = self._code(values[place])
        return (*filled, [value is not None for value in values])

    def _code(self, text: str) -> int:
        code = self._codes.setdefault(text, len(self._texts))
        if code == len(self._texts):
            self._texts.append(text)
        return code

    def _rows(self, block: NDArray[Any]) -> Iterator[Row]:
        texts, places = self._texts, _text_places()
        for (*values, _), known in zip(block.tolist(), block[_KNOWN_FIELD].tolist(), strict=True):
            for place in places:
                if known[place]:
                    values[place] = texts[values[place]]
            cells: Any = [v if k else None for v, k in zip(values, known, strict=True)]
            yield Row(*cells)


class _ChosenRows(_Rows):
    """Some rows of a table."""

    def __init__(self, table: RowTable, places: NDArray[np.int64]) -> None:
        self._table, self._places = table, places

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, place: int) -> Row: ...
    @overload
    def __getitem__(self, place: slice) -> Sequence[Row]: ...
    def __getitem__(self, place: int | slice) -> Row | Sequence[Row]:
        """Return a row, or a sequence that takes its rows from the same table."""
        if isinstance(place, slice):
            return _ChosenRows(self._table, self._places[place])
        return self._table[int(self._places[place])]

    def column(self, name: str) -> list[Any]:
        """The values of a column in these rows."""
        values = self._table.column(name)
        return [values[place] for place in self._places.tolist()]

    def numbers(self, name: str) -> NDArray[np.float64]:
        """The values of a column of numbers in these rows, NaN where there is none."""
        return self._table.numbers(name)[self._places]


@cache
def _record() -> np.dtype[Any]:
    types = field_types()
    fields: list[Any] = [(name, _COLUMN_TYPES[kind]) for name, (kind, _) in types.items()]
    return np.dtype([*fields, (_KNOWN_FIELD, "?", (len(types),))])


@cache
def _places() -> Mapping[str, int]:
    return {name: place for place, name in enumerate(field_types())}


@cache
def _text_places() -> tuple[int, ...]:
    return tuple(k for k, (kind, _) in enumerate(field_types().values()) if kind is str)


def _values(row: Row) -> tuple[Any, ...]:
    return _getter()(row)


@cache
def _getter() -> attrgetter[tuple[Any, ...]]:
    return attrgetter(*field_types())


def column_of(rows: Sequence[Row], name: str) -> list[Any]:
    """Return the values of a column in all rows.

    Args:
        rows: a table, or any other sequence.
        name: of the column.
    """
    if isinstance(rows, (RowTable, _ChosenRows)):
        return rows.column(name)
    return list(map(attrgetter(name), rows))


def numbers(rows: Sequence[Row], name: str) -> NDArray[np.float64]:
    """Return the values of a column of numbers in all rows, NaN where there is none.

    Args:
        rows: a table, or any other sequence.
        name: of the column.
    """
    if isinstance(rows, (RowTable, _ChosenRows)):
        return rows.numbers(name)
    return np.array(list(map(attrgetter(name), rows)), dtype=np.float64)


def chosen(rows: Sequence[Row], which: NDArray[Any]) -> Sequence[Row]:
    """Return some rows, which stay in the table where they come from one.

    Args:
        rows: a table, or any other sequence.
        which: (n,) flags of the rows, or their places.
    """
    places = np.flatnonzero(which) if which.dtype == bool else which
    if isinstance(rows, RowTable):
        return _ChosenRows(rows, places)
    return [rows[place] for place in places.tolist()]


def used_rows(rows: Sequence[Row]) -> Sequence[Row]:
    """Return the rows of the scans that updated the estimate (gamma = 1).

    Args:
        rows: a table, or any other sequence.
    """
    return chosen(rows, numbers(rows, "gamma") == 1.0)


class Columns(Mapping[str, Sequence[Any]]):
    """The columns of rows by name; each is taken from the rows when it is read."""

    def __init__(self, rows: Sequence[Row]) -> None:
        """Refer to rows.

        Args:
            rows: a table, or any other sequence.
        """
        self._rows = rows

    def __getitem__(self, name: str) -> Sequence[Any]:
        """Return a column."""
        if name not in field_types():
            raise KeyError(name)
        return column_of(self._rows, name)

    def numbers(self, name: str) -> NDArray[np.float64]:
        """Return a column of numbers, NaN where there is none.

        Args:
            name: of the column.
        """
        return numbers(self._rows, name)

    def __iter__(self) -> Iterator[str]:
        return iter(field_types())

    def __len__(self) -> int:
        return len(field_types())


class PoseTable(Sequence[tuple[int, Pose]]):
    """Stamped poses (t_ns, T_ac)."""

    def __init__(self, file: SpoolFile | None = None) -> None:
        """Start without poses.

        Args:
            file: temporary file that other tables use as well; None: one of its own.
        """
        file = file or SpoolFile()
        self._t_ns, self._poses = Spool("i8", (), file), Spool("f8", (7,), file)

    def __len__(self) -> int:
        return len(self._t_ns)

    @overload
    def __getitem__(self, place: int) -> tuple[int, Pose]: ...
    @overload
    def __getitem__(self, place: slice) -> Sequence[tuple[int, Pose]]: ...
    def __getitem__(self, place: int | slice) -> Any:
        """Return a stamped pose, or a list of some."""
        if isinstance(place, slice):
            return [self[k] for k in range(*place.indices(len(self)))]
        return _stamped(self._t_ns[place], self._poses[place])

    def __iter__(self) -> Iterator[tuple[int, Pose]]:
        return (self[place] for place in range(len(self)))

    def append(self, t_ns: int, pose: Pose) -> None:
        """Append a stamped pose.

        Args:
            t_ns: its instant.
            pose: the pose T_ac.
        """
        self._t_ns.append(t_ns)
        self._poses.append([*pose.q, *pose.t])

    def arrays(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the instants (n,) [ns] and the poses (n, 7), attitude and position."""
        return self._t_ns.read(0, len(self)), self._poses.read(0, len(self))

    def extend(self, t_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> None:
        """Append the arrays of another table.

        Args:
            t_ns: (n,) instants.
            poses: (n, 7) attitude and position.
        """
        self._t_ns.extend(t_ns)
        self._poses.extend(poses)


def _stamped(t_ns: Any, values: NDArray[np.float64]) -> tuple[int, Pose]:
    """A stored pose, whose quaternion is that of a pose and is not normalised once more."""
    pose = object.__new__(Pose)
    values.flags.writeable = False
    pose.q, pose.t = values[:4], values[4:]  # type: ignore[misc]
    return int(t_ns), pose
