"""Faults on recorded scans change the scans of their window as labelled, equally for equal
seeds.
"""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from avsreplay.cli.record import record_command
from avsreplay.log import SourceOptions, open_source
from avsreplay.parts import FAULTS
from avsreplay.record import RecordOptions, record
from avsreplay.records import Scan, ScanStatus
from avsreplay.simulate.faults import InjectedFault, kinds_with_strengths
from avsreplay.simulate.recorded_faults import disturbed, range_noise
from avsreplay.simulate.scanner import Returns

NS = 1_000_000_000
EPOCH = 5 * NS
CHANGES_POINTS = {
    *("occlusion", "partial_occlusion", "empty", "clutter", "range_bias", "noise_burst", "frozen"),
    *("outliers", "subsampled"),
}


def plane(seed, towards=(0.0, 0.0, 1.0), n=1500, noise=0.004, dtype=np.float32):
    """A plane of 2 m x 2 m at 5 m in a direction, with noise along the direction."""
    rng = np.random.default_rng(seed)
    points = np.column_stack(
        [rng.uniform(-1, 1, n), rng.uniform(-1, 1, n), 5.0 + noise * rng.standard_normal(n)]
    )
    turn = Rotation.align_vectors([towards], [[0.0, 0.0, 1.0]])[0]
    return turn.apply(points).astype(dtype)


def scans(n=10, **how):
    return [Scan(k, k * NS, plane(k, **how), log_ns=EPOCH + k * NS) for k in range(n)]


def faulty(given, *texts, seed=1, radius_m=None):
    faults = [InjectedFault.parse(text) for text in texts]
    return [changed for _, changed in disturbed(given, faults, EPOCH, seed, radius_m)]


def same(one, two):
    return one is not None and one.points.tobytes() == two.points.tobytes() and one.t_ns == two.t_ns


def test_the_help_of_record_lists_every_kind_with_its_default_strength():
    text = CliRunner().invoke(record_command, ["--help"]).stdout
    assert set(kinds_with_strengths().split()) <= set(text.split())
    assert {word.partition(":")[0] for word in kinds_with_strengths().split()} == set(
        FAULTS.names()
    )


@pytest.mark.parametrize("kind", FAULTS.names())
def test_only_the_scans_of_the_window_change(kind):
    given = scans()
    found = faulty(given, f"{kind}:3:3")
    inside = [found[k] is None or not same(found[k], given[k]) for k in range(10)]
    assert inside[:3] == [False] * 3
    assert inside[6:] == [False] * 4
    expected = [False, True, False] if kind == "frame_rate" else [True] * 3
    assert inside[3:6] == expected


@pytest.mark.parametrize("kind", FAULTS.names())
def test_a_further_fault_does_not_change_what_another_one_does(kind):
    alone = faulty(scans(), f"{kind}:3:2")
    both = faulty(scans(), f"{kind}:3:2", "clutter:7:1")
    for one, two in zip(alone[:6], both[:6], strict=True):
        assert (one is None and two is None) or same(one, two)


def test_the_seed_decides():
    text = "outliers:0:10"
    assert all(map(same, faulty(scans(), text, seed=4), faulty(scans(), text, seed=4)))
    assert not any(map(same, faulty(scans(), text, seed=4), faulty(scans(), text, seed=5)))


