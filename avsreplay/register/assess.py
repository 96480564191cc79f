"""One ruler for every back end: inliers, rms, information, covariance and a status, from the pose alone.

With p_c = T_ca p_a, foot c and face normal n, the error d = [theta; v] in {C}, T_ac_true = T_ac @ Exp(d), shows as
n . (p_c - c) = J d + noise, J = [p_c x n, n]. Sums over the inliers give everything below.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Alignment, AlignStatus, Fit
from avsreplay.register.facing import View
from avsreplay.register.freedom import free_directions, loose_directions
from avsreplay.register.params import Limits, RegisterParams
from avsreplay.register.surface_index import Closest, SurfaceIndex

__all__ = ["Evidence", "assess", "counted", "covariance", "evidence", "instants", "nothing"]

PATCH_OF_EXTENT = 0.05  # residuals of points nearer than this may agree with one another
LEAST_PATCHES = 24
# What the jackknife leaves out (closest points near edges lean one way), by tests/benchmarks/estimate_noise.py.
UNEXPLAINED = 1.1
LONE = 0.5  # of what is known of a motion: more than that from one patch, and the patch does not count
SIGMA_PER_MEDIAN = 1.4826  # of |e| for a normal e
ALONE = 1e-9  # keeps the motion that one patch alone holds finite
NOISE_FLOOR_OF_GATE = 1e-6  # an exact scan must not claim infinite information


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What the inliers at a pose say, all in {C}.

    Attributes:
        points: of the scan.  inliers: nearer than the gate to the model, or to its sides
            that face the camera where its place is known.  rms_m: of their distances.
        J: (k, 6) rows [p x n, n].  e: (k,) n . (p - foot) [m].  centre: (3,) centroid of the inliers.
        noise_m: 1 sigma of e, robust.  patch: (k,) number of the patch of the model that each inlier lies on.
        normals, pulls: (m, 6, 6) and (m, 6) sums of J'J and of e J over each of the m patches.
    """

    points: int
    inliers: int
    rms_m: float
    J: Array
    e: Array
    centre: Array
    noise_m: float
    patch: NDArray[np.intp]
    normals: Array = field(init=False)
    pulls: Array = field(init=False)

    def __post_init__(self) -> None:
        normals, pulls = _patch_sums(self.J, self.e, self.patch)
        object.__setattr__(self, "normals", normals)
        object.__setattr__(self, "pulls", pulls)


def evidence(
    model: SurfaceIndex, view: View, points: NDArray[Any], T_ca: Pose, gate_m: float, noise_m: float | None = None
) -> Evidence:
    """Gather it: ``points`` (n, 3) in {A} [m]; ``noise_m`` None estimates it from the residuals."""
    moved, found, near = _met(model, view, points, T_ca, gate_m)
    p, n = moved[near], found.normal[near]
    e = np.einsum("ij,ij->i", n, p - found.foot[near])
    count = len(p)
    rms = float(np.sqrt(found.d2[near].mean())) if count else float("nan")
    centre = p.mean(axis=0) if count else np.zeros(3)
    J = _rows(p, n)
    noise = noise_m or _noise(e, gate_m)
    return Evidence(len(points), count, rms, J, e, centre, noise, _patches(p, PATCH_OF_EXTENT * model.extent_m))


def instants(
    model: SurfaceIndex, view: View, points: NDArray[Any], times_s: NDArray[Any], T_ca: Pose, gate_m: float
) -> Array:
    """(6, 6) M [s]: a pose error d(t) = d0 + t d1 inside the scan is registered as d0 + M d1.

    Point k, at ``times_s`` (n,), says J_k d(t_k), so the least squares give N^-1 (sum of t J'J) = M, N = J'J. What no
    inlier sees takes the mean of all times.
    """
    moved, found, near = _met(model, view, points, T_ca, gate_m)
    times = np.asarray(times_s, dtype=np.float64)
    mean = float(times.mean()) if len(times) else 0.0
    J = _rows(moved[near], found.normal[near])
    M: Array = mean * np.eye(6) + np.linalg.pinv(J.T @ J, hermitian=True) @ ((J.T * (times[near] - mean)) @ J)
    return M


def _met(
    model: SurfaceIndex, view: View, points: NDArray[Any], T_ca: Pose, gate_m: float
) -> tuple[Array, Closest, NDArray[np.bool_]]:
    """Points in {C} (n, 3), what of the model is closest to each, and which are inliers (n,)."""
    moved = T_ca.apply(points)
    found = model.closest(moved, camera_c=view.camera_c(model, points, T_ca))
    return moved, found, found.d2 < gate_m**2


def _rows(p: Array, n: Array) -> Array:
    """J (k, 6) of points p and normals n (k, 3)."""
    return np.hstack([np.cross(p, n), n])


