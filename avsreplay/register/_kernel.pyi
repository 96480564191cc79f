from collections.abc import Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

LAYOUT: int

def request_stop(wanted: bool) -> None: ...
def shield(wanted: bool) -> bool: ...
def is_shielded() -> bool: ...
def checksum(payload: NDArray[np.uint8]) -> int: ...
def keep_patches(normals: NDArray[np.float64], counts: NDArray[np.int64]) -> NDArray[np.bool_]: ...
def pseudo_inverse(N: NDArray[np.float64]) -> NDArray[np.float64]: ...
def is_narrower(
    points: NDArray[Any], T_ca: NDArray[np.float64], model: NDArray[np.float64], least: float
) -> bool: ...
def seen(
    points: NDArray[Any],
    T_ca: NDArray[np.float64],
    model: NDArray[np.float64],
    normals: NDArray[np.float64],
    in_front: float,
    least_facing: float,
    least_cosine: float,
    hidden_m: float,
    per_cell: float,
) -> NDArray[np.int64]: ...
def sandwich(
    normals: NDArray[np.float64], gradients: NDArray[np.float64]
) -> NDArray[np.float64]: ...
def pair_sums(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    weights: NDArray[np.float64],
    from_points: NDArray[np.int64],
    to_points: NDArray[np.int64],
    begin: NDArray[np.int64],
    gate_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]: ...

class Matches: ...

def voxels(
    points: NDArray[np.float64], size_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]: ...
def different(
    T_ca: NDArray[np.float64], middle: NDArray[np.float64], most: int, trace: float, near_m: float
) -> NDArray[np.int64]: ...

class PointTree:
    def __init__(self, points: NDArray[np.float64]) -> None: ...
    def query(
        self, points: NDArray[np.float64], k: int = 1, most_m: float = ...
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]: ...
    def planes(
        self,
        all_points: NDArray[np.float64],
        all_normals: NDArray[np.float64],
        points: NDArray[np.float64],
        normals: NDArray[np.float64],
        k: int,
        most_m: float = ...,
        least_cosine: float = -2.0,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]: ...
    def groups(self, most_m: float) -> NDArray[np.int64]: ...

class Table:
    def __init__(
        self,
        normals: NDArray[np.float64],
        gradients: NDArray[np.float64],
        offsets: NDArray[np.float64],
        counts: NDArray[np.int64],
        errors: NDArray[np.float64],
        places: NDArray[np.float64],
        centre: Sequence[float],
        extent_m: float,
        side_m: float,
        camera: Sequence[float],
    ) -> None: ...
    def systematic(
        self,
    ) -> tuple[float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]: ...
    def size_error(self) -> list[float]: ...
    def covariance(
        self,
        block: float,
        smooth: Sequence[float],
        amplitudes: Sequence[float],
        fit: Sequence[float],
    ) -> NDArray[np.float64]: ...
    def split(
        self,
        block: float,
        smooth: Sequence[float],
        amplitudes: Sequence[float],
        fit: Sequence[float],
        across: NDArray[np.float64],
    ) -> float: ...

class Field:
    def __init__(
        self, points: NDArray[np.float64], normals: NDArray[np.float64], across: int
    ) -> None: ...
    def refine(
        self,
        points: NDArray[np.float64],
        T_ca: NDArray[np.float64],
        passes: int,
        gate_m: float,
        fall: float,
        floor_m: float,
        beyond_m: float,
        facing: bool,
        threads: int = 1,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...

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
        clearances: bool = True,
    ) -> None: ...
    @overload
    def __init__(
        self, saved: NDArray[np.uint8], ids: int, mesh: bool, portable: bool = False
    ) -> None: ...
    def save(self) -> bytes: ...
    def closest(
        self,
        points: NDArray[Any],
        threads: int = 1,
        camera_c: Sequence[float] | None = None,
        most_m: float = ...,
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
        most_work: int = ...,
        poor_m: float = 0.0,
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
    def grade(
        self,
        points: NDArray[Any],
        T_ca: NDArray[np.float64],
        *,
        gate_m: float,
        patch_m: float,
        least_patches: int,
        camera: bool,
        tested: int,
        least_facing: float,
        extent_m: float,
        noise_m: float,
        noise_floor_m: float,
        least_inliers: float,
        least_ratio: float,
        least_information: float,
        systematic: bool,
        turn_rad: float,
        move_m: float,
        across: NDArray[np.float64],
        beyond_m: float,
        least_close: float,
        part: int,
        numbers: NDArray[np.float64],
        many: int,
        least_share: int,
        most_share: int,
        small_share: int,
        quiet_m: float,
        threads: int = 1,
        matches: Matches | None = None,
    ) -> dict[str, Any]: ...
    def distances(
        self,
        points: NDArray[Any],
        T_ca: NDArray[np.float64],
        most_m: float,
        camera: bool,
        tested: int,
        least_facing: float,
    ) -> tuple[NDArray[np.float64], int]: ...
    def cast(
        self, eye: Sequence[float], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], int]: ...
    def size_step(
        self,
        points: NDArray[np.float64],
        camera: Sequence[float] | None,
        most_m: float,
        least: int,
        normal_quantile: float,
        cauchy: float,
        least_information: float,
    ) -> tuple[float, NDArray[np.float64], NDArray[np.float64]] | None: ...
    def faces_camera(self, points: Any, T_ca: Any, tested: int, least_facing: float) -> bool: ...
    @property
    def primitives(self) -> int: ...
    @property
    def nbytes(self) -> int: ...
    @property
    def isa(self) -> str: ...
    @property
    def shape(self) -> dict[str, Any]: ...
