import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array

def follow(
    q: Array, w: Array, sigma: tuple[float, float, float], push: tuple[float, float, float], times: NDArray[np.float64]
) -> tuple[Array, Array, Array, Array]: ...

class Path:
    def __init__(self, q: Array, w: Array, sigma: tuple[float, float, float]) -> None: ...
    def at(self, times: NDArray[np.float64]) -> tuple[Array, Array]: ...
