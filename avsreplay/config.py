"""The stages' parameter classes put together: one strict TOML table each.

Precedence: flag over environment over ``--config`` file over the log's own ``[run]`` table over default. The effective
configuration is saved with every result.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from avsreplay import settings
from avsreplay.errors import UsageError
from avsreplay.estimate import EstimatorParams
from avsreplay.geometry import Pose
from avsreplay.monitor.consistency import ConsistencyParams
from avsreplay.monitor.convergence import ConvergenceParams
from avsreplay.monitor.faults import FaultParams
from avsreplay.plan import PlanParams, SupervisorParams
from avsreplay.register import RegisterParams

__all__ = ["Against", "Guess", "RunConfig", "load_config", "parse_pose"]


class Guess(Enum):
    """What registration starts from."""

    PREDICTED = "predicted"  # closed loop: the filter's prior
    LAST = "last"  # open loop: the last healthy pose


class Against(Enum):
    """What errors are taken against."""

    TRUTH = "truth"
    FIT = "fit"


@dataclass(frozen=True, slots=True)
class RunConfig:
    """Everything that a replay may be told."""

    # the registration's guess: the filter's prediction (closed loop) or the last healthy pose (open loop)
    guess: Guess = Guess.PREDICTED
    # first pose: "log" (what the log says), "truth", "auto" (acquisition), or "x,y,z,qx,qy,qz,qw" of {C} in {A}
    init: str = "log"
    # carry points with times of their own to the scan's instant by the predicted motion
    deskew: bool = True
    # search without a guess once a faulty scan finds the prediction too unsure to be one
    reacquire: bool = True
    # what errors are against: "truth" (the log's), or "fit" (one motion fitted to all healthy poses of a first pass)
    reference: Against = Against.TRUTH
    register: RegisterParams = field(default_factory=RegisterParams)
    estimator: EstimatorParams = field(default_factory=EstimatorParams)
    faults: FaultParams = field(default_factory=FaultParams)
    consistency: ConsistencyParams = field(default_factory=ConsistencyParams)
    convergence: ConvergenceParams = field(default_factory=ConvergenceParams)
    plan: PlanParams = field(default_factory=PlanParams)
    supervisor: SupervisorParams = field(default_factory=SupervisorParams)
    # the fixture's outward axis in {C}: the robot comes in along it
    fixture_axis_c: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.init not in ("log", "truth", "auto"):
            parse_pose(self.init)
        if abs(math.hypot(*self.fixture_axis_c) - 1.0) > 1e-6:
            raise ValueError(f"fixture_axis_c is {self.fixture_axis_c}, must be of unit length")


def parse_pose(text: str) -> Pose:
    """``x,y,z,qx,qy,qz,qw`` as a pose. Raises ValueError saying what is wrong."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 7 or not all(abs(v) < float("inf") for v in values):
        raise ValueError(f"init is '{text}', not log, truth, auto or seven numbers x,y,z,qx,qy,qz,qw")
    if abs(sum(v * v for v in values[3:]) - 1.0) > 1e-2:
        raise ValueError(f"init is '{text}', its quaternion (last four numbers) is not of unit length")
    return Pose(values[3:], values[:3])  # type: ignore[arg-type]


def load_config(file: Path | None, log_table: Mapping[str, Any], assignments: Sequence[str]) -> RunConfig:
    """The effective configuration.

    Args:
        file: TOML file, or None.
        log_table: the log's own ``[run]`` table.
        assignments: ``a.b=c`` from flags.

    Raises:
        UnreadableInput, UsageError: naming file and line, or the flag.
    """
    of_log = settings.Document("the log's [run] table", log_table)
    settings.build(RunConfig, of_log)  # a wrong key there is the log's fault and is named so
    of_file = settings.load(file) if file else settings.Document("configuration", {})
    settings.build(RunConfig, of_file)
    merged = settings.Document(of_file.name, _over(log_table, of_file.table), of_file.text)
    try:
        return settings.build(RunConfig, settings.override(merged, assignments))
    except UsageError as error:
        if not assignments:
            raise
        raise UsageError(error.what, where=f"among {', '.join(assignments)}", hint=error.hint) from None


def _over(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in top.items():
        below = merged.get(key)
        merged[key] = _over(below, value) if isinstance(below, Mapping) and isinstance(value, Mapping) else value
    return merged
