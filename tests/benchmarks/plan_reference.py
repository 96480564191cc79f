"""Reference solutions of constrained planning problems by CasADi with IPOPT.

A direct transcription with free end time and constant thrust in every interval. Each alternative
(inside the cone, or outside its range) is a smoothed maximum. Its constraints hold only at the
nodes; where the path between two nodes violates them by more than 1 mm, the margin of both nodes is
raised and the problem is solved again. Five paths of different arrival time, and a path given by
the caller, are solved on a coarse grid; the three earliest results are the initial paths of the
fine grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

COARSE, FINE = 50, 200  # intervals
SMOOTH_M = 1e-2  # distance of the smoothed maximum from the maximum, twice
FACTORS = (
    1.0,
    1.15,
    1.4,
    1.8,
    2.3,
)  # end times of the initial paths over the least time without constraints
LATEST_S = 119.0
REFINED = 3  # coarse results that are refined
RAISED, EXCESS_M = (
    6,
    1e-3,
)  # largest number of times that the margins are raised; accepted violation between the nodes


@dataclass(frozen=True)
class Reference:
    """A path with constant thrust u (n, 3) in n equal intervals and its end time t_s."""

    t_s: float
    u: np.ndarray


def motion_of(scene):
    """Position (3) and rotation (9, by rows) of {C} and their derivatives as functions of time."""
    grid = np.arange(0.0, LATEST_S + 1.2, 0.2)
    R = Rotation.from_quat(scene.attitude(grid)).as_matrix().reshape(-1, 9)
    table = np.concatenate([scene.goal(grid)[0], R], axis=1)
    motion, tau = ca.interpolant("motion", "bspline", [grid], table.ravel()), ca.MX.sym("tau")
    return motion, ca.Function("rate", [tau], [ca.jacobian(motion(tau), tau)])


def norm(x):
    """Length of a vector, smooth at zero."""
    return ca.sqrt(ca.sumsqr(x) + 1e-10)


def either(first, second):
    """A value that is at least 0 only where the larger of both is."""
    return first + second + ca.sqrt((first - second) ** 2 + SMOOTH_M**2) - SMOOTH_M


def node_constraints(problem, limits):
    """Function of the position and of the pose of {C} at a node; its values must be at least 0."""
    r, m = ca.SX.sym("r", 3), ca.SX.sym("m", 12)
    y = ca.mtimes(ca.reshape(m[3:], 3, 3), r - m[:3])  # the column-major reshape is the transpose
    reach, across = norm(y), norm(y[1:])
    values, corridor = [], None
    for degrees, length in (
        (limits.cone_deg, limits.cone_range_m),
        (limits.final_deg, limits.final_range_m),
    ):
        if degrees is not None:
            inside = math.tan(math.radians(degrees)) * y[0] + limits.mouth_m - across
            values.append(either(inside, reach - length))
            corridor = ca.fmin(inside, length - reach)
    if limits.clearance_m is not None:
        p = ca.fabs(y - problem.centre_c) - problem.half
        gap = norm(ca.fmax(p, 0)) + ca.fmin(ca.mmax(p), 0)
        values.append(either(corridor, gap - limits.clearance_m))
    return ca.Function("node", [r, m], [ca.vertcat(*values)])


class Transcription:
    """The problem on a grid of n intervals."""

    def __init__(self, problem, limits, free_s, motion, rate, n):
        """State the problem; ``free_s`` is the least time without constraints."""
        self.n, self.opti = n, ca.Opti()
        opti = self.opti
        self.r, self.v = opti.variable(3, n + 1), opti.variable(3, n + 1)
        self.u, self.T = opti.variable(3, n), opti.variable()
        r, v, u, h = self.r, self.v, self.u, self.T / n
        opti.minimize(self.T)
        opti.subject_to(r[:, 0] == problem.r0)
        opti.subject_to(v[:, 0] == 0)
        opti.subject_to(r[:, 1:] == r[:, :-1] + h * v[:, :-1] + 0.5 * h * h * u)
        opti.subject_to(v[:, 1:] == v[:, :-1] + h * u)
        opti.subject_to(ca.sum1(u * u) <= problem.a_max**2)
        opti.subject_to(r[:, n] == motion(self.T)[:3])
        opti.subject_to(v[:, n] == rate(self.T)[:3])
        opti.subject_to(opti.bounded(0.5 * free_s, self.T, LATEST_S))
        poses = motion.map(n - 1)(h * ca.DM(np.arange(1, n)).T)
        values = node_constraints(problem, limits).map(n - 1)(r[:, 1:n], poses)
        self.margins = opti.parameter(1, n - 1)
        opti.subject_to(
            ca.vec(values - 2.0 * ca.repmat(self.margins, values.shape[0], 1)) >= 0
        )  # ``either`` is twice
        self.options = {"print_level": 0, "sb": "yes", "max_iter": 200, "tol": 1e-5}

    def solved(self, t_end, positions, thrust=None, margins=0.0):
        """Reference from an initial path, positions (n + 1, 3) and thrust (n, 3); None where
        IPOPT fails.
        """
        times, opti = np.linspace(0.0, t_end, self.n + 1), self.opti
        barrier = {
            "mu_init": 0.1 if thrust is None else 1e-3
        }  # a path with its thrust is near a minimum
        opti.solver("ipopt", {"print_time": False}, {**self.options, **barrier})
        opti.set_initial(self.r, positions.T)
        opti.set_initial(self.v, np.gradient(positions, times, axis=0).T)
        opti.set_initial(self.u, 0.0 if thrust is None else thrust.T)
        opti.set_initial(self.T, t_end)
        opti.set_value(self.margins, margins)
        try:
            found = opti.solve()
        except RuntimeError:
            return None
        return Reference(float(found.value(self.T)), np.array(found.value(self.u)).T)


def along_axis(scene, t_end, n):
    """Initial path: to a point on the fixture's axis, then along it; (n + 1, 3)."""
    times = np.linspace(0.0, t_end, n + 1)
    rho, turn = scene.goal(times)[0], Rotation.from_quat(scene.attitude(times)).as_matrix()
    last = 0.35 * t_end
    left = np.clip((t_end - times) / last, 0.0, 1.0)[:, None]
    s = np.clip(times / (t_end - last), 0.0, 1.0)[:, None]
    return (rho + 2.1 * left**2 * turn[:, :, 0]) * s**2 * (3 - 2 * s)


