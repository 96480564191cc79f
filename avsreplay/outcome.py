"""The typed result of one scan: plan, outcome of the pipeline, and score against ground truth.

``pipeline.step`` makes the Outcome without access to ground truth; ``score.Scorer`` makes the Score afterwards;
``rows.Row.of`` turns the two into columns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TypeVar

import numpy as np

from avsreplay.geometry import Array, Pose
from avsreplay.records import (
    Alignment,
    Belief,
    BodyParameters,
    Drift,
    Forecast,
    Innovation,
    Manoeuvre,
    Scan,
    ScanStatus,
    Verdict,
)


class PlanStatus(Enum):
    """Result of the planner."""

    OPTIMAL = "optimal"  # first feasible time, certified to the stated gap
    FEASIBLE = "feasible"  # satisfies all constraints; no claim of least time
    NOT_FOUND = "none_found"  # the search found no plan; there may be one
    INFEASIBLE = "infeasible_within_horizon"  # certified: there is no plan within the horizon
    NO_CONVERGENCE = "no_convergence"


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A rendezvous in least time: meet the grasp point in position and velocity with |u| <= a_max (eq:terminal).

    Attributes:
        t_ns: Instant of planning.  t_go_s: Time from it to the capture [s], NaN where there is none.
        costate: (6,) [c1, c2] of the primer vector p = c2 - c1 tau, tau from t_ns, of unit norm; NaN for a plan with
            ``thrust``.
        a_max: Bound on the thrust, or its constant magnitude where the turn of the gripper delays the capture [m/s2].
        lower_bound_s: Certified lower bound of t_go_s [s].
        position_error_m, velocity_error_mps: Terminal errors of the propagated plan.
        u_max: Largest |u| found along the propagated plan [m/s2].
        latency_s: Coasting time before the thrust [s].
        thrust: (n, 3) acceleration in {A} over n equal intervals [m/s2]; None where the costate defines the thrust.
        violation_m: Largest excess over the geometric constraints along the plan [m]; NaN without constraints.
        margin_m, binding: Smallest margin of the geometric constraints along the plan [m], and the constraint with it;
            NaN and "" without constraints.
        abort_margin_m: Smallest margin of the clearance if the robot aborts at any instant before the corridor [m]; NaN
            without a clearance.
        steps: Number of steps of the search.
        attitude_s: Time from t_ns until the gripper has attitude and rate of the fixture [s]; NaN where not planned.
        delayed_by: What makes the capture later than the flight alone: "attitude" (the turn of the gripper), "arm" (the
            joints); "" where nothing does.
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


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MonitorReport:
    """What the monitors report after a scan.

    Attributes:
        ogm_rank: numerical rank of the scaled observability Gramian, at most 20.
        ogm_log10_cond, ogm_log10_cond_scaled: log10 of its condition number as it is and scaled by the prior standard
            deviations; None below full rank.
        consistent: the innovations agree with their covariance; None before there are enough of them.
        violations: consistency checks that the estimate has failed so far.
        nis_mean, autocorrelation: mean NIS and lag-1 autocorrelation of white innovations in the consistency window.
        converged: the planner may rely on the estimate.
        covariance_converged, predictive_converged: every block of the covariance (the paper's criterion), or every
            predicted standard deviation of the grasp point, is below its limit.
        unconverged: blocks whose covariance is above its limit.
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
    forecast: Forecast


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Outcome:
    """Result of the pipeline for one scan.

    Attributes:
        scan: the scan itself.  start_ns: instant of the first scan of the replay.
        guess: where the initial guess of the registration came from.
        alignment: the graded pose.  innovation: None where no pose was measured.
        verdict: gamma and its reason.
        belief: estimate after the update.
        pose: estimated T_ac.
        pose_covariance: (6, 6) covariance of that pose: position in {A} [m], half-angle vector in {B} [rad].
        body: inertia, mass centre and rate in {C}.
        estimator: estimator in use: near, start, fit or filter.
        sigma_hits, r_floors: how often a bound of the inertia ratios limited the gain, and a floor an eigenvalue of R.
        reinitialised: how often the filter or the given start was replaced by a fit so far.
        manoeuvres: all changes of the target's velocity found so far.  drift: constant torque or force, if any.
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
    sigma_hits: int
    r_floors: int
    reinitialised: int
    manoeuvres: tuple[Manoeuvre, ...]
    drift: Drift | None
    monitors: MonitorReport
    action: str
    supervisor_rule: str
    plan: Plan | None


@dataclass(frozen=True, slots=True)
class PoseError:
    """Difference of two poses: distance of their origins [m] and angle between their attitudes [deg]."""

    distance_m: float
    angle_deg: float


@dataclass(frozen=True, slots=True)
class CaptureError:
    """Gripper against true grasp point at the planned instant; NaN where the truth is not known at that instant."""

    distance_m: float
    speed_mps: float
    angle_deg: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Score:
    """An outcome compared with ground truth; None where there is no truth for it.

    Attributes:
        fault: label of the injected fault.  reference: "truth", or "fit" (a motion fitted to all healthy poses).
        estimate, registration: errors of the estimated and of the measured pose.
        nees, nees_blocks: normalised estimation error squared, for the best order of the principal axes, and by block.
        planned: error of a plan made at this scan at its planned instant.  captured: of a capture since the last scan.
    """

    fault: str | None = None
    reference: str | None = None
    estimate: PoseError | None = None
    registration: PoseError | None = None
    nees: float | None = None
    nees_blocks: Mapping[str, float] = field(default_factory=dict)
    planned: CaptureError | None = None
    captured: CaptureError | None = None


T = TypeVar("T")
Value = Callable[[Outcome, Score], T]
"""Takes the value of a column from an outcome and its score."""


def finite(value: float | None) -> float | None:
    """Return a value, or None where it is None, NaN or infinite.

    Args:
        value: the value.
    """
    return float(value) if value is not None and np.isfinite(value) else None


def if_innovation(get: Callable[[Innovation], float | None]) -> Value[float | None]:
    """Return a column value taken from the innovation, None where nothing was measured.

    Args:
        get: takes the value from the innovation.
    """
    return lambda o, s: None if o.innovation is None else get(o.innovation)


def if_planned(get: Callable[[Outcome, Plan], T]) -> Value[T | None]:
    """Return a column value taken from the capture plan in force, None where there is none.

    Args:
        get: takes the value from the outcome and its plan.
    """
    return lambda o, s: get(o, o.plan) if o.plan is not None and o.plan.found else None


def change_values(get: Callable[[Outcome], Manoeuvre | None]) -> tuple[Value[float | None], ...]:
    """Return the column values of a manoeuvre or a drift, None where there is none.

    Args:
        get: takes it from the outcome.

    Returns:
        Instant [s], size of the linear part, size of the angular part, each followed by its standard deviation.
    """

    def of(value: Callable[[Outcome, Manoeuvre], float]) -> Value[float | None]:
        return lambda o, s: None if (change := get(o)) is None else float(value(o, change))

    return (
        of(lambda o, m: since_start_s(o, m.t_ns)),
        of(lambda o, m: m.t_1s_s),
        of(lambda o, m: float(np.linalg.norm(m.velocity))),
        of(lambda o, m: math.sqrt(np.trace(m.P[3:, 3:]))),
        of(lambda o, m: float(np.linalg.norm(m.rate))),
        of(lambda o, m: math.sqrt(np.trace(m.P[:3, :3]))),
    )


def if_measured(get: Callable[[Pose], float]) -> Value[float | None]:
    """Return a column value that ``get`` takes from the registered pose, None where nothing was measured."""
    return lambda o, s: float(get(o.alignment.T_ac)) if o.alignment.measured else None


def if_points(get: Callable[[Outcome], T]) -> Value[T | None]:
    """Return a column value of the registration, None where the scan holds no point.

    Args:
        get: takes the value from the outcome.
    """
    return lambda o, s: get(o) if len(o.scan.points) else None


def pose_error_values(get: Callable[[Score], PoseError | None]) -> tuple[Value[float | None], Value[float | None]]:
    """Return the column values of a pose error: distance [m] and angle [deg], None without truth.

    Args:
        get: takes the pose error from the score.
    """
    return (
        lambda o, s: None if (error := get(s)) is None else error.distance_m,
        lambda o, s: None if (error := get(s)) is None else error.angle_deg,
    )


def capture_error_values(
    get: Callable[[Score], CaptureError | None],
) -> tuple[Value[float | None], Value[float | None], Value[float | None]]:
    """Return the column values of a capture error: distance [m], speed [m/s] and angle [deg], None where there is none.

    Args:
        get: takes the capture error from the score.
    """
    return (
        lambda o, s: None if (error := get(s)) is None else finite(error.distance_m),
        lambda o, s: None if (error := get(s)) is None else finite(error.speed_mps),
        lambda o, s: None if (error := get(s)) is None else finite(error.angle_deg),
    )


def full_angle_deg(variance: float) -> float:
    """Return the standard deviation of a full angle [deg].

    Args:
        variance: variance of the half angle [rad^2]; negative values count as 0.
    """
    return float(np.degrees(2.0 * np.sqrt(max(float(variance), 0.0))))


def position_1s_m(covariance: Array) -> float:
    """Return the root of the trace of the position block [m].

    Args:
        covariance: (6, 6) covariance of a pose, position first [m2].
    """
    return float(np.sqrt(max(np.diag(covariance)[:3].sum(), 0.0)))


def since_start_s(outcome: Outcome, t_ns: int) -> float:
    """Return the seconds from the first scan of the replay to an instant.

    Args:
        outcome: any outcome of the replay.
        t_ns: the instant [ns].
    """
    return (t_ns - outcome.start_ns) * 1e-9


def status(outcome: Outcome) -> str:
    """Return the status of the alignment, or of the scan where that is not ok.

    Args:
        outcome: outcome of the scan.
    """
    scan = outcome.scan.status
    return outcome.alignment.status.value if scan is ScanStatus.OK else scan.value
