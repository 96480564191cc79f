"""``avsreplay record`` writes a log; ``export`` and ``report`` write a saved result in other
formats and as a page.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.config import Command
from avsreplay.cli.options import (
    HTML,
    PATH,
    check_binary_output,
    check_outputs,
    check_suffix,
    read_options,
    read_result,
    source_options,
    tracked,
)
from avsreplay.errors import DataLost, UsageError
from avsreplay.files import STDOUT, check_output
from avsreplay.report import export

if TYPE_CHECKING:
    from avsreplay.log import SourceOptions
    from avsreplay.record import Recorded
    from avsreplay.records import Scan
    from avsreplay.simulate.faults import InjectedFault

EPILOG = """\b
Examples:
  avsreplay record -o tumble.mcap                       the built-in scenario
  avsreplay record scenario.toml -o x.mcap --seed 7     a scenario file
  avsreplay record scans/ -o y.mcap --model m.ply       a folder of scans with a poses file
  avsreplay record drive.bag -o z.mcap --topic /points  a ROS 1 or 2 bag, or an MCAP
  avsreplay record y.mcap -o f.mcap --fault occlusion:10:4 --fault range_bias:20:2:0.05"""
FAULT_KINDS_HELP = "Kinds of fault with their default strengths (docs/scenario.md describes them):"


class RecordCommand(Command):
    """``record``, whose help lists the kinds of fault."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples, then the kinds of fault with their default strengths."""
        from avsreplay.simulate.faults import kinds_with_strengths

        super().format_epilog(ctx, formatter)
        formatter.write_paragraph()
        formatter.write_text(FAULT_KINDS_HELP)
        with formatter.indentation():
            formatter.write_text(kinds_with_strengths())


class _Fault(click.ParamType["InjectedFault"]):
    """``kind:start:duration[:strength]``."""

    name = "kind:start:duration[:strength]"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> InjectedFault:
        from avsreplay.simulate.faults import InjectedFault

        try:
            return InjectedFault.parse(str(value))
        except ValueError as error:
            self.fail(str(error), param, ctx)


