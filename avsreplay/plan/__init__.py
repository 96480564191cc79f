"""Rendezvous with a moving grasp point in least time, under a supervisor, and what it would have done."""

from avsreplay.plan.constrained import constrained
from avsreplay.plan.flight import Flight, Path, StepFlight, path_of
from avsreplay.plan.hindsight import Execution, Miss, Motion, Tolerance, execute, interpolated, miss
from avsreplay.plan.limits import Limits, Scene
from avsreplay.plan.pilot import Pilot, PilotMemory, Sight
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.plan.spread import Future, Spread, draws, sigma_points, spread
from avsreplay.plan.supervisor import (
    RULES,
    Action,
    Decision,
    Facts,
    Supervisor,
    SupervisorMemory,
    SupervisorParams,
)

__all__ = [
    "RULES",
    "Action",
    "Decision",
    "Execution",
    "Facts",
    "Flight",
    "Future",
    "Limits",
    "Miss",
    "Motion",
    "Path",
    "Pilot",
    "PilotMemory",
    "PlanParams",
    "Scene",
    "Sight",
    "Spread",
    "StepFlight",
    "Supervisor",
    "SupervisorMemory",
    "SupervisorParams",
    "Tolerance",
    "constrained",
    "draws",
    "execute",
    "interpolated",
    "miss",
    "path_of",
    "rendezvous",
    "sigma_points",
    "spread",
]
