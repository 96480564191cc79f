"""Errors that all measured poses have in common: a wrong size, wrong ranges, errors of the
shape of the model.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avsreplay import geometry
from avsreplay.estimate.common_errors import (
    NO_MODEL_ERRORS,
    ModelErrors,
    line_of_sight_1s,
    motion_covariance,
    systematic_share,
)
from avsreplay.geometry import Pose
from avsreplay.records import Alignment, AlignStatus, Scan, Surface
from avsreplay.register.contract import boxes, example_pose, view
from avsreplay.register.model_check import ModelCheck
from avsreplay.register.registrar import Registrar

EXTENT_M = 4.0


def aligned(share: float, size: float = 0.0, rms_m: float = 0.002) -> Alignment:
    """An alignment with a share of systematic errors along all directions."""
    C = np.diag([1e-6] * 3 + [1e-6] * 3)
    pose = Pose(np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, 7.0]))
    found = Alignment(pose, 1, True, 1000, 1000, rms_m, np.linalg.inv(C), AlignStatus.ALIGNED, C)
    return replace(found, systematic=share * C, size=(size, 2e-4))


def after(count: int, *found: Alignment) -> ModelErrors:
    """The sums after scans that repeat these."""
    errors = NO_MODEL_ERRORS
    for k in range(count):
        errors = errors.with_scan(found[k % len(found)], EXTENT_M, None)
    return errors


def test_the_share_of_the_systematic_errors_is_that_of_the_variance() -> None:
    assert systematic_share(aligned(0.25)) == pytest.approx(0.25)
    assert systematic_share(replace(aligned(0.25), systematic=None)) == 0.0
    assert systematic_share(replace(aligned(0.25), covariance=None)) == 0.0


def test_estimates_of_zero_variances_do_not_count() -> None:
    errors = after(100, aligned(0.0), aligned(0.5), aligned(0.0), aligned(0.25))
    assert errors.counted == 0.0
    assert errors.motions.shape == (6, 0)


def test_systematic_errors_leave_a_motion_that_more_scans_do_not_reduce() -> None:
    few, many = after(20, aligned(0.9)), after(400, aligned(0.9))
    covariance = few.motions @ few.motions.T
    assert covariance == pytest.approx(0.5 * 0.9 * 1e-6 * np.eye(6), abs=1e-12)
    assert many.motions @ many.motions.T == pytest.approx(covariance, abs=1e-12)
    assert after(5, aligned(0.9)).motions.shape == (6, 0)


def test_a_scan_that_is_not_used_changes_only_the_place_of_the_sensor() -> None:
    errors, sensor = (
        after(20, aligned(0.9)),
        Pose(np.array([0.0, 0.0, 0.0, 1.0]), np.array([1.0, 2.0, 3.0])),
    )
    later = errors.with_scan(None, EXTENT_M, sensor)
    assert later.sensor == (1.0, 2.0, 3.0)
    assert (later.scans, later.share, later.sizes) == (errors.scans, errors.share, errors.sizes)


def test_the_paper_keeps_no_sums() -> None:
    paper = ModelErrors(kept=False)
    assert paper.with_scan(aligned(0.9), EXTENT_M, None) is paper


@pytest.mark.parametrize("size", [0.004, -0.004])
def test_a_wrong_size_makes_the_distance_uncertain_by_its_share(size: float) -> None:
    at = np.array([3.0, 0.0, 4.0])
    b = line_of_sight_1s(at, np.zeros((3, 3)), after(100, aligned(0.1, size)))
    assert b / np.linalg.norm(b) == pytest.approx(at / 5.0)
    assert np.linalg.norm(b) == pytest.approx(np.sqrt(0.5) * 0.004 * 5.0, rel=0.01)


def test_the_size_that_noise_feigns_does_not_count() -> None:
    rng = np.random.default_rng(3)
    scattered = after(60, *(aligned(0.1, 0.003 * x) for x in rng.normal(size=60)))
    assert scattered.size_error == 0.0
    assert after(60, aligned(0.1, 0.004, rms_m=0.02)).size_error == 0.0
    assert after(60, aligned(0.1, 0.004, rms_m=0.002)).size_error > 0.0


def test_the_line_of_sight_begins_at_the_sensor() -> None:
    sensor, at = np.array([0.0, 5.0, 0.0]), np.array([0.0, 5.0, 2.0])
    errors = after(100, aligned(0.1, 0.004)).with_scan(
        None, EXTENT_M, Pose(np.array([0.0, 0.0, 0.0, 1.0]), sensor)
    )
    assert line_of_sight_1s(at, np.zeros((3, 3)), errors) == pytest.approx(
        [0.0, 0.0, np.sqrt(0.5) * 0.004 * 2.0], rel=0.01
    )


def test_a_constant_motion_of_the_model_is_an_error_of_the_fixture() -> None:
    """The covariance of the pose of {C} gains that of d, rotated to the frames of the state."""
    rng = np.random.default_rng(5)
    d = 1e-3 * rng.normal(size=(6, 2))
    q_bc = geometry.exp(np.array([0.3, -0.2, 0.5]))
    P, R = motion_covariance(d, q_bc), geometry.matrix(q_bc)
    assert P[17:, 17:] == pytest.approx(0.25 * R @ d[:3] @ d[:3].T @ R.T)
    assert P[14:17, 14:17] == pytest.approx(R @ d[3:] @ d[3:].T @ R.T)
    assert np.linalg.matrix_rank(P, tol=1e-15) == 2


def bent(surface: Surface, angle: float) -> Surface:
    """The model with its second box rotated about its middle [rad]: a part that is not where
    the model says.
    """
    v = np.array(surface.vertices)
    middle = v[8:16].mean(axis=0)
    v[8:16] = (v[8:16] - middle) @ geometry.matrix(
        geometry.exp(np.array([angle, angle, 0.0]))
    ).T + middle
    return replace(surface, vertices=v, sha256="")


def test_a_registration_to_a_bent_model_states_systematic_errors() -> None:
    surface, rng = boxes(), np.random.default_rng(7)
    shares, remarks = [], list[str]()
    for model in (surface, bent(surface, 0.06)):
        registrar, found = Registrar(model), []
        check = ModelCheck(registrar, model)
        for k in range(6):
            pose = example_pose() @ Pose(geometry.exp(np.array([0.0, 0.2 * k, 0.0])), np.zeros(3))
            scan = pose.apply(view(surface, 6000, pose.inverse().t))
            scan += 0.003 * rng.normal(size=scan.shape)
            alignment = registrar.register(scan, pose, k)
            found.append(systematic_share(alignment))
            check.add(Scan(k, 10**9 * k, scan), alignment)
        remarks.append(check.remark())
        shares.append(float(np.mean(found)))
    assert shares[0] < 0.4
    assert shares[1] > 0.6
    assert remarks[0] == ""
    assert "errors of the model or of the ranges" in remarks[1]
