"""A manipulator described by a URDF: the joint path of the last metres, through pinocchio (the
extra ``arm``).

The arm carries the gripper along a plan that was made for its end-effector. Its joints follow by
inverse kinematics from the capture backwards. A plan that exceeds limits of joints, rates or
torques is replaced by a later or slower one. There is no gravity.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from avsreplay import geometry
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import Array, Pose
from avsreplay.outcome import Plan, PlanStatus
from avsreplay.plan.joint_path import (
    JointPath,
    last_metres_s,
    share_of,
    shoulder_and_wrist,
    sum_of_links,
)
from avsreplay.plan.limits import Scene
from avsreplay.plan.path import MOTION_FACTOR, RobotPath
from avsreplay.plan.rendezvous import no_plan
from avsreplay.plan.robot import Limits, RobotParams

JOINT_INSTANTS = 81  # instants of the last metres
STARTS = 32  # joint configurations from which the inverse kinematics of the capture begins
JOINT_ITERATIONS = 200
STALLED = 10  # iterations without a smaller error that end the inverse kinematics
POSE_ERROR = 1e-8  # largest error of the inverse kinematics [m, rad]
DAMPING = 1e-3
CAPTURES = 16  # plans that are tried until the joints can fly one
REACH_GRID_S = 0.25  # spacing of the instants at which the reach is bounded
# interval between a capture that the joints miss and one that they follow at which the search ends
CLOSE_S = 0.1
CAPTURE_STEP_S = 1.0  # spacing of the capture instants
APPROACH = 9  # poses on the axis of the corridor at which a capture instant is tried
QUICK = 8  # joint configurations from which the inverse kinematics of a capture instant begins
SLOWEST = 0.1  # smallest share of the largest acceleration
SAME_BRANCH_RAD = 1e-4  # joints of the capture that differ by less belong to one branch
JUMP_RAD = 0.5  # a larger change of a joint between two instants is another branch


class Arm:
    """Kinematics and dynamics of a manipulator."""

    def __init__(self, urdf: Path, frame: str | None = None) -> None:
        """Read a URDF.

        Args:
            urdf: The file; meshes in it are not read.
            frame: Frame of the gripper; the last frame of the file where None.

        Raises:
            UsageError: pinocchio is not installed, the frame is unknown, or a joint turns without
                an end.
            UnreadableInput: The file cannot be read as a URDF.
        """
        try:
            self._pin: Any = importlib.import_module("pinocchio")
        except ModuleNotFoundError:
            hint = (
                "pip install 'avsreplay[arm]', or leave robot.urdf out and give robot.reach_max_m"
            )
            what = "a manipulator needs pinocchio, which is not installed"
            raise UsageError(what, where="robot.urdf", hint=hint) from None
        if not urdf.is_file():
            hint = (
                "a relative path refers to the file that states it; name the robot again with"
                " --robot"
            )
            raise UnreadableInput("no such URDF", where=str(urdf), hint=hint)
        try:
            self._model = self._pin.buildModelFromXML(urdf.read_text(encoding="utf-8"))
        except (OSError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise UnreadableInput(
                f"no URDF: {reason}", where=str(urdf), hint="check the file"
            ) from None
        model = self._model
        if model.nq != model.nv or model.nq == 0:
            raise UsageError(
                "joints without limits are not supported",
                where=str(urdf),
                hint="give them as revolute",
            )
        frame = frame or model.frames[model.nframes - 1].name
        if not model.existFrame(frame):
            names = ", ".join(f.name for f in list(model.frames)[1:])
            raise UsageError(
                f"there is no frame '{frame}'", where=str(urdf), hint=f"frames: {names}"
            )
        model.gravity = self._pin.Motion.Zero()
        self._data, self._frame = model.createData(), model.getFrameId(frame)
        self._reach = shoulder_and_wrist(self._pin, model, self._data, self._frame)

    @property
    def reach_m(self) -> float:
        """Upper bound of the distance from the base to the gripper: the sum of the lengths of
        all links [m].
        """
        return sum_of_links(self._model, self._frame)

    def missing_m(self, target: Pose) -> float:
        """Return by how much a pose is certainly out of reach [m]; at most 0 where it may be in
        reach.

        Args:
            target: Pose of the gripper in the frame of the base.
        """
        shoulder, wrist, length = self._reach
        return (
            float(np.linalg.norm(target.t + geometry.matrix(target.q) @ wrist - shoulder)) - length
        )

    def never_reaches(self, scene: Scene, limits: Limits, horizon_s: float) -> bool:
        """Return whether the pose of the fixture is certainly out of reach at all times.

        Between two instants the distance changes by at most half the spacing times its largest
        rate, times 1.5.

        Args:
            scene: The target after the instant of planning, with its attitude.
            limits: Resolved limits: the pose of the base.
            horizon_s: Latest capture [s after the instant of planning].
        """
        times = np.linspace(0.0, horizon_s, math.ceil(horizon_s / REACH_GRID_S) + 1)
        missing = np.array(
            [
                self.missing_m(pose)
                for pose in self._poses(scene, limits, times, scene.goal(times)[0])
            ]
        )
        return bool(missing.min() > 0.5 * MOTION_FACTOR * np.abs(np.diff(missing)).max())

    def inverse(self, target: Pose, start: Array) -> Array | None:
        """Return joints (k,) that bring the gripper to a pose, by damped Gauss-Newton steps; None
        where it fails.

        Args:
            target: Pose of the gripper in the frame of the base.
            start: (k,) joints at the begin.
        """
        pin, model, data = self._pin, self._model, self._data
        goal = pin.SE3(geometry.matrix(target.q), np.asarray(target.t))
        q, least, since = np.array(start, dtype=np.float64), math.inf, 0
        for _ in range(JOINT_ITERATIONS):
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

    def last_metres(
        self, path: RobotPath, scene: Scene, limits: Limits, starts: Array | None = None
    ) -> JointPath:
        """Return the joints along the end of a plan; of several branches at the capture the one
        that reaches farthest.

        The gripper has the attitude of the fixture.

        Args:
            path: Path of the end-effector in {A}.
            scene: The target after the instant of planning, with its attitude.
            limits: Resolved limits: the pose of the base, and the length of the final approach.
            starts: (m, k) joints from which the inverse kinematics of the capture begins; None:
                over their whole range.

        Raises:
            ValueError: The scene has no attitude.
        """
        times = np.linspace(last_metres_s(path, scene, limits), path.t_go_s, JOINT_INSTANTS)
        r = path.at(times)[0]
        poses = self._poses(scene, limits, times, r)
        best = self._farthest(poses, self._starts() if starts is None else starts)
        return self._graded(
            times[len(times) - len(best) :],
            best,
            r[len(times) - len(best) :],
            len(best) == len(times),
        )

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
        """Return the earliest plan found whose last metres the joints can fly within all of their
        limits.

        If rates or torques are too large, the acceleration is reduced. If the pose of the capture
        or the way to it is out of reach, the next capture instant is tried whose pose the arm
        reaches.

        Args:
            make: Plans for an earliest capture [s] with a share of the largest acceleration.
            path: Returns the path of a plan.
            scene: The target after the instant of planning, with its attitude.
            limits: Resolved limits: the pose of the base, and the length of the final approach.
            first_s: Earliest capture [s after the instant of planning].
            horizon_s: Latest capture.
            hint_s: Capture of an earlier plan that the joints delayed; it is tried first.

        Returns:
            The plan and its joints. Without one a plan with the status ``none_found`` and the
            joints of the first plan, or ``infeasible_within_horizon`` without joints where the
            fixture is certainly out of the arm's reach.
        """
        if self.never_reaches(scene, limits, horizon_s):
            made = make(first_s, 1.0)
            return no_plan(made.t_ns, PlanStatus.INFEASIBLE, made.a_max, horizon_s), None

        def flown(earliest_s: float, share: float) -> tuple[Plan, JointPath | None]:
            return self._flown(make(earliest_s, share), path, scene, limits)

        if hint_s > first_s:
            made, joints = flown(hint_s, 1.0)
            if _possible(joints):
                return _later(made, make(first_s, 1.0).lower_bound_s), joints
        first = flown(first_s, 1.0)
        if _possible(first[1]):
            return first
        later = self._later_capture(flown, path, scene, limits, first, (first_s, horizon_s))
        if later is not None:
            tried, last = later
            made, joints = self._earlier(make, path, scene, limits, tried, last)
            return _later(made, first[0].lower_bound_s), joints
        made, joints = first
        if not made.found:
            return made, joints
        none = no_plan(made.t_ns, PlanStatus.NOT_FOUND, made.a_max, made.lower_bound_s)
        return replace(none, delayed_by="arm"), joints

    def _later_capture(
        self,
        flown: Callable[[float, float], tuple[Plan, JointPath | None]],
        path: Callable[[Plan], RobotPath],
        scene: Scene,
        limits: Limits,
        first: tuple[Plan, JointPath | None],
        span_s: tuple[float, float],
    ) -> tuple[tuple[float, float], tuple[Plan, JointPath]] | None:
        """Return the first plan that the joints can fly after one that they cannot.

        Args:
            flown: Plan and joints for an earliest capture [s] with a share of the acceleration.
            path: Returns the path of a plan.
            scene: The target after the instant of planning.
            limits: Resolved limits.
            first: The plan that the joints cannot fly, with its joints.
            span_s: Earliest and latest capture [s after the instant of planning].

        Returns:
            The last capture that was missed [s] with the share of the acceleration, and the plan
            with its joints; None without one.
        """
        made, joints = first
        earliest_s, missed_s, share, lead_s = span_s[0], span_s[0], 1.0, 0.0
        for _ in range(1, CAPTURES):
            slower = 1.0 if joints is None else joints.slower
            if slower < 1.0 and slower * share >= SLOWEST:
                share *= slower
            else:
                if made.found:
                    lead_s = made.t_go_s - last_metres_s(path(made), scene, limits)
                    earliest_s = missed_s = max(made.t_go_s, earliest_s)
                after_s = self._next_capture(scene, limits, earliest_s, span_s[1], lead_s)
                if after_s is None or (not made.found and share == 1.0):
                    return None
                earliest_s, share = after_s, 1.0
            made, joints = flown(earliest_s, share)
            if _possible(joints):
                return (missed_s, share), (made, joints)
        return None

    def _flown(
        self, made: Plan, path: Callable[[Plan], RobotPath], scene: Scene, limits: Limits
    ) -> tuple[Plan, JointPath | None]:
        """Return a plan with the joints of its last metres, None where there is no plan."""
        return made, self.last_metres(path(made), scene, limits) if made.found else None

    def _earlier(
        self,
        make: Callable[[float, float], Plan],
        path: Callable[[Plan], RobotPath],
        scene: Scene,
        limits: Limits,
        missed: tuple[float, float],
        best: tuple[Plan, JointPath],
    ) -> tuple[Plan, JointPath]:
        """Return an earlier capture with the same branch of the joints; ``missed``: a capture
        that they miss, share.
        """
        missed_s, share = missed
        while best[0].t_go_s - missed_s > CLOSE_S:
            middle_s = 0.5 * (missed_s + best[0].t_go_s)
            made = make(middle_s, share)
            if made.found and made.t_go_s >= best[0].t_go_s:  # no capture is earlier
                break
            joints = (
                self.last_metres(path(made), scene, limits, best[1].joints[-1:])
                if made.found
                else None
            )
            if joints is not None and joints.possible:
                best = made, joints
            else:
                missed_s = middle_s
        return best

    def _next_capture(
        self, scene: Scene, limits: Limits, after_s: float, horizon_s: float, lead_s: float
    ) -> float | None:
        """Return the first instant later than ``after_s``, in steps of STEP_S, at which the arm
        reaches the fixture.

        It reaches the pose of the capture and, with the same branch of the joints, the axis of the
        corridor ahead of it during the time ``lead_s`` before, with a distance that decreases with
        the square of the time to the capture.
        """
        times = np.arange(after_s + CAPTURE_STEP_S, horizon_s, CAPTURE_STEP_S)
        goal = scene.goal(times)[0]
        near = [self.missing_m(pose) <= 0.0 for pose in self._poses(scene, limits, times, goal)]
        axis = np.array([1.0, 0.0, 0.0]) if scene.axis_c is None else scene.axis_c
        for k in np.flatnonzero(near):
            left = np.linspace(1.0, 0.0, APPROACH)
            instants = np.maximum(times[k] - lead_s * left, 0.0)
            assert scene.attitude is not None
            ahead = ((limits.final_range_m or 0.0) * left**2)[:, None]
            r = scene.goal(instants)[0] + ahead * (geometry.matrix(scene.attitude(instants)) @ axis)
            if (
                len(self._farthest(self._poses(scene, limits, instants, r), self._starts()[:QUICK]))
                == APPROACH
            ):
                return float(times[k])
        return None

    def _poses(self, scene: Scene, limits: Limits, times: Array, r: Array) -> list[Pose]:
        """Return the poses of the gripper at r (n, 3) in {A}, with the attitude of the fixture, in
        the base's frame.
        """
        if scene.attitude is None:
            raise ValueError(
                "the joints of an arm need the fixture's attitude, and the scene has none"
            )
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
        return np.concatenate(
            [0.5 * (low + high)[None], low + (high - low) * rng.random((STARTS - 1, len(low)))]
        )

    def _farthest(self, poses: list[Pose], starts: Array) -> list[Array]:
        """Return the joints at the last poses, of the branch at the last pose that reaches farthest
        back.
        """
        best, ends = list[Array](), list[Array]()
        for start in starts:
            end = self.inverse(poses[-1], start)
            if end is None or any(
                float(np.abs(end - other).max()) < SAME_BRANCH_RAD for other in ends
            ):
                continue
            ends.append(end)
            traced = self._traced(poses, end)
            if len(traced) > len(best):
                best = traced
            if len(best) == len(poses):
                break
        return best

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
        torque = np.array(
            [self._pin.rnea(model, self._data, *row) for row in zip(q, rate, bend, strict=True)]
        )
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


def _possible(joints: JointPath | None) -> TypeGuard[JointPath]:
    """Whether the joints can fly a path."""
    return joints is not None and joints.possible


def _later(made: Plan, lower_bound_s: float) -> Plan:
    """Return a plan that the joints delay; the bound is certified without them [s]."""
    return replace(made, status=PlanStatus.FEASIBLE, lower_bound_s=lower_bound_s, delayed_by="arm")


def with_arm(robot: RobotParams) -> tuple[RobotParams, Arm | None]:
    """Return the robot and its arm, None without; the arm's reach is the workspace where none is
    given.

    Args:
        robot: The robot.

    Raises:
        UsageError: pinocchio is not installed, or the URDF is not usable.
        UnreadableInput: The URDF cannot be read.
    """
    if robot.urdf is None:
        return robot, None
    arm = Arm(Path(robot.urdf), robot.urdf_frame)
    return (
        robot if robot.reach_max_m is not None else replace(robot, reach_max_m=arm.reach_m)
    ), arm
