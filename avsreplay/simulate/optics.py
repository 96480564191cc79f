"""Optics of a scanner: reflectance of materials, intensity of returns, and beams of finite width.

The intensity is that of the return over the return of a white diffuse surface, perpendicular to the beam, at the
reference range r0 of the scanner:

    I = (rho_d cos(theta) + rho_s exp(-(theta / w)^2)) (r0 / r)^2

with the angle of incidence theta, the diffuse reflectance rho_d (Lambert's law), and a specular lobe of strength rho_s
and width w about the normal, since emitter and receiver are at one place. A beam of finite width is sampled by rays; on
an edge they meet surfaces at different ranges, whose returns merge into one range between them (a mixed pixel).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array
from avsreplay.records import Surface
from avsreplay.settings import Settings, setting

REFLECTANCE = 0.5  # diffuse reflectance where no material is given
_RING = 6  # rays of a beam around its centre
Corners = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Material(Settings):
    """One table [[material]]: the optical properties of a part of the target."""

    name: str = setting(doc="Name of the material.")
    box_m: Corners | None = setting(
        None,
        "The faces whose centre is within (xmin, ymin, zmin, xmax, ymax, zmax) in {C} have this material; of several"
        " materials the last applies.",
        unit="m",
        infinite=True,
        unset="all faces",
    )
    reflectance: float = setting(REFLECTANCE, "Diffuse reflectance.", low=0.0, high=1.0)
    specular: float = setting(0.0, "Strength of the specular lobe in units of a white diffuse surface.", low=0.0)
    specular_width_deg: float = setting(
        3.0, "Angle of incidence at which the specular lobe has fallen to 1/e.", unit="deg", above=0.0, below=90.0
    )
    dropout_ratio: float = setting(0.0, "Share of the returns that are lost.", low=0.0, high=1.0)


@dataclass(frozen=True, slots=True, eq=False)
class FaceOptics:
    """Optical properties of the faces of a surface, each (m,): diffuse, specular, width [rad], share of dropouts."""

    diffuse: Array
    specular: Array
    width_rad: Array
    dropouts: Array

    def intensity(self, faces: NDArray[np.int64], cosines: Array, ranges: Array, reference_m: float) -> Array:
        """Intensity (n,) of returns from these faces (n,), by cosine of incidence (n,) and range (n,) [m]."""
        angle = np.arccos(np.minimum(cosines, 1.0))
        lobe = self.specular[faces] * np.exp(-np.square(angle / self.width_rad[faces]))
        return np.asarray((self.diffuse[faces] * cosines + lobe) * np.square(reference_m / ranges))


def face_optics(surface: Surface, materials: Sequence[Material]) -> FaceOptics:
    """The optical properties of a surface's faces; those without a material have a diffuse reflectance of 0.5."""
    count = len(surface.faces)
    optics = FaceOptics(np.full(count, REFLECTANCE), np.zeros(count), np.full(count, 0.1), np.zeros(count))
    centres = surface.vertices[surface.faces].mean(axis=1)
    for material in materials:
        inside = np.ones(count, dtype=bool)
        if material.box_m is not None:
            inside = np.all((centres >= material.box_m[:3]) & (centres <= material.box_m[3:]), axis=1)
        optics.diffuse[inside] = material.reflectance
        optics.specular[inside] = material.specular
        optics.width_rad[inside] = math.radians(material.specular_width_deg)
        optics.dropouts[inside] = material.dropout_ratio
    return optics


@dataclass(frozen=True, slots=True, eq=False)
class TracedRays:
    """Rays cast on surfaces.

    Attributes:
        ranges: (n,) to the first surface [m], inf without one.
        returned: (n,) range of the return [m], inf without one.
        cosines: (n,) cosine of the angle of incidence.
        intensities: (n,) intensity of the return, 0 without one.
        dropouts: (n,) probability that the return is lost.
    """

    ranges: Array
    returned: Array
    cosines: Array
    intensities: Array
    dropouts: Array

    @classmethod
    def empty(cls, n: int) -> TracedRays:
        """Rays that meet nothing."""
        return cls(np.full(n, np.inf), np.full(n, np.inf), np.zeros(n), np.zeros(n), np.zeros(n))

    def nearer(self, other: TracedRays) -> TracedRays:
        """Ray by ray the nearer surface; it blocks the other one also where it gives no return."""
        other_first = other.ranges < self.ranges
        names = [field.name for field in fields(self)]
        return TracedRays(*(np.where(other_first, getattr(other, name), getattr(self, name)) for name in names))

    def chosen(self, index: NDArray[np.intp]) -> TracedRays:
        """Some of the rays."""
        return TracedRays(*(getattr(self, field.name)[index] for field in fields(self)))


def beam(directions: Array, divergence_rad: float) -> Array:
    """Rays (k, n, 3) that sample the beams about unit ``directions`` (n, 3); k is 1 without divergence.

    One ray in the centre and six on a ring, of equal weight; they have the second moments of a uniform cone of full
    angle ``divergence_rad``, whose radius is half of it: 6/7 ring^2 / 2 = radius^2 / 4.
    """
    if divergence_rad == 0.0:
        return directions[None]
    ring = 0.5 * divergence_rad * math.sqrt(7.0 / 12.0)
    side = np.cross(directions, np.where(np.abs(directions[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    side /= np.linalg.norm(side, axis=1)[:, None]
    other = np.cross(directions, side)
    rays = [directions]
    for k in range(_RING):
        angle = 2.0 * math.pi * k / _RING
        ray = directions + math.tan(ring) * (math.cos(angle) * side + math.sin(angle) * other)
        rays.append(ray / np.linalg.norm(ray, axis=1)[:, None])
    return np.stack(rays)


def merged(ranges: Array, intensities: Array, merge_m: float) -> tuple[Array, Array, Array]:
    """The return of each beam from those of its rays.

    Args:
        ranges: (k, n) range of each ray [m], inf without a return.
        intensities: (k, n) its intensity, 0 without a return.
        merge_m: Returns within this distance of the strongest one merge with it.

    Returns:
        Range (n,) [m], the mean weighted by intensity; intensity (n,), averaged over the rays; weights (k, n) of the
        rays, which sum to 1, or to 0 where nothing returns.
    """
    strongest = np.argmax(intensities, axis=0)
    anchor = np.take_along_axis(ranges, strongest[None], axis=0)
    with np.errstate(invalid="ignore"):
        taking_part = (np.abs(ranges - anchor) <= merge_m) & np.isfinite(ranges)
    weights = np.where(taking_part, intensities, 0.0)
    total = weights.sum(axis=0)
    weights = weights / np.where(total > 0.0, total, 1.0)
    mean = (np.where(taking_part, ranges, 0.0) * weights).sum(axis=0)
    return np.where(total > 0.0, mean, np.inf), total / len(ranges), weights
