"""Whole runs on nearly symmetric bodies whose one mark is small: own dynamics, ray casting by
Embree, own bags.

python tests/benchmarks/symmetric_logs.py [--bodies stage,...] [--marks side15,...] [--seeds 0,1]
                                          [--seconds 80] [--hz 2] [--rate 0.1] [--rays 80] [--away]
                                          [--keep FOLDER]

Bodies: ``stage`` (a cylinder of 1.0 m by 2.5 m), ``bell`` (the same with a nozzle and a domed end)
and ``prism`` (eight flat sides). A mark is a place and a size in cm: ``side`` (the middle of the
shell), ``end`` (the shell near the top) or ``cap`` (the upper end, off the axis), and ``none``. A
box of that size stands on the surface there. With ``--away`` the attitude of the first scan is
chosen so that the mark is out of sight. Motion and bags are those of ``raycast_logs``.

The program runs ``avsreplay run`` on each log and prints, per log: scans in which at least ten rays
hit the mark; rows by status; scans that were rejected (gamma 0), and how many of them before the
first scan with the mark; rows of status aligned whose measured pose is wrong (beyond 2 deg or 0.02
of the extent), and the same of rows that were used and of estimates for which convergence is
claimed; rms error of the estimate in the last half of the log, its least claimed 1 sigma there, and
estimates beyond 4 sigma; processor time per scan.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
import trimesh
from raycast_logs import cast, motion, ray_grid, recorded
from scipy.spatial.transform import Rotation
from trimesh.ray.ray_pyembree import RayMeshIntersector

RADIUS_M, HEIGHT_M, NOISE_M, SEEN_RAYS = 0.5, 2.5, 0.002, 10
WRONG_DEG, WRONG_OF_EXTENT, SIGMAS = 2.0, 0.02, 4.0
HEADS = (
    "body",
    "mark",
    "seed",
    "mark in scans",
    "share of points",
    "statuses",
    "rejected",
    "before the mark",
    "wrong aligned",
    "wrong used",
    "wrong converged",
    "converged",
    "rms [deg]",
    "1 sigma [deg]",
    "> 4 sigma",
    "ms/scan",
)


def body(name: str, mark: str) -> tuple[trimesh.Trimesh, int]:
    """The mesh with the faces of the mark last, and how many these are."""
    if name == "prism":
        made = [trimesh.creation.cylinder(RADIUS_M, HEIGHT_M, sections=8)]
    else:
        made = [trimesh.creation.cylinder(RADIUS_M, HEIGHT_M, sections=96)]
    if name == "bell":
        nozzle = trimesh.creation.cone(0.4, 0.8, sections=96)
        nozzle.apply_translation((0.0, 0.0, -0.5 * HEIGHT_M - 0.5))
        dome = trimesh.creation.icosphere(4, 0.42)
        dome.apply_translation((0.0, 0.0, 0.5 * HEIGHT_M - 0.1))
        made += [nozzle, dome]
    place, size = mark.rstrip("0123456789"), mark.lstrip("abcdefghijklmnopqrstuvwxyz")
    if place == "none":
        return trimesh.util.concatenate(made), 0
    edge = 0.01 * float(size)
    box = trimesh.creation.box((edge, edge, edge))
    wall = RADIUS_M * (np.cos(np.pi / 8) if name == "prism" else 1.0)
    at = {
        "side": (wall + 0.48 * edge, 0.0, 0.15),
        "end": (wall + 0.48 * edge, 0.0, 0.5 * HEIGHT_M - 0.6 * edge),
        "cap": (RADIUS_M - 0.6 * edge, 0.0, 0.5 * HEIGHT_M + 0.48 * edge),
    }[place]
    box.apply_translation(at)
    if name == "prism":
        box.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 8, (0, 0, 1)))
    return trimesh.util.concatenate([*made, box]), len(box.faces)


def hidden_first(
    turns: np.ndarray, places: np.ndarray, mesh: trimesh.Trimesh, count: int
) -> np.ndarray:
    """The rotations after a constant turn of the body about its axis that puts the mark out of
    sight at first.
    """
    mark = mesh.triangles_center[-count:].mean(axis=0)
    seen = turns[0].T @ -places[0]
    about = np.arctan2(seen[1], seen[0]) - np.arctan2(mark[1], mark[0]) + np.pi
    return turns @ Rotation.from_euler("z", about).as_matrix()


def make(folder: Path, name: str, mark: str, seed: int, asked: argparse.Namespace) -> None:
    """Write ``log`` (a ROS 2 bag), ``model.stl`` and ``seen.npy`` (points, rays on the mark) to
    ``folder``.
    """
    rng = np.random.default_rng([seed, 1313])
    mesh, count = body(name, mark)
    mesh.export(folder / "model.stl")
    caster = RayMeshIntersector(mesh)
    times = np.arange(round(asked.seconds * asked.hz)) / asked.hz
    turns, places, _ = motion(rng, times, "clean", asked.rate)
    if asked.away and count:
        turns = hidden_first(turns, places, mesh, count)
    rays, seen = ray_grid(14.0, asked.rays), []
    with recorded(folder / "log") as write:
        for t_s, turn, place in zip(times, turns, places, strict=True):
            ranges, rows, faces = cast(caster, rays, turn, place)
            ranges += NOISE_M * rng.normal(size=len(ranges))
            seen.append((len(ranges), int(np.count_nonzero(faces >= len(mesh.faces) - count))))
            write(t_s, ranges[:, None] * rays[rows], turn, place)
    np.save(folder / "seen.npy", np.array(seen))
    np.savez(folder / "truth.npz", turns=turns, places=places)


def examine(folder: Path, name: str, mark: str, seed: int) -> list[str]:
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
    ]
    done = subprocess.run(
        [*command, "-o", str(folder / "result"), "--overwrite", "--json"],
        capture_output=True,
        check=False,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        return [name, mark, str(seed), f"exit {done.returncode}: {done.stderr.decode()[-200:]}"]
    spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    rows = json.loads(done.stdout)["rows"]
    (folder / "rows.json").write_text(json.dumps(rows))
    seen, truth = np.load(folder / "seen.npy"), np.load(folder / "truth.npz")
    mesh, _ = body(name, mark)
    wrong = [
        _wrong(row, truth["turns"][row["seq"]], truth["places"][row["seq"]], mesh.scale)
        for row in rows
    ]
    marked = np.flatnonzero(seen[:, 1] >= SEEN_RAYS)
    first = marked[0] if len(marked) else len(seen)
    rejected = [row["seq"] for row in rows if row["gamma"] == 0]
    aligned = [bad for row, bad in zip(rows, wrong, strict=True) if row["status"] == "aligned"]
    used = [
        bad
        for row, bad in zip(rows, wrong, strict=True)
        if row["status"] == "aligned" and row["gamma"]
    ]
    late = [row for row in rows[len(rows) // 2 :] if row["rot_err_deg"] is not None]
    beyond = [
        max(row["pos_err_m"] / row["pos_1s_m"], row["rot_err_deg"] / row["rot_1s_deg"]) > SIGMAS
        for row in late
    ]
    converged = [row for row in rows if row["converged"]]
    share = seen[marked, 1].sum() / max(1, seen[marked, 0].sum())
    counts = Counter(row["status"] for row in rows)
    return [
        name,
        mark,
        str(seed),
        str(len(marked)),
        f"{100 * share:.1f} %",
        " ".join(f"{counts[key]} {key}" for key in sorted(counts)),
        str(len(rejected)),
        str(sum(seq < first for seq in rejected)),
        str(sum(aligned)),
        str(sum(used)),
        str(sum(row["rot_err_deg"] > WRONG_DEG for row in converged)),
        str(len(converged)),
        f"{np.sqrt(np.mean([row['rot_err_deg'] ** 2 for row in late])):.2f}" if late else "-",
        f"{min(row['rot_1s_deg'] for row in late):.2f}" if late else "-",
        str(sum(beyond)),
        f"{1e3 * spent_s / len(rows):.0f}",
    ]


def _wrong(row: dict, turn: np.ndarray, place: np.ndarray, extent: float) -> bool:
    """Whether the measured pose is beyond 2 deg or 0.02 of the extent from the true one."""
    if row["reg_qw"] is None:
        return False
    found = Rotation.from_quat([row[f"reg_q{axis}"] for axis in "xyzw"])
    apart = np.array([row[f"reg_{axis}_m"] for axis in "xyz"]) - place
    degrees = np.degrees((found.inv() * Rotation.from_matrix(turn)).magnitude())
    return bool(degrees > WRONG_DEG or np.linalg.norm(apart) > WRONG_OF_EXTENT * extent)


def main() -> None:
    """Make the logs, run avsreplay on each and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bodies", default="stage,bell,prism")
    parser.add_argument("--marks", default="side15,side30,end15,cap15,none")
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--seconds", type=float, default=80.0)
    parser.add_argument("--hz", type=float, default=2.0)
    parser.add_argument("--rate", type=float, default=0.1, help="mean rate of the targets [rad/s]")
    parser.add_argument("--rays", type=int, default=80, help="rays along each side of the image")
    parser.add_argument(
        "--away", action="store_true", help="the mark is out of sight in the first scan"
    )
    parser.add_argument(
        "--keep", type=Path, help="write the logs and results to this folder and keep them"
    )
    asked = parser.parse_args()
    print("| " + " | ".join(HEADS) + " |\n|" + "---|" * len(HEADS), flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        for name in asked.bodies.split(","):
            for mark in asked.marks.split(","):
                for seed in map(int, asked.seeds.split(",")):
                    folder = (asked.keep or Path(scratch)) / f"{name}-{mark}-{seed}-{asked.away}"
                    if not (folder / "log").exists():
                        folder.mkdir(parents=True, exist_ok=True)
                        make(folder, name, mark, seed, asked)
                    print("| " + " | ".join(examine(folder, name, mark, seed)) + " |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
