"""The joints of a manipulator during the last metres, against forward kinematics written here; needs pinocchio."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.plan import Limits, RobotParams, Scene, StepPath
from avsreplay.plan.arm import Arm, with_arm

LENGTHS = (0.4, 1.2, 1.0, 0.3, 0.2, 0.15)
AXES = np.array([[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0], [0, 0, 1]], dtype=float)
TURN = Rotation.from_rotvec([0.0, 1.2, 0.0])


def _urdf(path: Path, rate: float = 1.0, effort: float = 50.0, bound: float = 2.9) -> Path:
    """Six revolute joints along z, y, y, z, y, z; links along z with a mass at their end."""
    out, height = ['<robot name="arm"><link name="base"/>'], 0.0
    for k, (axis, length) in enumerate(zip(AXES, LENGTHS, strict=True)):
        parent = f"link{k - 1}" if k else "base"
        out.append(
            f'<joint name="joint{k}" type="revolute"><parent link="{parent}"/><child link="link{k}"/>'
            f'<origin xyz="0 0 {height}"/><axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>'
            f'<limit lower="{-bound}" upper="{bound}" velocity="{rate}" effort="{effort}"/></joint>'
            f'<link name="link{k}">'
            f'<inertial><origin xyz="0 0 {length}"/><mass value="{5.0 * length}"/>'
            '<inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>'
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
    pytest.importorskip("pinocchio", reason="pinocchio is not installed: pip install 'avsreplay[arm]'")
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
    assert "cannot fly" in again.described()[0][1]
    weak = Arm(_urdf(tmp_path / "weak.urdf", effort=0.25 * found.torque_share * 50.0), "gripper")
    assert weak.last_metres(path, scene, LIMITS).torque_share == pytest.approx(4.0, rel=1e-6)


def test_a_capture_out_of_reach_is_said_so(arm: Arm) -> None:
    found = arm.last_metres(*_flight((6.0, 0.3, 0.5)), LIMITS)
    assert not found.possible
    assert found.described() == [("arm", "cannot reach the pose of the capture")]


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


def test_without_the_library_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    with pytest.raises(UsageError, match=r"pinocchio, which is not installed; pip install 'avsreplay\[arm\]'"):
        Arm(_urdf(tmp_path / "arm.urdf"))
