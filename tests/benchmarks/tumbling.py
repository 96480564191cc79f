"""A tumbling body, integrated from its full inertia tensor with DOP853, and noisy poses of it.

This is the truth the estimator never sees. The tensor stands in {C} and is not diagonal; sigma, mu
and the principal axes are only read off it. Nothing here calls the estimator's motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import solve_ivp

from avsreplay import geometry
from avsreplay.estimate.error_state import boxplus
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus, Belief, State

NEAR_1S = np.repeat([0.0025, 0.0025, 0.01, 0.001, 0.025, 0.025, 0.005], [3, 3, 3, 3, 2, 3, 3])


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Times (n,) [s], true states, and the inertia they came from."""

    times: Array
    states: list[State]
    moments: Array


def draw(
    seed: int,
    *,
    rate: float = 0.1,
    mu_deg: float = 15.0,
    varrho: float = 0.3,
    seconds: float = 100.0,
    hz: float = 2.0,
    sigma_max: float = 1.0,
) -> World:
    """Random attitude and axis, mu up to ``mu_deg``, varrho up to ``varrho`` [m].

    Inertia is uniform over the whole triangle of mass moments, or over the part where no |sigma|
    passes ``sigma_max``.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    moments = _moments(rng, sigma_max)
    q_ab, w = (
        geometry.exp(random_direction(rng) * rng.uniform(0, np.pi)),
        random_direction(rng) * rate,
    )
    q_bc = geometry.exp(random_direction(rng) * np.radians(mu_deg) * rng.uniform())
    c = random_direction(rng) * varrho * rng.uniform() ** (1 / 3)
    r, v = np.array([0.0, 0.0, 5.0]) + rng.normal(size=3) * 0.2, rng.normal(size=3) * 0.005
    times = np.arange(0.0, seconds + 0.5 / hz, 1.0 / hz)
    return World(
        times, follow(times, moments, State(q_ab, w, r, v, ratios(moments), c, q_bc)), moments
    )


def _moments(rng: np.random.Generator, sigma_max: float) -> Array:
    while True:
        masses = rng.dirichlet(np.ones(3))
        moments = masses.sum() - masses
        x, y, z = moments
        if max(abs(y - z) / x, abs(z - x) / y, abs(x - y) / z) <= sigma_max:
            return moments


def ratios(moments: Array) -> Array:
    """(sigma1, sigma2) of principal moments (3,)."""
    x, y, z = moments
    return np.array([(y - z) / x, (z - x) / y])


def follow(times: Array, moments: Array, start: State) -> list[State]:
    """True states at ``times`` from ``start`` at 0."""
    R_bc = geometry.matrix(start.q_bc)
    tensor = R_bc.T @ np.diag(moments) @ R_bc
    inverse = np.linalg.inv(tensor)

    def rates(_: float, y: Array) -> Array:
        q, w = y[:4], y[4:]
        w_dot = inverse @ np.cross(tensor @ w, w)
        return np.concatenate([0.5 * geometry.multiply(q, np.append(w, 0.0)), w_dot])

    q_ac = geometry.multiply(start.q_ab, start.q_bc)
    y0 = np.concatenate([q_ac, R_bc.T @ start.w_b])
    path = solve_ivp(
        rates, (0.0, times[-1] + 1e-9), y0, method="DOP853", rtol=1e-12, atol=1e-13, t_eval=times
    ).y.T
    q_cb = geometry.conjugate(start.q_bc)
    return [
        State(
            geometry.normalise(geometry.multiply(y[:4], q_cb)),
            R_bc @ y[4:],
            start.r_a + t * start.v_a,
            start.v_a,
            start.sigma,
            start.c_b,
            start.q_bc,
        )
        for t, y in zip(times, path, strict=True)
    ]


def pushed(seed: int, torque: float, *, seconds: float, hz: float) -> World:
    """A body under a random torque of that root density, integrated from its full tensor between
    the pushes.
    """
    world = draw(seed, seconds=1.0, hz=hz, sigma_max=0.85)
    rng = np.random.Generator(np.random.PCG64([seed, 99]))
    states = [world.states[0]]
    for _ in range(round(seconds * hz)):
        x = follow(np.array([0.0, 1.0 / hz]), world.moments, states[-1])[-1]
        push = world.moments.sum() / world.moments * torque * rng.normal(size=3) / np.sqrt(hz)
        states.append(replace(x, w_b=x.w_b + push))
    return World(np.arange(len(states)) / hz, states, world.moments)


def near(x: State, seed: int, wide: float = 1.0) -> Belief:
    """A belief drawn about a state, ``wide`` times ``NEAR_1S`` wide: attitude 0.29 deg, sigma
    0.025, mu 0.57 deg.
    """
    drawn = wide * NEAR_1S * np.random.Generator(np.random.PCG64([seed, 8])).normal(size=20)
    return Belief(0, boxplus(x, drawn), np.diag((wide * NEAR_1S) ** 2))


def alignment(
    truth: Pose, rng: np.random.Generator, pos_m: float, rot_rad: float, reported: float = 1.0
) -> Alignment:
    """A pose with isotropic noise (per axis, in {C}); ``reported`` scales the covariance it
    claims.
    """
    theta, v = rng.normal(size=3) * rot_rad, rng.normal(size=3) * pos_m
    C = np.diag(np.repeat([rot_rad**2, pos_m**2], 3)) * reported
    T_ac = truth @ Pose(geometry.exp(theta), v)
    return Alignment(T_ac, 5, True, 4000, 3900, 0.008, np.linalg.inv(C), AlignStatus.ALIGNED, C)


def random_direction(rng: np.random.Generator) -> Array:
    """A unit vector (3,), all directions equally likely."""
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)
