"""The scanner: a fixed grid of rays from the camera, cast on the moving target, with noise.

A flash scanner measures all rays at once. A raster scanner measures them point by point and row by row while the target
moves: each ray is cast on the target at its pose at the time of that ray.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array, frozen, rotate
from avsreplay.records import Surface
from avsreplay.settings import Settings, setting
from avsreplay.simulate.motion import Motion
from avsreplay.simulate.ray_casting import Engine, RayCaster


class Pattern(Enum):
    """Order in which the rays are measured."""

    FLASH = "flash"  # all rays at the stamp
    RASTER = "raster"  # row after row over ``scan_s``, each point with its own time


class FieldOfView(Enum):
    """Outline of the field of view."""

    RECTANGLE = "rectangle"
    CONE = "cone"  # the ellipse inside the rectangle


@dataclass(frozen=True, slots=True)
class ScannerParams(Settings):
    """The table [scanner]: rays, field of view and noise. The camera looks along +z of {A}, x to the right."""

    pattern: Pattern = setting(Pattern.FLASH, "All rays at the stamp (flash), or row by row over scan_s (raster).")
    fov_deg: tuple[float, float] = setting(
        (44.0, 44.0), "Full angles of the field of view, horizontal and vertical.", unit="deg", above=0.0, below=170.0
    )
    view: FieldOfView = setting(
        FieldOfView.RECTANGLE, "Outline of the field of view: the rectangle, or the cone inscribed in it."
    )
    rays: tuple[int, int] = setting((128, 128), "Rays horizontally and vertically.", low=1, high=4096)
    scan_s: float = setting(0.0, "Duration of a raster scan, which begins at its stamp.", unit="s", low=0.0)
    noise_m: float = setting(0.008, "1 sigma of the range, along the ray.", unit="m", low=0.0)
    outlier_ratio: float = setting(
        0.02, "Share of the returns with a range anywhere between range_min_m and range_max_m.", low=0.0, high=1.0
    )
    dropout_ratio: float = setting(0.0, "Share of the returns that are lost.", low=0.0, high=1.0)
    max_incidence_deg: float = setting(
        85.0,
        "Largest angle between the ray and the surface normal at which there is a return.",
        unit="deg",
        above=0.0,
        high=90.0,
    )
    range_min_m: float = setting(0.5, "Smallest range of a return.", unit="m", low=0.0)
    range_max_m: float = setting(12.0, "Largest range of a return.", unit="m", above=0.0)
    engine: Engine = setting(Engine.AUTO, "Ray casting: embree, exact (numpy), or embree where it is installed (auto).")

    def check(self) -> None:
        """Raise ValueError where the ranges, or pattern and duration, do not go together."""
        if self.range_min_m >= self.range_max_m:
            raise ValueError(f"range_min_m = {self.range_min_m} must be below range_max_m = {self.range_max_m}")
        if (self.pattern is Pattern.RASTER) != (self.scan_s > 0.0):
            raise ValueError(f"scan_s = {self.scan_s}: positive for a raster scan, 0 for a flash")


@dataclass(frozen=True, slots=True, eq=False)
class Returns:
    """The returns of a scan.

    Attributes:
        directions: (n, 3) unit vectors in {A}.
        ranges: (n,) [m].
        times_s: (n,) after the stamp [s].
    """

    directions: Array
    ranges: Array
    times_s: Array

    def keep(self, mask: NDArray[np.bool_]) -> Returns:
        """The returns selected by a mask (n,)."""
        return Returns(self.directions[mask], self.ranges[mask], self.times_s[mask])

    def joined(self, other: Returns) -> Returns:
        """These returns, then the others."""
        return Returns(
            np.concatenate([self.directions, other.directions]),
            np.concatenate([self.ranges, other.ranges]),
            np.concatenate([self.times_s, other.times_s]),
        )

    def in_order(self) -> Returns:
        """The returns by time; the order of equal times is kept."""
        order = np.argsort(self.times_s, kind="stable")
        return Returns(self.directions[order], self.ranges[order], self.times_s[order])

    @property
    def points(self) -> NDArray[np.float32]:
        """(n, 3) float32 in {A} [m]."""
        return (self.directions * self.ranges[:, None]).astype(np.float32)


class Scanner:
    """A scanner that observes one target.

    Attributes:
        params: Its parameters.
        centre_c: (3,) centre of the target's bounding sphere in {C} [m].
        radius_m: Its radius [m].
    """

    def __init__(self, params: ScannerParams, surface: Surface, motion: Motion) -> None:
        self.params = params
        self._motion = motion
        self._caster = RayCaster(surface, params.engine)
        self._directions, self._times = _grid(params)
        low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
        self.centre_c = frozen(0.5 * (low + high))
        self.radius_m = float(np.max(np.linalg.norm(surface.vertices - self.centre_c, axis=1)))

    @property
    def engine(self) -> Engine:
        """The engine that casts the rays."""
        return self._caster.engine

    def cast(self, t_s: float) -> Returns:
        """The first returns of a scan at ``t_s`` [s] without noise; rays without a return are left out."""
        R_ac, t_ac = self._poses(t_s)
        near = self._may_hit(R_ac, t_ac)
        R_ca = np.swapaxes(R_ac[near] if len(R_ac) > 1 else R_ac, -1, -2)
        origins = rotate(R_ca, -(t_ac[near] if len(t_ac) > 1 else t_ac))
        directions = rotate(R_ca, self._directions[near])
        ranges, cosine = self._caster.ranges(origins, directions)
        p = self.params
        seen = (ranges >= p.range_min_m) & (ranges <= p.range_max_m)
        seen &= cosine >= math.cos(math.radians(p.max_incidence_deg))
        return Returns(self._directions[near], ranges, self._times[near]).keep(seen)

    def disturb(self, returns: Returns, rng: np.random.Generator, noise_factor: float = 1.0) -> Returns:
        """Add range noise and outliers, and remove dropouts."""
        p, n = self.params, len(returns.ranges)
        ranges = returns.ranges + noise_factor * p.noise_m * rng.standard_normal(n)
        wrong = rng.random(n) < p.outlier_ratio
        ranges = np.where(wrong, rng.uniform(p.range_min_m, p.range_max_m, n), ranges)
        kept = rng.random(n) >= p.dropout_ratio
        return Returns(returns.directions, ranges, returns.times_s).keep(kept & (ranges > 0.0))

    def _poses(self, t_s: float) -> tuple[Array, Array]:
        """Rotations (n, 3, 3) and positions (n, 3) of the target at the time of each ray; n = 1 for a flash."""
        if self.params.pattern is Pattern.FLASH:
            return self._motion.poses([t_s])
        return self._motion.poses(t_s + self._times)

    def _may_hit(self, R_ac: Array, t_ac: Array) -> NDArray[np.intp]:
        """The rays that pass through the bounding sphere of the target."""
        centre = rotate(R_ac, self.centre_c) + t_ac
        along = np.sum(self._directions * centre, axis=1)
        aside = np.sum(centre * centre, axis=1) - along * along
        return np.flatnonzero(aside <= (1.001 * self.radius_m) ** 2)


def _grid(params: ScannerParams) -> tuple[Array, Array]:
    """Unit directions (n, 3) in {A}, row by row from the top left, and times (n,) [s] after the stamp.

    The rays of a flash are uniform on the image plane, those of a raster in the angle of its mirror.
    """
    (across, down), (columns, rows) = params.fov_deg, params.rays
    u, v = _steps(columns), _steps(rows)
    halves = [math.radians(0.5 * across), math.radians(0.5 * down)]
    if params.pattern is Pattern.FLASH:
        x, y = [math.tan(halves[0]) * s for s in u], [math.tan(halves[1]) * s for s in v]
    else:
        x, y = [math.tan(halves[0] * s) for s in u], [math.tan(halves[1] * s) for s in v]
    grid = np.array([(a, b, 1.0) for b in y for a in x])
    grid /= np.sqrt(np.sum(grid * grid, axis=1))[:, None]
    times = np.arange(len(grid)) * (params.scan_s / len(grid))
    if params.view is FieldOfView.CONE:
        inside = np.array([a * a + b * b <= 1.0 for b in v for a in u])
        grid, times = grid[inside], times[inside]
    return frozen(grid), frozen(times)


def _steps(n: int) -> list[float]:
    """The centres of n equal cells over (-1, 1)."""
    return [(2 * k + 1) / n - 1.0 for k in range(n)]
