"""The reconstructed model: its frame, its comparison with a CAD model, and the files that
hold it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from avsreplay import geometry
from avsreplay.errors import MissingBackend, UnreadableInput, UsageError, value_class
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.reconstruct.fusion import Sight
from avsreplay.reconstruct.tracking import FreeMotion
from avsreplay.reconstruct.views import averaged, point_tree
from avsreplay.records import BLOCKS, Surface

PATCH_RADIUS_OF_EXTENT = 0.04  # radius of a grasp patch as a share of the extent
APPROACH_COSINE = np.cos(
    np.radians(20.0)
)  # cosine of the half-angle of the cone about the outward normal that must be free
MAX_REGIONS = 10
LEAST_REGION_POINTS = 10  # least number of points of a region
LEAST_EMPTY_SCANS = 3.0  # least number of scans without a return from a surface that they faced


@value_class
class Reconstruction:
    """A model made from scans.

    Attributes:
        points: (n, 3) surface points in {C} [m].
        normals: (n, 3) outward unit normals.
        one_sigma_m: (n,) standard error of each point along its normal [m].
        scans: (n,) scans that saw each point.
        poses: instant and pose T_ac of every scan that was used.
        used, offered: scans used, and scans in the log.
        searches: scans whose pose a global search found.
        coverage: share of all directions from which the target was seen.
        turn_deg: largest angle between two views.
        rms_m: of the point-to-plane distances after the refinement [m].
        voxel_m: edge of the voxels in which points were averaged [m].
        notes: what limits the result, in sentences.
        motion: the free motion of a rigid body that the poses follow, None if they do not.
        T_oc: pose of {C} in the frame {C} to which ``motion`` refers.
        sights: views of a bounded number of scans.
        frame: origin and axes of {C} in words.
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
    voxel_m: float
    notes: tuple[str, ...]
    motion: FreeMotion | None
    sights: tuple[Sight, ...]
    frame: str
    T_oc: Pose = field(default_factory=Pose.identity)

    @property
    def extent(self) -> float:
        """Return the diagonal of the bounding box [m]."""
        return geometry.bounding_diagonal(self.points)

    @property
    def spacing_m(self) -> float:
        """Distance up to which neighbouring points, or rays of one scan, belong to one
        surface [m].
        """
        return 1.5 * self.voxel_m

    @property
    def mass_centre(self) -> tuple[Array, float] | None:
        """Mass centre (3,) in {C} [m] and its 1 sigma, the root of the trace [m]; None if the
        motion is not known.
        """
        if self.motion is None:
            return None
        centre, spread = self.motion.mass_centre_c
        return self.T_oc.inverse().apply(centre), spread

    @property
    def principal_axes(self) -> tuple[Array, float] | None:
        """Attitude q_cb (4,) of the principal axes in {C} and its 1 sigma [rad]; None if the
        motion is not known.
        """
        if self.motion is None:
            return None
        P = self.motion.P[BLOCKS["mu"], BLOCKS["mu"]]
        q_ob = geometry.conjugate(self.motion.state.q_bc)
        return geometry.multiply(geometry.conjugate(self.T_oc.q), q_ob), 2.0 * float(
            np.sqrt(np.trace(P))
        )


