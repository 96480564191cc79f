"""Registration of one scan to the model so far, search over many attitudes, and distances between
pairs of scans.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.reconstruct.views import ScanView, sight_lines
from avsreplay.register.size import normal_jacobian
from avsreplay.register.surface_index import kernel_module

SAME_SIDE_COSINE = 0.5  # least cosine between the normals of two corresponding points
REGISTERED_POINTS = 1500  # points of a scan in one registration
# Search over attitudes.
ATTITUDE_SEARCH_POINTS = 200
ATTITUDE_SEARCH_PASSES = 8
HALVING_PASSES = (2, 4, 5)  # passes after which the worse half of the attitudes is dropped
PAIR_TURN_RAD = np.radians(
    90.0
)  # key scans seen from directions closer than this are compared in the refinement
COMPARED_KEY_SCANS = 12  # most key scans with which one is compared
PAIR_POINTS = 600  # points of a scan in one comparison
LEAST_COMMON_POINTS = 30  # points that two scans must share to be compared
REFINED_ATTITUDES = 6  # poses of a search that are registered with all points


@value_class
class Patchwork:
    """The model so far: points (n, 3) [m] and unit normals (n, 3) in {C}, with a search tree
    over the points.
    """

    points: Array
    normals: Array
    tree: Any


@value_class
class Match:
    """A registered scan.

    Attributes:
        T_ac: pose of the model in the camera frame.
        ratio: share of the points that lie on the model.
        rms_m: root mean square of their point-to-plane distances [m].
        weakest: third smallest eigenvalue of the normal equations over the largest, in units of the
            extent; near 0 where the surface leaves three directions of the pose open (a sphere, a
            plane).
    """

    T_ac: Pose
    ratio: float
    rms_m: float
    weakest: float


def registered(
    view: ScanView, model: Patchwork, guess: Pose, reach_m: float, extent: float, passes: int = 40
) -> Match:
    """Point-to-plane ICP of a view on the model, with Tukey's weights whose scale follows the
    residuals.

    Args:
        view: the view.
        model: the model so far.
        guess: T_ac at which the search begins.
        reach_m: largest distance of corresponding points at first [m].
        extent: diameter of the target [m].
        passes: largest number of passes.
    """
    T_ca, gate = guess.inverse(), reach_m
    ratio = rms = weakest = 0.0
    for _ in range(passes):
        N, g, distances, ratio = _normal_equations(view, model, T_ca, gate)
        if len(distances) < 12:
            return Match(guess, 0.0, float("inf"), 0.0)
        rms = float(np.sqrt(np.mean(distances**2)))
        step, weakest = _solved(N, g, extent)
        T_ca = moved(T_ca, step)
        small = np.linalg.norm(step[:3]) * extent + np.linalg.norm(step[3:]) < 1e-5 * extent
        tighter = max(3.0 * 1.4826 * float(np.median(np.abs(distances))), 0.01 * extent)
        if small and tighter > 0.98 * gate:
            break
        gate = min(gate, tighter)
    return Match(T_ca.inverse(), ratio, rms, weakest)


def _normal_equations(
    view: ScanView, model: Patchwork, T_ca: Pose, gate: float
) -> tuple[Array, Array, Array, float]:
    """Sums J'WJ (6, 6) and J'We (6,) over corresponding points, their distances to the planes [m],
    and their share.
    """
    every = max(1, len(view.points) // REGISTERED_POINTS)
    p, n_view = T_ca.apply(view.points[::every]), view.normals[::every] @ T_ca.R.T
    distance, nearest = model.tree.query(p, most_m=gate)
    near = np.isfinite(distance[:, 0])
    index = np.where(near, nearest[:, 0], 0)
    near &= np.einsum("ni,ni->n", n_view, model.normals[index]) > SAME_SIDE_COSINE
    p, q, n = p[near], model.points[index[near]], between(n_view[near], model.normals[index[near]])
    e = np.einsum("ni,ni->n", n, q - p)
    w = np.maximum(1.0 - (e / gate) ** 2, 0.0) ** 2
    J = normal_jacobian(p, n)
    return (J * w[:, None]).T @ J, J.T @ (w * e), e, float(near.mean())


def between(a: Array, b: Array) -> Array:
    """Unit vectors halfway between unit normals a and b (n, 3).

    The distance along them is zero for two points of one circle, so that the curvature of a surface
    gives no bias (S. Rusinkiewicz, A symmetric objective function for ICP, ACM Transactions on
    Graphics 38(4), 2019).
    """
    both = a + b
    return np.asarray(both / np.linalg.norm(both, axis=1, keepdims=True))


def _solved(N: Array, g: Array, extent: float) -> tuple[Array, float]:
    """The step d = [theta; v] in {C}; directions that the surface does not determine are left
    out.
    """
    scale = np.array([1.0 / extent] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(N * np.outer(scale, scale))
    good = values > 1e-4 * values[-1]
    step = vectors[:, good] @ ((vectors[:, good].T @ (g * scale)) / values[good])
    return np.asarray(step * scale), float(values[2] / values[-1])


def moved(T_ca: Pose, step: Array) -> Pose:
    """The pose after a step [theta; v] in {C} [rad, m].

    Args:
        T_ca: the pose of {A} in {C}.
        step: rotation vector and displacement (6,) in {C} [rad, m].
    """
    return Pose(geometry.exp(step[:3]), step[3:]) @ T_ca


def best_starts(
    view: ScanView, model: Patchwork, attitudes: Array, gate_m: float, extent: float
) -> list[Pose]:
    """Return the REFINED_ATTITUDES poses with most points on the model, after a few passes from
    every attitude, all at once.

    A part of the points is registered; after the passes HALVING_PASSES the worse half of the poses
    is left out.

    Args:
        view: the scan.
        model: the model so far.
        attitudes: (m, 4) q_ac to start from, each where the visible side of the model is where the
            scan is.
        gate_m: largest distance of corresponding points [m].
        extent: of the target [m].
    """
    R_ac = geometry.matrix(attitudes)
    every = max(1, len(view.points) // ATTITUDE_SEARCH_POINTS)
    points, normals, centre = view.points[::every], view.normals[::every], view.points.mean(axis=0)
    R, t = R_ac.transpose(0, 2, 1), _visible_centres(model, R_ac, view.camera - centre)  # T_ca
    t = t - R @ centre
    gate, scale = np.full(len(R), gate_m), np.array([1.0 / extent] * 3 + [1.0] * 3)
    for number in range(ATTITUDE_SEARCH_PASSES):
        p, n = points @ R.transpose(0, 2, 1) + t[:, None], normals @ R.transpose(0, 2, 1)
        d, index = (
            found.reshape(p.shape[:2])
            for found in model.tree.query(p.reshape(-1, 3), most_m=gate_m)
        )
        near = np.isfinite(d) & (d < gate[:, None])
        index = np.where(near, index, 0)
        other = model.normals[index]
        near &= np.einsum("mki,mki->mk", n, other) > SAME_SIDE_COSINE
        both = n + other
        along = both / np.maximum(np.linalg.norm(both, axis=2, keepdims=True), 1e-12)
        e = np.where(near, np.einsum("mki,mki->mk", along, model.points[index] - p), np.nan)
        w = np.nan_to_num(np.maximum(1.0 - (e / gate[:, None]) ** 2, 0.0) ** 2)
        J = np.concatenate([np.cross(p, along), along], axis=2) * scale
        N, g = (
            (J * w[:, :, None]).transpose(0, 2, 1) @ J,
            np.einsum("mki,mk->mi", J, w * np.nan_to_num(e)),
        )
        values, vectors = np.linalg.eigh(N)
        inverse = np.where(values > 1e-4 * values[:, -1:], 1.0 / np.maximum(values, 1e-12), 0.0)
        step = scale * np.einsum(
            "mij,mj->mi", vectors, inverse * np.einsum("mji,mj->mi", vectors, g)
        )
        turn_ca = geometry.matrix(geometry.exp(step[:, :3]))
        R, t = turn_ca @ R, np.einsum("mij,mj->mi", turn_ca, t) + step[:, 3:]
        shown = (np.abs(np.nan_to_num(e, nan=gate_m)) < 0.02 * extent).mean(axis=1)
        few = near.sum(axis=1) < 12
        tighter = 3.0 * 1.4826 * np.nanmedian(np.where(few[:, None], gate_m, np.abs(e)), axis=1)
        gate = np.minimum(gate, np.maximum(tighter, 0.01 * extent))
        best = np.argsort(-shown, kind="stable")
        if number in HALVING_PASSES:
            kept = best[: max(REFINED_ATTITUDES, len(best) // 2)]
            R, t, gate, best = R[kept], t[kept], gate[kept], np.arange(len(kept))
    return [Pose(geometry.quaternion(R[m]), t[m]).inverse() for m in best[:REFINED_ATTITUDES]]


def _visible_centres(model: Patchwork, R_ac: Array, towards: Array) -> Array:
    """Centre (m, 3) of the side of the model that faces the camera in the direction ``towards``,
    for every attitude.
    """
    every = max(1, len(model.points) // REGISTERED_POINTS)
    points, normals = model.points[::every], model.normals[::every]
    facing = (normals @ (R_ac.transpose(0, 2, 1) @ towards).T > 0.0).T
    facing |= facing.sum(axis=1, keepdims=True) < 0.01 * len(points)
    return np.asarray((facing @ points) / facing.sum(axis=1, keepdims=True))


def near_attitudes(q_ac: Array) -> Array:
    """Return (m, 4) the attitude q_ac and those 12, 24, 36 and 50 degrees from it about 13 axes,
    both ways.
    """
    turns = [geometry.exp(np.radians(deg) * axis) for deg in (12, 24, 36, 50) for axis in _axes()]
    return np.array([q_ac] + [geometry.multiply(q_ac, turn) for turn in turns])


def _axes() -> list[Array]:
    every = [
        np.array((x, y, z), dtype=np.float64)
        for x in (-1, 0, 1)
        for y in (-1, 0, 1)
        for z in (-1, 0, 1)
    ]
    return [a / np.linalg.norm(a) for a in every if a.any()]


def pair_rms(views: Sequence[ScanView], poses: dict[int, Pose], gate: float) -> float:
    """Weighted rms of the distances between all overlapping pairs of views at poses T_ac [m].

    Args:
        views: the views, in order of time.
        poses: T_ac by number of the view.
        gate: largest distance of corresponding points [m].
    """
    keys = sorted(poses)
    T_ca = [poses[k].inverse() for k in keys]
    return Pairing([views[k] for k in keys], T_ca, PAIR_POINTS, 0.0).equations(T_ca, gate)[3]


class Pairing:
    """Corresponding points of overlapping pairs of views: of a point of view i the nearest point of
    view j.

    The points of a pair are searched again where the relative pose has changed by more than
    ``still_m`` at a corner of the box of view i: within a small share of the spacing of the points
    the distance along the normals does not depend on which of the neighbouring points corresponds.
    Each pair of a view takes every n-th point from another first one.

    Args:
        views: the n views that are compared.
        poses: their poses T_ca, which decide on the pairs.
        most: points of a view in one comparison.
        still_m: change of a relative pose that does not require a new search [m].
    """

    def __init__(
        self, views: Sequence[ScanView], poses: Sequence[Pose], most: int, still_m: float
    ) -> None:
        self._views, self._most, self._still_m, self._gate = views, most, still_m, 0.0
        self._pairs = overlapping(views, poses)
        self._corners = np.array(
            [
                list(product(*zip(v.points.min(axis=0), v.points.max(axis=0), strict=True)))
                for v in views
            ]
        )
        self._at = np.full((len(self._pairs), 8, 3), np.inf)
        self._found = [(np.zeros(0, np.int64), np.zeros(0, np.int64))] * len(self._pairs)

    def equations(self, poses: Sequence[Pose], gate: float) -> tuple[Array, Array, Array, float]:
        """Normal equations of the distances, along the mean of the two normals.

        Args:
            poses: T_ca of the views.
            gate: largest distance that counts [m].

        Returns:
            Normal matrix (6n, 6n) and right side (6n,) of steps [theta; v] in {C} of all poses, the
            distances [m], and their weighted rms [m] by Tukey's function, whose square the steps
            minimise.
        """
        views, count = self._views, len(self._views)
        first = np.cumsum([0] + [len(view.points) for view in views])
        p = np.vstack([T.apply(view.points) for view, T in zip(views, poses, strict=True)])
        n = np.vstack([view.normals @ T.R.T for view, T in zip(views, poses, strict=True)])
        self._search(p, n, first, poses, gate)
        used = np.array([len(own) >= LEAST_COMMON_POINTS for own, _ in self._found], dtype=bool)
        if not used.any():
            return np.eye(6 * count), np.zeros(6 * count), np.zeros(1), 0.0
        found = [pair for pair, good in zip(self._found, used, strict=True) if good]
        a, b = (np.concatenate([pair[k] for pair in found]) for k in (0, 1))
        begin = np.cumsum([0] + [len(own) for own, _ in found])
        weight = np.concatenate([view.weight for view in views])
        M, r, e, totals = kernel_module().pair_sums(p, n, weight, a, b, begin, gate)
        i, j = self._pairs[used].T
        N, g = np.zeros((count, count, 6, 6)), np.zeros((count, 6))
        for u, v, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
            np.add.at(N, (u, v), sign * M)
        np.add.at(g, i, r)
        np.add.at(g, j, -r)
        rms = float(gate * np.sqrt(totals[0] / totals[1] / 3.0))
        return N.transpose(0, 2, 1, 3).reshape(6 * count, 6 * count), g.ravel(), e, rms

    def _search(
        self, p: Array, n: Array, first: NDArray[np.int64], poses: Sequence[Pose], gate: float
    ) -> None:
        """Search the corresponding points of the pairs whose relative poses have changed; of
        all if the gate has.
        """
        if gate != self._gate:
            self._gate, self._at[:] = gate, np.inf
        for number, (i, j) in enumerate(self._pairs):
            to_j = poses[j].inverse()
            at = to_j.apply(poses[i].apply(self._corners[i]))
            if np.abs(at - self._at[number]).max() < self._still_m:
                continue
            every = max(1, (first[i + 1] - first[i]) // self._most)
            own = np.arange(first[i] + number % every, first[i + 1], every)
            d, index = self._views[j].tree.query(to_j.apply(p[own]), most_m=gate)
            near = np.isfinite(d[:, 0])
            own, other = own[near], first[j] + index[near, 0]
            same = np.einsum("ni,ni->n", n[own], n[other]) > SAME_SIDE_COSINE
            self._at[number], self._found[number] = at, (own[same], other[same])


def overlapping(views: Sequence[ScanView], poses: Sequence[Pose]) -> NDArray[np.int64]:
    """Ordered pairs (m, 2) of views at poses T_ca whose directions of view differ by less than
    PAIR_TURN_RAD.
    """
    found, directions = [], sight_lines(views, poses)
    for i, at in enumerate(directions):
        cosine = directions @ at
        order = [
            int(j)
            for j in np.argsort(-cosine, kind="stable")
            if j != i and cosine[j] > np.cos(PAIR_TURN_RAD)
        ]
        if order:
            found += [
                (i, order[int(k)])
                for k in np.unique(np.linspace(0, len(order) - 1, COMPARED_KEY_SCANS).round())
            ]
    return np.array(found, dtype=np.int64).reshape(-1, 2)
