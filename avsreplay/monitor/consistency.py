"""Does the estimate tell the truth about itself: NIS and NEES in chi-square bands, whiteness of innovations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from avsreplay.geometry import Array, frozen
from avsreplay.records import BLOCKS, Innovation
from avsreplay.settings import Settings, setting

__all__ = ["Consistency", "ConsistencyParams", "ConsistencyTrack", "Verdicts", "block_nees", "mean_band"]


@dataclass(frozen=True, slots=True)
class ConsistencyParams(Settings):
    """The innovation test that may withdraw ``converged``."""

    window: int = setting(50, "Healthy scans in the window of the test.", low=2)
    least: int = setting(15, "Healthy scans from which the test is made.", low=2)
    level: float = setting(
        0.9999,
        "Probability of the two-sided band in which the mean NIS of a correct filter lies.",
        above=0.0,
        below=1.0,
    )
    slack: float = setting(
        2.0,
        "Factor by which the mean NIS may exceed the band, because registration errors are not quite white.",
        low=1.0,
    )

    def check(self) -> None:
        """Raise ValueError where the test needs more scans than its window holds."""
        if self.least > self.window:
            raise ValueError(f"least is {self.least}, must not exceed window = {self.window}")


def mean_band(dof: int, count: int, level: float) -> tuple[float, float]:
    """Two-sided band of the mean of ``count`` chi-square values of ``dof`` degrees of freedom each."""
    from scipy.special import gammaincinv

    n = 0.5 * dof * count
    tail = 0.5 * (1.0 - level)
    return float(2.0 * gammaincinv(n, tail)) / count, float(2.0 * gammaincinv(n, 1.0 - tail)) / count


def block_nees(error: Array, P: Array) -> dict[str, float]:
    """NEES e' P^-1 e of each block by itself, and of all 20 as 'all'. error (20,), P (20, 20)."""
    out = {name: float(error[b] @ np.linalg.solve(P[b, b], error[b])) for name, b in BLOCKS.items()}
    out["all"] = float(error @ np.linalg.solve(P, error))
    return out


@dataclass(frozen=True, slots=True, eq=False)
class ConsistencyTrack:
    """The fold's state: whitened innovations L^-1 alpha of the last healthy epochs, (n, 6), oldest first.

    Each at the weight the estimate gave it: a wild pose that was hardly listened to says little about the filter.
    """

    white: Array


@dataclass(frozen=True, slots=True)
class Verdicts:
    """The window in numbers, None before there is enough of it.

    Attributes:
        consistent: may the covariance be believed.  nis_mean: mean NIS.  band: its two-sided chi-square band.
        autocorrelation: of the whitened innovations one healthy epoch apart, 0 where white.
        autocorrelation_band: half width of the band it stays in where white.
    """

    consistent: bool | None
    nis_mean: float | None = None
    band: tuple[float, float] | None = None
    autocorrelation: float | None = None
    autocorrelation_band: float | None = None


class Consistency:
    """Watches the innovations of healthy scans."""

    def __init__(self, params: ConsistencyParams) -> None:
        self.params = params
        self._bands: dict[int, tuple[float, float]] = {}

    def initial(self) -> ConsistencyTrack:
        """Nothing seen yet."""
        return ConsistencyTrack(frozen(np.zeros((0, 6))))

    def observe(self, track: ConsistencyTrack, seen: Innovation | None, gamma: int) -> ConsistencyTrack:
        """One scan on; faulty ones say nothing."""
        if seen is None or gamma == 0:
            return track
        white = np.sqrt(seen.weight) * np.linalg.solve(np.linalg.cholesky(seen.S), seen.alpha)
        kept = track.white[max(0, len(track.white) + 1 - self.params.window) :]
        return ConsistencyTrack(frozen(np.vstack([kept, white])))

    def judge(self, track: ConsistencyTrack) -> Verdicts:
        """The window's verdict.

        Only a mean NIS above its band (times the slack) denies consistency: a filter that claims too little is safe.
        """
        n = len(track.white)
        if n < self.params.least:
            return Verdicts(None)
        band = self._band(n)
        mean = float(np.einsum("ij,ij->", track.white, track.white)) / n
        lag = float(np.einsum("ij,ij->", track.white[1:], track.white[:-1]) / (mean * (n - 1)))
        return Verdicts(mean <= self.params.slack * band[1], mean, band, lag, self._autocorrelation_band(n))

    def _band(self, n: int) -> tuple[float, float]:
        if n not in self._bands:
            self._bands[n] = mean_band(6, n, self.params.level)
        return self._bands[n]

    def _autocorrelation_band(self, n: int) -> float:
        from scipy.special import ndtri

        return float(ndtri(0.5 * (1.0 + self.params.level))) / math.sqrt(6.0 * (n - 1))
