"""Fault detection by kind of fault: windows detected, delay, recovery, and largest errors of the estimate.

Computed from the fault accounts of the runs (report/episodes), without their scans. Two windows of one kind in a run
count as two. Kind "none" stands for the scans outside every window; those flagged there are false alarms.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from avsreplay import settings
from avsreplay.report.episodes import Episode, Peak
from avsreplay.sweep.statistics import Rate, Typical, rate, typical

NONE = "none"
_PLAIN = tuple(f.name for f in dataclasses.fields(Episode) if not f.name.startswith("peak_"))
_PEAKS = ("flagged", "used", "after")
_ERRORS = tuple(f.name for f in dataclasses.fields(Peak))
EPISODE_COLUMNS = (*_PLAIN, *(f"peak_{when}.{error}" for when in _PEAKS for error in _ERRORS))
_TIMES = ("delay_s", "delay_scans", "recover_s", "recover_scans")


@dataclass(frozen=True, slots=True)
class FaultKind:
    """All windows of one kind of fault in one combination.

    Attributes:
        harmful: Whether a label says that its scans must not be used.
        strengths: Strengths of the windows, each value once.
        lengths_s: Lengths of the windows, each value once [s].
        scans: Number of scans in the windows.
        flagged: Share of them with gamma 0; for "none" the false alarms.
        episodes: Number of windows.
        detected: Share of the windows with a flagged scan or, without any scan, a gap.
        delay_s: From the first scan of a window to the first flagged one, where there was one [s].
        delay_scans: The same in scans.
        recovery_s: From the first scan after a window to the first healthy one, where recovery was needed [s].
        recovery_scans: The same in scans.
        lost: Windows after which no scan was healthy.
        peak_flagged: Largest errors of the estimate over its scans with gamma 0; None without truth.
        peak_used: The same over its scans with gamma 1.
        peak_after: The same over the healthy scans after a window, up to the next one.
    """

    harmful: bool
    strengths: tuple[float, ...]
    lengths_s: tuple[float, ...]
    scans: int
    flagged: Rate | None
    episodes: int = 0
    detected: Rate | None = None
    delay_s: Typical | None = None
    delay_scans: Typical | None = None
    recovery_s: Typical | None = None
    recovery_scans: Typical | None = None
    lost: int = 0
    peak_flagged: Peak = field(default_factory=Peak)
    peak_used: Peak = field(default_factory=Peak)
    peak_after: Peak = field(default_factory=Peak)


def episode_lines(episodes: Iterable[Episode]) -> tuple[tuple[Any, ...], ...]:
    """One tuple of plain values per window, in the order of EPISODE_COLUMNS."""
    return tuple(tuple(_at(settings.dump(e), name) for name in EPISODE_COLUMNS) for e in episodes)


def _at(plain: Mapping[str, Any], name: str) -> Any:
    for key in name.split("."):
        plain = plain[key]
    return plain


class _Windows:
    """Sums over the windows of one kind, or over the scans outside every window."""

    def __init__(self) -> None:
        self.harmful = False
        self.strengths, self.lengths = set[float](), set[float]()
        self.scans = self.flagged = self.episodes = self.detected = self.lost = 0
        self.times: dict[str, list[float]] = {name: [] for name in _TIMES}
        self.peaks: dict[str, float] = {}

    def add(self, window: Mapping[str, Any]) -> None:
        self.harmful |= window["harmful"]
        self.strengths |= {window["strength"]} - {None}
        self.lengths.add(round(window["end_s"] - window["start_s"], 6))
        self.scans += window["scans"]
        self.flagged += window["flagged"]
        self.episodes += 1
        self.detected += window["detected"]
        self.lost += window["lost"]
        for name, values in self.times.items():
            values += [] if window[name] is None else [window[name]]
        self.take_peaks(window)

    def take_peaks(self, found: Mapping[str, Any], prefix: str = "") -> None:
        for name in (f"peak_{when}.{error}" for when in _PEAKS for error in _ERRORS):
            value = found.get(prefix + name)
            if value is not None:
                self.peaks[name] = max(value, self.peaks.get(name, value))

    def result(self) -> FaultKind:
        delay_s, delay_scans, recovery_s, recovery_scans = (typical(self.times[name]) for name in _TIMES)
        flagged, used, after = (Peak(*(self.peaks.get(f"peak_{when}.{e}") for e in _ERRORS)) for when in _PEAKS)
        return FaultKind(
            harmful=self.harmful,
            strengths=tuple(sorted(self.strengths)),
            lengths_s=tuple(sorted(self.lengths)),
            scans=self.scans,
            flagged=rate(self.flagged, self.scans),
            episodes=self.episodes,
            detected=rate(self.detected, self.episodes),
            delay_s=delay_s,
            delay_scans=delay_scans,
            recovery_s=recovery_s,
            recovery_scans=recovery_scans,
            lost=self.lost,
            peak_flagged=flagged,
            peak_used=used,
            peak_after=after,
        )


class FaultKinds:
    """Adds up the runs of one combination, in any order."""

    def __init__(self) -> None:
        self._kinds: dict[str, _Windows] = {}

    def add(self, episodes: Iterable[Sequence[Any]], metrics: Mapping[str, Any]) -> None:
        """Add one run.

        Args:
            episodes: Its windows, in the order of EPISODE_COLUMNS.
            metrics: Its metrics; where its log does not say what was injected, they are left out.
        """
        for line in episodes:
            window = dict(zip(EPISODE_COLUMNS, line, strict=True))
            self._kinds.setdefault(window["kind"], _Windows()).add(window)
        if metrics.get("faults.known"):
            none = self._kinds.setdefault(NONE, _Windows())
            none.scans += metrics["faults.unlabelled"]
            none.flagged += metrics["faults.false_alarms"]
            none.take_peaks(metrics, "faults.")

    def result(self) -> dict[str, FaultKind]:
        """The kinds in alphabetical order."""
        return {kind: windows.result() for kind, windows in sorted(self._kinds.items())}
