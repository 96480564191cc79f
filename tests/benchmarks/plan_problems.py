"""Seeded rendezvous problems: a grasp point on a torque-free tumbling body, integrated by
DOP853 and tabulated.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation


class Table:
    """Position, velocity, acceleration on a grid joined by quintic pieces: as exact as the
    integration, and cheap.
    """

    def __init__(self, step, position, velocity, acceleration):
        self.step, self.p, self.v, self.a = step, position, velocity, acceleration

    def __call__(self, times):
        d = self.step
        k = np.minimum((times / d).astype(int), len(self.p) - 2)
        s = (times / d - k)[:, None]
        p0, v0, a0 = self.p[k], self.v[k] * d, self.a[k] * (d * d)
        p1, v1, a1 = self.p[k + 1], self.v[k + 1] * d, self.a[k + 1] * (d * d)
        rise, rate, bend = p1 - p0 - v0 - 0.5 * a0, v1 - v0 - a0, a1 - a0
        c3 = 10 * rise - 4 * rate + 0.5 * bend
        c4 = -15 * rise + 7 * rate - bend
        c5 = 6 * rise - 3 * rate + 0.5 * bend
        position = p0 + s * (v0 + s * (0.5 * a0 + s * (c3 + s * (c4 + s * c5))))
        velocity = (v0 + s * (a0 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / d
        return position, velocity


def tumbling(rng, rate_radps, arm_m, distance_m, horizon_s=125.0, step_s=0.05):
    """One target: principal moments, attitude, rate, arm and drift drawn from ``rng``."""
    J = np.sort(rng.uniform(1.0, 3.0, 3))
    w, c, d = rng.normal(size=(3, 3))
    w *= rate_radps / np.linalg.norm(w)
    c *= arm_m / np.linalg.norm(c)
    centre, drift = distance_m * d / np.linalg.norm(d), 0.02 * rng.normal(size=3)

    def rate_of(w):
        return -np.cross(w, J * w) / J

    def flow(_, y):
        q, w = y[:4], y[4:]
        return np.r_[0.5 * (q[3] * w + np.cross(q[:3], w)), -0.5 * q[:3] @ w, rate_of(w)]

    start = np.r_[Rotation.from_rotvec(rng.normal(size=3)).as_quat(), w]
    times = np.arange(0.0, horizon_s + step_s, step_s)
    y = solve_ivp(
        flow, [0.0, times[-1]], start, method="DOP853", rtol=1e-13, atol=1e-14, t_eval=times
    ).y.T
    R, w = Rotation.from_quat(y[:, :4]), y[:, 4:]
    position = centre + drift * times[:, None] + R.apply(c)
    velocity = drift + R.apply(np.cross(w, c))
    acceleration = R.apply(np.cross(w, np.cross(w, c)) + np.cross(rate_of(w), c))
    return Table(step_s, position, velocity, acceleration)


def problems(count, hard, seed=1):
    """(goal, a_max) pairs: hard is 0.1-0.35 rad/s, 1.5 m arm, 0.02-0.1 m/s2; ordinary half
    the rate and 1 m.
    """
    rng = np.random.default_rng(seed)
    for _ in range(count):
        rate = rng.uniform(0.1, 0.35) if hard else rng.uniform(0.03, 0.1)
        a_max = rng.uniform(0.02, 0.1)
        yield tumbling(rng, rate, 1.5 if hard else 1.0, rng.uniform(2.0, 8.0)), a_max
