"""The fault rule by kind of fault: windows detected, delay, recovery, and what the estimate's errors came to.

Made from the runs' own accounts (report/episodes), so it needs no lines a scan. Two windows of one kind in a run are
two episodes. "none" stands for the scans outside every window: what is flagged there is a false alarm.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from avsreplay import settings
from avsreplay.report.episodes import Episode, Peak
from avsreplay.sweep.statistics import Rate, Typical, rate, typical

__all__ = ["EPISODE_COLUMNS", "NONE", "KindOfFault", "episode_lines", "kinds_of_fault"]

NONE = "none"
_PLAIN = tuple(f.name for f in dataclasses.fields(Episode) if not f.name.startswith("peak_"))
_PEAKS = ("flagged", "used", "after")
_ERRORS = tuple(f.name for f in dataclasses.fields(Peak))
EPISODE_COLUMNS = (*_PLAIN, *(f"peak_{when}.{error}" for when in _PEAKS for error in _ERRORS))


@dataclass(frozen=True, slots=True)
class KindOfFault:
    """All windows of one kind of fault in a combination ("none": the scans outside every window).

    Attributes:
        harmful: does a label say its scans must not be used?  strengths, lengths_s: of the windows, each value once.
        scans: that carry it.  flagged: share of them with gamma 0; of "none" the false alarms.
        episodes: windows.  detected: share of them with a flagged scan or, without any scan, a gap.
        delay_s, delay_scans: from a window's first scan to its first flagged one, where there was one.
        recovery_s, recovery_scans: from the first scan after a window to the first healthy one, where there was
            something to recover from.  lost: windows after which no scan was healthy.
        peak_flagged, peak_used: largest errors of the estimate over its scans with gamma 0, with gamma 1.
        peak_after: over the healthy scans after a window, up to the next one.  All None without truth.
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
    """A list a window in the order of EPISODE_COLUMNS: plain values for the journal."""
    return tuple(tuple(_at(settings.dump(e), name) for name in EPISODE_COLUMNS) for e in episodes)


def _at(plain: Mapping[str, Any], name: str) -> Any:
    for key in name.split("."):
        plain = plain[key]
    return plain


def kinds_of_fault(episodes: Iterable[Sequence[Any]], accounts: Sequence[Mapping[str, Any]]) -> dict[str, KindOfFault]:
    """By kind, in alphabetical order, of a combination's runs.

    Args:
        episodes: lines of EPISODE_COLUMNS, of all runs.
        accounts: each run's metrics; those whose log does not say what was injected are left out.
    """
    by_kind: dict[str, list[dict[str, Any]]] = {}
    for line in episodes:
        episode = dict(zip(EPISODE_COLUMNS, line, strict=True))
        by_kind.setdefault(episode["kind"], []).append(episode)
    found = {kind: _kind(windows) for kind, windows in by_kind.items()}
    known = [account for account in accounts if account.get("faults.known")]
    if known:
        found[NONE] = _none(known)
    return dict(sorted(found.items()))


def _kind(windows: Sequence[Mapping[str, Any]]) -> KindOfFault:
    scans = sum(w["scans"] for w in windows)
    return KindOfFault(
        harmful=any(w["harmful"] for w in windows),
        strengths=tuple(sorted({w["strength"] for w in windows if w["strength"] is not None})),
        lengths_s=tuple(sorted({round(w["end_s"] - w["start_s"], 6) for w in windows})),
        scans=scans,
        flagged=rate(sum(w["flagged"] for w in windows), scans),
        episodes=len(windows),
        detected=rate(sum(w["detected"] for w in windows), len(windows)),
        delay_s=_typical(windows, "delay_s"),
        delay_scans=_typical(windows, "delay_scans"),
        recovery_s=_typical(windows, "recover_s"),
        recovery_scans=_typical(windows, "recover_scans"),
        lost=sum(w["lost"] for w in windows),
        peak_flagged=_peak(windows, "peak_flagged"),
        peak_used=_peak(windows, "peak_used"),
        peak_after=_peak(windows, "peak_after"),
    )


def _none(accounts: Sequence[Mapping[str, Any]]) -> KindOfFault:
    scans = sum(a["faults.unlabelled"] for a in accounts)
    return KindOfFault(
        harmful=False,
        strengths=(),
        lengths_s=(),
        scans=scans,
        flagged=rate(sum(a["faults.false_alarms"] for a in accounts), scans),
        peak_flagged=_peak(accounts, "faults.peak_flagged"),
        peak_used=_peak(accounts, "faults.peak_used"),
    )


def _typical(lines: Iterable[Mapping[str, Any]], name: str) -> Typical | None:
    return typical([line[name] for line in lines if line[name] is not None])


def _peak(lines: Sequence[Mapping[str, Any]], name: str) -> Peak:
    """The largest of each error over ``lines``."""
    values = ([line[f"{name}.{e}"] for line in lines if line[f"{name}.{e}"] is not None] for e in _ERRORS)
    return Peak(*(max(v, default=None) for v in values))
