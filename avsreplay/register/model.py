"""The fixed model a scan is laid against: exact closest point on its triangles (or points) and the ICP loop over it.

Two engines stand behind the same methods. ``kernel`` is the C++ extension; ``reference`` is numpy and scipy, slow and
plain, and is what the tests compare the kernel with. A model is built once for one reach and then only read.

What is closest
    The foot of a query is the nearest point of the closed surface, on a face, an edge or a vertex. At ``reach_m`` or
    farther there is none: id -1, d2 inf, else NaN.
Who owns it
    Of faces at the same distance (to 1e-10, rounding: a foot on an edge or a vertex) the one that faces the query most
    squarely, then the lower index; of points, the lower index.
Which normal
    The face normal (winding, right hand) of the triangle that owns the foot, also where the foot lies on an edge or a
    vertex; of a cloud, the least direction of its ``NORMAL_NEIGHBOURS`` nearest points, its sign free.
Triangles without area
    are left out of the index (``dropped``): they are a segment that their neighbours hold too.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from avsreplay.errors import UsageError
from avsreplay.geometry import Array, Pose
from avsreplay.records import Surface

__all__ = ["Closest", "Engine", "IcpParams", "IcpResult", "Model", "NormalEquations", "Rule"]

Engine = Literal["kernel", "reference"]
Rule = tuple[int, int, float, float, float, float, float]
"""n_max, n_plane, gate, tighten, floor, eps_rad, eps_m: IcpParams with its autos resolved."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IcpParams:
    """How the loop runs.

    Rejection rule: a point takes part while its foot is nearer than the gate; after each pass
    gate = min(gate, max(floor_m, tighten * rms_m of that pass)), so the gate never grows. ``tighten`` 0: constant gate.
    Stopping rule: the last step turned less than ``eps_rad`` and moved the inliers' centroid less than ``eps_m``, and
    the gate has settled (to 1 %). A plane pass never stops the loop; the last passes are Horn's.
    """

    n_max: int = 100  # most passes, of both kinds
    n_plane: int = 6  # point-to-plane passes before Horn's; fewer are made once their step is below eps
    gate_m: float | None = None  # first rejection distance [m]; auto: the model's reach
    tighten: float = 3.0  # the gate in units of the last pass' rms; 0: never tightened
    floor_m: float | None = None  # least gate [m]; auto: 1/500 of the model's extent
    eps_rad: float = 1e-5  # stop below this turn [rad]
    eps_m: float | None = None  # and below this move of the centroid [m]; auto: 1e-6 of the model's extent
    threads: int = 1  # the result is the same, to the bit, for any number
    facing: bool = False  # match only faces that look at the camera, {A}'s origin: for meshes wound outwards
    keep: bool = True  # keep a neighbour while it provably cannot change; the result is the same, to the bit

    def __post_init__(self) -> None:
        if self.n_max < 1 or not 0 <= self.n_plane <= self.n_max:
            raise ValueError(f"need n_max >= 1 and 0 <= n_plane <= n_max, got {self.n_max} and {self.n_plane}")
        for name in ("gate_m", "tighten", "floor_m", "eps_rad", "eps_m"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be finite and not negative, got {value}")
        if self.threads < 1:
            raise ValueError(f"threads must be at least 1, got {self.threads}")


@dataclass(frozen=True, slots=True, eq=False)
class Closest:
    """Feet of n queries: foot (n, 3) [m], d2 (n,) [m^2], id (n,) face or point index, normal (n, 3) unit."""

    foot: Array
    d2: Array
    id: NDArray[np.int32]
    normal: Array


@dataclass(frozen=True, slots=True, eq=False)
class IcpResult:
    """Where the loop ended.

    Attributes:
        T_ca: (4, 4) scan {A} into model {C}.  iterations: passes made, of both kinds.
        converged: the stopping rule held before n_max.  inliers, rms_m: of the last pass, before its step (point to
        foot distance).  gate_m: rejection distance after it.  step_rad, step_m: the last step.
        ignored: points with a coordinate that is not finite.  searched: neighbour searches made over all passes.
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


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Point-to-plane sums at a pose, for d = [theta; v] in {C} with T_ac_true = T_ac @ Exp(d).

    With p_c = T_ca p_a, e = n . (foot - p_c) and J = de/dd = [p_c x n, n].

    Attributes:
        info: (6, 6) sum J'J, noise-free.  gradient: (6,) sum J'e.  inliers: points nearer than the gate.
        sum_e2: sum of e^2 [m^2].  sum_d2: sum of squared point-to-foot distances [m^2].
        points: finite points looked at.  ignored: the others.
    """

    info: Array
    gradient: Array
    inliers: int
    sum_e2: float
    sum_d2: float
    points: int
    ignored: int


class _Index(Protocol):
    """What an engine offers; shapes and units as in :class:`Model`."""

    def closest(
        self, points: NDArray[Any], threads: int, camera_c: Array | None
    ) -> tuple[Array, Array, NDArray[np.int32], Array]: ...

    @property
    def nbytes(self) -> int: ...

    restored: bool

    def icp(
        self, points: NDArray[Any], T_ca: Array, rule: Rule, threads: int, keep: bool, facing: bool
    ) -> tuple[Any, ...]: ...

    def normal_equations(
        self, points: NDArray[Any], T_ca: Array, gate_m: float, threads: int, facing: bool
    ) -> tuple[Array, Array, int, float, float, int, int]: ...


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """An indexed surface. Build it with :meth:`build`; it is read-only and may be shared by threads.

    Attributes:
        reach_m: no foot is looked for at this distance or farther.  extent_m: diagonal of the surface's box.
        primitives: triangles or points in the index.  dropped: triangles without area, left out.
    """

    reach_m: float
    extent_m: float
    engine: Engine
    primitives: int
    dropped: int
    _index: _Index

    @classmethod
    def build(
        cls,
        surface: Surface,
        reach_m: float,
        *,
        engine: Engine = "kernel",
        threads: int = 1,
        portable: bool = False,
        saved_in: Path | None = None,
    ) -> Model:
        """Index ``surface`` for queries up to ``reach_m`` [m] from it.

        ``threads`` build it; ``portable`` keeps the kernel to the instructions every machine of its kind has. Neither
        shows in any result. ``saved_in``, a folder: the kernel's index is read from there where a sound file under this
        surface's hash lies, else built and written there.

        Raises:
            UsageError: a surface with no primitive, a coordinate that is not finite, a face that names a vertex that is
            not there, a reach that is not positive, or an engine there is not.
        """
        vertices, faces = _checked(surface, reach_m)
        kept = _with_area(vertices, faces)
        if len(faces) and not len(kept):
            raise UsageError("no face has an area", where=surface.name, hint="give a mesh with proper triangles")
        index = _engine(engine, surface.name)(vertices, faces, kept, float(reach_m), threads, portable, saved_in)
        size = len(kept) if len(faces) else len(vertices)
        return cls(float(reach_m), surface.extent, engine, size, len(faces) - len(kept), index)

    @property
    def restored(self) -> bool:
        """Was the index read from a file instead of built?"""
        return self._index.restored

    @property
    def nbytes(self) -> int:
        """Memory of the index [B]; 0 for the reference engine, which does not count."""
        return self._index.nbytes

    def closest(self, points: NDArray[Any], *, threads: int = 1, camera_c: ArrayLike | None = None) -> Closest:
        """Feet of ``points`` (n, 3) [m] in {C}; a point that is not finite has none.

        With ``camera_c`` (3,) [m] given only faces that look at it count; a cloud has no sides and counts whole.
        """
        camera = None if camera_c is None else np.asarray(camera_c, dtype=np.float64).reshape(3)
        return Closest(*self._index.closest(_points(points), threads, camera))

    def icp(self, points: NDArray[Any], T_ca: ArrayLike | Pose, params: IcpParams | None = None) -> IcpResult:
        """Lay the scan ``points`` (n, 3) [m] in {A} on the model from the guess ``T_ca`` (4, 4).

        Point-to-plane passes first, then Horn's point-to-point passes to their fixed point.
        The guess' rotation is re-orthonormalised. With under 6 inliers the loop ends where it stands, not converged.
        """
        params = params or IcpParams()
        gate = min(self.reach_m, self.reach_m if params.gate_m is None else params.gate_m)
        floor = self.extent_m / 500.0 if params.floor_m is None else params.floor_m
        eps_m = 1e-6 * self.extent_m if params.eps_m is None else params.eps_m
        rule = (params.n_max, params.n_plane, gate, params.tighten, floor, params.eps_rad, eps_m)
        return IcpResult(
            *self._index.icp(_points(points), _rigid(T_ca), rule, params.threads, params.keep, params.facing)
        )

    def normal_equations(
        self,
        points: NDArray[Any],
        T_ca: ArrayLike | Pose,
        gate_m: float | None = None,
        *,
        threads: int = 1,
        facing: bool = False,
    ) -> NormalEquations:
        """Point-to-plane information, gradient and residual sums of ``points`` (n, 3) in {A} at ``T_ca`` (4, 4).

        ``facing``: as in :class:`IcpParams`.
        """
        gate = self.reach_m if gate_m is None else min(gate_m, self.reach_m)
        return NormalEquations(*self._index.normal_equations(_points(points), _rigid(T_ca), gate, threads, facing))


def _points(points: NDArray[Any]) -> NDArray[Any]:
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"points must be (n, 3), got {array.shape}")
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)


