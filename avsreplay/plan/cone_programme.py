"""One convex subproblem of the constrained planner: a second-order cone programme with free end time.

Thrust is constant over each of N equal intervals of length h. In the scaled variables q = h v and w = h^2 u the
dynamics r' = r + q + w/2, q' = q + w are linear also for free h. The bound |w| <= a_max h^2 is replaced by its tangent
in h, which lies below, so every solution obeys the true bound and the true dynamics. Only the motion of the target with
the end time is linearised.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array

Index = NDArray[np.signedinteger[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class PointRows:
    """Scalar rows c.(r - origin) + rate (h/h_ref - 1) of the robot's position at given instants.

    Attributes:
        interval: (m,) number of the interval, from 0.
        fraction: (m,) position of the instant within its interval, 0 to 1.
        vector: (m, 3) coefficients c in {A}.
        offset: (m,) value of -c.origin plus the constant of the row [m].
        rate: (m,) change of the row with the relative change of h, from the motion of the target [m].
        slack: (m,) coefficient of the common slack variable.
        lead: (m,) the rows are those of the position this much later if the robot coasts [s]; None: at the instants.
    """

    interval: Index
    fraction: Array
    vector: Array
    offset: Array
    rate: Array
    slack: Array
    lead: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Subproblem:
    """Least end time near a reference. Lengths in metres, times in seconds.

    Attributes:
        n, h: Number of intervals and reference length of an interval.
        r0, v0: (3,) position and velocity at the start.
        rho, rate, acceleration: (3,) motion of the goal at the reference end time n h.
        a_max: Bound on the thrust.
        change: Largest relative change of h.
        weight: Cost of the slack, in relative end time per length scale.
        speed: Bound on the speed.
        contact: Bound on |u - acceleration| in the last interval.
        earliest: Lower bound of h.
        axes: (3, 3) rows e with |e.u| <= 1; None without bounds per axis.
        planes: Rows that must be at least 0.
        cones: Rows in groups of ``size``; in each group the first row bounds the norm of the others.
    """

    n: int
    h: float
    r0: Array
    v0: Array
    rho: Array
    rate: Array
    acceleration: Array
    a_max: float
    change: float
    weight: float = 1000.0
    speed: float | None = None
    contact: float | None = None
    axes: Array | None = None
    earliest: float = 0.0
    planes: tuple[PointRows, ...] = ()
    cones: tuple[tuple[int, PointRows], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Solution of a subproblem: interval length h [s], thrust u (n, 3) [m/s2] and the slack [m]."""

    h: float
    u: Array
    slack: float


@dataclass(slots=True)
class _Rows:
    """Rows of A x + s = b, collected as triplets; s lies in a product of cones."""

    rows: list[Index] = field(default_factory=list)
    columns: list[Index] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)
    right: list[Array] = field(default_factory=list)
    count: int = 0

    def put(self, rows: Index, columns: Index | int, value: Array | float) -> None:
        """Add entries at rows (counted from the current block) and columns; a number stands for equal entries."""
        self.rows.append(self.count + rows)
        self.columns.append(np.full(rows.shape, columns) if isinstance(columns, int) else columns)
        self.values.append(value if isinstance(value, np.ndarray) else np.full(rows.shape, value))

    def close(self, right: Array) -> None:
        """End the current block with its right-hand side."""
        self.right.append(right)
        self.count += len(right)


