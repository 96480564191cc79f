"""A run of scans about the predicted trajectory, and the evidence of unknowns that are linear in
their innovations.

All hypotheses about large innovations (``hypotheses``) are linear in their unknowns, so that their
marginal likelihood is Gaussian in closed form: the generalised likelihood ratio of Willsky and
Jones (IEEE Trans. Automatic Control 21, 1976) with a Gaussian prior on the size of the change,
which makes hypotheses with different numbers of unknowns comparable (Basseville and Nikiforov,
Detection of Abrupt Changes, 1993).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.driven import DrivenBelief, driven_steps
from avsreplay.estimate.dynamics import process_noise
from avsreplay.estimate.error_state import LARGEST_MOVE, REACHED, rotation
from avsreplay.estimate.measurement import innovation_vector, measured_pose, measurement_jacobian
from avsreplay.estimate.noise import correlated_noise
from avsreplay.estimate.params import EstimatorParams
from avsreplay.estimate.pose_noise import cholesky_root
from avsreplay.estimate.relative_orbit import OrbitArc
from avsreplay.estimate.scan_points import ScanPoints, scan_points
from avsreplay.estimate.track import NO_CHANGE, Epoch
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import UNLIKELY, Belief

EXPLAINED = 2.5  # chi-square per degree of freedom up to which a hypothesis explains the scans
PRIOR_ODDS = math.log(
    1e-3
)  # prior log odds of every hypothesis relative to free motion with good scans
_SUSPECTED = 5  # last scans in which a change may have begun
_SIZES = (
    0.3,
    0.1,
)  # prior standard deviations of such a change over those of a manoeuvre; a larger one is deferred
_RUNS = (1, 2, 4, 8, 16, 32)  # lengths of the runs of innovations that are summed
_RUN_GATE = 18.5  # of their squared sums: 99.5 % point of chi-square with 6 degrees of freedom
OFFSETS = (slice(6, 7), slice(0, 3), slice(0, 6))  # errors of the sensor: range, position, pose
SCALES = (
    1.0,
    0.1,
    0.01,
)  # factors on a prior standard deviation: a large, a small or a very small error or change
_ZERO = frozen(np.zeros(6))
_NO_COVARIANCE = frozen(np.zeros((6, 6)))


class Hypothesis(Enum):
    """What explains a run of scans."""

    FREE_MOTION = "free_motion"
    MANOEUVRE = "manoeuvre"
    DISTURBED = "disturbed"  # the velocity changes all the time
    ACCELERATED = "accelerated"  # a constant torque or force
    SENSOR_BIAS = "sensor_bias"
    BAD_SCANS = "bad_scans"
    NOISIER = "noisier"  # the errors of the poses are larger than their covariance


@dataclass(frozen=True, slots=True)
class ChangePriors:
    """1 sigma of the size of a change: rate [rad/s], velocity [m/s], position [m] and half angle of
    a sensor error.

    ``scales`` are the factors on those of rate and velocity that are compared. A single prior that
    is wide in all directions would hide a small change from few scans.
    """

    rate_radps: float
    velocity_mps: float
    position_m: float
    half_angle: float
    scales: tuple[float, ...] = SCALES

    @classmethod
    def of(cls, params: EstimatorParams, extent_m: float) -> ChangePriors:
        """The priors of a run. Where large changes are expected, the small ones are compared that
        others show as well.

        Args:
            params: settings, auto values filled in.
            extent_m: the target's bounding diagonal [m].
        """
        usual = EstimatorParams().resolved(extent_m).change_1s
        larger = max(
            1.0, *(given / default for given, default in zip(params.change_1s, usual, strict=True))
        )
        more = math.ceil(math.log10(larger) - 1e-9)
        scales = (*SCALES, *(SCALES[-1] * 0.1 ** (k + 1) for k in range(more)))
        return cls(*params.change_1s, 0.05 * extent_m, 0.05, scales)


@value_class
class Explanation:
    """A hypothesis with its most likely parameters.

    Attributes:
        log_evidence: log of the marginal likelihood times the prior odds.
        chi2: squared norm of the whitened residuals of the innovations, ``dof`` of them.
        onset: index of the first affected scan.
        after_s: instant of a manoeuvre after the first scan's prior belief [s], with its standard
            deviation.
        size, P: (6,) (rate, velocity) of a manoeuvre or the offset of a sensor bias, with its
            covariance (6, 6).
        changes_s: instants of free changes of the velocity: the ends of the 90 % interval of the
            instant, or two in each interval between scans over which a manoeuvre extends.
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
    def changes(self) -> bool:
        """Whether the change of the velocities, its instant unknown, is not one by chance."""
        return float(self.size @ np.linalg.solve(self.P, self.size)) >= UNLIKELY[6]

    @property
    def explains(self) -> bool:
        """Whether the residuals are not much larger than the noise."""
        return self.chi2 < EXPLAINED * self.dof


