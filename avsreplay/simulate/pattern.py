"""Patterns of a scanner: directions of the rays in the order of measurement, and their times."""

from __future__ import annotations

import math
from enum import Enum

import numpy as np

from avsreplay.geometry import Array, frozen


class Pattern(Enum):
    """Order in which the rays are measured."""

    FLASH = "flash"  # all rays at the stamp
    RASTER = "raster"  # row after row over ``scan_s``, each point with its own time
    LISSAJOUS = "lissajous"  # two sinusoidal mirrors over ``scan_s``
    SPINNING = "spinning"  # a column of beams that rotates about the vertical axis over ``scan_s``


class FieldOfView(Enum):
    """Outline of the field of view."""

    RECTANGLE = "rectangle"
    CONE = "cone"  # the ellipse inside the rectangle


def ray_grid(
    pattern: Pattern,
    view: FieldOfView,
    fov_deg: tuple[float, float],
    rays: tuple[int, int],
    lissajous: tuple[int, int],
    scan_s: float,
) -> tuple[Array, Array]:
    """Unit directions (n, 3) in {A} in the order of measurement, and times (n,) [s] after the stamp.

    The rays of a flash are uniform on the image plane, those of a raster in the angle of its mirrors, row by row from
    the top left. A Lissajous figure has as many rays as columns times rows. A spinning scanner measures column by
    column from the left; its rays are uniform in azimuth and elevation.
    """
    (across, down), (columns, rows) = fov_deg, rays
    halves = [math.radians(0.5 * across), math.radians(0.5 * down)]
    if pattern is Pattern.LISSAJOUS:
        count = columns * rows
        phases = [2.0 * math.pi * (k + 0.5) / count for k in range(count)]
        a, b = lissajous
        image = [(math.sin(a * phase), math.sin(b * phase + 0.25 * math.pi)) for phase in phases]
    elif pattern is Pattern.SPINNING:
        image = [(u, v) for u in _steps(columns) for v in _steps(rows)]
    else:
        image = [(u, v) for v in _steps(rows) for u in _steps(columns)]
    grid = np.array([_direction(pattern, halves, u, v) for u, v in image])
    grid /= np.sqrt(np.sum(grid * grid, axis=1))[:, None]
    group = rows if pattern is Pattern.SPINNING else 1  # rays that are measured at once
    times = (np.arange(len(grid)) // group * group) * (scan_s / len(grid))
    if view is FieldOfView.CONE:
        inside = np.array([u * u + v * v <= 1.0 for u, v in image])
        grid, times = grid[inside], times[inside]
    return frozen(grid), frozen(times)


def _direction(pattern: Pattern, halves: list[float], u: float, v: float) -> tuple[float, float, float]:
    """The direction of a ray at (u, v) in (-1, 1) of the field of view with these half angles; not of unit length."""
    if pattern is Pattern.FLASH:
        return math.tan(halves[0]) * u, math.tan(halves[1]) * v, 1.0
    if pattern is Pattern.SPINNING:
        return math.sin(halves[0] * u), math.tan(halves[1] * v), math.cos(halves[0] * u)
    return math.tan(halves[0] * u), math.tan(halves[1] * v), 1.0


def _steps(n: int) -> list[float]:
    """The centres of n equal cells over (-1, 1)."""
    return [(2 * k + 1) / n - 1.0 for k in range(n)]
