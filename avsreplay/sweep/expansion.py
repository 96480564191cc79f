"""The runs of a campaign. Each is a task that contains everything a worker needs.

The id of a task is the hash of its scenario, settings and inputs: a finished run stays finished
when the campaign is extended, and two equal runs are made once. The seed depends on the repeat
only, so that all combinations of one repeat have the same noise and the same draws and differences
between combinations are not due to chance.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

import avsreplay
from avsreplay import geometry, toml_document
from avsreplay.config import RunConfig
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.job_file import read_job
from avsreplay.simulate.scenario import load_scenario, scenario_of
from avsreplay.sweep.campaign import Campaign, Draw, DrawKind, LoadedCampaign

RESULT_FORMAT = 4  # format of a run's result; a result with another format is computed again
_NAMED_TABLES = ("scenario", "log", "case")  # axes that select a file or a case, not a key


@dataclass(frozen=True, slots=True)
class Task:
    """What a worker needs for one run.

    Attributes:
        id: Hash of everything below except folder names.
        scenario: TOML text, "" where a log is replayed.
        folder: Folder to which file names in the scenario are relative.
        log: Log, or job file with a log and its options, or "".
        model: Model file, or "".
        assignments: Settings ``a.b=value`` of the replay.
        scans: Whether one row per scan is kept.
        flights: Number of whole flights after the run.
    """

    id: str
    scenario: str
    folder: str
    log: str
    model: str
    assignments: tuple[str, ...]
    scans: bool
    flights: int = 0


@dataclass(frozen=True, slots=True)
class Point:
    """One run: row number, number of the combination, repeat, seed (None for a log), values
    by key, and task.
    """

    index: int
    cell: int
    repeat: int
    seed: int | None
    values: Mapping[str, Any]
    task: Task


@dataclass(frozen=True, slots=True)
class Expansion:
    """All runs of a campaign, made one by one.

    ``cells`` are the combinations by key, without what is drawn.
    """

    loaded: LoadedCampaign
    cells: tuple[Mapping[str, Any], ...]
    _bases: Mapping[str, Mapping[str, Any]]
    _run: tuple[str, ...]
    _inputs: Mapping[str, str]

    def __len__(self) -> int:
        return len(self.cells) * self.loaded.campaign.repeats

    def points(self) -> Iterator[Point]:
        """The runs in the order of their rows: repeat by repeat, so that a stop leaves
        complete repeats.
        """
        campaign = self.loaded.campaign
        for repeat in range(campaign.repeats):
            drawn = _draws(campaign, repeat)
            seed = None if campaign.logs else _seed(campaign, repeat)
            for cell, chosen in enumerate(self.cells):
                index, values = repeat * len(self.cells) + cell, {**chosen, **drawn}
                yield Point(index, cell, repeat, seed, values, self.task(values, repeat))

    def task(self, values: Mapping[str, Any], repeat: int) -> Task:
        """Return the task of one run.

        Args:
            values: Values of the combination by key, including the values drawn for this repeat.
            repeat: Number of the repeat, from 0; the seed of the scenario is derived from it.
        """
        campaign, folder = self.loaded.campaign, self.loaded.folder
        of_case: Mapping[str, Any] = next(
            (case.set for case in campaign.case if case.name == values.get("case")), {}
        )
        every = {
            **campaign.set,
            **of_case,
            **{k: v for k, v in values.items() if k not in _NAMED_TABLES},
        }
        name = values.get("scenario", campaign.scenario)
        home = (folder / name).parent
        scenario = "" if campaign.logs else self._scenario(name, every, repeat)
        run = _assignments({k[4:]: v for k, v in every.items() if k.startswith("run.")})
        log = str(folder / values["log"]) if campaign.logs else ""
        model = str(folder / campaign.model) if campaign.model else ""
        assignments = (*self._run, *run)
        named = _models_of(scenario, home)
        inputs = [self._inputs.get(path, "") for path in (log, model or named[0], *named[1:])]
        content = [
            RESULT_FORMAT,
            avsreplay.__version__,
            scenario,
            inputs,
            assignments,
            campaign.scans,
            campaign.flights,
        ]
        digest = hashlib.sha256(json.dumps(content).encode()).hexdigest()[:24]
        return Task(
            digest, scenario, str(home), log, model, assignments, campaign.scans, campaign.flights
        )

    def _scenario(self, name: str, every: Mapping[str, Any], repeat: int) -> str:
        table = dict(self._bases[name])
        table["seed"] = _seed(self.loaded.campaign, repeat)
        for key, value in every.items():
            if key.startswith("scenario."):
                table = _placed(table, key.split(".")[1:], value, key, self.loaded.name)
        return tomli_w.dumps(table)


def expand(loaded: LoadedCampaign) -> Expansion:
    """Return the runs of a campaign; every value of every axis is checked before the first run
    starts.

    Args:
        loaded: the campaign and its folder.

    Raises:
        UsageError: A wrong key or value; the message names it.
        UnreadableInput: A file cannot be read.
    """
    campaign = loaded.campaign
    axes: list[list[tuple[str, Any]]] = [
        [(axis.key, value) for value in axis.values] for axis in campaign.grid
    ]
    if campaign.case:
        axes.insert(0, [("case", case.name) for case in campaign.case])
    for name, files in (("scenario", campaign.scenarios), ("log", campaign.logs)):
        if files:
            axes.insert(0, [(name, file) for file in files])
    cells = tuple(dict(chosen) for chosen in itertools.product(*axes))
    bases = _base_tables(loaded)
    plan = Expansion(loaded, cells, bases, _base_run(loaded), _inputs(loaded, bases))
    _try_all(plan, axes)
    return plan


def _base_tables(loaded: LoadedCampaign) -> dict[str, Mapping[str, Any]]:
    """The scenarios by their names in the campaign; the name of the built-in one is ""."""
    campaign = loaded.campaign
    names = () if campaign.logs else campaign.scenarios or (campaign.scenario,)
    return {name: _table(loaded.folder / name if name else None) for name in names}


def _table(path: Path | None) -> Mapping[str, Any]:
    return toml_document.parse(load_scenario(path).text, str(path or "built-in scenario")).table


def _base_run(loaded: LoadedCampaign) -> tuple[str, ...]:
    if not loaded.campaign.config:
        return ()
    document = toml_document.load(loaded.folder / loaded.campaign.config)
    toml_document.build(RunConfig, document)
    return tuple(_assignments(document.table))


def _inputs(loaded: LoadedCampaign, bases: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Hashes of the files that runs read, by path."""
    campaign = loaded.campaign
    paths = {str(loaded.folder / name) for name in (*campaign.logs, campaign.model) if name}
    texts = {name: tomli_w.dumps(table) for name, table in bases.items()}
    paths |= {
        path
        for name, text in texts.items()
        for path in _models_of(text, (loaded.folder / name).parent)
    }
    return {path: _digest(Path(path)) for path in sorted(paths - {""})}


