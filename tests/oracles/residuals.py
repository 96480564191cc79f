"""Residuals and Jacobians of a registered scan point by point in numpy, to compare the sums of the
C++ kernel with.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array, Pose
from avsreplay.register.covariance import Evidence
from avsreplay.register.quality import LEAST_PATCHES, PATCH_OF_EXTENT
from avsreplay.register.surface_index import SurfaceIndex
from avsreplay.register.visibility import Visibility


@dataclass(frozen=True, eq=False)
class Residuals:
    """Inliers at a pose: J (k, 6) rows [p x n, n], e (k,) n . (p - closest point) [m], patch
    (k,), points p (k, 3).
    """

    J: Array
    e: Array
    patch: NDArray[np.intp]
    p: Array
    d2: Array

    @property
    def inliers(self) -> int:
        return len(self.e)


def residuals(
    index: SurfaceIndex, visibility: Visibility, points: NDArray[Any], T_ca: Pose, gate_m: float
) -> Residuals:
    moved = T_ca.apply(points)
    found = index.closest(moved, camera_c=visibility.camera_c(index, points, T_ca))
    near = found.d2 < gate_m**2
    p, n = moved[near], found.normal[near]
    e = np.sum(n * (p - found.foot[near]), axis=1)
    at = p - e[:, None] * n
    cells = np.unique(
        np.floor(at / (PATCH_OF_EXTENT * index.extent_m)), axis=0, return_inverse=True
    )[1].reshape(-1)
    patch = cells if cells.max(initial=-1) >= LEAST_PATCHES else np.arange(len(p))
    return Residuals(np.hstack([np.cross(p, n), n]), e, patch, p, found.d2[near])


def summed(
    J: Array, e: Array, patch: NDArray[np.intp], noise_m: float = 0.3, p: Array | None = None
) -> Evidence:
    """The evidence of given residuals; patch (k,) numbers from 0; points p (k, 3), all at the
    origin if None.
    """
    counts = np.bincount(patch)
    normals, gradients = np.zeros((len(counts), 6, 6)), np.zeros((len(counts), 6))
    np.add.at(normals, patch, J[:, :, None] * J[:, None, :])
    np.add.at(gradients, patch, J * e[:, None])
    offsets, errors, places = (
        np.zeros((len(counts), 6)),
        np.zeros(len(counts)),
        np.zeros((len(counts), 3)),
    )
    np.add.at(offsets, patch, J)
    np.add.at(errors, patch, e)
    np.add.at(places, patch, np.zeros((len(e), 3)) if p is None else p)
    places /= np.maximum(counts, 1)[:, None]
    rms, centre = float(np.sqrt(np.mean(e**2))), places.mean(axis=0)
    return Evidence(
        len(e), len(e), rms, centre, noise_m, counts, normals, gradients, offsets, errors, places
    )
