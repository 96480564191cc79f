"""Records a simulation or a recorded source to a log, scan by scan."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from avsreplay.errors import UsageError, value_class
from avsreplay.files import STDOUT
from avsreplay.geometry import Pose
from avsreplay.log import LogWriter, Loss, SourceOptions, open_source, read_surface
from avsreplay.log.options import lost_text
from avsreplay.log.writer import ROOT_FRAME
from avsreplay.records import NS_PER_S, Label, LogHeader, Scan, ScanStatus, Surface, Truth
from avsreplay.simulate.faults import InjectedFault
from avsreplay.simulate.rays import Engine
from avsreplay.simulate.recorded_faults import disturbed
from avsreplay.simulate.scenario import Scenario, load_scenario
from avsreplay.simulate.simulation import SIMULATED_EPOCH_NS, simulate
from avsreplay.simulate.target import builtin_surface

Ticker = Callable[[Iterable[Scan], int], AbstractContextManager[Iterator[Scan]]]
"""Shows progress: (scans, expected number or 0 if unknown) -> a context manager that yields the
scans.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordOptions:
    """How to write a log, see ``log.LogWriter``.

    Attributes:
        model: model file that replaces the model of the scenario or source.
        faults: faults that are injected into the scans and labelled.
        fault_seed: seed of the random numbers of these faults.
    """

    model: Path | None = None
    cloud_model: bool = False
    overwrite: bool = False
    compression: str = "zstd"
    faults: tuple[InjectedFault, ...] = ()
    fault_seed: int = 0


@value_class(eq=True)
class Recorded:
    """What a recording contains.

    Attributes:
        path: the log.
        scans: number of clouds.
        points: total number of points.
        empty: number of clouds without points.
        damaged: number of scans of the source that could not be used and were left out.
        span_s: time from the first to the last scan [s].
        bytes: size of the file.
        model: name of the model, None without one.
        faults: labels as (kind, start [s], end [s] after the first scan, whether its scans are
            unusable), without those outside of the recording.
        losses: parts of the source that could not be read.
        note: a remark for the user, "" if there is none.
        lost: what of the source could not be read, in words; "" if nothing was lost.
    """

    path: str
    scans: int
    points: int
    empty: int
    damaged: int
    span_s: float
    bytes: int
    model: str | None
    seed: int | None
    faults: tuple[tuple[str, float, float, bool], ...]
    losses: tuple[Loss, ...] = ()
    note: str = ""
    lost: str = ""


def record(
    source: Path | None,
    output: Path,
    *,
    seed: int | None = None,
    options: RecordOptions | None = None,
    reading: SourceOptions | None = None,
    ticker: Ticker | None = None,
) -> Recorded:
    """Record a simulation or a recorded source to a log.

    Args:
        source: a scenario (.toml), a recorded source (bag, log, folder), or None for the built-in
            scenario.
        output: the log to write (.mcap).
        seed: seed that replaces that of the scenario.
        options: how to write the log.
        reading: how to read a recorded source; its duration replaces that of a scenario.
        ticker: shows the progress.

    Returns:
        What was written.

    Raises:
        UsageError: an option does not apply to this kind of source, or a value in the scenario is
            invalid.
        UnreadableInput: the scenario, the model or the source cannot be read.
    """
    options = options or RecordOptions()
    if source is None or source.suffix.lower() == ".toml":
        duration_s = None if reading is None else reading.duration_s
        if reading is not None and reading != SourceOptions(duration_s=duration_s):
            hint = (
                "leave out the options that read a recorded source; --duration and --seed apply to"
                " a scenario"
            )
            raise UsageError(
                "a scenario has no topics or files to read",
                where=str(source or "record"),
                hint=hint,
            )
        return record_scenario(load_scenario(source, seed, duration_s), output, options, ticker)
    if seed is not None and not options.faults:
        hint = "leave out --seed; it is used with --fault only"
        raise UsageError("a recorded source has no seed", where=str(source), hint=hint)
    return record_source(source, output, reading or SourceOptions(), options, ticker)


def surface_for(scenario: Scenario, model: Path | None = None, cloud_ok: bool = False) -> Surface:
    """Return the model of a scenario: ``model`` if given, else the file it names, else its built-in
    shape.

    Args:
        scenario: the scenario.
        model: model file that replaces that of the scenario.
        cloud_ok: whether a model without faces is accepted.

    Raises:
        UnreadableInput: the file cannot be read.
        UsageError: the file holds no faces and ``cloud_ok`` is False.
    """
    path = model or scenario.model
    return (
        read_surface(path, cloud_ok)
        if path is not None
        else builtin_surface(scenario.params.target.shape)
    )


