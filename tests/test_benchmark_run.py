"""A whole benchmark on one short scenario: results, continuation, comparison, plots."""

import json
import xml.etree.ElementTree as ElementTree
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from avsreplay.assessment import Assessment, Chance, InFact
from avsreplay.benchmark import results
from avsreplay.benchmark.prepared import Prepared
from avsreplay.benchmark.scores import MEASURES, difference, scores
from avsreplay.benchmark.work import RunScorer, capture_of, events_of, pose_nees
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import IDENTITY_QUAT, Pose, exp
from avsreplay.outcome import CaptureError
from avsreplay.plan.uncertainty import Tolerance
from avsreplay.records import Belief, Label, ScanStatus, State
from avsreplay.report.summary_parts import VelocityChange
from avsreplay.rows import Row

SHORT = ("benchmark", "--quick", "--only", "clean-fast,real-tosses", "--n-scans", 6)


def of(key):
    return next(each for each in MEASURES if each.key == key)


def run(**values):
    base = {"scenario": "a", "group": "clean", "repeat": 0, "entry": "x+own", "status": "ok"}
    return {**base, "wrong": 0, "usable": 10, "used_usable": 10, **values}


@pytest.fixture(scope="module")
def made(cli, tmp_path_factory):
    folder = tmp_path_factory.mktemp("benchmark")
    nothing = folder / "nothing"
    asked = (*SHORT, "--workers", 0, "--data", nothing, "-o", folder / "out")
    done = cli(*asked, "--backend", "horn", "--estimator", "own,ekf")
    assert done.code == 0, done.err
    return folder, done.out


@pytest.mark.slow
def test_one_table_shows_each_entry_and_the_scenario_without_data(made):
    folder, text = made
    found = results.read(folder / "out" / "benchmark.json")
    assert "horn+own" in text
    assert "horn+ekf" in text
    assert "real-tosses" in text
    assert "not available" in text
    assert [r["scans"] for r in found["runs"] if r["status"] == "ok"] == [6, 6]
    assert found["suite"]["name"] == "capture-1"
    assert "ms_per_scan" not in json.dumps(found)
    ElementTree.parse(folder / "out" / "plots" / "clean.svg")


@pytest.mark.slow
def test_the_same_command_makes_nothing_again_and_gives_the_same_bytes(made, cli):
    folder, text = made
    before = (folder / "out" / "benchmark.json").read_bytes()
    journal = (folder / "out" / "journal.txt").read_bytes()
    asked = (*SHORT, "--workers", 0, "--data", folder / "nothing", "-o", folder / "out")
    done = cli(*asked, "--backend", "horn", "--estimator", "own,ekf")
    assert done.out == text
    assert (folder / "out" / "benchmark.json").read_bytes() == before
    assert (folder / "out" / "journal.txt").read_bytes() == journal


@pytest.mark.slow
def test_workers_give_the_bytes_of_one_process(made, cli):
    pytest.importorskip("distributed", reason="Dask is not installed")
    folder, _ = made
    asked = (*SHORT, "--workers", 2, "--data", folder / "nothing", "-o", folder / "two")
    done = cli(*asked, "--backend", "horn", "--estimator", "own,ekf", "--details")
    assert done.code == 0, done.err
    assert "Runs of horn+ekf" in done.out
    one, two = (folder / name / "benchmark.json" for name in ("out", "two"))
    assert one.read_bytes() == two.read_bytes()


@pytest.mark.slow
def test_compare_reads_two_results(made, cli):
    folder, _ = made
    path = folder / "out" / "benchmark.json"
    done = cli("compare", path, path)
    assert done.code == 0, done.err
    assert "2 of 2 runs agree" in done.out
    other = json.loads(path.read_text())
    other["suite"]["seed"] = 1
    (folder / "other.json").write_text(json.dumps(other))
    assert cli("compare", path, folder / "other.json").code == 2


