"""``avsreplay config``: the effective configuration as TOML, and the reference page of all settings."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.setting_options import run_settings, take_run_settings

if TYPE_CHECKING:
    from avsreplay.settings import Entry

EPILOG = """\b
Examples:
  avsreplay config > run.toml                  then: avsreplay run LOG --config run.toml
  avsreplay config tumble.mcap --policy all    with the settings that the log itself brings
  avsreplay config --json --set plan.a_max_mps2=0.02"""

INTRODUCTION = """# Settings

This page is generated from the declarations in the code by `avsreplay config --markdown`.

A setting without a default applies as stated in its description. The target's extent is the diagonal of the bounding
box of its model, so that the defaults suit a target of any size. A value outside its range, an unknown key or a wrong
type is an error that names the file and the line.

Settings of a run are given, in order of precedence, by an option (`--set register.gate_m=0.2`), an environment variable
(`AVSREPLAY_RUN_POLICY`, `AVSREPLAY_RUN_SET="register.gate_m=0.2 deskew=false"`), the `--config` file, or the log's own
`[run]` table. `avsreplay config` prints the effective configuration as a file that `--config` reads.
"""

SECTIONS = (
    ("Run", "Keys of `--config` and `--set`.", "avsreplay.config:RunConfig"),
    ("Reading a log", "Options of `avsreplay run`, `info` and `record`.", "avsreplay.log:SourceOptions"),
    ("Constraints of a plan", "Options of `avsreplay plan`.", "avsreplay.plan:Limits"),
    ("Scenario", "A scenario file, see [Scenarios](scenario.md).", "avsreplay.simulate.scenario:ScenarioParams"),
    ("Campaign", "A campaign file, see [Campaigns](sweep.md).", "avsreplay.sweep.campaign:Campaign"),
    ("Gate", "A file of rules for `avsreplay compare --gate`, see [CI](ci.md).", "avsreplay.report.gate:GateRules"),
)


@click.command("config", epilog=EPILOG)
@click.argument("log", type=click.Path(path_type=Path), required=False)
@run_settings
@click.option("--json", "as_json", is_flag=True, help="One JSON document on stdout and nothing else.")
@click.option("--markdown", is_flag=True, help="Print the reference page of all settings.")
def config_command(log: Path | None, as_json: bool, markdown: bool, **flags: Any) -> None:
    """Print the effective settings of a run as a TOML file that 'avsreplay run --config' reads.

    With LOG, the log's own [run] table is included. An option takes precedence over an environment variable
    (AVSREPLAY_RUN_...), that over the --config file, that over the log's own table, and that over the default.
    """
    from avsreplay import settings, toml_document
    from avsreplay.config import load_config

    file, assignments = take_run_settings(flags)
    if markdown:
        click.echo(reference_page(), nl=False)
        return
    config = load_config(file, _own_table(log) if log else {}, assignments)
    if as_json:
        click.echo(json.dumps(settings.dump(config), indent=1))
    else:
        click.echo(toml_document.to_toml(config, "Settings of 'avsreplay run', to be read with --config"), nl=False)


def _own_table(log: Path) -> dict[str, Any]:
    import tomllib

    from avsreplay.log import SourceOptions, open_source

    with open_source(log, SourceOptions()) as source:
        table: dict[str, Any] = tomllib.loads(source.header.scenario).get("run", {})
    return table


def reference_page() -> str:
    """The text of docs/settings.md."""
    return "\n".join([INTRODUCTION, *_page()]).rstrip("\n") + "\n"


def _page() -> Iterator[str]:
    import importlib

    from avsreplay.settings import entries

    for title, introduction, owner in SECTIONS:
        module, _, name = owner.partition(":")
        yield f"## {title}\n\n{introduction}\n"
        tables: dict[str, list[Entry]] = {}
        for entry in entries(getattr(importlib.import_module(module), name)):
            tables.setdefault(entry.key.rpartition(".")[0], []).append(entry)
        for table, rows in tables.items():
            if table:
                yield f"### [{table}]\n"
            yield "| setting | default | unit | range | meaning |\n|---|---|---|---|---|"
            yield "\n".join(map(_row, rows)) + "\n"


def _row(entry: Entry) -> str:
    from dataclasses import MISSING

    from avsreplay.toml_document import toml_value

    declared = entry.declared
    if entry.default is MISSING:
        default = "required"
    elif entry.default is None:
        default = declared.automatic or "off"
    else:
        default = "`{}`" if entry.default == {} else f"`{toml_value(entry.default)}`"
    limits = ", ".join(f"`{choice}`" for choice in entry.choices) or declared.range
    cells = (f"`{entry.key}`", default, declared.unit, limits, declared.doc)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
