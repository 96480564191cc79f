"""Three robots described by robot.toml: plans under limits of axes, workspace, attitude and joints,
and whole flights.

    python tests/benchmarks/plan_robots.py --count 40 --flights 20

Every bound is checked at many instants with numpy and scipy alone: the acceleration in the axes of
the base, the workspace, the delay, the angular acceleration of the gripper and its attitude and
rate at the capture, and for the arm the pose of the gripper by forward kinematics written in the
tests, ranges and rates of the joints. The capture must be that of the flight alone where the turn
is the shorter one, and no earlier than the turn where it is not. The problems are those of
``plan_scenes``. The arm needs pinocchio; without it its problems are planned for the ball of its
reach. Whole flights are those of ``plan_campaign``. Exit code 1 if a bound is exceeded.
"""

from __future__ import annotations

import argparse
import collections
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from plan_campaign import campaign
from plan_limits import EXTENT_M, violations
from plan_scenes import problems
from scipy.spatial.transform import Rotation

from avsreplay import toml_document
from avsreplay.config import robot_settings
from avsreplay.errors import UsageError
from avsreplay.plan.arm import with_arm
from avsreplay.plan.attitude import turn_to, with_turn
from avsreplay.plan.constrained import constrained
from avsreplay.plan.path import path_of
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.plan.robot import Limits, RobotParams, slowed
from avsreplay.saved_result import PlanningConfig

sys.path.insert(0, str(Path(__file__).parents[1]))
from test_plan_arm import LENGTHS, _forward, _urdf

ROBOTS = {
    "inspector": (
        """[robot]
name = "inspector"
mass_kg = 80.0
thrust_axes_n = [6.0, 4.0, 3.0]
base_attitude_xyzw = [0.1830127, 0.1830127, 0.6830127, 0.6830127]
base_position_m = [0.0, 0.0, -1.0]
reach_min_m = 0.5
reach_max_m = 9.0
angular_accel_radps2 = 0.02
start_attitude_xyzw = [0.0, 0.6, 0.0, 0.8]
radius_m = 0.05
delay_s = 0.2
thrust_noise = 0.01
"""
    ),
    "tug": (
        """[robot]
name = "tug"
accel_max_mps2 = 0.05
angular_accel_radps2 = 0.004
radius_m = 0.1
delay_s = 0.5
thrust_noise = 0.02
"""
    ),
    "arm": (
        """[robot]
name = "arm"
urdf = "arm.urdf"
urdf_frame = "gripper"
accel_max_mps2 = 0.05
delay_s = 0.1
"""
    ),
}
LIMITS = Limits(final_deg=15.0, clearance_m=0.2)
INSTANTS = 20_000


def read(name: str, folder: Path) -> RobotParams:
    """The robot as ``--robot`` reads it from a file."""
    _urdf(folder / "arm.urdf")
    file = folder / f"{name}.toml"
    file.write_text(ROBOTS[name], encoding="utf-8")
    document = toml_document.override(toml_document.Document(str(file), {}), robot_settings(file))
    return toml_document.build(PlanningConfig, document).robot


def placed(robot: RobotParams, problem) -> RobotParams:
    """The arm with its base beside the target: at half a metre more than the sphere that
    contains the body.
    """
    centre = problem.scene.goal(np.zeros(1))[0][0] + Rotation.from_quat(
        problem.scene.attitude(np.zeros(1))[0]
    ).apply(problem.centre_c)
    away = float(np.linalg.norm(problem.half)) + 0.5
    base = centre * (1.0 - away / np.linalg.norm(centre))
    start = base + 0.3 * centre / np.linalg.norm(centre)
    return replace(
        robot, base_position_m=tuple(base.tolist()), start_position_m=tuple(start.tolist())
    )


