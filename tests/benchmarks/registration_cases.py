"""Shared parts of the benchmarks of registration: scans, meshes, candidates that run in turn,
and the peers.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from avsreplay.geometry import Array, Pose, exp
from avsreplay.records import Surface
from avsreplay.register.peers import best_motion
from avsreplay.register.surface_index import IcpParams, SurfaceIndex

REACH_M = 0.3
NOISE_M = 0.01
NO_FACES = np.zeros((0, 3), dtype=np.int32)


def sample(surface: Surface, n: int, seed: int) -> Surface:
    """A cloud of n points on the surface, spread evenly over its area; coordinates rounded to
    single precision.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    corners = surface.vertices[surface.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    k = np.searchsorted(np.cumsum(area) / area.sum(), (np.arange(n) + rng.random(n)) / n).clip(
        0, len(area) - 1
    )
    a, b = rng.random(n), rng.random(n)
    flip = a + b > 1
    a[flip], b[flip] = 1 - a[flip], 1 - b[flip]
    p = (
        corners[k, 0]
        + a[:, None] * (corners[k, 1] - corners[k, 0])
        + b[:, None] * (corners[k, 2] - corners[k, 0])
    )
    return Surface(p.astype(np.float32).astype(np.float64), NO_FACES, f"{n} points", "")


Cast = Callable[
    [Array, Array], Array
]  # ranges, inf: none, of the first faces on rays (n, 3) from a point, in {C}


def look(
    surface: Surface, n: int, outliers: float, seed: int, cast: Cast | None = None
) -> tuple[Array, Pose]:
    """A scan (n, 3) float32 in {A} from a random side, 6 extents away in angle terms, and the true
    T_ca.

    ``cast`` finds the points on the surface; by default trimesh does, which takes much longer.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    T_ca = Pose(exp(rng.standard_normal(3)), np.zeros(3))
    cast = cast or trimesh_rays(surface)
    centre = (surface.vertices.max(0) + surface.vertices.min(0)) / 2
    eye = centre - 2.0 * surface.extent * T_ca.R[:, 2]
    T_ca = Pose(T_ca.q, eye)
    corners = (surface.vertices - eye) @ T_ca.R
    lo, hi = (corners[:, :2] / corners[:, 2:]).min(0), (corners[:, :2] / corners[:, 2:]).max(0)
    hits = np.empty((0, 3))
    while len(hits) < n:
        xy = rng.uniform(lo, hi, (2 * n, 2))
        d = np.column_stack([xy, np.ones(2 * n)])
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        ranges = cast(eye, d @ T_ca.R.T)
        seen = np.isfinite(ranges)
        distance = ranges[seen] + NOISE_M * rng.standard_normal(np.count_nonzero(seen))
        hits = np.concatenate([hits, d[seen] * distance[:, None]])
    hits = hits[:n]
    hits = hits[
        np.lexsort(
            (np.floor(hits[:, 0] / hits[:, 2] * 300), np.floor(hits[:, 1] / hits[:, 2] * 300))
        )
    ]
    wrong = rng.choice(n, int(outliers * n), replace=False)
    hits[wrong] = rng.uniform(hits.min(0) - 0.5, hits.max(0) + 0.5, (len(wrong), 3))
    return hits.astype(np.float32), T_ca


def trimesh_rays(surface: Surface) -> Cast:
    """Rays that trimesh follows."""
    import trimesh

    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)

    def cast(eye: Array, directions: Array) -> Array:
        at, ray, _ = mesh.ray.intersects_location(
            np.tile(eye, (len(directions), 1)), directions, multiple_hits=False
        )
        ranges = np.full(len(directions), np.inf)
        ranges[ray] = np.linalg.norm(at - eye, axis=1)
        return ranges

    return cast


def off(T_ca: Pose, deg: float, metres: float, seed: int) -> Pose:
    """T_ca with its error: `deg` about the target's middle and `metres` of shift, in random
    directions.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    a, b = rng.standard_normal(3), rng.standard_normal(3)
    return Pose(exp(np.radians(deg) * a / np.linalg.norm(a)), metres * b / np.linalg.norm(b)) @ T_ca


def error(T_ca: Array, truth: Pose) -> tuple[float, float]:
    """Degrees, and millimetres at the target's origin."""
    d = Pose.from_matrix(T_ca) @ truth.inverse()
    return float(np.degrees(2 * np.arcsin(min(1.0, np.linalg.norm(d.q[:3]))))), float(
        1e3 * np.linalg.norm(d.t)
    )


def determined_error(
    T_ca: Array, truth: Pose, free: Array | None, extent: float
) -> tuple[float, float]:
    """As `error`, without the part along the motions d = [turn; shift] in {C} of ``free`` (6,
    k), None: none.
    """
    d = Pose.from_matrix(T_ca) @ truth.inverse()
    lengths = np.concatenate([2 * np.arcsin(np.clip(d.q[:3], -1.0, 1.0)) * extent, d.t])
    if free is not None:
        motions = np.concatenate([free[:3] * extent, free[3:]])
        lengths = lengths - motions @ np.linalg.lstsq(motions, lengths, rcond=None)[0]
    return float(np.degrees(np.linalg.norm(lengths[:3]) / extent)), float(
        1e3 * np.linalg.norm(lengths[3:])
    )


@dataclass
class Case:
    """One candidate: what it does, how long each turn took [s], by the clock and by the
    processor, where it ended.
    """

    run: Callable[[], tuple[Array, int]]
    seconds: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    T_ca: Array = field(default_factory=lambda: np.eye(4))
    passes: int = 0

    @property
    def ms(self) -> float:
        return 1e3 * statistics.median(self.seconds)


def in_turn(cases: dict[str, Case], reps: int) -> None:
    """A B C A B C ...: every candidate once a round, the first round not counted."""
    for turn in range(reps + 1):
        for case in cases.values():
            start, busy = time.perf_counter(), time.process_time()
            case.T_ca, case.passes = case.run()
            if turn:
                case.seconds.append(time.perf_counter() - start)
                case.cpu.append(time.process_time() - busy)


def ratio(a: list[float], b: list[float]) -> float:
    """Median over the turns of a / b."""
    return statistics.median(x / y for x, y in zip(a, b, strict=True))


def table(title: str, cases: dict[str, Case], truth: Pose, ours: str) -> None:
    """Times, how many times slower than ours turn by turn (clock, processor over all threads),
    where each ended.
    """
    print(f"\n{title}")
    print(
        f"{'method':40} {'ms':>9} {'cpu ms':>9} {'x ours':>7} {'x cpu':>7} {'passes':>7} {'deg':>8}"
        f" {'mm':>8}"
    )
    base = cases[ours]
    for name, case in cases.items():
        slower, busier = ratio(case.seconds, base.seconds), ratio(case.cpu, base.cpu)
        deg, mm = error(case.T_ca, truth)
        times = (
            f"{case.ms:9.2f} {1e3 * statistics.median(case.cpu):9.2f} {slower:7.2f} {busier:7.2f}"
        )
        print(f"{name:40} {times} {case.passes:7d} {deg:8.4f} {mm:8.3f}", flush=True)


def ours(
    model: SurfaceIndex, scan: Array, guess: Pose, rule: IcpParams
) -> Callable[[], tuple[Array, int]]:
    def run() -> tuple[Array, int]:
        r = model.icp(scan, guess, rule)
        return r.T_ca, r.iterations

    return run


def scipy_horn(
    points: Array, scan: Array, guess: Pose, n_max: int, eps: float
) -> Callable[[], tuple[Array, int]]:
    from scipy.spatial import cKDTree

    tree = cKDTree(points)

    def run() -> tuple[Array, int]:
        T, passes, p = guess, 0, scan.astype(np.float64)
        while passes < n_max:
            passes += 1
            q = T.apply(p)
            d, i = tree.query(q, distance_upper_bound=REACH_M)
            ok = np.isfinite(d)
            D = best_motion(q[ok], points[i[ok]])
            T = D @ T
            c = q[ok].mean(axis=0)
            if 2 * np.linalg.norm(D.q[:3]) < eps and np.linalg.norm(D.apply(c) - c) < eps:
                break
        return T.matrix, passes

    return run


def small_gicp(
    points: Array, scan: Array, guess: Pose, kind: str, n_max: int, eps: float, threads: int = 1
) -> Callable[[], tuple[Array, int]]:
    import small_gicp as sg
    from scipy.spatial import cKDTree

    target = sg.PointCloud(points)
    tree = sg.KdTree(target)
    sg.estimate_normals_covariances(target, tree, 10, 1)
    scan64, T0 = scan.astype(np.float64), guess.matrix
    model = cKDTree(points)

    def run() -> tuple[Array, int]:
        # the library's own search is slowest for points that match nothing
        away = model.query(guess.apply(scan64), distance_upper_bound=REACH_M)[0]
        source = sg.PointCloud(scan64[np.isfinite(away)])
        if kind == "GICP":
            sg.estimate_covariances(source, sg.KdTree(source, num_threads=threads), 10, threads)
        r = sg.align(
            target,
            source,
            tree,
            T0,
            registration_type=kind,
            max_correspondence_distance=REACH_M,
            num_threads=threads,
            max_iterations=n_max,
            rotation_epsilon=eps,
            translation_epsilon=eps,
        )
        return r.T_target_source, r.iterations

    return run


def open3d_plane(
    points: Array, normals: Array, scan: Array, guess: Pose
) -> Callable[[], tuple[Array, int]]:
    import open3d as o3d

    reg = o3d.pipelines.registration
    target = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    target.normals = o3d.utility.Vector3dVector(normals)
    scan64 = scan.astype(np.float64)

    def run() -> tuple[Array, int]:
        source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(scan64))
        rule = reg.ICPConvergenceCriteria(1e-7, 1e-7, 200)
        estimate = reg.TransformationEstimationPointToPlane()
        r = reg.registration_icp(source, target, REACH_M, guess.matrix, estimate, rule)
        return np.array(r.transformation), 0

    return run


