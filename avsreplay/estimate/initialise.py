"""Start without a belief: rate from the first poses, then a batch fit over all of them.

The first belief has zero sigma and varrho, and mu is the identity. Its covariance is that of one
linearised fit: the prior's information plus H' R^-1 H of each pose, propagated back along the
motion. Rate, velocity and their correlations with the unknown parameters thus agree with the poses.

The fit is repeated each time the poses have grown by a stated share (``refit`` decides when). It is
final once its likelihood is Gaussian (``batch_covariance`` finds no non-Gaussian direction) and
every direction is determined by the poses rather than by the prior: the filter may then start from
its mean and covariance. A body with an unobservable direction stays with the fit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.batch import BatchFit, FitParams, Poses, Prior, Problem, fit
from avsreplay.estimate.batch_covariance import (
    LATEST,
    BatchCovariance,
    covariance_of,
    final_mixture,
    sandwich,
    unseen_torque,
)
from avsreplay.estimate.chart import Chart, to_chart
from avsreplay.estimate.dynamics import propagate_state
from avsreplay.estimate.error_state import DIM, RHO, VEL, hamilton
from avsreplay.estimate.measurement import in_camera, measurement_jacobian
from avsreplay.estimate.mixture import Component, moments
from avsreplay.estimate.noise import BOUND
from avsreplay.estimate.noise_levels import MOST_NORMAL_POINTS, NoiseLevels, estimate_levels
from avsreplay.estimate.normal_points import PositionRows, gross_errors, normal_points
from avsreplay.estimate.params import Adaptation, EstimatorParams
from avsreplay.estimate.pose_noise import cholesky_root
from avsreplay.estimate.relative_orbit import RelativeOrbit
from avsreplay.geometry import Array, Pose
from avsreplay.records import Belief, State
from avsreplay.settings import given

_PAIR_RAD = 0.7
_DRAWS = 500
_EDGE = 0.99
_LEVEL_STEPS = 20
_LEVEL_TOL = 0.1
# a direction whose posterior sigma is above this share of the prior's is determined by the prior
_DETERMINED = 0.5


@value_class
class PoseFix:
    """A healthy pose T_ac at an instant.

    Attributes:
        C: (6, 6) covariance of d = [theta; v] in {C} [rad, m], T_true = T_ac Exp(d).
        lag_ns: the instant relative to that of its scan: a scan of finite duration shows the pose
            at its middle.
        correlated_share: the part of C that neighbouring poses have in common.
        count: number of poses that it stands for.
        orbit: the relative orbit that the target is on; None for free motion.
        weight: Cauchy weight of the pose in the update.
        shift: (6,) as in ``batch.Poses``, of one that stands for several; None for 0.
    """

    t_ns: int
    T_ac: Pose
    C: Array
    lag_ns: int = 0
    correlated_share: float = 0.0
    count: int = 1
    orbit: RelativeOrbit | None = None
    weight: float = 1.0
    shift: Array | None = None

    @property
    def scan_ns(self) -> int:
        """Instant of its scan."""
        return self.t_ns - self.lag_ns


@value_class
class BatchResult:
    """The last batch fit: its values at the epoch (the first pose) and the resulting belief.

    Attributes:
        epoch_ns: instant of the first pose.
        chart: values there, where the next fit starts.
        count: poses.
        factors, inflation: (2,) noise factors and correlation inflation, of attitude and position.
        belief: at the last pose.
        gaussian: the filter may start from it.
        components: the Gaussian mixture that ``belief`` has the moments of.
        prior_rejected: the poses contradict the given start, and it was left out.
        points: the poses of the fit, or their normal points.
        share: mean claimed part of the variance of the poses that near views have in common.
        position_m2: (3, 3) claimed covariance of the position of a pose in {A}, the inverse of the
            mean information.
    """

    epoch_ns: int
    chart: Chart
    count: int
    factors: Array
    inflation: Array
    belief: Belief
    gaussian: bool
    components: tuple[Component, ...] = ()
    prior_rejected: bool = False
    points: Poses | None = None
    share: float = 0.0
    position_m2: Array | None = None


def guessed_belief(t_ns: int, T_ac: Pose, params: EstimatorParams) -> Belief:
    """A body at rest at a guessed pose, with the start's wide standard deviations."""
    return Belief(t_ns, _at_pose(T_ac, np.zeros(3), np.zeros(3)), np.diag(params.start_1s**2))


