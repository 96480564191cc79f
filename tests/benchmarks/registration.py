"""Registration against a fixed model: ours and the peers on the same inputs, one process, in turn, medians of ratios.

    python tests/benchmarks/registration.py [--quick] [--model 100000] [--scan 10000] [--reps 7] [--only index,passes]

The target is the built-in satellite; the scan is ray-cast from one side with 1 cm noise and a share of outliers.
Structures of the model are built beforehand; the scan covariances of GICP are part of its work. Peers that are not
installed are left out and named.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from avsreplay.geometry import Array, Pose, exp
from avsreplay.records import Surface
from avsreplay.register.horn import best_motion
from avsreplay.register.params import RegisterParams
from avsreplay.register.registrar import Registrar
from avsreplay.register.surface_index import IcpParams, SurfaceIndex
from avsreplay.simulate import builtin_surface

REACH_M = 0.3
NOISE_M = 0.01
EPS_RAD, EPS_M = 1e-5, 1e-5
NO_FACES = np.zeros((0, 3), dtype=np.int32)


def sample(surface: Surface, n: int, seed: int) -> Surface:
    """A cloud of n points on the surface, spread evenly over its area; coordinates rounded to single precision."""
    rng = np.random.Generator(np.random.PCG64(seed))
    corners = surface.vertices[surface.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    k = np.searchsorted(np.cumsum(area) / area.sum(), (np.arange(n) + rng.random(n)) / n).clip(0, len(area) - 1)
    a, b = rng.random(n), rng.random(n)
    flip = a + b > 1
    a[flip], b[flip] = 1 - a[flip], 1 - b[flip]
    p = corners[k, 0] + a[:, None] * (corners[k, 1] - corners[k, 0]) + b[:, None] * (corners[k, 2] - corners[k, 0])
    return Surface(p.astype(np.float32).astype(np.float64), NO_FACES, f"{n} points", "")


def look(surface: Surface, n: int, outliers: float, seed: int) -> tuple[Array, Pose]:
    """A scan (n, 3) float32 in {A} from a random side, 6 extents away in angle terms, and the true T_ca."""
    import trimesh

    rng = np.random.Generator(np.random.PCG64(seed))
    T_ca = Pose(exp(rng.standard_normal(3)), np.zeros(3))
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    centre = (surface.vertices.max(0) + surface.vertices.min(0)) / 2
    eye = centre - 2.0 * surface.extent * T_ca.R[:, 2]
    T_ca = Pose(T_ca.q, eye)
    seen = (surface.vertices - eye) @ T_ca.R
    lo, hi = (seen[:, :2] / seen[:, 2:]).min(0), (seen[:, :2] / seen[:, 2:]).max(0)
    hits = np.empty((0, 3))
    while len(hits) < n:
        xy = rng.uniform(lo, hi, (2 * n, 2))
        d = np.column_stack([xy, np.ones(2 * n)])
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        at, ray, _ = mesh.ray.intersects_location(np.tile(eye, (2 * n, 1)), d @ T_ca.R.T, multiple_hits=False)
        distance = np.linalg.norm(at - eye, axis=1) + NOISE_M * rng.standard_normal(len(at))
        hits = np.concatenate([hits, d[ray] * distance[:, None]])
    hits = hits[:n]
    hits = hits[np.lexsort((np.floor(hits[:, 0] / hits[:, 2] * 300), np.floor(hits[:, 1] / hits[:, 2] * 300)))]
    wrong = rng.choice(n, int(outliers * n), replace=False)
    hits[wrong] = rng.uniform(hits.min(0) - 0.5, hits.max(0) + 0.5, (len(wrong), 3))
    return hits.astype(np.float32), T_ca


def off(T_ca: Pose, deg: float, metres: float, seed: int) -> Pose:
    """T_ca with its error: `deg` about the target's middle and `metres` of shift, in random directions."""
    rng = np.random.Generator(np.random.PCG64(seed))
    a, b = rng.standard_normal(3), rng.standard_normal(3)
    return Pose(exp(np.radians(deg) * a / np.linalg.norm(a)), metres * b / np.linalg.norm(b)) @ T_ca


def error(T_ca: Array, truth: Pose) -> tuple[float, float]:
    """Degrees, and millimetres at the target's origin."""
    d = Pose.from_matrix(T_ca) @ truth.inverse()
    return float(np.degrees(2 * np.arcsin(min(1.0, np.linalg.norm(d.q[:3]))))), float(1e3 * np.linalg.norm(d.t))


