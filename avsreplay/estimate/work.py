"""Long computations in parts over several scans, so that no scan takes much longer than the others.

A computation is a generator that yields the size of each part when the part is done, in linearised poses: those over
which residuals and their derivatives are computed, or as many as take the same time. A budget per scan counts them. A
computation that is continued over scans uses the poses that were there when it began; its result is corrected by the
later ones.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

T = TypeVar("T")
Parts = Generator[int, None, T]
"""A computation in parts."""

BUDGET = 1000  # linearised poses per scan; the part that exceeds it is finished


def whole(parts: Parts[T]) -> T:
    """Return the result of a computation, all parts at once."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            result: T = end.value
            return result


class Work(Generic[T]):
    """A computation up to some part. ``continued`` leaves it as it is: any track that holds it may continue it."""

    def __init__(self, parts: Parts[T]) -> None:
        self._parts = parts
        self._after: Work[T] | None = None
        self.result: T | None = None
        self.done = False

    def continued(self) -> Work[T]:
        """Return the computation after the parts of one more scan."""
        if self._after is None:
            after, left = Work(self._parts), BUDGET
            try:
                while left > 0:
                    left -= next(self._parts)
            except StopIteration as end:
                after.done, after.result = True, end.value
            self._after = after
        return self._after


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """A computation that a track carries on, and what its result changes.

    Attributes:
        work: so far.  until_ns: instant of the last pose it uses.
        finished: the track with the result, from the track at the end.
    """

    work: Work[Any]
    until_ns: int
    finished: Callable[[Any, Any], Any]
