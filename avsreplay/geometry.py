"""Poses, quaternions and rotation vectors; every function takes one or a batch (leading axes).

Quaternions are ``[x y z w]``, Hamilton, active: ``matrix(q_ab)`` takes coordinates in b to
coordinates in a, and ``multiply(q_ab, q_bc)`` is ``q_ac``. The paper's product has the factors in
the other order, ``a (x) b`` is ``multiply(b, a)``. A single value is computed with scalars, ten
times faster than with arrays and with the same bits.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from avsreplay.errors import value_class

Array = NDArray[np.float64]


def frozen(values: ArrayLike, *shape: int) -> Array:
    """Return a read-only float64 copy in C order.

    Args:
        values: numbers of any shape.
        shape: required shape, -1 for any size of a dimension; any shape is allowed if it is
            omitted.

    Raises:
        ValueError: the values have another shape.
    """
    array = np.array(values, np.float64, order="C")
    if shape and array.shape != shape:
        sizes = zip(shape, array.shape, strict=False)
        if len(shape) != array.ndim or any(s not in (-1, n) for s, n in sizes):
            raise ValueError(f"expected shape {shape}, got {array.shape}")
    array.setflags(write=False)
    return array


IDENTITY_QUAT = frozen([0.0, 0.0, 0.0, 1.0])
_CONJUGATE = frozen([-1.0, -1.0, -1.0, 1.0])


def about(point: Array) -> Array:
    """Return the matrix (6, 6) that takes a small motion d = [theta; v] of a frame to that of a
    point which the frame carries: v + theta x point.

    Args:
        point: (3,) in the frame [m].
    """
    J = np.eye(6)
    J[3:, :3] -= skew(point)
    return J


def covariance_about(C: Array, point: Array) -> Array:
    """Return the covariance of d = [theta; v] about a point that the frame carries.

    Args:
        C: (6, 6) covariance of d about the origin of the frame [rad, m].
        point: (3,) in the frame [m].
    """
    J = about(point)
    return np.asarray(J @ C @ J.T)


def skew(v: ArrayLike) -> Array:
    """Return the matrix [v x] with ``skew(v) @ u == cross(v, u)``.

    Args:
        v: (..., 3) vectors.

    Returns:
        (..., 3, 3) skew-symmetric matrices.
    """
    a: Array = np.asarray(v, dtype=np.float64)
    if a.ndim == 1:
        x, y, z = a.tolist()
        return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    out = np.zeros((*a.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -a[..., 2], a[..., 1], -a[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = a[..., 2], -a[..., 1], a[..., 0]
    return out


def normalise(q: ArrayLike) -> Array:
    """Return the unit quaternion with w >= 0 (if w is 0: first non-zero component > 0).

    Args:
        q: (..., 4) quaternions ``[x y z w]``, not zero.

    Returns:
        (..., 4) unit quaternions of the same rotation.
    """
    unit: Array = np.asarray(q, dtype=np.float64)
    if unit.size == 4 and any(parts := unit.ravel().tolist()):
        return np.array(_unit(*parts)).reshape(unit.shape)
    unit = unit / np.linalg.norm(unit, axis=-1, keepdims=True)
    wxyz = np.roll(unit, 1, axis=-1)
    lead = np.take_along_axis(wxyz, np.argmax(wxyz != 0.0, axis=-1)[..., None], axis=-1)
    return np.asarray(np.where(lead < 0.0, -unit, unit), dtype=np.float64)


def _unit(x: float, y: float, z: float, w: float) -> tuple[float, float, float, float]:
    n = math.sqrt(x * x + y * y + z * z + w * w)
    n = -n if (w or x or y or z) < 0.0 else n
    return x / n, y / n, z / n, w / n


def multiply(q_ab: ArrayLike, q_bc: ArrayLike) -> Array:
    """Return the Hamilton product ``q_ac = q_ab q_bc``.

    Args:
        q_ab: (..., 4) quaternions ``[x y z w]`` from b to a.
        q_bc: (..., 4) quaternions from c to b; the leading dimensions are broadcast.

    Returns:
        (..., 4) quaternions from c to a.
    """
    a, b = np.asarray(q_ab, dtype=np.float64), np.asarray(q_bc, dtype=np.float64)
    if a.ndim == b.ndim == 1:
        return np.array(_product(*a.tolist(), *b.tolist()))
    ax, ay, az, aw = a[..., 0], a[..., 1], a[..., 2], a[..., 3]
    bx, by, bz, bw = b[..., 0], b[..., 1], b[..., 2], b[..., 3]
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0], out[..., 1], out[..., 2], out[..., 3] = _product(ax, ay, az, aw, bx, by, bz, bw)
    return out


def _product(
    ax: Any, ay: Any, az: Any, aw: Any, bx: Any, by: Any, bz: Any, bw: Any
) -> tuple[Any, Any, Any, Any]:
    return (
        aw * bx + bw * ax + (ay * bz - az * by),
        aw * by + bw * ay + (az * bx - ax * bz),
        aw * bz + bw * az + (ax * by - ay * bx),
        aw * bw - (ax * bx + ay * by + az * bz),
    )


def conjugate(q_ab: ArrayLike) -> Array:
    """Return the conjugates ``q_ba`` (..., 4) of quaternions (..., 4): the inverse rotations
    of unit quaternions.

    Args:
        q_ab: quaternions (..., 4) ``[x y z w]``.
    """
    return np.asarray(q_ab, dtype=np.float64) * _CONJUGATE


def matrix(q_ab: ArrayLike) -> Array:
    """Return the active rotation matrix R_ab = I + 2 w [v x] + 2 [v x]^2 (paper, eq:R).

    Args:
        q_ab: (..., 4) unit quaternions ``[x y z w]``.

    Returns:
        (..., 3, 3) rotation matrices.
    """
    q: Array = np.asarray(q_ab, dtype=np.float64)
    if q.size == 4:
        return np.array(_rows(*q.ravel().tolist())).reshape(*q.shape[:-1], 3, 3)
    R = np.empty((*q.shape[:-1], 3, 3))
    for k, row in enumerate(_rows(*np.moveaxis(q, -1, 0))):
        R[..., k, 0], R[..., k, 1], R[..., k, 2] = row
    return R


def _rows(x: Any, y: Any, z: Any, w: Any) -> tuple[tuple[Any, Any, Any], ...]:
    square, w2 = x * x + y * y + z * z, 2.0 * w
    xy, xz, yz = 2.0 * (x * y), 2.0 * (x * z), 2.0 * (y * z)
    return (
        (1.0 + 2.0 * (x * x - square), xy - w2 * z, w2 * y + xz),
        (w2 * z + xy, 1.0 + 2.0 * (y * y - square), yz - w2 * x),
        (xz - w2 * y, w2 * x + yz, 1.0 + 2.0 * (z * z - square)),
    )


def rotate(R_ab: ArrayLike, v_b: ArrayLike) -> Array:
    """Return R_ab v_b, summed term by term for the same bits on any processor.

    Args:
        R_ab: (..., 3, 3) rotation matrices.
        v_b: (..., 3) vectors in b.

    Returns:
        (..., 3) vectors in a.
    """
    R, v = np.asarray(R_ab, dtype=np.float64), np.asarray(v_b, dtype=np.float64)
    if R.ndim == 2 and v.ndim == 1:
        x, y, z = v.tolist()
        return np.array([a * x + b * y + c * z for a, b, c in R.tolist()])
    (x, y, z), out = np.moveaxis(v, -1, 0), np.empty(np.broadcast_shapes(R.shape[:-1], v.shape))
    for k in range(3):  # numpy is slow along rows of three
        out[..., k] = R[..., k, 0] * x + R[..., k, 1] * y + R[..., k, 2] * z
    return out


def quaternion(R_ab: ArrayLike) -> Array:
    """Return the unit quaternion of a rotation matrix.

    Args:
        R_ab: (..., 3, 3) rotation matrices.

    Returns:
        (..., 4) unit quaternions ``[x y z w]`` with w >= 0.
    """
    R = np.asarray(R_ab, dtype=np.float64)
    if R.ndim == 2:
        return np.array(_unit(*_multiple(*R.ravel().tolist())))
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    four_q_qT = np.empty(
        (*R.shape[:-2], 4, 4)
    )  # row k is 4 q_k q: the row of the largest q_k is well conditioned
    four_q_qT[..., 0, 0], four_q_qT[..., 1, 1] = 1 + xx - yy - zz, 1 - xx + yy - zz
    four_q_qT[..., 2, 2], four_q_qT[..., 3, 3] = 1 - xx - yy + zz, 1 + xx + yy + zz
    for i, j, value in (
        (0, 1, R[..., 0, 1] + R[..., 1, 0]),
        (0, 2, R[..., 0, 2] + R[..., 2, 0]),
        (1, 2, R[..., 1, 2] + R[..., 2, 1]),
        (0, 3, R[..., 2, 1] - R[..., 1, 2]),
        (1, 3, R[..., 0, 2] - R[..., 2, 0]),
        (2, 3, R[..., 1, 0] - R[..., 0, 1]),
    ):
        four_q_qT[..., i, j] = four_q_qT[..., j, i] = value
    best = np.argmax(np.diagonal(four_q_qT, axis1=-2, axis2=-1), axis=-1)
    return normalise(np.take_along_axis(four_q_qT, best[..., None, None], axis=-2)[..., 0, :])


def _multiple(*R: float) -> tuple[float, ...]:
    """The quaternion of a rotation matrix, given row by row, times a number."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R
    squares = (1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz)
    a, b, c, d, e, f = xy + yx, xz + zx, yz + zy, zy - yz, xz - zx, yx - xy
    rows = (
        (squares[0], a, b, d),
        (a, squares[1], c, e),
        (b, c, squares[2], f),
        (d, e, f, squares[3]),
    )
    return rows[squares.index(max(squares))]


