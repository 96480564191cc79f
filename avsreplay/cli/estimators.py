"""``avsreplay estimators``: the estimators that are installed, and their laws on one of them."""

from __future__ import annotations

import dataclasses
import json

import click

from avsreplay.cli.backends import print_plain_table
from avsreplay.cli.config import Command

EPILOG = """\b
Examples:
  avsreplay estimators
  avsreplay estimators --check ekf
  avsreplay run tumble.mcap --estimator ekf"""


@click.command("estimators", cls=Command, epilog=EPILOG)
@click.option(
    "--check",
    "name",
    metavar="NAME",
    help="Run the contract tests on this estimator; exit code 1 if one fails.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
def estimators_command(name: str | None, as_json: bool) -> None:
    r"""List the estimators for 'run --estimator NAME', or check one.

    \f
    Args:
        name: estimator to check; None to list all.
        as_json: print JSON.

    Raises:
        UsageError: no estimator has this name.
        CheckFailed: it breaks a law.
    """
    if name is None:
        from avsreplay.estimate.plugin import about, names

        rows = [{"estimator": each, "description": about(each)} for each in names()]
        if as_json:
            click.echo(json.dumps(rows, indent=2))
        else:
            print_plain_table("Estimators", ("name", "description"), (r.values() for r in rows))
        return
    from avsreplay.errors import CheckFailed
    from avsreplay.estimate.contract import check

    found = check(name)
    if as_json:
        laws = [dataclasses.asdict(law) for law in found]
        click.echo(json.dumps({"estimator": name, "findings": laws}, indent=2))
    else:
        rows_of = ((law.law, "yes" if law.held else "NO", law.detail) for law in found)
        print_plain_table(f"Contract of {name}", ("law", "holds", "measured"), rows_of)
    broken = [law.law for law in found if not law.held]
    if broken:
        raise CheckFailed(
            f"{len(broken)} of {len(found)} laws broken: {'; '.join(broken)}", where=name
        )
