"""A manipulator described by a URDF: the joint path of the last metres, through pinocchio (the extra ``arm``).

The arm carries the gripper along a plan that was made for its end-effector. Its joints follow by inverse kinematics
from the capture backwards. A plan that exceeds limits of joints, rates or torques is replaced by a later or slower one.
There is no gravity.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from avsreplay import geometry
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import Array, Pose
from avsreplay.outcome import Plan, PlanStatus
from avsreplay.plan.limits import Scene
from avsreplay.plan.path import RobotPath
from avsreplay.plan.rendezvous import no_plan
from avsreplay.plan.robot import Limits, RobotParams

INSTANTS = 81  # of the last metres
STARTS = 32  # joint configurations from which the inverse kinematics of the capture begins
ITERATIONS = 200
POSE_ERROR = 1e-8  # in metres and radians
DAMPING = 1e-3
CAPTURES = 16  # plans that are tried until the joints can fly one
STEP_S = 1.0  # spacing of the capture instants
QUICK = 8  # joint configurations from which the inverse kinematics of a capture instant begins
SLOWEST = 0.1  # smallest share of the largest acceleration
JUMP_RAD = 0.5  # a larger change of a joint between two instants is another branch


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


class Arm:
    """Kinematics and dynamics of a manipulator."""

    def __init__(self, urdf: Path, frame: str | None = None) -> None:
        """Read a URDF.

        Args:
            urdf: The file; meshes in it are not read.
            frame: Frame of the gripper; the last frame of the file where None.

        Raises:
            UsageError: pinocchio is not installed, the frame is unknown, or a joint turns without an end.
            UnreadableInput: The file cannot be read as a URDF.
        """
        try:
            self._pin: Any = importlib.import_module("pinocchio")
        except ModuleNotFoundError:
            hint = "pip install 'avsreplay[arm]', or leave robot.urdf out and give robot.reach_max_m"
            what = "a manipulator needs pinocchio, which is not installed"
            raise UsageError(what, where="robot.urdf", hint=hint) from None
        try:
            self._model = self._pin.buildModelFromXML(urdf.read_text(encoding="utf-8"))
        except FileNotFoundError:
            hint = "a relative path refers to the file that states it; name the robot again with --robot"
            raise UnreadableInput("no such URDF", where=str(urdf), hint=hint) from None
        except (OSError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise UnreadableInput(f"no URDF: {reason}", where=str(urdf), hint="check the file") from None
        model = self._model
        if model.nq != model.nv or model.nq == 0:
            raise UsageError("joints without limits are not supported", where=str(urdf), hint="give them as revolute")
        frame = frame or model.frames[model.nframes - 1].name
        if not model.existFrame(frame):
            names = ", ".join(f.name for f in list(model.frames)[1:])
            raise UsageError(f"there is no frame '{frame}'", where=str(urdf), hint=f"frames: {names}")
        model.gravity = self._pin.Motion.Zero()
        self._data, self._frame = model.createData(), model.getFrameId(frame)

    @property
    def reach_m(self) -> float:
        """Upper bound of the distance from the base to the gripper: the sum of the lengths of all links [m]."""
        model = self._model
        total = float(np.linalg.norm(model.frames[self._frame].placement.translation))
        joint = int(model.frames[self._frame].parentJoint)
        while joint > 0:
            total += float(np.linalg.norm(model.jointPlacements[joint].translation))
            if model.joints[joint].shortname().startswith("JointModelP"):  # a prismatic joint
                k = model.joints[joint].idx_q
                total += max(abs(model.lowerPositionLimit[k]), abs(model.upperPositionLimit[k]))
            joint = int(model.parents[joint])
        return total

    def inverse(self, target: Pose, start: Array) -> Array | None:
        """Return joints (k,) that bring the gripper to a pose, by damped Gauss-Newton steps; None where it fails.

        Args:
            target: Pose of the gripper in the frame of the base.
            start: (k,) joints at the begin.
        """
        pin, model, data = self._pin, self._model, self._data
        goal = pin.SE3(geometry.matrix(target.q), np.asarray(target.t))
        q = np.array(start, dtype=np.float64)
        for _ in range(ITERATIONS):
            pin.framesForwardKinematics(model, data, q)
            error = pin.log6(data.oMf[self._frame].actInv(goal)).vector
            if float(np.abs(error).max()) <= POSE_ERROR:
                return q
            J = pin.computeFrameJacobian(model, data, q, self._frame, pin.ReferenceFrame.LOCAL)
            damping = DAMPING * min(float(error @ error), 1.0) + 1e-12
            step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), error)
            step *= min(1.0, JUMP_RAD / max(float(np.abs(step).max()), 1e-12))
            q = np.clip(q + step, model.lowerPositionLimit, model.upperPositionLimit)
        return None

    def last_metres(self, path: RobotPath, scene: Scene, limits: Limits) -> JointPath:
        """Return the joints along the end of a plan; of several branches at the capture the one that reaches farthest.

        The gripper has the attitude of the fixture.

        Args:
            path: Path of the end-effector in {A}.
            scene: The target after the instant of planning, with its attitude.
            limits: Resolved limits: the pose of the base, and the length of the final approach.

        Raises:
            ValueError: The scene has no attitude.
        """
        all_times = np.linspace(0.0, path.t_go_s, 1001)
        far = np.flatnonzero(
            np.linalg.norm(path.at(all_times)[0] - scene.goal(all_times)[0], axis=1) > (limits.final_range_m or 0.0)
        )
        begin_s = float(all_times[far[-1]]) if len(far) else 0.0
        times = np.linspace(begin_s, path.t_go_s, INSTANTS)
        r = path.at(times)[0]
        poses = self._poses(scene, limits, times, r)
        best: list[Array] = []
        for start in self._starts():
            end = self.inverse(poses[-1], start)
            if end is None:
                continue
            traced = self._traced(poses, end)
            if len(traced) > len(best):
                best = traced
            if len(best) == len(times):
                break
        return self._graded(times[len(times) - len(best) :], best, r[len(times) - len(best) :], len(best) == len(times))

    def fitted(
        self,
        make: Callable[[float, float], Plan],
        path: Callable[[Plan], RobotPath],
        scene: Scene,
        limits: Limits,
        first_s: float,
        horizon_s: float,
        hint_s: float = 0.0,
    ) -> tuple[Plan, JointPath | None]:
        """Return the earliest plan found whose last metres the joints can fly within all of their limits.

        Where rates or torques are too large the acceleration is reduced; where the pose of the capture or the way to it
        is out of reach, the next capture instant whose pose the arm reaches is tried.

        Args:
            make: Plans for an earliest capture [s] with a share of the largest acceleration.
            path: Returns the path of a plan.
            scene: The target after the instant of planning, with its attitude.
            limits: Resolved limits: the pose of the base, and the length of the final approach.
            first_s: Earliest capture [s after the instant of planning].
            horizon_s: Latest capture.
            hint_s: Capture of an earlier plan that the joints delayed; it is tried first, a little earlier.

        Returns:
            The plan and its joints. Without one the first plan with the status ``none_found`` and the joints of the
            first plan; a plan that was not found, without joints.
        """
        if hint_s - 0.5 * STEP_S > first_s:
            made = make(hint_s - 0.5 * STEP_S, 1.0)
            joints = self.last_metres(path(made), scene, limits) if made.found else None
            if joints is not None and joints.possible:
                return _later(made, make(first_s, 1.0).lower_bound_s), joints
        earliest_s, share, first = first_s, 1.0, None
        for _ in range(CAPTURES):
            made = make(earliest_s, share)
            joints = self.last_metres(path(made), scene, limits) if made.found else None
            if joints is not None and joints.possible:
                return (made if first is None else _later(made, first[0].lower_bound_s)), joints
            first = first or (made, joints)
            least = 1.0 if joints is None else joints.slower
            if joints is not None and least * share >= SLOWEST and least < 1.0:
                share *= least
                continue
            after_s = self._next_capture(scene, limits, max(made.t_go_s if made.found else 0.0, earliest_s), horizon_s)
            if after_s is None or (not made.found and share == 1.0):
                break
            earliest_s, share = after_s, 1.0
        assert first is not None
        made, joints = first
        none = no_plan(made.t_ns, PlanStatus.NOT_FOUND, made.a_max, made.lower_bound_s)
        return (replace(none, delayed_by="arm") if made.found else made), joints

    def _next_capture(self, scene: Scene, limits: Limits, after_s: float, horizon_s: float) -> float | None:
        """Return the first instant later than ``after_s`` by STEP_S or more at which the arm reaches the fixture."""
        times = np.arange(after_s + STEP_S, horizon_s, STEP_S)
        poses, reach = self._poses(scene, limits, times, scene.goal(times)[0]), self.reach_m
        for t, pose in zip(times, poses, strict=True):
            near = float(np.linalg.norm(pose.t)) <= reach
            if near and any(self.inverse(pose, start) is not None for start in self._starts()[:QUICK]):
                return float(t)
        return None

    def _poses(self, scene: Scene, limits: Limits, times: Array, r: Array) -> list[Pose]:
        """Return the poses of the gripper at r (n, 3) in {A}, with the attitude of the fixture, in the base's frame."""
        if scene.attitude is None:
            raise ValueError("the joints of an arm need the fixture's attitude, and the scene has none")
        turn = np.array(limits.base_attitude_xyzw)
        back = geometry.conjugate(turn / np.linalg.norm(turn))
        q, r_base = (
            geometry.multiply(back, scene.attitude(times)),
            (r - np.array(limits.base_m)) @ geometry.matrix(back).T,
        )
        return [Pose(*pose) for pose in zip(q, r_base, strict=True)]

    def _starts(self) -> Array:
        low, high = self._model.lowerPositionLimit, self._model.upperPositionLimit
        rng = np.random.Generator(np.random.PCG64(0))
        return np.concatenate([0.5 * (low + high)[None], low + (high - low) * rng.random((STARTS - 1, len(low)))])

    def _traced(self, poses: list[Pose], end: Array) -> list[Array]:
        """Return the joints at the last poses, in their order, as far back as the branch exists."""
        out = [end]
        for pose in reversed(poses[:-1]):
            found = self.inverse(pose, out[-1])
            if found is None or float(np.abs(found - out[-1]).max()) > JUMP_RAD:
                break
            out.append(found)
        return out[::-1]

    def _graded(self, times: Array, joints: list[Array], r: Array, complete: bool) -> JointPath:
        nan, model = math.nan, self._model
        if len(joints) < 3:
            return JointPath(np.empty(0), np.empty((0, model.nq)), 0.0, False, nan, nan, nan, nan)
        q = np.array(joints)
        rate = np.gradient(q, times, axis=0)
        bend = np.gradient(rate, times, axis=0)
        torque = np.array([self._pin.rnea(model, self._data, *row) for row in zip(q, rate, bend, strict=True)])
        middle = 0.5 * (model.lowerPositionLimit + model.upperPositionLimit)
        half = 0.5 * (model.upperPositionLimit - model.lowerPositionLimit)
        J = [self._pin.computeFrameJacobian(model, self._data, row, self._frame) for row in q]
        return JointPath(
            times=times,
            joints=q,
            length_m=float(np.linalg.norm(np.diff(r, axis=0), axis=1).sum()),
            complete=complete,
            condition=float(np.linalg.cond(np.array(J)).max()),
            range_share=_share(q - middle, half),
            rate_share=_share(rate, model.velocityLimit),
            torque_share=_share(torque, model.effortLimit),
        )


def _later(made: Plan, lower_bound_s: float) -> Plan:
    """Return a plan that the joints delay; the bound is certified without them [s]."""
    return replace(made, status=PlanStatus.FEASIBLE, lower_bound_s=lower_bound_s, delayed_by="arm")


def _share(values: Array, limits: Array) -> float:
    """Return the largest ratio to the limits; NaN where there is none."""
    on = np.isfinite(limits) & (limits > 0.0)
    return float((np.abs(values[:, on]) / limits[on]).max()) if on.any() else math.nan


def with_arm(robot: RobotParams) -> tuple[RobotParams, Arm | None]:
    """Return the robot and its arm, None without; the arm's reach is the workspace where none is given.

    Args:
        robot: The robot.

    Raises:
        UsageError: pinocchio is not installed, or the URDF is not usable.
        UnreadableInput: The URDF cannot be read.
    """
    if robot.urdf is None:
        return robot, None
    arm = Arm(Path(robot.urdf), robot.urdf_frame)
    return (robot if robot.reach_max_m is not None else replace(robot, reach_max_m=arm.reach_m)), arm
