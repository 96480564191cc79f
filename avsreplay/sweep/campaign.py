"""The campaign file: what is varied, how often, and what counts as a success; the result of one of
its runs.

A campaign file states what is varied, how often, and what counts as a success. The result files are
made from the journal in the order of the plan. No clock, host, path or order of completion reaches
them: any number of workers, interrupted or not, gives the same bytes. Runs are read one by one, so
that the memory needed hardly depends on their number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from avsreplay import toml_document
from avsreplay.settings import Settings, setting

MAX_REPEATS = 10_000_000
RECORDED_SCORES = ("rms_m", "alpha_m", "inlier_ratio", "nis", "nees", "pos_err_m", "rot_err_deg")
SCAN_COLUMNS = ("seq", "fault", "harmful", "gamma", *RECORDED_SCORES)
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
class Axis(Settings):
    """One table [[grid]]: every value is combined with every value of the other tables."""

    key: str = setting(
        doc=(
            "scenario.<key> or run.<key>; a number selects an entry, as in"
            " scenario.fault.0.strength."
        )
    )
    values: Any = setting(doc="The list of its values.")

    def check(self) -> None:
        """Raise ValueError for a wrong key or an empty list."""
        _check_key(self.key)
        if not isinstance(self.values, list) or not self.values:
            raise ValueError(f"values of '{self.key}' must be a list that is not empty")


@dataclass(frozen=True, slots=True)
class CampaignCase(Settings):
    """One table [[case]]: settings that go together; cases are alternatives, each combined
    with the grid.
    """

    name: str = setting(doc="Name of the case in tables.")
    set: Any = setting(dict, "Settings of the case, by key.")

    def check(self) -> None:
        """Raise ValueError for a wrong key."""
        _check_set(self.set)


@dataclass(frozen=True, slots=True)
class Draw(Settings):
    """One table [[draw]]: a value drawn anew for every repeat, the same for all combinations
    of that repeat.
    """

    key: str = setting(doc="scenario.<key> or run.<key>.")
    kind: DrawKind = setting(doc="Distribution of the value.")
    low: float = setting(0.0, "Smallest value; the mean of a normal distribution.")
    high: float = setting(1.0, "Largest value; the standard deviation of a normal distribution.")
    values: Any = setting(list, "The values of a choice.")

    def check(self) -> None:
        """Raise ValueError where the bounds do not fit the distribution."""
        _check_key(self.key)
        if self.kind is DrawKind.CHOICE and not (isinstance(self.values, list) and self.values):
            raise ValueError(f"a choice for '{self.key}' needs values")
        if self.kind is DrawKind.NORMAL and not self.high >= 0.0:
            raise ValueError(f"standard deviation (high) of '{self.key}' must not be negative")
        if self.kind is not DrawKind.NORMAL and self.low > self.high:
            raise ValueError(f"low = {self.low} of '{self.key}' must not exceed high = {self.high}")
        if self.kind is DrawKind.LOG_UNIFORM and not self.low > 0.0:
            raise ValueError(f"low = {self.low} of '{self.key}' must be positive")


@dataclass(frozen=True, slots=True)
class SuccessCriterion(Settings):
    """One table [[success]]: a run succeeds where the metric has a value and is within the
    limits.
    """

    name: str = setting(doc="Name of the criterion in tables.")
    metric: str = setting(doc="A column of the results.")
    min: float = setting(-math.inf, "Smallest value that counts as success.", infinite=True)
    max: float = setting(math.inf, "Largest value that counts as success.", infinite=True)


@dataclass(frozen=True, slots=True)
class Campaign(Settings):
    """A campaign file."""

    name: str = setting("campaign", "Name of the campaign.")
    seed: int = setting(
        0, "Seed of every draw, and through it of every run's own seed.", low=0, below=2**63
    )
    repeats: int = setting(1, "Runs of every combination.", low=1, high=MAX_REPEATS)
    scenario: str = setting(
        "", "Scenario file, relative to this one; empty for the built-in scenario."
    )
    scenarios: tuple[str, ...] = setting(
        (), "Several scenario files, each one a value of the axis 'scenario'."
    )
    model: str = setting("", "Model of the target in place of the scenario's or the logs' own.")
    logs: tuple[str, ...] = setting(
        (), "Recorded logs in place of a scenario, each one a value of the axis 'log'."
    )
    config: str = setting("", "File with settings of the replay, as for 'avsreplay run --config'.")
    scans: bool = setting(
        True, "Keep one line per scan (scans.parquet), from which the ROC curves are made."
    )
    flights: int = setting(
        0,
        "Number of simulated flights after each run, to targets drawn from its belief, as with"
        " 'avsreplay plan --flights'.",
        low=0,
    )
    set: Any = setting(dict, "Settings of every run.")
    grid: tuple[Axis, ...] = setting((), "What is varied.")
    case: tuple[CampaignCase, ...] = setting((), "Alternatives.")
    draw: tuple[Draw, ...] = setting((), "What is drawn.")
    success: tuple[SuccessCriterion, ...] = setting((), "What counts as a success.")

    def check(self) -> None:
        """Raise ValueError where entries exclude each other or a name occurs twice."""
        if sum(map(bool, (self.logs, self.scenario, self.scenarios))) > 1:
            raise ValueError("scenario, scenarios and logs exclude each other")
        _check_set(self.set)
        self._check_names()

    def _check_names(self) -> None:
        names = [axis.key for axis in self.grid] + [draw.key for draw in self.draw]
        for kind, entries in (("key", names), ("case", [c.name for c in self.case])):
            double = next((n for n in entries if entries.count(n) > 1), None)
            if double is not None:
                raise ValueError(f"{kind} '{double}' occurs twice")
        wrong = next((n for n in self._keys() if self.logs and n.startswith("scenario.")), None)
        if wrong is not None:
            raise ValueError(f"'{wrong}' cannot be set where logs are given")

    def _keys(self) -> list[str]:
        cases = [key for case in self.case for key in case.set]
        return [*self.set, *cases, *(a.key for a in self.grid), *(d.key for d in self.draw)]


@dataclass(frozen=True, slots=True)
class LoadedCampaign:
    """A campaign, the folder to which its file names are relative, and its own name."""

    campaign: Campaign
    folder: Path
    name: str


@dataclass(frozen=True, slots=True)
class RunResult:
    """The result of one run.

    Attributes:
        id: Id of its task.
        status: ``ok``; ``lossy``: part of the log could not be read; ``failed``: an error of the
            input; ``crashed``.
        error: One line of text, None where the status is ``ok``.
        metrics: Numbers, truth values and words by name.
        scans: One tuple per scan, in the order of SCAN_COLUMNS.
        episodes: One tuple per fault window, in the order of EPISODE_COLUMNS.
        scan_count: Number of scans that are kept.
    """

    id: str
    status: str
    error: str | None = None
    metrics: Mapping[str, Any] | None = None
    scans: tuple[tuple[Any, ...], ...] = ()
    episodes: tuple[tuple[Any, ...], ...] = ()
    scan_count: int = 0


def load_campaign(path: Path) -> LoadedCampaign:
    """Read a campaign file.

    Args:
        path: the TOML file; file names in it are relative to its folder.

    Raises:
        UnreadableInput: the file cannot be read.
        UsageError: the file is not TOML, or a key or value is invalid; the message gives file and
            line.
    """
    document = toml_document.load(path)
    return LoadedCampaign(toml_document.build(Campaign, document), Path(path).parent, str(path))


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
