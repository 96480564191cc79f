"""Directions of a pose that a view does not determine, such as the rotation of a cylinder about its
axis.

A motion of the target in {C} is written x = [L theta; u]: rotation about the centroid of the
points, in units of their rms radius L, and displacement of the centroid. The mean information of a
point on x then lies between 0 and about 1 for each direction, whatever the size of the target.
Directions below ``FREE_BELOW`` are unobservable.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.register.covariance import Evidence

# a motion that moves the rms point by 1 but its surface distance by less than 0.032 is unobservable
FREE_BELOW = 1e-3
# cosine of 15 deg: a direction nearer than that to an axis is given the name of the axis
AXIS_WITHIN = 0.966


@value_class
class Directions:
    """Observable and unobservable directions of one view.

    Attributes:
        free: (6, k) unobservable directions of x, orthonormal.
        observable: (6, 6 - k) the others.
        to_x: (6, 6) x = to_x d for d = [theta; v] about the origin of {C}.
        level: mean information of the scan on an observable direction of x.
        centre: (3,) centroid of the points in {C} [m].
        radius_m: L.
    """

    free: Array
    observable: Array
    to_x: Array
    level: float
    centre: Array
    radius_m: float

    @classmethod
    def of(cls, total: Array, count: int, centre: Array) -> Directions:
        """Return the directions by the sum of J'J (6, 6) over ``count`` points with the centroid
        (3,) [m].
        """
        info, radius = scaled_information(total, count, centre)
        values, vectors = np.linalg.eigh(info)
        to_x = geometry.about(centre)  # the inverse of d = shift x in scaled_information
        to_x[:3] *= radius
        free = values < FREE_BELOW
        level = count * float(values[~free].mean())
        return cls(vectors[:, free], vectors[:, ~free], to_x, level, centre, radius)

    @property
    def motions(self) -> Array:
        """The unobservable directions as columns d = [theta; v] (6, k), for |x| = 1 m."""
        return np.asarray(np.linalg.solve(self.to_x, self.free))

    @property
    def words(self) -> tuple[str, ...]:
        """The unobservable directions, one name each."""
        return tuple(_words(row) for row in _sparse_basis(self.free.T)) if self.free.size else ()

    def held(self, found: Evidence) -> Evidence:
        """Return the sums with information on the unobservable directions, so that they determine a
        pose.

        It is the mean information of the observable ones, spread evenly over the patches. Both
        kinds of directions are orthogonal in the information, so that the covariance of the
        observable ones does not change.
        """
        F = self.to_x.T @ self.free
        return replace(found, normals=found.normals + self.level / len(found.normals) * (F @ F.T))

    def observable_information(self, P: Array) -> Array:
        """Return the information (6, 6) of d by a covariance P (6, 6) of d, zero along the
        unobservable directions.
        """
        U = self.to_x.T @ self.observable  # columns: gradients of the observable components of x
        V = np.linalg.inv(self.observable.T @ self.to_x @ P @ self.to_x.T @ self.observable)
        info = U @ V @ U.T
        return np.asarray(0.5 * (info + info.T))

    def nearest(self, T_ca: Pose, other: Pose) -> Pose:
        """Return the pose nearest ``other`` that ``T_ca`` is carried to by a motion along the
        unobservable directions.

        The motion is a screw motion, so that a body of revolution is carried onto itself by any
        angle.
        """
        step = other @ T_ca.inverse()
        theta = geometry.log(step.q)
        x = np.concatenate(
            [
                self.radius_m * theta,
                np.linalg.solve(_screw(theta), step.apply(self.centre) - self.centre),
            ]
        )
        along = self.free @ (self.free.T @ x)
        theta = along[:3] / self.radius_m
        q, c = geometry.exp(theta), self.centre
        return Pose(q, c + _screw(theta) @ along[3:] - geometry.matrix(q) @ c) @ T_ca

    def refined(self, T_ca: Pose, info: Array, gradient: Array) -> Pose:
        """Return ``T_ca`` after one point-to-plane step along the observable directions.

        Args:
            T_ca: the pose.
            info: sum of J'J (6, 6) at it, see ``surface_index.NormalEquations``.
            gradient: sum of J'e (6,) at it.
        """
        U = np.linalg.solve(self.to_x, self.observable)
        d = U @ np.linalg.solve(U.T @ info @ U, U.T @ gradient)
        return Pose(geometry.exp(d[:3]), d[3:]) @ T_ca


def _screw(theta: Array) -> Array:
    """V (3, 3) with exp([theta; u]) = (exp(theta), V u), the left Jacobian of SO(3)."""
    W, angle = geometry.skew(theta), float(np.linalg.norm(theta))
    if angle < 1e-4:
        return np.asarray(np.eye(3) + 0.5 * W + W @ W / 6.0)
    return np.asarray(
        np.eye(3)
        + (1.0 - np.cos(angle)) / angle**2 * W
        + (angle - np.sin(angle)) / angle**3 * W @ W
    )


def scaled_information(total: Array, count: int, centre: Array) -> tuple[Array, float]:
    """Return the mean of J'J (6, 6) with rotations about ``centre`` in units of the rms radius L,
    and L [m].

    ``total`` is the sum of J'J over ``count`` points, with rotations about the origin. Each
    diagonal entry is the mean squared change of surface distance per squared unit of point motion,
    between 0 and about 1, whatever the size of the target.
    """
    shift = np.eye(6)
    shift[3:, :3] = geometry.skew(centre)  # (p - centre) x n = p x n - centre x n
    mean = shift.T @ total @ shift / count
    radius = float(np.sqrt(max(np.trace(mean[:3, :3]), 0.0)))
    scale = np.repeat([1.0 / max(radius, np.finfo(float).tiny), 1.0], 3)
    return scale[:, None] * mean * scale, radius


def unbounded_directions(P: Array, extent_m: float) -> tuple[tuple[str, ...], Array]:
    """Return every motion whose standard deviation by P (6, 6) is at least the extent (rotations: 1
    rad).

    Args:
        P: covariance of d = [theta; v] in {C} [rad, m].
        extent_m: the target's bounding diagonal [m].

    Returns:
        Their names, and the motions as columns d (6, k), of length 1 in units of 1 rad and of the
        extent.
    """
    scale = np.repeat([1.0, extent_m], 3)
    scaled = P / np.outer(scale, scale)
    if np.trace(scaled) < 1.0:  # all eigenvalues are then below 1
        return (), np.zeros((6, 0))
    values, vectors = np.linalg.eigh(scaled)
    free = vectors[:, values >= 1.0]
    return tuple(_words(row) for row in _sparse_basis(free.T)), scale[:, None] * free


def motions_outside(motions: Array, free: Array | None, length_m: float) -> Array:
    """Return those of the motions d (6, k) that are not in the span of others (6, n).

    Args:
        motions: as columns d = [theta; v].
        free: the others; None for none.
        length_m: a rotation by 1 rad counts as much as a displacement by this length.
    """
    if free is None or not motions.size:
        return motions
    scale = np.repeat([length_m, 1.0], 3)[:, None]
    basis, d = (
        np.linalg.qr(scale * free)[0],
        scale * motions / np.linalg.norm(scale * motions, axis=0),
    )
    return motions[:, np.linalg.norm(basis.T @ d, axis=0) < AXIS_WITHIN]


def motion_words(d: Array) -> tuple[str, ...]:
    """Name the motions d = [theta; v] (6, k), one name each."""
    return tuple(_words(column) for column in d.T)


def turn_words(step: Pose) -> str:
    """Describe a rigid motion in {C}: "turned 180 deg about x"."""
    degrees = float(np.degrees(geometry.angle(step.q)))
    if degrees < 1.0:
        return f"moved along {_axis(step.t)}"
    return f"turned {degrees:.0f} deg about {_axis(geometry.log(step.q))}"


def _sparse_basis(rows: Array) -> Array:
    """Basis of the same space by elimination with full pivoting: one motion per row, as few
    axes as possible.
    """
    basis = rows.copy()
    used: list[int] = []
    for k in range(len(basis)):
        left = np.abs(basis[k:])
        left[:, used] = 0.0
        row, column = divmod(int(np.argmax(left)), basis.shape[1])
        basis[[k, k + row]] = basis[[k + row, k]]
        basis[k] /= basis[k, column]
        others = [i for i in range(len(basis)) if i != k]
        basis[others] -= np.outer(basis[others, column], basis[k])
        used.append(column)
    basis = basis[np.argsort(used)]
    unit: Array = basis / np.linalg.norm(basis, axis=1, keepdims=True)
    return unit


def _words(motion: Array) -> str:
    turn, slide = motion[:3], motion[3:]
    if np.linalg.norm(slide) >= np.linalg.norm(turn):
        return f"slides along {_axis(slide)}"
    return f"turns about {_axis(turn)}"


def _axis(vector: Array) -> str:
    unit = vector / np.linalg.norm(vector)
    k = int(np.argmax(np.abs(unit)))
    if abs(unit[k]) > AXIS_WITHIN:
        return "xyz"[k]
    unit = unit * np.sign(unit[k])
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in unit) + ")"
