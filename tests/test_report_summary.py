"""The summary: statistics, faults injected against faults flagged, recovery, parameters, plans."""

from __future__ import annotations

import dataclasses
import itertools
import math
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from avsreplay.estimate.chart import AXIS_PERMUTATIONS, permute_axes
from avsreplay.geometry import exp, matrix
from avsreplay.records import Label, State
from avsreplay.report.summary import NEES_BAND, NIS_BAND, Summary
from avsreplay.report.summary_parts import Statistics, of_motion
from avsreplay.report.summary_tables import fact_lines, in_one_line, manoeuvre_table
from avsreplay.tables import RowTable

STEP = 200_000_000


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=40), st.randoms())
def test_statistics_agree_with_numpy_in_any_order(values, rng):
    spread = Statistics.of(values)
    array = np.array(values)
    assert spread.count == len(values)
    assert spread.rmse == pytest.approx(math.sqrt(np.mean(array**2)), rel=1e-12, abs=1e-9)
    assert (spread.mean, spread.std) == pytest.approx(
        (array.mean(), array.std()), rel=1e-9, abs=1e-6
    )
    assert (spread.median, spread.min, spread.max) == (
        pytest.approx(np.median(array)),
        array.min(),
        array.max(),
    )
    shuffled = list(values)
    rng.shuffle(shuffled)
    assert Statistics.of(shuffled) == spread


def test_no_values_have_no_statistics():
    assert Statistics.of([]) is None


def test_the_bands_are_those_of_chi_squared():
    np.testing.assert_allclose(NIS_BAND, chi2.ppf([0.025, 0.975], 6), atol=5e-5)
    np.testing.assert_allclose(NEES_BAND, chi2.ppf([0.025, 0.975], 20), atol=5e-5)


def test_errors_are_split_by_gamma(make_rows):
    rows = make_rows(40)
    summary = Summary.fold(rows)
    for state, gamma in ((summary.pose_healthy, 1), (summary.pose_coasting, 0)):
        expected = [r.pos_err_m for r in rows if r.gamma == gamma]
        assert state.position_m == Statistics.of(expected)
        assert state.rotation_deg == Statistics.of(
            [r.rot_err_deg for r in rows if r.gamma == gamma]
        )
    assert summary.registration_flagged.position_m is None
    assert summary.registration_healthy.position_m.count == 34


def test_without_truth_there_are_no_errors_and_no_zeros(make_rows):
    summary = Summary.fold(make_rows(10, pos_err_m=None, rot_err_deg=None, nees=None))
    assert summary.pose_healthy.position_m is None
    assert summary.nees is None


def test_a_table_gives_the_summary_of_its_rows(make_rows):
    rows = make_rows(40)
    assert Summary.fold(RowTable(rows)) == Summary.fold(rows)


def test_no_rows_make_a_summary():
    summary = Summary.fold([])
    assert (summary.scans, summary.duration_s, summary.convergence.t1_s, summary.longest_coast) == (
        0,
        0.0,
        None,
        None,
    )


def _flag(rows, where, reason="fit_error", fault=None):
    return [
        dataclasses.replace(r, gamma=0, reason=reason, fault=fault) if r.seq in where else r
        for r in rows
    ]


@pytest.fixture
def clean(make_rows):
    return make_rows(40, blackout=range(0))


def _label(rows, kind, first, last, harmful=True):
    return Label(kind, rows[first].t_ns, rows[last].t_ns, harmful)


