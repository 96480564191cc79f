"""Quality of a registered pose, measured in the same way for every back end.

With p_c = T_ca p_a, closest point c and face normal n, the error d = [theta; v] in {C}, T_ac_true =
T_ac @ Exp(d), appears in the residual n . (p_c - c) = J d + noise, J = [p_c x n, n]. Sums over the
inliers give all that follows.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Alignment, AlignStatus, Fit
from avsreplay.register.backend import ACCURACY
from avsreplay.register.covariance import (
    Evidence,
    normal_numbers,
    pseudo_inverse,
    registration_covariance,
    sandwich_covariance,
    systematic_errors,
    without_dominant_patches,
)
from avsreplay.register.degenerate import FREE_BELOW, Directions, motion_words, unbounded_directions
from avsreplay.register.params import RegisterParams, RegistrationLimits
from avsreplay.register.size import LEAST_ERROR, normal_jacobian, size_remark
from avsreplay.register.surface_index import Closest, GradeRule, SurfaceIndex
from avsreplay.register.visibility import LEAST_FACING, TESTED_POINTS, Visibility
from avsreplay.register.work import LEAST_RATIO

# gates from which a point is well off; points per which those are counted
WELL_OFF = 2.0
PART = 1000
PATCH_OF_EXTENT = 0.05  # residuals of points nearer to each other than this may be correlated
LEAST_PATCHES = 24
SIGMA_PER_MEDIAN = 1.4826  # standard deviation over median |e| for a normal e
NOISE_FLOOR_OF_GATE = 1e-6  # keeps the information of an exact scan finite
# ratios of inliers and rms for which a pose fits as well
AS_MANY = 0.99
AS_NEAR = 1.02
# error of size from sums of patches: over the least reported one, sigmas
SUGGESTED = 0.4
SUGGESTED_SIGMAS = 2.5
# a statistic that is chi-square with 6 degrees of freedom at the true pose is smaller with p = 4e-6
UNCHANGED = 0.06
NUMBERS = 1024  # normal numbers of the simulated noise
# points that are simulated; one of so many at most, at least, at most of small noise
SIMULATED = 1024
SHARES = (3, 12, 8)
# of the extent: with less noise a part of the simulated points decides whether the others are
SMALL_NOISE = 0.002
UNCERTAIN_BIAS = 0.5  # of the bias of the noise: standard error


@value_class
class PoseQuality:
    """The quality of a pose by the kernel; from ``bounded`` on it holds only if ``observable``.

    Attributes:
        points, inliers: of the scan.
        used: inliers in the patches that are not left out.
        rms_m, noise_m, centre: as in ``covariance.Evidence``.
        total: (6, 6) sum of J'J over the inliers used.
        statistic: g' N^+ g / noise^2 of all inliers; 0 at a minimum of the distances.
        overlap, observable: there are enough inliers; they determine every motion.
        bounded: the standard deviations are below the extent and 1 rad.
        beyond: the residuals require a step above the accuracy of the back end and three standard
            deviations.
        covariance, systematic: (6, 6) and the part of it from systematic errors.
        dof: its degrees of freedom.
        split_nis: the test of halves, NaN where it was not made.
        size, size_1s: as of ``covariance.patch_size``.
        well_off: of ``PART`` points, those two gates away.
        bias, left, chance: (6,) of the pose, caused by the noise, as far as it is not by chance:
            T_ac_true = T_ac Exp(bias); (6,) the rest of the estimate; (6, 6) covariance of the
            bias.
        patches: the arrays of ``covariance.Evidence`` of the patches used; empty where every motion
            is observable.
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
    systematic: Array
    dof: float
    split_nis: float
    size: float
    size_1s: float
    well_off: int
    bias: Array
    left: Array
    chance: Array
    patches: tuple[Any, ...]


