"""Fault accounts of a run against labels."""

from avsreplay.records import Label
from avsreplay.report.episodes import Mark, account

NS = 1_000_000_000


def test_labels_outside_the_replayed_time_are_not_missed():
    labels = [Label("empty", a * NS, b * NS) for a, b in ((2, 4), (20, 22), (50, 60))]
    marks = [Mark(k * NS, 0 if 2 <= k < 4 else 1, "empty" if 2 <= k < 4 else None) for k in range(10)]
    whole = account(marks, labels)
    assert (whole.injected, whole.detected, whole.missed, len(whole.episodes)) == (1, 1, 0, 1)
    late = account([Mark(k * NS, 1, None) for k in range(5, 10)], labels)
    assert (late.injected, late.missed) == (0, 0)


def test_a_window_within_the_replayed_time_counts_although_it_left_no_scan():
    """Scans 3 to 6 are not in the log: the gap is the detection; a window without scans and without a gap is missed."""
    labels = [Label("dropped", 3 * NS, 7 * NS), Label("dropped", 8 * NS + 1, 8 * NS + 2)]
    found = account([Mark(k * NS, 1, None) for k in (0, 1, 2, 7, 8, 9, 10, 11)], labels)
    assert (found.injected, found.detected, found.missed) == (2, 1, 1)
