"""The nouns of one scan into its row: units changed for people, nothing computed that a stage should have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.chart import nearest_permutation, nees
from avsreplay.estimate.error_state import boxminus
from avsreplay.estimate.measurement import measurement_jacobian
from avsreplay.geometry import Array, Pose
from avsreplay.monitor.consistency import block_nees
from avsreplay.records import BLOCKS, Alignment, Belief, Innovation, Scan, ScanStatus, Verdict
from avsreplay.rows import Row

__all__ = ["Findings", "row_of"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What the stages found of one scan.

    Attributes:
        since_ns: instant of the log's first scan.  guess: where the registration's guess came from.
        belief: after the update, None before the first pose.  estimator: who speaks.
        reference: what the scan's truth is: "truth", or "fit".
        columns: row fields that monitors and pilot fill, by column name.
    """

    scan: Scan
    since_ns: int
    guess: str
    alignment: Alignment
    verdict: Verdict
    innovation: Innovation | None
    belief: Belief | None
    estimator: str
    reference: str
    converged: bool
    columns: dict[str, Any]


def row_of(found: Findings) -> Row:
    """The scan's row. None stands where there is nothing to say."""
    scan = found.scan
    return Row(
        seq=scan.seq,
        t_ns=scan.t_ns,
        t_s=(scan.t_ns - found.since_ns) * 1e-9,
        status=(found.alignment.status if scan.status is ScanStatus.OK else scan.status).value,
        gamma=found.verdict.gamma,
        reason=found.verdict.reason.value,
        guess=found.guess,
        fault=scan.fault,
        reference=None if scan.truth is None else found.reference,
        estimator=found.estimator,
        converged=found.converged,
        **_registration(found.alignment, scan),
        **_innovation(found.innovation),
        **_estimate(found.belief),
        **_errors(found.belief, scan, found.estimator),
        **found.columns,
    )


def _registration(alignment: Alignment, scan: Scan) -> dict[str, Any]:
    fields: dict[str, Any] = {"points": len(scan.points), "weakest": alignment.weakest or None}
    if len(scan.points):
        fields |= {"iterations": alignment.iterations, "inliers": alignment.inliers}
        fields |= {"inlier_ratio": alignment.inlier_ratio, "rms_m": _finite(alignment.rms_m)}
    if alignment.measured:
        fields |= _pose(alignment.T_ac, "reg_")
        if scan.truth is not None:
            fields |= dict(
                zip(("reg_pos_err_m", "reg_rot_err_deg"), _distance(alignment.T_ac, scan.truth), strict=True)
            )
    return fields


def _innovation(innovation: Innovation | None) -> dict[str, Any]:
    if innovation is None:
        return {}
    noise = np.diag(innovation.R)
    return {
        "nis": _finite(innovation.nis),
        "weight": innovation.weight,
        "innov_m": _finite(innovation.distance_m),
        "innov_deg": _finite(np.degrees(innovation.angle_rad)),
        "r_pos_m": float(np.sqrt(noise[:3].mean())),
        "r_rot_deg": _half_angle_deg(noise[3:].mean()),
    }


def _estimate(belief: Belief | None) -> dict[str, Any]:
    if belief is None:
        return {}
    x, variance = belief.x, np.diag(belief.P)
    fields = _pose(x.T_ac, "")
    fields |= _xyz(x.w_b, "w", "_radps") | _xyz(x.r_a, "r", "_m") | _xyz(x.v_a, "v", "_mps") | _xyz(x.c_b, "c", "_m")
    fields |= {f"mu{axis}": float(v) for axis, v in zip("xyzw", x.q_bc, strict=True)}
    for k in (0, 1):
        fields[f"sigma{k + 1}"] = float(x.sigma[k])
        fields[f"sigma{k + 1}_1s"] = float(np.sqrt(variance[BLOCKS["sigma"]][k]))
    fields["c_1s_m"] = float(np.sqrt(variance[BLOCKS["varrho"]].sum()))
    fields["mu_1s_deg"] = _half_angle_deg(variance[BLOCKS["mu"]].sum())
    return fields | dict(zip(("pos_1s_m", "rot_1s_deg"), _pose_sigma(belief), strict=True))


def _pose_sigma(belief: Belief) -> tuple[float, float]:
    """1 sigma of the fixture's position [m] and attitude [deg]."""
    H = measurement_jacobian(belief.x)
    variance = np.diag(H @ belief.P @ H.T)
    return float(np.sqrt(max(variance[:3].sum(), 0.0))), _half_angle_deg(variance[3:].sum())


def _errors(belief: Belief | None, scan: Scan, estimator: str) -> dict[str, Any]:
    """Against the truth; no NEES of a cold start's first poses, which are no normal belief about the 20 numbers yet."""
    if belief is None or scan.truth is None:
        return {}
    fields: dict[str, Any] = dict(zip(("pos_err_m", "rot_err_deg"), _distance(belief.x.T_ac, scan.truth), strict=True))
    if scan.body is None or estimator == "start":
        return fields
    named, _ = nearest_permutation(belief, scan.body)
    blocks = block_nees(boxminus(named, belief.x), belief.P)
    return (
        fields | {"nees": _finite(nees(belief, scan.body))} | {f"nees_{name}": _finite(blocks[name]) for name in BLOCKS}
    )


def _distance(pose: Pose, truth: Pose) -> tuple[float, float]:
    turn = geometry.multiply(geometry.conjugate(truth.q), pose.q)
    return float(np.linalg.norm(pose.t - truth.t)), float(np.degrees(geometry.angle(turn)))


def _pose(pose: Pose, prefix: str) -> dict[str, float]:
    position = {f"{prefix}{axis}_m": float(v) for axis, v in zip("xyz", pose.t, strict=True)}
    return position | {f"{prefix}q{axis}": float(v) for axis, v in zip("xyzw", pose.q, strict=True)}


def _xyz(vector: Array, name: str, unit: str) -> dict[str, float]:
    return {f"{name}{axis}{unit}": float(v) for axis, v in zip("xyz", vector, strict=True)}


def _half_angle_deg(variance: float) -> float:
    """1 sigma of a full angle [deg] from the variance of its half [rad^2]."""
    return float(np.degrees(2.0 * np.sqrt(max(float(variance), 0.0))))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