def checked(problem, robot: RobotParams, arm) -> dict:
    """Plan one problem and measure what it exceeds."""
    scene, params = problem.scene, robot.applied(PlanParams(a_max_mps2=problem.a_max))
    limits = robot.limited(LIMITS).resolved(EXTENT_M)
    r0, v0, gripper = np.array(params.robot_position_m), np.zeros(3), robot.gripper
    begun, turn, ready = time.process_time(), None, 0.0
    if gripper is not None:
        turn = turn_to(scene.attitude, gripper[0], np.zeros(3), gripper[1], params, 0)
        ready = params.horizon_s if turn is None else turn.ready_s(params.horizon_s)

    def make(earliest_s, share=1.0):
        return constrained(
            scene, r0, v0, *slowed(params, limits, share), 0, EXTENT_M, None, earliest_s
        )

    joints = None
    if arm is None:
        plan = make(ready)
    else:
        plan, joints = arm.fitted(
            make, lambda p: path_of(p, r0, v0), scene, limits, ready, params.horizon_s
        )
    plan = plan if turn is None else with_turn(plan, ready)
    out = {
        "status": plan.status.value,
        "plan": plan,
        "ready": ready,
        "ms": 1e3 * (time.process_time() - begun),
    }
    if plan.status.value == "infeasible_within_horizon":
        first_s = rendezvous(
            scene.goal, r0, v0, params
        ).lower_bound_s  # of a robot without a workspace
        goal = scene.goal(np.linspace(first_s, params.horizon_s, 2401))[0]
        away = np.linalg.norm(goal - limits.base_m, axis=1)
        near = (away <= limits.reach_max_m) & (away >= (limits.reach_min_m or 0.0))
        if arm is not None:  # the last three links lie along the gripper's axis up to the wrist
            turn_c = Rotation.from_quat(
                scene.attitude(np.linspace(first_s, params.horizon_s, 2401))
            )
            wrist = goal - limits.base_m - turn_c.apply([0.0, 0.0, sum(LENGTHS[4:])])
            near &= np.linalg.norm(wrist - [0.0, 0.0, LENGTHS[0]], axis=1) <= sum(LENGTHS[1:4])
        out["reachable"] = bool(np.any(near))
    if not plan.found:
        return out
    path, t = path_of(plan, r0, v0), np.linspace(0.0, plan.t_go_s, INSTANTS)
    r, _ = path.at(t)
    u = Rotation.from_quat(limits.base_attitude_xyzw).inv().apply(path.thrust(t[:-1] + 0.5 * t[1]))
    bounds = robot.axes_mps2
    share = np.abs(u) / bounds if bounds else np.linalg.norm(u, axis=1) / params.a_max_mps2
    out["thrust"] = float(share.max())
    second = (
        np.diff(r, 2, axis=0) / t[1] ** 2
    )  # the path is that of its thrust; also the robot coasts in the delay
    wait = t[1:-1] < params.latency_s - t[1]
    out["coast"] = float(np.abs(second[wait]).max(initial=0.0))
    away = np.linalg.norm(r - np.array(limits.base_m), axis=1)
    most, least = limits.reach_max_m or np.inf, limits.reach_min_m or 0.0
    out["workspace"] = float(np.maximum(away - most, least - away)[1:].max())
    out["body"] = float(violations(problem, limits, t[:-1], r[:-1]).max())
    if turn is not None:
        out |= turned(turn, scene, ready, gripper[1])
        alone = make(0.0)
        out["alone"], out["binds"] = alone.t_go_s, plan.delayed_by == "attitude"
        out["coupled"] = plan.t_go_s - max(ready, alone.t_go_s)
    if joints is not None:
        out |= flown(joints, scene, path, limits)
        out["delayed"] = plan.delayed_by == "arm"
    return out


def turned(turn, scene, ready: float, accel: float) -> dict:
    """Angular acceleration as a share of its bound, and the error of attitude [deg] and rate
    [deg/s] at the end.
    """
    t = np.arange(0.0, ready - 0.02, 0.02)
    q = Rotation.from_quat(turn.at(t))
    rates = (q[:-1].inv() * q[1:]).as_rotvec() / 0.02
    end, before = Rotation.from_quat(turn.at(np.array([ready - 1e-9, ready - 2e-3])))
    true, true_before = Rotation.from_quat(scene.attitude(np.array([ready - 1e-9, ready - 2e-3])))
    rate = ((before.inv() * end).as_rotvec() - (true_before.inv() * true).as_rotvec()) / 2e-3
    return {
        "angular": float(np.linalg.norm(np.diff(rates, axis=0), axis=1).max() / 0.02 / accel),
        "angle": float(np.degrees((true.inv() * end).magnitude())),
        "rate": float(np.degrees(np.linalg.norm(rate))),
    }


def flown(joints, scene, path, limits) -> dict:
    """Error of the gripper's pose by forward kinematics [m, deg], and the use of the ranges and
    rates of the joints.
    """
    q = np.atleast_2d(joints.joints)
    forward = [_forward(each) for each in q]
    true = Rotation.from_quat(scene.attitude(joints.times))
    wrong = path.at(joints.times)[0] - (np.array([p for p, _ in forward]) + np.array(limits.base_m))
    angles = [(true[k].inv() * turn).magnitude() for k, (_, turn) in enumerate(forward)]
    rates = np.diff(q, axis=0) / np.diff(joints.times)[:, None]
    return {
        "tip": float(np.linalg.norm(wrong, axis=1).max()),
        "tip_deg": float(np.degrees(max(angles))),
        "range": float(np.abs(q).max() / 2.9),
        "joint_rate": float(np.abs(rates).max()),
        "torque": joints.torque_share,
    }


