"""Whether the poses determine the angular rate, or another rate explains them as well.

Poses at multiples of one interval T are the same for a rotation about a fixed axis by the angle
w T and by w T - 2 pi. Where the target turns by more than about 2 rad between two poses, the
slower of these motions is taken, whichever is right. The poses exclude it only if their intervals
are no multiples of one.
"""

from __future__ import annotations

import math

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array

MOST_TURN_RAD = 2.0  # between two poses: less is far enough from half a turn for any tumbling body
ALIKE_RAD = 0.35  # the other rate differs at no pose by more than this, so that none excludes it
KEPT = 32  # poses whose instants are compared


@value_class
class Instants:
    """Instants of the last healthy poses [ns], oldest first."""

    t_ns: tuple[int, ...] = ()

    def after(self, t_ns: int) -> Instants:
        """Return the instants with that of one more healthy pose."""
        return Instants((*self.t_ns, t_ns)[-KEPT:])


def other_rate(instants: Instants, w: Array) -> float | None:
    """Return another angular rate that explains the poses [rad/s], None where there is none.

    Args:
        instants: of the healthy poses so far.
        w: (3,) estimated angular rate [rad/s].
    """
    rate = float(np.linalg.norm(w))
    spans = np.diff(instants.t_ns) * 1e-9
    spans = spans[spans > 0.0]
    if not len(spans) or rate * float(spans.min()) <= MOST_TURN_RAD:
        return None
    period = float(spans.min())
    turns = spans / period
    differs = 2.0 * math.pi * float(np.abs(turns - np.round(turns)).max())
    return None if differs > ALIKE_RAD else abs(2.0 * math.pi / period - rate)


def in_words(w: Array, other: float) -> str:
    """Return both rates in words.

    Args:
        w: (3,) estimated angular rate [rad/s].
        other: the other rate [rad/s].
    """
    rate = float(np.linalg.norm(w))
    return f"rates of {rate:.3g} and {other:.3g} rad/s both explain the poses"
