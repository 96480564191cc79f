"""The joints of a manipulator during the last metres, against an independent forward
kinematics; needs pinocchio.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import Pose
from avsreplay.outcome import Plan, PlanStatus
from avsreplay.plan.arm import Arm, with_arm
from avsreplay.plan.constrained import constrained
from avsreplay.plan.guidance import Guidance, PlannerInput
from avsreplay.plan.joint_path import JointPath
from avsreplay.plan.limits import Scene
from avsreplay.plan.path import StepPath, path_of
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.plan.robot import Limits, RobotParams, slowed
from avsreplay.plan.supervisor import Supervisor, SupervisorParams
from avsreplay.records import Forecast

LENGTHS = (0.4, 1.2, 1.0, 0.3, 0.2, 0.15)
AXES = np.array([[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0], [0, 0, 1]], dtype=float)
TURN = Rotation.from_rotvec([0.0, 1.2, 0.0])


def _urdf(path: Path, rate: float = 1.0, effort: float = 50.0, bound: float = 2.9) -> Path:
    """Six revolute joints along z, y, y, z, y, z; links along z with a mass at their end."""
    out, height = ['<robot name="arm"><link name="base"/>'], 0.0
    for k, (axis, length) in enumerate(zip(AXES, LENGTHS, strict=True)):
        parent = f"link{k - 1}" if k else "base"
        out.append(
            f'<joint name="joint{k}" type="revolute"><parent link="{parent}"/><child'
            f' link="link{k}"/><origin xyz="0 0 {height}"/><axis xyz="{axis[0]} {axis[1]}'
            f' {axis[2]}"/><limit lower="{-bound}" upper="{bound}" velocity="{rate}"'
            f' effort="{effort}"/></joint><link name="link{k}"><inertial><origin xyz="0 0'
            f' {length}"/><mass value="{5.0 * length}"/><inertia ixx="0.02" iyy="0.02" izz="0.02"'
            ' ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
        height = length
    tip = '<joint name="tip" type="fixed"><parent link="link5"/><child link="gripper"/>'
    tip += f'<origin xyz="0 0 {height}"/></joint>'
    path.write_text("".join([*out, tip, '<link name="gripper"/></robot>']), encoding="utf-8")
    return path


def _forward(q: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Position and attitude of the gripper."""
    turn, position = Rotation.identity(), np.zeros(3)
    for angle, axis, length in zip(q, AXES, LENGTHS, strict=True):
        turn = turn * Rotation.from_rotvec(angle * axis)
        position = position + turn.apply([0.0, 0.0, length])
    return position, turn


def _flight(start: tuple[float, float, float], speed: float = 0.05) -> tuple[StepPath, Scene]:
    """Ten seconds along x at constant speed to a grasp point at rest."""
    path = StepPath(np.array(start), np.array([speed, 0.0, 0.0]), np.zeros((8, 3)), 0.0, 10.0)
    end = path.at(np.array([10.0]))[0]
    goal = lambda t: (np.tile(end, (len(t), 1)), np.zeros((len(t), 3)))  # noqa: E731
    return path, Scene(goal, lambda t: np.tile(TURN.as_quat(), (len(t), 1)))


LIMITS = Limits(base_m=(0.1, -0.2, 0.3), base_attitude_xyzw=(0.0, 0.0, 0.6, 0.8), final_range_m=0.4)
BASE, AHEAD = np.array(LIMITS.base_m), Rotation.from_quat(LIMITS.base_attitude_xyzw)


@pytest.fixture
def arm(tmp_path: Path) -> Arm:
    pytest.importorskip(
        "pinocchio", reason="pinocchio is not installed: pip install 'avsreplay[arm]'"
    )
    return Arm(_urdf(tmp_path / "arm.urdf"), "gripper")


