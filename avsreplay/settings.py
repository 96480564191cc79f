"""Settings, each declared once: default, unit, range, scaling with the target's extent, and
meaning.

A parameter class is a frozen dataclass that derives from ``Settings`` and declares each field with
``setting``. The validation, the values taken from the target's extent, the help texts, the printed
configuration and docs/settings.md are derived from these declarations. ``toml_document`` reads such
a class from TOML and writes it.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, TypeVar, cast

from avsreplay.errors import value_class
from avsreplay.parts import Parts

S = TypeVar("S", bound="Settings")

LARGEST_NUMBER = 1e100  # of every setting: squares and products of two settings remain finite


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """The declaration of one setting.

    Attributes:
        doc: Its meaning, one sentence.
        unit: Its unit, "" without one.
        above: Lower bound that is not allowed itself.
        low: Lower bound that is allowed.
        below: Upper bound that is not allowed itself.
        high: Upper bound that is allowed.
        infinite: Whether infinite values are allowed.
        of_extent: Where the setting is not given: its value as a fraction of the target's extent.
        unset: Where the setting is not given and does not scale with the extent: what applies
            instead.
        one_of: The value is the name of one of these parts.
        parts: The field is a ``Tables`` with one table of parameters for each of these parts.
    """

    doc: str
    unit: str = ""
    above: float | None = None
    low: float | None = None
    below: float | None = None
    high: float | None = None
    infinite: bool = False
    of_extent: float | None = None
    unset: str = ""
    one_of: Parts | None = None
    parts: Parts | None = None

    @property
    def range(self) -> str:
        """The range in words, "" without bounds."""
        lower = (
            f"above {self.above:g}"
            if self.above is not None
            else f"at least {self.low:g}"
            if self.low is not None
            else ""
        )
        upper = (
            f"below {self.below:g}"
            if self.below is not None
            else f"at most {self.high:g}"
            if self.high is not None
            else ""
        )
        return " and ".join(part for part in (lower, upper) if part)

    @property
    def automatic(self) -> str:
        """Return what applies if the setting is not given, "" if it always has a value."""
        per_second = " per second" if self.unit == "m/s" else ""
        return (
            self.unset
            if self.of_extent is None
            else f"{self.of_extent:g} of the target's extent{per_second}"
        )

    def check(self, name: str, value: Any) -> None:
        """Check that a value is in the range.

        Args:
            name: Name of the field, for the error message.
            value: The value; a tuple is checked number by number, anything else but a number is
                accepted.

        Raises:
            SettingError: A number is outside the range.
        """
        if self.one_of is not None and value not in self.one_of.names():
            known = ", ".join(self.one_of.names())
            raise SettingError(name, f"{name} is '{value}', must be one of: {known}")
        several = isinstance(value, tuple)
        for number in value if several else (value,):
            if (
                isinstance(number, (int, float))
                and not isinstance(number, bool)
                and not self._allows(number)
            ):
                unit = f" [{self.unit}]" if self.unit else ""
                each = "each value " if several else ""
                shown = list(value) if several else value
                allowed = self.range or "finite"
                if LARGEST_NUMBER < abs(number) < math.inf:
                    allowed = f"at most {LARGEST_NUMBER:g} in magnitude"
                raise SettingError(name, f"{name} is {shown}, {each}must be {allowed}{unit}")

    def _allows(self, number: float) -> bool:
        inside = (
            (self.above is None or number > self.above)
            and (self.low is None or number >= self.low)
            and (self.below is None or number < self.below)
            and (self.high is None or number <= self.high)
        )
        return inside and (abs(number) <= LARGEST_NUMBER or (self.infinite and math.isinf(number)))


class SettingError(ValueError):
    """A value outside its declared range; ``name`` is the field."""

    def __init__(self, name: str, message: str) -> None:
        """Create the error.

        Args:
            name: Name of the field.
            message: What is wrong.
        """
        super().__init__(message)
        self.name = name


def is_unit(values: Sequence[float], tolerance: float = 1e-3) -> bool:
    """Return whether a vector or a quaternion has the length 1 within ``tolerance``.

    Args:
        values: (n,) components.
        tolerance: largest difference of the length from 1.
    """
    return math.isclose(math.hypot(*values), 1.0, abs_tol=tolerance)


def are_orthonormal(
    first: Sequence[float], other: Sequence[float], tolerance: float = 1e-6
) -> bool:
    """Return whether two vectors have the length 1 and are perpendicular, each within
    ``tolerance``.

    Args:
        first: components of one vector.
        other: components of the other vector.
        tolerance: largest difference of lengths from 1 and of the scalar product from 0.
    """
    cosine = sum(a * b for a, b in zip(first, other, strict=True))
    return is_unit(first, tolerance) and is_unit(other, tolerance) and abs(cosine) <= tolerance


def setting(default: Any = dataclasses.MISSING, doc: str = "", **declared: Any) -> Any:
    """A field of a ``Settings`` class.

    Args:
        default: Default value; a class (a nested table, ``dict`` or ``list``) is called for each
            object. A field without one must be given.
        doc: Its meaning, one plain sentence.
        **declared: The other attributes of ``Setting``.
    """
    metadata = {"setting": Setting(doc=doc, **declared)}
    if isinstance(default, type) and not issubclass(default, enum.Enum):
        return dataclasses.field(default_factory=default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


class Settings:
    """Base of every parameter class. Creating one checks every range; it raises ValueError
    naming the field.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):  # type: ignore[arg-type]
            declared_of(each).check(each.name, getattr(self, each.name))
        self.check()

    def check(self) -> None:
        """Raise ValueError where values do not fit together; a class with such conditions
        overrides this.
        """

    def resolved(self, extent_m: float) -> Self:
        """The same with every setting that scales with the target filled in.

        Args:
            extent_m: The target's extent, the diagonal of its bounding box [m].

        Raises:
            ValueError: The extent is not positive and finite.
        """
        if not 0.0 < extent_m < math.inf:
            raise ValueError(f"extent_m is {extent_m}, must be positive and finite")
        filled = {}
        for each in dataclasses.fields(self):  # type: ignore[arg-type]
            fraction = declared_of(each).of_extent
            if fraction is not None and getattr(self, each.name) is None:
                filled[each.name] = fraction * extent_m
        return dataclasses.replace(self, **filled)  # type: ignore[type-var]


