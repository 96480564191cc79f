"""One row a scan, declared once: unit, format, golden tolerance and meaning stand beside each field.

JSONL and CSV columns, table heads, golden tolerances, the docs' column list and the JSON schema are read from here.
A row holds results only: no wall clock, host, version or path, so the same input gives the same bytes.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

__all__ = ["Column", "Row", "column", "columns"]


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
    unit: str = "", fmt: str = "", rtol: float = 0.0, atol: float = 0.0, doc: str = "", table: bool = False
) -> Any:
    """A row field with its metadata; None (nothing to say) is every column's default."""
    meta = {"unit": unit, "fmt": fmt, "rtol": rtol, "atol": atol, "doc": doc, "table": table}
    return dataclasses.field(default=None, metadata=meta)


def _metres(doc: str, table: bool = False, fmt: str = ".4f") -> Any:
    return column("m", fmt, 1e-5, 1e-6, doc, table)


def _degrees(doc: str, table: bool = False) -> Any:
    return column("deg", ".3f", 1e-4, 1e-4, doc, table)


def _number(doc: str, unit: str = "", fmt: str = ".4g", table: bool = False, atol: float = 1e-6) -> Any:
    return column(unit, fmt, 1e-4, atol, doc, table)


def _nees(block: str) -> Any:
    return column("", ".2f", 1e-2, 1e-3, f"the same of the block '{block}' alone")


