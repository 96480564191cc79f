"""``avsreplay report``: the HTML page of a saved result, and its rows and poses in other formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click

from avsreplay.errors import UnreadableInput, UsageError

__all__ = ["command", "write_page"]

EPILOG = """\b
Examples:
  avsreplay run tumble.mcap -o results/ --report
  avsreplay report results/ -o report.html
  avsreplay report results/rows.jsonl -o report.html     charts only, no 3D scan
  avsreplay report results/ --csv rows.csv --kitti poses.txt

\b
Exit codes: 0 ok, 2 usage, 3 unreadable input."""


@click.command("report", epilog=EPILOG)
@click.argument("result", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The page; report.html in RESULT by default.")
@click.option("--title", help="What the run is called; the name of RESULT by default.")
@click.option("--csv", type=click.Path(path_type=Path), help="Write all columns as CSV.")
@click.option("--parquet", type=click.Path(path_type=Path), help="Write all columns as Parquet (extra 'report').")
@click.option("--tum", type=click.Path(path_type=Path), help="Write the estimated poses in TUM's format.")
@click.option("--kitti", type=click.Path(path_type=Path), help="Write the estimated poses in KITTI's format.")
@click.option("--overwrite", is_flag=True, help="Replace existing files.")
def command(result: Path, output: Path | None, title: str | None, overwrite: bool, **exports: Path | None) -> None:
    """Build one self-contained HTML page of RESULT, a directory written by 'avsreplay run -o'.

    The page needs no network and opens from disk: charts on one linked time axis, a 3D view with a time slider, faults
    with jump-to, the effective configuration. With an export and no -o only the exports are written.
    """
    wanted = {name: path for name, path in exports.items() if path is not None}
    page = output or (None if wanted else (result if result.is_dir() else result.parent) / "report.html")
    for path in (*wanted.values(), *([page] if page else [])):
        if path.exists() and not overwrite:
            raise UsageError("is already there", where=str(path), hint="name another, or add --overwrite")
    _export(result, wanted)
    if page:
        click.echo(write_page(result, page, title))


def _export(result: Path, wanted: dict[str, Path]) -> None:
    from avsreplay import report

    if not wanted:
        return
    rows = report.load_result(result).rows
    writers: dict[str, Callable[[Path], object]] = {
        "csv": lambda path: report.write_csv(path, rows),
        "parquet": lambda path: report.write_parquet(path, rows),
        "tum": lambda path: report.write_tum(path, report.row_poses(rows, "estimate")),
        "kitti": lambda path: report.write_kitti(path, report.row_poses(rows, "estimate")),
    }
    for name, path in wanted.items():
        writers[name](path)
        click.echo(str(path))


def write_page(result: Path, target: Path, title: str | None = None) -> str:
    """Build the page of ``result``, write it to ``target`` whole or not at all, and say so in one line."""
    from avsreplay.report import load_result
    from avsreplay.report.atomic import atomic_text
    from avsreplay.report.page import build_page

    found = load_result(result)
    if not found.rows:
        raise UnreadableInput("holds no row", where=str(result), hint="name a result of a run that saw scans")
    page = build_page(
        found.rows,
        found.summary,
        found.header,
        title=title or found.name,
        truth=found.truth,
        poses=found.poses,
        view=found.view,
    )
    with atomic_text(target) as stream:
        stream.write(page)
    return f"{target} ({len(page) / 1e6:.2f} MB)"