def test_a_flagged_label_is_detected_and_recovery_counts_late_scans(clean):
    rows = [dataclasses.replace(r, fault="clutter") if 10 <= r.seq <= 14 else r for r in clean]
    rows = [
        dataclasses.replace(r, gamma=0, reason="fit_error") if 11 <= r.seq <= 16 else r
        for r in rows
    ]
    faults = Summary.fold(rows, labels=[_label(rows, "clutter", 10, 14)]).faults
    (episode,) = faults.episodes
    assert (faults.injected, faults.detected, faults.missed) == (1, 1, 0)
    assert (faults.harmful_scans, faults.missed_scans) == (5, 1)
    assert (episode.scans, episode.flagged, episode.recover_scans) == (5, 4, 2)
    assert episode.recover_s == pytest.approx(0.4)
    assert faults.longest_recovery_s == pytest.approx(0.4)
    assert (faults.false_alarms, faults.unlabelled) == (2, 35)
    assert faults.false_alarm_rate == pytest.approx(2 / 35)


def test_an_unflagged_harmful_label_is_missed_and_a_harmless_one_is_not(clean):
    rows = [
        dataclasses.replace(r, fault={5: "range_bias", 9: "partial_occlusion"}.get(r.seq))
        for r in clean
    ]
    labels = [
        _label(rows, "range_bias", 5, 5),
        _label(rows, "partial_occlusion", 9, 9, harmful=False),
    ]
    faults = Summary.fold(rows, labels=labels).faults
    assert (faults.injected, faults.missed, faults.missed_scans) == (1, 1, 1)
    assert [e.recover_s for e in faults.episodes] == [None, None]


def test_a_flagged_harmless_label_is_no_false_alarm(clean):
    rows = _flag(clean, {9}, fault="partial_occlusion")
    faults = Summary.fold(rows, labels=[_label(rows, "partial_occlusion", 9, 9, False)]).faults
    assert (faults.injected, faults.false_alarms, faults.unlabelled) == (0, 0, 39)


def test_a_dropped_scan_has_no_row_and_is_seen_as_a_gap(clean):
    label = _label(clean, "dropped", 12, 12)
    summary = Summary.fold([r for r in clean if r.seq != 12], labels=[label])
    assert summary.gaps == 1
    assert summary.faults.detected == 1
    assert summary.faults.episodes[0].recover_s == 0.0
    unseen = Summary.fold(clean, labels=[label]).faults
    assert (unseen.detected, unseen.missed) == (0, 1)


def test_two_windows_of_one_kind_keep_their_own_scans(clean):
    rows = _flag(clean, {5, 6, 20}, fault="clutter")
    labels = [_label(rows, "clutter", 5, 6), _label(rows, "clutter", 20, 20)]
    assert [e.scans for e in Summary.fold(rows, labels=labels).faults.episodes] == [2, 1]


def test_a_stamp_outside_its_window_is_matched_to_its_label(clean):
    label = _label(clean, "stamp_jump", 12, 12)
    rows = [
        dataclasses.replace(r, t_ns=r.t_ns + 90_000_000, fault="stamp_jump") if r.seq == 12 else r
        for r in clean
    ]
    assert Summary.fold(rows, labels=[label]).faults.episodes[0].scans == 1


def test_rows_alone_give_labels_where_the_log_gave_none(clean):
    rows = _flag(_flag(clean, {5, 6}, fault="clutter"), {7, 20}, fault="frozen")
    faults = Summary.fold(rows).faults
    assert faults.known
    assert [(e.kind, e.scans) for e in faults.episodes] == [
        ("clutter", 2),
        ("frozen", 1),
        ("frozen", 1),
    ]


def test_without_labels_a_flag_is_not_called_false(clean):
    assert not Summary.fold(_flag(clean, {3})).faults.known
    assert Summary.fold(_flag(clean, {3}), labels=()).faults.known


def test_a_track_that_is_not_recovered_has_no_recovery_time(clean):
    rows = _flag(_flag(clean, range(30, 40)), {28, 29}, fault="clutter")
    faults = Summary.fold(rows, labels=[_label(rows, "clutter", 28, 29)]).faults
    assert faults.episodes[0].detected
    assert faults.episodes[0].recover_s is None


