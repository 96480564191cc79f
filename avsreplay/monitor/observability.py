"""The observability Gramian (eq after [eq:S_recursive]), updated scan by scan.

W_o = sum of (H Phi)' (H Phi). Its triangular root is stored, [root; H Phi] re-triangularised: the condition number of
W_o is the square of the root's, so values up to 10^30 are resolved; from the sum itself, up to 10^16. Scaled by the
prior standard deviations it has no units. The rank is relative to the measurement noise: it counts the directions
about which the poses, weighted by R^-1, give more information than the prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array, frozen
from avsreplay.records import BLOCKS

_WORDS: Mapping[str, str] = {
    "attitude": "attitude of the principal axes",
    "rate": "angular rate",
    "position": "centre of mass",
    "velocity": "velocity of the centre of mass",
    "sigma": "inertia ratios",
    "varrho": "fixture position in the body",
    "mu": "misalignment of the fixture",
}


@dataclass(frozen=True, slots=True, eq=False)
class Gramian:
    """The Gramian so far.

    Attributes:
        root: (n, n) with W_o = root' root.  white: (n, n) the same root with rows weighted by R^-1/2.
        Phi_k0: (n, n) transition from the first scan to the last.  scale: (n,) prior 1 sigma.
    """

    root: Array
    white: Array
    Phi_k0: Array
    scale: Array


@dataclass(frozen=True, slots=True)
class Observability:
    """The Gramian in numbers.

    Attributes:
        rank: directions that the poses determine better than the prior.  size: number of states.
        log10_cond, log10_cond_scaled: log10 of the condition number of W_o, None below full rank.
    """

    rank: int
    size: int
    log10_cond: float | None
    log10_cond_scaled: float | None


def gramian(prior_1s: Array) -> Gramian:
    """Return the Gramian before the first scan.

    Args:
        prior_1s: (n,) prior standard deviations in the states' units.

    Raises:
        ValueError: one of them is not positive and finite.
    """
    scale = frozen(prior_1s, -1)
    if not np.all(np.isfinite(scale)) or np.any(scale <= 0.0):
        raise ValueError("prior standard deviations must be positive and finite")
    zero = np.zeros((scale.size, scale.size))
    return Gramian(zero, zero, np.eye(scale.size), scale)


def observe(state: Gramian, Phi: Array, H: Array, R: Array | None, from_first: bool = False) -> Gramian:
    """Return the Gramian after one more scan: Phi_k0 = Phi Phi_k-1,0, and H Phi_k0 is added for a healthy scan.

    Args:
        state: the Gramian so far.
        Phi: (n, n) transition from the last scan.
        H: (m, n) measurement Jacobian.
        R: (m, m) measurement noise, None for a faulty scan.
        from_first: ``Phi`` begins at the first scan instead of the last one.
    """
    Phi_k0 = Phi if from_first else Phi @ state.Phi_k0
    if R is None:
        return Gramian(state.root, state.white, Phi_k0, state.scale)
    return _added(state, (H @ Phi_k0)[None], R[None], Phi_k0)


def from_trajectory(scale: Array, rows: Array, R: Array, Phi_k0: Array) -> Gramian:
    """Return the Gramian of many healthy scans along one trajectory.

    Args:
        scale: (n,) prior standard deviations.
        rows: (k, m, n) H Phi from the first scan.
        R: (k, m, m) measurement noise.
        Phi_k0: (n, n) transition from the first scan to the last.
    """
    return _added(gramian(scale), rows, R, Phi_k0)


def _added(state: Gramian, rows: Array, R: Array, Phi_k0: Array) -> Gramian:
    white = np.linalg.solve(np.linalg.cholesky(R), rows)
    roots = [
        np.asarray(np.linalg.qr(np.vstack([old, new.reshape(-1, state.scale.size)]), mode="r"))
        for old, new in ((state.root, rows), (state.white, white))
    ]
    return Gramian(roots[0], roots[1], Phi_k0, state.scale)


def measure(state: Gramian) -> Observability:
    """Return the rank and the condition numbers."""
    told = np.linalg.svd(state.white * state.scale, compute_uv=False)
    rank, n = int(np.sum(told > 1.0)), state.scale.size
    if rank < n:
        return Observability(rank, n, None, None)
    raw = np.linalg.svd(state.root, compute_uv=False)
    scaled = np.linalg.svd(state.root * state.scale, compute_uv=False)
    return Observability(rank, n, _log10_cond(raw), _log10_cond(scaled))


def _log10_cond(singular: NDArray[Any]) -> float | None:
    return 2.0 * math.log10(singular[0] / singular[-1]) if singular[-1] > 0.0 else None


def weakest(state: Gramian, count: int = 3, blocks: Mapping[str, slice] = BLOCKS) -> tuple[str, ...]:
    """Return the least observed directions of the scaled Gramian in words, weakest first.

    Args:
        state: the Gramian.
        count: number of directions.
        blocks: names of the states.
    """
    _, _, rows = np.linalg.svd(state.root * state.scale)
    return tuple(_in_words(row, blocks) for row in rows[::-1][:count])


def _in_words(direction: Array, blocks: Mapping[str, slice]) -> str:
    """The blocks that hold most of a unit direction, with their shares."""
    shares = {name: float(np.sum(direction[where] ** 2)) for name, where in blocks.items()}
    named = sorted(shares.items(), key=lambda item: (-item[1], item[0]))
    return " with ".join(f"{_WORDS.get(name, name)} ({share:.0%})" for name, share in named if share >= 0.1)
