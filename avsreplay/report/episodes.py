"""Compares the injected faults of a log with the decisions of the fault detector.

A label marks the scans that an injected fault affects. Its ``harmful`` states that these scans are
unusable and that the detector must flag them (gamma 0); otherwise either decision is right. A fault
with unusable scans is *detected* where at least one of its scans has gamma 0 or, where no scan came
at all, where a gap covers it. Where all scans in its window carry the label of another fault, these
scans decide. A flagged scan without a label is a *false alarm*. A *gap* is an interval between
scans longer than 1.5 times the median interval.

Recovery is assessed by gamma alone: an estimate that followed wrong poses agrees with the next ones
and counts as healthy. The effect of a fault is seen in the errors of the estimate over its flagged
scans, its used scans and the scans after it.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import field
from itertools import pairwise, takewhile
from typing import NamedTuple

from avsreplay.errors import value_class
from avsreplay.records import Label
from avsreplay.report.summary_parts import median

GAP_STEPS = 1.5  # least gap between two scans, in median intervals


class Mark(NamedTuple):
    """The values of a row that the comparison of faults and decisions needs."""

    t_ns: int
    gamma: int
    fault: str | None
    pos_err_m: float | None = None
    rot_err_deg: float | None = None


@value_class(eq=True)
class Peak:
    """The largest position [m] and attitude error [deg] over some scans; None where the log has no
    truth, or without a scan.
    """

    pos_err_m: float | None = None
    rot_err_deg: float | None = None

    @classmethod
    def of(cls, marks: Iterable[Mark]) -> Peak:
        """Return the largest errors over ``marks``; errors that are None are ignored."""
        listed = list(marks)
        return cls(
            max((m.pos_err_m for m in listed if m.pos_err_m is not None), default=None),
            max((m.rot_err_deg for m in listed if m.rot_err_deg is not None), default=None),
        )


@value_class(eq=True)
class Episode:
    """One injected fault, from its first to its last scan, and what the detector decided.

    Attributes:
        start_s, end_s: begin and end of its window, in seconds since the first scan.
        scans: number of rows that carry it.
        flagged: number of these rows with gamma 0.
        detected: whether it was detected, as the module defines it.
        recover_scans: number of scans without a label after it that were still flagged.
        recover_s: time from the first scan without a label after it to the first healthy scan, 0 if
            that is the same scan. None where neither the fault nor the scan after it was flagged,
            so that there is nothing to recover from, and where no recovery followed.
        strength: the strength that its label states.
        delay_scans, delay_s: scans and seconds from its first scan to the first flagged one; None
            where no scan was flagged.
        lost: whether scans without a label came after it and none of them was healthy.
        peak_flagged, peak_used: largest errors over its scans with gamma 0, and over those with
            gamma 1.
        peak_after: largest errors over the healthy scans without a label after it, up to the next
            label.
    """

    kind: str
    harmful: bool
    start_s: float
    end_s: float
    scans: int
    flagged: int
    detected: bool
    recover_scans: int | None
    recover_s: float | None
    strength: float | None = None
    delay_scans: int | None = None
    delay_s: float | None = None
    lost: bool = False
    peak_flagged: Peak = field(default_factory=Peak)
    peak_used: Peak = field(default_factory=Peak)
    peak_after: Peak = field(default_factory=Peak)


@value_class(eq=True)
class FaultAccount:
    """The injected faults of a log and the decisions on all its scans.

    Attributes:
        known: whether the log states the injected faults; without that a flagged scan is no proven
            false alarm.
        injected, detected, missed: number of faults with unusable scans, and of those detected and
            missed.
        harmful_scans, missed_scans: number of unusable scans, and of those with gamma 1.
        false_alarms: number of flagged scans without a label, of ``unlabelled`` scans.
        peak_flagged, peak_used: largest errors over the scans without a label with gamma 0, and
            over those with gamma 1.
    """

    known: bool
    injected: int
    detected: int
    missed: int
    harmful_scans: int
    missed_scans: int
    unlabelled: int
    false_alarms: int
    episodes: tuple[Episode, ...]
    peak_flagged: Peak = field(default_factory=Peak)
    peak_used: Peak = field(default_factory=Peak)

    @property
    def false_alarm_rate(self) -> float:
        """Number of false alarms over the number of scans without a label."""
        return self.false_alarms / self.unlabelled if self.unlabelled else 0.0

    @property
    def longest_recovery_s(self) -> float | None:
        """The longest time to recover [s]."""
        return max((e.recover_s for e in self.episodes if e.recover_s is not None), default=None)


@value_class(eq=True)
class Coast:
    """Consecutive scans with gamma 0, and the pose error at the last of them."""

    start_s: float
    scans: int
    duration_s: float
    pos_err_m: float | None
    rot_err_deg: float | None


def gaps(t_ns: Sequence[int]) -> list[tuple[int, int]]:
    """Return the instants [ns] before and after every interval longer than ``GAP_STEPS`` times the
    median interval.

    Args:
        t_ns: stamps of the scans in order [ns].
    """
    steps = [b - a for a, b in pairwise(t_ns) if b > a]
    if not steps:
        return []
    limit = GAP_STEPS * median(steps)
    return [(a, b) for a, b in pairwise(t_ns) if b - a > limit]


def account(marks: Sequence[Mark], labels: Sequence[Label] | None) -> FaultAccount:
    """Compare rows with labels.

    Args:
        marks: the values of the rows, one per scan in their order.
        labels: the injected faults; where there are none, they are taken from the column ``fault``
            of the rows.

    Returns:
        The faults, what was detected of them, and the false alarms.
    """
    known = labels is not None or any(m.fault is not None for m in marks)
    labels = _labels_of(marks) if labels is None else labels
    labels, members = _replayed(marks, labels, _members(marks, labels))
    holes = gaps([m.t_ns for m in marks])
    t0 = marks[0].t_ns if marks else 0
    nexts = _nexts(labels)
    episodes = tuple(
        _episode(label, members[i], marks, holes, t0, nexts[i]) for i, label in enumerate(labels)
    )
    harmful = [i for i, label in enumerate(labels) if label.harmful]
    scans = [k for i in harmful for k in members[i]]
    free = [m for m in marks if m.fault is None]
    detected = sum(episodes[i].detected for i in harmful)
    return FaultAccount(
        known=known,
        injected=len(harmful),
        detected=detected,
        missed=len(harmful) - detected,
        harmful_scans=len(scans),
        missed_scans=sum(marks[k].gamma == 1 for k in scans),
        unlabelled=len(free),
        false_alarms=sum(m.gamma == 0 for m in free),
        episodes=episodes,
        peak_flagged=Peak.of(m for m in free if m.gamma == 0),
        peak_used=Peak.of(m for m in free if m.gamma == 1),
    )


def _replayed(
    marks: Sequence[Mark], labels: Sequence[Label], members: list[list[int]]
) -> tuple[list[Label], list[list[int]]]:
    """The labels that have scans or lie within the replayed time, so that others do not count as
    missed.
    """
    stamps = [m.t_ns for m in marks if m.fault is None] or [m.t_ns for m in marks]
    first, last = min(stamps, default=0), max(stamps, default=-1)
    kept = [
        i
        for i, label in enumerate(labels)
        if members[i] or (label.start_ns <= last and label.end_ns > first)
    ]
    return [labels[i] for i in kept], [members[i] for i in kept]


def _labels_of(marks: Sequence[Mark]) -> list[Label]:
    """One harmful label for each run of rows with the same fault."""
    out: list[Label] = []
    for before, mark in zip([None, *marks], marks, strict=False):
        if mark.fault is None:
            continue
        if before is not None and before.fault == mark.fault:
            out[-1] = Label(mark.fault, out[-1].start_ns, mark.t_ns)
        else:
            out.append(Label(mark.fault, mark.t_ns, mark.t_ns))
    return out


def _members(marks: Sequence[Mark], labels: Sequence[Label]) -> list[list[int]]:
    """Rows of each label: those of its kind to whose stamp its window is the nearest (a fault
    may shift stamps).
    """
    out: list[list[int]] = [[] for _ in labels]
    kinds: dict[str | None, list[int]] = {}
    for i, label in sorted(enumerate(labels), key=lambda item: item[1].start_ns):
        kinds.setdefault(label.kind, []).append(i)
    starts = {kind: [labels[i].start_ns for i in same] for kind, same in kinds.items()}
    apart = {
        kind: all(labels[i].end_ns < labels[j].start_ns for i, j in pairwise(same))
        for kind, same in kinds.items()
    }
    for k, mark in enumerate(marks):
        if same := kinds.get(mark.fault):
            place = bisect_right(starts[mark.fault], mark.t_ns)
            # the windows do not overlap, so that only the neighbours of the stamp can be the
            # nearest
            near = same[max(place - 1, 0) : place + 1] if apart[mark.fault] else same
            out[min(near, key=lambda i: (_distance(labels[i], mark.t_ns), i))].append(k)
    return out


def _distance(label: Label, t_ns: int) -> int:
    return max(label.start_ns - t_ns, t_ns - label.end_ns, 0)


def _episode(
    label: Label,
    rows: Sequence[int],
    marks: Sequence[Mark],
    holes: Sequence[tuple[int, int]],
    t0: int,
    next_ns: int | None,
) -> Episode:
    own = [marks[k] for k in rows]
    flagged = [m for m in own if m.gamma == 0]
    missing = not rows and any(a <= label.end_ns and label.start_ns <= b for a, b in holes)
    behind = rows[-1] + 1 if rows else bisect_right(marks, label.end_ns, key=lambda m: m.t_ns)
    begin = behind if rows else bisect_left(marks, label.start_ns, key=lambda m: m.t_ns)
    shared = (m for m in marks[begin:behind] if m.fault is not None)

    def after() -> Iterator[Mark]:
        return (marks[k] for k in range(behind, len(marks)))

    recover_scans, recover_s, lost = _recovery(after, disturbed=bool(flagged) or missing)
    delay_scans, delay_s = _first(own, gamma=0)
    return Episode(
        kind=label.kind,
        harmful=label.harmful,
        start_s=(label.start_ns - t0) * 1e-9,
        end_s=(label.end_ns - t0) * 1e-9,
        scans=len(rows),
        flagged=len(flagged),
        detected=missing or any(m.gamma == 0 for m in flagged or shared),
        recover_scans=recover_scans,
        recover_s=recover_s,
        strength=label.strength,
        delay_scans=delay_scans,
        delay_s=delay_s,
        lost=lost,
        peak_flagged=Peak.of(flagged),
        peak_used=Peak.of(m for m in own if m.gamma == 1),
        peak_after=Peak.of(m for m in _until_next(after(), next_ns) if m.gamma == 1),
    )


def _recovery(
    after: Callable[[], Iterator[Mark]], *, disturbed: bool
) -> tuple[int | None, float | None, bool]:
    """Scans and seconds from the first scan without a fault to the first healthy one, None where
    there was nothing to recover from, and whether no such scan was healthy.
    """
    scans, seconds = _first((m for m in after() if m.fault is None), gamma=1)
    if scans is None:
        return None, None, any(m.fault is None for m in after())
    return (scans, seconds, False) if disturbed or scans else (None, None, False)


def _first(marks: Iterable[Mark], gamma: int) -> tuple[int, float] | tuple[None, None]:
    """Scans and seconds from the first of ``marks`` to the first of them with ``gamma``; None
    where none has it.
    """
    begin: Mark | None = None
    for place, mark in enumerate(marks):
        begin = begin or mark
        if mark.gamma == gamma:
            return place, (mark.t_ns - begin.t_ns) * 1e-9
    return None, None


def _until_next(marks: Iterable[Mark], next_ns: int | None) -> Iterable[Mark]:
    """The first of ``marks`` up to a label; one that begins at ``next_ns`` may have left no
    scan.
    """
    return takewhile(lambda m: m.fault is None and (next_ns is None or m.t_ns < next_ns), marks)


def _nexts(labels: Sequence[Label]) -> list[int | None]:
    """The begin of the next label after the end of each label."""
    starts = sorted(label.start_ns for label in labels)
    places = [bisect_left(starts, max(label.end_ns, label.start_ns + 1)) for label in labels]
    return [starts[k] if k < len(starts) else None for k in places]


def coasts(marks: Sequence[Mark]) -> list[Coast]:
    """Return all runs of consecutive scans with gamma 0. The duration of one is the time from the
    last healthy scan before it to its last scan.

    Args:
        marks: instant and gamma of each scan.
    """
    out: list[Coast] = []
    begin: int | None = None
    for k, mark in enumerate(marks):
        if mark.gamma == 1:
            begin = None
            continue
        if begin is None:
            begin = k
        else:
            out.pop()
        out.append(_coast(marks, begin, k))
    return out


def _coast(marks: Sequence[Mark], begin: int, end: int) -> Coast:
    before, last = marks[max(begin - 1, 0)], marks[end]
    seconds = (last.t_ns - before.t_ns) * 1e-9
    start_s = (marks[begin].t_ns - marks[0].t_ns) * 1e-9
    return Coast(start_s, end - begin + 1, seconds, last.pos_err_m, last.rot_err_deg)