def test_delay_is_counted_from_the_labels_first_scan(clean):
    rows = [dataclasses.replace(r, fault="clutter") if 10 <= r.seq <= 14 else r for r in clean]
    labels = [_label(rows, "clutter", 10, 14), _label(rows, "dropped", 30, 30)]
    late = Summary.fold(_flag(rows, {13, 14}, fault="clutter"), labels=labels).faults.episodes
    assert (late[0].delay_scans, late[0].delay_s) == (3, pytest.approx(0.6))
    at_once = Summary.fold(_flag(rows, {10}, fault="clutter"), labels=labels).faults.episodes
    assert (at_once[0].delay_scans, at_once[0].delay_s) == (0, 0.0)
    never = Summary.fold(rows, labels=labels).faults.episodes
    assert [(e.delay_scans, e.delay_s) for e in never] == [(None, None)] * 2


def test_a_fault_seen_only_in_what_follows_it_needs_recovery(clean):
    rows = _flag(
        [dataclasses.replace(r, fault="frozen") if r.seq == 10 else r for r in clean], {11, 12}
    )
    (episode,) = Summary.fold(rows, labels=[_label(rows, "frozen", 10, 10)]).faults.episodes
    assert (episode.detected, episode.recover_scans, episode.lost) == (False, 2, False)
    assert episode.recover_s == pytest.approx(0.4)
    rows = _flag(rows, range(11, 40))
    (episode,) = Summary.fold(rows, labels=[_label(rows, "frozen", 10, 10)]).faults.episodes
    assert (episode.detected, episode.recover_s, episode.lost) == (False, None, True)


def test_a_fault_that_lasts_to_the_end_is_not_called_lost(clean):
    rows = _flag(clean, range(35, 40), fault="clutter")
    (episode,) = Summary.fold(rows, labels=[_label(rows, "clutter", 35, 39)]).faults.episodes
    assert (episode.detected, episode.recover_s, episode.lost) == (True, None, False)


def test_the_errors_of_a_fault_are_apart_by_what_was_done_with_the_scan(clean):
    rows = [
        dataclasses.replace(r, pos_err_m=0.001 * r.seq, rot_err_deg=40.0 - r.seq) for r in clean
    ]
    rows = [dataclasses.replace(r, fault="clutter") if 10 <= r.seq <= 14 else r for r in rows]
    rows = [
        dataclasses.replace(r, gamma=0, reason="fit_error") if r.seq in (11, 12, 16, 17) else r
        for r in rows
    ]
    gone = _label(rows, "dropped", 20, 21)
    rows = [r for r in rows if r.seq not in (20, 21)]
    faults = Summary.fold(rows, labels=[_label(clean, "clutter", 10, 14), gone]).faults
    episode, dropped = faults.episodes
    assert dataclasses.astuple(episode.peak_flagged) == (0.012, 29.0)
    assert dataclasses.astuple(episode.peak_used) == (0.014, 30.0)
    assert dataclasses.astuple(episode.peak_after) == (0.019, 25.0)  # up to the gap, not beyond it
    assert dataclasses.astuple(dropped.peak_flagged) == (None, None)
    assert dataclasses.astuple(dropped.peak_after) == (0.039, 18.0)
    assert dataclasses.astuple(faults.peak_flagged) == (0.017, 24.0)
    assert dataclasses.astuple(faults.peak_used) == (0.039, 40.0)
    blind = [dataclasses.replace(r, pos_err_m=None, rot_err_deg=None) for r in rows]
    assert Summary.fold(blind, labels=[gone]).faults.peak_used.pos_err_m is None


def test_the_longest_coast_ends_with_its_error(make_rows):
    rows = _flag(make_rows(40), {3})
    summary = Summary.fold(rows)
    assert len(summary.coasts) == 2
    coast = summary.longest_coast
    assert (coast.scans, coast.pos_err_m) == (6, rows[25].pos_err_m)
    assert coast.duration_s == pytest.approx(1.2)


