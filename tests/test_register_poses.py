"""Measured poses in place of clouds: every format gives the same run, and wrong input gives
one clear line.
"""

from __future__ import annotations

import json
import struct
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
import tumbling
from mcap.writer import Writer

from avsreplay import geometry
from avsreplay.errors import AvsError, UnreadableInput, UsageError
from avsreplay.geometry import Pose
from avsreplay.log import SourceOptions, open_source
from avsreplay.log.cdr import pose_stamped
from avsreplay.preflight import preflight
from avsreplay.records import ScanStatus
from avsreplay.report.summary_parts import of_sensor
from avsreplay.run import Job, Run

POS_M, ROT_RAD, HZ, SECONDS = 0.002, 0.003, 3.0, 20.0
STAMPED, COVARIANT = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"


@pytest.fixture(scope="module")
def motion() -> tuple[list[int], list[Pose], list[Pose]]:
    """Instants [ns], true poses and noisy poses of a tumbling body."""
    world = tumbling.draw(5, seconds=SECONDS, hz=HZ, rate=0.3)
    rng = np.random.Generator(np.random.PCG64(1))
    times = [1_000_000_000 + round(t * 1e9) for t in world.times]
    true = [x.T_ac for x in world.states]
    return times, true, [tumbling.alignment(pose, rng, POS_M, ROT_RAD).T_ac for pose in true]


def tum(path: Path, times: list[int], poses: list[Pose]) -> Path:
    lines = [
        " ".join(map(repr, [t * 1e-9, *p.t.tolist(), *p.q.tolist()]))
        for t, p in zip(times, poses, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def csv(path: Path, times: list[int], poses: list[Pose]) -> Path:
    """Shuffled named columns, nanoseconds, scalar-first quaternion, an unrelated column."""
    lines = ["qw,qx,qy,qz,label,pos_z [m],pos_y [m],pos_x [m],t_ns"]
    for t, p in zip(times, poses, strict=True):
        x, y, z, w = p.q.tolist()
        lines.append(",".join(map(str, [w, x, y, z, "a", *p.t[::-1].tolist(), t])))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def mcap(
    path: Path, times: list[int], payloads: list[bytes], kind: str = STAMPED, topic: str = "/pose"
) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        channel = writer.register_channel(
            topic, "cdr", writer.register_schema(kind, "ros2msg", b"")
        )
        for t, payload in zip(times, payloads, strict=True):
            writer.add_message(channel, t, payload, t)
        writer.finish()
    return path


def stamped(times: list[int], poses: list[Pose]) -> list[bytes]:
    return [pose_stamped(t, "tracker", p) for t, p in zip(times, poses, strict=True)]


def rows(path: Path, *assignments: str, **options):
    job = Job(
        source=path,
        options=SourceOptions(**options),
        assignments=("register.backend=poses", *assignments),
        prefetch=0,
    )
    with Run(job) as run:
        found = list(run.rows())
        return found, run.summary()


def test_a_pose_file_runs_through_the_whole_chain(tmp_path, motion) -> None:
    times, true, noisy = motion
    truth, log = tum(tmp_path / "truth.tum", times, true), tum(tmp_path / "log.tum", times, noisy)
    sigma = (1e3 * POS_M, float(np.degrees(ROT_RAD)))
    found, summary = rows(log, truth_file=truth, extent_m=2.0, pose_sigma=sigma)
    assert [row.gamma for row in found] == [1] * len(times)
    assert {row.status for row in found} == {"measured"} == {row.guess for row in found}
    empty = ("points", "inliers", "inlier_ratio", "rms_m", "iterations", "free_directions")
    assert all(getattr(row, name) is None for row in found for name in empty)
    late = found[len(found) // 2 :]
    for estimate, measured in (("pos_err_m", "reg_pos_err_m"), ("rot_err_deg", "reg_rot_err_deg")):
        mean = [
            np.mean([getattr(row, name) ** 2 for row in late]) ** 0.5
            for name in (estimate, measured)
        ]
        assert mean[0] < mean[1]
    assert summary.manoeuvres == 0
    assert summary.violations == 0
    assert summary.nis is not None
    assert summary.nis.inside > 0.8


def test_a_tracker_that_repeats_its_pose_is_frozen_and_the_estimate_goes_on(
    tmp_path, motion
) -> None:
    times, true, noisy = motion
    stuck = [*noisy[:30], *[noisy[29]] * 8, *noisy[38:]]
    truth, log = tum(tmp_path / "truth.tum", times, true), tum(tmp_path / "log.tum", times, stuck)
    found, _ = rows(log, truth_file=truth, extent_m=2.0)
    assert [k for k, row in enumerate(found) if row.reason == "frozen"] == list(range(30, 38))
    assert all(row.gamma for row in found[38:])
    assert found[38].pos_err_m < 0.02
    assert found[38].manoeuvres == 0
    (said,) = (text for text in of_sensor(found) if "repeated" in text)
    assert "8 times, first at 10.0 s" in said


def test_a_target_at_rest_in_a_log_without_noise_is_not_a_frozen_sensor(tmp_path, motion) -> None:
    times, true, _ = motion
    found, _ = rows(tum(tmp_path / "rest.tum", times[:20], true[:1] * 20), extent_m=2.0)
    assert {row.reason for row in found} == {"ok"}


def test_all_formats_give_the_same_rows(tmp_path, motion) -> None:
    times, _, noisy = motion
    times, noisy = times[:20], noisy[:20]
    expected, _ = rows(tum(tmp_path / "a.tum", times, noisy))
    named, _ = rows(csv(tmp_path / "a.csv", times, noisy))
    logged, _ = rows(mcap(tmp_path / "a.mcap", times, stamped(times, noisy)))
    assert named == expected == logged


@pytest.mark.parametrize("mark", [",", ";", "\t", "; with decimal commas"])
@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001)])
@pytest.mark.parametrize(("time", "ns"), [("s", 10**9), ("ms", 10**6), ("us", 10**3), ("ns", 1)])
def test_separators_and_units_that_the_heading_names(
    tmp_path, motion, mark, unit, metres, time, ns
) -> None:
    times, _, noisy = motion
    names = [f"t_{time}", *(f"{axis} [{unit}]" for axis in "xyz"), "qx", "qy", "qz", "qw"]
    lines = [mark[0].join(names)]
    for t, pose in zip(times[:4], noisy[:4], strict=True):
        text = mark[0].join(
            [
                f"{Decimal(t) / ns:f}",
                *map(repr, (pose.t / metres).tolist()),
                *map(repr, pose.q.tolist()),
            ]
        )
        lines.append(text.replace(".", ",") if "decimal" in mark else text)
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines))
    with open_source(path, SourceOptions(poses=True)) as source:
        for scan, t, pose in zip(source.scans(), times, noisy, strict=False):
            assert scan.t_ns == t
            np.testing.assert_allclose(scan.pose.T_ac.t, pose.t, rtol=1e-12)
            np.testing.assert_allclose(scan.pose.T_ac.q, pose.q, atol=1e-12)


