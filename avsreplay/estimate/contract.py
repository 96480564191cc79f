"""The laws that every estimator must satisfy, used by the tests and by ``avsreplay estimators
--check NAME``.

They are checked on pose streams of simulated free bodies: a random inertia, arm, attitude and rate,
and poses with independent errors of a known covariance. The estimate begins at a given belief whose
error has the stated covariance, so that a filter that is linear in its errors can satisfy them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate.dynamics import propagate_state
from avsreplay.estimate.error_state import boxplus
from avsreplay.estimate.measurement import innovation_vector, measurement_jacobian
from avsreplay.estimate.params import EstimatorParams, Start
from avsreplay.estimate.plugged import AnyEstimator, estimator_of
from avsreplay.geometry import Array, Pose
from avsreplay.parts import LawResult
from avsreplay.records import Admission, Alignment, AlignStatus, Belief, State

EXTENT_M = 2.0
POSES = 80
PERIOD_S = 0.5
BODIES = 6
# errors of the simulated poses
POSITION_1S_M = 0.002
ATTITUDE_1S_RAD = np.radians(0.1)
# of the given belief, by block: half angle, rad/s, m, m/s, ratios, m, half angle
START_1S = np.repeat([0.02, 0.02, 0.02, 0.005, 0.05, 0.02, 0.02], [3, 3, 3, 3, 2, 3, 3])
SETTLED_POSES = 30  # poses after which the errors are compared with the covariance
# equal but for rounding
ROUNDING_M = 1e-6
ROUNDING_RAD = 1e-6
MEAN_NEES = (0.3, 2.5)  # allowed mean of the squared error over its variance, per direction
FORECAST_S = 10.0  # a forecast is compared with the motion this long after the last pose
SEED = 20
NS = 1_000_000_000


@value_class
class Stream:
    """Poses of one free body.

    Attributes:
        start: the given belief at the first pose.
        truth: its true states.
        alignments: the measured poses with their covariance.
        times_ns: their instants.
    """

    start: Belief
    truth: tuple[State, ...]
    alignments: tuple[Alignment, ...]
    times_ns: tuple[int, ...]


def check(name: str) -> list[LawResult]:
    """Check all laws on one estimator.

    Args:
        name: of the estimator.

    Raises:
        UsageError: no estimator has this name.
    """
    bodies = [stream(seed) for seed in range(SEED, SEED + BODIES)]
    runs = [_beliefs(name, body) for body in bodies]
    laws = (
        partial(_repeats, name, bodies[0], runs[0]),
        partial(_frame, name, bodies[0], runs[0]),
        partial(_epoch, name, bodies[0], runs[0]),
        partial(_gap, name, bodies[0]),
        partial(_accuracy, bodies, runs),
        partial(_consistency, bodies, runs),
        partial(_forecast, name, bodies),
    )
    return [law() for law in laws]


def stream(seed: int) -> Stream:
    """Return the poses of one random free body.

    Args:
        seed: of the body and of the errors of its poses.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    x = State(
        geometry.exp(rng.normal(size=3)),
        rng.normal(size=3) * 0.12,
        np.array([0.0, 0.0, 5.0]) + rng.normal(size=3),
        rng.normal(size=3) * 0.01,
        rng.uniform(-0.5, 0.5, size=2),
        rng.normal(size=3) * 0.2,
        geometry.exp(rng.normal(size=3) * 0.1),
    )
    C = np.diag(np.repeat([ATTITUDE_1S_RAD, POSITION_1S_M], 3) ** 2)
    truth = tuple(propagate_state(x, k * PERIOD_S)[0] for k in range(POSES))
    errors = rng.normal(size=(POSES, 6)) * np.sqrt(np.diagonal(C))
    measured = tuple(_measured(s.T_ac, d, C) for s, d in zip(truth, errors, strict=True))
    start = Belief(0, boxplus(x, rng.normal(size=20) * START_1S), np.diag(START_1S**2))
    return Stream(start, truth, measured, tuple(round(k * PERIOD_S * NS) for k in range(POSES)))


