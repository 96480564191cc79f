"""Parts that plug in: classes that this package or another one provides under a name.

A part is a class with the attributes ``name``, ``about`` and ``parameters``, its parameter class
(``settings.Settings``). Back ends of registration, estimators and kinds of fault are parts. A
package registers a part in the entry-point group of its kind. A field that is declared with
``setting(Tables, parts=GROUP)`` contains one table of parameters for each of them:
``[register.NAME]``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any

from avsreplay.errors import UsageError


@dataclass(frozen=True, slots=True)
class BuiltIn:
    """A part that the program itself builds, with the settings of its stage as its parameters.

    Attributes:
        name: of the part.
        about: what it is, in one line.
        parameters: None: it has no table of its own.
    """

    name: str
    about: str
    parameters: None = None


@dataclass(frozen=True, slots=True)
class LawResult:
    """Result of one law of a contract: its name, whether it holds and the figures in one line."""

    law: str
    held: bool
    detail: str


class Parts:
    """The parts of one kind, by name.

    Attributes:
        group: entry-point group in which packages register parts.
        what: name of the kind in error messages.
        where: option or key that names such a part, for error messages.
        built_in: classes that need no entry point, by name.
    """

    def __init__(
        self, group: str, what: str, where: str = "", built_in: Sequence[Any] = ()
    ) -> None:
        """Describe the kind.

        Args:
            group: entry-point group in which packages register parts.
            what: name of the kind in error messages.
            where: option or key that names such a part, for error messages.
            built_in: classes that need no entry point; they come first, in this order.
        """
        self.group, self.what, self.where = group, what, where
        self.built_in = {part.name: part for part in built_in}

    def names(self) -> tuple[str, ...]:
        """Return every name once: those without an entry point, then the others, sorted."""
        return (*self.built_in, *sorted(set(installed(self.group)) - set(self.built_in)))

    def load(self, name: str) -> Any:
        """Return the class of a part.

        Args:
            name: its name.

        Raises:
            UsageError: no part has this name.
            ImportError: its module cannot be imported.
        """
        if name in self.built_in:
            return self.built_in[name]
        found = installed(self.group).get(name)
        if found is None:
            known = ", ".join(self.names())
            hint = f"one of: {known}" if known else "install avsreplay ('pip install .')"
            raise UsageError(f"no {self.what} is called '{name}'", where=self.where, hint=hint)
        return found.load()

    def parameters(self, name: str) -> Any:
        """Return the parameter class of a part; None without one, or where it cannot be imported.

        Args:
            name: its name.
        """
        try:
            return getattr(self.load(name), "parameters", None)
        except (ImportError, UsageError):
            return None


@cache
def installed(group: str) -> dict[str, metadata.EntryPoint]:
    """Return the entry points of a group by name; of two with one name the first by value.

    They are read once, and again after ``installed.cache_clear()``.

    Args:
        group: the group, such as ``avsreplay.backends``.
    """
    found = sorted(metadata.entry_points(group=group), key=lambda entry: entry.value, reverse=True)
    return {entry.name: entry for entry in found}


BACKENDS = Parts("avsreplay.backends", "registration back end", "--backend")
FAULTS = Parts("avsreplay.faults", "kind of fault", "kind")
# the estimators that are no plug-ins
OWN = "own"
PRINTED = "paper"
ESTIMATORS = Parts(
    "avsreplay.estimators",
    "estimator",
    "--estimator",
    (
        BuiltIn(OWN, "batch fit and noise-adaptive constrained filter, with tests of hypotheses"),
        BuiltIn(PRINTED, "the noise-adaptive constrained filter as printed in the paper"),
    ),
)
