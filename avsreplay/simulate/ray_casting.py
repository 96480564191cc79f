"""First intersection of rays with a triangle mesh: by embreex where it is installed, by an exhaustive search elsewhere.

Either engine only finds the triangle; the range is computed from the plane of that triangle in float64.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import MissingBackend
from avsreplay.geometry import Array
from avsreplay.records import Surface

CHUNK = 1 << 20  # ray-triangle pairs held at once by the exact search
Hits = NDArray[np.int64]
Search = Callable[[Array, Array], Hits]


class Engine(Enum):
    """The search for the triangle."""

    AUTO = "auto"  # embree where embreex is installed, else exact
    EMBREE = "embree"  # float32, fast; hits on an edge may differ between processors
    EXACT = "exact"  # every triangle in float64: slow, the same bits on any machine


class RayCaster:
    """Casts rays on one mesh.

    Args:
        surface: The mesh.
        engine: The search for the triangle.

    Raises:
        MissingBackend: embree is requested and embreex is not installed.
    """

    def __init__(self, surface: Surface, engine: Engine = Engine.AUTO) -> None:
        corners = surface.vertices[surface.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        keep = np.linalg.norm(normals, axis=1) > 0.0  # a zero-area triangle cannot be hit
        self._index = np.flatnonzero(keep)
        self._corners = np.ascontiguousarray(corners[keep])
        self._normals = normals[keep] / np.linalg.norm(normals[keep], axis=1, keepdims=True)
        self.engine = _resolve(engine)
        build = _embree if self.engine is Engine.EMBREE else _exact
        self._search = build(self._corners)

    def ranges(self, origins: Array, directions: Array) -> tuple[Array, Array, Hits]:
        """First intersections of rays.

        Args:
            origins: (n, 3), or (1, 3) where all rays have one origin [m].
            directions: (n, 3) unit vectors.

        Returns:
            Range (n,) [m] (inf: none), cosine (n,) of the angle of incidence, and face (n,) of the mesh (-1: none).
        """
        face = self._search(origins, directions)
        origins = np.broadcast_to(origins, directions.shape)
        hit = np.flatnonzero(face >= 0)
        normal = self._normals[face[hit]]
        cosine = _dot(normal, directions[hit])
        ranges, cosines, faces = np.full(len(face), np.inf), np.zeros(len(face)), np.full(len(face), -1)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = _dot(normal, self._corners[face[hit], 0] - origins[hit]) / cosine
        good = np.isfinite(depth) & (depth > 0.0)
        ranges[hit[good]], cosines[hit[good]] = depth[good], np.abs(cosine[good])
        faces[hit[good]] = self._index[face[hit[good]]]
        return ranges, cosines, faces


def _resolve(engine: Engine) -> Engine:
    present = importlib.util.find_spec("embreex") is not None
    if engine is Engine.EMBREE and not present:
        hint = "pip install embreex, or set scanner.engine to 'exact' (slower)"
        raise MissingBackend("embreex is not installed", where="scanner.engine", hint=hint)
    if engine is Engine.AUTO:
        return Engine.EMBREE if present else Engine.EXACT
    return engine


def _embree(corners: Array) -> Search:
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, corners.astype(np.float32))

    def search(origins: Array, directions: Array) -> Hits:
        if not len(origins):
            return np.empty(0, np.int64)
        starts = np.ascontiguousarray(np.broadcast_to(origins, directions.shape), np.float32)
        found = scene.run(starts, np.ascontiguousarray(directions, np.float32))
        return np.asarray(found, dtype=np.int64)

    return search


def _exact(corners: Array) -> Search:
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]

    def search(origins: Array, directions: Array) -> Hits:
        rows = max(1, CHUNK // max(1, len(a)))
        parts = [
            _nearest(
                origins[k : k + rows, None] if len(origins) > 1 else origins[None], directions[k : k + rows], a, e1, e2
            )
            for k in range(0, len(directions), rows)
        ]
        return np.concatenate([np.empty(0, np.int64), *parts])

    return search


def _nearest(origins: Array, directions: Array, a: Array, e1: Array, e2: Array) -> Hits:
    """Index of the nearest triangle (m, corner a, edges e1, e2) hit by each ray, -1 where none.

    Moeller and Trumbore's test, its triple products permuted so that all but the direction is computed once
    where the rays share an origin: origins (n or 1, 1, 3), directions (n, 3).
    """
    s = origins - a
    q, rays = np.cross(s, e1), directions[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / _dot(rays, np.cross(e2, e1))
        u, v, t = _dot(rays, np.cross(e2, s)) * scale, _dot(rays, q) * scale, _dot(q, e2) * scale
        inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)
    t = np.where(inside, t, np.inf)
    best = np.argmin(t, axis=1)
    return np.where(np.isfinite(t[np.arange(len(t)), best]), best, -1)


def _dot(u: Array, v: Array) -> Array:
    return np.asarray(u[..., 0] * v[..., 0] + u[..., 1] * v[..., 1] + u[..., 2] * v[..., 2])
