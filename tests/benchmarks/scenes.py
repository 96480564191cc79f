"""Registration in difficult scenes: share correct, share accepted although wrong (must be 0), work
and time.

    python tests/benchmarks/scenes.py [--quick] [--meshes hst,kepler,...] [--scenes
                                      wall,outliers,...] [--views 2] [--points 4000] [--backend
                                      horn] [--seed 1]

Meshes: HST, Kepler, bunny and dragon from ../shared/data where it exists, the built-in target, a
cylinder stage (a cylinder with closed ends), a box, a bracket of three boxes, a box with a thin
panel, mesh files by their path, and bodies of bodies.py by kind and seed, as grid:51. Every view is
ray-cast from a random side at three extents, with noise of 0.002 of the extent along the ray;
"close" is at 0.65 extents and "closer" at 0.5, with a quarter of the noise. The scenes add walls,
outliers, occlusion, a second object, noise, an error of scale or a bad guess, or show another body
of the same extent alone, at the predicted place if there is a guess. "Correct": within 2 deg and
0.02 of the extent of the true pose, or of a pose that differs by a symmetry of the mesh. With an
error of scale up to 10 % the pose counts; with a factor of 1000, and of another body, no pose is
correct. "Accepted": status aligned. "Wrong": accepted, not correct, and the row says neither that
the scan fits a target of another size, nor that the view does not determine the size, nor that
noise leaves the attitude uncertain by more than 1 deg; where no pose is correct, every accepted one
is wrong. "Beyond": accepted, and the squared error in the metric of the claimed covariance exceeds
the 99.99 % point of Hotelling's T^2, whatever the row says. NEES is the mean of this squared error
over 6, 1 for a correct covariance. Time is processor time; "x" is the ratio to the median of the
clean scans of the same mesh. A row per scene over all meshes, and with --each one per scene and
mesh.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import bodies
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from avsreplay import geometry
from avsreplay.estimate.measurement import from_chi2
from avsreplay.geometry import Array, Pose, exp
from avsreplay.log import read_surface
from avsreplay.records import Alignment, AlignStatus, Surface
from avsreplay.register.params import RegisterParams
from avsreplay.register.registrar import Registrar
from avsreplay.simulate.target import builtin_surface

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FILES = {
    "hst": "spacecraft-meshes/HST.obj",
    "kepler": "spacecraft-meshes/Kepler.obj",
    "bunny": "stanford-bunny/bun_zipper_res3.ply",
    "dragon": "stanford-dragon/dragon_vrip_res3.ply",
}
BOXES = {  # sizes and middles of the boxes of a body
    "box": [((2.0, 1.0, 0.6), (0.0, 0.0, 0.0))],
    "bracket": [
        ((2.0, 1.2, 0.2), (0, 0, 0)),
        ((0.2, 1.2, 1.5), (-0.9, 0, 0.75)),
        ((0.5, 0.3, 0.3), (0.4, 0.3, 0.25)),
    ],
    "panel": [
        ((1.5, 1.2, 1.0), (0, 0, 0)),
        ((3.0, 0.8, 0.05), (2.4, 0, 0.1)),
        ((0.3, 0.3, 0.5), (0.4, -0.4, 0.7)),
    ],
}
NOISE = 0.002  # of the extent
DISTANCE, CLOSE, CLOSER = 3.0, 0.65, 0.5  # extents from the camera to the middle of the target
# 99.99 % point of chi-square with 6 degrees of freedom: a larger squared error contradicts the
# claim
CLAIM = 27.86
RIGHT_DEG, RIGHT_OF_EXTENT = 2.0, 0.02


@dataclass(frozen=True)
class View:
    """One ray-cast scan in {A}, the true T_ac and what is needed to add to it."""

    surface: Surface
    points: Array
    T_ac: Pose
    rng: np.random.Generator

    @property
    def extent(self) -> float:
        return self.surface.extent


@dataclass(frozen=True)
class Case:
    """What is registered: points, the guess (None: global search), and the true pose (None:
    nothing is right).
    """

    points: Array
    guess: Pose | None
    truth: Pose | None


def meshes(names: list[str]) -> dict[str, Surface]:
    """The surfaces by name; files that are not there are left out with a note."""
    found: dict[str, Surface] = {}
    for name in names:
        kind, _, seed = name.partition(":")
        if seed and kind in bodies.MORE:
            found[name] = bodies.surface_of(bodies.body(kind, int(seed)), name)
        elif name == "builtin":
            found[name] = builtin_surface()
        elif name == "cylinder":
            found[name] = _surface(
                trimesh.creation.cylinder(radius=1.8, height=9.0, sections=64), name
            )
        elif name in BOXES:
            parts = [trimesh.creation.box(size).apply_translation(at) for size, at in BOXES[name]]
            found[name] = _surface(trimesh.util.concatenate(parts), name)
        elif name not in FILES:
            found[Path(name).stem] = read_surface(Path(name))
        elif (DATA / FILES[name]).exists():
            found[name] = read_surface(DATA / FILES[name])
        else:
            print(f"{name}: left out, {FILES[name]} is not in {DATA}")
    return found


def _surface(shape: trimesh.Trimesh, name: str) -> Surface:
    return Surface(np.array(shape.vertices), np.array(shape.faces, dtype=np.int32), name, "")


def cast(surfaces: list[tuple[Surface, Pose]], directions: Array) -> tuple[Array, Array]:
    """Range (n,) of the first hit (inf: none) and which surface was hit (n,), from the origin
    of {A}.
    """
    best, which = np.full(len(directions), np.inf), np.full(len(directions), -1)
    for k, (surface, T_ac) in enumerate(surfaces):
        mesh = trimesh.Trimesh(T_ac.apply(surface.vertices), surface.faces, process=False)
        at, ray, _ = mesh.ray.intersects_location(
            np.zeros_like(directions), directions, multiple_hits=False
        )
        distance = np.linalg.norm(at, axis=1)
        nearer = distance < best[ray]
        best[ray[nearer]], which[ray[nearer]] = distance[nearer], k
    return best, which


def cone(points: Array, rng: np.random.Generator, count: int) -> Array:
    """(count, 3) unit directions, uniform over the box of the image of ``points``."""
    image = points[:, :2] / points[:, 2:]
    xy = rng.uniform(image.min(0), image.max(0), (count, 2))
    rays = np.column_stack([xy, np.ones(count)])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def pose(surface: Surface, rng: np.random.Generator, distance: float = DISTANCE) -> Pose:
    """A random attitude, the middle of the target so many extents in front of the camera."""
    q = rng.standard_normal(4)
    turn = Pose(q / np.linalg.norm(q), np.zeros(3))
    middle = (surface.vertices.max(0) + surface.vertices.min(0)) / 2
    place = surface.extent * (
        np.array([0.0, 0.0, distance]) + 0.2 * distance / DISTANCE * rng.uniform(-1, 1, 3)
    )
    return Pose(turn.q, place - turn.R @ middle)


def view(
    surface: Surface,
    count: int,
    seed: int,
    others: Callable[[Pose], list] = lambda _: [],
    noise: float = NOISE,
    distance: float = DISTANCE,
):
    """A view of about ``count`` points on the target and what ``others`` (surfaces and poses) adds
    to it.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    T_ac = pose(surface, rng, distance)
    scene = [(surface, T_ac), *others(T_ac)]
    probe = cone(T_ac.apply(surface.vertices), rng, 2000)
    share = max(0.05, float(np.isfinite(cast(scene[:1], probe)[0]).mean()))
    rays = cone(T_ac.apply(surface.vertices), rng, int(count / share))
    ranges, _ = cast(scene, rays)
    hit = np.isfinite(ranges)
    measured = ranges[hit] + noise * surface.extent * rng.standard_normal(hit.sum())
    return View(surface, rays[hit] * measured[:, None], T_ac, rng)


