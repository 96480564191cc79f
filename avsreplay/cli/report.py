"""``avsreplay report``: the HTML page of a saved result, and its rows and poses in other formats."""

from __future__ import annotations

from pathlib import Path

import click

from avsreplay.errors import UnreadableInput, UsageError

EPILOG = """\b
Examples:
  avsreplay run tumble.mcap -o results/ --report
  avsreplay report results/ -o report.html
  avsreplay report results/rows.jsonl -o report.html     charts only, no 3D scan

\b
Exit codes: 0 ok, 2 usage, 3 unreadable input."""


@click.command("report", epilog=EPILOG)
@click.argument("result", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The page; report.html in RESULT by default.")
@click.option("--title", help="What the run is called; the name of RESULT by default.")
@click.option("--overwrite", is_flag=True, help="Replace an existing page.")
def command(result: Path, output: Path | None, title: str | None, overwrite: bool) -> None:
    """Build one self-contained HTML page of RESULT, a directory written by 'avsreplay run -o'.

    The page needs no network and opens from disk: charts on one linked time axis, a 3D view with a time slider, faults
    with jump-to, the effective configuration.
    """
    page = output or (result if result.is_dir() else result.parent) / "report.html"
    if page.exists() and not overwrite:
        raise UsageError("is already there", where=str(page), hint="name another, or add --overwrite")
    click.echo(write_page(result, page, title))


def write_page(result: Path, target: Path, title: str | None = None) -> str:
    """Build the page of ``result``, write it to ``target`` whole or not at all, and say so in one line."""
    from avsreplay.report.atomic import atomic_text
    from avsreplay.report.page import build_page
    from avsreplay.report.result import load_result

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
