"""Time-optimal rendezvous with the grasp point under constraints, the supervisor, and their evaluation."""

from avsreplay.plan.attitude import Turn, turn_time, turn_to, with_turn, without_turn
from avsreplay.plan.constrained import constrained
from avsreplay.plan.evaluation import Execution, Flights, Miss, Motion, closed_loop, execute, interpolated, miss
from avsreplay.plan.guidance import Guidance, GuidanceState, PlannerInput, Segment
from avsreplay.plan.limits import CONSTRAINTS, Scene, TargetGeometry, hull_vertices, in_fixture_axes, margins
from avsreplay.plan.path import CostatePath, RobotPath, StepPath, path_of
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.plan.robot import Limits, RobotParams
from avsreplay.plan.supervisor import RULES, Action, Decision, Facts, Supervisor, SupervisorMemory, SupervisorParams
from avsreplay.plan.uncertainty import Disturbance, Spread, Tolerance, draws, spread

__all__ = [
    "CONSTRAINTS", "RULES", "Action", "CostatePath", "Decision", "Disturbance", "Execution", "Facts", "Flights",
    "Guidance", "GuidanceState", "Limits", "Miss", "Motion", "PlanParams", "PlannerInput", "RobotParams",
    "RobotPath", "Scene", "Segment", "Spread", "StepPath", "Supervisor", "SupervisorMemory", "SupervisorParams",
    "TargetGeometry", "Tolerance", "Turn", "closed_loop", "constrained", "draws", "execute", "hull_vertices",
    "in_fixture_axes", "interpolated", "margins", "miss", "path_of", "rendezvous", "spread", "turn_time", "turn_to",
    "with_turn", "without_turn",
]  # fmt: skip