def test_the_joints_carry_the_gripper_along_the_path(arm: Arm) -> None:
    path, scene = _flight((1.2, 0.3, 0.5))
    found = arm.last_metres(path, scene, LIMITS)
    assert found.complete
    assert found.possible
    assert found.length_m == pytest.approx(0.4, abs=2e-3)
    assert found.times[-1] == pytest.approx(10.0)
    for t, q in zip(found.times, found.joints, strict=True):
        position, turn = _forward(q)
        assert np.linalg.norm(AHEAD.apply(position) + BASE - path.at(np.array([t]))[0][0]) < 1e-6
        assert ((AHEAD * turn).inv() * TURN).magnitude() < 1e-6


def test_the_use_of_the_limits_is_that_of_the_joints(arm: Arm, tmp_path: Path) -> None:
    path, scene = _flight((-0.3, 0.3, 0.5), 0.2)
    found = arm.last_metres(path, scene, LIMITS)
    step = np.diff(found.joints, axis=0) / np.diff(found.times)[:, None]
    assert found.rate_share == pytest.approx(np.abs(step).max() / 1.0, rel=0.1)
    assert found.range_share == pytest.approx(np.abs(found.joints).max() / 2.9)
    slow = Arm(_urdf(tmp_path / "slow.urdf", rate=0.5 * found.rate_share), "gripper")
    again = slow.last_metres(path, scene, LIMITS)
    assert again.rate_share == pytest.approx(2.0, rel=1e-6)
    assert not again.possible
    assert "cannot follow" in again.described()[0][1]
    weak = Arm(_urdf(tmp_path / "weak.urdf", effort=0.25 * found.torque_share * 50.0), "gripper")
    assert weak.last_metres(path, scene, LIMITS).torque_share == pytest.approx(4.0, rel=1e-6)


def test_a_capture_out_of_reach_is_said_so(arm: Arm) -> None:
    found = arm.last_metres(*_flight((6.0, 0.3, 0.5)), LIMITS)
    assert not found.possible
    assert found.described() == [("arm", "cannot reach the pose of the capture")]


