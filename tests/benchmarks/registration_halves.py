"""Is the registration's covariance right on real scans? Pose from one half of the points against
the other half.

    python tests/benchmarks/registration_halves.py [--every 1] [--seed 1]

The scans of bunny, dragon and the PrimeSense figure in ../shared/data. Every scan is registered,
then both halves of its points from that pose: left and right, top and bottom, both diagonals of the
image, random halves. Printed: mean of the normalised squared difference over 6 (1 is right), with
the covariance of the difference that the whole scan gives, in which errors common to both halves
cancel; the largest; and the medians of the column ``split_nis`` over 6, of the claimed standard
deviation of the attitude, and of the processor time of the covariance and of the test of halves
over that of ``register``.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.log import SourceOptions, open_source, read_surface
from avsreplay.log.scan_files import read_points
from avsreplay.records import Surface
from avsreplay.register import quality
from avsreplay.register.covariance import split_nis, systematic_errors
from avsreplay.register.registrar import Registrar

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from oracles.covariance import difference_covariance

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def sets() -> Iterator[tuple[str, Surface, list[tuple[Array, Pose]]]]:
    """Name, model, scans with the pose from which they are registered."""
    for name, file in (
        ("stanford-bunny", "bun_zipper_res3.ply"),
        ("stanford-dragon", "dragon_vrip_res3.ply"),
    ):
        if (DATA / name).is_dir():
            with open_source(DATA / name, SourceOptions(model=DATA / name / file)) as source:
                scans = [
                    (scan.points.astype(np.float64), source.truth_of(scan).pose)
                    for scan in source.scans()
                ]
            yield name, read_surface(DATA / name / file), scans
    folder = DATA / "primesense-bunny"
    if folder.is_dir():
        lines = (folder / "truth_marker_calibrated.csv").read_text().splitlines()
        rows = np.array([line.split(",") for line in lines if line[:1].isdigit()], dtype=float)
        poses = [Pose(geometry.normalise(row[[2, 3, 4, 1]]), row[5:8]) for row in rows]
        files = [folder / "scans" / f"scan_{int(row[0]):02d}.ply" for row in rows]
        scans = [
            (read_points(f, 1 << 30).astype(np.float64), T)
            for f, T in zip(files, poses, strict=True)
        ]
        yield "primesense", read_surface(folder / "model_bun_zipper.ply"), scans


def halves(points: Array, rng: np.random.Generator) -> dict[str, Array]:
    """Masks (n,) of one half, by the name of the split."""
    x, y = (points[:, k] - np.median(points[:, k]) for k in (0, 1))
    along = {"left/right": x, "top/bottom": y, "diagonal": x + y, "other diagonal": x - y}
    masks = {name: value < np.median(value) for name, value in along.items()}
    return {**masks, "random": rng.random(len(points)) < 0.5}


def difference(registrar: Registrar, points: Array, T_ac: Pose, half: Array) -> float:
    """Normalised squared difference of the poses of both halves, over 6."""
    T_ca, gate = T_ac.inverse(), registrar.limits.gate_m
    found = [registrar.register(part, T_ac) for part in (points[half], points[~half])]
    steps = [T_ac.inverse() @ each.T_ac for each in found]
    d = np.subtract(*([*geometry.log(step.q), *step.t] for step in steps[::-1]))
    target = registrar.target
    whole, first, second = (
        quality.evidence(target.index, target.visibility, part, T_ca, gate)
        for part in (points, points[half], points[~half])
    )
    extent = target.index.extent_m
    C = difference_covariance(
        first, second, systematic_errors(whole, extent, quality.PATCH_OF_EXTENT * extent)
    )
    return float(d @ np.linalg.solve(C, d)) / 6.0


def cost(registrar: Registrar, points: Array, T_ac: Pose) -> tuple[float, float]:
    """Processor time of the systematic errors, and of the test of halves, over that of a
    registration.
    """
    target, extent = registrar.target, registrar.index.extent_m
    found = quality.evidence(
        target.index, target.visibility, points, T_ac.inverse(), registrar.limits.gate_m
    )
    shares = []
    for _ in range(5):
        begun = time.process_time()
        errors = systematic_errors(found, extent, quality.PATCH_OF_EXTENT * extent)
        fitted = time.process_time()
        split_nis(found, errors, np.eye(3)[:2])
        tested = time.process_time()
        registrar.register(points, T_ac)
        shares.append(np.array([fitted - begun, tested - fitted]) / (time.process_time() - tested))
    first, second = np.median(shares, axis=0)
    return float(first), float(second)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--every", type=int, default=1, help="take every n-th scan")
    parser.add_argument("--seed", type=int, default=1, help="of the random halves")
    args = parser.parse_args()
    for name, surface, scans in sets():
        registrar, rng = Registrar(surface), np.random.default_rng(args.seed)
        table: dict[str, list[float]] = {}
        column, degrees, shares = [], [], []
        for points, T_ac in scans[:: args.every]:
            found = registrar.register(points, T_ac)
            for split, half in halves(points, rng).items():
                table.setdefault(split, []).append(difference(registrar, points, found.T_ac, half))
            column.append(found.split_nis / 6.0)
            degrees.append(np.degrees(np.sqrt(np.trace(found.covariance[:3, :3]))))
            shares.append(cost(registrar, points, found.T_ac))
        print(f"{name}: {len(column)} scans")
        for split, values in table.items():
            print(
                f"  {split:16} mean {np.mean(values):5.2f}  median {np.median(values):5.2f}  max"
                f" {max(values):5.1f}"
            )
        print(
            f"  split_nis / 6    mean {np.mean(column):5.2f}  median {np.median(column):5.2f}  max"
            f" {max(column):5.1f}"
        )
        share = 100.0 * np.median(shares, axis=0)
        print(
            f"  1 sigma {np.median(degrees):.3f} deg, time {share[0]:.1f} % and {share[1]:.1f} %",
            flush=True,
        )


if __name__ == "__main__":
    main()
