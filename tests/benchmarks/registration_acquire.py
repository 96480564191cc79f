"""Acquisition without a guess, and registration from far guesses: how often right, and what it
costs.

python tests/benchmarks/registration_acquire.py [--quick]

The built-in target at random attitudes, 5 m and 3 m away, seeded; the scans of bunny and dragon
where ../shared/data is there. Right is within 2 deg of the truth. Times are processor seconds of
one thread, median and largest.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from pathlib import Path

import numpy as np
from true_scans import true_scans

from avsreplay import geometry, toml_document
from avsreplay.geometry import Array, Pose
from avsreplay.log import read_surface
from avsreplay.log.ply import read_ply
from avsreplay.register.registrar import Registrar
from avsreplay.simulate.scenario import scenario_of
from avsreplay.simulate.simulation import simulate
from avsreplay.simulate.target import builtin_surface

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FOLDERS = (
    ("stanford-bunny", "bun.conf", "bun_zipper.ply"),
    ("stanford-dragon", "dragonStandRight.conf", "dragon_vrip_res3.ply"),
)
RIGHT_DEG = 2.0
Case = tuple[Array, Pose]


def built_in(count: int, distance_m: float, seed: int) -> list[Case]:
    """One scan each of ``count`` random attitudes."""
    rng, surface, cases = np.random.default_rng(seed), builtin_surface(), []
    for k in range(count):
        q = geometry.normalise(rng.normal(size=4)).tolist()
        text = (
            f"seed = {k}\nduration_s = 1.0\nrate_hz = 5.0\n[motion]\nattitude_xyzw = {q}\n"
            f"rate_radps = [0.0, 0.0, 0.0]\nposition_m = [0.15, -0.1, {distance_m}]\n"
        )
        scan = next(
            true_scans(simulate(scenario_of(toml_document.parse(text, "acquire")), surface))
        )
        assert scan.truth is not None
        cases.append((scan.points, scan.truth))
    return cases


def real(folder: str, conf: str) -> list[Case]:
    """Scans with given poses: p_model = R(q)' p_scan + t."""
    cases = []
    for line in (DATA / folder / conf).read_text().splitlines():
        words = line.split()
        if words and words[0] == "bmesh":
            T_ca = Pose(
                geometry.conjugate(np.array(words[5:9], dtype=float)),
                np.array(words[2:5], dtype=float),
            )
            cases.append(
                (read_ply((DATA / folder / words[1]).read_bytes()).points(), T_ca.inverse())
            )
    return cases


def off_deg(truth: Pose, found: Pose) -> float:
    return float(np.degrees(geometry.angle((truth.inverse() @ found).q)))


def acquired(name: str, registrar: Registrar, cases: list[Case]) -> None:
    registrar.acquire(cases[0][0])  # prepares the search
    seconds, right, statuses = [], 0, Counter[str]()
    for points, truth in cases:
        begun = time.process_time()
        found = registrar.acquire(points)
        seconds.append(time.process_time() - begun)
        right += off_deg(truth, found.T_ac) < RIGHT_DEG
        statuses[found.status.value] += 1
    cost = f"{np.median(seconds):.2f} s, largest {max(seconds):.2f} s"
    print(
        f"{name:28s} from nothing  {right:4d} of {len(cases):3d}   {cost}   {dict(statuses)}",
        flush=True,
    )


def from_guess(
    name: str, registrar: Registrar, middle: Array, cases: list[Case], degrees: float
) -> None:
    rng, right, errors = np.random.default_rng(3), 0, []
    for points, truth in cases:
        axis = rng.normal(size=3)
        q = geometry.exp(np.radians(degrees) * axis / np.linalg.norm(axis))
        found = registrar.register(points, truth @ Pose(q, middle - geometry.matrix(q) @ middle))
        if off_deg(truth, found.T_ac) < RIGHT_DEG:
            right += 1
            errors.append(
                (off_deg(truth, found.T_ac), 1e3 * np.linalg.norm(found.T_ac.t - truth.t))
            )
    rms = np.sqrt(np.mean(np.square(errors), axis=0)) if errors else np.full(2, np.nan)
    print(
        f"{name:28s} from {degrees:3.0f} deg  {right:4d} of {len(cases):3d}   rms {rms[0]:.3f} deg"
        f" {rms[1]:.3f} mm",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="20 attitudes, and no real scans")
    args = parser.parse_args()
    registrar = Registrar(builtin_surface())
    for distance_m in (5.0, 3.0):
        cases = built_in(20 if args.quick else 200, distance_m, seed=int(distance_m))
        acquired(f"built-in target, {distance_m:.0f} m", registrar, cases)
    if args.quick or not DATA.is_dir():
        return
    for folder, conf, model in FOLDERS:
        surface, cases = read_surface(DATA / folder / model), real(folder, conf)
        registrar, middle = Registrar(surface), surface.vertices.mean(axis=0)
        acquired(folder, registrar, cases)
        for degrees in (5.0, 15.0, 24.0, 40.0):
            from_guess(folder, registrar, middle, cases, degrees)


if __name__ == "__main__":
    main()
