"""Measurement noise from residuals (eq:R_resudua2): a ring buffer with a re-sum, so that nothing drifts.

Two rules. ``matrix`` is the paper's: R = mean of r r' + H P+ H', six by six, from R0's place. ``scale`` keeps the
shape of the base R (the registration's own covariance, else R0) and adapts one factor for position and one for
attitude, s^2 = mean of tr(R_b^-1 (r r' + H P+ H')) / 3 over the block: two numbers from a window instead of 21, so the
window's own scatter does not spoil the consistency. The mean is weighted as the updates were: a
wild pose is no noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from avsreplay.geometry import Array, frozen

__all__ = ["Epoch", "NoiseWindow", "at_floor", "filled", "floored", "matrix_noise", "push"]

_DOUBT = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """What one healthy epoch says: outer (6, 6) = r r' + H P+ H', its trace against the base R by block, its weight."""

    outer: Array
    ratios: tuple[float, float]
    weight: float


@dataclass(frozen=True, slots=True, eq=False)
class NoiseWindow:
    """The last healthy epochs, oldest first, at most the window's length.

    Attributes:
        factors: (6,) standard deviations over the base R, position three times and attitude three times; 1 until full.
        doubtful: do the poses contradict the estimate: have more than a tenth of them lost their say?
    """

    epochs: tuple[Epoch, ...]
    factors: Array
    doubtful: bool

    @classmethod
    def empty(cls) -> NoiseWindow:
        """A window nothing has been put into."""
        return cls((), frozen(np.ones(6)), False)


def push(
    window: NoiseWindow, residual: Array, HPH: Array, base: Array, length: int, weight: float = 1.0
) -> NoiseWindow:
    """The window with one more epoch: residual (6,) after the update, H P+ H' (6, 6), the base R it was given."""
    outer = residual[:, None] * residual + HPH
    place, turn = np.linalg.solve(_blocks(base), _blocks(outer)).trace(axis1=1, axis2=2).tolist()
    return _summed((*window.epochs[-length + 1 :], Epoch(outer, (place / 3.0, turn / 3.0), weight)), length)


def _blocks(A: Array) -> Array:
    """(2, 3, 3) position and attitude blocks of (6, 6)."""
    return A.reshape(2, 3, 2, 3).diagonal(axis1=0, axis2=2).transpose(2, 0, 1)


def _summed(epochs: tuple[Epoch, ...], length: int) -> NoiseWindow:
    weight = place = turn = 0.0
    for epoch in epochs:
        weight += epoch.weight
        place += epoch.weight * epoch.ratios[0]
        turn += epoch.weight * epoch.ratios[1]
    doubtful = weight < (1.0 - _DOUBT) * len(epochs)
    if len(epochs) < length:
        return NoiseWindow(epochs, np.ones(6), doubtful)
    s, t = math.sqrt(place / weight), math.sqrt(turn / weight)
    return NoiseWindow(epochs, np.array((s, s, s, t, t, t)), doubtful)


def matrix_noise(window: NoiseWindow, R0: Array, length: int) -> Array:
    """The paper's R: R0 until the window is full, then the mean over it."""
    if len(window.epochs) < length:
        return R0
    weight = sum(epoch.weight for epoch in window.epochs)
    return np.asarray(sum(epoch.weight * epoch.outer for epoch in window.epochs) / weight)


def filled(base: Array, factors: Array, length: int) -> NoiseWindow:
    """A full window that says what a fit found: ``factors`` (2,) of attitude and position on ``base`` (6, 6)."""
    turn, place = factors.tolist()
    s = factors[::-1].repeat(3)
    return _summed((Epoch(base * np.outer(s, s), (place**2, turn**2), 1.0),) * length, length)


def floored(R: Array, R0: Array, fraction: float) -> Array:
    """R with its eigenvalues, measured in units of R0, not below ``fraction``."""
    try:
        np.linalg.cholesky(R - fraction * R0)
    except np.linalg.LinAlgError:
        values, axes = _eigen(R, R0)
        half = axes * np.sqrt(np.maximum(values, fraction))
        return half @ half.T
    return R


def at_floor(R: Array, R0: Array, fraction: float) -> int:
    """How many eigenvalues of R in units of R0 stand on the floor."""
    bound = fraction * (1.0 + 1e-6)
    try:
        np.linalg.cholesky(R - bound * R0)
    except np.linalg.LinAlgError:
        return int(np.sum(_eigen(R, R0)[0] <= bound))
    return 0


def _eigen(R: Array, R0: Array) -> tuple[Array, Array]:
    """Values (6,) and axes (6, 6) with R = axes diag(values) axes' and R0 = axes axes'."""
    root = np.linalg.cholesky(R0)
    inside = np.linalg.solve(root, np.linalg.solve(root, R).T)
    values, vectors = np.linalg.eigh(0.5 * (inside + inside.T))
    return values, root @ vectors