def _rigid(T_ca: ArrayLike | Pose) -> Array:
    pose = T_ca if isinstance(T_ca, Pose) else Pose.from_matrix(T_ca)
    return pose.matrix


def _checked(surface: Surface, reach_m: float) -> tuple[Array, NDArray[np.int32]]:
    vertices = np.ascontiguousarray(surface.vertices, dtype=np.float64)
    faces = np.ascontiguousarray(surface.faces, dtype=np.int32).reshape(-1, 3)
    if not (np.isfinite(reach_m) and reach_m > 0.0):
        raise UsageError(f"reach must be positive, got {reach_m}", where=surface.name, hint="give a distance in metres")
    if not len(vertices):
        raise UsageError("the model has no point", where=surface.name, hint="give a mesh or a cloud")
    if not np.isfinite(vertices).all():
        raise UsageError("the model has a coordinate that is not finite", where=surface.name, hint="mend the model")
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise UsageError("a face names a vertex that is not there", where=surface.name, hint="mend the model")
    return vertices, faces


def _with_area(vertices: Array, faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """Indices of the faces whose area is more than rounding: |ab x ac| > 1e-12 of the longest edge squared."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    longest2 = np.max([np.sum((b - a) ** 2, 1), np.sum((c - b) ** 2, 1), np.sum((a - c) ** 2, 1)], axis=0, initial=0.0)
    area2 = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.flatnonzero(area2 > 1e-12 * longest2).astype(np.int32)


def _engine(engine: Engine, name: str) -> Any:
    if engine == "reference":
        from avsreplay.register.model_reference import ReferenceIndex

        return ReferenceIndex
    if engine == "kernel":
        from avsreplay.register.model_kernel import KernelIndex

        return KernelIndex
    raise UsageError(f"no engine {engine!r}", where=name, hint="use kernel or reference")
