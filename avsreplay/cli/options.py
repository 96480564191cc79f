"""Shared parts of the commands: options, sources, results, progress on stderr, and
interruption between scans.
"""

from __future__ import annotations

import _thread
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from avsreplay.cli import interrupts
from avsreplay.cli.config import source_setting
from avsreplay.errors import AvsError, DataLost, UnreadableInput, UsageError
from avsreplay.files import check_output, is_stream

if TYPE_CHECKING:
    from avsreplay.log import GrowingLog, Source, SourceOptions
    from avsreplay.report.result import Result
    from avsreplay.rows import Row

F = TypeVar("F", bound=Callable[..., Any])
PATH = click.Path(path_type=Path)
HTML = (".html", ".htm")


class Numbers(click.ParamType[tuple[float, ...]]):
    """A given count of numbers, separated by commas."""

    name = "numbers"

    def __init__(self, count: int) -> None:
        self.count = count

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """A tuple of floats; anything else is a usage error."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(word) for word in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self.count:
            self.fail(f"'{value}' is not {self.count} numbers separated by commas", param, ctx)
        return numbers


class Seconds(click.ParamType[float]):
    """A time in seconds."""

    name = "float"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """A float; for a start mode the usage error names the option that takes it."""
        modes = [p for p in (ctx.command.params if ctx else ()) if "--start-mode" in p.opts]
        try:
            return float(value)
        except ValueError:
            hint = f"; to choose how the estimate begins, use --start-mode {value}" if modes else ""
            self.fail(f"'{value}' is no time in seconds{hint}", param, ctx)


def added(*options: Callable[[F], F]) -> Callable[[F], F]:
    """Return a decorator that adds ``options`` to a command in this order."""

    def decorate(command: F) -> F:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


model_options = added(
    source_setting("--model", type=PATH, common=True),
    source_setting("--model-unit", common=True),
    source_setting("--model-scale", type=float),
    source_setting("--model-mirror", is_flag=True),
    source_setting("--cloud-model", is_flag=True),
)
"""Options for the model of the target."""
truth_options = added(
    source_setting("--truth-topic", common=True),
    source_setting("--truth", "truth_file", type=PATH),
    source_setting("--truth-frame"),
)
"""Options for the true poses."""
scan_options = added(
    source_setting("-t", "--topic", common=True),
    source_setting("--start", "start_s", type=Seconds(), common=True),
    source_setting("--end", "end_s", type=float),
    source_setting("--duration", "duration_s", type=float, common=True),
    source_setting("-n", "--n-scans", type=int, common=True),
    source_setting("--every-scan", "every", type=int),
    source_setting("--crop-box", type=Numbers(6), metavar="X0,Y0,Z0,X1,Y1,Z1"),
    source_setting("--crop-range", type=Numbers(2), metavar="MIN,MAX"),
    source_setting("--fixed-frame"),
    source_setting("--sensor-topic"),
    source_setting("--sensor-at", "sensor_m", type=Numbers(3), metavar="X,Y,Z"),
    source_setting("--truth-gap", "truth_gap_s", type=float),
    source_setting("--scan-unit"),
    source_setting("--scan-duration", "scan_duration_s", type=float),
    source_setting("--point-time", metavar="FIELD:UNIT:ORIGIN"),
    source_setting("--no-return", metavar="CODES"),
    source_setting("--byte-order"),
    source_setting("--intrinsics", type=str),
    source_setting("--rate", "rate_hz", type=float),
    source_setting("--clock"),
    source_setting("--max-message-mib", type=int),
    source_setting("--strict", is_flag=True),
)
"""Options for the scans: which ones, in which frame, and what their values mean."""
source_options = added(model_options, truth_options, scan_options)
"""All options for reading a log; each has the name of its field in ``log.SourceOptions`` and is
None by default.
"""
pose_options = added(
    source_setting("--pose-sigma", type=Numbers(2), metavar="MM,DEG"),
    source_setting("--grasp", type=Numbers(3), metavar="X,Y,Z"),
    source_setting("--extent", "extent_m", type=float),
)
"""Options for reading measured poses (``--backend poses``)."""


_CHOICES = {
    "clock": "ClockChoice",
    "model_unit": "Unit",
    "scan_unit": "Unit",
    "byte_order": "ByteOrder",
}  # options that are enumerations


def read_options(flags: Mapping[str, Any]) -> SourceOptions:
    """Return the options that were given (not None) as ``SourceOptions``.

    Args:
        flags: options by the names of their fields.

    Raises:
        UsageError: a value is not allowed.
    """
    from avsreplay.log import SourceOptions
    from avsreplay.log import options as log_options

    given = {name: value for name, value in flags.items() if value is not None}
    for name, choice in _CHOICES.items():
        if isinstance(given.get(name), str):
            given[name] = getattr(log_options, choice)(given[name])
    if "grasp" in given and given.get("model") == Path("auto"):
        hint = "build the model first with 'avsreplay model', which has the same option"
        raise UsageError(
            "the frame of a model is not known before it is built", where="--grasp", hint=hint
        )
    try:
        return SourceOptions(**given)
    except ValueError as error:
        field, _, what = str(error).partition(" ")
        context = click.get_current_context(silent=True)
        known = context.command.params if context else []
        option = next((param.opts[-1] for param in known if param.name == field), field)
        raise UsageError(f"{option} {what}", hint="correct the option") from None


def report_losses(source: Source, damaged: int | None = None) -> None:
    """Raise DataLost if a part of a log or any of the scans that were read could not be used.

    Args:
        source: the log, after its scans were read.
        damaged: number of scans that could not be used, if more were read than by ``source``.

    Raises:
        DataLost: names the number of parts and of scans, and the first of each.
    """
    from avsreplay.log.options import lost_text
    from avsreplay.log.source import UNKNOWN_SENSOR

    if text := lost_text(source.losses, source.damaged, len(source), damaged):
        uncovered = not source.losses and UNKNOWN_SENSOR in text
        hint = (
            "see --truth-gap, or choose a part with --start and --end"
            if uncovered
            else "see 'avsreplay doctor'"
        )
        raise DataLost(text, where=str(source.path), hint=hint)


def read_result(path: Path) -> Result:
    """Read and verify a saved result; warn on stderr if it could not be verified or its log
    was damaged.
    """
    from avsreplay.report.result import load_result

    result = load_result(path)
    for line in result.warnings:
        click.echo(f"avsreplay: warning: {line}", err=True)
    return result


@contextmanager
def log_file(log: Path, *, follow: bool = False) -> Iterator[tuple[Path, GrowingLog | None]]:
    """Yield the log, and where it is still written the reader that follows it.

    Args:
        log: the log; "-" is standard input, which is copied to a temporary file while it is read.
        follow: whether the log is a file that is still written.

    Raises:
        AvsError: the log cannot be followed, or what reads it fails.
    """
    from avsreplay.log import GrowingLog

    if str(log) != "-":
        yield log, GrowingLog(log) if follow else None
        return
    with tempfile.TemporaryDirectory(
        ignore_cleanup_errors=True
    ) as folder:  # Windows: the file is still open
        if sys.stdin is None:
            raise UnreadableInput(
                "it is closed",
                where="standard input",
                hint="give a file, or a pipe: ... | avsreplay run -",
            )
        path = Path(folder) / "stdin"
        try:
            yield path, GrowingLog(path, sys.stdin.buffer)
        except AvsError as error:
            error.where = (error.where or "").replace(str(path), "standard input") or None
            if path.is_file() and not path.stat().st_size and "broke off" not in error.what:
                error.what, error.hint = (
                    "no data",
                    "see the message of the program that writes to the pipe",
                )
            raise


def given_paths(*others: str) -> list[Path]:
    """Return all paths that the current command was given, except the values of the parameters
    ``others``.
    """
    context = click.get_current_context()
    found: list[Path] = []
    for param in context.command.params:
        value = context.params.get(str(param.name))
        if isinstance(param.type, click.Path) and param.name not in others and value is not None:
            found += value if isinstance(value, (list, tuple)) else [value]
    return found


def check_outputs(*names: str, overwrite: bool = True) -> None:
    """Raise an error for outputs of the current command that cannot be written, before any work is
    done.

    Args:
        names: parameters of the command that are files to write. None of them may be an input,
            which is every other parameter that is a path, or the file of another output.
        overwrite: whether an existing file may be replaced.

    Raises:
        UsageError: see ``files.check_output``.
        UnreadableInput: the folder of an output cannot be written.
    """
    inputs = given_paths(*names)
    for name in names:
        output = click.get_current_context().params.get(name)
        if output is not None:
            check_output(output, overwrite=overwrite, inputs=inputs)
            inputs.append(output)


def check_suffix(path: Path, *suffixes: str) -> None:
    """Raise UsageError if the name of an output states another format; devices may have any name.

    Args:
        path: the output.
        suffixes: those that the name may have, the first one named after the format.
    """
    if path.suffix.lower() not in ("", *suffixes) and not is_stream(path):
        hint = f"name a file that ends in {' or '.join(suffixes)}"
        raise UsageError(f"the format is {suffixes[0][1:].upper()}", where=str(path), hint=hint)


def check_binary_output(output: Path) -> None:
    """Raise UsageError if ``output`` is "-" and standard output is a terminal."""
    if str(output) == "-" and sys.stdout.isatty():
        raise UsageError(
            "a log is binary", where="-o -", hint="redirect the output to a file or a pipe"
        )


T = TypeVar("T")
PROGRESS_PERIOD_S = 30.0


def tracked(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    """Yield items and show the progress on stderr.

    Args:
        items: the items.
        total: their number, 0 if it is unknown.
        what: what is being done, in words.
    """
    if not sys.stderr.isatty():
        yield from _with_lines(items, total, what)
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        yield from progress.track(items, total=total or None, description=what)


def _with_lines(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    begun = said = time.monotonic()
    for count, item in enumerate(items, 1):
        yield item
        now = time.monotonic()
        if now - said >= PROGRESS_PERIOD_S:
            said = now
            of = f" of {total}" if total else ""
            left = f", about {(now - begun) * (total - count) / count:.0f} s left" if total else ""
            print(  # noqa: T201 (progress of a long operation)
                f"avsreplay: {what}: {count}{of} after {now - begun:.0f} s{left}",
                file=sys.stderr,
                flush=True,
            )


_INTERRUPT_GRACE_S = 1.0  # for the scan at which Ctrl-C was pressed


@contextmanager
def interruptible(rows: Sequence[object], stop: Callable[[], None]) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C was pressed; the scan in progress is finished.

    A scan that takes longer than ``_INTERRUPT_GRACE_S`` after this, or until a second Ctrl-C, is
    given up: its row is missing. What collects scans is never left with a part of one.

    Args:
        rows: results so far; before the first one Ctrl-C interrupts at once.
        stop: called at the first Ctrl-C.

    Raises:
        KeyboardInterrupt: the scan in progress was given up.
    """
    asked: list[int] = []
    ended = threading.Event()

    def ask(number: int, _frame: object) -> None:
        if not interrupts.counts():
            return
        asked.append(number)
        if ended.is_set():
            return
        stop()
        if not rows or len(asked) > 1:
            interrupt.stop()
        elif not late.is_alive():
            late.start()

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    from avsreplay.register import interrupt

    late = threading.Timer(_INTERRUPT_GRACE_S, _thread.interrupt_main)  # as a second Ctrl-C
    late.daemon = True
    before = signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: bool(asked)
    finally:
        ended.set()  # what arrives from here on does not leave this block half done
        late.cancel()
        if late.is_alive():
            late.join()
        signal.signal(signal.SIGINT, before)
        interrupt.request_stop(False)


_LIVE_HEAD = "  scan     t [s]  state             rms [mm]     nis pos err [mm] rot err [deg]"


def say_live(row: Row) -> None:
    """Print a line about a scan of a log that is still written, the first one under a heading."""
    cells = [
        f"{_number(row.rms_m, 1000.0, '.2f'):>9}",
        f"{_number(row.nis, 1.0, '.2f'):>7}",
        f"{_number(row.pos_err_m, 1000.0, '.2f'):>12}",
        f"{_number(row.rot_err_deg, 1.0, '.3f'):>13}",
    ]
    state = "ok" if row.gamma else row.reason
    line = f"{row.seq:>6} {row.t_s:>9.3f}  {state:<16} {' '.join(cells)}"
    click.echo(line if row.seq else f"{_LIVE_HEAD}\n{line}")


def _number(value: float | None, factor: float, form: str) -> str:
    return "-" if value is None else format(factor * value, form)