def evidence(
    index: SurfaceIndex,
    visibility: Visibility,
    points: NDArray[Any],
    T_ca: Pose,
    gate_m: float,
    noise_m: float | None = None,
    matches: Any = None,
) -> Evidence:
    """Return the sums for ``points`` (n, 3) in {A} [m] at ``T_ca``; ``noise_m`` None: estimated
    from the residuals.

    A patch is the points that project onto their faces in one cube, or one point with at most
    ``LEAST_PATCHES`` cubes.
    """
    camera_c = visibility.camera_c(index, points, T_ca)
    facing, size = camera_c is not None, PATCH_OF_EXTENT * index.extent_m
    found = index.evidence(
        points, T_ca, gate_m, size, LEAST_PATCHES, facing=facing, matches=matches
    )
    rms = float(np.sqrt(found.sum_d2 / found.inliers)) if found.inliers else float("nan")
    noise = noise_m or max(SIGMA_PER_MEDIAN * found.median_m, NOISE_FLOOR_OF_GATE * gate_m)
    sums = (found.counts, found.normals, found.gradients, found.offsets, found.errors, found.places)
    inliers, centre = found.inliers, found.centre
    return Evidence(len(points), inliers, rms, centre, noise, *sums, camera_c=camera_c)


def instants(
    index: SurfaceIndex,
    visibility: Visibility,
    points: NDArray[Any],
    times_s: NDArray[Any],
    T_ca: Pose,
    gate_m: float,
) -> Array:
    """Return M (6, 6) [s]: a pose error d(t) = d0 + t d1 during the scan is registered as d0 + M
    d1.

    Point k, measured at ``times_s[k]``, has the residual J_k d(t_k). Least squares give M = N^-1
    (sum of t J'J) with N = J'J. Motions that no inlier observes are given the mean of all times.
    """
    moved, found, near = _matched(index, visibility, points, T_ca, gate_m)
    times = np.asarray(times_s, dtype=np.float64)
    mean = float(times.mean()) if len(times) else 0.0
    J = normal_jacobian(moved[near], found.normal[near])
    return frozen(
        mean * np.eye(6)
        + np.linalg.pinv(J.T @ J, hermitian=True) @ ((J.T * (times[near] - mean)) @ J)
    )


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
    simulated: bool = False,
) -> Alignment:
    """Measure the quality of the pose of a back end.

    Too few inliers give NO_OVERLAP, whatever the convergence flag of the back end is. A pose that
    equals its guess, although the residuals require a step, is FAILED, unless it is one of least
    squared distances: these do not move from where they end. The pose of a degenerate view has its
    unobservable directions as in the guess, if the surface then fits as well. The size is not
    fitted; if it should be (``Alignment.size_1s``), ``Decision.with_size`` fits it for the pose
    that is returned.

    Args:
        index: of the model.
        visibility: where the camera may be.
        points: (n, 3) in {A} [m].
        fit: the pose of the back end.
        limits: of the registration.
        params: settings of the registration.
        halves: compare the poses from two halves of the scan.
        accuracy: of the back end on an exact scan [deg, share of the extent].
        systematic: the covariance includes errors that vary slowly over the target.
        guess: T_ca from which the back end began.
        simulated: the pose is one of least squared distances. The bias that noise causes in it is
            taken from the pose, and the mean that noise adds to the residuals from the covariance,
            see ``kernel/noise.hpp``.
    """
    if not all(map(math.isfinite, (*fit.T_ca.q.tolist(), *fit.T_ca.t.tolist()))):
        return not_measured(len(points), AlignStatus.FAILED)
    faced = visibility.faced(index, points, fit.T_ca)
    across = fit.T_ca.R[:, :2].T if halves else np.empty((0, 3))  # x and y of {A}
    rule = _rule(index, params, limits.gate_m, accuracy, faced, across, systematic, simulated)
    found = PoseQuality(**index.grade(points, fit.T_ca, rule, fit.matches))
    step = found.overlap and found.statistic > UNCHANGED and not simulated
    if step and guess is not None and fit.T_ca.matrix.tobytes() == guess.matrix.tobytes():
        failed = not_measured(len(points), AlignStatus.FAILED)
        return replace(
            failed, message="returned its guess unchanged, although the residuals require a step"
        )
    pose = Determined(fit.T_ca, found.total / found.noise_m**2)
    if found.observable:
        pose = _determined(found, fit.T_ca, index.extent_m)
    elif found.overlap:
        camera_c = visibility.camera_c(index, points, fit.T_ca)
        view = _seen(index, visibility, points, limits.gate_m, found, camera_c)
        pose = view.pose(fit, guess if fit.converged else None, systematic)
    return _alignment(found, fit, pose, systematic)


