"""The sides of a triangle mesh: consistent winding, outward faces, and faces of open parts that
both sides show.

Registration with a known position of the camera, signed distances and mass properties need the
outer side of each face (right-hand rule). CAD exports often reverse single faces or mirrored parts.
Parts are the sets of faces that are connected by edges of exactly two faces.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array

# least share of the edges of a closed part that two opposite half-edges form
PAIRED_EDGE_SHARE = 0.95
# least volume of a part with an inside, times six, in units of its area to the power of 3/2
LEAST_VOLUME_RATIO = 1e-9
# least area of an open part over that of the mesh; smaller parts are remains of meshing
LEAST_PART_AREA_SHARE = 1e-3
# area of a circle as long as the open edges of a part, over its area; parts below it have no inner
# side
OPENING_AREA_SHARE = 0.01
# vertices on the same point of a grid this fine are one: exports round 0 to 1e-17
MERGED_OF_EXTENT = 1e-6
_CORNER_DIRECTIONS = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)]) - 1.0  # (26, 3)

Faces = NDArray[np.int32]


def with_area(vertices: Array, faces: NDArray[np.int64]) -> Faces:
    """Return the triangles whose area is not zero; the others have no normal.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices.
    """
    faces = faces.reshape(-1, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        wide = lengths(normals(vertices, faces)) > 0.0
    kept: Faces = np.ascontiguousarray(faces if wide.all() else faces[wide], np.int32)
    return kept


def numbers_with_area(vertices: Array, faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the numbers of the faces whose area is above rounding: |ab x ac| > 1e-12 of the
    longest edge squared.

    ``with_area`` leaves out what has no normal at all; an index also leaves out faces whose normal
    is rounding.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices.
    """
    (ax, bx, cx), (ay, by, cy), (az, bz, cz) = _coordinates(vertices, faces)
    ab2 = (bx - ax) ** 2 + (by - ay) ** 2 + (bz - az) ** 2
    bc2 = (cx - bx) ** 2 + (cy - by) ** 2 + (cz - bz) ** 2
    ca2 = (ax - cx) ** 2 + (ay - cy) ** 2 + (az - cz) ** 2
    longest2 = np.maximum(np.maximum(ab2, bc2), ca2)
    area2 = lengths(normals(vertices, faces))
    return np.flatnonzero(area2 > 1e-12 * longest2).astype(np.int32)


