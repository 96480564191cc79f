"""Processor time of the estimator's parts.

``python tests/benchmarks/estimate_speed.py [--quick] [--scans] [--cases] [--long N] [--log LOG]``.
Each figure is the least of five repeats, so that other load on the machine matters little.
``--scans``: instead, the time of estimator and monitors scan by scan over whole runs with simulated
poses, mean and largest, the least of three repeats of each scan. ``--cases``: that of the estimator
in cases of ``estimate_surprises.py``, the least of three runs. ``--log LOG``: that of estimator and
monitors in replays of a log, the least of three repeats of each scan. ``--long N``: as ``--scans``
over a log of N scans at 10 Hz, by part of the log, for a tumbling body (the filter takes over), for
a spin about the axis of the largest moment (it stays with the fit), and for one about that of the
middle moment. The last is unstable: the rounding of the simulated motion, 1e-18 rad/s, grows 18
times in 100 s and turns the body over after 1,200 s.
"""

from __future__ import annotations

from avsreplay import arithmetic

if __name__ == "__main__":
    # as the command does: the waiting of OpenBLAS's second thread would count as processor time
    arithmetic.pin()

import argparse
import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import estimate_surprises as surprises
import numpy as np
import tumbling

from avsreplay import geometry
from avsreplay.estimate import Estimator, EstimatorParams, Prediction, Track
from avsreplay.estimate.batch import FitParams, Poses, fit
from avsreplay.estimate.batch_schedule import CHECK_GROWTH, FEWEST_TO_CHECK
from avsreplay.estimate.chart import to_chart
from avsreplay.estimate.dynamics import rotation_history
from avsreplay.estimate.initialise import weak_prior
from avsreplay.estimate.params import Constraint, Start
from avsreplay.monitor.convergence import (
    Consistency,
    ConsistencyParams,
    Convergence,
    ConvergenceParams,
)
from avsreplay.monitor.fault_detection import FaultDetector, FaultParams
from avsreplay.pipeline import Monitors, PlannedTime
from avsreplay.records import Alignment, Belief, ScanStatus
from avsreplay.run import Job, Run


def least(run: Callable[[], object], count: int) -> float:
    """Seconds of one run: least mean over five repeats of ``count``."""
    best = np.inf
    for _ in range(5):
        begun = time.process_time()
        for _ in range(count):
            run()
        best = min(best, (time.process_time() - begun) / count)
    return best


def tracked(params: EstimatorParams, scans: int) -> tuple[Estimator, Track, Prediction, Alignment]:
    """An estimator so many scans on at 5 Hz, its window full, all poses remembered, and the scan
    that is next.
    """
    world = tumbling.draw(4, seconds=0.2 * scans, hz=5.0)
    rng = np.random.Generator(np.random.PCG64(0))
    seen = [tumbling.alignment(x.T_ac, rng, 0.005, 0.005) for x in world.states]
    times = [round(t * 1e9) for t in world.times]
    estimator = Estimator(params, Belief(0, world.states[0], np.eye(20) * 1e-6), 2.0)
    track = estimator.initial(0, seen[0].T_ac)
    for t_ns, alignment in zip(times[:-1], seen[:-1], strict=True):
        prediction = estimator.predict(track, t_ns)
        track = estimator.update(track, prediction, estimator.innovate(prediction, alignment), 1)
    return estimator, replace(track, since=0), estimator.predict(track, times[-1]), seen[-1]


def scan_us(name: str, params: EstimatorParams, count: int) -> dict[str, float]:
    """Parts of a scan, with 200 poses remembered; no fit is due."""
    estimator, track, prediction, seen = tracked(params, 200)
    if track.mode != "filter":
        raise SystemExit("the filter does not speak")
    innovation, t_ns = estimator.innovate(prediction, seen), prediction.belief.t_ns
    parts = {
        "predict": 1e6 * least(lambda: estimator.predict(track, t_ns), count),
        "innovate": 1e6 * least(lambda: estimator.innovate(prediction, seen), count),
        f"update ({name})": (
            1e6 * least(lambda: estimator.update(track, prediction, innovation, 1), count)
        ),
    }
    return parts | {f"predict + update ({name})": parts["predict"] + parts[f"update ({name})"]}


def ahead_us(count: int) -> dict[str, float]:
    """What the planner asks."""
    estimator, track, _, _ = tracked(EstimatorParams(start=Start.NEAR), 20)
    times, many = np.linspace(5.0, 30.0, 6), np.linspace(0.0, 60.0, 100)
    path = estimator.motion(track.belief)
    return {
        "forecast 30 s": 1e6 * least(lambda: estimator.forecast(track.belief, times), count),
        "new path": 1e6 * least(lambda: estimator.motion(track.belief)(times[3:4]), count),
        "path, 100 times": 1e6 * least(lambda: path(many), count),
    }


