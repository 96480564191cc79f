"""The group of the commands, and the entry point that turns every error into one line and an exit
code.

A command is the object ``<name>_command`` in ``avsreplay/cli/<name>.py``, or in the module that
``HOMES`` names; it is imported when it is called, so that ``avsreplay --help`` is fast.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib
import io
import os
import re
import shlex
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from avsreplay import __version__, arithmetic
from avsreplay.cli import interrupts
from avsreplay.cli.config import Command
from avsreplay.errors import AvsError, UsageError, printable

__all__ = ["entry_point"]

SUMMARIES = {
    "record": "Write a log: simulate a scenario, or convert recorded scans.",
    "run": "Replay a log and print verdict and tables.",
    "model": "Build a model of an unknown target from the scans of a log.",
    "odometry": "Track an unknown target through the scans of a log, without a model.",
    "info": "Show the content of a log and the options that a run needs.",
    "doctor": "Check a log for damage and repair it.",
    "backends": "List the registration back ends; run the contract tests on one.",
    "estimators": "List the estimators; run the contract tests on one.",
    "bench": "Compare the speed and error of back ends on a log.",
    "observability": "Show which states the measurements of a log determine.",
    "plan": "Plan the capture again from a saved result.",
    "report": "Build the HTML report of a saved result.",
    "export": "Write a saved result as CSV, Parquet, TUM or KITTI.",
    "compare": "Compare saved results; gate one against a baseline.",
    "sweep": "Run a campaign of many runs and summarise it.",
    "benchmark": "Run a suite of captures for every back end and estimator.",
    "config": "Print the effective settings of a run.",
    "completion": "Print the completion script of a shell.",
}

# The modules of the commands that share one.
HOMES = {
    "doctor": "info",
    "bench": "backends",
    "odometry": "model",
    "export": "record",
    "report": "record",
    "completion": "main",
}

EPILOG = """\b
Examples:
  avsreplay record -o tumble.mcap          the built-in scenario, simulated
  avsreplay run tumble.mcap                replay it and print tables
  avsreplay run tumble.mcap --golden fixtures/tumble.rows.jsonl

