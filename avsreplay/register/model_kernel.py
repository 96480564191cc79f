"""The C++ engine's Python side: hands arrays to ``_kernel`` and says plainly when the extension is not there."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import MissingBackend
from avsreplay.geometry import Array

Rule = tuple[int, int, float, float, float, float, float]

__all__ = ["KernelIndex"]


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
    ) -> None:
        try:
            import avsreplay.register._kernel as _kernel
        except ImportError as error:
            raise MissingBackend(
                "the C++ kernel is not built", where="avsreplay.register._kernel", hint="install a compiler and run pip"
            ) from error
        self._index = _kernel.Index(vertices, faces, kept, reach_m, threads, portable)

    def closest(
        self, points: NDArray[Any], threads: int, camera_c: Array | None
    ) -> tuple[Array, Array, NDArray[np.int32], Array]:
        """Feet (n, 3), squared distances (n,), ids (n,), normals (n, 3)."""
        camera = None if camera_c is None else tuple(camera_c.tolist())
        foot, d2, ids, normal = self._index.closest(points, threads, camera)
        return foot, d2, ids, normal

    @property
    def bytes(self) -> int:
        """Memory of the index [B]."""
        return self._index.bytes

    def icp(
        self, points: NDArray[Any], T_ca: Array, rule: Rule, threads: int, keep: bool, facing: bool
    ) -> tuple[Any, ...]:
        """The loop of ``Model.icp``."""
        return self._index.icp(points, T_ca, *rule, threads, keep, facing)

    def normal_equations(
        self, points: NDArray[Any], T_ca: Array, gate_m: float, threads: int, facing: bool
    ) -> tuple[Array, Array, int, float, float, int, int]:
        """Sums of ``Model.normal_equations``."""
        info, gradient, inliers, sum_e2, sum_d2, seen, ignored = self._index.normal_equations(
            points, T_ca, gate_m, threads, facing
        )
        return info, gradient, inliers, sum_e2, sum_d2, seen, ignored
