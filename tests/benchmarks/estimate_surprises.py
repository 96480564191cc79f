"""The estimator under conditions that its model does not contain.

``python tests/benchmarks/estimate_surprises.py [--bodies 20] [--cases name,name] [--poses]
[--without] [--free]``.

Each case is a random tumbling body of 4 m extent, seen at 2 Hz from a cold start, with poses
simulated by a registration-noise model: white noise of 2 mm and 0.1 deg per axis, a tenth of its
variance correlated over 0.4 rad of rotation. The events: manoeuvres, sensor biases, a constant
torque, a noise burst, spins about a principal axis, a body at rest. Printed per case: scans from
the event to the first flagged one, manoeuvres found, the error of the reported size in its own
sigma, the scans until the error is below its limit for good, the scans that claim convergence
although an error is above its limit, and the final error. The limit is a Mahalanobis distance of
4.7 in each of the blocks position, attitude, velocity and rate (probability 6e-5 a block).

``--hz``, ``--rate``, ``--velocity`` and ``--turn`` set the scan rate, the rate of the body and the
sizes of the steps. ``--poses`` simulates the log of a tracker (``avsreplay run --backend poses``):
the errors are white, and the expected changes of the motion are those of poses at this interval.
"""

from __future__ import annotations

from avsreplay import arithmetic

if __name__ == "__main__":
    # as the command does: the waiting of OpenBLAS's second thread would count as processor time
    arithmetic.pin()

import argparse
import gc
import time
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
import tumbling
from scipy.stats import chi2

from avsreplay import geometry
from avsreplay.estimate import Estimator, EstimatorParams, Track
from avsreplay.estimate.chart import ARM, ETA, INERTIA, RATE, to_chart, to_errors
from avsreplay.estimate.dynamics import after_change
from avsreplay.estimate.error_state import RHO, VEL
from avsreplay.estimate.measurement import innovation_vector, measurement_jacobian
from avsreplay.estimate.track import in_doubt
from avsreplay.geometry import Array, Pose
from avsreplay.monitor.convergence import (
    Consistency,
    ConsistencyParams,
    Convergence,
    ConvergenceParams,
    violations,
)
from avsreplay.monitor.fault_detection import FaultDetector, FaultParams
from avsreplay.records import Alignment, AlignStatus, Belief, Manoeuvre, ScanStatus, State

NEES_S = (40.0, 60.0, 80.0)
HEADS = (
    "case",
    "scans to the first flag: median, worst (bodies)",
    "manoeuvres",
    "scans to the report: median, worst",
    "drifts: bodies, size, 1 sigma, onset (medians)",
    "largest size error, largest time error [1 sigma], time error, median",
    "scans to recover: median, worst",
    "scans converged beyond the limit: any block; position, attitude, velocity, rate",
    "bodies converged ever, at the end",
    "final error, median",
    "worst",
    "reasons",
    "failed checks",
    "ms a scan",
    "worst ms",
    "grasp 1 sigma, last 10 s [mm]",
    "claimed over true error during the event: position, attitude, velocity",
    f"NEES at {NEES_S} s, mean: all, attitude, rate, inertia, arm, position, velocity",
    "share of these inside the 95 % band",
    "t_1, median [s]",
)
NEES_DOF = np.array([20, 3, 3, 5, 3, 3, 3])  # of the blocks of nees_of
LIMIT = 4.7  # Mahalanobis distance of a block with 3 degrees of freedom above which it is wrong
EXTENT, POS_M, ROT_RAD, LATER_S = 4.0, 0.002, np.radians(0.1), 0.2  # LATER_S: of a step after at_s
# of the task [m, m/s, rad]: the claims that are counted are those of an error of 1 % of the extent
TOLERANCE = 0.01 * EXTENT, 0.002 * EXTENT, np.radians(3.0)


@dataclass(frozen=True, slots=True)
class Case:
    """An event: when, and what it does to the body or to the sensor."""

    name: str
    at_s: float = 45.0
    until_s: float = 1e9
    seconds: float = 80.0
    velocity: float = 0.0  # step [m/s]
    rate: float = 0.0  # step [rad/s]
    torque: float = 0.0  # constant, per unit inertia [rad/s2]
    random: tuple[float, float] = (
        0.0,
        0.0,
    )  # root densities of random torque [rad/s^1.5] and force [m/s^1.5]
    bias: float = 0.0  # along the line of sight [m]
    noise: float = 1.0  # factor on sigma, not reported by the registration
    spin: int | None = None  # about this principal axis; 3 for that of the middle moment
    speed: float = 0.1  # rad/s
    hz: float = 2.0
    wrong: float = 0.0  # share of the poses that are 0.1 m (1 sigma of each component) off
    correlated: float = (
        0.1  # share of the variance of the poses that neighbouring scans have in common
    )
    tracker: bool = False  # the poses are those of a tracker


