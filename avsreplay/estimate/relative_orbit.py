"""The motion of the centre of mass relative to a camera on a circular orbit (Clohessy and
Wiltshire).

{A} keeps its inertial attitude. With the mean motion n and the radial unit vector o(t), to first
order in the distance,

    d2r/dt2 = n^2 (3 o o' - 1) r.

In axes that turn with the orbit (radial, along the track, normal) the coefficients are constant,
and the transition from one instant to another is a closed form (Clohessy and Wiltshire, Terminal
Guidance System for Satellite Rendezvous, 1960; Vallado, Fundamentals of Astrodynamics and
Applications, section 6.8). The attitude is not affected: the gravity gradient torque is neglected.
"""

from __future__ import annotations

import numpy as np

from avsreplay.errors import value_class
from avsreplay.estimate.params import EstimatorParams
from avsreplay.geometry import Array


@value_class
class RelativeOrbit:
    """The camera's circular orbit.

    Attributes:
        rate: mean motion [rad/s].
        axes: (3, 3) columns: radial, along-track and normal unit vectors in {A} at the epoch.
        epoch_ns: the instant to which the axes belong [ns].
    """

    rate: float
    axes: Array
    epoch_ns: int

    @classmethod
    def of(cls, params: EstimatorParams, epoch_ns: int) -> RelativeOrbit | None:
        """The orbit of the settings; None for free motion.

        Args:
            params: of the estimator.
            epoch_ns: instant of the first scan [ns].
        """
        if params.orbit_rate_radps == 0.0:
            return None
        radial, normal = np.array(params.orbit_radial_a), np.array(params.orbit_normal_a)
        return cls(
            params.orbit_rate_radps,
            np.stack([radial, np.cross(normal, radial), normal], axis=1),
            epoch_ns,
        )

    def at(self, t_ns: int) -> OrbitArc:
        """The orbit from an instant [ns] on."""
        return OrbitArc(self, t_ns)


@value_class
class OrbitArc:
    """An orbit from the instant ``start_ns`` on."""

    orbit: RelativeOrbit
    start_ns: int

    def shifted(self, after_s: float) -> OrbitArc:
        """The same orbit from a later instant on."""
        return OrbitArc(self.orbit, self.start_ns + round(after_s * 1e9))

    def transitions(self, times_s: Array) -> Array:
        """(n, 6, 6) position and velocity in {A} after ``times_s`` (n,) [s], of either sign, by
        those at the start.
        """
        n, times = self.orbit.rate, np.asarray(times_s, dtype=np.float64)
        begin = (self.start_ns - self.orbit.epoch_ns) * 1e-9
        turning = _turning_axes(n, times)
        start, end = self._inertial(np.array([begin])), self._inertial(begin + times)
        back = np.zeros((6, 6))  # the inverse of ``start``
        C = start[0, :3, :3]
        back[:3, :3] = back[3:, 3:] = C.T
        back[3:, :3] = -C.T @ start[0, 3:, :3] @ C.T
        return np.asarray(end @ turning @ back)

    def _inertial(self, after_s: Array) -> Array:
        """(n, 6, 6) from position and velocity in the turning axes to those in {A}, v = C (u + n x
        p).
        """
        n = self.orbit.rate
        c, s = np.cos(n * after_s), np.sin(n * after_s)
        radial, along, normal = self.orbit.axes.T
        C = np.stack(
            [
                c[:, None] * radial + s[:, None] * along,
                c[:, None] * along - s[:, None] * radial,
                np.broadcast_to(normal, (len(after_s), 3)),
            ],
            axis=2,
        )
        W = np.zeros((len(after_s), 6, 6))
        W[:, :3, :3] = W[:, 3:, 3:] = C
        W[:, 3:, 0], W[:, 3:, 1] = n * C[:, :, 1], -n * C[:, :, 0]
        return W


def _turning_axes(n: float, h: Array) -> Array:
    """(m, 6, 6) the transition in the axes that turn with the orbit, after h (m,) seconds."""
    c, s, one = np.cos(n * h), np.sin(n * h), np.ones(len(h))
    M = np.zeros((len(h), 6, 6))
    M[:, 0, 0], M[:, 0, 3], M[:, 0, 4] = 4.0 - 3.0 * c, s / n, 2.0 * (1.0 - c) / n
    M[:, 1, 0], M[:, 1, 1], M[:, 1, 3] = 6.0 * (s - n * h), one, 2.0 * (c - 1.0) / n
    M[:, 1, 4] = 4.0 * s / n - 3.0 * h
    M[:, 2, 2], M[:, 2, 5] = c, s / n
    M[:, 3, 0], M[:, 3, 3], M[:, 3, 4] = 3.0 * n * s, c, 2.0 * s
    M[:, 4, 0], M[:, 4, 3], M[:, 4, 4] = 6.0 * n * (c - 1.0), -2.0 * s, 4.0 * c - 3.0
    M[:, 5, 2], M[:, 5, 5] = -n * s, c
    return M
