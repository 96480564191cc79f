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

from avsreplay.estimate.dynamics import propagate, propagate_state
from avsreplay.estimate.error_state import VEL, W, rotation
from avsreplay.estimate.measurement import innovation_vector, measured_pose, measurement_jacobian
from avsreplay.estimate.track import Epoch
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Belief

_PRIOR_ODDS = math.log(1e-3)  # prior log odds of every hypothesis relative to free motion with good scans
_PER_BAD_SCAN = math.log(1e-2)
_INSTANTS = 8  # number of instants tried for a manoeuvre between two scans
_TWO = (1, 6)  # of these instants, those of the two changes in each interval over which a long manoeuvre extends
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
        changes_s: the instants at which a manoeuvre changes the velocity: one, or two in each interval of a long one.
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
    """Innovations y (6n,) about the trajectory predicted from the belief before the window, whitened by root."""

    times_s: Array
    y: Array
    C: Array
    rows: Array  # (n, 6, 20) H Phi from the start of the window
    poses: tuple[Pose, ...]
    R: tuple[Array, ...]
    R_ba: tuple[Array, ...]


def explain(
    epochs: Sequence[Epoch], first_doubtful: int, priors: ChangePriors, torque: float, force: float
) -> list[Explanation]:
    """All hypotheses on a window of scans, most likely first.

    Args:
        epochs: consecutive measured scans, ``first_doubtful`` of them accepted, the others in doubt.
        first_doubtful: index of the first doubtful scan, 1 at least.
        priors: 1 sigma of the size of a change.
        torque: root density of the angular disturbance [rad/s^1.5].
        force: root density of the linear disturbance [m/s^1.5].
    """
    start = epochs[0].track.belief
    window = _window(epochs, start, torque, force)
    root = cholesky_root(window.C)
    white = np.asarray(np.linalg.solve(root, window.y), dtype=np.float64)
    free = -0.5 * float(white @ white) - float(np.log(np.diagonal(root)).sum())
    n = len(epochs)
    found = [
        Explanation(Hypothesis.FREE_MOTION, free, float(white @ white), 6 * n, n),
        _manoeuvre(window, start, root, white, free, priors, n),
        _sensor_bias(window, root, white, free, priors, n),
        _bad_scans(window, priors, first_doubtful, n),
        _frozen(window, first_doubtful, n),
    ]
    return sorted(found, key=lambda e: -e.log_evidence)


def cholesky_root(C: Array) -> Array:
    """Lower Cholesky factor of a window covariance that rounding may have made indefinite.

    Args:
        C: (n, n) covariance.

    Returns:
        (n, n) factor of C; if C is indefinite, of C plus the smallest sufficient multiple of the identity.

    Raises:
        ValueError: no multiple suffices, as with a matrix that is not finite.
    """
    scale = float(np.trace(C)) / len(C)
    for k in range(-14, 1):
        try:
            return np.asarray(np.linalg.cholesky(C + (10.0**k * scale if k > -14 else 0.0) * np.eye(len(C))))
        except np.linalg.LinAlgError:
            continue
    raise ValueError("the covariance of the window is not finite")


def _window(epochs: Sequence[Epoch], start: Belief, torque: float, force: float) -> _Window:
    n = len(epochs)
    times, y = np.empty(n), np.empty((n, 6))
    rows, back, poses = np.empty((n, 6, 20)), [], []
    for k, epoch in enumerate(epochs):
        prior = epoch.prediction.belief
        times[k] = (prior.t_ns - start.t_ns) * 1e-9
        belief, Phi = propagate(start, prior.t_ns, torque, force)
        poses.append(measured_pose(prior.x, epoch.innovation.alpha))
        y[k] = innovation_vector(belief.x, poses[-1])
        rows[k] = measurement_jacobian(belief.x) @ Phi
        half = np.linalg.solve(Phi, belief.P)
        back.append(np.linalg.solve(Phi, half.T).T)  # P propagated back to the start, process noise included
    C = np.zeros((n, 6, n, 6))
    for i in range(n):
        for j in range(i, n):
            C[i, :, j] = rows[i] @ back[i] @ rows[j].T
            C[j, :, i] = C[i, :, j].T
    R_ba = tuple(rotation(propagate_state(start.x, float(t))[0].q_ab).T for t in times)
    innovations = [e.innovation for e in epochs]
    R = tuple(i.R for i in innovations)
    flat = C.reshape(6 * n, 6 * n) + correlated_noise(R, [i.share for i in innovations])
    return _Window(times, y.reshape(-1), 0.5 * (flat + flat.T), rows, tuple(poses), R, R_ba)


