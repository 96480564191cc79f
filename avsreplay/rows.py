"""The row of a scan. Each column is declared once: value, unit, format and golden tolerance;
columns.toml describes it.

JSONL, CSV and Parquet files, tables, golden comparisons, docs/columns.md and the JSON schema are
made from these two files. A row holds results only, no wall clock, host, version or path: the same
input gives the same bytes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.outcome import CaptureError, Outcome, Plan, PoseError, Score
from avsreplay.records import Innovation, Manoeuvre, ScanStatus

T = TypeVar("T")
Value = Callable[[Outcome, Score], T]
"""Takes the value of a column from an outcome and its score."""


@value_class(eq=True)
class Column:
    """Metadata of a row field.

    Attributes:
        name: field name, with its unit as suffix where it has one.
        unit: as printed in table headings, "" if none.
        fmt: format specification for tables.
        rtol, atol: relative and absolute golden tolerance; both 0 means exact.
        table: shown in the per-scan table.
    """

    name: str
    unit: str
    fmt: str
    rtol: float
    atol: float
    table: bool


def column(
    value: Value[T],
    unit: str = "",
    fmt: str = "",
    rtol: float = 0.0,
    atol: float = 0.0,
    table: bool = False,
) -> T:
    """Declare a row field: its value and its metadata. Every field's default is None.

    Args:
        value: takes the value from an outcome and its score.
        unit: as printed in table headings, "" if none.
        fmt: format specification for tables.
        rtol: relative golden tolerance; 0 with ``atol`` 0 means exact.
        atol: absolute golden tolerance.
        table: shown in the per-scan table.
    """
    meta = {"unit": unit, "fmt": fmt, "rtol": rtol, "atol": atol, "table": table, "value": value}
    return cast(T, dataclasses.field(default=None, metadata=meta))


def _metres(value: Value[T]) -> T:
    return column(value, "m", ".4f", 1e-5, 1e-6)


def _error_m(value: Value[T], unit: str = "m", table: bool = False) -> T:
    return column(value, unit, ".4f", 1e-3, 1e-5, table)


def _error_deg(value: Value[T], table: bool = False) -> T:
    return column(value, "deg", ".3f", 1e-3, 1e-3, table)


def _seconds(value: Value[T], table: bool = False) -> T:
    return column(value, "s", ".2f", 1e-4, 1e-3, table)


def _number(
    value: Value[T], unit: str = "", fmt: str = ".4g", table: bool = False, atol: float = 1e-6
) -> T:
    return column(value, unit, fmt, 1e-4, atol, table)


def _exact(value: Value[T], table: bool = False) -> T:
    return column(value, table=table)


def finite(value: float | None) -> float | None:
    """Return a value, or None where it is None, NaN or infinite."""
    return float(value) if value is not None and math.isfinite(value) else None


def _if_innovation(get: Callable[[Innovation], float | None]) -> Value[float | None]:
    return lambda o, s: None if o.innovation is None else get(o.innovation)


def _if_planned(get: Callable[[Outcome, Plan], T]) -> Value[T | None]:
    return lambda o, s: get(o, o.plan) if o.plan is not None and o.plan.found else None


def _if_measured(get: Callable[[Pose], float]) -> Value[float | None]:
    return lambda o, s: float(get(o.alignment.T_ac)) if o.alignment.measured else None


def _if_points(get: Callable[[Outcome], T]) -> Value[T | None]:
    return lambda o, s: get(o) if len(o.scan.points) else None


def _change(get: Callable[[Outcome], Manoeuvre | None]) -> tuple[Value[float | None], ...]:
    """Instant [s] and sizes of the linear and the angular part of a change, each followed by its
    standard deviation.
    """

    def of(value: Callable[[Outcome, Manoeuvre], float]) -> Value[float | None]:
        return lambda o, s: None if (change := get(o)) is None else float(value(o, change))

    return (
        of(lambda o, m: _since_start_s(o, m.t_ns)),
        of(lambda o, m: m.t_1s_s),
        of(lambda o, m: float(np.linalg.norm(m.velocity))),
        of(lambda o, m: math.sqrt(np.trace(m.P[3:, 3:]))),
        of(lambda o, m: float(np.linalg.norm(m.rate))),
        of(lambda o, m: math.sqrt(np.trace(m.P[:3, :3]))),
    )


def _of_error(
    get: Callable[[Score], PoseError | CaptureError | None], name: str
) -> Value[float | None]:
    return lambda o, s: None if (error := get(s)) is None else finite(getattr(error, name))


def _full_angle_deg(variance: float) -> float:
    """Standard deviation of a full angle [deg] from the variance of the half angle [rad2], at least
    0.
    """
    return math.degrees(2.0 * math.sqrt(max(variance, 0.0)))


def _traces(C: Array) -> tuple[float, float]:
    """Sums of the first three and of the last three variances of a covariance (6, 6)."""
    a, b, c, d, e, f = C.diagonal().tolist()
    return a + b + c, d + e + f


def _since_start_s(outcome: Outcome, t_ns: int) -> float:
    return (t_ns - outcome.start_ns) * 1e-9


def _status(outcome: Outcome) -> str:
    """The status of the alignment, or of the scan where that is not ok."""
    scan = outcome.scan.status
    return outcome.alignment.status.value if scan is ScanStatus.OK else scan.value


_PUSH, _DRIFT = (
    _change(lambda o: o.manoeuvres[-1] if o.manoeuvres else None),
    _change(lambda o: o.drift),
)


def _nees(block: str) -> float | None:
    value: Value[float | None] = lambda o, s: finite(s.nees_blocks.get(block))  # noqa: E731
    return column(value, "", ".2f", 1e-2, 1e-3)


@value_class(eq=True)
class Row:
    """The result of one scan. None: does not apply (no truth, no measurement, no plan, no
    fault).
    """

    seq: int = _exact(lambda o, s: o.scan.seq, table=True)
    t_ns: int = _exact(lambda o, s: o.scan.t_ns)
    t_s: float = column(
        lambda o, s: _since_start_s(o, o.scan.t_ns), "s", ".2f", 0.0, 1e-09, table=True
    )
    status: str = _exact(lambda o, s: _status(o), table=True)
    gamma: int = _exact(lambda o, s: o.verdict.gamma, table=True)
    reason: str = _exact(lambda o, s: o.verdict.reason.value, table=True)
    guess: str = _exact(lambda o, s: o.guess)
    fault: str | None = _exact(lambda o, s: s.fault, table=True)
    message: str | None = _exact(lambda o, s: o.alignment.message or o.scan.note or None)
    points: int | None = _exact(lambda o, s: None if o.scan.pose else len(o.scan.points))
    iterations: int | None = _exact(_if_points(lambda o: o.alignment.iterations), table=True)
    inliers: int | None = column(_if_points(lambda o: o.alignment.inliers), "", "d", 0.001, 3)
    inlier_ratio: float | None = column(
        _if_points(lambda o: o.alignment.inlier_ratio), "", ".3f", 0.001, 0.001, table=True
    )
    rms_m: float | None = column(
        _if_points(lambda o: finite(o.alignment.rms_m)), "m", ".5f", 0.0001, 1e-07, table=True
    )
    free_directions: str | None = _exact(lambda o, s: o.alignment.free_directions or None)
    split_nis: float | None = _number(
        _if_points(lambda o: finite(o.alignment.split_nis)), fmt=".1f"
    )
    reg_dof: float | None = _number(_if_points(lambda o: finite(o.alignment.dof)), fmt=".0f")
    reg_x_m: float | None = _metres(_if_measured(lambda T: T.t[0]))
    reg_y_m: float | None = _metres(_if_measured(lambda T: T.t[1]))
    reg_z_m: float | None = _metres(_if_measured(lambda T: T.t[2]))
    reg_qx: float | None = _number(_if_measured(lambda T: T.q[0]))
    reg_qy: float | None = _number(_if_measured(lambda T: T.q[1]))
    reg_qz: float | None = _number(_if_measured(lambda T: T.q[2]))
    reg_qw: float | None = _number(_if_measured(lambda T: T.q[3]))
    nis: float | None = column(
        _if_innovation(lambda i: finite(i.chi2)), "", ".2f", 0.001, 0.0001, table=True
    )
    cauchy_weight: float | None = _number(_if_innovation(lambda i: i.weight), atol=0.0001)
    innov_m: float | None = _metres(_if_innovation(lambda i: finite(i.distance_m)))
    innov_deg: float | None = column(
        _if_innovation(lambda i: finite(math.degrees(i.angle_rad))), "deg", ".3f", 0.0001, 0.0001
    )
    estimator: str = _exact(lambda o, s: o.estimator)
    x_m: float | None = _metres(lambda o, s: float(o.pose.t[0]))
    y_m: float | None = _metres(lambda o, s: float(o.pose.t[1]))
    z_m: float | None = _metres(lambda o, s: float(o.pose.t[2]))
    qx: float | None = _number(lambda o, s: float(o.pose.q[0]))
    qy: float | None = _number(lambda o, s: float(o.pose.q[1]))
    qz: float | None = _number(lambda o, s: float(o.pose.q[2]))
    qw: float | None = _number(lambda o, s: float(o.pose.q[3]))
    pos_1s_m: float | None = _number(
        lambda o, s: math.sqrt(max(_traces(o.pose_covariance)[0], 0.0)), "m"
    )
    rot_1s_deg: float | None = _number(
        lambda o, s: _full_angle_deg(_traces(o.pose_covariance)[1]), "deg"
    )
    wx_radps: float | None = _number(lambda o, s: float(o.belief.x.w_b[0]), "rad/s")
    wy_radps: float | None = _number(lambda o, s: float(o.belief.x.w_b[1]), "rad/s")
    wz_radps: float | None = _number(lambda o, s: float(o.belief.x.w_b[2]), "rad/s")
    rx_m: float | None = _metres(lambda o, s: float(o.belief.x.r_a[0]))
    ry_m: float | None = _metres(lambda o, s: float(o.belief.x.r_a[1]))
    rz_m: float | None = _metres(lambda o, s: float(o.belief.x.r_a[2]))
    vx_mps: float | None = _number(lambda o, s: float(o.belief.x.v_a[0]), "m/s")
    vy_mps: float | None = _number(lambda o, s: float(o.belief.x.v_a[1]), "m/s")
    vz_mps: float | None = _number(lambda o, s: float(o.belief.x.v_a[2]), "m/s")
    sigma1: float | None = _number(lambda o, s: float(o.belief.x.sigma[0]), fmt=".4f", table=True)
    sigma2: float | None = _number(lambda o, s: float(o.belief.x.sigma[1]), fmt=".4f", table=True)
    sigma1_1s: float | None = _number(lambda o, s: o.body.limited_1s[0])
    sigma2_1s: float | None = _number(lambda o, s: o.body.limited_1s[1])
    cx_m: float | None = _metres(lambda o, s: float(o.belief.x.c_b[0]))
    cy_m: float | None = _metres(lambda o, s: float(o.belief.x.c_b[1]))
    cz_m: float | None = _metres(lambda o, s: float(o.belief.x.c_b[2]))
    c_1s_m: float | None = _number(lambda o, s: o.body.limited_1s[2], "m")
    mux: float | None = _number(lambda o, s: float(o.belief.x.q_bc[0]))
    muy: float | None = _number(lambda o, s: float(o.belief.x.q_bc[1]))
    muz: float | None = _number(lambda o, s: float(o.belief.x.q_bc[2]))
    muw: float | None = _number(lambda o, s: float(o.belief.x.q_bc[3]))
    mu_1s_deg: float | None = _number(
        lambda o, s: _full_angle_deg(o.body.limited_1s[3] ** 2), "deg"
    )
    com_x_m: float | None = _metres(lambda o, s: float(o.body.centre_c[0]))
    com_y_m: float | None = _metres(lambda o, s: float(o.body.centre_c[1]))
    com_z_m: float | None = _metres(lambda o, s: float(o.body.centre_c[2]))
    com_1s_m: float | None = _number(lambda o, s: o.body.centre_1s_m, "m")
    rate_cx_radps: float | None = _number(lambda o, s: float(o.body.rate_c[0]), "rad/s")
    rate_cy_radps: float | None = _number(lambda o, s: float(o.body.rate_c[1]), "rad/s")
    rate_cz_radps: float | None = _number(lambda o, s: float(o.body.rate_c[2]), "rad/s")
    rate_c_1s_radps: float | None = _number(lambda o, s: o.body.rate_1s_radps, "rad/s")
    ixx: float | None = _number(lambda o, s: float(o.body.inertia[0, 0]))
    iyy: float | None = _number(lambda o, s: float(o.body.inertia[1, 1]))
    izz: float | None = _number(lambda o, s: float(o.body.inertia[2, 2]))
    ixy: float | None = _number(lambda o, s: float(o.body.inertia[0, 1]))
    ixz: float | None = _number(lambda o, s: float(o.body.inertia[0, 2]))
    iyz: float | None = _number(lambda o, s: float(o.body.inertia[1, 2]))
    inertia_1s: float | None = _number(lambda o, s: float(o.body.inertia_1s.max()))
    moment_small: float | None = _number(lambda o, s: float(o.body.moments[0]))
    moment_middle: float | None = _number(lambda o, s: float(o.body.moments[1]))
    moment_large: float | None = _number(lambda o, s: float(o.body.moments[2]))
    moments_1s: float | None = _number(lambda o, s: float(o.body.moments_1s.max()))
    pos_err_m: float | None = _error_m(_of_error(lambda s: s.estimate, "distance_m"), table=True)
    rot_err_deg: float | None = _error_deg(_of_error(lambda s: s.estimate, "angle_deg"), table=True)
    reg_pos_err_m: float | None = _error_m(_of_error(lambda s: s.registration, "distance_m"))
    reg_rot_err_deg: float | None = _error_deg(_of_error(lambda s: s.registration, "angle_deg"))
    reference: str | None = _exact(lambda o, s: s.reference)
    nees: float | None = column(lambda o, s: finite(s.nees), "", ".2f", 0.01, 0.001)
    nees_attitude: float | None = _nees("attitude")
    nees_rate: float | None = _nees("rate")
    nees_position: float | None = _nees("position")
    nees_velocity: float | None = _nees("velocity")
    nees_sigma: float | None = _nees("sigma")
    nees_varrho: float | None = _nees("varrho")
    nees_mu: float | None = _nees("mu")
    r_pos_m: float | None = _number(
        _if_innovation(lambda i: math.sqrt(max(_traces(i.R)[0] / 3.0, 0.0))), "m"
    )
    r_rot_deg: float | None = _number(
        _if_innovation(lambda i: _full_angle_deg(_traces(i.R)[1] / 3.0)), "deg"
    )
    sigma_hits: int | None = _exact(lambda o, s: o.sigma_hits)
    r_floors: int | None = _exact(lambda o, s: o.r_floors)
    reinitialised: int | None = _exact(lambda o, s: o.reinitialised)
    manoeuvres: int | None = _exact(lambda o, s: len(o.manoeuvres))
    manoeuvre_s: float | None = _seconds(_PUSH[0])
    manoeuvre_1s_s: float | None = _seconds(_PUSH[1])
    manoeuvre_mps: float | None = _number(_PUSH[2], "m/s")
    manoeuvre_1s_mps: float | None = _number(_PUSH[3], "m/s")
    manoeuvre_radps: float | None = _number(_PUSH[4], "rad/s")
    manoeuvre_1s_radps: float | None = _number(_PUSH[5], "rad/s")
    drift_s: float | None = _seconds(_DRIFT[0])
    drift_1s_s: float | None = _seconds(_DRIFT[1])
    drift_mps2: float | None = _number(_DRIFT[2], "m/s2", atol=1e-09)
    drift_1s_mps2: float | None = _number(_DRIFT[3], "m/s2", atol=1e-09)
    drift_radps2: float | None = _number(_DRIFT[4], "rad/s2", atol=1e-09)
    drift_1s_radps2: float | None = _number(_DRIFT[5], "rad/s2", atol=1e-09)
    ogm_log10_cond: float | None = column(
        lambda o, s: o.monitors.ogm_log10_cond, "", ".1f", 0.001, 0.01, table=True
    )
    ogm_log10_cond_scaled: float | None = column(
        lambda o, s: o.monitors.ogm_log10_cond_scaled, "", ".1f", 0.001, 0.01
    )
    ogm_rank: int | None = _exact(lambda o, s: o.monitors.ogm_rank, table=True)
    nis_mean: float | None = _number(lambda o, s: o.monitors.nis_mean, fmt=".2f", atol=0.0001)
    autocorrelation: float | None = _number(lambda o, s: o.monitors.autocorrelation, atol=0.0001)
    consistent: bool | None = _exact(lambda o, s: o.monitors.consistent)
    violations: int | None = _exact(lambda o, s: o.monitors.violations)
    converged: bool = _exact(lambda o, s: o.monitors.converged, table=True)
    covariance_converged: bool | None = _exact(lambda o, s: o.monitors.covariance_converged)
    predictive_converged: bool | None = _exact(lambda o, s: o.monitors.predictive_converged)
    unconverged_blocks: str | None = _exact(lambda o, s: ", ".join(o.monitors.unconverged) or None)
    grasp_pos_1s_m: float | None = _number(
        lambda o, s: float(o.monitors.forecast.pos_1s_m.max()), "m"
    )
    grasp_vel_1s_mps: float | None = _number(
        lambda o, s: float(o.monitors.forecast.vel_1s_mps.max()), "m/s"
    )
    grasp_rot_1s_deg: float | None = _number(
        lambda o, s: math.degrees(o.monitors.forecast.rot_1s_rad.max()), "deg"
    )
    plan_status: str | None = _exact(lambda o, s: None if o.plan is None else o.plan.status.value)
    capture_time_s: float | None = _seconds(
        _if_planned(lambda o, p: _since_start_s(o, p.t_ns) + p.t_go_s), table=True
    )
    t_go_s: float | None = _seconds(
        _if_planned(lambda o, p: p.t_go_s - (o.scan.t_ns - p.t_ns) * 1e-09)
    )
    earliest_capture_s: float | None = _seconds(
        lambda o, s: (
            None if o.plan is None else _since_start_s(o, o.plan.t_ns) + o.plan.lower_bound_s
        )
    )
    plan_margin_m: float | None = column(
        lambda o, s: None if o.plan is None else finite(o.plan.margin_m), "m", ".4f", 0.0, 0.01
    )
    plan_limit: str | None = _exact(lambda o, s: None if o.plan is None else o.plan.binding or None)
    abort_margin_m: float | None = column(
        lambda o, s: None if o.plan is None else finite(o.plan.abort_margin_m),
        "m",
        ".4f",
        0.0,
        0.01,
    )
    gripper_ready_s: float | None = _seconds(
        _if_planned(lambda o, p: finite(_since_start_s(o, p.t_ns) + p.attitude_s))
    )
    plan_delay: str | None = _exact(_if_planned(lambda o, p: p.delayed_by or None))
    plan_miss_m: float | None = _error_m(_of_error(lambda s: s.planned, "distance_m"))
    plan_miss_mps: float | None = _error_m(_of_error(lambda s: s.planned, "speed_mps"), "m/s")
    plan_miss_deg: float | None = _error_deg(_of_error(lambda s: s.planned, "angle_deg"))
    action: str = _exact(lambda o, s: o.action, table=True)
    supervisor_rule: str = _exact(lambda o, s: o.supervisor_rule)
    capture_miss_m: float | None = _error_m(_of_error(lambda s: s.captured, "distance_m"))
    capture_miss_mps: float | None = _error_m(_of_error(lambda s: s.captured, "speed_mps"), "m/s")
    capture_miss_deg: float | None = _error_deg(_of_error(lambda s: s.captured, "angle_deg"))

    @classmethod
    def of(cls, outcome: Outcome, score: Score) -> Row:
        """Flatten an outcome and its score into the row of the scan.

        Args:
            outcome: result of the pipeline for the scan.
            score: its comparison with the ground truth.
        """
        return cls(
            *[value(outcome, score) for value in _VALUES]
        )  # by place: 150 names take as long as the values

    def rescored(self, score: Score) -> Row:
        """Return the row with the errors of planned and flown captures of another score.

        Args:
            score: its ``planned`` and ``captured``.
        """
        values: dict[str, Any] = {
            f"{kind}_miss_{unit}": None if error is None else finite(getattr(error, name))
            for kind, error in (("plan", score.planned), ("capture", score.captured))
            for unit, name in (("m", "distance_m"), ("mps", "speed_mps"), ("deg", "angle_deg"))
        }
        return dataclasses.replace(self, **values)


_VALUES = tuple(f.metadata["value"] for f in dataclasses.fields(Row))


def columns() -> tuple[Column, ...]:
    """Every column in order."""
    names = [f.name for f in dataclasses.fields(Column) if f.name != "name"]
    return tuple(
        Column(f.name, **{n: f.metadata[n] for n in names}) for f in dataclasses.fields(Row)
    )