CASES = (
    Case("clean"),
    Case("bias 0.15 m, first 10 s", at_s=0.0, until_s=10.0, bias=0.15),
    Case("bias 0.15 m, first 2 s", at_s=0.0, until_s=2.0, bias=0.15),
    Case("velocity step 1 cm/s", velocity=0.01),
    Case("rate step 0.01 rad/s", rate=0.01),
    Case("constant torque 1e-4", torque=1e-4),
    Case("random torque and force 1e-5", random=(1e-5, 1e-5)),
    Case("random torque and force 3e-5", random=(3e-5, 3e-5)),
    Case("random torque and force 1e-4", random=(1e-4, 1e-4)),
    Case("bias 3 cm from 40 s to the end", at_s=40.0, bias=0.03),
    Case("bias 3 cm from 60 s to the end", at_s=60.0, bias=0.03),
    Case("bias 5 cm from 40 to 55 s", at_s=40.0, until_s=55.0, bias=0.05),
    Case("bias 5 cm from 60 to 75 s", at_s=60.0, until_s=75.0, bias=0.05, seconds=100.0),
    Case("bias 1 cm from 45 s to the end", bias=0.01),
    Case("bias 1.5 cm from 45 s to the end", bias=0.015),
    Case("noise x5 for 20 s", at_s=40.0, until_s=60.0, noise=5.0),
    Case("single outlier 0.1 m", at_s=45.0, until_s=45.4, bias=0.1),
    Case("a quarter of the poses 0.1 m off", wrong=0.25),
    Case("spin about axis x", spin=0, seconds=150.0),
    Case("spin about axis y", spin=1, seconds=150.0),
    Case("spin about axis z", spin=2, seconds=150.0),
    Case("spin about the middle axis", spin=3),
    Case("at rest", speed=1e-6),
)


@dataclass(slots=True)
class Result:
    """One body: per scan time, gamma, reason, converged, error and claimed sigma; manoeuvres
    at the end.
    """

    t: list[float] = field(default_factory=list)
    gamma: list[int] = field(default_factory=list)
    reason: list[str] = field(default_factory=list)
    converged: list[bool] = field(default_factory=list)
    apart: list[Array] = field(default_factory=list)  # Mahalanobis distances of the four blocks
    error: list[tuple[float, float]] = field(default_factory=list)
    grasp: list[float] = field(default_factory=list)
    nees: list[list[float]] = field(default_factory=list)
    squares: list[Array] = field(
        default_factory=list
    )  # (2, 3) claimed and true, of position, attitude, velocity
    violations: list[str] = field(default_factory=list)
    failed_at: list[float] = field(default_factory=list)  # times of these checks [s]
    track: Track | None = None
    seconds: float = 0.0
    worst_ms: float = 0.0
    axes: dict[int, Array] = field(default_factory=dict)  # q_bc at each report, by its instant [ns]
    step_s: float = 0.0  # instant of a step of rate or velocity
    true_velocity: Array = field(default_factory=lambda: np.zeros(3))
    true_rate: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def pose(self) -> Array:
        """(n,) the larger distance of position and attitude."""
        return np.array(self.apart)[:, :2].max(axis=1)


