"""Which hypothesis explains a run of large innovations: manoeuvre, sensor error, bad scans, or none of these.

The pose of a free body is continuous and its velocity constant but for small disturbances. A step in the velocity with
a continuous pose is therefore a manoeuvre; a step in the pose that the velocity does not explain is an error of the
sensor; scans that contradict one another are bad. All are linear in their unknowns about the predicted trajectory, so
the marginal likelihood of the innovations is Gaussian in closed form: the generalised likelihood ratio of Willsky and
Jones (IEEE Trans. Automatic Control 21, 1976) with a Gaussian prior on the size of the change, which makes hypotheses
with different numbers of unknowns comparable (Basseville and Nikiforov, Detection of Abrupt Changes, 1993).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from avsreplay.estimate.dynamics import advance, flows, process_noise, rotation_history, transition
from avsreplay.estimate.error_state import RHO, VEL, rotation
from avsreplay.estimate.measurement import innovation_vector, measured_pose, measurement_jacobian
from avsreplay.estimate.noise import cholesky_root, correlated_noise
from avsreplay.estimate.relative_orbit import OrbitArc, RelativeOrbit
from avsreplay.estimate.track import Epoch
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Belief

PRIOR_ODDS = math.log(1e-3)  # prior log odds of every hypothesis relative to free motion with good scans
_PER_BAD_SCAN = math.log(1e-2)
_INSTANTS, _FEWER, _LONG = 8, 4, 9  # instants tried for a manoeuvre between two scans; fewer in a window of _LONG scans
_LONGEST_SPREAD = 6  # latest scans over whose intervals a manoeuvre that is not instantaneous may extend
_TAIL = 0.05  # probability that a manoeuvre is earlier, or later, than the interval in which it is allowed for
_SCALES = (1.0, 0.1)  # of the prior standard deviations: a large or a small change
_CHANGES = (slice(0, 3), slice(3, 6), slice(0, 6))  # rate, velocity, both
_OFFSETS = (slice(6, 7), slice(0, 3), slice(0, 6))  # range, position, pose
_SPREAD = (0.7, 0.1, 0.1, 0.1)  # prior share of manoeuvres at one instant, and over one, two and three intervals
_ZERO, _NO_COVARIANCE = frozen(np.zeros(6)), frozen(np.zeros((6, 6)))


class Hypothesis(Enum):
    """What explains a run of scans."""

    FREE_MOTION = "free_motion"
    MANOEUVRE = "manoeuvre"
    SENSOR_BIAS = "sensor_bias"
    FROZEN = "frozen"  # the sensor repeats an old scan
    BAD_SCANS = "bad_scans"


@dataclass(frozen=True, slots=True)
class ChangePriors:
    """1 sigma of the size of a change: rate [rad/s], velocity [m/s], position [m] and half angle of a sensor error."""

    rate_radps: float
    velocity_mps: float
    position_m: float
    half_angle: float


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """A hypothesis with its most likely parameters.

    Attributes:
        log_evidence: log of the marginal likelihood times the prior odds.
        chi2: squared norm of the whitened residuals of the innovations, ``dof`` of them.
        onset: index of the first affected scan.
        after_s: instant of a manoeuvre after the first scan's prior belief [s], with its standard deviation.
        size, P: (6,) (rate, velocity) of a manoeuvre or the offset of a sensor bias, with its covariance (6, 6).
        changes_s: instants of free changes of the velocity: the ends of the 90 % interval of the instant, or two in
            each interval between scans over which a manoeuvre extends.
    """

    hypothesis: Hypothesis
    log_evidence: float
    chi2: float
    dof: int
    onset: int
    after_s: float = 0.0
    after_1s_s: float = 0.0
    size: Array = field(default_factory=lambda: _ZERO)
    P: Array = field(default_factory=lambda: _NO_COVARIANCE)
    changes_s: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """Innovations y (6n,) about the trajectory predicted from the belief before the window.

    ``C`` (6n, 6n) is their covariance without a change, ``whiten`` the inverse of its Cholesky factor.
    """

    times_s: Array
    y: Array
    C: Array
    whiten: Array
    rows: Array  # (n, 6, 20) H Phi from the start of the window
    poses: tuple[Pose, ...]
    R: tuple[Array, ...]
    R_ba: tuple[Array, ...]


def explain(
    epochs: Sequence[Epoch],
    first_doubtful: int,
    priors: ChangePriors,
    torque: float,
    force: float,
    orbit: RelativeOrbit | None = None,
) -> list[Explanation]:
    """All hypotheses on a window of scans, most likely first.

    Args:
        epochs: consecutive measured scans, ``first_doubtful`` of them accepted, the others in doubt.
        first_doubtful: index of the first doubtful scan, 1 at least.
        priors: 1 sigma of the size of a change.
        torque: root density of the angular disturbance [rad/s^1.5].
        force: root density of the linear disturbance [m/s^1.5].
        orbit: the relative orbit of the target; None for free motion.
    """
    start = epochs[0].track.belief
    window = _window(epochs, start, torque, force, None if orbit is None else orbit.at(start.t_ns))
    white = window.whiten @ window.y
    free = -0.5 * float(white @ white) + float(np.log(np.diagonal(window.whiten)).sum())
    n = len(epochs)
    found = [
        Explanation(Hypothesis.FREE_MOTION, free, float(white @ white), 6 * n, n),
        _manoeuvre(window, start, white, free, priors, n),
        _sensor_bias(window, white, free, priors, n),
        _bad_scans(window, priors, first_doubtful, n),
        _frozen(window, first_doubtful, n),
    ]
    return sorted(found, key=lambda e: -e.log_evidence)


def _window(epochs: Sequence[Epoch], start: Belief, torque: float, force: float, arc: OrbitArc | None) -> _Window:
    n, x = len(epochs), start.x
    times = np.array([(e.prediction.belief.t_ns - start.t_ns) * 1e-9 for e in epochs])
    y, rows, back, poses, R_ba = np.empty((n, 6)), np.empty((n, 6, 20)), np.empty((n, 20, 20)), [], []
    for k, (epoch, step, t) in enumerate(zip(epochs, flows(x.w_b, x.sigma, times, torque), times, strict=True)):
        then, Phi = advance(x, step, t, arc), transition(step, x.sigma, t, arc)
        poses.append(measured_pose(epoch.prediction.belief.x, epoch.innovation.alpha))
        y[k] = innovation_vector(then, poses[-1])
        rows[k] = measurement_jacobian(then) @ Phi
        inverse = np.linalg.inv(Phi)
        back[k] = start.P + inverse @ process_noise(step, t, force) @ inverse.T  # what the noise at the start would be
        R_ba.append(rotation(then.q_ab).T)
    C = ((rows @ back).reshape(6 * n, 20) @ rows.reshape(6 * n, 20).T).reshape(n, 6, n, 6)
    earlier = np.arange(n)[:, None] < np.arange(n)  # scans i before j: the noise until i is what they have in common
    C = np.where(earlier.T[:, None, :, None], C.transpose(2, 3, 0, 1), C)
    innovations = [e.innovation for e in epochs]
    R = tuple(i.R for i in innovations)
    flat = C.reshape(6 * n, 6 * n) + correlated_noise(R, [i.share for i in innovations])
    flat = 0.5 * (flat + flat.T)
    whiten = np.asarray(np.linalg.inv(cholesky_root(flat)), dtype=np.float64)
    return _Window(times, y.reshape(-1), flat, whiten, rows, tuple(poses), R, tuple(R_ba))


def _evidence(white: Array, free: float, M: Array, scale: Array) -> tuple[float, Array, Array]:
    """Log evidence, mean and covariance of the unknowns u ~ N(0, scale^2) in white = M u + N(0, 1)."""
    A, b = M.T @ M * np.outer(scale, scale) + np.eye(len(scale)), scale * (M.T @ white)
    inverse = np.linalg.inv(A)
    v = inverse @ b
    value = free + 0.5 * float(b @ v) - 0.5 * float(np.linalg.slogdet(A)[1])
    return value, scale * v, np.outer(scale, scale) * (0.5 * (inverse + inverse.T))


def _mixed(M: Array, white: Array, scale: Array, kinds: Sequence[slice]) -> Array:
    """(k,) log evidence over free motion of unknowns with columns M (k, m, n), the mean over kinds and prior widths.

    A single prior that is wide in all directions would hide a small change of the velocity alone from few scans.
    """
    Mt = np.swapaxes(M, 1, 2)
    G, g = Mt @ M, Mt @ white
    found = []
    for kind in kinds:
        for factor in _SCALES:
            s = factor * scale[kind]
            A = G[:, kind, kind] * np.outer(s, s) + np.eye(len(s))
            b = g[:, kind] * s
            v = np.linalg.solve(A, b[:, :, None])[:, :, 0]
            found.append(0.5 * (b * v).sum(axis=1) - 0.5 * np.linalg.slogdet(A)[1])
    return np.asarray(np.logaddexp.reduce(found, axis=0) - math.log(len(found)))


def _manoeuvre(window: _Window, start: Belief, white: Array, free: float, priors: ChangePriors, n: int) -> Explanation:
    """A change of rate and velocity: at one instant, or spread over one to three intervals between scans.

    A thrust or an impact that is not instantaneous is a sum of changes, two in each interval, so that both the velocity
    and the pose at the end of the interval are free. All instants are marginalised for the evidence; the explanation is
    the most likely, with rate and velocity free.
    """
    count = _INSTANTS if n < _LONG else _FEWER
    edges = np.concatenate([[0.0], window.times_s[: n - 1]])
    lengths = np.diff(np.append(edges, window.times_s[-1]))
    instants = (edges[:, None] + lengths[:, None] * ((np.arange(count) + 0.5) / count)).reshape(-1)
    columns = _after_changes(window, start, instants)
    scale = np.repeat([priors.rate_radps, priors.velocity_mps], 3)
    single = free + _mixed(columns, white, scale, _CHANGES)
    k = int(np.argmax(single))
    found = [replace(_changes(instants[[k]], columns[[k]], white, free, scale), log_evidence=float(single[k]))]
    two = count * np.arange(max(0, n - _LONGEST_SPREAD), n)[:, None] + np.array([count // 8, count - 1 - count // 8])
    evidence = [_log_mean(single.tolist())]
    for m in range(1, len(_SPREAD)):
        chosen = [two[k : k + m].reshape(-1) for k in range(len(two) + 1 - m)]
        if not chosen:
            evidence.append(-math.inf)
            continue
        values = free + _joint(columns, white, scale, np.array(chosen))
        evidence.append(_log_mean(values.tolist()))
        c = chosen[int(np.argmax(values))]
        found.append(_changes(instants[c], columns[c], white, free, scale))
    best = max(found, key=lambda f: f.log_evidence)
    total = float(np.logaddexp.reduce(np.log(_SPREAD) + evidence))
    after_s, step = best.after_s, float(lengths.max())
    spread = math.hypot(best.after_1s_s, step / math.sqrt(12.0))
    if len(best.changes_s) == 1:
        weight = np.exp(single - single.max())
        after_s = float(weight @ instants / weight.sum())
        variance = float(weight @ (instants - after_s) ** 2 / weight.sum())
        spread = math.hypot(math.sqrt(max(variance, 0.0)), step / count / math.sqrt(12.0))
        share = np.cumsum(weight) / weight.sum()
        ends = instants[np.minimum(np.searchsorted(share, [_TAIL, 1.0 - _TAIL]), len(instants) - 1)]
        best = replace(best, changes_s=tuple(np.unique(ends).tolist()))
    onset = int(np.searchsorted(window.times_s, best.changes_s[0], side="right"))
    return replace(best, log_evidence=total + PRIOR_ODDS, onset=onset, after_s=after_s, after_1s_s=spread)


def _after_changes(window: _Window, start: Belief, instants: Array) -> Array:
    """Derivatives (k, 6n, 6) of the whitened innovations by a change of (rate, velocity) at each instant (k,) [s]."""
    back = np.linalg.inv(rotation_history(start.x, instants).S[:, :, :6])[:, :, 3:]
    tau, n = instants[:, None, None, None], len(window.times_s)
    M = np.empty((len(instants), n, 6, 6))
    M[..., :3] = window.rows[:, :, :6] @ back[:, None]
    M[..., 3:] = window.rows[:, :, VEL] - tau * window.rows[:, :, RHO]
    M *= window.times_s[:, None, None] > tau
    return np.asarray(window.whiten @ M.reshape(-1, 6 * n, 6))


def _joint(columns: Array, white: Array, scale: Array, chosen: NDArray[np.int64]) -> Array:
    """(k,) log evidence over free motion of changes at several instants ``chosen`` (k, m), as in ``_changes``."""
    first = int(chosen.min())
    used = columns[first : int(chosen.max()) + 1] * scale
    count, size = len(used), chosen.shape[1] * used.shape[2]
    M = used.transpose(1, 0, 2).reshape(len(white), -1)
    G, g = (M.T @ M).reshape(count, 6, count, 6), (M.T @ white).reshape(count, 6)
    at = chosen - first
    A = G[at[:, :, None], :, at[:, None, :]].transpose(0, 1, 3, 2, 4).reshape(-1, size, size) + np.eye(size)
    b = g[at].reshape(-1, size)
    v = np.linalg.solve(A, b[:, :, None])[:, :, 0]
    return np.asarray(0.5 * (b * v).sum(axis=1) - 0.5 * np.linalg.slogdet(A)[1])


def _changes(instants: Array, columns: Array, white: Array, free: float, scale: Array) -> Explanation:
    """Changes at given instants; size and P are those of their sum, ``after_s`` their mean weighted by size."""
    m = len(columns)
    M = np.hstack(list(columns))
    value, u, P = _evidence(white, free, M, np.tile(scale, m))
    left = white - M @ u
    joined = np.tile(np.eye(6), m)
    share = np.linalg.norm(u.reshape(m, 6) / scale, axis=1)
    share = share / max(float(share.sum()), 1e-300)
    after_s = float(share @ instants)
    return Explanation(
        Hypothesis.MANOEUVRE,
        value,
        float(left @ left),
        len(white) - 6 * m,
        0,
        after_s,
        math.sqrt(float(share @ (instants - after_s) ** 2)),
        joined @ u,
        joined @ P @ joined.T,
        tuple(instants.tolist()),
    )


def _log_mean(values: Sequence[float]) -> float:
    return float(np.logaddexp.reduce(values)) - math.log(len(values))


def _sensor_bias(window: _Window, white: Array, free: float, priors: ChangePriors, n: int) -> Explanation:
    """A constant offset of the pose in {A} from one of the scans on: of its range, its position, or all of it."""
    half = priors.half_angle
    scale = np.concatenate([np.repeat([priors.position_m, half], 3), [priors.position_m]])
    M = np.zeros((n, 6, 7))
    for k, (pose, R_ba) in enumerate(zip(window.poses, window.R_ba, strict=True)):
        M[k, :3, :3], M[k, 3:, 3:6] = np.eye(3), R_ba
        M[k, :3, 6] = pose.t / max(float(np.linalg.norm(pose.t)), 1e-300)
    since = np.arange(n)[None, :] >= np.arange(1, n)[:, None]
    columns = window.whiten @ (M * since[:, :, None, None]).reshape(n - 1, 6 * n, 7)
    values = free + _mixed(columns, white, scale, _OFFSETS)
    onset = int(np.argmax(values)) + 1
    whitened = columns[onset - 1][:, :6]
    _, u, P = _evidence(white, free, whitened, scale[:6])
    left = white - whitened @ u
    evidence = _log_mean(values.tolist()) + PRIOR_ODDS
    return Explanation(Hypothesis.SENSOR_BIAS, evidence, float(left @ left), 6 * n - 6, onset, size=u, P=P)


def _bad_scans(window: _Window, priors: ChangePriors, first: int, n: int) -> Explanation:
    """Every doubtful scan has an error of its own."""
    C = window.C.copy()
    extra = np.repeat([priors.position_m, priors.half_angle], 3) ** 2
    for k in range(first, n):
        C[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += np.diag(extra)
    value, chi2 = _gaussian(window.y, C)
    value += PRIOR_ODDS + _PER_BAD_SCAN * (n - first)
    return Explanation(Hypothesis.BAD_SCANS, value, chi2, 6 * n, first)


def _frozen(window: _Window, first: int, n: int) -> Explanation:
    """The doubtful scans repeat the last accepted one: their poses equal its pose."""
    value, chi2 = _gaussian(window.y[: 6 * first], window.C[: 6 * first, : 6 * first])
    for k in range(first, n):
        away = _difference(window.poses[k], window.poses[first - 1], window.R_ba[k])
        part, size = _gaussian(away, 2.0 * window.R[k])
        value, chi2 = value + part, chi2 + size
    return Explanation(Hypothesis.FROZEN, value + PRIOR_ODDS, chi2, 6 * n, first)


def _difference(a: Pose, b: Pose, R_ba: Array) -> Array:
    """(6,) difference of two poses: metres in {A} and half angle in {B}."""
    turn = (a @ b.inverse()).q
    half = turn[:3] if turn[3] >= 0.0 else -turn[:3]
    return np.concatenate([a.t - b.t, R_ba @ half])


def _gaussian(y: Array, C: Array) -> tuple[float, float]:
    """Log density of N(0, C) at y without its constant, and the squared whitened norm."""
    root = cholesky_root(C)
    white = np.linalg.solve(root, y)
    chi2 = float(white @ white)
    return -0.5 * chi2 - float(np.log(np.diagonal(root)).sum()), chi2
