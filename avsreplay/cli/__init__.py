"""The command line: one file per command; no other package prints or exits.

A command is the object ``command`` in ``avsreplay/cli/<name>.py``; it is imported when it is called, so that
``avsreplay --help`` is fast.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator

import click

from avsreplay.errors import AvsError, UsageError

__all__ = ["main"]

SUMMARIES = {
    "record": "Write a log: simulate a scenario, or convert recorded scans.",
    "run": "Replay a log, print tables, compare with a golden file.",
    "info": "Show the content of a log.",
    "doctor": "Check a log for damage and repair it.",
    "backends": "List the registration back ends; run the contract tests on one.",
    "bench": "Compare the speed and error of back ends on a log.",
    "observability": "Show which states the measurements of a log determine.",
    "plan": "Plan the capture again from a saved result.",
    "report": "Build the HTML report of a saved result.",
    "export": "Write a saved result as CSV, Parquet, TUM or KITTI.",
    "compare": "Compare saved results; gate one against a baseline.",
    "sweep": "Run a campaign of many runs and summarise it.",
    "config": "Print the effective configuration.",
    "completion": "Print the completion script of a shell.",
}

EPILOG = """\b
Examples:
  avsreplay record -o tumble.mcap          the built-in scenario, simulated
  avsreplay run tumble.mcap                replay it and print tables
  avsreplay run tumble.mcap --golden fixtures/tumble.rows.jsonl

\b
Exit codes: 0 ok, 1 a requested check failed, 2 usage,
            3 unreadable input, 4 finished but data was lost,
            130 interrupted, 141 the reader of the output stopped reading."""


class _Commands(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 (click names it)
        return list(SUMMARIES)

    def invoke(self, ctx: click.Context) -> object:
        """Run a command; an environment variable that no command knows is an error."""
        unknown = sorted(name for name in os.environ if name.startswith("AVSREPLAY_"))
        if unknown:
            known = list(self._variables(ctx))
            unknown = [name for name in unknown if name not in known]
        if unknown:
            import difflib

            near = difflib.get_close_matches(unknown[0], known, 1)
            hint = f"did you mean {near[0]}?" if near else "unset it, or see 'avsreplay COMMAND --help'"
            raise UsageError("no command has an option of this name", where=f"environment {unknown[0]}", hint=hint)
        return super().invoke(ctx)

    def _variables(self, ctx: click.Context) -> Iterator[str]:
        """Every environment variable that stands for an option."""
        for name in SUMMARIES:
            command = self.get_command(ctx, name)
            for param in command.params if command else ():
                automatic = f"AVSREPLAY_{name}_{param.name}".upper() if isinstance(param, click.Option) else ()
                given = param.envvar or automatic
                yield from [given] if isinstance(given, str) else given

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:  # noqa: ARG002 (click names it)
        if name not in SUMMARIES:
            return None
        command: click.Command = importlib.import_module(f"avsreplay.cli.{name}").command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 (click names it)
        with formatter.section("Commands"):
            formatter.write_dl(list(SUMMARIES.items()))

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            raise click.UsageError(f"{error.message} Known: {', '.join(SUMMARIES)}.", ctx) from None


def _print_version(ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    if not wanted or ctx.resilient_parsing:
        return
    from avsreplay.cli.version import version_text

    click.echo(version_text())
    ctx.exit()


@click.group(cls=_Commands, epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_print_version,
    help="Show the versions of avsreplay and of its dependencies.",
)
def group() -> None:
    """Record, replay and test the processing chain of vision-guided capture of a tumbling object.

    Input: point clouds of a log. Output: poses and their errors, fault flags, observability, planned capture time.
    The same input gives the same bytes.
    """


def main() -> None:
    """Entry point: an AvsError becomes one line on stderr and its exit code, without a traceback."""
    try:
        code = group.main(standalone_mode=False, prog_name="avsreplay", auto_envvar_prefix="AVSREPLAY")
    except AvsError as error:
        code = _fail(str(error), error.exit_code)
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except (click.Abort, KeyboardInterrupt):
        code = _fail("interrupted", 130)
    except SystemExit:  # click exits only where the reader of stdout has closed the pipe: 128 + SIGPIPE
        code = 141
    sys.exit(code if isinstance(code, int) else 0)


def _fail(message: str, code: int) -> int:
    printable = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in message)
    click.echo(f"avsreplay: {printable}", err=True)
    return code
