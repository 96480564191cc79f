"""Settings of registration; lengths that are not given scale with the model's extent."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

from avsreplay.parts import BACKENDS
from avsreplay.settings import NoParameters, Settings, Tables, given, setting


class Camera(Enum):
    """Where the scans were taken from."""

    # origin of {A}, if the mesh has a closed part and the origin is well outside the model
    AUTO = "auto"
    ORIGIN = "origin"  # origin of {A}
    NONE = "none"  # unknown: both sides of a face are matched


@dataclass(frozen=True, slots=True)
class RegistrationLimits:
    """The parameters of a back end, every length given.

    Attributes:
        reach_m: rejection distance of a correspondence in the first iteration [m].
        gate_m: the same in the last iteration; nearer points are inliers [m].
        n_max: largest number of iterations.
        eps_rad, eps_m: an iteration that moves the pose by less ends the loop.
        threads: largest number of threads; the result does not depend on it.
    """

    reach_m: float
    gate_m: float
    n_max: int
    eps_rad: float
    eps_m: float
    threads: int


@dataclass(frozen=True, slots=True)
class AcquireParams(Settings):
    """Parameters of the global search: registration without an initial guess."""

    starts: int = setting(
        600,
        "Number of initial attitudes of the search; its second round tries seven times as many."
        " With more of them, poses of difficult shapes are found more often, in more time.",
        low=1,
    )
    least_ratio: float = setting(
        0.7,
        "Smallest inlier ratio of a pose that the search returns. A larger value rejects more wrong"
        " poses, and more poses of partly hidden targets.",
        low=0.0,
        high=1.0,
    )
    least_separate: float = setting(
        0.4,
        "Smallest inlier ratio of a pose that the search returns if the other points are far from"
        " the model, as those of another object are.",
        low=0.0,
        high=1.0,
    )
    margin: float = setting(
        0.01,
        "The result is ambiguous if a second pose leaves less than this share more of the"
        " points unexplained. A larger value rejects more poses of nearly symmetric targets.",
        low=0.0,
        high=1.0,
    )


@dataclass(frozen=True, slots=True)
class RegisterParams(Settings):
    """Parameters of registration."""

    backend: str = setting(
        "horn", "Registration back end, by its entry-point name ('avsreplay backends' lists them)."
    )
    reach_m: float | None = setting(
        None,
        "Rejection distance of a correspondence in the first iteration. A larger value corrects"
        " larger errors of the initial guess, but uses more points that are not on the target.",
        unit="m",
        above=0.0,
        of_extent=0.15,
    )
    gate_m: float | None = setting(
        None,
        "Rejection distance in the last iteration; a point closer to the model is an inlier. A"
        " larger value accepts a less accurate model and more points beside the target.",
        unit="m",
        above=0.0,
        of_extent=0.01,
    )
    n_max: int = setting(
        200,
        "Iterations after which a registration counts as not converged. A larger value helps views"
        " with a weakly determined direction and takes more time.",
        low=1,
    )
    eps_rad: float = setting(
        1e-5,
        "The iteration ends when a step rotates the pose by less than this. A larger value ends it"
        " earlier, at a less exact pose.",
        unit="rad",
        above=0.0,
    )
    eps_m: float | None = setting(
        None,
        "The iteration ends when a step moves the pose by less than this. A larger value ends it"
        " earlier, at a less exact pose.",
        unit="m",
        above=0.0,
        of_extent=1e-6,
    )
    noise_m: float | None = setting(
        None,
        "1 sigma of a point's error normal to the surface. A larger value increases the covariance"
        " of the pose.",
        unit="m",
        above=0.0,
        unset="estimated from the residuals of each scan",
    )
    min_inliers: int = setting(
        30,
        "Smallest number of inliers; a scan with fewer gets the status no_overlap and is not used.",
        low=1,
    )
    min_inlier_ratio: float = setting(
        0.02,
        "Smallest ratio of inliers to points; a scan with a smaller one gets the status no_overlap"
        " and is not used.",
        low=0.0,
        high=1.0,
    )
    camera: Camera = setting(
        Camera.AUTO,
        "Position of the camera, which decides the side of a face on which a point can be: the"
        " origin of the frame of the clouds (origin), unknown (none), or the origin where model and"
        " scan agree with it (auto).",
    )
    subsample_m: float = setting(
        0.0,
        "Edge length of the voxels in each of which one point is kept. A larger value takes less"
        " time and gives a less accurate pose; 0 keeps all points.",
        unit="m",
        low=0.0,
    )
    split_every: int = setting(
        5,
        "The poses from two halves of the scan are compared on every n-th scan (column split_nis)."
        " A larger value takes less time and tests fewer scans.",
        low=1,
    )
    threads: int = setting(
        1,
        "Largest number of threads of a back end; the result does not depend on it.",
        low=1,
        high=1024,
    )
    index_cache: bool = setting(
        True, "Keep the index of a large model in the user's cache folder between runs."
    )
    acquire: AcquireParams = setting(AcquireParams, "The global search.")
    own: Tables = setting(
        Tables, "The parameters of back ends, one table [register.NAME] each.", parts=BACKENDS
    )

    def check(self) -> None:
        """Raise ValueError where the two rejection distances are in the wrong order."""
        if self.reach_m is not None and self.gate_m is not None and self.gate_m > self.reach_m:
            raise ValueError(f"gate_m is {self.gate_m}, must not exceed reach_m = {self.reach_m}")

    def with_own(self) -> RegisterParams:
        """Return the same with the parameters of the back end that is used, given or default."""
        kind = BACKENDS.parameters(self.backend) or NoParameters
        return replace(self, own=self.own.with_part(self.backend, kind))

    def limits(self, extent_m: float) -> RegistrationLimits:
        """Return the parameters of a back end for a model of a given size.

        Args:
            extent_m: diagonal of the model's bounding box [m]; automatic lengths are proportional
                to it.
        """
        auto = replace(self, reach_m=None, gate_m=None).resolved(extent_m)
        reach = given(auto.reach_m) if self.reach_m is None else self.reach_m
        gate = given(auto.gate_m) if self.gate_m is None else self.gate_m
        return RegistrationLimits(
            max(reach, gate),
            min(gate, reach),
            self.n_max,
            self.eps_rad,
            given(auto.eps_m),
            self.threads,
        )
