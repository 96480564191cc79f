"""A kinematic tracker: whether a registered pose agrees with the poses before it, whatever moves
the target.

The estimate of a free body answers another question, whether the target moves freely. A target that
is driven, dragged or swung, or one that is seen from a sensor that accelerates, contradicts it with
poses that are right. The tracker assumes only that angular rate and velocity change little from
scan to scan: each is constant, with a random acceleration between two poses. How large the
accelerations are, and how many times the errors of the poses exceed the claimed ones, is not known.
A bank of filters has every combination of both; their probabilities follow from how well each
predicts the poses, and leak to neighbouring combinations, so that the noise adapts (Bar-Shalom, Li,
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 11).

The attitude and the position of the middle of the model have a bank each. All three axes of one
have the same noise.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate.kinematic import Motion
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus

# Standard deviation of the acceleration between two poses [rad/s2, extents/s2], and errors of the
# poses over the claimed ones. More values take more time; a wider range follows faster changes.
_ACCELERATIONS = np.logspace(-4.0, 0.5, 10)
_ERRORS = np.logspace(0.0, 1.5, 7)
# Probability that the acceleration or the errors grow or fall by one value from scan to scan. A
# larger one accepts more sudden motions, and more wrong poses.
_LEAK = 0.05
_LEAST_ERROR = 1e-4  # of a pose [rad, extents], below which no smaller one is used
_FIRST_RATE = 3.0  # 1 sigma of the rate before a second pose [rad/s, extents/s]
# A pose whose error has a smaller probability contradicts the poses before it.
_LEAST_PROBABILITY = 1e-4
# Probability with which the errors of the poses exceed the claimed ones by at least the factor that
# their covariance is multiplied by. A smaller one multiplies that of poses as good as claimed.
_SURE = 0.95
_LEAST_POSES = 3  # of a track, from which on it judges poses: fewer determine no acceleration
# A pose nearer to the last one than this share of its claimed 1 sigma, in attitude and position, is
# no new measurement: independent errors make it so in one of 10^8 poses.
_REPEATED = 0.1
_MOST_MISSED = 3  # poses in a row that contradict a track; the next track begins with the last one
# 3 sigma of a prediction [rad, extents], above which it judges no pose: any one would agree.
_MOST_PREDICTED = (math.radians(15.0), 0.15)


@value_class
class Bank:
    """Filters (k,) of one vector and its rate, of all three axes alike.

    Attributes:
        offset: (k, 3) from the last pose of the track.
        rate: (k, 3) [1/s].
        P: (k, 2, 2) covariance of an axis of both.
        weight: (k,) probability of each filter.
    """

    offset: Array
    rate: Array
    P: Array
    weight: Array

    @classmethod
    def begun(cls, variance: float) -> Bank:
        """Return the filters after a first pose with a variance of each axis."""
        k = len(_grid()[0])
        P = np.zeros((k, 2, 2))
        P[:, 0, 0], P[:, 1, 1] = variance * _grid()[1] ** 2, _FIRST_RATE**2
        return cls(np.zeros((k, 3)), np.zeros((k, 3)), P, np.full(k, 1.0 / k))

    def after(self, dt: float) -> Bank:
        """Return the filters ``dt`` [s] later; the offsets stay those of the last pose."""
        F = np.array([[1.0, dt], [0.0, 1.0]])
        Q = np.array([[dt**4 / 4.0, dt**3 / 2.0], [dt**3 / 2.0, dt**2]])
        P = F @ self.P @ F.T + _grid()[0][:, None, None] ** 2 * Q
        weight = _leak() @ self.weight
        return Bank(self.offset, self.rate, P, weight)

    def likely(self, e: Array, variance: float) -> float:
        """Return the probability of an error as large as e (k, 3) of the prediction of a pose."""
        S = self.P[:, 0, 0] + variance * _grid()[1] ** 2
        x = np.einsum("ki,ki->k", e, e) / S
        tail = np.array([math.erfc(math.sqrt(0.5 * each)) for each in x.tolist()])
        return float(self.weight @ (tail + np.sqrt(2.0 * x / np.pi) * np.exp(-0.5 * x)))

    def updated(self, e: Array, variance: float) -> Bank:
        """Return the filters after a pose with errors e (k, 3) of its prediction; offsets from
        it.
        """
        R = variance * _grid()[1] ** 2
        S = self.P[:, 0, 0] + R
        gain = self.P[:, :, 0] / S[:, None]
        P = self.P - gain[:, :, None] * self.P[:, None, 0, :]
        log_weight = np.log(np.maximum(self.weight, np.finfo(float).tiny))
        log_weight -= 0.5 * np.einsum("ki,ki->k", e, e) / S + 1.5 * np.log(S)
        weight = np.exp(log_weight - log_weight.max())
        offset, rate = (gain[:, :1] - 1.0) * e, self.rate + gain[:, 1:] * e
        return Bank(offset, rate, P, weight / weight.sum())

    @property
    def best(self) -> int:
        """Return the number of the filter with the largest probability."""
        return int(np.argmax(self.weight))

    @property
    def least_error(self) -> float:
        """Return the factor that the errors of the poses exceed the claimed ones by at least."""
        each = self.weight.reshape(len(_ACCELERATIONS), len(_ERRORS)).sum(axis=0)
        at_least = np.cumsum(each[::-1])[::-1]
        return float(_ERRORS[np.flatnonzero(at_least >= _SURE).max(initial=0)])

    @property
    def variance(self) -> float:
        """Return the variance of an axis of the predicted vector, over all filters."""
        return float(self.weight @ self.P[:, 0, 0])


@cache
def _grid() -> tuple[Array, Array]:
    """The acceleration and the factor of the errors of each filter (k,)."""
    a, e = np.meshgrid(_ACCELERATIONS, _ERRORS, indexing="ij")
    return a.ravel(), e.ravel()


@cache
def _leak() -> Array:
    """(k, k) probabilities of each filter's noise at a scan by those at the scan before it."""
    one = [_neighbours(len(_ACCELERATIONS)), _neighbours(len(_ERRORS))]
    return np.asarray(np.kron(*one), dtype=np.float64)


