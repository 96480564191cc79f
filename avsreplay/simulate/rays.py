"""The table [scanner] of a scenario, and the rays: directions and times in the order of
measurement, and triangles hit.

The triangle is found by embreex where it is installed, by an exhaustive search elsewhere. Either
engine only finds the triangle; the range is computed from the plane of that triangle in float64.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from avsreplay import mesh
from avsreplay.errors import MissingBackend
from avsreplay.geometry import Array, frozen
from avsreplay.records import Surface
from avsreplay.settings import Settings, is_unit, setting


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
    """Unit directions (n, 3) in {A} in the order of measurement, and times (n,) [s] after the
    stamp.

    The rays of a flash are uniform on the image plane, those of a raster in the angle of its
    mirrors, row by row from the top left. A Lissajous figure has as many rays as columns times
    rows. A spinning scanner measures column by column from the left; its rays are uniform in
    azimuth and elevation.

    Args:
        pattern: order in which the rays are measured.
        view: shape of the field of view.
        fov_deg: width and height of the field of view [deg].
        rays: number of columns and rows.
        lissajous: frequencies of the figure across and down.
        scan_s: duration of a scan [s].
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


def _direction(
    pattern: Pattern, halves: list[float], u: float, v: float
) -> tuple[float, float, float]:
    """The direction of a ray at (u, v) in (-1, 1) of the field of view with these half
    angles; not of unit length.
    """
    if pattern is Pattern.FLASH:
        return math.tan(halves[0]) * u, math.tan(halves[1]) * v, 1.0
    if pattern is Pattern.SPINNING:
        return math.sin(halves[0] * u), math.tan(halves[1] * v), math.cos(halves[0] * u)
    return math.tan(halves[0] * u), math.tan(halves[1] * v), 1.0


def _steps(n: int) -> list[float]:
    """The centres of n equal cells over (-1, 1)."""
    return [(2 * k + 1) / n - 1.0 for k in range(n)]


CHUNK_PAIRS = 1 << 20  # ray-triangle pairs held at once by the exact search
Hits = NDArray[np.int64]
Search = Callable[[Array, Array], Hits]


class Engine(Enum):
    """The program that finds the triangle that a ray hits."""

    AUTO = "auto"  # embree where embreex is installed, else exact
    EMBREE = "embree"  # float32, fast; hits on an edge may differ between processors
    EXACT = "exact"  # every triangle in float64: slow, the same bits on any machine


class RayCaster:
    """Casts rays on one mesh.

    Args:
        surface: The mesh.
        engine: The search for the triangle.

    Raises:
        MissingBackend: embree is requested and embreex is not installed.
    """

    def __init__(self, surface: Surface, engine: Engine = Engine.AUTO) -> None:
        normals = mesh.normals(surface.vertices, surface.faces)
        length = mesh.lengths(normals)
        self._index = np.flatnonzero(length > 0.0)  # no ray hits a triangle without area
        self._corners = surface.vertices[surface.faces[self._index]]
        self._normals = normals[self._index] / length[self._index, None]
        self.engine = _resolve(engine)
        build = _embree if self.engine is Engine.EMBREE else _exact
        self._search = build(self._corners)

    def ranges(self, origins: Array, directions: Array) -> tuple[Array, Array, Hits]:
        """First intersections of rays.

        Args:
            origins: (n, 3), or (1, 3) where all rays have one origin [m].
            directions: (n, 3) unit vectors.

        Returns:
            Range (n,) [m] (inf: none), cosine (n,) of the angle of incidence, and face (n,) of the
            mesh (-1: none).
        """
        face = self._search(origins, directions)
        origins = np.broadcast_to(origins, directions.shape)
        hit = np.flatnonzero(face >= 0)
        normal = self._normals[face[hit]]
        cosine = dot(normal, directions[hit])
        ranges, cosines, faces = (
            np.full(len(face), np.inf),
            np.zeros(len(face)),
            np.full(len(face), -1),
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = dot(normal, self._corners[face[hit], 0] - origins[hit]) / cosine
        good = np.isfinite(depth) & (depth > 0.0)
        ranges[hit[good]], cosines[hit[good]] = depth[good], np.abs(cosine[good])
        faces[hit[good]] = self._index[face[hit[good]]]
        return ranges, cosines, faces


def _resolve(engine: Engine) -> Engine:
    present = importlib.util.find_spec("embreex") is not None
    if engine is Engine.EMBREE and not present:
        hint = "pip install embreex, or set scanner.engine to 'exact' (slower)"
        raise MissingBackend("embreex is not installed", where="scanner.engine", hint=hint)
    if engine is Engine.AUTO:
        return Engine.EMBREE if present else Engine.EXACT
    return engine


def _embree(corners: Array) -> Search:
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, corners.astype(np.float32))

    def search(origins: Array, directions: Array) -> Hits:
        if not len(origins):
            return np.empty(0, np.int64)
        starts = np.ascontiguousarray(np.broadcast_to(origins, directions.shape), np.float32)
        found = scene.run(starts, np.ascontiguousarray(directions, np.float32))
        return np.asarray(found, dtype=np.int64)

    return search


