"""Signals that end a command: SIGTERM and SIGHUP act as Ctrl-C, also where Ctrl-C is ignored."""

from __future__ import annotations

import contextlib
import signal
from collections import namedtuple

_received: list[int] = []
_ignored: list[bool] = []


def hear() -> list[int]:
    """Make SIGTERM and SIGHUP act as SIGINT, unless they are ignored.

    A shell starts a command in the background with SIGINT ignored. It stays ignored, but a SIGINT
    that stands for one of the other signals counts.

    Returns:
        The list that receives the numbers of the signals.
    """
    del _received[:], _ignored[:]
    with contextlib.suppress(ValueError):  # a thread other than the main one sets no handler
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
            _ignored.append(True)
            signal.signal(signal.SIGINT, _end)
        for name in ("SIGTERM", "SIGHUP"):  # Windows has no SIGHUP
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, _stand_in)
    return _received


def counts() -> bool:
    """Return whether a SIGINT that has arrived is to end the command."""
    return bool(_received) or not _ignored


def forget() -> None:
    """Let the process end with an exit code of its own after an interrupt that was handled.

    CPython ends "python -m" with SIGINT if a KeyboardInterrupt has left code that was compiled from
    a text, as the methods of a data class that was being imported; the next such code that ends
    clears this, and a named tuple has some.
    """
    namedtuple("Handled", ())


def _stand_in(number: int, _frame: object) -> None:
    _received.append(number)
    signal.raise_signal(signal.SIGINT)


def _end(_number: int, _frame: object) -> None:
    if counts():
        raise KeyboardInterrupt
