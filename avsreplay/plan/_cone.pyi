import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array

def solve(
    n: int,
    start: tuple[float, float, float],
    cost: tuple[float, float],
    stage: NDArray[np.int32],
    C: Array,
    d: Array,
    cones: NDArray[np.int32],
) -> tuple[float, float, Array, int] | None: ...