@value_class
class Window:
    """Innovations y (6p,) of p points about the trajectory predicted from the belief before the
    window of n scans.

    ``C`` (6p, 6p) is their covariance without a change, ``whiten`` the inverse of its Cholesky
    factor. ``late`` (n + 1, 6p, 12) holds the derivatives of the whitened innovations by attitude
    to velocity at the start of the window, if these act on the scans from each one on alone.
    """

    points: ScanPoints
    times_s: Array
    y: Array
    C: Array
    whiten: Array
    late: Array
    poses: tuple[Pose, ...]
    R: tuple[Array, ...]
    R_ba: tuple[Array, ...]

    @property
    def edges_s(self) -> Array:
        """(p + 1,) ends of the intervals between points, from the start on [s]."""
        return np.append(0.0, self.times_s[np.append(self.points.first[1:], len(self.times_s)) - 1])

    def since_each(self, columns: Array) -> Array:
        """Columns (n, 6p, m) of the whitened innovations by what acts as ``columns`` (n, 6, m) from
        each scan on.
        """
        return self.points.since_each(self.whiten, columns)


def window_of(
    epochs: Sequence[Epoch],
    accepted: int,
    start: Belief,
    torque: float,
    force: float,
    arc: OrbitArc | None = None,
) -> Window:
    """The scans about the trajectory from ``start``, with disturbances of these root densities.

    Args:
        epochs: measured scans in the order of time.
        accepted: number of them before the doubtful ones.
        start: belief before the first of them.
        torque: root density of the angular disturbance [rad/s^1.5].
        force: root density of the linear disturbance [m/s^1.5].
        arc: orbit of the target from ``start`` on; None for free motion.
    """
    n = len(epochs)
    times = np.array([(e.prediction.belief.t_ns - start.t_ns) * 1e-9 for e in epochs])
    states, transitions, by_u, Q = driven_steps(start, times, torque, arc)
    poses = tuple(measured_pose(e.prediction.belief.x, e.innovation.alpha) for e in epochs)
    y = np.array([innovation_vector(x, pose) for x, pose in zip(states, poses, strict=True)])
    H, motion = (
        np.array([measurement_jacobian(x) for x in states]),
        slice(REACHED),
    )  # noise acts on these alone
    inverse, noise = (
        np.linalg.inv(transitions[:, motion, motion]),
        process_noise(Q, times, force)[:, motion, motion],
    )
    rows, back = H @ transitions, np.tile(start.P, (n, 1, 1))  # errors of the start
    back[:, motion, motion] += inverse @ noise @ np.swapaxes(inverse, 1, 2)
    C = ((rows @ back).reshape(6 * n, 20) @ rows.reshape(6 * n, 20).T).reshape(n, 6, n, 6)
    earlier = np.arange(n)[:, None] < np.arange(
        n
    )  # scans i before j: the noise until i is what they have in common
    C = np.where(earlier.T[:, None, :, None], C.transpose(2, 3, 0, 1), C)
    innovations = [e.innovation for e in epochs]
    R = tuple(i.R for i in innovations)
    if isinstance(start, DrivenBelief):
        seen = (H @ by_u).reshape(6 * n, 6)
        across = rows.reshape(6 * n, 20) @ start.cross @ seen.T
        C += (across + across.T + seen @ start.P_u @ seen.T).reshape(n, 6, n, 6)
    C += correlated_noise(R, [i.share for i in innovations]).reshape(n, 6, n, 6)
    points = scan_points(R, accepted)
    p = len(points.first)
    flat = points.covariance(C).reshape(6 * p, 6 * p)
    flat = 0.5 * (flat + flat.T)
    whiten = _motion.lower_inverse(cholesky_root(flat))
    late = np.concatenate(
        [points.since_each(whiten, rows[:, :, :REACHED]), np.zeros((1, 6 * p, REACHED))]
    )
    R_ba = tuple(rotation(x.q_ab).T for x in states)
    return Window(points, times, points.combined(y).reshape(-1), flat, whiten, late, poses, R, R_ba)


