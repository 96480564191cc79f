"""One convex subproblem of the constrained planner: a second-order cone programme with free end
time.

Thrust is constant over each of N equal intervals of length h. In the scaled variables q = h v and w
= h^2 u the dynamics r' = r + q + w/2, q' = q + w are linear also for free h. The bound |w| <= a_max
h^2 is replaced by its tangent in h, which lies below, so every solution obeys the true bound and
the true dynamics. Only the motion of the target with the end time is linearised.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.plan import _cone

Index = NDArray[np.signedinteger[Any]]


@value_class
class PointRows:
    """Scalar rows c.(r - origin) + rate (h/h_ref - 1) of the robot's position at given instants.

    Attributes:
        interval: (m,) number of the interval, from 0.
        fraction: (m,) position of the instant within its interval, 0 to 1.
        vector: (m, 3) coefficients c in {A}.
        offset: (m,) value of -c.origin plus the constant of the row [m].
        rate: (m,) change of the row with the relative change of h, from the motion of the target
            [m].
        slack: (m,) coefficient of the common slack variable.
        lead: (m,) the rows are those of the position this much later if the robot coasts [s]; None:
            at the instants.
    """

    interval: Index
    fraction: Array
    vector: Array
    offset: Array
    rate: Array
    slack: Array
    lead: Array | None = None


@value_class
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
        cones: Sizes of groups of rows, one for all groups or one for each, and the rows; in each
            group the first row bounds the norm of the others.
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
    cones: tuple[tuple[int | Index, PointRows], ...] = ()


@value_class
class Solution:
    """Solution of a subproblem: interval length h [s], thrust u (n, 3) [m/s2] and the slack [m]."""

    h: float
    u: Array
    slack: float


@dataclass(slots=True)
class _Rows:
    """Rows C (r, q, h, slack, w) + d of one interval each, in groups that lie in second-order
    cones.
    """

    n: int
    origin: Array
    stage: list[Index] = field(default_factory=list)
    C: list[Array] = field(default_factory=list)
    d: list[Array] = field(default_factory=list)
    sizes: list[Index] = field(default_factory=list)

    def put(self, size: int | Index, stage: Index, C: Array, d: Array) -> None:
        """Add rows of cones of one size, or of the sizes of all; positions in C are those
        less the start.
        """
        self.stage.append(stage)
        self.C.append(C)
        self.d.append(d + C[:, :3] @ self.origin)
        self.sizes.append(np.full(len(stage) // size, size) if isinstance(size, int) else size)

    def solved(self, start: Array, weight: float) -> tuple[float, float, Array, int] | None:
        """Return h, slack, w (n, 3) and the number of iterations; None where no solution was
        found.
        """
        stage, sizes = (np.concatenate(x).astype(np.int32) for x in (self.stage, self.sizes))
        C, d = np.concatenate(self.C), np.concatenate(self.d)
        found: tuple[float, float, Array, int] | None = _cone.solve(
            self.n, tuple(start), (1.0, weight), stage, C, d, sizes
        )
        return found


def solve(p: Subproblem) -> Solution | None:
    """Solve a subproblem. Returns None where the method does not converge."""
    scale = max(
        float(np.linalg.norm(p.rho - p.r0 - p.v0 * p.n * p.h)),
        0.5 * p.a_max * (p.n * p.h) ** 2,
        1e-9,
    )
    rows = _Rows(p.n, p.r0 / scale)
    _bounds(rows, p, scale)
    _thrust(rows, p, scale)
    _end(rows, p, scale)
    for plane in p.planes:
        _point_rows(rows, p, plane, scale, 1)
    for size, cone in p.cones:
        _point_rows(rows, p, cone, scale, size)
    found = rows.solved(p.v0 * p.h / scale, p.weight)
    if found is None:
        return None
    h = p.h * found[0]
    return Solution(h, found[2] * (scale / h**2), scale * max(found[1], 0.0))


# first columns
_Q = 3
_H = 6
_SLACK = 7
_W = 8


def _bounds(rows: _Rows, p: Subproblem, scale: float) -> None:
    """1 - change <= h/h_ref <= 1 + change, slack >= 0, and |e.w| <= h^2 (tangent) for bounds per
    axis.
    """
    C = np.zeros((3, 11))
    C[:, _H], C[2, _SLACK] = (1.0, -1.0, 0.0), 1.0
    rows.put(
        1,
        np.zeros(3, dtype=np.int64),
        C,
        np.array([-max(1.0 - p.change, p.earliest / p.h), 1.0 + p.change, 0.0]),
    )
    if p.axes is not None:
        bound = p.h**2 / scale
        C = np.zeros((p.n, 6, 11))
        C[:, :, _W:], C[:, :, _H] = np.concatenate([-p.axes, p.axes]), 2.0 * bound
        rows.put(1, np.repeat(np.arange(p.n), 6), C.reshape(-1, 11), np.full(6 * p.n, -bound))


def _thrust(rows: _Rows, p: Subproblem, scale: float) -> None:
    """Bound on the thrust, |w| <= bound (2 h/h_ref - 1), the tangent of h^2; on the speed; at
    contact.
    """
    n, stage, axis = p.n, np.repeat(np.arange(p.n), 4), np.arange(3)
    C, d = np.zeros((n, 4, 11)), np.zeros((n, 4))
    d[:, 0] = -p.a_max * p.h**2 / scale
    C[:, 0, _H] = -2.0 * d[:, 0]
    C[:, 1 + axis, _W + axis] = 1.0
    rows.put(4, stage, C.reshape(-1, 11), d.ravel())
    if p.speed is not None:
        C = np.zeros((n, 4, 11))
        C[:, 0, _H] = p.speed * p.h / scale
        C[:, 1 + axis, _Q + axis] = C[:, 1 + axis, _W + axis] = 1.0
        rows.put(4, stage, C.reshape(-1, 11), np.zeros(4 * n))
    if p.contact is not None:
        pull, reach = p.acceleration * p.h**2 / scale, p.contact * p.h**2 / scale
        C = np.zeros((4, 11))
        C[:, _H] = 2.0 * reach, *(-2.0 * pull)
        C[1 + axis, _W + axis] = 1.0
        rows.put(4, np.full(4, n - 1), C, np.array([-reach, *pull]))


def _end(rows: _Rows, p: Subproblem, scale: float) -> None:
    """The terminal errors are within the slack; the goal moves with the end time."""
    n, axis, last = p.n, np.arange(3), np.full(4, p.n - 1)
    C, d = np.zeros((4, 11)), np.zeros(4)
    shift = p.rate * n * p.h / scale  # shift of the goal per change of h/h_ref
    C[0, _SLACK] = C[1 + axis, axis] = C[1 + axis, _Q + axis] = 1.0
    C[1 + axis, _W + axis], C[1:, _H] = 0.5, -shift
    d[1:] = shift - p.rho / scale
    rows.put(4, last, C, d)
    C, d = np.zeros((4, 11)), np.zeros(4)
    turn = p.acceleration * n * p.h  # change of the goal's velocity per change of h/h_ref
    C[0, _SLACK] = 1.0 / n
    C[1 + axis, _Q + axis] = C[1 + axis, _W + axis] = 1.0
    C[1:, _H], d[1:] = -(p.rate + turn) * p.h / scale, turn * p.h / scale
    rows.put(4, last, C, d)


def _point_rows(
    rows: _Rows, p: Subproblem, points: PointRows, scale: float, size: int | Index
) -> None:
    C, s = np.empty((len(points.interval), 11)), points.fraction[:, None]
    lead = 0.0 if points.lead is None else points.lead[:, None] / p.h
    C[:, :_Q] = points.vector
    C[:, _Q:_H] = (s + lead) * points.vector
    C[:, _H], C[:, _SLACK] = points.rate / scale, points.slack
    C[:, _W:] = (0.5 * s * s + s * lead) * points.vector
    rows.put(size, points.interval, C, (points.offset - points.rate) / scale)
