"""Built-in targets, made of closed solids. {C} is on the face of the grapple fixture, +x outward:
the approach axis.

Vertices are rounded to float32 as in the binary PLY file, so that this surface and the one in a log
are identical. Faces are counter-clockwise seen from outside.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from avsreplay import geometry
from avsreplay.errors import UsageError, value_class
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Surface
from avsreplay.settings import Settings, is_unit, setting
from avsreplay.simulate.inertia import Body, body_of, with_axes


class Shape(Enum):
    """The built-in targets."""

    SATELLITE = "satellite"  # bus, two unequal panels, nozzle, fixture, small parts: no symmetry
    BRACKET = "bracket"  # an L-shaped bracket with a tapered pin
    STAGE = (  # a spent rocket stage: nearly a body of revolution, marked by a raceway and a box
        "stage"
    )
    CUBE = "cube"  # fully symmetric: 24 equivalent poses


FROM_MESH = "from the mesh, of uniform density"
# least distance of an inertia ratio from -1 and 1, which no body reaches
LEAST_INERTIA_MARGIN = 1e-9


@dataclass(frozen=True, slots=True)
class TargetParams(Settings):
    """The table [target]: the model, and mass properties that replace those of the mesh."""

    shape: Shape = setting(Shape.SATELLITE, "A built-in target; not used where a model is given.")
    model: str = setting(
        "",
        "STL, OBJ or PLY file in metres in {C}, relative to the scenario file; empty for the"
        " built-in shape.",
    )
    moments_m2: tuple[float, float, float] | None = setting(
        None,
        "Principal moments of inertia of {B} per unit mass.",
        unit="m^2",
        above=0.0,
        unset=FROM_MESH,
    )
    axes_xyzw: tuple[float, float, float, float] | None = setting(
        None, "mu = q_bc, the rotation from {C} to {B}.", unset=FROM_MESH
    )
    mass_centre_m: tuple[float, float, float] | None = setting(
        None, "Mass centre in {C}.", unit="m", unset=FROM_MESH
    )

    def check(self) -> None:
        """Raise ValueError where the mass properties are not those of a rigid body."""
        if self.moments_m2 is not None and not _triangle(self.moments_m2):
            raise ValueError(
                f"moments_m2 = {list(self.moments_m2)} are not those of a body: each below the"
                " others' sum"
            )
        if self.axes_xyzw is not None and not is_unit(self.axes_xyzw):
            raise ValueError(f"axes_xyzw = {list(self.axes_xyzw)} is not a unit quaternion")
        if (self.moments_m2 is None) != (self.axes_xyzw is None):
            raise ValueError("moments_m2 and axes_xyzw go together: give both or neither")


def builtin_surface(shape: Shape = Shape.SATELLITE) -> Surface:
    """Return the mesh of a built-in target in {C}, with its PLY bytes. Parts that touch keep their
    own faces.

    Args:
        shape: The built-in target.
    """
    parts = {
        Shape.SATELLITE: _satellite,
        Shape.BRACKET: _bracket,
        Shape.STAGE: _stage,
        Shape.CUBE: _cube,
    }[shape]()
    solid = join(parts)
    vertices = solid.vertices.astype("<f4")
    data = ply_bytes(vertices, solid.faces)
    return Surface(
        frozen(vertices), solid.faces, f"{shape.value}.ply", hashlib.sha256(data).hexdigest(), data
    )


def body(params: TargetParams, surface: Surface) -> Body:
    """Mass properties of the target: those of the scenario where given, else those of the mesh.

    Args:
        params: the target of the scenario.
        surface: its mesh.

    Raises:
        UsageError: They are needed from a mesh that has none (see ``body_of``), or the body has no
            thickness.
    """
    found = _stated_or_computed(params, surface)
    if np.abs(found.sigma).max() > 1.0 - LEAST_INERTIA_MARGIN:
        moments = ", ".join(f"{m:.4g}" for m in found.moments)
        what = (
            f"the body has no thickness: of its principal moments {moments} m2 one is the sum of"
            " the others"
        )
        hint = "give the model a thickness, or moments_m2 and axes_xyzw under [target]"
        raise UsageError(what, where=surface.name, hint=hint)
    return found


def _stated_or_computed(params: TargetParams, surface: Surface) -> Body:
    given = params.moments_m2 is not None and params.axes_xyzw is not None
    if given and params.mass_centre_m is not None:
        return with_axes(params.moments_m2 or (), params.axes_xyzw or (), params.mass_centre_m)
    mesh = body_of(surface)
    centre = mesh.centre_c if params.mass_centre_m is None else frozen(params.mass_centre_m)
    if given:
        return with_axes(params.moments_m2 or (), params.axes_xyzw or (), centre)
    return Body(mesh.inertia_c, centre, mesh.moments, mesh.q_bc)


def ply_bytes(vertices: NDArray[np.float32] | Array, faces: NDArray[np.int32]) -> bytes:
    """Return a triangle mesh as a binary little-endian PLY file.

    Args:
        vertices: (n, 3) [m], stored as float32.
        faces: (m, 3) vertex indices.
    """
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    rows["n"], rows["v"] = 3, faces
    return header.encode() + np.ascontiguousarray(vertices, dtype="<f4").tobytes() + rows.tobytes()


def _triangle(moments: tuple[float, float, float]) -> bool:
    total = sum(moments)
    return all(0.0 < m < total - m for m in moments)


def _at(
    x: float, y: float, z: float, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0
) -> Pose:
    """T_cs from a position [m] and rotations about x, then y, then z [deg]."""
    turns = [
        geometry.exp(np.radians(angle) * axis)
        for angle, axis in zip((roll, pitch, yaw), np.eye(3), strict=True)
    ]
    return Pose(
        geometry.multiply(turns[2], geometry.multiply(turns[1], turns[0])), np.array([x, y, z])
    )


@value_class
class Solid:
    """A closed triangle surface.

    Attributes:
        vertices: (n, 3) [m].
        faces: (m, 3) vertex indices, outward by the right hand.
    """

    vertices: Array
    faces: NDArray[np.int32]


def join(solids: Iterable[Solid]) -> Solid:
    """Several solids as one list of triangles."""
    parts = list(solids)
    shifts = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    faces = np.concatenate([p.faces + s for p, s in zip(parts, shifts, strict=True)]).astype(
        np.int32
    )
    return Solid(np.concatenate([p.vertices for p in parts]), faces)


def placed(solid: Solid, pose: Pose) -> Solid:
    """The solid in {C}, given its pose T_cs."""
    return Solid(pose.apply(solid.vertices), solid.faces)


def extrusion(outline: Sequence[tuple[float, float]], x0: float, x1: float) -> Solid:
    """An outline in (y, z), counter-clockwise about +x, star-shaped from its mean point, from x0 to
    x1 [m].
    """
    centre = tuple(sum(c) / len(outline) for c in zip(*outline, strict=True))
    return _tube(
        [[(x0, *centre)], [(x0, *p) for p in outline], [(x1, *p) for p in outline], [(x1, *centre)]]
    )


def box(low: ArrayLike, high: ArrayLike) -> Solid:
    """The box between two corners (3,) [m], two triangles a side.

    Args:
        low: corner (3,) with the smallest coordinates [m].
        high: corner (3,) with the largest coordinates [m].
    """
    (x0, y0, z0), (x1, y1, z1) = (
        np.asarray(low, dtype=np.float64),
        np.asarray(high, dtype=np.float64),
    )
    corners = [(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Solid(
        np.array(corners),
        np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32),
    )


def frustum(x0: float, r0: float, x1: float, r1: float, sides: int = 24) -> Solid:
    """A closed cone frustum about x from radius r0 at x0 to r1 at x1 > x0 [m].

    Args:
        x0: begin along x [m].
        r0: radius there [m].
        x1: end along x, above ``x0`` [m].
        r1: radius there [m].
        sides: number of sides of the polygon that stands for a circle.
    """
    return _tube([[(x0, 0.0, 0.0)], _ring(x0, r0, sides), _ring(x1, r1, sides), [(x1, 0.0, 0.0)]])


def shell(
    x0: float, r0: float, x1: float, r1: float, wall: float, floor: float, sides: int = 24
) -> Solid:
    """An open cup about x: radius r0 at x0 and r1 at its opening x1, thickness ``wall``,
    bottom at x0 + floor [m].

    Args:
        x0: begin along x [m].
        r0: outer radius there [m].
        x1: opening along x [m].
        r1: outer radius there [m].
        wall: thickness of the wall [m].
        floor: thickness of the bottom [m].
        sides: number of sides of the polygon that stands for a circle.
    """
    outer0, outer1 = _ring(x0, r0, sides), _ring(x1, r1, sides)
    inner1, inner0 = _ring(x1, r1 - wall, sides), _ring(x0 + floor, r0 - wall, sides)
    return _tube([[(x0, 0.0, 0.0)], outer0, outer1, inner1, inner0, [(x0 + floor, 0.0, 0.0)]])


def adapter(r0: float, r1: float, half_height: float) -> Solid:
    """A hollow truncated cone about z, open at both ends, from radius r0 to r1 [m]; wall 5 %
    of the smaller one.

    Args:
        r0: radius at one end [m].
        r1: radius at the other end [m].
        half_height: half of the height [m].
    """
    wall, low, high = 0.05 * min(r0, r1), -half_height, half_height
    outer, inner = _ring(low, r0, 48), _ring(low, r0 - wall, 48)
    ring = _tube([outer, _ring(high, r1, 48), _ring(high, r1 - wall, 48), inner, outer])
    return Solid(ring.vertices[:, [1, 2, 0]], ring.faces)


def _ring(x: float, radius: float, sides: int) -> list[tuple[float, float, float]]:
    angles = [2.0 * math.pi * k / sides for k in range(sides)]
    return [(x, radius * math.cos(a), radius * math.sin(a)) for a in angles]


def _tube(rings: Sequence[Sequence[tuple[float, float, float]]]) -> Solid:
    """The surface through rings about x, from a single point to a single point."""
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


def _fixture() -> list[Solid]:
    """The grapple fixture: base, pin along +x and three unequal cams; the face of the base is
    x = 0.
    """
    return [
        box((-0.06, -0.16, -0.16), (0.0, 0.16, 0.16)),
        frustum(0.0, 0.035, 0.14, 0.02, 16),
        box((0.0, 0.07, -0.03), (0.05, 0.14, 0.03)),
        box((0.0, -0.12, 0.05), (0.04, -0.06, 0.11)),
        box((0.0, -0.10, -0.13), (0.07, -0.05, -0.08)),
    ]


def _satellite() -> list[Solid]:
    bus = box((-1.26, -0.55, -0.60), (-0.06, 0.35, 1.15))
    long_wing = placed(
        box((-0.025, 0.0, -0.45), (0.025, 1.75, 0.45)), _at(-0.75, 0.65, 0.35, pitch=20.0)
    )
    short_wing = placed(
        box((-0.025, -1.05, -0.40), (0.025, 0.0, 0.40)), _at(-0.60, -0.80, 0.15, pitch=-35.0)
    )
    return [
        *_fixture(),
        bus,
        box((-0.79, 0.35, 0.31), (-0.71, 0.65, 0.39)),
        long_wing,
        box((-0.64, -0.80, 0.11), (-0.56, -0.55, 0.19)),
        short_wing,
        placed(shell(0.0, 0.12, 0.42, 0.30, 0.02, 0.05), _at(-1.26, -0.10, 0.30, yaw=180.0)),
        placed(shell(0.0, 0.05, 0.28, 0.34, 0.02, 0.02), _at(-0.45, -0.10, 1.15, pitch=-90.0)),
        placed(frustum(0.0, 0.16, 0.30, 0.09, 12), _at(-1.00, 0.10, -0.60, pitch=90.0)),
        box((-0.35, -0.50, -0.80), (-0.15, -0.25, -0.60)),
        box((-0.06, 0.10, 0.75), (0.10, 0.30, 1.00)),
        box((-1.15, -0.50, 1.15), (-0.90, -0.35, 1.35)),
        placed(frustum(0.0, 0.03, 0.55, 0.03, 10), _at(-1.10, 0.20, 1.15, pitch=-90.0)),
    ]


def _bracket() -> list[Solid]:
    outline = [
        (-0.30, -0.20),
        (0.50, -0.20),
        (0.50, -0.05),
        (-0.10, 0.00),
        (-0.15, 0.60),
        (-0.30, 0.60),
    ]
    return [
        extrusion(outline, -0.30, 0.0),
        frustum(0.0, 0.06, 0.15, 0.03, 16),
        box((0.0, 0.30, -0.18), (0.10, 0.42, -0.08)),
        box((0.0, -0.28, 0.40), (0.06, -0.18, 0.55)),
        placed(frustum(0.0, 0.08, 0.14, 0.05, 12), _at(-0.18, 0.25, -0.20, pitch=90.0)),
        box((-0.20, -0.42, 0.30), (-0.10, -0.30, 0.42)),
        placed(frustum(0.0, 0.07, 0.20, 0.07, 12), _at(-0.10, -0.30, -0.05, yaw=-90.0)),
        placed(frustum(0.0, 0.09, 0.10, 0.04, 12), _at(-0.30, -0.05, -0.10, yaw=180.0)),
        box((-0.42, -0.25, 0.25), (-0.30, -0.20, 0.50)),
    ]


def _stage() -> list[Solid]:
    return [
        placed(join(_fixture()), _at(0.0, 0.0, 0.0)),
        frustum(-0.70, 0.55, -0.06, 0.55, 32),
        frustum(-3.40, 0.80, -0.70, 0.80, 32),
        placed(shell(0.0, 0.25, 0.75, 0.55, 0.03, 0.05, 32), _at(-3.40, 0.0, 0.0, yaw=180.0)),
        box((-2.90, 0.79, -0.06), (-0.90, 0.90, 0.06)),
        box((-2.20, -0.95, -0.15), (-1.60, -0.78, 0.15)),
        box((-1.20, -0.12, 0.79), (-0.95, 0.12, 0.92)),
    ]


def _cube() -> list[Solid]:
    return [box((-1.0, -0.5, -0.5), (0.0, 0.5, 0.5))]
