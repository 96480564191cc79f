"""The end of long registrations on request: the compiled code polls between parts of its work."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from avsreplay.register import _kernel


def request_stop(wanted: bool = True) -> None:
    """Let registrations that run on any thread raise KeyboardInterrupt, now and later.

    Args:
        wanted: whether they end; False lets later ones run.
    """
    _kernel.request_stop(wanted)


@contextmanager
def shielded() -> Iterator[None]:
    """Let the registrations of this thread finish: state that they change would be left half
    changed.
    """
    before = _kernel.shield(True)
    try:
        yield
    finally:
        _kernel.shield(before)