def correlated_noise(R: Sequence[Array], shares: Sequence[float]) -> Array:
    """Covariance (6n, 6n) of the errors of n neighbouring scans that have a share of their variance in common.

    The common part of scan k is sqrt(share_k) L_k z with one z for all scans and R_k = L_k L_k', so the covariance of
    scans i and j is sqrt(share_i share_j) L_i L_j'. The matrix is positive semidefinite for any R and shares up to 1.

    Args:
        R: (6, 6) noise of each scan.
        shares: common share of the variance of each scan, 0 to 1.
    """
    roots = [math.sqrt(share) * np.linalg.cholesky(one) for one, share in zip(R, shares, strict=True)]
    common = np.concatenate(roots)
    out: Array = common @ common.T
    for k, one in enumerate(R):
        out[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = one
    return out


def _evidence(white: Array, free: float, M: Array, scale: Array) -> tuple[float, Array, Array]:
    """Log evidence, mean and covariance of the unknowns u ~ N(0, scale^2) in white = M u + N(0, 1)."""
    precision = M.T @ M + np.diag(scale**-2.0)
    P = np.linalg.inv(precision)
    g = M.T @ white
    u = P @ g
    value = free + 0.5 * float(g @ u) - 0.5 * float(np.linalg.slogdet(precision)[1]) - float(np.log(scale).sum())
    return value, u, 0.5 * (P + P.T)


def _manoeuvre(
    window: _Window, start: Belief, root: Array, white: Array, free: float, priors: ChangePriors, n: int
) -> Explanation:
    """A change of rate and velocity: at one instant, or spread over one to three intervals between scans.

    A thrust or an impact that is not instantaneous is a sum of changes, two in each interval, so that both the velocity
    and the pose at the end of the interval are free. All instants are marginalised for the evidence; the explanation is
    the most likely.
    """
    edges = np.concatenate([[0.0], window.times_s[: n - 1]])
    lengths = np.diff(np.append(edges, window.times_s[-1]))
    instants = (edges[:, None] + lengths[:, None] * _fractions()).reshape(-1)
    columns = [_after_change(window, start, root, float(tau)) for tau in instants]
    pairs = (_INSTANTS * np.arange(n)[:, None] + np.array(_TWO)).reshape(-1)
    choices = [[[k] for k in range(len(instants))]]
    choices += [[pairs[2 * k : 2 * (k + m)].tolist() for k in range(n + 1 - m)] for m in range(1, len(_SPREAD))]
    kinds = [
        [_changes(instants[k], [columns[j] for j in k], white, free, priors) for k in chosen] for chosen in choices
    ]
    evidence = [_log_mean([f.log_evidence for f in found]) for found in kinds]
    total = _log_sum([math.log(share) + value for share, value in zip(_SPREAD, evidence, strict=True)])
    best = max((f for found in kinds for f in found), key=lambda f: f.log_evidence)
    single = [f.log_evidence for f in kinds[0]]
    weight = np.exp(np.array(single) - max(single))
    after_s, step = best.after_s, float(lengths.max())
    spread = math.hypot(best.after_1s_s, step / math.sqrt(12.0))
    if len(best.changes_s) == 1:
        after_s = float(weight @ instants / weight.sum())
        variance = float(weight @ (instants - after_s) ** 2 / weight.sum())
        spread = math.hypot(math.sqrt(max(variance, 0.0)), step / _INSTANTS / math.sqrt(12.0))
    onset = int(np.searchsorted(window.times_s, best.changes_s[0], side="right"))
    value = total + _PRIOR_ODDS
    return replace(best, log_evidence=value, onset=onset, after_s=after_s, after_1s_s=spread)


def _after_change(window: _Window, start: Belief, root: Array, tau: float) -> Array:
    """Derivative (6n, 6) of the whitened innovations by a change of (rate, velocity) at an instant [s]."""
    _, Phi = propagate_state(start.x, tau)
    columns = np.linalg.inv(Phi)[:, [*range(W.start, W.stop), *range(VEL.start, VEL.stop)]]
    M = (window.rows @ columns) * (window.times_s > tau)[:, None, None]
    return np.asarray(np.linalg.solve(root, M.reshape(-1, 6)), dtype=np.float64)


def _changes(instants: Array, columns: list[Array], white: Array, free: float, priors: ChangePriors) -> Explanation:
    """Changes at given instants; size and P are those of their sum, ``after_s`` their mean weighted by size."""
    m, scale = len(columns), np.repeat([priors.rate_radps, priors.velocity_mps], 3)
    M = np.hstack(columns)
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


def _log_sum(values: Sequence[float]) -> float:
    top = max(values)
    return top + math.log(sum(math.exp(v - top) for v in values))


def _log_mean(values: Sequence[float]) -> float:
    return _log_sum(values) - math.log(len(values))


def _fractions() -> Array:
    return (np.arange(_INSTANTS) + 0.5) / _INSTANTS


def _sensor_bias(window: _Window, root: Array, white: Array, free: float, priors: ChangePriors, n: int) -> Explanation:
    """A constant offset of the measured pose in {A} from one of the scans on."""
    scale = np.repeat([priors.position_m, priors.half_angle], 3)
    found = []
    for onset in range(1, n):
        M = np.zeros((n, 6, 6))
        for k in range(onset, n):
            M[k, :3, :3], M[k, 3:, 3:] = np.eye(3), window.R_ba[k]
        whitened = np.asarray(np.linalg.solve(root, M.reshape(-1, 6)), dtype=np.float64)
        value, u, P = _evidence(white, free, whitened, scale)
        left = white - whitened @ u
        found.append(Explanation(Hypothesis.SENSOR_BIAS, value, float(left @ left), 6 * n - 6, onset, size=u, P=P))
    best = max(found, key=lambda e: e.log_evidence)
    values = np.array([e.log_evidence for e in found])
    evidence = float(best.log_evidence + np.log(np.exp(values - best.log_evidence).mean())) + _PRIOR_ODDS
    return Explanation(Hypothesis.SENSOR_BIAS, evidence, best.chi2, best.dof, best.onset, size=best.size, P=best.P)


def _bad_scans(window: _Window, priors: ChangePriors, first: int, n: int) -> Explanation:
    """Every doubtful scan has an error of its own."""
    C = window.C.copy()
    extra = np.repeat([priors.position_m, priors.half_angle], 3) ** 2
    for k in range(first, n):
        C[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += np.diag(extra)
    value, chi2 = _gaussian(window.y, C)
    value += _PRIOR_ODDS + _PER_BAD_SCAN * (n - first)
    return Explanation(Hypothesis.BAD_SCANS, value, chi2, 6 * n, first)


def _frozen(window: _Window, first: int, n: int) -> Explanation:
    """The doubtful scans repeat the last accepted one: their poses equal its pose."""
    value, chi2 = _gaussian(window.y[: 6 * first], window.C[: 6 * first, : 6 * first])
    for k in range(first, n):
        away = _difference(window.poses[k], window.poses[first - 1], window.R_ba[k])
        part, size = _gaussian(away, 2.0 * window.R[k])
        value, chi2 = value + part, chi2 + size
    return Explanation(Hypothesis.FROZEN, value + _PRIOR_ODDS, chi2, 6 * n, first)


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
