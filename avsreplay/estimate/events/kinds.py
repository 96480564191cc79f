"""Kinds of events: each is one class with its columns, its prior and its words.

An event is a shock of the state (``problem.py``) at its onset, of known direction and unknown
size. Kinds that last (a torque, a force, an offset or a drift of the sensor) are shocks of a state
that is constant and zero before. A new kind is one more class here.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from avsreplay.errors import value_class
from avsreplay.estimate.chart import POSITION, VELOCITY
from avsreplay.geometry import Array

# the parts of the state after the 20 numbers of the chart
COLOUR = slice(20, 26)  # common errors of the poses, in their 1 sigma
TORQUE = slice(26, 29)  # angular acceleration in {C} [rad/s2]
FORCE = slice(29, 32)  # acceleration in {A} [m/s2]
DRAG = slice(32, 33)  # [1/s]
OFFSET = slice(33, 34)  # of the range [m]
DRIFT = slice(34, 35)  # of the range [m/s]
SINE = slice(35, 41)  # amplitudes of sine and cosine of a periodic torque in {C} [rad/s2]
STATES = 41


@value_class
class Intervals:
    """What shocks within the intervals between knots do to the state at their ends.

    Attributes:
        times_s: (k,) of the knots.
        turn: (k, 3, 20, 3) effect of a change of the rate in {C} at the begin, the middle and the
            end of the interval that ends at a knot.
        torque, force: (k, 20, 3) effect of constant accelerations over the interval.
        drag: (k, 20, 1) the same of a torque of minus the rate.
    """

    times_s: Array
    turn: Array
    torque: Array
    force: Array
    drag: Array

    def part(self, late: Array) -> Array:
        """(k, 20, 3) effect of a change of the rate at a part (k,) of the interval."""
        x = late[:, None, None]
        first, middle, last = self.turn[:, 0], self.turn[:, 1], self.turn[:, 2]
        return np.asarray(
            first * (1 - x) * (1 - 2 * x) + middle * 4 * x * (1 - x) + last * x * (2 * x - 1)
        )

    def length(self) -> Array:
        """(k,) length of the interval that ends at each knot; 0 for the first."""
        return np.diff(self.times_s, prepend=self.times_s[0])


class Kind(ABC):
    """What one kind of events declares.

    Attributes:
        name: in ``run.json``.
        words: in sentences, with the size as ``{size}``.
        unit, factor: of the size in words, and its value in SI units.
        si: SI unit of the size.
        size: number of columns.
        most: largest 1 sigma of the size before the poses [SI].
        odds: log prior probability of one such event in a log.
        anywhere: its onset is any instant; else it acts from the first pose on.
        periodic: it has a frequency.
    """

    name: str
    words: str
    unit: str
    factor = 1e-3
    si: str
    size = 3
    most = math.inf
    odds = -3.0
    anywhere = True
    periodic = False

    @abstractmethod
    def columns(self, of: Intervals, late: Array) -> Array:
        """Return the (k, STATES, size) shock of the state at each knot by an event of unit size.

        Args:
            of: the intervals between knots.
            late: (k,) instant of the onset as a part of the interval that ends at the knot.
        """

    def _zeros(self, of: Intervals) -> Array:
        return np.zeros((len(of.times_s), STATES, self.size))


class RateStep(Kind):
    """A sudden change of the rate, as by a collision or a thruster pulse."""

    name = "rate_step"
    words = "rate changed by {size}"
    unit = "mrad/s"
    si = "rad/s"

    def columns(self, of: Intervals, late: Array) -> Array:
        """Effect of a change of the rate."""
        out = self._zeros(of)
        out[:, :20] = of.part(late)
        return out


class VelocityStep(Kind):
    """A sudden change of the velocity of the mass centre."""

    name = "velocity_step"
    words = "velocity changed by {size}"
    unit = "mm/s"
    si = "m/s"

    def columns(self, of: Intervals, late: Array) -> Array:
        """Effect of a change of the velocity."""
        out = self._zeros(of)
        out[:, VELOCITY] = np.eye(3)
        out[:, POSITION] = (of.length() * (1.0 - late))[:, None, None] * np.eye(3)
        return out


class Torque(Kind):
    """A constant torque in {C}, as of a leak, from its onset to the end."""

    name = "torque"
    words = "constant torque of {size}"
    unit = "mrad/s2"
    si = "rad/s2"

    def columns(self, of: Intervals, late: Array) -> Array:
        """The torque, and its effect since the onset within the interval."""
        out = self._zeros(of)
        rest = of.length() * (1.0 - late)
        out[:, :20] = rest[:, None, None] * of.part(0.5 * (1.0 + late))
        out[:, TORQUE] = np.eye(3)
        return out


class Force(Kind):
    """A constant force in {A}, from its onset to the end."""

    name = "force"
    words = "constant force of {size}"
    unit = "mm/s2"
    si = "m/s2"

    def columns(self, of: Intervals, late: Array) -> Array:
        """The acceleration, and its effect since the onset within the interval."""
        out = self._zeros(of)
        rest = (of.length() * (1.0 - late))[:, None, None]
        out[:, VELOCITY], out[:, POSITION] = rest * np.eye(3), 0.5 * rest**2 * np.eye(3)
        out[:, FORCE] = np.eye(3)
        return out


class Drag(Kind):
    """A torque against the rate, as of eddy currents or air, over the whole log."""

    name = "drag"
    words = "drag of {size}"
    unit = "%/s"
    factor = 1e-2
    si = "1/s"
    size = 1
    anywhere = False

    def columns(self, of: Intervals, late: Array) -> Array:  # noqa: ARG002
        """The coefficient."""
        out = self._zeros(of)
        out[:, DRAG] = 1.0
        return out


class PeriodicTorque(Kind):
    """A torque in {C} with one frequency over the whole log, as of sloshing or of a panel."""

    name = "periodic_torque"
    words = "periodic torque of {size}"
    unit = "mrad/s2"
    si = "rad/s2"
    size = 6
    anywhere = False
    periodic = True

    def columns(self, of: Intervals, late: Array) -> Array:  # noqa: ARG002
        """The amplitudes of sine and cosine."""
        out = self._zeros(of)
        out[:, SINE] = np.eye(6)
        return out


class SensorOffset(Kind):
    """A jump of the measured range, from its onset to the end."""

    name = "sensor_offset"
    words = "measured range jumped by {size}"
    unit = "mm"
    si = "m"
    size = 1
    most = 0.2
    odds = -5.0

    def columns(self, of: Intervals, late: Array) -> Array:  # noqa: ARG002
        """The offset."""
        out = self._zeros(of)
        out[:, OFFSET] = 1.0
        return out


class SensorDrift(Kind):
    """A linear drift of the measured range, from its onset to the end."""

    name = "sensor_drift"
    words = "measured range drifts by {size}"
    unit = "mm/s"
    si = "m/s"
    size = 1
    most = 2e-3
    odds = -5.0

    def columns(self, of: Intervals, late: Array) -> Array:
        """The drift, and the offset since the onset within the interval."""
        out = self._zeros(of)
        out[:, DRIFT] = 1.0
        out[:, OFFSET] = (of.length() * (1.0 - late))[:, None, None]
        return out


KINDS: tuple[Kind, ...] = (
    RateStep(),
    VelocityStep(),
    Torque(),
    Force(),
    Drag(),
    PeriodicTorque(),
    SensorOffset(),
    SensorDrift(),
)