def exp(rotvec: ArrayLike) -> Array:
    """Return the unit quaternions (..., 4) ``[x y z w]`` of rotation vectors (..., 3) (full angle)
    [rad].

    Args:
        rotvec: rotation vectors (..., 3), full angle [rad].
    """
    v = np.asarray(rotvec, dtype=np.float64)
    half = 0.5 * np.linalg.norm(v, axis=-1, keepdims=True)
    return np.concatenate([0.5 * np.sinc(half / np.pi) * v, np.cos(half)], axis=-1)


def log(q: ArrayLike) -> Array:
    """Return the rotation vector of a quaternion.

    Args:
        q: (..., 4) quaternions ``[x y z w]``, not zero.

    Returns:
        (..., 3) rotation vectors [rad] with an angle in [0, pi].
    """
    v, w = np.split(normalise(q), [3], axis=-1)
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    small = norm < 1e-8
    return np.asarray(
        np.where(small, 2.0, 2.0 * np.arctan2(norm, w) / np.where(small, 1.0, norm)) * v
    )


def angle(q: ArrayLike) -> Array:
    """Return the rotation angles (...) in [0, pi] [rad] of quaternions (..., 4); their length
    does not matter.
    """
    a: Array = np.asarray(q, dtype=np.float64)
    if a.ndim == 1:
        x, y, z, w = a.tolist()
        return np.asarray(2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w)))
    return np.asarray(2.0 * np.arctan2(np.linalg.norm(a[..., :3], axis=-1), np.abs(a[..., 3])))