\b
Exit codes: 0 ok, 1 the requested check failed, 2 usage, 3 a file cannot
            be read or written, 4 finished but data was lost, 70 internal
            error, 130 interrupted (129 and 143 by SIGHUP and SIGTERM), 141
            standard output was closed."""


class _Commands(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 (click names it)
        return list(SUMMARIES)

    def invoke(self, ctx: click.Context) -> object:
        """Run a command; an environment variable that belongs to no command is an error."""
        _check_arithmetic()
        unknown = sorted(
            name
            for name in os.environ
            if name.startswith("AVSREPLAY_") and name != arithmetic.VARIABLE
        )
        if unknown:
            known = list(self._variables(ctx))
            unknown = [name for name in unknown if name not in known]
        if unknown:
            near = difflib.get_close_matches(unknown[0], known, 1)
            hint = (
                f"did you mean {near[0]}?"
                if near
                else "unset it, or see 'avsreplay COMMAND --help'"
            )
            raise UsageError(
                "no command has an option of this name",
                where=f"environment {unknown[0]}",
                hint=hint,
            )
        try:
            return super().invoke(ctx)
        except BrokenPipeError:  # a log on standard output; click exits with 1
            return 141

    def _variables(self, ctx: click.Context) -> Iterator[str]:
        """Every environment variable that stands for an option."""
        for name in SUMMARIES:
            command = self.get_command(ctx, name)
            for param in command.params if command else ():
                automatic = (
                    f"AVSREPLAY_{name}_{param.name}".upper()
                    if isinstance(param, click.Option)
                    else ()
                )
                given = param.envvar or automatic
                yield from [given] if isinstance(given, str) else given

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:  # noqa: ARG002 (click names it)
        if name not in SUMMARIES:
            return None
        home = importlib.import_module(f"avsreplay.cli.{HOMES.get(name, name)}")
        command: click.Command = getattr(home, f"{name}_command")
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
            if Path(args[0]).exists():
                hint = f"avsreplay {_command_for(Path(args[0]))} {shlex.join(args)}"
                raise UsageError(
                    "is no command", where=args[0], hint=f"did you mean: {hint}"
                ) from None
            near = difflib.get_close_matches(args[0], SUMMARIES, 1)
            meant = f" Did you mean {near[0]}?" if near else ""
            message = f"{error.message}{meant} Known: {', '.join(SUMMARIES)}."
            raise click.UsageError(message, ctx) from None


def _command_for(path: Path) -> str:
    """The command that is suggested where only a file or folder is named."""
    return "report" if (path / "rows.jsonl").is_file() else "run"


PARTS = ("numpy", "scipy", "mcap", "rosbags", "kiss-icp", "trimesh", "embreex", "click", "rich")


def versions() -> dict[str, str]:
    """Return the versions of the package, of Python and of the dependencies, by name; "missing" for
    one that is not installed.
    """
    import platform
    from importlib import metadata

    found = {"avsreplay": __version__, "python": platform.python_version()}
    for part in PARTS:
        try:
            found[part] = metadata.version(part)
        except metadata.PackageNotFoundError:
            found[part] = "missing"
    return found


def version_text() -> str:
    """Return one line for the package and one for its dependencies."""
    own, *rest = versions().items()
    return f"{own[0]} {own[1]}\n" + ", ".join(f"{name} {version}" for name, version in rest)


def _print_version(ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    if not wanted or ctx.resilient_parsing:
        return
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

    Input: point clouds of a log. Output: poses and their errors, fault flags, observability,
    planned capture time. The same input gives the same bytes.
    """


COMPLETION_EPILOG = """\b
Examples:
  eval "$(avsreplay completion bash)"                              in ~/.bashrc
  eval "$(avsreplay completion zsh)"                               in ~/.zshrc
  avsreplay completion fish > ~/.config/fish/completions/avsreplay.fish"""


@click.command("completion", cls=Command, epilog=COMPLETION_EPILOG)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion_command(shell: str) -> None:
    """Print the completion script for SHELL.

    \f
    Raises:
        UsageError: the shell is not supported.
    """  # noqa: D301
    from click.shell_completion import get_completion_class

    found = get_completion_class(shell)
    if found is None:
        raise UsageError(
            f"no completion for {shell}", where="completion", hint="use bash, zsh or fish"
        )
    click.echo(found(group, {}, "avsreplay", "_AVSREPLAY_COMPLETE").source())


def _check_arithmetic() -> None:
    """Raise UsageError if the variable that chooses the arithmetic has another value than those
    known.
    """
    value = os.environ.get(arithmetic.VARIABLE, "pinned")
    if value not in arithmetic.CHOICES:
        known = " or ".join(arithmetic.CHOICES)
        raise UsageError(
            f"{value[:40]!r} is unknown",
            where=f"environment {arithmetic.VARIABLE}",
            hint=f"use {known}",
        )


class _Discarding(io.FileIO):
    """Standard output that takes what can no longer be written, so that a command completes its
    other outputs.

    Attributes:
        failure: why the first write failed; None while standard output can be written.
    """

    failure: OSError | None = None

    def write(self, data: Any) -> int | None:  # type: ignore[override]
        """Write the data, or discard them after a failed write; in both cases their number of
        bytes is returned.
        """
        if self.failure is None:
            try:
                return super().write(data)
            except OSError as error:
                self.failure = error
        return len(memoryview(data).cast("B"))