def test_without_a_directory_the_command_says_what_to_add(cli):
    done = cli("benchmark")
    assert done.code == 2
    assert "-o DIR" in done.err


def test_the_list_describes_every_scenario_and_its_data(cli):
    done = cli("benchmark", "--list")
    assert done.code == 0
    assert done.out.count(" (hard)") == 5
    assert "Stanford 3D Scanning Repository" in " ".join(done.out.split())


def test_a_wrong_pose_is_counted_by_run_and_in_total():
    found = scores([run(wrong=0), run(wrong=7), run(wrong=0), run(wrong=1)])["wrong"]
    assert (found.value, found.count, found.total) == (0.5, 4, 8)
    assert 0.0 < found.low < 0.5 < found.high < 1.0


def test_a_failed_run_uses_no_scan_and_has_no_error():
    failed = {k: v for k, v in run().items() if k not in ("wrong", "usable", "used_usable")}
    found = scores([run(), {**failed, "status": "failed"}])
    assert found["failed"].total == 1
    assert found["used"].count == 1


def test_shares_are_those_of_the_usable_scans():
    found = scores([run(used_usable=5), run(used_usable=10)])["used"]
    assert found.value == 0.75
    assert found.low <= 0.75 <= found.high


def test_a_difference_is_called_better_only_with_evidence():
    base = [run(attitude_deg=1.0 + 0.01 * k) for k in range(8)]
    other = [run(attitude_deg=0.5 + 0.02 * k) for k in range(8)]
    measure = of("attitude_deg")
    assert difference("x", measure, base, other).word == "better"
    assert difference("x", measure, other, base).word == "worse"
    assert difference("x", measure, base, base).word == "same"
    assert difference("x", measure, base[:1], other[:1]).word == "no evidence"
    assert difference("x", of("brier"), base, other) is None


def test_rows_with_different_names_are_compared_where_each_result_has_one():
    base = results.document(SUITE, [], [run(captured=0.0)])
    other = results.document(SUITE, [], [run(entry="mine+own", captured=1.0)])
    found, (agreeing, count) = results.compared(base, other)
    assert (agreeing, count) == (0, 1)
    assert {each.entry for each in found} == {"x+own -> mine+own"}
    two = results.document(SUITE, [], [run(entry="mine+own"), run(entry="other+own")])
    with pytest.raises(UsageError, match="no entry"):
        results.compared(base, two)


SUITE = {"name": "s", "sha256": "0" * 64, "seed": 1, "repeats": 1, "n_scans": None}


def test_two_runs_agree_within_one_percent_of_a_figure_and_exactly_in_counts():
    assert results.agree(run(nees=1.0), run(nees=1.005))
    assert not results.agree(run(nees=1.0), run(nees=1.02))
    assert not results.agree(run(), run(wrong=1))
    assert not results.agree(run(nees=1.0), run())


def test_a_file_that_is_no_result_is_named(tmp_path):
    path = tmp_path / "x.json"
    path.write_text("{}")
    with pytest.raises(UnreadableInput, match="avsreplay-benchmark"):
        results.read(path)


def test_where_the_motion_is_not_free_no_capture_is_judged():
    assert set(capture_of(None).values()) == {None}


def change(t_s, sigma_s=0.1):
    return VelocityChange(t_s + 1.0, t_s, sigma_s, 0.01, 0.001, 0.0, 0.0)


def summary(changes=(), detected=(), drift=None):
    faults = [SimpleNamespace(harmful=True, detected=each) for each in detected]
    faults.append(SimpleNamespace(harmful=False, detected=True))
    account = SimpleNamespace(episodes=faults)
    return SimpleNamespace(faults=account, velocity_changes=changes, drift=drift)


