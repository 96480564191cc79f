"""Seeded planning problems under constraints: a tumbling box with a fixture on one of its faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from avsreplay.plan._cone import Body
from avsreplay.plan.limits import Scene

HORIZON_S = 125.0


@dataclass(frozen=True)
class Problem:
    """A scene with its robot.

    ``half`` (3,) are the half-lengths of the box, ``centre_c`` its centre in {C} [m].
    """

    scene: Scene
    r0: np.ndarray
    a_max: float
    half: np.ndarray
    centre_c: np.ndarray


def box_surface(centre, half):
    """Mesh of a box whose axes are those of {C}."""
    mesh = trimesh.creation.box(extents=2.0 * half)
    return Body(mesh.vertices + centre, np.asarray(mesh.faces, np.int32))


def problem(rng, rate=(0.02, 0.1)):
    """Return one problem: box of 1.2 to 3 m, fixture in the middle of the +x face, robot at
    rest 3 to 8 m away.
    """
    half = rng.uniform(0.6, 1.5, 3)
    J = np.array(
        [half[1] ** 2 + half[2] ** 2, half[0] ** 2 + half[2] ** 2, half[0] ** 2 + half[1] ** 2]
    )
    w = rng.normal(size=3)
    w *= rng.uniform(*rate) / np.linalg.norm(w)
    c = np.array(
        [half[0], *(0.5 * half[1:] * rng.uniform(-1, 1, 2))]
    )  # fixture in the box frame, axes parallel to {C}
    centre, drift = rng.normal(size=3), 0.01 * rng.normal(size=3)
    centre *= rng.uniform(4.0, 8.0) / np.linalg.norm(centre)

    def flow(_, y):
        q, w = y[:4], y[4:]
        return np.r_[
            0.5 * (q[3] * w + np.cross(q[:3], w)), -0.5 * q[:3] @ w, -np.cross(w, J * w) / J
        ]

    times = np.arange(0.0, HORIZON_S, 0.1)
    start = np.r_[Rotation.random(random_state=int(rng.integers(2**31))).as_quat(), w]
    y = solve_ivp(
        flow, [0.0, times[-1]], start, method="DOP853", rtol=1e-11, atol=1e-12, t_eval=times
    ).y.T
    quat = y[:, :4] / np.linalg.norm(y[:, :4], axis=1, keepdims=True)
    R = Rotation.from_quat(quat)
    rho = centre + drift * times[:, None] + R.apply(c)
    line, turn = CubicSpline(times, rho), CubicSpline(times, quat)

    def attitude(t):
        q = turn(t)
        return q / np.linalg.norm(q, axis=1, keepdims=True)

    scene = Scene(
        goal=lambda t: (line(t), line(t, 1)),
        attitude=attitude,
        axis_c=np.array([1.0, 0.0, 0.0]),
        centre_c=-c,
        surface=box_surface(-c, half),
    )
    return Problem(scene, np.zeros(3), float(rng.uniform(0.03, 0.1)), half, -c)


def problems(count, seed=1, rate=(0.02, 0.1)):
    """Return ``count`` problems of one seed."""
    rng = np.random.default_rng(seed)
    return [problem(rng, rate) for _ in range(count)]
