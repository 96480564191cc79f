"""Quality of a registered pose, measured in the same way for every back end: inliers, rms, information, status.

With p_c = T_ca p_a, closest point c and face normal n, the error d = [theta; v] in {C}, T_ac_true = T_ac @ Exp(d),
appears in the residual n . (p_c - c) = J d + noise, J = [p_c x n, n]. Sums over the inliers give all that follows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Alignment, AlignStatus, Fit
from avsreplay.register.covariance import Evidence, pseudo_inverse, without_dominant_patches
from avsreplay.register.params import RegisterParams, RegistrationLimits
from avsreplay.register.size import LEAST_ERROR, SizeError, normal_jacobian, size_error
from avsreplay.register.surface_index import Closest, SurfaceIndex
from avsreplay.register.visibility import LEAST_FACING, TESTED_POINTS, Visibility

PATCH_OF_EXTENT = 0.05  # residuals of points nearer to each other than this may be correlated
LEAST_PATCHES = 24
SIGMA_PER_MEDIAN = 1.4826  # standard deviation over median |e| for a normal e
NOISE_FLOOR_OF_GATE = 1e-6  # an exact scan must not claim infinite information
FREE_BELOW = 1e-3  # a motion that moves the rms point by 1 but its surface distance by less than 0.032 is unobservable
AS_MANY, AS_NEAR = 0.99, 1.02  # inliers and rms of a pose that fits as well
SUGGESTED, SUGGESTED_SIGMAS = 0.4, 2.5  # an error of size by the sums of patches: share of the least one, and sigmas
MANY_INLIERS = 0.9  # with a smaller share the sums of the inliers alone do not show the size
UNCHANGED = 0.06  # of a statistic that is chi-square with 6 degrees of freedom at the true pose: smaller with p = 4e-6
ACCURACY = (0.1, 1e-3)  # deg and share of the extent, of a back end that states none of its own
AXIS_WITHIN = 0.966  # cosine of 15 deg: a direction nearer than that to an axis is given the name of the axis


@dataclass(frozen=True, slots=True, eq=False)
class Grade:
    """The quality of a pose by the kernel; from ``bounded`` on it holds only if ``observable``.

    Attributes:
        points, inliers: of the scan.  used: inliers in the patches that are not left out.
        rms_m, noise_m, centre: as in ``covariance.Evidence``.  total: (6, 6) sum of J'J over the inliers used.
        statistic: g' N^+ g / noise^2 of all inliers; 0 at a minimum of the distances.
        overlap, observable: there are enough inliers; they determine every motion.
        bounded: the standard deviations are below the extent and 1 rad.
        beyond: the residuals require a step above the accuracy of the back end and three standard deviations.
        covariance, dof: (6, 6) and its degrees of freedom.  split_nis: the test of halves, NaN where it was not made.
        size, size_1s: as of ``covariance.patch_size``.
    """

    points: int
    inliers: int
    used: int
    rms_m: float
    noise_m: float
    centre: Array
    total: Array
    statistic: float
    overlap: bool
    observable: bool
    bounded: bool
    beyond: bool
    covariance: Array
    dof: float
    split_nis: float
    size: float
    size_1s: float


def evidence(
    index: SurfaceIndex,
    visibility: Visibility,
    points: NDArray[Any],
    T_ca: Pose,
    gate_m: float,
    noise_m: float | None = None,
    matches: Any = None,
) -> Evidence:
    """Return the sums for ``points`` (n, 3) in {A} [m] at ``T_ca``; ``noise_m`` None: estimated from the residuals.

    A patch is what lies in one cube; each point is its own patch if there are not more than ``LEAST_PATCHES`` cubes.
    """
    facing = visibility.camera_c(index, points, T_ca) is not None
    size = PATCH_OF_EXTENT * index.extent_m
    found = index.evidence(points, T_ca, gate_m, size, LEAST_PATCHES, facing=facing, matches=matches)
    rms = float(np.sqrt(found.sum_d2 / found.inliers)) if found.inliers else float("nan")
    noise = noise_m or max(SIGMA_PER_MEDIAN * found.median_m, NOISE_FLOOR_OF_GATE * gate_m)
    sums = (found.counts, found.normals, found.gradients, found.offsets, found.errors, found.places)
    return Evidence(len(points), found.inliers, rms, found.centre, noise, *sums)


def instants(
    index: SurfaceIndex,
    visibility: Visibility,
    points: NDArray[Any],
    times_s: NDArray[Any],
    T_ca: Pose,
    gate_m: float,
) -> Array:
    """Return M (6, 6) [s]: a pose error d(t) = d0 + t d1 during the scan is registered as d0 + M d1.

    Point k, measured at ``times_s[k]``, has the residual J_k d(t_k). Least squares give M = N^-1 (sum of t J'J) with
    N = J'J. Motions that no inlier observes are given the mean of all times.
    """
    moved, found, near = _matched(index, visibility, points, T_ca, gate_m)
    times = np.asarray(times_s, dtype=np.float64)
    mean = float(times.mean()) if len(times) else 0.0
    J = normal_jacobian(moved[near], found.normal[near])
    M: Array = mean * np.eye(6) + np.linalg.pinv(J.T @ J, hermitian=True) @ ((J.T * (times[near] - mean)) @ J)
    return M


def _matched(
    index: SurfaceIndex, visibility: Visibility, points: NDArray[Any], T_ca: Pose, gate_m: float
) -> tuple[Array, Closest, NDArray[np.bool_]]:
    """Points in {C} (n, 3), their closest points on the model, and which are inliers (n,)."""
    moved = T_ca.apply(points)
    found = index.closest(moved, camera_c=visibility.camera_c(index, points, T_ca))
    return moved, found, found.d2 < gate_m**2


def grade(
    index: SurfaceIndex,
    visibility: Visibility,
    points: NDArray[Any],
    fit: Fit,
    limits: RegistrationLimits,
    params: RegisterParams,
    halves: bool = True,
    accuracy: tuple[float, float] = ACCURACY,
    systematic: bool = True,
    guess: Pose | None = None,
) -> Alignment:
    """Measure the quality of the pose of a back end.

    Too few inliers give NO_OVERLAP, whatever the convergence flag of the back end is. ``halves``: compare the poses
    from two halves of the scan. ``accuracy``: of the back end on an exact scan [deg, share of the extent].
    ``systematic``: the covariance includes errors that vary slowly over the target. ``guess``: T_ca from which the back
    end began; a pose that equals this guess, although the residuals require a step, is FAILED.
    """
    if not (np.isfinite(fit.T_ca.t).all() and np.isfinite(fit.T_ca.q).all()):
        return not_measured(len(points), AlignStatus.FAILED)
    across = fit.T_ca.R[:, :2].T if halves else np.empty((0, 3))  # x and y of {A}
    found = _grade(index, visibility, points, fit, limits.gate_m, params, across, accuracy, systematic)
    if found.overlap and _same(fit.T_ca, guess) and found.statistic > UNCHANGED:
        failed = not_measured(len(points), AlignStatus.FAILED)
        return replace(failed, message="returned its guess unchanged; the scan asks for another pose")
    info, P = found.total / found.noise_m**2, None
    weakest: tuple[str, ...] = ()
    if found.observable:
        P, weakest = found.covariance, () if found.bounded else unbounded_directions(found.covariance, index.extent_m)
        if weakest:
            info, P = pseudo_inverse(found.covariance), None
    elif found.overlap:
        weakest = unobservable_directions(found.total, found.used, found.centre)
    settled = P is None or not found.beyond
    size = None
    if P is not None and settled and systematic and _other_size(found):
        size = size_error(index, points, fit.T_ca, visibility.camera_c(index, points, fit.T_ca))
        P = P if size is None else P + np.outer(size.shift, size.shift)
    return Alignment(
        T_ac=fit.T_ca.inverse(),
        iterations=fit.iterations,
        converged=fit.converged and settled,
        points=found.points,
        inliers=found.inliers,
        rms_m=found.rms_m,
        info=frozen(info),
        status=_status(found.overlap, fit.converged and settled, bool(weakest)),
        covariance=None if P is None else frozen(P),
        free_directions=", ".join(weakest),
        split_nis=None if np.isnan(found.split_nis) else found.split_nis,
        message=_message(settled, size),
        dof=np.inf if P is None else found.dof,
    )


def _other_size(found: Grade) -> bool:
    """Whether another size is worth a fit: the sums of patches suggest one, or many points are not on the model."""
    suggested = max(SUGGESTED * LEAST_ERROR, SUGGESTED_SIGMAS * found.size_1s)
    return found.inliers < MANY_INLIERS * found.points or abs(found.size) > suggested


def _message(settled: bool, size: SizeError | None) -> str:
    if not settled:
        return "the back end reports convergence, but its pose is not at a minimum of the distances"
    return "" if size is None else size.message


def _same(T_ca: Pose, guess: Pose | None) -> bool:
    return guess is not None and (T_ca.q.tobytes(), T_ca.t.tobytes()) == (guess.q.tobytes(), guess.t.tobytes())


def _grade(
    index: SurfaceIndex,
    visibility: Visibility,
    points: NDArray[Any],
    fit: Fit,
    gate_m: float,
    params: RegisterParams,
    across: Array,
    accuracy: tuple[float, float],
    systematic: bool,
) -> Grade:
    """Grade the pose of a back end in the kernel; ``across`` (k, 3) in {C}: directions of the test of halves."""
    extent = index.extent_m
    camera = (visibility.may_be_camera(fit.T_ca), TESTED_POINTS, LEAST_FACING, extent)
    noise = (params.noise_m or 0.0, NOISE_FLOOR_OF_GATE * gate_m)
    overlap = (float(params.min_inliers), params.min_inlier_ratio, FREE_BELOW)
    step = (systematic, float(np.radians(accuracy[0])), accuracy[1] * extent)
    rule = (min(gate_m, index.reach_m), PATCH_OF_EXTENT * extent, LEAST_PATCHES, *camera, *noise, *overlap, *step)
    return Grade(*index.grade(points, fit.T_ca, *rule, np.ascontiguousarray(across), 1, fit.matches))


def not_measured(points: int, status: AlignStatus, T_ac: Pose | None = None) -> Alignment:
    """Return an alignment without a measurement: the guess is kept, no inliers, no information."""
    pose = T_ac if T_ac is not None else Pose.identity()
    return Alignment(pose, 0, False, points, 0, float("nan"), frozen(np.zeros((6, 6))), status)


def _status(overlap: bool, converged: bool, free: bool) -> AlignStatus:
    if not overlap:
        return AlignStatus.NO_OVERLAP
    if not converged:
        return AlignStatus.NOT_CONVERGED
    return AlignStatus.DEGENERATE if free else AlignStatus.ALIGNED


def scaled_information(total: Array, count: int, centre: Array) -> tuple[Array, float]:
    """Return the mean of J'J (6, 6) with rotations about ``centre`` in units of the rms radius L, and L [m].

    ``total`` is the sum of J'J over ``count`` points, with rotations about the origin. Each diagonal entry is the mean
    squared change of surface distance per squared unit of point motion, between 0 and about 1, whatever the size of the
    target.
    """
    shift = np.eye(6)
    shift[3:, :3] = geometry.skew(centre)  # (p - centre) x n = p x n - centre x n
    mean = shift.T @ total @ shift / count
    radius = float(np.sqrt(max(np.trace(mean[:3, :3]), 0.0)))
    scale = np.repeat([1.0 / max(radius, np.finfo(float).tiny), 1.0], 3)
    return scale[:, None] * mean * scale, radius


def unobservable_directions(total: Array, count: int, centre: Array) -> tuple[str, ...]:
    """Name every motion whose scaled information is below ``FREE_BELOW``; empty if all six are observable."""
    info, _ = scaled_information(total, count, centre)
    values, vectors = np.linalg.eigh(info)
    free = vectors[:, values < FREE_BELOW].T
    if not len(free):
        return ()
    return tuple(_words(row) for row in _sparse_basis(free))


def with_free_directions_of(
    guess: Pose, index: SurfaceIndex, visibility: Visibility, points: NDArray[Any], T_ca: Pose, gate_m: float
) -> Pose:
    """Return the pose of a degenerate view with its unobservable directions as in the guess.

    Passes over a curved surface drift along them. To first order in the difference, so that the result is kept only if
    the surface still fits.

    Args:
        guess: predicted T_ca.
        index: of the model.
        visibility: of its faces.
        points: (n, 3) in {A} [m].
        T_ca: registered pose.
        gate_m: distance of an inlier [m].
    """
    found = evidence(index, visibility, points, T_ca, gate_m)
    sums = without_dominant_patches(found)
    info, radius = scaled_information(sums.normals.sum(axis=0), int(sums.counts.sum()), sums.centre)
    values, vectors = np.linalg.eigh(info)
    free = vectors[:, values < FREE_BELOW]
    step = guess @ T_ca.inverse()
    motion = np.concatenate([radius * geometry.log(step.q), step.apply(sums.centre) - sums.centre])
    along = free @ (free.T @ motion)
    q = geometry.exp(along[:3] / radius)
    kept = Pose(q, sums.centre + along[3:] - geometry.matrix(q) @ sums.centre) @ T_ca
    moved = evidence(index, visibility, points, kept, gate_m)
    fits = moved.inliers >= AS_MANY * found.inliers and moved.rms_m <= AS_NEAR * found.rms_m
    return kept if fits else T_ca


def unbounded_directions(P: Array, extent_m: float) -> tuple[str, ...]:
    """Name every motion whose standard deviation by P (6, 6) is at least the extent (rotations: 1 rad)."""
    scale = np.repeat([1.0, 1.0 / extent_m], 3)
    scaled = P * np.outer(scale, scale)
    if np.trace(scaled) < 1.0:  # the largest eigenvalue is not larger
        return ()
    values, vectors = np.linalg.eigh(scaled)
    return tuple(_words(row) for row in _sparse_basis(vectors[:, values >= 1.0].T))


def turn_words(step: Pose) -> str:
    """Describe a rigid motion in {C}: "turned 180 deg about x"."""
    degrees = float(np.degrees(geometry.angle(step.q)))
    if degrees < 1.0:
        return f"moved along {_axis(step.t)}"
    return f"turned {degrees:.0f} deg about {_axis(geometry.log(step.q))}"


def _sparse_basis(rows: Array) -> Array:
    """Basis of the same space by elimination with full pivoting: one motion per row, as few axes as possible."""
    basis = rows.copy()
    used: list[int] = []
    for k in range(len(basis)):
        left = np.abs(basis[k:])
        left[:, used] = 0.0
        row, column = divmod(int(np.argmax(left)), basis.shape[1])
        basis[[k, k + row]] = basis[[k + row, k]]
        basis[k] /= basis[k, column]
        others = [i for i in range(len(basis)) if i != k]
        basis[others] -= np.outer(basis[others, column], basis[k])
        used.append(column)
    basis = basis[np.argsort(used)]
    unit: Array = basis / np.linalg.norm(basis, axis=1, keepdims=True)
    return unit


def _words(motion: Array) -> str:
    turn, slide = motion[:3], motion[3:]
    if np.linalg.norm(slide) >= np.linalg.norm(turn):
        return f"slides along {_axis(slide)}"
    return f"turns about {_axis(turn)}"


def _axis(vector: Array) -> str:
    unit = vector / np.linalg.norm(vector)
    k = int(np.argmax(np.abs(unit)))
    if abs(unit[k]) > AXIS_WITHIN:
        return "xyz"[k]
    unit = unit * np.sign(unit[k])
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in unit) + ")"