def _models_of(scenario: str, folder: Path) -> tuple[str, ...]:
    """Paths of the target's model that a scenario names ("" for none) and of the meshes of its
    objects.
    """
    table = toml_document.parse(scenario, "scenario").table if scenario else {}
    names = [
        table.get("target", {}).get("model"),
        *(each.get("model") for each in table.get("object", ())),
    ]
    return tuple(str(folder / name) if name else "" for name in names)


def _digest(path: Path) -> str:
    """Hash of a file, of the files of a folder, or of a job file and all that it names."""
    if path.is_dir():
        parts = {file.name: file for file in sorted(path.iterdir()) if file.is_file()}
    elif (job := read_job(path)) is not None:
        parts = {"": path} | {str(k): named for k, named in enumerate(job.inputs)}
    else:
        return _sha256(path)
    each = [
        (name, _sha256(part) if part == path else _digest(part)) for name, part in parts.items()
    ]
    return hashlib.sha256(json.dumps(each).encode()).hexdigest()


def _sha256(path: Path) -> str:
    if path.exists() and not path.is_file():
        raise UnreadableInput("is not a regular file", where=str(path), hint="name a file")
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise UnreadableInput(
            error.strerror or "cannot be read", where=str(path), hint="check the path"
        ) from None


def _try_all(plan: Expansion, axes: list[list[tuple[str, Any]]]) -> None:
    """Build scenario and settings once for every value of every axis, the other axes at their first
    value.
    """
    first = {axis[0][0]: axis[0][1] for axis in axes}
    drawn = _draws(plan.loaded.campaign, 0)
    for key, value in [(None, None), *(pair for axis in axes for pair in axis)]:
        chosen = {**first, **({key: value} if key else {}), **drawn}
        task = plan.task(chosen, 0)
        try:
            if task.scenario:
                scenario_of(toml_document.parse(task.scenario, plan.loaded.name))
            toml_document.build(
                RunConfig, toml_document.override(toml_document.Document("", {}), task.assignments)
            )
        except UsageError as error:
            at = f"{plan.loaded.name}, {key} = {value}" if key else plan.loaded.name
            raise UsageError(error.what, where=at, hint=error.hint) from None


