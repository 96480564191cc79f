"""TOML documents: reading one into a parameter class (``settings``), overriding keys, and writing
one.

An unknown key, a missing one, a wrong type or a value out of range is a UsageError that names the
file and the line.
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

from avsreplay.errors import UnreadableInput, UsageError, value_class
from avsreplay.parts import Parts
from avsreplay.read_budget import ReadBudget
from avsreplay.settings import Entry, SettingError, Tables, declared_of, dump, entries, value_of

T = TypeVar("T")
_Path = tuple[str | int, ...]
MAX_TOML_BYTES = 1 << 20
_LEAST_SIMILARITY = 0.7  # similarity from which a known key is suggested in place of an unknown one
_MAX_COMPARED_CHARACTERS = 200  # characters of an unknown key that are compared with the known ones
_BYTES_PER_CHARACTER = 8  # memory of parsed TOML for each character of its text
# Three and more keys joined by dots; each part is tried at one place, so that the time is linear.
_MAX_FLOAT_INTEGER = 1 << 1023  # that is taken for a float
_KEY_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DOTTED = re.compile(rf"(?<![A-Za-z0-9_-]){_KEY_PART}(?:[ \t]*+\.[ \t]*+{_KEY_PART}){{2,}}+")
_TABLE_HEADER = re.compile(r"^\s*(\[\[?)\s*([^\[\]]+?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"^\s*([A-Za-z0-9_\-.\"']+)\s*=")


@value_class(eq=True)
class Document:
    """A parsed TOML text; ``origins`` names the source of keys that do not come from this text."""

    name: str
    table: Mapping[str, Any]
    text: str = ""
    origins: Mapping[tuple[str, ...], str] = dataclasses.field(default_factory=dict)

    def where(self, path: Sequence[str | int]) -> str:
        """Return ``name:line`` of a key, ``name`` if it has no line, or where an assignment
        replaced it.

        Args:
            path: the keys from the root to the key; the entries of an array of tables by index.
        """
        wanted = tuple(map(str, path))
        given_by = [name for key, name in self.origins.items() if key[: len(wanted)] == wanted]
        if given_by:
            return ", ".join(given_by)
        line = _line_of(self.text, path)
        return f"{self.name}:{line}" if line else self.name


def load(path: str | Path) -> Document:
    """Read a TOML file.

    Args:
        path: the file.

    Raises:
        UnreadableInput: the file cannot be read, is not UTF-8 text or is larger than 1 MiB.
        UsageError: the file is not TOML.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_TOML_BYTES + 1)  # a pipe or a device has no size
        if len(data) > MAX_TOML_BYTES:
            raise UnreadableInput(
                "larger than 1 MiB, not a settings file", where=str(path), hint="name a TOML file"
            )
        text = data.decode("utf-8")
    except FileNotFoundError:
        raise UnreadableInput("no such file", where=str(path), hint="check the path") from None
    except UnicodeDecodeError:
        raise UnreadableInput("not UTF-8 text", where=str(path), hint="name a TOML file") from None
    except (OSError, ValueError) as error:
        what = getattr(error, "strerror", None) or "cannot be read"
        raise UnreadableInput(what, where=str(path), hint="check the path") from None
    return parse(text, str(path))


def parse(text: str, name: str) -> Document:
    """Parse TOML text.

    Args:
        text: the text.
        name: name of the document in error messages.

    Raises:
        UsageError: the text is not TOML.
    """
    try:
        return Document(name, _loads(text), text)
    except (ValueError, RecursionError) as error:
        message = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise UsageError(
            f"not valid TOML: {message}", where=name, hint="correct the syntax"
        ) from None


def _loads(text: str) -> dict[str, Any]:
    """Parse TOML whose keys are not nested deeply; the time of the parser grows with the square
    of their depth.

    Raises ValueError, which includes OverBudget, or RecursionError.
    """
    budget = ReadBudget(len(text))
    budget.take_bytes(_BYTES_PER_CHARACTER * len(text), "values")
    for found in _DOTTED.finditer(text):
        budget.check_depth(found[0].count(".") + 1, "keys")
    return tomllib.loads(text)