def off(v: View, degrees: float, share: float) -> Pose:
    """The true pose with a rotation error about the middle of the target and a position error, in
    random directions.
    """
    axis, shift = v.rng.standard_normal((2, 3))
    turn = exp(np.radians(degrees) * axis / np.linalg.norm(axis))
    middle = (v.surface.vertices.max(0) + v.surface.vertices.min(0)) / 2
    D = Pose(
        turn,
        middle - geometry.matrix(turn) @ middle + share * v.extent * shift / np.linalg.norm(shift),
    )
    return v.T_ac @ D


def with_wall(v: View) -> Array:
    """As many points on a wall behind the target as on the target, where the target does not hide
    it.
    """
    rng, L = v.rng, v.extent
    n = np.array([*rng.uniform(-0.5, 0.5, 2), -1.0])
    n /= np.linalg.norm(n)
    centre = v.points.mean(0)
    anchor = centre * (1.0 + 0.8 * L / np.linalg.norm(centre))
    rays = cone(
        np.vstack([v.points, centre + L * np.eye(3), centre - L * np.eye(3)]),
        rng,
        6 * len(v.points),
    )
    ranges = (n @ anchor) / (rays @ n)
    hidden, _ = cast([(v.surface, v.T_ac)], rays)
    wall = (rays * ranges[:, None])[~np.isfinite(hidden) & (ranges > 0)][: len(v.points)]
    wall = wall + NOISE * L * rng.standard_normal((len(wall), 1)) * wall / np.linalg.norm(
        wall, axis=1, keepdims=True
    )
    return np.vstack([v.points, wall])