def _measured(T_ac: Pose, d: Array, C: Array) -> Alignment:
    """The pose with the error d, so that T_true = T_measured Exp(d), as a measurement."""
    error = Pose(geometry.exp(d[:3]), d[3:])
    return Alignment(
        T_ac=T_ac @ error.inverse(),
        iterations=0,
        converged=True,
        points=0,
        inliers=0,
        rms_m=0.0,
        info=np.diag(1.0 / np.diagonal(C)),
        status=AlignStatus.MEASURED,
        covariance=C,
    )


def _estimator(name: str, body: Stream) -> AnyEstimator:
    params = EstimatorParams(method=name, start=Start.NEAR)
    return estimator_of(params, body.start, EXTENT_M, body.times_ns[0], np.zeros(3))


def _beliefs(name: str, body: Stream, healthy: Sequence[bool] | None = None) -> list[Belief]:
    """The published belief after each pose; poses that are not healthy are only predicted."""
    estimator = _estimator(name, body)
    track = estimator.initial(body.times_ns[0], body.alignments[0].T_ac)
    found = []
    for k, (alignment, t_ns) in enumerate(zip(body.alignments, body.times_ns, strict=True)):
        prior = estimator.predict(track, t_ns)
        seen = estimator.innovate(prior, alignment)
        used = healthy is None or healthy[k]
        admission = Admission.ADMITTED if used else Admission.REFUSED
        track, _ = estimator.step(track, prior, seen if used else None, admission, False)
        found.append(estimator.published(track))
    return found


def _difference(a: Belief, b: Belief) -> tuple[float, float]:
    """Distance [m] and angle [rad] between the poses of two beliefs."""
    one, two = a.x.T_ac, b.x.T_ac
    turn = geometry.multiply(geometry.conjugate(one.q), two.q)
    return float(np.linalg.norm(one.t - two.t)), float(geometry.angle(turn))


def _same(law: str, pairs: Sequence[tuple[Belief, Belief]]) -> LawResult:
    found = np.array([_difference(a, b) for a, b in pairs])
    away, turned = found.max(axis=0).tolist()
    return LawResult(
        law,
        away <= ROUNDING_M and turned <= ROUNDING_RAD,
        f"{away:.1e} m, {turned:.1e} rad at most",
    )


def _repeats(name: str, body: Stream, run: Sequence[Belief]) -> LawResult:
    again = _beliefs(name, body)
    same = all(
        a.x.flat.tobytes() == b.x.flat.tobytes() and a.P.tobytes() == b.P.tobytes()
        for a, b in zip(run, again, strict=True)
    )
    return LawResult("the same poses give the same bytes", same, "two runs over one body")


def _frame(name: str, body: Stream, run: Sequence[Belief]) -> LawResult:
    G = Pose(geometry.exp([0.4, -0.9, 0.3]), np.array([1.0, -2.0, 0.5]))
    turned = tuple(replace(a, T_ac=G @ a.T_ac) for a in body.alignments)
    start = replace(body.start, x=_moved(body.start.x, G), P=_turned(body.start.P, G.R))
    other = _beliefs(name, replace(body, start=start, alignments=turned))
    back = [replace(b, x=_moved(b.x, G.inverse())) for b in other]
    return _same(
        "a turned and displaced camera gives the same motion", list(zip(run, back, strict=True))
    )


def _moved(x: State, G: Pose) -> State:
    """The state in another inertial frame."""
    return replace(
        x, q_ab=geometry.multiply(G.q, x.q_ab), r_a=G.apply(x.r_a[None])[0], v_a=G.R @ x.v_a
    )


def _turned(P: Array, R: Array) -> Array:
    """The covariance (20, 20) with position and velocity turned by R (3, 3)."""
    J = np.eye(20)
    J[6:9, 6:9] = J[9:12, 9:12] = R
    return np.asarray(J @ P @ J.T)