def own_settings(scenario: str, log: str) -> Mapping[str, Any]:
    """Return the table ``[run]`` of the scenario that a log contains; an empty one if there is
    none.

    Args:
        scenario: TOML text from the log, "" for none.
        log: name of the log in error messages.

    Raises:
        UsageError: the text is not TOML, or ``run`` is not a table.
    """
    table = parse(scenario, f"{log} (its scenario)").table.get("run", {})
    if not isinstance(table, Mapping):
        raise UsageError("'run' must be a table", where=f"{log} (its scenario)", hint="record anew")
    return table


class Assignment(str):
    """An assignment ``a.b=value`` that an option other than ``--set`` stands for.

    Attributes:
        given: option or environment variable with its value, as the user wrote it; error messages
            name it.
    """

    __slots__ = ("given",)
    given: str

    def __new__(cls, text: str, given: str) -> Assignment:
        """Create the assignment ``text`` that ``given`` stands for."""
        made = super().__new__(cls, text)
        made.given = given
        return made


def override(document: Document, assignments: Sequence[str]) -> Document:
    """Return the document with assignments applied.

    Args:
        document: the document; it is not changed.
        assignments: each ``a.b=value`` or an ``Assignment``; a value that is not TOML is taken as
            text.

    Raises:
        UsageError: an assignment has another form, or a part of its key is not a table.
    """
    table, origins = _deep_copy(document.table), dict(document.origins)
    for assignment in assignments:
        key, sep, raw = assignment.partition("=")
        given = assignment.given if isinstance(assignment, Assignment) else f"--set {assignment}"
        if not sep or not key.strip():
            hint = "for example --set register.gate_m=0.2"
            raise UsageError(
                f"'{assignment}' is not of the form a.b=value", where="--set", hint=hint
            )
        try:
            value = _loads(f"v = {raw}")["v"]
        except (ValueError, RecursionError):
            value = raw.strip()
        path = tuple(key.strip().split("."))
        node = table
        for parent in path[:-1]:
            node = node.setdefault(parent, {})
            if not isinstance(node, dict):
                raise UsageError(f"'{parent}' is not a table", where=given, hint="check the key")
        node[path[-1]] = value
        origins[path] = given
    return Document(document.name, table, document.text, origins)


def _deep_copy(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _deep_copy(v) for k, v in value.items()}
    return [_deep_copy(v) for v in value] if isinstance(value, list) else value


def build(cls: type[T], document: Document, path: Sequence[str | int] = ()) -> T:
    """Return an instance of ``cls`` made from a table of a document.

    Args:
        cls: a dataclass of settings.
        document: the document.
        path: the keys from the root to the table; an absent table gives the defaults.

    Raises:
        UsageError: a key is unknown or missing, a type is wrong, or a value is invalid for the
            class.
    """
    table: Any = document.table
    for part in path:
        table = table[part] if isinstance(part, int) else table.get(part, {})
    return typing.cast(T, _Builder(cls, document, tuple(path)).table(cls, table, tuple(path)))


def _is_of(value: Any, hint: Any) -> bool:
    """Whether a plain value has the declared type; a truth value is no number."""
    same = isinstance(hint, type) and isinstance(value, hint)
    return same and isinstance(value, bool) == (hint is bool)


