"""Fault accounts of a run against labels."""

import random

import pytest

from avsreplay.records import Label
from avsreplay.report.episodes import Mark, account

NS = 1_000_000_000


def test_labels_outside_the_replayed_time_are_not_missed():
    labels = [Label("empty", a * NS, b * NS) for a, b in ((2, 4), (20, 22), (50, 60))]
    marks = [
        Mark(k * NS, 0 if 2 <= k < 4 else 1, "empty" if 2 <= k < 4 else None) for k in range(10)
    ]
    whole = account(marks, labels)
    assert (whole.injected, whole.detected, whole.missed, len(whole.episodes)) == (1, 1, 0, 1)
    late = account([Mark(k * NS, 1, None) for k in range(5, 10)], labels)
    assert (late.injected, late.missed) == (0, 0)


def test_a_window_within_the_replayed_time_counts_although_it_left_no_scan():
    """Scans 3 to 6 are not in the log: the gap is the detection; a window without scans and
    without a gap is missed.
    """
    labels = [Label("dropped", 3 * NS, 7 * NS), Label("dropped", 8 * NS + 1, 8 * NS + 2)]
    found = account([Mark(k * NS, 1, None) for k in (0, 1, 2, 7, 8, 9, 10, 11)], labels)
    assert (found.injected, found.detected, found.missed) == (2, 1, 1)


@pytest.mark.parametrize(("gamma", "detected"), [(0, 2), (1, 0)])
def test_a_window_whose_scans_all_carry_another_fault_is_judged_by_them(gamma, detected):
    labels = [Label("clutter", 3 * NS, 7 * NS), Label("bias", 4 * NS, 5 * NS)]
    marks = [
        Mark(k * NS, gamma if 3 <= k <= 7 else 1, "clutter" if 3 <= k <= 7 else None)
        for k in range(12)
    ]
    found = account(marks, labels)
    assert (found.injected, found.detected, found.missed) == (2, detected, 2 - detected)
    assert [episode.scans for episode in found.episodes] == [5, 0]


@pytest.mark.parametrize("longest", [2, 15])  # windows that are apart, and windows that overlap
def test_a_scan_belongs_to_the_nearest_window_of_its_kind(longest):
    rng = random.Random(longest)
    for _ in range(50):
        windows = [(10 * k, 10 * k + rng.randint(0, longest), rng.choice("ab")) for k in range(8)]
        rng.shuffle(windows)
        labels = [Label(kind, start * NS, end * NS) for start, end, kind in windows]
        marks = [
            Mark(k * NS, rng.randint(0, 1), rng.choice(("a", "b", None))) for k in range(-2, 90)
        ]
        expected = [0] * len(labels)
        for mark in marks:
            t = mark.t_ns // NS
            far = [
                (max(start - t, t - end, 0), i)
                for i, (start, end, kind) in enumerate(windows)
                if kind == mark.fault
            ]
            for _, nearest in sorted(far)[:1]:
                expected[nearest] += 1
        assert [episode.scans for episode in account(marks, labels).episodes] == expected
