"""Progress on stderr: a bar on a terminal, a plain line every 30 seconds elsewhere; and interruption between scans."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

import click

if TYPE_CHECKING:
    from avsreplay.rows import Row

T = TypeVar("T")
PERIOD_S = 30.0


def tracked(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    """Yield the items and show the progress on stderr; ``total`` 0 means that their number is unknown."""
    if not sys.stderr.isatty():
        yield from _with_lines(items, total, what)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        yield from progress.track(items, total=total or None, description=what)


def _with_lines(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    begun = said = time.monotonic()
    for count, item in enumerate(items, 1):
        yield item
        now = time.monotonic()
        if now - said >= PERIOD_S:
            said = now
            of = f" of {total}" if total else ""
            left = f", about {(now - begun) * (total - count) / count:.0f} s left" if total else ""
            print(f"avsreplay: {what}: {count}{of} after {now - begun:.0f} s{left}", file=sys.stderr, flush=True)  # noqa: T201


@contextmanager
def interruptible(rows: Sequence[object], stop: Callable[[], None]) -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether Ctrl-C was pressed; a second Ctrl-C interrupts at once.

    Args:
        rows: results so far; before the first one Ctrl-C interrupts at once.
        stop: called at the first Ctrl-C.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed a second time, or before the first result.
    """
    asked: list[int] = []

    def ask(number: int, _frame: object) -> None:
        asked.append(number)
        stop()
        if not rows or len(asked) > 1:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: bool(asked)
    finally:
        signal.signal(signal.SIGINT, before)


_LIVE_HEAD = "  scan     t [s]  state             rms [mm]     nis pos err [mm] rot err [deg]"


def say_live(row: Row) -> bool:
    """Print a line about a scan of a log that is still written, the first one under a heading.

    Returns:
        False if the reader of standard output has ended, which the tables report later.
    """
    from avsreplay.cli import StdoutClosed

    cells = [
        f"{_number(row.rms_m, 1000.0, '.2f'):>9}",
        f"{_number(row.nis, 1.0, '.2f'):>7}",
        f"{_number(row.pos_err_m, 1000.0, '.2f'):>12}",
        f"{_number(row.rot_err_deg, 1.0, '.3f'):>13}",
    ]
    state = "ok" if row.gamma else row.reason
    line = f"{row.seq:>6} {row.t_s:>9.3f}  {state:<16} {' '.join(cells)}"
    try:
        click.echo(line if row.seq else f"{_LIVE_HEAD}\n{line}")
    except (OSError, StdoutClosed):
        return False
    return True


def _number(value: float | None, factor: float, form: str) -> str:
    return "-" if value is None else format(factor * value, form)
