"""Statistics of a list of numbers, the same to the last bit whatever the order: sums are correctly rounded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Spread", "median"]


@dataclass(frozen=True, slots=True)
class Spread:
    """Root mean square, mean, median, standard deviation (over n), least and greatest of ``count`` values."""

    count: int
    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread | None:
        """None for no value at all."""
        if not values:
            return None
        n = len(values)
        mean = math.fsum(values) / n
        rmse = math.sqrt(math.fsum(v * v for v in values) / n)
        std = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / n)
        return cls(n, rmse, mean, median(values), std, min(values), max(values))


def median(values: Sequence[float]) -> float:
    """The middle value, or the mean of the two middle ones. ``values`` must not be empty."""
    ordered, half = sorted(values), len(values) // 2
    return ordered[half] if len(ordered) % 2 else 0.5 * (ordered[half - 1] + ordered[half])
