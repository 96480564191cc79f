"""Strict TOML into frozen dataclasses: unknown keys and wrong types are errors with file and line.

Parameters are dataclasses that live beside their algorithm; this is the one door through which text becomes
such an object, for configuration, scenarios and campaigns alike.
"""

from __future__ import annotations

import dataclasses
import difflib
import enum
import re
import tomllib
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from avsreplay.errors import UnreadableInput, UsageError

__all__ = ["Document", "build", "dump", "load", "override", "parse"]

T = TypeVar("T")
_Path = tuple[str | int, ...]
MAX_BYTES = 1 << 20
_HEADER = re.compile(r"^\s*(\[\[?)\s*([^\[\]]+?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"^\s*([A-Za-z0-9_\-.\"']+)\s*=")


@dataclasses.dataclass(frozen=True, slots=True)
class Document:
    """A parsed TOML text that can say on which line a key stands."""

    name: str
    table: Mapping[str, Any]
    text: str = ""

    def where(self, path: Sequence[str | int]) -> str:
        """``name:line`` of the key at ``path`` (array-of-tables entries by index), ``name`` if it has no line."""
        line = _line_of(self.text, path)
        return f"{self.name}:{line}" if line else self.name


def load(path: str | Path) -> Document:
    """Read a TOML file. Raises UnreadableInput where it cannot be read, UsageError where it is not TOML."""
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise UnreadableInput("larger than 1 MiB, not a settings file", where=str(path), hint="name a TOML file")
        text = path.read_bytes().decode("utf-8")
    except FileNotFoundError:
        raise UnreadableInput("no such file", where=str(path), hint="check the path") from None
    except UnicodeDecodeError:
        raise UnreadableInput("not UTF-8 text", where=str(path), hint="name a TOML file") from None
    except OSError as error:
        raise UnreadableInput(error.strerror or "cannot be read", where=str(path), hint="check the path") from None
    return parse(text, str(path))


def parse(text: str, name: str) -> Document:
    """Parse TOML text; ``name`` is what errors call it."""
    try:
        return Document(name, tomllib.loads(text), text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        message = str(error) or "nested too deeply"
        raise UsageError(f"not valid TOML: {message}", where=name, hint="mend the syntax") from None


def build(cls: type[T], document: Document, path: Sequence[str | int] = ()) -> T:
    """The dataclass ``cls`` from the table at ``path`` (an absent table gives the defaults).

    Raises UsageError for an unknown key, a missing one, a wrong type or a value the class refuses (ValueError).
    """
    table: Any = document.table
    for part in path:
        table = table[part] if isinstance(part, int) else table.get(part, {})
    return typing.cast(T, _build(cls, table, document, tuple(path)))


def dump(value: Any) -> Any:
    """A dataclass as plain JSON/TOML values (enums by value, tuples as lists, None left in)."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: dump(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, Mapping):
        return {str(k): dump(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [dump(v) for v in value]
    return str(value) if isinstance(value, Path) else value


def override(document: Document, assignments: Sequence[str]) -> Document:
    """``a.b=c`` assignments over a document; the value is TOML, or a bare word taken as a string."""
    table = _deep_copy(document.table)
    for assignment in assignments:
        key, sep, raw = assignment.partition("=")
        if not sep or not key.strip():
            raise UsageError(
                f"'{assignment}' is not of the form a.b=value", where="--set", hint="for example --set horn.r_max_m=0.2"
            )
        try:
            value = tomllib.loads(f"v = {raw}")["v"]
        except tomllib.TOMLDecodeError:
            value = raw.strip()
        *parents, leaf = key.strip().split(".")
        node = table
        for parent in parents:
            node = node.setdefault(parent, {})
            if not isinstance(node, dict):
                raise UsageError(f"'{parent}' is not a table", where=f"--set {assignment}", hint="check the key")
        node[leaf] = value
    return Document(document.name if document.text else "--set", table, document.text)


def _deep_copy(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _deep_copy(v) for k, v in value.items()}
    return [_deep_copy(v) for v in value] if isinstance(value, list) else value


def _build(cls: Any, table: Any, document: Document, path: _Path) -> Any:
    if not isinstance(table, Mapping):
        raise UsageError(f"'{_dotted(path)}' must be a table", where=document.where(path), hint="write it as [table]")
    hints = typing.get_type_hints(cls)
    known = {f.name: f for f in dataclasses.fields(cls) if f.init}
    for key in table:
        if key not in known:
            close = difflib.get_close_matches(key, known, 1)
            hint = f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(known)}"
            raise UsageError(f"unknown key '{_dotted((*path, key))}'", where=document.where((*path, key)), hint=hint)
    missing = [n for n, f in known.items() if n not in table and f.default is f.default_factory is dataclasses.MISSING]
    if missing:
        raise UsageError(f"missing key '{_dotted((*path, missing[0]))}'", where=document.where(path), hint="add it")
    values = {key: _coerce(hints[key], value, document, (*path, key)) for key, value in table.items()}
    try:
        return cls(**values)
    except ValueError as error:
        raise UsageError(str(error), where=document.where(path), hint="correct the value") from None


def _coerce(hint: Any, value: Any, document: Document, path: _Path) -> Any:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        return _coerce(next(a for a in args if a is not type(None)), value, document, path)
    if dataclasses.is_dataclass(hint):
        return _build(hint, value, document, path)
    if origin is tuple and isinstance(value, list):
        return _coerce_tuple(args, value, document, path)
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        allowed = [m.value for m in hint]
        if value in allowed:
            return hint(value)
        raise UsageError(
            f"'{_dotted(path)}' is {value!r}",
            where=document.where(path),
            hint=f"one of: {', '.join(map(str, allowed))}",
        )
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint is Any or (
        isinstance(hint, type) and isinstance(value, hint) and isinstance(value, bool) == (hint is bool)
    ):
        return value
    raise UsageError(
        f"'{_dotted(path)}' must be {_type_name(hint)}, not {value!r}",
        where=document.where(path),
        hint="correct the value",
    )


def _coerce_tuple(args: tuple[Any, ...], value: list[Any], document: Document, path: _Path) -> tuple[Any, ...]:
    if len(args) == 2 and args[1] is Ellipsis:
        args = (args[0],) * len(value)
    if len(args) != len(value):
        wrong = f"'{_dotted(path)}' must have {len(args)} values, not {len(value)}"
        raise UsageError(wrong, where=document.where(path), hint="correct the value")
    return tuple(_coerce(a, v, document, (*path, i)) for i, (a, v) in enumerate(zip(args, value, strict=True)))


def _dotted(path: Sequence[str | int]) -> str:
    return ".".join(str(p) for p in path)


def _type_name(hint: Any) -> str:
    names = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
    return names.get(hint, f"a list like {hint}" if typing.get_origin(hint) is tuple else str(hint))


def _line_of(text: str, path: Sequence[str | int]) -> int | None:
    """The line a key stands on; falls back to the nearest parent that has one."""
    lines: dict[tuple[str | int, ...], int] = {}
    table: tuple[str | int, ...] = ()
    counts: dict[tuple[str | int, ...], int] = {}
    for number, line in enumerate(text.splitlines(), 1):
        header, key = _HEADER.match(line), _KEY.match(line)
        if header:
            table = tuple(p.strip().strip("\"'") for p in header[2].split("."))
            if header[1] == "[[":
                counts[table] = counts.get(table, -1) + 1
                table = (*table, counts[table])
            lines.setdefault(table, number)
        elif key:
            lines.setdefault((*table, *(p.strip().strip("\"'") for p in key[1].split("."))), number)
    for length in range(len(path), 0, -1):
        if tuple(path[:length]) in lines:
            return lines[tuple(path[:length])]
    return None
