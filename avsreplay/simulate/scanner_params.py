"""The table [scanner] of a scenario."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from avsreplay.settings import Settings, is_unit, setting
from avsreplay.simulate.rays import Engine, FieldOfView, Pattern


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
    """The table [scanner]: rays, field of view and noise. The camera looks along +z of {A}, x to the right."""

    preset: Preset = setting(
        Preset.NONE, "Class of instrument, which sets the defaults of this table (docs/scenario.md, Scanner)."
    )
    pattern: Pattern = setting(
        Pattern.FLASH,
        "All rays at the stamp (flash), row by row (raster), along a Lissajous figure (lissajous), or column by column"
        " with all rays of a column at once (spinning); the last three over scan_s.",
    )
    fov_deg: tuple[float, float] = setting(
        (44.0, 44.0), "Full angles of the field of view, horizontal and vertical.", unit="deg", above=0.0, below=170.0
    )
    view: FieldOfView = setting(
        FieldOfView.RECTANGLE, "Outline of the field of view: the rectangle, or the cone inscribed in it."
    )
    rays: tuple[int, int] = setting((128, 128), "Rays horizontally and vertically.", low=1, high=4096)
    lissajous: tuple[int, int] = setting(
        (73, 101), "Periods of the two mirrors in a Lissajous scan, horizontal and vertical.", low=1, high=4096
    )
    scan_s: float = setting(0.0, "Duration of a scan that is not a flash; it begins at its stamp.", unit="s", low=0.0)
    divergence_mrad: float = setting(
        0.0,
        "Full angle of the beam; on an edge the returns of one beam merge into a mixed pixel.",
        unit="mrad",
        low=0.0,
        below=100.0,
    )
    merge_m: float = setting(
        math.inf,
        "Returns of one beam that differ by less in range merge, weighted by intensity; else the strongest counts.",
        unit="m",
        low=0.0,
        infinite=True,
    )
    noise_m: float = setting(
        0.008, "1 sigma of the range, along the ray, at the reference range and normal incidence.", unit="m", low=0.0
    )
    noise_growth: float = setting(
        0.0, "The 1 sigma of the range is proportional to the range to this power.", low=0.0, high=4.0
    )
    noise_incidence: float = setting(
        0.0, "The 1 sigma of the range is proportional to 1 / cos(incidence) to this power.", low=0.0, high=4.0
    )
    reference_m: float = setting(1.0, "Reference range of noise and intensity.", unit="m", above=0.0)
    quantisation_m: float = setting(0.0, "Ranges are rounded to multiples of this; 0: not rounded.", unit="m", low=0.0)
    intensity_min: float = setting(
        0.0,
        "Smallest intensity of a return, over that of a white diffuse surface at normal incidence and reference range.",
        low=0.0,
    )
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
    intensity: bool = setting(False, "Write the intensity of each return to the log.")
    returns: int = setting(
        1, "Most returns of one beam, strongest first; more than one needs a divergence and merge_m.", low=1, high=7
    )
    range_walk_m: float = setting(
        0.0, "Error of the range by which it grows for each factor of ten that the intensity is below 1.", unit="m"
    )
    crosstalk_ratio: float = setting(
        0.0, "Share of the strongest return of a scan that is added to every return as stray light.", low=0.0, below=1.0
    )
    saturation: float = setting(
        math.inf, "Intensity from which a return saturates the detector and blooms.", above=0.0, infinite=True
    )
    bloom_deg: float = setting(
        0.0, "Rays within this angle of a saturated return give its range instead of their own.", unit="deg", low=0.0
    )
    sun_a: tuple[float, float, float] | None = setting(
        None, "Unit vector to the sun in {A}; specular faces that mirror it return nothing.", unset="no sun"
    )
    engine: Engine = setting(Engine.AUTO, "Ray casting: embree, exact (numpy), or embree where it is installed (auto).")

    def check(self) -> None:
        """Raise ValueError where the ranges, or pattern and duration, do not go together."""
        if self.range_min_m >= self.range_max_m:
            raise ValueError(f"range_min_m = {self.range_min_m} must be below range_max_m = {self.range_max_m}")
        if self.sun_a is not None and not is_unit(self.sun_a, 1e-6):
            raise ValueError(f"sun_a = {list(self.sun_a)} is not a unit vector")
        if (self.pattern is not Pattern.FLASH) != (self.scan_s > 0.0):
            raise ValueError(f"scan_s = {self.scan_s}: 0 for a flash, positive for any other pattern")
