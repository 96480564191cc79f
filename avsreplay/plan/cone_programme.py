"""For a fixed end time: the least thrust under convex limits, a second-order cone programme.

Thrust is constant over each of N equal intervals, so velocities are linear and positions quadratic between nodes, and
a bound on thrust or speed at the nodes is a bound everywhere. Lengths are in units of the way to go, times in units of
the end time: the programme has the same shape whatever the target's size.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array

Index = NDArray[np.signedinteger[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class ConeConstraint:
    """|across| <= slope * along + mouth at some nodes, along and across taken from ``apex`` about ``axis``.

    Attributes:
        nodes: (m,) node numbers from 1.  apex, axis: (m, 3) [m], unit.  slope: tan of the half-angle.
        mouth: (m,) radius at the apex, less what keeps the path inside between nodes [m].
    """

    nodes: Index
    apex: Array
    axis: Array
    slope: float
    mouth: Array


@dataclass(frozen=True, slots=True, eq=False)
class HalfSpaces:
    """``normal . r >= offset`` at some nodes. nodes (m,), normal (m, 3) unit, offset (m,) [m]."""

    nodes: Index
    normal: Array
    offset: Array


@dataclass(frozen=True, slots=True, eq=False)
class ConeProgramme:
    """From (r0, v0) to (r1, v1) in t seconds over n intervals, under the limits given.

    Attributes:
        speed: bound on |v| [m/s].  contact: (acceleration (3,), bound): |u - acceleration| <= bound at the end.
    """

    t: float
    n: int
    r0: Array
    v0: Array
    r1: Array
    v1: Array
    speed: float | None = None
    contact: tuple[Array, float] | None = None
    funnels: tuple[ConeConstraint, ...] = ()
    walls: tuple[HalfSpaces, ...] = ()


@dataclass(slots=True)
class _Rows:
    """Rows of A x + s = b in the making, s in a product of cones."""

    rows: list[Index] = field(default_factory=list)
    columns: list[Index] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)
    right: list[Array] = field(default_factory=list)
    count: int = 0

    def put(self, rows: Index, columns: Index, value: Any) -> None:
        """Entries ``value`` at rows (counted from the present block) and columns."""
        self.rows.append(self.count + rows)
        self.columns.append(np.broadcast_to(columns, rows.shape))
        self.values.append(np.broadcast_to(np.asarray(value, dtype=np.float64), rows.shape))

    def close(self, right: Array) -> None:
        """End the present block of rows with its right-hand side."""
        self.right.append(right)
        self.count += len(right)


def solve(p: ConeProgramme) -> tuple[float, Array] | None:
    """Least bound on thrust [m/s2] and the thrust (n, 3) that keeps it; None where the limits cannot be met."""
    clarabel: Any = importlib.import_module("clarabel")
    from scipy import sparse

    way = max(float(np.linalg.norm(p.r1 - p.r0 - p.v0 * p.t)), float(np.linalg.norm(p.v1 - p.v0)) * p.t, 1e-9)
    n, size = p.n, 9 * p.n + 7
    rows = _Rows()
    _dynamics(rows, p, way)
    cones = [clarabel.ZeroConeT(rows.count)]
    cones += [clarabel.SecondOrderConeT(4)] * _norms(rows, p, way)
    cones += [clarabel.SecondOrderConeT(4)] * _funnels(rows, p, way)
    walls = _walls(rows, p, way)
    cones += [clarabel.NonnegativeConeT(walls)] if walls else []
    A = sparse.csc_matrix(
        (np.concatenate(rows.values), (np.concatenate(rows.rows), np.concatenate(rows.columns))), (rows.count, size)
    )
    cost = np.zeros(size)
    cost[-1] = 1.0
    nothing = sparse.csc_matrix((size, size))
    found = clarabel.DefaultSolver(nothing, cost, A, np.concatenate(rows.right), cones, _settings(clarabel)).solve()
    if str(found.status) not in ("Solved", "AlmostSolved"):
        return None
    x = np.array(found.x)
    u = x[6 * (n + 1) : -1].reshape(n, 3) * (way / p.t**2)
    return float(np.sqrt(np.max(np.sum(u * u, axis=1)))), u


def _settings(clarabel: Any) -> Any:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = 1e-10
    settings.tol_feas = 1e-11
    return settings


def _dynamics(rows: _Rows, p: ConeProgramme, way: float) -> None:
    """Let r' = r + h v + h^2/2 u and v' = v + h u over each interval, and both ends. Variables: r, v, u, bound."""
    n, h = p.n, 1.0 / p.n
    k, at_v, at_u = np.arange(3 * n), 3 * (n + 1), 6 * (n + 1)
    for column, factor in ((k + 3, 1.0), (k, -1.0), (at_v + k, -h), (at_u + k, -0.5 * h * h)):
        rows.put(k, column, factor)
    rows.close(np.zeros(3 * n))
    for column, factor in ((at_v + k + 3, 1.0), (at_v + k, -1.0), (at_u + k, -h)):
        rows.put(k, column, factor)
    rows.close(np.zeros(3 * n))
    j = np.arange(3)
    pace = way / p.t
    for first, value in ((0, p.r0 / way), (at_v, p.v0 / pace), (3 * n, p.r1 / way), (at_v + 3 * n, p.v1 / pace)):
        rows.put(j, first + j, 1.0)
        rows.close(value)


def _norms(rows: _Rows, p: ConeProgramme, way: float) -> int:
    """|u| <= bound, |v| <= speed, |u_last - a| <= contact. Returns how many cones of 4 these are."""
    n, at_v, at_u = p.n, 3 * (p.n + 1), 6 * (p.n + 1)
    k, count = np.arange(n), n
    rows.put(4 * k, np.array(9 * n + 6), -1.0)
    for c in range(3):
        rows.put(4 * k + 1 + c, at_u + 3 * k + c, -1.0)
    rows.close(np.zeros(4 * n))
    if p.speed is not None:
        for c in range(3):
            rows.put(4 * k + 1 + c, at_v + 3 * k + 3 + c, -1.0)
        rows.close(np.tile((p.speed * p.t / way, 0.0, 0.0, 0.0), n))
        count += n
    if p.contact is not None:
        acceleration, bound = p.contact
        j = np.arange(3)
        rows.put(1 + j, at_u + 3 * (n - 1) + j, -1.0)
        rows.close(np.array([bound, *(-acceleration)]) * (p.t**2 / way))
        count += 1
    return count


def _funnels(rows: _Rows, p: ConeProgramme, way: float) -> int:
    """Rows s = (slope axis.(r - apex) + mouth, (I - axis axis^T)(r - apex)) in the cone of 4, each node."""
    count = 0
    for f in p.funnels:
        m = np.arange(len(f.nodes))
        first = 3 * f.nodes
        along = np.sum(f.axis * f.apex, axis=1)
        right = np.empty((len(m), 4))
        right[:, 0] = (f.mouth - f.slope * along) / way
        right[:, 1:] = -(f.apex - f.axis * along[:, None]) / way
        for c in range(3):
            rows.put(4 * m, first + c, -f.slope * f.axis[:, c])
            for d in range(3):
                rows.put(4 * m + 1 + d, first + c, f.axis[:, c] * f.axis[:, d] - float(c == d))
        rows.close(right.ravel())
        count += len(m)
    return count


def _walls(rows: _Rows, p: ConeProgramme, way: float) -> int:
    count = 0
    for w in p.walls:
        m = np.arange(len(w.nodes))
        for c in range(3):
            rows.put(m, 3 * w.nodes + c, -w.normal[:, c])
        rows.close(-w.offset / way)
        count += len(m)
    return count
