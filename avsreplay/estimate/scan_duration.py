"""The motion during a scan whose points were measured one after the other.

The points are moved to the scan's instant by the predicted motion (``deskew``). The error of the
prediction moves with them, so the scan's pose is not a measurement at the scan's instant alone:
``with_scan_duration`` gives its Jacobian. Without it, part of the prior would be used as new
information, and the covariance would be too small.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.estimate.dynamics import propagate_state, rotation_path
from avsreplay.estimate.measurement import measurement_jacobian, to_camera, to_fixture
from avsreplay.estimate.track import Prediction
from avsreplay.geometry import Array
from avsreplay.records import State

# instants at which the motion is computed; in between, rotation and position are interpolated
# linearly
_KNOTS = 65


def deskew(points: NDArray[Any], times_s: NDArray[Any], x: State) -> Array:
    """Points in {A} as if all had been measured at the scan's instant: p(0) = T_ac(0) T_ac(t)^-1
    p(t).

    The remaining error is that of the predicted rate and velocity times the duration of the scan.

    Args:
        points: (n, 3) in {A} [m].
        times_s: (n,) instant of each relative to the scan's [s].
        x: predicted state at the scan's instant, in {A}.

    Returns:
        (n, 3) points in {A} [m].

    Raises:
        ValueError: shapes differ, or a time is not finite.
    """
    points, times = np.asarray(points, dtype=np.float64), np.asarray(times_s, dtype=np.float64)
    if points.shape != (len(times), 3) or not np.all(np.isfinite(times)):
        raise ValueError(
            f"points {points.shape} and times {times.shape} do not fit, or a time is not finite"
        )
    if not len(times) or float(np.ptp(times)) == 0.0 == float(times[0]):
        return points
    knots = np.linspace(min(float(times.min()), 0.0), max(float(times.max()), 0.0), _KNOTS)
    rotations, offsets = _to_scan_instant(x, knots)
    return geometry.moved_in_time(points, times, knots, rotations, offsets)


def with_scan_duration(
    prediction: Prediction, instants: Array, times_s: NDArray[Any]
) -> Prediction:
    """The prediction with the H (6, 20), the lag and the blur of a scan that was deskewed by the
    same prediction.

    A point measured at tau and moved by the prior shows the prior's error at tau: delta(tau) in
    {C}, whatever instant it is moved to. Over a scan delta is taken as linear in time, so the
    registered pose shows delta(first) + (M - first) delta', with the mean instants M. Treated as
    the pose at one instant, the lag tr M / 6, it is off by (M - lag) delta': the blur.

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
    G, lag_s, blur = _fixture_jacobian(x, first), float(np.trace(instants)) / 6.0, None
    if last > first:
        slope = (_fixture_jacobian(x, last) - G) / (last - first)
        rest = (instants - lag_s * np.eye(6)) @ slope
        G = G + (instants - first * np.eye(6)) @ slope
        blur = rest @ prediction.belief.P @ rest.T
    return replace(prediction, H=to_camera(x.T_ac.q, x.q_bc) @ G, lag_s=lag_s, blur=blur)


def _fixture_jacobian(x: State, h: float) -> Array:
    """(6, 20) error of the pose h seconds later, d = [theta; v] in {C} [rad, m], by the error
    states now.
    """
    then, Phi = propagate_state(x, h)
    return to_fixture(then.T_ac.q, x.q_bc) @ measurement_jacobian(then) @ Phi


def _to_scan_instant(x: State, knots: Array) -> tuple[Array, Array]:
    """R (k, 3, 3) and offset (k, 3) of T_ac(0) T_ac(t)^-1 at ``knots`` relative to the scan's
    instant.
    """
    q_ab, _ = rotation_path(x).at(knots)
    A_t, now = geometry.matrix(q_ab), x.T_ac
    q_ac = geometry.multiply(q_ab, x.q_bc)
    t_ac = x.r_a + knots[:, None] * x.v_a + A_t @ x.c_b
    R = now.R @ np.swapaxes(geometry.matrix(q_ac), -1, -2)
    return R, now.t - np.einsum("kij,kj->ki", R, t_ac)
