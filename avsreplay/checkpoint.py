"""The state of an interrupted run as declared data, from which it continues with the same bits.

A checkpoint is an uncompressed archive of one array for each type of number, and of a JSON document
that describes the objects. The document is derived from the declarations of the data classes:
reading it creates objects of the data classes and enumerations of this package with exactly their
declared fields, whose values have their declared types; containers; and arrays of numbers. It
calls no function and no constructor, so that a file from elsewhere cannot execute code.

Objects that a run builds from its input (model, stages) are not stored but named, and those of the
continued run take their places. Objects that collect values scan by scan and are no data classes
are read only where the continued run has one of the same class, with the same attributes. One
object that is referred to from several places is one object again.
"""

from __future__ import annotations

import dataclasses
import importlib
import io
import json
import math
import types
import typing
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from avsreplay.binary_files import parse_npy, read_limited, read_members
from avsreplay.errors import UnreadableInput
from avsreplay.read_budget import BadFile, ReadBudget

CHECKPOINT_VERSION = 3  # of the format of the document; a file of another version is not read

_PACKAGE = __name__.partition(".")[0]
_HINT = "start the run anew with --overwrite"
_MAX_CHECKPOINT_BYTES = 16 << 30
_DOCUMENT = "state.json"
_ATOMS = (str, bool, int, type(None))
_CONTAINERS: dict[str, Callable[[Iterable[Any]], Any]] = {
    "list": list,
    "tuple": tuple,
    "set": set,
    "frozenset": frozenset,
}
_MAPPINGS: dict[str, Callable[[Iterable[tuple[Any, Any]]], Any]] = {
    "dict": dict,
    "Counter": lambda pairs: Counter(dict(pairs)),
}
_NUMBERS = {"f8": float, "i8": int}  # lists of these alone are stored as arrays
_ARRAY_KINDS = ("f8", "f4", "f2", "i8", "i4", "i2", "i1", "u8", "u4", "u2", "u1", "b1")


def pack(value: Any, named: Mapping[str, object]) -> bytes:
    """Return a value as bytes.

    Args:
        value: state of a run: objects of this package, arrays and plain values, without circles.
        named: objects that are replaced by their names.

    Raises:
        TypeError: the value contains an object of another kind.
    """
    return _Packer(named).packed(value)


def unpack(path: Path, named: Mapping[str, object], like: object = None) -> Any:
    """Read a value that ``pack`` made.

    Args:
        path: the file.
        named: objects in place of their names.
        like: a value of the same structure: where it is not None, the value read has its type, and
            its attributes if it is no data class. Only classes of such attributes that occur here
            are read.

    Raises:
        UnreadableInput: the file is missing, damaged, of another version, or contains what a
            checkpoint never contains.
    """
    data = read_limited(path, _MAX_CHECKPOINT_BYTES, _HINT)
    try:
        return _Reader(data, named, like).value()
    except (BadFile, ArithmeticError, LookupError, RecursionError, TypeError, ValueError) as error:
        what = f"the checkpoint cannot be read: {error}".splitlines()[0][:200]
        raise UnreadableInput(what, where=str(path), hint=_HINT) from None


class _Packer:
    """Collects the nodes of a document, each after those that it contains, and its arrays."""

    def __init__(self, named: Mapping[str, object]) -> None:
        self._names = {id(thing): name for name, thing in named.items() if thing is not None}
        self._nodes: list[list[Any]] = []
        self._places: dict[int, int | None] = {}  # of each object; None while it is being packed
        self._kept: list[Any] = []  # objects made here, whose identity must stay unique
        self._arrays: dict[str, list[NDArray[Any]]] = {}
        self._lengths: Counter[str] = Counter()

    def packed(self, value: Any) -> bytes:
        root = self._child(value)
        document = {"version": CHECKPOINT_VERSION, "root": root, "nodes": self._nodes}
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        out = io.BytesIO()
        numbers = {
            kind: np.concatenate(parts) if kind != "b1" else np.concatenate(parts).view("u1")
            for kind, parts in sorted(self._arrays.items())
        }
        arrays: dict[str, Any] = {_DOCUMENT: np.frombuffer(text, "u1"), **numbers}
        np.savez(out, allow_pickle=False, **arrays)
        return out.getvalue()

    def _child(self, value: Any) -> Any:
        """A plain value as it is, another one as the place of its node."""
        if type(value) in _ATOMS or (type(value) is float and math.isfinite(value)):
            return value
        found = self._places.get(id(value), -1)
        if found is None:
            raise TypeError(f"a {type(value).__name__} that contains itself")
        if found < 0:
            self._places[id(value)] = None
            node = self._node(value)
            self._kept.append(value)
            found = self._places[id(value)] = len(self._nodes)
            self._nodes.append(node)
        return [found]

    def _node(self, value: Any) -> list[Any]:
        cls = type(value)
        if id(value) in self._names:
            return ["named", self._names[id(value)]]
        if cls is float:
            return ["float", repr(value)]
        if isinstance(value, (np.ndarray, np.generic)):
            return ["array" if isinstance(value, np.ndarray) else "scalar", *self._array(value)]
        if cls.__name__ in _CONTAINERS and _CONTAINERS[cls.__name__] is cls:
            return self._container(value)
        if cls in (dict, Counter):
            return [cls.__name__, *(self._child(part) for pair in value.items() for part in pair)]
        if isinstance(value, Enum):
            return ["enum", _name_of(cls), value.name]
        if not cls.__module__.startswith(f"{_PACKAGE}."):
            raise TypeError(f"a {cls.__name__} cannot be stored in a checkpoint")
        return ["object", _name_of(cls), {k: self._child(v) for k, v in _attributes(value)}]

    def _container(self, value: Any) -> list[Any]:
        kind = type(value).__name__
        for dtype, number in _NUMBERS.items():
            ordered = len(value) > 1 and kind in ("list", "tuple")
            if ordered and all(type(each) is number for each in value):
                try:
                    return ["numbers", kind, *self._array(np.array(value, dtype))]
                except OverflowError:
                    break  # whole numbers over 64 bits
        return [kind, *map(self._child, value)]

    def _array(self, value: Any) -> list[Any]:
        """Type, place among the numbers of the type, shape, order and whether it may be changed."""
        array = np.asarray(value)
        kind = array.dtype.str[1:]
        if kind not in _ARRAY_KINDS:
            raise TypeError(f"an array of {array.dtype} cannot be stored in a checkpoint")
        order: Literal["F", "C"] = (
            "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
        )
        native = array.astype(array.dtype.newbyteorder("="), copy=False)
        self._arrays.setdefault(kind, []).append(native.ravel(order=order))
        start = self._lengths[kind]
        self._lengths[kind] += array.size
        return [kind, start, list(array.shape), order, bool(array.flags.writeable)]


