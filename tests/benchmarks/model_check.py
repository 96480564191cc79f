"""What a run says of its model: mirror images, and the duration of scans beside a wrong size and
noise.

python tests/benchmarks/model_check.py [mirror] [duration] [--seeds 0,1] [--kinds satellite,...]
    [--meshes FILE,...] [--noise 0.002]

Targets are the bodies of ``bodies.py`` for each kind and seed, and mesh files.

mirror     Eight views of 3,000 points from random sides at three extents. "right" registers them
           from the true pose; "mirrored" reflects the scans and registers them without a guess. The
           scanned target is the model, or the model with a smooth deformation of 0.3 or 0.8 % of
           the extent (rms), without one part, with a further part, with both, or 1.02 times as
           large. The table has the runs with accepted scans, and those with the message that the
           mirror image is better. The runs of ``symmetric`` and of right models must have none.
duration   60 scans at 2 Hz of a target that rotates by 0.1 to 0.3 rad/s; 80 x 80 rays, row by row
           or column by column, are spread over the duration, and the points have no times. Size,
           duration and noise vary. The table has the runs, and those that report a duration and a
           size; "off" is the largest difference of a reported duration from the true one, over the
           latter.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterator

import bodies
import numpy as np
import scenes
import trimesh
from raycast_logs import of_file, ray_grid
from scipy.spatial.transform import Rotation
from trimesh.ray.ray_pyembree import RayMeshIntersector

from avsreplay.geometry import Pose
from avsreplay.records import AlignStatus, Scan, Surface
from avsreplay.register.model_check import ModelCheck
from avsreplay.register.registrar import Registrar

VIEWS, POINTS, SCANS, HZ, RAYS = 8, 3000, 60, 2.0, 80
REFLECTED = np.array([-1.0, 1.0, 1.0])
DURATIONS = [  # size of the target over that of the model, duration [s], noise over the extent
    *(
        (1.0, 0.0, 0.0005),
        (1.02, 0.0, 0.0005),
        (0.98, 0.0, 0.0005),
        (1.0, 0.0, 0.004),
        (1.0, 0.0, 0.008),
    ),
    *(
        (1.0, 0.2, 0.0005),
        (1.0, 0.6, 0.0005),
        (1.0, 0.6, 0.004),
        (1.02, 0.6, 0.0005),
        (1.0, -0.6, 0.0005),
    ),
]


def targets(asked: argparse.Namespace) -> Iterator[tuple[str, trimesh.Trimesh]]:
    """The names and meshes."""
    for kind in filter(None, asked.kinds.split(",")):
        for seed in map(int, asked.seeds.split(",")):
            yield f"{kind} {seed}", bodies.body(kind, seed)
    for file in filter(None, asked.meshes.split(",")):
        yield file, of_file(file)


def deformed(mesh: trimesh.Trimesh, share: float, rng: np.random.Generator) -> trimesh.Trimesh:
    """The mesh with a smooth displacement of this rms over the extent."""
    extent = np.linalg.norm(mesh.extents)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if len(faces) < 5000:
        vertices, faces = trimesh.remesh.subdivide_to_size(
            vertices, faces, 0.05 * extent, max_iter=30
        )
    moved = np.zeros_like(vertices)
    for _ in range(8):
        wave, phase = 2.0 * np.pi / extent * rng.normal(size=3), rng.uniform(0.0, 2.0 * np.pi)
        moved += rng.normal(size=3) * np.sin(vertices @ wave + phase)[:, None]
    moved *= share * extent / np.sqrt((moved**2).sum(axis=1).mean())
    return trimesh.Trimesh(vertices + moved, faces, process=False)


def without_part(mesh: trimesh.Trimesh, rng: np.random.Generator) -> trimesh.Trimesh:
    """The mesh without one of its parts, but not the largest."""
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    areas = np.bincount(labels, mesh.area_faces)
    others = np.delete(np.arange(len(areas)), np.argmax(areas))
    return (
        mesh
        if not len(others)
        else mesh.submesh([labels != rng.choice(others)], append=True, repair=False)
    )


def with_part(mesh: trimesh.Trimesh, rng: np.random.Generator) -> trimesh.Trimesh:
    """The mesh with a box somewhere on its surface."""
    place = trimesh.sample.sample_surface(mesh, 1, seed=int(rng.integers(2**31)))[0][0]
    size = rng.uniform(0.05, 0.15, 3) * np.linalg.norm(mesh.extents)
    return trimesh.util.concatenate([mesh, trimesh.creation.box(size).apply_translation(place)])


ERRORS: dict[str, Callable[[trimesh.Trimesh, np.random.Generator], trimesh.Trimesh]] = {
    "none": lambda mesh, _: mesh,
    "deformed by 0.3 %": lambda mesh, rng: deformed(mesh, 0.003, rng),
    "deformed by 0.8 %": lambda mesh, rng: deformed(mesh, 0.008, rng),
    "without a part": without_part,
    "with a further part": with_part,
    "both": lambda mesh, rng: with_part(without_part(mesh, rng), rng),
    "1.02 times as large": lambda mesh, _: mesh.copy().apply_scale(1.02),
}


def mirror(asked: argparse.Namespace) -> None:
    """Print the table of mirrored models."""
    runs = defaultdict(lambda: np.zeros((2, 2), dtype=int))
    for number, (name, mesh) in enumerate(targets(asked)):
        model = bodies.surface_of(mesh, name)
        registrar = Registrar(model)
        handed = "the same" if name.startswith("symmetric") else "another"
        for error, change in ERRORS.items():
            target = bodies.surface_of(
                change(mesh.copy(), np.random.default_rng([number, 77])), name
            )
            for mirrored in (0, 1):
                runs[handed, error][mirrored] += run_of_views(
                    registrar, model, target, bool(mirrored), 7000 + number, asked.noise
                )
    print(
        "| mirror image | error of the model | right: runs with accepted scans, of these called"
        " mirrored | mirrored |"
    )
    for (handed, error), ((accepted, said), (of_image, said_of_image)) in sorted(runs.items()):
        print(f"| {handed} | {error} | {accepted}, {said} | {of_image}, {said_of_image} |")


def run_of_views(
    registrar: Registrar, model: Surface, target: Surface, mirrored: bool, seed: int, noise: float
) -> tuple[bool, bool]:
    """Whether scans were accepted, and whether the mirror image was then called better."""
    check, accepted = ModelCheck(registrar, model), 0
    for k in range(VIEWS):
        seen = scenes.view(target, POINTS, seed + 100 * k, noise=noise)
        points = np.ascontiguousarray(seen.points * (REFLECTED if mirrored else 1.0))
        found = registrar.acquire(points) if mirrored else registrar.register(points, seen.T_ac)
        accepted += found.status is AlignStatus.ALIGNED
        check.add(Scan(k, k * 10**9, points), found)
    return accepted > 0, accepted > 0 and any("mirror" in note for note in check.notes())


def scans(
    mesh: trimesh.Trimesh, extent: float, duration_s: float, noise: float, seed: int
) -> Iterator[tuple[Scan, Pose, float]]:
    """Scans with the pose in their middle, and the time that their points take [s]."""
    rng = np.random.default_rng([seed, 5])
    rays = ray_grid(11.0, RAYS)
    if seed % 2:
        rays = rays.reshape(RAYS, RAYS, 3).transpose(1, 0, 2).reshape(-1, 3)
    spin = rng.normal(size=3)
    spin *= (0.1 + 0.05 * (seed % 5)) / np.linalg.norm(spin)
    start, velocity = Rotation.random(random_state=seed), 0.001 * extent * rng.normal(size=3)
    place = np.array([0.0, 0.0, 2.9 * extent]) + 0.1 * extent * rng.normal(size=3)
    caster, share = RayMeshIntersector(mesh), (np.arange(len(rays)) + 0.5) / len(rays) - 0.5
    for k in range(SCANS):
        t = k / HZ + duration_s * share
        turns = (Rotation.from_rotvec(t[:, None] * spin) * start).as_matrix()
        places = place + t[:, None] * velocity
        eyes, directions = (np.einsum("nji,nj->ni", turns, each) for each in (-places, rays))
        hits, rows, _ = caster.intersects_location(eyes, directions, multiple_hits=False)
        order = np.argsort(rows)
        hits, rows = hits[order], rows[order]
        ranges = np.linalg.norm(hits - eyes[rows], axis=1) + noise * extent * rng.normal(
            size=len(rows)
        )
        points = (ranges[:, None] * rays[rows]).astype(np.float32)
        before = (np.arange(len(points)) / len(points)).astype(np.float32)
        middle = k / HZ + duration_s * float(share[rows].mean())
        pose = Pose(
            (Rotation.from_rotvec(middle * spin) * start).as_quat(), place + middle * velocity
        )
        taken = duration_s * float(share[rows[-1]] - share[rows[0]])
        yield Scan(k, round(1e9 * k / HZ), points, places=before), pose, taken


def duration(asked: argparse.Namespace) -> None:
    """Print the table of durations."""
    found = {case: [] for case in DURATIONS}
    for number, (name, mesh) in enumerate(targets(asked)):
        model = bodies.surface_of(mesh, name)
        registrar = Registrar(model)
        for case in DURATIONS:
            size, duration_s, noise = case
            check, target, taken = ModelCheck(registrar, model), mesh.copy().apply_scale(size), []
            for scan, T_ac, time_s in scans(target, model.extent, duration_s, noise, number):
                check.add(scan, registrar.register(scan.points, T_ac))
                taken.append(time_s)
            notes, result = check.notes(), check._durations.result(registrar.index)
            off = (
                abs(result.duration_s - np.mean(taken)) / abs(np.mean(taken))
                if result and duration_s
                else 0.0
            )
            found[case].append(
                (result is not None, any("--model-scale" in note for note in notes), off)
            )
    print(
        "| size | duration of all rays [s] | noise | runs | report a duration | report a size |"
        " off |"
    )
    for (size, duration_s, noise), runs in found.items():
        reported, sized, off = zip(*runs, strict=True)
        counts = f"{len(runs)} | {sum(reported)} | {sum(sized)}"
        print(f"| {size} | {duration_s} | {noise} | {counts} | {100 * max(off):.0f} % |")


def main() -> None:
    """Print the tables asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "parts", nargs="*", default=["mirror", "duration"], choices=["mirror", "duration"]
    )
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--kinds", default=",".join(bodies.KINDS))
    parser.add_argument("--meshes", default="")
    parser.add_argument("--noise", type=float, default=0.002)
    asked = parser.parse_args()
    for part in asked.parts:
        {"mirror": mirror, "duration": duration}[part](asked)


if __name__ == "__main__":
    main()