@pytest.mark.parametrize(
    "towards", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.5, -0.6, 0.2)]
)
def test_strengths_mean_what_the_table_says_in_any_direction(towards):
    def one(text):
        return faulty(scans(1, towards=towards), text)[0].points.astype(float)

    before = scans(1, towards=towards)[0].points.astype(float)
    ranges = np.linalg.norm(before, axis=1)
    unchanged = {tuple(p) for p in before}

    def share_kept(after):
        return sum(tuple(p) in unchanged for p in after) / len(before)

    assert np.linalg.norm(one("range_bias:0:1:0.25"), axis=1) - ranges == pytest.approx(
        0.25, abs=1e-5
    )
    moved = one("outliers:0:1:0.3")
    wrong = np.abs(np.linalg.norm(moved, axis=1) - ranges) > 1e-4
    assert wrong.mean() == pytest.approx(0.3, abs=0.05)
    assert len(one("subsampled:0:1:0.8")) / len(before) == pytest.approx(0.2, abs=0.04)
    assert len(one("clutter:0:1:0.4")) / len(before) == pytest.approx(1.4, abs=0.01)
    kept = one("partial_occlusion:0:1:0.6")
    near = np.linalg.norm(kept, axis=1) < 0.6 * np.median(ranges)  # the returns of the plate
    assert (~near).sum() / len(before) == pytest.approx(0.4, abs=0.01)
    assert near.sum() / (0.6 * len(before)) == pytest.approx(0.05, abs=0.03)
    assert len(one("empty:0:1")) == 0
    assert share_kept(one("clutter:0:1:0.4")) > 0.99


@pytest.mark.parametrize("noise", [0.002, 0.02])
def test_the_noise_is_estimated_from_the_scan_and_multiplied(noise):
    points = plane(3, n=6000, noise=noise, dtype=np.float64)
    spread = np.std(faulty([Scan(0, 0, points, log_ns=EPOCH)], "noise_burst:0:1:5")[0].points[:, 2])
    ranges = np.linalg.norm(points, axis=1)
    ones, zeros = np.ones(len(points)), np.zeros(len(points))
    returns = Returns(points / ranges[:, None], ranges, zeros, ones, zeros, zeros)
    assert range_noise(returns, np.random.default_rng(0)) == pytest.approx(noise, rel=0.12)
    assert spread == pytest.approx(5.0 * noise, rel=0.15)


def test_a_frozen_window_repeats_the_scan_before_it_and_a_stamp_jump_moves_the_stamp():
    given = scans()
    frozen = faulty(given, "frozen:4:3")
    assert [scan.points.tobytes() == given[3].points.tobytes() for scan in frozen[4:7]] == [
        True
    ] * 3
    assert [scan.t_ns for scan in frozen] == [scan.t_ns for scan in given]
    jumped = faulty(given, "stamp_jump:4:1:12.5")
    assert jumped[4].t_ns - given[4].t_ns == 12_500_000_000
    assert jumped[4].log_ns == given[4].log_ns


def test_frame_rate_keeps_every_nth_scan():
    assert [scan is not None for scan in faulty(scans(), "frame_rate:2:6:3")] == [True] * 3 + [
        False
    ] * 2 + [True] + [False] * 2 + [True] * 2


def test_times_of_points_stay_with_their_points():
    points, times = plane(1), np.linspace(0.0, 0.5, 1500, dtype=np.float32)
    found = faulty([Scan(0, 0, points, times_s=times, log_ns=EPOCH)], "subsampled:0:1:0.5")[0]
    expected = {tuple(p): t for p, t in zip(points, times, strict=True)}
    assert all(
        abs(
            expected[
                min(
                    expected,
                    key=lambda q, p=p: sum((a - b) ** 2 for a, b in zip(p, q, strict=True)),
                )
            ]
            - t
        )
        < 1e-6
        for p, t in list(zip(found.points, found.times_s, strict=True))[:5]
    )


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("fog:1:2", "no fault 'fog'"),
        ("clutter:1", "is not kind:start:duration"),
        ("clutter:a:b", "is not kind:start:duration"),
        ("clutter:1:nan", "is not kind:start:duration"),
        ("clutter:-1:2", "start_s is -1.0, must be at least 0"),
        ("clutter:1:0", "duration_s is 0.0, must be above 0"),
        ("empty:1:2:3", "has no strength"),
        ("occlusion:1:2:1.5", "must be above 0 and at most 1 for 'occlusion'"),
        ("frame_rate:1:2:1.5", "must be at least 2"),
        ("stamp_jump:0:1:-1e300", "strength is -1e+300"),
        ("clutter:0:1:101", "at most 100"),
        ("occlusion:0:1e9", "at most 1e+08"),
        ("dropped:1e300:1", "start_s is 1e+300"),
        ("noise_burst:0:1:1e10", "at most 1e+09"),
    ],
)
def test_a_wrong_fault_is_one_line(text, what, fixtures_folder, tmp_path):
    log = str(fixtures_folder / "tumble.mcap")
    done = CliRunner().invoke(
        record_command, [log, "-o", str(tmp_path / "o.mcap"), "--fault", text]
    )
    assert done.exit_code == 2
    assert what in done.output
    assert not (tmp_path / "o.mcap").exists()