BOUNDS = {  # largest value that is accepted, with the rounding of the checks
    "thrust": 1.0 + 1e-9,
    "coast": 1e-6,
    "workspace": 1e-9,
    "body": 1e-9,
    "angular": 1.0 + 2e-3,
    "angle": 1e-3,
    "rate": 1e-2,
    "tip": 1e-6,
    "tip_deg": 1e-4,
    "range": 1.0 + 1e-9,
    "joint_rate": 1.0 + 1e-2,
}


def report(name: str, done: list[dict]) -> int:
    """Print the figures of one robot; returns the number of bounds that are exceeded."""
    status, bad = collections.Counter(of["status"] for of in done), 0
    found = [of for of in done if of["plan"].found]
    print(
        f"{name}, {len(done)} problems: {', '.join(f'{k} {n}' for k, n in sorted(status.items()))}"
    )
    times = [of["ms"] for of in done]
    print(f"  processor time: median {np.median(times):.0f} ms, most {max(times):.0f} ms")
    wrongly = sum(of.get("reachable", False) for of in done)
    print(
        "  called impossible although the grasp point is in the workspace after the least time:"
        f" {wrongly}"
    )
    for key, most in BOUNDS.items():
        values = [of[key] for of in found if key in of]
        if values:
            bad += max(values) > most
            print(
                f"  {key:10s} worst {max(values):.3g}{'  EXCEEDED' if max(values) > most else ''}"
            )
    coupled = [of for of in found if "coupled" in of]
    if coupled:
        binds = [of for of in coupled if of["ready"] > of["alone"]]
        same = [abs(of["coupled"]) for of in coupled if of["ready"] <= of["alone"] - 1e-3]
        early = [of for of in coupled if of["plan"].t_go_s < of["ready"] - 1e-6]
        bad += bool(early) + (max(same, default=0.0) > 1e-6)
        print(
            f"  the turn decides in {len(binds)} of {len(coupled)}, stated in"
            f" {sum(of['binds'] for of in coupled)}"
        )
        print(f"  else the capture is that of the flight alone to {max(same, default=0.0):.2g} s")
        late = [of["coupled"] for of in binds]
        if late:
            print(f"  later than the turn: median {np.median(late):.3g} s, most {max(late):.3g} s")
    if any("delayed" in of for of in found):
        print(
            f"  the joints delay the capture in {sum(of.get('delayed', False) for of in found)} of"
            f" {len(found)}"
        )
    return bad + wrongly


def flights(name: str, robot: RobotParams, count: int, seed: int) -> int:
    """Print how whole flights end; returns the number of flights that touch the body."""
    done = [campaign(seed * 10_000 + k, robot=robot) for k in range(count)]
    ends, touched = collections.Counter(d[0] for d in done), sum(d[4] for d in done)
    closed = [d[1] for d in done if d[1] is not None]
    print(
        f"{name}, {count} flights: {', '.join(f'{k} {n}' for k, n in sorted(ends.items()))},"
        f" touched {touched}"
    )
    for what, values in (
        ("miss [mm]", [1e3 * m.distance_m for m in closed]),
        ("relative speed [mm/s]", [1e3 * m.speed_mps for m in closed]),
        ("angle of the gripper [deg]", [m.angle_deg for m in closed]),
    ):
        if values:
            print(f"  {what}: median {np.median(values):.2f}, worst {max(values):.2f}")
    for k, each in enumerate(done):
        if each[0] != "captured" or each[4]:
            print(
                f"  seed {seed * 10_000 + k}: {each[0]}{', touched' if each[4] else ''};"
                f" {', '.join(each[2])}"
            )
    return touched


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument(
        "--flights", type=int, default=0, help="whole flights of each robot without an arm"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--robot", choices=ROBOTS, action="append")
    args, bad = parser.parse_args(), 0
    with tempfile.TemporaryDirectory() as folder:
        for name in args.robot or ROBOTS:
            robot, arm = read(name, Path(folder)), None
            if name == "arm":
                try:
                    robot, arm = with_arm(robot)
                except UsageError as error:
                    print(f"{error.what}: the arm is planned as the ball of its reach")
                    robot = replace(robot, urdf=None, reach_max_m=sum(LENGTHS))
            if args.count:
                cases = [
                    (p, placed(robot, p) if name == "arm" else robot)
                    for p in problems(args.count, args.seed)
                ]
                bad += report(name, [checked(problem, each, arm) for problem, each in cases])
            if args.flights and name != "arm":
                bad += flights(name, robot, args.flights, args.seed)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
