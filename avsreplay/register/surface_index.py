"""Exact closest points on the target model, and the ICP loop and normal equations that use them.

The work is done by the C++ extension ``_kernel``; this module checks the input and names the
results. An index is built once for one maximum distance and is read-only afterwards.

Closest point The nearest point of the surface to a query point: on a face, an edge or a vertex. A
    query at ``reach_m`` or farther from the surface has none: id -1, d2 inf, foot and normal NaN.
Ties Among faces at the same distance (to 1e-10, on edges and vertices) the face whose plane is
    farthest from the query point is chosen, then the lower index. Among points of a cloud the lower
    index is chosen.
Normal The face normal by the right-hand rule of the chosen triangle, also on an edge or a vertex.
    For a point cloud: the eigenvector of the smallest eigenvalue of the scatter of the 10 nearest
    points, with any sign.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from avsreplay import mesh
from avsreplay.errors import MissingBackend, UsageError, value_class
from avsreplay.geometry import Array, Pose
from avsreplay.records import Surface
from avsreplay.register import index_cache
from avsreplay.settings import Settings, setting

# largest coordinate [m], and largest reach in units of the model's extent
LARGEST_M = 1e9
LARGEST_REACH = 1e5
MOST_PRIMITIVES = 50_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class IcpParams(Settings):
    """Parameters of the ICP loop.

    Rejection rule: a point is used while its distance to the surface is below the gate; after each
    pass gate = min(gate, max(floor_m, tighten * rms of that pass)), so the gate never grows.
    ``tighten`` 0: constant gate. Stopping rule: Horn's step (point to point) of a pass rotates by
    less than ``eps_rad`` and moves the centroid of the inliers by less than ``eps_m``, the gate
    changed by less than 1 %, and with ``newton`` Newton's step is as small.
    """

    n_max: int = setting(100, "Largest number of passes of both kinds.", low=1)
    n_plane: int = setting(3, "Largest number of point-to-plane passes before Horn's.", low=0)
    newton: bool = setting(True, "Take Newton steps towards the fixed point of Horn's iteration.")
    gate_m: float | None = setting(
        None, "First rejection distance.", unit="m", low=0.0, unset="the reach of the index"
    )
    tighten: float = setting(
        3.0, "Gate in units of the rms of the last pass; 0 keeps it constant.", low=0.0
    )
    floor_m: float | None = setting(
        None, "Smallest gate.", unit="m", low=0.0, unset="1/500 of the model's extent"
    )
    eps_rad: float = setting(1e-5, "Stopping rule: rotation of the last step.", unit="rad", low=0.0)
    eps_m: float | None = setting(
        None,
        "Stopping rule: displacement of the inliers' centroid.",
        unit="m",
        low=0.0,
        of_extent=1e-6,
    )
    threads: int = setting(
        1, "Largest number of threads; no result depends on it.", low=1, high=1024
    )
    facing: bool = setting(
        False, "Match only faces that face the camera (origin of {A}); needs outward faces."
    )
    few: int = setting(
        0, "Points of the scan with which a much larger scan is aligned first; 0: none.", low=0
    )
    poor_m: float = setting(
        0.0, "End with them where their rms is larger, and few are off.", unit="m", low=0.0
    )
    keep: bool = setting(
        True, "Keep a correspondence while it provably cannot change; does not change a result."
    )

    def check(self) -> None:
        """Raise ValueError where ``n_plane`` exceeds ``n_max``."""
        if self.n_plane > self.n_max:
            raise ValueError(f"n_plane is {self.n_plane}, must not exceed n_max = {self.n_max}")


@value_class
class Closest:
    """Closest points of n queries: foot (n, 3) [m], d2 (n,) squared distance [m^2], id (n,)
    face or point, normal.
    """

    foot: Array
    d2: Array
    id: NDArray[np.int32]
    normal: Array


@value_class
class IcpResult:
    """Result of the ICP loop.

    Attributes:
        T_ca: (4, 4) scan {A} into model {C}.
        iterations: passes over all points; those over a part count as its share of the points,
            rounded up together.
        converged: the stopping rule held before n_max.
        inliers, rms_m: of the last pass, before its step.
        gate_m: rejection distance after the last pass.
        step_rad, step_m: the last step; that of Horn's which is not made where it converged.
        ignored: points not finite.
        searched: neighbour searches made over all passes.
        work: of all passes, counted in ordinary searches.
        matches: opaque; shortens :meth:`SurfaceIndex.evidence` of the same points. None: it ended
            with a part of them.
    """

    T_ca: Array
    iterations: int
    converged: bool
    inliers: int
    rms_m: float
    gate_m: float
    step_rad: float
    step_m: float
    ignored: int
    searched: int
    work: int = 0
    matches: Any = None


@value_class
class NormalEquations:
    """Point-to-plane sums at a pose, for d = [theta; v] in {C} with T_ac_true = T_ac @ Exp(d).

    With p_c = T_ca p_a, e = n . (foot - p_c) and J = de/dd = [p_c x n, n].

    Attributes:
        info: (6, 6) sum J'J, not divided by the variance of the noise.
        gradient: (6,) sum J'e.
        inliers: points nearer than the gate.
        points: finite points.
        ignored: points that are not finite.
        sum_e2, sum_d2: sums of e^2 and of the squared distances to the closest points [m^2].
    """

    info: Array
    gradient: Array
    inliers: int
    sum_e2: float
    sum_d2: float
    points: int
    ignored: int


@value_class
class PatchSums:
    """Sums over the inliers at a pose by patches of the model, with J and e as in
    :class:`NormalEquations`, e negated.

    Attributes:
        points: of the scan, also those that are not finite.
        inliers: points nearer than the gate.
        sum_d2: sum of the squared distances to the closest points [m^2].
        median_m: median of |e| [m].
        centre: (3,) centroid of the inliers in {C} [m].
        counts: (m,) inliers of each patch.
        normals: (m, 6, 6) sums of J'J.
        gradients: (m, 6) sums of e J with e = n . (p_c - foot).
        offsets, errors, places: sums of J (m, 6) and of e (m,), and the centroid (m, 3) of each
            patch.
    """

    points: int
    inliers: int
    sum_d2: float
    median_m: float
    centre: Array
    counts: NDArray[np.int64]
    normals: Array
    gradients: Array
    offsets: Array
    errors: Array
    places: Array


class GradeRule(TypedDict):
    """How the kernel grades a pose.

    Attributes:
        gate_m: largest distance of an inlier [m].
        patch_m, least_patches: as of ``SurfaceIndex.evidence``.
        camera: whether the camera may be where the faces look.
        tested, least_facing: points that tell it, and the share of them on faces towards it.
        extent_m: size of the model [m].
        noise_m, noise_floor_m: standard deviation of the residuals [m], 0: estimated; its least
            value.
        least_inliers, least_ratio: with fewer inliers there is no overlap.
        least_information: scaled information below which a motion is not observable.
        systematic: the covariance includes systematic errors.
        turn_rad, move_m: accuracy of the back end.
        across: (k, 3) directions in {C} of the test of halves.
        beyond_m: distance from which a point is well off the model [m].
        least_close: share of inliers below which all other points are counted.
        part: points per which those well off are counted.
        numbers: normal numbers of the simulated noise; empty: none is simulated.
        many: points that are simulated, about.
        least_share, most_share, small_share: one of so many points is simulated at least, at most,
            and where the noise is below ``quiet_m``.
        quiet_m: noise below which a part of the points decides whether the others are simulated
            [m].
    """

    gate_m: float
    patch_m: float
    least_patches: int
    camera: bool
    tested: int
    least_facing: float
    extent_m: float
    noise_m: float
    noise_floor_m: float
    least_inliers: float
    least_ratio: float
    least_information: float
    systematic: bool
    turn_rad: float
    move_m: float
    across: Array
    beyond_m: float
    least_close: float
    part: int
    numbers: Array
    many: int
    least_share: int
    most_share: int
    small_share: int
    quiet_m: float


@value_class
class SurfaceIndex:
    """An indexed surface. Build it with :meth:`build`; it is read-only and may be shared by
    threads.

    Attributes:
        reach_m: no closest point is searched at this distance or farther.
        extent_m: diagonal of the bounding box of the surface.
        primitives: triangles or points in the index.
        dropped: triangles without area.
        restored: read from the cache.
    """

    reach_m: float
    extent_m: float
    primitives: int
    dropped: int
    restored: bool
    _index: Any

    @classmethod
    def build(
        cls,
        surface: Surface,
        reach_m: float,
        *,
        threads: int = 1,
        portable: bool = False,
        clearances: bool = True,
        cache_dir: Path | None = None,
    ) -> SurfaceIndex:
        """Index ``surface`` for queries up to ``reach_m`` [m] from it.

        Args:
            surface: mesh or point cloud, vertices in {C} [m].
            reach_m: largest distance at which a closest point is searched [m].
            threads: threads that build the index; the result does not depend on it.
            portable: use only the instructions that every processor of this kind has; the results
                are identical.
            clearances: the index also stores how far the surface is flat, which ``grade`` and
                ``evidence`` use; this takes most of the time of building for a large mesh.
            cache_dir: folder in which the index with clearances is looked up and, where possible,
                saved under the hash of the surface.

        Raises:
            UsageError: a surface with no primitive, too many or too large a surface, a coordinate
                that is not finite, a face that refers to a missing vertex, or a reach that is not
                positive.
            MissingBackend: the C++ extension is not built.
        """
        vertices, faces = _checked(surface, reach_m)
        kernel = kernel_module()
        path = (
            None
            if cache_dir is None or not clearances
            else index_cache.cache_path(cache_dir, kernel.LAYOUT, vertices, faces, reach_m)
        )
        index = (
            None
            if path is None
            else _restored(kernel, path, len(faces) or len(vertices), len(faces) > 0, portable)
        )
        restored = index is not None
        if index is None:
            kept = mesh.numbers_with_area(vertices, faces)
            if len(faces) and not len(kept):
                raise UsageError(
                    "no face has an area",
                    where=surface.name,
                    hint="give a mesh with proper triangles",
                )
            index = kernel.Index(
                vertices, faces, kept, float(reach_m), threads, portable, clearances
            )
            if path is not None:
                index_cache.write(path, index.save(), kernel.checksum)
        size = int(index.primitives)
        return cls(float(reach_m), surface.extent, size, max(0, len(faces) - size), restored, index)

    @property
    def nbytes(self) -> int:
        """Memory of the index [B]."""
        return int(self._index.nbytes)

    def closest(
        self,
        points: NDArray[Any],
        *,
        threads: int = 1,
        camera_c: ArrayLike | None = None,
        most_m: float = np.inf,
    ) -> Closest:
        """Closest points of ``points`` (n, 3) [m] in {C}; one that is not finite, or ``most_m`` [m]
        away, has none.

        With ``camera_c`` (3,) [m] only faces that face this position are searched; a point cloud is
        searched whole.
        """
        camera = None if camera_c is None else tuple(float(x) for x in np.reshape(camera_c, 3))
        return Closest(*self._index.closest(_points(points), threads, camera, most_m))

    def icp(
        self,
        points: NDArray[Any],
        T_ca: Any,
        params: IcpParams | None = None,
        most_work: int = 2**62,
    ) -> IcpResult:
        """Align the scan ``points`` (n, 3) [m] in {A} to the model from the guess ``T_ca`` (4, 4).

        Point-to-plane passes, then Newton's method to the fixed point of Horn's point-to-point
        iteration (eq:ICP), a stationary point of the sum of squared distances. A Newton step that
        raises the sum is replaced by Horn's. At the last pass, over all points, the steps of Horn
        and of Newton are both within the stopping rule, and Newton's is made. With fewer than 6
        inliers, or after ``most_work``, it ends, not converged.
        """
        params = params or IcpParams()
        gate = min(self.reach_m, self.reach_m if params.gate_m is None else params.gate_m)
        floor = self.extent_m / 500.0 if params.floor_m is None else params.floor_m
        eps_m = 1e-6 * self.extent_m if params.eps_m is None else params.eps_m
        rule = (params.n_max, params.n_plane, gate, params.tighten, floor, params.eps_rad, eps_m)
        flags = (
            params.threads,
            params.keep,
            params.facing,
            params.newton,
            params.few,
            most_work,
            params.poor_m,
        )
        return IcpResult(*self._index.icp(_points(points), _rigid(T_ca), *rule, *flags))

    def normal_equations(
        self,
        points: NDArray[Any],
        T_ca: ArrayLike | Pose,
        gate_m: float | None = None,
        *,
        threads: int = 1,
        facing: bool = False,
    ) -> NormalEquations:
        """Point-to-plane sums of ``points`` (n, 3) in {A} at ``T_ca`` (4, 4); ``facing``: as
        in :class:`IcpParams`.
        """
        gate = self.reach_m if gate_m is None else min(gate_m, self.reach_m)
        return NormalEquations(
            *self._index.normal_equations(_points(points), _rigid(T_ca), gate, threads, facing)
        )

    def evidence(
        self,
        points: NDArray[Any],
        T_ca: ArrayLike | Pose,
        gate_m: float,
        patch_m: float,
        least_patches: int,
        *,
        threads: int = 1,
        facing: bool = False,
        matches: Any = None,
    ) -> PatchSums:
        """Return sums over the inliers of ``points`` (n, 3) in {A} at ``T_ca`` (4, 4).

        A patch is what lies in one cube of side ``patch_m`` [m] in {C}; with at most
        ``least_patches`` occupied cubes each point is a patch. ``facing``: as in
        :class:`IcpParams`. ``matches``: of an alignment of the same points.
        """
        rule = (min(gate_m, self.reach_m), patch_m, least_patches, facing, threads, matches)
        return PatchSums(*self._index.evidence(_points(points), _rigid(T_ca), *rule))

    def grade(
        self, points: NDArray[Any], T_ca: Pose, rule: GradeRule, matches: Any = None
    ) -> dict[str, Any]:
        """Grade the pose of ``points`` (n, 3) in {A}, see ``quality.PoseQuality``.

        ``matches``: of an alignment of the same points.
        """
        found: dict[str, Any] = self._index.grade(
            _points(points), T_ca.matrix, **rule, matches=matches
        )
        return found

    def distances(
        self, points: NDArray[Any], T_ca: Pose, most_m: float, *sight: Any
    ) -> tuple[Array, int]:
        """Distances (n,) [m] of ``points`` in {A}, at most ``most_m``; the work. ``sight``:
        ``kernel/evidence.hpp``.
        """
        at, work = self._index.distances(
            _points(points), T_ca.matrix, min(most_m, self.reach_m), *sight
        )
        return at, work

    def cast(self, eye_c: Array, directions: Array) -> tuple[Array, int]:
        """Ranges (n,) [m] of the first faces of a mesh on rays (n, 3) from ``eye_c`` (3,),
        inf: none; and the work.
        """
        ranges, work = self._index.cast(eye_c.tolist(), np.ascontiguousarray(directions))
        return ranges, work

    def size_step(
        self, points: Array, camera_c: Array | None, *rule: Any
    ) -> tuple[float, Array, Array] | None:
        """Step of the size, pose d (6,) about a centre (3,), that (n, 3) in {C} ask for; see
        ``kernel/size.hpp``.
        """
        camera = None if camera_c is None else tuple(float(x) for x in camera_c)
        step: tuple[float, Array, Array] | None = self._index.size_step(
            np.ascontiguousarray(points), camera, *rule
        )
        return step

    def faces_camera(self, points: NDArray[Any], T_ca: Pose, tested: int, least: float) -> bool:
        """Return whether at least a share of the faces closest to about ``tested`` points (n, 3)
        face the camera.
        """
        return bool(self._index.faces_camera(_points(points), T_ca.matrix, tested, least))


def kernel_module() -> Any:
    """Return the C++ extension. Raises MissingBackend if it is not built."""
    try:
        from avsreplay.register import _kernel
    except ImportError:
        hint = (
            "run 'pip install .' in the source folder (needs a C++17 compiler), then Python"
            " outside of it"
        )
        raise MissingBackend(
            "the C++ extension is not built", where="avsreplay.register._kernel", hint=hint
        ) from None
    return _kernel


def _restored(kernel: Any, path: Path, ids: int, mesh: bool, portable: bool) -> Any:
    """The index in this file; None where there is none or it is damaged: it is then built again."""
    saved = index_cache.read(path, kernel.checksum)
    try:
        return None if saved is None else kernel.Index(saved, ids, mesh, portable)
    except ValueError:
        return None


def _points(points: NDArray[Any]) -> NDArray[Any]:
    if (array := np.asarray(points)).ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"points must be (n, 3), got {array.shape}")
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)


def _rigid(T_ca: ArrayLike | Pose) -> Array:
    return (T_ca if isinstance(T_ca, Pose) else Pose.from_matrix(T_ca)).matrix


def _checked(surface: Surface, reach_m: float) -> tuple[Array, NDArray[np.int32]]:
    vertices = np.ascontiguousarray(surface.vertices, dtype=np.float64)
    faces = np.ascontiguousarray(surface.faces, dtype=np.int32).reshape(-1, 3)
    if not len(vertices) or not np.isfinite(vertices).all():
        what = "has a coordinate that is not finite" if len(vertices) else "has no point"
        raise UsageError(f"the model {what}", where=surface.name, hint="repair the model")
    if not (most := LARGEST_REACH * (surface.extent or 1.0)) >= reach_m > 0.0:
        raise UsageError(
            f"reach is {reach_m:g} m, must be above 0 and at most {most:g} m",
            where="register.reach_m",
        )
    _check_size(surface, vertices, faces)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise UsageError(
            "a face refers to a missing vertex", where=surface.name, hint="repair the model"
        )
    return vertices, faces


def _check_size(surface: Surface, vertices: Array, faces: NDArray[np.int32]) -> None:
    """Raise UsageError for a model that single precision or 32-bit indices cannot represent."""
    largest = float(np.abs(vertices).max())
    if largest > LARGEST_M:
        hint = "remove stray vertices, or scale the model to metres"
        raise UsageError(
            f"a coordinate of {largest:.3g} m is too large", where=surface.name, hint=hint
        )
    if max(len(vertices), len(faces)) > MOST_PRIMITIVES:
        what = (
            f"{len(vertices)} vertices and {len(faces)} faces are more than the limit of"
            f" {MOST_PRIMITIVES}"
        )
        raise UsageError(what, where=surface.name, hint="simplify the model")
