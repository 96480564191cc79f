"""The first belief where none is given: the rate from the first healthy poses, everything else unknown and said so.

sigma and varrho are zero, mu is the identity. The covariance is that of one linearised fit: the prior's information
plus H' R^-1 H of each pose carried back along the motion, so rate, velocity and their correlations with the
unknown parameters come out as the poses fix them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.layout import hamilton
from avsreplay.estimate.measure import in_camera, sensitivity
from avsreplay.estimate.motion import moved
from avsreplay.estimate.params import EstimatorParams
from avsreplay.geometry import Array, Pose
from avsreplay.records import Belief, State

__all__ = ["PoseFix", "first_belief", "guessed_belief", "rates"]


@dataclass(frozen=True, slots=True, eq=False)
class PoseFix:
    """A healthy pose T_ac at an instant.

    Attributes:
        C: (6, 6) covariance of d = [theta; v] in {C} [rad, m], T_true = T_ac Exp(d).
        lag_ns: the instant after that of its scan: a scan that takes its time shows the pose of its middle.
        share: of C that neighbouring poses have in common.
    """

    t_ns: int
    T_ac: Pose
    C: Array
    lag_ns: int = 0
    share: float = 0.0

    @property
    def scan_ns(self) -> int:
        """Instant of its scan."""
        return self.t_ns - self.lag_ns


def guessed_belief(t_ns: int, T_ac: Pose, params: EstimatorParams) -> Belief:
    """A body at rest at a guessed pose, with the start's wide standard deviations."""
    return Belief(t_ns, _state(T_ac, np.zeros(3), np.zeros(3)), np.diag(params.start_1s**2))


def first_belief(fixes: tuple[PoseFix, ...], params: EstimatorParams) -> Belief:
    """The belief at the last pose's scan: rate and velocity from the last two, at rest from a single one."""
    last = fixes[-1]
    x, _ = moved(_state(last.T_ac, *rates(fixes)), -last.lag_ns * 1e-9)
    info = np.diag(params.start_1s**-2.0)
    for fix in fixes:
        h = (fix.t_ns - last.scan_ns) * 1e-9
        then, Phi = moved(x, h)
        H = sensitivity(then) @ Phi
        info += H.T @ np.linalg.solve(in_camera(fix.C, fix.T_ac.q, x.q_bc), H)
    P = np.linalg.inv(info)
    return Belief(last.scan_ns, x, 0.5 * (P + P.T))


def rates(fixes: tuple[PoseFix, ...]) -> tuple[Array, Array]:
    """Rate in {C} [rad/s] and velocity in {A} [m/s], mean over the poses; zero for one pose or no time between."""
    h = (fixes[-1].t_ns - fixes[0].t_ns) * 1e-9
    if h <= 0.0:
        return np.zeros(3), np.zeros(3)
    turns = [geometry.log(np.array(hamilton(geometry.conjugate(a.T_ac.q), b.T_ac.q))) for a, b in pairwise(fixes)]
    return np.sum(turns, axis=0) / h, (fixes[-1].T_ac.t - fixes[0].T_ac.t) / h


def _state(T_ac: Pose, w: Array, v: Array) -> State:
    return State(T_ac.q, w, T_ac.t, v, np.zeros(2), np.zeros(3), geometry.IDENTITY_QUAT)
