"""``avsreplay estimators``: the estimators that are installed, and their laws on one of them."""

from __future__ import annotations

import click

from avsreplay.cli.backends import print_json, print_plain_table, report_laws
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
    if name is not None:
        from avsreplay.estimate.contract import check

        report_laws("estimator", name, check(name), as_json)
        return
    from avsreplay.parts import ESTIMATORS

    rows = [{"estimator": each, "description": _about(each)} for each in sorted(ESTIMATORS.names())]
    if as_json:
        print_json(rows)
    else:
        print_plain_table("Estimators", ("name", "description"), (r.values() for r in rows))


def _about(name: str) -> str:
    from avsreplay.parts import ESTIMATORS

    try:
        return str(getattr(ESTIMATORS.load(name), "about", ""))
    except ImportError as error:
        return f"cannot be imported: {error}"