def world_of(case: Case, seed: int) -> tuple[list[float], list[State], Array, Array]:
    """Times, true states, true changes of velocity in {A} and of rate in {C}."""
    rng = np.random.Generator(np.random.PCG64([seed, 5]))
    world = tumbling.draw(seed, seconds=case.seconds, hz=case.hz, rate=case.speed, sigma_max=0.85)
    x0, dv, dw = world.states[0], np.zeros(3), np.zeros(3)
    if case.spin is not None:
        axis = int(np.argsort(world.moments)[1]) if case.spin == 3 else case.spin
        x0 = replace(x0, w_b=case.speed * np.eye(3)[axis])
        return list(world.times), tumbling.follow(world.times, world.moments, x0), dv, dw
    if case.torque:
        direction = tumbling.random_direction(rng)
        states, x, part = [x0], x0, 10
        for _ in world.times[1:]:
            for _ in range(part):
                push = case.torque * direction / (case.hz * part)
                x = tumbling.follow(
                    np.array([0.0, 1.0 / (case.hz * part)]),
                    world.moments,
                    replace(x, w_b=x.w_b + push),
                )[-1]
            states.append(x)
        return list(world.times), states, dv, dw
    if any(case.random):
        states, x, part = [x0], x0, 4
        sizes = case.random[0] * world.moments.sum() / world.moments, case.random[1]
        for _ in world.times[1:]:
            for _ in range(part):
                dw, dv = (size * rng.normal(size=3) / np.sqrt(case.hz * part) for size in sizes)
                pushed = replace(x, w_b=x.w_b + dw, v_a=x.v_a + dv)
                x = tumbling.follow(np.array([0.0, 1.0 / (case.hz * part)]), world.moments, pushed)[
                    -1
                ]
            states.append(x)
        return list(world.times), states, np.zeros(3), np.zeros(3)
    if not (case.velocity or case.rate):
        return list(world.times), world.states, dv, dw
    at = case.at_s + LATER_S
    before = world.times[world.times <= at]
    dv, dw = (
        case.velocity * tumbling.random_direction(rng),
        case.rate * tumbling.random_direction(rng),
    )
    x = tumbling.follow(np.array([0.0, at]), world.moments, x0)[-1]
    pushed = replace(x, v_a=x.v_a + dv, w_b=x.w_b + dw)
    rest = world.times[len(before) :]
    later = tumbling.follow(np.append(0.0, rest - at), world.moments, pushed)[1:]
    return (
        list(world.times),
        world.states[: len(before)] + later,
        dv,
        geometry.matrix(x.q_bc).T @ dw,
    )


def measured(case: Case, times: list[float], states: list[State], seed: int) -> list[Alignment]:
    """Noisy poses: white noise, and a part that stays while the view turns little."""
    rng = np.random.Generator(np.random.PCG64([seed, 6]))
    sigma = np.repeat([ROT_RAD, POS_M], 3)
    C, share, lean, out = np.diag(sigma**2), case.correlated, rng.normal(size=6), []
    for k, (t, x) in enumerate(zip(times, states, strict=True)):
        turn = float(np.linalg.norm(x.w_b)) / case.hz
        keep = np.exp(-turn / 0.4)
        lean = keep * lean + np.sqrt(1.0 - keep**2) * rng.normal(size=6) if k else lean
        event = case.at_s <= t < case.until_s
        d = sigma * (np.sqrt(1.0 - share) * rng.normal(size=6) + np.sqrt(share) * lean)
        d *= case.noise if event else 1.0
        T = x.T_ac @ Pose(geometry.exp(d[:3]), d[3:])
        if event and case.bias:
            T = Pose(T.q, T.t + case.bias * T.t / np.linalg.norm(T.t))
        if case.wrong and rng.random() < case.wrong:
            T = Pose(T.q, T.t + 0.1 * rng.normal(size=3))
        claimed = C * case.noise**2 if event else C
        out.append(
            Alignment(
                T, 5, True, 4000, 3900, 0.008, np.linalg.inv(claimed), AlignStatus.ALIGNED, claimed
            )
        )
    return out


