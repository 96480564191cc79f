"""The verdict: no run with a serious problem passes, and every reason states what, when and
how large.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import re

import numpy as np
import pytest

from avsreplay.records import Label
from avsreplay.report.export import document_parts
from avsreplay.report.moments import worst_moments
from avsreplay.report.page import build_page
from avsreplay.report.summary import Summary
from avsreplay.report.verdict import Grade, first_pose, verdict_of

HEADER = {
    "model": {"extent_m": 8.0},
    "config": {"init": "log", "estimator": {"start": "auto"}, "plan": {}},
}


def _labels(rows):
    return [Label("full_occlusion", rows[20].t_ns, rows[25].t_ns)]


def _judged(rows, *, header=HEADER, **facts):
    facts.setdefault("labels", _labels(rows) if len(rows) > 25 else None)
    return verdict_of(rows, Summary.fold(rows, **facts), header)


def _good(make_rows, n=100, **changes):
    """Rows of a consistent run: the statistics are those of the expected distributions."""
    return make_rows(n, seed=3, **changes)


def _scattered(rows, metres):
    """Rows with position errors that scatter about a value."""
    factors = np.random.default_rng(2).uniform(0.5, 1.5, len(rows))
    return [
        dataclasses.replace(row, pos_err_m=metres * float(f))
        for row, f in zip(rows, factors, strict=True)
    ]


def test_a_good_run_passes(make_rows):
    found = _judged(_good(make_rows))
    assert (found.grade, found.reasons) == (Grade.PASS, ())
    assert found.line == "PASS: no reason for concern was found."


PERIODIC = "periodic torque of 0.3 +- 0.02 mrad/s2, period 20 s"


def _by_all_poses(*events, rivals=(), onset_s=0.0):
    """A header with events of the whole log: kind, words, log odds, first known."""
    names = ("kind", "words", "log_odds", "first_known_s", "onset_s", "onset_1s_s")
    found = [dict(zip(names, (*event, onset_s, 0.0), strict=True)) for event in events]
    others = [{"log_odds": odds, "events": kinds} for odds, kinds in rivals]
    return {**HEADER, "smoothed": {"events": found, "rivals": others}}


@pytest.mark.parametrize(
    ("known", "odds", "said"),
    [
        (None, 40.0, f"{PERIODIC} (no row states it)"),
        (30.0, 40.0, f"{PERIODIC} (in the rows from 30.0 s on)"),
        (None, 2.0, ""),
    ],
)
def test_an_event_of_the_whole_log_is_a_reason_with_when_it_was_known(make_rows, known, odds, said):
    header = _by_all_poses(("periodic_torque", PERIODIC, odds, known))
    found = _judged(_good(make_rows), header=header)
    assert (PERIODIC in found.line) == bool(said)
    assert said in found.line
    assert found.tracking is (Grade.CHECK if said else Grade.PASS)
    assert _judged(_good(make_rows), header={**HEADER, "smoothed": None}).tracking is Grade.PASS


def test_what_rows_took_for_a_manoeuvre_is_no_manoeuvre_of_the_log(make_rows):
    """All poses show drag: the change of the velocity and the torque that rows state are what was
    believed before.
    """
    rows = _good(
        make_rows,
        manoeuvres=1,
        manoeuvre_s=20.0,
        manoeuvre_1s_s=0.1,
        manoeuvre_mps=0.004,
        manoeuvre_1s_mps=0.001,
    )
    alone = _judged(rows)
    assert any("the target's velocity changed" in reason.text for reason in alone.reasons)
    drag = ("drag", "drag of 1 +- 0.01 %/s", 90.0, 50.0)
    found = _judged(rows, header=_by_all_poses(drag))
    texts = [reason.text for reason in found.reasons]
    assert not any("the target's velocity changed" in text for text in texts)
    (before,) = (text for text in texts if text.startswith("rows before the cause was known"))
    assert "a change of the velocity once, at 20.0 s" in before
    step = ("velocity_step", "velocity changed by 4 +- 1 mm/s at 20.0 s", 90.0, 21.0)
    header = _by_all_poses(step, onset_s=20.5)
    assert not any("rows before" in r.text for r in _judged(rows, header=header).reasons)


def test_a_set_of_events_that_is_nearly_as_likely_is_stated(make_rows):
    drag = ("drag", "drag of 0.2 +- 0.01 %/s", 90.0, None)
    rivals = [(-2.3, ["torque"]), (-3.0, ["drag", "rate_step"]), (-30.0, ["sensor_drift"])]
    found = _judged(_good(make_rows), header=_by_all_poses(drag, rivals=rivals))
    (said,) = (r.text for r in found.reasons if r.text.startswith("nearly as likely"))
    assert said == "nearly as likely: torque in place of drag"


def test_no_healthy_scan_fails(make_rows):
    rows = _good(
        make_rows,
        gamma=0,
        reason="not_aligned",
        nis=None,
        converged=False,
        pos_err_m=7.0,
        rot_err_deg=90.0,
    )
    found = _judged(rows)
    assert found.grade is Grade.FAIL
    assert "none of the 100 scans was used (mostly not aligned)" in found.line
    assert not any(
        "error" in reason.text for reason in found.reasons
    )  # errors of a start that nothing corrected


def test_a_single_scan_that_is_not_used_is_said_in_the_singular(make_rows):
    rows = _good(make_rows, 1, gamma=0, reason="not_aligned", nis=None, converged=False)
    assert _judged(rows).line.startswith("FAIL: the only scan was not used (not aligned)")


def test_one_used_scan_of_35_fails(make_rows):
    rows = [
        dataclasses.replace(r, gamma=int(r.seq == 0), reason="fit_error")
        for r in make_rows(35, fault=None)
    ]
    assert _judged(rows, labels=None).grade is Grade.FAIL


@pytest.mark.parametrize(
    ("column", "end", "said"),
    [
        (
            "pos_err_m",
            0.1,
            (
                "the position error grows: median 16 mm in the first third of the used scans, 85 mm"
                " in the last"
            ),
        ),
        (
            "rot_err_deg",
            1.0,
            (
                "the attitude error grows: median 0.16 deg in the first third of the used scans,"
                " 0.85 deg"
            ),
        ),
    ],
)
def test_an_error_that_grows_is_stated(make_rows, column, end, said):
    """An error in proportion to the time.

    In the reverse order it decreases, as while an estimate converges.
    """
    rows = make_rows(100, seed=3)
    errors = [end * k / 100 for k in range(1, 101)]
    grown = [dataclasses.replace(row, **{column: e}) for row, e in zip(rows, errors, strict=True)]
    shrunk = [
        dataclasses.replace(row, **{column: e}) for row, e in zip(rows, errors[::-1], strict=True)
    ]
    assert next(
        reason.text for reason in _judged(grown).reasons if "grows" in reason.text
    ).startswith(said)
    assert not any("grows" in reason.text for reason in _judged(shrunk).reasons)
    small = [
        dataclasses.replace(row, **{column: e / 100}) for row, e in zip(rows, errors, strict=True)
    ]
    assert not any(
        "grows" in reason.text for reason in _judged(small).reasons
    )  # 0.8 mm of 8 m, 0.01 deg
    assert not any(
        "grows" in reason.text for reason in _judged(grown[:80], labels=None).reasons
    )  # too few scans


@pytest.mark.parametrize(("spread", "said"), [(0.001, True), (0.2, False)])
def test_errors_that_are_the_same_in_all_scans_are_those_of_another_frame(make_rows, spread, said):
    """A constant displacement and rotation between the frames of model and truth, with the noise of
    the poses.
    """
    rng, rows = np.random.default_rng(4), make_rows(100, seed=3)
    noise = 1.0 + spread * rng.normal(size=(100, 2))
    moved = [
        dataclasses.replace(row, pos_err_m=3.7 * float(a), rot_err_deg=68.0 * float(b))
        for row, (a, b) in zip(rows, noise, strict=True)
    ]
    found = _judged(moved)
    assert found.grade is Grade.FAIL
    assert found.reasons[0].text.startswith("the errors are the same in all used scans") == said
    small = [dataclasses.replace(row, pos_err_m=0.01, rot_err_deg=0.5) for row in rows]
    assert not any("the same in all" in reason.text for reason in _judged(small).reasons)


@pytest.mark.parametrize(
    ("metres", "degrees", "said"),
    [(1.0, 0.0, True), (0.0, 30.0, True), (1.0, 30.0, True), (0.1, 1.0, False)],
)
def test_a_displaced_or_a_turned_frame_is_found(make_rows, metres, degrees, said):
    """Only one of both may be there: the other errors are then those of the estimate, which
    scatter.
    """
    rng, rows = np.random.default_rng(4), make_rows(100, seed=3)
    noise = np.abs(rng.normal(size=(100, 2))) * (0.02, 0.5)
    moved = [
        dataclasses.replace(
            row, pos_err_m=float(np.hypot(metres, a)), rot_err_deg=float(np.hypot(degrees, b))
        )
        for row, (a, b) in zip(rows, noise, strict=True)
    ]
    assert (
        any("the same in all used scans" in reason.text for reason in _judged(moved).reasons)
        == said
    )


def test_a_large_error_that_scatters_is_not_that_of_another_frame(make_rows):
    rng, rows = np.random.default_rng(5), make_rows(100, seed=3)
    rows = [
        dataclasses.replace(r, pos_err_m=2.0 * float(e), rot_err_deg=1.0)
        for r, e in zip(rows, 1.0 + 0.15 * rng.normal(size=100), strict=True)
    ]
    reasons = [reason.text for reason in _judged(rows).reasons]
    assert not any("the same in all used scans" in text for text in reasons)
    assert any("median position error" in text for text in reasons)


def test_an_injected_blackout_is_no_reason(make_rows):
    rows = make_rows(100, seed=3, blackout=range(20, 80))
    labels = [Label("full_occlusion", rows[20].t_ns, rows[79].t_ns)]
    assert not any("were used" in reason.text for reason in _judged(rows, labels=labels).reasons)


def test_a_missed_fault_fails_and_is_named(make_rows):
    rows = _good(make_rows)
    missed = Label("range_bias", rows[50].t_ns, rows[55].t_ns)
    rows = [dataclasses.replace(r, fault="range_bias") if 50 <= r.seq <= 55 else r for r in rows]
    found = _judged(rows, labels=[*_labels(rows), missed])
    assert found.grade is Grade.FAIL
    assert (
        "1 of 2 faults with unusable scans were not detected, the first: range bias at 10.0 s"
        in found.line
    )


def test_the_end_of_the_log_without_a_used_scan_fails(make_rows):
    rows = [
        dataclasses.replace(r, gamma=0, reason="pose_jump") if r.seq >= 85 else r
        for r in _good(make_rows)
    ]
    assert "no scan after 16.8 s was used" in _judged(rows).line


PUSH = {
    "manoeuvres": 1,
    "manoeuvre_s": 4.0,
    "manoeuvre_1s_s": 0.1,
    "manoeuvre_mps": 0.01,
    "manoeuvre_1s_mps": 0.0002,
    "manoeuvre_radps": 1e-5,
    "manoeuvre_1s_radps": 1e-4,
}


@pytest.mark.parametrize(
    ("changes", "grade", "text"),
    [
        (
            {"pos_err_m": 0.51},
            Grade.FAIL,
            "median position error of all scans is 0.51 m, 6.4 % of the model",
        ),
        ({"pos_err_m": 0.2}, Grade.CHECK, "2.5 % of the model"),
        ({"rot_err_deg": 178.0}, Grade.FAIL, "median attitude error of all scans is 178 deg"),
        ({"rms_m": 0.3}, Grade.CHECK, "check unit, scale and model"),
        (
            {"nees": 100.0},
            Grade.CHECK,
            "the covariance is too small (overconfident): only 0 % of NEES inside",
        ),
        ({"nees": 1.0}, Grade.CHECK, "the covariance is too large"),
        ({"nis": 40.0}, Grade.CHECK, "only 0 % of NIS inside the 95 % band, 100 % above it"),
        (
            {"consistent": False},
            Grade.CHECK,
            "the innovations are inconsistent in 100 of 100 scans, first at 0.0 s",
        ),
        (
            {"reinitialised": 2},
            Grade.CHECK,
            "the estimate was reinitialised 2 times, first at 0.0 s",
        ),
        (PUSH, Grade.CHECK, "the target's velocity changed at 4.0 s by 10 +- 0.2 mm/s"),
        ({"converged": False}, Grade.CHECK, "did not converge"),
    ],
)
def test_each_problem_is_a_reason(make_rows, changes, grade, text):
    found = _judged(_good(make_rows, **changes))
    assert found.grade is grade
    assert any(text in reason.text for reason in found.reasons), found.reasons


def test_a_covariance_that_is_somewhat_larger_than_the_errors_is_no_concern(make_rows):
    assert _judged(_good(make_rows, nees=5.0)).grade is Grade.PASS


def test_convergence_that_is_withdrawn_for_the_last_scans_is_a_reason(make_rows):
    """A single doubtful scan at the end is none."""
    rows = _good(make_rows, converged=True)
    for lapse, reasons in ((1, 0), (30, 1)):
        ended = [dataclasses.replace(r, converged=r.seq < len(rows) - lapse) for r in rows]
        texts = [reason.text for reason in _judged(ended).reasons if "convergence" in reason.text]
        assert len(texts) == reasons
    assert texts == [f"convergence, reached at 0.0 s, does not hold after {rows[-31].t_s:.1f} s"]


def test_losses_and_an_interruption_are_reasons(make_rows):
    rows = _good(make_rows)
    found = _judged(rows, counts={"losses": 2}, header={**HEADER, "interrupted_after": 100})
    assert (
        found.line
        == "CHECK: the replay was interrupted after 100 scans; 2 damaged places of the log were"
        " left out."
    )


def test_the_worst_reason_is_first_and_at_most_three_are_in_the_line(make_rows):
    found = _judged(
        _scattered(_good(make_rows, rms_m=0.3, nees=100.0, nis=40.0, reinitialised=1), 1.0)
    )
    assert found.line.startswith("FAIL: the median position error")
    assert (
        found.line.count(";") == 4
    )  # three reasons, one of them with a semicolon, and the count of the others
    assert re.search(r"(1 more reason|[2-9] more reasons)\.$", found.line)


@pytest.mark.parametrize(
    ("guess", "words"),
    [
        ("truth", "the ground truth of the log"),
        ("acquired", "a global search"),
        ("start", "the log's initial state"),
        ("given", "the option --init log"),
    ],
)
def test_the_origin_of_the_first_pose_is_stated(make_rows, guess, words):
    assert words in first_pose(make_rows(3, guess=guess), HEADER)


def test_the_worst_moments_do_not_overlap_and_state_their_cause(make_rows):
    rows = [dataclasses.replace(r, pos_err_m=0.5) if r.seq == 70 else r for r in _good(make_rows)]
    found = worst_moments(rows)
    assert 1 <= len(found) <= 5
    spans = sorted((m.start_s, m.end_s) for m in found)
    assert all(a[1] < b[0] for a, b in itertools.pairwise(spans))
    assert any(
        m.what.startswith("position error 500 mm, ") and rows[m.row].seq == 70 for m in found
    )
    assert any(
        m.what.startswith("6 scans not used") and m.cause == "injected: full occlusion"
        for m in found
    )


def test_a_moment_states_what_is_usual_and_its_cause(make_rows):
    rows = _good(make_rows, n=60, gamma=1, reason="ok", fault=None, nis=6.0, converged=True)
    changed = {5: {"nis": 26.0}, 20: {"nis": 60.0}, 30: {"rot_err_deg": 5.0, "guess": "acquired"}}
    changed[40] = {"pos_err_m": 0.5, "converged": False}
    rows = [dataclasses.replace(r, **changed.get(r.seq, {})) for r in rows]
    found = {m.row: (m.what, m.cause) for m in worst_moments(rows)}
    assert set(found) == {20, 30, 40}  # a NIS of 26 among 60 scans is not unusual
    assert found[20] == ("NIS 60, above its 99.99 % point 27.9", "none known")
    assert found[30][0].startswith("attitude error 5 deg, ")
    assert found[30][0].endswith(" times the median")
    assert found[30][1] == "pose found by a search"
    assert found[40][1] == "the estimate is not converged"


@pytest.mark.parametrize("column", ["pos_err_m", "rot_err_deg"])
def test_an_error_stands_out_above_three_times_the_median(make_rows, column):
    clean = {"gamma": 1, "reason": "ok", "fault": None, "nis": 6.0}
    clean |= {"pos_err_m": 0.002, "rot_err_deg": 0.1}
    rows = [dataclasses.replace(r, **clean) for r in make_rows(n=20)]
    for factor, found in ((1.0, 0), (2.9, 0), (3.1, 1), (3.9, 1), (30.0, 1)):
        worse = dataclasses.replace(rows[7], **{column: factor * clean[column]})
        moments = worst_moments([*rows[:7], worse, *rows[8:]])
        assert [m.row for m in moments] == [7] * found


def test_a_manoeuvre_is_the_cause_of_the_scans_that_were_rejected_before_it_was_decided(make_rows):
    rows = _good(
        make_rows, n=40, gamma=1, reason="ok", fault=None, nis=6.0, converged=True, manoeuvres=0
    )
    late = {"manoeuvres": 1, "manoeuvre_s": 50.24}
    changed = {k: {"gamma": 0, "reason": "doubtful", "nis": 300.0} for k in (20, 21)}
    changed[22] = {"nis": 208.0}
    rows = [
        dataclasses.replace(r, **(late if r.seq > 20 else {}), **changed.get(r.seq, {}))
        for r in rows
    ]
    found = [m.cause for m in sorted(worst_moments(rows), key=lambda m: m.start_s)]
    manoeuvre = "manoeuvre of the target at 50.2 s"
    assert found == [f"rejected: doubtful; {manoeuvre}", manoeuvre]
    rejected = [dataclasses.replace(r, manoeuvres=0) for r in rows]
    assert {m.cause for m in worst_moments(rejected)} == {
        "rejected: doubtful",
        "first used scan after rejected scans",
    }


@pytest.mark.parametrize("kind", ["manoeuvres", "reinitialised"])
@pytest.mark.parametrize("at", [1, 2, 20])
def test_what_was_found_at_a_scan_is_no_cause_of_a_later_one(make_rows, kind, at):
    """Whether the scan before was used or not: it is the cause of the first used scan since."""
    clean = {"gamma": 1, "reason": "ok", "fault": None, "nis": 6.0, "converged": True, kind: 0}
    rows = [dataclasses.replace(r, **clean) for r in make_rows(n=30)]
    rows = [dataclasses.replace(r, **({kind: 1} if r.seq >= at else {})) for r in rows]
    for place in range(max(at - 1, 1), at + 4):
        for skipped in {at, place} - {place}, set():
            changed = {k: {"gamma": 0, "reason": "doubtful"} for k in skipped if k < place}
            changed[place] = {"nis": 60.0}
            found = [dataclasses.replace(r, **changed.get(r.seq, {})) for r in rows]
            (cause,) = {m.cause for m in worst_moments(found) if m.row == place}
            named = cause.startswith(("manoeuvre", "the estimate was reinitialised"))
            first_used = min(k for k in range(at, 30) if k not in changed or k == place)
            assert named is (place == first_used)


def test_harmful_scans_that_were_used_are_judged_by_the_error(make_rows):
    """Some scans of the fault were flagged, so that it counts as detected, but others moved the
    estimate.
    """
    rows = _good(make_rows)
    labels = _labels(rows)
    at = next(r.seq for r in rows if r.fault)
    for share, grade in ((0.01, "PASS"), (0.03, "CHECK"), (0.4, "FAIL")):
        used = {"gamma": 1, "reason": "ok", "pos_err_m": share * HEADER["model"]["extent_m"]}
        changed = [dataclasses.replace(r, **used) if r.seq == at else r for r in rows]
        found = verdict_of(changed, Summary.fold(changed, labels=labels), HEADER)
        assert found.grade is Grade[grade], found.line
        assert ("scans that faults make unusable were used" in found.line) == (grade != "PASS")
    assert (
        "1 of 6 scans that faults make unusable were used, with a position error up to "
        in found.line
    )


def test_a_rejected_measurement_is_no_moment_of_its_own(make_rows):
    rows = _good(make_rows, n=35, gamma=0, reason="fit_error", fault=None, nis=5.0)
    rows = [dataclasses.replace(r, nis=3000.0) if r.seq == 20 else r for r in rows]
    (moment,) = worst_moments(rows)
    assert moment.what.startswith("35 scans not used")


def test_a_wrong_unit_stands_before_the_failures_that_it_explains(make_rows):
    advice = [{"grade": "fail", "text": "the model seems to be in inches; add --model-unit inch"}]
    good = _judged(_good(make_rows), header={**HEADER, "preflight": advice})
    assert good.line.startswith("CHECK: the model seems to be in inches")
    bad = _judged(_scattered(_good(make_rows), 1.0), header={**HEADER, "preflight": advice})
    assert bad.line.startswith(
        "FAIL: the model seems to be in inches; add --model-unit inch; the median position"
    )


def test_json_and_page_carry_the_verdict_first(make_rows):
    rows = _good(make_rows, reinitialised=1)
    summary = Summary.fold(rows, labels=_labels(rows))
    header = {**HEADER, "changed_settings": ['faults.policy = "all" (default "any")']}
    document = json.loads("".join(document_parts(rows, summary, header)))
    assert list(document)[:2] == ["format", "verdict"]
    assert document["verdict"]["grade"] == "CHECK"
    assert document["verdict"]["changed_settings"] == header["changed_settings"]
    page = build_page(rows, summary, header)
    answer = [page.index(text) for text in ("CHECK: ", 'id="scene"', 'id="charts"')]
    rest = [page.index(text) for text in ("More charts", "Worst moments", "Injected faults")]
    assert answer + rest == sorted(answer + rest)
    assert "faults.policy = &#34;all&#34;" in page


def test_any_rows_get_a_verdict(make_rows):
    rng = np.random.default_rng(1)
    for n in (0, 1, 2, 7):
        rows = [
            dataclasses.replace(r, gamma=int(rng.integers(2)), fault=None) for r in make_rows(n)
        ]
        assert _judged(rows, labels=None, header=None).line


def test_what_the_poses_show_of_the_motion_is_said(make_rows):
    """No free motion, random disturbances, two rates; each is a reason of its own."""

    def texts(rows):
        return " ".join(reason.text for reason in verdict_of(rows, Summary.fold(rows)).reasons)

    free = make_rows(40, blackout=range(0))
    assert "move freely" not in texts(free)
    replaced = dataclasses.replace
    driven = [replaced(r, motion="driven") if r.seq >= 30 else r for r in free]
    assert "no free motion explains the poses of 10 of 40 scans, first at" in texts(driven)
    pushed = [replaced(r, motion="disturbed", torque_noise_radps15=1e-4) for r in free]
    assert "does not move freely: random torques or forces act, 0.0001 rad/s^1.5" in texts(pushed)
    assert "both explain" not in texts(free)
    fast = [replaced(r, alias_slow_radps=5.57, alias_fast_radps=7.0) for r in free]
    assert "rates of 5.57 and 7 rad/s both explain the poses" in texts(fast)


def test_a_noise_that_was_assumed_too_large_is_no_reason(make_rows):
    """The innovations are then small; those that are large are one."""
    for nis, said in ((0.5, False), (25.0, True)):
        rows = [dataclasses.replace(r, nis=nis) for r in make_rows(80, blackout=range(0))]
        reasons = verdict_of(rows, Summary.fold(rows)).reasons
        assert any("NIS" in reason.text for reason in reasons) == said
