"""The row of a scan. Each column is declared once, in its place: value, meaning, unit, format and
golden tolerance. Columns of one vector, covariance or change share a declaration.

JSONL, CSV and Parquet files, tables, golden comparisons, docs/columns.md and the JSON schema are
made from this declaration. A row holds results only, no wall clock, host, version or path: the same
input gives the same bytes.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from types import MappingProxyType
from typing import Any, TypeVar, cast

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.outcome import CaptureError, Outcome, Plan, PoseError, Score
from avsreplay.records import Innovation, Manoeuvre, ScanStatus

T = TypeVar("T")
Value = Callable[[Outcome, Score], T]
"""Takes the value of a column from an outcome and its score."""


@value_class(eq=True)
class Section:
    """A section of docs/columns.md.

    Attributes:
        title: its heading.
        text: what holds for its columns, "" if nothing.
    """

    title: str
    text: str = ""


@value_class(eq=True)
class Column:
    """Metadata of a row field.

    Attributes:
        name: name of the field, with its unit as suffix where it has one.
        text: meaning of its values, one or more sentences.
        unit: unit as printed in table headings, "" if there is none.
        fmt: format specification for tables.
        rtol, atol: relative and absolute golden tolerance; if both are 0, values must be equal.
        table: whether the table of scans shows it.
        section: the section of docs/columns.md that begins with it, None if it continues one.
        words: meaning of every value of a column that holds one of a few words.
    """

    name: str
    text: str
    unit: str
    fmt: str
    rtol: float
    atol: float
    table: bool
    section: Section | None
    words: Mapping[str, str]


def column(
    value: Value[T],
    text: str,
    unit: str = "",
    fmt: str = "",
    rtol: float = 0.0,
    atol: float = 0.0,
    table: bool = False,
    section: Section | None = None,
    words: Mapping[str, str] | None = None,
) -> T:
    """Declare a row field: its value and its metadata. Every field's default is None.

    Args:
        value: takes the value from an outcome and its score.
        text: its meaning.
        unit: as printed in table headings, "" if none.
        fmt: format specification for tables.
        rtol: relative golden tolerance; 0 with ``atol`` 0 means exact.
        atol: absolute golden tolerance.
        table: shown in the per-scan table.
        section: the section that begins with it.
        words: meaning of every value of a column that holds one of a few words.
    """
    made = Column("", text, unit, fmt, rtol, atol, table, section, words or {})
    return cast(T, dataclasses.field(default=None, metadata={"column": made, "value": value}))


def _metres(value: Value[T], text: str) -> T:
    return column(value, text, "m", ".4f", 1e-5, 1e-6)


def _error_m(value: Value[T], text: str, unit: str = "m", **more: Any) -> T:
    return column(value, text, unit, ".4f", 1e-3, 1e-5, **more)


def _error_deg(value: Value[T], text: str, **more: Any) -> T:
    return column(value, text, "deg", ".3f", 1e-3, 1e-3, **more)


def _seconds(value: Value[T], text: str, **more: Any) -> T:
    return column(value, text, "s", ".2f", 1e-4, 1e-3, **more)


def _number(
    value: Value[T], text: str, unit: str = "", fmt: str = ".4g", atol: float = 1e-6, **more: Any
) -> T:
    return column(value, text, unit, fmt, 1e-4, atol, **more)


def _radps(value: Value[T], text: str) -> T:
    return _number(value, text, "rad/s")


def _mps(value: Value[T], text: str) -> T:
    return _number(value, text, "m/s")


def _exact(value: Value[T], text: str, **more: Any) -> T:
    return column(value, text, **more)


_VECTOR_AXES = ("x", "y", "z")
_XYZW = ("x", "y", "z", "w")
_ENTRIES = ((0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2))  # the six entries of a symmetric matrix


def _block(
    values: Value[Array | None],
    make: Callable[[Value[float | None], str], float | None],
    text: str,
    first: str = "",
    names: Sequence[str] = _VECTOR_AXES,
) -> list[float | None]:
    """Declare the columns of one vector.

    Args:
        values: takes the vector from an outcome and its score; None where it does not apply.
        make: declares one column.
        text: meaning, after the name of the component.
        first: the same for the first component, where it says more.
        names: names of the components.
    """

    def one(place: int) -> Value[float | None]:
        def value(outcome: Outcome, score: Score) -> float | None:
            found = values(outcome, score)
            return None if found is None else float(found[place])

        return value

    return [
        make(one(k), f"{name} {first if first and k == 0 else text}.")
        for k, name in enumerate(names)
    ]


def finite(value: float | None) -> float | None:
    """Return a value, or None where it is None, NaN or infinite."""
    return float(value) if value is not None and math.isfinite(value) else None


def _if_innovation(get: Callable[[Innovation], float | None]) -> Value[float | None]:
    return lambda o, s: None if o.innovation is None else get(o.innovation)


def _if_planned(get: Callable[[Outcome, Plan], T]) -> Value[T | None]:
    return lambda o, s: get(o, o.plan) if o.plan is not None and o.plan.found else None


def _if_points(get: Callable[[Outcome], T]) -> Value[T | None]:
    return lambda o, s: get(o) if len(o.scan.points) else None


def _change(
    get: Callable[[Outcome], Manoeuvre | None],
    per: str,
    texts: Sequence[str],
    atol: float = 1e-6,
) -> list[float | None]:
    """Declare the six columns of a change of the motion: its instant, its linear and its angular
    part, each followed by its standard deviation.

    Args:
        get: takes the change; None where there is none.
        per: unit of time below m and rad, "s" of a change of the velocity.
        texts: meaning of each column.
        atol: absolute golden tolerance of the sizes.
    """

    def of(value: Callable[[Outcome, Manoeuvre], float]) -> Value[float | None]:
        return lambda o, s: None if (change := get(o)) is None else float(value(o, change))

    def size(part: Callable[[Manoeuvre], float], text: str, unit: str) -> float | None:
        return _number(of(lambda o, m: part(m)), text, f"{unit}/{per}", atol=atol)

    return [
        _seconds(of(lambda o, m: _since_start_s(o, m.t_ns)), texts[0]),
        _seconds(of(lambda o, m: m.t_1s_s), texts[1]),
        size(lambda m: float(np.linalg.norm(m.velocity)), texts[2], "m"),
        size(lambda m: math.sqrt(np.trace(m.P[3:, 3:])), texts[3], "m"),
        size(lambda m: float(np.linalg.norm(m.rate)), texts[4], "rad"),
        size(lambda m: math.sqrt(np.trace(m.P[:3, :3])), texts[5], "rad"),
    ]


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


def _nees(block: str, text: str) -> float | None:
    value: Value[float | None] = lambda o, s: finite(s.nees_blocks.get(block))  # noqa: E731
    return column(value, text, "", ".2f", 1e-2, 1e-3)


_MEASURED = _block(
    lambda o, s: o.alignment.T_ac.t if o.alignment.measured else None,
    _metres,
    "coordinate of the measured position of {C} in {A}",
)
_MEASURED_ATTITUDE = _block(
    lambda o, s: o.alignment.T_ac.q if o.alignment.measured else None,
    _number,
    "component of the measured attitude",
    first="component of the measured attitude, the quaternion q_ac with w >= 0",
    names=_XYZW,
)
_ESTIMATED = _block(
    lambda o, s: o.pose.t,
    _metres,
    "coordinate of the estimated position of {C} in {A}",
    first="coordinate of the estimated position of {C} in {A}, after the update",
)
_ESTIMATED_ATTITUDE = _block(
    lambda o, s: o.pose.q,
    _number,
    "component of the estimated attitude",
    first="component of the estimated attitude, the quaternion q_ac with w >= 0",
    names=_XYZW,
)
_RATE = _block(lambda o, s: o.belief.x.w_b, _radps, "component of the angular rate in {B}")
_CENTRE = _block(lambda o, s: o.belief.x.r_a, _metres, "coordinate of the mass centre in {A}")
_VELOCITY = _block(
    lambda o, s: o.belief.x.v_a, _mps, "component of the velocity of the mass centre in {A}"
)
_VARRHO = _block(
    lambda o, s: o.belief.x.c_b,
    _metres,
    "coordinate of varrho",
    first="coordinate of varrho, the position of the fixture in {B}",
)
_MU = _block(
    lambda o, s: o.belief.x.q_bc,
    _number,
    "component of mu",
    first="component of mu, the attitude of the fixture in {B}, as the quaternion q_bc",
    names=_XYZW,
)
_CENTRE_C = _block(lambda o, s: o.body.centre_c, _metres, "coordinate of the mass centre in {C}")
_RATE_C = _block(lambda o, s: o.body.rate_c, _radps, "component of the angular rate in {C}")
_INERTIA = _block(
    lambda o, s: o.body.inertia[_ENTRIES],
    _number,
    "entry of this tensor",
    first=(
        "entry of the inertia tensor about the mass centre, in {C}, divided by its trace. The "
        "tensor does not depend on the order of the principal axes"
    ),
    names=("xx", "yy", "zz", "xy", "xz", "yz"),
)
_MOMENTS = _block(
    lambda o, s: o.body.moments,
    _number,
    "principal moment of inertia, divided by the sum of the three moments",
    names=("Smallest", "Middle", "Largest"),
)
_PUSH = _change(
    lambda o: o.manoeuvres[-1] if o.manoeuvres else None,
    "s",
    (
        "Time of the last manoeuvre since the first scan.",
        "Standard deviation of the time of the last manoeuvre.",
        "Change of the velocity of the mass centre by the last manoeuvre.",
        "Standard deviation of this change of velocity.",
        "Change of the angular rate by the last manoeuvre.",
        "Standard deviation of this change of the angular rate.",
    ),
)
_DRIFT = _change(
    lambda o: o.drift,
    "s2",
    (
        "Time since the first scan at which a constant torque or force on the target began.",
        "Standard deviation of this time.",
        "Acceleration of the mass centre by the constant force.",
        "Standard deviation of this acceleration.",
        "Angular acceleration by the constant torque.",
        "Standard deviation of this angular acceleration.",
    ),
    atol=1e-9,
)

_MOTION_WORDS = {
    "free": "Nothing contradicts free motion.",
    "accelerated": "A constant torque or force acts on the target.",
    "disturbed": "Random torques or forces act on the target.",
    "driven": "No free motion explains the poses, which agree with one another.",
}
_STATUS_WORDS = {
    "aligned": "The scan was registered.",
    "measured": "The pose comes from the log itself; nothing was registered.",
    "not_converged": (
        "The iteration limit was reached. The quality of the pose is still measured."
    ),
    "degenerate": (
        "The view does not determine all six directions of the pose. The scan is "
        "used for the others."
    ),
    "no_overlap": "Too few points are close to the model.",
    "no_points": "The registration had no points to use.",
    "ambiguous": "A search found a second, different pose that fits as well.",
    "failed": (
        "The back end raised an error, returned its guess unchanged, or gave a pose "
        "that is not finite."
    ),
    "implausible": "The scan contradicts the pose.",
    "postponed": (
        "Until a first pose is found, a scan that shows the same as one searched in vain is not"
        " searched."
    ),
    "empty": "The message has no finite point.",
    "damaged": "The message cannot be decoded.",
    "clock": "The time stamp is implausible; the clock of the log was used instead.",
}
_REASON_WORDS = {
    "ok": "The scan is used.",
    "no_scan": "The scan is empty or damaged.",
    "frozen": "The sensor repeats the scan before, although the target moves.",
    "not_aligned": "The registration found no overlap, failed, or is ambiguous.",
    "not_converged": "The registration did not converge.",
    "few_inliers": "Too few points are close to the model.",
    "fit_error": "The distance of the inliers from the model is too large.",
    "halves_differ": (
        "The poses from two halves of the scan differ by more than their errors explain."
    ),
    "clock": "The time stamp steps back or jumps.",
    "sensor_bias": "The measured poses have a constant offset that motion does not explain.",
    "wrong_scan": "Neither a motion nor an error of the sensor explains the last poses.",
    "pose_jump": "The pose is too far from the prediction, and what explains it is not decided.",
    "doubtful": (
        "The innovations are unlikely, and it is not decided yet whether the scan, the "
        "sensor or the target is the cause."
    ),
}
_GUESS_WORDS = {
    "start": "The initial state that the log states.",
    "truth": "The true pose of the log (--init truth).",
    "given": "A pose given by an option.",
    "acquired": "A search without a guess.",
    "predicted": "The prediction of the filter.",
    "tracked": (
        "The prediction of the tracker, where the motion of a free body contradicts the last poses."
    ),
    "last": "The pose of the last healthy scan.",
    "measured": "None was needed, because the log holds poses.",
}
_ESTIMATOR_WORDS = {
    "near": "The given initial state, before the first healthy scan.",
    "start": "The first poses of a cold start.",
    "fit": "A maximum-likelihood fit to all poses.",
    "filter": "The Kalman filter.",
    "kinematic": "The tracker, where the motion of a free body contradicts the poses.",
}
_REFERENCE_WORDS = {
    "truth": "True poses of the log or of a file.",
    "fit": "One motion that was fitted to all healthy poses (--reference fit).",
}
_PLAN_DELAY_WORDS = {
    "attitude": "The turn of the gripper.",
    "arm": "The joints of the arm.",
}
_PLAN_STATUS_WORDS = {
    "optimal": "The earliest time, certified to the stated gap.",
    "feasible": "The plan satisfies all constraints; it may not be the earliest.",
    "none_found": "The search found no plan; there may be one.",
    "infeasible_within_horizon": "It is certified that no plan exists within the horizon.",
    "no_convergence": "The solver did not converge.",
}
_ACTION_WORDS = {
    "stand_still": "Remain at rest.",
    "approach": "Fly the plan with healthy measurements.",
    "approach_on_prediction": (
        "Fly the plan without measurements, because the prediction suffices."
    ),
    "hold": (
        "Interrupt the approach, brake relative to the mass centre and keep the stand-off distance."
    ),
    "retreat": "Increase the distance to the target.",
    "capture": "Fly the last plan to its end and close the gripper.",
    "abort": "Retreat and end the approach.",
}


@value_class(eq=True)
class Row:
    """The result of one scan. A value is None where it does not apply: without truth, measurement,
    plan or fault.
    """

    seq: int = _exact(
        lambda o, s: o.scan.seq,
        "Index of the scan in the replay, from 0.",
        table=True,
        section=Section("Scan and result"),
    )
    t_ns: int = _exact(lambda o, s: o.scan.t_ns, "Time of the scan on the selected clock [ns].")
    t_s: float = column(
        lambda o, s: _since_start_s(o, o.scan.t_ns),
        "Time of the scan since the first scan.",
        "s",
        ".2f",
        0.0,
        1e-09,
        table=True,
    )
    status: str = _exact(
        lambda o, s: _status(o),
        "Status of the registration, or of the scan if nothing could be registered.",
        table=True,
        words=_STATUS_WORDS,
    )
    gamma: int = _exact(
        lambda o, s: o.verdict.gamma,
        (
            "1 if the scan is healthy and updates the filter; 0 if it is faulty and the filter "
            "only predicts."
        ),
        table=True,
    )
    reason: str = _exact(
        lambda o, s: o.verdict.reason.value,
        "Why gamma is 0; ok where gamma is 1.",
        table=True,
        words=_REASON_WORDS,
    )
    guess: str = _exact(
        lambda o, s: o.guess,
        (
            "Where the initial guess of the registration came from. Until the first healthy scan "
            "this is the source of the first pose."
        ),
        words=_GUESS_WORDS,
    )
    fault: str | None = _exact(
        lambda o, s: s.fault, "Kind of the fault that was injected into this scan.", table=True
    )
    message: str | None = _exact(
        lambda o, s: o.alignment.message or o.scan.note or None,
        "Error of the back end, or what is wrong with the recorded message or its time stamp.",
    )
    points: int | None = _exact(
        lambda o, s: None if o.scan.pose else len(o.scan.points),
        "Number of points of the scan with finite coordinates.",
        section=Section("Registration"),
    )
    iterations: int | None = _exact(
        _if_points(lambda o: o.alignment.iterations),
        "Number of iterations of the registration.",
        table=True,
    )
    inliers: int | None = column(
        _if_points(lambda o: o.alignment.inliers),
        (
            "Number of points that are closer to the model than the rejection distance of the "
            "last iteration."
        ),
        "",
        "d",
        0.001,
        3,
    )
    inlier_ratio: float | None = column(
        _if_points(lambda o: o.alignment.inlier_ratio),
        "Number of inliers divided by the number of points.",
        "",
        ".3f",
        0.001,
        0.001,
        table=True,
    )
    rms_m: float | None = column(
        _if_points(lambda o: finite(o.alignment.rms_m)),
        "Root mean square of the distances of the inliers from the model.",
        "m",
        ".5f",
        0.0001,
        1e-07,
        table=True,
    )
    free_directions: str | None = _exact(
        lambda o, s: o.alignment.free_directions or None,
        "Directions of the pose that this view does not determine, in words.",
    )
    split_nis: float | None = _number(
        _if_points(lambda o: finite(o.alignment.split_nis)),
        (
            "Squared difference between the poses from two halves of the scan, normalised by its "
            "covariance; the larger value of the divisions left/right and top/bottom."
        ),
        fmt=".1f",
    )
    reg_dof: float | None = _number(
        _if_points(lambda o: finite(o.alignment.dof)),
        (
            "Degrees of freedom of the registration's covariance as an estimate from the "
            "residuals; null if there is no covariance or if it is known."
        ),
        fmt=".0f",
    )
    reg_x_m: float | None = _MEASURED[0]
    reg_y_m: float | None = _MEASURED[1]
    reg_z_m: float | None = _MEASURED[2]
    reg_qx: float | None = _MEASURED_ATTITUDE[0]
    reg_qy: float | None = _MEASURED_ATTITUDE[1]
    reg_qz: float | None = _MEASURED_ATTITUDE[2]
    reg_qw: float | None = _MEASURED_ATTITUDE[3]
    nis: float | None = column(
        _if_innovation(lambda i: finite(i.chi2)),
        (
            "Normalised innovation squared. If the filter is consistent it has a chi-square "
            "distribution with 6 degrees of freedom: its mean is 6, and 95 % of the values lie "
            "between 1.2 and 14.4. Where the covariance of the registration is an estimate "
            "(`reg_dof`), it is converted from Hotelling's T-squared."
        ),
        "",
        ".2f",
        0.001,
        0.0001,
        table=True,
        section=Section(
            "Innovation",
            (
                "The innovation is the difference between the measured pose and the pose "
                "that the filter predicted."
            ),
        ),
    )
    cauchy_weight: float | None = _number(
        _if_innovation(lambda i: i.weight),
        (
            "Weight of the pose in the update (Cauchy); it is below 1 where the NIS is above "
            "27.9, its 99.99 % point."
        ),
        atol=0.0001,
    )
    innov_m: float | None = _metres(
        _if_innovation(lambda i: finite(i.distance_m)),
        "Distance between the measured and the predicted position of the centre of the model.",
    )
    innov_deg: float | None = column(
        _if_innovation(lambda i: finite(math.degrees(i.angle_rad))),
        "Rotation angle between the measured and the predicted attitude.",
        "deg",
        ".3f",
        0.0001,
        0.0001,
    )
    estimator: str = _exact(
        lambda o, s: o.estimator,
        "Estimator that gave the estimate.",
        section=Section(
            "Estimate",
            (
                "The standard deviation of a vector is the square root of the trace of "
                "its covariance."
            ),
        ),
        words=_ESTIMATOR_WORDS,
    )
    motion: str | None = _exact(
        lambda o, s: o.moves.value,
        "What the poses show of the motion of the target.",
        words=_MOTION_WORDS,
    )
    cause: str | None = _exact(
        lambda o, s: o.cause or None,
        (
            "What the healthy poses so far show besides free motion, in words with 1 sigma: steps,"
            " constant and periodic torque, force, drag, jump and drift of the range; causes that"
            " are nearly as likely follow after 'or'. Null where free motion may explain them."
        ),
    )
    torque_noise_radps15: float | None = _number(
        lambda o, s: None if o.disturbances is None else o.disturbances[0],
        "Root density of the random torque that the estimate allows for.",
        "rad/s^1.5",
        atol=1e-9,
    )
    force_noise_mps15: float | None = _number(
        lambda o, s: None if o.disturbances is None else o.disturbances[1],
        "Root density of the random force that the estimate allows for.",
        "m/s^1.5",
        atol=1e-9,
    )
    x_m: float | None = _ESTIMATED[0]
    y_m: float | None = _ESTIMATED[1]
    z_m: float | None = _ESTIMATED[2]
    qx: float | None = _ESTIMATED_ATTITUDE[0]
    qy: float | None = _ESTIMATED_ATTITUDE[1]
    qz: float | None = _ESTIMATED_ATTITUDE[2]
    qw: float | None = _ESTIMATED_ATTITUDE[3]
    pos_1s_m: float | None = _number(
        lambda o, s: math.sqrt(max(_traces(o.pose_covariance)[0], 0.0)),
        "Standard deviation of the estimated position.",
        "m",
    )
    rot_1s_deg: float | None = _number(
        lambda o, s: _full_angle_deg(_traces(o.pose_covariance)[1]),
        "Standard deviation of the estimated attitude.",
        "deg",
    )
    wx_radps: float | None = _RATE[0]
    wy_radps: float | None = _RATE[1]
    wz_radps: float | None = _RATE[2]
    rx_m: float | None = _CENTRE[0]
    ry_m: float | None = _CENTRE[1]
    rz_m: float | None = _CENTRE[2]
    vx_mps: float | None = _VELOCITY[0]
    vy_mps: float | None = _VELOCITY[1]
    vz_mps: float | None = _VELOCITY[2]
    sigma1: float | None = _number(
        lambda o, s: float(o.belief.x.sigma[0]),
        (
            "First inertia ratio, (Iyy - Izz) / Ixx, with the principal moments of inertia in the"
            " order of the axes of {B}."
        ),
        fmt=".4f",
        table=True,
    )
    sigma2: float | None = _number(
        lambda o, s: float(o.belief.x.sigma[1]),
        "Second inertia ratio, (Izz - Ixx) / Iyy.",
        fmt=".4f",
        table=True,
    )
    sigma1_1s: float | None = _number(
        lambda o, s: o.body.limited_1s[0],
        "Standard deviation of sigma1; at most that of an unknown value in its range.",
    )
    sigma2_1s: float | None = _number(
        lambda o, s: o.body.limited_1s[1],
        "Standard deviation of sigma2; at most that of an unknown value in its range.",
    )
    cx_m: float | None = _VARRHO[0]
    cy_m: float | None = _VARRHO[1]
    cz_m: float | None = _VARRHO[2]
    c_1s_m: float | None = _number(
        lambda o, s: o.body.limited_1s[2],
        (
            "Standard deviation of varrho; at most that of a vector of this length with unknown "
            "direction."
        ),
        "m",
    )
    mux: float | None = _MU[0]
    muy: float | None = _MU[1]
    muz: float | None = _MU[2]
    muw: float | None = _MU[3]
    mu_1s_deg: float | None = _number(
        lambda o, s: _full_angle_deg(o.body.limited_1s[3] ** 2),
        "Standard deviation of mu; at most that of an unknown attitude.",
        "deg",
    )
    com_x_m: float | None = _CENTRE_C[0]
    com_y_m: float | None = _CENTRE_C[1]
    com_z_m: float | None = _CENTRE_C[2]
    com_1s_m: float | None = _number(
        lambda o, s: o.body.centre_1s_m, "Standard deviation of the mass centre in {C}.", "m"
    )
    rate_cx_radps: float | None = _RATE_C[0]
    rate_cy_radps: float | None = _RATE_C[1]
    rate_cz_radps: float | None = _RATE_C[2]
    rate_c_1s_radps: float | None = _number(
        lambda o, s: o.body.rate_1s_radps, "Standard deviation of the angular rate in {C}.", "rad/s"
    )
    ixx: float | None = _INERTIA[0]
    iyy: float | None = _INERTIA[1]
    izz: float | None = _INERTIA[2]
    ixy: float | None = _INERTIA[3]
    ixz: float | None = _INERTIA[4]
    iyz: float | None = _INERTIA[5]
    inertia_1s: float | None = _number(
        lambda o, s: float(o.body.inertia_1s.max()),
        "Largest standard deviation of the six entries of the inertia tensor.",
    )
    moment_small: float | None = _MOMENTS[0]
    moment_middle: float | None = _MOMENTS[1]
    moment_large: float | None = _MOMENTS[2]
    moments_1s: float | None = _number(
        lambda o, s: float(o.body.moments_1s.max()),
        "Largest standard deviation of the three moments divided by their sum.",
    )
    pos_err_m: float | None = _error_m(
        _of_error(lambda s: s.estimate, "distance_m"),
        "Distance between the estimated and the true position of {C}.",
        table=True,
        section=Section(
            "Errors",
            (
                "The normalised estimation error squared (NEES) has a chi-square "
                "distribution with as many degrees of freedom as states, if the "
                "covariance is correct. The true principal axes are taken in the order "
                "that is nearest to the estimate."
            ),
        ),
    )
    rot_err_deg: float | None = _error_deg(
        _of_error(lambda s: s.estimate, "angle_deg"),
        "Rotation angle between the estimated and the true attitude of {C}.",
        table=True,
    )
    reg_pos_err_m: float | None = _error_m(
        _of_error(lambda s: s.registration, "distance_m"),
        "Distance between the measured and the true position of {C}.",
    )
    reg_rot_err_deg: float | None = _error_deg(
        _of_error(lambda s: s.registration, "angle_deg"),
        "Rotation angle between the measured and the true attitude of {C}.",
    )
    reference: str | None = _exact(
        lambda o, s: s.reference, "What the errors are computed against.", words=_REFERENCE_WORDS
    )
    nees: float | None = column(
        lambda o, s: finite(s.nees),
        "NEES of all 20 states; its mean is 20 if the covariance is correct.",
        "",
        ".2f",
        0.01,
        0.001,
    )
    nees_attitude: float | None = _nees(
        "attitude", "NEES of the attitude of the principal axes (3 states)."
    )
    nees_rate: float | None = _nees("rate", "NEES of the angular rate (3 states).")
    nees_position: float | None = _nees(
        "position", "NEES of the position of the mass centre (3 states)."
    )
    nees_velocity: float | None = _nees(
        "velocity", "NEES of the velocity of the mass centre (3 states)."
    )
    nees_sigma: float | None = _nees("sigma", "NEES of the inertia ratios (2 states).")
    nees_varrho: float | None = _nees("varrho", "NEES of the position of the fixture (3 states).")
    nees_mu: float | None = _nees("mu", "NEES of the attitude of the fixture (3 states).")
    r_pos_m: float | None = _number(
        _if_innovation(lambda i: math.sqrt(max(_traces(i.R)[0] / 3.0, 0.0))),
        (
            "Standard deviation of the measured position of the centre of the model per axis in "
            "R, the covariance of the measurement noise."
        ),
        "m",
        section=Section(
            "Adaptation and events",
            "Counts and events are those from the first scan up to this one.",
        ),
    )
    r_rot_deg: float | None = _number(
        _if_innovation(lambda i: _full_angle_deg(_traces(i.R)[1] / 3.0)),
        "Standard deviation of the measured attitude per axis in R.",
        "deg",
    )
    sigma_hits: int | None = _exact(
        lambda o, s: o.sigma_hits,
        "Number of updates in which a bound on sigma1 or sigma2 limited the Kalman gain.",
    )
    r_floors: int | None = _exact(
        lambda o, s: o.r_floors, "Number of eigenvalues of R that were raised to the lower limit."
    )
    reinitialised: int | None = _exact(
        lambda o, s: o.reinitialised,
        (
            "Number of times that the poses contradicted the filter or the given initial state "
            "and a fit replaced the estimate."
        ),
    )
    manoeuvres: int | None = _exact(
        lambda o, s: len(o.manoeuvres),
        (
            "Number of manoeuvres: changes of the target's velocity or rate that free motion does"
            " not explain."
        ),
    )
    manoeuvre_s: float | None = _PUSH[0]
    manoeuvre_1s_s: float | None = _PUSH[1]
    manoeuvre_mps: float | None = _PUSH[2]
    manoeuvre_1s_mps: float | None = _PUSH[3]
    manoeuvre_radps: float | None = _PUSH[4]
    manoeuvre_1s_radps: float | None = _PUSH[5]
    drift_s: float | None = _DRIFT[0]
    drift_1s_s: float | None = _DRIFT[1]
    drift_mps2: float | None = _DRIFT[2]
    drift_1s_mps2: float | None = _DRIFT[3]
    drift_radps2: float | None = _DRIFT[4]
    drift_1s_radps2: float | None = _DRIFT[5]
    ogm_log10_cond: float | None = column(
        lambda o, s: o.monitors.ogm_log10_cond,
        (
            "Decimal logarithm of the condition number of the observability Gramian; null where "
            "the rank is below 20."
        ),
        "",
        ".1f",
        0.001,
        0.01,
        table=True,
        section=Section("Observability, consistency and convergence"),
    )
    ogm_log10_cond_scaled: float | None = column(
        lambda o, s: o.monitors.ogm_log10_cond_scaled,
        (
            "Decimal logarithm of the condition number with each state scaled by its prior "
            "standard deviation."
        ),
        "",
        ".1f",
        0.001,
        0.01,
    )
    ogm_rank: int | None = _exact(
        lambda o, s: o.monitors.ogm_rank,
        (
            "Numerical rank of the scaled observability Gramian: how many of the 20 directions of"
            " the state the measurements determine."
        ),
        table=True,
    )
    nis_mean: float | None = _number(
        lambda o, s: o.monitors.nis_mean,
        "Mean of NIS over the consistency window; 6 is expected.",
        fmt=".2f",
        atol=0.0001,
    )
    autocorrelation: float | None = _number(
        lambda o, s: o.monitors.autocorrelation,
        (
            "Correlation of each whitened innovation with the next one, over the consistency "
            "window; 0 is expected."
        ),
        atol=0.0001,
    )
    consistent: bool | None = _exact(
        lambda o, s: o.monitors.consistent,
        (
            "Whether the mean NIS and the sum of the innovations are below the upper limits of "
            "their chi-square intervals, no scan is doubtful, and few poses of the window have a "
            "reduced weight."
        ),
    )
    violations: int | None = _exact(
        lambda o, s: o.monitors.violations,
        (
            "Number of consistency checks that the estimate has failed so far. A failed check "
            "withdraws converged."
        ),
    )
    converged: bool = _exact(
        lambda o, s: o.monitors.converged,
        "Whether the planner may rely on the estimate.",
        table=True,
    )
    covariance_converged: bool | None = _exact(
        lambda o, s: o.monitors.covariance_converged,
        (
            "Whether the covariance of every block of states is below its limit (the criterion of"
            " the paper)."
        ),
    )
    predictive_converged: bool | None = _exact(
        lambda o, s: o.monitors.predictive_converged,
        "Whether the predicted standard deviations of the grasp point are below their limits.",
    )
    unconverged_blocks: str | None = _exact(
        lambda o, s: ", ".join(o.monitors.unconverged) or None,
        "Names of the blocks of states whose covariance is above its limit.",
    )
    alias_slow_radps: float | None = _number(
        lambda o, s: None if o.monitors.alias is None else o.monitors.alias[0],
        "Slower of two angular rates that both explain the poses; empty where only one does.",
        "rad/s",
    )
    alias_fast_radps: float | None = _number(
        lambda o, s: None if o.monitors.alias is None else o.monitors.alias[1],
        "Faster of these two rates.",
        "rad/s",
    )
    grasp_pos_1s_m: float | None = _number(
        lambda o, s: float(o.monitors.forecast.pos_1s_m.max()),
        (
            "Standard deviation of the position of the grasp point, predicted for the "
            "planned capture; for now where that already exceeds the tolerance."
        ),
        "m",
    )
    grasp_vel_1s_mps: float | None = _number(
        lambda o, s: float(o.monitors.forecast.vel_1s_mps.max()),
        (
            "Standard deviation of the velocity of the grasp point, predicted for the "
            "planned capture likewise."
        ),
        "m/s",
    )
    grasp_rot_1s_deg: float | None = _number(
        lambda o, s: math.degrees(o.monitors.forecast.rot_1s_rad.max()),
        (
            "Standard deviation of the attitude of the grasp point, predicted for the "
            "planned capture likewise."
        ),
        "deg",
    )
    plan_status: str | None = _exact(
        lambda o, s: None if o.plan is None else o.plan.status.value,
        "Result of the planner for the plan in force.",
        section=Section(
            "Plan and supervisor",
            ("The conditions of the supervisor's rules are listed under [planning](planning.md)."),
        ),
        words=_PLAN_STATUS_WORDS,
    )
    capture_time_s: float | None = _seconds(
        _if_planned(lambda o, p: _since_start_s(o, p.t_ns) + p.t_go_s),
        "Planned time of capture since the first scan.",
        table=True,
    )
    t_go_s: float | None = _seconds(
        _if_planned(lambda o, p: p.t_go_s - (o.scan.t_ns - p.t_ns) * 1e-09),
        "Time from this scan to the planned capture.",
    )
    earliest_capture_s: float | None = _seconds(
        lambda o, s: (
            None if o.plan is None else _since_start_s(o, o.plan.t_ns) + o.plan.lower_bound_s
        ),
        "Certified lower bound of the time of capture since the first scan.",
    )
    plan_margin_m: float | None = column(
        lambda o, s: None if o.plan is None else finite(o.plan.margin_m),
        (
            "Smallest margin of the geometric limits along the plan; negative where a limit is "
            "violated."
        ),
        "m",
        ".4f",
        0.0,
        0.01,
    )
    plan_limit: str | None = _exact(
        lambda o, s: None if o.plan is None else o.plan.binding or None,
        (
            "Name of the limit that has the smallest margin, for example cone, corridor, sphere "
            "or body."
        ),
    )
    abort_margin_m: float | None = column(
        lambda o, s: None if o.plan is None else finite(o.plan.abort_margin_m),
        (
            "Certified smallest margin of the required distance to the body if the robot withdraws "
            "at any instant of the plan; from within the corridor less is required."
        ),
        "m",
        ".4f",
        0.0,
        0.01,
    )
    passive_margin_m: float | None = column(
        lambda o, s: None if o.plan is None else finite(o.plan.passive_margin_m),
        (
            "Certified smallest margin of this distance if the thrust is cut at any instant of the "
            "plan and the robot coasts for 30 s."
        ),
        "m",
        ".4f",
        0.0,
        0.01,
    )
    passive_safe_s: float | None = _seconds(
        _if_planned(lambda o, p: finite(_since_start_s(o, p.t_ns) + p.passive_safe_s)),
        "Time since the first scan up to which a cut of the thrust keeps this distance.",
    )
    gripper_ready_s: float | None = _seconds(
        _if_planned(lambda o, p: finite(_since_start_s(o, p.t_ns) + p.attitude_s)),
        (
            "Time since the first scan from which the gripper has attitude and rate of the "
            "fixture; null where its attitude is not planned."
        ),
    )
    plan_delay: str | None = _exact(
        _if_planned(lambda o, p: p.delayed_by or None),
        (
            "What makes the planned capture later than the flight of the end-effector alone; null"
            " where nothing does."
        ),
        words=_PLAN_DELAY_WORDS,
    )
    plan_miss_m: float | None = _error_m(
        _of_error(lambda s: s.planned, "distance_m"),
        (
            "Distance between the gripper and the true grasp point at the end of the plan that "
            "was made at this scan."
        ),
    )
    plan_miss_mps: float | None = _error_m(
        _of_error(lambda s: s.planned, "speed_mps"),
        "Relative speed of the gripper and the true grasp point at the end of this plan.",
        "m/s",
    )
    plan_miss_deg: float | None = _error_deg(
        _of_error(lambda s: s.planned, "angle_deg"),
        "Error of the attitude that was predicted for the end of this plan.",
    )
    action: str = _exact(
        lambda o, s: o.action,
        "Command of the supervisor to the robot.",
        table=True,
        words=_ACTION_WORDS,
    )
    supervisor_rule: str = _exact(
        lambda o, s: o.supervisor_rule, "Name of the rule of the supervisor that gave the command."
    )
    capture_miss_m: float | None = _error_m(
        _of_error(lambda s: s.captured, "distance_m"),
        (
            "Distance between the gripper and the true grasp point when the gripper closed; given"
            " in the first row after that."
        ),
    )
    capture_miss_mps: float | None = _error_m(
        _of_error(lambda s: s.captured, "speed_mps"),
        "Relative speed of the gripper and the true grasp point when the gripper closed.",
        "m/s",
    )
    capture_miss_deg: float | None = _error_deg(
        _of_error(lambda s: s.captured, "angle_deg"), "Attitude error when the gripper closed."
    )

    @classmethod
    def of(cls, outcome: Outcome, score: Score) -> Row:
        """Flatten an outcome and its score into the row of the scan.

        Args:
            outcome: result of the pipeline for the scan.
            score: its comparison with the ground truth.
        """
        return cls(
            *[value(outcome, score) for value in _COLUMN_VALUES]
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


_COLUMN_VALUES = tuple(f.metadata["value"] for f in dataclasses.fields(Row))


def columns() -> tuple[Column, ...]:
    """Return every column in order."""
    return tuple(
        dataclasses.replace(f.metadata["column"], name=f.name) for f in dataclasses.fields(Row)
    )


@cache
def field_types() -> Mapping[str, tuple[type, bool]]:
    """Return for every column the type of its values (str, int, float or bool) and whether a value
    may be null.
    """
    hints = typing.get_type_hints(Row)
    names = (field.name for field in dataclasses.fields(Row))
    return MappingProxyType({name: _split(hints[name]) for name in names})


def _split(hint: Any) -> tuple[type, bool]:
    args = typing.get_args(hint)
    return (next(a for a in args if a is not type(None)), True) if args else (hint, False)
