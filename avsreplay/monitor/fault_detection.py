"""Gamma for each scan, and why it is 0 (section 6 of the equations): one table of rules.

The rules on a scan alone come first. What they admit goes to the estimate, which finds whether the
motion of the target, an error of the sensor or a wrong scan explains it, and to the tracker. The
remaining rules decide from what both have found. No other part of the program sets gamma.

The pose test is |alpha|_W = sqrt(|d rho|^2 + (L theta)^2) against a limit. While the filter tracks,
the limit is ``alpha_max_m``. Where the prediction is uncertain (at the start, after a blackout) it
is ``sigmas`` times the predicted 1 sigma of the same norm, sqrt(tr S_rho + (2 L)^2 tr S_half). The
first healthy scan is thus accepted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from avsreplay.errors import value_class
from avsreplay.records import (
    Admission,
    Alignment,
    AlignStatus,
    Belief,
    Finding,
    Innovation,
    Reason,
    ScanStatus,
    Verdict,
)
from avsreplay.settings import Settings, given, setting

# chi-square (6) of an innovation below which a repeated scan is that of a target at rest in a log
# without noise; an error of the pose as large as claimed is above it in 99 % of the scans
_EXACT_CHI2 = 1.0


class Policy(Enum):
    """How the fit test and the pose test are combined."""

    ANY = "any"  # either one is a fault
    ALL = "all"  # as printed: a fault only where both fail


@dataclass(frozen=True, slots=True)
class FaultParams(Settings):
    """Limits of fault detection."""

    policy: Policy = setting(
        Policy.ANY,
        "How the fit test and the pose test are joined: a scan is faulty if either fails (any), or"
        " only if both fail, as printed in the paper (all).",
    )
    rms_max_m: float | None = setting(
        None,
        "Rms distance of the inliers from the model from which a scan is faulty. A larger value"
        " accepts worse registrations.",
        unit="m",
        above=0.0,
        of_extent=0.01,
    )
    alpha_max_m: float | None = setting(
        None,
        "Innovation of the pose, in the weighted norm, from which a scan is faulty. A larger value"
        " accepts larger deviations from the prediction.",
        unit="m",
        above=0.0,
        of_extent=0.02,
    )
    length_m: float | None = setting(
        None,
        "Characteristic length that converts an angle to a length in the weighted norm. A larger"
        " value gives errors of attitude more weight.",
        unit="m",
        above=0.0,
        of_extent=0.25,
    )
    sigmas: float = setting(
        4.0,
        "The limit on the innovation is never below this multiple of its predicted 1 sigma. A"
        " larger value accepts more poses after a blackout.",
        above=0.0,
    )
    min_inliers: int = setting(
        50,
        "Smallest number of inliers of a healthy scan. A larger value rejects more scans of small"
        " or distant targets.",
        low=0,
    )
    split_nis_max: float = setting(
        60.0,
        "A scan is faulty if the normalised squared difference of the poses from its two halves is"
        " above this value.",
        above=0.0,
    )


def weighted_norm(seen: Innovation, length_m: float) -> float:
    """|alpha|_W [m]: the printed W = diag(I, L I) on metres and the full rotation angle.

    Args:
        seen: the innovation.
        length_m: the length L [m] that weighs the rotation.
    """
    return math.hypot(seen.distance_m, length_m * seen.angle_rad)


def pose_limit(seen: Innovation, alpha_max_m: float, length_m: float, sigmas: float) -> float:
    """The limit on |alpha|_W [m]: ``alpha_max_m``, or ``sigmas`` predicted 1 sigma where that
    is more.

    Args:
        seen: the innovation with its covariance.
        alpha_max_m: the fixed limit [m].
        length_m: the length L [m] that weighs the rotation.
        sigmas: predicted 1 sigma that are allowed.
    """
    variances = np.diagonal(seen.S)
    predicted = math.sqrt(
        float(variances[:3].sum()) + (2.0 * length_m) ** 2 * float(variances[3:].sum())
    )
    return max(alpha_max_m, sigmas * predicted)


@value_class
class ScanEvidence:
    """What the rules see of one scan.

    Attributes:
        status: of the reader.
        alignment: the graded pose; None without one.
        seen: its innovation; None where nothing was measured.
        prior: the prediction at the scan.
        limits: of the run, with all lengths filled in.
        repeated: the scan has the points, or the pose, of the one before.
        finding: of the estimate.
        followed: the target does not move freely, and the tracker confirms the pose.
    """

    status: ScanStatus
    alignment: Alignment | None
    seen: Innovation | None
    prior: Belief
    limits: FaultParams
    repeated: bool = False
    finding: Finding = Finding.UNTESTED
    followed: bool = False

    @property
    def fitted(self) -> bool:
        """Whether the pose is that of a registration, and not one that the log contains."""
        return self.alignment is None or self.alignment.status is not AlignStatus.MEASURED

    @property
    def poor_fit(self) -> bool:
        """Whether the rms residual reaches its limit."""
        return self.alignment is None or not self.alignment.rms_m < given(self.limits.rms_max_m)

    @property
    def jumps(self) -> bool:
        """Whether the weighted innovation reaches its limit."""
        p, length = self.limits, given(self.limits.length_m)
        return self.seen is not None and weighted_norm(self.seen, length) >= pose_limit(
            self.seen, given(p.alpha_max_m), length, p.sigmas
        )


@value_class
class Rule:
    """One row of the table.

    Attributes:
        reason: value of the column ``reason`` of a scan for which the test holds; gamma is 1 with
            ``OK`` and 0 with any other.
        words: what the test finds, for people.
        holds: the test.
        policies: under which the row applies.
        fitted: the row applies to poses of a registration only, not to poses that the log contains.
    """

    reason: Reason
    words: str
    holds: Callable[[ScanEvidence], bool]
    policies: tuple[Policy, ...] = (Policy.ANY, Policy.ALL)
    fitted: bool = False

    def applies(self, scan: ScanEvidence, policy: Policy) -> bool:
        """Return whether the row decides on a scan.

        Args:
            scan: what is known of it.
            policy: of the run; of a pose that the log contains there is no fit to combine, so that
                its innovation decides under each.
        """
        if self.fitted and not scan.fitted:
            return False
        return (policy if scan.fitted else Policy.ANY) in self.policies and self.holds(scan)


def _no_scan(scan: ScanEvidence) -> bool:
    lost = scan.status in (ScanStatus.EMPTY, ScanStatus.DAMAGED)
    return lost or (scan.alignment is not None and scan.alignment.status is AlignStatus.NO_POINTS)


def _frozen(scan: ScanEvidence) -> bool:
    return scan.repeated and scan.seen is not None and scan.seen.chi2 > _EXACT_CHI2


def _not_aligned(scan: ScanEvidence) -> bool:
    found = scan.alignment
    if found is None or not found.measured or found.status is AlignStatus.AMBIGUOUS:
        return True
    return (
        scan.seen is None
        or not np.isfinite(scan.seen.nis)
        or not bool(np.all(np.isfinite(scan.prior.P)))
    )


def _not_converged(scan: ScanEvidence) -> bool:
    found = scan.alignment
    return found is None or not found.converged or found.status is AlignStatus.NOT_CONVERGED


def _few_inliers(scan: ScanEvidence) -> bool:
    found = scan.alignment
    return found is None or found.inliers < scan.limits.min_inliers


def _halves_differ(scan: ScanEvidence) -> bool:
    found = scan.alignment
    return found is not None and (found.split_nis or 0.0) > scan.limits.split_nis_max


def _as_printed(scan: ScanEvidence) -> bool:
    return scan.poor_fit and scan.jumps


def _jumps(scan: ScanEvidence) -> bool:
    return scan.jumps


def _found(*findings: Finding) -> Callable[[ScanEvidence], bool]:
    return lambda scan: scan.finding in findings


SCAN_RULES = (
    Rule(Reason.NO_SCAN, "the scan has no point, or its message is damaged", _no_scan),
    Rule(
        Reason.FROZEN,
        "the scan repeats the one before, and its pose is not the predicted one",
        _frozen,
        (Policy.ANY,),
    ),
    Rule(Reason.NOT_ALIGNED, "the registration failed or is ambiguous", _not_aligned),
    Rule(
        Reason.FIT_ERROR,
        "the rms residual and the innovation reach their limits (the rule of the paper)",
        _as_printed,
        (Policy.ALL,),
        fitted=True,
    ),
    Rule(
        Reason.NOT_CONVERGED,
        "the registration did not converge",
        _not_converged,
        (Policy.ANY,),
        fitted=True,
    ),
    Rule(
        Reason.FEW_INLIERS,
        "too few points are on the model",
        _few_inliers,
        (Policy.ANY,),
        fitted=True,
    ),
    Rule(
        Reason.FIT_ERROR,
        "the rms residual reaches its limit",
        lambda scan: scan.poor_fit,
        (Policy.ANY,),
        fitted=True,
    ),
    Rule(
        Reason.HALVES_DIFFER,
        "the poses from two halves of the scan differ",
        _halves_differ,
        (Policy.ANY,),
        fitted=True,
    ),
    Rule(
        Reason.CLOCK,
        "the time stamp steps back or jumps",
        lambda scan: scan.status is ScanStatus.CLOCK,
    ),
)
"""The rules on a scan alone, of which the first that holds rejects it."""

JUMP = Rule(Reason.POSE_JUMP, "the innovation reaches its limit", _jumps, (Policy.ANY,))

MOTION_RULES = (
    Rule(
        Reason.OK,
        "the target does not move freely, and the pose agrees with the poses before it",
        lambda scan: scan.followed,
    ),
    Rule(
        Reason.OK,
        "the motion of the target explains the pose",
        _found(Finding.AGREES, Finding.EXPLAINED),
    ),
    Rule(
        Reason.SENSOR_BIAS,
        "the poses have an offset that no motion explains",
        _found(Finding.OFFSET),
    ),
    Rule(
        Reason.WRONG_SCAN,
        "neither a motion nor an error of the sensor explains the last poses",
        _found(Finding.UNEXPLAINED),
    ),
    JUMP,
    Rule(
        Reason.DOUBTFUL,
        "the innovations are unlikely, and their cause is not decided",
        lambda scan: True,  # noqa: ARG005
    ),
)
"""The rules on a scan that none of the others has rejected, with what the estimate and the tracker
have found; the last one holds always."""

SCAN_AND_MOTION_RULES = (*SCAN_RULES, *MOTION_RULES)
"""All rules in their order; the first that holds decides on gamma and gives the reason."""


@value_class
class Examined:
    """A scan after the rules that need nothing but it.

    Attributes:
        scan: what is known of it.
        rejected: the rule that rejected it, or None.
        admission: what the estimate may do with its pose.
    """

    scan: ScanEvidence
    rejected: Rule | None
    admission: Admission


class FaultDetector:
    """Decides on one scan at a time, without state.

    Args:
        params: limits; those left out are taken from ``extent_m``, the target's bounding diagonal
            [m].
    """

    def __init__(self, params: FaultParams, extent_m: float) -> None:
        self.params = params.resolved(extent_m)

    def examine(
        self,
        scan_status: ScanStatus,
        alignment: Alignment | None,
        innovation: Innovation | None,
        prior: Belief,
        repeated: bool = False,
    ) -> Examined:
        """Return what the rules on a scan alone find.

        Args:
            scan_status: of the reader.
            alignment: the graded pose; None without one.
            innovation: of it; None where nothing was measured.
            prior: the prediction at the scan.
            repeated: the scan has the points, or the pose, of the one before.
        """
        scan = ScanEvidence(scan_status, alignment, innovation, prior, self.params, repeated)
        rejected = self._first(SCAN_RULES, scan)
        admission = Admission.REFUSED
        if rejected is None:
            large = JUMP.applies(scan, self.params.policy)
            admission = Admission.LARGE if large else Admission.ADMITTED
        return Examined(scan, rejected, admission)

    def judge(self, examined: Examined, finding: Finding, followed: bool = False) -> Verdict:
        """Return gamma and the reason of the first rule that holds.

        Args:
            examined: the scan.
            finding: of the estimate.
            followed: the target does not move freely, and the tracker confirms the pose.
        """
        rule = examined.rejected
        if rule is None:
            scan = replace(examined.scan, finding=finding, followed=followed)
            rule = self._first(MOTION_RULES, scan)
        reason = Reason.OK if rule is None else rule.reason
        return Verdict(int(reason is Reason.OK), reason)

    def _first(self, rules: tuple[Rule, ...], scan: ScanEvidence) -> Rule | None:
        return next((rule for rule in rules if rule.applies(scan, self.params.policy)), None)
