"""``avsreplay backends``: the registration back ends, how to install those that are missing, and their laws."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from collections.abc import Iterable

    from avsreplay.register.backend import Availability
    from avsreplay.register.contract import LawResult


EPILOG = """\b
Examples:
  avsreplay backends
  avsreplay backends --check horn

\b
"On other processors": the same bytes on every x86-64 Linux machine with the same libraries, or how far a pose can
differ: libraries that stop by their own rules may take another number of iterations. See docs/ci.md."""


@click.command("backends", epilog=EPILOG)
@click.option(
    "--check", "name", metavar="NAME", help="Check the laws of the contract on this back end; exit 1 if one fails."
)
@click.option("--json", "as_json", is_flag=True, help="One JSON document on stdout.")
def backends_command(name: str | None, as_json: bool) -> None:
    """List the registration back ends, and how to install those that are missing."""
    if name is None:
        _list(as_json)
    else:
        _check(name, as_json)


def _list(as_json: bool) -> None:
    from avsreplay.register.backend import available

    states = available()
    if as_json:
        _print_json([dataclasses.asdict(state) for state in states])
    else:
        heads = ("name", "installed", "version", "description", "on other processors", "how to install")
        _print_table("Registration back ends", heads, map(_state_row, states))


def _state_row(state: Availability) -> tuple[str, ...]:
    return state.name, "yes" if state.installed else "no", state.version, state.about, state.elsewhere, state.get


def _check(name: str, as_json: bool) -> None:
    from avsreplay.errors import CheckFailed
    from avsreplay.register.contract import check

    findings = check(name)
    if as_json:
        _print_json({"backend": name, "findings": [dataclasses.asdict(finding) for finding in findings]})
    else:
        _print_table(f"Contract of {name}", ("law", "holds", "measured"), map(_finding_row, findings))
    broken = [finding.law for finding in findings if not finding.held]
    if broken:
        raise CheckFailed(f"{len(broken)} of {len(findings)} laws broken: {'; '.join(broken)}", where=name)


def _finding_row(finding: LawResult) -> tuple[str, ...]:
    return finding.law, "yes" if finding.held else "NO", finding.detail


def _print_json(value: Any) -> None:
    click.echo(json.dumps(value, indent=2))


def _print_table(title: str, heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> None:
    from avsreplay.report.table import Table, make_console, print_table

    print_table(make_console(plain_width=120), Table(title, heads, tuple(rows), align="l"))