def distinct_rows(rows: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Identify equal rows, such as the repeated vertices of an STL file.

    Args:
        rows: (n, 3), finite.

    Returns:
        The first (k,) of each set of equal rows in the order of the list, and the number (n,) of
        each row's set.
    """
    if not len(rows):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    values = rows + 0.0  # -0.0 equals 0.0
    order = np.lexsort(values.T)
    begins = np.concatenate([[True], (np.diff(values[order], axis=0) != 0.0).any(axis=1)])
    first = np.minimum.reduceat(order, np.flatnonzero(begins))
    place = np.empty(len(first), dtype=np.int64)
    place[np.argsort(first)] = np.arange(len(first))
    number = np.empty(len(values), dtype=np.int64)
    number[order] = place[np.cumsum(begins) - 1]
    return np.sort(first), number


def normals(vertices: Array, faces: NDArray[Any]) -> Array:
    """Return the normals (m, 3) of faces by the right-hand rule, as long as twice their area [m^2].

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices.
    """
    (ax, bx, cx), (ay, by, cy), (az, bz, cz) = _coordinates(vertices, faces)
    ux, uy, uz, wx, wy, wz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    return np.stack([uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx], axis=1)


def lengths(vectors: Array) -> Array:
    """Return the lengths (n,) of vectors (n, 3)."""
    x, y, z = vectors.T
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def _coordinates(vertices: Array, faces: NDArray[Any]) -> list[list[Array]]:
    """The x, y and z of the corners a, b and c of faces, (m,) each: numpy is several times as fast
    on long rows.
    """
    corners = np.ascontiguousarray(faces.T)
    return [[axis[k] for k in corners] for axis in np.ascontiguousarray(vertices.T)]


def is_closed(vertices: Array, faces: Faces) -> bool:
    """Return whether each edge is used as often in one direction as in the other; equal vertices
    count as one.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices.
    """
    corners = _corners(vertices, faces)
    return bool(_edges(corners[(corners < len(vertices)).all(axis=1)]).paired().all())


def outward(vertices: Array, faces: Faces) -> tuple[Faces, int]:
    """Wind the faces consistently and outwards.

    Within a part that is not consistent, the fewer faces are reversed. Then closed parts with a
    negative volume are reversed, unless they are a cavity inside another closed part. Open parts
    have no outer side. Faces with the same vertices get one winding if their part is closed; on an
    open part they may be its two sides, and stay.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices.

    Returns:
        The faces (m, 3) in the same order, and the number of faces that were reversed.
    """
    if not len(faces):
        return faces, 0
    first, number, turned = _distinct(corners := _corners(vertices, faces))
    reversed_, solid = _reversed(vertices, faces[first], corners[first])
    changed = reversed_[number] ^ (turned & solid[number])
    if not changed.any():
        return faces, 0
    result: Faces = np.ascontiguousarray(np.where(changed[:, None], faces[:, ::-1], faces))
    return result, int(changed.sum())


def _reversed(
    vertices: Array, faces: Faces, corners: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of distinct faces (m,) must be reversed, and which belong to a closed part with a
    volume; ``corners``: as ``_corners`` gives them.
    """
    parts = _parts(_edges(corners))
    wound = np.where(parts.reversed[:, None], faces[:, ::-1], faces)
    volume, area = _volumes(vertices, wound, parts.of)
    closed = parts.closed & (np.abs(volume) > LEAST_VOLUME_RATIO * area**1.5)
    inside_out = np.full(len(volume), bool(volume[closed].sum() < 0.0)) & closed
    wound = np.where(inside_out[parts.of, None], wound[:, ::-1], wound)
    volume = np.where(inside_out, -volume, volume)
    solid, negative = closed & (volume > 0.0), closed & (volume < 0.0)
    cavities = [
        part
        for part in np.flatnonzero(negative)
        if _is_inside(vertices, wound[parts.of == part], wound[solid[parts.of]])
    ]
    inside_out = inside_out ^ negative
    inside_out[cavities] ^= True
    return parts.reversed ^ inside_out[parts.of], closed[parts.of]


def signed_volume(vertices: Array, faces: Faces) -> float:
    """Return the volume [m^3] that the faces enclose, negative if they point inwards.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices.
    """
    return float(_volumes(vertices, faces, np.zeros(len(faces), np.int64))[0].sum()) / 6.0


def open_parts(vertices: Array, faces: Faces) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the faces that differ, and the part of each that has openings.

    The edges that no opposite half-edge meets are the rims of openings. A finely meshed bowl has
    few of them, and the seams of patches with unequal vertices are rims as well: only the
    directions from which the faces of such a part are seen tell its sides. Parts with less than a
    thousandth of the area are left out. All parts of a mesh without a volume are open, as of one
    that lists each face with both windings; faces with equal vertices are then one.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices.

    Returns:
        Numbers (k,) of faces, and the numbers (k,) of their parts, -1 for parts without openings.
    """
    if not len(faces):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    _, either, turned = _distinct(corners := _corners(vertices, faces))
    volume, whole = (
        float(each[0]) for each in _volumes(vertices, faces, np.zeros(len(faces), np.int64))
    )
    flat = abs(volume) <= LEAST_VOLUME_RATIO * whole**1.5
    first = _distinct_keys(either if flat else _keys(either, turned))[0]
    edges, few = _edges(corners[first]), faces[first]
    paired = edges.paired()
    if paired.all() and not flat:
        return first, np.full(len(first), -1)
    parts = _parts(edges)
    area = _volumes(vertices, few, parts.of)[1]
    opened = (area > LEAST_PART_AREA_SHARE * area.sum()) & (
        flat
        | (_openings(vertices, few, corners[first], paired, parts.of) > OPENING_AREA_SHARE * area)
    )
    return first, np.where(opened[parts.of], parts.of, -1)


def _openings(
    vertices: Array,
    faces: Faces,
    corners: NDArray[np.int64],
    paired: NDArray[np.bool_],
    of: NDArray[np.int64],
) -> Array:
    """Area of the circles that are as long as the rims of each part; ``corners``: faces with
    equal vertices as one.
    """
    rim = np.flatnonzero(~paired)
    face, side = rim // 3, rim % 3
    start, end = corners[face, side], corners[face, (side + 1) % 3]
    length = lengths(vertices[faces[face, side]] - vertices[faces[face, (side + 1) % 3]])
    loop = components(int(corners.max()) + 1, start, end)[start]
    first, number = _distinct_keys(_keys(of[face], loop))
    around = np.bincount(number, length)
    return np.asarray(
        np.bincount(of[face][first], around**2 / (4.0 * np.pi), int(of.max()) + 1),
        dtype=np.float64,
    )


@value_class
class _Edges:
    """Number (3 m,) of the edge of each half-edge, its direction (3 m,) as 1 or -1, and the pairs
    with two faces.

    A pair is two half-edges (k, 2) that are alone at their edge.
    """

    number: NDArray[np.int64]
    sign: NDArray[np.int64]
    pairs: NDArray[np.int64]

    def paired(self) -> NDArray[np.bool_]:
        """Which half-edges (3 m,) have as many opposite ones."""
        balanced: NDArray[np.bool_] = np.bincount(self.number, self.sign)[self.number] == 0.0
        return balanced


@value_class
class _Parts:
    """Part (m,) of each face; whether (m,) it must be reversed for a consistent winding;
    which parts are closed.
    """

    of: NDArray[np.int64]
    reversed: NDArray[np.bool_]
    closed: NDArray[np.bool_]


def _corners(vertices: Array, faces: Faces) -> NDArray[np.int64]:
    """The faces (m, 3) with equal vertices as one.

    A face with two equal corners is a part of its own.
    """
    step = MERGED_OF_EXTENT * float(np.ptp(vertices, axis=0).max())
    x, y, z = np.round((vertices - vertices.min(axis=0)) / max(step, np.finfo(float).tiny)).T
    corners = _distinct_keys(_keys(_keys(x, y), z))[1][faces]
    flat = (corners == np.roll(corners, 1, axis=1)).any(axis=1)
    corners[flat] = len(vertices) + np.arange(3 * np.count_nonzero(flat)).reshape(-1, 3)
    return corners


def _distinct(
    corners: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Faces that differ: indices (k,), which of them (m,) each face equals, and whether its
    winding is the other.
    """
    a, b, c = corners.T
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    middle = a + b + c - low - high
    even = ((a <= b) & (b <= c)) | ((b <= c) & (c < a)) | ((c < a) & (a <= b))
    pair = _distinct_keys(_keys(low, middle))[1]
    first, number = _distinct_keys(_keys(pair, high))
    return first, number, even != even[first[number]]


def _keys(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.int64]:
    """One integer for each pair of integers of 0 and above: equal ones for equal pairs only, in
    lexicographic order.
    """
    most = int(b.max(initial=0)) + 1
    return np.asarray(a.astype(np.int64) * most + b.astype(np.int64))


def _distinct_keys(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """As ``distinct_rows``, of integers (n,) >= 0."""
    order = np.argsort(keys, kind="stable")
    begins = np.diff(keys[order], prepend=-1) != 0
    place = np.empty(len(keys), dtype=np.int64)
    first = order[begins]
    place[np.sort(first)] = np.arange(len(first))
    number = np.empty(len(keys), dtype=np.int64)
    number[order] = place[first][np.cumsum(begins) - 1]
    return np.sort(first), number


def _edges(corners: NDArray[np.int64]) -> _Edges:
    start, end = corners.ravel(), corners[:, (1, 2, 0)].ravel()
    key = np.minimum(start, end) * (corners.max() + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    begins = np.diff(key[order], prepend=-1) != 0
    number = np.empty(len(key), dtype=np.int64)
    number[order] = np.cumsum(begins) - 1
    first = np.flatnonzero(begins)
    twice = first[np.diff(first, append=len(key)) == 2]
    return _Edges(
        number, np.where(start < end, 1, -1), np.stack([order[twice], order[twice + 1]], axis=1)
    )


def _parts(edges: _Edges) -> _Parts:
    """The parts of a mesh.

    Where faces must be reversed, each face is two nodes of a graph, as it is and reversed. Nodes
    are connected if the faces share an edge and are wound consistently. A part that can be wound
    consistently is two components of it.
    """
    m = len(edges.number) // 3
    a, b = edges.pairs.T // 3
    same = edges.sign[edges.pairs[:, 0]] == edges.sign[edges.pairs[:, 1]]
    if not same.any():
        of, reversed_ = components(m, a, b), np.zeros(m, bool)
    else:
        nodes = components(
            2 * m, np.append(a, a + m), np.append(b + same * m, b + ~same * m)
        ).reshape(2, m)
        _, of = np.unique(nodes.min(axis=0), return_inverse=True)
        turned = nodes[1] < nodes[0]
        most = np.bincount(of, turned) > 0.5 * np.bincount(of)
        reversed_ = (turned ^ most[of]) & (nodes[0] != nodes[1])
    sign = np.where(np.repeat(reversed_, 3), -edges.sign, edges.sign)
    group = edges.number
    if np.bincount(group).max() > 2:  # several parts can meet at such an edge
        _, group = np.unique(group * (of.max() + 1) + np.repeat(of, 3), return_inverse=True)
    paired = np.bincount(group, sign)[group] == 0.0
    return _Parts(of, reversed_, _share(paired, of) >= PAIRED_EDGE_SHARE)


def components(nodes: int, a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number (nodes,) of the connected component of each node, in the order of the first
    nodes.

    Each node is linked to one of a lower number in its component until all are linked to the first.

    Args:
        nodes: number of nodes.
        a: nodes (n,) where the edges begin.
        b: nodes (n,) where they end.
    """
    first = np.arange(nodes)
    while len(a):
        low, high = np.minimum(first[a], first[b]), np.maximum(first[a], first[b])
        apart = low != high
        a, b = a[apart], b[apart]
        np.minimum.at(first, high[apart], low[apart])
        while not np.array_equal(further := first[first], first):
            first = further
    return np.unique(first, return_inverse=True)[1]


def _share(paired: NDArray[np.bool_], of: NDArray[np.int64]) -> Array:
    """Share of paired half-edges of each part."""
    share: Array = np.bincount(of, paired.reshape(-1, 3).mean(axis=1)) / np.bincount(of)
    return share


def _volumes(vertices: Array, faces: Faces, of: NDArray[np.int64]) -> tuple[Array, Array]:
    """Six times the signed volume and the area of each part; tetrahedra from the centroid of
    its faces.
    """
    corners, doubled = _coordinates(vertices, faces), normals(vertices, faces)
    count, heights = np.bincount(of), np.zeros(len(faces))
    for (a, b, c), normal in zip(corners, doubled.T, strict=True):
        centre = np.bincount(of, (a + b + c) / 3.0) / count
        heights += (a - centre[of]) * normal
    volumes, areas = (np.bincount(of, each) for each in (heights, 0.5 * lengths(doubled)))
    return volumes.astype(np.float64), areas.astype(np.float64)


def _is_inside(vertices: Array, part: Faces, others: Faces) -> bool:
    """Whether a part is inside other closed parts: at its outermost vertices and on its largest
    faces.

    The solid angle of closed parts is 4 pi inside them. All vertices of a rod may be inside the
    parts that it joins.
    """
    if not len(others):
        return False
    points, corners = vertices[np.unique(part)], vertices[others]
    outermost = np.unique(np.argmax(points @ _CORNER_DIRECTIONS.T, axis=0))
    largest = np.argsort(-lengths(normals(vertices, part)), kind="stable")
    middles = vertices[part[largest[: len(_CORNER_DIRECTIONS)]]].mean(axis=1)
    tested = np.concatenate([middles, points[outermost]])
    return all(_solid_angle(corners - p) > 2.0 * np.pi for p in tested)


def _solid_angle(corners: Array) -> float:
    """Solid angle [sr] at the origin of outward triangles (m, 3, 3) (Van Oosterom and Strackee
    1983).
    """
    a, b, c = (corners[:, k] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dots = [np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a))]
    below = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return float(2.0 * np.arctan2(np.einsum("ij,ij->i", a, np.cross(b, c)), below).sum())