@click.command("record", cls=RecordCommand, epilog=EPILOG)
@click.argument("source", required=False, type=PATH)
@click.option(
    "-o", "--output", required=True, type=PATH, help="Write this log (.mcap); - is standard output."
)
@click.option(
    "--seed", type=click.IntRange(0, 2**63 - 1), help="Seed of a simulation or of the faults."
)
@click.option(
    "--fault",
    "faults",
    type=_Fault(),
    multiple=True,
    help="Inject a fault [s after the first scan]; repeatable.",
)
@source_options
@click.option(
    "--compression", type=click.Choice(["zstd", "lz4", "none"]), default="zstd", show_default=True
)
@click.option("--overwrite", is_flag=True, help="Replace an existing output.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
def record_command(
    source: Path | None,
    output: Path,
    seed: int | None,
    faults: tuple[InjectedFault, ...],
    model: Path | None,
    cloud_model: bool | None,
    compression: str,
    overwrite: bool,
    as_json: bool,
    **reading: Any,
) -> None:
    """Write a log: simulate a scenario, or convert recorded scans.

    SOURCE is a scenario (.toml), a folder of PLY or PCD scans, a ROS 1 or ROS 2 bag, or an MCAP;
    without it the built-in scenario is simulated; --duration shortens it. The log holds the model,
    the scenario and the truth, so that 'avsreplay run' needs no option. Faults may be injected into
    any of these; each is labelled in the log, and the same seed gives the same bytes.

    \f
    Raises:
        UsageError: an option does not apply to SOURCE, or the output cannot be written.
        UnreadableInput: SOURCE or the model cannot be read.
        DataLost: a part of SOURCE could not be read and was left out of the log.
    """  # noqa: D301
    from avsreplay.record import RecordOptions, record

    options = RecordOptions(
        model=model,
        cloud_model=bool(cloud_model),
        overwrite=overwrite,
        compression=compression,
        faults=faults,
        fault_seed=seed or 0,
    )
    check_binary_output(output)
    check_outputs("output", overwrite=overwrite)
    check_suffix(output, ".mcap")
    done = record(
        source, output, seed=seed, options=options, reading=_reading(reading), ticker=_progress
    )
    text = json.dumps(dataclasses.asdict(done), indent=2) if as_json else _sentence(done)
    click.echo(text, err=str(output) == "-")
    if done.lost:
        raise DataLost(done.lost, where=str(source), hint="see 'avsreplay doctor'")


def _reading(flags: dict[str, Any]) -> SourceOptions | None:
    """The options for recorded sources, None if none was given."""
    return read_options(flags) if any(value is not None for value in flags.values()) else None


def _sentence(done: Recorded) -> str:
    lines = [
        (
            f"{done.path}: {done.scans} scans, {done.span_s:.1f} s, {done.points} points,"
            f" {done.bytes} bytes"
        ),
        f"model: {done.model or 'none'}" + (f", seed {done.seed}" if done.seed is not None else ""),
    ]
    lines += [
        f"fault: {kind} from {start:.1f} s to {end:.1f} s, its scans are"
        f" {'unusable' if harmful else 'usable'}"
        for kind, start, end, harmful in done.faults
    ]
    return "\n".join([*lines, f"note: {done.note}"] if done.note else lines)


@contextmanager
def _progress(scans: Iterable[Scan], due: int) -> Iterator[Iterator[Scan]]:
    yield tracked(scans, due, "recording")


EXPORT_EPILOG = """\b
Examples:
  avsreplay export results/ -o rows.csv
  avsreplay export results/ -o rows.parquet              (needs the extra 'report')
  avsreplay export results/ -o estimate.tum
  avsreplay export results/ --to kitti -o estimate.txt --poses registration"""

FORMATS = {  # endings that a file may have; all but .txt select the format
    "csv": (".csv", ".txt"),
    "parquet": (".parquet", ".pq"),
    "tum": (".tum", ".txt"),
    "kitti": (".kitti", ".txt"),
}


def _format_of(output: Path, kind: str | None) -> str:
    """The format of an export: as requested, or that of the name of the file.

    Raises UsageError if the name states no format and none is requested, or another one than the
    requested one.
    """
    if kind is None:
        ending = output.suffix.lower().replace(".txt", "")
        kind = next((name for name, endings in FORMATS.items() if ending in endings), None)
    if kind is None:
        known = ", ".join(FORMATS)
        raise UsageError(
            "the name states no format", where=str(output), hint=f"add --to, one of {known}"
        )
    check_suffix(output, *FORMATS[kind])
    return kind


@click.command("export", cls=Command, epilog=EXPORT_EPILOG)
@click.argument("result", type=PATH)
@click.option(
    "--to",
    "kind",
    type=click.Choice(list(FORMATS)),
    help="Format of the file; that of its name by default.",
)
@click.option(
    "--poses",
    type=click.Choice(["estimate", "registration", "truth"]),
    default="estimate",
    show_default=True,
    help="Which poses go into a trajectory (tum, kitti).",
)
@click.option("-o", "--output", type=PATH, required=True, help="The file to write.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
def export_command(
    result: Path, kind: str | None, poses: str, output: Path, overwrite: bool
) -> None:
    """Write RESULT, a directory made by 'avsreplay run -o', as CSV, Parquet, TUM or KITTI at full
    precision.

    CSV and Parquet hold every column of every scan with units in the headings; TUM and KITTI hold
    poses of {C} in {A}.

    \f
    Raises:
        UsageError: the output cannot be written, its name states no or another format, or the
            result has no poses of the requested kind.
        UnreadableInput: RESULT cannot be read.
        MissingBackend: pyarrow is needed and not installed.
    """  # noqa: D301
    check_outputs("output", overwrite=overwrite)
    kind = _format_of(output, kind)
    found, quiet = read_result(result), output == STDOUT
    if kind in ("csv", "parquet"):
        (export.write_csv if kind == "csv" else export.write_parquet)(output, found.rows)
        click.echo(f"{output}: {len(found.rows)} rows", err=quiet)
        return
    truth = dict(found.poses)
    by_row = [
        truth.get(row.t_ns) if poses == "truth" else export.row_pose(row, poses)  # type: ignore[arg-type]
        for row in found.rows
    ]
    count = sum(pose is not None for pose in by_row)
    if not count:
        raise UsageError(
            f"the result has no {poses} poses", where=str(result), hint="choose others with --poses"
        )
    if kind == "tum":
        stamped = found.poses if poses == "truth" else export.row_poses(found.rows, poses)  # type: ignore[arg-type]
        click.echo(f"{output}: {export.write_tum(output, stamped)} poses", err=quiet)
        return
    export.write_kitti(output, (pose for pose in by_row if pose is not None))
    missing = len(by_row) - count
    left = f"; {missing} scans without a pose are left out, --to tum has the times"
    click.echo(f"{output}: {count} lines, one per pose{left if missing else ''}", err=quiet)


REPORT_EPILOG = """\b
Examples:
  avsreplay run tumble.mcap -o results/ --report
  avsreplay report results/ -o report.html
  avsreplay report results/rows.jsonl -o report.html     charts only, no 3D scan

\b
Exit codes: 0 ok, 2 usage, 3 unreadable input."""


@click.command("report", cls=Command, epilog=REPORT_EPILOG)
@click.argument("result", type=PATH)
@click.option(
    "-o",
    "--output",
    type=PATH,
    help="Write the page to this file; report.html in RESULT by default.",
)
@click.option("--title", help="Title of the page; the name of RESULT by default.")
@click.option("--overwrite", is_flag=True, help="Replace an existing page.")
def report_command(result: Path, output: Path | None, title: str | None, overwrite: bool) -> None:
    """Build one self-contained HTML page of RESULT, a directory written by 'avsreplay run -o'.

    The page needs no network and opens from disk: linked charts over time, a 3D view with a time
    slider, tables, and the effective configuration.
    """
    page = output or (result if result.is_dir() else result.parent) / "report.html"
    check_output(page, overwrite=overwrite, inputs=[result])
    check_suffix(page, *HTML)
    click.echo(write_page(result, page, title), err=page == STDOUT)


def write_page(result: Path, target: Path, title: str | None = None) -> str:
    """Write the page of a result.

    Args:
        result: Result directory of a run or its rows.jsonl.
        target: HTML file to write.
        title: Title of the page; the name of the result if None.

    Returns:
        One line with the file and its size.

    Raises:
        UnreadableInput: The result cannot be read or has no rows.
    """
    from avsreplay.files import output_text
    from avsreplay.report.page import build_page

    found = read_result(result)
    page = build_page(
        found.rows,
        found.summary,
        found.header,
        title=title or found.name,
        truth=found.truth,
        poses=found.poses,
        view=found.view,
    )
    with output_text(target) as stream:
        stream.write(page)
    return f"{target} ({len(page) / 1e6:.2f} MB)"
