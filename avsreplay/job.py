"""One run, whole: open the log, wire the stages, fold the scans, sum up, write the result directory.

The command line, the Python API and a sweep all go through here.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from avsreplay import chain, settings
from avsreplay.chain import Memory
from avsreplay.config import Against, RunConfig, load_config
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.estimate.chart import nearest_permutation
from avsreplay.estimate.initialise import PoseFix
from avsreplay.estimate.params import EstimatorParams
from avsreplay.estimate.reference import Reference, healthy_pose, reference_of
from avsreplay.geometry import Pose
from avsreplay.log import Source, SourceOptions, open_source
from avsreplay.records import Scan, State, Surface
from avsreplay.register import Registrar
from avsreplay.report import Summary
from avsreplay.report.summary import SummaryFold
from avsreplay.rows import Row
from avsreplay.wire import first_memory, stages

__all__ = ["HealthyPoses", "Job", "Listener", "Run", "replay"]

Listener = Callable[[Scan, Memory, Row], None]
"""Called after each scan: what keeps beliefs, truth, clouds and plans beside the rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """What to run.

    Attributes:
        source: log, bag or folder.  options: how to read it.
        config_file: TOML of a RunConfig.  assignments: ``a.b=c`` over it, from flags.
        prefetch: scans decoded ahead while one registers; never changes a result.
    """

    source: Path
    options: SourceOptions = field(default_factory=SourceOptions)
    config_file: Path | None = None
    assignments: tuple[str, ...] = ()
    prefetch: int = 2


class HealthyPoses:
    """A listener that collects the healthy poses of a run, for a fit to all of them."""

    def __init__(self, params: EstimatorParams) -> None:
        """``params``: the estimator's, auto values filled in."""
        self._params, self._fixes = params, list[PoseFix]()

    def __call__(self, _scan: Scan, memory: Memory, row: Row) -> None:
        """Take one scan."""
        if row.gamma and memory.track is not None and memory.last is not None:
            self._fixes.append(healthy_pose(memory.track, row.t_ns, memory.last, self._params))

    def reference(self) -> Reference:
        """The motion that fits them best. Raises UsageError where they are too few."""
        return reference_of(self._fixes, self._params)


class Run:
    """An open run; a context manager. ``rows`` may be taken once.

    Attributes:
        source: the open log.  config: the effective configuration.  surface: the model in force.
        registrar: of that model.
    """

    def __init__(self, job: Job) -> None:
        """Open and wire.

        Raises:
            UnreadableInput: the log or the model cannot be read.  UsageError: a key, flag or topic is wrong.
        """
        self.job = job
        self.source: Source = open_source(job.source, job.options)
        try:
            header = self.source.header
            self.config: RunConfig = load_config(job.config_file, _run_table(header.scenario), job.assignments)
            self.surface: Surface = self._model()
            self._reference: Reference | None = None
            self.registrar = Registrar(self.surface, self.config.register)
            truth = self._true_poses()
            self._stages = stages(self.config, header, self.surface, truth, self.registrar)
        except BaseException:
            self.source.close()
            raise
        labelled = bool(header.labels) or header.seed is not None
        self._fold = SummaryFold(labels=header.labels if labelled else None, truth=header.truth)
        self._end: tuple[Memory, State] | None = None

    def __enter__(self) -> Run:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.source.close()

    def __len__(self) -> int:
        """How many scans are due."""
        return len(self.source)

    def rows(self, listeners: Iterable[Listener] = ()) -> Iterator[Row]:
        """The replay, row by row. Raises UnreadableInput where the log holds no scan."""
        if not len(self.source):
            hint = "widen the selection, or see 'avsreplay info'"
            raise UnreadableInput("no scan to replay", where=str(self.job.source), hint=hint)
        listeners = tuple(listeners)
        scans = map(self._judged, self.source.scans(self.job.prefetch))
        for scan, memory, row in chain.fold(self._stages, first_memory(self._stages), scans):
            self._fold.add(row)
            if scan.body is not None:
                self._end = memory, scan.body
            for listener in listeners:
                listener(scan, memory, row)
            yield row

    @property
    def truth(self) -> State | None:
        """The true state at the last scan that has one, its principal axes named as the estimate names them."""
        if self._end is None or self._end[0].track is None:
            return self.source.header.truth
        return nearest_permutation(self._end[0].track.belief, self._end[1])[0]

    def summary(self) -> Summary:
        """The summary of the rows taken so far."""
        clock, losses = self.source.clock, self.source.losses
        counts = {"losses": len(losses), "lost_messages": sum(loss.messages or 0 for loss in losses)}
        counts |= {"stamps_unset": clock.unset, "stamps_jumped": clock.jumps}
        counts |= {"stamps_equal": clock.equal, "stamps_back": clock.back}
        return replace(self._fold.result(self.truth), counts=counts)

    def facts(self) -> dict[str, Any]:
        """What stands in ``run.json`` but for versions: the effective configuration and the hashes of what was read."""
        return {
            "log": {"name": self.job.source.name, "sha256": self.source.sha256, "scans": len(self.source)},
            "model": self._model_facts(),
            "clock": settings.dump(self.source.clock),
            "selection": settings.dump(self.job.options),
            "config": settings.dump(self.config),
        }

    def _model_facts(self) -> dict[str, Any]:
        surface = self.surface
        return {"name": Path(surface.name).name, "sha256": surface.sha256, "extent_m": surface.extent}

    def _true_poses(self) -> list[tuple[int, Pose]]:
        """What hindsight judges by: the log's truth, or the poses of a motion fitted in a first pass."""
        if self.config.reference is Against.TRUTH:
            return self.source.truth_poses()
        ready = stages(self.config, self.source.header, self.surface, registrar=self.registrar)
        poses, stamps = HealthyPoses(ready.estimator.params), set[int]()
        for scan, memory, row in chain.fold(ready, first_memory(ready), self.source.scans(self.job.prefetch)):
            poses(scan, memory, row)
            if row.status != "clock":
                stamps.add(row.t_ns)
        reference = self._reference = poses.reference()
        inside = sorted(t_ns for t_ns in stamps if reference.epoch_ns <= t_ns <= reference.end_ns)
        return [(t_ns, reference.at(t_ns).T_ac) for t_ns in inside]

    def _judged(self, scan: Scan) -> Scan:
        """The scan with the reference in place of its truth, where a reference is asked for."""
        if self._reference is None:
            return scan
        try:
            state = self._reference.at(scan.t_ns)
        except ValueError:  # before the first or after the last healthy pose
            return replace(scan, truth=None, body=None)
        return replace(scan, truth=state.T_ac, body=None)

    def _model(self) -> Surface:
        surface = self.source.header.surface
        if surface is None:
            raise UsageError("the log holds no model", where=str(self.job.source), hint="name one with --model FILE")
        return surface


def _run_table(scenario: str) -> Mapping[str, Any]:
    """The ``[run]`` table of the log's own scenario."""
    table: Mapping[str, Any] = tomllib.loads(scenario).get("run", {}) if scenario else {}
    return table


def replay(source: str | Path, *assignments: str, **options: Any) -> Iterator[Row]:
    """Replay a log, row by row: ``for row in avsreplay.replay("log.mcap", "faults.policy=all", n_scans=100)``.

    Args:
        source: log, bag or folder of scans.
        *assignments: settings ``a.b=c`` as for ``--set``.
        **options: how to read the log, see log.SourceOptions.

    Raises:
        AvsError: where the log, the model or a setting cannot be used; its ``str`` is one line.
    """
    with Run(Job(source=Path(source), options=SourceOptions(**options), assignments=assignments)) as run:
        yield from run.rows()