def run(case: Case, seed: int, tested: bool = True, free: bool = False) -> Result:
    times, states, dv, dw = world_of(case, seed)
    none = {"torque_noise_radps15": 0.0, "force_noise_mps15": 0.0} if free else {}
    params = EstimatorParams(correlated_share=case.correlated, **none)
    params = params.at_interval(1.0 / case.hz, EXTENT) if case.tracker else params
    estimator = Estimator(params, None, EXTENT)
    estimator.anomalies.enabled = tested
    detector, watch = FaultDetector(FaultParams(), EXTENT), Consistency(ConsistencyParams())
    test = Convergence(ConvergenceParams(), EXTENT, TOLERANCE)
    word, seen_so_far = test.initial(), watch.initial()
    result = Result(step_s=case.at_s + LATER_S, true_velocity=dv, true_rate=dw)
    alignments = measured(case, times, states, seed)
    track = estimator.initial(0, alignments[0].T_ac)
    for t, x, alignment in zip(times, states, alignments, strict=True):
        begun = time.process_time()
        prediction = estimator.predict(track, round(t * 1e9))
        innovation = estimator.innovate(prediction, alignment)
        examined = detector.examine(ScanStatus.OK, alignment, innovation, prediction.belief)
        admission, held = examined.admission, word.converged
        track, finding = estimator.step(track, prediction, innovation, admission, held)
        verdict = detector.judge(examined, finding)
        spent = time.process_time() - begun
        result.axes |= {
            e.detected_ns: track.belief.x.q_bc
            for e in track.manoeuvres
            if e.detected_ns not in result.axes
        }
        result.seconds, result.worst_ms = result.seconds + spent, max(result.worst_ms, 1e3 * spent)
        seen_so_far = watch.observe(seen_so_far, innovation, verdict.gamma)
        window = watch.judge(seen_so_far, max(track.levels.common))
        honest = window.consistent is True and not track.window.many_outliers
        failed = ()
        found = estimator.residual_after(track, prediction, innovation) if verdict.gamma else None
        if found is not None:
            failed = violations(track.belief, *found)
        result.violations += list(failed)
        result.failed_at += [t] * len(failed)
        honest = honest and not in_doubt(track) and not failed
        forecast = estimator.track_forecast(track, np.array([30.0]))
        possible = after_change(
            track.belief, forecast.times_s, track.change_probability, track.change_P
        )
        word = test.judge(word, track.belief, forecast, honest, possible)
        published = estimator.published(track)
        score(result, t, x, published, verdict.gamma, verdict.reason.value, word.converged)
        if any(abs(t - mark) < 0.5 / case.hz for mark in NEES_S):
            result.nees.append(nees_of(published, x))
        if case.at_s <= t < case.until_s:
            result.squares.append(squares_of(published, x))
        result.grasp.append(float(forecast.pos_1s_m.max()))
    result.track = track
    return result


def score(
    result: Result, t: float, x: State, belief: Belief, gamma: int, reason: str, converged: bool
) -> None:
    """The error of the estimated pose, and the distance of each block from the truth in the claimed
    covariance.
    """
    pose, truth = belief.x.T_ac, x.T_ac
    position = float(np.linalg.norm(pose.t - truth.t))
    angle = float(geometry.angle(geometry.multiply(geometry.conjugate(truth.q), pose.q)))
    result.t.append(t)
    result.gamma.append(gamma)
    result.reason.append(reason)
    result.converged.append(converged)
    result.error.append((position, np.degrees(angle)))
    result.apart.append(apart_of(belief, x))


def apart_of(belief: Belief, truth: State) -> Array:
    """(4,) Mahalanobis distances of position and attitude of the pose, velocity, and rate in {C}
    from the truth.
    """
    H, here = measurement_jacobian(belief.x), to_chart(belief.x)
    alpha, S = innovation_vector(belief.x, truth.T_ac), H @ belief.P @ H.T
    T = to_errors(here)
    rate, P = to_chart(truth).minus(here)[RATE], np.linalg.solve(T, np.linalg.solve(T, belief.P).T)
    blocks = (
        (alpha[:3], S[:3, :3]),
        (alpha[3:], S[3:, 3:]),
        (truth.v_a - belief.x.v_a, belief.P[VEL, VEL]),
        (rate, P[RATE, RATE]),
    )
    return np.sqrt([max(float(e @ np.linalg.solve(C, e)), 0.0) for e, C in blocks])


def wrong_rows(result: Result) -> Array:
    """(5,) converged scans with an error above its limit in any block, then in each one."""
    over = np.array(result.apart)[np.array(result.converged)] > LIMIT
    return np.concatenate([[over.any(axis=1).sum()], over.sum(axis=0)])


def squares_of(belief: Belief, truth: State) -> Array:
    """(2, 3) claimed variance and squared error of the pose's position, its attitude, and the
    velocity.
    """
    H, pose = measurement_jacobian(belief.x), belief.x.T_ac
    S = H @ belief.P @ H.T
    claimed = np.trace(S[:3, :3]), 4.0 * np.trace(S[3:, 3:]), np.trace(belief.P[VEL, VEL])
    angle = geometry.angle(geometry.multiply(geometry.conjugate(truth.T_ac.q), pose.q))
    apart = np.sum((pose.t - truth.T_ac.t) ** 2), angle**2, np.sum((belief.x.v_a - truth.v_a) ** 2)
    return np.array([claimed, apart])


