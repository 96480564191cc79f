"""Estimators as plug-ins: the protocol, and how a name becomes an estimator.

An estimator of another package is a class with five functions, registered in the entry-point
group ``avsreplay.estimators``. The program tests each pose (gamma), computes the observability and
plans in the same way for every estimator, so that estimators can be compared.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import metadata
from typing import Any, Protocol, TypeVar

from avsreplay.errors import MissingBackend, UsageError, value_class
from avsreplay.estimate.params import OWN, PRINTED
from avsreplay.geometry import Array, Pose
from avsreplay.records import Belief, Forecast

GROUP = "avsreplay.estimators"
State = TypeVar("State")


@value_class
class Context:
    """What an estimator is built with.

    Attributes:
        extent_m: diagonal of the target's bounding box [m].
        start: a given belief in {A}, or None: the first pose is all that is known.
        start_1s: (20,) standard deviations of the error states of a start from a pose alone.
    """

    extent_m: float
    start: Belief | None
    start_1s: Array


class Method(Protocol[State]):
    """An estimator: five functions from one state to the next; a state is never changed.

    The constructor receives a :class:`Context`. Poses are those of {C} in {A}; the mean and the
    covariance of a ``Belief`` are those of the 20 error states (``avsreplay`` names their order).
    """

    def start(self, t_ns: int, T_ac: Pose) -> State:
        """Return the state before the first scan.

        Args:
            t_ns: instant of the first scan [ns].
            T_ac: its pose, not yet used as a measurement.
        """

    def predict(self, state: State, t_ns: int) -> State:
        """Return the state at the instant [ns] of a scan, before its pose is used."""

    def update(self, state: State, T_ac: Pose, C: Array) -> State:
        """Return the state after a healthy pose.

        Args:
            state: predicted for the instant of the pose.
            T_ac: the measured pose.
            C: (6, 6) covariance of its error d = [theta; v] in {C} [rad, m], T_true = T_ac Exp(d).
        """

    def forecast(self, state: State, times_s: Array) -> Forecast:
        """Return the 1 sigma of the grasp point at times (n,) >= 0, ascending [s after the
        state].
        """

    def belief(self, state: State) -> Belief:
        """Return mean and covariance (20, 20) of the state in {A}."""


def names() -> tuple[str, ...]:
    """The names of the installed estimators, sorted."""
    return tuple(sorted({OWN, PRINTED, *(e.name for e in metadata.entry_points(group=GROUP))}))


def about(name: str) -> str:
    """Return one line about an estimator, from the attribute ``about`` of its class."""
    built_in = {
        OWN: "batch fit and noise-adaptive constrained filter, with tests of hypotheses",
        PRINTED: "the noise-adaptive constrained filter as printed in the paper",
    }
    return built_in.get(name) or str(getattr(load_method(name), "about", ""))


def load_method(name: str) -> Callable[[Context], Method[Any]]:
    """Return the class of an estimator.

    Args:
        name: of the entry point.

    Raises:
        UsageError: no estimator has this name.
        MissingBackend: it cannot be imported.
    """
    found = [entry for entry in metadata.entry_points(group=GROUP) if entry.name == name]
    if not found:
        raise UsageError(
            f"no estimator is called '{name}'",
            where="--estimator",
            hint=f"one of: {', '.join(names())}",
        )
    entry = min(found, key=lambda each: each.value)  # the same one in every run
    try:
        loaded: Callable[[Context], Method[Any]] = entry.load()
    except ImportError as error:
        raise MissingBackend(
            f"estimator '{name}' cannot be imported: {error}",
            where="--estimator",
            hint="reinstall the package that provides it",
        ) from error
    return loaded
