"""The observability Gramian (eq after [eq:S_recursive]) as a fold over scans.

W_o = sum of (H Phi)' (H Phi). What is folded is its triangular root, [root; H Phi] re-triangularised: the condition
of W_o is the square of the root's, so 10^30 is still told from 10^16, which the sum itself cannot. Scaled by the prior
standard deviations it has no units. A rank below full is said as such, not as a huge number.
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

__all__ = ["Gramian", "Observability", "gramian", "measure", "observe", "weakest"]

RANK_TOL = 1e-11
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
    """The fold's state: root (n, n) with W_o = root' root, Phi_k0 (n, n), and the prior 1 sigma (n,) that scales it."""

    root: Array
    Phi_k0: Array
    scale: Array


@dataclass(frozen=True, slots=True)
class Observability:
    """The Gramian in numbers.

    Attributes:
        rank: of the scaled Gramian.  size: number of states.
        log10_cond, log10_cond_scaled: log10 of the condition, None below full rank.
    """

    rank: int
    size: int
    log10_cond: float | None
    log10_cond_scaled: float | None


def gramian(prior_1s: Array) -> Gramian:
    """Nothing seen yet; ``prior_1s`` (n,) are the prior standard deviations in the states' units."""
    scale = frozen(prior_1s, -1)
    if not np.all(np.isfinite(scale)) or np.any(scale <= 0.0):
        raise ValueError("prior standard deviations must be positive and finite")
    return Gramian(np.zeros((scale.size, scale.size)), np.eye(scale.size), scale)


def observe(state: Gramian, Phi: Array, H: Array, gamma: int) -> Gramian:
    """One scan on: Phi_k0 = Phi Phi_k-1,0 always, H Phi_k0 added where the scan is healthy. Phi (n, n), H (m, n)."""
    Phi_k0 = Phi @ state.Phi_k0
    if gamma == 0:
        return Gramian(state.root, Phi_k0, state.scale)
    root: Array = np.asarray(np.linalg.qr(np.vstack([state.root, H @ Phi_k0]), mode="r"))
    return Gramian(root, Phi_k0, state.scale)


def measure(state: Gramian) -> Observability:
    """Rank and conditions."""
    scaled = np.linalg.svd(state.root * state.scale, compute_uv=False)
    rank = int(np.sum(scaled > RANK_TOL * scaled[0])) if scaled[0] > 0.0 else 0
    n = scaled.size
    if rank < n:
        return Observability(rank, n, None, None)
    raw = np.linalg.svd(state.root, compute_uv=False)
    return Observability(rank, n, _log10_cond(raw), _log10_cond(scaled))


def _log10_cond(singular: NDArray[Any]) -> float | None:
    return 2.0 * math.log10(singular[0] / singular[-1]) if singular[-1] > 0.0 else None


def weakest(state: Gramian, count: int = 3, blocks: Mapping[str, slice] = BLOCKS) -> tuple[str, ...]:
    """The least observed directions of the scaled Gramian in words, weakest first."""
    _, _, rows = np.linalg.svd(state.root * state.scale)
    return tuple(_in_words(row, blocks) for row in rows[::-1][:count])


def _in_words(direction: Array, blocks: Mapping[str, slice]) -> str:
    """The blocks that hold most of a unit direction, with their shares."""
    shares = {name: float(np.sum(direction[where] ** 2)) for name, where in blocks.items()}
    named = sorted(shares.items(), key=lambda item: (-item[1], item[0]))
    return " with ".join(f"{_WORDS.get(name, name)} ({share:.0%})" for name, share in named if share >= 0.1)
