"""Writes own.bag and target.stl for the tutorial docs/your-own-log.md: ``python
docs/examples/own_bag.py FOLDER``.

own.bag is a ROS 1 bag as a robot records it: clouds of a tumbling target in front of a wall, in the
frame of a camera that moves, the transforms of this camera (/tf), and true poses in the fixed
frame. target.stl is the model in millimetres.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from avsreplay.geometry import Pose, exp
from avsreplay.simulate.scenario import load_scenario
from avsreplay.simulate.simulation import simulate
from avsreplay.simulate.target import builtin_surface

SCENARIO = """
seed = 5
duration_s = 14.0
rate_hz = 3.0
[motion]
rate_radps = [0.06, 0.064, -0.048]
[scanner]
rays = [60, 60]
"""
STORE = get_typestore(Stores.ROS1_NOETIC)
STORE.register(
    get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage")
)
TYPES = STORE.types


def main(folder: Path) -> None:
    """Write both files."""
    (folder / "scenario.toml").write_text(SCENARIO, encoding="utf-8")
    scenario = load_scenario(folder / "scenario.toml")
    surface = builtin_surface(scenario.params.target.shape)
    simulation, rng = simulate(scenario, surface), np.random.default_rng(5)
    write_stl(folder / "target.stl", 1000.0 * surface.vertices[surface.faces])
    (folder / "own.bag").unlink(missing_ok=True)
    with Writer(folder / "own.bag") as bag:
        topics = {"/camera/points": "PointCloud2", "/tf": "TFMessage", "/mocap/pose": "PoseStamped"}
        packages = {
            "PointCloud2": "sensor_msgs",
            "TFMessage": "tf2_msgs",
            "PoseStamped": "geometry_msgs",
        }
        channels = {
            topic: bag.add_connection(topic, f"{packages[kind]}/msg/{kind}", typestore=STORE)
            for topic, kind in topics.items()
        }
        for scan in simulation.scans():
            t_s = (scan.log_ns - 1_700_000_000_000_000_000) * 1e-9
            camera = camera_in_map(t_s)
            wall = np.column_stack(
                [rng.uniform(-5, 5, 5000), rng.uniform(-4, 4, 5000), np.full(5000, 9.0)]
            )
            points = camera.inverse().apply(
                np.concatenate([scan.points, wall + 0.005 * rng.standard_normal((5000, 3))])
            )
            true = simulation.truth_of(scan).pose
            for topic, message in (
                ("/tf", transforms(scan.log_ns, camera)),
                ("/camera/points", cloud(scan.log_ns, points)),
                ("/mocap/pose", pose_message(scan.log_ns, true)),
            ):
                kind = f"{packages[topics[topic]]}/msg/{topics[topic]}"
                bag.write(channels[topic], scan.log_ns, STORE.serialize_ros1(message, kind))


def camera_in_map(t_s: float) -> Pose:
    """The camera's pose in the fixed frame: it drifts and turns slowly."""
    return Pose(
        exp(np.array([0.0, 0.012 * t_s, 0.004 * t_s])),
        np.array([0.02 * t_s, -0.01 * t_s, 0.015 * t_s]),
    )


def header(t_ns: int, frame: str) -> object:
    """A std_msgs Header."""
    stamp = TYPES["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9)
    return TYPES["std_msgs/msg/Header"](0, stamp, frame)


def transforms(t_ns: int, camera: Pose) -> object:
    """A TFMessage with the camera's pose."""
    x, y, z, w = camera.q
    turn = TYPES["geometry_msgs/msg/Quaternion"](x, y, z, w)
    place = TYPES["geometry_msgs/msg/Transform"](
        TYPES["geometry_msgs/msg/Vector3"](*camera.t), turn
    )
    stamped = TYPES["geometry_msgs/msg/TransformStamped"](header(t_ns, "map"), "camera", place)
    return TYPES["tf2_msgs/msg/TFMessage"]([stamped])


def pose_message(t_ns: int, pose: Pose) -> object:
    """A PoseStamped in the fixed frame."""
    x, y, z, w = pose.q
    place = TYPES["geometry_msgs/msg/Pose"](
        TYPES["geometry_msgs/msg/Point"](*pose.t), TYPES["geometry_msgs/msg/Quaternion"](x, y, z, w)
    )
    return TYPES["geometry_msgs/msg/PoseStamped"](header(t_ns, "map"), place)


def cloud(t_ns: int, points: np.ndarray) -> object:
    """A PointCloud2 with x, y, z as float32."""
    data = np.frombuffer(points.astype("<f4").tobytes(), np.uint8)
    fields = [
        TYPES["sensor_msgs/msg/PointField"](name, 4 * k, 7, 1) for k, name in enumerate("xyz")
    ]
    return TYPES["sensor_msgs/msg/PointCloud2"](
        header(t_ns, "camera"), 1, len(points), fields, False, 12, 12 * len(points), data, True
    )


def write_stl(path: Path, triangles: np.ndarray) -> None:
    """A binary STL file of triangles (n, 3, 3)."""
    record = np.zeros(
        len(triangles),
        np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")]),
    )
    record["corners"] = triangles
    path.write_bytes(bytes(80) + np.uint32(len(triangles)).tobytes() + record.tobytes())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