def _patches(p: Array, size_m: float) -> NDArray[np.intp]:
    """Number of the cubic cell each point lies in; each point is a patch of its own where too few cells would be."""
    cells = np.floor(p / size_m).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    code = (cells[:, 0] * (cells[:, 1].max(initial=0) + 1) + cells[:, 1]) * (cells[:, 2].max(initial=0) + 1)
    patch = np.unique(code + cells[:, 2], return_inverse=True)[1].reshape(-1)
    return patch if patch.max(initial=0) >= LEAST_PATCHES else np.arange(len(p))


def _noise(e: Array, gate_m: float) -> float:
    floor = NOISE_FLOOR_OF_GATE * gate_m
    return max(SIGMA_PER_MEDIAN * float(np.median(np.abs(e))), floor) if len(e) else floor


def covariance(found: Evidence) -> Array:
    """(6, 6) covariance of d = [theta; v]: what leaving out one patch after the other does to it, squared and summed.

    Errors within a patch may agree (the model is off there, a range error seen at a slant, outliers that stick to it);
    patches are taken as independent. Without patch p, of sums N_p = J'J and g_p = sum of e J, d moves by
    (N - N_p)^-1 g_p = N^-1 (I - N_p N^-1)^-1 g_p: a patch that holds much shows more than its residuals.
    """
    bread = np.linalg.pinv(found.normals.sum(axis=0), hermitian=True)
    left = (1.0 + ALONE) * np.eye(6) - found.normals @ bread
    moved = np.linalg.solve(left, found.pulls[:, :, None])[:, :, 0] @ bread
    P: Array = moved.T @ moved
    return 0.5 * (P + P.T)


def counted(found: Evidence) -> Evidence:
    """The evidence without the patches that tell more than ``LONE`` of a motion by themselves.

    On a bare box the side that is hardly seen is held by a few points next to its edge, which may be its neighbour's.
    """
    while True:
        share = found.normals @ np.linalg.pinv(found.normals.sum(axis=0), hermitian=True)
        lone = np.trace(share, axis1=1, axis2=2) > LONE  # the largest eigenvalue is at most the trace
        lone[lone] = np.linalg.eigvals(share[lone]).real.max(axis=1, initial=0.0) > LONE
        keep = ~lone[found.patch]
        if not lone.any() or np.count_nonzero(keep) < 6:
            return found
        patch = np.unique(found.patch[keep], return_inverse=True)[1].reshape(-1)
        found = replace(found, J=found.J[keep], e=found.e[keep], patch=patch)


def _patch_sums(J: Array, e: Array, patch: NDArray[np.intp]) -> tuple[Array, Array]:
    """Sums of J'J (m, 6, 6) and of e J (m, 6) over each patch."""
    count = int(patch.max(initial=-1)) + 1
    normals = np.empty((count, 6, 6))
    for a in range(6):
        for b in range(a + 1):
            normals[:, a, b] = normals[:, b, a] = np.bincount(patch, J[:, a] * J[:, b], count)
    g = np.empty((count, 6))
    for a in range(6):
        g[:, a] = np.bincount(patch, J[:, a] * e, count)
    return normals, g


def assess(
    model: SurfaceIndex, view: View, points: NDArray[Any], fit: Fit, limits: Limits, params: RegisterParams
) -> Alignment:
    """Grade a back end's pose. No or too few inliers is NO_OVERLAP whatever the back end's flag says."""
    if not (np.isfinite(fit.T_ca.t).all() and np.isfinite(fit.T_ca.q).all()):
        return nothing(len(points), AlignStatus.FAILED)
    found = evidence(model, view, points, fit.T_ca, limits.gate_m, params.noise_m)
    overlap = found.inliers >= max(params.min_inliers, params.min_inlier_ratio * found.points)
    found = counted(found) if overlap else found
    info = frozen(found.J.T @ found.J / found.noise_m**2)
    weakest = free_directions(found.J, found.centre) if overlap else ()
    P: Array | None = UNEXPLAINED * covariance(found) if overlap and not weakest else None
    loose = () if P is None else loose_directions(P, model.extent_m)
    if P is not None and loose:
        info, P, weakest = frozen(np.linalg.pinv(P, hermitian=True)), None, loose
    return Alignment(
        T_ac=fit.T_ca.inverse(),
        iterations=fit.iterations,
        converged=fit.converged,
        points=found.points,
        inliers=found.inliers,
        rms_m=found.rms_m,
        info=info,
        status=_status(overlap, fit.converged, bool(weakest)),
        covariance=None if P is None else frozen(P),
        weakest=", ".join(weakest),
    )


def nothing(points: int, status: AlignStatus, T_ac: Pose | None = None) -> Alignment:
    """An alignment that measured nothing: the guess kept, no inliers, no information."""
    pose = T_ac if T_ac is not None else Pose.identity()
    return Alignment(pose, 0, False, points, 0, float("nan"), frozen(np.zeros((6, 6))), status)


def _status(overlap: bool, converged: bool, free: bool) -> AlignStatus:
    if not overlap:
        return AlignStatus.NO_OVERLAP
    if not converged:
        return AlignStatus.NOT_CONVERGED
    return AlignStatus.DEGENERATE if free else AlignStatus.ALIGNED