def peers(
    make: dict[str, Callable[[], Callable[[], tuple[Array, int]]]],
) -> Iterator[tuple[str, Case]]:
    for name, build in make.items():
        try:
            yield name, Case(build())
        except ImportError as missing:
            print(f"left out: {name} ({missing})")


def shared(*path: str) -> Surface | None:
    """A mesh of the shared test data, or None where the data is not there."""
    file = Path(__file__).resolve().parents[2].parent.joinpath("shared", "data", *path)
    file = file if file.exists() else Path(os.environ.get("SHARED_DATA", "")).joinpath(*path)
    if not file.is_file():
        print(f"left out: {path[-1]} (not there)")
        return None
    import trimesh

    mesh = trimesh.load(file, force="mesh", process=False)
    return Surface(
        np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32), file.stem, ""
    )


def stage() -> Surface:
    """A cylinder with a nozzle: the shape of a rocket's upper stage."""
    import trimesh

    tank = trimesh.creation.cylinder(1.2, 6.0, sections=96)
    nozzle = trimesh.creation.cone(0.9, 1.6, sections=96)
    nozzle.apply_translation((0.15, 0.1, 2.4))
    body = trimesh.util.concatenate([tank, nozzle])
    return Surface(np.asarray(body.vertices, float), np.asarray(body.faces, np.int32), "stage", "")


def scaled(surface: Surface) -> Surface:
    """The surface at the size of the built-in target, so that the noise and the starts are the same
    for all.
    """
    size = 5.3 / surface.extent
    return Surface(surface.vertices * size, surface.faces, surface.name, "")