def _turning(phase: float, rate: float, away_m: float = 1.9) -> Scene:
    """A grasp point 0.3 m from a centre in front of the arm; the fixture turns about z."""
    centre, q0 = np.array([away_m, 0.0, 0.9]), Rotation.from_rotvec([0.0, 0.0, phase])

    def turn(t: np.ndarray) -> Rotation:
        return Rotation.from_rotvec(np.outer(t, [0.0, 0.0, rate])) * q0

    def goal(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        offset = turn(t).apply([0.3, 0.0, 0.0])
        return centre + offset, np.cross([0.0, 0.0, rate], offset)

    return Scene(goal, lambda t: turn(t).as_quat(), axis_c=np.array([1.0, 0.0, 0.0]))


START, NEAR = np.array([0.8, 0.3, 1.2]), Limits(final_deg=15.0, final_range_m=0.3).resolved(2.0)


def _fitted(arm: Arm, scene: Scene, horizon_s: float = 90.0) -> tuple[Plan, Plan, JointPath | None]:
    """The plan without the arm, the one that the arm can fly, and its joints."""
    limits, params = (
        replace(NEAR, reach_max_m=arm.reach_m),
        PlanParams(a_max_mps2=0.05, horizon_s=horizon_s),
    )

    def make(earliest_s: float, share: float) -> Plan:
        slower, fewer = slowed(params, limits, share)
        return constrained(
            scene, START, np.zeros(3), slower, fewer, extent_m=2.0, earliest_s=earliest_s
        )

    made, joints = arm.fitted(
        make, lambda p: path_of(p, START, np.zeros(3)), scene, limits, 0.0, horizon_s
    )
    return make(0.0, 1.0), made, joints


def test_a_capture_out_of_reach_is_replaced_by_a_later_one(arm: Arm) -> None:
    scene = _turning(phase=3.6, rate=-0.05)
    free, made, joints = _fitted(arm, scene)
    assert free.found
    assert not arm.last_metres(path_of(free, START, np.zeros(3)), scene, NEAR).possible
    assert made.found
    assert joints is not None
    assert joints.possible
    assert made.delayed_by == "arm"
    assert made.t_go_s > free.t_go_s + 1.0
    assert made.lower_bound_s == free.lower_bound_s  # nothing is certified about the joints
    assert made.status is PlanStatus.FEASIBLE
    position, turn = _forward(joints.joints[-1])
    end = np.array([made.t_go_s])
    assert np.linalg.norm(position - scene.goal(end)[0][0]) < 1e-6
    assert (turn.inv() * Rotation.from_quat(scene.attitude(end)[0])).magnitude() < 1e-6


def test_the_later_capture_is_not_one_of_a_coarse_grid(arm: Arm) -> None:
    scene, limits = _turning(phase=3.6, rate=-0.05), replace(NEAR, reach_max_m=arm.reach_m)
    free, made, _ = _fitted(arm, scene)
    params, zero = PlanParams(a_max_mps2=0.05, horizon_s=90.0), np.zeros(3)
    for capture_s in np.arange(free.t_go_s, made.t_go_s - 0.1, 0.1)[::-1][
        :8
    ]:  # the joints miss those shortly before
        earlier = constrained(
            scene, START, zero, params, limits, extent_m=2.0, earliest_s=capture_s
        )
        assert not arm.last_metres(path_of(earlier, START, zero), scene, limits).possible


def test_a_weak_arm_flies_slower(arm: Arm, tmp_path: Path) -> None:
    scene = _turning(phase=0.0, rate=0.01)
    free, _, joints = _fitted(arm, scene)
    assert joints is not None
    weak = Arm(_urdf(tmp_path / "weak.urdf", effort=50.0 * 0.7 * joints.torque_share), "gripper")
    assert weak.last_metres(path_of(free, START, np.zeros(3)), scene, NEAR).torque_share > 1.0
    _, made, fewer = _fitted(weak, scene)
    assert made.found
    assert fewer is not None
    assert fewer.torque_share <= 1.0
    assert made.delayed_by == "arm"
    assert made.t_go_s > free.t_go_s


def test_no_capture_that_the_arm_can_fly_is_none_found(arm: Arm) -> None:
    free, made, joints = _fitted(arm, _turning(phase=3.0, rate=0.01), horizon_s=25.0)
    assert free.found
    assert made.status is PlanStatus.NOT_FOUND
    assert made.delayed_by == "arm"
    assert not np.isfinite(made.t_go_s)
    assert joints is None or not joints.possible


def test_no_reachable_pose_is_called_out_of_reach(arm: Arm) -> None:
    rng = np.random.default_rng(3)
    for q in rng.uniform(-2.9, 2.9, (200, 6)):
        position, turn = _forward(q)
        assert arm.missing_m(Pose(turn.as_quat(), position)) <= 1e-9
    position, turn = _forward(
        np.zeros(6)
    )  # the straight arm: the wrist is as far from the shoulder as it can be
    assert arm.missing_m(Pose(turn.as_quat(), position)) == pytest.approx(0.0, abs=1e-9)
    assert arm.missing_m(
        Pose(turn.as_quat(), position + np.array([0.0, 0.0, 0.2]))
    ) == pytest.approx(0.2)
    aside = turn * Rotation.from_rotvec(
        [0.5 * np.pi, 0.0, 0.0]
    )  # the same place with the gripper across
    assert arm.missing_m(Pose(aside.as_quat(), position)) > 0.3


def test_a_fixture_that_never_comes_into_reach_is_proven_impossible(arm: Arm) -> None:
    free, made, joints = _fitted(arm, _turning(phase=1.6, rate=0.002, away_m=2.7), horizon_s=60.0)
    assert free.found  # the end-effector alone reaches it
    assert made.status is PlanStatus.INFEASIBLE
    assert joints is None


def test_guidance_flies_a_capture_that_the_arm_reaches(arm: Arm) -> None:
    scene, start = _turning(phase=3.6, rate=-0.05), (0.8, 0.3, 1.2)
    params = PlanParams(a_max_mps2=0.05, horizon_s=90.0, robot_position_m=start)
    exact = lambda dt: Forecast(dt, *(1e-5 * np.ones((3, len(dt)))))  # noqa: E731
    known = (
        PlannerInput(round(t * 1e9), 1, True, scene.after(t), exact)
        for t in np.arange(0.0, 90.0, 2.0)
    )
    limits, supervisor = (
        replace(NEAR, reach_max_m=arm.reach_m),
        Supervisor(SupervisorParams().resolved(2.0)),
    )
    state = None
    for _, state in Guidance(params, supervisor, limits, 2.0, arm=arm).fly(known):
        if state.captured_ns is not None:
            break
    assert state is not None
    assert state.captured_ns is not None
    assert state.plan is not None
    assert state.plan.delayed_by == "arm"
    flown = arm.last_metres(state.segment.path, scene.after(state.segment.t_ns * 1e-9), limits)
    assert flown.possible


def test_the_reach_bounds_the_distance_of_every_configuration(arm: Arm) -> None:
    rng = np.random.default_rng(1)
    farthest = max(np.linalg.norm(_forward(q)[0]) for q in rng.uniform(-2.9, 2.9, (200, 6)))
    assert farthest <= arm.reach_m == pytest.approx(sum(LENGTHS))
    assert np.linalg.norm(_forward(np.zeros(6))[0]) == pytest.approx(arm.reach_m)


def test_the_arm_gives_the_workspace_where_none_is_given(arm: Arm, tmp_path: Path) -> None:
    assert arm.reach_m > 0.0
    robot = RobotParams(urdf=str(tmp_path / "arm.urdf"), urdf_frame="gripper")
    assert with_arm(robot)[0].reach_max_m == pytest.approx(sum(LENGTHS))
    assert with_arm(replace(robot, reach_max_m=1.5))[0].reach_max_m == 1.5
    assert with_arm(RobotParams())[1] is None


def test_files_that_are_no_manipulator_are_refused(arm: Arm, tmp_path: Path) -> None:
    assert arm.reach_m > 0.0
    with pytest.raises(UsageError, match="no frame 'hand'"):
        Arm(tmp_path / "arm.urdf", "hand")
    (tmp_path / "wrong.urdf").write_text("<robot", encoding="utf-8")
    with pytest.raises(UnreadableInput, match="no URDF"):
        Arm(tmp_path / "wrong.urdf")
    with pytest.raises(UnreadableInput, match="no such URDF"):
        Arm(tmp_path / "missing.urdf")


def test_without_the_library_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    with pytest.raises(
        UsageError, match=r"pinocchio, which is not installed; pip install 'avsreplay\[arm\]'"
    ):
        Arm(_urdf(tmp_path / "arm.urdf"))


@pytest.mark.parametrize("name", ["range_share", "rate_share", "torque_share"])
@pytest.mark.parametrize("share", [0.2, 1.0, 1.001, 1.5, math.nan])
def test_joints_can_move_where_no_limit_is_exceeded_and_slowly_enough_otherwise(name, share):
    """A rate grows with the root of the acceleration, a torque with it, a range does not."""
    shares = {"range_share": 0.5, "rate_share": 0.5, "torque_share": 0.5, name: share}
    path = JointPath(np.zeros(2), np.zeros((2, 6)), 1.0, True, 10.0, **shares)
    exceeded = share > 1.0
    assert path.possible == (not exceeded)
    assert not replace(path, complete=False).possible
    if exceeded and name != "range_share":
        slowed_share = share * (path.slower if name == "torque_share" else path.slower**0.5)
        assert 0.5 < slowed_share < 1.0
    elif not exceeded:
        assert path.slower >= 0.9 / max(share, 0.9) - 1e-12 or math.isnan(share)
    else:
        assert path.slower == 1.0