def audit_ms(scans: int) -> tuple[float, float]:
    """An audit of the filter with so many poses remembered, and its share of each scan until the
    next [ms].
    """
    estimator, track, _, _ = tracked(EstimatorParams(start=Start.NEAR), scans)
    due = replace(track, since=len(track.fixes))
    whole = 1e3 * least(lambda: estimator.batch.checked(due), 1)
    return whole, whole / max(FEWEST_TO_CHECK, CHECK_GROWTH * len(track.fixes))


def fit_s(n: int, seconds: float) -> tuple[float, float, int]:
    """Time of one linearisation and of a fit from near, over n poses; its steps."""
    world = tumbling.draw(4, seconds=seconds, hz=(n - 1) / seconds)
    rng = np.random.Generator(np.random.PCG64(1))
    seen = [tumbling.alignment(x.T_ac, rng, 0.01, np.radians(1.0)) for x in world.states]
    poses = Poses(
        world.times,
        np.array([a.T_ac.q for a in seen]),
        np.array([a.T_ac.t for a in seen]),
        np.array([a.covariance for a in seen]),
    )
    prior = weak_prior(poses, EstimatorParams().resolved(2.0))
    start = to_chart(world.states[0]).moved(
        np.repeat([5e-3, 2e-4, 5e-3, 1e-4, 0.05, 0.02], [3, 3, 3, 3, 5, 3])
    )
    once = least(lambda: rotation_history(world.states[0], world.times), 2)
    begun = time.process_time()
    fitted = fit(poses, start, prior, FitParams())
    off = float(
        geometry.angle(
            geometry.multiply(geometry.conjugate(fitted.x.T_ac.q), world.states[0].T_ac.q)
        )
    )
    if off > 0.05:
        raise SystemExit("the fit did not find the motion")
    return once, time.process_time() - begun, fitted.steps


RUNS = (
    (2.0, 80.0, 0.1),
    (5.0, 120.0, 0.1),
    (10.0, 60.0, 0.1),
    (10.0, 100.0, 0.3),
)  # hz, seconds, rad/s


def run_ms(world: tumbling.World) -> np.ndarray:
    """(n, 2) milliseconds of estimator and monitors for each scan of a cold start."""
    rng = np.random.Generator(np.random.PCG64(6))
    seen = [tumbling.alignment(x.T_ac, rng, 0.002, np.radians(0.1)) for x in world.states]
    estimator, detector = (
        Estimator(EstimatorParams(correlated_share=0.1), None, 4.0),
        FaultDetector(FaultParams(), 4.0),
    )
    monitors = Monitors(
        Consistency(ConsistencyParams()),
        Convergence(ConvergenceParams(), 4.0, (0.01, 0.005, 0.035)),
    )
    state, track, spent = monitors.initial(np.ones(20)), estimator.initial(0, seen[0].T_ac), []
    # no search for reference cycles among the simulated poses, which are none of the estimator's
    # objects
    gc.freeze()
    for t, alignment in zip(world.times, seen, strict=True):
        begun = time.process_time()
        prediction = estimator.predict(track, round(t * 1e9))
        innovation = estimator.innovate(prediction, alignment)
        examined = detector.examine(ScanStatus.OK, alignment, innovation, prediction.belief)
        track, finding = estimator.step(
            track, prediction, innovation, examined.admission, state.convergence.converged
        )
        middle = time.process_time()
        state, _ = monitors.observe(
            state,
            estimator,
            prediction,
            alignment,
            innovation,
            int(finding.used),
            track,
            estimator.published(track),
            PlannedTime(False, lambda: 30.0),
            np.zeros(3),
        )
        spent.append((1e3 * (middle - begun), 1e3 * (time.process_time() - middle)))
    return np.array(spent)


def whole_runs() -> None:
    """Mean and largest time of a scan over whole runs."""
    for hz, seconds, rate in RUNS:
        world = tumbling.draw(1, seconds=seconds, hz=hz, rate=rate, sigma_max=0.85)
        least_ms = np.min([run_ms(world) for _ in range(3)], axis=0)
        both = least_ms.sum(axis=1)
        print(
            f"{len(both)} scans at {hz:.0f} Hz, {rate} rad/s: estimator {least_ms[:, 0].mean():.2f}"
            f" ms, at most {least_ms[:, 0].max():.0f}; with monitors {both.mean():.2f} ms, at most"
            f" {both.max():.0f}, {both[-len(both) // 3 :].mean():.2f} ms over the last third",
            flush=True,
        )


