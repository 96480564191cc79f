"""The laws every back end is held to, shared by the tests and ``avsreplay backends --check NAME``.

A back end may state what it achieves on an exact scan as a class attribute ``accuracy`` (degrees, share of the
target's extent); it is held to that, or to 0.1 deg and a thousandth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array, Pose, exp
from avsreplay.records import Alignment, AlignStatus, Surface
from avsreplay.register.facing import Camera
from avsreplay.register.params import RegisterParams
from avsreplay.register.port import load
from avsreplay.register.proving import plate_scan, proving_pose, proving_surface, view
from avsreplay.register.registrar import Registrar

__all__ = ["LAWS", "Bench", "Finding", "check"]

POINTS = 3000
ACCURACY = (0.1, 1e-3)  # deg and share of the extent, for a back end that states none of its own
SAME_RAD, SAME_OF_EXTENT = np.radians(0.01), 5e-5  # equal but for rounding and the stopping rule
MOVE = Pose(exp([0.9, 0.4, -1.3]), np.array([-3.0, 2.0, 1.0]))
SEED = 20


@dataclass(frozen=True, slots=True)
class Finding:
    """What a law found: its name, whether it held and, in one line, the figures."""

    law: str
    held: bool
    detail: str


class Bench:
    """One back end at the proving ground. ``scale`` 1 is a 6.5 m target; the laws are the same at any scale."""

    def __init__(self, backend: str, scale: float = 1.0) -> None:
        self.params = RegisterParams(backend=backend)
        self.scale = scale
        self.surface = proving_surface(scale)
        self.T_ac = proving_pose(scale)
        self.scan = self.T_ac.apply(view(self.surface, POINTS, self.T_ac.inverse().t))
        self.guess = self.T_ac @ Pose(
            exp(np.radians([2.0, -1.5, 1.0])), self.surface.extent * np.array([0.006, -0.005, 0.004])
        )
        self.accuracy: tuple[float, float] = getattr(load(backend), "accuracy", ACCURACY)
        self.registrar = Registrar(self.surface, self.params)

    def fresh(self, surface: Surface | None = None) -> Registrar:
        """Another registrar with the same parameters."""
        return Registrar(surface if surface is not None else self.surface, self.params)

    def gap(self, T_a: Pose, T_b: Pose) -> tuple[float, float]:
        """Rotation [rad] and translation [share of the extent] between two poses of {C}."""
        step = T_a.inverse() @ T_b
        return float(geometry.angle(step.q)), float(np.linalg.norm(step.t)) / self.surface.extent


def recovers(bench: Bench) -> Finding:
    """An exact scan, the guess a few degrees off, comes back to the true pose."""
    return _aligned_near(
        "recovers the exact pose", bench, bench.registrar.register(bench.scan, bench.guess), bench.T_ac
    )


def stays(bench: Bench) -> Finding:
    """Begun at the true pose it stays there."""
    return _aligned_near("stays at the true pose", bench, bench.registrar.register(bench.scan, bench.T_ac), bench.T_ac)


def inverse(bench: Bench) -> Finding:
    """T_ac carries the model's points onto the scan, and T_ca, its inverse, the scan onto the model."""
    found = bench.registrar.register(bench.scan, bench.guess)
    there = found.T_ac.apply(view(bench.surface, POINTS, bench.T_ac.inverse().t))
    off = float(np.sqrt(np.mean(np.sum((there - bench.scan) ** 2, axis=1)))) / bench.surface.extent
    back = bench.gap(found.T_ac.inverse().inverse(), found.T_ac)
    held = off < 2.0 * (np.radians(bench.accuracy[0]) + bench.accuracy[1]) and max(back) < 1e-12
    return Finding("T_ac carries the model onto the scan", held, f"rms {off:.1e} of the extent")


def camera_moved(bench: Bench) -> Finding:
    """Scan and guess moved together in {A}: the pose moves with them. The camera does not, so its place is not told."""
    registrar = Registrar(bench.surface, replace(bench.params, camera=Camera.NONE))
    still = registrar.register(bench.scan, bench.guess)
    moved = registrar.register(MOVE.apply(bench.scan), MOVE @ bench.guess)
    return _same("moving the scan and the guess moves the pose", bench, MOVE @ still.T_ac, moved.T_ac)


def model_moved(bench: Bench) -> Finding:
    """The model given in another frame: the pose is of that frame. A sampled or gridded model may differ a little."""
    motion = Pose(MOVE.q, bench.scale * MOVE.t)
    other = replace(bench.surface, vertices=motion.apply(bench.surface.vertices), sha256="moved")
    moved = bench.fresh(other).register(bench.scan, bench.guess @ motion.inverse())
    return _aligned_near("a model in another frame gives the same target", bench, moved, bench.T_ac @ motion.inverse())


def order(bench: Bench) -> Finding:
    """The order of the points in a scan does not matter."""
    shuffled = bench.scan[np.random.default_rng(SEED).permutation(len(bench.scan))]
    first, second = (bench.registrar.register(scan, bench.guess).T_ac for scan in (bench.scan, shuffled))
    return _same("the order of points does not matter", bench, first, second)


