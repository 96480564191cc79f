"""The turn that poses can show, and whether they determine the angular rate or another rate
explains them as well.

Poses at multiples of one interval T are the same for a rotation by the angle w T and by w T - 2 pi
about one axis. Where the target turns by more than about 2 rad from pose to pose, the slower of
these motions is as large as the faster one, so that nothing favours it. The poses exclude one of
them only if their intervals are no multiples of one. The measured poses show this whether the
estimate follows one of the two motions or neither.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import field

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array, frozen

# Turn between two poses: less is far enough from half a turn for any tumbling body.
MAX_UNIQUE_TURN_RAD = 2.0
# Turn of the faster of two rates. Beyond it the slower one looks like the only one.
MAX_SHOWN_TURN_RAD = 2.0 * math.pi - MAX_UNIQUE_TURN_RAD
ALIKE_RAD = 0.35  # the other rate differs at no pose by more than this, so that none excludes it
COMPARED_POSES = 32  # poses that are compared
LEAST_TURNS = 6  # turns from pose to pose whose median counts
# Interquartile range of these turns; that of poses that have nothing to do with one another is 1.0
MOST_SPREAD_RAD = 0.7


_NO_POSES = frozen(np.zeros((0, 4)))


@value_class
class Turns:
    """The last measured attitudes and their instants [ns], oldest first."""

    t_ns: tuple[int, ...] = ()
    q: Array = field(default_factory=lambda: _NO_POSES)

    def after(self, t_ns: int, q: Array) -> Turns:
        """Return the turns with one more pose.

        Args:
            t_ns: its instant [ns].
            q: (4,) its attitude.
        """
        return Turns(
            (*self.t_ns, t_ns)[-COMPARED_POSES:], frozen(np.vstack([self.q, q])[-COMPARED_POSES:])
        )


def is_shown(rate_radps: float, t_ns: Sequence[int]) -> bool:
    """Return whether poses can show a rate: its turn within their least interval is not above
    ``MAX_SHOWN_TURN_RAD``.

    Args:
        rate_radps: angular rate [rad/s].
        t_ns: instants of the poses [ns], oldest first.
    """
    period = _period_s(t_ns)
    return period is None or rate_radps * period <= MAX_SHOWN_TURN_RAD


def two_rates(turns: Turns) -> tuple[float, float] | None:
    """Return the slower and the faster angular rate [rad/s] that explain the poses, None where only
    one does.

    Args:
        turns: of the poses so far.
    """
    period = _period_s(turns.t_ns)
    if period is None:
        return None
    spans = np.diff(turns.t_ns) * 1e-9
    number = spans / period
    single = np.round(number) == 1.0
    if np.count_nonzero(single) < LEAST_TURNS:
        return None
    q = turns.q
    angles = geometry.angle(geometry.multiply(geometry.conjugate(q[:-1]), q[1:]))[single]
    low, turn, high = np.quantile(angles, (0.25, 0.5, 0.75)).tolist()
    if turn <= MAX_UNIQUE_TURN_RAD or high - low > MOST_SPREAD_RAD:
        return None
    if 2.0 * math.pi * float(np.abs(number - np.round(number)).max()) > ALIKE_RAD:
        return None
    mean_s = float(np.median(spans[single]))
    return turn / mean_s, (2.0 * math.pi - turn) / mean_s


def _period_s(t_ns: Sequence[int]) -> float | None:
    """Least interval of the poses [s]; None where there is none."""
    spans = np.diff(t_ns) * 1e-9
    return float(spans[spans > 0.0].min()) if (spans > 0.0).any() else None


def in_words(rates: tuple[float, float]) -> str:
    """Return two rates [rad/s] in words."""
    return f"rates of {rates[0]:.3g} and {rates[1]:.3g} rad/s both explain the poses"
