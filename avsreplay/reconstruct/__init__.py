"""Reconstruct the model of an unknown target from the scans of a log, without a model and without an initial guess.

Three steps. (1) Tracking: each scan is registered against the model so far by point-to-plane ICP with an M-estimator,
from a constant-twist prediction; where that fails, a global search finds the pose. (2) Batch refinement: the poses of
the key scans minimise the point-to-plane distances between all pairs of key scans that overlap, including pairs that
see the same side again after a turn (loop closure). (3) Fusion: points and normals are averaged over the scans in a
voxel grid; a voxel through which rays of other scans have passed is removed (free-space carving by vote).

The frame {C} of the model is fixed to the target. Its axes are those of {A} at the first scan that is used, and its
origin is the centroid of that scan, until ``at_grasp`` moves it to a grasp point. Ground truth is never read.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from avsreplay import geometry
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import Array, Pose
from avsreplay.reconstruct.fusion import all_poses, fused, refined, turn_and_coverage
from avsreplay.reconstruct.tracking import ReconstructionParams, track
from avsreplay.reconstruct.views import extent_of, thinned_views
from avsreplay.records import Scan, Surface

__all__ = [
    "Deviations",
    "Reconstruction",
    "ReconstructionParams",
    "at_grasp",
    "deviations",
    "reconstruct",
    "reconstruction_ply",
    "surface_of",
]

WEAKEST = 1e-3  # below this ratio of the eigenvalues of a registration, a surface does not determine the pose


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """A model made from scans.

    Attributes:
        points: (n, 3) surface points in {C} [m].  normals: (n, 3) outward unit normals in {C}.
        one_sigma_m: (n,) standard error of each point along its normal [m].  scans: (n,) scans that saw each point.
        poses: instant and pose T_ac of every scan that was used.
        used, offered: scans used, and scans in the log.  searches: scans whose pose a global search found.
        coverage: share of all directions from which the target was seen.  turn_deg: largest angle between two views.
        rms_m: of the point-to-plane distances after the refinement [m].
        notes: what limits the result, in sentences.
    """

    points: Array
    normals: Array
    one_sigma_m: Array
    scans: NDArray[np.int64]
    poses: Sequence[tuple[int, Pose]]
    used: int
    offered: int
    searches: int
    coverage: float
    turn_deg: float
    rms_m: float
    notes: tuple[str, ...]


def reconstruct(scans: Iterable[Scan], params: ReconstructionParams | None = None) -> Reconstruction:
    """Build a model of the target from its scans.

    Args:
        scans: in order of time; their ground truth, if any, is not used.
        params: resolution and effort.

    Returns:
        The model in {C}, with poses of the scans that were used.

    Raises:
        UnreadableInput: fewer than three usable scans, or a target that did not turn or has no shape that fixes its
            pose; the message says which.
    """
    p = params or ReconstructionParams()
    offered = list(scans)
    step = max(1, -(-len(offered) // p.n_scans))
    usable = [s for s in offered[::step] if len(s.points) >= p.fewest_points]
    if len(usable) < 3:
        raise UnreadableInput(
            f"only {len(usable)} scans with {p.fewest_points} points or more", hint="a model needs three at least"
        )
    extent = float(np.median([extent_of(np.asarray(s.points[:: max(1, len(s.points) // 3000)], dtype=np.float64)) for s in usable]))
    views = thinned_views(usable, p.thin * extent)
    tracked = track(views, p, extent)
    if len(tracked.poses) < 3:
        hint = "smaller steps between scans, or fewer occluded scans, are needed"
        raise UnreadableInput(
            f"only {len(tracked.poses)} of {len(views)} scans could be registered to one another", hint=hint
        )
    keys, rms = refined(views, tracked, p, extent)
    poses = all_poses(views, tracked, keys, p, extent)
    turned, coverage = turn_and_coverage([views[k] for k in poses], list(poses.values()))
    _refuse_still(turned, tracked.weakest)
    surface = fused(views, poses, p.voxel * extent)
    notes = _notes(len(poses), len(views), coverage)
    found = tuple((views[k].t_ns, T) for k, T in sorted(poses.items()))
    return Reconstruction(
        *surface, found, len(found), len(offered), tracked.searches, coverage, np.degrees(turned), rms, notes
    )


def _refuse_still(turned: float, weakest: Sequence[float]) -> None:
    if turned < np.radians(5.0):
        what = f"the scans show a turn of {np.degrees(turned):.1f} deg only"
        known = float(np.median(weakest)) > WEAKEST
        why = "the target is at rest" if known else "its surface does not determine its attitude, as that of a sphere"
        raise UnreadableInput(f"{what}: {why}", hint="a model needs scans of several sides")


def _notes(used: int, offered: int, coverage: float) -> tuple[str, ...]:
    notes = []
    if used < 0.8 * offered:
        notes.append(f"{offered - used} of {offered} scans could not be registered and are not part of the model")
    if coverage < 0.5:
        notes.append(f"the target was seen from {100.0 * coverage:.0f} % of all directions only")
    return tuple(notes)


def at_grasp(made: Reconstruction, grasp: Array | None = None) -> Reconstruction:
    """Move the frame {C} to a grasp point: origin there, x axis along the outward normal of the surface.

    Args:
        made: the reconstruction.
        grasp: (3,) in {C} [m]; None chooses the flattest patch: the one whose normals differ least within a radius of
            4 % of the extent, among patches that enough scans have seen.

    Raises:
        UsageError: the point is farther from the surface than 5 % of the extent.
    """
    extent, tree = float(np.linalg.norm(np.ptp(made.points, axis=0))), cKDTree(made.points)
    if grasp is None:
        chosen = np.flatnonzero(made.scans >= np.median(made.scans))[::4]
        near: Any = tree.query_ball_point(made.points[chosen], 0.04 * extent)
        full = np.median([len(k) for k in near])
        flat = [float(np.linalg.norm(made.normals[k].mean(axis=0))) if len(k) >= full else 0.0 for k in near]
        grasp = made.points[chosen[int(np.argmax(flat))]]
    distance, nearest = tree.query(grasp)
    if distance > 0.05 * extent:
        hint = "give a point of the reconstructed model, in its frame"
        raise UsageError(f"the grasp point is {distance:.3f} m from the surface", where="--grasp", hint=hint)
    index = tree.query_ball_point(made.points[nearest], 0.04 * extent)
    x = made.normals[index].mean(axis=0)
    x /= np.linalg.norm(x)
    y = np.cross([0.0, 0.0, 1.0] if abs(x[2]) < 0.9 else [1.0, 0.0, 0.0], x)
    y /= np.linalg.norm(y)
    T_old_new = Pose(geometry.quaternion(np.column_stack([x, y, np.cross(x, y)])), np.asarray(grasp))
    poses = tuple((t_ns, T_ac @ T_old_new) for t_ns, T_ac in made.poses)
    inverse = T_old_new.inverse()
    return replace(made, points=inverse.apply(made.points), normals=made.normals @ inverse.R.T, poses=poses)


def surface_of(made: Reconstruction) -> Surface:
    """Return the reconstruction as the model of a replay: a point cloud in {C} [m].

    Args:
        made: the reconstruction.
    """
    data = reconstruction_ply(made)
    none = np.zeros((0, 3), dtype=np.int32)
    return Surface(made.points, none, "reconstructed.ply", hashlib.sha256(data).hexdigest(), data)


@dataclass(frozen=True, slots=True, eq=False)
class Deviations:
    """Distances of a reconstructed surface from a CAD model.

    Attributes:
        T_mc: pose of the reconstruction's {C} in the frame of the CAD model.
        signed_m: (n,) distance of each point from the CAD surface, positive outside [m]; NaN beyond ``most_m``.
        most_m: largest distance that is measured.  inlier_ratio: share of the points nearer than that.
        median_m, p95_m: median and 95 % quantile of the absolute distances that were measured [m].
    """

    T_mc: Pose
    signed_m: Array
    most_m: float
    inlier_ratio: float
    median_m: float
    p95_m: float


def deviations(made: Reconstruction, cad: Surface) -> Deviations:
    """Register a reconstruction to a CAD model and measure the distance of every point.

    Args:
        made: the reconstruction.
        cad: the model to compare with, in metres.

    Raises:
        UnreadableInput: no pose was found at which the two agree.
    """
    from avsreplay.register import Registrar
    from avsreplay.register.surface_index import SurfaceIndex

    found = Registrar(cad).acquire(made.points)
    if not found.measured:
        raise UnreadableInput(
            "the reconstruction does not fit the CAD model", where=cad.name, hint="check model and unit"
        )
    T_mc, most = found.T_ac.inverse(), 0.05 * cad.extent
    p_m = T_mc.apply(made.points)
    closest = SurfaceIndex.build(cad, most).closest(p_m)
    far = np.sqrt(closest.d2)
    outside = np.einsum("ni,ni->n", np.nan_to_num(closest.normal), p_m - np.nan_to_num(closest.foot)) >= 0.0
    signed = np.where(far < most, np.where(outside, far, -far), np.nan)
    known = np.abs(signed[np.isfinite(signed)])
    if not len(known):
        raise UnreadableInput("no point lies near the CAD model", where=cad.name, hint="check model and unit")
    ratio = float(np.isfinite(signed).mean())
    return Deviations(T_mc, signed, most, ratio, float(np.median(known)), float(np.quantile(known, 0.95)))


def reconstruction_ply(made: Reconstruction, found: Deviations | None = None) -> bytes:
    """Return a binary PLY file: points, normals, ``one_sigma`` [m], number of scans, and colours of the deviations.

    Args:
        made: the reconstruction.
        found: deviations from a CAD model; colours run from blue (inside) through white to red (outside).
    """
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
    fields += [("one_sigma", "<f4"), ("scans", "<i4")]
    fields += [(name, "u1") for name in ("red", "green", "blue")] if found else []
    table = np.zeros(len(made.points), dtype=fields)
    for k, axis in enumerate("xyz"):
        table[axis], table[f"n{axis}"] = made.points[:, k], made.normals[:, k]
    table["one_sigma"], table["scans"] = made.one_sigma_m, made.scans
    if found:
        share = np.clip(np.nan_to_num(found.signed_m / max(3.0 * found.median_m, 1e-9), nan=1.0), -1.0, 1.0)
        table["red"] = np.round(255.0 * np.minimum(1.0, 1.0 + share))
        table["green"] = np.round(255.0 * (1.0 - np.abs(share)))
        table["blue"] = np.round(255.0 * np.minimum(1.0, 1.0 - share))
    words = {"<f4": "float", "<i4": "int", "u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", "comment reconstructed by avsreplay, metres, frame {C}"]
    head += [
        f"element vertex {len(table)}",
        *(f"property {words[kind]} {name}" for name, kind in fields),
        "end_header",
        "",
    ]
    return "\n".join(head).encode("ascii") + table.tobytes()