def at_grasp(made: Reconstruction, grasp: Array | None = None) -> Reconstruction:
    """Move the frame {C} to a grasp point: origin there, x axis along the outward normal of the
    surface.

    Args:
        made: the reconstruction.
        grasp: (3,) in {C} [m]; None chooses the flattest reachable patch, whose normals differ
            least within a radius of 4 % of the extent. Enough scans must have seen it, and no other
            point may lie within 20 degrees of its outward normal up to half the extent.

    Raises:
        UsageError: the point is farther from the surface than 5 % of the extent.
    """
    tree, chosen_by = (
        cKDTree(made.points),
        "the given point" if grasp is not None else "the flattest reachable patch",
    )
    if grasp is None:
        grasp = _flattest(made)
    distance, nearest = tree.query(grasp)
    if distance > 0.05 * made.extent:
        hint = "give a point of the reconstructed model, in its frame"
        raise UsageError(
            f"the grasp point is {distance:.3f} m from the surface", where="--grasp", hint=hint
        )
    index = tree.query_ball_point(made.points[nearest], PATCH_RADIUS_OF_EXTENT * made.extent)
    x = _unit(made.normals[index].mean(axis=0))
    y = _unit(np.cross([0.0, 0.0, 1.0] if abs(x[2]) < 0.9 else [1.0, 0.0, 0.0], x))
    T_old_new = Pose(
        geometry.quaternion(np.column_stack([x, y, np.cross(x, y)])), np.asarray(grasp)
    )
    inverse = T_old_new.inverse()
    return replace(
        made,
        points=inverse.apply(made.points),
        normals=made.normals @ inverse.R.T,
        poses=tuple((t_ns, T_ac @ T_old_new) for t_ns, T_ac in made.poses),
        sights=tuple(replace(sight, T_ac=sight.T_ac @ T_old_new) for sight in made.sights),
        T_oc=made.T_oc @ T_old_new,
        frame=f"origin at {chosen_by}, x along the outward normal there",
    )


def _flattest(made: Reconstruction) -> Array:
    """The centre of the flattest patch that can be approached; of the flattest one if none can."""
    points, normals, cell = averaged(made.points, made.normals, made.extent / 100.0)
    scans = np.bincount(cell, made.scans) / np.bincount(cell)
    chosen = np.flatnonzero(scans >= np.median(scans))
    chosen = chosen[:: max(1, len(chosen) // 4000)]
    near: Any = cKDTree(points).query_ball_point(
        points[chosen], PATCH_RADIUS_OF_EXTENT * made.extent
    )
    full = np.median([len(k) for k in near])
    flat = np.array(
        [float(np.linalg.norm(normals[k].mean(axis=0))) if len(k) >= full else 0.0 for k in near]
    )
    order = np.argsort(-flat, kind="stable")
    for k in order[flat[order] > 0.0]:
        if _reachable(points, made.extent, points[chosen[k]], normals[near[k]].mean(axis=0)):
            return np.asarray(points[chosen[k]])
    return np.asarray(points[chosen[order[0]]])


def _reachable(points: Array, extent: float, at: Array, normal: Array) -> bool:
    """Whether the cone about the outward normal is free of points of the model."""
    away = points - at
    distance = np.linalg.norm(away, axis=1)
    inside = (distance > PATCH_RADIUS_OF_EXTENT * extent) & (distance < 0.5 * extent)
    return not bool(np.any(away[inside] @ _unit(normal) > APPROACH_COSINE * distance[inside]))


def _unit(v: Array) -> Array:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-30))


def surface_of(made: Reconstruction) -> Surface:
    """Return the reconstruction as the model of a replay: a point cloud in {C} [m].

    Args:
        made: the reconstruction.
    """
    data = reconstruction_ply(made)
    return Surface(
        made.points,
        np.zeros((0, 3), np.int32),
        "reconstructed.ply",
        hashlib.sha256(data).hexdigest(),
        data,
    )


def meshed(made: Reconstruction) -> tuple[Surface, float]:
    """Return a triangle mesh of the model, by screened Poisson reconstruction (Kazhdan and Hoppe,
    2013).

    Args:
        made: the reconstruction.

    Returns:
        The mesh in {C} without parts farther than 4 voxels from any point, and the share of its
        area that is
        interpolated: farther than 1.5 voxels from any point.

    Raises:
        MissingBackend: Open3D is not installed.
    """
    try:
        import open3d
    except ImportError:
        hint = "pip install 'avsreplay[open3d]'"
        raise MissingBackend(
            "a mesh needs Open3D, which is not installed", where="--mesh", hint=hint
        ) from None
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(made.points))
    cloud.normals = open3d.utility.Vector3dVector(made.normals)
    depth = int(
        np.clip(np.ceil(np.log2(1.1 * np.ptp(made.points, axis=0).max() / made.spacing_m)), 5, 9)
    )
    mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=depth, n_threads=1
    )
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    corners = vertices[faces]
    away = np.asarray(cKDTree(made.points).query(corners.mean(axis=1))[0])
    faces, kept = faces[away < 4.0 * made.spacing_m], away[away < 4.0 * made.spacing_m]
    area = np.linalg.norm(
        np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))), axis=1
    )
    used, faces = np.unique(faces, return_inverse=True)
    surface = Surface(
        frozen(vertices[used]), faces.reshape(-1, 3).astype(np.int32), "reconstructed.ply", ""
    )
    return surface, float(area[kept > 1.5 * made.spacing_m].sum() / max(area.sum(), 1e-30))


