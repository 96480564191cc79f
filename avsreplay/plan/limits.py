"""The constraints that the paper's abstract names, and the target as they see it.

Line of sight: the robot stays in a cone at the grasp point that turns with the target. Smooth capture: equal velocity,
and a bounded acceleration relative to the grasp point at contact. Physical: thrust, speed. And a sphere to stay out of.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from avsreplay.geometry import Array
from avsreplay.records import Trajectory
from avsreplay.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class Limits(Settings):
    """Constraints of a plan besides thrust; one that is not set is switched off, unless it scales with the target."""

    cone_deg: float | None = setting(
        None, "Half-angle of the approach cone at the grasp point.", unit="deg", above=0.0, below=90.0
    )
    cone_range_m: float | None = setting(
        None, "Distance to the grasp point within which the cone holds.", unit="m", above=0.0, of_extent=0.25
    )
    final_deg: float | None = setting(
        None,
        "Half-angle of the cone along the fixture's axis in the final approach.",
        unit="deg",
        above=0.0,
        below=90.0,
    )
    final_range_m: float | None = setting(None, "Length of the final approach.", unit="m", above=0.0, of_extent=0.06)
    mouth_m: float | None = setting(
        None, "Radius of both cones at the grasp point.", unit="m", above=0.0, of_extent=0.00125
    )
    speed_max_mps: float | None = setting(None, "Largest speed of the robot in {A}.", unit="m/s", above=0.0)
    contact_accel_mps2: float | None = setting(
        None, "Largest acceleration relative to the grasp point at contact.", unit="m/s2", above=0.0
    )
    keepout_m: float | None = setting(None, "Radius of the keep-out sphere about the mass centre.", unit="m", above=0.0)
    keepout_release_m: float | None = setting(
        None,
        "Distance to the grasp point within which the keep-out sphere does not hold.",
        unit="m",
        above=0.0,
        of_extent=0.06,
    )
    nodes: int = setting(100, "Thrust intervals of a constrained plan.", low=8)
    scan_s: float = setting(0.25, "Step of the search over the capture time.", unit="s", above=0.0)

    @property
    def any(self) -> bool:
        """Is there a limit at all?"""
        named = (self.cone_deg, self.final_deg, self.speed_max_mps, self.contact_accel_mps2, self.keepout_m)
        return any(value is not None for value in named)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The target after the instant of planning.

    Attributes:
        goal: the grasp point.
        axis: times (n,) -> (n, 3) unit vectors in {A}, outward along the fixture; the cones open along it.
        centre: times (n,) -> (n, 3) mass centre [m]; the sphere stands round it.
    """

    goal: Trajectory
    axis: Callable[[Array], Array] | None = None
    centre: Callable[[Array], Array] | None = None

    def check(self, limits: Limits) -> None:
        """Raises ValueError where a limit needs what the scene does not know."""
        if self.axis is None and (limits.cone_deg is not None or limits.final_deg is not None):
            raise ValueError("cone_deg and final_deg need the fixture's axis, and the scene has none")
        if limits.keepout_m is not None:
            self._check_sphere(limits.keepout_m, limits.keepout_release_m or 0.0)

    def _check_sphere(self, radius: float, release: float) -> None:
        if self.centre is None:
            raise ValueError("keepout_m needs the mass centre, and the scene has none")
        now = np.zeros(1)
        arm = float(np.linalg.norm(self.goal(now)[0] - self.centre(now)))
        if radius >= arm + release:
            raise ValueError(f"keepout_m is {radius}, must be below {arm + release:.3f}: arm and keepout_release_m")


def margin(scene: Scene, limits: Limits, r: Array, v: Array) -> float:
    """Least margin of the limits for a robot at r, v (3,) now, below 0 where one is broken.

    A plan may lie on a limit, and the target's estimate moves: lengths have the cone's mouth [m] to spare, speed a
    twentieth of itself. ``limits`` must be resolved. Infinite where no limit holds here.
    """
    now, least = np.zeros(1), math.inf
    from_apex = r - scene.goal(now)[0][0]
    distance, spare = float(np.linalg.norm(from_apex)), limits.mouth_m or 0.0
    cones = ((limits.cone_deg, limits.cone_range_m), (limits.final_deg, limits.final_range_m))
    for degrees, reach in cones if scene.axis else ():
        if degrees is not None and distance <= (reach or math.inf):
            along = float(from_apex @ scene.axis(now)[0]) if scene.axis else 0.0
            across = math.sqrt(max(distance * distance - along * along, 0.0))
            least = min(least, math.tan(math.radians(degrees)) * along + 2.0 * spare - across)
    if limits.keepout_m is not None and scene.centre and distance > (limits.keepout_release_m or 0.0):
        least = min(least, float(np.linalg.norm(r - scene.centre(now)[0])) - limits.keepout_m + spare)
    if limits.speed_max_mps is not None:
        least = min(least, 1.05 * limits.speed_max_mps - float(np.linalg.norm(v)))
    return least


class SampledScene:
    """A scene called on a grid and joined by cubic splines, for the many instants between nodes; it grows as needed."""

    def __init__(self, scene: Scene, horizon_s: float, step_s: float) -> None:
        self._scene, self._horizon_s, self._step_s = scene, horizon_s, step_s
        self._end_s = 0.0
        self._spline: Callable[[Array], Array] | None = None

    def at(self, times: Array) -> tuple[Array, Array, Array]:
        """Grasp point, axis and mass centre, each (n, 3), at times (n,) [s after planning]."""
        last = float(times[-1])
        if self._spline is None or last > self._end_s:
            self._end_s = min(max(1.5 * last, 8.0 * self._step_s), max(self._horizon_s, last))
            self._spline = self._joined(self._end_s)
        values: Array = self._spline(times)
        return values[:, :3], values[:, 3:6], values[:, 6:]

    def _joined(self, end_s: float) -> Callable[[Array], Array]:
        from scipy.interpolate import CubicSpline

        scene = self._scene
        times = np.linspace(0.0, end_s, max(math.ceil(end_s / self._step_s), 4) + 1)
        zero = np.zeros((len(times), 3))
        columns = [scene.goal(times)[0], scene.axis(times) if scene.axis else zero]
        columns.append(scene.centre(times) if scene.centre else zero)
        spline: Callable[[Array], Array] = CubicSpline(times, np.concatenate(columns, axis=1))
        return spline
