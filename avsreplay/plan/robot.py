"""Settings of the robot with the end-effector (``[robot]``) and of the constraints on its plans
(``[limits]``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import PurePath

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.settings import Settings, is_unit, setting


@dataclass(frozen=True, slots=True)
class Limits(Settings):
    """Constraints of a plan besides thrust; one that is not set is switched off, unless it
    scales with the target.
    """

    cone_deg: float | None = setting(
        None,
        "Half-angle of the approach cone at the grasp point.",
        unit="deg",
        above=0.0,
        below=90.0,
    )
    cone_range_m: float | None = setting(
        None,
        "Distance to the grasp point within which the cone holds.",
        unit="m",
        above=0.0,
        of_extent=0.25,
    )
    final_deg: float | None = setting(
        None,
        "Half-angle of the cone along the fixture's axis in the final approach.",
        unit="deg",
        above=0.0,
        below=90.0,
    )
    final_range_m: float | None = setting(
        None, "Length of the final approach.", unit="m", above=0.0, of_extent=0.06
    )
    mouth_m: float | None = setting(
        None, "Radius of both cones at the grasp point.", unit="m", above=0.0, of_extent=0.005
    )
    speed_max_mps: float | None = setting(
        None, "Largest speed of the robot in {A}.", unit="m/s", above=0.0
    )
    contact_accel_mps2: float | None = setting(
        None, "Largest acceleration relative to the grasp point at contact.", unit="m/s2", above=0.0
    )
    keepout_m: float | None = setting(
        None, "Radius of the keep-out sphere about the mass centre.", unit="m", above=0.0
    )
    keepout_release_m: float | None = setting(
        None,
        "Distance to the grasp point within which the keep-out sphere does not hold.",
        unit="m",
        above=0.0,
        of_extent=0.06,
    )
    clearance_m: float | None = setting(
        None,
        "Smallest distance of the end-effector's centre to the target's surface outside the final"
        " approach cone.",
        unit="m",
        above=0.0,
    )
    withdrawal_clearance_m: float | None = setting(
        None,
        "Smallest distance of the end-effector's centre to the target's surface while the robot"
        " withdraws.",
        unit="m",
        above=0.0,
        unset="clearance_m",
    )
    clearance_sigmas: float = setting(
        3.0,
        "Multiple of the predicted standard deviation of the surface's position that is added to"
        " the clearance, and by which cone and corridor are narrowed, at most to half.",
        low=0.0,
    )
    abort: bool = setting(
        True,
        "Require that the robot keeps withdrawal_clearance_m if it withdraws at any instant of a"
        " plan; from within the final approach cone it does not come nearer.",
    )
    base_m: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0),
        "Position of the robot's base in {A}, the centre of its workspace.",
        unit="m",
    )
    reach_max_m: float | None = setting(
        None, "Largest distance of the end-effector from the base.", unit="m", above=0.0
    )
    reach_min_m: float | None = setting(
        None, "Smallest distance of the end-effector from the base.", unit="m", above=0.0
    )
    accel_axes_mps2: tuple[float, float, float] | None = setting(
        None,
        "Largest acceleration along each axis of the base.",
        unit="m/s2",
        above=0.0,
        unset="plan.a_max_mps2 in all directions",
    )
    base_attitude_xyzw: tuple[float, float, float, float] = setting(
        (0.0, 0.0, 0.0, 1.0), "Quaternion that takes coordinates of the robot's base to {A}."
    )
    nodes: int = setting(
        60,
        "Number of thrust intervals of a constrained plan. A larger value gives an earlier capture,"
        " in more time.",
        low=8,
    )

    def widened(self, radius_m: float) -> Limits:
        """Return the limits for an end-effector of a given size.

        Args:
            radius_m: Its radius [m], added to the clearance; without clearance and corridor the
                limits do not change.
        """
        if radius_m <= 0.0 or (self.clearance_m is None and self.final_deg is None):
            return self
        kept = self.kept_m + radius_m
        clearance = (self.clearance_m or 0.0) + radius_m
        return replace(self, clearance_m=clearance, withdrawal_clearance_m=kept)

    @property
    def kept_m(self) -> float:
        """Distance to the surface that a withdrawal keeps [m]."""
        if self.withdrawal_clearance_m is not None:
            return self.withdrawal_clearance_m
        return self.clearance_m or 0.0

    @property
    def any(self) -> bool:
        """Whether there is a constraint besides the thrust."""
        others = (self.speed_max_mps, self.contact_accel_mps2, self.accel_axes_mps2)
        return self.geometric or any(value is not None for value in others)

    @property
    def cones(self) -> list[tuple[float, float]]:
        """Half-angle [deg] and length [m] of every cone that is required."""
        both = (self.cone_deg, self.cone_range_m), (self.final_deg, self.final_range_m)
        return [
            (degrees, length)
            for degrees, length in both
            if degrees is not None and length is not None
        ]

    @property
    def base_axes(self) -> Array:
        """Matrix (3, 3) whose columns are the axes of the robot's base in {A}."""
        q = np.array(self.base_attitude_xyzw)
        return np.asarray(geometry.matrix(q / np.linalg.norm(q)))

    @property
    def geometric(self) -> bool:
        """Whether there is a constraint on the position relative to the target."""
        named = (
            self.cone_deg,
            self.final_deg,
            self.keepout_m,
            self.clearance_m,
            self.reach_max_m,
            self.reach_min_m,
        )
        return any(value is not None for value in named)