def with_outliers(v: View, share: float) -> Array:
    """``share`` of the points replaced by points anywhere in a box a fifth larger than the scan."""
    points = v.points.copy()
    wrong = v.rng.random(len(points)) < share
    centre, half = (
        (points.max(0) + points.min(0)) / 2,
        0.6 * np.ptp(points, axis=0) + 0.1 * v.extent,
    )
    points[wrong] = v.rng.uniform(centre - half, centre + half, (wrong.sum(), 3))
    return points


def visible_part(v: View, share: float) -> Array:
    """The points on one side of a straight edge through the image, so that ``share`` of them are
    left.
    """
    angle = v.rng.uniform(0, 2 * np.pi)
    across = (v.points[:, :2] / v.points[:, 2:]) @ np.array([np.cos(angle), np.sin(angle)])
    return v.points[across <= np.quantile(across, share)]


def second_object(surface: Surface) -> Callable[[Pose], list]:
    """Another body beside the target: a box of half its extent."""
    made = trimesh.creation.box(np.array([0.5, 0.35, 0.25]) * surface.extent)
    box = _surface(made, "box")
    middle = (surface.vertices.max(0) + surface.vertices.min(0)) / 2

    def place(T_ac: Pose) -> list:
        at = T_ac.apply(middle) + surface.extent * np.array([0.35, 0.25, -0.3])
        return [(box, Pose(exp([0.4, 0.9, -0.3]), at))]

    return place


def random_object(surface: Surface, seed: int) -> Callable[[Pose], list]:
    """A body of one to three primitives, 0.2 to 0.7 extents large, anywhere next to the target."""
    rng = np.random.Generator(np.random.PCG64([seed, 77]))
    parts = []
    for _ in range(rng.integers(1, 4)):
        size = rng.uniform(0.1, 1.0, 3)
        made = (
            trimesh.creation.box(size)
            if rng.random() < 0.6
            else trimesh.creation.cylinder(0.5 * size[0], size[1])
        )
        made.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        parts.append(made.apply_translation(rng.uniform(-0.3, 0.3, 3)))
    mesh = trimesh.util.concatenate(parts)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.apply_scale(rng.uniform(0.2, 0.7) * surface.extent / np.linalg.norm(mesh.extents))
    middle, place = (surface.vertices.max(0) + surface.vertices.min(0)) / 2, rng.standard_normal(3)
    shift = rng.uniform(0.2, 0.7) * surface.extent * place / np.linalg.norm(place)
    return lambda T_ac: [
        (_surface(mesh, "object"), Pose(Pose.identity().q, T_ac.apply(middle) + shift))
    ]


