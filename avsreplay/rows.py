"""One row a scan, declared once: value, unit, format, golden tolerance and meaning stand beside each field.

JSONL and CSV columns, table heads, golden tolerances, the docs' column list and the JSON schema are read from here.
A row holds results only: no wall clock, host, version or path, so the same input gives the same bytes.
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
    deviation,
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
from avsreplay.records import BLOCKS

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Column:
    """What a row field means.

    Attributes:
        name: field name, with its unit as suffix where it has one.  unit: as printed in heads, "" if none.
        fmt: format spec for people.  rtol, atol: golden tolerance (both 0: exact).  doc: one sentence.
        table: shown in the per-scan table by default.
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
    """Declare a row field: its value and its metadata. Every field's default is None."""
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


def _flag(value: Value[T], doc: str, table: bool = False) -> T:
    return column(value, doc, table=table)


_ESTIMATE, _REGISTRATION = pose_error_values(lambda s: s.estimate), pose_error_values(lambda s: s.registration)
_PLANNED, _CAPTURED = capture_error_values(lambda s: s.planned), capture_error_values(lambda s: s.captured)


def _nees(block: str) -> float | None:
    value: Value[float | None] = lambda o, s: finite(s.nees_blocks.get(block))  # noqa: E731
    return column(value, f"the same of the block '{block}' alone", "", ".2f", 1e-2, 1e-3)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What one scan did. None where there is nothing to say: no truth, no measurement, not converged, no fault."""

    seq: int = _flag(lambda o, s: o.scan.seq, "place of the scan in the replay, from 0", table=True)
    t_ns: int = _flag(lambda o, s: o.scan.t_ns, "instant of the scan on the chosen clock [ns]")
    t_s: float = column(
        lambda o, s: since_start_s(o, o.scan.t_ns), "time since the first scan", "s", ".2f", 0.0, 1e-09, table=True
    )
    status: str = _flag(lambda o, s: status(o), "what the door and the ruler found of the scan", table=True)
    gamma: int = _flag(
        lambda o, s: o.verdict.gamma, "1: healthy, used by the filter; 0: faulty, the filter coasts", table=True
    )
    reason: str = _flag(lambda o, s: o.verdict.reason.value, "why gamma is 0; 'ok' where it is 1", table=True)
    guess: str = _flag(
        lambda o, s: o.guess, "where the registration's guess came from: init, predicted, last, acquired"
    )
    fault: str | None = _flag(lambda o, s: s.fault, "label of the fault injected into this scan", table=True)

    points: int = _flag(lambda o, s: len(o.scan.points), "finite points in the scan")
    iterations: int | None = _flag(
        if_points(lambda o: o.alignment.iterations), "passes of the registration", table=True
    )
    inliers: int | None = column(
        if_points(lambda o: o.alignment.inliers),
        "points within the rejection distance of the model",
        "",
        "d",
        0.001,
        3,
    )
    inlier_ratio: float | None = column(
        if_points(lambda o: o.alignment.inlier_ratio), "inliers over points", "", ".3f", 0.001, 0.001, table=True
    )
    rms_m: float | None = column(
        if_points(lambda o: finite(o.alignment.rms_m)),
        "root of the mean squared fit error over the inliers",
        "m",
        ".5f",
        0.0001,
        1e-07,
        table=True,
    )
    weakest: str | None = _flag(lambda o, s: o.alignment.weakest or None, "directions the view leaves free, in words")
    reg_x_m: float | None = _metres(if_measured(lambda T: T.t[0]), "registration's pose of {C} in {A}")
    reg_y_m: float | None = _metres(if_measured(lambda T: T.t[1]), "see reg_x_m")
    reg_z_m: float | None = _metres(if_measured(lambda T: T.t[2]), "see reg_x_m")
    reg_qx: float | None = _number(if_measured(lambda T: T.q[0]), "measured attitude q_ac, scalar last, w >= 0")
    reg_qy: float | None = _number(if_measured(lambda T: T.q[1]), "see reg_qx")
    reg_qz: float | None = _number(if_measured(lambda T: T.q[2]), "see reg_qx")
    reg_qw: float | None = _number(if_measured(lambda T: T.q[3]), "see reg_qx")

    nis: float | None = column(
        if_innovation(lambda i: i.nis),
        "normalised innovation squared, chi-square of 6",
        "",
        ".2f",
        0.001,
        0.0001,
        table=True,
    )
    weight: float | None = _number(
        if_innovation(lambda i: i.weight),
        "share of its say a pose is left, 1 up to the 99.99 % point of NIS",
        atol=0.0001,
    )
    innov_m: float | None = _metres(if_innovation(lambda i: i.distance_m), "length of the position innovation")
    innov_deg: float | None = column(
        if_innovation(lambda i: float(np.degrees(i.angle_rad))),
        "rotation angle of the innovation",
        "deg",
        ".3f",
        1e-4,
        1e-4,
    )

    estimator: str = _flag(lambda o, s: o.estimator, "who speaks: near, start, fit, filter")
    x_m: float | None = _metres(lambda o, s: float(o.pose.t[0]), "estimated pose of {C} in {A}, after the update")
    y_m: float | None = _metres(lambda o, s: float(o.pose.t[1]), "see x_m")
    z_m: float | None = _metres(lambda o, s: float(o.pose.t[2]), "see x_m")
    qx: float | None = _number(lambda o, s: float(o.pose.q[0]), "estimated attitude q_ac, scalar last, w >= 0")
    qy: float | None = _number(lambda o, s: float(o.pose.q[1]), "see qx")
    qz: float | None = _number(lambda o, s: float(o.pose.q[2]), "see qx")
    qw: float | None = _number(lambda o, s: float(o.pose.q[3]), "see qx")
    pos_1s_m: float | None = _number(
        lambda o, s: position_1s_m(o.pose_covariance), "predicted 1 sigma of the position, root of the trace", "m"
    )
    rot_1s_deg: float | None = _number(
        lambda o, s: full_angle_deg(np.diag(o.pose_covariance)[3:].sum()),
        "predicted 1 sigma of the attitude, root of the trace",
        "deg",
    )
    wx_radps: float | None = _number(lambda o, s: float(o.belief.x.w_b[0]), "angular rate in {B}", "rad/s")
    wy_radps: float | None = _number(lambda o, s: float(o.belief.x.w_b[1]), "see wx_radps", "rad/s")
    wz_radps: float | None = _number(lambda o, s: float(o.belief.x.w_b[2]), "see wx_radps", "rad/s")
    rx_m: float | None = _metres(lambda o, s: float(o.belief.x.r_a[0]), "centre of mass in {A}")
    ry_m: float | None = _metres(lambda o, s: float(o.belief.x.r_a[1]), "see rx_m")
    rz_m: float | None = _metres(lambda o, s: float(o.belief.x.r_a[2]), "see rx_m")
    vx_mps: float | None = _number(
        lambda o, s: float(o.belief.x.v_a[0]), "velocity of the centre of mass in {A}", "m/s"
    )
    vy_mps: float | None = _number(lambda o, s: float(o.belief.x.v_a[1]), "see vx_mps", "m/s")
    vz_mps: float | None = _number(lambda o, s: float(o.belief.x.v_a[2]), "see vx_mps", "m/s")
    sigma1: float | None = _number(
        lambda o, s: float(o.belief.x.sigma[0]), "inertia ratio (Iyy - Izz) / Ixx", fmt=".4f", table=True
    )
    sigma2: float | None = _number(
        lambda o, s: float(o.belief.x.sigma[1]), "inertia ratio (Izz - Ixx) / Iyy", fmt=".4f", table=True
    )
    sigma1_1s: float | None = _number(deviation("sigma", 0), "1 sigma of sigma1")
    sigma2_1s: float | None = _number(deviation("sigma", 1), "1 sigma of sigma2")
    cx_m: float | None = _metres(lambda o, s: float(o.belief.x.c_b[0]), "fixture in {B} (varrho)")
    cy_m: float | None = _metres(lambda o, s: float(o.belief.x.c_b[1]), "see cx_m")
    cz_m: float | None = _metres(lambda o, s: float(o.belief.x.c_b[2]), "see cx_m")
    c_1s_m: float | None = _number(deviation("varrho"), "1 sigma of varrho, root of the trace", "m")
    mux: float | None = _number(lambda o, s: float(o.belief.x.q_bc[0]), "mu = q_bc, scalar last")
    muy: float | None = _number(lambda o, s: float(o.belief.x.q_bc[1]), "see mux")
    muz: float | None = _number(lambda o, s: float(o.belief.x.q_bc[2]), "see mux")
    muw: float | None = _number(lambda o, s: float(o.belief.x.q_bc[3]), "see mux")
    mu_1s_deg: float | None = _number(
        lambda o, s: full_angle_deg(np.diag(o.belief.P)[BLOCKS["mu"]].sum()), "1 sigma of mu, root of the trace", "deg"
    )

    pos_err_m: float | None = _error_m(_ESTIMATE[0], "distance of estimated and true position", table=True)
    rot_err_deg: float | None = _error_deg(_ESTIMATE[1], "angle between estimated and true attitude", table=True)
    reg_pos_err_m: float | None = _error_m(_REGISTRATION[0], "distance of measured and true position")
    reg_rot_err_deg: float | None = _error_deg(_REGISTRATION[1], "angle between measured and true attitude")
    reference: str | None = _flag(
        lambda o, s: s.reference, "what the errors are against: truth, or fit (a motion fitted to all healthy poses)"
    )
    nees: float | None = column(
        lambda o, s: finite(s.nees),
        "normalised estimation error squared of 20 states, modulo relabelling",
        "",
        ".2f",
        0.01,
        0.001,
    )
    nees_attitude: float | None = _nees("attitude")
    nees_rate: float | None = _nees("rate")
    nees_position: float | None = _nees("position")
    nees_velocity: float | None = _nees("velocity")
    nees_sigma: float | None = _nees("sigma")
    nees_varrho: float | None = _nees("varrho")
    nees_mu: float | None = _nees("mu")

    r_pos_m: float | None = _number(
        if_innovation(lambda i: float(np.sqrt(np.diag(i.R)[:3].mean()))),
        "adapted measurement noise, position, root mean diagonal",
        "m",
    )
    r_rot_deg: float | None = _number(
        if_innovation(lambda i: full_angle_deg(np.diag(i.R)[3:].mean())),
        "adapted measurement noise, attitude, root mean diagonal",
        "deg",
    )
    sigma_hits: int | None = _flag(lambda o, s: o.sigma_hits, "times a sigma bound cut the gain so far")
    r_floors: int | None = _flag(lambda o, s: o.r_floors, "times an eigenvalue floor of R acted so far")
    recalls: int | None = _flag(
        lambda o, s: o.recalls, "times the poses contradicted the filter or the given start so far"
    )

    ogm_log10_cond: float | None = column(
        lambda o, s: o.monitors.ogm_log10_cond,
        "log10 condition of the Gramian (null below full rank)",
        "",
        ".1f",
        0.001,
        0.01,
        table=True,
    )
    ogm_log10_cond_scaled: float | None = column(
        lambda o, s: o.monitors.ogm_log10_cond_scaled, "the same, scaled by the prior sigmas", "", ".1f", 0.001, 0.01
    )
    ogm_rank: int | None = _flag(
        lambda o, s: o.monitors.ogm_rank, "numerical rank of the scaled Gramian out of 20", table=True
    )
    nis_mean: float | None = _number(
        lambda o, s: o.monitors.nis_mean, "mean NIS over the consistency window (6 is right)", fmt=".2f", atol=0.0001
    )
    autocorrelation: float | None = _number(
        lambda o, s: o.monitors.autocorrelation, "largest lag-1 autocorrelation of the whitened innovation", atol=0.0001
    )
    consistent: bool | None = _flag(lambda o, s: o.monitors.consistent, "innovations inside their chi-square band")
    converged: bool = _flag(lambda o, s: o.monitors.converged, "may the planner rely on the estimate", table=True)
    covariance_holds: bool | None = _flag(
        lambda o, s: o.monitors.covariance_holds, "every block of the covariance is below its limit (the paper's test)"
    )
    predictive_holds: bool | None = _flag(
        lambda o, s: o.monitors.predictive_holds, "the grasp point's predicted 1 sigma is below its limits"
    )
    unknown: str | None = _flag(
        lambda o, s: ", ".join(o.monitors.unconverged) or None, "blocks above their covariance limit"
    )
    grasp_pos_1s_m: float | None = _number(
        lambda o, s: float(o.monitors.forecast.pos_1s_m.max()),
        "horizon's largest 1 sigma of the grasp point's position",
        "m",
    )
    grasp_vel_1s_mps: float | None = _number(
        lambda o, s: float(o.monitors.forecast.vel_1s_mps.max()), "horizon's largest 1 sigma of its velocity", "m/s"
    )
    grasp_rot_1s_deg: float | None = _number(
        lambda o, s: float(np.degrees(o.monitors.forecast.rot_1s_rad.max())),
        "horizon's largest 1 sigma of its attitude",
        "deg",
    )

    plan_status: str | None = _flag(
        lambda o, s: None if o.plan is None else o.plan.status.value, "what the planner claims"
    )
    capture_time_s: float | None = _seconds(
        if_planned(lambda o, p: since_start_s(o, p.t_ns) + p.t_go_s),
        "planned instant of capture, since the first scan",
        table=True,
    )
    t_go_s: float | None = _seconds(
        if_planned(lambda o, p: p.t_go_s - (o.scan.t_ns - p.t_ns) * 1e-9), "time from this scan to the planned capture"
    )
    plan_bound_s: float | None = _seconds(
        lambda o, s: None if o.plan is None else since_start_s(o, o.plan.t_ns) + o.plan.lower_bound_s,
        "certified: no capture before, since the first scan",
    )
    hindsight_m: float | None = _error_m(_PLANNED[0], "plan made at this scan: miss of the true grasp point")
    hindsight_mps: float | None = _error_m(_PLANNED[1], "the same: true relative speed at its end", "m/s")
    hindsight_deg: float | None = _error_deg(_PLANNED[2], "the same: error of the predicted attitude there")
    action: str = _flag(lambda o, s: o.action, "what the supervisor tells the robot", table=True)
    rule: str = _flag(lambda o, s: o.rule, "the supervisor's rule that fired")
    capture_miss_m: float | None = _error_m(_CAPTURED[0], "gripper closed since the last scan: true distance")
    capture_miss_mps: float | None = _error_m(_CAPTURED[1], "the same: true relative speed", "m/s")
    capture_miss_deg: float | None = _error_deg(_CAPTURED[2], "the same: attitude error")

    @classmethod
    def of(cls, outcome: Outcome, score: Score) -> Row:
        """Flatten an outcome and its score into the row of the scan."""
        return cls(**{name: value(outcome, score) for name, value in _VALUES})


_VALUES = tuple((f.name, f.metadata["value"]) for f in dataclasses.fields(Row))


def columns() -> tuple[Column, ...]:
    """Every column in order."""
    names = [f.name for f in dataclasses.fields(Column)]
    return tuple(
        Column(f.name, **{name: f.metadata[name] for name in names if name != "name"}) for f in dataclasses.fields(Row)
    )
