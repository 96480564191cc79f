import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array

_Rows = tuple[NDArray[np.int64], Array, Array, Array, Array, Array, NDArray[np.int64]]

def solve(
    n: int,
    start: tuple[float, float, float],
    cost: tuple[float, float],
    stage: NDArray[np.int32],
    C: Array,
    d: Array,
    cones: NDArray[np.int32],
) -> tuple[float, float, Array, int] | None: ...
def rows(
    y: Array,
    dy: Array,
    r: Array,
    rho: Array,
    R: Array,
    first: Array,
    second: Array,
    off: Array,
    foot: Array,
    distance: Array,
    clearance: Array,
    inside: NDArray[np.bool_],
    frame: Array,
    limits: tuple[float, ...],
    /,
) -> tuple[_Rows, _Rows]: ...
def spline(x: Array, y: Array, /) -> Array: ...
def values(c: Array, x: Array, times: Array, order: int, /) -> Array: ...
def motion(c: Array, x: Array, times: Array, order: int, /) -> tuple[Array, Array]: ...
def integrals(
    P0: Array, P1: Array, nodes: Array, turn: float, least: float, /
) -> tuple[Array, Array]: ...

class Winding:
    def inside(self, points: Array, distances: Array, least: float, /) -> NDArray[np.bool_]: ...

def winding(vertices: Array, faces: NDArray[np.int32], /) -> Winding: ...
