"""What the patches of the model say of a registered pose: the jackknife's covariance, and which motions they hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avsreplay.register.quality import Residuals, jackknife_covariance, unbounded_directions, without_dominant_patches


def test_covariance_of_an_ideal_plane_fit_is_the_textbook_one() -> None:
    """White noise across the surface: the sandwich must agree with s^2 (J'J)^-1."""
    rng = np.random.default_rng(11)
    J = rng.normal(size=(20000, 6))
    e = rng.normal(0.0, 0.3, 20000)
    P = jackknife_covariance(Residuals(20000, 20000, 0.3, J, e, np.zeros(3), 0.3, np.arange(20000)))
    oracle = 0.09 * np.linalg.inv(J.T @ J)
    np.testing.assert_allclose(P, oracle, atol=0.1 * oracle[0, 0])


def _in_patches(seed: int) -> Residuals:
    rng = np.random.default_rng(seed)
    J, e = rng.normal(size=(600, 6)), rng.normal(0.0, 0.3, 600)
    return Residuals(600, 600, 0.3, J, e, np.zeros(3), 0.3, np.arange(600) // 20)


def test_covariance_is_the_jackknife_over_patches() -> None:
    """Fitted again without each patch in turn: the moves, squared and summed."""
    found = _in_patches(3)
    whole = np.linalg.lstsq(found.J, found.e, rcond=None)[0]
    settled = replace(found, e=found.e - found.J @ whole)
    moves = []
    for k in range(30):
        rest = settled.patch != k
        moves.append(np.linalg.lstsq(settled.J[rest], settled.e[rest], rcond=None)[0])
    oracle = np.array(moves).T @ np.array(moves)
    np.testing.assert_allclose(jackknife_covariance(settled), oracle, rtol=1e-6, atol=1e-9 * oracle.max())


def test_what_one_patch_holds_alone_is_not_held() -> None:
    """Nothing but patch 7 sees the last motion: it is left out, and the motion is free; without it nothing is lone."""
    found = _in_patches(4)
    J = found.J.copy()
    J[found.patch != 7, 5] = 0.0
    left = without_dominant_patches(replace(found, J=J))
    assert len(left.J) == 580
    assert np.all(left.J[:, 5] == 0.0)
    assert left.patch.max() == 28
    assert without_dominant_patches(found) is found


def test_patches_are_left_out_until_none_holds_a_motion_alone() -> None:
    """Patch 7 holds the last motion, 8 what is left of it without 7, 9 the rest: all three go, one after the other."""
    found = _in_patches(4)
    J = found.J.copy()
    for patch in range(30):
        J[found.patch == patch, 5] *= {7: 1.0, 8: 1e-2, 9: 1e-4}.get(patch, 0.0)
    left = without_dominant_patches(replace(found, J=J))
    assert np.all(left.J[:, 5] == 0.0)
    assert len(left.J) == 540


def test_a_motion_known_no_better_than_the_targets_size_is_loose() -> None:
    P = np.diag([1e-8, 1e-8, 4.0, 1e-8, 1e12, 1e-8])
    assert unbounded_directions(P, 3.0) == ("turns about z", "slides along y")
    assert unbounded_directions(P, 3e6) == ("turns about z",)
    assert unbounded_directions(np.eye(6) * 1e-6, 3.0) == ()
