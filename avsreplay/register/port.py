"""The port every back end answers to: a protocol, a name in an entry-point group, and the laws of ``contract``.

A back end is a class ``Backend(target)`` registered under the entry-point group ``avsreplay.backends``. It returns a
pose, a count of passes and its own flag, nothing more: ``assess`` grades every pose with one ruler.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from typing import TYPE_CHECKING, Any, Protocol, cast

from numpy.typing import NDArray

from avsreplay.errors import MissingBackend, UsageError
from avsreplay.geometry import Pose
from avsreplay.records import Fit, Surface

if TYPE_CHECKING:
    from avsreplay.register.facing import View
    from avsreplay.register.params import Limits
    from avsreplay.register.surface_index import SurfaceIndex

__all__ = ["GROUP", "Availability", "Backend", "Target", "available", "build", "load", "names"]

GROUP = "avsreplay.backends"


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """What a back end is built from: the surface in {C}, its exact index, the limits, and where the camera was."""

    surface: Surface
    model: SurfaceIndex
    limits: Limits
    view: View


class Backend(Protocol):
    """Aligns a scan to the model it was built with."""

    name: str

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """The pose T_ca that lays the scan on the model.

        Args:
            points: (n, 3) finite, n >= 1, float32 or float64, possibly strided, in {A} [m].
            guess: first T_ca, the inverse of the predicted pose.

        Returns:
            T_ca, the passes made and whether the back end holds its result for settled. Where nothing pulls, the
            guess and False. Anything it raises, and any pose that is not finite, becomes the status FAILED.
        """


Factory = Callable[[Target], Backend]


@dataclass(frozen=True, slots=True)
class Availability:
    """One line of ``avsreplay backends``.

    Attributes:
        name: entry-point name.  installed: can it be built here.  version: of the library behind it, "" if none.
        about: what it does, in one line.  get: how to get it, "" where it is installed.
    """

    name: str
    installed: bool
    version: str
    about: str
    get: str


def names() -> tuple[str, ...]:
    """Every registered name, sorted; a name registered twice counts once."""
    return tuple(sorted({entry.name for entry in metadata.entry_points(group=GROUP)}))


def load(name: str) -> Factory:
    """The back end's class. Raises UsageError for an unknown name, MissingBackend where its library is not here."""
    entry = _entry(name)
    try:
        factory = entry.load()
    except ImportError as error:
        raise _missing(name, f"its module does not load ({error})", "reinstall what provides it") from None
    state = _availability(name, factory)
    if not state.installed:
        raise _missing(name, "is not installed", state.get)
    return cast(Factory, factory)


def build(name: str, factory: Factory, target: Target) -> Backend:
    """The back end itself. Raises MissingBackend where its library is there but does not load."""
    try:
        return factory(target)
    except ImportError as error:
        get = str(getattr(factory, "get", "install the package that provides it"))
        raise _missing(name, f"does not load ({error})", get) from None


def available() -> tuple[Availability, ...]:
    """The state of every registered back end, by name; builds none and imports no registration library."""
    return tuple(_state(name) for name in names())


def _state(name: str) -> Availability:
    try:
        return _availability(name, _entry(name).load())
    except ImportError as error:
        return Availability(name, False, "", f"does not load: {error}", "reinstall what provides it")


def _availability(name: str, factory: Any) -> Availability:
    """Read from the class: ``requires`` (module, distribution), ``about`` and ``get``; all may be absent."""
    requires: tuple[tuple[str, str], ...] = getattr(factory, "requires", ())
    missing = [module for module, _ in requires if importlib.util.find_spec(module) is None]
    version = "" if missing or not requires else _version(requires[0][1])
    get = str(getattr(factory, "get", "install the package that provides it")) if missing else ""
    return Availability(name, not missing, version, str(getattr(factory, "about", "")), get)


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


def _entry(name: str) -> metadata.EntryPoint:
    found = [entry for entry in metadata.entry_points(group=GROUP) if entry.name == name]
    if not found:
        known = ", ".join(names())
        hint = f"one of: {known}" if known else "install avsreplay ('pip install .'), which registers its own"
        raise UsageError(f"no registration back end is called '{name}'", where="--backend", hint=hint)
    return min(found, key=lambda entry: entry.value)  # the same one on every run, were a name registered twice


def _missing(name: str, what: str, get: str) -> MissingBackend:
    return MissingBackend(f"back end '{name}' {what}", where="--backend", hint=f"get it with: {get}")
