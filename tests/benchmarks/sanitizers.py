"""The C++ extensions under AddressSanitizer and UndefinedBehaviorSanitizer: their tests, and a fuzz
campaign.

``python tests/benchmarks/sanitizers.py [--quick] [--inputs N] [--campaign S]`` (GCC or Clang on
Linux, CMake, Ninja or Make). Copies the sources to a temporary folder, builds the extensions there
with ``-DAVSREPLAY_SANITIZE=ON``, runs the tests of the extensions, and gives them mutated models,
saved indexes and arrays of extreme numbers. An input must be refused with an exception or give a
result; a report of a sanitizer ends the process and is a finding.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fuzz_inputs import mutate
from fuzz_workers import Check, report, run_campaign

ROOT = Path(__file__).resolve().parents[2]
TESTS = (
    "test_plan_cone_programme.py",
    "test_register_kernel.py",
    "test_register_surface_index.py",
    "test_register_index_cache.py",
    "test_register_restarts.py",
    "test_monitor_observability.py",
    "test_estimate_dynamics.py",
    "test_estimate_chart.py",
    "test_estimate_measurement.py",
)
LIMIT_S, LIMIT_MIB, BATCH = 60, 4096, 250
EXTREMES = np.array(
    [0.0, -0.0, 1.0, -1.0, 1e-320, 1e-30, 1e4, 1e20, -1e38, 1e300, np.inf, -np.inf, np.nan]
)
ENDS = np.array([0, 1, 2, -1, 7, 2**20, 2**31 - 1, -(2**31)], dtype=np.int64)


def build(folder: Path) -> dict[str, str]:
    """Build the extensions in a copy of the sources; the environment for processes that load
    them.
    """
    for name in ("avsreplay", "tests", "fixtures"):
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("*.so", "__pycache__")
        )
    for name in ("CMakeLists.txt", "pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, folder / name)
    command = [sys.executable, "-m", "nanobind", "--cmake_dir"]
    nanobind = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    configure = [
        "cmake",
        "-S",
        folder,
        "-B",
        folder / "build",
        "-DCMAKE_BUILD_TYPE=Release",
        "-DAVSREPLAY_SANITIZE=ON",
        f"-Dnanobind_DIR={nanobind}",
        f"-DPython_EXECUTABLE={sys.executable}",
    ]
    subprocess.run(configure, check=True, stdout=subprocess.DEVNULL)
    subprocess.run(
        ["cmake", "--build", folder / "build", "-j2"], check=True, stdout=subprocess.DEVNULL
    )
    libraries = [_library(name) for name in ("libasan.so", "libubsan.so", "libstdc++.so.6")]
    paths = [folder, folder / "tests", folder / "tests" / "benchmarks"]
    return {
        **os.environ,
        "LD_PRELOAD": " ".join(libraries),
        "PYTHONPATH": os.pathsep.join(map(str, paths)),
        "ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1",
        "UBSAN_OPTIONS": "print_stacktrace=1",
    }


def _library(name: str) -> str:
    compiler = os.environ.get("CXX", "c++")
    found = subprocess.run(
        [compiler, f"-print-file-name={name}"], capture_output=True, text=True, check=True
    )
    return found.stdout.strip()


def models() -> dict[str, bytes]:
    """Models to mutate: a mesh, a point cloud, and a mesh with faces of very different sizes."""
    import trimesh

    sphere, box = trimesh.creation.icosphere(2, 1.0), trimesh.creation.box((0.01, 1.0, 9.0))
    both = trimesh.util.concatenate([sphere, box])
    cloud = trimesh.PointCloud(sphere.vertices).export(file_type="ply")
    return {
        "sphere.ply": sphere.export(file_type="ply"),
        "cloud.ply": cloud,
        "both.stl": both.export(file_type="stl"),
        "box.obj": box.export(file_type="obj").encode(),
    }


def numbers(rng: np.random.Generator, *shape: int) -> np.ndarray:  # type: ignore[type-arg]
    """Normal numbers, some of them replaced by extreme ones."""
    out = rng.standard_normal(shape)
    share = rng.choice([0.0, 0.02, 0.3])
    return np.where(rng.random(shape) < share, rng.choice(EXTREMES, shape), out)


def use(index, rng: np.random.Generator) -> None:  # type: ignore[no-untyped-def]
    """Every query of an index, with any points, pose and parameters."""
    points = numbers(rng, int(rng.choice([0, 1, 7, 300])), 3).astype(rng.choice(["f4", "f8"]))
    T = np.eye(4)
    T[:3] += 0.05 * numbers(rng, 3, 4)
    gate, side = (float(abs(v)) for v in numbers(rng, 2))
    facing = bool(rng.random() < 0.5)
    calls: tuple[Callable[[], object], ...] = (
        lambda: index.closest(points, 1, tuple(T[:3, 3]) if facing else None),
        lambda: index.icp(
            points, T, 6, 2, gate, 3.0, 0.001, 1e-6, 1e-6, 1, facing, facing, facing, 0
        ),
        lambda: index.normal_equations(points, T, gate, 1, facing),
        lambda: index.evidence(points, T, gate, side, 6, facing, 1),
        lambda: index.faces_camera(points, T, int(rng.integers(-1, 500)), float(rng.random())),
    )
    for call in calls:
        _tried(call)


def _tried(call: Callable[[], object]) -> bool:
    from avsreplay.errors import AvsError

    try:
        call()
    except (AvsError, ValueError, TypeError, MemoryError, RuntimeError, OverflowError):
        return False
    return True


def from_model(rng: np.random.Generator) -> str:
    """A mutated model file, indexed and queried."""
    from avsreplay.errors import AvsError
    from avsreplay.log import parse_surface
    from avsreplay.register.surface_index import SurfaceIndex

    every = models()
    name = sorted(every)[int(rng.integers(len(every)))]
    data = mutate(every[name], rng, [every[name]])
    try:
        surface = parse_surface(data, name)
        index = SurfaceIndex.build(
            surface, float(rng.choice([0.01, 0.2, 5.0])) * max(surface.extent, 1e-3)
        )
    except AvsError:
        return "model refused"
    use(index._index, rng)
    return "model used"


def from_arrays(rng: np.random.Generator) -> str:
    """An index of arbitrary arrays, as a caller of the extension could give them."""
    from avsreplay.register import _kernel

    n, m = int(rng.choice([1, 3, 60])), int(rng.choice([0, 1, 40]))
    vertices, faces = numbers(rng, n, 3), rng.integers(0, n, (m, 3)).astype(np.int32)
    kept = np.arange(m, dtype=np.int32)
    if rng.random() < 0.3 and m:
        faces.flat[int(rng.integers(faces.size))] = rng.choice(ENDS)
        kept[int(rng.integers(m))] = rng.choice(ENDS)
    made = []
    if not _tried(
        lambda: made.append(_kernel.Index(vertices, faces, kept, float(abs(numbers(rng, 1)[0]))))
    ):
        return "arrays refused"
    use(made[0], rng)
    return "arrays used"


def from_saved(rng: np.random.Generator) -> str:
    """A mutated saved index."""
    from avsreplay.log import parse_surface
    from avsreplay.register import _kernel
    from avsreplay.register.surface_index import SurfaceIndex

    surface = parse_surface(models()["sphere.ply"], "sphere.ply")
    index = SurfaceIndex.build(surface, 0.5)
    saved = index._index.save()
    made = []
    call = lambda: made.append(_kernel.Index(mutate(saved, rng, [saved]), len(surface.faces), True))  # noqa: E731
    if not _tried(call):
        return "index refused"
    use(made[0], rng)
    return "index used"


def from_motion(rng: np.random.Generator) -> str:
    """Extreme states and covariances for the motion kernel."""
    from avsreplay.estimate import _motion

    sigma, push = numbers(rng, 3), tuple(numbers(rng, 3))
    times = np.sort(np.abs(numbers(rng, 5)) % 10.0)  # a million radians, the limit, take minutes
    state = [numbers(rng, k) for k in (4, 3, 3, 3, 2, 3, 4)]
    if rng.random() < 0.9:  # others are refused
        sigma, state[4] = np.clip(sigma, -1.0, 1.0), np.clip(state[4], -1.0, 1.0)
    sigma = tuple(sigma)
    P = numbers(rng, 20, 20)
    done = _tried(lambda: _motion.follow(state[0], state[1], sigma, push, times))
    done |= _tried(lambda: _motion.Path(state[0], state[1], sigma).at(times))
    done |= _tried(
        lambda: _motion.forecast(np.concatenate(state), P @ P.T, push, float(abs(push[0])), times)
    )
    H, S = numbers(rng, 6, 20), numbers(rng, 6, 6)
    done |= _tried(
        lambda: _motion.correct(
            np.concatenate(state), P @ P.T, H, numbers(rng, 6), S, S @ S.T, (0.5, 0.5)
        )
    )
    return "motion used" if done else "motion refused"


def from_cone(rng: np.random.Generator) -> str:
    """Random stagewise cone programmes, some with rows that do not fit."""
    from avsreplay.plan import _cone

    n, sizes = int(rng.integers(1, 6)), rng.integers(1, 6, int(rng.integers(1, 20)))
    stage = np.repeat(rng.integers(0, n, len(sizes)), sizes).astype(np.int32)
    rows = numbers(rng, 11 * len(stage)).reshape(-1, 11), numbers(rng, len(stage))
    done = _tried(
        lambda: _cone.solve(n, (0.0, 0.1, 0.2), (1.0, 10.0), stage, *rows, sizes.astype(np.int32))
    )
    return "cone used" if done else "cone refused"


KINDS = (from_model, from_arrays, from_saved, from_motion, from_cone)


def fuzz(campaign: int, inputs: list[int]) -> int:
    """Run the campaign in this process, which has loaded the sanitizers."""

    def task(number: int) -> tuple[str, Check]:
        rng, kind = np.random.default_rng([campaign, number]), KINDS[number % len(KINDS)]
        return kind.__name__, lambda _folder: kind(rng)

    with np.errstate(all="ignore"):
        return report(campaign, len(inputs), run_campaign(inputs, task, LIMIT_S, LIMIT_MIB, BATCH))


def main() -> int:
    """Build, test and fuzz; exit 1 on any finding."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--campaign", type=int, default=1)
    parser.add_argument("--only", type=int)
    parser.add_argument("--quick", action="store_true", help="400 inputs")
    parser.add_argument(
        "--inside", action="store_true", help="this process has loaded the sanitizers (internal)"
    )
    asked = parser.parse_args()
    if asked.inside:
        inputs = (
            [asked.only]
            if asked.only is not None
            else list(range(400 if asked.quick else asked.inputs))
        )
        return fuzz(asked.campaign, inputs)
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root)
        environment = build(folder)
        tests = [folder / "tests" / name for name in TESTS]
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-x",
            "-m",
            "not slow",
            "-p",
            "no:cacheprovider",
            *tests,
        ]
        tested = subprocess.run(command, cwd=folder, env=environment, check=False).returncode
        script = folder / "tests" / "benchmarks" / Path(__file__).name
        inside = [sys.executable, script, "--inside", *sys.argv[1:]]
        fuzzed = subprocess.run(inside, cwd=folder, env=environment, check=False).returncode
    return 1 if tested or fuzzed else 0


if __name__ == "__main__":
    raise SystemExit(main())
