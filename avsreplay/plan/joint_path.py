"""The joints of a manipulator during the last metres of a plan, and how much of their limits they use."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from avsreplay.geometry import Array


@dataclass(frozen=True, slots=True, eq=False)
class JointPath:
    """The joints during the last metres of a plan.

    Attributes:
        times: (n,) instants [s after the instant of planning]; fewer than INSTANTS where the path is not complete.
        joints: (n, k) joint positions [rad or m].
        length_m: Length of the end-effector's path that the joints follow [m].
        complete: Whether this is all of the last metres.
        condition: Largest condition number of the Jacobian.
        range_share, rate_share, torque_share: Largest use of the limits of joint range, rate and torque, 1 at the
            limit; NaN where the URDF has none.
    """

    times: Array
    joints: Array
    length_m: float
    complete: bool
    condition: float
    range_share: float
    rate_share: float
    torque_share: float

    @property
    def possible(self) -> bool:
        """Whether the arm can fly the last metres within all limits."""
        shares = (self.range_share, self.rate_share, self.torque_share)
        return self.complete and not any(share > 1.0 + 1e-9 for share in shares)

    @property
    def slower(self) -> float:
        """Share of the acceleration with which rates and torques may fit; 1 where another limit is exceeded."""
        inside = self.complete and not self.range_share > 1.0 + 1e-9
        rate, torque = (x if math.isfinite(x) else 0.0 for x in (self.rate_share, self.torque_share))
        return min(1.0, 0.9 / max(torque, rate * rate, 0.9)) if inside else 1.0

    def record(self) -> dict[str, object]:
        """Return the path and its figures for a JSON document."""
        names = ("length_m", "complete", "possible", "condition", "range_share", "rate_share", "torque_share")
        return {**{n: getattr(self, n) for n in names}, "t_s": self.times.tolist(), "joints": self.joints.tolist()}

    def described(self) -> list[tuple[str, str]]:
        """Return what is known about the arm as a name and a text."""
        if not len(self.times):
            return [("arm", "cannot reach the pose of the capture")]
        used = ", ".join(
            f"{name} {100.0 * share:.0f} %"
            for name, share in (("range", self.range_share), ("rate", self.rate_share), ("torque", self.torque_share))
            if math.isfinite(share)
        )
        verdict = "can follow" if self.possible else "cannot follow" if self.complete else "loses the path in"
        text = f"{verdict} the last metres ({self.length_m:.2f} m in joints): {used} of the limits"
        return [("arm", f"{text}; condition {self.condition:.0f}")]


def share_of(values: Array, limits: Array) -> float:
    """Return the largest ratio to the limits; NaN where there is none.

    Args:
        values: (n, k) values of k joints.
        limits: (k,) their limits; one that is zero or infinite does not exist.
    """
    on = np.isfinite(limits) & (limits > 0.0)
    return float((np.abs(values[:, on]) / limits[on]).max()) if on.any() else math.nan
