"""The laws that every back end must satisfy, used by the tests and by ``avsreplay backends --check
NAME``.

They are checked on a small target made of formulas, within the accuracy on an exact scan that the
back end states. The abilities that a back end may have besides ``align`` have laws as well; the
defaults of the base class satisfy them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array, Pose, exp
from avsreplay.parts import LawResult
from avsreplay.records import Alignment, AlignStatus, Fit, Surface
from avsreplay.register.backend import (
    Target,
    aligned,
    create_backend,
    load_backend,
)
from avsreplay.register.params import Camera, RegisterParams
from avsreplay.register.registrar import Registrar
from avsreplay.register.sampling import sample
from avsreplay.register.surface_index import SurfaceIndex
from avsreplay.register.visibility import Visibility

SCAN_POINTS = 3000
# equal except for rounding and the stopping rule
STOPPED_RAD = np.radians(0.01)
STOPPED_OF_EXTENT = 5e-5
MOVE = Pose(exp([0.9, 0.4, -1.3]), np.array([-3.0, 2.0, 1.0]))
SEED = 20
# step in shares of the extent; relative error, mostly of points at edges
HESSIAN_STEP = 1e-4
HESSIAN_WITHIN = 0.03

# centre [m], edge lengths [m], rotation vector [rad] of each box: disjoint, all different, no
# symmetry
BOXES = (
    ((0.0, 0.0, 0.0), (2.0, 1.6, 2.4), (0.0, 0.0, 0.0)),
    ((2.6, 0.2, 0.3), (2.2, 0.5, 0.12), (0.3, 0.0, 0.1)),
    ((-0.3, -1.5, 0.8), (0.7, 0.5, 0.9), (0.2, 0.4, -0.3)),
    ((0.2, 0.4, 1.9), (0.5, 0.3, 0.8), (0.0, 0.5, 0.2)),
    ((-1.6, 0.5, -0.6), (0.6, 0.9, 0.4), (-0.4, 0.1, 0.6)),
)
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
FACES = np.array([(a, b, c) for p, q, r, s in QUADS for a, b, c in ((p, q, r), (p, r, s))])


class Bench:
    """One back end with the target and the scan of the laws.

    Args:
        backend: entry-point name.
        scale: size of the target; 1 is 6.5 m. The laws are the same at any scale.
    """

    def __init__(self, backend: str, scale: float = 1.0) -> None:
        self.params = RegisterParams(backend=backend)
        self.scale = scale
        self.surface = boxes(scale)
        self.T_ac = example_pose(scale)
        self.scan = self.T_ac.apply(view(self.surface, SCAN_POINTS, self.T_ac.inverse().t))
        self.guess = self.T_ac @ Pose(
            exp(np.radians([2.0, -1.5, 1.0])),
            self.surface.extent * np.array([0.006, -0.005, 0.004]),
        )
        self._factory = load_backend(backend)
        self.accuracy = self._factory.accuracy
        self.registrar = Registrar(self.surface, self.params)

    def fit(
        self,
        T_ac: Pose,
        rough: bool = False,
    ) -> Fit | str:
        """Return what the back end itself gives for the scan, or the text of its failure.

        Args:
            T_ac: pose to begin with.
            rough: use ``align_roughly``.
        """
        limits = self.params.limits(self.surface.extent)
        visibility = Visibility(self.surface, self.params.camera)
        index = SurfaceIndex.build(visibility.surface, limits.reach_m)
        target = Target(visibility.surface, index, limits, visibility)
        backend = create_backend(self.params, self._factory, target)
        align = backend.align_roughly if rough else backend.align
        return aligned(self.params.backend, lambda: align(self.scan, T_ac.inverse()))

    def fresh(
        self, surface: Surface | None = None, params: RegisterParams | None = None
    ) -> Registrar:
        """Return a new registrar, with the same parameters unless others are given."""
        return Registrar(surface if surface is not None else self.surface, params or self.params)

    def gap(self, T_a: Pose, T_b: Pose) -> tuple[float, float]:
        """Return the rotation [rad] and translation [share of the extent] between two poses
        of {C}.
        """
        step = T_a.inverse() @ T_b
        return float(geometry.angle(step.q)), float(np.linalg.norm(step.t)) / self.surface.extent


def recovers(bench: Bench) -> LawResult:
    """An exact scan is registered to the true pose from a guess a few degrees off."""
    return _aligned_near(
        "recovers the exact pose",
        bench,
        bench.registrar.register(bench.scan, bench.guess),
        bench.T_ac,
    )


def stays(bench: Bench) -> LawResult:
    """Started at the true pose it stays there."""
    return _aligned_near(
        "stays at the true pose",
        bench,
        bench.registrar.register(bench.scan, bench.T_ac),
        bench.T_ac,
    )


def inverse(bench: Bench) -> LawResult:
    """T_ac carries points of the model onto the scan, and its inverse carries the scan onto the
    surface.
    """
    found = bench.registrar.register(bench.scan, bench.guess)
    there = found.T_ac.apply(view(bench.surface, SCAN_POINTS, bench.T_ac.inverse().t))
    off = _rms(np.linalg.norm(there - bench.scan, axis=1)) / bench.surface.extent
    back = (
        _rms(bench.registrar.distance(bench.scan, found.T_ac, bench.surface.extent))
        / bench.surface.extent
    )
    held = bool(max(off, back) < 2.0 * (np.radians(bench.accuracy[0]) + bench.accuracy[1]))
    detail = f"rms {off:.1e} of the extent, inverse {back:.1e}"
    return LawResult("T_ac carries the model onto the scan", held, detail)


def information(bench: Bench) -> LawResult:
    """The information is the Hessian of half the sum of squared distances over the variance, by
    finite differences.
    """
    sigma = 1e-3 * bench.surface.extent
    found = bench.fresh(params=replace(bench.params, noise_m=sigma)).register(
        bench.scan, bench.guess
    )
    scale = np.repeat([1.0 / bench.surface.extent, 1.0], 3)
    H = _hessian(bench, found.T_ac) / sigma**2
    error, size = (float(np.linalg.norm(A * np.outer(scale, scale))) for A in (found.info - H, H))
    held = found.status is AlignStatus.ALIGNED and error < HESSIAN_WITHIN * size
    detail = f"relative difference {error / size:.1e}" if size > 0.0 else found.status.value
    return LawResult("the information is the Hessian of the cost", held, detail)


def camera_moved(bench: Bench) -> LawResult:
    """Moving scan and guess together in {A} moves the pose with them.

    The camera position is not used.
    """
    registrar = bench.fresh(params=replace(bench.params, camera=Camera.NONE))
    still = registrar.register(bench.scan, bench.guess)
    moved = registrar.register(MOVE.apply(bench.scan), MOVE @ bench.guess)
    return _same(
        "moving the scan and the guess moves the pose", bench, MOVE @ still.T_ac, moved.T_ac
    )


def model_moved(bench: Bench) -> LawResult:
    """With the model in another frame the pose is of that frame.

    A sampled or gridded model may differ slightly.
    """
    motion = Pose(MOVE.q, bench.scale * MOVE.t)
    other = replace(bench.surface, vertices=motion.apply(bench.surface.vertices), sha256="moved")
    moved = bench.fresh(other).register(bench.scan, bench.guess @ motion.inverse())
    return _aligned_near(
        "a model in another frame gives the same target",
        bench,
        moved,
        bench.T_ac @ motion.inverse(),
    )


def order(bench: Bench) -> LawResult:
    """The order of the points in a scan does not matter."""
    shuffled = bench.scan[np.random.default_rng(SEED).permutation(len(bench.scan))]
    first, second = (
        bench.registrar.register(scan, bench.guess).T_ac for scan in (bench.scan, shuffled)
    )
    return _same("the order of points does not matter", bench, first, second)


def views(bench: Bench) -> LawResult:
    """A strided view, or single precision, gives the same pose as contiguous double precision."""
    wide = np.zeros((len(bench.scan), 5), dtype=np.float32)
    wide[:, 1:4] = bench.scan
    plain = bench.registrar.register(wide[:, 1:4].astype(np.float64), bench.guess).T_ac
    strided = bench.registrar.register(wide[:, 1:4], bench.guess).T_ac
    return _same("strided single precision is accepted", bench, plain, strided)


def repeats(bench: Bench) -> LawResult:
    """Two runs, and a second registrar, give identical bits."""
    runs = [
        r.register(bench.scan, bench.guess)
        for r in (bench.registrar, bench.registrar, bench.fresh())
    ]
    bits = {
        (run.T_ac.q.tobytes(), run.T_ac.t.tobytes(), run.iterations, run.inliers) for run in runs
    }
    said = f"{len(bits)} different results of 3" if len(bits) > 1 else "3 equal results"
    return LawResult("runs repeat to the bit", len(bits) == 1, said)


def roughly(bench: Bench) -> LawResult:
    """A rough alignment that converged is as exact as any other."""
    law = "a rough alignment that converged is exact"
    return _ability(law, bench, bench.guess, rough=True)


def far(bench: Bench) -> LawResult:
    """A scan ten extents away has no overlap."""
    away = bench.scan + 10.0 * bench.surface.extent
    return _refused(
        "far apart is no overlap",
        bench.registrar.register(away, bench.guess),
        AlignStatus.NO_OVERLAP,
    )


def planar(bench: Bench) -> LawResult:
    """A plane leaves two translations and a rotation unobservable, and is not called aligned."""
    found = bench.registrar.register(bench.T_ac.apply(plate_scan(bench.scale)), bench.T_ac)
    words = found.status is not AlignStatus.DEGENERATE or found.free_directions != ""
    finding = _refused(
        "a plane is degenerate", found, AlignStatus.DEGENERATE, AlignStatus.NOT_CONVERGED
    )
    return replace(finding, held=finding.held and words)


def collinear(bench: Bench) -> LawResult:
    """A line of points is not called aligned."""
    line = bench.T_ac.apply(plate_scan(bench.scale)[:30].repeat(4, axis=0))
    return _refused("a line is not aligned", bench.registrar.register(line, bench.T_ac))


def few(bench: Bench) -> LawResult:
    """One, two and five points are not called aligned."""
    found = [bench.registrar.register(bench.scan[:k], bench.T_ac) for k in (1, 2, 5)]
    return replace(
        _refused("a handful of points is not aligned", found[-1]), held=all(map(_honest, found))
    )


def empty(bench: Bench) -> LawResult:
    """A scan without a finite point has the status NO_POINTS and keeps the guess."""
    found = [
        bench.registrar.register(scan, bench.guess)
        for scan in (np.empty((0, 3)), np.full((50, 3), np.nan))
    ]
    held = all(
        a.status is AlignStatus.NO_POINTS and max(bench.gap(a.T_ac, bench.guess)) < 1e-12
        for a in found
    )
    return LawResult("an empty scan is no points", held, found[0].status.value)


def not_finite(bench: Bench) -> LawResult:
    """Points that are not finite change nothing."""
    dirty = np.insert(
        bench.scan, [10, 500, 500], [[np.nan, 0, 0], [np.inf, 0, 0], [0, -np.inf, 0]], axis=0
    )
    clean, found = (
        bench.registrar.register(scan, bench.guess).T_ac for scan in (bench.scan, dirty)
    )
    return _same("points that are not finite change nothing", bench, clean, found)


Law = Callable[[Bench], LawResult]
LAWS: tuple[Law, ...] = (
    recovers,
    stays,
    inverse,
    information,
    camera_moved,
    model_moved,
    order,
    views,
    repeats,
    roughly,
    far,
    planar,
    collinear,
    few,
    empty,
    not_finite,
)


def check(backend: str, scale: float = 1.0) -> tuple[LawResult, ...]:
    """Check every law.

    Args:
        backend: entry-point name.
        scale: size of the target; 1 is 6.5 m.

    Returns:
        One finding per law.

    Raises:
        UsageError: unknown back end.
        MissingBackend: its library is not installed.
    """
    bench = Bench(backend, scale)
    return tuple(law(bench) for law in LAWS)


def boxes(scale: float = 1.0) -> Surface:
    """Return the target of the laws in {C}: five boxes with outward faces, about 6.5 m
    overall at scale 1.
    """
    parts = [
        Pose(exp(turn), np.array(centre)).apply(CORNERS * np.array(size))
        for centre, size, turn in BOXES
    ]
    vertices = scale * np.vstack(parts)
    faces = np.vstack([FACES + 8 * k for k in range(len(BOXES))]).astype(np.int32)
    return Surface(vertices, faces, "five boxes", hashlib.sha256(vertices.tobytes()).hexdigest())


def example_pose(scale: float = 1.0) -> Pose:
    """Return a T_ac with no special angles, the target 6 m (at scale 1) in front of the camera."""
    return Pose(exp([0.3, -0.7, 2.0]), scale * np.array([0.2, 0.1, 6.0]))


def view(surface: Surface, count: int, camera_c: Array) -> Array:
    """Return exact points (n, 3) in {C} of the faces that face a camera there; faces do not
    hide each other.
    """
    points, normals = sample(surface, count)
    sight = camera_c - points
    facing: Array = points[
        np.einsum("ij,ij->i", normals, sight) > 0.1 * np.linalg.norm(sight, axis=1)
    ]
    return facing


def plate_scan(scale: float = 1.0) -> Array:
    """Return (900, 3) points inside the top face of the first box, in {C}: a plane and
    nothing else.
    """
    u, v = np.meshgrid(np.linspace(-0.6, 0.6, 30), np.linspace(-0.45, 0.45, 30))
    return scale * np.stack([u.ravel(), v.ravel(), np.full(u.size, 1.2)], axis=1)


def _hessian(bench: Bench, T_ac: Pose) -> Array:
    """(6, 6) second differences of half the sum of squared distances [m^2] in d of T_ac_true = T_ac
    @ Exp(d).
    """
    h = HESSIAN_STEP * np.repeat([1.0, bench.surface.extent], 3)

    def cost(d: Array) -> float:
        distance = bench.registrar.distance(
            bench.scan, T_ac @ Pose(exp(d[:3]), d[3:]), bench.surface.extent
        )
        return 0.5 * float(distance @ distance)

    H = np.empty((6, 6))
    for i, j in np.ndindex(6, 6):
        a, b = np.eye(6)[i] * h, np.eye(6)[j] * h
        H[i, j] = (cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / (4.0 * h[i] * h[j])
    return H


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _aligned_near(law: str, bench: Bench, found: Alignment, truth: Pose) -> LawResult:
    turn, shift = bench.gap(truth, found.T_ac)
    near = np.degrees(turn) < bench.accuracy[0] and shift < bench.accuracy[1]
    held = found.status is AlignStatus.ALIGNED and bool(near)
    return LawResult(
        law, held, f"{found.status.value}, {np.degrees(turn):.1e} deg, {shift:.1e} of the extent"
    )


def _ability(law: str, bench: Bench, start: Pose, **how: Any) -> LawResult:
    """The pose is exact, or the back end states that it did not converge."""
    fit = bench.fit(start, **how)
    if isinstance(fit, str):
        return LawResult(law, False, fit)
    turn, shift = bench.gap(bench.T_ac, fit.T_ca.inverse())
    near = bool(np.degrees(turn) < bench.accuracy[0] and shift < bench.accuracy[1])
    detail = f"{np.degrees(turn):.1e} deg, {shift:.1e} of the extent, converged {fit.converged}"
    return LawResult(law, near or not fit.converged, detail)


def _same(law: str, bench: Bench, first: Pose, second: Pose) -> LawResult:
    turn, shift = bench.gap(first, second)
    held = bool(turn < STOPPED_RAD and shift < STOPPED_OF_EXTENT)
    return LawResult(law, held, f"{np.degrees(turn):.1e} deg, {shift:.1e} of the extent")


def _honest(found: Alignment) -> bool:
    finite: Array = np.isfinite(found.T_ac.matrix)
    return found.status is not AlignStatus.ALIGNED and bool(finite.all())


def _refused(law: str, found: Alignment, *allowed: AlignStatus) -> LawResult:
    held = _honest(found) and (not allowed or found.status in allowed)
    return LawResult(
        law,
        held,
        f"{found.status.value}{': ' + found.free_directions if found.free_directions else ''}",
    )
