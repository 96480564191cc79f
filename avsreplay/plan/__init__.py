"""Rendezvous with a moving grasp point in least time, under a supervisor, and what it would have done."""

from avsreplay.plan.flight import Flight
from avsreplay.plan.hindsight import Execution, Miss, Motion, Tolerance, execute, interpolated, miss
from avsreplay.plan.pilot import Pilot, PilotMemory, Sight
from avsreplay.plan.rendezvous import PlanParams, rendezvous
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
    "Miss",
    "Motion",
    "Pilot",
    "PilotMemory",
    "PlanParams",
    "Sight",
    "Supervisor",
    "SupervisorMemory",
    "SupervisorParams",
    "Tolerance",
    "execute",
    "interpolated",
    "miss",
    "rendezvous",
]