@value_class(eq=True)
class Region:
    """A part of the target that differs from its CAD model.

    Attributes:
        kind: ``added`` (measured where the model has no surface), ``missing`` (scans saw through
            its surface) or ``no_return`` (scans that faced its surface have no points there:
            missing, or a material that returns none).
        points: number of points.
        centre_m: its centre in the frame of the CAD model [m].
        size_m: diagonal of its bounding box [m].
        deviation_m: median distance, positive outside the model, negative where it is missing; NaN
            beyond ``most_m``.
    """

    kind: str
    points: int
    centre_m: tuple[float, ...]
    size_m: float
    deviation_m: float


@value_class
class Deviations:
    """Distances of a reconstructed surface from a CAD model.

    Attributes:
        T_mc: pose of the reconstruction's {C} in the frame of the CAD model.
        signed_m: (n,) distance of each point from the CAD surface, positive outside [m]; NaN beyond
            ``most_m``.
        most_m: largest distance that is measured.
        inlier_ratio: share of the points nearer than that.
        median_m, p95_m: median and 95 % quantile of the absolute distances that were measured [m].
        regions: parts that differ, largest first.
    """

    T_mc: Pose
    signed_m: Array
    most_m: float
    inlier_ratio: float
    median_m: float
    p95_m: float
    regions: tuple[Region, ...] = ()


def deviations(made: Reconstruction, cad: Surface) -> Deviations:
    """Register a reconstruction to a CAD model and measure the distance of every point.

    Args:
        made: the reconstruction.
        cad: the model to compare with, in metres.

    Raises:
        UnreadableInput: no pose was found at which the two agree.
    """
    from avsreplay.register.params import Camera, RegisterParams
    from avsreplay.register.registrar import Registrar
    from avsreplay.register.surface_index import SurfaceIndex

    found = Registrar(cad, RegisterParams(camera=Camera.NONE)).acquire(
        made.points
    )  # its points were seen from all sides
    if not found.measured:
        raise UnreadableInput(
            "the reconstruction does not fit the CAD model",
            where=cad.name,
            hint="check model and unit",
        )
    T_mc, most = found.T_ac.inverse(), 0.05 * cad.extent
    p_m = T_mc.apply(made.points)
    closest = SurfaceIndex.build(cad, most).closest(p_m)
    far = np.sqrt(closest.d2)
    outside = (
        np.einsum("ni,ni->n", np.nan_to_num(closest.normal), p_m - np.nan_to_num(closest.foot))
        >= 0.0
    )
    signed = np.where(far < most, np.where(outside, far, -far), np.nan)
    known = np.abs(signed[np.isfinite(signed)])
    if not len(known):
        raise UnreadableInput(
            "no point lies near the CAD model", where=cad.name, hint="check model and unit"
        )
    ratio = float(np.isfinite(signed).mean())
    median = float(np.median(known))
    tolerance = max(4.0 * 1.4826 * median, 3.0 * made.spacing_m)
    extra = np.flatnonzero(~(np.abs(signed) < tolerance))
    regions = _regions("added", p_m[extra], signed[extra], made.spacing_m)
    for kind, found_m, away in _missing(made, cad, T_mc, tolerance):
        regions += _regions(kind, found_m, -away, made.spacing_m)
    largest = tuple(sorted(regions, key=lambda r: (-r.size_m, r.kind, r.centre_m[0]))[:MAX_REGIONS])
    return Deviations(T_mc, signed, most, ratio, median, float(np.quantile(known, 0.95)), largest)


