"""Whole runs on logs made without code of avsreplay: own dynamics, ray casting by Embree, written
by rosbags.

python tests/benchmarks/raycast_logs.py [--cases clean,push,...] [--seeds 0,1] [--hz 2] [--rate 0.1]
    [--mesh FILE] [--origin METRES] [--keep FOLDER]

The target is a spacecraft of primitives of trimesh (body, two panels, dish, boom) with random
sizes, or the mesh of FILE, enlarged to a diagonal of 4 m. It is written as an STL file in
millimetres, with its origin METRES off the centre. Its inertia tensor and its mass centre are
random, its motion is integrated from the full tensor with DOP853, and 80 x 80 rays with 2 mm range
noise (1 sigma) give the scans at HZ for SECONDS. A case adds an event:

clean   none                                    wall    a wall behind the target, half of all points
push    velocity step of 10 mm/s at 44.8 s      turn    rate step of 0.01 rad/s at 44.8 s bias
range bias of 50 mm from 45 s to 60 s   drift   constant torque of 1e-4 rad/s^2 of angular
acceleration block   no target between 45 s and 57 s         noise   range noise five times as large
from 45 s to 65 s first   range bias of 150 mm for the first 10 s

The program runs ``avsreplay run`` on each log as a user would and prints, per log: the verdict;
manoeuvres that the run reports; scans outside the event that were flagged; healthy scans whose
error is beyond 4 claimed sigma, converged or not; scans for which convergence is claimed; the rms
error of the estimate where convergence is claimed, and the median NEES per degree of freedom of the
mass centre's position and velocity there (0.79 if consistent, the median of the chi-square
distribution with 3 degrees of freedom, divided by 3); t_1; processor time per scan.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import trimesh
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from trimesh.ray.ray_pyembree import RayMeshIntersector

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
CASES = ("clean", "push", "turn", "bias", "first", "block", "noise", "drift", "wall")
START_NS, EVENT_S = 1_800_000_000 * 10**9, 44.8
EVENTS = {
    "bias": (45.0, 60.0),
    "block": (45.0, 57.0),
    "noise": (45.0, 65.0),
    "first": (0.0, 10.0),
    "push": (45.0, 50.5),
    "turn": (45.0, 50.5),
}
HEADS = (
    "case",
    "seed",
    "verdict",
    "t_1 [s]",
    "manoeuvres [mm/s, mrad/s]",
    "drift [mrad/s^2]",
    "reinit.",
    "flagged in event",
    "flagged outside",
    "converged scans",
    "converged > 4 sigma",
    "used > 4 sigma",
    "rms converged [mm]",
    "rms converged [deg]",
    "median NEES position",
    "median NEES velocity",
    "ms/scan",
)


def spacecraft(rng: np.random.Generator) -> trimesh.Trimesh:
    """A body with two panels, a dish and a boom; parts overlap, so that the mesh has interior
    faces.
    """
    x, y, z = rng.uniform([0.9, 0.8, 1.0], [1.4, 1.2, 1.8])
    parts = [trimesh.creation.box((x, y, z))]
    for side, length in ((-1, rng.uniform(0.8, 1.3)), (1, rng.uniform(1.2, 1.8))):
        panel = trimesh.creation.box((length, 0.03, rng.uniform(0.5, 0.9)))
        panel.apply_transform(
            trimesh.transformations.rotation_matrix(rng.uniform(0.1, 0.5), (1, 0, 0))
        )
        panel.apply_translation((side * (x / 2 + 0.25 + length / 2), 0, rng.uniform(-0.2, 0.2)))
        yoke = trimesh.creation.cylinder(0.03, 0.6, sections=12)
        yoke.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
        yoke.apply_translation((side * (x / 2 + 0.2), 0, 0))
        parts += [panel, yoke]
    dish = trimesh.creation.cone(rng.uniform(0.3, 0.45), 0.3, sections=24)
    dish.apply_translation((rng.uniform(-0.2, 0.2), 0.1, z / 2 - 0.05))
    boom = trimesh.creation.cylinder(0.04, rng.uniform(0.5, 0.9), sections=12)
    boom.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    boom.apply_translation((rng.uniform(-0.3, 0.3), y / 2 + 0.3, rng.uniform(-0.4, 0.4)))
    nozzle = trimesh.creation.cylinder(rng.uniform(0.15, 0.25), 0.3, sections=24)
    nozzle.apply_translation((0.1, 0, -z / 2 - 0.1))
    return trimesh.util.concatenate([*parts, dish, boom, nozzle])


def of_file(path: Path) -> trimesh.Trimesh:
    """The mesh of a file with the centre of its box in the origin and a diagonal of 4 m."""
    mesh = trimesh.load(path, force="mesh")
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.apply_scale(4.0 / np.linalg.norm(mesh.extents))
    return mesh


def motion(
    rng: np.random.Generator, times: np.ndarray, case: str, rate: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pose of the model's frame in the camera's frame, and motion of the mass centre, at ``times``
    [s].

    Returns rotations (n, 3, 3), positions (n, 3) [m], and position and velocity of the mass centre
    (n, 6) [m, m/s].
    """
    masses = rng.dirichlet((2, 2, 2))
    axes = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
    tensor = axes @ np.diag(masses.sum() - masses) @ axes.T
    arm, spin = rng.normal(size=3) * 0.08, rng.normal(size=3)
    spin *= rate * rng.uniform(0.5, 1.5) / np.linalg.norm(spin)
    place, speed = np.array([0.0, 0.0, 7.0]) + 0.2 * rng.normal(size=3), 0.004 * rng.normal(size=3)
    start = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
    kick = rng.normal(size=3)
    kick /= np.linalg.norm(kick)
    torque = 1e-4 * kick if case == "drift" else np.zeros(3)

    def slope(_: float, s: np.ndarray) -> np.ndarray:
        turn, w = s[:9].reshape(3, 3), s[9:12]
        cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate(
            [
                (turn @ cross).ravel(),
                np.linalg.solve(tensor, -np.cross(w, tensor @ w)) + torque,
                s[15:],
                np.zeros(3),
            ]
        )

    state = np.concatenate([start.ravel(), spin, place + start @ arm, speed])
    found, done = [], 0.0
    stepped = case in ("push", "turn")
    for part in (times[times < EVENT_S], times[times >= EVENT_S]) if stepped else (times,):
        end = EVENT_S if stepped and not found else times[-1] + 1e-6
        flow = solve_ivp(
            slope,
            (done, end),
            state,
            method="DOP853",
            t_eval=np.append(part, end),
            rtol=1e-11,
            atol=1e-12,
        )
        found.append(flow.y[:, :-1].T)
        state, done = flow.y[:, -1].copy(), end
        if stepped and len(found) == 1:
            state[15:18] += 0.01 * kick if case == "push" else 0.0
            state[9:12] += 0.01 * kick if case == "turn" else 0.0
    states = np.concatenate(found)
    turns = Rotation.from_matrix(states[:, :9].reshape(-1, 3, 3)).as_matrix()
    return turns, states[:, 12:15] - turns @ arm, states[:, 12:]


