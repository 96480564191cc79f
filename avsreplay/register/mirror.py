"""Whether the mirror image of a model explains the accepted scans of a run better than the model
itself.

A mirrored model of a nearly mirror-symmetric object is accepted on many scans, because only its
marks are on the wrong side. The mirror image needs no index of its own: a scan that is reflected in
the frame of the sensor is one of the reflected object.

Reflections: the motions with a mirroring that carry most of the surface onto itself. Planes through
its centroid are compared by the distances of reflected points, and the best of them are registered.
With the pose T_cs of the sensor in {C}, the reflection S in the frame of the sensor and one of
these motions R, the reflected scan is near R T_cs S.

Decision: the poses of a scan and of its reflection are refined in the same way, and each point has
the difference of its truncated squared distances, in units of three standard deviations of the
noise. The mean over a patch of the model and over all scans counts as one observation, because
errors of the model are alike within a patch and in every scan. The log likelihood ratio of a normal
error is 4.5 times this mean. It is limited to log((1 - e) / e), where e is the share of the patches
that contradict the true shape. The mirror image is better if the sum decides for it, and what is
against it is a small part of what is for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.records import Surface
from avsreplay.register.comparison import CONTRADICTING_SHARE, MOST_AGAINST
from avsreplay.register.evidence import MEASURED_OF_EXTENT, robust_noise
from avsreplay.register.quality import PATCH_OF_EXTENT
from avsreplay.register.registrar import Registrar
from avsreplay.register.sampling import directions, sample_evenly
from avsreplay.register.size import OFF_PLANES
from avsreplay.register.surface_index import IcpParams, SurfaceIndex
from avsreplay.register.visibility import LEAST_FACING, TESTED_POINTS

S = np.diag([-1.0, 1.0, 1.0, 1.0])  # the reflection in the frame of the sensor
# scans that are compared, from directions so far apart
MOST_REFLECTED = 6
DIRECTION_COSINE = np.cos(np.radians(30.0))
REFLECTED_POINTS = 600  # of a scan, with which the poses are chosen and refined
# planes, and points of the surface that are reflected
MIRROR_PLANES = 200
PLANE_TEST_POINTS = 100
REFLECTED_SURFACE_POINTS = 400
# planes that are registered, with normals so far apart
NEAR_PLANES = 16
PLANES_APART = np.cos(np.radians(12.0))
# most reflections, and rotation between them
REFLECTIONS = 6
SAME_TRACE = 1.0 + 2.0 * np.cos(np.radians(5.0))
# truncation of distances; largest mean after each stage
TRUNCATION_OF_EXTENT = 0.03
ROUGHLY = 0.5
UNCARRIED = 0.3
TO_MODEL = (
    (0.12, 5),
    (0.05, 5),
    (0.02, 5),
)  # rejection distances [extent] and passes of a reflected surface
TO_SCAN = ((0.03, 4), (0.015, 4), (0.008, 6))  # and of a scan
# reflections of which a scan is refined, and truncation to choose them
REFINED_REFLECTIONS = 2
TRIED_OF_EXTENT = 0.02
# truncation: noise, least
NOISE = 3.0
LEAST_OF_EXTENT = 0.003
# fewest points of a patch
PATCH_POINTS = 4
# log likelihood ratio that decides
MIRROR_LOG_RATIO = 6.0
ENOUGH = 3  # scans that decide for the model, after which no more are compared
# share of the points off the model, above which the mirror image of one scan is searched
MOST_OFF = 0.1


@value_class
class SeenScan:
    """Points (n, 3) of a registered scan in the frame of the sensor [m], and the pose of the sensor
    in {C}.
    """

    points: NDArray[np.float32]
    T_cs: Pose


@value_class
class _Compared:
    """A scan at the poses of the model and of its mirror image.

    Attributes:
        points: (n, 3) in {C} [m].
        gain: (n,) what each point has in favour of the mirror image, from -1 to 1.
        off: share of the points off the model.
    """

    points: Array
    gain: Array
    off: float


def from_another_side(T_cs: Pose, kept: Sequence[SeenScan], middle: Array) -> bool:
    """Return whether a sensor sees another side of the target, with its middle (3,) in {C} [m],
    than those kept.
    """
    sight = _sight(T_cs, middle)
    return all(float(sight @ _sight(each.T_cs, middle)) < DIRECTION_COSINE for each in kept)


def _sight(T_cs: Pose, middle: Array) -> Array:
    away = middle - T_cs.t
    return np.asarray(away / max(float(np.linalg.norm(away)), np.finfo(float).tiny))


def wanted(kept: Sequence[SeenScan]) -> bool:
    """Return whether more scans are needed."""
    return len(kept) < MOST_REFLECTED


def reflected(points: NDArray[Any]) -> NDArray[Any]:
    """Return the reflection of points (n, 3) in the frame of the sensor."""
    return np.ascontiguousarray(points * S.diagonal()[:3])


def mirror_image_fits(registrar: Registrar, surface: Surface, scans: Sequence[SeenScan]) -> bool:
    """Return whether the mirror image of a model explains scans better than the model.

    Args:
        registrar: of the model.
        surface: the model, vertices in {C} [m].
        scans: accepted scans; the points of one are at the instant of its pose.
    """
    if not scans:
        return False
    motions, extent, compared = (
        reflections(surface, registrar.index),
        registrar.index.extent_m,
        list[_Compared](),
    )
    for scan in scans:
        compared.append(_compared(registrar, scan, [R @ scan.T_cs.matrix @ S for R in motions]))
        if sum(_decide([each], extent, -1.0) for each in compared) == ENOUGH:
            break
    sure = [_decide([each], extent) for each in compared]
    worst = int(np.argmax([each.off for each in compared]))
    if not any(sure) and compared[worst].off > MOST_OFF:
        compared[worst] = _searched(registrar, scans[worst], compared[worst])
        sure[worst] = _decide([compared[worst]], extent)
    if any(sure):  # the motions may not contain those of the other scans
        compared += [_compared(registrar, scan, []) for scan in scans[len(compared) :]]
        sure += [False] * (len(compared) - len(sure))
        of = zip(scans, compared, sure, strict=True)
        compared = [
            each if decided else _searched(registrar, scan, each) for scan, each, decided in of
        ]
    return _decide(compared, extent)


def _searched(registrar: Registrar, scan: SeenScan, before: _Compared) -> _Compared:
    """The comparison with the mirror image where a search finds it, if that is better for it than
    ``before``.
    """
    found = registrar.acquire(reflected(scan.points))
    if not found.measured:
        return before
    again = _compared(registrar, scan, [found.T_ac.inverse().matrix])
    return max(before, again, key=lambda each: float(each.gain.sum()))


def _decide(compared: Sequence[_Compared], extent_m: float, sign: float = 1.0) -> bool:
    """Whether scans decide for the mirror image, or with a ``sign`` of -1 for the model."""
    most = float(np.log((1.0 - CONTRADICTING_SHARE) / CONTRADICTING_SHARE))
    ratio = sign * np.clip(0.5 * NOISE**2 * _by_patch(compared, extent_m), -most, most)
    gain, against = float(ratio[ratio > 0.0].sum()), -float(ratio[ratio < 0.0].sum())
    return gain - against > MIRROR_LOG_RATIO and against < MOST_AGAINST * gain


def reflections(surface: Surface, index: SurfaceIndex) -> Array:
    """Return the motions with a mirroring that carry most of a surface onto itself, the best first.

    Args:
        surface: vertices in {C} [m].
        index: of the surface.

    Returns:
        (k, 4, 4) in {C}, all different, with determinants of -1.
    """
    points = sample_evenly(surface, REFLECTED_SURFACE_POINTS)[0]
    few, middle = points[:: max(1, len(points) // PLANE_TEST_POINTS)], points.mean(axis=0)
    normals = directions(2 * MIRROR_PLANES)[:MIRROR_PLANES]  # a half of the sphere
    planes = np.tile(np.eye(4), (MIRROR_PLANES, 1, 1))
    planes[:, :3, :3] -= 2.0 * normals[:, :, None] * normals[:, None, :]
    planes[:, :3, 3] = 2.0 * normals * (normals @ middle)[:, None]
    cost = _uncarried(index, few, planes, 2.0 * TRUNCATION_OF_EXTENT)
    chosen = list[int]()
    for k in np.argsort(cost, kind="stable").tolist():
        if len(chosen) < NEAR_PLANES and all(
            abs(normals[k] @ normals[j]) < PLANES_APART for j in chosen
        ):
            chosen.append(k)
    moved = planes[chosen]
    for part, stages, most in ((few, TO_MODEL[:1], ROUGHLY), (points, TO_MODEL[1:], UNCARRIED)):
        ended = [
            _refined(index, _moved(part, T), Pose.identity(), stages, False).matrix @ T
            for T in moved
        ]
        moved = np.reshape(ended, (-1, 4, 4))
        cost = _uncarried(index, points, moved, TRUNCATION_OF_EXTENT)
        order = np.argsort(cost, kind="stable")
        moved = _different(moved[order[cost[order] < most]])
    return moved[:REFLECTIONS]


def _different(motions: Array) -> Array:
    """The motions (k, 4, 4) that differ from all before them by a rotation."""
    kept = [
        k
        for k, T in enumerate(motions)
        if (np.einsum("kij,ij->k", motions[:k, :3, :3], T[:3, :3]) < SAME_TRACE).all()
    ]
    return np.asarray(motions[kept])


def _moved(points: Array, T: Array) -> Array:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _uncarried(index: SurfaceIndex, points: Array, motions: Array, width: float) -> Array:
    """Mean of min(1, squared distance) of points (n, 3) after each motion (k, 4, 4);
    ``width`` is over the extent.
    """
    width_m = min(width * index.extent_m, index.reach_m)
    moved = points @ motions[:, :3, :3].transpose(0, 2, 1) + motions[:, None, :3, 3]
    distance = index.distances(moved.reshape(-1, 3), Pose.identity(), width_m, False, 1, 0.0)[0]
    return np.asarray(np.mean((distance.reshape(len(motions), len(points)) / width_m) ** 2, axis=1))


def _refined(
    index: SurfaceIndex, points: Array, T: Pose, stages: Sequence[tuple[float, int]], sided: bool
) -> Pose:
    """A pose T_cs after passes with falling rejection distances."""
    small = IcpParams(tighten=0.0, eps_rad=1e-4, eps_m=1e-4 * index.extent_m)
    for gate, n in stages:
        facing = sided and index.faces_camera(points, T, TESTED_POINTS, LEAST_FACING)
        rule = replace(small, n_max=n, n_plane=n, gate_m=gate * index.extent_m, facing=facing)
        T = Pose.from_matrix(index.icp(points, T, rule).T_ca)
    return T


def _compared(registrar: Registrar, scan: SeenScan, starts: Sequence[Array]) -> _Compared:
    """Compare the poses of a scan and of its reflection, from poses (k, 4, 4) of the sensor in {C}
    for the latter.
    """
    index, sided = registrar.index, registrar.sided
    points = scan.points.astype(np.float64)
    image = reflected(points)

    def distance(part: Array, T: Pose, most: float) -> Array:
        return index.distances(part, T, most * index.extent_m, sided, TESTED_POINTS, LEAST_FACING)[
            0
        ]

    def of_image(T: Pose) -> float:
        return float(np.mean(distance(some_of_image, T, TRIED_OF_EXTENT) ** 2))

    some, some_of_image = _some(points, REFLECTED_POINTS), _some(image, REFLECTED_POINTS)
    best = sorted(map(Pose.from_matrix, starts), key=of_image)[:REFINED_REFLECTIONS]
    ended = [_refined(index, some_of_image, T, TO_SCAN, sided) for T in best]
    own, mirrored = (
        _refined(index, some, scan.T_cs, TO_SCAN, sided),
        min(ended, key=of_image, default=None),
    )
    by_model = distance(points, own, MEASURED_OF_EXTENT)
    by_image = (
        np.full_like(by_model, np.inf)
        if mirrored is None
        else distance(image, mirrored, MEASURED_OF_EXTENT)
    )
    width = max(
        NOISE * min(map(robust_noise, (by_model, by_image))), LEAST_OF_EXTENT * index.extent_m
    )
    by_model, by_image = (np.minimum(each / width, 1.0) ** 2 for each in (by_model, by_image))
    return _Compared(own.apply(points), by_model - by_image, float(np.mean(by_model == 1.0)))


def _some(points: Array, count: int) -> Array:
    return np.ascontiguousarray(points[:: max(1, len(points) // count)])


def _by_patch(compared: Sequence[_Compared], extent_m: float) -> Array:
    """Mean over each patch, of all scans, of what its points have in favour of the mirror image."""
    points, gain = (
        np.concatenate([getattr(each, name) for each in compared]) for name in ("points", "gain")
    )
    cell = np.floor(points / (PATCH_OF_EXTENT * extent_m) + OFF_PLANES).astype(np.int64)
    cell -= cell.min(axis=0)
    span = cell.max(axis=0) + 1
    of = np.unique((cell[:, 0] * span[1] + cell[:, 1]) * span[2] + cell[:, 2], return_inverse=True)[
        1
    ]
    counts = np.bincount(of)
    return np.asarray((np.bincount(of, gain) / counts)[counts >= PATCH_POINTS])