def _truth(**changes):
    values = {
        "q_ab": [0, 0, 0, 1],
        "w_b": [0.1, 0, 0],
        "r_a": [0, 0, 5],
        "v_a": [0, 0, 0],
        "sigma": [0.25, -0.4],
        "c_b": [0.5, 0.6, -0.4],
        "q_bc": exp([0, 0, 0.1]),
    }
    return State(**(values | changes))


def test_parameters_are_compared_with_the_truth(make_rows):
    rows = make_rows(40)
    found = {p.name: p for p in Summary.fold(rows, truth=_truth()).parameters}
    assert found["sigma1"].error == pytest.approx(abs(rows[-1].sigma1 - 0.25))
    assert found["c (varrho)"].error == pytest.approx(0.3)
    assert found["mu"].error == pytest.approx(math.degrees(0.1))
    assert found["mu"].estimate == pytest.approx((0, 0, math.degrees(0.2)))
    assert found["mu"].one_sigma == 0.2


def test_values_in_the_fixture_frame_are_the_same_for_every_order_of_the_principal_axes(make_rows):
    """24 descriptions of one body: the paper's parameters differ and say so, the others have
    the same true values.
    """
    in_c = {
        "rate_cx_radps": 0.1,
        "rate_cy_radps": 0.0,
        "rate_cz_radps": 0.02,
        "rate_c_1s_radps": 0.003,
        "ixx": 0.3,
        "iyy": 0.3,
        "izz": 0.4,
        "ixy": 0.0,
        "ixz": 0.0,
        "iyz": 0.0,
        "moment_small": 0.3,
        "moment_middle": 0.3,
        "moment_large": 0.4,
        "com_x_m": 0.1,
        "com_y_m": 0.2,
        "com_z_m": 0.3,
    }
    rows = make_rows(2, **in_c)
    truths = [permute_axes(_truth(w_b=[0.1, -0.2, 0.3]), each) for each in AXIS_PERMUTATIONS]
    found = [{p.name: p for p in Summary.fold(rows, truth=truth).parameters} for truth in truths]
    free = {
        name
        for name, p in found[0].items()
        if p.note == "does not depend on the order of the principal axes"
    }
    assert len(free) == 4
    assert set(found[0]) - free == {"sigma1", "sigma2", "c (varrho)", "mu"}
    assert "arbitrary" in found[0]["sigma1"].note
    for name in free:
        np.testing.assert_allclose(
            [p[name].truth for p in found], [found[0][name].truth] * len(found), atol=1e-12
        )
    assert len({tuple(np.round(p["c (varrho)"].truth, 9)) for p in found}) == len(found)
    assert found[0]["rate in {C}"].truth == pytest.approx(
        matrix(exp([0, 0, 0.1])).T @ [0.1, -0.2, 0.3]
    )
    assert found[0]["rate in {C}"].one_sigma == 0.003


def test_the_angle_of_mu_ignores_the_sign(make_rows):
    rows = make_rows(2, mux=0.0, muy=0.0, muz=-math.sin(0.05), muw=-math.cos(0.05))
    found = {p.name: p for p in Summary.fold(rows, truth=_truth()).parameters}
    assert found["mu"].error == pytest.approx(0.0, abs=1e-6)


def test_parameters_without_truth_or_without_estimate(make_rows):
    assert all(p.truth is None and p.error is None for p in Summary.fold(make_rows(3)).parameters)
    names = [p.name for p in Summary.fold(make_rows(3, sigma1=None, muw=None)).parameters]
    assert names == ["sigma2", "c (varrho)"]


def test_t1_rank_and_withdrawals(make_rows):
    rows = make_rows(40)
    summary = Summary.fold(rows)
    assert (summary.convergence.t1_s, summary.convergence.at_end) == (rows[10].t_s, True)
    assert summary.observability.full_rank_s == rows[20].t_s
    unknown = [dataclasses.replace(row, ogm_rank=None) for row in rows]
    assert Summary.fold(unknown).observability.full_rank_s is None
    rows[30] = dataclasses.replace(rows[30], converged=False)
    assert Summary.fold(rows).convergence.withdrawn == 1


