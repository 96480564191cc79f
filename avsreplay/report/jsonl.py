"""Rows as JSON lines: one object per scan, keys in the order of ``Row``'s fields, floats as the
shortest exact text.

A float that is not finite is written as null. Facts about the run are in ``run.json``, so that the
same input gives the same bytes here.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import cache
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any

from avsreplay.binary_files import read_limited
from avsreplay.errors import UnreadableInput
from avsreplay.files import output_text, refuse_pointer
from avsreplay.rows import Row, field_types
from avsreplay.settings import LARGEST_NUMBER
from avsreplay.tables import RowTable

_ROW_COLUMNS = tuple(f.name for f in dataclasses.fields(Row))
_ROW_VALUES = attrgetter(*_ROW_COLUMNS)
_ENCODE = json.JSONEncoder(ensure_ascii=False, allow_nan=False).encode
_PLAIN_TYPES = (float, str, int, bool, type(None))  # types of values that JSON has
_MAX_LINE_BYTES = 1 << 20
_MAX_ROWS_BYTES = 2 << 30
_MAX_NAME_CHARACTERS = 100
_MAX_TEXT_CHARACTERS = 10_000
_READ_BYTES = 1 << 20  # of a file that are read at once, to the end of a line
_MAX_JSON_BYTES = 64 << 20


def plain(value: Any) -> Any:
    """Return a value that JSON has: numpy scalars as those of Python, floats that are not finite as
    None.
    """
    if type(value) not in _PLAIN_TYPES and hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def dump_row(row: Row) -> str:
    """Return a row as one line of JSON, without the line end."""
    values = _ROW_VALUES(row)
    try:
        return _ENCODE(dict(zip(_ROW_COLUMNS, values, strict=True)))
    except (TypeError, ValueError):  # a numpy scalar, or a float that is not finite
        return _ENCODE(dict(zip(_ROW_COLUMNS, map(plain, values), strict=True)))


class RowWriter:
    """Writes rows one after the other; the file appears when the ``with`` block ends without an
    error.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._stack = ExitStack()
        self.count = 0

    def __enter__(self) -> RowWriter:
        self._stream = self._stack.enter_context(output_text(self._path))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self._stack.__exit__(kind, error, tb)

    def write(self, row: Row) -> None:
        """Append one row."""
        self._stream.write(dump_row(row) + "\n")
        self.count += 1


def write_rows(path: str | Path, rows: Iterable[Row]) -> int:
    """Write all rows atomically and return their number.

    Raises:
        UnreadableInput: the path cannot be written.
    """
    with RowWriter(path) as writer:
        for row in rows:
            writer.write(row)
    return writer.count


