"""A plan as it is flown: positions, velocities and thrust at any instant, from the costate alone.

p(tau) = c2 - c1 tau, u = -a_max p / |p| (eq:u) after the coasting time, and the integrals of u in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from avsreplay.geometry import Array, frozen
from avsreplay.plan.reach import integrals
from avsreplay.records import Plan, Trajectory

__all__ = ["Flight", "Path", "StepFlight", "path_of"]


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
        return _errors(self, goal)

    def u_max(self, nodes: int = 65) -> float:
        """Largest |u| found along the flight [m/s2]."""
        times = np.linspace(self.latency_s, self.t_go_s, nodes)
        return float(np.max(np.linalg.norm(self.thrust(times), axis=1))) if math.isfinite(self.t_go_s) else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class StepFlight:
    """A robot under thrust that is constant over equal intervals: what a constrained plan is.

    Attributes:
        r0, v0: (3,) robot in {A} at the instant of planning [m, m/s].
        u: (n, 3) thrust of each interval [m/s2].  latency_s: coasting time before the first.  t_go_s: end.
    """

    r0: Array
    v0: Array
    u: Array
    latency_s: float
    t_go_s: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "r0", frozen(self.r0, 3))
        object.__setattr__(self, "v0", frozen(self.v0, 3))
        object.__setattr__(self, "u", frozen(self.u, -1, 3))

    @property
    def step_s(self) -> float:
        """Length of one interval [s]."""
        return (self.t_go_s - self.latency_s) / len(self.u)

    def nodes(self) -> tuple[Array, Array]:
        """Positions and velocities (n + 1, 3) at the interval ends."""
        h = self.step_s
        zero = np.zeros((1, 3))
        v = self.v0 + np.concatenate([zero, h * np.cumsum(self.u, axis=0)])
        start = self.r0 + self.latency_s * self.v0
        r = start + np.concatenate([zero, np.cumsum(h * v[:-1] + 0.5 * h * h * self.u, axis=0)])
        return r, v

    def _cell(self, times: Array) -> tuple[Array, Array]:
        since = np.clip(times - self.latency_s, 0.0, self.t_go_s - self.latency_s)
        k = np.minimum((since / self.step_s).astype(np.int64), len(self.u) - 1)
        return k, since - k * self.step_s

    def thrust(self, times: Array) -> Array:
        """Acceleration u at times (n,) [s after planning] -> (n, 3) [m/s2]; zero outside [latency, end]."""
        on = (times >= self.latency_s) & (times <= self.t_go_s)
        return np.where(on[:, None], self.u[self._cell(times)[0]], 0.0)

    def at(self, times: Array) -> tuple[Array, Array]:
        """Positions and velocities (n, 3) at times (n,) [s after planning]; past the end the robot coasts."""
        r, v = self.nodes()
        k, s = self._cell(times)
        early = np.minimum(times - self.latency_s, 0.0)[:, None]
        late = np.maximum(times - self.t_go_s, 0.0)[:, None]
        velocity = v[k] + s[:, None] * self.u[k]
        position = r[k] + s[:, None] * v[k] + 0.5 * s[:, None] ** 2 * self.u[k]
        return position + early * self.v0 + late * velocity, velocity

    def terminal_errors(self, goal: Trajectory) -> tuple[float, float]:
        """Distance [m] and relative speed [m/s] to the goal at the end."""
        return _errors(self, goal)

    def u_max(self) -> float:
        """Largest |u| along the flight [m/s2]."""
        return float(np.max(np.linalg.norm(self.u, axis=1)))


class Path(Protocol):
    """What can be flown."""

    @property
    def t_go_s(self) -> float:
        """End [s after planning]."""

    def at(self, times: Array) -> tuple[Array, Array]:
        """Positions and velocities (n, 3) at times (n,)."""

    def thrust(self, times: Array) -> Array:
        """Acceleration (n, 3) at times (n,)."""


def path_of(plan: Plan, r0: Array, v0: Array) -> Path:
    """What a plan flies, made for a robot at r0, v0: along its costate, or by its thrust steps."""
    if "thrust" in plan.extras:
        return StepFlight(r0, v0, plan.extras["thrust"], float(plan.extras["latency_s"]), plan.t_go_s)
    return Flight.of(plan, r0, v0)


def _errors(path: Path, goal: Trajectory) -> tuple[float, float]:
    end = np.array([path.t_go_s])
    r, v = path.at(end)
    rho, rate = goal(end)
    return float(np.linalg.norm(rho[0] - r[0])), float(np.linalg.norm(rate[0] - v[0]))
