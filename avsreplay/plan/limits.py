"""Constraints of the approach, and the target as the planner uses it.

The constraints in the fixture's frame {C} are the approach cone (line of sight), the corridor of
the last metres, a sphere about the centre of mass and the clearance to the surface. A robot at r
has y = R_ac' (r - rho) in {C}.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.plan import _cone
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.plan.robot import Limits
from avsreplay.records import Trajectory

CONSTRAINTS = (
    "cone",
    "corridor",
    "sphere",
    "body",
    "workspace",
)  # in the order of the columns of ``margins``
AXIS_POINTS = 401  # on the fixture's axis at which limits are compared with the body
NARROWEST = 0.5  # largest share of the width of cone and corridor that an uncertain target takes


@value_class
class Scene:
    """The target after the instant of planning.

    Attributes:
        goal: Trajectory of the grasp point, the origin of {C}, in {A}.
        attitude: Times (n,) [s] -> q_ac (n, 4) of the fixture; None where only speed and contact
            are limited.
        axis_c: (3,) outward axis of the fixture in {C}, unit; cone and corridor open along it.
        centre_c: (3,) centre of mass in {C} [m], the centre of the sphere; None where unknown.
        surface: The body: points (n, 3) in {C} -> closest points (n, 3), signed distances (n,) (see
            ``Margins``); None: unknown.
        sigma: Times (n,) ascending [s] -> predicted 1 sigma of the position [m] and attitude [rad]
            of {C}, each (n,).
        hull_c: (n, 3) points in {C} with the same convex hull as the target's surface [m]; None:
            unknown.
    """

    goal: Trajectory
    attitude: Callable[[Array], Array] | None = None
    axis_c: Array | None = None
    centre_c: Array | None = None
    surface: _cone.Body | None = None
    sigma: Callable[[Array], tuple[Array, Array]] | None = None
    hull_c: Array | None = None

    @property
    def radius_m(self) -> float:
        """Radius of the sphere about the centre of mass that contains the target in every attitude
        [m]; 0: unknown.
        """
        if self.hull_c is None or self.centre_c is None:
            return 0.0
        return float(np.sqrt(np.max(np.sum((self.hull_c - self.centre_c) ** 2, axis=1))))

    def centre(self, times: Array) -> Array:
        """Return the centre of mass (n, 3) in {A} [m], or the grasp point where it is unknown.

        Args:
            times: (n,) [s after the instant of planning].
        """
        position = self.goal(times)[0]
        if self.attitude is None or self.centre_c is None:
            return position
        return np.asarray(position + geometry.matrix(self.attitude(times)) @ self.centre_c)

    def after(self, delay_s: float) -> Scene:
        """Return the scene with times counted from a later instant.

        Args:
            delay_s: Delay of that instant [s].
        """
        goal, attitude, sigma = self.goal, self.attitude, self.sigma
        return replace(
            self,
            goal=lambda t: goal(t + delay_s),
            attitude=attitude and (lambda t: attitude(t + delay_s)),
            sigma=sigma and (lambda t: sigma(t + delay_s)),
        )

    def check(self, limits: Limits) -> None:
        """Check that the scene contains what the constraints need.

        Args:
            limits: Resolved limits.

        Raises:
            ValueError: Something is missing, or ``keepout_m`` is too large to reach the grasp
                point.
        """
        if limits.geometric and self.attitude is None:
            raise ValueError(
                "cone, corridor, sphere and clearance need the fixture's attitude, and the scene"
                " has none"
            )
        if self.axis_c is None and (limits.cone_deg is not None or limits.final_deg is not None):
            raise ValueError(
                "cone_deg and final_deg need the fixture's axis, and the scene has none"
            )
        if limits.clearance_m is not None and self.surface is None:
            raise ValueError("clearance_m needs the target's surface, and the scene has none")
        if limits.clearance_m is not None and limits.final_deg is None:
            raise ValueError(
                "clearance_m needs final_deg: contact is possible only inside the corridor"
            )
        if limits.keepout_m is not None:
            if self.centre_c is None:
                raise ValueError("keepout_m needs the mass centre, and the scene has none")
            most = float(np.linalg.norm(self.centre_c)) + (limits.keepout_release_m or 0.0)
            if limits.keepout_m >= most:
                raise ValueError(
                    f"keepout_m is {limits.keepout_m}, must be below {most:.3f} to leave the grasp"
                    " point"
                )


@value_class
class TargetGeometry:
    """Shape of the target for guidance.

    Attributes:
        axis_c: (3,) outward axis of the fixture in {C}, unit.
        hull_c: (n, 3) points in {C} with the same convex hull as the surface [m].
        surface: Closest points of the surface, see ``Scene``; None where no clearance is required.
    """

    axis_c: Array
    hull_c: Array
    surface: _cone.Body | None = None


@value_class
class Margins:
    """Margins of the geometric constraints at n points; a constraint holds where its margin is not
    negative.

    Attributes:
        first: (n, 5) margins of the first alternatives in the order of ``CONSTRAINTS`` [m]: inside
            the cone, inside the corridor, within the release distance of the sphere, inside the
            corridor instead of at the clearance.
        second: (n, 5) margins of the others [m], infinite where off: outside the range of the cone,
            outside that of the corridor, outside the sphere, at the clearance, inside the
            workspace.
        foot: (n, 3) closest points of the surface in {C} [m].
        clearance: (n,) required clearance [m].
        distance: (n,) signed distance to the surface [m], negative inside, infinite where far or
            not required.
    """

    first: Array
    second: Array
    foot: Array
    distance: Array
    clearance: Array

    @property
    def values(self) -> Array:
        """Margins (n, 5) of the constraints: the larger one of the alternatives [m]."""
        return np.maximum(self.first, self.second)

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Whether the first alternative has the larger margin (n, 5)."""
        return np.asarray(self.first > self.second)

    @property
    def between(self) -> Array:
        """Margins (n - 1, 5) between consecutive points: where the alternatives change, that
        of the crossing.
        """
        difference = self.first - self.second
        with np.errstate(invalid="ignore", divide="ignore"):
            share = difference[:-1] / (difference[:-1] - difference[1:])
            crossing = self.first[:-1] + share * (self.first[1:] - self.first[:-1])
        changes = (difference[:-1] > 0.0) != (difference[1:] > 0.0)
        least = np.minimum(self.values[:-1], self.values[1:])
        return np.where(changes & np.isfinite(crossing), np.minimum(least, crossing), least)