def checks(path: Path, **options) -> dict[str, tuple[str, str, str]]:
    with open_source(path, SourceOptions(poses=True, **options)) as source:
        return {
            a.about: (a.grade, a.text, a.option) for a in preflight(source, source.header.surface)
        }


def test_poses_in_millimetres_are_found_by_the_step_from_one_to_the_next(tmp_path, motion) -> None:
    times, _, noisy = motion
    log = tum(tmp_path / "mm.tum", times, [Pose(p.q, 1000.0 * p.t) for p in noisy])
    grade, text, _ = checks(log, extent_m=2.0)["unit"]
    assert grade == "fail"
    assert "check the size and the unit" in text
    assert "unit" not in checks(tum(tmp_path / "m.tum", times, noisy), extent_m=2.0)


def test_stamps_of_a_file_that_step_back_are_no_reason_for_another_clock(tmp_path, motion) -> None:
    times, _, noisy = motion
    log = tum(tmp_path / "a.tum", [*times[:9], *times[:9]], [*noisy[:9], *noisy[:9]])
    assert checks(log)["time stamps"] == (
        "check",
        "time stamps of scans: 9 back; several recordings in one source must be split",
        "",
    )


def test_only_complete_options_are_printed_to_be_copied(cli, tmp_path, motion) -> None:
    times, _, noisy = motion
    log = tum(tmp_path / "a.tum", times[:9], noisy[:9])
    done = cli("info", log, "--poses", "--rate", "2")
    assert "--pose-sigma MM,DEG" in done.out
    assert "options to add" not in done.out