def record_scenario(
    scenario: Scenario, output: Path, options: RecordOptions, ticker: Ticker | None = None
) -> Recorded:
    """Record a simulation; the ground truth is stamped with the true instants.

    Args:
        scenario: what to simulate.
        output: log to write (.mcap).
        options: how to write the log; a model in it replaces that of the scenario.
        ticker: shows progress.
    """
    meshes = {name: read_surface(path) for name, path in scenario.meshes.items()}
    simulation = simulate(
        scenario, surface_for(scenario, options.model, options.cloud_model), meshes
    )
    last_ns = SIMULATED_EPOCH_NS + round((simulation.count - 1) * 1e9 / scenario.params.rate_hz)
    header = _labelled(
        simulation.header, options, SIMULATED_EPOCH_NS, moving=scenario.params.camera is not None
    )
    header, outside = _within(header, SIMULATED_EPOCH_NS, last_ns)
    with (
        _writer(output, header, options) as writer,
        _ticked(ticker, simulation.scans(), simulation.count) as scans,
    ):
        pairs = _with_faults(scans, header, options, SIMULATED_EPOCH_NS)
        tally = write_recorded(
            pairs, simulation.truth_of, writer, true_clock=True, camera_of=simulation.camera_poses
        )
    by_hand = scenario.params.scanner.engine is Engine.AUTO and simulation.engine is Engine.EXACT
    slow = "embreex is not installed: rays were cast by the exact engine, which is slower"
    done = tally.recorded(output, writer.bytes, header)
    return replace(
        done, note="; ".join(each for each in (slow if by_hand else "", outside) if each)
    )


def record_source(
    source: Path,
    output: Path,
    reading: SourceOptions,
    options: RecordOptions,
    ticker: Ticker | None = None,
) -> Recorded:
    """Record the scans, ground truth, labels and model of a source, stamped with the selected
    clock.

    Args:
        source: log, bag or folder of scans.
        output: log to write (.mcap).
        reading: how to read the source.
        options: how to write the log; a model in it replaces that of ``reading``.
        ticker: shows progress.

    Raises:
        UsageError: the output is the source or cannot be written, or an option is invalid.
        UnreadableInput: the source or the model cannot be read, a part is lost and ``reading`` is
            strict, or the output cannot be written.
    """
    if output != STDOUT and output.exists() and source.exists() and output.samefile(source):
        raise UsageError("the output is the source", where=str(output), hint="name another output")
    reading = replace(
        reading,
        model=options.model or reading.model,
        cloud_model=options.cloud_model or reading.cloud_model,
    )
    with open_source(source, reading) as opened:
        epoch_ns = opened.scan_at(0).log_ns if len(opened) else 0
        moved = opened.options.fixed_frame is not None or opened.options.sensor_topic is not None
        header, due = _labelled(opened.header, options, epoch_ns, moving=moved), opened.info().scans
        header = replace(header, sensor_at_stamp=moved)
        header, outside = _within(
            header, epoch_ns, opened.scan_at(len(opened) - 1).log_ns if len(opened) else 0
        )
        with (
            _writer(output, header, options) as writer,
            _ticked(ticker, opened.scans(), due) as scans,
        ):
            # registration and faults need the position of the sensor: a log holds its frame and its
            # poses
            seen = (replace(s, points=opened.in_own_frame(s)) for s in scans) if moved else scans
            pairs = _with_faults(seen, header, options, epoch_ns)
            tally = write_recorded(
                pairs,
                opened.truth_of,
                writer,
                true_clock=False,
                camera_of=lambda s: [(0, at)] if (at := opened.frame_of(s)) else [],
            )
        lost = lost_text(opened.losses, opened.damaged, len(opened))
        done = replace(
            tally.recorded(output, writer.bytes, header, tuple(opened.losses)), lost=lost
        )
        frame = (
            f"scans are in the frame of the sensor, which moves in '{ROOT_FRAME}'; a replay"
            " transforms them to it"
        )
        return replace(
            done, note="; ".join(each for each in (frame if moved else "", outside) if each)
        )