def margins(
    scene: Scene, limits: Limits, y: Array, r: Array, sigma: tuple[Array, Array] | None = None
) -> Margins:
    """Evaluate the geometric constraints; ``Margins`` states the two alternatives of each.

    Args:
        scene: The target.
        limits: Resolved limits.
        y: (n, 3) positions in {C} [m].
        r: (n, 3) the same positions in {A} [m].
        sigma: Predicted 1 sigma of position [m] and attitude [rad] at each point, each (n,).
    """
    n, distance = len(y), np.linalg.norm(y, axis=1)
    first, second = np.full((n, 5), -math.inf), np.full((n, 5), math.inf)
    foot, gap, clearance = np.zeros((n, 3)), np.full(n, math.inf), np.zeros(n)
    mouth, reach, corridor = (
        limits.mouth_m or 0.0,
        limits.final_range_m or 0.0,
        np.full(n, -math.inf),
    )
    if scene.axis_c is not None:
        along = y @ scene.axis_c
        across = np.linalg.norm(y - along[:, None] * scene.axis_c, axis=1)
        narrowed = narrowing(scene, limits, y, sigma)
        for i, degrees, length in (
            (0, limits.cone_deg, limits.cone_range_m or 0.0),
            (1, limits.final_deg, reach),
        ):
            if degrees is not None:
                within = math.tan(math.radians(degrees)) * along + mouth - across
                first[:, i], second[:, i] = within - narrowed[:, i], distance - length
                corridor = np.minimum(within, reach - distance) if i else corridor
    if limits.keepout_m is not None and scene.centre_c is not None:
        first[:, 2] = (limits.keepout_release_m or 0.0) - distance
        second[:, 2] = np.linalg.norm(y - scene.centre_c, axis=1) - limits.keepout_m
    if limits.clearance_m is not None and scene.surface is not None:
        foot, gap = scene.surface(y)
        clearance = required_clearance(limits, distance, sigma)
        first[:, 3], second[:, 3] = corridor, gap - clearance
    if limits.reach_max_m is not None or limits.reach_min_m is not None:
        from_base = np.linalg.norm(r - np.array(limits.base_m), axis=1)
        shell = limits.reach_min_m or -math.inf, limits.reach_max_m or math.inf
        second[:, 4] = np.minimum(from_base - shell[0], shell[1] - from_base)
    return Margins(first, second, foot, gap, clearance)


