"""``avsreplay report``: writes the HTML page of a saved result."""

from __future__ import annotations

from pathlib import Path

import click

from avsreplay.cli.options import PATH, read_result
from avsreplay.errors import UnreadableInput
from avsreplay.files import STDOUT, check_output

REPORT_EPILOG = """\b
Examples:
  avsreplay run tumble.mcap -o results/ --report
  avsreplay report results/ -o report.html
  avsreplay report results/rows.jsonl -o report.html     charts only, no 3D scan

\b
Exit codes: 0 ok, 2 usage, 3 unreadable input."""


@click.command("report", epilog=REPORT_EPILOG)
@click.argument("result", type=PATH)
@click.option("-o", "--output", type=PATH, help="The page; report.html in RESULT by default.")
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
