"""Size of the target over that of the model, from the residuals of a registered scan.

With T_ac_true = T_ac Exp(d) and a target 1 + delta times as large as the model, the residual at p with normal n is
n . (p - c) = J d + delta n . p. Robust least squares give pose and delta; the points are matched again a few times,
because the closest points move with both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.register.surface_index import SurfaceIndex

LEAST_RESIDUALS = 50
NORMAL_QUANTILE = 0.67449  # median |e| over standard deviation for a normal e
LEAST_ERROR = 0.005  # least |delta| that is reported, to which the rms over the extent is added
LEAST_INFORMATION = 1e-2  # least share of n . p that the pose cannot explain
WIDTH_OF_EXTENT, ROUNDS, POINTS = 0.02, 3, 600  # larger residuals are not used; times that the points are matched


@dataclass(frozen=True, slots=True, eq=False)
class SizeError:
    """Size of the target estimated from one scan.

    Attributes:
        delta: size of the target over that of the model, less 1.
        share: share of n . p that no pose explains: the information on delta.
        shift: (6,) change d of the pose if the size is fitted with it, T_ac Exp(d).
    """

    delta: float
    share: float
    shift: Array

    @property
    def message(self) -> str:
        """The text of the row's message."""
        larger = "larger" if self.delta > 0.0 else "smaller"
        return f"the scan fits a target {100.0 * abs(self.delta):.1f} % {larger} than the model"


def size_error(
    index: SurfaceIndex, points: NDArray[Any], T_ca: Pose, camera_c: Array | None, rms_m: float
) -> SizeError | None:
    """Return the error of size that a registered scan shows.

    Args:
        index: of the model.
        points: (n, 3) in {A} [m].
        T_ca: registered pose.
        camera_c: (3,) position of the camera in {C} [m] if only faces towards it are matched.
        rms_m: of the inliers; noise makes thin parts appear thicker, so an error of size below it is not reported.

    Returns:
        The error; None if it is too small, or if a pose explains it.
    """
    p = T_ca.apply(points[:: max(1, len(points) // POINTS)])
    found = fitted_size(index, p, camera_c)
    if found is None or found.share < LEAST_INFORMATION:
        return None
    return found if abs(found.delta) > LEAST_ERROR + rms_m / index.extent_m else None


def fitted_size(index: SurfaceIndex, p: Array, camera_c: Array | None) -> SizeError | None:
    """Fit size and pose to points of a registered scan.

    Args:
        index: of the model.
        p: (n, 3) points in {C} [m], at the registered pose.
        camera_c: (3,) camera position in {C} [m], or None: both sides of a face are matched.

    Returns:
        The fit; None with fewer than 50 residuals.
    """
    delta, share, moved = 0.0, 0.0, Pose.identity()
    for _ in range(ROUNDS):
        q = moved.apply(p) / (1.0 + delta)
        found = index.closest(q, camera_c=camera_c)
        near = found.d2 < (WIDTH_OF_EXTENT * index.extent_m) ** 2
        if np.count_nonzero(near) < LEAST_RESIDUALS:
            return None
        n, q = found.normal[near], q[near]
        e = np.einsum("ij,ij->i", n, q - found.foot[near])
        J, a = normal_jacobian(q - q.mean(axis=0), n), np.einsum("ij,ij->i", n, q - q.mean(axis=0))
        J, a, e = _weighted(J, a, e)
        of_a, of_e = np.linalg.lstsq(J, np.column_stack([a, e]), rcond=1e-6)[0].T
        free = a - J @ of_a
        share = float(free @ free) / max(float(a @ a), np.finfo(float).tiny)
        step = float(free @ e) / max(float(free @ free), np.finfo(float).tiny)
        d = of_e - step * of_a
        turn = Pose(geometry.exp(-d[:3]), np.zeros(3))
        centre = q.mean(axis=0)
        about = centre - turn.R @ centre - d[3:] + step * centre
        moved = Pose(turn.q, (1.0 + delta) * about) @ moved
        delta = (1.0 + delta) * (1.0 + step) - 1.0
    back = moved.inverse()
    return SizeError(delta, share, np.concatenate([geometry.log(back.q), back.t]))


def normal_jacobian(p: Array, n: Array) -> Array:
    """Return J (k, 6) of points p and normals n (k, 3): rows [p x n, n]."""
    return np.hstack([np.cross(p, n), n])


def _weighted(J: Array, a: Array, e: Array) -> tuple[Array, Array, Array]:
    """Rows times the square root of their Cauchy weight; scale: robust standard deviation of e."""
    noise = max(float(np.median(np.abs(e))) / NORMAL_QUANTILE, np.finfo(float).tiny)
    root = 1.0 / np.sqrt(1.0 + (e / (2.0 * noise)) ** 2)
    return J * root[:, None], a * root, e * root