def offsets(window: Window, priors: ChangePriors) -> tuple[Array, Array]:
    """Derivatives (n, 6, 7) of the innovations by an offset in {A} of position, half angle and
    range, and its 1 sigma.

    Args:
        window: the scans.
        priors: 1 sigma of the size of a change.
    """
    M = np.zeros((len(window.poses), 6, 7))
    for k, (pose, R_ba) in enumerate(zip(window.poses, window.R_ba, strict=True)):
        M[k, :3, :3], M[k, 3:, 3:6] = np.eye(3), R_ba
        M[k, :3, 6] = pose.t / max(float(np.linalg.norm(pose.t)), 1e-300)
    return M, np.concatenate(
        [np.repeat([priors.position_m, priors.half_angle], 3), [priors.position_m]]
    )


def possible_change(
    epochs: Sequence[Epoch], scale: float, priors: ChangePriors, prior: float
) -> tuple[float, Array]:
    """The probability of a change of rate or velocity within the last accepted scans, and what it
    adds to the variance.

    The estimate is wrong before a change can be detected. By the law of total covariance, the
    second moments of the error that the change would cause are added to the covariance, times its
    probability. This is done where the likelihood ratio of a change in one of the last five
    intervals is above 1. Of the changes that are compared, which differ in instant, size and kind,
    only those count that the scans have made more likely: a change just before the last scan is as
    likely as at any other time, and its effect on the velocity could be large.

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
    ratio, P = _motion.change(
        np.array([e.used for e in last]),
        (priors.rate_radps, priors.velocity_mps),
        [size * each for each in priors.scales[:-1] for size in _SIZES],
        scale,
        last[-1].innovation.share,
        LARGEST_MOVE,
    )
    if not ratio > 1.0:
        return 0.0, NO_CHANGE
    probability = prior * ratio / (1.0 - prior + prior * ratio)
    return probability, frozen(probability * P)


def long_run(epochs: tuple[Epoch, ...], scale: float) -> bool:
    """Return whether the sum of the last whitened innovations is large, over one of several runs of
    scans.
    """
    sums = np.cumsum([e.white for e in epochs[: -_RUNS[-1] - 1 : -1]], axis=0)
    share, lengths = epochs[-1].innovation.share, [n for n in _RUNS if n <= len(sums)]
    return any(
        sums[n - 1] @ sums[n - 1] > _RUN_GATE * scale * n * (1.0 + (n - 1) * share) for n in lengths
    )


def log_evidence(white: Array, free: float, M: Array, scale: Array) -> tuple[Array, Array, Array]:
    """Log evidence, mean and covariance of the unknowns u ~ N(0, scale^2) in white = M u + N(0, 1),
    for each M.
    """
    value, mean, P = _motion.evidence(M if M.ndim == 3 else M[None], white, scale)
    return (free + value, mean, P) if M.ndim == 3 else (free + value[0], mean[0], P[0])


def mixed(
    M: Array, white: Array, scale: Array, kinds: Sequence[slice], scales: Sequence[float] = SCALES
) -> Array:
    """(k,) log evidence over free motion of unknowns with columns M (k, m, n), the mean over kinds
    and prior widths.
    """
    return _motion.mixed(
        M, white, scale, np.array(scales), [(kind.start, kind.stop) for kind in kinds]
    )


def scans_after(window: tuple[Epoch, ...], found: Explanation) -> int:
    """Number of scans of the window after a manoeuvre."""
    return sum(e.prediction.belief.t_ns > last_change_ns(window, found) for e in window)


def last_change_ns(window: tuple[Epoch, ...], found: Explanation) -> int:
    """Instant at which a manoeuvre ends [ns]."""
    return window[0].track.belief.t_ns + round(found.changes_s[-1] * 1e9)


def odds_over_free(ranked: Sequence[Explanation]) -> float:
    """Log odds of the best hypothesis over free motion, with the noise that its own residuals show
    if that is larger.

    Errors of the registration that are larger than claimed, or correlated, resemble small changes
    of the motion.
    """
    best = ranked[0]
    free = next(e.log_evidence for e in ranked if e.hypothesis is Hypothesis.FREE_MOTION)
    scale = max(1.0, best.chi2 / best.dof) if best.dof > 0 else 1.0
    return (best.log_evidence - free - PRIOR_ODDS) / scale + PRIOR_ODDS


def log_mean(values: Sequence[float]) -> float:
    """Logarithm of the mean of the exponentials."""
    return float(np.logaddexp.reduce(values)) - math.log(len(values))