def make(folder: Path, case: str, seed: int, asked: argparse.Namespace) -> None:
    """Write ``log`` (a ROS 2 bag), ``model.stl`` and ``centre.npy`` (motion of the mass centre) to
    ``folder``.
    """
    rng = np.random.default_rng([seed, 77])
    mesh = spacecraft(rng) if asked.mesh is None else of_file(asked.mesh)
    mm = mesh.copy()
    mm.apply_translation((asked.origin, 0.0, 0.0))
    mm.apply_scale(1000.0)
    mm.export(folder / "model.stl")
    caster = RayMeshIntersector(mesh)
    times = np.arange(round(asked.seconds * asked.hz)) / asked.hz
    turns, places, centre = motion(rng, times, case, asked.rate)
    np.save(folder / "centre.npy", centre)
    rays = ray_grid(17.0, 80)
    with recorded(folder / "log") as write:
        for t_s, turn, place in zip(times, turns, places, strict=True):
            ranges, rows, _ = cast(caster, rays, turn, place)
            points_rays = rays[rows]
            begin, end = EVENTS.get(case, (0.0, 0.0))
            inside = begin <= t_s < end
            ranges += (
                0.002 * (5.0 if case == "noise" and inside else 1.0) * rng.normal(size=len(ranges))
            )
            ranges += {"bias": 0.05, "first": 0.15}.get(case, 0.0) * inside
            points = ranges[:, None] * points_rays
            if case == "block" and inside:
                points = np.column_stack(
                    [rng.uniform(-1, 1, (300, 2)), 2.0 + 0.01 * rng.normal(size=300)]
                )
            if case == "wall":
                n = len(points)
                points = np.concatenate(
                    [
                        points,
                        np.column_stack(
                            [rng.uniform(-4, 4, (n, 2)), 10 + 0.003 * rng.normal(size=n)]
                        ),
                    ]
                )
            write(t_s, points, turn, place - asked.origin * turn[:, 0])