def test_a_replan_is_a_plan_that_differs(make_rows):
    capture = Summary.fold(make_rows(40)).capture
    assert capture.replans == 3
    assert (capture.first_s, capture.last_s) == (30.1, 30.3)
    assert capture.range_s == pytest.approx(0.2)
    assert capture.std_s == pytest.approx(np.std([30.1, 30.2, 30.3]))


def test_a_planner_without_a_plan_has_a_status_and_no_time(make_rows):
    rows = make_rows(20, plan_status="infeasible_within_horizon", capture_time_s=None)
    capture = Summary.fold(rows).capture
    assert (capture.replans, capture.last_s, capture.status) == (
        0,
        None,
        "infeasible_within_horizon",
    )


def test_hindsight_gripper_and_actions_are_reported(make_rows):
    rows = make_rows(6, blackout=range(0))
    rows[1] = dataclasses.replace(rows[1], plan_miss_m=0.02)
    rows[3] = dataclasses.replace(rows[3], plan_miss_m=0.01, action="capture")
    rows[4] = dataclasses.replace(
        rows[4], capture_miss_m=0.002, capture_miss_mps=0.001, capture_miss_deg=0.3
    )
    summary = Summary.fold(rows)
    capture = summary.capture
    assert (capture.plan_miss_m.count, capture.plan_miss_m.max) == (2, 0.02)
    assert (capture.miss.position_m, capture.miss.speed_mps, capture.miss.rotation_deg) == (
        0.002,
        0.001,
        0.3,
    )
    assert capture.actions == {"approach": 5, "capture": 1}
    facts = dict(fact_lines(summary))
    assert facts["gripper"] == "closed 2 mm, 1 mm/s, 0.3 deg from the true grasp point"
    assert facts["hindsight"] == "2 plans miss by 15 mm in the median, 20 mm at most"
    assert "gripper closed 2 mm" in in_one_line(summary)


def test_shares_count_what_is_inside(make_rows):
    rows = [
        dataclasses.replace(r, nis=v)
        for r, v in zip(make_rows(4, blackout=range(0)), (1.0, 2.0, 14.0, 15.0), strict=True)
    ]
    nis = Summary.fold(rows).nis
    assert (nis.count, nis.inside, nis.median) == (4, 0.5, 8.0)


def test_the_share_of_nis_leaves_out_the_scans_to_which_the_noise_is_adapted(make_rows):
    """Of a long log; a short one has no others."""
    rows = [
        dataclasses.replace(r, nis=0.5 if k < 30 else 6.0)
        for k, r in enumerate(make_rows(60, blackout=range(0)))
    ]
    assert Summary.fold(rows).nis.inside == 1.0
    assert Summary.fold(rows[:35]).nis.count == 25  # since convergence


def test_counts_are_passed_on(make_rows):
    counts = {"messages lost": 2}
    assert Summary.fold(make_rows(2), counts=counts).counts == counts


def test_states_and_reasons_are_counted_in_a_stable_order(make_rows):
    rows = _flag(_flag(make_rows(40), {1}, "pose_jump"), {2}, "clock")
    for order in itertools.islice(itertools.permutations((rows[1], rows[2], rows[21])), 6):
        assert list(Summary.fold(order).reasons) == ["clock", "no_scan", "pose_jump"]


def test_a_shuffled_log_has_the_same_errors(make_rows):
    rows = make_rows(40)
    shuffled = list(rows)
    random.Random(3).shuffle(shuffled)
    assert Summary.fold(shuffled).pose_healthy == Summary.fold(rows).pose_healthy


