"""``avsreplay backends``: what is installed, what is not and how to get it."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from rich.table import Table

    from avsreplay.register.port import Availability

__all__ = ["command"]


@click.command("backends")
@click.option("--json", "as_json", is_flag=True, help="One JSON document on stdout.")
def command(as_json: bool) -> None:
    """List the registration back ends: what is installed, and how to get what is not."""
    from avsreplay.register.port import available

    states = available()
    if as_json:
        click.echo(json.dumps([dataclasses.asdict(state) for state in states], indent=2))
        return
    from rich.console import Console

    Console(width=120).print(_table(states))


def _table(states: tuple[Availability, ...]) -> Table:
    from rich.table import Table

    table = Table("name", "installed", "version", "what it is", "how to get it")
    for state in states:
        table.add_row(state.name, "yes" if state.installed else "no", state.version, state.about, state.get)
    return table