def first_belief(fixes: tuple[PoseFix, ...], params: EstimatorParams) -> Belief:
    """The belief at the last pose's scan: rate and velocity from all poses, at rest from a
    single one.
    """
    last = fixes[-1]
    x, _ = propagate_state(_at_pose(last.T_ac, *mean_rates(fixes)), -last.lag_ns * 1e-9)
    info = np.diag(params.start_1s**-2.0)
    for fix in fixes:
        h = (fix.t_ns - last.scan_ns) * 1e-9
        then, Phi = propagate_state(x, h)
        H = measurement_jacobian(then) @ Phi
        info += H.T @ np.linalg.solve(in_camera(fix.C, fix.T_ac.q, x.q_bc), H)
    P = np.linalg.inv(info)
    return Belief(last.scan_ns, x, 0.5 * (P + P.T))


def mean_rates(fixes: tuple[PoseFix, ...]) -> tuple[Array, Array]:
    """Mean rate in {C} [rad/s] and velocity in {A} [m/s] over the poses; zero for one pose or
    no time between them.
    """
    h = (fixes[-1].t_ns - fixes[0].t_ns) * 1e-9
    if h <= 0.0:
        return np.zeros(3), np.zeros(3)
    return np.sum(_turns(fixes, 1), axis=0) / h, (fixes[-1].T_ac.t - fixes[0].T_ac.t) / h


def _turns(fixes: tuple[PoseFix, ...], apart: int) -> Array:
    """Rotation vectors (n - apart, 3) from each of n poses to that ``apart`` from it."""
    q = np.array([fix.T_ac.q for fix in fixes])
    return geometry.log(np.array(hamilton(geometry.conjugate(q[:-apart]).T, q[apart:].T)).T)


def _at_pose(T_ac: Pose, w: Array, v: Array) -> State:
    return State(T_ac.q, w, T_ac.t, v, np.zeros(2), np.zeros(3), geometry.IDENTITY_QUAT)


def poses_of(fixes: tuple[PoseFix, ...], epoch_ns: int | None = None) -> Poses:
    """The fixes as input of the fit, times from the epoch, by default the first pose."""
    t0 = fixes[0].t_ns if epoch_ns is None else epoch_ns
    counts, orbit = [f.count for f in fixes], fixes[0].orbit
    joined_ones = any(f.shift is not None for f in fixes)
    return Poses(
        np.array([(f.t_ns - t0) * 1e-9 for f in fixes]),
        np.array([f.T_ac.q for f in fixes]),
        np.array([f.T_ac.t for f in fixes]),
        np.array([f.C for f in fixes]),
        np.array(counts) if max(counts) > 1 else None,
        shares=np.array([f.correlated_share for f in fixes]),
        arc=None if orbit is None else orbit.at(t0),
        shift=np.array([np.zeros(6) if f.shift is None else f.shift for f in fixes])
        if joined_ones
        else None,
    )


def pose_count(fixes: tuple[PoseFix, ...]) -> int:
    """Number of poses that the fixes stand for; the oldest are joined first."""
    return len(fixes) if not fixes or fixes[0].count == 1 else sum(fix.count for fix in fixes)


