"""A back end and an estimator for the benchmark, as short as they can be."""

import numpy as np
from scipy.spatial.transform import Rotation

from avsreplay.estimate.ekf import Ekf
from avsreplay.geometry import Pose, angle
from avsreplay.records import Fit
from avsreplay.register.backend import Backend

INFLATED = 4.0  # factor on the covariance of every pose


class Points(Backend):
    """Point-to-point ICP: closest points, then the rigid motion between them."""

    name = "mine"
    about = "point-to-point ICP of the tutorial"

    def __init__(self, target):
        self.closest, self.limits = target.index.closest, target.limits

    def align(self, points, guess):
        T_ca, gate = guess, self.limits.reach_m
        for count in range(1, self.limits.n_max + 1):
            moved = T_ca.apply(points)
            found = self.closest(moved)
            near = found.d2 < gate**2
            if near.sum() < 6:
                return Fit(guess, count, False)
            a, b = moved[near].mean(axis=0), found.foot[near].mean(axis=0)
            turn = Rotation.align_vectors(found.foot[near] - b, moved[near] - a)[0]
            step = Pose(turn.as_quat(), b - turn.apply(a))
            T_ca, last = step @ T_ca, gate
            gate = max(self.limits.gate_m, min(gate, 3.0 * found.d2[near].mean() ** 0.5))
            shift = np.linalg.norm(step.apply(a) - a)
            if gate > 0.99 * last and angle(step.q) < 1e-4 and shift < 10 * self.limits.eps_m:
                return Fit(T_ca, count, True)
        return Fit(T_ca, count, False)


class Smooth(Ekf):
    """The plain filter with poses that count as less certain."""

    about = "the plain filter with an inflated covariance of the poses"

    def update(self, state, T_ac, C):
        return super().update(state, T_ac, INFLATED * C)
