"""Which motions a view leaves free, in plain words: "slides along x", "turns about z"."""

from __future__ import annotations

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array, Pose

__all__ = ["FREE_BELOW", "free_directions", "loose_directions", "scaled_information", "turn_words"]

FREE_BELOW = 1e-3  # a motion that moves the rms point by 1 but its surface distance by less than 0.032 is free
AXIS_WITHIN = 0.966  # cosine of 15 deg: nearer than that to an axis is called by the axis' name


def scaled_information(J: Array, centre: Array) -> tuple[Array, float]:
    """(6, 6) mean of J'J with turns taken about ``centre`` and in units of the inliers' rms radius L; and L [m].

    Each diagonal entry is then the mean squared change of surface distance per squared unit of point motion, within
    0 and about 1, whatever the size of the target.
    """
    n = J[:, 3:]
    turns = J[:, :3] - np.cross(centre, n)  # (p - centre) x n
    radius = float(np.sqrt(np.mean(np.sum(turns**2, axis=1))))
    scaled = np.hstack([turns / max(radius, np.finfo(float).tiny), n])
    return scaled.T @ scaled / len(J), radius


def free_directions(J: Array, centre: Array) -> tuple[str, ...]:
    """Words for every motion whose scaled information is below ``FREE_BELOW``; empty where the view holds all six."""
    info, _ = scaled_information(J, centre)
    values, vectors = np.linalg.eigh(info)
    free = vectors[:, values < FREE_BELOW].T
    return tuple(_words(row) for row in _plain_basis(free))


def loose_directions(P: Array, extent_m: float) -> tuple[str, ...]:
    """Words for every motion whose 1 sigma by P (6, 6), turns in units of the extent, is the extent or more.

    Such a motion is held by next to nothing, whatever the points' number says.
    """
    scale = np.repeat([1.0, 1.0 / extent_m], 3)
    values, vectors = np.linalg.eigh(P * np.outer(scale, scale))
    return tuple(_words(row) for row in _plain_basis(vectors[:, values >= 1.0].T))


def turn_words(step: Pose) -> str:
    """A rigid step in {C} in words: "turned 180 deg about x"."""
    degrees = float(np.degrees(geometry.angle(step.q)))
    if degrees < 1.0:
        return f"moved along {_axis(step.t)}"
    return f"turned {degrees:.0f} deg about {_axis(geometry.log(step.q))}"


def _plain_basis(rows: Array) -> Array:
    """Another basis of the same space, by elimination with full pivoting: one motion a row, as few axes as possible."""
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
