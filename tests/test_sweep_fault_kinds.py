"""Faults by kind: from runs' accounts to one line a kind, against sums made by hand; any order, the same."""

import itertools
import json
from pathlib import Path

import estimate_faults
import pytest

from avsreplay import settings, toml_document
from avsreplay.report.episodes import Episode, Peak
from avsreplay.simulate import load_scenario
from avsreplay.simulate.faults import Kind
from avsreplay.sweep import Journal, expand, load_campaign
from avsreplay.sweep.execute import RunResult
from avsreplay.sweep.fault_kinds import EPISODE_COLUMNS, FaultKinds, episode_lines
from avsreplay.sweep.statistics import Typical, typical

CAMPAIGN = Path(__file__).parent.parent / "docs" / "campaigns" / "faults.toml"


def kinds_of_fault(lines, metrics):
    """The windows as one run's, then the metrics as those of runs without a window."""
    kinds = FaultKinds()
    kinds.add(lines, {})
    for each in metrics:
        kinds.add([], each)
    return kinds.result()


def episode(kind="frozen", **changes):
    plain = {"harmful": True, "start_s": 2.0, "end_s": 4.0, "scans": 4, "flagged": 4, "detected": True}
    return Episode(kind, **{**plain, "recover_scans": 0, "recover_s": 0.0, **changes})


def account(unlabelled=100, false_alarms=1, known=True, used=0.01):
    named = {"known": known, "unlabelled": unlabelled, "false_alarms": false_alarms}
    peaks = {"peak_used.pos_err_m": used, "peak_used.rot_err_deg": 1.0}
    return {f"faults.{k}": v for k, v in {**named, **peaks}.items()} | {
        "faults.peak_flagged.pos_err_m": None,
        "faults.peak_flagged.rot_err_deg": None,
    }


EPISODES = (
    episode(delay_s=0.0, delay_scans=0, peak_flagged=Peak(0.1, 5.0), peak_after=Peak(0.2, 1.0)),
    episode(flagged=1, delay_s=1.5, delay_scans=3, peak_flagged=Peak(0.3, 2.0), peak_used=Peak(0.4, 3.0)),
    episode(flagged=0, detected=False, recover_s=None, recover_scans=None, lost=True, end_s=8.0, scans=12),
    episode("clutter", harmful=False, flagged=0, detected=False, recover_s=None, recover_scans=None, strength=0.5),
    episode("dropped", scans=0, flagged=0, recover_s=1.0, recover_scans=2, peak_after=Peak(0.5, 0.5)),
)


def test_kinds_are_summed_over_their_windows():
    kinds = kinds_of_fault(episode_lines(EPISODES), [account(), account(50, 2, used=0.02), account(10, 9, known=False)])
    assert list(kinds) == ["clutter", "dropped", "frozen", "none"]
    frozen = kinds["frozen"]
    assert (frozen.episodes, frozen.scans, frozen.lost, frozen.lengths_s) == (3, 20, 1, (2.0, 6.0))
    assert (frozen.flagged.successes, frozen.flagged.count) == (5, 20)
    assert (frozen.detected.successes, frozen.detected.count) == (2, 3)
    assert (frozen.delay_s, frozen.delay_scans) == (Typical(2, 0.75, 1.5), Typical(2, 1.5, 3.0))
    assert frozen.recovery_s == Typical(2, 0.0, 0.0)
    assert (frozen.peak_flagged, frozen.peak_used, frozen.peak_after) == (
        Peak(0.3, 5.0),
        Peak(0.4, 3.0),
        Peak(0.2, 1.0),
    )
    assert (kinds["clutter"].harmful, kinds["clutter"].strengths) == (False, (0.5,))
    none = kinds["none"]
    assert (none.flagged.successes, none.flagged.count, none.episodes) == (3, 150, 0)
    assert (none.peak_used, none.peak_flagged) == (Peak(0.02, 1.0), Peak())


