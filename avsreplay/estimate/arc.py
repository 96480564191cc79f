"""A whole motion at once: attitude, rate and their derivatives by the initial state at many instants.

The path is cut into pieces of ``SUBSTEP_RAD`` of turn. The rate's series runs through them one after another; the
linear series of all pieces is then summed in one go, and every instant is a polynomial of its piece.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.estimate.layout import hamilton
from avsreplay.estimate.motion import GENERATORS, SUBSTEP_RAD, rate_series, series_order, sigma3, sigma_join
from avsreplay.geometry import Array
from avsreplay.records import State

__all__ = ["Arc", "Path", "arc"]

_SLOWEST = 1e-4  # rad in a piece that holds the whole path of a body almost at rest


@dataclass(frozen=True, slots=True, eq=False)
class Arc:
    """Rotation at n instants from one initial state.

    Attributes:
        q: (n, 4) attitude q_ab.  w: (n, 3) rate in {B} [rad/s].
        S: (n, 6, 8) derivative of (dq_v, w) at each instant by (dq_v, w, sigma) at the start.
    """

    q: Array
    w: Array
    S: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Pieces:
    """m pieces: start [s], length [s], scaled rate coefficients (m, k + 1, 3) and products (m, k, 3)."""

    start: Array
    length: Array
    rates: Array
    products: Array


def arc(x: State, times_s: Array) -> Arc:
    """The motion from ``x`` at 0 to each of ``times_s`` (n,) >= 0 [s], in any order."""
    times = np.asarray(times_s, dtype=np.float64)
    return Path(x, float(times.max(initial=0.0))).at(times)


class Path:
    """A motion laid out up to ``end_s``, to be asked many times."""

    def __init__(self, x: State, end_s: float) -> None:
        self.end_s = end_s
        ratios = np.array((float(x.sigma[0]), float(x.sigma[1]), sigma3(x.sigma)))
        self._pieces = _lay_out(x.w_b, ratios, end_s)
        self._Y = _sensitivities(self._pieces, ratios)
        m, terms = self._Y.shape[:2]
        whole = _at(self._Y, np.ones((m, terms)), np.arange(m), self._pieces.length)
        self._q, self._chain = _join(x.q_ab, whole)
        self._sigma_join = sigma_join(x.sigma)

    def at(self, times: Array) -> Arc:
        """The motion at ``times`` (n,) in [0, end_s]."""
        p = self._pieces
        where = np.clip(np.searchsorted(p.start, times, side="right") - 1, 0, len(p.start) - 1)
        tau = (times - p.start[where]) / p.length[where]
        powers = tau[:, None] ** np.arange(self._Y.shape[1])
        inside = _at(self._Y, powers, where, p.length)
        S9 = inside @ self._chain[where]
        S = np.concatenate([S9[:, :, :6], S9[:, :, 6:] @ self._sigma_join], axis=2)
        w = np.einsum("nk,nkj->nj", powers, p.rates[where]) / p.length[where, None]
        return Arc(geometry.multiply(self._q[where], _relative(inside)), w, S)


def _lay_out(w: Array, ratios: Array, end: float) -> _Pieces:
    order = series_order(SUBSTEP_RAD)
    s1, s2, s3 = ratios.tolist()
    wx, wy, wz = w.tolist()
    start = 0.0
    starts: list[float] = []
    lengths, rates, products = [], [], []
    while not starts or start < end:
        speed = math.sqrt(wx * wx + wy * wy + wz * wz)
        h = max(end - start, 1e-9) if speed * (end - start) < _SLOWEST else SUBSTEP_RAD / speed
        series, pairs = rate_series((wx * h, wy * h, wz * h), (s1, s2, s3), order)
        starts.append(start)
        lengths.append(h)
        rates.append(series)
        products.append(pairs)
        wx, wy, wz = (math.fsum(c) / h for c in zip(*series, strict=True))
        start += h
    return _Pieces(np.array(starts), np.array(lengths), np.array(rates), np.array(products))


def _sensitivities(pieces: _Pieces, ratios: Array) -> Array:
    """(m, k + 1, 6, 9): Taylor coefficients of the derivatives by (dq_v, w h, sigma1..3) over pieces of length 1."""
    m, order, _ = pieces.products.shape
    E = (np.concatenate([[1.0], ratios]) @ GENERATORS).reshape(3, 36)
    terms = (pieces.rates[:, order - 1 :: -1] @ E).reshape(m, order, 6, 6)
    terms[:, -1, :3, 3:] = 0.5 * np.eye(3)
    N = np.ascontiguousarray(terms.transpose(0, 2, 1, 3)).reshape(m, 6, 6 * order)
    Y = np.zeros((m, 6 * (order + 1), 9))
    Y[:, :6, :6] = np.eye(6)
    axes = np.arange(3)
    for k in range(order):
        step = N[:, :, 6 * (order - 1 - k) :] @ Y[:, : 6 * (k + 1)]
        step[:, 3 + axes, 6 + axes] += pieces.products[:, k]
        Y[:, 6 * (k + 1) : 6 * (k + 2)] = step / (k + 1.0)
    return Y.reshape(m, order + 1, 6, 9)


def _at(Y: Array, powers: Array, where: NDArray[np.intp], length: Array) -> Array:
    """(n, 6, 9) sensitivities within pieces ``where`` at ``powers`` (n, k + 1) of the scaled time, in rates again."""
    n, h = len(powers), length[where, None, None]
    S = (powers[:, None, :] @ Y.reshape(*Y.shape[:2], 54)[where]).reshape(n, 6, 9)
    S[:, :3, 3:6] *= h
    S[:, 3:, 6:9] /= h
    return S


def _join(q: Array, whole: Array) -> tuple[Array, Array]:
    """Attitude (m, 4) and derivative (m, 9, 9) at the start of each piece, from the pieces' whole steps."""
    turns = _relative(whole)
    qs, chain = [q], np.zeros((len(whole), 9, 9))
    chain[0] = np.eye(9)
    for k in range(1, len(whole)):
        qs.append(np.array(hamilton(qs[-1], turns[k - 1])))
        chain[k, :6] = whole[k - 1] @ chain[k - 1]
        chain[k, 6:, 6:] = np.eye(3)
    return np.array(qs), chain


def _relative(S: Array) -> Array:
    """q_rel (n, 4) of attitude blocks A(q_rel)' (n, 3, 3) well below a half turn."""
    return geometry.quaternion(np.swapaxes(S[:, :3, :3], -1, -2))