@value_class
class Determined:
    """A pose T_ca, its information and covariance, and the motions that are not determined, in
    words and as columns d (6, k).
    """

    T_ca: Pose
    info: Array
    covariance: Array | None = None
    words: tuple[str, ...] = ()
    free: Array | None = None


def _determined(found: PoseQuality, T_ca: Pose, extent_m: float) -> Determined:
    """A pose whose directions are all observed, without the bias that noise causes."""
    b = found.bias
    uncertain = UNCERTAIN_BIAS**2 * np.outer(b, b) + found.chance
    P = found.covariance + uncertain + np.outer(found.left, found.left)
    if not found.bounded:
        words, free = unbounded_directions(P, extent_m)
        if words:
            return Determined(T_ca, pseudo_inverse(P), None, words, free)
    if b.any():
        T_ca = Pose(geometry.exp(b[:3]), b[3:]).inverse() @ T_ca
    return Determined(T_ca, found.total / found.noise_m**2, P)


@value_class
class _Seen:
    """A view that does not determine a pose."""

    index: SurfaceIndex
    visibility: Visibility
    points: NDArray[Any]
    gate_m: float
    found: PoseQuality
    used: Evidence
    view: Directions

    def pose(self, fit: Fit, guess: Pose | None, systematic: bool) -> Determined:
        """Return the pose with its unobservable directions as in the guess T_ca, if the surface
        then fits as well; passes over a curved surface drift along them.
        """
        info = _observable_information(self.view, self.used, self.index.extent_m, systematic)
        T_ca = fit.T_ca if guess is None else self._kept(fit.T_ca, guess)
        return Determined(T_ca, info, None, self.view.words, self.view.motions)

    def _kept(self, T_ca: Pose, guess: Pose) -> Pose:
        kept = self.view.nearest(T_ca, guess)
        facing = self.visibility.camera_c(self.index, self.points, kept) is not None
        at = self.index.normal_equations(self.points, kept, self.gate_m, facing=facing)
        many = at.inliers >= AS_MANY * self.found.inliers
        near = at.sum_d2 <= (AS_NEAR * self.found.rms_m) ** 2 * at.inliers
        # corrects the observable directions
        return self.view.refined(kept, at.info, at.gradient) if many and near else T_ca


def _seen(
    index: SurfaceIndex,
    visibility: Visibility,
    points: NDArray[Any],
    gate_m: float,
    found: PoseQuality,
    camera_c: Array | None,
) -> _Seen:
    of_all = (found.points, found.inliers, found.rms_m, found.centre, found.noise_m)
    used = replace(Evidence(*of_all, *found.patches), camera_c=camera_c)
    return _Seen(index, visibility, points, gate_m, found, used, _directions(used))


def _alignment(found: PoseQuality, fit: Fit, pose: Determined, systematic: bool) -> Alignment:
    """The alignment of a pose with its quality."""
    P = pose.covariance
    settled = P is None or not found.beyond
    sized = P is not None and systematic
    fitted = sized and settled and _other_size(found)
    converged = fit.converged and settled
    return Alignment(
        T_ac=pose.T_ca.inverse(),
        iterations=fit.iterations,
        converged=converged,
        points=found.points,
        inliers=found.inliers,
        rms_m=found.rms_m,
        info=frozen(pose.info),
        status=_status(found.overlap, converged, bool(pose.words)),
        covariance=None if P is None else frozen(P),
        free_directions=", ".join(pose.words),
        split_nis=None if np.isnan(found.split_nis) else found.split_nis,
        message=_message(settled, found.size_1s if sized and not fitted else 0.0),
        dof=np.inf if P is None else found.dof,
        free=pose.free if pose.words else None,
        well_off=found.well_off,
        size_1s=found.size_1s if fitted else None,
        systematic=frozen(found.systematic) if sized else None,
        size=(found.size, found.size_1s) if sized else None,
    )


def _other_size(found: PoseQuality) -> bool:
    """Whether size is fitted: the sums of patches suggest another size, or many points are
    not on the model.
    """
    suggested = abs(found.size) > max(SUGGESTED * LEAST_ERROR, SUGGESTED_SIGMAS * found.size_1s)
    return found.inliers < LEAST_RATIO * found.points or suggested