class _Builder:
    """Builds one object; uses the document for line numbers and all keys for suggestions."""

    def __init__(self, cls: Any, document: Document, path: _Path) -> None:
        self.document = document
        self.cls, self.prefix = cls, "".join(f"{part}." for part in path)

    def table(self, cls: Any, table: Any, path: _Path) -> Any:
        """The dataclass ``cls`` from a table."""
        if not isinstance(table, Mapping):
            raise self.error(path, f"'{_dotted(path)}' must be a table", "write it as [table]")
        hints = typing.get_type_hints(cls)
        known = {f.name: f for f in dataclasses.fields(cls) if f.init}
        of_parts = [known.pop(f.name) for f in dataclasses.fields(cls) if declared_of(f).parts]
        own = {f.name: self.parts(f, table, path) for f in of_parts}
        taken = {name for tables in own.values() for name, _ in tables.given}
        table = {key: value for key, value in table.items() if key not in taken}
        self._check_keys(table, known, path)
        values = {key: self.value(hints[key], value, (*path, key)) for key, value in table.items()}
        try:
            return cls(**values, **own)
        except SettingError as error:
            prefix = f"{_dotted(path)}." if path else ""
            raise self.error((*path, error.name), f"{prefix}{error}", "correct the value") from None
        except ValueError as error:
            raise self.error(path, str(error), "correct the value") from None

    def _check_keys(
        self, table: Mapping[str, Any], known: Mapping[str, dataclasses.Field[Any]], path: _Path
    ) -> None:
        """Raise UsageError for a key that is unknown or missing."""
        unknown = next((key for key in table if key not in known), None)
        if unknown is not None:
            hint = self.nearest(path, unknown, table[unknown], known)
            raise self.error((*path, unknown), f"unknown key '{_dotted((*path, unknown))}'", hint)
        required = (
            n for n, f in known.items() if f.default is f.default_factory is dataclasses.MISSING
        )
        missing = next((name for name in required if name not in table), None)
        if missing:
            raise self.error(path, f"missing key '{_dotted((*path, missing))}'", "add it")

    def parts(self, field: dataclasses.Field[Any], table: Mapping[str, Any], path: _Path) -> Tables:
        """The tables of a field that belong to installed parts."""
        parts = typing.cast(Parts, declared_of(field).parts)
        kinds = {name: parts.parameters(name) for name in table if name in parts.names()}
        given = [
            (name, self.table(kind, table[name], (*path, name)))
            for name, kind in sorted(kinds.items())
            if kind is not None
        ]
        return Tables(tuple(given))

    def value(self, hint: Any, value: Any, path: _Path) -> Any:
        """A value of the type that a field declares."""
        origin, args = typing.get_origin(hint), typing.get_args(hint)
        if origin in (typing.Union, types.UnionType):
            inner = next(each for each in args if each is not type(None))
            return None if value is None else self.value(inner, value, path)
        if dataclasses.is_dataclass(hint):
            return self.table(hint, value, path)
        if origin is tuple and isinstance(value, (list, tuple)):
            return self._tuple(args, value, path)
        if isinstance(hint, type) and issubclass(hint, enum.Enum):
            return self._member(hint, value, path)
        if hint is float and type(value) is int and abs(value) <= _MAX_FLOAT_INTEGER:
            return float(value)
        if hint is Path and isinstance(value, str):
            return Path(value)
        if hint is Any or _is_of(value, hint):
            return value
        shown = repr(value) if len(repr(value)) <= 60 else f"{repr(value)[:57]}..."
        raise self.error(
            path, f"'{_dotted(path)}' must be {_type_name(hint)}, not {shown}", "correct the value"
        )

    def _member(self, kind: type[enum.Enum], value: Any, path: _Path) -> enum.Enum:
        allowed = [member.value for member in kind]
        if value in allowed:
            return kind(value)
        raise self.error(
            path, f"'{_dotted(path)}' is {value!r}", f"one of: {', '.join(map(str, allowed))}"
        )

    def _tuple(self, args: tuple[Any, ...], value: Sequence[Any], path: _Path) -> tuple[Any, ...]:
        if len(args) == 2 and args[1] is Ellipsis:
            args = (args[0],) * len(value)
        if len(args) != len(value):
            raise self.error(
                path,
                f"'{_dotted(path)}' must have {len(args)} values, not {len(value)}",
                "correct the value",
            )
        return tuple(
            self.value(a, v, (*path, i)) for i, (a, v) in enumerate(zip(args, value, strict=True))
        )

    def nearest(self, path: _Path, key: str, value: Any, known: Mapping[str, Any]) -> str:
        """A hint that names the known key most like an unknown one, of this table or of any
        other.
        """
        inside: _Path = (key,)
        while (
            isinstance(value, Mapping) and value
        ):  # an unknown table: its content determines the suggestion
            name, value = next(iter(value.items()))
            inside = (*inside, name)
        whole, leaf = (
            _dotted((*path, *inside))[:_MAX_COMPARED_CHARACTERS],
            str(inside[-1])[:_MAX_COMPARED_CHARACTERS],
        )

        def likeness(entry: str) -> tuple[float, float]:
            in_full = difflib.SequenceMatcher(None, whole, entry).ratio()
            return (
                max(in_full, difflib.SequenceMatcher(None, leaf, entry.rpartition(".")[2]).ratio()),
                in_full,
            )

        here = [_dotted((*path, name)) for name in known]
        every = [*here, *(entry.key for entry in entries(self.cls, self.prefix))]
        best = max(every, key=likeness, default="")
        if likeness(best)[0] >= _LEAST_SIMILARITY:
            return f"did you mean '{best}'?"
        return f"known keys: {', '.join(known) or 'none'}"

    def error(self, path: _Path, what: str, hint: str) -> UsageError:
        """A UsageError that names the place of ``path``."""
        return UsageError(what, where=self.document.where(path), hint=hint)


