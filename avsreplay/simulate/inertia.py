"""Mass properties of a triangle model, and its principal axes {B}.

Density is uniform over the volume of a closed mesh, or over the area of an open one (a thin shell).
Moments are per unit mass [m2], since only their ratios affect the motion. Sums are exact (fsum):
the order of faces does not matter.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import ArrayLike

from avsreplay import geometry
from avsreplay.errors import UsageError, value_class
from avsreplay.geometry import Array, frozen
from avsreplay.mesh import is_closed
from avsreplay.records import Surface


@value_class
class Body:
    """Mass properties of a rigid body.

    Attributes:
        inertia_c: (3, 3) inertia about the mass centre in the axes of {C}, per unit mass [m2].
        centre_c: (3,) mass centre in {C} [m].
        moments: (3,) principal moments Ixx, Iyy, Izz of {B} per unit mass [m2].
        q_bc: (4,) mu, {C} to {B}, scalar last.
    """

    inertia_c: Array
    centre_c: Array
    moments: Array
    q_bc: Array

    @property
    def c_b(self) -> Array:
        """Origin of {C} in {B} (3,) [m], the paper's varrho: p_b = A(mu) p_c + varrho is zero at
        the mass centre.
        """
        return -geometry.rotate(geometry.matrix(self.q_bc), self.centre_c)

    @property
    def sigma(self) -> Array:
        """Inertia ratios (2,), ((Iyy - Izz) / Ixx, (Izz - Ixx) / Iyy)."""
        xx, yy, zz = self.moments
        return np.array([(yy - zz) / xx, (zz - xx) / yy])


def body_of(surface: Surface) -> Body:
    """Return the body of uniform density with this surface.

    Args:
        surface: a mesh in {C} [m].

    Raises:
        UsageError: the model has no faces, or encloses no volume.
    """
    if not len(surface.faces):
        hint = "name a mesh, or give moments_m2, axes_xyzw and mass_centre_m under [target]"
        raise UsageError("a cloud has no mass", where=surface.name, hint=hint)
    mass, first, second = _moments(surface)
    if not mass > 0.0:
        raise UsageError(
            "the model encloses no volume", where=surface.name, hint="name a mesh that is not flat"
        )
    centre = first / mass
    central = second / mass - np.outer(centre, centre)
    return principal(np.eye(3) * np.trace(central) - central, centre)


def principal(inertia_c: ArrayLike, centre_c: ArrayLike) -> Body:
    """The body with inertia ``inertia_c`` (3, 3) [m2] about its mass centre ``centre_c`` (3,) [m]
    in {C}.

    Of the 24 right-handed orders and signs of its principal axes, {B} has those with the smallest
    rotation from {C}.
    """
    inertia = np.asarray(inertia_c, dtype=np.float64)
    moments, axes = _jacobi(inertia)
    best = max(
        _axis_permutations(axes),
        key=lambda option: (round(float(np.trace(option[0])), 12), option[1]),
    )
    R_cb, order = best
    q_bc = geometry.conjugate(geometry.quaternion(R_cb))
    return Body(
        frozen(inertia),
        frozen(centre_c),
        frozen(moments[list(order)]),
        frozen(geometry.normalise(q_bc)),
    )


def with_axes(moments: ArrayLike, q_bc: ArrayLike, centre_c: ArrayLike) -> Body:
    """Return the body of given principal moments (3,) [m2], axes mu (4,) and mass centre (3,) in
    {C} [m].

    Args:
        moments: principal moments (3,) over the mass [m2].
        q_bc: attitude (4,) of {C} in {B}.
        centre_c: mass centre (3,) in {C} [m].
    """
    R_bc = geometry.matrix(geometry.normalise(q_bc))
    inertia = R_bc.T @ np.diag(np.asarray(moments, dtype=np.float64)) @ R_bc
    return Body(
        frozen(inertia), frozen(centre_c), frozen(moments), frozen(geometry.normalise(q_bc))
    )


def _moments(surface: Surface) -> tuple[float, Array, Array]:
    """Mass, first and second moments about {C}'s origin for unit density."""
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    if is_closed(surface.vertices, surface.faces):
        weight, over, under = (
            np.sum(a * np.cross(b, c), axis=1) / 6.0,
            4.0,
            20.0,
        )  # tetrahedra from the origin
    else:
        weight, over, under = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1), 3.0, 12.0
    s = a + b + c
    first = [math.fsum(weight * s[:, i] / over) for i in range(3)]
    second = np.empty((3, 3))
    for i, j in itertools.combinations_with_replacement(range(3), 2):
        terms = sum((p[:, i] * p[:, j] for p in (a, b, c)), s[:, i] * s[:, j])
        second[i, j] = second[j, i] = math.fsum(weight * terms / under)
    return math.fsum(weight), np.array(first), second


def _axis_permutations(axes: Array) -> list[tuple[Array, tuple[int, ...]]]:
    found = []
    for order in itertools.permutations(range(3)):
        R_cb = axes[:, order] * np.where(np.diagonal(axes[:, order]) < 0.0, -1.0, 1.0)
        if np.linalg.det(R_cb) < 0.0:
            R_cb[:, np.argmin(np.abs(np.diagonal(R_cb)))] *= -1.0
        found.append((R_cb, order))
    return found


def _jacobi(matrix: Array) -> tuple[Array, Array]:
    """Eigenvalues (3,) and vectors (columns) of a symmetric matrix by Jacobi rotations, with
    reproducible bits.
    """
    a, v = (
        [[float(x) for x in row] for row in matrix],
        [[float(i == j) for j in range(3)] for i in range(3)],
    )
    for _sweep in range(12):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            _rotate(a, v, p, q)
    return np.array([a[i][i] for i in range(3)]), np.array(v)


def _rotate(a: list[list[float]], v: list[list[float]], p: int, q: int) -> None:
    if abs(a[p][q]) <= 1e-300 or abs(a[p][q]) < 1e-18 * (abs(a[p][p]) + abs(a[q][q])):
        return
    theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q])
    t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
    c = 1.0 / math.sqrt(t * t + 1.0)
    s = t * c
    for k in range(3):
        a[k][p], a[k][q] = c * a[k][p] - s * a[k][q], s * a[k][p] + c * a[k][q]
    for k in range(3):
        a[p][k], a[q][k] = c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]
        v[k][p], v[k][q] = c * v[k][p] - s * v[k][q], s * v[k][p] + c * v[k][q]
