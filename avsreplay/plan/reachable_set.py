"""The reachable set of a robot with bounded thrust, a convex set common to all problems, and its
support function.

With s = tau / t in [0, 1] and |w(s)| <= 1, the moments b0 = int (1 - s) w ds and b1 = int s w ds
form a fixed convex set K in R^6. Its support function is h(P0, P1) = int |P(s)| ds with P(s) = (1 -
s) P0 + s P1, and the maximiser is w = P / |P|, the primer-vector law of eq:u. Thrust of magnitude a
over time t takes a coasting robot from the terminal residual (dr, dv) to the goal if and only if
(dr, t dv - dr) / (a t^2) lies in K. The least thrust is therefore a gauge (Minkowski functional):
a*(t) = max over P of P.b / (t^2 h(P)).

K does not change when both moments are rotated alike, so the optimal P lies in the plane of b0 and
b1, and the search has four unknowns in the plane, one of which is scale. All quantities here are
dimensionless and belong to no frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.plan import _cone

Vector = list[float]

# |P1 - P0| / (|P0| + |P1|) below which the closed form loses digits; eight Gauss nodes are exact to
# rounding there
SMALL_TURN = 0.25
MAX_NEWTON = 60
_POSITIVE = np.array(
    [0.18343464249564978, 0.525532409916329, 0.7966664774136267, 0.9602898564975362]
)
_OF_POSITIVE = np.array(
    [0.36268378337836166, 0.3137066458778869, 0.22238103445337443, 0.10122853629037706]
)
# Gauss-Legendre
_NODES = np.r_[-_POSITIVE[::-1], _POSITIVE]
_WEIGHTS = np.r_[_OF_POSITIVE[::-1], _OF_POSITIVE]
_GAUSS_S = 0.5 * (_NODES + 1.0)
_GAUSS_W = 0.5 * _WEIGHTS
_GAUSS_NODES = np.stack([_GAUSS_S, _GAUSS_W])
_GAUSS = tuple(zip(_GAUSS_S.tolist(), _GAUSS_W.tolist(), strict=True))
_FLOOR = 1e-150


@value_class(eq=True)
class Gauge:
    """The boundary point of K in a given direction.

    Attributes:
        P0, P1: (3,) normal of K at that point, scaled to h(P0, P1) = 1.
        value: The gauge P.b, the factor by which K must be scaled to contain b (b lies in K if it
            is <= 1).
        residual: |grad h - b / value|, which is 0 at the exact boundary point.
    """

    P0: Array
    P1: Array
    value: float
    residual: float


def _rod(p0x: float, p0y: float, p1x: float, p1y: float) -> tuple[float, float, float]:
    """Return the integral of 1/|P| over s in [0, 1], (2/l) atanh(l/(r0+r1)), and the lengths at
    both ends.
    """
    r0, r1 = math.hypot(p0x, p0y), math.hypot(p1x, p1y)
    length = math.hypot(p1x - p0x, p1y - p0y)
    dot, cross = p0x * p1x + p0y * p1y, p0x * p1y - p0y * p1x
    # (r0 + r1)^2 - l^2 = 2 (r0 r1 + dot), written without cancellation for opposed ends
    gap = 2.0 * (r0 * r1 + dot) if dot > 0.0 else 2.0 * cross * cross / max(r0 * r1 - dot, _FLOOR)
    total = r0 + r1 + length
    return math.log(max(total * total, _FLOOR) / max(gap, _FLOOR)) / max(length, _FLOOR), r0, r1


def _gauss_support(
    p0x: float, p0y: float, p1x: float, p1y: float
) -> tuple[float, list[float], list[float]]:
    """Evaluate the support function with eight Gauss nodes, for P of nearly constant direction."""
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


def _closed_support(
    p0x: float, p0y: float, p1x: float, p1y: float
) -> tuple[float, list[float], list[float]]:
    """Evaluate the support function in closed form: P = u e + d n, u = u0 + l s, e = (P1 -
    P0)/l, n normal to e.
    """
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


def support(
    p0x: float, p0y: float, p1x: float, p1y: float
) -> tuple[float, list[float], list[float]]:
    """Return h(P0, P1) in the plane, its gradient (4) and the Hessian blocks 00, 01, 11 as (xx, xy,
    yy) each.
    """
    turn = math.hypot(p1x - p0x, p1y - p0y)
    ends = math.hypot(p0x, p0y) + math.hypot(p1x, p1y)
    if turn < SMALL_TURN * ends:
        return _gauss_support(p0x, p0y, p1x, p1y)
    return _closed_support(p0x, p0y, p1x, p1y)


def newton_step(
    residual: list[float], hess: list[float], P: list[float], b: list[float], damping: float
) -> list[float]:
    """Return the Newton step (4) that decreases h on the plane P.b = 1.

    h is homogeneous, so H P = 0 and P.(grad - h b) = 0. The solution of (H + k b b^T) step = -(grad
    - h b) therefore satisfies b.step = 0, and the KKT system reduces to four symmetric positive
    definite equations (LDL^T).
    """
    k = hess[0] + hess[2] + hess[6] + hess[8]
    b0, b1, b2, b3 = b
    d0 = hess[0] + k * b0 * b0 + damping
    l1, l2, l3 = (
        (hess[1] + k * b0 * b1) / d0,
        (hess[3] + k * b0 * b2) / d0,
        (hess[4] + k * b0 * b3) / d0,
    )
    d1 = hess[2] + k * b1 * b1 + damping - l1 * l1 * d0
    m2, m3 = (
        (hess[4] + k * b1 * b2 - l1 * l2 * d0) / d1,
        (hess[5] + k * b1 * b3 - l1 * l3 * d0) / d1,
    )
    d2 = hess[6] + k * b2 * b2 + damping - l2 * l2 * d0 - m2 * m2 * d1
    n3 = (hess[7] + k * b2 * b3 - l2 * l3 * d0 - m2 * m3 * d1) / d2
    d3 = hess[8] + k * b3 * b3 + damping - l3 * l3 * d0 - m3 * m3 * d1 - n3 * n3 * d2
    y0 = -residual[0]
    y1 = -residual[1] - l1 * y0
    y2 = -residual[2] - l2 * y0 - m2 * y1
    x3 = (-residual[3] - l3 * y0 - m3 * y1 - n3 * y2) / d3
    x2 = y2 / d2 - n3 * x3
    x1 = y1 / d1 - m2 * x2 - m3 * x3
    x0 = y0 / d0 - l1 * x1 - l2 * x2 - l3 * x3
    off = b0 * x0 + b1 * x1 + b2 * x2 + b3 * x3
    return [x0 - off * P[0], x1 - off * P[1], x2 - off * P[2], x3 - off * P[3]]


def _norm(v: list[float]) -> float:
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2] + v[3] * v[3])


def _dot(a: list[float], b: list[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


@dataclass(slots=True)
class _Point:
    """One iterate: P, h(P), the Hessian, the residual grad h - h b and its norm."""

    P: list[float]
    h: float
    hess: list[float]
    residual: list[float]
    size: float


def _evaluate(P: list[float], b: list[float]) -> _Point:
    h, grad, hess = support(*P)
    residual = [grad[0] - h * b[0], grad[1] - h * b[1], grad[2] - h * b[2], grad[3] - h * b[3]]
    return _Point(P, h, hess, residual, _norm(residual))


def _descend(P: list[float], b: list[float], tolerance: float) -> _Point:
    """Minimise h on P.b = 1 by damped Newton steps with a line search until |grad h - h b| <=
    tolerance.
    """
    now = _evaluate(P, b)
    for _ in range(MAX_NEWTON):
        if now.size <= tolerance + 4e-16 * now.h:
            break
        trace = now.hess[0] + now.hess[2] + now.hess[6] + now.hess[8]
        damping = 1e-3 * min(now.size, 1.0) * trace + 1e-14 * trace
        better = _search(now, newton_step(now.residual, now.hess, now.P, b, damping), b)
        if better is None or (better.size >= now.size and now.size < 1e-13):
            break
        now = better
    return now


def _search(now: _Point, step: list[float], b: list[float]) -> _Point | None:
    """Return the first point along the step with sufficient decrease of h (Armijo), or of the
    residual at rounding.
    """
    size = min(1.0, 2.0 * _norm(now.P) / max(_norm(step), _FLOOR))
    slope = _dot(now.residual, step)  # slope of h, because b.step is 0
    P = now.P
    for _ in range(30):
        trial = [
            P[0] + size * step[0],
            P[1] + size * step[1],
            P[2] + size * step[2],
            P[3] + size * step[3],
        ]
        point = _evaluate(trial, b)
        falls = point.h <= now.h + 1e-4 * size * slope
        if falls or (point.h <= now.h * (1.0 + 1e-15) and point.size < now.size):
            return point
        size *= 0.5
    return None


def gauge(
    b0: Array, b1: Array, warm: tuple[Array, Array] | None = None, tolerance: float = 1e-15
) -> Gauge:
    """Return the gauge of K at (b0, b1) and the normal at the boundary point.

    Args:
        b0: (3,) first moment.
        b1: (3,) second moment; b0 and b1 must not both be zero.
        warm: A normal found for similar moments, used as the initial guess.
        tolerance: On the residual. The gauge is too small by about the square of the residual.
    """
    x, y, size = _scaled(b0, b1)
    plane = _plane(x, y)
    b = _in_plane(x, y, plane)
    start = [
        4 * b[0] - 2 * b[2],
        4 * b[1] - 2 * b[3],
        4 * b[2] - 2 * b[0],
        4 * b[3] - 2 * b[1],
    ]
    if warm is not None:
        tried = _in_plane(warm[0].tolist(), warm[1].tolist(), plane)
        start = tried if _dot(tried, b) > 0.0 else start
    along = _dot(start, b)
    end = _descend([p / along for p in start], b, tolerance)
    p0x, p0y, p1x, p1y = (p / end.h for p in end.P)
    return Gauge(_lifted(p0x, p0y, plane), _lifted(p1x, p1y, plane), size / end.h, end.size)


def _scaled(b0: Array, b1: Array) -> tuple[Vector, Vector, float]:
    """Return both vectors in units of their common norm, and that norm; lists are faster than
    arrays of three.
    """
    x, y = b0.tolist(), b1.tolist()
    size = math.sqrt(_dot3(x, x) + _dot3(y, y))
    return [v / size for v in x], [v / size for v in y], size


def _dot3(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _in_plane(b0: Vector, b1: Vector, plane: tuple[Vector, Vector]) -> list[float]:
    e0, e1 = plane
    return [_dot3(b0, e0), _dot3(b0, e1), _dot3(b1, e0), _dot3(b1, e1)]


def _lifted(along: float, across: float, plane: tuple[Vector, Vector]) -> Array:
    e0, e1 = plane
    return np.array([along * u + across * v for u, v in zip(e0, e1, strict=True)])


def _plane(b0: Vector, b1: Vector) -> tuple[Vector, Vector]:
    """Return two orthonormal vectors whose plane contains b0 and b1, also if these are parallel or
    one is zero.
    """
    first, second = (b0, b1) if _dot3(b0, b0) >= _dot3(b1, b1) else (b1, b0)
    norm = math.sqrt(_dot3(first, first))
    e0 = [v / norm for v in first]
    across = _without(
        _without(second, e0), e0
    )  # twice, to remove the rounding error of the first pass
    norm = math.sqrt(_dot3(across, across))
    if norm < 1e-14:
        least = min(range(3), key=lambda i: abs(e0[i]))
        across = _without([float(i == least) for i in range(3)], e0)
        norm = math.sqrt(_dot3(across, across))
    return e0, [v / norm for v in across]


def _without(v: Vector, e: Vector) -> Vector:
    """Return the component of v normal to the unit vector e."""
    k = _dot3(v, e)
    return [v[0] - k * e[0], v[1] - k * e[1], v[2] - k * e[2]]


def integrals(P0: Array, P1: Array) -> tuple[Array, Array]:
    """Integrate P/|P| over s in [0, 1] once and twice, with closed forms in J_k = int s^k / |P| ds.

    Where the direction of P hardly changes, eight Gauss nodes replace the closed form.

    Args:
        P0: (n, 3) vectors at s = 0.
        P1: (n, 3) vectors at s = 1.

    Returns:
        int w ds (n, 3) and int (1 - s) w ds (n, 3) with w = P/|P|.
    """
    return _cone.integrals(
        np.ascontiguousarray(P0), np.ascontiguousarray(P1), _GAUSS_NODES, SMALL_TURN, _FLOOR
    )
