"""What is in the scene beside the target: objects, plume particles, and the sunlit Earth behind.

An object is a box, a launcher adapter or a mesh in its own frame {S}, which moves in {A} with
constant velocity and angular rate. It blocks the rays to what is behind it and returns points
itself. Particles of a plume do the same at random places. The Earth is too far for a return; its
light causes false returns and noise. An item that is present in a part of the log only has a label
in the log, like a fault.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import UsageError, value_class
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import NS_PER_S, Label, Surface
from avsreplay.settings import Settings, is_unit, setting
from avsreplay.simulate.optics import DEFAULT_REFLECTANCE, FaceOptics, Material, face_optics
from avsreplay.simulate.rays import Engine, RayCaster
from avsreplay.simulate.target import adapter, box

_PLUME_STATIONS = 64  # points of the sum along a ray through a plume
# distance from the nozzle below which the density of the particles is constant
_NOZZLE_DISTANCE_M = 0.1
Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Presence(Settings):
    """An item that is in the scene for the whole log or for a part of it."""

    name: str = setting(doc="Name, which is also the kind in its label.")
    start_s: float = setting(
        0.0,
        "Time at which it appears, after the time of the first scan.",
        unit="s",
        low=0.0,
        high=1e8,
    )
    duration_s: float | None = setting(
        None,
        "Time for which it is present.",
        unit="s",
        above=0.0,
        high=1e8,
        unset="to the end of the log, without a label",
    )
    harmful: bool = setting(False, "Whether such a scan is unusable: it gives no correct pose.")

    def check(self) -> None:
        """Raise ValueError where the name is empty."""
        if not self.name:
            raise ValueError("it needs a name")

    def present(self, t_s: float) -> bool:
        """Return whether it is present at a time [s after the instant of the first scan].

        Args:
            t_s: time [s after the first scan].
        """
        return self.start_s <= t_s and (
            self.duration_s is None or t_s < self.start_s + self.duration_s
        )

    def label(self, epoch_ns: int) -> Label | None:
        """Return its label on a log clock that begins at ``epoch_ns``; None where it stays to the
        end of the log.
        """
        if self.duration_s is None:
            return None
        start, end = (
            epoch_ns + round(t * NS_PER_S) for t in (self.start_s, self.start_s + self.duration_s)
        )
        return Label(self.name, start, end, self.harmful)


class ObjectShape(Enum):
    """Shape of an object without a mesh."""

    BOX = "box"
    # a launcher's payload adapter: a hollow truncated cone about z, open at both ends
    ADAPTER = "adapter"


@dataclass(frozen=True, slots=True)
class SceneObject(Presence):
    """The table [[object]]: an object other than the target in the field of view."""

    shape: ObjectShape = setting(
        ObjectShape.BOX,
        "A box, or a launcher adapter: a hollow truncated cone about the z axis of {S}, open at"
        " both ends.",
    )
    size_m: Triple = setting(
        (1.0, 1.0, 1.0),
        "Edge lengths of a box; outer diameters of an adapter at -z and +z, and its height. Centred"
        " in {S}.",
        unit="m",
        above=0.0,
    )
    model: str = setting(
        "",
        "Mesh file in metres in {S} in place of the shape (STL, OBJ or PLY), relative to the"
        " scenario file.",
    )
    position_m: Triple = setting((0.0, 0.0, 8.0), "Position of {S} in {A} at the time 0.", unit="m")
    attitude_xyzw: tuple[float, float, float, float] = setting(
        (0.0, 0.0, 0.0, 1.0), "q_as, attitude at the time 0."
    )
    velocity_mps: Triple = setting((0.0, 0.0, 0.0), "Velocity of {S} in {A}.", unit="m/s")
    rate_radps: Triple = setting(
        (0.0, 0.0, 0.0), "Constant angular rate in the axes of {A}.", unit="rad/s"
    )
    reflectance: float = setting(DEFAULT_REFLECTANCE, "Diffuse reflectance.", low=0.0, high=1.0)

    def check(self) -> None:
        """Raise ValueError where the attitude is not a unit quaternion, or the name is empty."""
        Presence.check(self)
        if not is_unit(self.attitude_xyzw):
            raise ValueError(f"attitude_xyzw = {list(self.attitude_xyzw)} is not a unit quaternion")

    def poses(self, times_s: Array) -> tuple[Array, Array]:
        """Rotations R_as (n, 3, 3) and positions (n, 3) in {A} [m] at times (n,) [s].

        Args:
            times_s: (n,) [s after the first scan].
        """
        turn = geometry.exp(times_s[:, None] * np.array(self.rate_radps))
        R_as = geometry.matrix(
            geometry.multiply(turn, geometry.normalise(np.array([self.attitude_xyzw])))
        )
        return R_as, np.array(self.position_m) + times_s[:, None] * np.array(self.velocity_mps)


@dataclass(frozen=True, slots=True)
class Plume(Presence):
    """One table [[plume]]: particles from a thruster, drawn anew for every scan because they cross
    the view within it.

    The mean number of particles that a ray meets on a path dl at the distance d from the nozzle and
    the angle theta from the axis is particles_per_metre (1 m / d)^2 exp(-(theta / half angle)^2)
    dl, as in a steady flow from a point.
    """

    name: str = setting("plume", "Name, which is also the kind in its label.")
    nozzle_m: Triple = setting(
        (0.0, -0.5, 0.0), "Position of the nozzle in the frame of the camera.", unit="m"
    )
    direction: Triple = setting(
        (0.0, 0.0, 1.0), "Unit vector of the flow in the frame of the camera."
    )
    half_angle_deg: float = setting(
        20.0,
        "Angle from the axis at which the density has fallen to 1/e.",
        unit="deg",
        above=0.0,
        high=90.0,
    )
    particles_per_metre: float = setting(
        0.05,
        "Mean number of particles per metre of a ray on the axis 1 m from the nozzle.",
        unit="1/m",
        low=0.0,
    )
    reflectance: float = setting(
        DEFAULT_REFLECTANCE, "Diffuse reflectance of a particle.", low=0.0, high=1.0
    )

    def check(self) -> None:
        """Raise ValueError where the direction is not a unit vector, or the name is empty."""
        Presence.check(self)
        if not is_unit(self.direction):
            raise ValueError(f"direction = {list(self.direction)} is not a unit vector")

    def particles(self, rays: Array, ends_m: Array, rng: np.random.Generator) -> Array:
        """Range (n,) of the first particle on each ray [m], inf without one.

        Args:
            rays: (n, 3) unit directions in the frame of the camera.
            ends_m: (n,) length of each ray [m].
            rng: draws the particles.
        """
        depth_at_hit = rng.exponential(size=len(rays))
        spacing, axis = (
            ends_m / _PLUME_STATIONS,
            np.array(self.direction) / math.hypot(*self.direction),
        )
        depth, found = np.zeros(len(rays)), np.full(len(rays), np.inf)
        for k in range(_PLUME_STATIONS):  # the midpoint rule
            there = (k + 0.5) * spacing[:, None] * rays - np.array(self.nozzle_m)
            away = np.maximum(np.linalg.norm(there, axis=1), _NOZZLE_DISTANCE_M)
            angle = np.arccos(np.clip(there @ axis / away, -1.0, 1.0))
            spread = np.exp(-np.square(angle / math.radians(self.half_angle_deg)))
            added = self.particles_per_metre * spread / np.square(away) * spacing
            hit = np.isinf(found) & (depth + added >= depth_at_hit)
            found[hit] = (k + (depth_at_hit - depth)[hit] / added[hit]) * spacing[hit]
            depth += added
        return found


@dataclass(frozen=True, slots=True)
class Limb(Presence):
    """One table [[limb]]: the sunlit Earth behind the target, a disc with the Earth's limb as its
    edge.

    A beam that meets nothing and looks at it gives a false return with some probability, at any
    range: the detector triggers on background light. Its stray light in the optics adds to the
    variance of all ranges, in proportion to the share of the field of view that it fills.
    """

    name: str = setting("limb", "Name, which is also the kind in its label.")
    centre_a: Triple = setting(
        (0.0, 0.0, 1.0), "Unit vector to the Earth's centre in {A} at the time 0."
    )
    rate_radps: Triple = setting(
        (0.0, 0.0, 0.0), "Constant angular rate of that vector, in the axes of {A}.", unit="rad/s"
    )
    radius_deg: float = setting(
        70.2,
        "Angular radius of the Earth; 70.2 at an altitude of 400 km.",
        unit="deg",
        above=0.0,
        high=90.0,
    )
    false_ratio: float = setting(
        0.01,
        "Share of the beams toward the Earth that meet no surface and give a false return.",
        low=0.0,
        high=1.0,
    )
    glare: float = setting(
        1.0,
        "Factor on the 1 sigma of all ranges if the Earth fills the whole field of view.",
        low=1.0,
        high=100.0,
    )

    def check(self) -> None:
        """Raise ValueError where the centre is not a unit vector, or the name is empty."""
        Presence.check(self)
        if not is_unit(self.centre_a):
            raise ValueError(f"centre_a = {list(self.centre_a)} is not a unit vector")

    def behind(self, rays: Array, times_s: Array, R_wa: Array) -> NDArray[np.bool_]:
        """Whether each beam (n,) looks at the Earth, nothing being in front.

        Args:
            rays: (n, 3) unit directions in the frame of the camera.
            times_s: (n,) or (1,) [s].
            R_wa: (n, 3, 3) or (1, 3, 3) attitude of the camera in the fixed frame.
        """
        turn = geometry.matrix(geometry.exp(times_s[:, None] * np.array(self.rate_radps)))
        towards = np.array(self.centre_a) / math.hypot(*self.centre_a)
        centre = geometry.rotate(np.swapaxes(R_wa, -1, -2) @ turn, towards)
        return np.asarray(np.sum(rays * centre, axis=1) > math.cos(math.radians(self.radius_deg)))


@dataclass(frozen=True, slots=True)
class Appendage(Settings):
    """One table [[appendage]]: a flexible part of the target, which swings about a hinge
    while the model is rigid.
    """

    name: str = setting(doc="Name of the part.")
    box_m: tuple[float, float, float, float, float, float] = setting(
        doc=(
            "The faces whose centre is within (xmin, ymin, zmin, xmax, ymax, zmax) in {C} belong"
            " to it."
        ),
        unit="m",
        infinite=True,
    )
    hinge_m: Triple = setting((0.0, 0.0, 0.0), "A point of the hinge in {C}.", unit="m")
    axis_c: Triple = setting((1.0, 0.0, 0.0), "Unit vector along the hinge in {C}.")
    amplitude_deg: float = setting(1.0, "Amplitude of the swing.", unit="deg", low=0.0, high=90.0)
    frequency_hz: float = setting(0.1, "Frequency of the swing.", unit="Hz", above=0.0)
    phase_deg: float = setting(
        0.0, "Phase of the swing at the time 0; 0: through the middle.", unit="deg"
    )

    def check(self) -> None:
        """Raise ValueError where the axis is not a unit vector."""
        if not is_unit(self.axis_c):
            raise ValueError(f"axis_c = {list(self.axis_c)} is not a unit vector")

    def placed(self, target: tuple[Array, Array], times_s: Array) -> tuple[Array, Array]:
        """Poses (n, 3, 3), (n, 3) of the part in {A} from those of the target at times (n,) [s].

        Args:
            target: rotations (n, 3, 3) and positions (n, 3) of {C} in {A} [m].
            times_s: (n,) [s after the first scan].
        """
        R_ac, t_ac = target
        phase = 2.0 * math.pi * self.frequency_hz * times_s + math.radians(self.phase_deg)
        angle = math.radians(self.amplitude_deg) * np.sin(phase)
        R, hinge = (
            geometry.matrix(geometry.exp(angle[:, None] * np.array(self.axis_c))),
            np.array(self.hinge_m),
        )
        return R_ac @ R, t_ac + geometry.rotate(R_ac, hinge - R @ hinge)


def appendage_faces(surface: Surface, appendages: Sequence[Appendage]) -> NDArray[np.int64]:
    """The number of the appendage (m,) to which each face belongs, -1 for the rigid part; of
    several the last.

    Args:
        surface: the model of the target.
        appendages: the moving parts.

    Raises:
        UsageError: no face lies in the box of an appendage.
    """
    owner = np.full(len(surface.faces), -1, dtype=np.int64)
    centres = surface.vertices[surface.faces].mean(axis=1)
    for k, each in enumerate(appendages):
        inside = np.all((centres >= each.box_m[:3]) & (centres <= each.box_m[3:]), axis=1)
        if not inside.any():
            hint = "the box is in the axes of {C}, in metres"
            raise UsageError(
                f"no face lies in the box of '{each.name}'", where="appendage.box_m", hint=hint
            )
        owner[inside] = k
    return owner


@dataclass(frozen=True, slots=True)
class CameraParams(Settings):
    """The table [camera]: motion of the camera in the fixed frame, which is {A} at the time 0
    without vibration.
    """

    velocity_mps: Triple = setting((0.0, 0.0, 0.0), "Velocity in the fixed frame.", unit="m/s")
    rate_radps: Triple = setting(
        (0.0, 0.0, 0.0), "Constant angular rate in the fixed frame.", unit="rad/s"
    )
    vibration_m: float = setting(
        0.0, "Amplitude of the vibration along each axis.", unit="m", low=0.0
    )
    vibration_deg: float = setting(
        0.0, "Amplitude of the vibration about each axis.", unit="deg", low=0.0, high=10.0
    )
    frequency_hz: float = setting(5.0, "Frequency of the vibration.", unit="Hz", above=0.0)
    pose_std_m: float = setting(
        0.0, "1 sigma of the position that the pose topic reports.", unit="m", low=0.0
    )
    pose_std_deg: float = setting(
        0.0, "1 sigma of the attitude that it reports, each axis.", unit="deg", low=0.0
    )


@value_class
class MovingCamera:
    """A moving camera: its parameters and the phases (6,) of its vibration [rad]."""

    params: CameraParams
    phases: Array

    def poses(self, times_s: Array) -> tuple[Array, Array]:
        """Rotations R_wa (n, 3, 3) and positions (n, 3) in the fixed frame [m] at times (n,)
        [s].

        Args:
            times_s: (n,) [s after the first scan].
        """
        p = self.params
        swing = np.sin(2.0 * math.pi * p.frequency_hz * times_s[:, None] + self.phases)
        turn = geometry.exp(times_s[:, None] * np.array(p.rate_radps))
        shake = geometry.exp(math.radians(p.vibration_deg) * swing[:, 3:])
        R = geometry.matrix(geometry.multiply(turn, shake))
        return R, times_s[:, None] * np.array(p.velocity_mps) + p.vibration_m * swing[:, :3]

    def pose(self, t_s: float) -> Pose:
        """Return the pose T_wa at a time [s].

        Args:
            t_s: time [s after the first scan].
        """
        R, t = self.poses(np.array([t_s]))
        return Pose(geometry.quaternion(R[0]), t[0])

    def reported(self, t_s: float, rng: np.random.Generator) -> Pose:
        """Return the pose that the topic reports, with its error.

        Args:
            t_s: time [s after the first scan].
            rng: generator of the errors.
        """
        p, true = self.params, self.pose(t_s)
        error = geometry.exp(math.radians(p.pose_std_deg) * rng.standard_normal(3))
        return Pose(
            geometry.multiply(true.q, error), true.t + p.pose_std_m * rng.standard_normal(3)
        )


@value_class
class SceneBody:
    """An object with its surface, ready for ray casting."""

    params: SceneObject
    caster: RayCaster
    optics: FaceOptics


def scene_bodies(
    objects: Sequence[SceneObject], meshes: dict[str, Surface], engine: Engine
) -> list[SceneBody]:
    """The objects of a scenario; ``meshes`` has the surface of every ``model`` that one of
    them names.

    Args:
        objects: the objects.
        meshes: the surface of every ``model`` that one of them names.
        engine: what casts the rays.
    """
    bodies = []
    for params in objects:
        half = 0.5 * np.array(params.size_m)
        is_box = params.shape is ObjectShape.BOX
        solid = box(-half, half) if is_box else adapter(*half.tolist())
        name = params.shape.value
        surface = (
            meshes[params.model]
            if params.model
            else Surface(frozen(solid.vertices), solid.faces, name, "")
        )
        optics = face_optics(surface, [Material(params.name, reflectance=params.reflectance)])
        bodies.append(SceneBody(params, RayCaster(surface, engine), optics))
    return bodies