def read_records(path: str | Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each line as (``file:line``, object of columns).

    The columns are not checked, but every name is printable text and every value is null, a bool, a
    number of 64 bits or printable text.

    Args:
        path: a rows.jsonl file.

    Raises:
        UnreadableInput: the file is missing or larger than 2 GiB, or a line is not such an object.
    """
    for first, _, block in _blocks(Path(path)):
        yield from _records(block, path, first)


def _blocks(path: Path) -> Iterator[tuple[int, int, bytes]]:
    """Yield the number of the first line, the count of line ends, and whole lines, some MiB at a
    time.

    A line that is too long is cut.
    """
    try:
        if path.stat().st_size > _MAX_ROWS_BYTES or not path.is_file():
            raise UnreadableInput(
                "not a rows.jsonl file", where=str(path), hint="name a rows.jsonl file"
            )
        number = 1
        with path.open("rb") as stream:
            while block := stream.read(_READ_BYTES) + stream.readline(_MAX_LINE_BYTES + 1):
                if number == 1:
                    refuse_pointer(block, str(path))
                ends = block.count(b"\n")
                yield number, ends, block
                number += ends
    except OSError as error:
        what = (
            "no such file"
            if isinstance(error, FileNotFoundError)
            else error.strerror or "cannot be read"
        )
        raise UnreadableInput(what, where=str(path), hint="check the path") from None


def _records(block: bytes, path: str | Path, first: int) -> Iterator[tuple[str, dict[str, Any]]]:
    for number, line in enumerate(block.split(b"\n"), first):
        if line.strip():
            yield f"{path}:{number}", _parse(line, f"{path}:{number}")


def _parse(line: bytes, where: str) -> dict[str, Any]:
    hint = "name the directory that 'avsreplay run LOG -o DIR' writes"
    if len(line) > _MAX_LINE_BYTES:
        raise UnreadableInput("a line longer than 1 MiB, not a row", where=where, hint=hint)
    record = parse_json(line, where=where, hint=hint)
    if not isinstance(record, dict):
        raise UnreadableInput("not a JSON object", where=where, hint=hint)
    for name, value in record.items():
        if not name.isprintable() or len(name) > _MAX_NAME_CHARACTERS:
            raise UnreadableInput(
                f"a column with the name {ascii(name)[:40]}", where=where, hint=hint
            )
        if not _is_cell(value):
            raise UnreadableInput(f"column '{name}' is {ascii(value)[:40]}", where=where, hint=hint)
    return record


def _is_cell(value: Any) -> bool:
    if isinstance(value, str):
        return value.isprintable() and len(value) <= _MAX_TEXT_CHARACTERS
    if isinstance(value, float):
        return abs(value) <= LARGEST_NUMBER
    return value is None or (isinstance(value, int) and -(2**63) <= value < 2**63)


def parse_row(record: Mapping[str, Any], where: str) -> Row:
    """Build a row from its JSON object; a text column and one that may be null may be missing.

    Args:
        record: the object.
        where: file and line, for messages.

    Raises:
        UnreadableInput: a column is unknown or missing, or a value has the wrong type.
    """
    types = field_types()
    for name in record:
        if name not in types:
            raise UnreadableInput(
                f"unknown column '{name}'", where=where, hint="was it written by another version?"
            )
    words: dict[str, Any] = {
        name: "" for name, (kind, nullable) in types.items() if kind is str and not nullable
    }
    values = words | dict(record)
    return Row(**{name: _checked(values.get(name), name, *types[name], where) for name in types})


def _checked(value: Any, name: str, kind: type, nullable: bool, where: str) -> Any:
    if value is None and nullable:
        return None
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(value, kind) and isinstance(value, bool) == (kind is bool):
        return value
    what = (
        f"column '{name}' is missing or null" if value is None else f"column '{name}' is {value!r}"
    )
    raise UnreadableInput(what, where=where, hint=f"it must be {kind.__name__}")


def read_rows(path: str | Path) -> RowTable:
    """Read all rows of a file.

    Whole blocks of lines are decoded and checked at once. A block in which anything differs from
    what a run writes is read cell by cell, which accepts it or names line and column.

    Args:
        path: the file.

    Returns:
        The rows.

    Raises:
        UnreadableInput: the file cannot be read, a line is no row, or the scans are not in
            ascending order.
    """
    rows = RowTable()
    for first, ends, block in _blocks(Path(path)):
        found = _checked_at_once(block, ends + (not block.endswith(b"\n")))
        if found is None or any(a.seq >= b.seq for a, b in pairwise([*rows[-1:], *found])):
            _add_cell_by_cell(rows, block, path, first)
        else:
            rows.extend(found)
    return rows


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Pause the garbage collector, which would visit all rows again and again while they are read;
    rows have no cycles.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _add_cell_by_cell(rows: RowTable, block: bytes, path: str | Path, first: int) -> None:
    for where, record in _records(block, path, first):
        row = parse_row(record, where)
        if rows and row.seq <= rows[-1].seq:
            what = f"scan {row.seq} after scan {rows[-1].seq}"
            raise UnreadableInput(
                what, where=where, hint="the file is not as a run wrote it: run again"
            )
        rows.append(row)


def _checked_at_once(block: bytes, lines: int) -> list[Row] | None:
    """The rows of some lines, None where a line is not one object with the columns, types and
    ranges of a row.
    """
    decode = _decoder()
    found = decode(block) if decode else None
    if found is None or len(found) != lines:
        return None
    texts: set[str | None] = set()
    for name, (kind, _) in field_types().items():
        if kind is str:
            texts.update(map(attrgetter(name), found))
    return found if all(text is None or text.isprintable() for text in texts) else None


@cache
def _decoder() -> Callable[[bytes], list[Row] | None] | None:
    """Decodes JSON lines into rows and checks names, types and ranges, without a call for each
    cell.

    The function returns None where a line does not pass. Where msgspec is not installed, None takes
    its place.
    """
    try:
        import msgspec
    except ImportError:
        return None
    meta = msgspec.Meta
    kinds: dict[type, Any] = {
        int: Annotated[int, meta(ge=-(2**63), le=2**63 - 1)],
        float: Annotated[float, meta(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)],
        str: Annotated[str, meta(max_length=_MAX_TEXT_CHARACTERS)],
        bool: bool,
    }
    fields = [
        (name, kinds[kind] | None, None) if nullable else (name, kinds[kind])
        for name, (kind, nullable) in field_types().items()
    ]
    checked = msgspec.defstruct(
        "CheckedRow", fields, kw_only=True, forbid_unknown_fields=True, gc=False
    )
    lines = msgspec.json.Decoder(checked)

    def decode(block: bytes) -> list[Row] | None:
        try:
            return msgspec.convert(lines.decode_lines(block), list[Row], from_attributes=True)
        except (msgspec.MsgspecError, UnicodeError, RecursionError):
            return None

    return decode


def parse_json(text: str | bytes, *, where: str, hint: str) -> Any:
    """Return the value of a JSON text, with finite floats, integers of at most 64 bits and valid
    Unicode only.

    Args:
        text: the text.
        where: the file, for the message.
        hint: what to do, for the message.

    Raises:
        UnreadableInput: the text is no such JSON.
    """
    try:
        value = json.loads(text, parse_constant=_reject_constant)
        _check_json(value)
    except (ValueError, RecursionError) as error:
        reason = "not UTF-8 text" if isinstance(error, UnicodeDecodeError) else "not valid JSON"
        raise UnreadableInput(reason, where=where, hint=hint) from None
    return value


def read_json(path: Path, *, hint: str) -> Any:
    """Return the value of a JSON file, see ``parse_json``.

    Args:
        path: the file.
        hint: what to do where it cannot be read.

    Raises:
        UnreadableInput: the file cannot be read, or is no such JSON.
    """
    return parse_json(read_limited(path, _MAX_JSON_BYTES, hint), where=str(path), hint=hint)


def _reject_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def _check_json(value: Any) -> None:
    """Raise ValueError for a number or a string that JSON permits and this program cannot use."""
    if isinstance(value, str):
        value.encode("utf-8")  # a lone surrogate is a UnicodeEncodeError, which is a ValueError
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError("a number that is too large")
    elif isinstance(value, int) and abs(value) >= 1 << 64:
        raise ValueError("an integer that is too large")
    elif isinstance(value, dict):
        for key, item in value.items():
            _check_json(key)
            _check_json(item)
    elif isinstance(value, list):
        for item in value:
            _check_json(item)