def _neighbours(count: int) -> Array:
    leak = np.diag(np.full(count, 1.0 - 2.0 * _LEAK))
    leak += _LEAK * (np.eye(count, k=1) + np.eye(count, k=-1))
    leak[0, 0] += _LEAK
    leak[-1, -1] += _LEAK
    return leak


@value_class
class Kinematics:
    """The track of one target.

    Attributes:
        t_ns: instant of the last pose of the track.
        T_ac: that pose.
        turn, move: filters of the attitude and of the position of the middle [extents].
        poses: of the track.
        missed: poses since then that contradict it.
        connected: the estimate of the free body used a pose of the track. A track that begins
            after a jump is not, until that estimate accepts a pose of it.
        interval_s: between the last two poses [s].
    """

    t_ns: int
    T_ac: Pose
    turn: Bank
    move: Bank
    poses: int = 1
    missed: int = 0
    connected: bool = False
    interval_s: float = 0.0


@value_class
class Tracker:
    """The tracker of one model.

    Attributes:
        middle: (3,) of the model in {C} [m].
        extent_m: of the model.
    """

    middle: Array
    extent_m: float

    def predicted(self, before: Kinematics | None, t_ns: int) -> Motion | None:
        """Return the predicted motion at an instant; None without a track that can judge a pose.

        Args:
            before: the track.
            t_ns: the instant.
        """
        if before is None or before.poses < _LEAST_POSES or t_ns <= before.t_ns:
            return None
        found = self.motion(before, t_ns)
        return None if _vague(found.rot_1s, found.pos_1s / self.extent_m) else found

    def motion(self, before: Kinematics, t_ns: int) -> Motion:
        """Return the motion of a track at the instant of its last pose or later."""
        dt = (t_ns - before.t_ns) * 1e-9
        turn, move = (bank.after(dt) if dt > 0.0 else bank for bank in (before.turn, before.move))
        i, j, L = turn.best, move.best, self.extent_m
        q = self._attitudes(before, turn, dt)[i]
        middle = self._middles(before, move, dt)[j]
        T_ac = Pose(q, middle - geometry.rotate(geometry.matrix(q), self.middle))
        return Motion(
            T_ac,
            turn.rate[i],
            L * move.rate[j],
            math.sqrt(turn.variance),
            L * math.sqrt(move.variance),
            math.sqrt(float(turn.P[i, 1, 1])),
            L * math.sqrt(float(move.P[j, 1, 1])),
            float(_grid()[0][i]) * math.sqrt(before.interval_s),
            L * float(_grid()[0][j]) * math.sqrt(before.interval_s),
        )

    def after(
        self, before: Kinematics | None, t_ns: int, found: Alignment
    ) -> tuple[Kinematics | None, bool]:
        """Return the track after a scan, and whether the track confirms its pose.

        Args:
            before: the track, None before the first pose.
            t_ns: instant of the scan.
            found: what was registered; only a pose that is determined in all directions belongs to
                a track.
        """
        C = found.covariance
        if found.status not in (AlignStatus.ALIGNED, AlignStatus.MEASURED) or C is None:
            return before, False
        J = np.hstack([-geometry.skew(self.middle), np.eye(3)])
        variances = (
            float(np.trace(C[:3, :3])) / 3.0 + _LEAST_ERROR**2,
            float(np.trace(J @ C @ J.T)) / (3.0 * self.extent_m**2) + _LEAST_ERROR**2,
        )
        if not np.isfinite(variances).all():
            return before, False
        first = Bank.begun(variances[0]), Bank.begun(variances[1])
        begun = Kinematics(t_ns, found.T_ac, first[0], first[1])
        if before is None:
            return begun, False
        if t_ns <= before.t_ns or self._repeated(before.T_ac, found.T_ac, variances):
            return before, False
        dt = (t_ns - before.t_ns) * 1e-9
        turn, move = before.turn.after(dt), before.move.after(dt)
        inverse = geometry.conjugate(self._attitudes(before, turn, dt))
        of_turn = geometry.log(geometry.multiply(found.T_ac.q, inverse))
        at = found.T_ac.apply(self.middle) / self.extent_m
        of_move = at - self._middles(before, move, dt) / self.extent_m
        pairs = (turn, of_turn, variances[0]), (move, of_move, variances[1])
        if min(bank.likely(e, v) for bank, e, v in pairs) < _LEAST_PROBABILITY:
            if before.missed + 1 >= _MOST_MISSED or before.poses < _LEAST_POSES:
                return begun, False
            return replace(before, missed=before.missed + 1), False
        vague = _vague(math.sqrt(turn.variance), math.sqrt(move.variance))
        sure = before.connected and before.poses >= _LEAST_POSES and not vague
        turn, move = (bank.updated(e, v) for bank, e, v in pairs)
        poses, known = before.poses + 1, before.connected
        return Kinematics(t_ns, found.T_ac, turn, move, poses, 0, known, dt), sure

    def weighed(self, before: Kinematics | None, found: Alignment) -> Alignment:
        """Return a pose with the covariance that the poses before it show.

        Args:
            before: the track.
            found: what was registered, with the claimed covariance.
        """
        if before is None or before.poses < _LEAST_POSES or found.covariance is None:
            return found
        turn, move = before.turn.least_error, before.move.least_error
        if turn == move == 1.0:
            return found
        about = geometry.about(self.middle)  # the factor on the position is that of the middle
        scale = np.repeat([turn, move], 3)
        D = np.linalg.solve(about, scale[:, None] * about)
        back = np.linalg.solve(about, about / scale[:, None])
        of = found.systematic
        return replace(
            found,
            covariance=D @ found.covariance @ D.T,
            info=back.T @ found.info @ back,
            systematic=None if of is None else D @ of @ D.T,
        )

    def used(self, track: Kinematics | None, t_ns: int) -> Kinematics | None:
        """Return a track of whose pose at an instant the estimate of the free body made use."""
        if track is None or track.t_ns != t_ns or track.connected:
            return track
        return replace(track, connected=True)

    def _repeated(self, last: Pose, pose: Pose, variances: tuple[float, float]) -> bool:
        """Whether a pose is the last one again, as that of a sensor that repeats its scan."""
        turned = float(geometry.angle_between(last.q, pose.q))
        moved = float(np.linalg.norm(pose.apply(self.middle) - last.apply(self.middle)))
        changes = turned, moved / self.extent_m
        return all(c < _REPEATED * math.sqrt(v) for c, v in zip(changes, variances, strict=True))

    def _attitudes(self, before: Kinematics, turn: Bank, dt: float) -> Array:
        """The attitudes (k, 4) after ``dt`` [s]."""
        turned = geometry.multiply(geometry.exp(turn.rate * dt), geometry.exp(turn.offset))
        return geometry.multiply(turned, before.T_ac.q)

    def _middles(self, before: Kinematics, move: Bank, dt: float) -> Array:
        """The positions (k, 3) of the middle of the model after ``dt`` [s], in {A} [m]."""
        moved = self.extent_m * (move.offset + dt * move.rate)
        return np.asarray(before.T_ac.apply(self.middle) + moved)


def _vague(rot_1s: float, pos_1s: float) -> bool:
    """Whether a prediction with standard deviations [rad, extents] judges no pose."""
    return 3.0 * rot_1s > _MOST_PREDICTED[0] or 3.0 * pos_1s > _MOST_PREDICTED[1]
