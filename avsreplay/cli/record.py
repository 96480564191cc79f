"""``avsreplay record``: write a log, from a scenario or from scans that others recorded."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.reading import READING_FLAGS, reading_flags
from avsreplay.cli.setting_options import source_setting
from avsreplay.errors import DataLost, UsageError

if TYPE_CHECKING:
    from avsreplay.log import SourceOptions
    from avsreplay.record import Recorded
    from avsreplay.records import Scan

EPILOG = """\b
Examples:
  avsreplay record -o tumble.mcap                       the built-in scenario
  avsreplay record scenario.toml -o x.mcap --seed 7     a scenario file
  avsreplay record scans/ -o y.mcap --model m.ply       a folder of scans with a poses file
  avsreplay record drive.bag -o z.mcap --topic /points  a ROS 1 or 2 bag, or an MCAP"""
READING = (
    *("topic", "truth_topic", "truth_file", "rate_hz", "every", "start_s", "end_s", "duration_s", "n_scans"),
    *("start_offset_s", "max_message_mib", "clock", "strict", *READING_FLAGS),
)


@click.command("record", epilog=EPILOG)
@click.argument("source", required=False, type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="The log to write (.mcap).")
@click.option("--seed", type=click.IntRange(0), help="Seed of a simulation, over the scenario's own.")
@source_setting("--model", type=click.Path(path_type=Path))
@source_setting("--cloud-model", is_flag=True)
@source_setting("--topic")
@source_setting("--truth-topic")
@source_setting("--truth", "truth_file", type=click.Path(path_type=Path))
@source_setting("--rate", "rate_hz", type=float)
@source_setting("--every-scan", "--every", "every", type=int)
@source_setting("--start", "start_s", type=float)
@source_setting("--end", "end_s", type=float)
@source_setting("--duration", "duration_s", type=float)
@source_setting("--start-offset", "start_offset_s", type=float)
@source_setting("--max-message-mib", type=int)
@source_setting("--n-scans", type=int)
@source_setting("--clock")
@reading_flags
@source_setting("--strict", is_flag=True, default=None)
@click.option("--compression", type=click.Choice(["zstd", "lz4", "none"]), default="zstd", show_default=True)
@click.option("--overwrite", is_flag=True, help="Replace an existing output.")
@click.option("--json", "as_json", is_flag=True, help="One JSON document on stdout.")
def command(
    source: Path | None,
    output: Path,
    seed: int | None,
    model: Path | None,
    cloud_model: bool | None,
    compression: str,
    overwrite: bool,
    as_json: bool,
    **reading: Any,
) -> None:
    """Write a log: simulate a scenario, or take over scans that others recorded.

    SOURCE is a scenario (.toml), a folder of PLY or PCD scans, a ROS 1 or ROS 2 bag, or an MCAP; without it the
    built-in scenario is simulated. The log holds the model, the scenario and the truth, and runs with no flag.
    """
    from avsreplay.record import RecordOptions, record

    options = RecordOptions(model=model, cloud_model=bool(cloud_model), overwrite=overwrite, compression=compression)
    done = record(source, output, seed=seed, options=options, reading=_reading(reading), ticker=_progress)
    click.echo(json.dumps(dataclasses.asdict(done), indent=2) if as_json else _sentence(done))
    if done.losses or done.damaged:
        lost = f"{len(done.losses)} damaged places, {done.damaged} messages that could not be decoded were left out"
        raise DataLost(lost, where=str(source), hint="see 'avsreplay doctor'")


def _reading(flags: dict[str, Any]) -> SourceOptions | None:
    """The flags for recorded sources, None where none was given."""
    from avsreplay.log import ClockChoice, SourceOptions

    given = {name: flags[name] for name in READING if flags[name] is not None}
    if "clock" in given:
        given["clock"] = ClockChoice(given["clock"])
    try:
        return SourceOptions(**given) if given else None
    except ValueError as error:
        raise UsageError(str(error), where="record", hint="correct the flag") from None


def _sentence(done: Recorded) -> str:
    lines = [
        f"{done.path}: {done.scans} scans, {done.span_s:.1f} s, {done.points} points, {done.bytes} bytes",
        f"model: {done.model or 'none'}" + (f", seed {done.seed}" if done.seed is not None else ""),
    ]
    lines += [
        f"fault: {kind} from {start:.1f} s to {end:.1f} s, {'harmful' if harmful else 'harmless'}"
        for kind, start, end, harmful in done.faults
    ]
    return "\n".join([*lines, f"note: {done.note}"] if done.note else lines)


@contextmanager
def _progress(scans: Iterable[Scan], due: int) -> Iterator[Iterator[Scan]]:
    """A bar on stderr, on a terminal only."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    if not console.is_terminal:
        yield iter(scans)
        return
    with Progress(console=console, transient=True) as bar:
        yield iter(bar.track(scans, total=due or None, description="recording"))
