"""Bodies of several kinds from a seed, for benchmarks on shapes that were not used before.

Each is an assembly of primitives of trimesh whose parts overlap, so that it has interior faces as
CAD exports do. All kinds but ``symmetric`` differ from their mirror images: ``satellite``,
``vehicle`` and ``lander`` by small parts, the others by their shape. The bodies of ``THIN`` have
rods and panels 0.1 to 0.5 % of their extent thick.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh
from trimesh.creation import annulus, box, cone, cylinder, icosphere

from avsreplay.records import Surface

Mesh = trimesh.Trimesh
X, Y, Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)


def at(mesh: Mesh, *place: float) -> Mesh:
    """The mesh moved."""
    return mesh.apply_translation(place)


def turned(mesh: Mesh, degrees: float, axis: tuple[int, int, int]) -> Mesh:
    """The mesh turned about an axis through the origin."""
    return mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(degrees), axis))


def satellite(rng: np.random.Generator) -> list[Mesh]:
    """A bus with two equal panels, a dish and a nozzle, and one to three boxes on its sides."""
    bus = rng.uniform([1.0, 0.8, 1.0], [1.6, 1.3, 2.2])
    length, width = rng.uniform(1.0, 2.2), rng.uniform(0.5, 0.9)
    parts = [box(bus)]
    for side in (-1, 1):
        parts.append(at(box((length, 0.04, width)), side * (bus[0] / 2 + 0.3 + length / 2), 0, 0))
        parts.append(
            at(turned(cylinder(0.04, 0.7, sections=12), 90, Y), side * (bus[0] / 2 + 0.2), 0, 0)
        )
    parts.append(at(cone(rng.uniform(0.25, 0.5), 0.3, sections=20), 0, 0, bus[2] / 2))
    parts.append(at(cylinder(rng.uniform(0.15, 0.3), 0.3, sections=20), 0, 0, -bus[2] / 2 - 0.1))
    for _ in range(rng.integers(1, 4)):
        size, axis, side = rng.uniform(0.12, 0.35, 3), rng.integers(3), rng.choice((-1, 1))
        place = rng.uniform(-0.7, 0.7, 3) * bus / 2
        place[axis] = side * (bus[axis] / 2 + size[axis] / 2 - 0.02)
        parts.append(at(box(size), *place))
    return parts


def wing(rng: np.random.Generator) -> list[Mesh]:
    """A bus with one panel, a dish on the other side, a boom, a box and a sphere."""
    x, y, z = rng.uniform(0.8, [1.5, 1.4, 1.6])
    length = rng.uniform(1.5, 3.0)
    return [
        box((x, y, z)),
        at(
            turned(box((length, 0.05, 0.8)), rng.uniform(5, 40), X),
            x / 2 + 0.1 + length / 2,
            0,
            0.1,
        ),
        at(turned(cone(0.5, 0.35, sections=24), 90, Y), -x / 2 - 0.2, y * 0.2, z * 0.2),
        at(cylinder(0.05, 1.2, sections=10), x * 0.3, -y * 0.3, z / 2 + 0.5),
        at(box((0.3, 0.3, 0.5)), -x * 0.2, y / 2 + 0.1, -z * 0.3),
        at(icosphere(2, 0.2), x * 0.25, -y / 2, z * 0.2),
    ]


def bracket(rng: np.random.Generator) -> list[Mesh]:
    """Two plates at right angles, with a rib and a pin."""
    a, b, t = rng.uniform(1.2, 2.2), rng.uniform(0.8, 1.5), rng.uniform(0.1, 0.25)
    upright = at(box((t, b, rng.uniform(0.8, 1.6))), -a / 2 + t / 2, 0, 0.5)
    rib = at(turned(box((0.9, 0.1, 0.15)), 45, Y), -a / 2 + 0.35, rng.uniform(-0.4, 0.25) * b, 0.35)
    return [
        box((a, b, t)),
        upright,
        rib,
        at(cylinder(0.15, 0.3), a * 0.3, rng.uniform(-0.3, 0.3) * b, t / 2 + 0.1),
    ]


def chair(rng: np.random.Generator) -> list[Mesh]:
    """A chair with one arm, and with a tray on some."""
    s, side = rng.uniform(0.45, 0.6), rng.choice((-1, 1))
    parts = [
        box((s, s, 0.05)),
        at(turned(box((0.04, s, 0.5)), rng.uniform(-12, -4), Y), -s * 0.47, 0, 0.27),
    ]
    for i in (-1, 1):
        parts += [
            at(cylinder(0.025, 0.45, sections=10), i * s * 0.43, j * s * 0.43, -0.22)
            for j in (-1, 1)
        ]
    parts.append(at(box((s * 0.8, 0.05, 0.04)), 0, side * s * 0.48, 0.22))
    parts.append(at(cylinder(0.02, 0.2, sections=8), s * 0.3, side * s * 0.48, 0.11))
    return (
        [*parts, at(box((0.3, 0.3, 0.02)), s * 0.2, side * s * 0.48, 0.25)]
        if rng.random() < 0.5
        else parts
    )


def mug(rng: np.random.Generator) -> list[Mesh]:
    """A closed mug with a handle, and a box beside it."""
    handle = at(turned(annulus(0.18, 0.25, 0.1, sections=32), 90, X), 0.5, 0, 0.05)
    return [
        cylinder(0.4, 0.9, sections=48),
        handle,
        at(box((0.1, 0.1, 0.3)), 0.1, 0.42, rng.uniform(-0.2, 0.2)),
    ]


def lander(rng: np.random.Generator) -> list[Mesh]:
    """An octagonal body with four legs, a dish, boxes and a mast."""
    parts = [cylinder(0.9, 0.6, sections=8), at(cylinder(0.5, 0.5, sections=16), 0, 0, 0.5)]
    for k in range(4):
        leg = at(turned(cylinder(0.05, 1.3, sections=8), 35, Y), -1.1, 0, -0.5)
        parts.append(turned(leg, 90 * k, Z))
    parts += [
        at(cone(0.35, 0.3, sections=20), 0.5, 0.2, 0.6),
        at(box((0.2, 0.5, 0.2)), -0.4, 0.5, 0.4),
    ]
    parts.append(at(cylinder(0.03, 1.0, sections=8), -0.5, -0.4, 0.8))
    for _ in range(2):
        size, turn = rng.uniform(0.15, 0.35, 3), rng.uniform(0, 2 * np.pi)
        parts.append(
            at(box(size), 0.85 * np.cos(turn), 0.85 * np.sin(turn), rng.uniform(-0.2, 0.3))
        )
    return parts


def vehicle(rng: np.random.Generator) -> list[Mesh]:
    """A car of boxes with an aerial and a mirror, and with a box on some."""
    parts = _car()
    parts += [
        at(cylinder(0.02, 0.6, sections=8), -0.8, 0.4, 1.0),
        at(box((0.15, 0.2, 0.12)), 0.6, 0.75, 0.4),
    ]
    return [*parts, at(box((0.5, 0.3, 0.3)), -1.2, -0.3, 0.45)] if rng.random() < 0.6 else parts


def _car() -> list[Mesh]:
    parts = [box((3, 1.4, 0.6)), at(box((1.4, 1.2, 0.6)), -0.3, 0, 0.55)]
    for i in (-1, 1):
        wheels = (turned(cylinder(0.35, 0.25, sections=24), 90, X) for _ in range(2))
        parts += [
            at(wheel, i * 1.0, j * 0.75, -0.3) for j, wheel in zip((-1, 1), wheels, strict=True)
        ]
    return parts


def symmetric(rng: np.random.Generator) -> list[Mesh]:
    """A satellite, a bracket or a car that is its own mirror image."""
    kind = rng.integers(3)
    if kind == 0:
        panels = [at(box((1.5, 0.04, 0.7)), side * 1.6, 0, 0) for side in (-1, 1)]
        dish = at(cone(0.4, 0.3, sections=20), 0, 0, 0.8)
        return [box((1.2, 1, 1.6)), *panels, dish, at(box((0.3, 0.3, 0.3)), 0, 0.6, 0.3)]
    if kind == 1:
        pin = at(cylinder(0.15, 0.5, sections=24), 0.4, 0, 0.3)
        return [box((2, 1, 0.2)), at(box((0.2, 1, 1.2)), -0.9, 0, 0.6), pin]
    return _car()


def rod(start: tuple, end: tuple, radius: float, sections: int = 8) -> Mesh:
    """A rod between two places."""
    return cylinder(radius, segment=np.array([start, end], dtype=float), sections=sections)


def direction(rng: np.random.Generator) -> np.ndarray:
    """A random direction."""
    d = rng.normal(size=3)
    return d / np.linalg.norm(d)


def probe(rng: np.random.Generator) -> list[Mesh]:
    """A bus with three to five long thin booms, one or two thin panels, a dish on struts and two
    boxes.
    """
    size = rng.uniform(0.5, [1.0, 0.9, 1.1])
    x, _, z = size
    parts = [
        box(size),
        rod((0, 0, 0), rng.uniform(1.5, 2.5) * direction(rng), rng.uniform(0.008, 0.02)),
    ]
    for _ in range(rng.integers(2, 5)):
        parts.append(
            rod((0, 0, 0), rng.uniform(0.8, 2.0) * direction(rng), rng.uniform(0.006, 0.02))
        )
    panel = rng.uniform([0.8, 0.006, 0.3], [1.6, 0.02, 0.6])
    for side in (-1, 1) if rng.random() < 0.6 else (1,):
        parts.append(
            at(
                turned(box(panel), rng.uniform(0, 60), X),
                side * (x / 2 + 0.15 + panel[0] / 2),
                0,
                0,
            )
        )
        parts.append(rod((0, 0, 0), (side * (x / 2 + 0.2), 0, 0), 0.015))
    parts.append(
        at(turned(cone(rng.uniform(0.3, 0.5), 0.15, sections=24), 180, X), 0, 0, z / 2 + 0.35)
    )
    for angle in 2 * np.pi * np.arange(3) / 3:
        c, s = np.cos(angle), np.sin(angle)
        parts.append(rod((0.2 * c, 0.2 * s, z / 2 - 0.02), (0.25 * c, 0.25 * s, z / 2 + 0.3), 0.01))
    for _ in range(2):
        place, axis = rng.uniform(-0.6, 0.6, 3) * size / 2, rng.integers(3)
        place[axis] = rng.choice((-1, 1)) * size[axis] / 2
        parts.append(at(box(rng.uniform(0.1, 0.25, 3)), *place))
    return parts


def guitar(rng: np.random.Generator) -> list[Mesh]:
    """An electric guitar: a flat body with a horn, neck, head, strings, frets, pegs, pickups
    and knobs.
    """
    t, tilt = rng.uniform(0.035, 0.05), rng.uniform(15, 35)
    parts = [cylinder(rng.uniform(0.16, 0.19), t, sections=48), at(box((0.22, 0.2, t)), 0.11, 0, 0)]
    parts.append(at(cylinder(rng.uniform(0.12, 0.15), t, sections=40), 0.22, 0.01, 0))
    parts.append(at(turned(box((0.16, 0.05, t)), tilt, Z), 0.33, 0.09, 0))
    parts.append(at(box((0.5, 0.055, 0.022)), 0.55, 0, t / 2 - 0.004))
    parts.append(
        at(turned(box((0.18, 0.08, 0.015)), rng.uniform(5, 14), Y), 0.87, 0.005, t / 2 - 0.01)
    )
    for k in range(6):
        y, peg = (k - 2.5) * 0.008, 0.82 + 0.022 * k
        parts.append(
            rod((-0.05, y, t / 2 + 0.012), (0.80, y * 0.8, t / 2 + 0.012), 0.0007 + 0.0002 * k, 6)
        )
        parts.append(
            at(turned(cylinder(0.005, 0.03, sections=8), 90, X), peg, 0.055, t / 2 - 0.012)
        )
        parts.append(at(box((0.012, 0.02, 0.008)), peg, 0.075, t / 2 - 0.012))
    parts += [
        at(cylinder(0.012, 0.018, sections=16), -0.02 - 0.03 * k, -0.11 + 0.01 * k, t / 2 + 0.006)
        for k in range(3)
    ]
    parts += [at(box((0.035, 0.08, 0.01)), 0.05 + 0.1 * k, 0, t / 2 + 0.004) for k in range(2)]
    parts.append(at(box((0.03, 0.08, 0.012)), -0.05, 0, t / 2 + 0.005))
    return parts + [
        at(box((0.002, 0.052, 0.002)), 0.33 + 0.022 * k, 0, t / 2 + 0.0075) for k in range(20)
    ]


def comsat(rng: np.random.Generator) -> list[Mesh]:
    """A bus with two wings of two or three thin panels each, three dishes on masts and four whip
    antennas.
    """
    x, y, z = rng.uniform(0.5, [0.9, 0.9, 1.2])
    parts, count, tilt = [box((x, y, z))], rng.integers(2, 4), rng.uniform(0, 90)
    panel = rng.uniform([0.45, 0.006, 0.35], [0.7, 0.02, 0.6])
    for side in (-1, 1):
        for k in range(count):
            parts.append(
                turned(
                    at(box(panel), side * (x / 2 + 0.2 + (k + 0.5) * (panel[0] + 0.03)), 0, 0),
                    tilt,
                    X,
                )
            )
        parts.append(
            rod((0, 0, 0), (side * (x / 2 + 0.2 + count * (panel[0] + 0.03)), 0, 0), 0.012)
        )
    for _ in range(3):
        a, b = rng.uniform(-0.4, 0.4, 2) * np.array([x, y])
        parts.append(
            at(turned(cone(rng.uniform(0.12, 0.3), 0.08, sections=20), 180, X), a, b, z / 2 + 0.15)
        )
        parts.append(rod((a, b, z / 2 - 0.02), (a, b, z / 2 + 0.12), 0.01))
    for _ in range(4):
        root = np.array([*rng.uniform(-0.4, 0.4, 2) * np.array([x, y]), -z / 2])
        d = rng.normal(size=3) * [0.4, 0.4, 0.1] - [0, 0, 1]
        end = root + rng.uniform(0.3, 0.8) * d / np.linalg.norm(d)
        parts.append(rod(tuple(root), tuple(end), rng.uniform(0.006, 0.012)))
    return [*parts, at(box((0.2, 0.15, 0.1)), x * 0.2, y / 2, z * 0.2)]


def truss(rng: np.random.Generator) -> list[Mesh]:
    """A triangular mast of rods with a bus at one end, a thin panel at the other and a box."""
    side, radius, count = rng.uniform(0.12, 0.2), rng.uniform(0.006, 0.014), rng.integers(6, 10)
    corners = [(side, 0.0), (-side / 2, 0.87 * side), (-side / 2, -0.87 * side)]
    parts = []
    for low in 1.6 * side * np.arange(count):
        high = low + 1.6 * side
        for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
            parts += [rod((*a, low), (*a, high), radius), rod((*a, low), (*b, low), radius)]
            parts.append(rod((*a, low), (*b, high), 0.7 * radius))
    parts.append(at(box(rng.uniform(0.4, 0.7, 3)), 0, 0, -0.3))
    parts.append(
        at(turned(box((0.8, 0.01, 0.4)), rng.uniform(10, 50), Y), 0.2, 0.1, count * 1.6 * side)
    )
    return [*parts, at(box((0.2, 0.3, 0.15)), 0.3, 0.1, -0.2)]


def grid(rng: np.random.Generator) -> list[Mesh]:
    """A plate of bars that cross at right angles, with a plate in one of its holes and a small box
    on it.
    """
    rows, columns, thick = rng.integers(3, 6), rng.integers(4, 7), rng.uniform(0.05, 0.15)
    size = np.array([columns, rows]) * rng.uniform(0.4, 0.6)
    parts = [
        at(box((size[0] + 0.12, 0.12, thick)), 0, y, 0)
        for y in np.linspace(-0.5, 0.5, rows + 1) * size[1]
    ]
    parts += [
        at(box((0.12, size[1] + 0.12, thick)), x, 0, 0)
        for x in np.linspace(-0.5, 0.5, columns + 1) * size[0]
    ]
    hole = (rng.integers((columns, rows)) + 0.5) / (columns, rows) - 0.5
    parts.append(at(box((*(size / (columns, rows)), thick)), *(hole * size), 0))
    return [*parts, at(box((0.3, 0.2, 0.2)), *rng.uniform(-0.4, 0.4, 2) * size, thick / 2 + 0.05)]


def station(rng: np.random.Generator) -> list[Mesh]:
    """Modules in a row, a node with a module across, and panels on a truss that are equal but for
    their tilt.
    """
    radius, lengths = rng.uniform(0.3, 0.45), rng.uniform(0.7, 1.6, 3)
    parts, x = [box((0.8, 0.8, 0.8))], 0.4
    for length in lengths[:2]:
        parts.append(at(turned(cylinder(radius, length, sections=20), 90, Y), x + length / 2, 0, 0))
        x += length - 0.02
    parts.append(
        at(
            turned(cylinder(radius * 0.9, lengths[2], sections=20), 90, X),
            0,
            0.4 + lengths[2] / 2,
            0,
        )
    )
    parts.append(at(box((0.15, 5.0, 0.15)), -0.4, 0, 0.45))
    for y, tilt in zip((-2.2, 2.2), rng.uniform(-40, 40, 2), strict=True):
        parts.append(at(turned(box((1.6, 0.7, 0.04)), tilt, Y), -0.4, y, 0.6))
    return parts


KINDS: dict[str, Callable[[np.random.Generator], list[Mesh]]] = {
    each.__name__: each
    for each in (satellite, wing, bracket, chair, mug, lander, vehicle, symmetric)
}
THIN: dict[str, Callable[[np.random.Generator], list[Mesh]]] = {
    each.__name__: each for each in (probe, guitar, comsat, truss)
}
MORE = {**KINDS, **THIN, "grid": grid, "station": station}


def body(kind: str, seed: int) -> Mesh:
    """A body with the origin off the centre of its box; ``kind``: one of ``MORE``."""
    mesh = trimesh.util.concatenate(MORE[kind](np.random.default_rng([seed, sum(map(ord, kind))])))
    return at(
        mesh,
        *(
            0.05 * np.linalg.norm(mesh.extents) * np.array([0.3, -0.2, 0.4])
            - mesh.bounds.mean(axis=0)
        ),
    )


def surface_of(mesh: Mesh, name: str) -> Surface:
    """The surface of a mesh."""
    return Surface(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int32), name, "")