def _exact(corners: Array) -> Search:
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]

    def search(origins: Array, directions: Array) -> Hits:
        rows = max(1, CHUNK_PAIRS // max(1, len(a)))
        parts = [
            _nearest(
                origins[k : k + rows, None] if len(origins) > 1 else origins[None],
                directions[k : k + rows],
                a,
                e1,
                e2,
            )
            for k in range(0, len(directions), rows)
        ]
        return np.concatenate([np.empty(0, np.int64), *parts])

    return search


def _nearest(origins: Array, directions: Array, a: Array, e1: Array, e2: Array) -> Hits:
    """Index of the nearest triangle (m, corner a, edges e1, e2) hit by each ray, -1 where none.

    Moeller and Trumbore's test, its triple products permuted so that all but the direction is
    computed once where the rays share an origin: origins (n or 1, 1, 3), directions (n, 3).
    """
    s = origins - a
    q, rays = np.cross(s, e1), directions[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / dot(rays, np.cross(e2, e1))
        u, v, t = dot(rays, np.cross(e2, s)) * scale, dot(rays, q) * scale, dot(q, e2) * scale
        inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)
    t = np.where(inside, t, np.inf)
    best = np.argmin(t, axis=1)
    return np.where(np.isfinite(t[np.arange(len(t)), best]), best, -1)


def dot(u: Array, v: Array) -> Array:
    """Return the scalar products (...) of vectors (..., 3); numpy is slow along rows of three."""
    return np.asarray(u[..., 0] * v[..., 0] + u[..., 1] * v[..., 1] + u[..., 2] * v[..., 2])


class Preset(Enum):
    """Classes of instruments; their figures and sources are in presets.toml."""

    NONE = "none"
    FLASH_TOF = "flash_tof"
    FLASH_TOF_SMALL = "flash_tof_small"
    RASTER_TRIANGULATION = "raster_triangulation"
    LISSAJOUS_LIDAR = "lissajous_lidar"
    SPINNING_LIDAR = "spinning_lidar"


@dataclass(frozen=True, slots=True)
class ScannerParams(Settings):
    """The table [scanner]: rays, field of view and noise.

    The camera looks along +z of {A}, x to the right.
    """

    preset: Preset = setting(
        Preset.NONE,
        "Class of instrument, which sets the defaults of this table (docs/scenario.md, Scanner).",
    )
    pattern: Pattern = setting(
        Pattern.FLASH,
        "All rays at the stamp (flash), row by row (raster), along a Lissajous figure (lissajous),"
        " or column by column with all rays of a column at once (spinning); the last three over"
        " scan_s.",
    )
    fov_deg: tuple[float, float] = setting(
        (44.0, 44.0),
        "Full angles of the field of view, horizontal and vertical.",
        unit="deg",
        above=0.0,
        below=170.0,
    )
    view: FieldOfView = setting(
        FieldOfView.RECTANGLE,
        "Outline of the field of view: the rectangle, or the cone inscribed in it.",
    )
    rays: tuple[int, int] = setting(
        (128, 128), "Rays horizontally and vertically.", low=1, high=4096
    )
    lissajous: tuple[int, int] = setting(
        (73, 101),
        "Periods of the two mirrors in a Lissajous scan, horizontal and vertical.",
        low=1,
        high=4096,
    )
    scan_s: float = setting(
        0.0, "Duration of a scan that is not a flash; it begins at its stamp.", unit="s", low=0.0
    )
    divergence_mrad: float = setting(
        0.0,
        "Full angle of the beam; on an edge the returns of one beam merge into a mixed pixel.",
        unit="mrad",
        low=0.0,
        below=100.0,
    )
    merge_m: float = setting(
        math.inf,
        "Returns of a beam merge, weighted by intensity, if their ranges differ by less; else the"
        " strongest counts.",
        unit="m",
        low=0.0,
        infinite=True,
    )
    noise_m: float = setting(
        0.008,
        "1 sigma of the range, along the ray, at the reference range and normal incidence.",
        unit="m",
        low=0.0,
    )
    noise_growth: float = setting(
        0.0,
        "The 1 sigma of the range is proportional to the range to this power.",
        low=0.0,
        high=4.0,
    )
    noise_incidence: float = setting(
        0.0,
        "The 1 sigma of the range is proportional to 1 / cos(incidence) to this power.",
        low=0.0,
        high=4.0,
    )
    reference_m: float = setting(
        1.0, "Reference range of noise and intensity.", unit="m", above=0.0
    )
    quantisation_m: float = setting(
        0.0, "Ranges are rounded to multiples of this; 0: not rounded.", unit="m", low=0.0
    )
    intensity_min: float = setting(
        0.0,
        "Smallest intensity of a return, over that of a white diffuse surface at normal incidence"
        " and reference range.",
        low=0.0,
    )
    outlier_ratio: float = setting(
        0.02,
        "Share of the returns with a random range from range_min_m to range_max_m.",
        low=0.0,
        high=1.0,
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
    intensity: bool = setting(False, "Write the intensity of each return to the log.")
    returns: int = setting(
        1,
        "Largest number of returns of a beam, strongest first; more than 1 needs divergence and"
        " merge_m.",
        low=1,
        high=7,
    )
    range_walk_m: float = setting(
        0.0,
        "Amount by which the range is too long for each factor of ten that the intensity is"
        " below 1.",
        unit="m",
    )
    crosstalk_ratio: float = setting(
        0.0,
        "Share of the strongest return of a scan that is added to every return as stray light.",
        low=0.0,
        below=1.0,
    )
    saturation: float = setting(
        math.inf,
        "Intensity from which a return saturates the detector and blooms.",
        above=0.0,
        infinite=True,
    )
    bloom_deg: float = setting(
        0.0,
        "Rays within this angle of a saturated return give the range of that return.",
        unit="deg",
        low=0.0,
    )
    sun_a: tuple[float, float, float] | None = setting(
        None,
        "Unit vector to the sun in {A}; specular faces that mirror it return nothing.",
        unset="no sun",
    )
    engine: Engine = setting(
        Engine.AUTO, "Ray casting: embree, exact (numpy), or embree where it is installed (auto)."
    )

    def check(self) -> None:
        """Raise ValueError where the ranges, or pattern and duration, contradict each other."""
        if self.range_min_m >= self.range_max_m:
            raise ValueError(
                f"range_min_m = {self.range_min_m} must be below range_max_m = {self.range_max_m}"
            )
        if self.sun_a is not None and not is_unit(self.sun_a, 1e-6):
            raise ValueError(f"sun_a = {list(self.sun_a)} is not a unit vector")
        if (self.pattern is not Pattern.FLASH) != (self.scan_s > 0.0):
            raise ValueError(
                f"scan_s = {self.scan_s}: 0 for a flash, positive for any other pattern"
            )