@dataclasses.dataclass(frozen=True, slots=True)
class NoParameters(Settings):
    """The parameter class of a part without parameters."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Tables:
    """The parameters of parts that were given, each a pair of the name and the parameters.

    Tables with the same effect are equal: parameters that are the defaults count as not given.
    """

    given: tuple[tuple[str, Settings], ...] = ()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tables) and self._changed() == other._changed()

    def __hash__(self) -> int:
        return hash(self._changed())

    def _changed(self) -> tuple[tuple[str, Settings], ...]:
        return tuple((name, part) for name, part in self.given if part != type(part)())

    def of(self, name: str, kind: type[S]) -> S:
        """Return the parameters of a part; the defaults where none were given.

        Args:
            name: Its name.
            kind: Its parameter class.
        """
        return cast(S, dict(self.given).get(name) or kind())

    def with_part(self, name: str, kind: type[Settings] | None) -> Tables:
        """Return the tables that change something, and that of a part, given or default.

        Args:
            name: Its name.
            kind: Its parameter class; None: it has no parameters.
        """
        own = {} if kind is None else {name: self.of(name, kind)}
        return Tables(tuple(sorted({**dict(self._changed()), **own}.items())))


def declared_of(field: dataclasses.Field[Any]) -> Setting:
    """Return the declaration of a field, an empty one if it was not declared with ``setting``.

    Args:
        field: A field of a dataclass.
    """
    found: Setting = field.metadata.get("setting", Setting(doc=""))
    return found


def given(value: float | None) -> float:
    """Return a value that ``resolved`` has filled in.

    Args:
        value: Value of a setting that scales with the target.

    Raises:
        ValueError: The value is None.
    """
    if value is None:
        raise ValueError(
            "a setting that scales with the target has no value yet: call resolved(extent_m) first"
        )
    return value


@value_class(eq=True)
class Entry:
    """One setting of a tree of tables: full dotted key, declaration, type and default
    (MISSING: must be given).
    """

    key: str
    declared: Setting
    hint: Any
    default: Any

    @property
    def choices(self) -> tuple[str, ...]:
        """The values of an enumeration, the names of parts, () of anything else."""
        if self.declared.one_of is not None:
            return self.declared.one_of.names()
        kind = _inner(self.hint)
        return (
            tuple(m.value for m in kind)
            if isinstance(kind, type) and issubclass(kind, enum.Enum)
            else ()
        )


def entries(cls: Any, prefix: str = "") -> Iterator[Entry]:
    """Yield every setting of a class and of the tables inside it, in order of declaration.

    Args:
        cls: A dataclass of settings.
        prefix: Text before each key, for example ``register.``.
    """
    hints = typing.get_type_hints(cls)
    for each in dataclasses.fields(cls):
        key, inner = f"{prefix}{each.name}", _inner(hints[each.name])
        parts = declared_of(each).parts
        if parts is not None:
            for name in parts.names():
                yield from entries(parts.parameters(name) or NoParameters, f"{prefix}{name}.")
        elif dataclasses.is_dataclass(inner):
            yield from entries(inner, f"{key}.")
        else:
            default = (
                each.default
                if each.default_factory is dataclasses.MISSING
                else each.default_factory()
            )
            yield Entry(key, declared_of(each), hints[each.name], default)


def value_of(owner: Any, key: str) -> Any:
    """Return the value of a setting.

    Args:
        owner: A dataclass of settings.
        key: Its dotted key, as in ``Entry``.
    """
    for name in key.split("."):
        own = {f.name: declared_of(f).parts for f in dataclasses.fields(owner)}
        of_parts = [(field, parts) for field, parts in own.items() if parts is not None]
        if of_parts and name not in own.keys() - dict(of_parts).keys():
            field, parts = of_parts[0]
            owner = getattr(owner, field).of(name, parts.parameters(name))
        else:
            owner = getattr(owner, name)
    return owner


def _inner(hint: Any) -> Any:
    """The type inside an optional one, or inside a tuple of any length."""
    args = typing.get_args(hint)
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return _inner(next(a for a in args if a is not type(None)))
    return args[0] if typing.get_origin(hint) is tuple and args[1:] == (Ellipsis,) else hint


def dump(value: Any) -> Any:
    """Return a value as plain JSON or TOML values: tables as dicts, enums by value, tuples as
    lists; None is kept.

    Args:
        value: A dataclass, or a value inside one.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        out: dict[str, Any] = {}
        for each in dataclasses.fields(value):
            found = getattr(value, each.name)
            own = dict(found.given) if isinstance(found, Tables) else {each.name: found}
            out.update({name: dump(part) for name, part in own.items()})
        return out
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, Mapping):
        return {str(k): dump(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [dump(v) for v in value]
    if isinstance(value, (str, Path)):  # a name of a file may contain bytes that are not UTF-8
        text = value.as_posix() if isinstance(value, Path) else value
        return text.encode("utf-8", "backslashreplace").decode("utf-8")
    return value
