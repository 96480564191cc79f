"""``avsreplay config``, and the settings of a run as options of other commands."""

from __future__ import annotations

import importlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from avsreplay.errors import UsageError

if TYPE_CHECKING:
    from avsreplay.settings import Entry

F = TypeVar("F", bound=Callable[..., Any])
CONFIG = "avsreplay.config:RunConfig"
SOURCE = "avsreplay.log.options:SourceOptions"
# names of parameters that are settings of a run, besides those that have an option of their own
METHOD = {"no_deskew", "config_file", "robot_file", "task_file", "assignments", "paper", "init"}
RARE = ("policy", "guess", "reference")  # of ASSIGNED: not in the short help
ASSIGNED = {
    "backend": "register.backend",
    "estimator": "estimator.method",
    "start_mode": "estimator.start",
    "policy": "faults.policy",
    "guess": "guess",
    "init": "init",
    "region": "region",
    "reference": "reference",
}


def declared(owner: str, key: str) -> Entry:
    """Return the declaration of a setting.

    Args:
        owner: class that declares it, as ``module:class``.
        key: its dotted key.
    """
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

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002 (click names it)
        param: click.Parameter,  # noqa: ARG002 (click names it)
        incomplete: str,
    ) -> list[CompletionItem]:
        choices = declared(self.owner, self.key).choices
        return [CompletionItem(choice) for choice in choices if choice.startswith(incomplete)]


