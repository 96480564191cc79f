"""A campaign file: what is varied, how often, and what counts as success. Strict TOML like every other file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from avsreplay import settings

__all__ = ["Axis", "Campaign", "Case", "Criterion", "Draw", "DrawKind", "LoadedCampaign", "load_campaign"]

MAX_REPEATS = 10_000_000
PREFIXES = ("scenario.", "run.")


class DrawKind(Enum):
    """How a random value is drawn."""

    UNIFORM = "uniform"  # a number in [low, high)
    LOG_UNIFORM = "log_uniform"  # a number whose logarithm is uniform
    NORMAL = "normal"  # a number of mean ``low`` and standard deviation ``high``
    INTEGER = "integer"  # a whole number in [low, high]
    CHOICE = "choice"  # one of ``values``
    DIRECTION = "direction"  # three numbers: any direction, length uniform in [low, high]
    ATTITUDE = "attitude"  # four numbers: a unit quaternion, uniform over all attitudes


@dataclass(frozen=True, slots=True)
class Axis:
    """One table [[grid]]: every value is combined with every value of the other axes."""

    # scenario.<key> or run.<key>; a number picks from a list, as in scenario.fault.0.strength
    key: str
    # what it takes
    values: Any

    def __post_init__(self) -> None:
        _check_key(self.key)
        if not isinstance(self.values, list) or not self.values:
            raise ValueError(f"values of '{self.key}' must be a list with something in it")


@dataclass(frozen=True, slots=True)
class Case:
    """One table [[case]]: settings that go together; cases are alternatives, each crossed with the grid."""

    # what to call it in tables
    name: str
    # what it sets, by key
    set: Any = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_set(self.set)


@dataclass(frozen=True, slots=True)
class Draw:
    """One table [[draw]]: a value drawn anew for every repeat, the same for all combinations of that repeat."""

    # scenario.<key> or run.<key>
    key: str
    kind: DrawKind
    low: float = 0.0
    high: float = 1.0
    values: Any = field(default_factory=list)

    def __post_init__(self) -> None:
        _check_key(self.key)
        if self.kind is DrawKind.CHOICE and not (isinstance(self.values, list) and self.values):
            raise ValueError(f"a choice for '{self.key}' needs values")
        if self.kind is DrawKind.NORMAL and not self.high >= 0.0:
            raise ValueError(f"standard deviation (high) of '{self.key}' must not be negative")
        if self.kind is not DrawKind.NORMAL and not -math.inf < self.low <= self.high < math.inf:
            raise ValueError(f"low = {self.low} of '{self.key}' must not exceed high = {self.high}")
        if self.kind is DrawKind.LOG_UNIFORM and not self.low > 0.0:
            raise ValueError(f"low = {self.low} of '{self.key}' must be positive")


@dataclass(frozen=True, slots=True)
class Criterion:
    """One table [[success]]: a run is a success by this name where the metric is there and within the limits."""

    name: str
    # a column of the results
    metric: str
    min: float = -math.inf
    max: float = math.inf


@dataclass(frozen=True, slots=True)
class Campaign:
    """The whole file."""

    # what to call it
    name: str = "campaign"
    # of every draw, and through it of every run's own seed
    seed: int = 0
    # runs of every combination
    repeats: int = 1
    # scenario file beside this one; empty: the built-in scenario
    scenario: str = ""
    # several scenario files, each one a value of the axis "scenario"
    scenarios: tuple[str, ...] = ()
    # model of the target in place of the scenario's or the logs' own
    model: str = ""
    # recorded logs instead of a scenario, each one a value of the axis "log"
    logs: tuple[str, ...] = ()
    # settings of the replay, a file as for `avsreplay run --config`
    config: str = ""
    # keep one line a scan (scans.parquet), which the ROC curves are made of
    scans: bool = True
    # settings of every run
    set: Any = field(default_factory=dict)
    grid: tuple[Axis, ...] = ()
    case: tuple[Case, ...] = ()
    draw: tuple[Draw, ...] = ()
    success: tuple[Criterion, ...] = ()

    def __post_init__(self) -> None:
        if not 1 <= self.repeats <= MAX_REPEATS:
            raise ValueError(f"repeats = {self.repeats} must lie between 1 and {MAX_REPEATS}")
        if not 0 <= self.seed < 1 << 63:
            raise ValueError(f"seed = {self.seed} must lie between 0 and 2^63")
        if sum(map(bool, (self.logs, self.scenario, self.scenarios))) > 1:
            raise ValueError("scenario, scenarios and logs exclude each other")
        _check_set(self.set)
        self._check_names()

    def _check_names(self) -> None:
        names = [axis.key for axis in self.grid] + [draw.key for draw in self.draw]
        for kind, entries in (("key", names), ("case", [c.name for c in self.case])):
            double = next((n for n in entries if entries.count(n) > 1), None)
            if double is not None:
                raise ValueError(f"{kind} '{double}' stands twice")
        wrong = next((n for n in self._keys() if self.logs and n.startswith("scenario.")), None)
        if wrong is not None:
            raise ValueError(f"'{wrong}' has no place where logs are given")

    def _keys(self) -> list[str]:
        cases = [key for case in self.case for key in case.set]
        return [*self.set, *cases, *(a.key for a in self.grid), *(d.key for d in self.draw)]


@dataclass(frozen=True, slots=True)
class LoadedCampaign:
    """A campaign and where its file names start."""

    campaign: Campaign
    folder: Path
    name: str


def load_campaign(path: Path) -> LoadedCampaign:
    """Read a campaign file. Raises UnreadableInput or UsageError with file and line."""
    document = settings.load(path)
    return LoadedCampaign(settings.build(Campaign, document), Path(path).parent, str(path))


def _check_key(key: str) -> None:
    if not key.startswith(PREFIXES) or not all(key.split(".")):
        raise ValueError(f"key '{key}' must begin with 'scenario.' or 'run.'")


def _check_set(table: Any) -> None:
    if not isinstance(table, dict):
        raise ValueError("set must be a table of key = value")
    for key in table:
        try:
            _check_key(key)
        except ValueError as error:
            raise ValueError(f'{error}, in quotes, as in "run.init" = "truth"') from None
