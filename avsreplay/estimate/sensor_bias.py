"""A sensor error in effect: whether it lasts, and whether its scans have another cause after all.

A bias of the sensor is a step of the pose; a manoeuvre is a step of the velocity. A small manoeuvre
between two scans may resemble a bias in the first scans after it. The hypotheses are therefore
compared again while the bias lasts. A constant offset that grows with time is a manoeuvre, where
the pose is continuous at its beginning.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from avsreplay.estimate.hypotheses import Ranked, certain
from avsreplay.estimate.measurement import GATE
from avsreplay.estimate.scan_window import (
    OFFSETS,
    PRIOR_ODDS,
    ChangePriors,
    Explanation,
    Hypothesis,
    Window,
    log_mean,
    mixed,
    offsets,
)
from avsreplay.estimate.track import Epoch, SensorBias
from avsreplay.geometry import Array

_MOST_COMPARED = 12  # scans of a bias that are compared
# 1 sigma of the change of an offset from scan to scan, because the view changes, over its size
_VARIES = 0.02
# least rms residual before and during an error over that of a scan which shows its end
_QUIETER = 1.5

Windowed = Callable[[tuple[Epoch, ...], int], Window]
"""Scans, of which as many as stated are accepted, about the motion predicted from before
(``window_of``).
"""
Compare = Callable[[tuple[Epoch, ...], int], Ranked]
"""The hypotheses about scans, of which as many as stated are accepted (``hypotheses.explain``)."""


def begun(window: Sequence[Epoch], found: Explanation) -> SensorBias:
    """Return the error that begins within some scans.

    Args:
        window: measured scans in the order of time, the last of them with the error.
        found: the hypothesis of a bias about them.
    """
    onset = found.onset
    return SensorBias(found.size, found.P, window[-1], tuple(window[:onset]), tuple(window[onset:]))


def continued(
    bias: SensorBias, epoch: Epoch, windowed: Windowed, priors: ChangePriors
) -> SensorBias | None:
    """Return the error after one more scan, None where it has ended.

    The error of the prediction grows while the estimate coasts, and with it the innovation. It
    changes little from one scan to the next, where an offset that ends changes the innovation by
    its own size. A range error displaces the pose a little differently in every view. Where this
    change does not decide, because the offset is small, all scans do that are compared. An error
    that begins with more noise ends with
    it: the bias of the noise is such an error, and after it the prediction is too uncertain to show
        the end.

    Args:
        bias: after the last scan.
        epoch: the scan.
        windowed: the scans in coordinates of one prediction.
        priors: 1 sigma of the size of an error.
    """
    seen = [e.innovation.rms_m for e in (*bias.before, *bias.since)]
    if _QUIETER * epoch.innovation.rms_m < min(seen, default=0.0):
        return None  # the scans are less noisy than before the error
    last, prediction = bias.last, epoch.prediction
    turned = prediction.H @ prediction.Phi - last.prediction.H
    P = turned @ last.prediction.belief.P @ turned.T + epoch.innovation.R + last.innovation.R
    sizes = np.repeat([priors.position_m, priors.half_angle], 3)
    P += np.diag((_VARIES * float(np.abs(bias.offset / sizes).max()) * sizes) ** 2)
    change = epoch.innovation.alpha - last.innovation.alpha
    still, ended = squared(change, P), squared(change + bias.offset, P + bias.P)
    ended += float(np.linalg.slogdet(P + bias.P)[1] - np.linalg.slogdet(P)[1])
    lasts = still < min(GATE, ended)
    if still < GATE and abs(ended - still) < -2.0 * PRIOR_ODDS and bias.before:
        scans = (*bias.before, *bias.since, epoch)
        lasts = _end_odds(windowed(scans, len(bias.before)), len(bias.before), priors) < 0.0
    return replace(bias, last=epoch) if lasts else None


def _end_odds(window: Window, onset: int, priors: ChangePriors) -> float:
    """Log odds of an error that begins at the scan ``onset`` of a window and has ended, over one
    that lasts.
    """
    white = window.whiten @ window.y
    M, scale = offsets(window, priors)
    since = window.since_each(M)[onset:]
    ratios = mixed(
        since[0] - np.concatenate([since[1:], np.zeros((1, *since.shape[1:]))]),
        white,
        scale,
        OFFSETS,
    )
    return log_mean(ratios[:-1].tolist()) - float(ratios[-1]) + PRIOR_ODDS


def compared(
    bias: SensorBias, compare: Compare
) -> tuple[SensorBias, tuple[tuple[Epoch, ...], Explanation] | None]:
    """Return the error with its last scan among those that are compared, and another hypothesis
    that explains them instead.

    At most ``_MOST_COMPARED`` scans of the error are kept. Then every second one is left out, and
    the next ones are added half as often, so that a slow growth of the offset is found as well.

    Args:
        bias: after the last scan.
        compare: the hypotheses about scans.

    Returns:
        The error, and the scans with their most likely cause if it is another one and certain;
        else None.
    """
    if bias.left_out + 1 < bias.spacing or not bias.before:
        return replace(bias, left_out=bias.left_out + 1), None
    since, spacing = (*bias.since, bias.last), bias.spacing
    if len(since) > _MOST_COMPARED:
        since, spacing = since[::2], 2 * spacing
    window, ranked = compare((*bias.before, *since), len(bias.before))
    doubted = ranked[0].hypothesis is not Hypothesis.SENSOR_BIAS
    bias = replace(bias, since=since, spacing=spacing, left_out=0, doubted=doubted)
    return bias, (window, ranked[0]) if doubted and certain(ranked) else None


def squared(y: Array, C: Array) -> float:
    """Return the squared norm of y (n,) whitened by the covariance C (n, n)."""
    return float(y @ np.linalg.solve(C, y))
