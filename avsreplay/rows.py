"""The row of a scan. Each column is declared once: value, meaning, unit, format, golden tolerance.

JSONL, CSV and Parquet files, tables, golden comparisons, docs/columns.md and the JSON schema are made from this
declaration. A row holds results only, no wall clock, host, version or path: the same input gives the same bytes.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np

from avsreplay.outcome import (
    Outcome,
    Score,
    Value,
    capture_error_values,
    change_values,
    finite,
    full_angle_deg,
    if_innovation,
    if_measured,
    if_planned,
    if_points,
    pose_error_values,
    position_1s_m,
    since_start_s,
    status,
)

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Column:
    """Metadata of a row field.

    Attributes:
        name: field name, with its unit as suffix where it has one.
        unit: as printed in table headings, "" if none.
        fmt: format specification for tables.
        rtol, atol: relative and absolute golden tolerance; both 0 means exact.
        doc: meaning.
        table: shown in the per-scan table.
    """

    name: str
    unit: str
    fmt: str
    rtol: float
    atol: float
    doc: str
    table: bool


def column(
    value: Value[T],
    doc: str,
    unit: str = "",
    fmt: str = "",
    rtol: float = 0.0,
    atol: float = 0.0,
    table: bool = False,
) -> T:
    """Declare a row field: its value and its metadata. Every field's default is None.

    Args:
        value: takes the value from an outcome and its score.
        doc: meaning.
        unit: as printed in table headings, "" if none.
        fmt: format specification for tables.
        rtol: relative golden tolerance; 0 with ``atol`` 0 means exact.
        atol: absolute golden tolerance.
        table: shown in the per-scan table.
    """
    meta = {"unit": unit, "fmt": fmt, "rtol": rtol, "atol": atol, "doc": doc, "table": table, "value": value}
    return cast(T, dataclasses.field(default=None, metadata=meta))


def _metres(value: Value[T], doc: str) -> T:
    return column(value, doc, "m", ".4f", 1e-5, 1e-6)


def _error_m(value: Value[T], doc: str, unit: str = "m", table: bool = False) -> T:
    return column(value, doc, unit, ".4f", 1e-3, 1e-5, table)


def _error_deg(value: Value[T], doc: str, table: bool = False) -> T:
    return column(value, doc, "deg", ".3f", 1e-3, 1e-3, table)


def _seconds(value: Value[T], doc: str, table: bool = False) -> T:
    return column(value, doc, "s", ".2f", 1e-4, 1e-3, table)


def _number(value: Value[T], doc: str, unit: str = "", fmt: str = ".4g", table: bool = False, atol: float = 1e-6) -> T:
    return column(value, doc, unit, fmt, 1e-4, atol, table)


def _exact(value: Value[T], doc: str, table: bool = False) -> T:
    return column(value, doc, table=table)


_ESTIMATE, _REGISTRATION = pose_error_values(lambda s: s.estimate), pose_error_values(lambda s: s.registration)
_PUSH, _DRIFT = change_values(lambda o: o.manoeuvres[-1] if o.manoeuvres else None), change_values(lambda o: o.drift)
_PLANNED, _CAPTURED = capture_error_values(lambda s: s.planned), capture_error_values(lambda s: s.captured)


def _nees(block: str, name: str) -> float | None:
    value: Value[float | None] = lambda o, s: finite(s.nees_blocks.get(block))  # noqa: E731
    return column(value, f"Normalised estimation error squared of {name}.", "", ".2f", 1e-2, 1e-3)


# fmt: off
@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The result of one scan. None: does not apply (no truth, no measurement, no plan, no fault)."""

    seq: int = _exact(lambda o, s: o.scan.seq, "Index of the scan in the replay, from 0.", table=True)
    t_ns: int = _exact(lambda o, s: o.scan.t_ns, "Time of the scan on the selected clock [ns].")
    t_s: float = column(lambda o, s: since_start_s(o, o.scan.t_ns), "Time since the first scan.",
        "s", ".2f", 0.0, 1e-9, table=True)
    status: str = _exact(lambda o, s: status(o), "Status of the registration; of the scan itself if that is not ok.",
        table=True)
    gamma: int = _exact(lambda o, s: o.verdict.gamma,
        "1: the scan is healthy and updates the filter; 0: it is faulty and the filter only predicts.", table=True)
    reason: str = _exact(lambda o, s: o.verdict.reason.value, "Why gamma is 0; ok where gamma is 1.", table=True)
    guess: str = _exact(lambda o, s: o.guess, "Initial guess of the registration: predicted (by the filter), last"
        " (healthy pose), acquired (search without a guess), measured (a pose of the log needs none); until the first"
        " healthy scan the source of the first pose: start (in the log), truth, given (by an option) or acquired.")
    fault: str | None = _exact(lambda o, s: s.fault, "Label of the fault that was injected into this scan.", table=True)
    message: str | None = _exact(lambda o, s: o.alignment.message or o.scan.note or None,
        "Error of the back end, or what was wrong with the recorded message or its stamp.")

    points: int | None = _exact(lambda o, s: None if o.scan.pose else len(o.scan.points), "Finite points in the scan.")
    iterations: int | None = _exact(if_points(lambda o: o.alignment.iterations), "Iterations of the registration.",
        table=True)
    inliers: int | None = column(if_points(lambda o: o.alignment.inliers),
        "Points closer to the model than the last rejection distance.", "", "d", 1e-3, 3)
    inlier_ratio: float | None = column(if_points(lambda o: o.alignment.inlier_ratio),
        "Inliers divided by points.", "", ".3f", 1e-3, 1e-3, table=True)
    rms_m: float | None = column(if_points(lambda o: finite(o.alignment.rms_m)),
        "Root mean square distance of the inliers to the model.", "m", ".5f", 1e-4, 1e-7, table=True)
    free_directions: str | None = _exact(lambda o, s: o.alignment.free_directions or None,
        "Directions that the registration cannot determine, in words.")
    split_nis: float | None = _number(if_points(lambda o: finite(o.alignment.split_nis)), "Normalised squared"
        " difference of the poses from two halves of the scan, the larger of left/right and top/bottom.", fmt=".1f")
    reg_x_m: float | None = _metres(if_measured(lambda T: T.t[0]), "Measured position of {C} in {A}.")
    reg_y_m: float | None = _metres(if_measured(lambda T: T.t[1]), "See reg_x_m.")
    reg_z_m: float | None = _metres(if_measured(lambda T: T.t[2]), "See reg_x_m.")
    reg_qx: float | None = _number(if_measured(lambda T: T.q[0]), "Measured attitude q_ac, scalar last, w >= 0.")
    reg_qy: float | None = _number(if_measured(lambda T: T.q[1]), "See reg_qx.")
    reg_qz: float | None = _number(if_measured(lambda T: T.q[2]), "See reg_qx.")
    reg_qw: float | None = _number(if_measured(lambda T: T.q[3]), "See reg_qx.")

    nis: float | None = column(if_innovation(lambda i: finite(i.nis)),
        "Normalised innovation squared; chi-square with 6 degrees of freedom if the filter is consistent.",
        "", ".2f", 1e-3, 1e-4, table=True)
    cauchy_weight: float | None = _number(if_innovation(lambda i: i.weight),
        "Cauchy weight of the pose in the update; 1 up to the 99.99 % point of NIS.", atol=1e-4)
    innov_m: float | None = _metres(if_innovation(lambda i: finite(i.distance_m)),
        "Length of the position innovation.")
    innov_deg: float | None = column(if_innovation(lambda i: finite(np.degrees(i.angle_rad))),
        "Rotation angle of the attitude innovation.", "deg", ".3f", 1e-4, 1e-4)

    estimator: str = _exact(lambda o, s: o.estimator, "Estimator in use: near (given initial state, before the first"
        " healthy scan), start (first poses of a cold start), fit (maximum-likelihood fit to all poses), filter.")
    x_m: float | None = _metres(lambda o, s: float(o.pose.t[0]), "Estimated position of {C} in {A} after the update.")
    y_m: float | None = _metres(lambda o, s: float(o.pose.t[1]), "See x_m.")
    z_m: float | None = _metres(lambda o, s: float(o.pose.t[2]), "See x_m.")
    qx: float | None = _number(lambda o, s: float(o.pose.q[0]), "Estimated attitude q_ac, scalar last, w >= 0.")
    qy: float | None = _number(lambda o, s: float(o.pose.q[1]), "See qx.")
    qz: float | None = _number(lambda o, s: float(o.pose.q[2]), "See qx.")
    qw: float | None = _number(lambda o, s: float(o.pose.q[3]), "See qx.")
    pos_1s_m: float | None = _number(lambda o, s: position_1s_m(o.pose_covariance),
        "Standard deviation of the estimated position (root of the trace of its covariance).", "m")
    rot_1s_deg: float | None = _number(lambda o, s: full_angle_deg(np.diag(o.pose_covariance)[3:].sum()),
        "Standard deviation of the estimated attitude (root of the trace of its covariance).", "deg")
    wx_radps: float | None = _number(lambda o, s: float(o.belief.x.w_b[0]), "Angular rate in {B}.", "rad/s")
    wy_radps: float | None = _number(lambda o, s: float(o.belief.x.w_b[1]), "See wx_radps.", "rad/s")
    wz_radps: float | None = _number(lambda o, s: float(o.belief.x.w_b[2]), "See wx_radps.", "rad/s")
    rx_m: float | None = _metres(lambda o, s: float(o.belief.x.r_a[0]), "Centre of mass in {A}.")
    ry_m: float | None = _metres(lambda o, s: float(o.belief.x.r_a[1]), "See rx_m.")
    rz_m: float | None = _metres(lambda o, s: float(o.belief.x.r_a[2]), "See rx_m.")
    vx_mps: float | None = _number(lambda o, s: float(o.belief.x.v_a[0]), "Velocity of the centre of mass in {A}.",
        "m/s")
    vy_mps: float | None = _number(lambda o, s: float(o.belief.x.v_a[1]), "See vx_mps.", "m/s")
    vz_mps: float | None = _number(lambda o, s: float(o.belief.x.v_a[2]), "See vx_mps.", "m/s")
    sigma1: float | None = _number(lambda o, s: float(o.belief.x.sigma[0]), "Inertia ratio (Iyy - Izz) / Ixx.",
        fmt=".4f", table=True)
    sigma2: float | None = _number(lambda o, s: float(o.belief.x.sigma[1]), "Inertia ratio (Izz - Ixx) / Iyy.",
        fmt=".4f", table=True)
    sigma1_1s: float | None = _number(lambda o, s: o.body.limited_1s[0],
        "Standard deviation of sigma1, at most that of a value anywhere in its range.")
    sigma2_1s: float | None = _number(lambda o, s: o.body.limited_1s[1], "Standard deviation of sigma2.")
    cx_m: float | None = _metres(lambda o, s: float(o.belief.x.c_b[0]), "Position of the fixture in {B} (varrho).")
    cy_m: float | None = _metres(lambda o, s: float(o.belief.x.c_b[1]), "See cx_m.")
    cz_m: float | None = _metres(lambda o, s: float(o.belief.x.c_b[2]), "See cx_m.")
    c_1s_m: float | None = _number(lambda o, s: o.body.limited_1s[2],
        "Standard deviation of varrho (root of the trace), at most that of any direction.", "m")
    mux: float | None = _number(lambda o, s: float(o.belief.x.q_bc[0]), "Fixture attitude mu = q_bc, scalar last.")
    muy: float | None = _number(lambda o, s: float(o.belief.x.q_bc[1]), "See mux.")
    muz: float | None = _number(lambda o, s: float(o.belief.x.q_bc[2]), "See mux.")
    muw: float | None = _number(lambda o, s: float(o.belief.x.q_bc[3]), "See mux.")
    mu_1s_deg: float | None = _number(lambda o, s: full_angle_deg(o.body.limited_1s[3] ** 2),
        "Standard deviation of mu (root of the trace).", "deg")
    com_x_m: float | None = _metres(lambda o, s: float(o.body.centre_c[0]), "Centre of mass in {C}.")
    com_y_m: float | None = _metres(lambda o, s: float(o.body.centre_c[1]), "See com_x_m.")
    com_z_m: float | None = _metres(lambda o, s: float(o.body.centre_c[2]), "See com_x_m.")
    com_1s_m: float | None = _number(lambda o, s: o.body.centre_1s_m,
        "Standard deviation of the centre of mass in {C} (root of the trace).", "m")
    rate_cx_radps: float | None = _number(lambda o, s: float(o.body.rate_c[0]), "Angular rate in {C}.", "rad/s")
    rate_cy_radps: float | None = _number(lambda o, s: float(o.body.rate_c[1]), "See rate_cx_radps.", "rad/s")
    rate_cz_radps: float | None = _number(lambda o, s: float(o.body.rate_c[2]), "See rate_cx_radps.", "rad/s")
    rate_c_1s_radps: float | None = _number(lambda o, s: o.body.rate_1s_radps,
        "Standard deviation of the angular rate in {C} (root of the trace).", "rad/s")
    ixx: float | None = _number(lambda o, s: float(o.body.inertia[0, 0]),
        "Inertia tensor about the centre of mass, in {C}, divided by its trace; independent of the order of the axes.")
    iyy: float | None = _number(lambda o, s: float(o.body.inertia[1, 1]), "See ixx.")
    izz: float | None = _number(lambda o, s: float(o.body.inertia[2, 2]), "See ixx.")
    ixy: float | None = _number(lambda o, s: float(o.body.inertia[0, 1]), "See ixx.")
    ixz: float | None = _number(lambda o, s: float(o.body.inertia[0, 2]), "See ixx.")
    iyz: float | None = _number(lambda o, s: float(o.body.inertia[1, 2]), "See ixx.")
    inertia_1s: float | None = _number(lambda o, s: float(o.body.inertia_1s.max()),
        "Largest standard deviation of an entry of that tensor.")
    moment_small: float | None = _number(lambda o, s: float(o.body.moments[0]),
        "Smallest principal moment of inertia, divided by the sum of the three.")
    moment_middle: float | None = _number(lambda o, s: float(o.body.moments[1]), "See moment_small.")
    moment_large: float | None = _number(lambda o, s: float(o.body.moments[2]), "See moment_small.")
    moments_1s: float | None = _number(lambda o, s: float(o.body.moments_1s.max()),
        "Largest standard deviation of the three moments.")

    pos_err_m: float | None = _error_m(_ESTIMATE[0], "Distance of the estimated from the true position.", table=True)
    rot_err_deg: float | None = _error_deg(_ESTIMATE[1], "Angle between estimated and true attitude.", table=True)
    reg_pos_err_m: float | None = _error_m(_REGISTRATION[0], "Distance of the measured from the true position.")
    reg_rot_err_deg: float | None = _error_deg(_REGISTRATION[1], "Angle between measured and true attitude.")
    reference: str | None = _exact(lambda o, s: s.reference,
        "What the errors are computed against: truth, or fit (one motion fitted to all healthy poses).")
    nees: float | None = column(lambda o, s: finite(s.nees), "Normalised estimation error squared of the 20 states;"
        " the order of the principal axes that is nearest to the estimate is used.", "", ".2f", 1e-2, 1e-3)
    nees_attitude: float | None = _nees("attitude", "the attitude of the principal axes")
    nees_rate: float | None = _nees("rate", "the angular rate")
    nees_position: float | None = _nees("position", "the centre of mass")
    nees_velocity: float | None = _nees("velocity", "its velocity")
    nees_sigma: float | None = _nees("sigma", "the inertia ratios")
    nees_varrho: float | None = _nees("varrho", "the fixture position")
    nees_mu: float | None = _nees("mu", "the fixture attitude")

    r_pos_m: float | None = _number(if_innovation(lambda i: float(np.sqrt(np.diag(i.R)[:3].mean()))),
        "Adapted measurement noise of the position (root of the mean variance in R).", "m")
    r_rot_deg: float | None = _number(if_innovation(lambda i: full_angle_deg(np.diag(i.R)[3:].mean())),
        "Adapted measurement noise of the attitude (root of the mean variance in R).", "deg")
    sigma_hits: int | None = _exact(lambda o, s: o.sigma_hits,
        "How often a bound on sigma1 or sigma2 limited the Kalman gain, up to this scan.")
    r_floors: int | None = _exact(lambda o, s: o.r_floors,
        "How many eigenvalues of R were raised to the lower limit, up to this scan.")
    reinitialised: int | None = _exact(lambda o, s: o.reinitialised,
        "How often the poses contradicted the filter or the given initial state, so that a fit replaced it.")
    manoeuvres: int | None = _exact(lambda o, s: len(o.manoeuvres),
        "Number of manoeuvres found so far: changes of the target's velocity that free motion does not explain.")
    manoeuvre_s: float | None = _seconds(_PUSH[0], "Instant of the last manoeuvre, since the first scan.")
    manoeuvre_1s_s: float | None = _seconds(_PUSH[1], "Standard deviation of manoeuvre_s.")
    manoeuvre_mps: float | None = _number(_PUSH[2], "Change of the mass centre's velocity by it.", "m/s")
    manoeuvre_1s_mps: float | None = _number(_PUSH[3], "Standard deviation of that change (root of the trace).", "m/s")
    manoeuvre_radps: float | None = _number(_PUSH[4], "Change of the angular rate by it.", "rad/s")
    manoeuvre_1s_radps: float | None = _number(_PUSH[5], "Standard deviation of that (root of the trace).", "rad/s")
    drift_s: float | None = _seconds(_DRIFT[0], "Onset of a constant torque or force, since the first scan.")
    drift_1s_s: float | None = _seconds(_DRIFT[1], "Standard deviation of drift_s.")
    drift_mps2: float | None = _number(_DRIFT[2], "Acceleration by that force.", "m/s2", atol=1e-9)
    drift_1s_mps2: float | None = _number(_DRIFT[3], "Its standard deviation (root of the trace).", "m/s2", atol=1e-9)
    drift_radps2: float | None = _number(_DRIFT[4], "Angular acceleration by that torque.", "rad/s2", atol=1e-9)
    drift_1s_radps2: float | None = _number(_DRIFT[5], "Its standard deviation (root of trace).", "rad/s2", atol=1e-9)

    ogm_log10_cond: float | None = column(lambda o, s: o.monitors.ogm_log10_cond,
        "log10 of the condition number of the observability Gramian; null below full rank.",
        "", ".1f", 1e-3, 1e-2, table=True)
    ogm_log10_cond_scaled: float | None = column(lambda o, s: o.monitors.ogm_log10_cond_scaled,
        "The same with each state scaled by its prior standard deviation.", "", ".1f", 1e-3, 1e-2)
    ogm_rank: int | None = _exact(lambda o, s: o.monitors.ogm_rank,
        "Numerical rank of the scaled observability Gramian; 20 is full.", table=True)
    nis_mean: float | None = _number(lambda o, s: o.monitors.nis_mean,
        "Mean NIS over the consistency window; 6 is expected.", fmt=".2f", atol=1e-4)
    autocorrelation: float | None = _number(lambda o, s: o.monitors.autocorrelation,
        "Lag-1 autocorrelation of the whitened innovations over that window; 0 is expected.", atol=1e-4)
    consistent: bool | None = _exact(lambda o, s: o.monitors.consistent,
        "The mean NIS is below the upper limit of its chi-square interval and few poses have a reduced weight.")
    violations: int | None = _exact(lambda o, s: o.monitors.violations,
        "Consistency checks that the estimate has failed so far; a failed check withdraws converged.")
    converged: bool = _exact(lambda o, s: o.monitors.converged, "The planner may rely on the estimate.", table=True)
    covariance_converged: bool | None = _exact(lambda o, s: o.monitors.covariance_converged,
        "The covariance of every block of states is below its limit (the paper's criterion).")
    predictive_converged: bool | None = _exact(lambda o, s: o.monitors.predictive_converged,
        "The predicted standard deviations of the grasp point are below their limits.")
    unconverged_blocks: str | None = _exact(lambda o, s: ", ".join(o.monitors.unconverged) or None,
        "Blocks of states whose covariance is above its limit.")
    grasp_pos_1s_m: float | None = _number(lambda o, s: float(o.monitors.forecast.pos_1s_m.max()),
        "Largest predicted standard deviation of the grasp point's position over the horizon.", "m")
    grasp_vel_1s_mps: float | None = _number(lambda o, s: float(o.monitors.forecast.vel_1s_mps.max()),
        "Largest predicted standard deviation of its velocity over the horizon.", "m/s")
    grasp_rot_1s_deg: float | None = _number(lambda o, s: float(np.degrees(o.monitors.forecast.rot_1s_rad.max())),
        "Largest predicted standard deviation of its attitude over the horizon.", "deg")

    plan_status: str | None = _exact(lambda o, s: None if o.plan is None else o.plan.status.value,
        "Result of the planner for the plan in force.")
    capture_time_s: float | None = _seconds(if_planned(lambda o, p: since_start_s(o, p.t_ns) + p.t_go_s),
        "Planned time of capture, from the first scan.", table=True)
    t_go_s: float | None = _seconds(if_planned(lambda o, p: p.t_go_s - (o.scan.t_ns - p.t_ns) * 1e-9),
        "Time from this scan to the planned capture.")
    earliest_capture_s: float | None = _seconds(
        lambda o, s: None if o.plan is None else since_start_s(o, o.plan.t_ns) + o.plan.lower_bound_s,
        "Certified lower bound of the time of capture, from the first scan.")
    plan_margin_m: float | None = column(lambda o, s: None if o.plan is None else finite(o.plan.margin_m),
        "Smallest margin of the geometric limits along the plan.", "m", ".4f", 0.0, 0.01)
    plan_limit: str | None = _exact(lambda o, s: None if o.plan is None else o.plan.binding or None,
        "Limit that has the smallest margin: cone, corridor, sphere or body.")
    abort_margin_m: float | None = column(lambda o, s: None if o.plan is None else finite(o.plan.abort_margin_m),
        "Smallest margin of the clearance if the robot aborts at any instant of the plan before the corridor.",
        "m", ".4f", 0.0, 0.01)
    plan_miss_m: float | None = _error_m(_PLANNED[0],
        "Distance of gripper and true grasp point at the end of the plan that was made at this scan.")
    plan_miss_mps: float | None = _error_m(_PLANNED[1], "Their relative speed at that time.", "m/s")
    plan_miss_deg: float | None = _error_deg(_PLANNED[2], "Error of the attitude predicted for that time.")
    action: str = _exact(lambda o, s: o.action, "Command of the supervisor to the robot.", table=True)
    supervisor_rule: str = _exact(lambda o, s: o.supervisor_rule, "Rule of the supervisor that gave this command.")
    capture_miss_m: float | None = _error_m(_CAPTURED[0],
        "Distance of gripper and true grasp point, where the gripper has closed since the last scan.")
    capture_miss_mps: float | None = _error_m(_CAPTURED[1], "Their relative speed at that time.", "m/s")
    capture_miss_deg: float | None = _error_deg(_CAPTURED[2], "Attitude error at that time.")

    @classmethod
    def of(cls, outcome: Outcome, score: Score) -> Row:
        """Flatten an outcome and its score into the row of the scan.

        Args:
            outcome: result of the pipeline for the scan.
            score: its comparison with the ground truth.
        """
        return cls(**{name: value(outcome, score) for name, value in _VALUES})


# fmt: on
_VALUES = tuple((f.name, f.metadata["value"]) for f in dataclasses.fields(Row))


def columns() -> tuple[Column, ...]:
    """Every column in order."""
    names = [f.name for f in dataclasses.fields(Column) if f.name != "name"]
    return tuple(Column(f.name, **{n: f.metadata[n] for n in names}) for f in dataclasses.fields(Row))
