"""The joints of a manipulator during the last metres of a plan, the use of their limits, and the
reach of its links.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.plan.limits import Scene
from avsreplay.plan.path import RobotPath
from avsreplay.plan.robot import Limits

EXACT_M = 1e-9  # an offset within this distance is on an axis [m]


@value_class
class JointPath:
    """The joints during the last metres of a plan.

    Attributes:
        times: (n,) instants [s after the instant of planning]; fewer than INSTANTS where the path
            is not complete.
        joints: (n, k) joint positions [rad or m].
        length_m: Length of the end-effector's path that the joints follow [m].
        complete: Whether this is all of the last metres.
        condition: Largest condition number of the Jacobian.
        range_share, rate_share, torque_share: Largest use of the limits of joint range, rate and
            torque, 1 at the limit; NaN where the URDF has none.
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
        """Share of the acceleration with which rates and torques may fit; 1 where another
        limit is exceeded.
        """
        inside = self.complete and not self.range_share > 1.0 + 1e-9
        rate, torque = (
            x if math.isfinite(x) else 0.0 for x in (self.rate_share, self.torque_share)
        )
        return min(1.0, 0.9 / max(torque, rate * rate, 0.9)) if inside else 1.0

    def record(self) -> dict[str, object]:
        """Return the path and its figures for a JSON document."""
        names = (
            "length_m",
            "complete",
            "possible",
            "condition",
            "range_share",
            "rate_share",
            "torque_share",
        )
        return {
            **{n: getattr(self, n) for n in names},
            "t_s": self.times.tolist(),
            "joints": self.joints.tolist(),
        }

    def described(self) -> list[tuple[str, str]]:
        """Return what is known about the arm as a name and a text."""
        if not len(self.times):
            return [("arm", "cannot reach the pose of the capture")]
        used = ", ".join(
            f"{name} {100.0 * share:.0f} %"
            for name, share in (
                ("range", self.range_share),
                ("rate", self.rate_share),
                ("torque", self.torque_share),
            )
            if math.isfinite(share)
        )
        verdict = (
            "can follow"
            if self.possible
            else "cannot follow"
            if self.complete
            else "loses the path in"
        )
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


def last_metres_s(path: RobotPath, scene: Scene, limits: Limits) -> float:
    """Return the instant at which the last metres of a plan begin, the length of the corridor
    before the capture [s].

    Args:
        path: Path of the end-effector in {A}.
        scene: The target after the instant of planning.
        limits: Resolved limits.
    """
    times = np.linspace(0.0, path.t_go_s, 1001)
    away = np.linalg.norm(path.at(times)[0] - scene.goal(times)[0], axis=1)
    far = np.flatnonzero(away > (limits.final_range_m or 0.0))
    return float(times[far[-1]]) if len(far) else 0.0


def sum_of_links(model: Any, frame: int) -> float:
    """Return an upper bound of the distance from the base to the gripper: the sum of the lengths of
    all links [m].

    Args:
        model: Model of the manipulator.
        frame: Number of the frame of the gripper.
    """
    total = float(np.linalg.norm(model.frames[frame].placement.translation))
    joint = int(model.frames[frame].parentJoint)
    while joint > 0:
        total += float(np.linalg.norm(model.jointPlacements[joint].translation))
        if model.joints[joint].shortname().startswith("JointModelP"):  # a prismatic joint
            k = model.joints[joint].idx_q
            total += max(abs(model.lowerPositionLimit[k]), abs(model.upperPositionLimit[k]))
        joint = int(model.parents[joint])
    return total


def shoulder_and_wrist(pin: Any, model: Any, data: Any, frame: int) -> tuple[Array, Array, float]:
    """Return shoulder (3,), wrist (3,) and the largest distance between them [m], the same for all
    joint positions.

    The shoulder is given in the frame of the base, the wrist in that of the gripper. They are the
    origins of the first and the last joint, or of the ones next to them where the offset lies on
    the axis of rotation.

    Args:
        pin: The module pinocchio.
        model: Model of the manipulator.
        data: Its data.
        frame: Number of the frame of the gripper.
    """
    tip, chain = model.frames[frame].placement.inverse(), [int(model.frames[frame].parentJoint)]
    while model.parents[chain[0]] > 0:
        chain.insert(0, int(model.parents[chain[0]]))
    pin.computeJointJacobians(model, data, pin.neutral(model))
    axes = [
        pin.getJointJacobian(model, data, j, pin.LOCAL)[:, model.joints[j].idx_v] for j in chain
    ]
    if len(chain) < 4 or any(np.linalg.norm(axis[3:]) < 0.5 for axis in axes):  # a prismatic joint
        return np.zeros(3), np.zeros(3), sum_of_links(model, frame)
    place = model.jointPlacements
    shoulder, wrist, inner = place[chain[0]].translation.copy(), tip.translation.copy(), chain[1:]
    if float(np.linalg.norm(np.cross(axes[0][3:], place[chain[1]].translation))) < EXACT_M:
        shoulder += place[chain[0]].rotation @ place[chain[1]].translation
        inner = inner[1:]
    offset = place[chain[-1]].rotation.T @ place[chain[-1]].translation
    if float(np.linalg.norm(np.cross(axes[-1][3:], offset))) < EXACT_M:
        wrist -= tip.rotation @ offset
        inner = inner[:-1]
    return shoulder, wrist, float(sum(np.linalg.norm(place[j].translation) for j in inner))