def angle_between(q_ab: ArrayLike, q_ac: ArrayLike) -> Array:
    """Return the angles (...) in [0, pi] [rad] between attitudes (..., 4).

    Args:
        q_ab: unit quaternions (..., 4).
        q_ac: unit quaternions (..., 4).
    """
    return angle(multiply(conjugate(q_ab), q_ac))


def moved_in_time(points: Array, times: Array, knots: Array, R: Array, t: Array) -> Array:
    """Return points (n, 3) transformed by R p + t, each with the R and t of its own time ``times``
    (n,).

    R (k, 3, 3) and t (k, 3) are given at evenly spaced ``knots`` (k,). Between two knots the point
    is transformed at both, and the result is interpolated.
    """
    at = np.clip((times - knots[0]) / (knots[1] - knots[0]), 0.0, len(knots) - 1.0)
    low = np.minimum(at.astype(int), len(knots) - 2)
    part = (at - low)[:, None]
    moved = [np.einsum("nij,nj->ni", R[k], points) + t[k] for k in (low, low + 1)]
    return np.asarray((1.0 - part) * moved[0] + part * moved[1])


def across(axis: Array) -> Array:
    """Return a unit vector (3,) at right angles to a unit vector (3,): the part of a
    coordinate axis across it.
    """
    side = np.eye(3)[int(np.abs(axis).argmin())]
    side = side - (side @ axis) * axis
    return np.asarray(side / np.linalg.norm(side))


