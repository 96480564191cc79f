"""The fault rule: every reason, their order, both policies, and a limit that grows with the
predicted 1 sigma.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avsreplay.geometry import Pose
from avsreplay.monitor.fault_detection import (
    SCAN_AND_MOTION_RULES,
    FaultDetector,
    FaultParams,
    Policy,
    pose_limit,
    weighted_norm,
)
from avsreplay.records import (
    Admission,
    Alignment,
    AlignStatus,
    Belief,
    Finding,
    Innovation,
    Reason,
    ScanStatus,
    State,
)

PRIOR = Belief(
    0,
    State([0, 0, 0, 1.0], *[np.zeros(3)] * 3, np.zeros(2), np.zeros(3), [0, 0, 0, 1.0]),
    np.eye(20),
)
GOOD = Alignment(
    Pose.identity(), 5, True, 4000, 3900, 0.008, np.eye(6), AlignStatus.ALIGNED, np.eye(6)
)
SMALL = np.eye(6) * 1e-8


def seen(distance: float = 0.0, angle: float = 0.0, S: np.ndarray = SMALL) -> Innovation:
    alpha = np.array([distance, 0, 0, np.sin(angle / 2), 0, 0])
    nis = float(alpha @ np.linalg.solve(S, alpha))
    return Innovation(alpha, S, S, nis, nis, distance, angle)


def judge(
    alignment: Alignment | None = GOOD,
    innovation: Innovation | None = None,
    status=ScanStatus.OK,
    **params,
):
    innovation = seen() if innovation is None else innovation
    return judged(FaultDetector(FaultParams(**params), 8.0), status, alignment, innovation)


def judged(detector, status, alignment, innovation, repeated=False, finding=None, followed=False):
    """The verdict where the estimate uses each admitted pose, or has found something else."""
    examined = detector.examine(status, alignment, innovation, PRIOR, repeated)
    admitted = examined.admission is Admission.ADMITTED
    found = finding or (Finding.AGREES if admitted else Finding.UNTESTED)
    return detector.judge(examined, found, followed)


def test_a_good_scan_is_healthy() -> None:
    verdict = judge()
    assert (verdict.gamma, verdict.reason) == (1, Reason.OK)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"status": AlignStatus.NO_POINTS}, Reason.NO_SCAN),
        ({"status": AlignStatus.NO_OVERLAP}, Reason.NOT_ALIGNED),
        ({"status": AlignStatus.FAILED}, Reason.NOT_ALIGNED),
        ({"status": AlignStatus.AMBIGUOUS}, Reason.NOT_ALIGNED),
        ({"status": AlignStatus.NOT_CONVERGED, "converged": False}, Reason.NOT_CONVERGED),
        ({"converged": False}, Reason.NOT_CONVERGED),
        ({"inliers": 49, "points": 60}, Reason.FEW_INLIERS),
        ({"rms_m": 0.08}, Reason.FIT_ERROR),
        ({"rms_m": float("nan")}, Reason.FIT_ERROR),
    ],
)
def test_each_reason(change: dict[str, object], reason: Reason) -> None:
    verdict = judge(replace(GOOD, **change))
    assert (verdict.gamma, verdict.reason) == (0, reason)


def test_missing_and_empty_scans_are_faults() -> None:
    assert judge(status=ScanStatus.EMPTY).reason is Reason.NO_SCAN
    assert judge(status=ScanStatus.DAMAGED).reason is Reason.NO_SCAN
    assert judge(status=ScanStatus.CLOCK).reason is Reason.CLOCK
    assert (
        judged(FaultDetector(FaultParams(), 8.0), ScanStatus.OK, None, None).reason
        is Reason.NOT_ALIGNED
    )


def test_a_scan_that_repeats_the_one_before_is_frozen_unless_its_pose_is_the_predicted_one() -> (
    None
):
    detector, moved = FaultDetector(FaultParams(), 8.0), seen(0.001)
    assert moved.chi2 > 6.0
    found = [
        judged(detector, ScanStatus.OK, GOOD, innovation, repeated)
        for innovation, repeated in ((moved, True), (moved, False), (seen(), True))
    ]
    assert [v.reason for v in found] == [Reason.FROZEN, Reason.OK, Reason.OK]
    printed = FaultDetector(FaultParams(policy=Policy.ALL), 8.0)
    assert judged(printed, ScanStatus.OK, GOOD, moved, True).gamma == 1


def test_a_degenerate_view_is_not_a_fault() -> None:
    assert judge(replace(GOOD, status=AlignStatus.DEGENERATE, covariance=None)).gamma == 1


def test_the_first_reason_that_holds_is_given() -> None:
    worst = replace(GOOD, converged=False, inliers=3, rms_m=1.0)
    assert judge(worst, seen(5.0)).reason is Reason.NOT_CONVERGED
    assert judge(replace(worst, converged=True), seen(5.0)).reason is Reason.FEW_INLIERS
    assert judge(replace(GOOD, rms_m=1.0), seen(5.0)).reason is Reason.FIT_ERROR


NEAR, FAR = seen(0.001), seen(5.0)


@pytest.mark.parametrize(
    ("innovation", "finding", "reason"),
    [
        (NEAR, Finding.AGREES, Reason.OK),
        (FAR, Finding.EXPLAINED, Reason.OK),
        (NEAR, Finding.OPEN, Reason.DOUBTFUL),
        (FAR, Finding.OPEN, Reason.POSE_JUMP),
        (FAR, Finding.UNTESTED, Reason.POSE_JUMP),
        (NEAR, Finding.OFFSET, Reason.SENSOR_BIAS),
        (FAR, Finding.OFFSET, Reason.SENSOR_BIAS),
        (NEAR, Finding.UNEXPLAINED, Reason.WRONG_SCAN),
        (FAR, Finding.UNEXPLAINED, Reason.WRONG_SCAN),
    ],
)
def test_the_reason_is_that_which_decided(innovation, finding, reason) -> None:
    """The estimate decides on what no other rule refuses, and the pose test while it has not."""
    detector = FaultDetector(FaultParams(), 8.0)
    found = judged(detector, ScanStatus.OK, GOOD, innovation, finding=finding)
    assert (found.gamma, found.reason) == (int(reason is Reason.OK), reason)
    confirmed = judged(detector, ScanStatus.OK, GOOD, innovation, finding=finding, followed=True)
    assert confirmed.gamma == 1
    late = judged(detector, ScanStatus.CLOCK, GOOD, innovation, finding=finding, followed=True)
    assert (late.gamma, late.reason) == (0, Reason.CLOCK)


def test_every_reason_has_a_rule_and_the_last_rule_always_holds() -> None:
    assert {rule.reason for rule in SCAN_AND_MOTION_RULES} == set(Reason)
    never = FaultDetector(FaultParams(policy=Policy.ALL), 8.0)
    open_ = judged(never, ScanStatus.OK, GOOD, FAR, finding=Finding.OPEN)
    assert open_.reason is Reason.DOUBTFUL


def test_weighted_norm_uses_the_full_angle() -> None:
    assert weighted_norm(seen(0.03, 0.02), 2.0) == pytest.approx(0.05)


@pytest.mark.parametrize(("distance", "angle"), [(0.17, 0.0), (0.0, 0.09), (0.12, 0.06)])
def test_a_pose_jump_is_a_fault_though_the_fit_is_good(distance: float, angle: float) -> None:
    """A half-turned or slid fit on a symmetric target: small rms, wrong pose."""
    assert judge(innovation=seen(distance, angle)).reason is Reason.POSE_JUMP
    assert judge(innovation=seen(distance, angle), policy=Policy.ALL).gamma == 1


def test_policy_all_needs_both() -> None:
    poor, jump = replace(GOOD, rms_m=0.5), seen(1.0)
    assert judge(poor, policy=Policy.ALL).gamma == 1
    assert judge(poor, jump, policy=Policy.ALL).reason is Reason.FIT_ERROR
    assert judge(None, policy=Policy.ALL).gamma == 0


def test_the_limit_grows_with_the_predicted_sigma() -> None:
    """After a blackout with 0.3 m and 5 deg predicted 1 sigma an innovation of that size takes the
    track up again.
    """
    half = np.radians(2.5)
    S = np.diag(np.repeat([0.3**2, half**2], 3))
    predicted = np.sqrt(3 * 0.3**2 + 4 * 2.0**2 * 3 * half**2)
    assert pose_limit(seen(S=S), 0.16, 2.0, 4.0) == pytest.approx(4.0 * predicted)
    assert judge(innovation=seen(0.3, 2 * half, S)).gamma == 1
    assert judge(innovation=seen(0.3, 2 * half)).gamma == 0


def test_false_alarms_of_the_pose_test_are_below_a_percent() -> None:
    """Innovations drawn from their own S, at any ratio of position to attitude spread."""
    rng = np.random.Generator(np.random.PCG64(0))
    alarms = 0
    for _ in range(2000):
        root = (
            rng.normal(size=(6, 6))
            * np.repeat(10.0 ** rng.uniform(-3, 0, size=2), 3)[:, None]
            * [1, 1, 1, 0.1, 0.1, 0.1]
        )
        S = root @ root.T
        alpha = root @ rng.normal(size=6)
        angle = 2 * np.arcsin(min(1.0, float(np.linalg.norm(alpha[3:]))))
        one = Innovation(alpha, S, S, 6.0, 6.0, float(np.linalg.norm(alpha[:3])), angle)
        alarms += judge(innovation=one, alpha_max_m=1e-9).gamma == 0
    assert alarms < 20


@pytest.mark.parametrize("name", ["rms_max_m", "alpha_max_m", "length_m", "sigmas"])
def test_params_refuse_by_name(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        FaultParams(**{name: -1.0})


def test_auto_limits_scale_with_the_target() -> None:
    small, large = FaultParams().resolved(0.2), FaultParams().resolved(8.0)
    for name in ("rms_max_m", "alpha_max_m", "length_m"):
        assert getattr(large, name) == pytest.approx(40.0 * getattr(small, name))
    assert FaultParams(rms_max_m=0.003).resolved(8.0).rms_max_m == 0.003