@dataclass(slots=True)
class _Tally:
    scans: int = 0
    points: int = 0
    empty: int = 0
    damaged: int = 0
    first_ns: int = 0
    last_ns: int = 0

    def span(self, scan: Scan) -> None:
        """Take the time of a scan, also of one that a fault removes."""
        self.first_ns = self.first_ns or scan.log_ns
        self.last_ns = scan.log_ns

    def add(self, scan: Scan) -> None:
        self.scans += 1
        self.points += len(scan.points)
        self.empty += not len(scan.points)

    def recorded(
        self, output: Path, size: int, header: LogHeader, losses: tuple[Loss, ...] = ()
    ) -> Recorded:
        return Recorded(
            path=str(output),
            scans=self.scans,
            points=self.points,
            empty=self.empty,
            damaged=self.damaged,
            span_s=(self.last_ns - self.first_ns) * 1e-9,
            bytes=size,
            model=header.surface.name if header.surface else None,
            seed=header.seed,
            faults=tuple(self._fault(label) for label in header.labels),
            losses=losses,
        )

    def _fault(self, label: Label) -> tuple[str, float, float, bool]:
        start, end = ((t - self.first_ns) / NS_PER_S for t in (label.start_ns, label.end_ns))
        return label.kind, start, end, label.harmful


def write_recorded(
    pairs: Iterable[tuple[Scan, Scan | None]],
    truth_of: Callable[[Scan], Truth],
    writer: LogWriter,
    true_clock: bool,
    camera_of: Callable[[Scan], list[tuple[int, Pose]]],
) -> _Tally:
    """Write scans with the truth at each scan as it was; damaged scans are counted.

    Args:
        pairs: a scan as it was, and the scan to write; None where it is left out.
        truth_of: the ground truth of a scan.
        writer: the log that is written.
        true_clock: whether truth is stamped with the log clock.
        camera_of: poses of a moving camera at a scan, each with its time after the stamp [ns].
    """
    tally = _Tally()
    for before, scan in pairs:
        if before.status is ScanStatus.DAMAGED:
            tally.damaged += 1
            continue
        tally.span(before)
        if scan is None:
            continue
        writer.write(scan)
        truth = truth_of(before)
        if truth.pose is not None:
            writer.write_truth(
                before.log_ns, before.log_ns if true_clock else before.t_ns, truth.pose, truth.state
            )
        for after_ns, camera in camera_of(before):
            stamp_ns = before.log_ns if true_clock else before.t_ns
            writer.write_camera(before.log_ns + after_ns, stamp_ns + after_ns, camera)
        tally.add(scan)
    return tally


def _labelled(
    header: LogHeader, options: RecordOptions, epoch_ns: int, *, moving: bool
) -> LogHeader:
    """The header with the labels of the injected faults, the seed of their random numbers, and the
    fixed frame.
    """
    header = replace(header, fixed_frame=ROOT_FRAME if moving else "")
    if not options.faults:
        return header
    labels = (*header.labels, *(fault.label(epoch_ns) for fault in options.faults))
    return replace(
        header, labels=labels, notes={**header.notes, "fault_seed": str(options.fault_seed)}
    )


def _within(header: LogHeader, first_ns: int, last_ns: int) -> tuple[LogHeader, str]:
    """Return the header without the faults that begin after the last scan or end before the first,
    and a remark.

    Args:
        header: header with the labels of all faults.
        first_ns: time of the first scan on the log clock.
        last_ns: time of the last scan.
    """
    inside = [label.start_ns <= last_ns and label.end_ns > first_ns for label in header.labels]
    left = [label.kind for label, kept in zip(header.labels, inside, strict=True) if not kept]
    if not left:
        return header, ""
    kept = tuple(label for label, kept in zip(header.labels, inside, strict=True) if kept)
    return (
        replace(header, labels=kept),
        f"faults outside of the recording are left out: {', '.join(left)}",
    )


def _with_faults(
    scans: Iterable[Scan], header: LogHeader, options: RecordOptions, epoch_ns: int
) -> Iterator[tuple[Scan, Scan | None]]:
    if not options.faults:
        return ((scan, scan) for scan in scans)
    radius_m = None if header.surface is None else 0.5 * header.surface.extent
    return disturbed(scans, options.faults, epoch_ns, options.fault_seed, radius_m)


def _writer(output: Path, header: LogHeader, options: RecordOptions) -> LogWriter:
    return LogWriter(output, header, overwrite=options.overwrite, compression=options.compression)


def _ticked(
    ticker: Ticker | None, scans: Iterable[Scan], due: int
) -> AbstractContextManager[Iterator[Scan]]:
    return ticker(scans, due) if ticker else nullcontext(iter(scans))