def bounding_diagonal(points: ArrayLike) -> float:
    """Return the diagonal [m] of the bounding box of points (n, 3) [m]."""
    return float(
        np.linalg.norm(np.ptp(np.ascontiguousarray(np.asarray(points).T), axis=1))
    )  # numpy is slow along rows


@value_class
class Pose:
    """Pose T_ab of frame b in frame a: takes coordinates in b to coordinates in a, ``p_a = R_ab p_b
    + t_ab_a``.

    Attributes:
        q: (4,) unit quaternion q_ab ``[x y z w]``, w >= 0.
        t: (3,) origin of b in a [m].
    """

    q: Array
    t: Array

    def __post_init__(self) -> None:
        q, t = normalise(self.q), np.array(self.t, np.float64)
        if q.shape != (4,) or t.shape != (3,):
            raise ValueError(f"expected shapes (4,) and (3,), got {q.shape} and {t.shape}")
        q.flags.writeable = t.flags.writeable = False
        self.q, self.t = q, t  # type: ignore[misc]

    @classmethod
    def _of(cls, q: tuple[float, ...], t: list[float]) -> Pose:
        """The pose of a quaternion that is not zero and of a position: as the constructor, in
        half the time.
        """
        pose, pose_q, pose_t = cls.__new__(cls), np.array(_unit(*q)), np.array(t)
        pose_q.flags.writeable = pose_t.flags.writeable = False
        pose.q, pose.t = pose_q, pose_t  # type: ignore[misc]
        return pose

    @classmethod
    def identity(cls) -> Pose:
        """Return the identity."""
        return cls(IDENTITY_QUAT, np.zeros(3))

    @classmethod
    def from_matrix(cls, T_ab: ArrayLike) -> Pose:
        """Convert a homogeneous matrix; the rotation is orthonormalised through its quaternion.

        Args:
            T_ab: (4, 4) homogeneous matrix, translation in [m].
        """
        a, b, c, _ = np.asarray(T_ab, dtype=np.float64).tolist()
        return cls._of(_unit(*_multiple(*a[:3], *b[:3], *c[:3])), [a[3], b[3], c[3]])

    @property
    def R(self) -> Array:
        """Return the (3, 3) rotation matrix R_ab."""
        return matrix(self.q)

    @property
    def matrix(self) -> Array:
        """Return the (4, 4) homogeneous matrix T_ab."""
        (a, b, c), (x, y, z) = _rows(*self.q.tolist()), self.t.tolist()
        return np.array((*a, x, *b, y, *c, z, 0.0, 0.0, 0.0, 1.0)).reshape(4, 4)

    def inverse(self) -> Pose:
        """Return the inverse T_ba."""
        (x, y, z, w), (u, v, s) = self.q.tolist(), self.t.tolist()
        return self._of(
            (-x, -y, -z, w), [-(a * u + b * v + c * s) for a, b, c in _rows(-x, -y, -z, w)]
        )

    def __matmul__(self, other: Pose) -> Pose:
        """Compose: T_ab @ T_bc = T_ac."""
        return self.composed(self.q, self.t, other.q, other.t)

    @classmethod
    def composed(cls, q_ab: Array, t_ab: Array, q_bc: Array, t_bc: Array) -> Pose:
        """Return T_ac of unit quaternions (4,) and origins (3,) [m]: of b in a and of c in b.

        Args:
            q_ab: attitude (4,) of b in a.
            t_ab: origin (3,) of b in a [m].
            q_bc: attitude (4,) of c in b.
            t_bc: origin (3,) of c in b [m].
        """
        q, (x, y, z), t = q_ab.tolist(), t_bc.tolist(), t_ab.tolist()
        moved = [a * x + b * y + c * z + o for (a, b, c), o in zip(_rows(*q), t, strict=True)]
        return cls._of(_product(*q, *q_bc.tolist()), moved)

    def apply(self, points_b: ArrayLike) -> Array:
        """Transform points from b to a.

        Args:
            points_b: (..., 3) coordinates in b [m].

        Returns:
            (..., 3) coordinates in a [m].
        """
        return np.asarray(points_b, dtype=np.float64) @ self.R.T + self.t


@value_class
class MeasuredPose:
    """A pose T_ac of {C} in {A} that a tracker measured (markers, motion capture), in place of a
    point cloud.

    ``covariance`` (6, 6) is that of the error d = [theta; v] in {C} [rad, m], T_true = T_ac @
    Exp(d); None: not stated.
    """

    T_ac: Pose
    covariance: Array | None = None