def test_the_covariance_of_a_message_is_the_noise_of_the_measurement(tmp_path, motion) -> None:
    times, _, noisy = motion
    sigma = np.array([1e-3, 4e-3, 2e-3, 1e-3, 1e-3, 1e-3])
    tail = struct.pack("<36d", *np.diag(sigma**2).reshape(-1))
    payloads = [data + tail for data in stamped(times[:5], noisy[:5])]
    log = mcap(tmp_path / "a.mcap", times[:5], payloads, COVARIANT)
    with open_source(log, SourceOptions(poses=True)) as source:
        for scan in source.scans():
            assert scan.pose is not None
            assert scan.pose.covariance is not None
            R = scan.pose.T_ac.R
            position = R @ scan.pose.covariance[3:, 3:] @ R.T  # {C} to {A}
            np.testing.assert_allclose(position, np.diag(sigma[:3] ** 2), atol=1e-15)
    found, _ = rows(log)
    assert found[0].r_pos_m == pytest.approx(np.sqrt(np.mean(sigma[:3] ** 2)))
    unknown = [data + struct.pack("<36d", *([0.0] * 36)) for data in stamped(times[:5], noisy[:5])]
    with open_source(
        mcap(tmp_path / "b.mcap", times[:5], unknown, COVARIANT), SourceOptions(poses=True)
    ) as source:
        assert all(
            scan.pose is not None and scan.pose.covariance is None for scan in source.scans()
        )


def test_pose_sigma_replaces_the_default(tmp_path, motion) -> None:
    times, _, noisy = motion
    found, _ = rows(tum(tmp_path / "a.tum", times[:3], noisy[:3]), pose_sigma=(3.0, 0.2))
    assert found[0].r_pos_m == pytest.approx(3e-3)
    assert found[0].r_rot_deg == pytest.approx(0.2)


def test_the_grasp_point_is_the_origin_of_the_measured_poses_moved_with_the_body(
    tmp_path, motion
) -> None:
    times, _, noisy = motion
    grasp = (0.3, -0.1, 0.2)
    log = tum(tmp_path / "a.tum", times, noisy)
    with open_source(log, SourceOptions(poses=True, grasp=grasp)) as source:
        for scan, pose in zip(source.scans(), noisy, strict=True):
            assert scan.pose is not None
            np.testing.assert_allclose(
                scan.pose.T_ac.t, pose.t + geometry.matrix(pose.q) @ grasp, atol=1e-9
            )


def test_true_poses_are_those_of_the_grasp_point(tmp_path, motion) -> None:
    times, _, noisy = motion
    log = tum(tmp_path / "a.tum", times, noisy)
    grasp = (0.3, -0.1, 0.2)
    with open_source(log, SourceOptions(poses=True, grasp=grasp, truth_file=log)) as source:
        for scan in source.scans():
            true = source.truth_of(scan).pose
            assert scan.pose is not None
            assert true is not None
            np.testing.assert_allclose(true.t, scan.pose.T_ac.t, atol=1e-9)


def test_a_bad_pose_becomes_a_row_and_the_run_continues(tmp_path, motion) -> None:
    times, _, noisy = motion
    log = tum(tmp_path / "a.tum", times[:16], noisy[:16])
    lines = log.read_text().splitlines()
    lines[8] = f"{times[8] * 1e-9} nan nan nan 0 0 0 1"
    lines[9] = f"{times[9] * 1e-9} 0 0 5 0 0 0 0.5"
    lines[12], lines[13] = lines[13], lines[12]  # the stamps step back
    log.write_text("\n".join(lines))
    found, _ = rows(log)
    assert [found[8].status, found[9].status] == ["damaged"] * 2
    assert found[8].message == "a pose that is not finite"
    assert found[9].message == "a quaternion of length 0.5, not 1"
    assert [row.seq for row in found if row.status == ScanStatus.CLOCK.value] == [13]
    assert [row.gamma for row in found[:8]] == [1] * 8


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("1 2 3\n", "not a pose line"),
        (f"{'9' * 400},0,0,1,1,0,0,0\n", "not a pose line"),
        ("t,x,y,z,qx,qy,qz\n0,1,2,3,0,0,0\n", "no column for qw"),
        ("t_s,x,y,z,qx,qy,qz,qw\nnow,1,2,3,0,0,0,1\n", "'now' is not a time"),
        ("0 nan 0 0 0 0 0 1\n", "no valid pose in this file; the first: a pose that is not finite"),
        ("", "no valid pose in this file"),
    ],
)
def test_a_file_that_holds_no_poses_is_refused_with_file_and_line(tmp_path, text, what) -> None:
    path = tmp_path / "x.csv"
    path.write_text(text)
    with pytest.raises(UnreadableInput, match=what) as error:
        open_source(path, SourceOptions(poses=True))
    assert "x.csv" in str(error.value)


