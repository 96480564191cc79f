"""What the patches of the model say of a registered pose: the jackknife's covariance, and which motions they hold."""

from __future__ import annotations

import numpy as np
from oracles.residuals import summed

from avsreplay.register.covariance import Evidence, jackknife_covariance, without_dominant_patches
from avsreplay.register.quality import unbounded_directions


def test_covariance_of_an_ideal_plane_fit_is_the_textbook_one() -> None:
    """White noise across the surface: the sandwich must agree with s^2 (J'J)^-1."""
    rng = np.random.default_rng(11)
    J = rng.normal(size=(20000, 6))
    e = rng.normal(0.0, 0.3, 20000)
    P = _jackknife(summed(J, e, np.arange(20000)))
    oracle = 0.09 * np.linalg.inv(J.T @ J)
    np.testing.assert_allclose(P, oracle, atol=0.1 * oracle[0, 0])


PATCH = np.arange(600) // 20


def _jackknife(found: Evidence) -> np.ndarray:
    return jackknife_covariance(found.normals, found.gradients)


def _rows(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(600, 6)), rng.normal(0.0, 0.3, 600)


def test_covariance_is_the_jackknife_over_patches() -> None:
    """Fitted again without each patch in turn: the moves, squared and summed."""
    J, e = _rows(3)
    e = e - J @ np.linalg.lstsq(J, e, rcond=None)[0]
    moves = [np.linalg.lstsq(J[k != PATCH], e[k != PATCH], rcond=None)[0] for k in range(30)]
    oracle = np.array(moves).T @ np.array(moves)
    np.testing.assert_allclose(_jackknife(summed(J, e, PATCH)), oracle, rtol=1e-6, atol=1e-9 * oracle.max())


def test_a_motion_that_one_patch_alone_determines_is_not_counted() -> None:
    """Nothing but patch 7 sees the last motion: it is left out, and the motion is free; without it nothing is lone."""
    J, e = _rows(4)
    found = summed(J, e, PATCH)
    assert without_dominant_patches(found) is found
    J[PATCH != 7, 5] = 0.0
    left = without_dominant_patches(summed(J, e, PATCH))
    assert left.counts.sum() == 580
    assert np.all(left.normals[:, 5] == 0.0)
    assert len(left.normals) == len(left.gradients) == 29


def test_patches_are_left_out_until_none_determines_a_motion_alone() -> None:
    """Patch 7 holds the last motion, 8 what is left of it without 7, 9 the rest: all three go, one after the other."""
    J, e = _rows(4)
    for patch in range(30):
        J[patch == PATCH, 5] *= {7: 1.0, 8: 1e-2, 9: 1e-4}.get(patch, 0.0)
    left = without_dominant_patches(summed(J, e, PATCH))
    assert np.all(left.normals[:, 5] == 0.0)
    assert left.counts.sum() == 540


def test_a_motion_known_no_better_than_the_targets_size_is_loose() -> None:
    P = np.diag([1e-8, 1e-8, 4.0, 1e-8, 1e12, 1e-8])
    assert unbounded_directions(P, 3.0) == ("turns about z", "slides along y")
    assert unbounded_directions(P, 3e6) == ("turns about z",)
    assert unbounded_directions(np.eye(6) * 1e-6, 3.0) == ()
