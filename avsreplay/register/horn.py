"""The ``horn`` back end: point-to-plane passes to come near, then Horn's quaternion ICP to its fixed point, in C++."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Pose
from avsreplay.records import Fit
from avsreplay.register.model import IcpParams, IcpResult
from avsreplay.register.port import Target

__all__ = ["HornBackend"]

PLANE_PASSES = 6
ROUND_PASSES = 3  # plane passes between two looks at which points face the camera
ROUNDS = 12
SETTLED_SHARE = 0.002  # rounds end once fewer points than this share change sides
NEAR = 100.0  # or once a round's last step is within this many eps


class HornBackend:
    """Ours: exact closest points on the model, one fused pass, the same bits for any number of threads.

    Rounds: points whose foot lies on a side that the camera cannot see are left out (``facing``), three plane passes
    are made with the rest, and so on until hardly a point changes sides; then the passes to the fixed point.
    Rejection and stopping are those of :class:`avsreplay.register.model.IcpParams`: the gate starts at ``reach_m``,
    follows three times the last pass' rms and never goes under ``gate_m``.
    """

    name: ClassVar[str] = "horn"
    about: ClassVar[str] = "plane start, then Horn's quaternion ICP to its fixed point on the mesh itself, C++"

    def __init__(self, target: Target) -> None:
        limits = self._limits = target.limits
        self._model, self._view = target.model, target.view
        self._rule = IcpParams(
            n_max=limits.n_max,
            n_plane=min(PLANE_PASSES, limits.n_max),
            gate_m=limits.reach_m,
            floor_m=limits.gate_m,
            eps_rad=limits.eps_rad,
            eps_m=limits.eps_m,
            threads=limits.threads,
        )

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """See :class:`avsreplay.register.port.Backend`."""
        T_ca, facing, gate, passes = guess, self._facing(points, guess), self._limits.reach_m, 0
        for _ in range(ROUNDS):
            if passes + ROUND_PASSES >= self._rule.n_max:
                break
            rule = replace(self._rule, n_max=ROUND_PASSES, n_plane=ROUND_PASSES, gate_m=gate)
            found = self._model.icp(points[facing], T_ca, rule)
            T_ca, gate, passes = Pose.from_matrix(found.T_ca), found.gate_m, passes + found.iterations
            before, facing = facing, self._facing(points, T_ca)
            if np.count_nonzero(before != facing) <= SETTLED_SHARE * len(points) and self._near(found):
                break
        left = self._rule.n_max - passes
        rule = replace(self._rule, n_max=left, n_plane=min(PLANE_PASSES, left), gate_m=gate)
        found = self._model.icp(points[facing], T_ca, rule)
        return Fit(Pose.from_matrix(found.T_ca), passes + found.iterations, found.converged)

    def _facing(self, points: NDArray[Any], T_ca: Pose) -> NDArray[np.bool_]:
        return self._view.seen(self._model.closest(T_ca.apply(points)), T_ca)

    def _near(self, found: IcpResult) -> bool:
        return found.step_rad < NEAR * self._limits.eps_rad and found.step_m < NEAR * self._limits.eps_m
