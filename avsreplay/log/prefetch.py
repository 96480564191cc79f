"""The next scan is decoded while one registers: a bounded queue and one thread."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from queue import Empty, Full, Queue
from typing import TypeVar

__all__ = ["ahead"]

T = TypeVar("T")
_WAIT_S = 0.1


def ahead(items: Iterator[T], count: int) -> Iterator[T]:
    """The same items in the same order, at most ``count`` made ahead; what the maker raises is raised here."""
    queue: Queue[tuple[bool, T | BaseException | None]] = Queue(max(count, 1))
    stop = threading.Event()

    def put(entry: tuple[bool, T | BaseException | None]) -> None:
        while not stop.is_set():
            try:
                queue.put(entry, timeout=_WAIT_S)
                return
            except Full:
                continue

    def make() -> None:
        try:
            for item in items:
                put((True, item))
                if stop.is_set():
                    return
            put((False, None))
        except BaseException as error:  # handed to the consumer's thread, which raises it
            put((False, error))

    thread = threading.Thread(target=make, name="avsreplay-read-ahead", daemon=True)
    thread.start()
    try:
        yield from _drained(queue, thread)
    finally:
        stop.set()
        thread.join()


def _drained(queue: Queue[tuple[bool, T | BaseException | None]], thread: threading.Thread) -> Iterator[T]:
    while True:
        try:
            more, item = queue.get(timeout=_WAIT_S)
        except Empty:
            if thread.is_alive():
                continue
            more, item = queue.get_nowait()
        if more:
            yield item  # type: ignore[misc]
        elif isinstance(item, BaseException):
            raise item
        else:
            return
