"""What registration may be told; every length left to ``None`` is a stated fraction of the model's extent."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

from avsreplay.register.facing import Camera

__all__ = ["AcquireParams", "Limits", "RegisterParams"]

REACH_OF_EXTENT = 0.15  # a guess off by 24 deg moves a surface's far points by about this much
GATE_OF_EXTENT = 0.01
EPS_OF_EXTENT = 1e-6


@dataclass(frozen=True, slots=True)
class Limits:
    """The parameters a back end works with, no length left open.

    Attributes:
        reach_m: farthest a point may be from the model and still pull at the first pass.
        gate_m: the same at the end, and for the ruler: nearer points are inliers.
        n_max: passes.  eps_rad, eps_m: a pass that moves the pose by less ends the loop.
        threads: at most this many; never changes a bit of the result.
    """

    reach_m: float
    gate_m: float
    n_max: int
    eps_rad: float
    eps_m: float
    threads: int


@dataclass(frozen=True, slots=True)
class AcquireParams:
    """Parameters of the search for a pose without a guess. Raises ValueError naming a value that cannot be right."""

    starts: int = 600  # attitudes tried; seven times as many in the second effort
    coarse_points: int = 150  # points of the scan in the first selection
    coarse_passes: int = 8  # plane passes a start in the first selection
    middle_starts: int = 60  # starts kept for the second selection
    middle_points: int = 400  # points in the second selection
    middle_passes: int = 15  # plane passes in the second selection
    fine_starts: int = 6  # different poses registered on the model itself
    fine_points: int = 1500  # points they are registered and ranked with
    enough_ratio: float = 0.95  # share of the scan on the model that ends the search at the first effort
    least_ratio: float = 0.7  # smaller than that nothing was found
    margin: float = 0.01  # a second pose that leaves so little more of the scan unexplained is as good

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(each.default, int) and value < 1:
                raise ValueError(f"{each.name} is {value}, it must be at least 1")
            if isinstance(each.default, float) and not 0.0 <= value <= 1.0:
                raise ValueError(f"{each.name} is {value}, it must be within 0 and 1")


@dataclass(frozen=True, slots=True)
class RegisterParams:
    """Parameters of registration. Raises ValueError naming a value that cannot be right."""

    backend: str = "horn"  # entry-point name of the back end
    reach_m: float | None = None  # first rejection distance [m]; auto: 0.15 of the model's extent
    gate_m: float | None = None  # last rejection distance, and the ruler's [m]; auto: 0.01 of the extent
    n_max: int = 200  # passes before a registration counts as not converged
    eps_rad: float = 1e-5  # a pass that turns the pose by less has settled [rad]
    eps_m: float | None = None  # a pass that moves it by less has settled [m]; auto: 1e-6 of the extent
    noise_m: float | None = None  # 1 sigma of a point across the surface [m]; auto: from each scan's residuals
    min_inliers: int = 30  # fewer points on the model: no overlap
    min_inlier_ratio: float = 0.02  # a smaller share of the scan on the model: no overlap
    camera: Camera = Camera.AUTO  # where the scans were taken from: auto, origin or none
    subsample_m: float = 0.0  # keep one point a voxel of this size [m]; 0: keep all
    threads: int = 1  # threads of a back end that gives the same bits for any number
    acquire: AcquireParams = field(default_factory=AcquireParams)  # the search without a guess

    def __post_init__(self) -> None:
        for name in ("reach_m", "gate_m", "eps_m", "noise_m", "eps_rad"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}, it must be a positive number")
        for name in ("n_max", "min_inliers", "threads"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, it must be at least 1")
        if not 0.0 <= self.min_inlier_ratio <= 1.0:
            raise ValueError(f"min_inlier_ratio is {self.min_inlier_ratio}, it must be within 0 and 1")
        if not (math.isfinite(self.subsample_m) and self.subsample_m >= 0.0):
            raise ValueError(f"subsample_m is {self.subsample_m}, it must be 0 or a positive length")
        if self.reach_m is not None and self.gate_m is not None and self.gate_m > self.reach_m:
            raise ValueError(f"gate_m is {self.gate_m}, it must not exceed reach_m = {self.reach_m}")

    def limits(self, extent_m: float) -> Limits:
        """These parameters for a model of this extent [m] (the diagonal of its bounding box)."""
        reach = self.reach_m if self.reach_m is not None else REACH_OF_EXTENT * extent_m
        gate = self.gate_m if self.gate_m is not None else GATE_OF_EXTENT * extent_m
        eps = self.eps_m if self.eps_m is not None else EPS_OF_EXTENT * extent_m
        return Limits(max(reach, gate), min(gate, reach), self.n_max, self.eps_rad, eps, self.threads)
