"""Estimators as plug-ins: the protocol, and how a name becomes an estimator.

An estimator is a part (``parts.ESTIMATORS``): a class with five functions, and with its own
parameters in ``[estimator.NAME]``. The program tests each pose (gamma), computes the observability
and plans in the same way for every estimator, so that estimators can be compared.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from avsreplay.errors import MissingBackend, value_class
from avsreplay.geometry import Array, Pose
from avsreplay.parts import ESTIMATORS
from avsreplay.records import Belief, Forecast
from avsreplay.settings import NoParameters, Settings

State = TypeVar("State")


@value_class
class Context:
    """What an estimator is built with.

    Attributes:
        extent_m: diagonal of the target's bounding box [m].
        start: a given belief in {A}, or None: the first pose is all that is known.
        start_1s: (20,) standard deviations of the error states of a start from a pose alone.
        own: the parameters of the estimator, of its class ``parameters``.
    """

    extent_m: float
    start: Belief | None
    start_1s: Array
    own: Settings = NoParameters()


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


def load_method(name: str) -> Callable[[Context], Method[Any]]:
    """Return the class of an estimator.

    Args:
        name: of the entry point.

    Raises:
        UsageError: no estimator has this name.
        MissingBackend: it cannot be imported.
    """
    try:
        found: Callable[[Context], Method[Any]] = ESTIMATORS.load(name)
    except ImportError as error:
        raise MissingBackend(
            f"estimator '{name}' cannot be imported: {error}",
            where="--estimator",
            hint="reinstall the package that provides it",
        ) from error
    return found