_CAPABILITIES = ("accel_max_mps2", "accel_axes_mps2", "thrust_max_n", "thrust_axes_n")


@dataclass(frozen=True, slots=True)
class RobotParams(Settings):
    """The robot that carries the end-effector.

    What is set here takes precedence over ``plan`` and ``limits``.
    """

    name: str = setting("point", "Name of the robot, printed with every plan.")
    mass_kg: float | None = setting(
        None, "Mass, by which a thrust is divided.", unit="kg", above=0.0
    )
    thrust_max_n: float | None = setting(
        None,
        "Largest thrust in any direction. Divided by the mass it is the largest acceleration.",
        unit="N",
        above=0.0,
    )
    thrust_axes_n: tuple[float, float, float] | None = setting(
        None,
        "Largest thrust along each axis of the base. Divided by the mass it is the largest"
        " acceleration.",
        unit="N",
        above=0.0,
    )
    accel_max_mps2: float | None = setting(
        None,
        "Largest acceleration in any direction.",
        unit="m/s2",
        above=0.0,
        unset="plan.a_max_mps2",
    )
    accel_axes_mps2: tuple[float, float, float] | None = setting(
        None, "Largest acceleration along each axis of the base.", unit="m/s2", above=0.0
    )
    angular_accel_radps2: float | None = setting(
        None,
        "Largest angular acceleration of the gripper.",
        unit="rad/s2",
        above=0.0,
        unset="the gripper has the attitude of the fixture at all times",
    )
    base_position_m: tuple[float, float, float] | None = setting(
        None, "Position of the base in {A}.", unit="m", unset="limits.base_m"
    )
    base_attitude_xyzw: tuple[float, float, float, float] = setting(
        (0.0, 0.0, 0.0, 1.0), "Quaternion that takes coordinates of the base to {A}."
    )
    start_position_m: tuple[float, float, float] | None = setting(
        None,
        "Position of the end-effector in {A} at the start.",
        unit="m",
        unset="plan.robot_position_m",
    )
    start_velocity_mps: tuple[float, float, float] | None = setting(
        None,
        "Velocity of the end-effector in {A} at the start.",
        unit="m/s",
        unset="plan.robot_velocity_mps",
    )
    start_attitude_xyzw: tuple[float, float, float, float] = setting(
        (0.0, 0.0, 0.0, 1.0),
        "Quaternion that takes coordinates of the gripper to {A} at the start; at capture the"
        " gripper has the axes of {C}.",
    )
    radius_m: float = setting(
        0.0,
        "Radius of the end-effector, added to limits.clearance_m; without that setting it is the"
        " clearance.",
        unit="m",
        low=0.0,
    )
    reach_max_m: float | None = setting(
        None,
        "Largest distance of the end-effector from the base.",
        unit="m",
        above=0.0,
        unset="limits.reach_max_m",
    )
    reach_min_m: float | None = setting(
        None,
        "Smallest distance of the end-effector from the base.",
        unit="m",
        above=0.0,
        unset="limits.reach_min_m",
    )
    urdf: str | None = setting(
        None,
        "URDF of a manipulator that carries the end-effector, relative to the file that states it:"
        " its joints can follow the last metres of every plan, and its reach is the workspace where"
        " reach_max_m is not given.",
    )
    urdf_frame: str | None = setting(
        None, "Frame of the gripper in the URDF.", unset="its last frame"
    )
    delay_s: float | None = setting(
        None,
        "Time between planning and the first thrust.",
        unit="s",
        low=0.0,
        unset="plan.latency_s",
    )
    thrust_noise: float = setting(
        0.0,
        "1 sigma of the thrust error of each axis, as a fraction of the largest thrust, over 1 s.",
        low=0.0,
    )

    def check(self) -> None:
        """Raise ValueError where values contradict each other."""
        given = [name for name in _CAPABILITIES if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} exclude each other, give one of them")
        thrust = self.thrust_max_n is not None or self.thrust_axes_n is not None
        if thrust and self.mass_kg is None:
            raise ValueError(f"mass_kg and {given[0]} must be given together")
        if self.mass_kg is not None and not given:
            raise ValueError(
                "mass_kg and thrust_max_n (or another capability) must be given together"
            )
        for name in ("base_attitude_xyzw", "start_attitude_xyzw"):
            if not is_unit(getattr(self, name)):
                raise ValueError(f"{name} is {list(getattr(self, name))}, must be of unit length")
        least, most = self.reach_min_m, self.reach_max_m
        if least is not None and most is not None and least >= most:
            raise ValueError(f"reach_min_m is {least}, must be below reach_max_m = {most}")

    @property
    def axes_mps2(self) -> tuple[float, float, float] | None:
        """Largest acceleration along each axis of the base [m/s2]; None where it is equal in
        all directions.
        """
        if self.accel_axes_mps2 is not None:
            return self.accel_axes_mps2
        if self.thrust_axes_n is None or self.mass_kg is None:
            return None
        x, y, z = self.thrust_axes_n
        return x / self.mass_kg, y / self.mass_kg, z / self.mass_kg

    def applied(self, params: PlanParams) -> PlanParams:
        """Return the planner's parameters with acceleration, start and delay of the robot.

        Args:
            params: The planner's parameters. The acceleration becomes one that the robot has in
                every direction.
        """
        axes, given = self.axes_mps2, self.accel_max_mps2
        if axes is not None:
            given = min(axes)
        elif self.thrust_max_n is not None and self.mass_kg is not None:
            given = self.thrust_max_n / self.mass_kg
        return replace(
            params,
            a_max_mps2=params.a_max_mps2 if given is None else given,
            latency_s=params.latency_s if self.delay_s is None else self.delay_s,
            robot_position_m=self.start_position_m or params.robot_position_m,
            robot_velocity_mps=self.start_velocity_mps or params.robot_velocity_mps,
        )

    def limited(self, limits: Limits) -> Limits:
        """Return the limits with size, workspace and acceleration per axis of the robot.

        Args:
            limits: Constraints besides the robot.
        """
        widened = limits.widened(self.radius_m)
        return replace(
            widened,
            base_m=self.base_position_m or limits.base_m,
            base_attitude_xyzw=self.base_attitude_xyzw,
            reach_max_m=self.reach_max_m or limits.reach_max_m,
            reach_min_m=self.reach_min_m or limits.reach_min_m,
            accel_axes_mps2=self.axes_mps2 or limits.accel_axes_mps2,
        )

    @property
    def gripper(self) -> tuple[Array, float] | None:
        """Attitude (4,) of the gripper at the start and its largest angular acceleration;
        None: not planned.
        """
        q = np.array(self.start_attitude_xyzw)
        turn = self.angular_accel_radps2
        return None if turn is None else (np.asarray(q / np.linalg.norm(q)), turn)

    def described(self, params: PlanParams, limits: Limits) -> str:
        """Return the assumed robot in one line.

        Args:
            params: The planner's parameters.
            limits: Constraints besides the robot.
        """
        params, limits = self.applied(params), self.limited(limits)
        mass = [] if self.mass_kg is None else [f"{self.mass_kg:g} kg"]
        axes = limits.accel_axes_mps2
        per_axis = f"at most ({', '.join(f'{a:g}' for a in axes)}) m/s2 per axis" if axes else ""
        turn = self.angular_accel_radps2
        reach = _shell(limits)
        parts = [
            *mass,
            per_axis or f"at most {params.a_max_mps2:g} m/s2",
            "attitude not planned" if turn is None else f"at most {turn:g} rad/s2",
            f"radius {self.radius_m:g} m",
            f"from ({', '.join(f'{x:g}' for x in params.robot_position_m)}) m in {{A}}",
            *([reach] if reach else []),
            *([] if self.urdf is None else [f"arm {PurePath(self.urdf).name}"]),
            f"delay {params.latency_s:g} s",
            f"thrust noise {self.thrust_noise:g}",
        ]
        return f"{self.name}: {', '.join(parts)}"


def slowed(params: PlanParams, limits: Limits, share: float) -> tuple[PlanParams, Limits]:
    """Return the parameters and the limits with a share of the acceleration.

    Args:
        params: The planner's parameters.
        limits: Constraints, with the largest acceleration of each axis or without.
        share: Of the largest acceleration, above 0, at most 1.
    """
    axes = limits.accel_axes_mps2
    if axes is not None:
        limits = replace(
            limits, accel_axes_mps2=(share * axes[0], share * axes[1], share * axes[2])
        )
    return replace(params, a_max_mps2=share * params.a_max_mps2), limits


def _shell(limits: Limits) -> str:
    """Return the workspace in words, "" where it is not limited."""
    least, most = limits.reach_min_m, limits.reach_max_m
    if least is None and most is None:
        return ""
    within = f"{least or 0.0:g} to {most:g} m" if most is not None else f"at least {least:g} m"
    return f"{within} from the base ({', '.join(f'{x:g}' for x in limits.base_m)}) m"
