"""The observability Gramian along a run: its rank, its condition number and the directions that are
not determined.

Equation after [eq:S_recursive]: W_o = sum of (H Phi)' (H Phi). Its triangular root is stored,
[root; H Phi] re-triangularised: the condition number of W_o is the square of the root's, so values
up to 10^30 are resolved; from the sum itself, up to 10^16. Scaled by the prior standard deviations
it has no units. The rank is relative to the measurement noise: it counts the directions about which
the poses, weighted by R^-1, give more information than the prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array, frozen
from avsreplay.monitor import _root
from avsreplay.records import BLOCKS

_BLOCK_WORDS: Mapping[str, str] = {
    "attitude": "attitude of the principal axes",
    "rate": "angular rate",
    "position": "centre of mass",
    "velocity": "velocity of the centre of mass",
    "sigma": "inertia ratios",
    "varrho": "fixture position in the body",
    "mu": "misalignment of the fixture",
}


@value_class
class Gramian:
    """The Gramian so far.

    Attributes:
        root: (n, n) upper triangular with W_o = root' root.
        white: (n, n) the same root with rows weighted by R^-1/2.
        Phi_k0: (n, n) transition from the first scan to the last.
        scale: (n,) prior 1 sigma.
    """

    root: Array
    white: Array
    Phi_k0: Array
    scale: Array


@value_class(eq=True)
class Observability:
    """The Gramian in numbers.

    Attributes:
        rank: directions that the poses determine better than the prior.
        size: number of states.
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


def observe(state: Gramian, Phi: Array, H: Array, R: Array | None) -> Gramian:
    """Return the Gramian after one more scan: Phi_k0 = Phi Phi_k-1,0, and H Phi_k0 is added for a
    healthy scan.

    Args:
        state: the Gramian so far.
        Phi: (n, n) transition from the last scan.
        H: (m, n) measurement Jacobian.
        R: (m, m) measurement noise, None for a faulty scan.
    """
    Phi_k0 = Phi @ state.Phi_k0
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
    root, whitened = _root.extended(state.root, state.white, rows, R)
    return Gramian(root, whitened, Phi_k0, state.scale)


def measure(state: Gramian) -> Observability:
    """Return the rank and the condition numbers.

    Args:
        state: the Gramian.
    """
    n = state.scale.size
    told = np.linalg.svd(state.white * state.scale, compute_uv=False)
    if (rank := int(np.count_nonzero(told > 1.0))) < n:
        return Observability(rank, n, None, None)
    raw, scaled = np.linalg.svd(np.array([state.root, state.root * state.scale]), compute_uv=False)
    return Observability(rank, n, _log10_cond(raw), _log10_cond(scaled))


def _log10_cond(singular: NDArray[Any]) -> float | None:
    return 2.0 * math.log10(singular[0] / singular[-1]) if singular[-1] > 0.0 else None


def unobserved(state: Gramian, blocks: Mapping[str, slice] = BLOCKS) -> tuple[str, ...]:
    """Return in words the directions about which the poses give less information than the prior,
    each once.

    Args:
        state: the Gramian.
        blocks: names of the states.

    Returns:
        One text for each of the ``size - rank`` directions of ``measure``.
    """
    told, directions = _directions(state)
    return _in_words(directions[told <= 1.0], blocks)


def weakest(
    state: Gramian, count: int = 3, blocks: Mapping[str, slice] = BLOCKS
) -> tuple[str, ...]:
    """Return in words the directions with the least information among those that the poses do
    determine, each once.

    Args:
        state: the Gramian.
        count: number of directions.
        blocks: names of the states.
    """
    told, directions = _directions(state)
    return _in_words(directions[told > 1.0][::-1][:count], blocks)


def _directions(state: Gramian) -> tuple[Array, Array]:
    """Singular values (n,) of the whitened and scaled root, largest first, and its directions (n,
    n) as rows.
    """
    _, told, rows = np.linalg.svd(state.white * state.scale)
    return told, rows


def _in_words(directions: Array, blocks: Mapping[str, slice]) -> tuple[str, ...]:
    """A text for each of k orthonormal directions (k, n): its states, each with its block and axis.

    The directions are replaced by others that span the same space and each of which alone contains
    one of k states, because the axes within a space of equal information are arbitrary.
    """
    if not len(directions):
        return ()
    own, rest = list[int](), directions.copy()
    for _ in directions:  # QR decomposition with column pivoting
        own.append(int(np.argmax(np.sum(rest**2, axis=0))))
        q = rest[:, own[-1]] / np.linalg.norm(rest[:, own[-1]])
        rest -= np.outer(q, q @ rest)
    own.sort()
    basis = np.linalg.solve(directions[:, own], directions)
    shares = basis**2 / np.sum(basis**2, axis=1, keepdims=True)
    return tuple(_text_of(share, state, blocks) for share, state in zip(shares, own, strict=True))


def _text_of(share: Array, own: int, blocks: Mapping[str, slice]) -> str:
    """The state ``own`` and those with at least a tenth of a direction, by block, with shares
    unless one is all.
    """
    place = {
        i: (name, i - where.start)
        for name, where in blocks.items()
        for i in range(where.start, where.stop)
    }
    named = sorted(
        {own, *map(int, np.flatnonzero(share >= 0.1))}, key=lambda i: (i != own, -share[i], i)
    )
    together = dict.fromkeys(place[i][0] for i in named)
    texts = []
    for name in together:
        axes = ", ".join(
            "123"[place[i][1]] if name == "sigma" else "xyz"[place[i][1]]
            for i in named
            if place[i][0] == name
        )
        held = float(np.sum(share[blocks[name]]))
        texts.append(
            f"{_BLOCK_WORDS.get(name, name)} {axes}"
            + ("" if len(together) == 1 else f" ({held:.0%})")
        )
    return " with ".join(texts)
