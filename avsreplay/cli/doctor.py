"""``avsreplay doctor``: checks a log and writes a repaired copy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from avsreplay.log.doctor import Finding, Repaired


EPILOG = """\b
Examples:
  avsreplay doctor x.mcap
  avsreplay doctor x.mcap --repair clean.mcap"""


@click.command(name="doctor", epilog=EPILOG)
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--topic", help="The cloud topic, if there are several.")
@click.option(
    "--repair", "output", type=click.Path(path_type=Path), help="Write every intact record to this file (MCAP only)."
)
@click.option("--overwrite", is_flag=True, help="Replace an existing output.")
@click.option("--strict", is_flag=True, help="Exit with code 3 if any part is lost.")
@click.option("--json", "as_json", is_flag=True, help="Write one JSON document to stdout.")
@click.option("--max-message-mib", type=int, default=128, show_default=True, help="Largest message that is read [MiB].")
def doctor_command(
    source: Path, topic: str | None, output: Path | None, overwrite: bool, strict: bool, as_json: bool,
    max_message_mib: int,
) -> None:  # fmt: skip
    """Check SOURCE: structure, checksums, clocks, gaps, duplicates, points, layout and truth.

    The exit code is 0 if no part is lost, else 4 (3 with --strict).

    \f
    Raises:
        UsageError: an option is invalid, or the repaired file cannot be written.
        UnreadableInput: SOURCE cannot be read, or it has errors and --strict is given.
        DataLost: SOURCE has errors.
    """  # noqa: D301
    from avsreplay.errors import UsageError
    from avsreplay.log import SourceOptions
    from avsreplay.log.doctor import examine, repair

    try:
        options = SourceOptions(topic=topic, max_message_mib=max_message_mib)
    except ValueError as error:
        raise UsageError(str(error), where="--max-message-mib", hint="give a whole number of MiB") from None
    _, findings = examine(source, options)
    done = None
    if output is not None:
        done = repair(source, output, overwrite=overwrite, max_message_mib=max_message_mib)
    if as_json:
        click.echo(json.dumps(_document(source, findings, output, done), indent=2))
    else:
        _print(source, findings, output, done)
    _judge(source, findings, strict)


def _judge(source: Path, findings: list[Finding], strict: bool) -> None:
    from avsreplay.errors import DataLost, UnreadableInput
    from avsreplay.log.doctor import Severity

    errors = [f for f in findings if f.severity is Severity.ERROR]
    if errors:
        what = f"{len(errors)} error(s), the first: {errors[0].about}: {errors[0].text}"
        if strict:
            raise UnreadableInput(what, where=str(source), hint="repair it with --repair OUT")
        raise DataLost(what, where=str(source), hint="--repair OUT copies the intact records")


def _document(source: Path, findings: list[Finding], output: Path | None, done: Repaired | None) -> dict[str, Any]:
    import dataclasses

    listed = [{**dataclasses.asdict(f), "severity": f.severity.value} for f in findings]
    repaired = None if done is None else {"output": str(output), **dataclasses.asdict(done)}
    return {"source": str(source), "findings": listed, "repaired": repaired}


def _print(source: Path, findings: list[Finding], output: Path | None, done: Repaired | None) -> None:
    from avsreplay.cli.info import WIDTH
    from avsreplay.log.bytes_io import shown
    from avsreplay.report.table import Table, TableCell, make_console, print_line, print_table

    marks = {"error": "bad", "warning": "warn", "note": "", "ok": "good"}
    rows = tuple(
        (TableCell(f.severity.value, marks[f.severity.value]), f.about, shown(f.text), ", ".join(map(str, f.places)))
        for f in findings
    )
    console = make_console(plain_width=WIDTH)
    print_table(console, Table(shown(source), ("severity", "about", "finding", "at"), rows, align="l"))
    if done is not None:
        kept = f"{done.messages} messages, {done.attachments} attachments, {done.records} metadata records"
        print_line(console, shown(f"repaired: {output}: {kept}"))
        for line in done.dropped:
            print_line(console, shown(f"left out: {line}"))
