"""A whole motion from one initial state: at many instants at once, with derivatives, or at any instant when asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avsreplay.estimate import _motion
from avsreplay.estimate.motion import ratios, sigma_join
from avsreplay.geometry import Array
from avsreplay.records import State

__all__ = ["Arc", "Path", "arc"]

_CALM = (0.0, 0.0, 0.0)  # no disturbance


@dataclass(frozen=True, slots=True, eq=False)
class Arc:
    """Rotation at n instants from one initial state.

    Attributes:
        q: (n, 4) attitude q_ab.  w: (n, 3) rate in {B} [rad/s].
        S: (n, 6, 8) derivative of (dq_v, w) at each instant by (dq_v, w, sigma) at the start.
    """

    q: Array
    w: Array
    S: Array


def arc(x: State, times_s: Array) -> Arc:
    """The motion from ``x`` at 0 to each of ``times_s`` (n,) [s], of either sign; it is walked in their order."""
    q, w, S, _ = _motion.follow(x.q_ab, x.w_b, ratios(x.sigma), _CALM, np.asarray(times_s, dtype=np.float64))
    return Arc(q, w, np.concatenate([S[:, :, :6], S[:, :, 6:] @ sigma_join(x.sigma)], axis=2))


class Path:
    """A motion to be asked many times, at any instants; what was worked out on the way to one serves the next."""

    def __init__(self, x: State) -> None:
        self._path = _motion.Path(x.q_ab, x.w_b, ratios(x.sigma))

    def at(self, times_s: Array) -> tuple[Array, Array]:
        """Attitude q_ab (n, 4) and rate in {B} (n, 3) [rad/s] at ``times_s`` (n,) [s], before 0 too.

        Raises:
            ValueError: a time that is not finite, or more than a million radians away.
        """
        return self._path.at(times_s)
