import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array

def follow(
    q: Array, w: Array, sigma: tuple[float, float, float], push: tuple[float, float, float], times: NDArray[np.float64]
) -> tuple[Array, Array, Array, Array]: ...
def correct(
    q_ab: Array,
    w_b: Array,
    r_a: Array,
    v_a: Array,
    sigma: Array,
    c_b: Array,
    q_bc: Array,
    P: Array,
    H: Array,
    alpha: Array,
    S: Array,
    R: Array,
    colour: tuple[float, float],
) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array]: ...
def filter(y: Array, P: Array, e: Array, H: Array, Q: Array) -> tuple[Array, Array]: ...

class Path:
    def __init__(self, q: Array, w: Array, sigma: tuple[float, float, float]) -> None: ...
    def at(self, times: NDArray[np.float64]) -> tuple[Array, Array]: ...
