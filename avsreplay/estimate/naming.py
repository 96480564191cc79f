"""The 24 names of the principal axes: proper rotations that permute the axes and turn some of them round."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array

__all__ = ["NAMINGS", "Naming"]


@dataclass(frozen=True, slots=True, eq=False)
class Naming:
    """One of the 24: R_bn (3, 3), its quaternion, new axis i is old axis perm[i] up to sign, parity of perm."""

    R_bn: Array
    q_bn: Array
    perm: tuple[int, int, int]
    parity: float


def _namings() -> tuple[Naming, ...]:
    found = []
    for perm in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[perm, (0, 1, 2)] = signs
            if np.linalg.det(R) > 0.0:
                parity = float(np.sign(np.linalg.det(np.abs(R))))
                found.append(Naming(R, geometry.quaternion(R), (perm[0], perm[1], perm[2]), parity))
    return tuple(found)


NAMINGS = _namings()