def grown(surface: Surface, factor: float) -> Surface:
    """The surface scaled: what was measured is ``factor`` times the size of the model."""
    return replace(surface, vertices=surface.vertices * factor)


Maker = Callable[[Surface, int, int], Case]


def _plain(
    degrees: float | None, share: float, change: Callable[[View], Array] = lambda v: v.points
) -> Maker:
    def make(surface: Surface, count: int, seed: int) -> Case:
        v = view(surface, count, seed)
        return Case(change(v), None if degrees is None else off(v, degrees, share), v.T_ac)

    return make


def _noisy(noise: float) -> Maker:
    def make(surface: Surface, count: int, seed: int) -> Case:
        v = view(surface, count, seed, noise=noise)
        return Case(v.points, off(v, 3.0, 0.01), v.T_ac)

    return make


def _close(distance: float, degrees: float) -> Maker:
    """A camera next to the target, with a quarter of the noise; the smallest error is that of
    a prediction.
    """

    def make(surface: Surface, count: int, seed: int) -> Case:
        v = view(surface, count, seed, noise=NOISE / 4, distance=distance)
        return Case(v.points, off(v, degrees, 0.003 * degrees), v.T_ac)

    return make


def _beside(degrees: float | None) -> Maker:
    def make(surface: Surface, count: int, seed: int) -> Case:
        v = view(surface, count, seed, second_object(surface))
        return Case(v.points, None if degrees is None else off(v, degrees, 0.01), v.T_ac)

    return make


def _among(degrees: float | None) -> Maker:
    """Beside a random body."""

    def make(surface: Surface, count: int, seed: int) -> Case:
        v = view(surface, count, seed, random_object(surface, seed))
        return Case(v.points, None if degrees is None else off(v, degrees, 0.01), v.T_ac)

    return make


def _another(body: str, guessed: bool) -> Maker:
    def make(surface: Surface, count: int, seed: int) -> Case:
        other = meshes([body])[body]
        v = view(grown(other, surface.extent / other.extent), count, seed)
        seen, sought = (
            0.5 * (each.vertices.max(0) + each.vertices.min(0)) for each in (v.surface, surface)
        )
        return Case(
            v.points, v.T_ac @ Pose(Pose.identity().q, seen - sought) if guessed else None, None
        )

    return make


def _scaled(factor: float) -> Maker:
    def make(surface: Surface, count: int, seed: int) -> Case:
        v = view(grown(surface, factor), count, seed)
        return Case(v.points, v.T_ac, v.T_ac if abs(factor - 1.0) < 0.1 else None)

    return make


SCENES: dict[str, Maker] = {
    "clean, 3 deg": _plain(3.0, 0.01),
    "clean, 10 deg 3 %": _plain(10.0, 0.03),
    "clean, 45 deg": _plain(45.0, 0.0),
    "clean, 60 deg": _plain(60.0, 0.0),
    "clean, search": _plain(None, 0.0),
    "close, 1 deg": _close(CLOSE, 1.0),
    "close, 5 deg": _close(CLOSE, 5.0),
    "close, 10 deg": _close(CLOSE, 10.0),
    "closer, 1 deg": _close(CLOSER, 1.0),
    "closer, 5 deg": _close(CLOSER, 5.0),
    "closer, 10 deg": _close(CLOSER, 10.0),
    "outliers 5 %, 3 deg": _plain(3.0, 0.01, lambda v: with_outliers(v, 0.05)),
    "outliers 60 %, 0.1 deg": _plain(0.1, 0.0002, lambda v: with_outliers(v, 0.6)),
    "outliers 60 %, 3 deg": _plain(3.0, 0.01, lambda v: with_outliers(v, 0.6)),
    "outliers 60 %, search": _plain(None, 0.0, lambda v: with_outliers(v, 0.6)),
    "wall 50 %, 3 deg": _plain(3.0, 0.01, with_wall),
    "wall 50 %, search": _plain(None, 0.0, with_wall),
    "30 % visible, 3 deg": _plain(3.0, 0.01, lambda v: visible_part(v, 0.3)),
    "30 % visible, search": _plain(None, 0.0, lambda v: visible_part(v, 0.3)),
    "second object, 3 deg": _beside(3.0),
    "second object, search": _beside(None),
    "random object, 3 deg": _among(3.0),
    "random object, search": _among(None),
    "noise 0.004, 3 deg": _noisy(0.004),
    "noise 0.008, 3 deg": _noisy(0.008),
    "noise 0.015, 3 deg": _noisy(0.015),
    "scale 1.02": _scaled(1.02),
    "scale 1.05": _scaled(1.05),
    "scale 1000": _scaled(1000.0),
    "bracket alone, guess": _another("bracket", True),
    "bracket alone, search": _another("bracket", False),
    "panel alone, guess": _another("panel", True),
    "panel alone, search": _another("panel", False),
}
QUICK = (
    "clean, 3 deg",
    "clean, 60 deg",
    "outliers 60 %, 3 deg",
    "wall 50 %, search",
    "noise 0.015, 3 deg",
)


