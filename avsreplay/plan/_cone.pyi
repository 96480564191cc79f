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

class Body:
    def __init__(self, vertices: Array, faces: NDArray[np.int32], /) -> None: ...
    def moved(self, origin: tuple[float, float, float], /) -> Body: ...
    def __call__(self, points: Array, /) -> tuple[Array, Array]: ...

class Space:
    def __init__(
        self,
        body: Body | None,
        clearance_m: float,
        sigmas: float,
        axis_c: tuple[float, float, float],
        corridor: tuple[float, float, float],
        centre_c: tuple[float, float, float],
        radius_m: float,
        enough_m: float,
        rates: tuple[float, float, float, float],
        a_max: float,
        coast_s: float,
        kept_share: float,
    ) -> None: ...
    def set_motion(self, c: Array, x: Array, /) -> None: ...
    def set_sigma(self, end_s: float, position: Array, attitude: Array, /) -> None: ...
    def gradient(self, y: Array, times: Array, most: Array, /) -> Array: ...
    def most(self, times: Array, r: Array, /) -> Array: ...
    def span(self, times: Array, r: Array, v: Array, /) -> Array: ...
    def ended(self, m: Array, /) -> Array: ...
    def margins(self, m: Array, tau: Array, below: float, /) -> Array: ...
    def least(self, m: Array, target: float, /) -> Array: ...
    def search(self, times: Array, r: Array, v: Array, d: Array, wanted: float, /) -> Array: ...