def test_a_recorded_log_with_faults_has_labels_and_the_truth_of_the_scans_as_they_were(
    fixtures_folder, tmp_path
):
    log, out = fixtures_folder / "tumble.mcap", tmp_path / "faulty.mcap"
    faults = tuple(
        InjectedFault.parse(t) for t in ("stamp_jump:1:0.5:9", "clutter:2:1:0.3", "dropped:9:0.5")
    )
    done = record(log, out, options=RecordOptions(faults=faults, fault_seed=7))
    assert {kind for kind, *_ in done.faults} >= {"stamp_jump", "clutter", "dropped"}
    with open_source(log, SourceOptions()) as one, open_source(out, SourceOptions()) as two:
        new = two.header.labels[len(one.header.labels) :]
        assert [(label.kind, label.strength, label.harmful) for label in new] == [
            ("stamp_jump", 9.0, True),
            ("clutter", 0.3, False),
            ("dropped", None, True),
        ]
        before = {scan.log_ns: (scan, one.truth_of(scan)) for scan in one.scans()}
        after = {scan.log_ns: (scan, two.truth_of(scan)) for scan in two.scans()}
        assert len(before) - len(after) in (1, 2)
        for log_ns, (scan, truth) in after.items():
            was, true = before[log_ns]
            assert np.array_equal(truth.pose.matrix, true.pose.matrix)
            if truth.fault is None:
                assert scan.points.tobytes() == was.points.tobytes()
        jumped = [scan for scan, truth in after.values() if truth.fault == "stamp_jump"]
        assert jumped
        assert {scan.status for scan in jumped} == {ScanStatus.CLOCK}


def test_a_fault_after_the_end_is_said(fixtures_folder, tmp_path):
    faults = (InjectedFault.parse("empty:900:1"),)
    done = record(
        fixtures_folder / "tumble.mcap", tmp_path / "o.mcap", options=RecordOptions(faults=faults)
    )
    assert done.note == "faults outside of the recording are left out: empty"


def test_a_shortened_scenario_lists_its_own_faults_only(tmp_path):
    (tmp_path / "s.toml").write_text(
        "duration_s = 10.0\nrate_hz = 2.0\n[scanner]\nrays = [16, 16]\n"
        '[[fault]]\nkind = "empty"\nstart_s = 1.0\nduration_s = 9.0\n'
        '[[fault]]\nkind = "frozen"\nstart_s = 3.9\nduration_s = 2.0\n',
        encoding="utf-8",
    )
    whole = record(tmp_path / "s.toml", tmp_path / "whole.mcap")
    assert [fault[0] for fault in whole.faults] == ["empty", "frozen"]
    cut = record(
        tmp_path / "s.toml", tmp_path / "cut.mcap", reading=SourceOptions(duration_s=4.0)
    )  # last scan: 3.5 s
    assert [fault[0] for fault in cut.faults] == ["empty"]
    assert cut.note == "faults outside of the recording are left out: frozen"
    with open_source(tmp_path / "cut.mcap") as source:
        assert [label.kind for label in source.header.labels] == ["empty"]
    again = record(
        tmp_path / "whole.mcap", tmp_path / "part.mcap", reading=SourceOptions(end_s=3.0)
    )
    assert [fault[0] for fault in again.faults] == ["empty"]
