"""State of an interrupted run in one file, from which the run continues with the same bits.

The file is a pickle that is read with a restricted reader: it creates objects of the classes of this package that hold
data, and numpy arrays, and refuses everything else, so that a result from elsewhere cannot run code. Objects that a run
builds from its input (model, stages) are not stored but named, and those of the continued run take their places.
"""

from __future__ import annotations

import dataclasses
import io
import pickle
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

from avsreplay.errors import UnreadableInput

_HINT = "start the run anew with --overwrite"
_LIBRARY = {
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("collections", "Counter"),
    ("builtins", "set"),
}
_ACCUMULATORS = {  # classes that collect values scan by scan and are no dataclasses
    ("avsreplay.register.model_check", "ModelCheck"),
    ("avsreplay.report.summary", "SummaryFold"),
    ("avsreplay.report.summary_parts", "CaptureFold"),
    ("avsreplay.result_dir", "Beliefs"),
    ("avsreplay.viewers", "NewPaths"),
    ("avsreplay.result_dir", "ViewWriter"),
    ("avsreplay.score", "Scorer"),
}


def pack_state(value: Any, named: Mapping[str, object]) -> bytes:
    """Return a value as bytes.

    Args:
        value: state of a run: objects of this package, arrays and plain values.
        named: objects that are replaced by their names.
    """
    names = {id(thing): name for name, thing in named.items() if thing is not None}

    class Packer(pickle.Pickler):
        def persistent_id(self, thing: Any) -> str | None:
            return names.get(id(thing))

    stream = io.BytesIO()
    Packer(stream, protocol=5).dump(value)
    return stream.getvalue()


def unpack(path: Path, named: Mapping[str, object]) -> Any:
    """Read a value that ``pack_state`` made.

    Args:
        path: the file.
        named: objects in place of their names.

    Raises:
        UnreadableInput: the file is missing, damaged, of another version, or contains what a checkpoint never contains.
    """
    try:
        return _Unpacker(io.BytesIO(path.read_bytes()), named).load()
    except Exception as error:  # a damaged pickle raises almost any error
        what = f"the checkpoint cannot be read: {error}".splitlines()[0][:200]
        raise UnreadableInput(what, where=str(path), hint=_HINT) from None


class _Unpacker(pickle.Unpickler):
    def __init__(self, stream: io.BytesIO, named: Mapping[str, object]) -> None:
        super().__init__(stream)
        self._named = named

    def persistent_load(self, name: Any) -> object:
        if name not in self._named:
            raise pickle.UnpicklingError(f"no object '{name}'")
        return self._named[name]

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _LIBRARY and not module.startswith("avsreplay."):
            raise pickle.UnpicklingError(f"{module}.{name} is not allowed")
        found = super().find_class(module, name)
        if (module, name) in _LIBRARY or _holds_data(found, module):
            return found
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed")


def _holds_data(found: Any, module: str) -> bool:
    """Whether it is a class of that module and a dataclass, an enumeration or one of the accumulators."""
    if not isinstance(found, type) or found.__module__ != module:
        return False
    known = (module, found.__name__) in _ACCUMULATORS
    return known or dataclasses.is_dataclass(found) or issubclass(found, Enum)
