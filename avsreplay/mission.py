"""The planner's place in the replay: plan from t_1 on, replan at a stated period from where the robot then is.

The robot stands still until the estimate has converged; from then on it is taken to fly the last plan that was found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avsreplay.geometry import Array
from avsreplay.plan import Flight, PlanParams, rendezvous
from avsreplay.records import Plan, Trajectory

__all__ = ["Mission", "replan"]


@dataclass(frozen=True, slots=True, eq=False)
class Mission:
    """The plan in force.

    Attributes:
        plan: the last one made.  flight: the last one found, which the robot flies; ``since_ns`` is its instant.
    """

    plan: Plan | None = None
    flight: Flight | None = None
    since_ns: int = 0

    def arrived(self, t_ns: int) -> bool:
        """Has the planned instant of capture gone by?"""
        return self.flight is not None and (t_ns - self.since_ns) * 1e-9 >= self.flight.t_go_s

    def robot(self, t_ns: int, params: PlanParams) -> tuple[Array, Array]:
        """Position (3,) [m] and velocity (3,) [m/s] of the robot in {A}."""
        if self.flight is None:
            return np.array(params.robot_position_m), np.array(params.robot_velocity_mps)
        position, velocity = self.flight.at(np.array([(t_ns - self.since_ns) * 1e-9]))
        return position[0], velocity[0]


def replan(mission: Mission, params: PlanParams, t_ns: int, converged: bool, goal: Trajectory) -> Mission:
    """The mission after a scan: unchanged before t_1, between replans and after the planned capture."""
    if not converged or mission.arrived(t_ns):
        return mission
    if mission.plan is not None and (t_ns - mission.plan.t_ns) * 1e-9 < params.replan_period_s - 1e-6:
        return mission
    position, velocity = mission.robot(t_ns, params)
    plan = rendezvous(goal, position, velocity, params, t_ns)
    if not plan.found:
        return Mission(plan, mission.flight, mission.since_ns)
    return Mission(plan, Flight.of(plan, position, velocity), t_ns)