def _dotted(path: Sequence[str | int]) -> str:
    return ".".join(str(p) for p in path)


def _type_name(hint: Any) -> str:
    """The type of a value in words, for example "a list of 3 numbers"."""
    names = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
    if typing.get_origin(hint) is not tuple:
        return names.get(hint, str(hint))
    of = typing.get_args(hint)
    words = {"a number": "numbers", "a whole number": "whole numbers", "text": "texts"}
    inside = words.get(names.get(of[0], ""), "values")
    return f"a list of {inside}" if of[-1] is Ellipsis else f"a list of {len(of)} {inside}"


def _line_of(text: str, path: Sequence[str | int]) -> int | None:
    """The line of a key, or of its nearest parent that has one."""
    lines: dict[tuple[str | int, ...], int] = {}
    table: tuple[str | int, ...] = ()
    counts: dict[tuple[str | int, ...], int] = {}
    for number, line in enumerate(text.splitlines(), 1):
        header, key = _TABLE_HEADER.match(line), _KEY.match(line)
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


def to_toml(value: Any, name: str = "") -> str:
    """A parameter object as commented TOML that ``build`` reads back; a setting without a value is
    a comment.

    Args:
        value: The object.
        name: First line of comment, "" for none.
    """
    lines = [f"# {name}"] if name else []
    table = ""
    for entry in sorted(
        entries(type(value)), key=lambda each: "." in each.key
    ):  # a key after a table is the table's
        parent, _, leaf = entry.key.rpartition(".")
        if parent != table:
            lines += ["", f"[{parent}]"]
            table = parent
        lines += ["", *_commented(entry), _assignment(leaf, value_of(value, entry.key), entry)]
    return "\n".join(lines).lstrip("\n") + "\n"


def _commented(entry: Entry) -> list[str]:
    import textwrap

    declared, facts = entry.declared, []
    if declared.range:
        facts.append(declared.range)
    if entry.choices:
        facts.append(f"one of: {', '.join(entry.choices)}")
    if entry.default is not None:
        facts.append(f"default {toml_value(entry.default)}")
    unit = f" [{declared.unit}]" if declared.unit else ""
    text = f"{declared.doc}{unit}" + (f" ({'; '.join(facts)})" if facts else "")
    return textwrap.wrap(
        text, 118, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False
    )


def _assignment(leaf: str, value: Any, entry: Entry) -> str:
    if value is None:
        return f"# {leaf} is not set: {entry.declared.automatic or 'off'}"
    return f"{leaf} = {toml_value(value)}"


def toml_value(value: Any) -> str:
    """Return a value as TOML on one line.

    Args:
        value: a number, text, flag, list, tuple, enum or dataclass.
    """
    import tomli_w

    text = tomli_w.dumps({"v": dump(value)}).removeprefix("v = ").rstrip("\n")
    if isinstance(value, (tuple, list)):  # on one line; line breaks inside texts are escaped
        text = re.sub(r"\n\s*", " ", text).replace("[ ", "[").replace(", ]", "]")
    return text