def _message(settled: bool, size_1s: float) -> str:
    if not settled:
        return "the back end reports convergence, but its pose is not at a minimum of the distances"
    return size_remark(None, size_1s)


def _rule(
    index: SurfaceIndex,
    params: RegisterParams,
    gate_m: float,
    accuracy: tuple[float, float],
    faced: bool,
    across: Array,
    systematic: bool,
    simulated: bool,
) -> GradeRule:
    """The rule by which the kernel grades a pose; ``faced``: the camera may be where the faces
    look; ``across`` (k, 3) in {C}: directions of the test of halves; the others as of ``grade``.
    """
    extent = index.extent_m
    return GradeRule(
        gate_m=min(gate_m, index.reach_m),
        patch_m=PATCH_OF_EXTENT * extent,
        least_patches=LEAST_PATCHES,
        camera=faced,
        tested=TESTED_POINTS,
        least_facing=LEAST_FACING,
        extent_m=extent,
        noise_m=params.noise_m or 0.0,
        noise_floor_m=NOISE_FLOOR_OF_GATE * gate_m,
        least_inliers=float(params.min_inliers),
        least_ratio=params.min_inlier_ratio,
        least_information=FREE_BELOW,
        systematic=systematic,
        turn_rad=float(np.radians(accuracy[0])),
        move_m=accuracy[1] * extent,
        across=np.ascontiguousarray(across),
        beyond_m=WELL_OFF * gate_m,
        least_close=LEAST_RATIO,
        part=PART,
        numbers=normal_numbers(NUMBERS) if simulated else np.empty(0),
        many=SIMULATED,
        least_share=SHARES[0],
        most_share=SHARES[1],
        small_share=SHARES[2],
        quiet_m=SMALL_NOISE * extent,
    )


def _observable_information(
    view: Directions, found: Evidence, extent_m: float, systematic: bool
) -> Array:
    """The information (6, 6) of a degenerate view, by the same covariance estimate as for any other
    view.
    """
    held = view.held(found)
    if systematic:
        P, _ = registration_covariance(
            held, systematic_errors(held, extent_m, PATCH_OF_EXTENT * extent_m)
        )
    else:
        P, _ = sandwich_covariance(held.normals, held.gradients)
    return view.observable_information(P)


def left_undetermined(found: Alignment, motions: Array) -> Alignment:
    """Return an alignment whose information is independent of motions d (6, k) of the model:
    DEGENERATE.
    """
    N, D = found.info, motions / np.linalg.norm(motions, axis=0)
    info = N - N @ D @ np.linalg.pinv(D.T @ N @ D, hermitian=True) @ D.T @ N
    motions = motions if found.free is None else np.hstack([found.free, motions])
    words, info = ", ".join(motion_words(motions)), frozen(0.5 * (info + info.T))
    free = replace(found, status=AlignStatus.DEGENERATE, info=info, covariance=None, dof=np.inf)
    return replace(free, free_directions=words, free=motions, split_nis=None)


def not_measured(points: int, status: AlignStatus, T_ac: Pose | None = None) -> Alignment:
    """Return an alignment without a measurement: the guess is kept, no inliers, no information."""
    return Alignment(
        T_ac or Pose.identity(), 0, False, points, 0, float("nan"), frozen(np.zeros((6, 6))), status
    )


def _status(overlap: bool, converged: bool, free: bool) -> AlignStatus:
    if not overlap:
        return AlignStatus.NO_OVERLAP
    if not converged:
        return AlignStatus.NOT_CONVERGED
    return AlignStatus.DEGENERATE if free else AlignStatus.ALIGNED


def view_directions(
    index: SurfaceIndex, visibility: Visibility, points: NDArray[Any], T_ca: Pose, gate_m: float
) -> Directions:
    """Return the directions that a view determines at a pose, and the others; arguments as in
    ``evidence``.
    """
    return _directions(without_dominant_patches(evidence(index, visibility, points, T_ca, gate_m)))


def _directions(used: Evidence) -> Directions:
    return Directions.of(used.normals.sum(axis=0), int(used.counts.sum()), used.centre)
