"""How often two reasons of the verdict are false, and which changes they find: a growing error,
another frame.

python tests/benchmarks/verdict_reasons.py [--count 50] [--first 500] [--seconds 60] [--data
../shared/data]

Simulated runs: COUNT scenarios from seed FIRST on, 2 Hz, with three built-in shapes and two meshes
(enlarged to a diagonal of 5 m) in turn, a random attitude, rate (0.02 to 0.15 rad/s), velocity (up
to 10 mm/s) and range noise (2 to 16 mm). The fixtures and the logs of real scans in DATA that have
true poses are replayed as well. In all of them the frames of model and truth are the same.

A reason is false where - growth: the errors of the last third of the used scans are within three
times the standard deviations that the
  estimate claims (in the median), that is, the growth is expected;
- frame: always, because the frames are the same. The stage, which is nearly a body of revolution,
  is counted apart:
  there an estimate may be an equivalent pose.

The same runs are judged again with true poses that are changed after the replay: - another frame:
T_true X with a constant X, the translation in fractions of the extent, and the rotation in degrees;
- growth: an error in proportion to the time, with its size in the median of the last third, in the
same units. The table states in how many runs each change is named. A small change is named where no
other error hides it.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import math
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from avsreplay import geometry
from avsreplay.geometry import Pose
from avsreplay.log import SourceOptions
from avsreplay.record import RecordOptions, record_scenario
from avsreplay.report.summary import Summary
from avsreplay.report.verdict import verdict_of
from avsreplay.rows import Row
from avsreplay.run import Job
from avsreplay.run import Run as Replay
from avsreplay.simulate.scenario import scenario_of
from avsreplay.toml_document import parse

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("SHARED_DATA", ROOT.parent / "shared" / "data"))
SHAPES, EQUIVALENT = ("satellite", "bracket", "stage", "HST", "Kepler"), ("stage",)
FRAMES = ((0.0, 8.0), (0.03, 0.0), (0.03, 8.0), (0.1, 0.0), (0.1, 90.0), (0.5, 0.0), (0.5, 180.0))
GROWTHS = ((0.002, 0.0), (0.01, 0.0), (0.03, 0.0), (0.0, 0.5), (0.0, 3.0))
GROWTH, FRAME, SIGMAS = "error grows", "another frame", 3.0


def scenario(seed: int, seconds: float) -> tuple[str, str]:
    """Shape and TOML text of a scenario."""
    rng = np.random.default_rng(seed)
    shape = SHAPES[seed % len(SHAPES)]
    spin = rng.normal(size=3)
    spin *= rng.uniform(0.02, 0.15) / np.linalg.norm(spin)
    attitude = Rotation.random(random_state=int(rng.integers(2**31))).as_quat()
    size = 0.3 if shape == "bracket" else 1.0
    place = size * np.array([0.2 * rng.normal(), 0.2 * rng.normal(), rng.uniform(4.0, 7.0)])
    velocity = rng.uniform(-0.01, 0.01, 3)
    table = {
        "motion": {
            "attitude_xyzw": attitude,
            "rate_radps": spin,
            "position_m": place,
            "velocity_mps": velocity,
        },
        "scanner": {"rays": [80, 80], "noise_m": rng.uniform(0.002, 0.016)},
    }
    lines = [f"seed = {seed}", f"duration_s = {seconds}", "rate_hz = 2.0"]
    lines += ["[target]", f'shape = "{shape}"'] if shape.islower() else []
    for name, values in table.items():
        lines += [
            f"[{name}]",
            *(f"{key} = {np.asarray(value).tolist()}" for key, value in values.items()),
        ]
    return shape, "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class Run:
    """Rows, true poses of their scans, and diagonal of the box of the model [m]."""

    rows: list[Row]
    truth: list[Pose | None]
    extent: float


def replayed(job: Job) -> Run:
    """The run of a log with true poses."""
    with Replay(job) as run:
        rows = list(run.rows())
        truth = dict(run.source.truth_poses())
        return Run(rows, [truth.get(row.t_ns) for row in rows], run.surface.extent)


def simulated(seed: int, seconds: float, data: Path) -> Run:
    """The run of a simulated log."""
    shape, text = scenario(seed, seconds)
    with tempfile.TemporaryDirectory() as folder:
        log, model = Path(folder) / "log.mcap", None
        if not shape.islower():
            model = Path(folder) / "model.ply"
            mesh = trimesh.load(data / "spacecraft-meshes" / f"{shape}.obj", force="mesh")
            mesh.apply_translation(-mesh.bounds.mean(axis=0))
            mesh.apply_scale(5.0 / np.linalg.norm(mesh.extents))
            mesh.export(model)
        record_scenario(
            scenario_of(parse(text, f"seed {seed}")),
            log,
            RecordOptions(compression="none", model=model),
        )
        return replayed(Job(source=log))


def recorded(data: Path, folder: Path) -> Iterator[tuple[str, Job]]:
    """The fixtures, and the real scans that have true poses."""
    for name in ("tumble", "spin-raster"):
        yield name, Job(source=ROOT / "fixtures" / f"{name}.mcap")
    for name, model in (
        ("stanford-bunny", "bun_zipper_res3.ply"),
        ("stanford-dragon", "dragon_vrip_res3.ply"),
    ):
        if (data / name).is_dir():
            yield name, Job(source=data / name, options=SourceOptions(model=data / name / model))
    views = data / "primesense-bunny"
    for truth in ("truth_marker_calibrated", "truth_marker") if views.is_dir() else ():
        file, model = folder / f"{truth}.tum", views / "model_bun_zipper.ply"
        with (views / f"{truth}.csv").open(encoding="utf-8") as table:
            lines = [row for row in csv.reader(table) if row and row[0].isdigit()]
        text = [" ".join((str(int(r[0]) + 1), *r[5:8], *r[2:5], r[1])) for r in lines]
        file.write_text("\n".join(text) + "\n", encoding="utf-8")
        yield (
            f"primesense {truth}",
            Job(source=views / "scans", options=SourceOptions(model=model, truth_file=file)),
        )


def named(rows: Sequence[Row], extent: float) -> dict[str, bool]:
    """Whether the verdict names each of the two reasons."""
    verdict = verdict_of(rows, Summary.fold(rows), {"model": {"extent_m": extent}})
    texts = [reason.text for reason in verdict.reasons]
    return {
        GROWTH: any("error grows" in t for t in texts),
        FRAME: any("another frame" in t for t in texts),
    }


def used(run: Run) -> list[tuple[Row, Pose]]:
    """The rows that the reasons are about, with the true poses."""
    return [
        (row, pose)
        for row, pose in zip(run.rows, run.truth, strict=True)
        if row.gamma == 1 and pose is not None
    ]


def expected(run: Run) -> bool:
    """Whether the errors of the last third are those that the estimate claims."""
    last = [row for row, _ in used(run)]
    last = last[-(len(last) // 3) :]
    ratios = [(r.pos_err_m / r.pos_1s_m, r.rot_err_deg / r.rot_1s_deg) for r in last]
    return bool(np.all(np.median(ratios, axis=0) < SIGMAS))


def changed(run: Run, change: Callable[[Pose, float], Pose]) -> list[Row]:
    """Rows whose errors refer to changed true poses; ``change`` has the true pose and the
    share of the time.
    """
    out, count = [], len(run.rows)
    for k, (row, pose) in enumerate(zip(run.rows, run.truth, strict=True)):
        if pose is not None:
            T = change(pose, k / max(count - 1, 1))
            step = T.inverse() @ Pose((row.qx, row.qy, row.qz, row.qw), (row.x_m, row.y_m, row.z_m))
            angle = math.degrees(geometry.angle(step.q))
            row = dataclasses.replace(
                row, pos_err_m=float(np.linalg.norm(step.t)), rot_err_deg=angle
            )
        out.append(row)
    return out


def offset(seed: int, metres: float, degrees: float) -> Pose:
    """A translation and a rotation of these sizes in random directions."""
    rng = np.random.default_rng(seed)
    way, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    return Pose(Rotation.from_rotvec(math.radians(degrees) * axis).as_quat(), metres * way)


def another_frame(run: Run, seed: int, size: tuple[float, float]) -> list[Row]:
    """The rows where the true poses are those of another frame of the body."""
    X = offset(seed, size[0] * run.extent, size[1])
    return changed(run, lambda T, _share: T @ X)


def growing(run: Run, seed: int, size: tuple[float, float]) -> list[Row]:
    """The rows with an error in proportion to the time; ``size`` is the median of its last
    third.
    """
    scale = 6.0 / 5.0  # the median of the last third of a line from 0 to 1 is 5/6

    def change(T: Pose, share: float) -> Pose:
        more = offset(seed, scale * share * size[0] * run.extent, scale * share * size[1])
        return Pose(T.q, T.t + more.t) if not size[1] else T @ more

    return changed(run, change)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--first", type=int, default=500)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--data", type=Path, default=SHARED)
    options = parser.parse_args()
    runs = dict[str, Run]()
    with tempfile.TemporaryDirectory() as folder:
        for name, job in recorded(options.data, Path(folder)):
            runs[name] = replayed(job)
    for seed in range(options.first, options.first + options.count):
        runs[f"{seed} {scenario(seed, options.seconds)[0]}"] = simulated(
            seed, options.seconds, options.data
        )
    _print_runs(runs)
    _print_changes({name: run for name, run in runs.items() if name[0].isdigit()})


def _print_runs(runs: Mapping[str, Run]) -> None:
    print(
        "| run | scans used | error grows: ratio of position, of attitude | named | false "
        "| another frame: spread of position, of attitude | named |"
    )
    print("|---|---|---|---|---|---|---|")
    counts: Counter[str] = Counter()
    for name, run in runs.items():
        rows = [row for row, _ in used(run)]
        said = named(run.rows, run.extent)
        third = len(rows) // 3
        ratios, spreads = [], []
        for column in ("pos_err_m", "rot_err_deg"):
            found = np.array([getattr(row, column) for row in rows])
            ratios.append(np.median(found[-third:]) / np.median(found[:third]) if third else np.nan)
            low, middle, high = np.quantile(found, (0.05, 0.5, 0.95)) if third else (np.nan,) * 3
            spreads.append((high - low) / middle)
        false = said[GROWTH] and expected(run)
        group = "bodies with equivalent poses" if name.split()[-1] in EQUIVALENT else "others"
        group = group if name[0].isdigit() else "fixtures and real scans"
        counts.update(
            {
                f"{group}: runs": 1,
                f"{group}: {GROWTH}": said[GROWTH],
                f"{group}: {GROWTH}, false": false,
                f"{group}: {FRAME}": said[FRAME],
            }
        )
        cells = [
            f"{ratios[0]:.2f}, {ratios[1]:.2f}",
            said[GROWTH],
            false,
            f"{spreads[0]:.3f}, {spreads[1]:.3f}",
        ]
        print(
            f"| {name} | {len(rows)} of {len(run.rows)} |"
            f" {' | '.join(map(str, [*cells, said[FRAME]]))} |",
            flush=True,
        )
    print()
    for key, count in sorted(counts.items()):
        print(f"{key}: {count}")


def _print_changes(runs: Mapping[str, Run]) -> None:
    print(
        "\n| change of the true poses: translation over the extent, rotation | named | bodies with"
        " equivalent poses |"
    )
    print("|---|---|---|")
    for reason, make, sizes in ((FRAME, another_frame, FRAMES), (GROWTH, growing, GROWTHS)):
        for size in sizes:
            found: dict[bool, list[bool]] = {False: [], True: []}
            for name, run in runs.items():
                rows = make(run, int(name.split()[0]), size)
                found[name.split()[-1] in EQUIVALENT].append(named(rows, run.extent)[reason])
            cells = [
                f"{sum(found[equivalent])} of {len(found[equivalent])}"
                for equivalent in (False, True)
            ]
            print(
                f"| {reason}: {size[0]:g}, {size[1]:g} deg | {cells[0]} | {cells[1]} |", flush=True
            )


if __name__ == "__main__":
    main()