def flown(reference, times):
    """Positions of a reference from rest at the origin, by summation over its intervals."""
    n = len(reference.u)
    h = reference.t_s / n
    k = np.minimum((times / h).astype(int), n - 1)
    v = h * np.concatenate([np.zeros((1, 3)), np.cumsum(reference.u, axis=0)])
    r = np.concatenate(
        [np.zeros((1, 3)), np.cumsum(h * v[:-1] + 0.5 * h * h * reference.u, axis=0)]
    )
    s = (times - k * h)[:, None]
    return r[k] + s * v[k] + 0.5 * s * s * reference.u[k]


def refined(grid, draft, violation):
    """The draft on the fine grid, with margins at the nodes; None where IPOPT fails or the
    excess remains.
    """
    n, found = grid.n, draft
    margins, thrust = np.zeros(n - 1), np.repeat(draft.u, n // len(draft.u), axis=0)
    for _ in range(RAISED):
        path = flown(found, np.linspace(0.0, found.t_s, n + 1))
        found = grid.solved(found.t_s, path, thrust, margins[None])
        if found is None:
            return None
        times = np.linspace(0.0, found.t_s, 100 * n + 1)[:-1]
        over = violation(times, flown(found, times)).reshape(n, 100).max(axis=1)
        if over.max() <= EXCESS_M:
            return found
        margins += 1.1 * np.maximum(over[:-1], over[1:])
        thrust = found.u
    return None


def ipopt(problem, limits, free_s, violation, given=None, fine=FINE):
    """Earliest reference that IPOPT finds on the fine grid; None if it finds none.

    ``violation`` is a function of times (m,) and positions (m, 3) to the excess (m,). ``given`` is
    a further initial
    path: its end time, and functions of times (m,) to positions and thrust (m, 3).
    """
    motion, rate = motion_of(problem.scene)
    coarse = Transcription(problem, limits, free_s, motion, rate, COARSE)
    starts = []
    if given is not None:
        times = np.linspace(0.0, given[0], COARSE + 1)
        starts.append((given[0], given[1](times), given[2](0.5 * (times[1:] + times[:-1]))))
    for t_end in (min(factor * free_s, LATEST_S - 1.0) for factor in FACTORS):
        starts.append((t_end, along_axis(problem.scene, t_end, COARSE)))
    drafts = [found for start in starts if (found := coarse.solved(*start)) is not None]
    drafts.sort(key=lambda draft: draft.t_s)
    grid = Transcription(problem, limits, free_s, motion, rate, fine)
    found = [refined(grid, draft, violation) for draft in drafts[:REFINED]]
    return min(
        (path for path in found if path is not None), key=lambda path: path.t_s, default=None
    )
