"""Size of the target over that of the model from the residuals of a registered scan.

With T_ac_true = T_ac Exp(d) and a target 1 + delta times as large as the model, the residual at p
with normal n is n . (p - c) = J d + delta n . p. Robust least squares give pose and delta; the
points are matched again until delta does not change, because the closest points move with both.

Standard error: one part is that of the weighted residuals, which are correlated within a patch of
the model (cluster-robust sandwich). Another is that of slowly varying errors of model and ranges,
an anisotropic strain and an offset of the surface. Their amplitudes are fitted to what pose and
size leave, and their variances enter with the change of delta that they cause.

Bias: the closest point is a nonlinear function of the measured one, so that noise makes curved and
thin parts appear larger. The same fit to the closest points with artificial noise of the same size
along the rays, with both signs, gives this bias; it is subtracted, and half of it counts as a
standard error (indirect inference: Gourieroux, Monfort and Renault, J. Applied Econometrics 8,
1993).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.register.covariance import noise_along
from avsreplay.register.surface_index import SurfaceIndex

LEAST_RESIDUALS = 50
# diameter of a scan over that of the model above which more than the target is in view
MOST_OF_MODEL = 1.3
NORMAL_QUANTILE = 0.67449  # median |e| over standard deviation for a normal e
# least |delta| that is reported, by itself and in standard errors
LEAST_ERROR = 0.005
SIZE_SIGMAS = 4.0
# from so many standard errors on, the covariance of the pose contains the change with the size
LIKELY_SIGMAS = 2.0
# the message of such a view begins with it
SIZE_UNSEEN = "the view does not show an error of the size"
# a view in which a larger error would not be significant does not determine the size
UNSEEN_ERROR = 0.03
# larger residuals are not used
USED_OF_EXTENT = 0.02
SIZE_POINTS = 600
# times that the points are matched; step of the size that ends them
MATCH_ROUNDS = 3
MOST_ROUNDS = 20
SMALL_STEP = 2e-4
LARGEST_ERROR = 0.3  # a fit with a larger step has not converged
# least share of n . p not explained by the pose: three faces of a box give no size
LEAST_INFORMATION = 1e-3
PATCHES_OF_EXTENT = (
    0.05,
    0.15,
)  # sides of the patches; the larger of the two standard errors counts
OFF_PLANES = 0.381966  # share of a patch from its boundary to a coordinate plane
LEAST_LEFT = 0.2  # leverage is limited to 0.8 where it enlarges the residual of a patch
# an amplitude that the pose and the size explain to all but this share of its norm is not fitted
OBSERVABLE = 0.05
# width of the weights in standard deviations; variance over the weighted one
CAUCHY = 2.0
CAUCHY_VARIANCE = 1.56


@value_class
class SizeError:
    """Size of the target estimated from one scan.

    Attributes:
        delta: size of the target over that of the model, less 1.
        sigma: standard error of delta.
        shift: (6,) change d of the pose if the size is fitted with it, T_ac Exp(d).
    """

    delta: float
    sigma: float
    shift: Array

    @property
    def significant(self) -> bool:
        """Whether delta is larger than 0.5 % and than four standard errors."""
        return abs(self.delta) > max(LEAST_ERROR, SIZE_SIGMAS * self.sigma)

    @property
    def likely(self) -> bool:
        """Whether delta is larger than 0.5 % and than two standard errors: the pose is then
        uncertain by its shift.
        """
        return abs(self.delta) > max(LEAST_ERROR, LIKELY_SIGMAS * self.sigma)


def size_remark(size: SizeError | None, size_1s: float) -> str:
    """Return what a row says about the size: its error, or that the view does not show one of 3 %;
    "" for neither.

    ``size``: the fit to the points, None if it was not made; ``size_1s``: standard error from the
    sums of patches.
    """
    if size is not None and size.significant:
        larger = "larger" if size.delta > 0.0 else "smaller"
        return f"the scan fits a target {100.0 * abs(size.delta):.1f} % {larger} than the model"
    error = SIZE_SIGMAS * max(size_1s, 0.0 if size is None else size.sigma)
    if error <= UNSEEN_ERROR:
        return ""
    return f"{SIZE_UNSEEN} below {100.0 * error:.1f} %" if error < np.inf else SIZE_UNSEEN


def size_error(
    index: SurfaceIndex, points: NDArray[Any], T_ca: Pose, camera_c: Array | None
) -> SizeError | None:
    """Return the error of size that a registered scan shows.

    Args:
        index: of the model.
        points: (n, 3) in {A} [m].
        T_ca: registered pose.
        camera_c: (3,) position of the camera in {C} [m] if only faces towards it are matched.

    Returns:
        The error, without the bias of the noise if it is significant; None without a fit.
    """
    rows = _fitted(index, T_ca.apply(points[:: max(1, len(points) // SIZE_POINTS)]), camera_c)
    if rows is None or not (found := _size_of(index, rows)).significant:
        return None if rows is None else found
    bias = _bias_of(index, rows, camera_c)
    return SizeError(found.delta - bias, float(np.hypot(found.sigma, 0.5 * bias)), found.shift)


@value_class
class Rows:
    """The weighted rows of the last round, and the result.

    Attributes:
        used: (n,) which points are used, k of them.
        p, foot, normal: (k, 3) these points in the model's size, their closest points and normals,
            {C} [m].
        J: (k, 6) Jacobian of the pose about the mean of p; (k, 7) if the size is fitted as a part
            of the pose.
        free: (k,) effect of a unit of the parameter that no pose explains.
        left: (k,) residual.
        weight: (k,) square root of the weight.
        noise_m: standard deviation of the residual.
    """

    used: NDArray[np.bool_]
    p: Array
    foot: Array
    normal: Array
    J: Array
    free: Array
    left: Array
    weight: Array
    noise_m: float
    delta: float
    moved: Pose

    @property
    def information(self) -> float:
        """Inverse variance of the parameter for residuals of unit variance."""
        return max(float(self.free @ self.free), np.finfo(float).tiny)


def fitted_size(index: SurfaceIndex, p: Array, camera_c: Array | None) -> SizeError | None:
    """Fit size and pose to points of a registered scan.

    Args:
        index: of the model.
        p: (n, 3) points in {C} [m], at the registered pose.
        camera_c: (3,) camera position in {C} [m], or None: both sides of a face are matched.

    Returns:
        The fit, with the bias of the noise; None with fewer than 50 residuals, or if a pose
        explains any size.
    """
    return None if (rows := _fitted(index, p, camera_c)) is None else _size_of(index, rows)


def _size_of(index: SurfaceIndex, rows: Rows) -> SizeError:
    sigma = max(clustered(rows, side * index.extent_m) for side in PATCHES_OF_EXTENT)
    back = rows.moved.inverse()
    shift = np.concatenate([geometry.log(back.q), back.t])
    return SizeError(rows.delta, float(np.hypot(sigma, systematic(rows, index.extent_m))), shift)


def noise_bias(index: SurfaceIndex, p: Array, camera_c: Array | None) -> float:
    """Return the size, less 1, that the noise of a scan makes a target of the right size appear to
    have.

    Args:
        index: of the model.
        p: (n, 3) points in {C} [m], at the registered pose.
        camera_c: (3,) camera position in {C} [m]; None: the noise is taken along the normals.

    Returns:
        The mean over noise of both signs, in which terms linear in the noise cancel. A fit that the
        noise prevents counts with the largest error; 0 if there is no fit without it.
    """
    return 0.0 if (rows := _fitted(index, p, camera_c)) is None else _bias_of(index, rows, camera_c)


def _bias_of(index: SurfaceIndex, rows: Rows, camera_c: Array | None) -> float:
    found = [
        _rounds(index, noisy, camera_c, MATCH_ROUNDS) for noisy in noisy_points(rows, camera_c)
    ]
    return float(np.mean([LARGEST_ERROR if each is None else each[0] for each in found]))


def noisy_points(rows: Rows, camera_c: Array | None) -> tuple[Array, Array]:
    """Return the closest points (k, 3) of rows with noise of the size of their residuals along the
    rays, of both signs.

    ``camera_c``: (3,) camera position in {C} [m]; None: the noise is along the normals.
    """
    rays = rows.normal if camera_c is None else rows.foot - np.asarray(camera_c)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    moved = (
        noise_along(rays, rows.normal, np.sqrt(CAUCHY_VARIANCE) * rows.left, rows.weight)[:, None]
        * rays
    )
    return rows.foot + moved, rows.foot - moved


def normal_jacobian(p: Array, n: Array) -> Array:
    """Return J (k, 6) of points p and normals n (k, 3): rows [p x n, n]."""
    J = np.empty((6, len(p)))  # np.cross takes three times as long
    J[3:] = n.T
    (x, y, z), (u, v, w) = p.T, J[3:]
    J[0], J[1], J[2] = y * w - z * v, z * u - x * w, x * v - y * u
    return np.ascontiguousarray(J.T)


def _fitted(index: SurfaceIndex, p: Array, camera_c: Array | None) -> Rows | None:
    """The rows of the last round."""
    if (begun := _rounds(index, p, camera_c, MATCH_ROUNDS - 1)) is None:
        return None
    delta, moved = begun
    if (found := least_squares(index, moved.apply(p) / (1.0 + delta), camera_c)) is None:
        return None
    rows, d, centre = found
    delta, moved = joined(delta, moved, rows.delta, d, centre)
    return None if abs(delta) > LARGEST_ERROR else replace(rows, delta=delta, moved=moved)


def _rounds(
    index: SurfaceIndex, p: Array, camera_c: Array | None, count: int
) -> tuple[float, Pose] | None:
    """Size and motion after so many rounds, and more while they change the size; their rows
    are not needed.
    """
    delta, moved = 0.0, Pose.identity()
    rule = (
        USED_OF_EXTENT * index.extent_m,
        LEAST_RESIDUALS,
        NORMAL_QUANTILE,
        CAUCHY,
        LEAST_INFORMATION,
    )
    for done in range(1, MOST_ROUNDS + 1):
        if (step := index.size_step(moved.apply(p) / (1.0 + delta), camera_c, *rule)) is None:
            return None
        delta, moved = joined(delta, moved, *step)
        if abs(delta) > LARGEST_ERROR:
            return None
        if done >= count and abs(step[0]) < SMALL_STEP:
            break
    return delta, moved


def joined(delta: float, moved: Pose, step: float, d: Array, centre: Array) -> tuple[float, Pose]:
    """Return size and motion after a step of the size, and one d (6,) of the pose about a centre
    (3,).
    """
    back = _undone(d, centre)
    moved = Pose(back.q, (1.0 + delta) * (back.t + step * centre)) @ moved
    return (1.0 + delta) * (1.0 + step) - 1.0, moved


def _undone(d: Array, centre: Array) -> Pose:
    """The motion that undoes a pose error d (6,) about a centre (3,)."""
    turn = Pose(geometry.exp(-d[:3]), np.zeros(3))
    return Pose(turn.q, centre - turn.R @ centre - d[3:])


def least_squares(
    index: SurfaceIndex, q: Array, camera_c: Array | None, motion: Array | None = None
) -> tuple[Rows, Array, Array] | None:
    """Return one least-squares step.

    Args:
        index: of the model.
        q: (n, 3) points in {C} [m], in the model's size.
        camera_c: as of :func:`fitted_size`.
        motion: (n, 3) displacement of the points by a unit of the parameter; the size is then a
            seventh component of the pose. None: the parameter is the size.

    Returns:
        The rows with the step of the parameter, the pose (6,) or (7,), and the centre (3,) to which
        it refers; None as for :func:`fitted_size`.
    """
    if (matched := matched_points(index, q, camera_c)) is None:
        return None
    near, n, foot, e, weight, noise = matched
    q, centre = q[near], q[near].mean(axis=0)
    J, a = (
        weight[:, None] * normal_jacobian(q - centre, n),
        weight * np.einsum("ij,ij->i", n, q - centre),
    )
    if motion is not None:
        J, a = np.column_stack([J, a]), weight * np.einsum("ij,ij->i", n, motion[near])
    of_a, of_e = np.linalg.lstsq(J, np.column_stack([a, weight * e]), rcond=1e-6)[0].T
    free = a - J @ of_a
    if free @ free <= LEAST_INFORMATION * (a @ a):
        return None
    step = float(free @ (weight * e)) / max(float(free @ free), np.finfo(float).tiny)
    left = weight * e - J @ of_e - step * free
    return (
        Rows(near, q, foot, n, J, free, left, weight, noise, step, Pose.identity()),
        of_e - step * of_a,
        centre,
    )


def matched_points(
    index: SurfaceIndex, p: Array, camera_c: Array | None
) -> tuple[NDArray[np.bool_], Array, Array, Array, Array, float] | None:
    """Return a mask (n,) of the points p (n, 3) near the model, and what follows for these k; None
    for fewer than 50.

    Normals and closest points (k, 3), residuals and square roots of their Cauchy weights (k,),
    their robust 1 sigma.
    """
    found = index.closest(p, camera_c=camera_c, most_m=USED_OF_EXTENT * index.extent_m)
    near = np.isfinite(found.d2)
    if np.count_nonzero(near) < LEAST_RESIDUALS:
        return None
    n, foot = found.normal[near], found.foot[near]
    e = np.einsum("ij,ij->i", n, p[near] - foot)
    noise = max(float(np.median(np.abs(e))) / NORMAL_QUANTILE, np.finfo(float).tiny)
    return near, n, foot, e, 1.0 / np.sqrt(1.0 + (e / (CAUCHY * noise)) ** 2), noise


def clustered(rows: Rows, side_m: float) -> float:
    """Return the standard error of the parameter from the sums over patches, each enlarged by its
    leverage.

    ``side_m``: of a patch [m].

    A point belongs to the patch in which its projection onto its face lies, so that noise does not
    divide a face. The boundaries of the patches are not at the coordinate planes, so that rounding
    does not divide a face in one of them.
    """
    on = rows.p - np.einsum("ij,ij->i", rows.normal, rows.p - rows.foot)[:, None] * rows.normal
    cell = np.floor(on / side_m + OFF_PLANES).astype(np.int64)
    span = cell.max(axis=0) - cell.min(axis=0) + 1
    cell = cell - cell.min(axis=0)
    patch = np.unique(
        (cell[:, 0] * span[1] + cell[:, 1]) * span[2] + cell[:, 2], return_inverse=True
    )[1]
    leverage = np.bincount(patch, rows.free**2) / rows.information
    score = np.bincount(patch, rows.free * rows.left) / np.maximum(1.0 - leverage, LEAST_LEFT)
    return float(np.sqrt(score @ score)) / rows.information


def systematic(rows: Rows, extent_m: float) -> float:
    """Return the standard deviation of the parameter from an anisotropic strain and an offset of
    the surface.
    """
    q, n = (rows.p - rows.p.mean(axis=0)) / extent_m, rows.normal
    xx, yy, zz = (n * q).T
    shears = [n[:, i] * q[:, j] + n[:, j] * q[:, i] for i, j in ((0, 1), (0, 2), (1, 2))]
    strain = np.column_stack([xx - yy, (xx + yy - 2.0 * zz) / np.sqrt(3.0), *shears])
    of_strain, of_offset = (
        _effect(rows, rows.weight[:, None] * B) for B in (strain, np.ones((len(q), 1)))
    )
    return float(np.hypot(of_strain, of_offset))


def _effect(rows: Rows, B: Array) -> float:
    """Standard deviation of delta from amplitudes of B (k, m) that are draws of one normal
    distribution.
    """
    change = rows.free @ B / rows.information
    own = B - np.outer(rows.free, change)
    own = own - rows.J @ np.linalg.lstsq(rows.J, own, rcond=1e-6)[0]
    U, s, Vt = np.linalg.svd(own, full_matrices=False)
    kept = s > OBSERVABLE * max(
        float(np.linalg.norm(B)) / np.sqrt(B.shape[1]), np.finfo(float).tiny
    )
    if not kept.any():
        return 0.0
    amplitudes = (U.T @ rows.left)[kept] / s[kept]
    random = float(rows.left @ rows.left) / len(rows.left) / s[kept] ** 2
    variance = max(0.0, float(np.mean(amplitudes**2 - random)))
    return float(np.sqrt(variance * np.sum((change @ Vt.T[:, kept]) ** 2)))


def spread_of(without: Array) -> float:
    """Return the standard error of an estimate by the jackknife: from its values (n,) without
    one of n parts each.
    """
    n = len(without)
    return float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))