def narrowing(scene: Scene, limits: Limits, y: Array, sigma: tuple[Array, Array] | None) -> Array:
    """Return by how much cone and corridor (n, 2) are narrowed at n points [m]: by the predicted
    standard deviations, at most to half of their width.

    Args:
        scene: The target.
        limits: Resolved limits.
        y: (n, 3) positions in {C} [m].
        sigma: Predicted 1 sigma of position [m] and attitude [rad], each (n,); None: exact.
    """
    out = np.zeros((len(y), 2))
    if sigma is None or scene.axis_c is None:
        return out
    away = limits.clearance_sigmas * (sigma[0] + sigma[1] * np.linalg.norm(y, axis=1))
    for i, degrees in enumerate((limits.cone_deg, limits.final_deg)):
        if degrees is not None:
            width = math.tan(math.radians(degrees)) * (y @ scene.axis_c) + (limits.mouth_m or 0.0)
            out[:, i] = np.minimum(away, NARROWEST * np.maximum(width, 0.0))
    return out


def required_clearance(limits: Limits, distance: Array, sigma: tuple[Array, Array] | None) -> Array:
    """Return the distance to the surface (n,) that is required at n points [m].

    Args:
        limits: Limits; without a clearance the centre of the end-effector must not touch.
        distance: (n,) distances to the grasp point [m].
        sigma: Predicted 1 sigma of position [m] and attitude [rad], each (n,); None: exact.
    """
    clearance = np.full(len(distance), limits.clearance_m or 0.0)
    if sigma is not None:
        clearance += limits.clearance_sigmas * (sigma[0] + sigma[1] * distance)
    return clearance


def axis_blocked(scene: Scene, limits: Limits, length_m: float) -> tuple[str, float, float] | None:
    """Return why no straight approach along the fixture's axis exists: the constraint that is
    violated there, the distance from the grasp point up to which it is [m], and the largest
    violation [m]; None where all hold.

    Args:
        scene: The target.
        limits: Resolved limits.
        length_m: Length of the axis that is looked at [m].
    """
    if scene.axis_c is None or not limits.geometric:
        return None
    along = np.linspace(0.0, length_m, AXIS_POINTS)
    y = along[:, None] * scene.axis_c
    found = margins(scene, replace(limits, reach_max_m=None, reach_min_m=None), y, y).values
    worst = int(found[1:].min(axis=0).argmin())
    violated = np.flatnonzero(found[1:, worst] < 0.0)
    if not len(violated):
        return None
    last = float(along[1 + violated[-1]])
    return CONSTRAINTS[worst], last, float(-found[1:, worst].min())


def margin(scene: Scene, limits: Limits, r: Array, v: Array) -> float:
    """Return the smallest margin for a robot now [m or m/s]: negative if a constraint is violated,
    infinite without.

    Args:
        scene: The target.
        limits: Resolved limits. As estimates change, lengths are extended by ``mouth_m`` and the
            speed by a twentieth.
        r: (3,) position of the robot in {A} [m].
        v: (3,) its velocity [m/s].
    """
    least, now = math.inf, np.zeros(1)
    if limits.geometric and scene.attitude is not None:
        y = (r - scene.goal(now)[0]) @ geometry.matrix(scene.attitude(now)[0])
        least = float(margins(scene, limits, y, r[None]).values.min()) + (limits.mouth_m or 0.0)
    if limits.speed_max_mps is not None:
        least = min(least, 1.05 * limits.speed_max_mps - float(np.linalg.norm(v)))
    return least