def solve(p: Subproblem) -> Solution | None:
    """Solve a subproblem with Clarabel. Returns None where the solver fails."""
    clarabel: Any = importlib.import_module("clarabel")
    from scipy import sparse

    n = p.n
    scale = max(float(np.linalg.norm(p.rho - p.r0 - p.v0 * n * p.h)), 0.5 * p.a_max * (n * p.h) ** 2, 1e-9)
    size = 9 * n + 8
    rows = _Rows()
    _dynamics(rows, p, scale)
    cones = [clarabel.ZeroConeT(rows.count)]
    start = rows.count
    _bounds(rows, p, scale)
    for plane in p.planes:
        _point_rows(rows, p, plane, scale)
    cones.append(clarabel.NonnegativeConeT(rows.count - start))
    cones += [clarabel.SecondOrderConeT(4)] * _norms(rows, p, scale)
    for dimension, cone in p.cones:
        _point_rows(rows, p, cone, scale)
        cones += [clarabel.SecondOrderConeT(dimension)] * (len(cone.interval) // dimension)
    triplets = (np.concatenate(rows.values), (np.concatenate(rows.rows), np.concatenate(rows.columns)))
    A = sparse.csc_matrix(triplets, (rows.count, size))
    cost = np.zeros(size)
    cost[-2:] = 1.0, p.weight
    none = sparse.csc_matrix((size, size))
    found = clarabel.DefaultSolver(none, cost, A, np.concatenate(rows.right), cones, _settings(clarabel)).solve()
    if str(found.status) not in ("Solved", "AlmostSolved"):
        return None
    x = np.asarray(found.x)
    h = p.h * float(x[-2])
    return Solution(h, x[6 * (n + 1) : -2].reshape(n, 3) * (scale / h**2), scale * max(float(x[-1]), 0.0))


def _settings(clarabel: Any) -> Any:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = 1e-6
    settings.tol_feas = 1e-7
    settings.presolve_enable = False
    # refinement takes two thirds of the time, and the planner removes the residuals itself (``_exact_end``)
    settings.iterative_refinement_enable = False
    return settings


@lru_cache(maxsize=8)
def _dynamics_entries(n: int) -> tuple[Index, Index, Array]:
    """Return rows, columns and values of r' = r + q + w/2 and q' = q + w over n intervals; they do not change."""
    k, q, w = np.arange(3 * n), 3 * (n + 1), 6 * (n + 1)
    blocks = [(k, k + 3, 1.0), (k, k, -1.0), (k, q + k, -1.0), (k, w + k, -0.5)]
    blocks += [(3 * n + k, q + k + 3, 1.0), (3 * n + k, q + k, -1.0), (3 * n + k, w + k, -1.0)]
    rows, columns, values = zip(*blocks, strict=True)
    return np.concatenate(rows), np.concatenate(columns), np.repeat(values, 3 * n)


def _dynamics(rows: _Rows, p: Subproblem, scale: float) -> None:
    """R' = r + q + w/2 and q' = q + w over each interval; the start. Variables: r, q, w, h/h_ref, slack."""
    n, q = p.n, 3 * (p.n + 1)
    rows.put(*_dynamics_entries(n))
    rows.close(np.zeros(6 * n))
    j = np.arange(3)
    rows.put(j, j, 1.0)
    rows.close(p.r0 / scale)
    rows.put(j, q + j, 1.0)
    rows.put(j, 9 * n + 6, -p.v0 * p.h / scale)
    rows.close(np.zeros(3))


def _bounds(rows: _Rows, p: Subproblem, scale: float) -> None:
    """1 - change <= h/h_ref <= 1 + change, slack >= 0, and |e.w| <= h^2 (tangent) for bounds per axis."""
    rows.put(np.array([0, 1]), 9 * p.n + 6, np.array([-1.0, 1.0]))
    rows.put(np.array([2]), 9 * p.n + 7, -1.0)
    rows.close(np.array([-max(1.0 - p.change, p.earliest / p.h), 1.0 + p.change, 0.0]))
    if p.axes is not None:
        both, n, bound = np.concatenate([p.axes, -p.axes]), p.n, p.h**2 / scale
        row = np.arange(6 * n)
        for c in range(3):
            rows.put(row, 6 * (n + 1) + 3 * (row // 6) + c, both[row % 6, c])
        rows.put(row, 9 * n + 6, -2.0 * bound)
        rows.close(np.full(6 * n, -bound))


def _norms(rows: _Rows, p: Subproblem, scale: float) -> int:
    """Thrust, speed, contact and end condition. Returns the number of cones of dimension 4."""
    n, q, w, h = p.n, 3 * (p.n + 1), 6 * (p.n + 1), 9 * p.n + 6
    k, j, count = np.arange(n), np.arange(3), n
    bound = p.a_max * p.h**2 / scale  # |w| <= bound (2 h/h_ref - 1), the tangent of h^2
    rows.put(4 * k, h, -2.0 * bound)
    for c in range(3):
        rows.put(4 * k + 1 + c, w + 3 * k + c, -1.0)
    rows.close(np.tile((-bound, 0.0, 0.0, 0.0), n))
    if p.speed is not None:
        rows.put(4 * k, h, -p.speed * p.h / scale)
        for c in range(3):
            rows.put(4 * k + 1 + c, q + 3 * k + 3 + c, -1.0)
        rows.close(np.zeros(4 * n))
        count += n
    if p.contact is not None:
        pull, reach = p.acceleration * p.h**2 / scale, p.contact * p.h**2 / scale
        rows.put(np.array([0, 1, 2, 3]), h, np.array([-2.0 * reach, *(2.0 * pull)]))
        rows.put(1 + j, w + 3 * (n - 1) + j, -1.0)
        rows.close(np.array([-reach, *pull]))
        count += 1
    shift = p.rate * n * p.h / scale  # of the goal with h/h_ref
    rows.put(np.zeros(1, dtype=np.int64), h + 1, -1.0)
    rows.put(1 + j, 3 * n + j, -1.0)
    rows.put(1 + j, h, shift)
    rows.close(np.array([0.0, *(shift - p.rho / scale)]))
    turn = p.acceleration * n * p.h  # of the goal's velocity with h/h_ref
    rows.put(np.zeros(1, dtype=np.int64), h + 1, -1.0 / n)
    rows.put(1 + j, q + 3 * n + j, -1.0)
    rows.put(1 + j, h, (p.rate + turn) * p.h / scale)
    rows.close(np.array([0.0, *(turn * p.h / scale)]))
    return count + 2


def _point_rows(rows: _Rows, p: Subproblem, points: PointRows, scale: float) -> None:
    m = len(points.interval)
    first, q, w = 3 * points.interval[:, None] + np.arange(3), 3 * (p.n + 1), 6 * (p.n + 1)
    s = points.fraction[:, None]
    ends = np.tile((9 * p.n + 6, 9 * p.n + 7), (m, 1))
    columns = np.concatenate([first, q + first, w + first, ends], axis=1)
    lead = np.zeros((m, 1)) if points.lead is None else points.lead[:, None] / p.h
    parts = (points.vector, (s + lead) * points.vector, (0.5 * s * s + s * lead) * points.vector)
    values = np.concatenate([*parts, points.rate[:, None] / scale, points.slack[:, None]], axis=1)
    rows.put(np.repeat(np.arange(m), columns.shape[1]), columns.ravel(), -values.ravel())
    rows.close((points.offset - points.rate) / scale)