class SettingOption(click.Option):
    """An option for one setting.

    Attributes:
        owner: class that declares the setting, as ``module:class``.
        key: its dotted key; the parameter's name where not given.
        common: whether the short help of a command lists it.
    """

    def __init__(
        self,
        names: list[str],
        owner: str = CONFIG,
        key: str = "",
        *,
        common: bool = True,
        **more: Any,
    ) -> None:
        super().__init__(names, **more)
        self.owner, self.key, self.common = owner, key or str(self.name), common
        if more.get("type") is None and not self.is_flag:
            self.type = _Choice(self.owner, self.key)

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Option and help text, from the declaration."""
        setting = declared(self.owner, self.key).declared
        notes = [
            setting.unit and f"[{setting.unit}]",
            setting.automatic and f"(default: {setting.automatic})",
        ]
        self.help = " ".join(part for part in (setting.doc.removesuffix("."), *notes) if part) + "."
        return super().get_help_record(ctx)


def _print_full_help(ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    if not wanted or ctx.resilient_parsing:
        return
    ctx.meta[_FULL] = True
    click.echo(ctx.get_help(), color=ctx.color)
    ctx.exit()


_FULL = "avsreplay.full_help"  # in the meta of a context: print every option in full
_CLAUSE = re.compile(r"[.:;] | \(")  # where the first clause of a description ends


class Command(click.Command):
    """A command whose help lists the settings of a run, and those of the input, apart from its
    other options.

    The short help has the first clause of each description and the most common settings;
    ``--help-all`` has everything.
    """

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        if any(map(_is_rare, self.params)):
            full = click.Option(
                ["--help-all"],
                is_flag=True,
                is_eager=True,
                expose_value=False,
                callback=_print_full_help,
                help="Show every option in full.",
            )
            self.params.append(full)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments; one that is too much is an error that names the option for it."""
        ctx.allow_extra_args = True
        left = []
        try:
            left = super().parse_args(ctx, list(args))
        except click.MissingParameter:
            left = self.make_parser(ctx).parse_args(list(args))[1]
            if not left:
                raise
        if left and not ctx.resilient_parsing:
            what = f"the argument '{left[0]}' is one too many"
            raise UsageError(what, where=ctx.info_name, hint=self._place_of(left[0], ctx))
        return left

    def _place_of(self, extra: str, ctx: click.Context) -> str:
        options = {name for param in self.params for name in param.opts}
        if "=" in extra and "--set" in options:
            return f"change a setting with --set {extra}"
        if "-o" in options and ctx.params.get("output") is None:
            return f"name the output with -o {extra}"
        return f"see '{ctx.command_path} --help'"

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, each under the heading of its section."""
        full = ctx.meta.get(_FULL, False)
        sections: dict[str, list[tuple[str, str]]] = {"Options": [], "Method": [], "Input": []}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is None or not isinstance(param, click.Option):
                continue
            if full or not (_is_rare(param) or param.name == "help_all"):
                text = record[1] if full else _CLAUSE.split(record[1])[0].removesuffix(".")
                sections[_section(param)].append((record[0], text))
        rare = 0 if full else sum(map(_is_rare, self.params))
        if rare:
            last = next(title for title in reversed(sections) if sections[title])
            sections[last].append(("--help-all", f"{rare} more options, and all in full"))
        for title, records in sections.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


def _is_rare(param: click.Parameter) -> bool:
    return not getattr(param, "common", True)


def _section(param: click.Parameter) -> str:
    if isinstance(param, SettingOption) and param.owner == SOURCE:
        return "Input"
    method = isinstance(param, SettingOption) or param.name in METHOD
    return "Method" if method else "Options"


def setting_option(*names: str, **more: Any) -> Callable[[F], F]:
    """Decorator: an option for one setting, see SettingOption."""
    return click.option(*names, cls=SettingOption, **more)


def source_setting(*names: str, **more: Any) -> Callable[[F], F]:
    """Decorator: an option for one setting of how a source is read, by default a rare one."""
    more.setdefault("common", False)
    if "is_flag" in more:
        more.setdefault("default", None)
    return setting_option(*names, owner=SOURCE, **more)


def _variable(name: str) -> str:
    return f"AVSREPLAY_RUN_{name.upper()}"


def robot_option(**more: Any) -> Callable[[F], F]:
    """Decorator: the option for a robot file."""
    file = click.Path(path_type=Path)
    return click.option(
        "--robot",
        "robot_file",
        type=file,
        help="TOML file with a table [robot].",
        **more,
    )


def run_settings(command: F) -> F:
    """Add the settings of a run to a command: one option each for the frequent ones,
    ``--config`` and ``--set``.
    """
    options = [
        setting_option(
            f"--{name.replace('_', '-')}",
            key=key,
            envvar=_variable(name),
            metavar={"init": "log|truth|auto|POSE", "region": "X,Y,Z"}.get(name),
            common=name not in RARE,
        )
        for name, key in ASSIGNED.items()
    ]
    file = click.Path(path_type=Path)
    options += [
        click.option(
            "--no-deskew",
            is_flag=True,
            envvar=_variable("no_deskew"),
            help="Do not move points to one instant: the motion while a scan is taken is ignored.",
        ),
        click.option(
            "--config",
            "config_file",
            type=file,
            envvar=_variable("config"),
            help="TOML file with settings: the form that 'avsreplay config' prints.",
        ),
        robot_option(envvar=_variable("robot")),
        click.option(
            "--task",
            "task_file",
            type=file,
            envvar=_variable("task"),
            help="TOML file with a table [task]: what is grasped, and perhaps a table [robot].",
        ),
        click.option(
            "--set",
            "assignments",
            multiple=True,
            metavar="A.B=VALUE",
            envvar=_variable("set"),
            help="Change one setting; 'avsreplay config' lists the keys. May be repeated.",
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def take_run_settings(flags: dict[str, Any]) -> tuple[Path | None, tuple[str, ...]]:
    """Take the options of ``run_settings`` out of ``flags``: the configuration file and
    ``a.b=value`` assignments.

    Options come after environment variables, so that they take precedence. An error in a value
    names what gave it.
    """
    from avsreplay.toml_document import Assignment, toml_value

    context = click.get_current_context()
    by_source: dict[bool, list[str]] = {False: [], True: []}

    def put(name: str, assignments: list[str], option: str = "", value: object = "") -> None:
        typed = context.get_parameter_source(name) is ParameterSource.COMMANDLINE
        variable = _variable(option[2:].replace("-", "_"))
        given = f"{option} {value}".rstrip() if typed else f"environment {variable}={value or 1}"
        by_source[typed] += (
            [Assignment(text, given) for text in assignments] if option else assignments
        )

    robot_file = flags.pop("robot_file")
    if robot_file is not None:
        from avsreplay.config import robot_settings

        put("robot_file", list(robot_settings(robot_file)), "--robot", robot_file)
    task_file = flags.pop("task_file")
    if task_file is not None:
        from avsreplay.config import task_settings

        put("task_file", list(task_settings(task_file)), "--task", task_file)
    put("assignments", list(flags.pop("assignments")))
    put("no_deskew", ["deskew=false"] if flags.pop("no_deskew") else [], "--no-deskew")
    for name, key in ASSIGNED.items():
        value, option = flags.pop(name), f"--{name.replace('_', '-')}"
        put(name, [] if value is None else [f"{key}={toml_value(value)}"], option, value)
    return flags.pop("config_file"), (*by_source[False], *by_source[True])


EPILOG = """\b
Examples:
  avsreplay config > run.toml                  then: avsreplay run LOG --config run.toml
  avsreplay config tumble.mcap --policy all    with the settings in the log itself
  avsreplay config --json --set plan.a_max_mps2=0.02"""

INTRODUCTION = """# Which settings are there?