def ray_grid(half_deg: float, count: int) -> np.ndarray:
    """Unit directions (count^2, 3) of a square field of view with this half angle."""
    half = np.tan(np.radians(half_deg)) * (np.arange(count) + 0.5 - 0.5 * count) / (0.5 * count)
    rays = np.stack([*np.meshgrid(half, half), np.ones((count, count))], -1).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1)[:, None]


def cast(
    caster: RayMeshIntersector, rays: np.ndarray, turn: np.ndarray, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ranges (k,) [m] of the rays that hit the body in a pose, their numbers and the faces that
    they hit.
    """
    hits, rows, faces = caster.intersects_location(
        np.tile(-place @ turn, (len(rays), 1)), rays @ turn, multiple_hits=False
    )
    return np.linalg.norm(hits @ turn.T + place, axis=1), rows, faces


@contextmanager
def recorded(path: Path) -> Iterator[Callable[[float, np.ndarray, np.ndarray, np.ndarray], None]]:
    """A ROS 2 bag; the function writes a scan and its true pose: time [s], points, rotation
    and position.
    """
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        clouds = bag.add_connection("/lidar/points", "sensor_msgs/msg/PointCloud2", typestore=STORE)
        poses = bag.add_connection("/truth/pose", "geometry_msgs/msg/PoseStamped", typestore=STORE)

        def write(t_s: float, points: np.ndarray, turn: np.ndarray, place: np.ndarray) -> None:
            ns = START_NS + round(t_s * 1e9)
            bag.write(
                clouds, ns, STORE.serialize_cdr(cloud(ns, points), "sensor_msgs/msg/PointCloud2")
            )
            bag.write(
                poses,
                ns,
                STORE.serialize_cdr(stamped(ns, turn, place), "geometry_msgs/msg/PoseStamped"),
            )

        yield write


def header(ns: int) -> object:
    """A std_msgs Header."""
    return TYPES["std_msgs/msg/Header"](
        TYPES["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9), "lidar"
    )


def cloud(ns: int, points: np.ndarray) -> object:
    """A PointCloud2 with x, y, z as float32."""
    data = np.frombuffer(points.astype("<f4").tobytes(), np.uint8)
    fields = [
        TYPES["sensor_msgs/msg/PointField"](name, 4 * k, 7, 1) for k, name in enumerate("xyz")
    ]
    return TYPES["sensor_msgs/msg/PointCloud2"](
        header(ns), 1, len(points), fields, False, 12, 12 * len(points), data, True
    )


def stamped(ns: int, turn: np.ndarray, place: np.ndarray) -> object:
    """A PoseStamped."""
    pose = TYPES["geometry_msgs/msg/Pose"](
        TYPES["geometry_msgs/msg/Point"](*place),
        TYPES["geometry_msgs/msg/Quaternion"](*Rotation.from_matrix(turn).as_quat()),
    )
    return TYPES["geometry_msgs/msg/PoseStamped"](header(ns), pose)


def changed(change: dict, name: str, unit: str) -> str:
    """A reported step of the velocity or of the rate with its 1 sigma, in 1e-3 of its unit, and its
    time.
    """
    size, sigma = change[f"{name}_{unit}"], change[f"{name}_1s_{unit}"]
    return f"{1e3 * size:.2f} +- {1e3 * sigma:.2f} at {change['t_s']:.2f} s"


def examine(folder: Path, case: str, seed: int) -> list[str]:
    """Run avsreplay on the log of ``folder`` and return the cells of its line of the table."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [
        sys.executable,
        "-m",
        "avsreplay",
        "run",
        str(folder / "log"),
        "--model",
        str(folder / "model.stl"),
        "--model-unit",
        "mm",
    ]
    crop = ["--crop-range", "0,9.3"] if case == "wall" else []
    done = subprocess.run(
        [*command, *crop, "-o", str(folder / "result"), "--overwrite", "--json"],
        capture_output=True,
        check=False,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        return [case, str(seed), f"exit {done.returncode}: {done.stderr.decode()[-200:]}"]
    spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    document = json.loads(done.stdout)
    summary, rows = document["summary"], document["rows"]
    beliefs, centre = np.load(folder / "result" / "beliefs.npz"), np.load(folder / "centre.npy")
    nees = {"position": [], "velocity": []}
    for k, row in enumerate(rows):
        if row["converged"]:
            for name, at, of in (("position", 6, 7), ("velocity", 9, 10)):
                error = beliefs["x"][k, of : of + 3] - centre[row["seq"], at - 6 : at - 3]
                nees[name].append(
                    error @ np.linalg.solve(beliefs["P"][k, at : at + 3, at : at + 3], error) / 3
                )
    begin, end = EVENTS.get(case, (0.0, 0.0))
    flagged = [begin <= row["t_s"] < end for row in rows if row["gamma"] == 0]
    beyond = [
        max(row["pos_err_m"] / row["pos_1s_m"], row["rot_err_deg"] / row["rot_1s_deg"]) > 4
        for row in rows
    ]
    converged = [row for row in rows if row["converged"]]
    changes = " ".join(
        changed(c, "velocity", "mps") + ", " + changed(c, "rate", "radps")
        for c in summary["velocity_changes"]
    )
    rms = [
        np.sqrt(np.mean([row[name] ** 2 for row in converged])) if converged else np.nan
        for name in ("pos_err_m", "rot_err_deg")
    ]
    drift = summary["drift"]
    return [
        case,
        str(seed),
        document["verdict"]["grade"],
        "-" if summary["convergence"]["t1_s"] is None else f"{summary['convergence']['t1_s']:.1f}",
        changes or "-",
        "-" if drift is None else json.dumps(drift),
        str(summary["reinitialised"]),
        str(sum(flagged)),
        str(len(flagged) - sum(flagged)),
        str(len(converged)),
        str(sum(b for b, row in zip(beyond, rows, strict=True) if row["converged"])),
        str(sum(b for b, row in zip(beyond, rows, strict=True) if row["gamma"])),
        f"{1e3 * rms[0]:.2f}",
        f"{rms[1]:.3f}",
        *(f"{np.median(nees[name]):.2f}" if nees[name] else "-" for name in nees),
        f"{1e3 * spent_s / len(rows):.0f}",
    ]


def main() -> None:
    """Make the logs, run avsreplay on each and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--seconds", type=float, default=100.0)
    parser.add_argument("--hz", type=float, default=2.0)
    parser.add_argument("--rate", type=float, default=0.1, help="mean rate of the targets [rad/s]")
    parser.add_argument(
        "--mesh", type=Path, help="mesh of the target, in place of random spacecraft"
    )
    parser.add_argument(
        "--origin",
        type=float,
        default=0.0,
        help="distance of the model's origin from its centre [m]",
    )
    parser.add_argument(
        "--keep", type=Path, help="write the logs and results to this folder and keep them"
    )
    asked = parser.parse_args()
    print("| " + " | ".join(HEADS) + " |\n|" + "---|" * len(HEADS), flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        for case in asked.cases.split(","):
            for seed in map(int, asked.seeds.split(",")):
                folder = (asked.keep or Path(scratch)) / f"{case}{seed}"
                if not (folder / "log").exists():
                    folder.mkdir(parents=True, exist_ok=True)
                    make(folder, case, seed, asked)
                print("| " + " | ".join(examine(folder, case, seed)) + " |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
