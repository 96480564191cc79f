from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

LAYOUT: int

def keep_patches(
    normals: NDArray[np.float64], counts: NDArray[np.int64], most: float, least: int
) -> NDArray[np.bool_]: ...
def sandwich(normals: NDArray[np.float64], gradients: NDArray[np.float64], alone: float) -> NDArray[np.float64]: ...

class Matches: ...

class Index:
    @overload
    def __init__(
        self,
        vertices: NDArray[np.float64],
        faces: NDArray[np.int32],
        kept: NDArray[np.int32],
        reach_m: float,
        threads: int = 1,
        portable: bool = False,
    ) -> None: ...
    @overload
    def __init__(
        self, saved: NDArray[np.uint8], primitives: int, ids: int, mesh: bool, portable: bool = False
    ) -> None: ...
    def save(self) -> bytes: ...
    def closest(
        self, points: NDArray[Any], threads: int = 1, camera_c: tuple[float, ...] | None = None
    ) -> tuple[Any, ...]: ...
    def icp(
        self,
        points: NDArray[Any],
        T_ca: NDArray[np.float64],
        n_max: int,
        n_plane: int,
        gate_m: float,
        tighten: float,
        floor_m: float,
        eps_rad: float,
        eps_m: float,
        threads: int = 1,
        keep: bool = False,
        facing: bool = False,
        newton: bool = False,
        few: int = 0,
    ) -> tuple[Any, ...]: ...
    def normal_equations(
        self,
        points: NDArray[Any],
        T_ca: NDArray[np.float64],
        gate_m: float,
        threads: int = 1,
        facing: bool = False,
    ) -> tuple[Any, ...]: ...
    def evidence(
        self,
        points: NDArray[Any],
        T_ca: NDArray[np.float64],
        gate_m: float,
        patch_m: float,
        least_patches: int,
        facing: bool = False,
        threads: int = 1,
        matches: Matches | None = None,
    ) -> tuple[Any, ...]: ...
    def looks(self, points: NDArray[Any], T_ca: NDArray[np.float64], stride: int) -> tuple[int, int]: ...
    @property
    def nbytes(self) -> int: ...
    @property
    def isa(self) -> str: ...
    @property
    def shape(self) -> dict[str, Any]: ...
