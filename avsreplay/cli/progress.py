"""Progress on stderr: a bar on a terminal, a plain line every 30 seconds elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

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