def _epoch(name: str, body: Stream, run: Sequence[Belief]) -> LawResult:
    more = 1_700_000_000 * NS
    start = replace(body.start, t_ns=body.start.t_ns + more)
    later = replace(body, start=start, times_ns=tuple(t + more for t in body.times_ns))
    return _same(
        "the origin of the clock does not matter",
        list(zip(run, _beliefs(name, later), strict=True)),
    )


def _gap(name: str, body: Stream) -> LawResult:
    """After poses that were not healthy the covariance has grown and contains the truth."""
    healthy = [k < POSES // 2 for k in range(POSES)]
    run = _beliefs(name, body, healthy)
    before, after = run[POSES // 2 - 1], run[-1]
    grown = float(np.trace(after.P[6:9, 6:9]) / np.trace(before.P[6:9, 6:9]))
    away = float(np.linalg.norm(after.x.T_ac.t - body.truth[-1].T_ac.t))
    bound = 4.0 * float(np.sqrt(np.trace(_estimator(name, body).pose_covariance(after)[:3, :3])))
    return LawResult(
        "without poses the covariance grows and contains the error",
        grown > 1.0 and away <= bound,
        f"variance {grown:.1f} times as large, error {1e3 * away:.1f} mm of {1e3 * bound:.1f} mm",
    )


def _accuracy(bodies: Sequence[Stream], runs: Sequence[Sequence[Belief]]) -> LawResult:
    away = [
        float(np.linalg.norm(run[-1].x.T_ac.t - body.truth[-1].T_ac.t))
        for body, run in zip(bodies, runs, strict=True)
    ]
    middle, limit = float(np.median(away)), POSITION_1S_M * np.sqrt(3.0)
    return LawResult(
        "the last pose is better than its measurement",
        middle < limit,
        f"median {1e3 * middle:.2f} mm, a single pose {1e3 * limit:.2f} mm",
    )


def _consistency(bodies: Sequence[Stream], runs: Sequence[Sequence[Belief]]) -> LawResult:
    squares = []
    for body, run in zip(bodies, runs, strict=True):
        for x, belief in zip(body.truth[SETTLED_POSES:], run[SETTLED_POSES:], strict=True):
            e = innovation_vector(belief.x, x.T_ac)
            S = _pose_covariance(belief)
            squares.append(float(e @ np.linalg.solve(S, e)) / 6.0)
    low, high = MEAN_NEES
    mean = float(np.mean(squares))
    return LawResult(
        "the errors agree with the covariance",
        low <= mean <= high,
        f"NEES of the pose {mean:.2f} per direction, allowed {low:g} to {high:g}",
    )


def _pose_covariance(belief: Belief) -> Array:
    H = measurement_jacobian(belief.x)
    return np.asarray(H @ belief.P @ H.T)


def _forecast(name: str, bodies: Sequence[Stream]) -> LawResult:
    inside = 0
    for body in bodies:
        estimator = _estimator(name, body)
        track = estimator.initial(body.times_ns[0], body.alignments[0].T_ac)
        for alignment, t_ns in zip(body.alignments, body.times_ns, strict=True):
            prior = estimator.predict(track, t_ns)
            seen = estimator.innovate(prior, alignment)
            track, _ = estimator.step(track, prior, seen, Admission.ADMITTED, False)
        belief = estimator.published(track)
        sigma = float(estimator.track_forecast(track, np.array([FORECAST_S])).pos_1s_m[0])
        there = estimator.motion(belief)(np.array([FORECAST_S]))[0][0]
        truth = propagate_state(body.truth[-1], FORECAST_S)[0].T_ac.t
        inside += bool(np.linalg.norm(there - truth) <= 4.0 * sigma)
    return LawResult(
        "the forecast contains the later motion",
        inside >= len(bodies) - 1,
        f"{inside} of {len(bodies)} within 4 sigma after {FORECAST_S:g} s",
    )
