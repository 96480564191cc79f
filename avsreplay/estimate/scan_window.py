"""A run of scans about the predicted trajectory, and the evidence of unknowns that are linear in their innovations.

All hypotheses about large innovations (``hypotheses``) are linear in their unknowns, so that their
marginal likelihood is Gaussian in closed form: the generalised likelihood ratio of Willsky and Jones (IEEE Trans.
Automatic Control 21, 1976) with a Gaussian prior on the size of the change, which makes hypotheses with different
numbers of unknowns comparable (Basseville and Nikiforov, Detection of Abrupt Changes, 1993).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise

import numpy as np

from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.batch_covariance import SPHERE
from avsreplay.estimate.driven import DrivenBelief, driven_steps
from avsreplay.estimate.dynamics import process_noise
from avsreplay.estimate.error_state import REACHED, rotation
from avsreplay.estimate.initialise import PoseFix
from avsreplay.estimate.measurement import innovation_vector, measured_pose, measurement_jacobian
from avsreplay.estimate.noise import cholesky_root, correlated_noise
from avsreplay.estimate.relative_orbit import OrbitArc
from avsreplay.estimate.track import NO_CHANGE, Epoch
from avsreplay.geometry import Array, Pose, conjugate, frozen, log, multiply
from avsreplay.records import Belief

EXPLAINED = 2.5  # chi-square per degree of freedom up to which a hypothesis explains the scans
PRIOR_ODDS = math.log(1e-3)  # prior log odds of every hypothesis relative to free motion with good scans
_SUSPECTED = 5  # last scans in which a change may have begun
_RUNS, _RUN_GATE = (1, 2, 4, 8), 18.5  # lengths of the runs of innovations that are summed; 99.5 % point, 6 degrees
OFFSETS = (slice(6, 7), slice(0, 3), slice(0, 6))  # errors of the sensor: range, position, pose
SCALES = (1.0, 0.1, 0.01)  # factors on the prior standard deviations: a large, a small or a very small change
FEWEST_DISTURBED, MOST_DISTURBED = 5, 8  # poses from which disturbances are estimated without a model of the motion
_DENSITIES, _ERRORS = np.logspace(-6.0, 2.0, 81), np.logspace(0.0, 4.0, 41)  # compared; errors over the claimed ones
_LONGEST = 3.0  # interval between two of them over the median
_MOST_TURN, _MOST_MOVE = 0.35, 0.1  # change of the step between poses: angle [rad], and length over the extent
_ZERO, _NO_COVARIANCE = frozen(np.zeros(6)), frozen(np.zeros((6, 6)))


class Hypothesis(Enum):
    """What explains a run of scans."""

    FREE_MOTION = "free_motion"
    MANOEUVRE = "manoeuvre"
    DISTURBED = "disturbed"  # the velocity changes all the time
    ACCELERATED = "accelerated"  # a constant torque or force
    SENSOR_BIAS = "sensor_bias"
    FROZEN = "frozen"  # the sensor repeats an old scan
    BAD_SCANS = "bad_scans"
    NOISIER = "noisier"  # the errors of the poses are larger than their covariance


@dataclass(frozen=True, slots=True)
class ChangePriors:
    """1 sigma of the size of a change: rate [rad/s], velocity [m/s], position [m] and half angle of a sensor error."""

    rate_radps: float
    velocity_mps: float
    position_m: float
    half_angle: float


@value_class
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

    @property
    def explains(self) -> bool:
        """Whether the residuals are not much larger than the noise."""
        return self.chi2 < EXPLAINED * self.dof


@value_class
class Window:
    """Innovations y (6n,) about the trajectory predicted from the belief before the window.

    ``C`` (6n, 6n) is their covariance without a change, ``whiten`` the inverse of its Cholesky factor. ``late``
    (n + 1, 6n, 12) holds the derivatives of the whitened innovations by attitude to velocity at the start of the
    window, if these act on the scans from each one on alone.
    """

    times_s: Array
    y: Array
    C: Array
    whiten: Array
    late: Array
    poses: tuple[Pose, ...]
    R: tuple[Array, ...]
    R_ba: tuple[Array, ...]


def window_of(
    epochs: Sequence[Epoch], start: Belief, torque: float, force: float, arc: OrbitArc | None = None
) -> Window:
    """The scans about the trajectory from ``start``, with disturbances of these root densities."""
    n = len(epochs)
    times = np.array([(e.prediction.belief.t_ns - start.t_ns) * 1e-9 for e in epochs])
    states, transitions, by_u, Q = driven_steps(start, times, torque, arc)
    poses = tuple(measured_pose(e.prediction.belief.x, e.innovation.alpha) for e in epochs)
    y = np.array([innovation_vector(x, pose) for x, pose in zip(states, poses, strict=True)])
    H, motion = np.array([measurement_jacobian(x) for x in states]), slice(REACHED)  # noise acts on these alone
    inverse, noise = np.linalg.inv(transitions[:, motion, motion]), process_noise(Q, times, force)[:, motion, motion]
    rows, back = H @ transitions, np.tile(start.P, (n, 1, 1))  # errors of the start
    back[:, motion, motion] += inverse @ noise @ np.swapaxes(inverse, 1, 2)
    C = ((rows @ back).reshape(6 * n, 20) @ rows.reshape(6 * n, 20).T).reshape(n, 6, n, 6)
    earlier = np.arange(n)[:, None] < np.arange(n)  # scans i before j: the noise until i is what they have in common
    C = np.where(earlier.T[:, None, :, None], C.transpose(2, 3, 0, 1), C)
    innovations = [e.innovation for e in epochs]
    R = tuple(i.R for i in innovations)
    flat = C.reshape(6 * n, 6 * n) + correlated_noise(R, [i.share for i in innovations])
    if isinstance(start, DrivenBelief):
        seen = (H @ by_u).reshape(6 * n, 6)
        across = rows.reshape(6 * n, 20) @ start.cross @ seen.T
        flat += across + across.T + seen @ start.P_u @ seen.T
    flat = 0.5 * (flat + flat.T)
    whiten = _motion.lower_inverse(cholesky_root(flat))
    late = np.concatenate([since_each(whiten, rows[:, :, :REACHED]), np.zeros((1, 6 * n, REACHED))])
    return Window(times, y.reshape(-1), flat, whiten, late, poses, R, tuple(rotation(x.q_ab).T for x in states))


def since_each(whiten: Array, columns: Array) -> Array:
    """Columns (n, 6n, m) of the whitened innovations by what acts as ``columns`` (n, 6, m) on each scan and later ones.

    The sum over the scans begins with the last.
    """
    by_scan = whiten.reshape(len(whiten), -1, 6).transpose(1, 0, 2) @ columns
    return np.asarray(np.cumsum(by_scan[::-1], axis=0)[::-1])


def offsets(window: Window, priors: ChangePriors) -> tuple[Array, Array]:
    """Derivatives (n, 6, 7) of the innovations by an offset in {A} of position, half angle and range, and its 1 sigma.

    Args:
        window: the scans.
        priors: 1 sigma of the size of a change.
    """
    M = np.zeros((len(window.poses), 6, 7))
    for k, (pose, R_ba) in enumerate(zip(window.poses, window.R_ba, strict=True)):
        M[k, :3, :3], M[k, 3:, 3:6] = np.eye(3), R_ba
        M[k, :3, 6] = pose.t / max(float(np.linalg.norm(pose.t)), 1e-300)
    return M, np.concatenate([np.repeat([priors.position_m, priors.half_angle], 3), [priors.position_m]])


def possible_change(epochs: Sequence[Epoch], scale: float, priors: ChangePriors, prior: float) -> tuple[float, Array]:
    """The probability of a change of rate or velocity within the last accepted scans, and what it adds to the variance.

    The estimate is wrong before a change can be detected. By the law of total covariance, the second moments of the
    error that the change would cause are added to the covariance, times its probability. This is done where the
    likelihood ratio of a change in one of the last five intervals is above 1. Of the changes that are compared, which
    differ in instant, size and kind, only those count that the scans have made more likely: a change just before the
    last scan is as likely as at any other time, and its effect on the velocity could be large.

    Args:
        epochs: accepted scans in the order of time.
        scale: factor on the covariance of their innovations (``nis_scale``).
        priors: 1 sigma of the size of a change.
        prior: probability of a change in these intervals before the scans are seen.

    Returns:
        The probability, and (20, 20); both 0 where the ratio is 1 or less, or without scans.
    """
    if not epochs or prior == 0.0:
        return 0.0, NO_CHANGE
    last = epochs[-_SUSPECTED:]
    seen = [e.innovation for e in last]
    inflation = [np.ones(2) if e.track.inflation is None else e.track.inflation for e in last]
    ratio, P = _motion.change(
        np.array([e.prediction.Phi for e in last]),
        np.array([e.prediction.belief.P for e in last]),
        np.array([e.prediction.H for e in last]),
        np.array([i.alpha for i in seen]),
        np.array([i.S for i in seen]),
        np.array([i.R for i in seen]),
        np.array([c / i.weight for c, i in zip(inflation, seen, strict=True)]),
        (priors.rate_radps, priors.velocity_mps),
        scale,
        seen[-1].share,
    )
    if not ratio > 1.0:
        return 0.0, NO_CHANGE
    probability = prior * ratio / (1.0 - prior + prior * ratio)
    return probability, frozen(probability * P)


def long_run(epochs: tuple[Epoch, ...], scale: float) -> bool:
    """Return whether the sum of the last whitened innovations is large, over one of several runs of scans."""
    last = [e.innovation for e in epochs[: -_RUNS[-1] - 1 : -1]]
    roots, _ = _motion.roots(np.array([one.S for one in last]))
    sums = np.cumsum((roots @ np.array([one.alpha for one in last])[:, :, None])[:, :, 0], axis=0)
    share, lengths = epochs[-1].innovation.share, [n for n in _RUNS if n <= len(sums)]
    return any(sums[n - 1] @ sums[n - 1] > _RUN_GATE * scale * n * (1.0 + (n - 1) * share) for n in lengths)


def log_evidence(white: Array, free: float, M: Array, scale: Array) -> tuple[Array, Array, Array]:
    """Log evidence, mean and covariance of the unknowns u ~ N(0, scale^2) in white = M u + N(0, 1), for each M."""
    value, mean, P = _motion.evidence(M if M.ndim == 3 else M[None], white, scale)
    return (free + value, mean, P) if M.ndim == 3 else (free + value[0], mean[0], P[0])


def pose_difference(a: Pose, b: Pose, R_ba: Array) -> Array:
    """(6,) difference of two poses: metres in {A} and half angle in {B}."""
    turn = (a @ b.inverse()).q
    half = turn[:3] if turn[3] >= 0.0 else -turn[:3]
    return np.concatenate([a.t - b.t, R_ba @ half])


def log_density(y: Array, C: Array) -> tuple[float, float]:
    """Log density of N(0, C) at y without its constant, and the squared whitened norm."""
    root = cholesky_root(C)
    white = _motion.lower_divided(root, y)
    chi2 = float(white @ white)
    return -0.5 * chi2 - float(np.log(np.diagonal(root)).sum()), chi2


def mixed(M: Array, white: Array, scale: Array, kinds: Sequence[slice]) -> Array:
    """(k,) log evidence over free motion of unknowns with columns M (k, m, n), the mean over kinds and prior widths.

    A single prior that is wide in all directions would hide a small change of the velocity alone from few scans.
    """
    return _motion.mixed(M, white, scale, np.array(SCALES), [(kind.start, kind.stop) for kind in kinds])


def disturbance_levels(fixes: Sequence[PoseFix], extent_m: float) -> tuple[float, float] | None:
    """Root densities of white disturbances that explain the differences of poses, without a model of the motion.

    Two hypotheses explain a velocity between poses that changes: the poses have independent errors larger than claimed,
    or the velocity is a random walk. Errors give consecutive changes of the velocity a correlation of -2/3, a random
    walk 1/4, and smooth motion one near 1. Their likelihoods are marginal over the size of the errors and the density
    of the walk, and their odds include the prior of every hypothesis.

    Args:
        fixes: registered poses in the order of time, none of them used.
        extent_m: the target's bounding diagonal [m].

    Returns:
        Of the torque over the trace of the inertia tensor [rad/s^1.5], and of the force per unit mass [m/s^1.5]; None
        where the poses are too few, or contradict one another, or the steps between them are too large to be followed.
    """
    if len(fixes) < FEWEST_DISTURBED:
        return None
    h = np.diff(np.array([f.t_ns for f in fixes], dtype=np.float64) * 1e-9)
    if h.min() <= 0.0 or h.max() > _LONGEST * np.median(h):
        return None
    turns = np.array([log(multiply(conjugate(a.T_ac.q), b.T_ac.q)) for a, b in pairwise(fixes)])
    moves = np.diff(np.array([f.T_ac.t for f in fixes]), axis=0)
    found, odds = [], PRIOR_ODDS
    for step, most, block in ((turns, _MOST_TURN, slice(0, 3)), (moves, _MOST_MOVE * extent_m, slice(3, 6))):
        if np.sqrt((np.diff(step, axis=0) ** 2).sum(axis=1)).max() > most:
            return None
        claimed = float(np.mean([np.trace(f.C[block, block]) / 3.0 for f in fixes]))
        errors, walk = _explained_changes(np.diff(step / h[:, None], axis=0), h, claimed)
        odds += log_mean(walk.tolist()) - log_mean(errors.tolist())
        weight = np.exp(walk - walk.max())
        found.append(float(weight @ _DENSITIES**1.5 / weight.sum()) ** (2.0 / 3.0))
    return (found[0] / SPHERE, found[1]) if odds > 0.0 else None


def _explained_changes(changes: Array, h: Array, claimed: float) -> tuple[Array, Array]:
    """Log likelihoods of changes (m, 3) of the velocity between poses at intervals h (m + 1,) [s].

    Args:
        changes: of the mean velocity from one interval to the next.
        h: intervals between the poses.
        claimed: variance of each component of a pose.

    Returns:
        (k,) by independent errors of the poses of the sizes ``_ERRORS`` over the claimed one, and (n,) by a random walk
        of the velocity of the root densities ``_DENSITIES`` with errors as claimed.
    """
    second = np.diff(np.diff(np.eye(len(h) + 1), axis=0) / h[:, None], axis=0)
    noise = claimed * second @ second.T
    walk = np.diag((h[1:] + h[:-1]) / 3.0) + np.diag(h[1:-1] / 6.0, 1) + np.diag(h[1:-1] / 6.0, -1)
    out = []
    for C in (_ERRORS[:, None, None] ** 2 * noise, noise + _DENSITIES[:, None, None] ** 2 * walk):
        left = np.einsum("mi,kmi->k", changes, np.linalg.solve(C, np.broadcast_to(changes, (len(C), *changes.shape))))
        out.append(-0.5 * left - 1.5 * np.linalg.slogdet(C)[1])
    return out[0], out[1]


def scans_after(window: tuple[Epoch, ...], found: Explanation) -> int:
    """Number of scans of the window after a manoeuvre."""
    return sum(e.prediction.belief.t_ns > last_change_ns(window, found) for e in window)


def last_change_ns(window: tuple[Epoch, ...], found: Explanation) -> int:
    """Instant at which a manoeuvre ends [ns]."""
    return window[0].track.belief.t_ns + round(found.changes_s[-1] * 1e9)


def odds_over_free(ranked: Sequence[Explanation]) -> float:
    """Log odds of the best hypothesis over free motion, with the noise that its own residuals show if that is larger.

    Errors of the registration that are larger than claimed, or correlated, resemble small changes of the motion.
    """
    best = ranked[0]
    free = next(e.log_evidence for e in ranked if e.hypothesis is Hypothesis.FREE_MOTION)
    scale = max(1.0, best.chi2 / best.dof) if best.dof > 0 else 1.0
    return (best.log_evidence - free - PRIOR_ODDS) / scale + PRIOR_ODDS


def log_mean(values: Sequence[float]) -> float:
    """Logarithm of the mean of the exponentials."""
    return float(np.logaddexp.reduce(values)) - math.log(len(values))
