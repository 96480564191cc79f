"""The fault detector: gamma for each scan, and why it is 0 (section 6 of the equations).

The pose test is |alpha|_W = sqrt(|d rho|^2 + (L theta)^2) against a limit. While the filter tracks,
the limit is ``alpha_max_m``. Where the prediction is uncertain (at the start, after a blackout) it
is ``sigmas`` times the predicted 1 sigma of the same norm, sqrt(tr S_rho + (2 L)^2 tr S_half). The
first healthy scan is thus accepted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from avsreplay.records import (
    Alignment,
    AlignStatus,
    Belief,
    Innovation,
    Reason,
    ScanStatus,
    Verdict,
)
from avsreplay.settings import Settings, setting


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
    min_inlier_ratio: float = setting(
        0.3,
        "Smallest ratio of inliers to points of a healthy scan. A larger value rejects more scans"
        " with background or clutter.",
        low=0.0,
        high=1.0,
    )


def weighted_norm(seen: Innovation, length_m: float) -> float:
    """|alpha|_W [m]: the printed W = diag(I, L I) on metres and the full rotation angle."""
    return math.hypot(seen.distance_m, length_m * seen.angle_rad)


def pose_limit(seen: Innovation, alpha_max_m: float, length_m: float, sigmas: float) -> float:
    """The limit on |alpha|_W [m]: ``alpha_max_m``, or ``sigmas`` predicted 1 sigma where that
    is more.
    """
    variances = np.diagonal(seen.S)
    predicted = math.sqrt(
        float(variances[:3].sum()) + (2.0 * length_m) ** 2 * float(variances[3:].sum())
    )
    return max(alpha_max_m, sigmas * predicted)


class FaultDetector:
    """Decides on one scan at a time, without state.

    Args:
        params: limits; those left out are taken from ``extent_m``, the target's bounding diagonal
            [m].
    """

    def __init__(self, params: FaultParams, extent_m: float) -> None:
        self.params = params.resolved(extent_m)
        p = self.params
        self._rms, self._alpha, self._length = (
            float(v or 0.0) for v in (p.rms_max_m, p.alpha_max_m, p.length_m)
        )

    def judge(
        self,
        scan_status: ScanStatus,
        alignment: Alignment | None,
        innovation: Innovation | None,
        prior: Belief,
    ) -> Verdict:
        """Gamma and the first reason that holds, in ``Reason``'s order."""
        reason = self._unusable(scan_status, alignment, innovation, prior)
        if reason is None and alignment is not None and innovation is not None:
            reason = self._doubtful(alignment, innovation)
        if reason is None and scan_status is ScanStatus.CLOCK:
            reason = Reason.CLOCK
        return Verdict(1, Reason.OK) if reason is None else Verdict(0, reason)

    def _unusable(
        self,
        status: ScanStatus,
        alignment: Alignment | None,
        seen: Innovation | None,
        prior: Belief,
    ) -> Reason | None:
        """Return why the scan has no pose that can be tested, whatever the policy; None if it
        has one.
        """
        if status in (ScanStatus.EMPTY, ScanStatus.DAMAGED) or (
            alignment and alignment.status is AlignStatus.NO_POINTS
        ):
            return Reason.NO_SCAN
        lost = (
            alignment is None or not alignment.measured or alignment.status is AlignStatus.AMBIGUOUS
        )
        if lost or seen is None or not np.isfinite(seen.nis):
            return Reason.NOT_ALIGNED
        return None if np.all(np.isfinite(prior.P)) else Reason.NOT_ALIGNED

    def _doubtful(self, alignment: Alignment, seen: Innovation) -> Reason | None:
        p = self.params
        poor_fit = not alignment.rms_m < self._rms
        jump = weighted_norm(seen, self._length) >= pose_limit(
            seen, self._alpha, self._length, p.sigmas
        )
        if (
            alignment.status is AlignStatus.MEASURED
        ):  # nothing was fitted: the pose test alone decides
            return Reason.POSE_JUMP if jump else None
        if p.policy is Policy.ALL:
            return Reason.FIT_ERROR if poor_fit and jump else None
        if not alignment.converged or alignment.status is AlignStatus.NOT_CONVERGED:
            return Reason.NOT_CONVERGED
        if alignment.inliers < p.min_inliers or alignment.inlier_ratio < p.min_inlier_ratio:
            return Reason.FEW_INLIERS
        if poor_fit:
            return Reason.FIT_ERROR
        if (alignment.split_nis or 0.0) > p.split_nis_max:
            return Reason.HALVES_DIFFER
        return Reason.POSE_JUMP if jump else None