def in_fixture_axes(R: Array, vectors: Array) -> Array:
    """Return the coordinates (n, 3) in {C} of vectors in {A}, R_ac' v.

    Args:
        R: (n, 3, 3) rotation matrices R_ac.
        vectors: (n, 3) vectors in {A}.
    """
    return np.asarray((vectors[:, None, :] @ R)[:, 0])


class SampledScene:
    """Motion of {C} sampled on a grid and interpolated by cubic splines; the grid is extended
    when needed.
    """

    def __init__(self, scene: Scene, horizon_s: float, step_s: float, span_s: float) -> None:
        self.scene, self._horizon_s, self._step_s, self._span_s = scene, horizon_s, step_s, span_s
        self._end_s, self._pieces = -1.0, (np.empty((4, 0, 12)), np.empty(1))
        self._sigma: tuple[Array, Array, Array] | None = None

    def anew(self) -> SampledScene:
        """Return the same motion with the first grid."""
        return SampledScene(self.scene, self._horizon_s, self._step_s, self._span_s)

    def at(self, times: Array, order: int = 0) -> tuple[Array, Array]:
        """Return rho (n, 3) and R_ac (n, 3, 3), or their first derivatives (order 1), at times (n,)
        [s].
        """
        return _cone.motion(*self.pieces(float(times.max(initial=0.0))), times, order)

    def pieces(self, last_s: float) -> tuple[Array, Array]:
        """Return coefficients (4, n, 12), highest power first, of the pieces of rho and R_ac, and
        their limits (n + 1,), until at least ``last_s`` [s].
        """
        if last_s > self._end_s:
            self._end_s = min(max(1.5 * last_s, self._span_s), max(self._horizon_s, last_s))
            self._pieces = self._joined(self._end_s)
        return self._pieces

    def coordinates(self, times: Array, r: Array) -> Array:
        """Return the coordinates in {C} (n, 3) of positions r (n, 3) in {A}."""
        rho, R = self.at(times)
        return in_fixture_axes(R, r - rho)

    def sigma(self, times: Array) -> tuple[Array, Array] | None:
        """Return the predicted 1 sigma of position [m] and attitude [rad] at times (n,); None
        where unknown.
        """
        table = self.sigma_table
        if table is None:
            return None
        grid, position, attitude = table
        return np.interp(times, grid, position), np.interp(times, grid, attitude)

    @property
    def sigma_table(self) -> tuple[Array, Array, Array] | None:
        """Equally spaced times (n,) from 0 [s] and the predicted 1 sigma of position [m] and
        attitude [rad] there; None where unknown.
        """
        if self._sigma is None and self.scene.sigma is not None:
            grid = np.linspace(0.0, self._horizon_s, 49)
            self._sigma = (grid, *self.scene.sigma(grid))
        return self._sigma

    def _joined(self, end_s: float) -> tuple[Array, Array]:
        times = np.linspace(0.0, end_s, max(math.ceil(end_s / self._step_s), 4) + 1)
        turn = np.tile(np.eye(3).ravel(), (len(times), 1))
        if self.scene.attitude is not None:
            turn = geometry.matrix(self.scene.attitude(times)).reshape(-1, 9)
        return _cone.spline(times, np.concatenate([self.scene.goal(times)[0], turn], axis=1)), times


def largest_acceleration(limits: Limits, params: PlanParams) -> float:
    """Return the largest acceleration in any direction [m/s2]: the corner of the box where each
    axis is bounded.

    Args:
        limits: Limits, with a bound of each axis or without.
        params: Acceleration without bounds of the axes.
    """
    bounds = limits.accel_axes_mps2
    return params.a_max_mps2 if bounds is None else math.hypot(*bounds)
