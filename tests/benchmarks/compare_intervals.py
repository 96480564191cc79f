"""Coverage of the intervals of ``compare`` for two runs of one log: ``python
tests/benchmarks/compare_intervals.py``.

Errors of both runs have the same size, so that an interval should contain zero in 95 % of the
cases. They are
|10 mm + 3 mm x| with x from a first-order autoregressive series of unit variance. Prints a Markdown
table.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.signal import lfilter

from avsreplay.report.conclusion import _LEAST_BLOCK_SCANS, _MAX_BLOCKS
from avsreplay.report.intervals import interval_of_roots


def contains_zero(rng: np.random.Generator, count: int, phi: float) -> bool:
    """Whether the interval of one pair of runs contains zero."""
    drawn = rng.standard_normal((2, count)) * np.sqrt(1.0 - phi**2)
    drawn[:, 0] /= np.sqrt(1.0 - phi**2)
    base, other = np.square(0.01 + 0.003 * lfilter([1.0], [1.0, -phi], drawn, axis=1))
    blocks = [
        np.array_split(squares, min(_MAX_BLOCKS, count // _LEAST_BLOCK_SCANS))
        for squares in (base, other)
    ]
    low, high = interval_of_roots(*(np.array([block.mean() for block in run]) for run in blocks))
    return low <= 0.0 <= high


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=2000)
    pairs, rng = parser.parse_args().pairs, np.random.default_rng(1)
    correlations = (0.0, 0.5, 0.8, 0.95)
    print("| scans | " + " | ".join(f"correlation {phi:g}" for phi in correlations) + " |")
    print("| ---: |" + " ---: |" * len(correlations))
    for count in (35, 100, 600):
        shares = [
            np.mean([contains_zero(rng, count, phi) for _ in range(pairs)]) for phi in correlations
        ]
        print(f"| {count} | " + " | ".join(f"{100 * share:.0f} %" for share in shares) + " |")


if __name__ == "__main__":
    main()