def _flag(doc: str, table: bool = False) -> Any:
    return column("", "", 0.0, 0.0, doc, table)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What one scan did. None where there is nothing to say: no truth, no measurement, not converged, no fault."""

    seq: int = _flag("place of the scan in the replay, from 0", table=True)
    t_ns: int = _flag("instant of the scan on the chosen clock [ns]")
    t_s: float = column("s", ".2f", 0.0, 1e-9, "time since the first scan", True)
    status: str = _flag("what the door and the ruler found of the scan", table=True)
    gamma: int = _flag("1: healthy, used by the filter; 0: faulty, the filter coasts", table=True)
    reason: str = _flag("why gamma is 0; 'ok' where it is 1", table=True)
    guess: str = _flag("where the registration's guess came from: init, predicted, last, acquired")
    fault: str | None = _flag("label of the fault injected into this scan", table=True)

    points: int = _flag("finite points in the scan")
    iterations: int | None = _flag("passes of the registration", table=True)
    inliers: int | None = column("", "d", 1e-3, 3, "points within the rejection distance of the model")
    inlier_ratio: float | None = column("", ".3f", 1e-3, 1e-3, "inliers over points", True)
    rms_m: float | None = column("m", ".5f", 1e-4, 1e-7, "root of the mean squared fit error over the inliers", True)
    weakest: str | None = _flag("directions the view leaves free, in words")
    reg_x_m: float | None = _metres("registration's pose of {C} in {A}")
    reg_y_m: float | None = _metres("see reg_x_m")
    reg_z_m: float | None = _metres("see reg_x_m")
    reg_qx: float | None = _number("measured attitude q_ac, scalar last, w >= 0")
    reg_qy: float | None = _number("see reg_qx")
    reg_qz: float | None = _number("see reg_qx")
    reg_qw: float | None = _number("see reg_qx")

    nis: float | None = column("", ".2f", 1e-3, 1e-4, "normalised innovation squared, chi-square of 6", True)
    weight: float | None = _number("share of its say a pose is left, 1 up to the 99.99 % point of NIS", atol=1e-4)
    innov_m: float | None = _metres("length of the position innovation")
    innov_deg: float | None = _degrees("rotation angle of the innovation")

    estimator: str = _flag("who speaks: near, start, fit, filter", table=False)
    x_m: float | None = _metres("estimated pose of {C} in {A}, after the update")
    y_m: float | None = _metres("see x_m")
    z_m: float | None = _metres("see x_m")
    qx: float | None = _number("estimated attitude q_ac, scalar last, w >= 0")
    qy: float | None = _number("see qx")
    qz: float | None = _number("see qx")
    qw: float | None = _number("see qx")
    pos_1s_m: float | None = _number("predicted 1 sigma of the position, root of the trace", "m")
    rot_1s_deg: float | None = _number("predicted 1 sigma of the attitude, root of the trace", "deg")
    wx_radps: float | None = _number("angular rate in {B}", "rad/s")
    wy_radps: float | None = _number("see wx_radps", "rad/s")
    wz_radps: float | None = _number("see wx_radps", "rad/s")
    rx_m: float | None = _metres("centre of mass in {A}")
    ry_m: float | None = _metres("see rx_m")
    rz_m: float | None = _metres("see rx_m")
    vx_mps: float | None = _number("velocity of the centre of mass in {A}", "m/s")
    vy_mps: float | None = _number("see vx_mps", "m/s")
    vz_mps: float | None = _number("see vx_mps", "m/s")
    sigma1: float | None = _number("inertia ratio (Iyy - Izz) / Ixx", fmt=".4f", table=True)
    sigma2: float | None = _number("inertia ratio (Izz - Ixx) / Iyy", fmt=".4f", table=True)
    sigma1_1s: float | None = _number("1 sigma of sigma1")
    sigma2_1s: float | None = _number("1 sigma of sigma2")
    cx_m: float | None = _metres("fixture in {B} (varrho)")
    cy_m: float | None = _metres("see cx_m")
    cz_m: float | None = _metres("see cx_m")
    c_1s_m: float | None = _number("1 sigma of varrho, root of the trace", "m")
    mux: float | None = _number("mu = q_bc, scalar last")
    muy: float | None = _number("see mux")
    muz: float | None = _number("see mux")
    muw: float | None = _number("see mux")
    mu_1s_deg: float | None = _number("1 sigma of mu, root of the trace", "deg")

    pos_err_m: float | None = column("m", ".4f", 1e-3, 1e-5, "distance of estimated and true position", True)
    rot_err_deg: float | None = column("deg", ".3f", 1e-3, 1e-3, "angle between estimated and true attitude", True)
    reg_pos_err_m: float | None = column("m", ".4f", 1e-3, 1e-5, "distance of measured and true position")
    reg_rot_err_deg: float | None = column("deg", ".3f", 1e-3, 1e-3, "angle between measured and true attitude")
    reference: str | None = _flag("what the errors are against: truth, or fit (a motion fitted to all healthy poses)")
    nees: float | None = column(
        "", ".2f", 1e-2, 1e-3, "normalised estimation error squared of 20 states, modulo relabelling"
    )
    nees_attitude: float | None = _nees("attitude")
    nees_rate: float | None = _nees("rate")
    nees_position: float | None = _nees("position")
    nees_velocity: float | None = _nees("velocity")
    nees_sigma: float | None = _nees("sigma")
    nees_varrho: float | None = _nees("varrho")
    nees_mu: float | None = _nees("mu")

    r_pos_m: float | None = _number("adapted measurement noise, position, root mean diagonal", "m")
    r_rot_deg: float | None = _number("adapted measurement noise, attitude, root mean diagonal", "deg")
    sigma_hits: int | None = _flag("times a sigma bound cut the gain so far")
    r_floors: int | None = _flag("times an eigenvalue floor of R acted so far")
    recalls: int | None = _flag("times the poses contradicted the filter or the given start so far")

    ogm_log10_cond: float | None = column(
        "", ".1f", 1e-3, 1e-2, "log10 condition of the Gramian (null below full rank)", True
    )
    ogm_log10_cond_scaled: float | None = column("", ".1f", 1e-3, 1e-2, "the same, scaled by the prior sigmas")
    ogm_rank: int | None = _flag("numerical rank of the scaled Gramian out of 20", table=True)
    nis_mean: float | None = _number("mean NIS over the consistency window (6 is right)", fmt=".2f", atol=1e-4)
    autocorrelation: float | None = _number("largest lag-1 autocorrelation of the whitened innovation", atol=1e-4)
    consistent: bool | None = _flag("innovations inside their chi-square band")
    converged: bool = _flag("may the planner rely on the estimate", table=True)
    covariance_holds: bool | None = _flag("every block of the covariance is below its limit (the paper's test)")
    predictive_holds: bool | None = _flag("the grasp point's predicted 1 sigma is below its limits")
    unknown: str | None = _flag("blocks above their covariance limit")
    grasp_pos_1s_m: float | None = _number("horizon's largest 1 sigma of the grasp point's position", "m")
    grasp_vel_1s_mps: float | None = _number("horizon's largest 1 sigma of its velocity", "m/s")
    grasp_rot_1s_deg: float | None = _number("horizon's largest 1 sigma of its attitude", "deg")

    plan_status: str | None = _flag("what the planner claims")
    capture_time_s: float | None = column(
        "s", ".2f", 1e-4, 1e-3, "planned instant of capture, since the first scan", True
    )
    t_go_s: float | None = column("s", ".2f", 1e-4, 1e-3, "time from this scan to the planned capture")
    plan_bound_s: float | None = column("s", ".2f", 1e-4, 1e-3, "certified: no capture before, since the first scan")
    hindsight_m: float | None = column("m", ".4f", 1e-3, 1e-5, "plan made at this scan: miss of the true grasp point")
    hindsight_mps: float | None = column("m/s", ".4f", 1e-3, 1e-5, "the same: true relative speed at its end")
    hindsight_deg: float | None = column("deg", ".3f", 1e-3, 1e-3, "the same: error of the predicted attitude there")
    action: str = _flag("what the supervisor tells the robot", table=True)
    rule: str = _flag("the supervisor's rule that fired")
    capture_miss_m: float | None = column("m", ".4f", 1e-3, 1e-5, "gripper closed since the last scan: true distance")
    capture_miss_mps: float | None = column("m/s", ".4f", 1e-3, 1e-5, "the same: true relative speed")
    capture_miss_deg: float | None = column("deg", ".3f", 1e-3, 1e-3, "the same: attitude error")


def columns() -> tuple[Column, ...]:
    """Every column in order."""
    return tuple(Column(f.name, **f.metadata) for f in dataclasses.fields(Row))
