"""The ``reference`` back end: the paper's ICP as corrected, in numpy and scipy, to compare the others with.

Every pass matches each point with its closest point on the model, then takes Horn's closed-form motion (eq:ICP).
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Fit
from avsreplay.register.port import Target
from avsreplay.register.quaternion_fit import best_motion

__all__ = ["ReferenceBackend"]

TIGHTEN = 3.0  # the gate in units of the last pass' rms
MIN_INLIERS = 6
SETTLED_GATE = 0.01  # the gate counts as settled once it moves by less than this share of itself


class ReferenceBackend:
    """Horn's quaternion ICP, point to surface, from the first pass to the fixed point.

    Rejection: a point takes part while it is nearer to the model than the gate. The gate starts at ``reach_m`` and
    after each pass is min(gate, max(gate_m, 3 rms)): wide while the guess is off, tight at the end, never growing.
    Stopping: a pass that turns less than ``eps_rad`` and moves the inliers' centroid less than ``eps_m``, with the
    gate settled.
    """

    name: ClassVar[str] = "reference"
    accuracy: ClassVar[tuple[float, float]] = (0.01, 0.0001)
    about: ClassVar[str] = "Horn's quaternion ICP on the mesh itself, numpy and scipy: slow and plain"

    def __init__(self, target: Target) -> None:
        self._limits, self._view = target.limits, target.view
        self._model = target.model

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """See :class:`avsreplay.register.port.Backend`."""
        scan = np.ascontiguousarray(points, dtype=np.float64)
        T_ca, gate = guess, self._limits.reach_m
        facing = self._view.camera_c(self._model, scan, guess) is not None
        for passes in range(1, self._limits.n_max + 1):
            moved = T_ca.apply(scan)
            found = self._model.closest(moved, camera_c=T_ca.t if facing else None)
            inlier = found.d2 < gate**2
            if inlier.sum() < MIN_INLIERS:
                return Fit(T_ca, passes, False)
            step = best_motion(moved[inlier], found.foot[inlier])
            T_ca = step @ T_ca
            tighter = min(gate, max(self._limits.gate_m, TIGHTEN * float(np.sqrt(found.d2[inlier].mean()))))
            if self._small(step, moved[inlier].mean(axis=0)) and gate - tighter <= SETTLED_GATE * gate:
                return Fit(T_ca, passes, True)
            gate = tighter
        return Fit(T_ca, self._limits.n_max, False)

    def _small(self, step: Pose, centroid: Array) -> bool:
        moved = float(np.linalg.norm(step.apply(centroid) - centroid))
        return float(geometry.angle(step.q)) < self._limits.eps_rad and moved < self._limits.eps_m
