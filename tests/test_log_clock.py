"""The clock rule: which stamps are used, which are replaced, and by which time."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from avsreplay.log.clock import place
from avsreplay.log.options import ClockChoice

SECOND = 1_000_000_000
STEP = SECOND // 5
START = 1_700_000_000 * SECOND


def clocks(n: int = 60, offset_ns: int = 0) -> tuple[list[int], list[int]]:
    """Recorder and header times of a log at 5 Hz."""
    log = [START + i * STEP for i in range(n)]
    return log, [t + offset_ns for t in log]


def judged(log: list[int], header: list[int], choice: ClockChoice = ClockChoice.HEADER):  # type: ignore[no-untyped-def]
    placed, summary = place(log, log, header, choice)
    times = [p.t_ns for p in placed]
    assert all(a < b for a, b in pairwise(times)), "instants go forward whatever the stamps do"
    return times, [i for i, p in enumerate(placed) if p.note], summary


@pytest.mark.parametrize("offset", [0, 37, -SECOND // 4, 20_000_000 * SECOND, -20_000_000 * SECOND])
def test_a_constant_offset_between_the_clocks_is_accepted(offset: int) -> None:
    log, header = clocks(offset_ns=offset)
    times, noted, summary = judged(log, header)
    assert times == header
    assert noted == []
    assert summary.offset_s == pytest.approx(offset * 1e-9, abs=1e-6)


def test_jitter_of_the_log_clock_is_accepted() -> None:
    log, header = clocks()
    rng = np.random.Generator(np.random.PCG64(1))
    log = [t + int(j) for t, j in zip(log, rng.integers(0, STEP // 2, len(log)), strict=True)]
    times, noted, _ = judged(log, header)
    assert times == header
    assert noted == []


def test_drift_of_200_ppm_over_an_hour_is_followed() -> None:
    log, _ = clocks(18_000)
    header = [START + round((t - START) * 1.0002) for t in log]
    times, noted, summary = judged(log, header)
    assert times == header
    assert noted == []
    assert summary.header_steps == summary.log_steps == 0


@pytest.mark.parametrize("at", [0, 1, 8, 30, 59])
@pytest.mark.parametrize(
    "jump", [3 * SECOND, -3 * SECOND, 40_000_000 * SECOND, -40_000_000 * SECOND]
)
@pytest.mark.parametrize("long", [1, 2])
def test_isolated_wrong_stamps_are_replaced_by_the_log_clock(at: int, jump: int, long: int) -> None:
    log, header = clocks(offset_ns=123_456)
    right = list(header)
    hit = [i for i in range(at, at + long) if i < len(header)]
    for i in hit:
        header[i] += jump
    times, noted, summary = judged(log, header)
    assert noted == hit
    assert times == right
    assert summary.jumps == len(hit)


def test_an_unset_stamp_is_replaced_by_the_log_clock() -> None:
    log, header = clocks()
    right = list(header)
    header[20] = header[21] = 0
    times, noted, summary = judged(log, header)
    assert times == right
    assert noted == [20, 21]
    assert summary.unset == 2


def test_a_log_without_stamps_uses_the_log_clock() -> None:
    log, _ = clocks()
    times, noted, summary = judged(log, [0] * len(log))
    assert times == log
    assert noted == []
    assert "never set" in summary.note


def test_clocks_that_start_at_zero_are_accepted() -> None:
    log = [i * STEP for i in range(20)]
    times, noted, _ = judged(log, list(log))
    assert times == log
    assert noted == []


def test_equal_stamps_and_steps_back() -> None:
    log, header = clocks()
    right = list(header)
    header[10] = header[9]
    header[30] = header[28]
    times, noted, summary = judged(log, header)
    assert (summary.equal, summary.back) == (1, 1)
    assert noted == [10, 30]
    assert times == right


def test_a_constant_stamp_is_not_a_clock_step() -> None:
    log, header = clocks()
    right = list(header)
    header[20:] = [header[19]] * 40
    times, noted, _ = judged(log, header)
    assert noted == list(range(20, 60))
    assert times == right


def test_a_permanent_step_of_the_header_clock_is_followed_from_the_third_scan_on() -> None:
    log, header = clocks()
    right = list(header)
    stepped = header[:25] + [t + 7200 * SECOND for t in header[25:]]
    times, noted, summary = judged(log, stepped)
    assert noted == [25, 26]
    assert summary.header_steps == 1
    assert times == right, "t_ns goes on without a break"


def test_a_step_of_the_log_clock_does_not_change_the_stamps() -> None:
    log, header = clocks()
    stepped = log[:25] + [t + 3600 * SECOND for t in log[25:]]
    times, noted, summary = judged(stepped, header)
    assert times == header
    assert noted == []
    assert summary.log_steps == 1


def test_a_gap_in_the_log_is_not_a_jump() -> None:
    log, header = clocks()
    kept = [i for i in range(60) if not 20 <= i < 45]
    times, noted, _ = judged([log[i] for i in kept], [header[i] for i in kept])
    assert times == [header[i] for i in kept]
    assert noted == []


def test_the_chosen_clock_is_used() -> None:
    log, header = clocks(offset_ns=5 * SECOND)
    publish = [t - 7 for t in log]
    assert [p.t_ns for p in place(log, publish, header, ClockChoice.LOG)[0]] == log
    assert [p.t_ns for p in place(log, publish, header, ClockChoice.PUBLISH)[0]] == publish


def test_no_scan_and_a_single_scan() -> None:
    assert place([], [], [], ClockChoice.HEADER)[0] == []
    assert [p.t_ns for p in place([START], [START], [START + 5], ClockChoice.HEADER)[0]] == [
        START + 5
    ]
    placed, summary = place([START], [START], [0], ClockChoice.HEADER)
    assert placed[0].t_ns == START
    assert "never set" in summary.note