def joined(fixes: tuple[PoseFix, ...], reference: Chart, factors: Array) -> tuple[PoseFix, ...]:
    """Half as many poses that carry the information of these: neighbouring ones are joined about a
    reference motion.

    Args:
        fixes: healthy poses, oldest first.
        reference: initial values, at the first pose, of a motion close to them.
        factors: (2,) noise factors of attitude and position, for the weights of outliers.
    """
    points = normal_points(poses_of(fixes), reference, factors, len(fixes) // 2)
    shares = np.zeros(len(points)) if points.shares is None else points.shares
    counts = np.ones(len(points)) if points.counts is None else points.counts
    return tuple(
        PoseFix(
            fixes[0].t_ns + round(t * 1e9),
            Pose(q, p),
            C,
            0,
            share,
            int(count),
            fixes[0].orbit,
            shift=shift,
        )
        for t, q, p, C, share, count, shift in zip(
            points.times_s.tolist(),
            points.q,
            points.t,
            points.C,
            shares.tolist(),
            counts,
            points.shifts,
            strict=True,
        )
    )


def weak_prior(poses: Poses, params: EstimatorParams) -> Prior:
    """The prior of a cold start, with large standard deviations: a sphere at rest at the first
    pose.

    The centre of the sphere is at the fixture.
    """
    mean = Chart.of(
        poses.q[0], np.zeros(3), poses.t[0], np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.eye(3)
    )
    arm = given(params.start_varrho_1s_m)
    speed = given(params.start_vel_1s_mps) + params.start_rate_1s_radps * arm
    widths = [2.0, params.start_rate_1s_radps, 4.0 * arm, speed, params.start_log_inertia_1s, arm]
    return Prior(mean, np.diag(np.repeat(widths, [3, 3, 3, 3, 5, 3]) ** 2))


def given_prior(belief: Belief) -> Prior:
    """A given belief in chart coordinates, by Monte Carlo.

    The Jacobian would not do: where two moments are nearly equal, the effect of the axes mu on the
    inertia depends on how far the moments differ, which the linearisation does not contain.
    """
    x, mean, J = belief.x, to_chart(belief.x), np.eye(DIM)
    # position and velocity along the axes of the body, so that the draws turn with the camera
    J[RHO, RHO] = J[VEL, VEL] = geometry.matrix(x.q_ab)
    root = J @ cholesky_root(J.T @ belief.P @ J)
    draws = np.random.Generator(np.random.PCG64(0)).standard_normal((_DRAWS, DIM)) @ root.T
    y = _motion.spread(x.flat, np.concatenate([draws, -draws]), _EDGE, mean.flat)
    return Prior(mean, y.T @ y / len(y))


def rough_state(fixes: tuple[PoseFix, ...]) -> State:
    """A sphere that spins about its fixture at the poses' median rate, which single outliers do not
    affect.

    Neighbouring poses give a coarse rate; pairs about 0.7 rad of rotation apart then give a finer
    one.
    """
    coarse = _median_rates(fixes, 1)[0]
    step = (fixes[-1].t_ns - fixes[0].t_ns) * 1e-9 / max(1, len(fixes) - 1)
    angle = float(np.linalg.norm(coarse)) * step
    apart = int(np.clip(_PAIR_RAD / max(angle, 1e-3), 1, max(1, len(fixes) // 2)))
    w, v = _median_rates(fixes[: 3 * apart], apart)
    return _at_pose(fixes[0].T_ac, w, v)


def _median_rates(fixes: tuple[PoseFix, ...], apart: int) -> tuple[Array, Array]:
    """Rate in {C} and velocity in {A}: medians over pairs of poses ``apart``, without those
    almost at one instant.
    """
    least = 1e-3 * (fixes[-1].t_ns - fixes[0].t_ns) / max(1, len(fixes) - 1)
    times, t = np.array([fix.t_ns for fix in fixes]), np.array([fix.T_ac.t for fix in fixes])
    h_ns = times[apart:] - times[:-apart]
    used = h_ns >= max(least, 1.0)
    if not used.any():
        return np.zeros(3), np.zeros(3)
    h = h_ns[used, None] * 1e-9
    return np.median(_turns(fixes, apart)[used] / h, axis=0), np.median(
        (t[apart:] - t[:-apart])[used] / h, axis=0
    )


def batch_estimate(
    fixes: tuple[PoseFix, ...],
    params: EstimatorParams,
    rules: FitParams,
    levels: NoiseLevels,
    last: BatchResult | None = None,
    start: Chart | None = None,
    given: Prior | None = None,
) -> BatchResult:
    """Fit all poses with noise of these levels, from ``start`` or the values of the last fit.

    ``given`` is the prior at the first pose; it is left out once the poses contradict it.
    """
    poses = poses_of(fixes)
    prior = weak = weak_prior(poses, params)
    if start is None:
        start = to_chart(rough_state(fixes)) if last is None else last.chart
    share = float(np.mean(poses.shares)) if poses.shares is not None else 0.0
    plain = levels.factors(share)
    if last is None:
        points = normal_points(poses, start, plain)
        inflation = sandwich(Problem(points, given or weak, plain, start), points, levels)[1]
    else:
        inflation = last.inflation
    factors = plain * np.sqrt(inflation)
    points = normal_points(poses, start, factors * np.sqrt(levels.slack))
    first, rejected = last is None, last is not None and last.prior_rejected
    noise, slack = (levels.torque, levels.force), levels.slack
    fitted = fit(points, start, weak, rules, factors, robust_start=first, slack=slack)
    if given is not None and not rejected:
        joint = fit(points, start, given, rules, factors, robust_start=first, slack=slack)
        rejected = _contradicts(points, fitted, weak, joint, given)
        fitted, prior = (fitted, weak) if rejected else (joint, given)
    problem = Problem(points, prior, factors, fitted.chart, slack)
    found = covariance_of(problem, fitted, rules)
    problem.core.linearise(fitted.chart.flat)
    spread, inflation = sandwich(problem, points, levels)
    now_ns = fixes[-1].scan_ns
    after_s = (now_ns - fixes[0].t_ns) * 1e-9
    unseen = unseen_torque(problem, after_s) if params.torque_noise_radps15 is None else None
    latest = poses.latest(LATEST, after_s)
    components = final_mixture(found, problem, latest, noise, now_ns, after_s, spread, unseen)
    gaussian = _determined(found, weak)
    return BatchResult(
        epoch_ns=fixes[0].t_ns,
        chart=fitted.chart,
        count=pose_count(fixes),
        factors=plain,
        inflation=inflation,
        belief=moments(components),
        gaussian=gaussian,
        components=components,
        prior_rejected=rejected,
        points=points,
        share=share,
        position_m2=_position_noise(points),
    )


def _position_noise(points: Poses) -> Array:
    """Covariance (3, 3) in {A} that each pose would have for the sum of their information on the
    position.
    """
    R = geometry.matrix(points.q)
    info = np.sum(R @ np.linalg.inv(points.C[:, 3:, 3:]) @ np.swapaxes(R, 1, 2), axis=0)
    return np.asarray(
        np.linalg.inv(info) * (len(points) if points.counts is None else float(points.counts.sum()))
    )


def improved_levels(
    fixes: tuple[PoseFix, ...],
    result: BatchResult,
    start: Chart,
    params: EstimatorParams,
    levels: NoiseLevels,
    positions: PositionRows | None = None,
) -> NoiseLevels:
    """Noise levels from the residuals of the poses but those with gross errors, which are no noise.

    Args:
        fixes: healthy poses, oldest first.
        result: the last fit.
        start: its chart, at the first pose.
        params: settings, auto values filled in.
        levels: the last estimate.
        positions: as in ``estimate_levels``.
    """
    poses = poses_of(fixes)
    factors = levels.factors(result.share) * np.sqrt(result.inflation)
    prior, chart, gate = weak_prior(poses, params), start, factors * np.sqrt(levels.slack)
    poses = poses.some(
        ~gross_errors(poses, poses.residuals(Problem(poses, prior, factors), chart), factors)
    )
    for _ in range(2):  # normal points about the given motion, then about the fitted one
        points = normal_points(poses, chart, gate, MOST_NORMAL_POINTS, scatter=True)
        problem = Problem(
            points, prior, factors, chart, np.inf
        )  # residuals with disturbances have the weight 1
        problem.core.descend(_LEVEL_STEPS, _LEVEL_TOL)
        chart = problem.chart
    problem.core.linearise(chart.flat)
    claimed = params.adapt is Adaptation.OFF
    found = estimate_levels(
        points, problem, levels, claimed, params.disturbances, positions=positions
    )
    return replace(found, count=pose_count(fixes))


def _contradicts(
    poses: Poses, fitted: BatchFit, weak: Prior, joint: BatchFit, given: Prior
) -> bool:
    """Return whether the given prior raises the cost of the poses too much, at the fitted noise.

    If the given prior is right, twice the difference is at most chi-square with 20 degrees of
    freedom.
    """
    alone, with_given = (Problem(poses, prior, fitted.effective) for prior in (weak, given))
    return 2.0 * (with_given.cost(joint.chart) - alone.cost(fitted.chart)) > BOUND


def _determined(found: BatchCovariance, weak: Prior) -> bool:
    """Return whether the likelihood is Gaussian and every direction is determined by the poses."""
    fitted = found.fitted
    ratio = np.linalg.eigvalsh(fitted.P_chart / np.outer(weak.one_sigma, weak.one_sigma))[-1]
    return found.gaussian and bool(ratio < _DETERMINED**2) and fitted.converged
