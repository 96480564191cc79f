"""Measurement noise from residuals (eq:R_resudua2): a ring buffer with a re-sum, so that nothing drifts.

Two rules. ``matrix`` is the paper's: R = mean of r r' + H P+ H', six by six, from R0's place. ``scale`` keeps the
shape of the base R (the registration's own covariance, else R0) and adapts one factor for position and one for
attitude, s^2 = mean of tr(R_b^-1 (r r' + H P+ H')) / 3 over the block: two numbers from a window instead of 21, so the
window's own scatter does not spoil the consistency.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avsreplay.geometry import Array, frozen

__all__ = ["NoiseWindow", "at_floor", "factors", "filled", "floored", "matrix_noise", "push"]


@dataclass(frozen=True, slots=True, eq=False)
class NoiseWindow:
    """Residuals of the last healthy epochs, oldest first, at most the window's length.

    Attributes:
        outer: (n, 6, 6) r r' + H P+ H' of each epoch.  ratios: (n, 2) its trace against the base R, by block.
    """

    outer: Array
    ratios: Array

    @classmethod
    def empty(cls) -> NoiseWindow:
        """A window nothing has been put into."""
        return cls(frozen(np.zeros((0, 6, 6))), frozen(np.zeros((0, 2))))


def push(window: NoiseWindow, residual: Array, HPH: Array, base: Array, length: int) -> NoiseWindow:
    """The window with one more epoch: residual (6,) after the update, H P+ H' (6, 6), the base R it was given."""
    outer = np.outer(residual, residual) + HPH
    ratios = np.trace(np.linalg.solve(_blocks(base), _blocks(outer)), axis1=1, axis2=2) / 3.0
    keep = length - 1
    return NoiseWindow(_append(window.outer, outer, keep), _append(window.ratios, ratios, keep))


def _blocks(A: Array) -> Array:
    """(2, 3, 3) position and attitude blocks of (6, 6)."""
    return np.stack([A[:3, :3], A[3:, 3:]])


def _append(stack: Array, item: Array, keep: int) -> Array:
    out = np.concatenate([stack[max(0, len(stack) - keep) :], item[None]])
    out.flags.writeable = False
    return out


def matrix_noise(window: NoiseWindow, R0: Array, length: int) -> Array:
    """The paper's R: R0 until the window is full, then the mean over it."""
    if len(window.outer) < length:
        return R0
    R: Array = window.outer.mean(axis=0)
    return R


def factors(window: NoiseWindow, length: int) -> Array:
    """(6,) standard deviation factors of the base R, position three times and attitude three times; 1 until full."""
    if len(window.ratios) < length:
        return np.ones(6)
    return np.repeat(np.sqrt(window.ratios.mean(axis=0)), 3)


def filled(base: Array, factors: Array, length: int) -> NoiseWindow:
    """A full window that says what a fit found: ``factors`` (2,) of attitude and position on ``base`` (6, 6)."""
    s = np.repeat(factors[::-1], 3)
    outer, ratios = base * np.outer(s, s), factors[::-1] ** 2
    return NoiseWindow(frozen(np.broadcast_to(outer, (length, 6, 6))), frozen(np.broadcast_to(ratios, (length, 2))))


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
