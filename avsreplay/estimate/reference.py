"""One free motion through all poses of a log, and the motion of a fit at any instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from avsreplay import geometry
from avsreplay.errors import UsageError, value_class
from avsreplay.estimate.batch import BatchFit, FitParams, Poses, fit
from avsreplay.estimate.chart import Chart, to_chart, to_state
from avsreplay.estimate.dynamics import pose_rows, propagate_state
from avsreplay.estimate.initialise import BatchResult, PoseFix, poses_of, rough_state, weak_prior
from avsreplay.estimate.params import EstimatorParams
from avsreplay.estimate.relative_orbit import RelativeOrbit
from avsreplay.estimate.track import Track
from avsreplay.geometry import Array, Pose
from avsreplay.records import State

_FEWEST = 4
_FIRST_TURN = np.pi  # the window starts at half a turn and doubles


def free_fit(
    t_ns: Sequence[int],
    poses: Sequence[Pose],
    covariances: Sequence[Array] | None,
    extent_m: float,
    params: EstimatorParams | None = None,
) -> BatchFit:
    """Fit one free motion to all poses T_ac of a log, in time order.

    The smoothing pass finds events and random disturbances between the poses; this fit assumes
    that there are none, and its residuals show whether that is so.

    Args:
        t_ns: instants, ascending [ns].
        poses: T_ac.
        covariances: (6, 6) each, of d = [theta; v] in {C} [rad, m]; None takes R0 for all (the
            residuals rescale it).
        extent_m: bounding diagonal of the target [m].
        params: the estimator's; None is the default. The axes of an orbit are those at the first
            pose.

    Returns:
        The fit, whose state is that at the first pose.

    Raises:
        UsageError: fewer than four poses.
    """
    settings = (params or EstimatorParams()).resolved(extent_m)
    given = covariances or [r0_covariance(settings)] * len(poses)
    orbit = RelativeOrbit.of(settings, t_ns[0]) if len(t_ns) else None
    fixes = tuple(
        PoseFix(t, pose, C, orbit=orbit) for t, pose, C in zip(t_ns, poses, given, strict=True)
    )
    if len(fixes) < _FEWEST:
        hint = "a free motion needs four healthy poses at least"
        raise UsageError(f"only {len(fixes)} poses to fit a motion to", hint=hint)
    return _grown(poses_of(fixes), to_chart(rough_state(fixes)), settings)


@value_class
class FittedMotion:
    """The motion of a fit at one instant.

    Attributes:
        epoch_ns: instant of its initial values [ns].
        chart: these.
        t_ns: the instant [ns].
        x: the state there.
    """

    epoch_ns: int
    chart: Chart
    t_ns: int
    x: State

    @classmethod
    def of(cls, fitted: BatchResult) -> FittedMotion:
        """The motion of a fit at its epoch."""
        return cls(fitted.epoch_ns, fitted.chart, fitted.epoch_ns, to_state(fitted.chart))

    def is_of(self, fitted: BatchResult) -> bool:
        """Whether the motion is that of a fit."""
        return self.epoch_ns == fitted.epoch_ns and bool(
            np.array_equal(self.chart.flat, fitted.chart.flat)
        )

    def at(self, t_ns: int, orbit: RelativeOrbit | None) -> tuple[FittedMotion, Array]:
        """The motion at another instant [ns], and the transition (20, 20) to there;
        ``orbit``: of the target.
        """
        arc = None if orbit is None else orbit.at(self.t_ns)
        x, Phi = propagate_state(self.x, (t_ns - self.t_ns) * 1e-9, arc)
        return replace(self, t_ns=t_ns, x=x), Phi


@value_class
class GramianRows:
    """What a scan gives to the observability Gramian.

    Attributes:
        motion: of the fit that the Gramian follows, at the scan; None before a fit.
        anew: the Gramian begins anew along this motion.
        Phi: (20, 20) transition from the last scan; ``anew``: from the epoch of the motion.
        H: (6, 20) of the scan; ``anew``: H Phi (n, 6, 20) of all poses of the fit.
        R: (6, 6) their noise, as the registration claims it, None where the pose was not used;
            ``anew``: (n, 6, 6).
    """

    motion: FittedMotion | None
    anew: bool
    Phi: Array
    H: Array
    R: Array | None


def rows_along(motion: FittedMotion, fixes: tuple[PoseFix, ...]) -> tuple[Array, Array]:
    """H Phi of poses along one motion, for the observability Gramian.

    Args:
        motion: at its epoch.
        fixes: the poses (n), later than the epoch.

    Returns:
        H Phi (n, 6, 20) and R (n, 6, 6) [m, half angle].
    """
    x, poses = motion.x, poses_of(fixes, motion.epoch_ns)
    arc = None if fixes[0].orbit is None else fixes[0].orbit.at(motion.epoch_ns)
    J = np.zeros((len(poses), 6, 6))  # from d = [theta; v] in {C}, as in ``measurement.to_camera``
    J[:, :3, 3:], J[:, 3:, :3] = geometry.matrix(poses.q), 0.5 * geometry.matrix(x.q_bc)
    R = J @ poses.C @ np.swapaxes(J, 1, 2)
    rows = pose_rows(x, poses.times_s, arc)
    if poses.counts is not None:  # where the oldest poses are joined, one stands for several
        each = np.sqrt(poses.counts)[:, None, None]
        rows, R = each * rows, each**2 * R
    return rows, R


def healthy_pose(track: Track, t_ns: int, T_ac: Pose, params: EstimatorParams) -> PoseFix:
    """The pose of a healthy scan, at its own instant and with its covariance if the track still
    contains it.
    """
    return track.fixes[-1] if track.fixes else PoseFix(t_ns, T_ac, r0_covariance(params))


def r0_covariance(params: EstimatorParams) -> Array:
    """Return R0 as a covariance (6, 6) of d = [theta; v] in {C} [rad, m].

    Args:
        params: with auto values resolved.
    """
    variances = np.diagonal(params.R0)
    return np.diag(np.concatenate([4.0 * variances[3:], variances[:3]]))


def _grown(poses: Poses, start: Chart, params: EstimatorParams) -> BatchFit:
    """The fit over half a turn, a turn, two, ..., all, each started from the previous one."""
    prior, rules = weak_prior(poses, params), FitParams(max_steps=60)
    chart = start
    for count in _windows(poses, start):
        chart = fit(poses.some(slice(count)), chart, prior, replace(rules, rescale=False)).chart
    return fit(poses, chart, prior, rules)


def _windows(poses: Poses, start: Chart) -> list[int]:
    """The number of poses in each growing window, without the last, which has all."""
    rate = float(np.linalg.norm(start.w_c))
    span = _FIRST_TURN / rate if rate > 0.0 else np.inf
    counts = []
    while span < poses.times_s[-1]:
        count = int(np.searchsorted(poses.times_s, span, side="right"))
        if count >= _FEWEST:
            counts.append(count)
        span *= 2.0
    return counts
