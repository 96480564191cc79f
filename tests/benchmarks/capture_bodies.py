"""Makes the meshes of the benchmark's bodies: ``python tests/benchmarks/capture_bodies.py``.

Each is in metres in {C}: the origin is on the face of its fixture, and +x points outward. The files
in ``avsreplay/benchmark/bodies`` are part of the suite, so that every machine has the same bytes.
"""

from pathlib import Path

import numpy as np
import trimesh

from avsreplay.simulate.target import Shape, builtin_surface

FOLDER = Path(__file__).resolve().parents[2] / "avsreplay" / "benchmark" / "bodies"
LONG_WING = [-9.0, 0.6, -9.0, 9.0, 9.0, 9.0]  # box about its faces, as in docs/scenario.md


def box(size, centre):
    made = trimesh.creation.box(size)
    made.apply_translation(centre)
    return made


def cylinder(radius, length, centre, axis=(0, 0, 1), sections=24):
    made = trimesh.creation.cylinder(radius, length, sections=sections)
    made.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), axis))
    made.apply_translation(centre)
    return made


def probe():
    """A small box with one panel, an antenna and a nozzle."""
    return [
        box((0.34, 0.30, 0.24), (-0.21, 0.0, 0.0)),
        box((0.02, 0.55, 0.22), (-0.25, 0.44, 0.02)),
        cylinder(0.012, 0.35, (-0.30, -0.05, 0.29), sections=12),
        cylinder(0.07, 0.10, (-0.42, 0.02, -0.02), axis=(1, 0, 0), sections=16),
        cylinder(0.04, 0.05, (-0.02, 0.0, 0.0), axis=(1, 0, 0), sections=16),
        box((0.06, 0.06, 0.05), (-0.20, -0.17, 0.05)),
    ]


def telescope():
    """A tube with an open door, two unequal panels and a box of instruments."""
    return [
        cylinder(0.55, 2.6, (-0.70, 0.0, 0.2)),
        box((0.05, 0.9, 0.9), (-1.22, 0.1, 1.85)),
        box((0.03, 1.4, 0.7), (-0.70, 1.35, 0.1)),
        box((0.03, 1.0, 0.7), (-0.60, -1.15, 0.3)),
        box((0.5, 0.6, 0.5), (-1.20, 0.15, -0.7)),
        cylinder(0.12, 0.18, (-0.08, 0.0, 0.0), axis=(1, 0, 0), sections=16),
    ]


def ball():
    """A sphere with a fixture, three boxes and a short mast: nearly the same from all sides."""
    sphere = trimesh.creation.icosphere(3, 0.70)
    sphere.apply_translation((-0.76, 0.0, 0.0))
    return [
        sphere,
        cylinder(0.10, 0.10, (-0.05, 0.0, 0.0), axis=(1, 0, 0), sections=16),
        box((0.20, 0.16, 0.14), (-0.60, 0.62, 0.25)),
        box((0.12, 0.22, 0.12), (-1.05, -0.50, -0.40)),
        box((0.14, 0.12, 0.20), (-0.50, -0.30, 0.60)),
        cylinder(0.03, 0.30, (-0.90, 0.10, 0.80), sections=12),
    ]


def satellite(without=None):
    """The built-in satellite, or the same without the faces whose centre is in a box."""
    surface = builtin_surface(Shape.SATELLITE)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    if without is not None:
        low, high = np.array(without[:3]), np.array(without[3:])
        inside = ((mesh.triangles_center > low) & (mesh.triangles_center < high)).all(axis=1)
        mesh.update_faces(~inside)
        mesh.remove_unreferenced_vertices()
    return [mesh]


def main():
    bodies = {
        "probe": probe(),
        "telescope": telescope(),
        "ball": ball(),
        "satellite": satellite(),
        "satellite-without-wing": satellite(LONG_WING),
    }
    for name, parts in bodies.items():
        mesh = trimesh.util.concatenate(parts)
        lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in mesh.vertices.round(5) + 0.0]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
        (FOLDER / f"{name}.obj").write_text("\n".join(lines) + "\n")
        print(name, len(mesh.faces), mesh.extents.round(2), np.linalg.norm(mesh.extents).round(2))


if __name__ == "__main__":
    main()
