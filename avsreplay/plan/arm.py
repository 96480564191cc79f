"""A manipulator described by a URDF: the joint path of the last metres, through pinocchio (the extra ``arm``).

The arm carries the gripper along a plan that was made for its end-effector. Its joints follow by inverse kinematics
from the capture backwards. A plan that exceeds limits of joints, rates or torques is replaced by a later or slower one.
There is no gravity.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from avsreplay import geometry
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import Array, Pose
from avsreplay.outcome import Plan, PlanStatus
from avsreplay.plan.joint_path import JointPath, share_of
from avsreplay.plan.limits import Scene
from avsreplay.plan.path import MOTION_FACTOR, RobotPath
from avsreplay.plan.rendezvous import no_plan
from avsreplay.plan.robot import Limits, RobotParams

INSTANTS = 81  # instants of the last metres
STARTS = 32  # joint configurations from which the inverse kinematics of the capture begins
ITERATIONS = 200
STALLED = 10  # iterations without a smaller error that end the inverse kinematics
POSE_ERROR = 1e-8  # largest error of the inverse kinematics [m, rad]
DAMPING = 1e-3
CAPTURES = 16  # plans that are tried until the joints can fly one
GRID_S = 0.25  # spacing of the instants at which the reach is bounded
EXACT_M = 1e-9  # an offset within this distance is on an axis [m]
STEP_S = 1.0  # spacing of the capture instants
APPROACH = 9  # poses on the axis of the corridor at which a capture instant is tried
QUICK = 8  # joint configurations from which the inverse kinematics of a capture instant begins
SLOWEST = 0.1  # smallest share of the largest acceleration
JUMP_RAD = 0.5  # a larger change of a joint between two instants is another branch


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
        if not urdf.is_file():
            hint = "a relative path refers to the file that states it; name the robot again with --robot"
            raise UnreadableInput("no such URDF", where=str(urdf), hint=hint)
        try:
            self._model = self._pin.buildModelFromXML(urdf.read_text(encoding="utf-8"))
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
        self._reach = self._wrist()

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

    def _wrist(self) -> tuple[Array, Array, float]:
        """Return shoulder (3,), wrist (3,) and the largest distance between them [m], the same for all joint positions.

        The shoulder is given in the frame of the base, the wrist in that of the gripper. They are the origins of the
        first and the last joint, or of the ones next to them where the offset lies on the axis of rotation.
        """
        pin, model, data = self._pin, self._model, self._data
        tip, chain = model.frames[self._frame].placement.inverse(), [int(model.frames[self._frame].parentJoint)]
        while model.parents[chain[0]] > 0:
            chain.insert(0, int(model.parents[chain[0]]))
        pin.computeJointJacobians(model, data, pin.neutral(model))
        axes = [pin.getJointJacobian(model, data, j, pin.LOCAL)[:, model.joints[j].idx_v] for j in chain]
        if len(chain) < 4 or any(np.linalg.norm(axis[3:]) < 0.5 for axis in axes):  # a prismatic joint
            return np.zeros(3), np.zeros(3), self.reach_m
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

    def missing_m(self, target: Pose) -> float:
        """Return by how much a pose is certainly out of reach [m]; at most 0 where it may be in reach.

        Args:
            target: Pose of the gripper in the frame of the base.
        """
        shoulder, wrist, length = self._reach
        return float(np.linalg.norm(target.t + geometry.matrix(target.q) @ wrist - shoulder)) - length

    def never_reaches(self, scene: Scene, limits: Limits, horizon_s: float) -> bool:
        """Return whether the pose of the fixture is certainly out of reach at all times.

        Between two instants the distance changes by at most half the spacing times its largest rate, times 1.5.

        Args:
            scene: The target after the instant of planning, with its attitude.
            limits: Resolved limits: the pose of the base.
            horizon_s: Latest capture [s after the instant of planning].
        """
        times = np.arange(0.0, horizon_s + GRID_S, GRID_S)
        missing = np.array([self.missing_m(pose) for pose in self._poses(scene, limits, times, scene.goal(times)[0])])
        return bool(missing.min() > 0.5 * MOTION_FACTOR * np.abs(np.diff(missing)).max())

    def inverse(self, target: Pose, start: Array) -> Array | None:
        """Return joints (k,) that bring the gripper to a pose, by damped Gauss-Newton steps; None where it fails.

        Args:
            target: Pose of the gripper in the frame of the base.
            start: (k,) joints at the begin.
        """
        pin, model, data = self._pin, self._model, self._data
        goal = pin.SE3(geometry.matrix(target.q), np.asarray(target.t))
        q, least, since = np.array(start, dtype=np.float64), math.inf, 0
        for _ in range(ITERATIONS):
            pin.framesForwardKinematics(model, data, q)
            error = pin.log6(data.oMf[self._frame].actInv(goal)).vector
            size = float(np.abs(error).max())
            if size <= POSE_ERROR:
                return q
            least, since = (size, 0) if size < 0.95 * least else (least, since + 1)
            if since > STALLED:
                return None
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

        If rates or torques are too large, the acceleration is reduced. If the pose of the capture or the way to it is
        out of reach, the next capture instant is tried whose pose the arm reaches.

        Args:
            make: Plans for an earliest capture [s] with a share of the largest acceleration.
            path: Returns the path of a plan.
            scene: The target after the instant of planning, with its attitude.
            limits: Resolved limits: the pose of the base, and the length of the final approach.
            first_s: Earliest capture [s after the instant of planning].
            horizon_s: Latest capture.
            hint_s: Capture of an earlier plan that the joints delayed; it is tried first, a little earlier.

        Returns:
            The plan and its joints. Without one a plan with the status ``none_found`` and the joints of the first plan,
            or ``infeasible_within_horizon`` without joints where the fixture is certainly out of the arm's reach.
        """
        if self.never_reaches(scene, limits, horizon_s):
            made = make(first_s, 1.0)
            return no_plan(made.t_ns, PlanStatus.INFEASIBLE, made.a_max, horizon_s), None
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
        none = replace(no_plan(made.t_ns, PlanStatus.NOT_FOUND, made.a_max, made.lower_bound_s), delayed_by="arm")
        return (none if made.found else made), joints

    def _next_capture(self, scene: Scene, limits: Limits, after_s: float, horizon_s: float) -> float | None:
        """Return the first instant later than ``after_s`` by STEP_S or more at which the arm reaches the fixture.

        It reaches the pose of the capture and, with the same branch of the joints, the corridor ahead of it.
        """
        times = np.arange(after_s + STEP_S, horizon_s, STEP_S)
        goal = scene.goal(times)[0]
        near = [self.missing_m(pose) <= 0.0 for pose in self._poses(scene, limits, times, goal)]
        axis = np.array([1.0, 0.0, 0.0]) if scene.axis_c is None else scene.axis_c
        for k in np.flatnonzero(near):
            instants = np.full(APPROACH, times[k])
            ahead = np.linspace(limits.final_range_m or 0.0, 0.0, APPROACH)[:, None]
            assert scene.attitude is not None
            r = goal[k] + ahead * (geometry.matrix(scene.attitude(instants[:1])[0]) @ axis)
            line = self._poses(scene, limits, instants, r)
            for start in self._starts()[:QUICK]:
                end = self.inverse(line[-1], start)
                if end is not None and len(self._traced(line, end)) == APPROACH:
                    return float(times[k])
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
            range_share=share_of(q - middle, half),
            rate_share=share_of(rate, model.velocityLimit),
            torque_share=share_of(torque, model.effortLimit),
        )


def _later(made: Plan, lower_bound_s: float) -> Plan:
    """Return a plan that the joints delay; the bound is certified without them [s]."""
    return replace(made, status=PlanStatus.FEASIBLE, lower_bound_s=lower_bound_s, delayed_by="arm")


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
