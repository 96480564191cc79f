"""Long computations in parts over several scans, so that no scan takes much longer than the others.

A computation is a generator that yields the size of each part when the part is done, in linearised
poses: those over which residuals and their derivatives are computed, or as many as take the same
time. A budget per scan counts them. A computation that is continued over scans uses the poses that
were there when it began; its result is corrected by the later ones.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Generic, TypeVar

from avsreplay.checkpoint import TRANSIENT
from avsreplay.errors import value_class

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


@dataclass(eq=False)
class Work(Generic[T]):
    """A computation up to some part. ``continued`` leaves it as it is: any track that holds it may
    continue it.

    A checkpoint contains the number of its parts only. A run that continues from there computes
    them again.
    """

    count: int = 0
    result: T | None = field(default=None, init=False, metadata=TRANSIENT)
    done: bool = field(default=False, init=False, metadata=TRANSIENT)
    _parts: Parts[T] | None = field(default=None, init=False, repr=False, metadata=TRANSIENT)
    _after: Work[T] | None = field(default=None, init=False, repr=False, metadata=TRANSIENT)

    def continued(self, begin: Callable[[], Parts[T]]) -> Work[T]:
        """Return the computation after the parts of one more scan. ``begin`` begins it."""
        if self._after is None:
            parts = self._parts or begin()
            for _ in range(0 if self._parts else self.count):
                next(parts)
            after, left = Work[T](self.count), BUDGET
            try:
                while left > 0:
                    left -= next(parts)
                    after.count += 1
                after._parts = parts
            except StopIteration as end:
                after.done, after.result = True, end.value
            self._after, self._parts = after, None
        return self._after


class ComputationKind(Enum):
    """What is computed in parts."""

    FIT = "fit"
    CHECK = "check"  # the fit with which the filter is compared
    LEVELS = "levels"
    DRIFT = "drift"


@value_class
class Computation:
    """A computation that a track carries on, and what its result changes.

    Attributes:
        kind: of the computation.
        begin: its arguments.
        finish: the arguments, besides track and result, of the change of the track when it has
            ended.
        work: the computation so far.
    """

    kind: ComputationKind
    begin: tuple[Any, ...]
    finish: tuple[Any, ...] = ()
    work: Work[Any] = field(default_factory=Work)