class _Escaping(io.TextIOWrapper):
    """A standard stream that prints control characters of names and other text from files as
    escapes; colours and the motion of the cursor only where it is a terminal.
    """

    _CONTROLS = re.compile(r"(\x1b\[[0-9;?]*[A-Za-z]|\r)")

    def write(self, text: str) -> int:
        """Write the text, its control characters other than tabs and line ends as escapes."""
        if text.isascii() and text.isprintable():
            return super().write(text)
        parts = self._CONTROLS.split(text) if self.isatty() else [text]
        kept = [part if k % 2 else printable(part, "\t\n") for k, part in enumerate(parts)]
        super().write("".join(kept))
        return len(text)


def entry_point() -> None:
    """Run a command of the arguments of this process and exit with its code; every error is
    one line on stderr.
    """
    output, received = _standard_output(), interrupts.hear()
    code = _run(received)
    sys.stdout.flush()
    if output and output.failure and not code:
        closed = isinstance(output.failure, BrokenPipeError)
        code = (
            141
            if closed
            else _fail(f"standard output: {output.failure.strerror or output.failure}", 3)
        )
    sys.exit(code)


def _run(received: Sequence[int]) -> int:
    """Run the command; return its exit code.

    Args:
        received: the signals that have been received, last one last.
    """
    try:
        code = group.main(
            standalone_mode=False, prog_name="avsreplay", auto_envvar_prefix="AVSREPLAY"
        )
    except AvsError as error:
        return _fail(str(error), error.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return error.exit_code
    except click.ClickException as error:
        return _fail(_with_help(error), error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        interrupts.forget()
        return _fail("interrupted", 128 + (received or [signal.SIGINT])[-1])
    except OSError as error:
        return _fail(f"{error.filename or 'output'}: {error.strerror or error}", 3)
    except Exception as error:
        return _crash(error)
    return code if isinstance(code, int) else 0


def _with_help(error: click.ClickException) -> str:
    """The message of an error, with the command that describes the arguments where it states no
    allowed values.
    """
    message = error.format_message().replace("\n\t", " ")
    invalid = isinstance(error, click.BadParameter) and not isinstance(
        error, click.MissingParameter
    )
    if invalid or not isinstance(error, click.UsageError) or error.ctx is None:
        return message
    return f"{message.removesuffix('.')}; see '{error.ctx.command_path} --help'"


def _standard_output() -> _Discarding | None:
    """Replace standard output by one whose failure does not end the command; None where it is not a
    file.

    A character that the encoding of standard output or standard error does not have is written as
    an escape.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
    try:
        output = _Discarding(sys.stdout.fileno(), "wb", closefd=False)
    except (OSError, ValueError):  # one that a test has put in its place
        return None
    encoding, lines = sys.stdout.encoding, bool(sys.stdout.line_buffering)
    sys.stdout = _Escaping(
        io.BufferedWriter(output), encoding, "backslashreplace", line_buffering=lines
    )
    if isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr = _Escaping(
            sys.stderr.buffer, sys.stderr.encoding, "backslashreplace", line_buffering=True
        )
    return output


def _crash(error: Exception) -> int:
    """Report an unexpected error in one line and write its traceback to a file; return exit
    code 70.
    """
    import hashlib
    import tempfile
    import traceback

    text = "".join(traceback.format_exception(error))
    name = f"avsreplay-crash-{hashlib.sha256(text.encode('utf-8', 'replace')).hexdigest()[:12]}.txt"
    report, where = Path(tempfile.gettempdir()) / name, "no report could be written"
    with contextlib.suppress(OSError):
        arguments = " ".join(map(ascii, sys.argv[1:]))
        report.write_text(
            f"avsreplay {arguments}\n{sys.version}\n{text}",
            encoding="utf-8",
            errors="backslashreplace",
        )
        where = f"please report it with {report}"
    reason = str(error) or "no message"
    return _fail(f"internal error: {type(error).__name__}: {reason[:200]}; {where}", 70)


def _fail(message: str, code: int) -> int:
    with contextlib.suppress(OSError):
        click.echo(f"avsreplay: {printable(message)}", err=True)
    return code
