"""``avsreplay export``: writes a saved result in formats that other tools open."""

from __future__ import annotations

from pathlib import Path

import click

from avsreplay.cli.options import PATH, read_result
from avsreplay.errors import UsageError
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
@click.option("--to", "kind", type=click.Choice(["csv", "parquet", *POSE_FORMATS]), required=True, help="Format.")
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