def views(bench: Bench) -> Finding:
    """A strided view, or single precision, gives the pose that contiguous doubles give."""
    wide = np.zeros((len(bench.scan), 5), dtype=np.float32)
    wide[:, 1:4] = bench.scan
    plain = bench.registrar.register(wide[:, 1:4].astype(np.float64), bench.guess).T_ac
    return _same(
        "strided single precision is taken", bench, plain, bench.registrar.register(wide[:, 1:4], bench.guess).T_ac
    )


def repeats(bench: Bench) -> Finding:
    """Two runs, and a second registrar, give the same bits."""
    runs = [r.register(bench.scan, bench.guess) for r in (bench.registrar, bench.registrar, bench.fresh())]
    bits = {(run.T_ac.q.tobytes(), run.T_ac.t.tobytes(), run.iterations, run.inliers) for run in runs}
    return Finding("runs repeat to the bit", len(bits) == 1, f"{len(bits)} different results of 3")


def far(bench: Bench) -> Finding:
    """A scan ten extents away overlaps nothing."""
    away = bench.scan + 10.0 * bench.surface.extent
    return _refused("far apart is no overlap", bench.registrar.register(away, bench.guess), AlignStatus.NO_OVERLAP)


def planar(bench: Bench) -> Finding:
    """A plane leaves two slides and a turn free, and is not called aligned."""
    found = bench.registrar.register(bench.T_ac.apply(plate_scan(bench.scale)), bench.T_ac)
    words = found.status is not AlignStatus.DEGENERATE or found.weakest != ""
    finding = _refused("a plane is degenerate", found, AlignStatus.DEGENERATE, AlignStatus.NOT_CONVERGED)
    return replace(finding, held=finding.held and words)


def collinear(bench: Bench) -> Finding:
    """A line of points is not called aligned."""
    line = bench.T_ac.apply(plate_scan(bench.scale)[:30].repeat(4, axis=0))
    return _refused("a line is not aligned", bench.registrar.register(line, bench.T_ac))


def few(bench: Bench) -> Finding:
    """One, two and five points are not called aligned."""
    found = [bench.registrar.register(bench.scan[:k], bench.T_ac) for k in (1, 2, 5)]
    return replace(_refused("a handful of points is not aligned", found[-1]), held=all(map(_honest, found)))


def empty(bench: Bench) -> Finding:
    """No points, or none finite, is said so and keeps the guess."""
    found = [bench.registrar.register(scan, bench.guess) for scan in (np.empty((0, 3)), np.full((50, 3), np.nan))]
    held = all(a.status is AlignStatus.NO_POINTS and max(bench.gap(a.T_ac, bench.guess)) < 1e-12 for a in found)
    return Finding("an empty scan is no points", held, found[0].status.value)


def not_finite(bench: Bench) -> Finding:
    """Points that are not finite change nothing."""
    dirty = np.insert(bench.scan, [10, 500, 500], [[np.nan, 0, 0], [np.inf, 0, 0], [0, -np.inf, 0]], axis=0)
    clean = bench.registrar.register(bench.scan, bench.guess)
    return _same(
        "points that are not finite change nothing",
        bench,
        clean.T_ac,
        bench.registrar.register(dirty, bench.guess).T_ac,
    )


Law = Callable[[Bench], Finding]
LAWS: tuple[Law, ...] = (
    recovers,
    stays,
    inverse,
    camera_moved,
    model_moved,
    order,
    views,
    repeats,
    far,
    planar,
    collinear,
    few,
    empty,
    not_finite,
)


def check(backend: str, scale: float = 1.0) -> tuple[Finding, ...]:
    """Every law's finding. Raises UsageError for an unknown back end, MissingBackend where it is not installed."""
    bench = Bench(backend, scale)
    return tuple(law(bench) for law in LAWS)


def _aligned_near(law: str, bench: Bench, found: Alignment, truth: Pose) -> Finding:
    turn, shift = bench.gap(truth, found.T_ac)
    near = np.degrees(turn) < bench.accuracy[0] and shift < bench.accuracy[1]
    held = found.status is AlignStatus.ALIGNED and bool(near)
    return Finding(law, held, f"{found.status.value}, {np.degrees(turn):.1e} deg, {shift:.1e} of the extent")


def _same(law: str, bench: Bench, first: Pose, second: Pose) -> Finding:
    turn, shift = bench.gap(first, second)
    return Finding(
        law, turn < SAME_RAD and shift < SAME_OF_EXTENT, f"{np.degrees(turn):.1e} deg, {shift:.1e} of the extent"
    )


def _honest(found: Alignment) -> bool:
    finite: Array = np.isfinite(found.T_ac.matrix)
    return found.status is not AlignStatus.ALIGNED and bool(finite.all())


def _refused(law: str, found: Alignment, *allowed: AlignStatus) -> Finding:
    held = _honest(found) and (not allowed or found.status in allowed)
    return Finding(law, held, f"{found.status.value}{': ' + found.weakest if found.weakest else ''}")
