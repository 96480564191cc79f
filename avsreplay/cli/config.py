"""``avsreplay config``: the effective configuration, with where to change it."""

from __future__ import annotations

import json
from pathlib import Path

import click

EPILOG = """\b
Examples:
  avsreplay config --dump
  avsreplay config --dump --set faults.policy=all > run.json"""


@click.command("config", epilog=EPILOG)
@click.option("--dump", is_flag=True, help="Print every setting with its value in force, as JSON.")
@click.option("--config", "config_file", type=click.Path(path_type=Path), help="TOML with settings, a table a stage.")
@click.option("--set", "assignments", multiple=True, metavar="A.B=C", help="One setting; may be repeated.")
def command(dump: bool, config_file: Path | None, assignments: tuple[str, ...]) -> None:
    """Print the settings of a run: each stage's table, and what each is set to (null: from the model's extent).

    Flag beats environment (AVSREPLAY_RUN_...) beats --config file beats the log's own [run] table beats default.
    """
    from avsreplay import settings
    from avsreplay.config import load_config

    plain = settings.dump(load_config(config_file, {}, assignments))
    if dump:
        click.echo(json.dumps(plain, indent=1))
        return
    for name, value in plain.items():
        rows = value.items() if isinstance(value, dict) else [("", value)]
        for key, setting in rows:
            click.echo(f"{name}{'.' if key else ''}{key} = {json.dumps(setting)}")
