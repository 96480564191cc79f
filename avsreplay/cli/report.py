"""``avsreplay report``: the HTML page of a saved result."""

from __future__ import annotations

from pathlib import Path

import click

__all__ = ["command"]

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
    from avsreplay.errors import UsageError
    from avsreplay.report import load_result
    from avsreplay.report.atomic import atomic_text
    from avsreplay.report.page import build_page

    target = output or (result if result.is_dir() else result.parent) / "report.html"
    if target.exists() and not overwrite:
        raise UsageError("is already there", where=str(target), hint="name another with -o, or add --overwrite")
    found = load_result(result)
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
    click.echo(f"{target} ({len(page) / 1e6:.2f} MB)")