@pytest.mark.parametrize(
    ("pushes", "loaded", "found", "wanted"),
    [
        ((32.0,), False, summary([change(32.4)]), (1, 1, 0)),
        ((32.0,), False, summary([change(40.0)]), (1, 0, 1)),
        ((32.0,), False, summary([change(40.0, 3.0)]), (1, 1, 0)),
        ((10.0, 11.0), False, summary([change(10.1), change(10.9), change(30.0)]), (2, 2, 1)),
        ((), True, summary(drift=object()), (1, 1, 0)),
        ((), False, summary(drift=object()), (0, 0, 1)),
        ((), True, summary(), (1, 0, 0)),
        ((), False, summary(detected=[True, False]), (2, 1, 0)),
    ],
)
def test_an_event_is_named_by_a_report_of_its_kind_near_its_instant(pushes, loaded, found, wanted):
    log = Prepared("a", "moved", 0, pushes_s=pushes, loaded=loaded)
    assert tuple(events_of(found, log).values()) == wanted


@pytest.mark.parametrize(
    ("chance", "captured", "probability", "brier"),
    [
        (Chance.LIKELY, True, 0.9, 0.01),
        (Chance.LIKELY, False, 0.9, 0.81),
        (Chance.LIKELY, None, 0.9, None),
        (Chance.NONE, None, 0.0, 0.0),
    ],
)
def test_a_probability_is_compared_where_the_outcome_is_known(chance, captured, probability, brier):
    fact = None if captured is None else InFact(captured, None, False, "")
    tolerance = CaptureError(0.01, 0.005, 2.0)
    given = Assessment(chance=chance, probability=probability, tolerance=tolerance, in_fact=fact)
    found = capture_of(given)
    assert found["captured"] == bool(captured)
    assert found["brier"] == (None if brier is None else pytest.approx(brier))


def test_the_nees_of_a_pose_is_that_of_its_error_and_covariance():
    """With a covariance of attitude and position alone the pose of the fixture at the mass centre
    is the state itself.
    """
    x = State(IDENTITY_QUAT, np.zeros(3), np.zeros(3), np.zeros(3), *THREE, IDENTITY_QUAT)
    P = np.zeros((20, 20))
    P[:3, :3], P[6:9, 6:9] = 0.01**2 * np.eye(3), 0.1**2 * np.eye(3)
    off = Pose(exp(np.array([0.04, 0.0, 0.0])), np.array([0.0, 0.3, 0.0]))
    assert pose_nees(Belief(0, x, P), off) == pytest.approx(2.0**2 + 3.0**2, rel=1e-3)


THREE = np.zeros(2), np.zeros(3)


def scored(rows, labels=(), **log):
    """Scores of rows on a target of 2 m whose capture allows 10 mm and 1 deg; the true pose is
    known at every row.
    """
    given = SimpleNamespace(
        header=SimpleNamespace(labels=labels),
        surface=SimpleNamespace(extent=2.0),
        task=SimpleNamespace(tolerance=Tolerance(0.01, 0.005, 1.0)),
        truth=None,
    )
    x = State(IDENTITY_QUAT, np.zeros(3), np.zeros(3), np.zeros(3), *THREE, IDENTITY_QUAT)
    belief = Belief(0, x, np.eye(20))
    scorer = RunScorer(given, Prepared("a", "clean", 0, **log))
    for row in rows:
        scan = SimpleNamespace(status=ScanStatus.OK, log_ns=row.t_ns)
        outcome = SimpleNamespace(scan=scan, belief=belief)
        truth = SimpleNamespace(pose=Pose(IDENTITY_QUAT, np.zeros(3)))
        scorer.take(SimpleNamespace(row=row, outcome=outcome, truth=truth))
    return scorer.result(SimpleNamespace(**vars(summary()), assessment=None))


