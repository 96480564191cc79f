"""The typed result of one scan: plan, outcome of the pipeline, and score against ground truth.

``pipeline.step`` makes the Outcome without access to ground truth; ``score.Scorer`` makes the Score
afterwards; ``rows.Row.of`` turns the two into columns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from enum import Enum

from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.records import (
    Alignment,
    Belief,
    Drift,
    Forecast,
    Innovation,
    Manoeuvre,
    Moves,
    Scan,
    Verdict,
)

# log odds of a set of events from which it is stated, and behind it from which a rival is left out
SURE_EVENT_LOG_ODDS = 6.0


class PlanStatus(Enum):
    """Result of the planner."""

    OPTIMAL = "optimal"  # first feasible time, certified to the stated gap
    FEASIBLE = "feasible"  # satisfies all constraints; no claim of least time
    NOT_FOUND = "none_found"  # the search found no plan; there may be one
    INFEASIBLE = "infeasible_within_horizon"  # certified: there is no plan within the horizon
    NO_CONVERGENCE = "no_convergence"


@value_class
class Plan:
    """A rendezvous in least time: meet the grasp point in position and velocity with |u| <= a_max
    (eq:terminal).

    Attributes:
        t_ns: Instant of planning.
        t_go_s: Time from it to the capture [s], NaN where there is none.
        costate: (6,) [c1, c2] of the primer vector p = c2 - c1 tau, tau from t_ns, of unit norm;
            NaN for a plan with ``thrust``.
        a_max: Bound on the thrust, or its constant magnitude where the turn of the gripper delays
            the capture [m/s2].
        lower_bound_s: Certified lower bound of t_go_s [s].
        position_error_m, velocity_error_mps: Terminal errors of the propagated plan.
        u_max: Largest |u| found along the propagated plan [m/s2].
        latency_s: Coasting time before the thrust [s].
        thrust: (n, 3) acceleration in {A} over n equal intervals [m/s2]; None where the costate
            defines the thrust.
        violation_m: Largest excess over the geometric constraints along the plan [m]; NaN without
            constraints.
        margin_m, binding: Smallest margin of the geometric constraints along the plan [m], and the
            constraint with it; NaN and "" without constraints.
        abort_margin_m: Lower bound of the smallest margin of ``withdrawal_clearance_m`` if the
            robot withdraws at any instant of the plan [m]; NaN: not checked, without a clearance.
        passive_margin_m, passive_safe_s: The same of a robot that coasts after a cut of its thrust
            [m], and the time from t_ns up to which a cut is safe [s].
        escapes: (m, 4) begins of ranges of instants of the path [s after its begin], ascending, and
            the direction in {A} in which the robot withdraws in each; None: not planned.
        steps: Number of steps of the search.
        attitude_s: Time from t_ns until the gripper has attitude and rate of the fixture [s]; NaN
            where not planned.
        delayed_by: What makes the capture later than the flight alone: "attitude" (the turn of the
            gripper), "arm" (the joints); "" where nothing does.
    """

    t_ns: int
    status: PlanStatus
    t_go_s: float
    costate: Array
    a_max: float
    lower_bound_s: float
    position_error_m: float
    velocity_error_mps: float
    u_max: float
    latency_s: float = 0.0
    thrust: Array | None = None
    violation_m: float = math.nan
    margin_m: float = math.nan
    binding: str = ""
    abort_margin_m: float = math.nan
    passive_margin_m: float = math.nan
    passive_safe_s: float = math.nan
    escapes: Array | None = None
    steps: int = 0
    attitude_s: float = math.nan
    delayed_by: str = ""

    @property
    def gap_s(self) -> float:
        """Difference between the time to go and its certified lower bound [s]."""
        return self.t_go_s - self.lower_bound_s

    @property
    def found(self) -> bool:
        """Return whether there is a capture to fly."""
        return self.status in (PlanStatus.OPTIMAL, PlanStatus.FEASIBLE)


@value_class(kw_only=True)
class MonitorReport:
    """What the monitors report after a scan.

    Attributes:
        ogm_rank: numerical rank of the scaled observability Gramian, at most 20.
        ogm_log10_cond, ogm_log10_cond_scaled: log10 of its condition number as it is and scaled by
            the prior standard deviations; None below full rank.
        consistent: the innovations agree with their covariance; None before there are enough of
            them.
        violations: consistency checks that the estimate has failed so far.
        nis_mean, autocorrelation: mean NIS and lag-1 autocorrelation of white innovations in the
            consistency window.
        converged: the planner may rely on the estimate.
        covariance_converged, predictive_converged: every block of the covariance (the paper's
            criterion), or every predicted standard deviation of the grasp point, is below its
            limit.
        unconverged: blocks whose covariance is above its limit, and two rates where both explain
            the poses.
        alias: the slower and the faster of two angular rates [rad/s] that both explain the poses;
            None where only one does.
        forecast: predicted standard deviations of the grasp point over the convergence horizon.
    """

    ogm_rank: int
    ogm_log10_cond: float | None
    ogm_log10_cond_scaled: float | None
    consistent: bool | None
    violations: int
    nis_mean: float | None
    autocorrelation: float | None
    converged: bool
    covariance_converged: bool
    predictive_converged: bool
    unconverged: tuple[str, ...]
    alias: tuple[float, float] | None
    forecast: Forecast


@value_class
class BodyParameters:
    """Parameters of the target in {C}, independent of the order of the principal axes.

    Attributes:
        inertia, inertia_1s: (3, 3) inertia tensor about the centre of mass over its trace, and 1
            sigma of its entries.
        moments, moments_1s: (3,) principal moments over their sum, ascending, and their 1 sigma.
        centre_c, centre_1s_m, rate_c, rate_1s_radps: (3,) centre of mass and angular rate, 1 sigma
            by root of trace.
        limited_1s: 1 sigma of sigma1, sigma2, varrho [m] and mu (half angle), at most that without
            any information.
    """

    inertia: Array
    inertia_1s: Array
    moments: Array
    moments_1s: Array
    centre_c: Array
    centre_1s_m: float
    rate_c: Array
    rate_1s_radps: float
    limited_1s: tuple[float, float, float, float]


@value_class(kw_only=True)
class Outcome:
    """Result of the pipeline for one scan.

    Attributes:
        scan: the scan itself.
        start_ns: instant of the first scan of the replay.
        guess: where the initial guess of the registration came from.
        alignment: the graded pose.
        innovation: None where no pose was measured.
        verdict: gamma and its reason.
        belief: estimate after the update.
        pose: estimated T_ac.
        pose_covariance: (6, 6) covariance of that pose: position in {A} [m], half-angle vector in
            {B} [rad].
        body: inertia, mass centre and rate in {C}.
        estimator: estimator in use: near, start, fit or filter.
        moves: what the poses show of the target's motion.
        disturbances: root densities of the random torque [rad/s^1.5] and force [m/s^1.5] that the
            estimate allows for; None where it states none.
        sigma_hits: how often a bound of the inertia ratios limited the gain.
        r_floors: how often an eigenvalue of R was raised to its floor.
        reinitialised: how often the filter or the given start was replaced by a fit so far.
        manoeuvres: all changes of the target's velocity found so far.
        drift: constant torque or force, if any.
        cause: what the poses so far show besides free motion, in words.
        monitors: observability, consistency and convergence.
        action, supervisor_rule: command of the supervisor to the robot, and the rule that gave it.
        plan: capture plan in force, None before the first.
    """

    scan: Scan
    start_ns: int
    guess: str
    alignment: Alignment
    innovation: Innovation | None
    verdict: Verdict
    belief: Belief
    pose: Pose
    pose_covariance: Array
    body: BodyParameters
    estimator: str
    moves: Moves
    disturbances: tuple[float, float] | None
    sigma_hits: int
    r_floors: int
    reinitialised: int
    manoeuvres: tuple[Manoeuvre, ...]
    drift: Drift | None
    monitors: MonitorReport
    action: str
    supervisor_rule: str
    plan: Plan | None
    cause: str = ""


@value_class(eq=True)
class PoseError:
    """Difference of two poses: the distance of their origins [m] and the angle between their
    attitudes [deg].
    """

    distance_m: float
    angle_deg: float


@value_class(eq=True)
class CaptureError:
    """Errors of the gripper relative to the true grasp point at the planned instant; NaN where the
    truth is not known at that instant.
    """

    distance_m: float
    speed_mps: float
    angle_deg: float


@value_class(kw_only=True)
class Score:
    """The comparison of an outcome with ground truth; a value is None where there is no truth for
    it.

    Attributes:
        fault: kind of the injected fault at the scan.
        reference: "truth", or "fit" (a motion fitted to all healthy poses).
        estimate, registration: errors of the estimated and of the registered pose.
        nees, nees_blocks: normalised estimation error squared, for the order of the principal axes
            in which it is smallest, in total and for each block of the state.
        planned: error of a plan that was made at this scan, at its planned instant.
        captured: error of a capture since the scan before.
    """

    fault: str | None = None
    reference: str | None = None
    estimate: PoseError | None = None
    registration: PoseError | None = None
    nees: float | None = None
    nees_blocks: Mapping[str, float] = field(default_factory=dict)
    planned: CaptureError | None = None
    captured: CaptureError | None = None
