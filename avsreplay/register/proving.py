"""A small target and scans of it, made of formulas alone, on which every back end is tried."""

from __future__ import annotations

import hashlib

import numpy as np

from avsreplay.geometry import Array, Pose, exp
from avsreplay.records import Surface
from avsreplay.register.sampling import sample

__all__ = ["plate_scan", "proving_pose", "proving_surface", "view"]

# centre [m], edge lengths [m], rotation vector [rad] of each box: disjoint, no two alike, nothing symmetric
BOXES = (
    ((0.0, 0.0, 0.0), (2.0, 1.6, 2.4), (0.0, 0.0, 0.0)),
    ((2.6, 0.2, 0.3), (2.2, 0.5, 0.12), (0.3, 0.0, 0.1)),
    ((-0.3, -1.5, 0.8), (0.7, 0.5, 0.9), (0.2, 0.4, -0.3)),
    ((0.2, 0.4, 1.9), (0.5, 0.3, 0.8), (0.0, 0.5, 0.2)),
    ((-1.6, 0.5, -0.6), (0.6, 0.9, 0.4), (-0.4, 0.1, 0.6)),
)
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
FACES = np.array([(a, b, c) for p, q, r, s in QUADS for a, b, c in ((p, q, r), (p, r, s))])


def proving_surface(scale: float = 1.0) -> Surface:
    """Five boxes, about 6.5 m over all at scale 1, in {C}; outward faces."""
    parts = [Pose(exp(turn), np.array(centre)).apply(CORNERS * np.array(size)) for centre, size, turn in BOXES]
    vertices = scale * np.vstack(parts)
    faces = np.vstack([FACES + 8 * k for k in range(len(BOXES))]).astype(np.int32)
    return Surface(vertices, faces, "proving ground", hashlib.sha256(vertices.tobytes()).hexdigest())


def proving_pose(scale: float = 1.0) -> Pose:
    """A T_ac far from anything round, the target 6 m (at scale 1) before the camera."""
    return Pose(exp([0.3, -0.7, 2.0]), scale * np.array([0.2, 0.1, 6.0]))


def view(surface: Surface, count: int, camera_c: Array) -> Array:
    """(n, 3) exact points of the faces that look at a camera there, in {C}; faces do not hide each other."""
    points, normals = sample(surface, count)
    sight = camera_c - points
    facing: Array = points[np.einsum("ij,ij->i", normals, sight) > 0.1 * np.linalg.norm(sight, axis=1)]
    return facing


def plate_scan(scale: float = 1.0) -> Array:
    """(900, 3) points well inside the first box's top face, in {C}: a plane and nothing else."""
    u, v = np.meshgrid(np.linspace(-0.6, 0.6, 30), np.linspace(-0.45, 0.45, 30))
    return scale * np.stack([u.ravel(), v.ravel(), np.full(u.size, 1.2)], axis=1)
