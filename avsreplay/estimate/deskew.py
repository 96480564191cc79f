"""Motion inside a scan: points measured at their own instants carried to the scan's instant by the predicted motion.

What is carried takes the prediction's error along, so the scan's pose is no measurement at the scan's instant: ``late``
says what it is one of. Without it the prior is taken for news, and the estimate for surer than it is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.estimate.arc import Path
from avsreplay.estimate.estimator import Prediction
from avsreplay.estimate.measure import sensitivity, to_camera, to_fixture
from avsreplay.estimate.motion import moved
from avsreplay.geometry import Array
from avsreplay.records import State

__all__ = ["deskew", "late"]

_KNOTS = 65  # instants the motion is worked out at; between them rotation and position go straight


def deskew(points: NDArray[Any], times_s: NDArray[Any], prediction: Prediction) -> Array:
    """Points (n, 3) in {A} as they would be if all were measured at the scan's instant.

    A point on the target moves with it: p(0) = T_ac(0) T_ac(t)^-1 p(t), by the prior's motion. Its error is that of
    the predicted rate and velocity times the span of the scan, not the motion itself.

    Args:
        points: (n, 3) [m].
        times_s: (n,) instant of each relative to the scan's [s].
        prediction: the scan's prior.

    Raises:
        ValueError: shapes differ, or a time is not finite.
    """
    points, times = np.asarray(points, dtype=np.float64), np.asarray(times_s, dtype=np.float64)
    if points.shape != (len(times), 3) or not np.all(np.isfinite(times)):
        raise ValueError(f"points {points.shape} and times {times.shape} do not fit, or a time is not finite")
    if not len(times) or float(np.ptp(times)) == 0.0 == float(times[0]):
        return points
    knots = np.linspace(min(float(times.min()), 0.0), max(float(times.max()), 0.0), _KNOTS)
    rotations, offsets = _back(prediction.belief.x, knots)
    place = np.clip((times - knots[0]) / (knots[1] - knots[0]), 0.0, _KNOTS - 1.0)
    low = np.minimum(place.astype(int), _KNOTS - 2)
    part = (place - low)[:, None]
    carried = [np.einsum("nij,nj->ni", rotations[k], points) + offsets[k] for k in (low, low + 1)]
    return np.asarray((1.0 - part) * carried[0] + part * carried[1])


def late(prediction: Prediction, instants: Array, times_s: NDArray[Any]) -> Prediction:
    """The prediction with the H (6, 20) of a scan that it carried to its instant itself, its lag and its blur.

    A point measured at tau and carried by the prior shows the prior's error at tau: delta(tau) in {C}, whatever
    instant it is carried to. Over a scan delta is taken as straight, so the registered pose shows
    delta(first) + (M - first) delta', by the mean instants M. Taken for the pose of one instant, the lag tr M / 6, it
    is off by (M - lag) delta': the blur.

    Args:
        prediction: the scan's prior, that of ``deskew``.
        instants: (6, 6) M, mean instant of the registered points by direction in {C} [s].
        times_s: (n,) instants of the points relative to the scan's [s].
    """
    if not len(times_s):
        return prediction
    x, first, last = prediction.belief.x, float(np.min(times_s)), float(np.max(times_s))
    if first == 0.0 == last:
        return prediction
    G, lag_s, blur = _fixture_rows(x, first), float(np.trace(instants)) / 6.0, None
    if last > first:
        slope = (_fixture_rows(x, last) - G) / (last - first)
        rest = (instants - lag_s * np.eye(6)) @ slope
        G = G + (instants - first * np.eye(6)) @ slope
        blur = rest @ prediction.belief.P @ rest.T
    return replace(prediction, H=to_camera(x.T_ac.q, x.q_bc) @ G, lag_s=lag_s, blur=blur)


def _fixture_rows(x: State, h: float) -> Array:
    """(6, 20) error of the pose h seconds on, d = [theta; v] in {C} [rad, m], by the error states now."""
    then, Phi = moved(x, h)
    return to_fixture(then.T_ac.q, x.q_bc) @ sensitivity(then) @ Phi


def _back(x: State, knots: Array) -> tuple[Array, Array]:
    """R (k, 3, 3) and offset (k, 3) of T_ac(0) T_ac(t)^-1 at ``knots`` about now."""
    q_ab, _ = Path(x).at(knots)
    A_t, now = geometry.matrix(q_ab), x.T_ac
    q_ac = geometry.multiply(q_ab, x.q_bc)
    t_ac = x.r_a + knots[:, None] * x.v_a + A_t @ x.c_b
    R = now.R @ np.swapaxes(geometry.matrix(q_ac), -1, -2)
    return R, now.t - np.einsum("kij,kj->ki", R, t_ac)
