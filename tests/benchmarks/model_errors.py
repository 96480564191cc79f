"""Whole runs on logs of targets and sensors that differ from the model, made without code of
avsreplay.

python tests/benchmarks/model_errors.py [--cases size,panel,...] [--seeds 0,1] [--seconds 90] [--hz
    2] [--rate 0.1] [--keep FOLDER]

Targets, motion, rays and files are those of ``raycast_logs.py``; the cases are:

size       the model is 0.4 % too large         ranges     ranges are 0.2 % too long panel      both
panels rotated by 2 deg         turning    both panels rotate by 0.05 deg/s missing    a small part
is not in the model     extra      a small part is in the model only incidence  ranges too long by
up to 6 mm at     mixed      two fifths of the points at edges lie between the
           grazing incidence                               surfaces before and behind
speckle    5 mm of range error in blocks of     grazing    noise grows and points are lost at
           grazing incidence 8 x 8 rays                           steps      ranges rounded to 1 cm
clutter    a tenth of the points anywhere       frozen     the sensor repeats a scan from 40 s to 44
s release    at rest until 30 s, then the motion of the other cases

The last columns are, over the healthy scans of the whole run: those beyond 4 claimed sigma; and the
root mean square of the error of the position over that of its claimed 1 sigma, and the same of the
attitude, where convergence is claimed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import raycast_logs as logs
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

CASES = (
    *("size", "ranges", "panel", "turning", "missing", "extra", "incidence"),
    *("mixed", "speckle", "grazing", "steps", "clutter", "frozen", "release"),
)
HEADS = (
    *(
        "case",
        "seed",
        "verdict",
        "t_1 [s]",
        "manoeuvres",
        "healthy scans",
        "converged",
        "of these > 4 sigma",
    ),
    *(
        "healthy > 4 sigma",
        "position: error / claim",
        "attitude: error / claim",
        "error [mm]",
        "error [deg]",
    ),
)
RAYS = 80


def rotated_panels(parts: list[trimesh.Trimesh], angle: float) -> trimesh.Trimesh:
    """The spacecraft with its two panels, the largest parts but the body, rotated about their long
    axes [rad].
    """
    panels = sorted(range(len(parts)), key=lambda k: -parts[k].area)[1:3]
    out = [part.copy() for part in parts]
    for k in panels:
        turn = trimesh.transformations.rotation_matrix(angle, (1, 0, 0), out[k].bounds.mean(axis=0))
        out[k].apply_transform(turn)
    return trimesh.util.concatenate(out)


def model_and_target(
    case: str, rng: np.random.Generator
) -> tuple[trimesh.Trimesh, trimesh.Trimesh, list]:
    """The model, the target that is scanned, and the parts of the spacecraft."""
    whole = logs.spacecraft(rng)
    parts = list(whole.split(only_watertight=False))
    small = sorted(range(len(parts)), key=lambda k: -parts[k].area)[3:]
    dropped = small[int(rng.integers(len(small)))]
    without = trimesh.util.concatenate([part for k, part in enumerate(parts) if k != dropped])
    if case == "size":
        large = whole.copy()
        large.apply_scale(1.004)
        return large, whole, parts
    return {
        "missing": (without, whole, parts),
        "extra": (whole, without, parts),
        "panel": (whole, rotated_panels(parts, np.radians(2.0)), parts),
    }.get(case, (whole, whole, parts))


def measured(
    case: str, ranges: np.ndarray, rows: np.ndarray, cosine: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Ranges (n,) with the errors of a sensor, NaN for points that are lost; ``rows``:
    numbers of the rays.
    """
    noise = 0.002 * rng.normal(size=len(ranges))
    if case == "mixed":
        grid = np.full(RAYS * RAYS, np.nan)
        grid[rows] = ranges
        beside = np.roll(grid.reshape(RAYS, RAYS), -1, axis=1).ravel()[rows]
        edge = (np.abs(ranges - beside) > 0.05) & (rng.random(len(ranges)) < 0.4)
        share = rng.random(len(ranges))
        ranges = np.where(edge, share * ranges + (1.0 - share) * beside, ranges)
    if case == "grazing":
        noise /= np.clip(cosine, 0.15, 1.0)
        ranges = np.where(rng.random(len(ranges)) < np.clip(cosine / 0.4, 0.0, 1.0), ranges, np.nan)
    if case == "speckle":
        block = (rows % RAYS) // 8 + 10 * (rows // RAYS // 8)
        noise += 0.005 * rng.normal(size=100)[block]
    ranges = ranges + noise
    if case == "incidence":
        ranges = ranges + 0.006 * (1.0 - cosine)
    if case == "ranges":
        ranges = 1.002 * ranges
    if case == "steps":
        ranges = np.round(ranges / 0.01) * 0.01
    if case == "clutter":
        ranges = np.where(
            rng.random(len(ranges)) < 0.1, rng.uniform(1.0, 12.0, len(ranges)), ranges
        )
    return ranges


