"""Errors that a user can correct, each with its exit code, and the decorator of value classes.

Only the command line prints errors or exits.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar, dataclass_transform, overload

T = TypeVar("T")


@overload
def value_class(cls: type[T], /) -> type[T]: ...
@overload
def value_class(*, kw_only: bool = False, eq: bool = False) -> Callable[[type[T]], type[T]]: ...


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(field,))
def value_class(
    cls: type[T] | None = None, /, *, kw_only: bool = False, eq: bool = False
) -> type[T] | Callable[[type[T]], type[T]]:
    """Make a data class with slots; the type checker reports an assignment to one of its fields.

    Unlike ``dataclass(frozen=True)`` it does not test assignments at run time, and creates an
    object in a tenth of the time and the class in a quarter. Arrays in its fields are read-only.

    Args:
        cls: the class.
        kw_only: fields are given by name.
        eq: values with equal fields are equal and have the same hash.
    """

    def made(cls: type[T]) -> type[T]:
        if "__repr__" not in cls.__dict__:
            cls.__repr__ = _described  # type: ignore[method-assign]
        if eq:
            cls.__eq__, cls.__hash__ = _equal, _hashed  # type: ignore[method-assign]
        return dataclass(slots=True, repr=False, eq=False, kw_only=kw_only)(cls)

    return made if cls is None else made(cls)


def _described(self: Any) -> str:
    """Name and fields of a value; one function for all classes, because each would take 0.1
    ms to make.
    """
    shown = (f"{each.name}={getattr(self, each.name)!r}" for each in fields(self) if each.repr)
    return f"{type(self).__qualname__}({', '.join(shown)})"


def _compared(value: Any) -> tuple[Any, ...]:
    return tuple(getattr(value, each.name) for each in fields(value) if each.compare)


def _equal(self: Any, other: object) -> bool:
    return (
        _compared(self) == _compared(other) if other.__class__ is self.__class__ else NotImplemented
    )


def _hashed(self: Any) -> int:
    return hash(_compared(self))


def counted(count: int, noun: str) -> str:
    """Return a count with its noun for a message, in the plural unless it is one.

    Args:
        count: the number.
        noun: in the singular; its plural ends in s.
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


# C0 and C1 control characters, bidirectional marks, zero-width characters and lone surrogates.
_UNSAFE = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff]"
)


def printable(text: str, keep: str = "") -> str:
    r"""Return a text with every control character replaced by an escape (``\x1b``, ``\u202e``).

    Args:
        text: the text.
        keep: control characters that stay.
    """
    return _UNSAFE.sub(
        lambda m: m[0] if m[0] in keep else m[0].encode("unicode_escape", "surrogatepass").decode(),
        text,
    )


class AvsError(Exception):
    """An error that the user can correct; its text is one line: where, what is wrong, what to
    do.
    """

    exit_code = 2

    def __init__(self, what: str, *, where: str | None = None, hint: str | None = None) -> None:
        """Create the error.

        Args:
            what: what is wrong, in one sentence without a full stop.
            where: file, key, topic or option that it concerns.
            hint: what to do about it.
        """
        super().__init__(what)
        self.what = what
        self.where = where
        self.hint = hint

    def __str__(self) -> str:
        """Return the line that is printed."""
        line = f"{self.where}: {self.what}" if self.where else self.what
        return f"{line}; {self.hint}" if self.hint else line


class CheckFailed(AvsError):
    """A requested check (golden file, gate, contract) failed. Exit code 1."""

    exit_code = 1


class UsageError(AvsError):
    """An option, key or value is invalid. Exit code 2."""

    exit_code = 2


class MissingBackend(UsageError):
    """A back end or an optional dependency is not installed. Exit code 2."""


class UnreadableInput(AvsError):
    """A file is missing, has another format than expected, or cannot be read. Exit code 3."""

    exit_code = 3


class DataLost(AvsError):
    """The command finished, but part of the input could not be read. Exit code 4."""

    exit_code = 4
