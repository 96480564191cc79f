"""The ``horn`` back end: point-to-plane passes, then Horn's quaternion ICP to its fixed point, in C++."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

from numpy.typing import NDArray

from avsreplay.geometry import Pose
from avsreplay.records import Fit
from avsreplay.register.backend import Target
from avsreplay.register.surface_index import IcpParams

PLANE_PASSES = 3
MOST_WITHIN = 60  # passes of an alignment that begins near its result
FEW_POINTS = 600  # of a scan that has many more, for the first passes


class HornBackend:
    """Exact closest points on the model, one fused pass, identical results for any number of threads.

    Rejection and stopping are those of :class:`~avsreplay.register.surface_index.IcpParams`: the gate starts at
    ``reach_m``, follows three times the rms of the last pass and never goes below ``gate_m``. Where the position of the
    camera is known, only faces that face it are matched.
    """

    name: ClassVar[str] = "horn"
    accuracy: ClassVar[tuple[float, float]] = (0.001, 1e-05)
    same_bytes: ClassVar[bool] = True  # on every x86-64 processor
    about: ClassVar[str] = (
        "point-to-plane start, then Newton steps to the fixed point of Horn's quaternion ICP on the mesh itself, C++"
    )
    requires: ClassVar[tuple[tuple[str, str], ...]] = (("avsreplay.register._kernel", "avsreplay"),)
    get: ClassVar[str] = "a C++17 compiler, then pip install ."

    def __init__(self, target: Target) -> None:
        limits = target.limits
        self._index, self._visibility = target.index, target.visibility
        rule = IcpParams(
            n_max=limits.n_max,
            n_plane=min(PLANE_PASSES, limits.n_max),
            few=FEW_POINTS,
            gate_m=limits.reach_m,
            floor_m=limits.gate_m,
            eps_rad=limits.eps_rad,
            eps_m=limits.eps_m,
            threads=limits.threads,
        )
        self._rules = {facing: replace(rule, facing=facing) for facing in (False, True)}

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca, see :class:`avsreplay.register.backend.Backend`."""
        return self._run(points, guess, self._rules)

    def align_within(self, points: NDArray[Any], guess: Pose, gate_m: float) -> Fit:
        """Return T_ca with correspondences nearer than ``gate_m`` [m] from the first pass to the last."""
        most = min(self._rules[True].n_max, MOST_WITHIN)
        rules = {
            facing: replace(rule, n_max=most, gate_m=gate_m, floor_m=gate_m, tighten=0.0)
            for facing, rule in self._rules.items()
        }
        return self._run(points, guess, rules)

    def _run(self, points: NDArray[Any], guess: Pose, rules: dict[bool, IcpParams]) -> Fit:
        facing = self._visibility.camera_c(self._index, points, guess) is not None
        found = self._index.icp(points, guess, rules[facing])
        return Fit(Pose.from_matrix(found.T_ca), found.iterations, found.converged, found.matches)