def cases() -> None:
    """Mean and largest time of a scan of the estimator in cases that its model does not contain."""
    for name in (
        "clean",
        "constant torque",
        "random torque and force 3",
        "random torque and force 1e-4",
        "a quarter",
    ):
        case = next(c for c in surprises.CASES if c.name.startswith(name))
        runs = [surprises.run(case, 3001) for _ in range(3)]
        mean, worst = min(r.seconds / len(r.t) for r in runs), min(r.worst_ms for r in runs)
        print(f"{case.name}: {1e3 * mean:.2f} ms a scan, at most {worst:.0f}", flush=True)


def long_runs(scans: int, repeats: int) -> None:
    """Mean, 99.9 % point and largest time of a scan of the estimator, by part of a long log."""
    for name, order in (
        ("tumbling", None),
        ("spin, largest moment", 2),
        ("spin, middle moment", 1),
    ):
        world = tumbling.draw(1, seconds=0.1 * (scans - 1), hz=10.0, sigma_max=0.85)
        if order is not None:
            first = replace(world.states[0], w_b=0.1 * np.eye(3)[np.argsort(world.moments)[order]])
            world = replace(world, states=tumbling.follow(world.times, world.moments, first))
        spent = np.min([run_ms(world) for _ in range(repeats)], axis=0)
        edges = [0, *(k for k in (100, 300, 1000, 3000, 10000, 30000) if k < scans), scans]
        for begin, end in pairwise(edges):
            part, both = spent[begin:end, 0], spent[begin:end].sum(axis=1)
            print(
                f"{name}, scans {begin} to {end}: estimator {part.mean():.2f} ms,"
                f" {np.quantile(part, 0.999):.1f} (99.9 %), at most {part.max():.1f}; with monitors"
                f" {both.mean():.2f}",
                flush=True,
            )


def replay_ms(log: Path, assignments: Sequence[str], repeats: int) -> None:
    """Mean and largest time of a scan of estimator and monitors in replays of a log."""
    spent, inside = [0.0, 0.0], [False]

    def timed(cls: type, name: str, place: int) -> None:
        original = getattr(cls, name)

        def found(*args, **named):
            if inside[0]:
                return original(*args, **named)
            inside[0], begun = True, time.process_time()
            try:
                return original(*args, **named)
            finally:
                spent[place] += time.process_time() - begun
                inside[0] = False

        setattr(cls, name, found)

    for name in ("predict", "determined", "innovate", "step"):
        timed(Estimator, name, 0)
    timed(Monitors, "observe", 1)
    runs = []
    for _ in range(repeats):
        with Run(Job(source=log, assignments=tuple(assignments), prefetch=0)) as run:
            each = []
            for _ in run.rows():
                each.append(tuple(spent))
                spent[:] = 0.0, 0.0
        runs.append(each)
    least_ms = 1e3 * np.min(runs, axis=0)
    estimator, both = least_ms[:, 0], least_ms.sum(axis=1)
    print(
        f"{len(both)} scans: estimator {estimator.mean():.2f} ms, at most {estimator.max():.1f};"
        f" with monitors {both.mean():.2f} ms, at most {both.max():.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="fewer repeats, no fit over 5,000 poses"
    )
    parser.add_argument("--scans", action="store_true", help="times scan by scan over whole runs")
    parser.add_argument("--long", type=int, metavar="N", help="times over a log of N scans")
    parser.add_argument(
        "--repeats",
        type=int,
        default=1,
        help="repeats of --long; the least time of each scan counts",
    )
    parser.add_argument(
        "--cases", action="store_true", help="times in cases of estimate_surprises.py"
    )
    parser.add_argument("--log", type=Path, metavar="LOG", help="times in replays of a log")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="settings of --log"
    )
    given = parser.parse_args()
    if given.log:
        replay_ms(given.log, given.set, max(3, given.repeats))
        return
    if given.cases:
        cases()
        return
    if given.long:
        long_runs(given.long, given.repeats)
        return
    if given.scans:
        whole_runs()
        return
    quick = given.quick
    count, near = 50 if quick else 400, EstimatorParams(start=Start.NEAR)
    parts = scan_us("gain", replace(near, constraint=Constraint.GAIN), count) | scan_us(
        "chart", near, count
    )
    for name, value in (parts | ahead_us(count // 10)).items():
        print(f"{name:24s} {value:8.1f} us")
    for scans in (200,) if quick else (200, 500, 1000):
        whole, share = audit_ms(scans)
        print(f"audit over {scans:4d} poses: {whole:6.1f} ms, amortised {share:.2f} ms a scan")
    for n, seconds in ((200, 100.0),) if quick else ((200, 100.0), (600, 120.0), (5000, 1000.0)):
        once, whole, steps = fit_s(n, seconds)
        print(
            f"fit of {n:5d} poses over {seconds:6.0f} s: {whole:6.3f} s, {steps} steps; rotation"
            f" {1e3 * once:.1f} ms"
        )


if __name__ == "__main__":
    main()
