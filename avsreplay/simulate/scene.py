"""Objects beside the target: a wall, a second object, the robot's own arm, or a moving occluder.

Each is a box or a mesh in its own frame {S}, which moves in {A} with constant velocity and angular rate. It blocks the
rays to what is behind it and returns points itself. An object that is present in part of the log only is labelled in
the log like a fault.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array, frozen
from avsreplay.records import Label, Surface
from avsreplay.settings import Settings, setting
from avsreplay.simulate.optics import REFLECTANCE, FaceOptics, Material, face_optics
from avsreplay.simulate.ray_casting import Engine, RayCaster
from avsreplay.simulate.target import box

NS = 1_000_000_000
Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class SceneObject(Settings):
    """One table [[object]]: something else than the target in the field of view."""

    name: str = setting(doc="Name of the object, which is the kind of its label.")
    size_m: Triple = setting((1.0, 1.0, 1.0), "Edge lengths of a box, centred in {S}.", unit="m", above=0.0)
    model: str = setting(
        "", "Mesh file in metres in {S} in place of the box (STL, OBJ or PLY), relative to the scenario file."
    )
    position_m: Triple = setting((0.0, 0.0, 8.0), "Position of {S} in {A} at the time 0.", unit="m")
    attitude_xyzw: tuple[float, float, float, float] = setting((0.0, 0.0, 0.0, 1.0), "q_as, attitude at the time 0.")
    velocity_mps: Triple = setting((0.0, 0.0, 0.0), "Velocity of {S} in {A}.", unit="m/s")
    rate_radps: Triple = setting((0.0, 0.0, 0.0), "Constant angular rate in the axes of {A}.", unit="rad/s")
    reflectance: float = setting(REFLECTANCE, "Diffuse reflectance.", low=0.0, high=1.0)
    start_s: float = setting(0.0, "Begin of its presence, after the first scan is due.", unit="s", low=0.0)
    duration_s: float | None = setting(
        None, "Length of its presence.", unit="s", above=0.0, unset="to the end of the log, without a label"
    )
    harmful: bool = setting(False, "Whether its label says that no good pose can come from such a scan.")

    def check(self) -> None:
        """Raise ValueError where the attitude is not a unit quaternion, or the name is empty."""
        if not self.name:
            raise ValueError("an object needs a name")
        if not math.isclose(math.hypot(*self.attitude_xyzw), 1.0, abs_tol=1e-3):
            raise ValueError(f"attitude_xyzw = {list(self.attitude_xyzw)} is not a unit quaternion")

    def present(self, t_s: float) -> bool:
        """Return whether the object is present at a time [s after the instant of the first scan]."""
        return self.start_s <= t_s and (self.duration_s is None or t_s < self.start_s + self.duration_s)

    def poses(self, times_s: Array) -> tuple[Array, Array]:
        """Rotations R_as (n, 3, 3) and positions (n, 3) in {A} [m] at times (n,) [s]."""
        turn = geometry.exp(times_s[:, None] * np.array(self.rate_radps))
        R_as = geometry.matrix(geometry.multiply(turn, geometry.normalise(np.array([self.attitude_xyzw]))))
        return R_as, np.array(self.position_m) + times_s[:, None] * np.array(self.velocity_mps)

    def label(self, epoch_ns: int) -> Label | None:
        """Its label on a log clock that begins at ``epoch_ns``; None where it stays to the end of the log."""
        if self.duration_s is None:
            return None
        start, end = (epoch_ns + round(t * NS) for t in (self.start_s, self.start_s + self.duration_s))
        return Label(self.name, start, end, self.harmful)


@dataclass(frozen=True, slots=True, eq=False)
class SceneBody:
    """An object with its surface, ready for ray casting."""

    params: SceneObject
    caster: RayCaster
    optics: FaceOptics


def scene_bodies(objects: Sequence[SceneObject], meshes: dict[str, Surface], engine: Engine) -> list[SceneBody]:
    """The objects of a scenario; ``meshes`` has the surface of every ``model`` that one of them names."""
    bodies = []
    for params in objects:
        half = 0.5 * np.array(params.size_m)
        solid = box(-half, half)
        surface = meshes[params.model] if params.model else Surface(frozen(solid.vertices), solid.faces, "box", "")
        optics = face_optics(surface, [Material(params.name, reflectance=params.reflectance)])
        bodies.append(SceneBody(params, RayCaster(surface, engine), optics))
    return bodies
