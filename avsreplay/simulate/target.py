"""Built-in targets, made in code. {C} is on the face of the grapple fixture, its +x outward: the approach axis.

The model is written as binary PLY with float32 corners and read back by the same rounding, so the surface here and
the one in a log's attachment are equal to the bit.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Surface
from avsreplay.settings import Settings, setting
from avsreplay.simulate.inertia import Body, body_of, with_axes
from avsreplay.simulate.shapes import Solid, box, extrusion, frustum, join, moved, shell

__all__ = ["Shape", "TargetParams", "body", "builtin_surface", "ply_bytes"]


class Shape(Enum):
    """The targets that need no file."""

    SATELLITE = "satellite"  # bus, two unequal panels, nozzle, fixture, small parts: no symmetry
    BRACKET = "bracket"  # an L-shaped bracket with a tapered pin
    STAGE = "stage"  # a spent rocket stage: nearly a body of revolution, marked by a raceway and a box
    CUBE = "cube"  # fully symmetric: the pose has 24 equals


FROM_MESH = "from the mesh, of uniform density"


@dataclass(frozen=True, slots=True)
class TargetParams(Settings):
    """The table [target]: the model, and its mass properties where those of the mesh are not wanted."""

    shape: Shape = setting(Shape.SATELLITE, "A built-in target; not used where a model is given.")
    model: str = setting(
        "", "STL, OBJ or PLY file in metres in {C}, relative to the scenario file; empty for the built-in shape."
    )
    moments_m2: tuple[float, float, float] | None = setting(
        None, "Principal moments of inertia of {B} per unit mass.", unit="m^2", above=0.0, unset=FROM_MESH
    )
    axes_xyzw: tuple[float, float, float, float] | None = setting(
        None, "mu = q_bc, the rotation from {C} to {B}.", unset=FROM_MESH
    )
    mass_centre_m: tuple[float, float, float] | None = setting(None, "Mass centre in {C}.", unit="m", unset=FROM_MESH)

    def check(self) -> None:
        """Raise ValueError where the mass properties are not those of a rigid body."""
        if self.moments_m2 is not None and not _triangle(self.moments_m2):
            raise ValueError(
                f"moments_m2 = {list(self.moments_m2)} are not those of a body: each below the others' sum"
            )
        if self.axes_xyzw is not None and not math.isclose(math.hypot(*self.axes_xyzw), 1.0, abs_tol=1e-3):
            raise ValueError(f"axes_xyzw = {list(self.axes_xyzw)} is not a unit quaternion")
        if (self.moments_m2 is None) != (self.axes_xyzw is None):
            raise ValueError("moments_m2 and axes_xyzw go together: give both or neither")


def builtin_surface(shape: Shape = Shape.SATELLITE) -> Surface:
    """The mesh of a built-in target in {C}, closed and outward, with its PLY bytes."""
    parts = {
        Shape.SATELLITE: _satellite,
        Shape.BRACKET: _bracket,
        Shape.STAGE: _stage,
        Shape.CUBE: _cube,
    }[shape]()
    solid = join(parts)
    vertices = solid.vertices.astype("<f4")
    data = ply_bytes(vertices, solid.faces)
    return Surface(frozen(vertices), solid.faces, f"{shape.value}.ply", hashlib.sha256(data).hexdigest(), data)


def body(params: TargetParams, surface: Surface) -> Body:
    """Mass properties of the target: the scenario's where given, else the mesh's. Raises UsageError (inertia)."""
    given = params.moments_m2 is not None and params.axes_xyzw is not None
    if given and params.mass_centre_m is not None:
        return with_axes(params.moments_m2 or (), params.axes_xyzw or (), params.mass_centre_m)
    mesh = body_of(surface)
    centre = mesh.centre_c if params.mass_centre_m is None else frozen(params.mass_centre_m)
    if given:
        return with_axes(params.moments_m2 or (), params.axes_xyzw or (), centre)
    return Body(mesh.inertia_c, centre, mesh.moments, mesh.q_bc)


def ply_bytes(vertices: NDArray[np.float32] | Array, faces: NDArray[np.int32]) -> bytes:
    """A triangle mesh as binary little-endian PLY; the same mesh gives the same bytes."""
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


def _at(x: float, y: float, z: float, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Pose:
    """T_cs from a place [m] and turns about x, then y, then z [deg]."""
    turns = [geometry.exp(np.radians(angle) * axis) for angle, axis in zip((roll, pitch, yaw), np.eye(3), strict=True)]
    return Pose(geometry.multiply(turns[2], geometry.multiply(turns[1], turns[0])), np.array([x, y, z]))


def _fixture() -> list[Solid]:
    """The grapple fixture: base, pin along +x and three unequal cams; the face of the base is x = 0."""
    return [
        box((-0.06, -0.16, -0.16), (0.0, 0.16, 0.16)),
        frustum(0.0, 0.035, 0.14, 0.02, 16),
        box((0.0, 0.07, -0.03), (0.05, 0.14, 0.03)),
        box((0.0, -0.12, 0.05), (0.04, -0.06, 0.11)),
        box((0.0, -0.10, -0.13), (0.07, -0.05, -0.08)),
    ]


def _satellite() -> list[Solid]:
    bus = box((-1.26, -0.55, -0.60), (-0.06, 0.35, 1.15))
    long_wing = moved(box((-0.025, 0.0, -0.45), (0.025, 1.75, 0.45)), _at(-0.75, 0.65, 0.35, pitch=20.0))
    short_wing = moved(box((-0.025, -1.05, -0.40), (0.025, 0.0, 0.40)), _at(-0.60, -0.80, 0.15, pitch=-35.0))
    return [
        *_fixture(),
        bus,
        box((-0.79, 0.35, 0.31), (-0.71, 0.65, 0.39)),
        long_wing,
        box((-0.64, -0.80, 0.11), (-0.56, -0.55, 0.19)),
        short_wing,
        moved(shell(0.0, 0.12, 0.42, 0.30, 0.02, 0.05), _at(-1.26, -0.10, 0.30, yaw=180.0)),
        moved(shell(0.0, 0.05, 0.28, 0.34, 0.02, 0.02), _at(-0.45, -0.10, 1.15, pitch=-90.0)),
        moved(frustum(0.0, 0.16, 0.30, 0.09, 12), _at(-1.00, 0.10, -0.60, pitch=90.0)),
        box((-0.35, -0.50, -0.80), (-0.15, -0.25, -0.60)),
        box((-0.06, 0.10, 0.75), (0.10, 0.30, 1.00)),
        box((-1.15, -0.50, 1.15), (-0.90, -0.35, 1.35)),
        moved(frustum(0.0, 0.03, 0.55, 0.03, 10), _at(-1.10, 0.20, 1.15, pitch=-90.0)),
    ]


def _bracket() -> list[Solid]:
    outline = [(-0.30, -0.20), (0.50, -0.20), (0.50, -0.05), (-0.10, 0.00), (-0.15, 0.60), (-0.30, 0.60)]
    return [
        extrusion(outline, -0.30, 0.0),
        frustum(0.0, 0.06, 0.15, 0.03, 16),
        box((0.0, 0.30, -0.18), (0.10, 0.42, -0.08)),
        box((0.0, -0.28, 0.40), (0.06, -0.18, 0.55)),
        moved(frustum(0.0, 0.08, 0.14, 0.05, 12), _at(-0.18, 0.25, -0.20, pitch=90.0)),
        box((-0.20, -0.42, 0.30), (-0.10, -0.30, 0.42)),
        moved(frustum(0.0, 0.07, 0.20, 0.07, 12), _at(-0.10, -0.30, -0.05, yaw=-90.0)),
        moved(frustum(0.0, 0.09, 0.10, 0.04, 12), _at(-0.30, -0.05, -0.10, yaw=180.0)),
        box((-0.42, -0.25, 0.25), (-0.30, -0.20, 0.50)),
    ]


def _stage() -> list[Solid]:
    return [
        moved(join(_fixture()), _at(0.0, 0.0, 0.0)),
        frustum(-0.70, 0.55, -0.06, 0.55, 32),
        frustum(-3.40, 0.80, -0.70, 0.80, 32),
        moved(shell(0.0, 0.25, 0.75, 0.55, 0.03, 0.05, 32), _at(-3.40, 0.0, 0.0, yaw=180.0)),
        box((-2.90, 0.79, -0.06), (-0.90, 0.90, 0.06)),
        box((-2.20, -0.95, -0.15), (-1.60, -0.78, 0.15)),
        box((-1.20, -0.12, 0.79), (-0.95, 0.12, 0.92)),
    ]


def _cube() -> list[Solid]:
    return [box((-1.0, -0.5, -0.5), (0.0, 0.5, 0.5))]