def _seed(campaign: Campaign, repeat: int) -> int:
    state = np.random.SeedSequence(campaign.seed, spawn_key=(0, repeat)).generate_state(
        1, np.uint64
    )
    return int(state[0] >> np.uint64(1))


def _draws(campaign: Campaign, repeat: int) -> dict[str, Any]:
    """The values drawn for a repeat, each from its own random stream, so that adding a draw changes
    no other.
    """
    drawn = {}
    for draw in campaign.draw:
        stream = np.random.SeedSequence(
            campaign.seed, spawn_key=(1, repeat, zlib.crc32(draw.key.encode()))
        )
        drawn[draw.key] = _drawn(draw, np.random.Generator(np.random.PCG64(stream)))
    return drawn


def _drawn(draw: Draw, rng: np.random.Generator) -> Any:
    low, high = draw.low, draw.high
    match draw.kind:
        case DrawKind.UNIFORM:
            return float(rng.uniform(low, high))
        case DrawKind.LOG_UNIFORM:
            return math.exp(float(rng.uniform(math.log(low), math.log(high))))
        case DrawKind.NORMAL:
            return float(rng.normal(low, high))
        case DrawKind.INTEGER:
            return int(rng.integers(math.ceil(low), math.floor(high), endpoint=True))
        case DrawKind.CHOICE:
            return draw.values[int(rng.integers(len(draw.values)))]
        case DrawKind.DIRECTION:
            towards = rng.standard_normal(3)
            return [
                float(x)
                for x in towards / np.linalg.norm(towards[None], axis=1) * rng.uniform(low, high)
            ]
        case DrawKind.ATTITUDE:
            return [float(x) for x in geometry.normalise(rng.standard_normal(4))]


def _placed(node: Any, path: list[str], value: Any, key: str, where: str) -> Any:
    """A copy of ``node`` with ``value`` at ``path``; everything else is shared."""
    head, rest = path[0], path[1:]
    if isinstance(node, list):
        if not head.isdigit() or int(head) >= len(node):
            raise UsageError(
                f"'{key}' names no setting", where=where, hint=f"the list has {len(node)} entries"
            )
        changed = list(node)
        changed[int(head)] = _placed(node[int(head)], rest, value, key, where) if rest else value
        return changed
    if not isinstance(node, Mapping):
        raise UsageError(f"'{key}' names no setting", where=where, hint="check the key")
    return {**node, head: _placed(node.get(head, {}), rest, value, key, where) if rest else value}


def _assignments(table: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """``a.b=value`` of every value in a table of tables."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _assignments(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}={toml_document.toml_value(value)}"
