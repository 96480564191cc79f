"""Long computations in parts: the same result, and any earlier state may be continued again."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import estimate_surprises as surprises
import numpy as np
import pytest

from avsreplay.checkpoint import pack, unpack
from avsreplay.estimate import Estimator
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
    work, done = Work[int](), []
    begin = partial(counted, [BUDGET, BUDGET // 2, BUDGET // 2, 3 * BUDGET, 1], log)
    while not work.done:
        work = work.continued(begin)
        done.append(len(log))
    assert done == [1, 3, 4, 5]
    assert work.result == 5
    assert whole(counted([1, 2, 3], [])) == 3


def test_an_earlier_state_may_be_continued_again() -> None:
    log: list[int] = []
    begin = partial(counted, [BUDGET, BUDGET], log)
    first = Work[int]()
    second = first.continued(begin)
    third = second.continued(begin)
    assert first.continued(begin) is second
    assert second.continued(begin) is third
    assert log == [0, 1]


@pytest.mark.parametrize("packed", range(4))
def test_a_computation_continues_from_a_checkpoint(packed: int, tmp_path: Path) -> None:
    begin = partial(counted, [BUDGET, BUDGET // 2, BUDGET // 2, BUDGET], [])
    work, scans = Work[int](), 0
    while not work.done:
        if scans == packed:
            (tmp_path / "work").write_bytes(pack(work, {}))
            work = unpack(tmp_path / "work", {})
        work, scans = work.continued(begin), scans + 1
    assert (work.result, scans) == (4, 4)


def test_a_track_that_is_read_from_a_checkpoint_after_every_scan_has_the_same_bits(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    case = surprises.Case("torque", torque=1e-4, seconds=45.0)
    want, step, spread = surprises.run(case, 3).track, Estimator.step, []

    def packed(self: Estimator, track: Track, *rest: Any) -> Any:
        spread.append(track.fitting is not None or track.testing is not None)
        (tmp_path / "track").write_bytes(pack(track, {}))
        return step(self, unpack(tmp_path / "track", {}), *rest)

    monkeypatch.setattr(Estimator, "step", packed)
    found = surprises.run(case, 3).track
    assert want is not None
    assert found is not None
    assert any(spread)
    assert (found.belief.P == want.belief.P).all()
    assert (found.belief.x.q_ab == want.belief.x.q_ab).all()
    assert (found.belief.x.c_b == want.belief.x.c_b).all()


@pytest.mark.parametrize("budget", [BUDGET, 10**9])
def test_the_drift_that_is_found_does_not_depend_on_the_budget(
    monkeypatch: pytest.MonkeyPatch, budget: int
) -> None:
    """1e-4 rad/s2, poses of 0.5 mm: found at 52.5 s where a scan does the whole test, else
    six scans later.
    """
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
    result = surprises.run(replace(surprises.Case("torque"), torque=1e-4, seconds=60.0), 2)
    assert result.track is not None
    drift = result.track.drift
    assert drift is not None
    assert abs(float(np.linalg.norm(drift.rate)) - 1e-4) < 4.0 * np.sqrt(np.trace(drift.P[:3, :3]))
    assert any(spread) == (budget == BUDGET)
    assert not any(
        c and r > surprises.LIMIT for c, r in zip(result.converged, result.pose, strict=True)
    )
    assert max(result.pose[-5:]) < surprises.LIMIT
