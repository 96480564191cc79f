"""Options that stand for settings: help, unit and choices come from the declaration, which is imported when needed.

``run_settings`` adds the settings of a run to a command. Their environment variables are the same for every command
that has them, so that ``config`` prints what ``run`` uses.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

if TYPE_CHECKING:
    from avsreplay.settings import Entry

F = TypeVar("F", bound=Callable[..., Any])
CONFIG = "avsreplay.config:RunConfig"
ASSIGNED = {
    "backend": "register.backend",
    "policy": "faults.policy",
    "guess": "guess",
    "init": "init",
    "reference": "reference",
}


def declared(owner: str, key: str) -> Entry:
    """The declaration of a setting: ``owner`` is ``module:class``, ``key`` its dotted key."""
    from avsreplay.settings import entries

    module, _, name = owner.partition(":")
    cls = getattr(importlib.import_module(module), name)
    return next(entry for entry in entries(cls) if entry.key == key)


class _Choice(click.ParamType[str]):
    """One of the values of a setting that is an enumeration; any text for another setting."""

    name = "text"

    def __init__(self, owner: str, key: str) -> None:
        self.owner, self.key = owner, key

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        choices = declared(self.owner, self.key).choices
        if choices and value not in choices:
            self.fail(f"'{value}' is not one of {', '.join(choices)}", param, ctx)
        return str(value)

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str | None:  # noqa: ARG002 (click names them)
        choices = declared(self.owner, self.key).choices
        return f"[{'|'.join(choices)}]" if choices else None

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG002 (click names them)
        choices = declared(self.owner, self.key).choices
        return [CompletionItem(choice) for choice in choices if choice.startswith(incomplete)]


class SettingOption(click.Option):
    """An option for one setting. ``owner`` is ``module:class``; ``key`` is the parameter's name where not given."""

    def __init__(self, names: list[str], owner: str = CONFIG, key: str = "", **more: Any) -> None:
        super().__init__(names, **more)
        self.owner, self.key = owner, key or str(self.name)
        if more.get("type") is None and not self.is_flag:
            self.type = _Choice(self.owner, self.key)

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Option and help text, from the declaration."""
        setting = declared(self.owner, self.key).declared
        notes = [setting.unit and f"[{setting.unit}]", setting.automatic and f"(default: {setting.automatic})"]
        self.help = " ".join(part for part in (setting.doc.removesuffix("."), *notes) if part) + "."
        return super().get_help_record(ctx)


def setting_option(*names: str, **more: Any) -> Callable[[F], F]:
    """Decorator: an option for one setting, see SettingOption."""
    return click.option(*names, cls=SettingOption, **more)


def source_setting(*names: str, **more: Any) -> Callable[[F], F]:
    """Decorator: an option for one setting of how a source is read."""
    if "is_flag" in more:
        more.setdefault("default", None)
    return setting_option(*names, owner="avsreplay.log:SourceOptions", **more)


def _variable(name: str) -> str:
    return f"AVSREPLAY_RUN_{name.upper()}"


def robot_option(**more: Any) -> Callable[[F], F]:
    """Decorator: the option for a robot file."""
    file = click.Path(path_type=Path)
    return click.option("--robot", "robot_file", type=file, help="TOML file with a table [robot].", **more)


def run_settings(command: F) -> F:
    """Add the settings of a run to a command: one option each for the frequent ones, ``--config`` and ``--set``."""
    options = [
        setting_option(
            f"--{name}", key=key, envvar=_variable(name), metavar="log|truth|auto|POSE" if name == "init" else None
        )
        for name, key in ASSIGNED.items()
    ]
    file = click.Path(path_type=Path)
    options += [
        click.option("--no-deskew", is_flag=True, envvar=_variable("no_deskew"), help="Do not deskew scans."),
        click.option(
            "--config",
            "config_file",
            type=file,
            envvar=_variable("config"),
            help="TOML file as 'avsreplay config' prints.",
        ),
        robot_option(envvar=_variable("robot")),
        click.option(
            "--set",
            "assignments",
            multiple=True,
            metavar="A.B=VALUE",
            envvar=_variable("set"),
            help="One setting by its key, see 'avsreplay config'; may be repeated.",
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def take_run_settings(flags: dict[str, Any]) -> tuple[Path | None, tuple[str, ...]]:
    """Take the options of ``run_settings`` out of ``flags``: the configuration file and ``a.b=value`` assignments.

    Options come after environment variables, so that they take precedence.
    """
    context = click.get_current_context()
    by_source: dict[bool, list[str]] = {False: [], True: []}

    def put(name: str, assignments: list[str]) -> None:
        by_source[context.get_parameter_source(name) is ParameterSource.COMMANDLINE].extend(assignments)

    robot_file = flags.pop("robot_file")
    if robot_file is not None:
        from avsreplay.config import robot_settings

        put("robot_file", list(robot_settings(robot_file)))
    put("assignments", list(flags.pop("assignments")))
    put("no_deskew", ["deskew=false"] if flags.pop("no_deskew") else [])
    for name, key in ASSIGNED.items():
        value = flags.pop(name)
        put(name, [] if value is None else [f"{key}={value}"])
    return flags.pop("config_file"), (*by_source[False], *by_source[True])
