"""Registration against a fixed model: ours and the peers on the same inputs, one process, in turn,
medians of ratios.

    python tests/benchmarks/registration.py [--quick] [--model 100000] [--scan 10000] [--reps 7]
    [--only index,passes]

The target is the built-in satellite; the scan is ray-cast from one side with 1 cm noise and a share
of outliers. Structures of the model are built beforehand; the scan covariances of GICP are part of
its work. Peers that are not installed are left out and named.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from registration_cases import (
    REACH_M,
    Case,
    determined_error,
    in_turn,
    look,
    off,
    open3d_plane,
    ours,
    peers,
    ratio,
    sample,
    scaled,
    scipy_horn,
    shared,
    small_gicp,
    stage,
    table,
)

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Fit, Surface
from avsreplay.register import quality
from avsreplay.register.params import RegisterParams
from avsreplay.register.registrar import Registrar
from avsreplay.register.surface_index import IcpParams, SurfaceIndex
from avsreplay.simulate.target import builtin_surface

EPS_RAD, EPS_M = 1e-5, 1e-5
STARTS = ((0.0, 0.5, 0.01), (0.05, 3.0, 0.05), (0.0, 10.0, 0.15))  # outliers, deg, m


def fixed(n_max: int, n_plane: int = 0, **more: Any) -> IcpParams:
    return IcpParams(
        n_max=n_max, n_plane=n_plane, tighten=0.0, eps_rad=0.0, eps_m=0.0, newton=False, **more
    )


def settled(n_plane: int = 3, **more: Any) -> IcpParams:
    return IcpParams(n_max=200, n_plane=n_plane, eps_rad=EPS_RAD, eps_m=EPS_M, **more)


def index(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """Build time and memory."""
    print(f"\nindex, reach {REACH_M} m")
    jobs: list[tuple[str, Surface, float]] = [
        ("built-in mesh", surface, REACH_M),
        (cloud.name, cloud, REACH_M),
    ]
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
        times = (
            f"{statistics.median(clock):7.3f} s, processor {statistics.median(processor):7.3f} s"
        )
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
            "ours, mesh, sides that face the camera": Case(
                ours(mesh, scan, guess, settled(facing=True))
            ),
            "the same, Horn only": Case(
                ours(mesh, scan, guess, settled(0, facing=True, newton=False))
            ),
            "ours, mesh, both sides": Case(ours(mesh, scan, guess, settled())),
            "ours, mesh, both sides, gate not tightened": Case(
                ours(mesh, scan, guess, settled(tighten=0.0))
            ),
            "ours, cloud": Case(ours(model, scan, guess, settled())),
        }
        makers = {
            "small_gicp GICP": partial(small_gicp, points, scan, guess, "GICP", 200, EPS_RAD),
            "small_gicp PLANE_ICP": partial(
                small_gicp, points, scan, guess, "PLANE_ICP", 200, EPS_RAD
            ),
            "Open3D point-to-plane (its own threads)": partial(
                open3d_plane, points, normals, scan, guess
            ),
        }
        cases.update(peers(makers))
        in_turn(cases, args.reps)
        case = f"model {len(points)}, scan {len(scan)}, outliers {outliers:.0%}, start {deg} deg"
        table(f"to converged: {case}", cases, truth, "ours, mesh, sides that face the camera")


def speed(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """Nanoseconds a point of one fused pass, searched and kept, and what a second thread gives at
    50k points.
    """
    print("\nfused pass, processor ns a point, one thread (start 0.5 deg, no outliers)")
    scan, truth = look(surface, args.scan, 0.0, 3)
    guess = off(truth, 0.5, 0.01, 4)
    for name, target in (("cloud", cloud), ("mesh", surface)):
        model = SurfaceIndex.build(target, REACH_M)
        still = Pose.from_matrix(model.icp(scan, guess, fixed(60)).T_ca)
        cases = {}
        for kind, n_plane in (("point", 0), ("plane", 20)):
            cases[f"{kind}, searched"] = Case(
                ours(model, scan, guess, fixed(20, n_plane, keep=False))
            )
            cases[f"{kind}, kept (from the fixed point)"] = Case(
                ours(model, scan, still, fixed(20, n_plane))
            )
        in_turn(cases, args.reps)
        for kind, case in cases.items():
            nanoseconds = (1e9 * f(case.cpu) / 20 / len(scan) for f in (statistics.median, min))
            print(f"{name:6} {kind:36} {next(nanoseconds):7.1f} (least {next(nanoseconds):.1f})")
    many, truth = look(surface, 50_000, 0.05, 3)
    guess = off(truth, 3.0, 0.05, 4)
    for name, target in (("cloud", cloud), ("mesh", surface)):
        model = SurfaceIndex.build(target, REACH_M)
        cases = {
            f"{t} threads": Case(ours(model, many, guess, fixed(20, threads=t))) for t in (1, 2)
        }
        in_turn(cases, args.reps)
        gain = ratio(*(c.seconds for c in cases.values()))
        same = np.array_equal(cases["1 threads"].T_ca, cases["2 threads"].T_ca)
        print(f"{name:6} 50000 points: 2 threads {gain:.2f}x one, poses bit-identical: {same}")


def accuracy(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """Errors of the poses over many sides, of `Registrar.register` and of the peers on the same
    scans.

    A ratio is the error of `register` over that of the peer on the same scan. The range is that of
    one standard error of the median, from the order of the ratios.
    """
    for mesh in [*real_meshes(surface, args), stage()]:
        registrar = Registrar(mesh, RegisterParams(index_cache=False))
        points = sample(mesh, args.model, 1).vertices
        for start in STARTS[:2]:
            sides = range(3 if args.quick else args.views)
            found = [_errors(registrar, mesh, points, start, side, args) for side in sides]
            print(
                f"\n{mesh.name}, outliers {start[0]:.0%}, start {start[1]} deg: median errors,"
                f" {len(found)} sides"
            )
            for name in found[0]:
                each = np.array([errors[name] for errors in found])
                deg, mm = np.median(each, axis=0)
                ratios = np.array([errors["register"] for errors in found]) / each
                text = (
                    ""
                    if name == "register"
                    else f"{_median(ratios[:, 0])} deg  {_median(ratios[:, 1])} mm"
                )
                print(f"{name:12} {deg:8.4f} deg {mm:7.3f} mm   {text}", flush=True)


def _errors(
    registrar: Registrar,
    mesh: Surface,
    points: Array,
    start: tuple[float, float, float],
    side: int,
    args: argparse.Namespace,
) -> dict[str, tuple[float, float]]:
    """The error of each method in the motions that `register` reports as determined by this
    view.
    """
    scan, truth = look(mesh, args.scan, start[0], side, partial(_ranges, registrar))
    guess = off(truth, *start[1:], 100 + side)
    found = registrar.register(scan, guess.inverse())
    kinds = ("GICP", "PLANE_ICP")
    makers = {kind: partial(small_gicp, points, scan, guess, kind, 200, EPS_RAD) for kind in kinds}
    poses = {
        "register": found.T_ac.inverse().matrix,
        **{name: case.run()[0] for name, case in peers(makers)},
    }
    return {
        name: determined_error(T_ca, truth, found.free, mesh.extent) for name, T_ca in poses.items()
    }


def _ranges(registrar: Registrar, eye: Array, rays: Array) -> Array:
    return registrar.index.cast(eye, rays)[0]


def _median(x: Array) -> str:
    n, ordered = len(x), np.sort(x)
    low, high = (ordered[round((n - 1) / 2 + k * np.sqrt(n) / 2)] for k in (-1, 1))
    return f"{np.median(x):5.2f} ({low:.2f} to {high:.2f})"


def meshes(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """Six meshes: index, one searched pass, and the whole of Registrar.register against the
    peers' registration.
    """
    for mesh in [*real_meshes(surface, args), stage()]:
        one_mesh(mesh, args)


def real_meshes(surface: Surface, args: argparse.Namespace) -> list[Surface]:
    """The built-in target, and the meshes of the shared data in its size."""
    files = [
        ("spacecraft-meshes", "HST.obj"),
        ("spacecraft-meshes", "Kepler.obj"),
        ("stanford-bunny", "bun_zipper.ply"),
        ("stanford-dragon", "dragon_vrip_res3.ply"),
    ]
    found = [shared(*file) for file in (files[:1] if args.quick else files)]
    return [surface, *(scaled(each) for each in found if each is not None)]


def fixed_point(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """Passes of an alignment over sides and starts, and the distance of its result from the fixed
    point.
    """
    print(
        "\npasses over all points: least, median, most; alignments with more than 12; distance to"
        " the fixed point"
    )
    for mesh in real_meshes(surface, args):
        registrar = Registrar(mesh, RegisterParams(index_cache=False))
        rule = registrar.backend._rules[True]
        exact = replace(rule, n_plane=0, few=0, tighten=0.0, eps_rad=1e-10, eps_m=1e-10)
        for outliers, deg, metres in STARTS:
            passes, far = [], []
            for side in range(2 if args.quick else 8):
                scan, truth = look(mesh, args.scan, outliers, side, partial(_ranges, registrar))
                fit = registrar.index.icp(scan, off(truth, deg, metres, 100 + side), rule)
                end = registrar.index.icp(scan, fit.T_ca, replace(exact, gate_m=fit.gate_m))
                passes.append(fit.iterations)
                apart = Pose.from_matrix(fit.T_ca).inverse() @ Pose.from_matrix(end.T_ca)
                far.append(np.degrees(geometry.angle(apart.q)))
            most = sum(n > 12 for n in passes)
            counts = (
                f"{min(passes):2} {statistics.median(passes):4} {max(passes):3}, {most} of"
                f" {len(passes)}"
            )
            print(
                f"{mesh.name:24} {deg:4} deg {outliers:3.0%}: {counts}; {np.median(far):.0e} to"
                f" {max(far):.0e} deg"
            )


def one_mesh(mesh: Surface, args: argparse.Namespace) -> None:
    reach = 0.15 * mesh.extent
    start, busy = time.perf_counter(), time.process_time()
    index = SurfaceIndex.build(mesh, reach)
    built = time.process_time() - busy
    clock = time.perf_counter() - start
    print(
        f"\n{mesh.name}: {len(mesh.faces)} triangles; index {built:.3f} s ({clock:.3f} by the"
        f" clock), {index.nbytes / 1e6:.1f} MB"
    )
    registrar, two = (Registrar(mesh, RegisterParams(threads=t, index_cache=False)) for t in (1, 2))
    points = sample(mesh, args.model, 1).vertices
    normals = SurfaceIndex.build(sample(mesh, args.model, 1), reach).closest(points).normal
    for outliers, deg, metres in STARTS:
        scan, truth = look(mesh, args.scan, outliers, 3, partial(_ranges, registrar))
        guess = off(truth, deg, metres, 4)
        cases = {
            "register, 1 thread": Case(registered(registrar, scan, guess)),
            "register, 2 threads": Case(registered(two, scan, guess)),
            "  align alone": Case(aligned(registrar, scan, guess)),
            "  20 searched passes": Case(
                ours(index, scan, truth, fixed(20, keep=False, facing=True, gate_m=0.05))
            ),
        }
        makers = {
            "small_gicp GICP": partial(small_gicp, points, scan, guess, "GICP", 200, EPS_RAD),
            "small_gicp PLANE_ICP": partial(
                small_gicp, points, scan, guess, "PLANE_ICP", 200, EPS_RAD
            ),
            "Open3D point-to-plane (its own threads)": partial(
                open3d_plane, points, normals, scan, guess
            ),
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
        print(
            f"searched pass {1e9 * searched:.0f} ns a point; outside align {100 * (1 - align):.0f}"
            " % of register"
        )


def registered(registrar: Registrar, scan: Array, guess: Pose) -> Callable[[], tuple[Array, int]]:
    def run() -> tuple[Array, int]:
        found = registrar.register(scan, guess.inverse())
        return found.T_ac.inverse().matrix, found.iterations

    return run


def aligned(registrar: Registrar, scan: Array, guess: Pose) -> Callable[[], tuple[Array, int]]:
    def run() -> tuple[Array, int]:
        found = registrar.backend.align(scan, guess)
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
        targets.append(
            scaled(
                Surface(np.asarray(vertices), np.asarray(faces, np.int32), "bunny, subdivided", "")
            )
        )
    for mesh in targets:
        start, busy = time.perf_counter(), time.process_time()
        SurfaceIndex.build(mesh, 0.15 * mesh.extent, threads=2)
        clock, built = time.perf_counter() - start, time.process_time() - busy
        print(
            f"\n{mesh.name}: {len(mesh.faces)} triangles, index {built:.2f} s ({clock:.2f} s by the"
            " clock, 2 threads)"
        )
        one, two = (Registrar(mesh, RegisterParams(threads=t, index_cache=False)) for t in (1, 2))
        cast = partial(_ranges, one)
        for n in (1_000, 4_000) if args.quick else (1_000, 10_000, 100_000, 1_000_000):
            scan, truth = look(mesh, n, 0.0, 3, cast)
            guess = off(truth, 3.0, 0.05, 4)
            cases = {
                "1": Case(registered(one, scan, guess)),
                "2": Case(registered(two, scan, guess)),
            }
            cases["align"] = Case(aligned(one, scan, guess))
            in_turn(cases, 1 if n > 100_000 else args.reps)
            ms = 1e3 * statistics.median(cases["1"].cpu)
            outside = 1 - ratio(cases["align"].cpu, cases["1"].cpu)
            gain = ratio(cases["1"].seconds, cases["2"].seconds)
            same = np.array_equal(cases["1"].T_ca, cases["2"].T_ca)
            print(
                f"{n:8} points: {ms:8.1f} ms processor, {1e6 * ms / n:7.0f} ns a point,"
                f" {cases['1'].passes} passes, outside align {100 * outside:.0f} %, 2 threads"
                f" {gain:.2f}x by the clock, same bits: {same}"
            )


def grading(cloud: Surface, surface: Surface, args: argparse.Namespace) -> None:
    """The parts of `register` in tracking; the quality of the pose also without the
    neighbours that `align` kept.
    """
    for mesh in [*real_meshes(surface, args), stage()]:
        one = Registrar(mesh, RegisterParams(index_cache=False))
        scan, truth = look(mesh, args.scan, 0.0, 3, partial(_ranges, one))
        guess = off(truth, 0.5, 0.01, 4)
        fit = one.backend.align(scan, guess)
        rest = (one.loop.grader._accuracy, True, guess)
        cases = {
            "register": Case(registered(one, scan, guess)),
            "align": Case(aligned(one, scan, guess)),
            "quality": Case(
                partial(_graded, one, scan, fit, (one.limits, one.params, False, *rest))
            ),
            "with halves": Case(
                partial(_graded, one, scan, fit, (one.limits, one.params, True, *rest))
            ),
            "every search": Case(
                partial(
                    _graded,
                    one,
                    scan,
                    replace(fit, matches=None),
                    (one.limits, one.params, False, *rest),
                )
            ),
        }
        in_turn(cases, args.reps)
        print(
            f"{mesh.name}:",
            ", ".join(
                f"{name} {1e3 * statistics.median(c.cpu):.2f} ms" for name, c in cases.items()
            ),
        )


def _graded(one: Registrar, scan: Array, fit: Fit, rest: tuple[Any, ...]) -> tuple[Array, int]:
    found = quality.grade(one.index, one._visibility, scan, fit, *rest)
    return found.T_ac.inverse().matrix, found.iterations


PARTS = {
    "grading": grading,
    "meshes": meshes,
    "fixed_point": fixed_point,
    "sizes": sizes,
    "index": index,
    "speed": speed,
    "passes": passes,
    "converged": converged,
    "accuracy": accuracy,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small and few: does it run")
    parser.add_argument("--model", type=int, default=100_000)
    parser.add_argument("--scan", type=int, default=10_000)
    parser.add_argument("--reps", type=int, default=7)
    parser.add_argument(
        "--views", type=int, default=30, help="sides of a mesh of which the errors are measured"
    )
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
