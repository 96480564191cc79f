"""The C++ engine's Python side: hands arrays to ``_kernel``, and says plainly when the extension is not there."""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import MissingBackend
from avsreplay.geometry import Array
from avsreplay.register import model_file

__all__ = ["KernelIndex"]

Rule = tuple[int, int, float, float, float, float, float]


class KernelIndex:
    """Closest points, the ICP loop and the normal equations in C++."""

    def __init__(
        self,
        vertices: Array,
        faces: NDArray[np.int32],
        kept: NDArray[np.int32],
        reach_m: float,
        threads: int,
        portable: bool,
        saved_in: Path | None,
    ) -> None:
        kernel = _kernel()
        ids, primitives = (len(faces), len(kept)) if len(faces) else (len(vertices), len(vertices))
        path = None if saved_in is None else model_file.path_of(saved_in, kernel.LAYOUT, vertices, faces, reach_m)
        saved = None if path is None else model_file.read(path)
        index = None if saved is None else _restored(kernel, saved, primitives, ids, len(faces) > 0, portable)
        self.restored = index is not None
        self._index: Any = index or kernel.Index(vertices, faces, kept, reach_m, threads, portable)
        if path is not None and not self.restored:
            model_file.write(path, self._index.save())

    @property
    def nbytes(self) -> int:
        """Memory of the index [B]."""
        return int(self._index.nbytes)

    def closest(
        self, points: NDArray[Any], threads: int, camera_c: Array | None
    ) -> tuple[Array, Array, NDArray[np.int32], Array]:
        """Feet (n, 3), squared distances (n,), ids (n,), normals (n, 3)."""
        camera = None if camera_c is None else tuple(camera_c.tolist())
        foot, d2, ids, normal = self._index.closest(points, threads, camera)
        return foot, d2, ids, normal

    def icp(
        self, points: NDArray[Any], T_ca: Array, rule: Rule, threads: int, keep: bool, facing: bool
    ) -> tuple[Any, ...]:
        """The loop of ``Model.icp``."""
        result: tuple[Any, ...] = self._index.icp(points, T_ca, *rule, threads, keep, facing)
        return result

    def normal_equations(
        self, points: NDArray[Any], T_ca: Array, gate_m: float, threads: int, facing: bool
    ) -> tuple[Array, Array, int, float, float, int, int]:
        """Sums of ``Model.normal_equations``."""
        info, gradient, inliers, sum_e2, sum_d2, seen, ignored = self._index.normal_equations(
            points, T_ca, gate_m, threads, facing
        )
        return info, gradient, inliers, sum_e2, sum_d2, seen, ignored


def _kernel() -> types.ModuleType:
    try:
        import avsreplay.register._kernel as kernel
    except ImportError as error:
        raise MissingBackend(
            "the C++ kernel is not built", where="avsreplay.register._kernel", hint="install a compiler and run pip"
        ) from error
    return kernel


def _restored(kernel: Any, saved: bytes, primitives: int, ids: int, mesh: bool, portable: bool) -> Any:
    try:
        return kernel.Index(saved, primitives, ids, mesh, portable)
    except ValueError:
        return None
