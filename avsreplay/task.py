"""The task of a capture (``[task]``): where the robot grasps, how exactly, with which gripper and
until when.

What is not given is derived from the model and the other settings, and is marked as assumed. The
grasp point is compared with the model before the run: a point inside the body, off its surface, or
one that a straight approach along the axis does not reach, cannot be used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from avsreplay import mesh
from avsreplay.errors import value_class
from avsreplay.geometry import Array, frozen
from avsreplay.plan.limits import TargetGeometry
from avsreplay.plan.robot import Limits, RobotParams
from avsreplay.plan.supervisor import SupervisorParams
from avsreplay.plan.uncertainty import Tolerance
from avsreplay.records import Surface
from avsreplay.settings import SettingError, Settings, given, is_unit, setting

Closest = Callable[[Array], tuple[Array, Array]]
"""Points (n, 3) in {C} -> closest points of the surface (n, 3) and signed distances (n,)."""

PROPOSED_PATCHES = 3  # grasp points that are proposed
_LINE_POINTS = 801  # points of the straight approach at which the distance to the body is taken
_CORRIDOR_RATIO = 1.2  # length of a corridor over the distance at which the clearance begins
_LEAST_CORRIDOR_OF_EXTENT = 0.06  # shorter ones are not needed, over the target's extent
# largest half opening that is assumed for a gripper, over the target's extent
_MAX_OPENING_OF_EXTENT = 0.04
_APPROACH_DEG = 15.0  # half-angle of the corridor along the axis where the limits set no cone
_APPROACH_CLEARANCE_OF_EXTENT = 0.02  # and the clearance outside it, over the target's extent
_FLAT_COS = math.cos(math.radians(8.0))  # faces of a patch have normals within this angle
# and lie within this distance of its plane, over the target's extent
_FLAT_OFFSET_OF_EXTENT = 0.003
_SEED_FACES = 24  # largest faces from which patches are grown


class Approach(Enum):
    """How the robot comes to the grasp point."""

    AXIS = "axis"
    FREE = "free"


@dataclass(frozen=True, slots=True)
class TaskParams(Settings):
    """What is to be grasped. It takes precedence over ``supervisor``, ``robot`` and
    ``fixture_axis_c``.
    """

    patch: str | None = setting(
        None,
        "Name of a patch of the model that 'avsreplay info' proposes as the grasp point.",
        unset="grasp_m",
    )
    grasp_m: tuple[float, float, float] | None = setting(
        None, "Grasp point in {C}.", unit="m", unset="the origin of {C}"
    )
    axis: tuple[float, float, float] | None = setting(
        None,
        "Unit vector in {C} that points out of the surface, along which the robot approaches.",
        unset="fixture_axis_c",
    )
    approach: Approach = setting(
        Approach.AXIS,
        "Approach to a model where [limits] sets no cone: through a corridor of 15 deg along"
        " the axis with a clearance of 0.02 of the extent (axis), or as if there were no body"
        " (free).",
    )
    position_m: float | None = setting(
        None,
        "Largest distance of the gripper from the grasp point when it closes.",
        unit="m",
        above=0.0,
        unset="supervisor.capture_pos_m",
    )
    speed_mps: float | None = setting(
        None,
        "Largest relative speed when it closes.",
        unit="m/s",
        above=0.0,
        unset="supervisor.capture_speed_mps",
    )
    angle_deg: float | None = setting(
        None,
        "Largest error of its attitude when it closes.",
        unit="deg",
        above=0.0,
        unset="supervisor.capture_angle_deg",
    )
    opening_m: float | None = setting(
        None,
        "Opening of the gripper: what it encloses at the grasp point is no contact.",
        unit="m",
        above=0.0,
        unset="the width of the part that stands at the grasp point",
    )
    radius_m: float | None = setting(
        None, "Radius of the gripper.", unit="m", low=0.0, unset="robot.radius_m"
    )
    deadline_s: float | None = setting(
        None,
        "Latest time of the capture after the first scan.",
        unit="s",
        above=0.0,
        unset="supervisor.approach_limit_s after the first approach",
    )
    robot: str | None = setting(
        None,
        "File with a table [robot], relative to the file that states it; settings of [robot] take"
        " precedence.",
        unset="[robot]",
    )

    def check(self) -> None:
        """Raise ValueError where the grasp point is given twice, or the axis is no unit vector."""
        if self.patch is not None and (self.grasp_m is not None or self.axis is not None):
            raise SettingError("patch", "patch and grasp_m or axis exclude each other")
        if self.axis is not None and not is_unit(self.axis, 1e-3):
            raise SettingError("axis", f"axis is {list(self.axis)}, must be of unit length")

    def with_gripper(self, robot: RobotParams) -> RobotParams:
        """Return the robot with the gripper of the task.

        Args:
            robot: the robot as configured.
        """
        return robot if self.radius_m is None else replace(robot, radius_m=self.radius_m)

    def with_tolerance(self, supervisor: SupervisorParams) -> SupervisorParams:
        """Return the supervisor with the tolerances of the task.

        Args:
            supervisor: its parameters as configured.
        """
        tolerances: dict[str, Any] = {
            "capture_pos_m": self.position_m,
            "capture_speed_mps": self.speed_mps,
            "capture_angle_deg": self.angle_deg,
        }
        known = {name: value for name, value in tolerances.items() if value is not None}
        return replace(supervisor, **known)


@value_class
class Task:
    """A task whose values are all known.

    Attributes:
        grasp_c, axis_c: (3,) grasp point [m] and outward axis of the approach in {C}.
        tolerance: largest errors of a capture.
        opening_m, radius_m: of the gripper.
        mouth_m: distance from the grasp point, along the axis, at which the gripper is past the
            part that it encloses.
        deadline_s: latest time of the capture after the first scan; infinite without.
        corridor_m: length of a corridor that ends where the clearance is kept; 0: the usual one.
        approach_m: clearance of the approach along the axis where the limits set no cone; 0: free.
        assumed: names of the values that were not given.
        problem: why the grasp point cannot be used, "" where it can.
    """

    grasp_c: Array
    axis_c: Array
    tolerance: Tolerance
    opening_m: float
    radius_m: float
    mouth_m: float
    deadline_s: float
    corridor_m: float = 0.0
    approach_m: float = 0.0
    assumed: tuple[str, ...] = ()
    problem: str = ""

    @property
    def text(self) -> str:
        """The task in one line, with the values that are assumed."""
        p, t = (
            self.tolerance,
            [
                f"grasp at ({', '.join(f'{x:.4g}' for x in self.grasp_c)}) m",
                f"along ({', '.join(f'{x:.3g}' for x in self.axis_c)}) in {{C}}",
            ],
        )
        t.append(
            f"within {1e3 * p.position_m:.3g} mm, {1e3 * p.speed_mps:.3g} mm/s and"
            f" {p.angle_deg:.3g} deg"
        )
        t.append(f"opening {1e3 * self.opening_m:.3g} mm, radius {1e3 * self.radius_m:.3g} mm")
        if math.isfinite(self.deadline_s):
            t.append(f"until {self.deadline_s:g} s")
        assumed = f"; assumed: {', '.join(self.assumed)}" if self.assumed else ""
        return ", ".join(t) + assumed

    def record(self) -> dict[str, Any]:
        """Plain values for JSON, by the names of ``TaskParams``."""
        return {
            "grasp_m": self.grasp_c.tolist(),
            "axis": self.axis_c.tolist(),
            "position_m": self.tolerance.position_m,
            "speed_mps": self.tolerance.speed_mps,
            "angle_deg": self.tolerance.angle_deg,
            "opening_m": self.opening_m,
            "radius_m": self.radius_m,
            "approach": (Approach.AXIS if self.approach_m > 0.0 else Approach.FREE).value,
            "deadline_s": self.deadline_s if math.isfinite(self.deadline_s) else None,
            "assumed": list(self.assumed),
            "problem": self.problem,
        }

    def corridor(self, limits: Limits) -> Limits:
        """Return the limits with the corridor of the approach, which begins where the clearance is
        kept.

        A corridor shorter than the part at the grasp point would end inside this part.

        Args:
            limits: constraints of a plan; a cone and a length that are set are kept.
        """
        limits = _along_axis(limits, self.approach_m)
        if limits.final_deg is None or limits.final_range_m is not None:
            return limits
        return replace(limits, final_range_m=self.corridor_m) if self.corridor_m > 0.0 else limits


def _along_axis(limits: Limits, clearance_m: float) -> Limits:
    """The limits of an approach along the axis, unless they set a cone or the clearance is 0.

    Safe withdrawals are stated but not required: they take most of the time of a search.
    """
    if clearance_m <= 0.0 or limits.cone_deg is not None or limits.final_deg is not None:
        return limits
    clear = limits.clearance_m or clearance_m
    return replace(limits, final_deg=_APPROACH_DEG, clearance_m=clear, abort=False)


@value_class(eq=True)
class Patch:
    """A part of the surface that a robot can grasp.

    Attributes:
        name: by which a task refers to it.
        point, axis: grasp point [m] and outward normal in {C}.
        area_m2: its area.
    """

    name: str
    point: tuple[float, float, float]
    axis: tuple[float, float, float]
    area_m2: float

    @property
    def option(self) -> str:
        """The option that selects it."""
        return f"--set task.patch={self.name}"

    @property
    def text(self) -> str:
        """Where it lies, how it is oriented and how large it is."""
        point = ", ".join(f"{x:.4g}" for x in self.point)
        axis = ", ".join(f"{x:.3g}" for x in self.axis)
        return f"flat, {1e4 * self.area_m2:.3g} cm2 at ({point}) m, outward normal ({axis})"


def task_of(
    params: TaskParams,
    supervisor: SupervisorParams,
    robot: RobotParams,
    axis_c: tuple[float, float, float],
    surface: Surface,
    closest: Closest,
    limits: Limits | None = None,
    extent_m: float | None = None,
) -> Task:
    """Return the task with everything that was not given.

    Args:
        params: as configured.
        supervisor: its parameters, which apply where the task gives nothing.
        robot: the robot, likewise.
        axis_c: axis where the task gives none.
        surface: model of the target.
        closest: its closest points.
        limits: constraints of the plans; their clearance determines where a corridor begins.
        extent_m: diagonal of the target's bounding box [m]; None: that of the model.

    Raises:
        SettingError: the model has no patch of the given name.
    """
    grasp, axis = params.grasp_m or (0.0, 0.0, 0.0), params.axis or axis_c
    if params.patch is not None:
        patch = _named_patch(params.patch, surface, closest)
        grasp, axis = patch.point, patch.axis
    extent = surface.extent if extent_m is None else extent_m
    watched = params.with_tolerance(supervisor).resolved(extent)
    tolerance = Tolerance(
        given(watched.capture_pos_m), given(watched.capture_speed_mps), watched.capture_angle_deg
    )
    radius = params.with_gripper(robot).radius_m
    point, out = frozen(np.array(grasp, float), 3), np.array(axis, float)
    out = frozen(out / np.linalg.norm(out), 3)
    along = params.approach is Approach.AXIS and len(surface.faces) > 0
    clear = _APPROACH_CLEARANCE_OF_EXTENT * extent if along else 0.0
    chosen = _along_axis(Limits() if limits is None else limits, clear)
    needed = _Room(params.opening_m, tolerance.position_m, (chosen.clearance_m or 0.0) + radius)
    access = _access(point, out, surface, closest, needed, extent)
    corridor = _CORRIDOR_RATIO * access.clear_m
    clear = 0.0 if access.problem else clear
    derived = clear > 0.0 and chosen != limits
    return Task(
        point,
        out,
        tolerance,
        params.opening_m or 2.0 * access.half_m,
        radius,
        access.mouth_m,
        math.inf if params.deadline_s is None else params.deadline_s,
        corridor if corridor > _LEAST_CORRIDOR_OF_EXTENT * extent else 0.0,
        clear,
        _assumed(params, supervisor, robot, derived),
        access.problem,
    )


def _named_patch(name: str, surface: Surface, closest: Closest) -> Patch:
    found = {patch.name: patch for patch in patches(surface, closest)}
    if name not in found:
        known = ", ".join(found) or "none"
        raise SettingError("patch", f"patch is '{name}', the model has: {known}")
    return found[name]


def _assumed(
    params: TaskParams, supervisor: SupervisorParams, robot: RobotParams, approach: bool
) -> tuple[str, ...]:
    """Names of the values that neither the task nor the settings of the robot give."""
    values = {
        "grasp point": params.patch or params.grasp_m,
        "axis": params.patch or params.axis,
        "position": params.position_m or supervisor.capture_pos_m,
        "speed": params.speed_mps,
        "angle": params.angle_deg,
        "opening": params.opening_m,
        "approach along the axis": None if approach else "given",
        "radius": robot.radius_m or None if params.radius_m is None else params.radius_m,
    }
    return tuple(name for name, value in values.items() if value is None)


class _Room(NamedTuple):
    """What a gripper needs around the grasp point: its opening (None: not given), the error of its
    position and the distance from the body [m].
    """

    opening_m: float | None
    tolerance_m: float
    clearance_m: float


class _Access(NamedTuple):
    """Half of the opening, distances at which a part at the grasp point ends and at which the
    clearance begins [m], and why the point cannot be used.
    """

    half_m: float
    mouth_m: float
    clear_m: float
    problem: str


def _access(
    point: Array, axis: Array, surface: Surface, closest: Closest, needed: _Room, extent: float
) -> _Access:
    """How a straight approach along an axis reaches a grasp point of a body with this diameter."""
    along = np.linspace(0.0, extent, _LINE_POINTS)
    foot, gap = closest(point + along[:, None] * axis)
    off = float(np.linalg.norm(foot[0] - point))
    given_m, tolerance_m = needed.opening_m, needed.tolerance_m
    allowed = _MAX_OPENING_OF_EXTENT * extent if given_m is None else 0.5 * given_m
    if not len(surface.faces):
        far = f"the grasp point is {off:.3g} m from the nearest point of the model"
        return _Access(tolerance_m, 0.0, 0.0, far if off > max(allowed, tolerance_m) else "")
    inside = gap < -1e-9 * extent
    depth = float(max(-gap.min(), 0.0))
    mouth = float(along[np.flatnonzero(inside)[-1]]) if inside.any() else 0.0
    near = np.flatnonzero(gap < needed.clearance_m)
    begin = float(along[near[-1]]) if len(near) else 0.0
    problem = ""
    if gap[0] < 0.0 and off > allowed:
        problem = f"the grasp point lies {off:.3g} m inside the body"
    elif off > max(tolerance_m, allowed if gap[0] < 0.0 else 0.0):
        problem = f"the grasp point lies {off:.3g} m off the surface"
    elif depth > allowed + tolerance_m:
        problem = (
            f"the approach along its axis passes through the body, up to {depth:.3g} m deep, within"
            f" {mouth:.3g} m of the grasp point"
        )
    return _Access(depth + tolerance_m, mouth, begin, problem)


def patches(surface: Surface, closest: Closest) -> tuple[Patch, ...]:
    """Return the largest flat patches of a model that a straight approach reaches, at most three.

    Args:
        surface: model in {C}; a point cloud has no patch.
        closest: its closest points.
    """
    if not len(surface.faces):
        return ()
    found = sorted(_flat(surface), key=lambda each: -each[2])
    out: list[Patch] = []
    needed = _Room(opening_m=1e-9, tolerance_m=1e-4 * surface.extent, clearance_m=0.0)
    for point, normal, area in found:
        if not _access(point, normal, surface, closest, needed, surface.extent).problem:
            x, y, z = (round(float(v), 5) for v in point)
            axis = (float(normal[0]), float(normal[1]), float(normal[2]))
            out.append(Patch(f"flat-{len(out) + 1}", (x, y, z), axis, area))
        if len(out) == PROPOSED_PATCHES:
            break
    return tuple(out)


def _flat(surface: Surface) -> Iterator[tuple[Array, Array, float]]:
    """Grasp point, normal and area of parts of one plane, grown from the largest faces."""
    corners, cross = surface.vertices[surface.faces], mesh.normals(surface.vertices, surface.faces)
    doubled = mesh.lengths(cross)
    normals, areas = cross / np.maximum(doubled, 1e-300)[:, None], 0.5 * doubled
    middles, free = corners.mean(axis=1), areas > 0.0
    for seed in np.argsort(-areas, kind="stable")[:_SEED_FACES]:
        if not free[seed]:
            continue
        normal = normals[seed]
        level = np.abs((corners - corners[seed, 0]) @ normal).max(axis=1)
        flat = (
            (normals @ normal > _FLAT_COS)
            & (level < _FLAT_OFFSET_OF_EXTENT * surface.extent)
            & free
        )
        weights = areas[flat]
        centre = weights @ middles[flat] / weights.sum()
        listed = np.flatnonzero(flat)
        nearest = listed[np.argmin(np.linalg.norm(middles[listed] - centre, axis=1))]
        inside = _in_face(centre, corners[nearest], normals[nearest])
        free &= ~flat
        yield (centre if inside else middles[nearest]), normals[nearest], float(weights.sum())


def _in_face(point: Array, corners: Array, normal: Array) -> bool:
    """Return whether a point of the plane of a triangle is inside it."""
    edges = np.roll(corners, -1, axis=0) - corners
    return bool((np.cross(edges, point - corners) @ normal >= 0.0).all())


def target_at(target: TargetGeometry, grasp_c: Array) -> TargetGeometry:
    """Return the geometry of a target with the grasp point as its origin.

    Args:
        target: with the origin of {C}.
        grasp_c: (3,) grasp point in {C} [m].
    """
    if not np.any(grasp_c):
        return target
    x, y, z = (float(value) for value in grasp_c)
    surface = target.surface and target.surface.moved((x, y, z))
    return TargetGeometry(target.axis_c, target.hull_c - grasp_c, surface)
