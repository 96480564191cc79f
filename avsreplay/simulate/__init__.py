"""Simulated scans with truth: target, motion, scanner, faults, scenario."""

from __future__ import annotations

from avsreplay.simulate.rays import Engine
from avsreplay.simulate.recorded_faults import RecordedFault, disturbed
from avsreplay.simulate.scenario import Scenario, load_scenario, scenario_of
from avsreplay.simulate.simulation import EPOCH_NS, Simulation, simulate
from avsreplay.simulate.target import Shape, builtin_surface

__all__ = [
    "EPOCH_NS",
    "Engine",
    "RecordedFault",
    "Scenario",
    "Shape",
    "Simulation",
    "builtin_surface",
    "disturbed",
    "load_scenario",
    "scenario_of",
    "simulate",
]
