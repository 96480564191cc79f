"""The bias that the noise of a scan causes in its registered pose.

The closest point is a nonlinear function of the measured one: noise near edges, thin parts and curved faces moves the
pose in the same way in every scan of a view. The residuals do not show this; the pose of simulated scans with noise of
the same size shows it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.register.backend import HornBackend, Target
from avsreplay.register.budget import BIAS_WORK, Budget
from avsreplay.register.covariance import noise_along
from avsreplay.register.plausibility import robust_noise
from avsreplay.register.restarts import Restarter
from avsreplay.register.surface_index import SurfaceIndex

BIAS_POINTS = 1000  # points of the simulated scan that gives the bias of the noise
FACE_OF_EXTENT = 1e-4  # a point where a ray meets the model is at most so far from the face
LEAST_FOR_BIAS = 30  # with fewer rays that meet the model no scan is simulated
UNCERTAIN_CHI2 = 4.0  # 6 unknowns less 2: the part of an estimated bias that chance explains
CREDIBLE = 3.0  # standard deviations beyond which a point is not one of the model with noise
BIAS_ROUNDS, SMALL_STEP = 2, 0.1  # simulations of a scan; chi-square of the step of the true pose that ends them


class NoiseBias:
    """Simulated scans of one target."""

    def __init__(self, target: Target, restarter: Restarter) -> None:
        self._target, self._restarter, self._horn = target, restarter, HornBackend(target)

    def bias(self, few: NDArray[Any], T_ca: Pose, P: Array, budget: Budget) -> tuple[Array, bool]:
        """The mean error (6,) of a pose that the noise of its scan causes; whether the ranges fit better without it.

        Sought is the true pose for which simulated scans are registered at this pose (indirect inference, as in
        ``size.py``). A simulated scan has the points at which the rays meet the model at the true pose of the last
        round, with normal noise along the rays, of both signs, so that what is linear in it cancels. The step of a
        registration of these points from this pose corrects the true pose. The rounds end with a small step.

        Args:
            few: (n, 3) in {A} [m], part of the scan.
            T_ca: registered pose.
            P: (6, 6) its covariance.
            budget: of the scan; it need not suffice for the second round.

        Returns:
            d = [theta; v] in {C}, T_ac_true = T_ac Exp(d); zero with fewer than 30 rays that meet the model. The ranges
            are not compared where chance explains d, or no work is left.
        """
        target, d = self._target, np.zeros(6)
        width = self._restarter.width(self._restarter.measure(few, T_ca, budget))
        camera_c = target.visibility.camera_c(target.index, few, T_ca)
        p, back, true = T_ca.apply(few), T_ca.inverse(), Pose.identity()
        first = at = _Noiseless.of(target.index, p, camera_c)
        budget.spend(at.work)
        for k in range(BIAS_ROUNDS):
            if len(at.points) < LEAST_FOR_BIAS:
                return np.zeros(6), False
            noise = noise_along(at.rays, at.rays, np.full(len(at.rays), at.noise_m), np.ones(len(at.rays)))
            moved = noise[:, None] * at.rays
            simulated = back.apply(true.apply(np.concatenate([at.points + moved, at.points - moved])))
            fit = self._horn.align_within(simulated, T_ca, width, near=True, most=1)
            budget.spend(fit.work)
            step = fit.T_ca @ back
            true = step @ true
            d, last = (np.concatenate([geometry.log(each.q), each.t]) for each in (true, step))
            more = budget.allows_at_the_end(BIAS_WORK)
            if not more or k + 1 == BIAS_ROUNDS or last @ np.linalg.solve(P, last) < SMALL_STEP:
                break
            at = first.moved(true.inverse())
        if not more or d @ np.linalg.solve(P, d) <= UNCERTAIN_CHI2:
            return d, False
        back = true.inverse()
        at = _Noiseless.of(target.index, back.apply(p), None if camera_c is None else back.apply(camera_c))
        budget.spend(at.work)
        return d, at.cost(first.noise_m) < first.cost(first.noise_m)


@value_class
class _Noiseless:
    """The points of a scan as they would be without noise, at one pose.

    Attributes:
        measured: (n, 3) the points of the scan in {C} [m].  camera_c: (3,) position of the camera, or None.
        on, normal: (n, 3) where the rays meet the model [m], NaN: nowhere, and the normals of the faces there; without
            a camera the closest points.
        points, rays: (k, 3) those of ``on`` that are not farther than three sigma from the measured point, and their
            unit directions; without a camera the normals.
        off: (n,) distance of each measured point from there [m], infinite where there is none.
        noise_m: robust standard deviation of these distances.  work: in point searches.
    """

    measured: Array
    camera_c: Array | None
    on: Array
    normal: Array
    points: Array
    rays: Array
    off: Array
    noise_m: float
    work: int

    @classmethod
    def of(cls, index: SurfaceIndex, p: Array, camera_c: Array | None) -> _Noiseless:
        """Look at points p (n, 3) in {C} with the camera (3,)."""
        if camera_c is None:
            found = index.closest(p)
            return cls._seen(p, camera_c, found.foot, found.normal, len(p))
        rays = _directions(p - camera_c)
        ranges, work = index.cast(camera_c, rays)
        met = np.isfinite(ranges)
        on = camera_c + np.where(met, ranges, np.nan)[:, None] * rays
        normal = index.closest(on, camera_c=camera_c, most_m=FACE_OF_EXTENT * index.extent_m).normal
        return cls._seen(p, camera_c, on, normal, work + len(p))

    def moved(self, T: Pose) -> _Noiseless:
        """Return the same for measured points and a camera that are moved by T, on the planes of the same faces."""
        p, n = T.apply(self.measured), self.normal
        if self.camera_c is None:
            return self._seen(p, None, p - np.einsum("ij,ij->i", n, p - self.on)[:, None] * n, n, 0)
        eye = T.apply(self.camera_c)
        rays = _directions(p - eye)
        with np.errstate(divide="ignore", invalid="ignore"):
            ranges = np.einsum("ij,ij->i", n, self.on - eye) / np.einsum("ij,ij->i", n, rays)
        return self._seen(p, eye, eye + ranges[:, None] * rays, n, 0)

    @classmethod
    def _seen(cls, p: Array, camera_c: Array | None, on: Array, normal: Array, work: int) -> _Noiseless:
        off = np.linalg.norm(on - p, axis=1)
        off[~np.isfinite(off)] = np.inf
        met = np.isfinite(off)
        noise = robust_noise(off[met]) if met.any() else 0.0
        seen = off < CREDIBLE * noise
        rays = normal[seen] if camera_c is None else _directions(on[seen] - camera_c)
        return cls(p, camera_c, on, normal, on[seen], rays, off, noise, work)

    def cost(self, noise_m: float) -> float:
        """Return the mean squared distance from the points, in units of three sigma, at most 1 for each."""
        return float(np.mean(np.minimum(self.off / (CREDIBLE * noise_m), 1.0) ** 2))


def _directions(rays: Array) -> Array:
    """Unit vectors along rays (n, 3)."""
    return np.asarray(rays / np.linalg.norm(rays, axis=1)[:, None])