def symmetries(name: str, surface: Surface) -> Callable[[Pose], Pose]:
    """Maps an error in {C} to the least one among the symmetries of the mesh.

    Tested are the rotations of a cube and those by a whole fraction of a turn (down to 1/24) about
    an axis of {C}, through the centre of the box, which displace no vertex by more than 1e-3 of the
    extent from the surface.
    """
    if name == "cylinder":
        return _least_of_cylinder
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    points = surface.vertices[:: max(1, len(surface.vertices) // 500)]
    centre = 0.5 * (surface.vertices.min(0) + surface.vertices.max(0))
    turns = [Rotation.from_matrix(m) for m in Rotation.create_group("O").as_matrix()]
    turns += [
        Rotation.from_rotvec(2 * np.pi * k / n * axis)
        for axis in np.eye(3)
        for n in range(3, 25)
        for k in (1, -1)
    ]
    group = [Pose.identity()]
    for turn in turns:
        moved = turn.apply(points - centre) + centre
        if np.abs(trimesh.proximity.closest_point(mesh, moved)[1]).max() < 1e-3 * surface.extent:
            group.append(Pose(exp(turn.as_rotvec()), centre - turn.apply(centre)))
    return lambda step: min((step @ s for s in group), key=lambda p: float(geometry.angle(p.q)))


def _least_of_cylinder(step: Pose) -> Pose:
    """The tilt of the axis alone, either way up; the shift along with it."""
    z = step.R @ np.array([0.0, 0.0, 1.0])
    tilt = np.arccos(np.clip(abs(z[2]), -1.0, 1.0))
    return Pose(exp([tilt, 0.0, 0.0]), step.t)


def gap(
    found: Alignment, truth: Pose, extent: float, least: Callable[[Pose], Pose]
) -> tuple[float, float]:
    """Rotation [deg] and translation [share of the extent] from the true pose, in {C}."""
    step = least(truth.inverse() @ found.T_ac)
    return float(np.degrees(geometry.angle(step.q))), float(np.linalg.norm(step.t)) / extent


def claimed(found: Alignment, truth: Pose, least: Callable[[Pose], Pose]) -> tuple[float, float]:
    """Squared error of an accepted pose in the metric of its covariance, and its 99.99 % point for
    a true claim.
    """
    step = least(truth.inverse() @ found.T_ac).inverse()
    d = np.concatenate([geometry.log(step.q), step.t])
    return float(d @ np.linalg.solve(found.covariance, d)), from_chi2(CLAIM, found.dof)


@dataclass
class Score:
    """What came of one scene on one mesh."""

    cases: int = 0
    right: int = 0
    accepted: int = 0
    wrong: int = 0
    said: int = 0
    beyond: int = 0
    statuses: str = ""
    seconds: list = None  # type: ignore[assignment]
    ratios: list = None  # type: ignore[assignment]
    squared: list = None  # type: ignore[assignment]


def measure(names: list[str], scenes: list[str], args: argparse.Namespace) -> None:
    """Run every scene on every mesh and print the table."""
    total: dict[str, Score] = {scene: Score(seconds=[], ratios=[], squared=[]) for scene in scenes}
    for name, surface in meshes(names).items():
        registrar = Registrar(surface, RegisterParams(backend=args.backend))
        healthy = _healthy(registrar, surface, args)
        least = symmetries(name, surface)
        for scene in scenes:
            score = Score(seconds=[], ratios=[], squared=[])
            for k in range(args.views):
                _one(
                    registrar,
                    SCENES[scene](surface, args.points, args.seed + 100 * k),
                    surface.extent,
                    least,
                    score,
                    healthy,
                )
            if args.each:
                _print(f"{name}: {scene}", score)
            _add(total[scene], score)
    print()
    for scene, score in total.items():
        _print(scene, score)


def _healthy(registrar: Registrar, surface: Surface, args: argparse.Namespace) -> float:
    """Median processor time of clean scans at 3 deg [s], after what is prepared once for all
    searches.
    """
    registrar.acquire(SCENES["clean, search"](surface, args.points, args.seed).points)
    times = []
    for k in range(3):
        case = SCENES["clean, 3 deg"](surface, args.points, args.seed + 7000 + k)
        begun = time.process_time()
        registrar.register(case.points, case.guess)
        times.append(time.process_time() - begun)
    return float(np.median(times))


def _one(
    registrar: Registrar,
    case: Case,
    extent: float,
    least: Callable[[Pose], Pose],
    score: Score,
    healthy: float,
) -> None:
    begun = time.process_time()
    found = (
        registrar.acquire(case.points)
        if case.guess is None
        else registrar.register(case.points, case.guess)
    )
    spent = time.process_time() - begun
    accepted = found.status is AlignStatus.ALIGNED
    right = False
    if accepted and case.truth is not None:
        squared, point = claimed(found, case.truth, least)
        score.squared.append(squared)
        score.beyond += squared > point
    if case.truth is not None:
        degrees, share = gap(found, case.truth, extent, least)
        right = degrees < RIGHT_DEG and share < RIGHT_OF_EXTENT
    score.cases += 1
    score.right += right
    score.accepted += accepted
    said = any(
        text in found.message
        for text in ("than the model", "error of the size", "attitude is known to")
    )
    score.wrong += accepted and not right and not (said and case.truth is not None)
    score.said += said
    score.statuses += " " + ("+" if right else "-") + found.status.value
    score.seconds.append(spent)
    score.ratios.append(spent / healthy)


def _add(total: Score, score: Score) -> None:
    for field in (
        "cases",
        "right",
        "accepted",
        "wrong",
        "said",
        "beyond",
        "statuses",
        "seconds",
        "ratios",
        "squared",
    ):
        setattr(total, field, getattr(total, field) + getattr(score, field))


def _print(label: str, s: Score) -> None:
    share = (
        f"{s.right:3d} of {s.cases:3d} right, {s.accepted:3d} accepted, {s.wrong:3d} wrong,"
        f" {s.said:3d} stated"
    )
    share += (
        f", {s.beyond:3d} beyond, NEES {np.mean(s.squared) / 6.0 if s.squared else np.nan:5.2f}"
    )
    times = (
        f"{np.median(s.seconds):7.3f} s median {max(s.seconds):7.3f} s max, x {max(s.ratios):6.1f}"
    )
    print(f"{label:36} {share}  {times} {s.statuses if s.cases < 9 else ''}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--meshes", default="hst,kepler,bunny,dragon,builtin,cylinder")
    parser.add_argument(
        "--scenes", default="", help="parts of the names of the scenes, separated by semicolons"
    )
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--points", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--backend", default="horn")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--each", action="store_true")
    args = parser.parse_args()
    asked = [part for part in args.scenes.split(";") if part]
    scenes = [s for s in SCENES if not asked or any(part in s for part in asked)]
    measure(args.meshes.split(","), [s for s in scenes if not args.quick or s in QUICK], args)


if __name__ == "__main__":
    main()