def _name_of(cls: type) -> str:
    return f"{cls.__module__}:{cls.__qualname__}"


def _attributes(value: Any) -> Iterable[tuple[str, Any]]:
    """The fields of a data class that are stored, or the attributes of another object."""
    if dataclasses.is_dataclass(value):
        return [(name, getattr(value, name)) for name in _fields(value.__class__)]
    return list(vars(value).items())


@cache
def _fields(cls: type[Any]) -> dict[str, Any]:
    """The stored fields of a data class, with their types as far as they can be resolved."""
    try:
        hints = typing.get_type_hints(cls)
    except NameError:  # a name that is imported for the type checker only
        hints = {}
    return {field.name: hints.get(field.name, Any) for field in dataclasses.fields(cls)}


class _Reader:
    """Creates the objects of a document in the order of its nodes."""

    def __init__(self, data: bytes, named: Mapping[str, object], like: object) -> None:
        self._named, self._like = named, like
        self._collectors = {type(each) for each in _collectors(like, set())}
        members = {
            name.removesuffix(".npy"): parse_npy(member)
            for name, member in read_members(data, ReadBudget(len(data))).items()
        }
        if _DOCUMENT not in members:
            raise BadFile("it has no document")
        document = json.loads(members.pop(_DOCUMENT).tobytes(), parse_constant=_no_number)
        if (
            document.keys() != {"version", "root", "nodes"}
            or document["version"] != CHECKPOINT_VERSION
        ):
            raise BadFile("it has another version")
        self._arrays = {
            kind: array.view("?") if kind == "b1" else array for kind, array in members.items()
        }
        if any(
            kind not in _ARRAY_KINDS or a.dtype.str[1:] != kind for kind, a in self._arrays.items()
        ):
            raise BadFile("an array of another type")
        self._root, self._nodes = document["root"], document["nodes"]
        self._values: list[Any] = []

    def value(self) -> Any:
        """The value of the document."""
        for kind, *parts in self._nodes:
            self._values.append(self._made(kind, parts))
        found = self._of(self._root)
        _check_alike(found, self._like)
        return found

    def _of(self, part: Any) -> Any:
        if not isinstance(part, list):
            return part
        (place,) = part
        if type(place) is not int or not 0 <= place < len(self._values):
            raise BadFile("a reference to an object that does not exist")
        return self._values[place]

    def _made(self, kind: str, parts: list[Any]) -> Any:
        if kind in _CONTAINERS:
            return _CONTAINERS[kind](map(self._of, parts))
        if kind in _MAPPINGS:
            pairs = zip(map(self._of, parts[::2]), map(self._of, parts[1::2]), strict=True)
            return _MAPPINGS[kind](pairs)
        return self._special(kind, *parts)

    def _special(self, kind: str, *parts: Any) -> Any:
        if kind == "named":
            return self._named[parts[0]]
        if kind == "float":
            return float(parts[0])
        if kind == "array":
            return self._array(*parts)
        if kind == "scalar":
            return self._array(*parts)[()]
        if kind == "numbers":
            return _CONTAINERS[parts[0]](self._array(*parts[1:]).tolist())
        if kind == "enum":
            return _class_of(parts[0], Enum)[parts[1]]
        if kind == "object":
            return self._object(*parts)
        raise BadFile("an object of an unknown kind")

    def _array(
        self, kind: str, start: int, shape: list[int], order: str, writeable: bool
    ) -> NDArray[Any]:
        count = math.prod(shape)
        numbers = self._arrays[kind]
        if start < 0 or min(shape, default=0) < 0 or start + count > len(numbers):
            raise BadFile("an array that the file does not contain")
        array = numbers[start : start + count].reshape(shape, order="F" if order == "F" else "C")
        array = array.copy(order="K")
        array.flags.writeable = writeable
        return array

    def _object(self, name: str, attributes: Mapping[str, Any]) -> Any:
        cls = _class_of(name, object)
        declared = dataclasses.is_dataclass(cls)
        if not declared and cls not in self._collectors:
            raise BadFile(f"{name} is not allowed")
        made = object.__new__(cls)
        if declared:
            types_of = _fields(cls)
            if attributes.keys() != types_of.keys():
                raise BadFile(f"a {cls.__name__} with other attributes")
            for field in dataclasses.fields(cls):
                if field.name not in types_of:
                    object.__setattr__(made, field.name, _default(field))
        for attribute, part in attributes.items():
            value = self._of(part)
            if declared and not _fits(value, types_of[attribute]):
                kind = type(value).__name__
                raise BadFile(f"a {kind} as the {attribute} of a {cls.__name__}")
            object.__setattr__(made, attribute, value)
        return made


