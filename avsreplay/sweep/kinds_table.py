"""The faults by kind as lines of words, the same for page and terminal: by kind, then by combination."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from avsreplay.report.episodes import Peak
from avsreplay.sweep.kinds import NONE, KindOfFault
from avsreplay.sweep.statistics import Rate, Typical
from avsreplay.sweep.summary import Cell

__all__ = ["KIND_HEADS", "kind_rows"]

KIND_HEADS = (
    "fault",
    "no.",
    "strength,\nlength",
    "scans\nflagged",
    "windows\nfound",
    "delay,\nworst",
    "recovery,\nworst",
    "lost",
    "worst\nflagged",
    "worst\nused",
    "worst\nafter",
)


def kind_rows(cells: Sequence[tuple[int, Cell]]) -> Iterator[tuple[str, ...]]:
    """One line a kind of fault and combination, in the order of KIND_HEADS; a harmless kind carries a ``~``.

    Times are in s; errors are position [mm] and rotation [deg] of the estimate. "none" comes first: what is flagged
    there is a false alarm.
    """
    names = {name for _, cell in cells for name in cell.kinds}
    for name in sorted(names, key=lambda name: (name != NONE, name)):
        for number, cell in cells:
            if name in cell.kinds:
                yield _row(name, number, cell.kinds[name])


def _row(name: str, number: int, kind: KindOfFault) -> tuple[str, ...]:
    harmless = name != NONE and not kind.harmful
    return (
        f"{name} ~" if harmless else name,
        str(number),
        ", ".join([*(f"{s:g}" for s in kind.strengths), *(f"{length:g} s" for length in kind.lengths_s)]),
        _share(kind.flagged),
        _count(kind.detected),
        _typical(kind.delay_s),
        _typical(kind.recovery_s),
        str(kind.lost) if kind.episodes else "",
        *(_peak(peak) for peak in (kind.peak_flagged, kind.peak_used, kind.peak_after)),
    )


def _share(found: Rate | None) -> str:
    return "" if found is None else f"{found.share:.1%}"


def _count(found: Rate | None) -> str:
    return "" if found is None else f"{found.successes}/{found.count}"


def _typical(found: Typical | None) -> str:
    return "" if found is None else f"{found.median:.3g}, {found.worst:.3g}"


def _peak(peak: Peak) -> str:
    if peak.pos_err_m is None or peak.rot_err_deg is None:
        return ""
    return f"{_short(1000.0 * peak.pos_err_m)}, {_short(peak.rot_err_deg)}"


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 100.0 else f"{value:.2g}" if value >= 0.01 else f"{value:.3f}"