Most runs need none: lengths scale with the *extent* of the target, the diagonal of the bounding box
of its model. These are the ones that people use; all others follow, table by table.

{frequent}

Settings of a run are given, in order of precedence, by an option (`--set register.gate_m=0.2`), an
environment variable (`AVSREPLAY_RUN_SET="register.gate_m=0.2 deskew=false"`), the `--config` file,
or the log's own `[run]` table. `avsreplay config` prints the effective configuration as a file that
`--config` reads. A value outside its range or an unknown key is an error with file and line.
`avsreplay config --markdown` makes this page from the declarations in the code.
"""

FREQUENT_OPTIONS = {
    "topic": "choose the clouds of a bag with several",
    "model": "replay against this CAD file",
    "model_unit": "state the unit of the model",
    "crop_range": "remove a wall behind the target",
    "fixed_frame": "transform the clouds of a moving camera",
    "truth_topic": "compute errors against true poses",
    "grasp": "grasp another point than the origin of the model",
    "n_scans": "replay the first scans only",
    "init": "begin at a given pose, or search for it",
    "region": "follow a target that approaches",
    "register.backend": "use another registration method",
    "register.gate_m": "use a model that is less accurate than 1 % of its extent",
    "estimator.start": "begin without, or with a given, state of motion",
    "estimator.force_noise_mps15": "state that forces of known size act",
    "faults.policy": "use the fault rule as printed in the paper",
    "faults.rms_max_m": "accept noisier scans",
    "task.position_m": "state how precise a capture must be",
    "robot.accel_max_mps2": "state what the robot can do",
    "limits.final_deg": "approach through a corridor",
    "limits.clearance_m": "keep clear of the target",
    "plan.enabled": "tune registration or estimation without plans, in about half of the time",
}  # key of a setting of a run or of reading a log: what it is used for

SECTIONS = (
    (
        "Run",
        "Keys of `--config` and `--set`. `avsreplay plan` takes those of `[limits]` as options.",
        "avsreplay.config:RunConfig",
    ),
    (
        "Reading a log",
        "Options of `avsreplay run`, `info` and `record`, with dashes: `--model-unit mm`;"
        " `run --help-all` lists them.",
        "avsreplay.log.options:SourceOptions",
    ),
    (
        "Scenario",
        "A scenario file, see [Scenarios](scenario.md).",
        "avsreplay.simulate.scenario:ScenarioParams",
    ),
    (
        "Campaign",
        "A campaign file, see [Campaigns](sweep.md).",
        "avsreplay.sweep.campaign:Campaign",
    ),
    (
        "Gate",
        "A file of rules for `avsreplay compare --gate`, see [CI](ci.md).",
        "avsreplay.report.gate:GateRules",
    ),
)


@click.command("config", cls=Command, epilog=EPILOG)
@click.argument("log", type=click.Path(path_type=Path), required=False)
@run_settings
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
@click.option("--markdown", is_flag=True, help="Print the reference page of all settings.")
def config_command(log: Path | None, as_json: bool, markdown: bool, **flags: Any) -> None:
    """Print the effective settings of a run as a TOML file that 'avsreplay run --config' reads.

    With LOG, the log's own [run] table is included. An option takes precedence over an environment
    variable (AVSREPLAY_RUN_...), that over the --config file, that over the log's own table, and
    that over the default.
    """
    from avsreplay import settings, toml_document
    from avsreplay.config import load_config

    file, assignments = take_run_settings(flags)
    if markdown:
        click.echo(reference_page(), nl=False)
        return
    config = load_config(file, _own_table(log) if log else {}, assignments, log and log.parent)
    if as_json:
        click.echo(json.dumps(settings.dump(config), indent=1))
    else:
        click.echo(
            toml_document.to_toml(config, "Settings of 'avsreplay run', to be read with --config"),
            nl=False,
        )


def _own_table(log: Path) -> Mapping[str, Any]:
    from avsreplay import toml_document
    from avsreplay.log import SourceOptions, open_source

    with open_source(log, SourceOptions()) as source:
        return toml_document.own_settings(source.header.scenario, str(log))


def reference_page() -> str:
    """The text of docs/settings.md."""
    found = {entry.key: entry for _, _, owner in SECTIONS[:2] for entry in _entries(owner)}
    lines = ["| to | setting | default |", "|---|---|---|"]
    lines += [
        f"| {purpose} | `{key}` | {_default(found[key])} |"
        for key, purpose in FREQUENT_OPTIONS.items()
    ]
    introduction = INTRODUCTION.replace("{frequent}", "\n".join(lines))
    return "\n".join([introduction, *_page()]).rstrip("\n") + "\n"


def _entries(owner: str) -> list[Entry]:
    import importlib

    from avsreplay.settings import entries

    module, _, name = owner.partition(":")
    return list(entries(getattr(importlib.import_module(module), name)))


def _page() -> Iterator[str]:
    for title, introduction, owner in SECTIONS:
        yield f"## {title}\n\n{introduction}\n"
        tables: dict[str, list[Entry]] = {}
        for entry in _entries(owner):
            tables.setdefault(entry.key.rpartition(".")[0], []).append(entry)
        for table, rows in tables.items():
            if table:
                yield f"### [{table}]\n"
            yield "\n".join(map(_line, rows)) + "\n"


def _line(entry: Entry) -> str:
    value = ", ".join(part for part in (_default(entry), _range(entry)) if part)
    return f"- `{entry.key}` ({value}): {entry.declared.doc}"


def _default(entry: Entry) -> str:
    from dataclasses import MISSING

    from avsreplay.toml_document import toml_value

    declared = entry.declared
    if entry.default is MISSING:
        return "required"
    if entry.default is not None:
        return "`{}`" if entry.default == {} else f"`{toml_value(entry.default)}`"
    if declared.of_extent is not None:
        return f"{declared.of_extent:g} extent" + ("/s" if declared.unit == "m/s" else "")
    return declared.unset or "off"


def _range(entry: Entry) -> str:
    """The range in short, with the unit: "0 to 1", ">0 m"; names where these are the values."""
    if entry.choices:
        return "of " + "/".join(f"`{choice}`" for choice in entry.choices)
    declared = entry.declared
    lower = f">{declared.above:g}" if declared.above is not None else ""
    lower = f"≥{declared.low:g}" if declared.low is not None else lower
    upper = f"<{declared.below:g}" if declared.below is not None else ""
    upper = f"≤{declared.high:g}" if declared.high is not None else upper
    return " ".join(
        part for part in (", ".join(filter(None, (lower, upper))), declared.unit) if part
    )
