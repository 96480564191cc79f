"""The body of reachable moments, one convex set for every problem, and its support function in closed form.

With s = tau / t in [0, 1] and |w(s)| <= 1, the moments b0 = int (1 - s) w ds and b1 = int s w ds fill one fixed
convex body K of R^6. Its support function is h(P0, P1) = int |P(s)| ds with P(s) = (1 - s) P0 + s P1, reached by
w = P / |P| (eq:u). Thrust of size a over t takes a coasting robot from the terminal residual (dr, dv) to the goal
iff (dr, t dv - dr) / (a t^2) lies in K, so the least thrust is a gauge: a*(t) = max over P of P.b / (t^2 h(P)).

K is unchanged by a rotation of both moments, so the best P lies in the plane of b0 and b1: the search is over two
plane vectors, four numbers and one scale. Everything here is plane geometry in floats; no unit, no frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from avsreplay.geometry import Array

__all__ = ["Touch", "integrals", "support", "touch"]

SMALL_TURN = 0.25  # |P1 - P0| / (|P0| + |P1|) below which the closed form cancels and eight Gauss nodes are exact
MAX_NEWTON = 60
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_GAUSS_S = 0.5 * (_NODES + 1.0)
_GAUSS_W = 0.5 * _WEIGHTS
_GAUSS = tuple(zip(_GAUSS_S.tolist(), _GAUSS_W.tolist(), strict=True))
_FLOOR = 1e-150


@dataclass(frozen=True, slots=True)
class Touch:
    """Where the ray through b leaves K.

    Attributes:
        P0, P1: (3,) normal of K there, scaled to h(P0, P1) = 1.
        gauge: P.b, the factor by which K must grow to reach b (b lies in K iff it is <= 1).
        residual: |grad h - b / gauge|, 0 at the exact touching point.
    """

    P0: Array
    P1: Array
    gauge: float
    residual: float


def _rod(p0x: float, p0y: float, p1x: float, p1y: float) -> tuple[float, float, float]:
    """Integrals over s in [0, 1] of 1/|P|, and the end lengths: the potential of a rod, (2/l) atanh(l/(r0+r1))."""
    r0, r1 = math.hypot(p0x, p0y), math.hypot(p1x, p1y)
    length = math.hypot(p1x - p0x, p1y - p0y)
    dot, cross = p0x * p1x + p0y * p1y, p0x * p1y - p0y * p1x
    # (r0 + r1)^2 - l^2 = 2 (r0 r1 + dot), written without the cancellation of opposed ends
    gap = 2.0 * (r0 * r1 + dot) if dot > 0.0 else 2.0 * cross * cross / max(r0 * r1 - dot, _FLOOR)
    total = r0 + r1 + length
    return math.log(max(total * total, _FLOOR) / max(gap, _FLOOR)) / max(length, _FLOOR), r0, r1


def _gauss_support(p0x: float, p0y: float, p1x: float, p1y: float) -> tuple[float, list[float], list[float]]:
    """The support function where P hardly turns: eight Gauss nodes, exact to rounding there."""
    h = g0x = g0y = g1x = g1y = 0.0
    hess = [0.0] * 9
    for s, weight in _GAUSS:
        a = 1.0 - s
        px, py = a * p0x + s * p1x, a * p0y + s * p1y
        r = math.hypot(px, py)
        ux, uy = px / r, py / r
        h += weight * r
        g0x += weight * a * ux
        g0y += weight * a * uy
        g1x += weight * s * ux
        g1y += weight * s * uy
        k = weight / r
        xx, xy, yy = k * uy * uy, -k * ux * uy, k * ux * ux
        for i, f in enumerate((a * a, a * s, s * s)):
            hess[3 * i] += f * xx
            hess[3 * i + 1] += f * xy
            hess[3 * i + 2] += f * yy
    return h, [g0x, g0y, g1x, g1y], hess


def _closed_support(p0x: float, p0y: float, p1x: float, p1y: float) -> tuple[float, list[float], list[float]]:
    """The support function by its closed form, along e = (P1 - P0)/l and n across: P = u e + d n, u = u0 + l s."""
    j0, r0, r1 = _rod(p0x, p0y, p1x, p1y)
    dx, dy = p1x - p0x, p1y - p0y
    l = math.hypot(dx, dy)
    ex, ey = dx / l, dy / l
    u0, u1 = p0x * ex + p0y * ey, p1x * ex + p1y * ey
    d = 0.5 * (p0y * ex - p0x * ey + p1y * ex - p1x * ey)
    r0, r1 = max(r0, _FLOOR), max(r1, _FLOOR)
    log, dd = j0 * l, d * d
    # integrals over u of u^k/r, of d^2 u^k/r^3, d u^(k+1)/r^3, u^(k+2)/r^3
    i1 = r1 - r0
    i2 = 0.5 * (u1 * r1 - u0 * r0 - dd * log)
    h = 0.5 * (u1 * r1 - u0 * r0 + dd * log) / l
    c0, c1, c2 = u1 / r1 - u0 / r0, dd / r0 - dd / r1, d / r0 - d / r1
    a0, a1, a2 = c0, c1, dd * (log - c0)
    b0, b1, b2 = c2, d * (log - c0), d * (i1 + dd / r1 - dd / r0)
    t0, t1, t2 = log - c0, i1 + dd / r1 - dd / r0, i2 - dd * (log - c0)
    k = 1.0 / (l * l)
    g1e, g1n = (i2 - u0 * i1) * k, d * (i1 - u0 * log) * k
    g0e, g0n = i1 / l - g1e, d * log / l - g1n
    hess: list[float] = []
    k3 = k / l
    for f in ((u1 * u1, -2.0 * u1, 1.0), (-u0 * u1, u0 + u1, -1.0), (u0 * u0, -2.0 * u0, 1.0)):
        ee = k3 * (f[0] * a0 + f[1] * a1 + f[2] * a2)
        en = -k3 * (f[0] * b0 + f[1] * b1 + f[2] * b2)
        nn = k3 * (f[0] * t0 + f[1] * t1 + f[2] * t2)
        hess += [
            ee * ex * ex - 2.0 * en * ex * ey + nn * ey * ey,
            ee * ex * ey + en * (ex * ex - ey * ey) - nn * ex * ey,
            ee * ey * ey + 2.0 * en * ex * ey + nn * ex * ex,
        ]
    grad = [g0e * ex - g0n * ey, g0e * ey + g0n * ex, g1e * ex - g1n * ey, g1e * ey + g1n * ex]
    return h, grad, hess


def support(p0x: float, p0y: float, p1x: float, p1y: float) -> tuple[float, list[float], list[float]]:
    """h(P0, P1) in the plane, its gradient (4) and the blocks 00, 01, 11 of its Hessian as (xx, xy, yy) each."""
    turn = math.hypot(p1x - p0x, p1y - p0y)
    ends = math.hypot(p0x, p0y) + math.hypot(p1x, p1y)
    if turn < SMALL_TURN * ends:
        return _gauss_support(p0x, p0y, p1x, p1y)
    return _closed_support(p0x, p0y, p1x, p1y)


def _newton_step(grad: list[float], hess: list[float], b: list[float], damping: float) -> list[float]:
    """Step that lowers h on the plane P.b = const: the KKT system of one Newton step, damped."""
    kkt = np.zeros((5, 5))
    xx0, xy0, yy0, xx1, xy1, yy1, xx2, xy2, yy2 = hess
    kkt[:4, :4] = ((xx0, xy0, xx1, xy1), (xy0, yy0, xy1, yy1), (xx1, xy1, xx2, xy2), (xy1, yy1, xy2, yy2))
    kkt[[0, 1, 2, 3], [0, 1, 2, 3]] += damping
    kkt[4, :4] = kkt[:4, 4] = b
    step: list[float] = np.linalg.solve(kkt, (-grad[0], -grad[1], -grad[2], -grad[3], 0.0)).tolist()
    return step[:4]


def _norm(v: list[float]) -> float:
    return math.sqrt(sum(x * x for x in v))


def _descend(P: list[float], b: list[float]) -> tuple[list[float], float, float]:
    """Least h on P.b = 1 by damped Newton with a line search. Returns P, h(P) and |grad h - h b|."""
    h, grad, hess = support(*P)
    residual = _norm([g - h * v for g, v in zip(grad, b, strict=True)])
    for _ in range(MAX_NEWTON):
        if residual <= 1e-15 + 4e-16 * h:
            break
        trace = hess[0] + hess[2] + hess[6] + hess[8]
        step = _newton_step(grad, hess, b, 1e-3 * min(residual, 1.0) * trace + 1e-14 * trace)
        size = min(1.0, 2.0 * _norm(P) / max(_norm(step), _FLOOR))
        slope = sum(g * v for g, v in zip(grad, step, strict=True))
        best = None
        for _ in range(30):
            trial = [p + size * v for p, v in zip(P, step, strict=True)]
            h_new, grad_new, hess_new = support(*trial)
            residual_new = _norm([g - h_new * v for g, v in zip(grad_new, b, strict=True)])
            if h_new <= h + 1e-4 * size * slope or (h_new <= h * (1 + 1e-15) and residual_new < residual):
                best = (trial, h_new, grad_new, hess_new, residual_new)
                break
            size *= 0.5
        if best is None or (best[4] >= residual and residual < 1e-13):
            break
        P, h, grad, hess, residual = best
    return P, h, residual


def touch(b0: Array, b1: Array, warm: tuple[Array, Array] | None = None) -> Touch:
    """Where the ray through (b0, b1) leaves K. (3,), (3,) -> Touch; ``warm`` is a normal found nearby."""
    size = math.sqrt(float(b0 @ b0 + b1 @ b1))
    e0, e1 = _plane(b0 / size, b1 / size)
    b = [float(v) / size for v in (b0 @ e0, b0 @ e1, b1 @ e0, b1 @ e1)]
    start = [4 * b[0] - 2 * b[2], 4 * b[1] - 2 * b[3], 4 * b[2] - 2 * b[0], 4 * b[3] - 2 * b[1]]  # least int |w|^2
    if warm is not None:
        start = [float(v) for v in (warm[0] @ e0, warm[0] @ e1, warm[1] @ e0, warm[1] @ e1)]
    along = sum(p * v for p, v in zip(start, b, strict=True))
    P, h, residual = _descend([p / along for p in start], b)
    return Touch((P[0] * e0 + P[1] * e1) / h, (P[2] * e0 + P[3] * e1) / h, size / h, residual)


def _plane(b0: Array, b1: Array) -> tuple[Array, Array]:
    """Two orthonormal (3,) vectors that span b0 and b1, also where these are parallel or one is zero."""
    first, second = (b0, b1) if b0 @ b0 >= b1 @ b1 else (b1, b0)
    e0 = first / math.sqrt(float(first @ first))
    across = second - (second @ e0) * e0
    across = across - (across @ e0) * e0
    norm = math.sqrt(float(across @ across))
    if norm < 1e-14:
        across = np.eye(3)[int(np.argmin(np.abs(e0)))]
        across = across - (across @ e0) * e0
        norm = math.sqrt(float(across @ across))
    return e0, across / norm


def integrals(P0: Array, P1: Array) -> tuple[Array, Array]:
    """First and second integral of P/|P| over s in [0, 1]. (n, 3), (n, 3) -> (n, 3) int w, (n, 3) int (1 - s) w.

    Closed form through J_k = int s^k / |P| ds, the collinear case with its reversal included; eight Gauss nodes
    where P hardly turns and the closed form would cancel.
    """
    r0, r1 = np.linalg.norm(P0, axis=1), np.linalg.norm(P1, axis=1)
    D = P1 - P0
    length = np.linalg.norm(D, axis=1)
    still = length < SMALL_TURN * (r0 + r1)
    safe = np.where(still, 1.0, length)
    dot, cross = np.sum(P0 * P1, axis=1), np.cross(P0, P1)
    opposed = 2.0 * np.sum(cross * cross, axis=1) / np.maximum(r0 * r1 - dot, _FLOOR)
    gap = np.maximum(np.where(dot > 0.0, 2.0 * (r0 * r1 + dot), opposed), _FLOOR)
    j0 = np.log(np.maximum((r0 + r1 + length) ** 2, _FLOOR) / gap) / safe
    e = D / safe[:, None]
    u0, u1 = np.sum(P0 * e, axis=1), np.sum(P1 * e, axis=1)
    across = P0 - u0[:, None] * e
    log = j0 * safe
    i1 = r1 - r0
    i2 = 0.5 * (u1 * r1 - u0 * r0 - np.sum(across * across, axis=1) * log)
    first = (i1[:, None] * e + log[:, None] * across) / safe[:, None]
    s_e, s_n = (i2 - u0 * i1) / safe**2, (i1 - u0 * log) / safe**2
    second = first - (s_e[:, None] * e + s_n[:, None] * across)
    if still.any():
        first[still], second[still] = _gauss_integrals(P0[still], P1[still])
    return first, second


def _gauss_integrals(P0: Array, P1: Array) -> tuple[Array, Array]:
    P = P0[:, None, :] + _GAUSS_S[None, :, None] * (P1 - P0)[:, None, :]
    r = np.linalg.norm(P, axis=2, keepdims=True)
    w = P / np.where(r > 0.0, r, 1.0) * _GAUSS_W[None, :, None]
    return w.sum(axis=1), (w * (1.0 - _GAUSS_S)[None, :, None]).sum(axis=1)
