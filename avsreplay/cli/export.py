"""``avsreplay export`` and ``avsreplay report``: a saved result in formats of other tools, and as an HTML page."""

from __future__ import annotations

from pathlib import Path

import click

from avsreplay.cli.options import PATH, read_result
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.files import STDOUT, check_output
from avsreplay.report import export

EPILOG = """\b
Examples:
  avsreplay export results/ --to csv -o rows.csv
  avsreplay export results/ --to parquet -o rows.parquet       (needs the extra 'report')
  avsreplay export results/ --to kitti -o estimate.txt --poses registration"""

POSE_FORMATS = ("tum", "kitti")


@click.command("export", epilog=EPILOG)
@click.argument("result", type=PATH)
@click.option(
    "--to", "kind", type=click.Choice(["csv", "parquet", *POSE_FORMATS]), required=True, help="Format of the file."
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
def export_command(result: Path, kind: str, poses: str, output: Path, overwrite: bool) -> None:
    """Write RESULT, a directory made by 'avsreplay run -o', as CSV, Parquet, TUM or KITTI at full precision.

    CSV and Parquet hold every column of every scan with units in the headings; TUM and KITTI hold poses of {C} in {A}.

    \f
    Raises:
        UsageError: the output cannot be written, or the result has no poses of the requested kind.
        UnreadableInput: RESULT cannot be read.
        MissingBackend: pyarrow is needed and not installed.
    """  # noqa: D301
    check_output(output, overwrite=overwrite)
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
        raise UsageError(f"the result has no {poses} poses", where=str(result), hint="choose others with --poses")
    if kind == "tum":
        stamped = found.poses if poses == "truth" else export.row_poses(found.rows, poses)  # type: ignore[arg-type]
        click.echo(f"{output}: {export.write_tum(output, stamped)} poses", err=quiet)
        return
    export.write_kitti(output, by_row)
    missing = len(by_row) - count
    note = f"; {missing} scans without a pose are lines of nan" if missing else ""
    click.echo(f"{output}: {len(by_row)} lines, one per scan{note}", err=quiet)


REPORT_EPILOG = """\b
Examples:
  avsreplay run tumble.mcap -o results/ --report
  avsreplay report results/ -o report.html
  avsreplay report results/rows.jsonl -o report.html     charts only, no 3D scan

\b
Exit codes: 0 ok, 2 usage, 3 unreadable input."""


@click.command("report", epilog=REPORT_EPILOG)
@click.argument("result", type=PATH)
@click.option("-o", "--output", type=PATH, help="Write the page to this file; report.html in RESULT by default.")
@click.option("--title", help="Title of the page; the name of RESULT by default.")
@click.option("--overwrite", is_flag=True, help="Replace an existing page.")
def report_command(result: Path, output: Path | None, title: str | None, overwrite: bool) -> None:
    """Build one self-contained HTML page of RESULT, a directory written by 'avsreplay run -o'.

    The page needs no network and opens from disk: linked charts over time, a 3D view with a time slider, tables, and
    the effective configuration.
    """
    page = output or (result if result.is_dir() else result.parent) / "report.html"
    check_output(page, overwrite=overwrite)
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
        UnreadableInput: The result cannot be read or holds no row.
    """
    from avsreplay.files import output_text
    from avsreplay.report.page import build_page

    found = read_result(result)
    if not found.rows:
        raise UnreadableInput("holds no row", where=str(result), hint="name the result of a run with at least one scan")
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