def test_a_kind_without_scans_has_a_row():
    dropped = kinds_of_fault(episode_lines(EPISODES), [])["dropped"]
    assert (dropped.scans, dropped.flagged, dropped.episodes, dropped.detected.share) == (0, None, 1, 1.0)
    assert (dropped.delay_s, dropped.recovery_s, dropped.recovery_scans) == (
        None,
        Typical(1, 1.0, 1.0),
        Typical(1, 2, 2),
    )


def test_the_order_of_the_runs_does_not_matter():
    lines = episode_lines(EPISODES)
    for turned in itertools.permutations(lines):
        assert kinds_of_fault(turned, [account()]) == kinds_of_fault(lines, [account()])


def test_without_labels_nothing_is_called_a_false_alarm():
    assert kinds_of_fault([], [account(known=False)]) == {}


def test_the_median_of_an_even_count_lies_between():
    assert typical([]) is None
    assert typical([3.0]) == Typical(1, 3.0, 3.0)
    assert typical([4.0, 1.0, 2.0, 9.0]) == Typical(4, 3.0, 9.0)


def test_windows_survive_the_journal(tmp_path):
    lines = episode_lines(EPISODES)
    assert {len(line) for line in lines} == {len(EPISODE_COLUMNS)}
    with Journal(tmp_path) as journal:
        journal.add(RunResult("ab", "ok", None, {}, (), lines))
    assert Journal(tmp_path).result("ab").episodes == lines


def test_the_campaign_of_faults_has_every_kind_at_three_strengths():
    tasks = [point.task for point in expand(load_campaign(CAMPAIGN)).points() if point.repeat == 0]
    how = {kind: set() for kind in Kind}
    for task in tasks:
        for fault in toml_document.parse(task.scenario, "scenario").table["fault"]:
            strength = fault.get("strength")
            how[Kind(fault["kind"])].add(fault["duration_s"] if strength is None else strength)
    assert {kind.value: len(found) for kind, found in how.items()} == {kind.value: 3 for kind in Kind}


@pytest.mark.parametrize("name", ["weak", "medium", "strong"])
def test_windows_of_the_campaign_do_not_overlap(name):
    params = load_scenario(CAMPAIGN.parent.parent / "scenarios" / f"faults-{name}.toml").params
    ends = [(f.start_s, f.start_s + f.duration_s) for f in params.fault]
    assert all(a[1] + 4.0 < b[0] for a, b in itertools.pairwise(ends))
    assert ends[-1][1] + 4.0 < params.duration_s


def test_the_table_for_the_docs_has_a_line_a_kind_and_strength():
    kinds = settings.dump(kinds_of_fault(episode_lines(EPISODES), [account()]))
    cells = [
        {"values": {"scenario": f"s/faults-{name}.toml", "run.faults.policy": policy}, "runs": 2, "kinds": kinds}
        for name in ("weak", "strong")
        for policy in ("any", "all")
    ]
    said = estimate_faults.tables(json.loads(json.dumps({"cells": cells})))
    assert [line for line in said.splitlines() if line.startswith("`")] == [
        f"`faults.policy = {policy}`, runs of each strength: 2:" for policy in ("any", "all")
    ]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in said.splitlines() if line.startswith("| ")]
    assert {len(row) for row in rows} == {len(estimate_faults.HEADS)}
    assert [row[:2] for row in rows[2:10]] == [
        *(["none (false alarms)", name] for name in ("weak", "strong")),
        *(["clutter (harmless)", f"{name}: 0.5, 2 s"] for name in ("weak", "strong")),
        *(["dropped", f"{name}: 2 s"] for name in ("weak", "strong")),
        *(["frozen", f"{name}: 2 s, 6 s"] for name in ("weak", "strong")),
    ]
    assert rows[8][2:] == [
        "5 of 20 (25 %)",
        "2 of 3",
        "0.75 (1.5), 1.5 (3)",
        "0 (0), 0 (0)",
        "1",
        "300 mm, 5°",
        "400 mm, 3°",
        "200 mm, 1°",
    ]
