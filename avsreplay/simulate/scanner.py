"""The scanner: beams from the camera, cast on the moving target, with noise.

A flash scanner measures all beams at once. Any other scanner measures them one after the other, or
column by column, while the target moves: each beam is cast on the target at its pose at the time of
that beam.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array, frozen, rotate
from avsreplay.records import Surface
from avsreplay.simulate.motion import Motion
from avsreplay.simulate.optics import (
    FaceOptics,
    Material,
    TracedRays,
    beam,
    bloomed,
    crosstalk,
    face_optics,
    kept_returns,
    part_of,
)
from avsreplay.simulate.rays import Engine, Pattern, RayCaster, ScannerParams, dot, ray_grid
from avsreplay.simulate.scene import (
    Appendage,
    Limb,
    MovingCamera,
    Plume,
    SceneBody,
    appendage_faces,
)


@value_class
class Returns:
    """The returns of a scan.

    Attributes:
        directions: (n, 3) unit vectors in {A}.
        ranges: (n,) [m].
        times_s: (n,) after the stamp [s].
        cosines: (n,) cosine of the angle of incidence.
        intensities: (n,) intensity, 1 for a white diffuse surface at normal incidence and reference
            range.
        dropouts: (n,) probability that the return is lost.
    """

    directions: Array
    ranges: Array
    times_s: Array
    cosines: Array
    intensities: Array
    dropouts: Array

    def keep(self, chosen: NDArray[Any]) -> Returns:
        """Return the returns that a mask (n,) or indices select.

        Args:
            chosen: mask (n,) or numbers (k,).
        """
        index = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
        return Returns(*(getattr(self, field.name).take(index, axis=0) for field in fields(self)))

    def joined(self, other: Returns) -> Returns:
        """Return these returns, followed by the others."""
        names = [field.name for field in fields(self)]
        return Returns(
            *(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names)
        )

    def in_order(self) -> Returns:
        """Return the returns ordered by time; the order of equal times is kept."""
        return self.keep(np.argsort(self.times_s, kind="stable"))

    @property
    def points(self) -> NDArray[np.float32]:
        """Return the points (n, 3) in {A} as float32 [m]."""
        return (self.directions * self.ranges[:, None]).astype(np.float32)


class Scanner:
    """A scanner that observes one target.

    Attributes:
        params: Its parameters.
        motion: Of the target.
        centre_c: (3,) centre of the target's bounding sphere in {C} [m].
        radius_m: Its radius [m].
        rays: Unit directions (k, n, 3) of k rays of each beam in the frame of the scanner; the
            first is its centre.
        times_s: (n,) when each ray is measured after the stamp [s].
    """

    def __init__(
        self,
        params: ScannerParams,
        surface: Surface,
        motion: Motion,
        materials: Sequence[Material] = (),
        appendages: Sequence[Appendage] = (),
        camera: MovingCamera | None = None,
    ) -> None:
        self.params = p = params
        self.motion, self._camera = motion, camera
        optics, owner = face_optics(surface, materials), appendage_faces(surface, appendages)
        rigid = np.flatnonzero(owner < 0)
        self._caster = RayCaster(part_of(surface, rigid), params.engine)
        self._optics = optics.part(rigid)
        self._flexible = [
            (each, RayCaster(part_of(surface, faces), params.engine), optics.part(faces))
            for k, each in enumerate(appendages)
            for faces in [np.flatnonzero(owner == k)]
        ]
        directions, self.times_s = ray_grid(
            p.pattern, p.view, p.fov_deg, p.rays, p.lissajous, p.scan_s
        )
        self.rays = beam(directions, 1e-3 * params.divergence_mrad)
        low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
        self.centre_c = frozen(0.5 * (low + high))
        reach = [float(np.max(np.linalg.norm(surface.vertices - self.centre_c, axis=1)))]
        for each in appendages:  # for any angle of its hinge
            hinge = np.array(each.hinge_m)
            reach.append(
                np.linalg.norm(hinge - self.centre_c)
                + np.linalg.norm(surface.vertices - hinge, axis=1).max()
            )
        self.radius_m, self._reach_m = reach[0], float(np.max(reach))

    @property
    def engine(self) -> Engine:
        """The engine that casts the rays."""
        return self._caster.engine

    def cast(
        self,
        t_s: float,
        bodies: Sequence[SceneBody] = (),
        plumes: Sequence[tuple[Plume, np.random.Generator]] = (),
        limbs: Sequence[tuple[Limb, np.random.Generator]] = (),
    ) -> Returns:
        """Return the returns of a scan without noise; beams without a return are left out.

        Args:
            t_s: time of the scan [s].
            bodies: objects beside the target that are present.
            plumes: plumes that are present, each with the generator of its particles.
            limbs: the sunlit Earth where it is present, with the generator of its false returns.
        """
        times = np.array([t_s]) if self.params.pattern is Pattern.FLASH else t_s + self.times_s
        target = self.motion.poses(times)
        poses = self._seen(target, times)
        near = self._may_hit(*poses)
        found = [self._traced(self._caster, self._optics, poses, rays, near) for rays in self.rays]
        for each, caster, optics in self._flexible:
            placed = self._seen(each.placed(target, times), times)
            for k, rays in enumerate(self.rays):
                found[k] = found[k].nearer(self._traced(caster, optics, placed, rays, near))
        every = np.arange(len(self.times_s))
        for body in bodies:
            placed = self._seen(body.params.poses(times), times)
            for k, rays in enumerate(self.rays):
                found[k] = found[k].nearer(
                    self._traced(body.caster, body.optics, placed, rays, every)
                )
        for plume, rng in plumes:
            for k, rays in enumerate(self.rays):
                found[k] = found[k].nearer(self._particles(plume, found[k], rays, rng))
        if bodies or plumes or self.params.bloom_deg > 0.0:
            near = every
        returns = self._beams([each.chosen(near) for each in found], near)
        returns = returns.keep(
            np.isfinite(returns.ranges) & (returns.intensities >= self.params.intensity_min)
        )
        for limb, rng in limbs:
            free = np.all([np.isinf(each.ranges) for each in found], axis=0) & self._behind(
                limb, times
            )
            returns = returns.joined(self._false(np.flatnonzero(free), limb.false_ratio, rng))
        return self._stray(returns)

    def glare(self, t_s: float, limbs: Sequence[Limb]) -> float:
        """Factor on the 1 sigma of the ranges by stray light of the Earth at a time [s].

        The variance grows in proportion to the share of the beams that look at it.

        Args:
            t_s: time [s after the first scan].
            limbs: the limbs of the Earth.
        """
        times = np.array([t_s])
        return math.sqrt(
            1.0
            + sum((limb.glare**2 - 1.0) * float(self._behind(limb, times).mean()) for limb in limbs)
        )

    def _behind(self, limb: Limb, times: Array) -> NDArray[np.bool_]:
        """Whether each beam looks at the Earth."""
        R_wa = np.eye(3)[None] if self._camera is None else self._camera.poses(times)[0]
        return limb.behind(self.rays[0], times, R_wa)

    def _false(self, beams: NDArray[np.intp], ratio: float, rng: np.random.Generator) -> Returns:
        """False returns of some of these beams (n,), with the least intensity at any range."""
        p = self.params
        beams = beams[rng.random(len(beams)) < ratio]
        n = len(beams)
        ranges, least = rng.uniform(p.range_min_m, p.range_max_m, n), np.full(n, p.intensity_min)
        return Returns(
            self.rays[0][beams], ranges, self.times_s[beams], np.ones(n), least, np.zeros(n)
        )

    def _particles(
        self, plume: Plume, met: TracedRays, rays: Array, rng: np.random.Generator
    ) -> TracedRays:
        """Rays (n, 3) on the particles of a plume that lie in front of the surfaces."""
        p = self.params
        ranges = plume.particles(rays, np.minimum(met.ranges, p.range_max_m), rng)
        seen = np.isfinite(ranges) & (ranges >= p.range_min_m)
        found = TracedRays.empty(len(rays))
        found.ranges[:], found.cosines[seen] = ranges, 1.0
        found.returned[seen] = ranges[seen]
        found.intensities[seen] = plume.reflectance * np.square(p.reference_m / ranges[seen])
        return found

    def _stray(self, returns: Returns) -> Returns:
        """Returns with stray light of the strongest one, and with the bloom of saturated ones."""
        p = self.params
        if p.crosstalk_ratio > 0.0:
            returns = replace(
                returns, ranges=crosstalk(returns.ranges, returns.intensities, p.crosstalk_ratio)
            )
        if p.bloom_deg > 0.0:
            strong = returns.keep(returns.intensities >= p.saturation)
            ray, source = bloomed(self.rays[0], strong.directions, math.radians(p.bloom_deg))
            if len(ray):
                from scipy.spatial import cKDTree  # takes 0.2 s to import

                inside = np.asarray(cKDTree(self.rays[0][ray]).query(returns.directions)[0]) < 1e-9
                bloom = replace(
                    strong.keep(source), directions=self.rays[0][ray], times_s=self.times_s[ray]
                )
                returns = returns.keep(~inside).joined(bloom)
        return returns

    def _seen(self, poses: tuple[Array, Array], times_s: Array) -> tuple[Array, Array]:
        """Poses (n, 3, 3), (n, 3) in the fixed frame seen from the moving camera."""
        if self._camera is None:
            return poses
        R_wa, t_wa = self._camera.poses(times_s)
        back = np.swapaxes(R_wa, -1, -2)
        return back @ poses[0], rotate(back, poses[1] - t_wa)

    def _beams(self, rays: list[TracedRays], near: NDArray[np.intp]) -> Returns:
        """The returns of beams from those of their rays."""
        ranges, intensities = (
            np.stack([r.returned for r in rays]),
            np.stack([r.intensities for r in rays]),
        )
        if len(rays) == 1:
            groups = [(ranges[0], intensities[0], np.ones((1, len(near))))]
        else:
            groups = kept_returns(ranges, intensities, self.params.merge_m, self.params.returns)
        found = None
        directions = self.rays[0].take(near, axis=0)
        for mean, intensity, weights in groups:
            cosines = (weights * np.stack([r.cosines for r in rays])).sum(axis=0)
            dropouts = (weights * np.stack([r.dropouts for r in rays])).sum(axis=0)
            each = Returns(directions, mean, self.times_s[near], cosines, intensity, dropouts)
            found = each if found is None else found.joined(each.keep(np.isfinite(mean)))
        assert found is not None
        return found

    def _traced(
        self,
        caster: RayCaster,
        optics: FaceOptics,
        poses: tuple[Array, Array],
        rays: Array,
        near: NDArray[np.intp],
    ) -> TracedRays:
        """Rays (n, 3) in {A} on one surface with these poses; only those in ``near`` are cast."""
        R, t = poses
        R_inverse = np.swapaxes(R[near] if len(R) > 1 else R, -1, -2)
        origins = rotate(R_inverse, -(t[near] if len(t) > 1 else t))
        p = self.params
        directions = rotate(R_inverse, rays.take(near, axis=0))
        ranges, cosines, faces = caster.ranges(origins, directions)
        seen = (ranges >= p.range_min_m) & (ranges <= p.range_max_m)
        seen &= cosines >= math.cos(math.radians(p.max_incidence_deg))
        traced = TracedRays.empty(len(rays))
        traced.ranges[near], traced.cosines[near] = ranges, cosines
        if p.sun_a is not None:
            sun = np.broadcast_to(rotate(R_inverse, np.array(p.sun_a)), (len(near), 3))
            seen &= ~optics.glint(np.maximum(faces, 0), directions, sun)
        back = near[seen]
        traced.returned[back] = ranges[seen]
        traced.intensities[back] = optics.intensity(
            faces[seen], cosines[seen], ranges[seen], p.reference_m
        )
        traced.dropouts[back] = optics.dropouts[faces[seen]]
        return traced

    def disturb(
        self, returns: Returns, rng: np.random.Generator, noise_factor: float = 1.0
    ) -> Returns:
        """Add range noise and outliers, remove dropouts, and quantise the ranges.

        Args:
            returns: the returns without errors.
            rng: generator of the random numbers.
            noise_factor: factor of the 1 sigma of the ranges.
        """
        p, n = self.params, len(returns.ranges)
        noise_m = noise_factor * p.noise_m * np.ones(n)
        if p.noise_growth > 0.0:
            noise_m *= (returns.ranges / p.reference_m) ** p.noise_growth
        if p.noise_incidence > 0.0:
            noise_m /= np.maximum(returns.cosines, 0.01) ** p.noise_incidence
        ranges = returns.ranges + noise_m * rng.standard_normal(n)
        if p.range_walk_m != 0.0:
            ranges = ranges - p.range_walk_m * np.log10(np.maximum(returns.intensities, 1e-6))
        wrong = rng.random(n) < p.outlier_ratio
        ranges = np.where(wrong, rng.uniform(p.range_min_m, p.range_max_m, n), ranges)
        lost = np.where(
            returns.dropouts > 0.0,
            1.0 - (1.0 - p.dropout_ratio) * (1.0 - returns.dropouts),
            p.dropout_ratio,
        )
        kept = rng.random(n) >= lost
        if p.quantisation_m > 0.0:
            ranges = np.round(ranges / p.quantisation_m) * p.quantisation_m
        return replace(returns, ranges=ranges).keep(kept & (ranges > 0.0))

    def _may_hit(self, R_ac: Array, t_ac: Array) -> NDArray[np.intp]:
        """The rays that pass through the bounding sphere of the target."""
        centre = rotate(R_ac, self.centre_c) + t_ac
        along = dot(self.rays[0], centre)
        aside = dot(centre, centre) - along * along
        spread = 1e-3 * self.params.divergence_mrad * np.maximum(along, 0.0)
        return np.flatnonzero(aside <= (1.001 * self._reach_m + spread) ** 2)