def make(folder: Path, case: str, seed: int, asked: argparse.Namespace) -> None:
    """Write ``log`` (a ROS 2 bag) and ``model.stl`` to ``folder``."""
    rng = np.random.default_rng([seed, 4177])
    model, target, parts = model_and_target(case, rng)
    model = model.copy()
    model.apply_scale(1000.0)
    model.export(folder / "model.stl")
    times = np.arange(round(asked.seconds * asked.hz)) / asked.hz
    turns, places, _ = logs.motion(rng, times, case, asked.rate)
    if case == "release":
        k = int(np.searchsorted(times, 30.0))
        turns, places = (
            np.concatenate([np.repeat(a[:1], k, axis=0), a[: len(a) - k]]) for a in (turns, places)
        )
    caster, rays, points = RayMeshIntersector(target), logs.ray_grid(17.0, RAYS), np.empty((0, 3))
    with logs.recorded(folder / "log") as write:
        for t_s, turn, place in zip(times, turns, places, strict=True):
            if case == "turning":
                target = rotated_panels(parts, np.radians(0.05) * t_s)
                caster = RayMeshIntersector(target)
            ranges, rows, faces = logs.cast(caster, rays, turn, place)
            cosine = np.abs(np.einsum("ij,ij->i", target.face_normals[faces] @ turn.T, rays[rows]))
            if not (case == "frozen" and 40.0 <= t_s < 44.0):
                found = measured(case, ranges, rows, cosine, rng)
                points = (found[:, None] * rays[rows])[np.isfinite(found)]
            write(t_s, points, turn, place)


def examine(folder: Path, case: str, seed: int) -> list[str]:
    """Run avsreplay on the log of ``folder`` and return the cells of its line of the table."""
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
        [*command, "--model-unit", "mm", "-o", str(folder / "result"), "--overwrite", "--json"],
        capture_output=True,
        check=False,
    )
    if done.returncode:
        return [case, str(seed), f"exit {done.returncode}: {done.stderr.decode()[-200:]}"]
    document = json.loads(done.stdout)
    summary, used = document["summary"], [row for row in document["rows"] if row["gamma"]]
    converged = [row for row in document["rows"] if row["converged"]]
    pairs = (("pos_err_m", "pos_1s_m"), ("rot_err_deg", "rot_1s_deg"))

    def beyond(rows: list[dict]) -> int:
        return sum(max(row[error] / row[claim] for error, claim in pairs) > 4.0 for row in rows)

    def rms(name: str) -> float:
        return (
            float(np.sqrt(np.mean([row[name] ** 2 for row in converged]))) if converged else np.nan
        )

    t1, changes = summary["convergence"]["t1_s"], summary["velocity_changes"]
    return [
        case,
        str(seed),
        document["verdict"]["grade"],
        "-" if t1 is None else f"{t1:.1f}",
        str(len(changes)),
        f"{len(used)} of {len(document['rows'])}",
        str(len(converged)),
        str(beyond(converged)),
        str(beyond(used)),
        *(f"{rms(error) / rms(claim):.2f}" for error, claim in pairs),
        f"{1e3 * rms('pos_err_m'):.2f}",
        f"{rms('rot_err_deg'):.3f}",
    ]


def main() -> None:
    """Make the logs, run avsreplay on each and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--hz", type=float, default=2.0)
    parser.add_argument("--rate", type=float, default=0.1, help="mean rate of the targets [rad/s]")
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
