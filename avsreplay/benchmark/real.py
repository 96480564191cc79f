"""Recordings of others as the suite uses them: which files, and the form that the program reads."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from avsreplay import geometry
from avsreplay.benchmark.prepared import Prepared
from avsreplay.files import output_folder
from avsreplay.geometry import Array, Pose
from avsreplay.log import SourceOptions
from avsreplay.log.scan_files import read_pcd

FILES = {  # of each data set, as patterns in its folder
    "stanford-dragon": ("dragonStandRight*", "dragon_vrip_res3.ply"),
    "primesense-bunny": ("scans/*.ply", "model_bun_zipper.ply", "truth_marker_calibrated.csv"),
    "cube-tosses": ("tosses.csv", "cube.obj"),
    "kitti-van-parked": ("scans/0000[89]?.pcd", "scans/0001[01]?.pcd", "truth_labels.tum"),
}
FLIGHT = 12  # least number of samples of a toss before its impact
AFTER = 12  # samples after the impact that are replayed
GRAVITY = (  # settings of docs/real.md: gravity of the tracks, and a cube about its own centre
    "estimator.acceleration_mps2=[0,0,-9.61]",
    "estimator.start_varrho_1s_m=0.002",
    "estimator.start_log_inertia_1s=0.1",
    "estimator.force_noise_mps15=0.02",
    "estimator.torque_noise_radps15=0.1",
)
# frames of the van
REPLAYED = range(80, 95)
MODELLED = range(96, 113)
# of its label file
FIRST_FRAME = 5
FRAME_S = 0.1
BOX_M = (5.530, 1.895, 2.195)  # of its label
# kept outside of the box, cut off above the ground
BESIDE_M = 0.15
GROUND_M = 0.25
VOXEL_M = 0.04  # of the points of its model
THIN_M = {"stanford-dragon": 0.002, "primesense-bunny": 0.002, "kitti-van-parked": 0.05}


def used_files(name: str, home: Path) -> list[Path]:
    """Return the files of a data set that are used, none where it is not whole.

    Args:
        name: of the data set.
        home: its folder.
    """
    found = [sorted(home.glob(pattern)) for pattern in FILES[name]]
    return [file for files in found for file in files] if all(found) else []


def _turntable(known: Prepared, home: Path, _place: Path, _seed: int, digest: str) -> Prepared:
    model = home / "dragon_vrip_res3.ply"
    return replace(
        known,
        source=str(home),
        sha256=digest,
        options=SourceOptions(model=model),
        truth_m=0.0002,
        truth_deg=0.2,
        thin_m=THIN_M["stanford-dragon"],
    )


def _depth(known: Prepared, home: Path, place: Path, _seed: int, digest: str) -> Prepared:
    lines = (home / "truth_marker_calibrated.csv").read_text(encoding="utf-8").splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    names = ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")
    truth = [" ".join([str(int(r["view"]) + 1), *(r[name] for name in names)]) for r in rows]
    _write(place, {"markers.tum": "\n".join(truth) + "\n"})
    options = SourceOptions(
        model=home / "model_bun_zipper.ply", truth_file=place / "markers.tum", truth_gap_s=1.5
    )
    return replace(
        known,
        source=str(home / "scans"),
        sha256=digest,
        options=options,
        truth_m=0.002,
        truth_deg=1.5,
        thin_m=THIN_M["primesense-bunny"],
    )


def _toss(known: Prepared, home: Path, place: Path, seed: int, digest: str) -> Prepared:
    tosses: dict[str, list[dict[str, str]]] = {}
    with (home / "tosses.csv").open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            tosses.setdefault(row["toss"], []).append(row)
    flights = {n: [r["free_flight"] for r in rows].count("1") for n, rows in tosses.items()}
    long = [name for name, count in flights.items() if FLIGHT <= count < len(tosses[name])]
    rng = np.random.Generator(np.random.PCG64([seed, known.repeat]))
    name = long[int(rng.integers(len(long)))]
    rows = tosses[name][: flights[name] + AFTER]
    names = ("px_m", "py_m", "pz_m", "qx", "qy", "qz", "qw")
    poses = [" ".join([f"{float(r['t_s']) + 1.0:.6f}", *(r[n] for n in names)]) for r in rows]
    _write(place, {"toss.tum": "\n".join(poses) + "\n"})
    options = SourceOptions(model=home / "cube.obj", pose_sigma=(0.05, 0.05))
    return replace(
        known,
        source=str(place / "toss.tum"),
        sha256=digest,
        options=options,
        assignments=GRAVITY,
        pushes_s=(float(rows[flights[name]]["t_s"]),),
        poses=True,
    )


def _van(known: Prepared, home: Path, place: Path, _seed: int, digest: str) -> Prepared:
    labels = np.loadtxt(home / "truth_labels.tum", ndmin=2)
    if not place.exists():
        with output_folder(place) as part:
            (part / "scans").mkdir()
            for frame in REPLAYED:
                points, inside, _ = _in_box(home, labels, frame)
                np.save(part / "scans" / f"{frame:06d}.npy", points[inside])
            model = np.vstack([p[i] for _, i, p in (_in_box(home, labels, f) for f in MODELLED)])
            times = "".join(f"{frame * FRAME_S:.1f}\n" for frame in REPLAYED)
            (part / "scans" / "times.txt").write_text(times, encoding="utf-8")
            (part / "van.ply").write_text(_cloud(_one_per_voxel(model)), encoding="utf-8")
    options = SourceOptions(
        model=place / "van.ply", cloud_model=True, truth_file=home / "truth_labels.tum"
    )
    return replace(
        known,
        source=str(place / "scans"),
        sha256=digest,
        options=options,
        truth_m=0.2,
        truth_deg=2.0,
        thin_m=THIN_M["kitti-van-parked"],
    )


def _in_box(home: Path, labels: Array, frame: int) -> tuple[Array, Array, Array]:
    """Points of a frame [m]: as measured, whether each is in the label box, in its frame."""
    cloud = read_pcd((home / "scans" / f"{frame:06d}.pcd").read_bytes())
    points = cloud[:, :3].astype(np.float64)
    row = labels[frame - FIRST_FRAME]
    local = Pose(geometry.normalise(row[4:8]), row[1:4]).inverse().apply(points)
    half = 0.5 * np.array(BOX_M)
    sides = (np.abs(local[:, :2]) < half[:2] + BESIDE_M).all(axis=1)
    height = (local[:, 2] > GROUND_M - half[2]) & (local[:, 2] < half[2] + BESIDE_M)
    return points, sides & height, local


def _one_per_voxel(points: Array) -> Array:
    cells = np.floor(points / VOXEL_M).astype(np.int64)
    return np.asarray(points[np.sort(np.unique(cells, axis=0, return_index=True)[1])])


def _cloud(points: Array) -> str:
    head = ("ply", "format ascii 1.0", f"element vertex {len(points)}")
    axes = (f"property float {axis}" for axis in "xyz")
    lines = (f"{x:.4f} {y:.4f} {z:.4f}" for x, y, z in points)
    return "\n".join([*head, *axes, "end_header", *lines]) + "\n"


def _write(place: Path, texts: dict[str, str]) -> None:
    if not place.exists():
        with output_folder(place) as part:
            for name, text in texts.items():
                (part / name).write_text(text, encoding="utf-8")


Reader = Callable[[Prepared, Path, Path, int, str], Prepared]
READERS: dict[str, Reader] = {
    "stanford-dragon": _turntable,
    "primesense-bunny": _depth,
    "cube-tosses": _toss,
    "kitti-van-parked": _van,
}