@dataclass
class Case:
    """One candidate: what it does, how long each turn took [s], by the clock and by the processor, where it ended."""

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
    """Times, how many times slower than ours turn by turn (clock, processor over all threads), where each ended."""
    print(f"\n{title}")
    print(f"{'method':40} {'ms':>9} {'cpu ms':>9} {'x ours':>7} {'x cpu':>7} {'passes':>7} {'deg':>8} {'mm':>8}")
    base = cases[ours]
    for name, case in cases.items():
        slower, busier = ratio(case.seconds, base.seconds), ratio(case.cpu, base.cpu)
        deg, mm = error(case.T_ca, truth)
        times = f"{case.ms:9.2f} {1e3 * statistics.median(case.cpu):9.2f} {slower:7.2f} {busier:7.2f}"
        print(f"{name:40} {times} {case.passes:7d} {deg:8.4f} {mm:8.3f}", flush=True)


def ours(model: SurfaceIndex, scan: Array, guess: Pose, rule: IcpParams) -> Callable[[], tuple[Array, int]]:
    def run() -> tuple[Array, int]:
        r = model.icp(scan, guess, rule)
        return r.T_ca, r.iterations

    return run


def scipy_horn(points: Array, scan: Array, guess: Pose, n_max: int, eps: float) -> Callable[[], tuple[Array, int]]:
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

    target = sg.PointCloud(points)
    tree = sg.KdTree(target)
    sg.estimate_normals_covariances(target, tree, 10, 1)
    scan64, T0 = scan.astype(np.float64), guess.matrix

    def run() -> tuple[Array, int]:
        source = sg.PointCloud(scan64)
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


def open3d_plane(points: Array, normals: Array, scan: Array, guess: Pose) -> Callable[[], tuple[Array, int]]:
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


def peers(make: dict[str, Callable[[], Callable[[], tuple[Array, int]]]]) -> Iterator[tuple[str, Case]]:
    for name, build in make.items():
        try:
            yield name, Case(build())
        except ImportError as missing:
            print(f"left out: {name} ({missing})")


def fixed(n_max: int, n_plane: int = 0, **more: Any) -> IcpParams:
    return IcpParams(n_max=n_max, n_plane=n_plane, tighten=0.0, eps_rad=0.0, eps_m=0.0, newton=False, **more)


def settled(n_plane: int = 3, **more: Any) -> IcpParams:
    return IcpParams(n_max=200, n_plane=n_plane, eps_rad=EPS_RAD, eps_m=EPS_M, **more)