def nees_of(belief: Belief, truth: State) -> list[float]:
    """NEES per degree of freedom of all states, then of each block in coordinates without an order
    of the axes.
    """
    here = to_chart(belief.x)
    T, y = to_errors(here), to_chart(truth).minus(here)
    P = np.linalg.solve(T, np.linalg.solve(T, belief.P).T)
    found = [(y, P)] + [(y[b], P[b, b]) for b in (ETA, RATE, INERTIA, ARM)]
    d = T @ y
    found += [(d[b], belief.P[b, b]) for b in (RHO, VEL)]
    return [float(e @ np.linalg.solve(C, e)) / len(e) for e, C in found]


def inside_band(nees: Array) -> Array:
    """Share of the values (bodies, instants, blocks) of NEES per degree of freedom in the two-sided
    95 % band.
    """
    low, high = chi2.ppf([[0.025], [0.975]], NEES_DOF) / NEES_DOF
    return ((nees >= low) & (nees <= high)).mean(axis=(0, 1))


def line(case: Case, results: list[Result]) -> str:
    """One row of the table."""
    after = [
        next(
            k
            for k, t in enumerate(r.t)
            if t >= case.at_s and (not (case.velocity or case.rate) or t > case.at_s)
        )
        for r in results
    ]
    if case.bias and case.until_s < 1e9 and case.at_s == 0.0:
        after = [next(k for k, t in enumerate(r.t) if t >= case.until_s) for r in results]
    delay = [
        next((k - a for k in range(a, len(r.t)) if not r.gamma[k]), None)
        for r, a in zip(results, after, strict=True)
    ]
    back = []
    for r, a in zip(results, after, strict=True):
        bad = [k for k in range(a, len(r.t)) if r.apart[k].max() > LIMIT]
        back.append(bad[-1] + 1 - a if bad else 0)
    wrong = sum(wrong_rows(r) for r in results)
    final = np.array([r.error[-1] for r in results])
    found = [r.track.manoeuvres if r.track else () for r in results]
    reasons = Counter(reason for r in results for reason in r.reason if reason != "ok")
    first = [d for d in delay if d is not None]
    claim = sum(any(r.converged) for r in results)
    end = sum(r.converged[-1] for r in results)
    cells = [
        case.name,
        f"{_middle(first)} ({len(first)}/{len(results)})",
        str(sum(map(len, found))),
        _middle(
            [
                _scans_to_report(r, a)
                for r, a in zip(results, after, strict=True)
                if r.track.manoeuvres
            ]
        ),
        _drifts(results),
        _sizes(results, found),
        _middle(back),
        f"{wrong[0]}; {', '.join(map(str, wrong[1:]))} of {sum(sum(r.converged) for r in results)}",
        f"{claim}, {end}",
        f"{1e3 * np.median(final[:, 0]):.1f} mm {np.median(final[:, 1]):.2f} deg",
        f"{1e3 * final[:, 0].max():.0f} mm {final[:, 1].max():.2f} deg",
        ", ".join(f"{reason} {n}" for reason, n in sorted(reasons.items())),
        ", ".join(
            f"{n} {k}" for k, n in sorted(Counter(v for r in results for v in r.violations).items())
        )
        or "0",
        f"{1e3 * sum(r.seconds for r in results) / sum(len(r.t) for r in results):.2f}",
        f"{max(r.worst_ms for r in results):.0f}",
        f"{1e3 * np.median([max(r.grasp[-20:]) for r in results]):.0f}",
        _claims(results),
        ", ".join(f"{v:.2f}" for v in np.mean([r.nees for r in results], axis=(0, 1))),
        ", ".join(f"{v:.0%}" for v in inside_band(np.array([r.nees for r in results]))),
        f"{np.median([_converged_s(r) for r in results]):.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


def _converged_s(result: Result) -> float:
    """Time of the first converged estimate [s], infinite without one."""
    return result.t[result.converged.index(True)] if any(result.converged) else float("inf")


def _claims(results: list[Result]) -> str:
    """Root of the ratio of the mean claimed variance to the mean squared error."""
    found = [np.mean(r.squares, axis=0) for r in results if r.squares]
    if not found:
        return "-"
    claimed, true = np.mean(found, axis=0)
    return ", ".join(f"{v:.2f}" for v in np.sqrt(claimed / true))


def _scans_to_report(r: Result, first: int) -> int:
    """Scans from the first one after the event, counted as 1, to the one at which the last
    manoeuvre was reported.
    """
    return int(np.searchsorted(r.t, r.track.manoeuvres[-1].detected_ns * 1e-9 - 1e-6)) - first + 1


def _drifts(results: list[Result]) -> str:
    """Bodies with a drift at the end; its torque [rad/s2] with 1 sigma and its onset [s],
    medians.
    """
    found = [r.track.drift for r in results if r.track and r.track.drift]
    if not found:
        return "0"
    size = np.median([np.linalg.norm(d.rate) for d in found])
    sigma = np.median([np.sqrt(np.trace(d.P[:3, :3])) for d in found])
    return (
        f"{len(found)}: {size:.2g} +- {sigma:.1g},"
        f" {np.median([d.t_ns * 1e-9 for d in found]):.0f} s"
    )


def _middle(values: list[int]) -> str:
    return f"{np.median(values):.0f}, {max(values)}" if values else "-"


def size_error(r: Result, event: Manoeuvre) -> float:
    """Root of NEES of the size, of the rate in {C}: the principal axes of the estimate may
    have another order.
    """
    to_c = geometry.matrix(r.axes[event.detected_ns]).T
    whole = np.kron(np.diag([1.0, 0.0]), to_c) + np.diag([0.0] * 3 + [1.0] * 3)
    d = np.concatenate([to_c @ event.rate - r.true_rate, event.velocity - r.true_velocity])
    return float(np.sqrt(d @ np.linalg.solve(whole @ event.P @ whole.T, d) / 6.0))


def _sizes(results: list[Result], found: list[tuple]) -> str:
    """Of the reported change nearest to the true one: size and time against the truth in
    sigma, and the time error.
    """
    off = []
    for r, events in zip(results, found, strict=True):
        if events and (r.true_velocity.any() or r.true_rate.any()):
            e = min(events, key=lambda e: abs(e.t_ns * 1e-9 - r.step_s))
            off.append(
                (
                    size_error(r, e),
                    abs(e.t_ns * 1e-9 - r.step_s) / e.t_1s_s,
                    abs(e.t_ns * 1e-9 - r.step_s),
                )
            )
    if not off:
        return "-"
    size, late, seconds = np.array(off).T
    return f"{size.max():.1f}, {late.max():.1f}, {np.median(seconds):.2f} s"


def main() -> None:
    gc.set_threshold(10_000)  # as the command does
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bodies", type=int, default=20)
    parser.add_argument(
        "--cases", default="", help="only those whose name contains this text, comma separated"
    )
    parser.add_argument("--first", type=int, default=0, help="seed of the first body")
    parser.add_argument("--hz", type=float, default=2.0)
    parser.add_argument("--rate", type=float, default=0.1, help="angular rate [rad/s]")
    parser.add_argument(
        "--velocity", type=float, default=0.01, help="size of the step of the velocity [m/s]"
    )
    parser.add_argument(
        "--turn", type=float, default=0.01, help="size of the step of the rate [rad/s]"
    )
    parser.add_argument("--poses", action="store_true", help="the poses are those of a tracker")
    parser.add_argument(
        "--seconds", type=float, default=None, help="duration of each case in place of its own [s]"
    )
    parser.add_argument("--without", action="store_true", help="without the test of hypotheses")
    parser.add_argument(
        "--free", action="store_true", help="the estimator is told that there are no disturbances"
    )
    given = parser.parse_args()
    print("| " + " | ".join(HEADS) + " |")
    print("|" + "---|" * len(HEADS))
    wanted = [w for w in given.cases.split(",") if w]
    for case in CASES:
        if not wanted or any(w in case.name for w in wanted):
            case = replace(case, hz=given.hz, speed=given.rate if case.speed == 0.1 else case.speed)
            case = replace(case, seconds=given.seconds or case.seconds, tracker=given.poses)
            case = replace(case, correlated=0.0 if given.poses else case.correlated)
            case = replace(
                case,
                velocity=given.velocity if case.velocity else 0.0,
                rate=given.turn if case.rate else 0.0,
            )
            seeds = range(given.first, given.first + given.bodies)
            print(
                line(case, [run(case, seed, not given.without, given.free) for seed in seeds]),
                flush=True,
            )


if __name__ == "__main__":
    main()