@pytest.mark.parametrize(("truth_m", "truth_deg"), [(0.0, 0.0), (0.004, 0.3)])
def test_limits_of_wrong_poses_and_claims_are_added_to_the_accuracy_of_the_truth(
    truth_m, truth_deg
):
    """A used pose is wrong beyond 2 % of the extent of 2 m or 2 deg, a claim beyond the tolerance
    of the capture.
    """
    limits = (
        (0.04, 2.0, "reg_pos_err_m", "reg_rot_err_deg", "wrong"),
        (*(0.01, 1.0, "pos_err_m", "rot_err_deg", "wrong_claims"),),
    )
    for limit_m, limit_deg, *names, count in limits:
        for part, off in product((0, 1), (-1e-6, 1e-6)):
            errors = [0.0, 0.0]
            errors[part] = (limit_m + truth_m, limit_deg + truth_deg)[part] + off
            row = Row(t_ns=0, gamma=1, converged=True, **dict(zip(names, errors, strict=True)))
            found = scored([row], truth_m=truth_m, truth_deg=truth_deg)
            assert found[count] == (off > 0.0)


def test_scans_are_counted_by_their_use_and_by_the_labels_of_the_log():
    label = Label("dropout", 10, 20)
    wrong = {"reg_pos_err_m": 1.0, "reg_rot_err_deg": 0.0}
    rows = [Row(t_ns=t, gamma=t % 2) for t in range(9, 22)]
    rows += [Row(t_ns=30, gamma=1, **wrong), Row(t_ns=31, gamma=1, status="degenerate", **wrong)]
    rows += [Row(t_ns=32, gamma=0, **wrong), Row(t_ns=33, converged=True, pos_err_m=None)]
    found = scored(rows, [label, Label("drift", 0, 99, harmful=False)])
    assert found["scans"] == 17
    assert found["usable"] == 17 - 10  # 10 to 19
    assert found["used"] == 7 + 2  # odd from 9 to 21
    assert found["used_usable"] == 9 - 5
    assert (found["judged"], found["wrong"]) == (1, 1)
    assert (found["claims"], found["wrong_claims"]) == (0, 0)


def test_errors_are_those_of_the_second_half():
    off_m = (1.0, 0.02)
    rows = [
        Row(t_ns=k, converged=False, pos_err_m=off_m[k // 4], rot_err_deg=0.5 * k) for k in range(8)
    ]
    found = scored(rows)
    assert found["position_permille"] == pytest.approx(10.0)
    assert found["attitude_deg"] == pytest.approx(0.5 * np.sqrt(np.mean(np.arange(4, 8) ** 2)))


def test_the_nees_is_that_of_an_exact_truth_only():
    row = Row(t_ns=0, converged=False, pos_err_m=0.0, rot_err_deg=0.0)
    assert scored([row])["nees"] == pytest.approx(0.0, abs=1e-12)
    assert scored([row], truth_m=0.001)["nees"] is None
    assert scored([])["nees"] is None


def test_an_entry_that_is_missing_is_in_the_table_of_all_groups_only():
    entries = [{"name": "x+own", "missing": ""}, {"name": "y+own", "missing": "not installed"}]
    found = results.document(SUITE, entries, [run(), run(group="moved")])
    for group, counts in ({"all": ["2"], "clean": ["1"], "moved": ["1"]}).items():
        for times in (None, {"x+own": 3.0}):
            table = results.score_table(found, group, times)
            lost = [["y+own", "not installed"]] * (group == "all")
            assert [list(row[:2]) for row in table.rows] == [["x+own", *counts], *lost]
            assert {len(row) for row in table.rows} == {len(table.heads)}


def test_counts_of_a_run_have_no_decimals_and_figures_have():
    found = results.document(SUITE, [], [run(wrong=3, nees=1.25, attitude_deg=0.5)])
    table = results.scenario_table(found, "x+own")
    shown = dict(zip(table.heads, table.rows[0], strict=True))
    assert shown["scenario"] == "a 0"
    assert shown["wrong pose"] == "3"
    assert shown[of("nees").head] == "1.25"
    assert shown[of("attitude_deg").head] == "0.5"
    assert shown[of("brier").head] == "-"
