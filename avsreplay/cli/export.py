"""``avsreplay export``: writes a saved result in formats that other tools open."""

from __future__ import annotations

from pathlib import Path

import click

from avsreplay.cli.options import PATH
from avsreplay.errors import UsageError
from avsreplay.report import export
from avsreplay.report.result import load_result

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
def command(result: Path, kind: str, poses: str, output: Path, overwrite: bool) -> None:
    """Write RESULT, a directory made by 'avsreplay run -o', as CSV, Parquet, TUM or KITTI at full precision.

    CSV and Parquet hold every column of every scan with units in the headings; TUM and KITTI hold poses of {C} in {A}.
    """
    if output.exists() and not overwrite:
        raise UsageError("already exists", where=str(output), hint="choose another name, or add --overwrite")
    found = load_result(result)
    if kind == "csv":
        export.write_csv(output, found.rows)
        click.echo(f"{output}: {len(found.rows)} rows")
        return
    if kind == "parquet":
        export.write_parquet(output, found.rows)
        click.echo(f"{output}: {len(found.rows)} rows")
        return
    trajectory = found.poses if poses == "truth" else export.row_poses(found.rows, poses)  # type: ignore[arg-type]
    count = (export.write_tum if kind == "tum" else export.write_kitti)(output, trajectory)
    if not count:
        output.unlink()
        raise UsageError(f"the result has no {poses} poses", where=str(result), hint="choose others with --poses")
    click.echo(f"{output}: {count} poses")