def _missing(
    made: Reconstruction, cad: Surface, T_mc: Pose, tolerance: float
) -> list[tuple[str, Array, Array]]:
    """Points of the CAD surface that scans saw through or had no return from, and their distances
    to the model [m].
    """
    corners = cad.vertices[cad.faces]
    areas = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    rng = np.random.default_rng(0)
    count = int(np.clip(areas.sum() / made.spacing_m**2, 1000, 40000))
    face = rng.choice(len(areas), count, p=areas / areas.sum())
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = (corners[face, k] for k in range(3))
    p_m = a + u * (b - a) + v * (c - a)
    p_c = T_mc.inverse().apply(p_m)
    away = np.asarray(cKDTree(made.points).query(p_c)[0])
    far = away > tolerance + 2.0 * made.spacing_m
    normals = (
        _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))[face[far]]
        @ T_mc.R
    )
    through, empty = np.zeros((2, int(far.sum())))
    for sight in made.sights if far.any() else ():
        through += sight.seen_through(p_c[far], 1.5 * made.spacing_m) > 6.0 * made.spacing_m
        empty += sight.without_return(p_c[far], normals, 3.0 * made.spacing_m)
    kinds = (
        ("missing", through >= 2.0),
        ("no_return", (empty >= LEAST_EMPTY_SCANS) & (through < 2.0)),
    )
    return [(kind, p_m[far][which], away[far][which]) for kind, which in kinds]


def _regions(kind: str, points: Array, deviation: Array, voxel_m: float) -> list[Region]:
    """Groups of points closer together than three voxels."""
    if len(points) < LEAST_REGION_POINTS:
        return []
    group = point_tree(points).groups(3.0 * voxel_m)
    found = []
    for k in np.flatnonzero(np.bincount(group) >= LEAST_REGION_POINTS):
        p, known = points[group == k], deviation[group == k]
        known = known[np.isfinite(known)]
        middle = float(np.median(known)) if len(known) else float("nan")
        size = geometry.bounding_diagonal(p)
        found.append(Region(kind, len(p), tuple(float(x) for x in p.mean(axis=0)), size, middle))
    return found


def reconstruction_ply(made: Reconstruction, found: Deviations | None = None) -> bytes:
    """Return a binary PLY file: points, normals, ``one_sigma`` [m], number of scans, and colours of
    the deviations.

    Args:
        made: the reconstruction.
        found: deviations from a CAD model; colours run from blue (inside) through white to red
            (outside).
    """
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
    fields += [("one_sigma", "<f4"), ("scans", "<i4")]
    fields += [(name, "u1") for name in ("red", "green", "blue")] if found else []
    table = np.zeros(len(made.points), dtype=fields)
    for k, axis in enumerate("xyz"):
        table[axis], table[f"n{axis}"] = made.points[:, k], made.normals[:, k]
    table["one_sigma"], table["scans"] = made.one_sigma_m, made.scans
    if found:
        share = np.clip(
            np.nan_to_num(found.signed_m / max(3.0 * found.median_m, 1e-9), nan=1.0), -1.0, 1.0
        )
        table["red"] = np.round(255.0 * np.minimum(1.0, 1.0 + share))
        table["green"] = np.round(255.0 * (1.0 - np.abs(share)))
        table["blue"] = np.round(255.0 * np.minimum(1.0, 1.0 - share))
    words = {"<f4": "float", "<i4": "int", "u1": "uchar"}
    head = [
        "ply",
        "format binary_little_endian 1.0",
        "comment reconstructed by avsreplay, metres, frame {C}",
    ]
    head += [f"comment frame: {made.frame}"]
    if made.mass_centre is not None:
        (x, y, z), spread = made.mass_centre
        head += [f"comment mass centre in {{C}}: {x:.4f} {y:.4f} {z:.4f} m, 1 sigma {spread:.2g} m"]
    head += [
        f"element vertex {len(table)}",
        *(f"property {words[kind]} {name}" for name, kind in fields),
        "end_header",
        "",
    ]
    return "\n".join(head).encode("ascii") + table.tobytes()