def index(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """Build time and memory."""
    print(f"\nindex, reach {REACH_M} m")
    jobs: list[tuple[str, Surface, float]] = [("built-in mesh", surface, REACH_M), (cloud.name, cloud, REACH_M)]
    if not args.quick:
        jobs.append(("500000 points", sample(surface, 500_000, 1), REACH_M))
    hubble = shared("spacecraft-meshes", "HST.obj")
    if hubble is not None:
        jobs.append((f"HST mesh ({len(hubble.faces)} triangles)", hubble, 0.05 * hubble.extent))
    for name, target, reach in jobs:
        clock, processor = [], []
        for _ in range(1 if args.quick else 3):
            start, busy = time.perf_counter(), time.process_time()
            model = SurfaceIndex.build(target, reach)
            clock.append(time.perf_counter() - start)
            processor.append(time.process_time() - busy)
        times = f"{statistics.median(clock):7.3f} s, processor {statistics.median(processor):7.3f} s"
        print(f"{name:28} {times} {model.nbytes / 1e6:8.1f} MB")


def passes(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """The same 20 point-to-point passes, with and without outliers."""
    model, mesh = SurfaceIndex.build(cloud, REACH_M), SurfaceIndex.build(surface, REACH_M)
    points = cloud.vertices
    for outliers, deg, metres in ((0.05, 3.0, 0.05), (0.0, 3.0, 0.05), (0.0, 0.5, 0.01)):
        scan, truth = look(surface, args.scan, outliers, 3)
        guess = off(truth, deg, metres, 4)
        cases = {
            "ours, cloud": Case(ours(model, scan, guess, fixed(20))),
            "ours, cloud, every search made": Case(ours(model, scan, guess, fixed(20, keep=False))),
            "ours, mesh": Case(ours(mesh, scan, guess, fixed(20))),
            "ours, mesh, every search made": Case(ours(mesh, scan, guess, fixed(20, keep=False))),
        }
        makers = {
            "scipy cKDTree + Horn": partial(scipy_horn, points, scan, guess, 20, 0.0),
            "small_gicp ICP": partial(small_gicp, points, scan, guess, "ICP", 20, 0.0),
        }
        cases.update(peers(makers))
        in_turn(cases, args.reps)
        case = f"model {len(points)}, scan {len(scan)}, outliers {outliers:.0%}, start {deg} deg"
        table(f"20 point-to-point passes: {case}", cases, truth, "ours, cloud")


def converged(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """To converged: ours with the default rule, the peers with theirs."""
    model, mesh = SurfaceIndex.build(cloud, REACH_M), SurfaceIndex.build(surface, REACH_M)
    points = cloud.vertices
    normals = model.closest(points).normal
    for outliers, deg, metres in ((0.0, 0.5, 0.01), (0.05, 3.0, 0.05)):
        scan, truth = look(surface, args.scan, outliers, 3)
        guess = off(truth, deg, metres, 4)
        cases = {
            "ours, mesh, sides that face the camera": Case(ours(mesh, scan, guess, settled(facing=True))),
            "the same, Horn only": Case(ours(mesh, scan, guess, settled(0, facing=True, newton=False))),
            "ours, mesh, both sides": Case(ours(mesh, scan, guess, settled())),
            "ours, mesh, both sides, gate not tightened": Case(ours(mesh, scan, guess, settled(tighten=0.0))),
            "ours, cloud": Case(ours(model, scan, guess, settled())),
        }
        makers = {
            "small_gicp GICP": partial(small_gicp, points, scan, guess, "GICP", 200, EPS_RAD),
            "small_gicp PLANE_ICP": partial(small_gicp, points, scan, guess, "PLANE_ICP", 200, EPS_RAD),
            "Open3D point-to-plane (its own threads)": partial(open3d_plane, points, normals, scan, guess),
        }
        cases.update(peers(makers))
        in_turn(cases, args.reps)
        case = f"model {len(points)}, scan {len(scan)}, outliers {outliers:.0%}, start {deg} deg"
        table(f"to converged: {case}", cases, truth, "ours, mesh, sides that face the camera")


def speed(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """Nanoseconds a point of one fused pass, searched and kept, and what a second thread gives at 50k points."""
    print("\nfused pass, processor ns a point, one thread (start 0.5 deg, no outliers)")
    scan, truth = look(surface, args.scan, 0.0, 3)
    guess = off(truth, 0.5, 0.01, 4)
    for name, target in (("cloud", cloud), ("mesh", surface)):
        model = SurfaceIndex.build(target, REACH_M)
        still = Pose.from_matrix(model.icp(scan, guess, fixed(60)).T_ca)
        cases = {}
        for kind, n_plane in (("point", 0), ("plane", 20)):
            cases[f"{kind}, searched"] = Case(ours(model, scan, guess, fixed(20, n_plane, keep=False)))
            cases[f"{kind}, kept (from the fixed point)"] = Case(ours(model, scan, still, fixed(20, n_plane)))
        in_turn(cases, args.reps)
        for kind, case in cases.items():
            nanoseconds = (1e9 * f(case.cpu) / 20 / len(scan) for f in (statistics.median, min))
            print(f"{name:6} {kind:36} {next(nanoseconds):7.1f} (least {next(nanoseconds):.1f})")
    many, truth = look(surface, 50_000, 0.05, 3)
    guess = off(truth, 3.0, 0.05, 4)
    for name, target in (("cloud", cloud), ("mesh", surface)):
        model = SurfaceIndex.build(target, REACH_M)
        cases = {f"{t} threads": Case(ours(model, many, guess, fixed(20, threads=t))) for t in (1, 2)}
        in_turn(cases, args.reps)
        gain = ratio(*(c.seconds for c in cases.values()))
        same = np.array_equal(cases["1 threads"].T_ca, cases["2 threads"].T_ca)
        print(f"{name:6} 50000 points: 2 threads {gain:.2f}x one, poses bit-identical: {same}")


def views(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """Final errors over 12 sides of the target, ours and GICP's."""
    mesh, points = SurfaceIndex.build(surface, REACH_M), cloud.vertices
    for outliers, deg, metres in ((0.0, 0.5, 0.01), (0.05, 3.0, 0.05)):
        errors: dict[str, list[tuple[float, float]]] = {}
        for side in range(3 if args.quick else 12):
            scan, truth = look(surface, args.scan, outliers, side)
            guess = off(truth, deg, metres, 100 + side)
            cases = {
                "ours, mesh, sides that face the camera": Case(ours(mesh, scan, guess, settled(facing=True))),
                "ours, mesh, both sides": Case(ours(mesh, scan, guess, settled())),
            }
            cases.update(peers({"small_gicp GICP": partial(small_gicp, points, scan, guess, "GICP", 200, EPS_RAD)}))
            for name, case in cases.items():
                errors.setdefault(name, []).append(error(case.run()[0], truth))
        print(f"\nfinal error over {side + 1} sides, outliers {outliers:.0%}, start {deg} deg: median (largest)")
        for name, found in errors.items():
            e = np.array(found)
            middle, most = np.median(e, axis=0), e.max(axis=0)
            print(f"{name:40} {middle[0]:8.4f} ({most[0]:.4f}) deg {middle[1]:8.3f} ({most[1]:.3f}) mm")


def shared(*path: str) -> Surface | None:
    """A mesh of the shared test data, or None where the data is not there."""
    file = Path(__file__).resolve().parents[2].parent.joinpath("shared", "data", *path)
    file = file if file.exists() else Path(os.environ.get("SHARED_DATA", "")).joinpath(*path)
    if not file.is_file():
        print(f"left out: {path[-1]} (not there)")
        return None
    import trimesh

    mesh = trimesh.load(file, force="mesh", process=False)
    return Surface(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32), file.stem, "")


def stage() -> Surface:
    """A cylinder with a nozzle: the shape of a rocket's upper stage."""
    import trimesh

    tank = trimesh.creation.cylinder(1.2, 6.0, sections=96)
    nozzle = trimesh.creation.cone(0.9, 1.6, sections=96)
    nozzle.apply_translation((0.15, 0.1, 2.4))
    body = trimesh.util.concatenate([tank, nozzle])
    return Surface(np.asarray(body.vertices, float), np.asarray(body.faces, np.int32), "stage", "")


def scaled(surface: Surface) -> Surface:
    """The surface at the size of the built-in target, so that the noise and the starts are the same for all."""
    size = 5.3 / surface.extent
    return Surface(surface.vertices * size, surface.faces, surface.name, "")


def meshes(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """Six meshes: index, one searched pass, and the whole of Registrar.register against the peers' registration."""
    files = [
        ("spacecraft-meshes", "HST.obj"),
        ("spacecraft-meshes", "Kepler.obj"),
        ("stanford-bunny", "bun_zipper.ply"),
        ("stanford-dragon", "dragon_vrip_res3.ply"),
    ]
    found = [shared(*file) for file in (files[:1] if args.quick else files)]
    for mesh in [surface, *(scaled(each) for each in found if each is not None), stage()]:
        one_mesh(mesh, args)


def one_mesh(mesh: Surface, args: argparse.Namespace) -> None:
    reach = 0.15 * mesh.extent
    start, busy = time.perf_counter(), time.process_time()
    index = SurfaceIndex.build(mesh, reach)
    built = time.process_time() - busy
    clock = time.perf_counter() - start
    print(
        f"\n{mesh.name}: {len(mesh.faces)} triangles; index {built:.3f} s ({clock:.3f} by the clock), "
        f"{index.nbytes / 1e6:.1f} MB"
    )
    registrar, two = (Registrar(mesh, RegisterParams(threads=t, index_cache=False)) for t in (1, 2))
    points = sample(mesh, args.model, 1).vertices
    normals = SurfaceIndex.build(sample(mesh, args.model, 1), reach).closest(points).normal
    for outliers, deg, metres in ((0.0, 0.5, 0.01), (0.05, 3.0, 0.05), (0.0, 10.0, 0.15)):
        scan, truth = look(mesh, args.scan, outliers, 3)
        guess = off(truth, deg, metres, 4)
        cases = {
            "register, 1 thread": Case(registered(registrar, scan, guess)),
            "register, 2 threads": Case(registered(two, scan, guess)),
            "  align alone": Case(aligned(registrar, scan, guess)),
            "  20 searched passes": Case(ours(index, scan, truth, fixed(20, keep=False, facing=True, gate_m=0.05))),
        }
        makers = {
            "small_gicp GICP": partial(small_gicp, points, scan, guess, "GICP", 200, EPS_RAD),
            "small_gicp PLANE_ICP": partial(small_gicp, points, scan, guess, "PLANE_ICP", 200, EPS_RAD),
            "Open3D point-to-plane (its own threads)": partial(open3d_plane, points, normals, scan, guess),
        }
        cases.update(peers(makers))
        in_turn(cases, args.reps)
        table(
            f"{mesh.name}, scan {len(scan)}, outliers {outliers:.0%}, start {deg} deg",
            cases,
            truth,
            "register, 1 thread",
        )
        searched = statistics.median(cases["  20 searched passes"].cpu) / 20 / len(scan)
        align = ratio(cases["  align alone"].cpu, cases["register, 1 thread"].cpu)
        print(f"searched pass {1e9 * searched:.0f} ns a point; outside align {100 * (1 - align):.0f} % of register")


def registered(registrar: Registrar, scan: Array, guess: Pose) -> Callable[[], tuple[Array, int]]:
    def run() -> tuple[Array, int]:
        found = registrar.register(scan, guess.inverse())
        return found.T_ac.inverse().matrix, found.iterations

    return run


def aligned(registrar: Registrar, scan: Array, guess: Pose) -> Callable[[], tuple[Array, int]]:
    def run() -> tuple[Array, int]:
        found = registrar._backend.align(scan, guess)
        return found.T_ca.matrix, found.iterations

    return run


def sizes(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """Scans of 1,000 to 1,000,000 points, a mesh of a million triangles, one and two threads."""
    import trimesh

    targets = [surface]
    bunny = shared("stanford-bunny", "bun_zipper.ply")
    if bunny is not None:
        vertices, faces = bunny.vertices, bunny.faces
        for _ in range(0 if args.quick else 2):
            vertices, faces = trimesh.remesh.subdivide(vertices, faces)
        targets.append(scaled(Surface(np.asarray(vertices), np.asarray(faces, np.int32), "bunny, subdivided", "")))
    for mesh in targets:
        start, busy = time.perf_counter(), time.process_time()
        SurfaceIndex.build(mesh, 0.15 * mesh.extent, threads=2)
        clock, built = time.perf_counter() - start, time.process_time() - busy
        print(
            f"\n{mesh.name}: {len(mesh.faces)} triangles, index {built:.2f} s ({clock:.2f} s by the clock, 2 threads)"
        )
        one, two = (Registrar(mesh, RegisterParams(threads=t, index_cache=False)) for t in (1, 2))
        for n in (1_000, 4_000) if args.quick else (1_000, 10_000, 100_000, 1_000_000):
            scan, truth = look(mesh, n, 0.0, 3)
            guess = off(truth, 3.0, 0.05, 4)
            cases = {"1": Case(registered(one, scan, guess)), "2": Case(registered(two, scan, guess))}
            cases["align"] = Case(aligned(one, scan, guess))
            in_turn(cases, 1 if n > 100_000 else args.reps)
            ms = 1e3 * statistics.median(cases["1"].cpu)
            outside = 1 - ratio(cases["align"].cpu, cases["1"].cpu)
            gain = ratio(cases["1"].seconds, cases["2"].seconds)
            same = np.array_equal(cases["1"].T_ca, cases["2"].T_ca)
            print(
                f"{n:8} points: {ms:8.1f} ms processor, {1e6 * ms / n:7.0f} ns a point, {cases['1'].passes} passes, "
                f"outside align {100 * outside:.0f} %, 2 threads {gain:.2f}x by the clock, same bits: {same}"
            )


PARTS = {
    "meshes": meshes,
    "sizes": sizes,
    "index": index,
    "speed": speed,
    "passes": passes,
    "converged": converged,
    "views": views,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small and few: does it run")
    parser.add_argument("--model", type=int, default=100_000)
    parser.add_argument("--scan", type=int, default=10_000)
    parser.add_argument("--reps", type=int, default=7)
    parser.add_argument("--only", default=",".join(PARTS))
    args = parser.parse_args()
    if args.quick:
        args.model, args.scan, args.reps = min(args.model, 20_000), min(args.scan, 2_000), 1
    surface = builtin_surface()
    cloud = sample(surface, args.model, 1)
    print(f"{surface.name}: {len(surface.faces)} triangles, extent {surface.extent:.2f} m")
    for name in args.only.split(","):
        PARTS[name](cloud, surface, args)


if __name__ == "__main__":
    main()
