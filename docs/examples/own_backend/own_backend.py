"""A registration back end of one's own: point-to-point ICP with SciPy's solution of the
rotation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from avsreplay.geometry import Pose, angle
from avsreplay.records import Fit
from avsreplay.register.backend import Backend, Target
from avsreplay.settings import Settings, setting

LEAST_POINTS = 6


@dataclass(frozen=True, slots=True)
class OwnParams(Settings):
    """The table [register.own]."""

    tighten: float = setting(
        3.0,
        "Rejection distance over the rms distance of the inliers. A larger value uses more points"
        " that are not on the target.",
        above=1.0,
    )


class OwnBackend(Backend):
    """Iterates closest points and the rigid motion between them."""

    name: ClassVar[str] = "own"
    about: ClassVar[str] = "point-to-point ICP of the tutorial"
    requires: ClassVar[tuple[tuple[str, str], ...]] = (("scipy", "scipy"),)
    get: ClassVar[str] = "pip install scipy"
    parameters = OwnParams
    accuracy: ClassVar[tuple[float, float]] = (0.05, 0.0005)

    def __init__(self, target: Target) -> None:
        """Keep what is needed of the target.

        Args:
            target: ``surface`` (vertices (n, 3) in {C} [m], faces), ``index`` (exact closest
                points), ``limits`` (rejection distances, stopping rule), ``visibility`` and the
                parameters of this back end.
        """
        self._index, self._limits = target.index, target.limits
        self._own = target.parameters(OwnParams)

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return the pose T_ca that takes the scan {A} to the model {C}.

        Args:
            points: (n, 3) finite points in {A} [m], n >= 1.
            guess: T_ca to start from.

        Returns:
            The pose, the number of iterations, and whether the iteration converged: a pose that did
            not converge must say so. Without correspondences: the guess and False.
        """
        scan, T_ca, gate = np.asarray(points, dtype=np.float64), guess, self._limits.reach_m
        for count in range(1, self._limits.n_max + 1):
            moved = T_ca.apply(scan)
            found = self._index.closest(moved)  # d2 (n,) [m2], foot (n, 3), normal (n, 3) in {C}
            inlier = found.d2 < gate**2
            if inlier.sum() < LEAST_POINTS:
                return Fit(guess, count, False)
            step = rigid_motion(moved[inlier], found.foot[inlier])
            T_ca = step @ T_ca
            rms = float(np.sqrt(found.d2[inlier].mean()))
            tighter = min(gate, max(self._limits.gate_m, self._own.tighten * rms))
            settled = gate - tighter <= 0.01 * gate
            gate = tighter
            middle = moved[inlier].mean(axis=0)
            shift = float(np.linalg.norm(step.apply(middle) - middle))
            if settled and angle(step.q) < self._limits.eps_rad and shift < self._limits.eps_m:
                return Fit(T_ca, count, True)
        return Fit(T_ca, self._limits.n_max, False)


def rigid_motion(moving: NDArray[Any], fixed: NDArray[Any]) -> Pose:
    """Least-squares motion that takes points (n, 3) [m] to the points of the same row."""
    a, b = moving.mean(axis=0), fixed.mean(axis=0)
    turn = Rotation.align_vectors(fixed - b, moving - a)[0]
    return Pose(turn.as_quat(), b - turn.apply(a))
