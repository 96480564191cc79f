"""A plan as it is flown: positions, velocities and thrust at any instant, from the costate alone.

p(tau) = c2 - c1 tau, u = -a_max p / |p| (eq:u) after the coasting time, and the integrals of u in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from avsreplay.geometry import Array, frozen
from avsreplay.plan.reach import integrals
from avsreplay.records import Plan, Trajectory

__all__ = ["Flight"]


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """A robot that coasts, then thrusts along the costate.

    Attributes:
        r0, v0: (3,) robot in {A} at the instant of planning [m, m/s].
        a_max: thrust [m/s2].  latency_s: coasting time before it.  t_go_s: end.
        costate: (6,) [c1, c2], tau from the instant of planning, unit norm.
    """

    r0: Array
    v0: Array
    a_max: float
    latency_s: float
    t_go_s: float
    costate: Array

    def __post_init__(self) -> None:
        for name, size in (("r0", 3), ("v0", 3), ("costate", 6)):
            object.__setattr__(self, name, frozen(getattr(self, name), size))

    @classmethod
    def from_normal(
        cls, r0: Array, v0: Array, a_max: float, latency_s: float, thrust_s: float, P0: Array, P1: Array
    ) -> Flight:
        """From the normal of the reachable body: p = -P, P running from P0 to P1 over the thrust time."""
        c1 = (P1 - P0) / thrust_s
        c = np.concatenate([c1, c1 * latency_s - P0])
        return cls(r0, v0, a_max, latency_s, latency_s + thrust_s, c / np.linalg.norm(c))

    @classmethod
    def of(cls, plan: Plan, r0: Array, v0: Array) -> Flight:
        """The flight of a plan made for a robot at r0, v0."""
        return cls(r0, v0, plan.a_max, float(plan.extras.get("latency_s", 0.0)), plan.t_go_s, plan.costate)

    def p(self, times: Array) -> Array:
        """Costate of the velocity at times (n,) -> (n, 3)."""
        out: Array = self.costate[None, 3:] - self.costate[None, :3] * times[:, None]
        return out

    def thrust(self, times: Array) -> Array:
        """Acceleration u at times (n,) [s after planning] -> (n, 3) [m/s2]; zero outside [latency, end]."""
        p = self.p(times)
        norm = np.linalg.norm(p, axis=1, keepdims=True)
        u: Array = -self.a_max * p / np.where(norm > 0.0, norm, 1.0)
        on = (times >= self.latency_s) & (times <= self.t_go_s)
        return np.where(on[:, None], u, 0.0)

    def at(self, times: Array) -> tuple[Array, Array]:
        """Positions and velocities (n, 3) at times (n,) [s after planning]; past the end the robot coasts."""
        burn = np.clip(times, self.latency_s, self.t_go_s) - self.latency_s
        start = self.p(np.full(len(times), self.latency_s))
        first, second = integrals(-start, -self.p(burn + self.latency_s))
        dv = self.a_max * burn[:, None] * first
        after = np.maximum(times - self.t_go_s, 0.0)[:, None]
        dr = self.a_max * burn[:, None] ** 2 * second + dv * after
        return self.r0 + self.v0 * times[:, None] + dr, self.v0 + dv

    def terminal_errors(self, goal: Trajectory) -> tuple[float, float]:
        """Distance [m] and relative speed [m/s] to the goal at the end."""
        end = np.array([self.t_go_s])
        r, v = self.at(end)
        rho, rate = goal(end)
        return float(np.linalg.norm(rho[0] - r[0])), float(np.linalg.norm(rate[0] - v[0]))

    def u_max(self, nodes: int = 65) -> float:
        """Largest |u| found along the flight [m/s2]."""
        times = np.linspace(self.latency_s, self.t_go_s, nodes)
        return float(np.max(np.linalg.norm(self.thrust(times), axis=1))) if math.isfinite(self.t_go_s) else math.nan