def test_wrong_topics_are_refused_with_the_topics_that_exist(
    tmp_path, motion, fixtures_folder
) -> None:
    times, _, noisy = motion
    log = mcap(tmp_path / "a.mcap", times[:3], stamped(times[:3], noisy[:3]))
    with pytest.raises(UsageError, match=r"no pose topic '/other'.*/pose \(geometry_msgs"):
        open_source(log, SourceOptions(poses=True, topic="/other"))
    with pytest.raises(UnreadableInput, match="add --backend poses"):
        open_source(log, SourceOptions())
    with pytest.raises(UsageError, match=r"2 pose topics.*--topic"):
        open_source(fixtures_folder / "tumble.mcap", SourceOptions(poses=True))
    with pytest.raises(UsageError, match="a pose file has no topics"):
        open_source(
            tum(tmp_path / "a.tum", times[:3], noisy[:3]), SourceOptions(poses=True, topic="/pose")
        )


def test_a_model_cannot_be_built_from_poses(tmp_path, motion) -> None:
    times, _, noisy = motion
    with pytest.raises(AvsError, match="poses contain no model"):
        rows(tum(tmp_path / "a.tum", times[:3], noisy[:3]), model=Path("auto"))


def test_a_measured_topic_is_not_its_own_truth(fixtures_folder) -> None:
    found, _ = rows(fixtures_folder / "tumble.mcap", topic="/truth/pose", n_scans=12)
    assert [row.gamma for row in found] == [1] * 12
    assert all(row.pos_err_m is None for row in found)


def test_the_command_names_the_missing_size_and_writes_results(tmp_path, motion, cli) -> None:
    times, _, noisy = motion
    log = tum(tmp_path / "a.tum", times[:20], noisy[:20])
    done = cli("run", log, "--backend", "poses", "-o", tmp_path / "out", "--report", "--json")
    assert done.code == 0, done.err
    reasons = [reason["text"] for reason in json.loads(done.out)["verdict"]["reasons"]]
    assert any("no model" in text and "--extent METRES" in text for text in reasons)
    sized = cli("run", log, "--backend", "poses", "--extent", "2", "--json")
    assert not any(
        "no model" in reason["text"] for reason in json.loads(sized.out)["verdict"]["reasons"]
    )
    assert (tmp_path / "out" / "report.html").is_file()
    info = cli("info", log, "--poses")
    assert info.code == 0
    assert "20 measured poses" in info.out


@pytest.mark.parametrize("lasts_s", [0.0, 0.8])
def test_a_push_is_one_manoeuvre_with_its_time_and_size_also_if_it_lasts_for_scans(
    tmp_path, motion, lasts_s
) -> None:
    times, _, noisy = motion
    push, begin = np.array([0.0, 0.06, -0.03]), 12.1
    moved = []
    for t_ns, pose in zip(times, noisy, strict=True):
        t = t_ns * 1e-9 - 1.0 - begin
        # constant thrust over lasts_s, then the velocity that it gave
        way = 0.0 if t <= 0.0 else (0.5 * t * t / lasts_s if t < lasts_s else t - 0.5 * lasts_s)
        moved.append(Pose(pose.q, pose.t + way * push))
    sigma = (1e3 * POS_M, float(np.degrees(ROT_RAD)))
    found, summary = rows(tum(tmp_path / "a.tum", times, moved), pose_sigma=sigma, extent_m=2.0)
    assert summary.manoeuvres == 1
    assert summary.reinitialised == 0
    last = found[-1]
    assert begin - 0.4 < last.manoeuvre_s < begin + lasts_s + 0.4
    assert abs(last.manoeuvre_mps - np.linalg.norm(push)) < 4.0 * last.manoeuvre_1s_mps
    assert all(row.gamma == 1 for row in found[-12:])