def _no_number(name: str) -> None:
    raise BadFile(f"{name} is not JSON")


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _class_of(name: str, base: type) -> Any:
    """The class of this package with a name; its module is imported, which does nothing else."""
    module, _, path = name.partition(":")
    if not module.startswith(f"{_PACKAGE}.") or module.endswith("__main__"):
        raise BadFile(f"{name} is not allowed")
    try:
        found: Any = importlib.import_module(module)
        for part in path.split("."):
            found = vars(found)[part]
    except (ImportError, KeyError, TypeError):
        raise BadFile(f"no class {name}") from None
    if not isinstance(found, type) or not issubclass(found, base) or found.__module__ != module:
        raise BadFile(f"{name} is not allowed")
    return found


def _collectors(value: object, seen: set[int]) -> Iterable[object]:
    """Objects of this package that are no data classes, in a value and in their attributes."""
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, (tuple, list)):
        for each in value:
            yield from _collectors(each, seen)
    elif _collects(value):
        yield value
        for each in vars(value).values():
            if _collects(each):
                yield from _collectors(each, seen)


def _collects(value: object) -> bool:
    """Whether a value is an object of this package with attributes, but no data class."""
    cls = type(value)
    own = cls.__module__.startswith(f"{_PACKAGE}.") and hasattr(value, "__dict__")
    return own and not dataclasses.is_dataclass(value) and not isinstance(value, Enum)


def _check_alike(found: Any, like: Any) -> None:
    """Raise BadFile where the types or the attributes of two values differ; None is like
    everything.
    """
    if like is None or found is like:
        return
    if not _alike(type(found), type(like)) or (isinstance(like, tuple) and len(found) != len(like)):
        raise BadFile(f"a {type(found).__name__} in place of a {type(like).__name__}")
    if isinstance(like, tuple):
        for one, other in zip(found, like, strict=True):
            _check_alike(one, other)
    elif isinstance(like, np.ndarray):
        if (found.ndim, found.dtype) != (like.ndim, like.dtype):
            raise BadFile(f"an array of {found.ndim} dimensions in place of {like.ndim}")
    elif _collects(like):
        if vars(found).keys() != vars(like).keys():
            raise BadFile(f"a {type(like).__name__} with other attributes")
        for name, own in vars(like).items():
            _check_alike(vars(found)[name], own)


def _alike(found: type, like: type) -> bool:
    numbers = (int, float, np.number)
    return found is like or (issubclass(found, numbers) and issubclass(like, numbers))


_NUMBER_CLASSES: dict[Any, tuple[type, ...]] = {
    float: (float, int, np.floating, np.integer),
    int: (int, np.integer),
    bool: (bool, np.bool_),
}


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value has a declared type; a type that cannot be tested fits everything."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, each) for each in args)
    if origin is typing.Literal:
        return value in args
    kind = origin or hint
    if kind is tuple and isinstance(value, tuple):
        return _tuple_fits(value, args)
    if kind in _NUMBER_CLASSES:
        return isinstance(value, _NUMBER_CLASSES[kind]) and isinstance(value, bool) <= (
            kind is bool
        )
    if kind is None or kind is type(None):
        return value is None
    if kind is Any or not isinstance(kind, type) or getattr(kind, "_is_protocol", False):
        return True
    return isinstance(value, kind) and (
        not (isinstance(value, (list, set, frozenset)) and len(args) == 1)
        or all(_fits(each, args[0]) for each in value)
    )


def _tuple_fits(value: tuple[Any, ...], args: tuple[Any, ...]) -> bool:
    if len(args) == 2 and args[1] is Ellipsis:
        return all(_fits(each, args[0]) for each in value)
    same = len(value) == len(args)
    return not args or (same and all(_fits(v, hint) for v, hint in zip(value, args, strict=True)))
