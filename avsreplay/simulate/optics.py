"""Optics of a scanner: reflectance of materials, intensity of returns, and beams of finite width.

The intensity is that of the return over the return of a white diffuse surface, perpendicular to the
beam, at the reference range r0 of the scanner:

    I = (rho_d cos(theta) + rho_s exp(-(theta / w)^2)) (r0 / r)^2

with the angle of incidence theta, the diffuse reflectance rho_d (Lambert's law), and a specular
lobe of strength rho_s and width w about the normal, since emitter and receiver are at one place. A
beam of finite width is sampled by rays; on an edge they meet surfaces at different ranges, whose
returns merge into one range between them (a mixed pixel).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from avsreplay import mesh
from avsreplay.errors import UsageError, value_class
from avsreplay.geometry import Array
from avsreplay.records import Surface
from avsreplay.settings import Settings, setting

DEFAULT_REFLECTANCE = 0.5  # diffuse reflectance where no material is given
_BEAM_RING_RAYS = 6  # rays of a beam around its centre
Corners = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Material(Settings):
    """One table [[material]]: the optical properties of a part of the target."""

    name: str = setting(doc="Name of the material.")
    box_m: Corners | None = setting(
        None,
        "The faces whose centre is within (xmin, ymin, zmin, xmax, ymax, zmax) in {C} have this"
        " material; of several materials the last applies.",
        unit="m",
        infinite=True,
        unset="all faces",
    )
    group: str = setting(
        "",
        "The faces of this group (g), object (o) or material (usemtl) of an OBJ model; empty: of"
        " any.",
    )
    reflectance: float = setting(DEFAULT_REFLECTANCE, "Diffuse reflectance.", low=0.0, high=1.0)
    specular: float = setting(
        0.0, "Strength of the specular lobe in units of a white diffuse surface.", low=0.0
    )
    specular_width_deg: float = setting(
        3.0,
        "Angle of incidence at which the specular lobe has fallen to 1/e.",
        unit="deg",
        above=0.0,
        below=90.0,
    )
    dropout_ratio: float = setting(0.0, "Share of the returns that are lost.", low=0.0, high=1.0)
    retroreflectance: float = setting(
        0.0,
        "Intensity of a retro-reflector, at any incidence, in units of a white diffuse surface.",
        low=0.0,
    )


@value_class
class FaceOptics:
    """Optical properties of the faces of a surface, each (m,).

    Attributes:
        diffuse, specular, retro: reflectances.
        width_rad: of the specular lobe.
        dropouts: share of the returns.
        normals: (m, 3) unit normals.
    """

    diffuse: Array
    specular: Array
    width_rad: Array
    dropouts: Array
    retro: Array
    normals: Array

    def part(self, faces: NDArray[np.intp]) -> FaceOptics:
        """Return the properties of some of the faces."""
        return FaceOptics(*(getattr(self, field.name)[faces] for field in fields(self)))

    def intensity(
        self, faces: NDArray[np.int64], cosines: Array, ranges: Array, reference_m: float
    ) -> Array:
        """Intensity (n,) of returns from these faces (n,), by cosine of incidence (n,) and range
        (n,) [m].

        Args:
            faces: number of the face of each return (n,).
            cosines: cosine of incidence (n,).
            ranges: (n,) [m].
            reference_m: range at which the intensity is the reflectance [m].
        """
        angle = np.arccos(np.minimum(cosines, 1.0))
        lobe = self.specular[faces] * np.exp(-np.square(angle / self.width_rad[faces]))
        reflected = self.diffuse[faces] * cosines + lobe + self.retro[faces]
        return np.asarray(reflected * np.square(reference_m / ranges))

    def glint(self, faces: NDArray[np.int64], directions: Array, sun: Array) -> NDArray[np.bool_]:
        """Whether faces mirror the sun into the camera.

        Args:
            faces: (n,) of the returns.
            directions: (n, 3) unit directions of the rays in the frame of the surface.
            sun: (n, 3) unit vectors to the sun in the same frame.
        """
        n = self.normals[faces]
        mirrored = directions - 2.0 * np.einsum("ni,ni->n", directions, n)[:, None] * n
        cosine = np.einsum("ni,ni->n", mirrored, sun)
        angle = 0.5 * np.arccos(
            np.clip(cosine, -1.0, 1.0)
        )  # cosine of the angle between the normal and the bisector
        return np.asarray((self.specular[faces] > 0.0) & (angle < self.width_rad[faces]))


def face_optics(surface: Surface, materials: Sequence[Material]) -> FaceOptics:
    """The optical properties of a surface's faces; those without a material have a diffuse
    reflectance of 0.5.

    Args:
        surface: vertices and faces.
        materials: what applies to which faces; a later one takes precedence.

    Raises:
        UsageError: a material names a group that the model does not have.
    """
    count = len(surface.faces)
    zero = np.zeros(count)
    normals = mesh.normals(surface.vertices, surface.faces)
    normals /= np.maximum(mesh.lengths(normals), 1e-300)[:, None]
    optics = FaceOptics(
        np.full(count, DEFAULT_REFLECTANCE),
        zero.copy(),
        np.full(count, 0.1),
        zero.copy(),
        zero.copy(),
        normals,
    )
    groups = face_groups(surface) if any(material.group for material in materials) else []
    for material in materials:
        inside = np.ones(count, dtype=bool)
        if material.box_m is not None:
            centres = surface.vertices[surface.faces].mean(axis=1)
            inside = np.all(
                (centres >= material.box_m[:3]) & (centres <= material.box_m[3:]), axis=1
            )
        if material.group:
            named = np.array([material.group in names for names in groups], dtype=bool)
            if not named.any():
                there = (
                    ", ".join(sorted({name for names in groups for name in names})[:20]) or "none"
                )
                hint = f"groups of the model: {there}"
                raise UsageError(
                    f"no group '{material.group}' in the model", where="material.group", hint=hint
                )
            inside &= named
        optics.diffuse[inside] = material.reflectance
        optics.retro[inside] = material.retroreflectance
        optics.specular[inside] = material.specular
        optics.width_rad[inside] = math.radians(material.specular_width_deg)
        optics.dropouts[inside] = material.dropout_ratio
    return optics


def face_groups(surface: Surface) -> list[frozenset[str]]:
    """The names of group, object and material of every face of an OBJ model; empty sets for any
    other format.

    Args:
        surface: the model with the bytes of its file. Its faces are found by their centres, because
            a reader merges vertices and drops faces without area.
    """
    vertices: list[list[float]] = []
    centres: list[Array] = []
    names: list[frozenset[str]] = []
    now: dict[str, frozenset[str]] = {}
    if surface.name.lower().endswith(".obj"):
        for line in surface.data.decode("utf-8", "replace").splitlines():
            word, _, rest = line.strip().partition(" ")
            if word == "v":
                vertices.append([float(x) for x in rest.split()[:3]])
            elif word in ("g", "o", "usemtl"):
                now[word] = frozenset(rest.split())
            elif word == "f":
                index = [int(part.split("/")[0]) for part in rest.split()]
                corners = np.array([vertices[i - 1 if i > 0 else i] for i in index])
                for k in range(1, len(corners) - 1):  # the triangles of a polygon
                    centres.append(corners[[0, k, k + 1]].mean(axis=0))
                    names.append(frozenset().union(*now.values()))
    if not centres:
        return [frozenset()] * len(surface.faces)
    from scipy.spatial import cKDTree  # takes 0.2 s to import

    _, nearest = cKDTree(np.array(centres)).query(surface.vertices[surface.faces].mean(axis=1))
    return [names[int(k)] for k in np.asarray(nearest)]


@value_class
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
        """Return ``n`` rays that meet nothing."""
        return cls(np.full(n, np.inf), np.full(n, np.inf), np.zeros(n), np.zeros(n), np.zeros(n))

    def nearer(self, other: TracedRays) -> TracedRays:
        """Return for each ray the nearer surface; it blocks the other one also where it gives no
        return.
        """
        other_first = other.ranges < self.ranges
        names = [field.name for field in fields(self)]
        return TracedRays(
            *(np.where(other_first, getattr(other, name), getattr(self, name)) for name in names)
        )

    def chosen(self, index: NDArray[np.intp]) -> TracedRays:
        """Return some of the rays.

        Args:
            index: their numbers (k,).
        """
        return TracedRays(*(getattr(self, field.name)[index] for field in fields(self)))


def beam(directions: Array, divergence_rad: float) -> Array:
    """Rays (k, n, 3) that sample the beams about unit ``directions`` (n, 3); k is 1 without
    divergence.

    One ray in the centre and six on a ring, of equal weight; they have the second moments of a
    uniform cone of full angle ``divergence_rad``, whose radius is half of it: 6/7 ring^2 / 2 =
    radius^2 / 4.
    """
    if divergence_rad == 0.0:
        return directions[None]
    ring = 0.5 * divergence_rad * math.sqrt(7.0 / 12.0)
    side = np.cross(
        directions, np.where(np.abs(directions[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    )
    side /= np.linalg.norm(side, axis=1)[:, None]
    other = np.cross(directions, side)
    rays = [directions]
    for k in range(_BEAM_RING_RAYS):
        angle = 2.0 * math.pi * k / _BEAM_RING_RAYS
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
        Range (n,) [m], the mean weighted by intensity; intensity (n,), averaged over the rays;
        weights (k, n) of the rays, which sum to 1, or to 0 where nothing returns.
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


def kept_returns(
    ranges: Array, intensities: Array, merge_m: float, returns: int
) -> list[tuple[Array, Array, Array]]:
    """The strongest returns of each beam, as of ``merged``; each ray takes part in one return at
    most.

    Args:
        ranges: (k, n) range of each ray [m], inf without a return.
        intensities: (k, n) its intensity, 0 without a return.
        merge_m: returns within this distance of a stronger one merge with it.
        returns: most returns of a beam.
    """
    found = []
    for _ in range(returns):
        mean, intensity, weights = merged(ranges, intensities, merge_m)
        found.append((mean, intensity, weights))
        taken = weights > 0.0
        ranges, intensities = np.where(taken, np.inf, ranges), np.where(taken, 0.0, intensities)
    return found


def crosstalk(ranges: Array, intensities: Array, ratio: float) -> Array:
    """Ranges (n,) with stray light: a share of the strongest return is added to every return.

    The sum of two returns of a continuous-wave instrument has, to first order in their difference,
    the mean of their ranges weighted by intensity.

    Args:
        ranges: (n,) [m].
        intensities: (n,) of the returns.
        ratio: share of the strongest return that is added to every return.
    """
    if not len(ranges):
        return ranges
    strongest = int(np.argmax(intensities))
    stray = ratio * intensities[strongest]
    return np.asarray((intensities * ranges + stray * ranges[strongest]) / (intensities + stray))


def bloomed(
    rays: Array, saturated: Array, angle_rad: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rays within an angle of a saturated return.

    Args:
        rays: (n, 3) unit directions.
        saturated: (m, 3) unit directions of the saturated returns.
        angle_rad: radius of the bloom.

    Returns:
        Index of each such ray, and index of the nearest saturated return.
    """
    if not len(saturated):
        none = np.zeros(0, dtype=np.intp)
        return none, none
    from scipy.spatial import cKDTree  # takes 0.2 s to import

    chord, nearest = cKDTree(saturated).query(rays)
    ray = np.flatnonzero(chord <= 2.0 * math.sin(0.5 * angle_rad))
    return ray, np.asarray(nearest)[ray]


def part_of(surface: Surface, faces: NDArray[np.intp]) -> Surface:
    """Return the mesh with some of its faces only.

    Args:
        surface: the mesh.
        faces: numbers (k,) of the faces.
    """
    return (
        surface
        if len(faces) == len(surface.faces)
        else replace(surface, faces=surface.faces[faces])
    )