def test_moments_follow_from_the_inertia_ratios() -> None:
    """Moments 4, 8, 5 over their sum, whatever the order of the axes that gives the ratios."""
    from itertools import permutations

    from avsreplay.records import State
    from avsreplay.report.parameters import relative_moments

    for xx, yy, zz in permutations((4.0, 8.0, 5.0)):
        sigma = np.array([(yy - zz) / xx, (zz - xx) / yy])
        x = State([0, 0, 0, 1.0], *[np.zeros(3)] * 3, sigma, np.zeros(3), [0, 0, 0, 1.0])
        assert relative_moments(x) == pytest.approx(np.array([xx, yy, zz]) / 17.0)


def test_each_manoeuvre_is_listed_as_last_reported(make_rows):
    """The first is corrected by a later row and withdrawn by none; the second is reported
    five scans later.
    """
    rows = make_rows(20)
    first = {
        "manoeuvres": 1,
        "manoeuvre_s": 0.8,
        "manoeuvre_1s_s": 0.3,
        "manoeuvre_mps": 0.02,
        "manoeuvre_1s_mps": 0.001,
    }
    rows[5:] = [dataclasses.replace(r, **first) for r in rows[5:]]
    rows[6:] = [dataclasses.replace(r, manoeuvre_s=0.9, manoeuvre_mps=0.01) for r in rows[6:]]
    rows[11:] = [
        dataclasses.replace(r, manoeuvres=2, manoeuvre_s=2.1, manoeuvre_mps=0.03) for r in rows[11:]
    ]
    found = Summary.fold(rows).velocity_changes
    assert [(m.t_s, m.velocity_mps, m.reported_s) for m in found] == [
        (0.9, 0.01, rows[5].t_s),
        (2.1, 0.03, rows[11].t_s),
    ]
    lines = [
        [str(getattr(cell, "text", cell)) for cell in line]
        for line in manoeuvre_table(Summary.fold(rows)).rows
    ]
    assert [line[0] for line in lines] == ["0.90", "2.10"]
    assert [line[2] for line in lines] == ["10", "30"]
    (text,) = of_motion(rows, found, None)
    assert (
        text == "the target's velocity changed 2 times, most significantly at 2.1 s by 30 +- 1 mm/s"
    )


def test_a_manoeuvre_that_is_withdrawn_is_not_listed(make_rows):
    rows = make_rows(10)
    rows[3] = dataclasses.replace(rows[3], manoeuvres=1, manoeuvre_s=0.3, manoeuvre_mps=0.02)
    assert Summary.fold(rows).velocity_changes == ()


@pytest.mark.parametrize(("sigma", "reported"), [(1e-6, True), (3e-6, False)])
def test_a_drift_is_reported_where_it_exceeds_two_standard_deviations(make_rows, sigma, reported):
    rows = make_rows(5)
    rows[-1] = dataclasses.replace(rows[-1], drift_s=2.0, drift_mps2=5e-6, drift_1s_mps2=sigma)
    assert (Summary.fold(rows).drift is not None) == reported


def test_without_a_scan_free_of_faults_no_rate_of_false_alarms_is_stated(clean):
    rows = [dataclasses.replace(r, fault="occlusion", gamma=0, reason="fit_error") for r in clean]
    summary = Summary.fold(rows)
    assert "no scan without a fault" in in_one_line(summary)
    assert dict(fact_lines(summary))["false alarms"] == "unknown: every scan carries a fault"


def test_manoeuvres_are_those_that_the_last_rows_describe(clean):
    """A row counts the manoeuvres and describes the last one; a later count of fewer
    withdraws the others.
    """
    described = [(0, None), (1, 1.0), (1, 1.1), (2, 4.0), (2, None), (2, 4.2), (1, 1.2)]
    rows = [
        dataclasses.replace(r, manoeuvres=n, manoeuvre_s=t)
        for r, (n, t) in zip(clean, described, strict=False)
    ]
    two, one = (Summary.fold(rows[:n]).velocity_changes for n in (6, 7))
    assert [(c.reported_s, c.t_s) for c in two] == [(rows[1].t_s, 1.1), (rows[3].t_s, 4.2)]
    assert [(c.reported_s, c.t_s) for c in one] == [(rows[1].t_s, 1.2)]
