"""The coordinates of the estimator: the fixture at the centre of the model, in a frame that falls
with the target.

Centre. A CAD file may have its origin far from the body, and the origin of {C} is where its
designer has put it. The pose of a point outside the body is uncertain by the error of the attitude
times the distance, and the prior of the offset from the centre of mass would be about a point that
is unrelated to the mass. The estimator therefore estimates {C'}, which is {C} with its origin at
the centre s of the model's bounding box, s given in {C}:

    T_ac' = T_ac (1, s),    varrho' = varrho + A(mu) s,    v' = v + theta x s for d = [theta; v] in
    {C}.

All other states are the same, so that an estimate does not depend on the origin of the model.

Fall. With a known acceleration a of the centre of mass in {A}, r' = r - a tau^2 / 2, v' = v - a tau
with tau the time since the first scan. In that frame the motion is free, and the error states and
their covariance are the same.

``EstimatorFrame`` converts the input and the output of the estimator; no other code depends on
either.
"""

from __future__ import annotations

from dataclasses import field, replace
from functools import lru_cache

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.driven import DrivenBelief
from avsreplay.estimate.error_state import DMU, VARRHO
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Alignment, Belief, State

ZERO = frozen(np.zeros(3), 3)


@value_class
class EstimatorFrame:
    """Conversion between {A}, {C} and the coordinates of the estimator.

    Attributes:
        centre_c: (3,) centre of the model in {C} [m].
        acceleration: (3,) of the centre of mass in {A} [m/s2].
        epoch_ns: instant at which the falling frame coincides with {A}.
        shifted, falls: whether centre and acceleration differ from zero.
    """

    centre_c: Array
    acceleration: Array
    epoch_ns: int
    shifted: bool = field(init=False)
    falls: bool = field(init=False)
    _into: Array = field(init=False, repr=False)  # (6, 6) d' = _into d
    _out: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "shifted", bool(self.centre_c.any()))
        object.__setattr__(self, "falls", bool(self.acceleration.any()))
        object.__setattr__(self, "_into", frozen(geometry.about(self.centre_c), 6, 6))
        object.__setattr__(self, "_out", frozen(geometry.about(-self.centre_c), 6, 6))

    @property
    def origin_c(self) -> tuple[float, float, float]:
        """Return the origin of {C} in {C'} (3,) [m]."""
        x, y, z = (-self.centre_c).tolist()
        return x, y, z

    def pose_into(self, T_ac: Pose, t_ns: int) -> Pose:
        """Convert a pose of {C} in {A} at an instant [ns] to the estimator's coordinates."""
        t = T_ac.t + geometry.rotate(T_ac.R, self.centre_c) if self.shifted else T_ac.t
        return Pose(T_ac.q, t - self._fallen(t_ns)[0]) if self.falls else Pose(T_ac.q, t)

    def alignment_into(self, alignment: Alignment, t_ns: int) -> Alignment:
        """Convert a registered pose of {C} in {A} at an instant [ns] to the estimator's
        coordinates.
        """
        if not (self.falls or self.shifted):
            return alignment
        T_ac = self.pose_into(alignment.T_ac, t_ns)
        if not self.shifted:
            return replace(alignment, T_ac=T_ac)
        into, out, C, free = self._into, self._out, alignment.covariance, alignment.free
        part = alignment.systematic
        return replace(
            alignment,
            T_ac=T_ac,
            info=out.T @ alignment.info @ out,
            covariance=None if C is None else into @ C @ into.T,
            systematic=None if part is None else into @ part @ into.T,
            free=None if free is None else into @ free,
        )

    def instants_into(self, instants: Array) -> Array:
        """Convert the mean instants (6, 6) [s] by directions of {C} to those by directions of
        {C'}.
        """
        return self._into @ instants @ self._out if self.shifted else instants

    def motions_into(self, motions: Array) -> Array:
        """Convert motions d = [theta; v] of {C} (6, k) to those of {C'}."""
        return self._into @ motions if self.shifted and motions.size else motions

    def motions_out(self, motions: Array) -> Array:
        """Convert motions d = [theta; v] of {C'} (6, k) to those of {C}."""
        return self._out @ motions if self.shifted and motions.size else motions

    def state_into(self, x: State, t_ns: int) -> State:
        """Convert a state about {C} in {A} at an instant [ns] to the estimator's coordinates."""
        return self._moved(x, t_ns, 1.0)

    def state_out(self, x: State, t_ns: int) -> State:
        """Convert a state at an instant [ns] from the estimator's coordinates to {C} and {A}."""
        return self._moved(x, t_ns, -1.0)

    def belief_into(self, belief: Belief) -> Belief:
        """Convert a belief about {C} in {A} to the estimator's coordinates."""
        return self._converted(belief, 1.0)

    def belief_out(self, belief: Belief) -> Belief:
        """Convert a belief from the estimator's coordinates to {C} and {A}; the last ones are
        kept.
        """
        return _belief_out(self, belief)

    def position_out(self, r_a: Array, t_ns: int) -> Array:
        """Convert a position (3,) [m] of the centre of mass at an instant [ns] from the falling
        frame to {A}.
        """
        return r_a + self._fallen(t_ns)[0] if self.falls else r_a

    def _moved(self, x: State, t_ns: int, sign: float) -> State:
        flat = _motion.shifted_mean(x.flat, sign * self.centre_c) if self.shifted else x.flat
        return State.of(self._falling(flat, t_ns, sign)) if self.falls or self.shifted else x

    def _falling(self, flat: Array, t_ns: int, sign: float) -> Array:
        """The 22 numbers of a state at another position and velocity."""
        if not self.falls:
            return flat
        away, speed = self._fallen(t_ns)
        return np.concatenate(
            (flat[:7], flat[7:10] - sign * away, flat[10:13] - sign * speed, flat[13:])
        )

    def _converted(self, belief: Belief, sign: float) -> Belief:
        """The belief, with the covariance of varrho' = varrho + A(mu) s, A(dmu mu) = (1 + 2 [dmu
        x]) A(mu).
        """
        if not self.shifted:
            x = self._moved(belief.x, belief.t_ns, sign)
            return belief if x is belief.x else replace(belief, x=x)
        flat, P = _motion.shifted(belief.x.flat, belief.P, sign * self.centre_c)
        x = State.of(self._falling(flat, belief.t_ns, sign))
        if not isinstance(belief, DrivenBelief):
            return Belief(belief.t_ns, x, P)
        cross = belief.cross.copy()
        cross[VARRHO] += 2.0 * geometry.skew(belief.x.c_b - x.c_b) @ belief.cross[DMU]
        return replace(belief, x=x, P=P, cross=cross)

    def _fallen(self, t_ns: int) -> tuple[Array, Array]:
        """Displacement and velocity of the falling frame in {A} at an instant."""
        tau = (t_ns - self.epoch_ns) * 1e-9
        return 0.5 * tau * tau * self.acceleration, tau * self.acceleration


@lru_cache(maxsize=2)
def _belief_out(frame: EstimatorFrame, belief: Belief) -> Belief:
    return frame._converted(belief, -1.0)
