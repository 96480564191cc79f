"""The end of long work on request: the compiled code polls between parts of its work."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from avsreplay.register import _kernel


def request_stop(wanted: bool = True) -> None:
    """Let compiled work that runs on any thread raise KeyboardInterrupt, now and later.

    Args:
        wanted: whether it ends; False lets later work run.
    """
    _kernel.request_stop(wanted)


def stop() -> None:
    """Request a stop and raise KeyboardInterrupt; within ``shielded``, only request it: the block
    ends as usual, and what follows it raises KeyboardInterrupt where it polls.
    """
    _kernel.request_stop(True)
    if not _kernel.is_shielded():
        raise KeyboardInterrupt


@contextmanager
def shielded() -> Iterator[None]:
    """Let the work of this thread finish: state that it changes would be left half changed."""
    before = _kernel.shield(True)
    try:
        yield
    finally:
        _kernel.shield(before)
