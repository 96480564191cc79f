"""Closed triangle solids in code: corners counter-clockwise seen from outside, so normals point outward."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from avsreplay.geometry import Array, Pose

__all__ = ["Solid", "box", "extrusion", "frustum", "join", "moved", "shell"]


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A closed triangle surface.

    Attributes:
        vertices: (n, 3) [m].  faces: (m, 3) vertex indices, outward by the right hand.
    """

    vertices: Array
    faces: NDArray[np.int32]


def join(solids: Iterable[Solid]) -> Solid:
    """Several solids as one list of triangles; touching parts keep their own faces."""
    parts = list(solids)
    shifts = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    faces = np.concatenate([p.faces + s for p, s in zip(parts, shifts, strict=True)]).astype(np.int32)
    return Solid(np.concatenate([p.vertices for p in parts]), faces)


def moved(solid: Solid, pose: Pose) -> Solid:
    """The solid carried by ``pose`` (T_cs: its own frame to the model's)."""
    return Solid(pose.apply(solid.vertices), solid.faces)


def extrusion(outline: Sequence[tuple[float, float]], x0: float, x1: float) -> Solid:
    """An outline in (y, z), counter-clockwise about +x, star-shaped from its mean point, from x0 to x1 [m]."""
    centre = tuple(sum(c) / len(outline) for c in zip(*outline, strict=True))
    return _tube([[(x0, *centre)], [(x0, *p) for p in outline], [(x1, *p) for p in outline], [(x1, *centre)]])


def box(low: ArrayLike, high: ArrayLike) -> Solid:
    """The box between two corners (3,) [m], two triangles a side."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    corners = [(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Solid(np.array(corners), np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32))


def frustum(x0: float, r0: float, x1: float, r1: float, sides: int = 24) -> Solid:
    """A closed cone frustum about x from radius r0 at x0 to r1 at x1 > x0 [m]."""
    return _tube([[(x0, 0.0, 0.0)], _ring(x0, r0, sides), _ring(x1, r1, sides), [(x1, 0.0, 0.0)]])


def shell(x0: float, r0: float, x1: float, r1: float, wall: float, floor: float, sides: int = 24) -> Solid:
    """An open cup about x: radius r0 at x0, r1 at its mouth x1 [m]; ``wall`` thick, its bottom at x0 + floor."""
    outer0, outer1 = _ring(x0, r0, sides), _ring(x1, r1, sides)
    inner1, inner0 = _ring(x1, r1 - wall, sides), _ring(x0 + floor, r0 - wall, sides)
    return _tube([[(x0, 0.0, 0.0)], outer0, outer1, inner1, inner0, [(x0 + floor, 0.0, 0.0)]])


def _ring(x: float, radius: float, sides: int) -> list[tuple[float, float, float]]:
    angles = [2.0 * math.pi * k / sides for k in range(sides)]
    return [(x, radius * math.cos(a), radius * math.sin(a)) for a in angles]


def _tube(rings: Sequence[Sequence[tuple[float, float, float]]]) -> Solid:
    """Rings about x joined in order, from a single point to a single point."""
    vertices = np.array([p for ring in rings for p in ring], dtype=np.float64)
    starts = np.cumsum([0, *(len(r) for r in rings)])
    faces: list[tuple[int, int, int]] = []
    for a, b, low, high in zip(starts[:-2], starts[1:-1], rings[:-1], rings[1:], strict=True):
        n = max(len(low), len(high))
        for k in range(n):
            i, j = k % len(low), (k + 1) % len(low)
            p, q = k % len(high), (k + 1) % len(high)
            if i != j:
                faces.append((a + i, a + j, b + p))
            if p != q:
                faces.append((a + j, b + q, b + p))
    return Solid(vertices, np.array(faces, np.int32))
