"""Long computations in parts: the same result, and any earlier state may be continued again."""

from __future__ import annotations

from dataclasses import replace

import estimate_surprises as surprises
import numpy as np
import pytest

from avsreplay.estimate.disturbance_schedule import DisturbanceSchedule
from avsreplay.estimate.track import Track
from avsreplay.estimate.work import BUDGET, Parts, Work, whole


def counted(sizes: list[int], log: list[int]) -> Parts[int]:
    for k, size in enumerate(sizes):
        log.append(k)
        yield size
    return len(sizes)


def test_each_scan_does_the_parts_of_its_budget() -> None:
    log: list[int] = []
    work, done = Work(counted([BUDGET, BUDGET // 2, BUDGET // 2, 3 * BUDGET, 1], log)), []
    while not work.done:
        work = work.continued()
        done.append(len(log))
    assert done == [1, 3, 4, 5]
    assert work.result == 5
    assert whole(counted([1, 2, 3], [])) == 3


def test_an_earlier_state_may_be_continued_again() -> None:
    log: list[int] = []
    first = Work(counted([BUDGET, BUDGET], log))
    second = first.continued()
    third = second.continued()
    assert first.continued() is second
    assert second.continued() is third
    assert log == [0, 1]


@pytest.mark.parametrize("budget", [BUDGET, 10**9])
def test_the_drift_that_is_found_does_not_depend_on_the_budget(monkeypatch: pytest.MonkeyPatch, budget: int) -> None:
    """1e-4 rad/s2, poses of 0.5 mm: whether a scan does one part of the test or all of it."""
    monkeypatch.setattr("avsreplay.estimate.work.BUDGET", budget)
    monkeypatch.setattr(surprises, "POS_M", 5e-4)
    monkeypatch.setattr(surprises, "ROT_RAD", np.radians(0.03))
    spread: list[int] = []
    advanced = DisturbanceSchedule.advanced

    def counting(self: DisturbanceSchedule, track: Track, tested: bool) -> Track:
        after = advanced(self, track, tested)
        spread.append(after.testing is not None)
        return after

    monkeypatch.setattr(DisturbanceSchedule, "advanced", counting)
    result = surprises.run(replace(surprises.Case("torque"), torque=1e-4, seconds=50.0), 3)
    assert result.track is not None
    drift = result.track.drift
    assert drift is not None
    assert abs(float(np.linalg.norm(drift.rate)) - 1e-4) < 4.0 * np.sqrt(np.trace(drift.P[:3, :3]))
    assert any(spread) == (budget == BUDGET)
    assert not any(c and r > 4.0 for c, r in zip(result.converged, result.ratio, strict=True))
    assert max(result.ratio[-5:]) < 4.0
