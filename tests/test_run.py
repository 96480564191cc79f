"""``avsreplay run``: tables, JSON, result directory, precedence of settings."""

import json
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from avsreplay.errors import UnreadableInput
from avsreplay.estimate.driven import DrivenBelief
from avsreplay.result_dir import MEAN_COLUMNS, Beliefs, read_beliefs


@pytest.fixture(scope="module")
def result(cli, fixtures_folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "result"
    done = cli("run", fixtures_folder / "tumble.mcap", "-o", out, "--json")
    assert done.code == 0, done.err
    return out, json.loads(done.out)


def test_json_is_one_document_with_summary_and_rows(result):
    _, document = result
    assert document["format"] == "avsreplay-run/1"
    assert len(document["rows"]) == document["summary"]["scans"]
    assert document["header"]["config"]["register"]["backend"] == "horn"
    assert len(document["header"]["log"]["sha256"]) == 64


def test_result_directory_holds_every_documented_file(result):
    out, document = result
    names = {p.name for p in out.iterdir()}
    assert {
        "rows.jsonl",
        "run.json",
        "estimate.tum",
        "registration.tum",
        "truth.tum",
        "smoothed.tum",
        "beliefs.npz",
    } <= names
    rows = [json.loads(line) for line in (out / "rows.jsonl").read_text().splitlines()]
    assert rows == document["rows"]
    estimate = np.loadtxt(out / "estimate.tum")
    truth = np.loadtxt(out / "truth.tum")
    assert estimate.shape == truth.shape == (len(rows), 8)
    smoothed = np.loadtxt(out / "smoothed.tum")
    after = np.searchsorted(truth[:, 0], smoothed[:, 0])
    np.testing.assert_array_equal(truth[after, 0], smoothed[:, 0])
    away = np.linalg.norm(smoothed[:, 1:4] - truth[after, 1:4], axis=1)
    assert np.sqrt(np.mean(away**2)) < 0.01
    healthy = [r["gamma"] == 1 for r in rows]
    distance = np.linalg.norm(estimate[:, 1:4] - truth[:, 1:4], axis=1)
    np.testing.assert_allclose(distance, [r["pos_err_m"] for r in rows], atol=1e-12)
    assert sum(healthy) > len(rows) / 2


def test_beliefs_read_back_as_written(result):
    out, document = result
    beliefs = read_beliefs(out / "beliefs.npz")
    assert [b.t_ns for b in beliefs] == [r["t_ns"] for r in document["rows"]]
    assert len(MEAN_COLUMNS) == 22
    last, row = beliefs[-1], document["rows"][-1]
    np.testing.assert_allclose(last.x.T_ac.t, [row["x_m"], row["y_m"], row["z_m"]], atol=1e-12)
    np.testing.assert_allclose(last.x.sigma, [row["sigma1"], row["sigma2"]], atol=0)
    assert np.linalg.eigvalsh(last.P).min() > 0.0


def test_beliefs_with_a_constant_acceleration_read_back_as_written(result, tmp_path):
    out, _ = result
    plain, written, rng = read_beliefs(out / "beliefs.npz"), Beliefs(), np.random.default_rng(1)
    beliefs = [
        (
            DrivenBelief(b.t_ns, b.x, b.P, rng.normal(size=6), np.eye(6), rng.normal(size=(20, 6)))
            if k % 3 == 1
            else b
        )
        for k, b in enumerate(plain)
    ]
    for belief in beliefs:
        scan = SimpleNamespace(
            outcome=SimpleNamespace(belief=belief), truth=SimpleNamespace(pose=None)
        )
        written(scan)
    written.table.write(tmp_path / "beliefs.npz")
    for found, belief in zip(read_beliefs(tmp_path / "beliefs.npz"), beliefs, strict=True):
        assert type(found) is type(belief)
        if isinstance(belief, DrivenBelief):
            assert all(
                np.array_equal(getattr(found, name), getattr(belief, name))
                for name in ("u", "P_u", "cross")
            )


@pytest.mark.parametrize("numbers", [[1000], [-1]])
def test_an_acceleration_of_a_belief_that_does_not_exist_is_refused(result, tmp_path, numbers):
    out, _ = result
    with np.load(out / "beliefs.npz") as data:
        arrays = dict(data)
    drive = {
        "driven": np.array(numbers),
        "u": np.zeros((1, 6)),
        "P_u": np.eye(6)[None],
        "cross": np.zeros((1, 20, 6)),
    }
    np.savez(tmp_path / "beliefs.npz", **arrays, **drive)
    with pytest.raises(UnreadableInput, match="has no belief"):
        read_beliefs(tmp_path / "beliefs.npz")


def test_an_existing_result_is_not_overwritten(result, cli, fixtures_folder):
    out, _ = result
    before = (out / "rows.jsonl").read_bytes()
    done = cli("run", fixtures_folder / "tumble.mcap", "-o", out, "--n-scans", 3)
    assert done.code == 2
    assert "--overwrite" in done.err
    assert (out / "rows.jsonl").read_bytes() == before


def test_overwrite_never_removes_what_is_no_result(cli, fixtures_folder, tmp_path):
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.txt").write_text("years of work")
    done = cli(
        "run", fixtures_folder / "tumble.mcap", "-o", precious, "--overwrite", "--n-scans", 3
    )
    assert done.code == 2
    assert (precious / "thesis.txt").read_text() == "years of work"


def test_a_failed_run_leaves_no_half_result(cli, fixtures_folder, tmp_path):
    done = cli("run", fixtures_folder / "tumble.mcap", "-o", tmp_path / "r", "--start", 1e9)
    assert done.code == 3
    assert "no scan to replay" in done.err
    assert list(tmp_path.iterdir()) == []


def test_flags_beat_the_file_and_the_file_beats_the_default(cli, fixtures_folder, tmp_path):
    config = tmp_path / "c.toml"
    config.write_text('[faults]\npolicy = "all"\n[plan]\na_max_mps2 = 0.07\n')
    done = cli(
        "run",
        fixtures_folder / "tumble.mcap",
        "--n-scans",
        2,
        "--json",
        "--config",
        config,
        "--policy",
        "any",
    )
    effective = json.loads(done.out)["header"]["config"]
    assert effective["faults"]["policy"] == "any"
    assert effective["plan"]["a_max_mps2"] == 0.07
    by_environment = cli(
        "run",
        fixtures_folder / "tumble.mcap",
        "--n-scans",
        2,
        "--json",
        env={"AVSREPLAY_RUN_POLICY": "all"},
    )
    assert json.loads(by_environment.out)["header"]["config"]["faults"]["policy"] == "all"


def test_start_takes_a_time_too(cli, fixtures_folder):
    whole = json.loads(cli("run", fixtures_folder / "tumble.mcap", "--json").out)["rows"]
    late = json.loads(
        cli("run", fixtures_folder / "tumble.mcap", "--json", "--start", 2.0, "--n-scans", 3).out
    )["rows"]
    assert len(late) == 3
    assert late[0]["t_ns"] == next(r["t_ns"] for r in whole if r["t_s"] >= 2.0)


def test_off_a_terminal_nothing_but_results_is_printed(cli, fixtures_folder):
    done = cli("run", fixtures_folder / "tumble.mcap", "--n-scans", 4)
    assert len(done.err.splitlines()) == 1  # the answer, for a reader who redirects the results
    assert "\x1b" not in done.out
    assert max(map(len, done.out.splitlines())) <= 80


def test_result_log_opens_in_rosbags_with_every_message(result):
    from rosbags.highlevel import AnyReader

    out, document = result
    count, healthy = len(document["rows"]), sum(r["gamma"] for r in document["rows"])
    seen = {}
    with AnyReader([out / "result.mcap"]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            seen.setdefault(connection.topic, []).append(message)
    assert {
        t: len(m) for t, m in seen.items() if t in ("/tf", "/points_aligned", "/diagnostics")
    } == {
        "/tf": 2 * count,  # the estimate and the true pose
        "/points_aligned": count,
        "/diagnostics": count,
    }
    assert len(seen["/registration/pose"]) >= healthy
    assert [s.status[0].message for s in seen["/diagnostics"]] == [
        r["reason"] for r in document["rows"]
    ]
    first, row = seen["/estimate/pose"][0], document["rows"][0]
    assert first.pose.pose.position.x == row["x_m"]
    assert np.linalg.eigvalsh(first.pose.covariance.reshape(6, 6)).min() > 0.0
    assert len(seen["/model"][0].points) % 3 == 0
    assert seen["/truth/model"][0].header.frame_id == "target_true"
    kinds, elsewhere = (
        (int, float),
        re.compile("seq|t_ns|(reg_)?([xyz]_m|q[xyzw])"),
    )  # bool is an int
    shown = {
        n
        for row in document["rows"]
        for n, v in row.items()
        if isinstance(v, kinds) and not elsewhere.fullmatch(n)
    }
    assert shown <= set(seen["/rows"][0].__dataclass_fields__)
    for name in shown | {"plan_miss_m"}:
        values = [np.nan if row[name] is None else row[name] for row in document["rows"]]
        np.testing.assert_array_equal(
            [getattr(message, name) for message in seen["/rows"]], values, name
        )
    cloud = next(m for m in seen["/points_aligned"] if m.width)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "residual"]
    points = np.frombuffer(cloud.data.tobytes(), np.dtype([("p", "<f4", 3), ("residual", "<f4")]))
    assert 0.0 < np.median(points["residual"]) < 0.02
    reasons = [row["reason"] for row in document["rows"]]
    changes = [b for a, b in zip([None, *reasons], reasons, strict=False) if a != b]
    assert [message.msg for message in seen["/rosout"]] == changes


def test_the_covariance_in_the_result_log_is_that_of_the_rows(result):
    from rosbags.highlevel import AnyReader

    out, document = result
    with AnyReader([out / "result.mcap"]) as reader:
        poses = [c for c in reader.connections if c.topic == "/estimate/pose"]
        messages = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(poses)]
    for message, row in zip(messages, document["rows"], strict=True):
        covariance = message.pose.covariance.reshape(6, 6)
        assert np.sqrt(np.trace(covariance[:3, :3])) == pytest.approx(row["pos_1s_m"], rel=1e-9)
        assert np.degrees(np.sqrt(np.trace(covariance[3:, 3:]))) == pytest.approx(
            row["rot_1s_deg"], rel=1e-9
        )


def test_a_run_is_written_for_rerun(fixtures_folder, tmp_path):
    pytest.importorskip("rerun", reason="the extra 'rerun' is not installed")
    from avsreplay.run import Job, Run
    from avsreplay.viewers import RerunStream

    with Run(Job(source=fixtures_folder / "tumble.mcap")) as run:
        stream = RerunStream(run, str(tmp_path / "x.rrd"))
        rows = list(run.rows([stream]))
        stream.close()
    written = (tmp_path / "x.rrd").read_bytes()
    assert len(written) > 100 * len(rows)
    for name in (
        b"camera/estimate/model",
        b"camera/position_3_sigma",
        b"camera/plan",
        b"rows/nis",
        b"rows/reason",
    ):
        assert name in written


@pytest.mark.parametrize(
    ("target", "says"),
    [
        ("view", "there is no display; write a file with --rerun FILE.rrd"),
        ("connect", "no viewer listens on port"),
        ("x.txt", "name a file .rrd"),
        ("x.rrd", "pip install 'avsreplay[rerun]'"),
    ],
)
def test_what_rerun_needs_is_said_in_one_line(target, says, fixtures_folder, monkeypatch, tmp_path):
    from avsreplay import viewers
    from avsreplay.errors import UsageError
    from avsreplay.run import Job, Run

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(viewers.sys, "platform", "linux")
    monkeypatch.setattr(viewers, "RERUN_PORT", 1)  # nothing listens there
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with (
        Run(Job(source=fixtures_folder / "tumble.mcap")) as run,
        pytest.raises(UsageError) as caught,
    ):
        viewers.RerunStream(run, target)
    assert says in str(caught.value)


def test_the_viewers_own_decoder_reads_every_message(result):
    decoder = pytest.importorskip("mcap_ros2.decoder", reason="mcap-ros2-support is not installed")
    from mcap.reader import make_reader

    out, document = result
    seen = {}
    with (out / "result.mcap").open("rb") as stream:
        for _, channel, _, message in make_reader(
            stream, decoder_factories=[decoder.DecoderFactory()]
        ).iter_decoded_messages():
            seen.setdefault(channel.topic, []).append(message)
    assert len(seen["/points_aligned"]) == len(document["rows"])
    assert seen["/estimate/pose"][0].pose.pose.position.x == document["rows"][0]["x_m"]
    assert seen["/model"][0].type == 11


def test_the_cones_of_the_approach_are_in_the_viewer_log(fixtures_folder, tmp_path, cli):
    from rosbags.highlevel import AnyReader

    angle, length, mouth = 20.0, 0.5, 0.03
    values = {"final_deg": angle, "final_range_m": length, "mouth_m": mouth}
    limits = [
        word for name, value in values.items() for word in ("--set", f"limits.{name}={value}")
    ]
    done = cli(
        "run", fixtures_folder / "tumble.mcap", "--n-scans", 3, *limits, "-o", tmp_path / "r"
    )
    assert done.code == 0, done.err
    with AnyReader([tmp_path / "r" / "result.mcap"]) as reader:
        (found,) = [
            reader.deserialize(raw, c.msgtype)
            for c, _, raw in reader.messages()
            if c.topic == "/plan/cone"
        ]
    points = np.array([(p.x, p.y, p.z) for p in found.points])
    away = np.linalg.norm(points, axis=1)
    across = np.linalg.norm(points[:, 1:], axis=1)
    np.testing.assert_allclose(across, mouth + np.tan(np.radians(angle)) * points[:, 0], rtol=1e-9)
    rim = points[:, 0] > 1e-9
    np.testing.assert_allclose(away[rim], length, rtol=1e-12)
    np.testing.assert_allclose(away[~rim], mouth, rtol=1e-12)
    assert found.header.frame_id == "target"


def test_an_empty_folder_takes_the_results(cli, fixtures_folder, tmp_path):
    (tmp_path / "results").mkdir()
    done = cli("run", fixtures_folder / "tumble.mcap", "--n-scans", 3, "-o", tmp_path / "results")
    assert done.code == 0, done.err
    assert (tmp_path / "results" / "rows.jsonl").is_file()
    again = cli("run", fixtures_folder / "tumble.mcap", "--n-scans", 3, "-o", tmp_path / "results")
    assert again.code == 2
    assert "already exists" in again.err


def test_a_golden_failure_begins_with_the_settings_that_differ(cli, fixtures_folder, tmp_path):
    log, golden = fixtures_folder / "tumble.mcap", tmp_path / "rows.jsonl"
    assert cli("run", log, "--n-scans", 4, "--update-golden", golden).code == 0
    done = cli("run", log, "--n-scans", 4, "--golden", golden, "--set", "register.n_max=1")
    assert done.code == 1
    heading = (
        "settings that differ from their defaults: n_scans = 4 (default all); register.n_max = 1"
        " (default 200)"
    )
    assert " ".join(done.out.split()).index(heading) < " ".join(done.out.split()).index(
        "Golden: first"
    )


@pytest.mark.slow
def test_a_prediction_that_leaves_no_room_to_approach_is_named(cli, fixtures_folder):
    """With the same limits and an allowance of 3 sigma a capture is planned."""
    limits = "limits.final_deg=30", "limits.clearance_m=0.1", "task.position_m=0.05"
    limits += ("limits.clearance_sigmas=4",)
    words = [word for each in limits for word in ("--set", each)]
    said = " ".join(cli("run", fixtures_folder / "tumble.mcap", *words).out.split())
    assert "the predicted error of" in said
    assert "a longer observation would help" in said


WALL = """
duration_s = 3.0
rate_hz = 2.5
[scanner]
fov_deg = [48.0, 48.0]
rays = [64, 64]
[[object]]
name = "wall"
size_m = [20.0, 20.0, 0.1]
position_m = [0.0, 0.0, 8.5]
[motion]
position_m = [0.0, 0.0, 6.0]
"""


@pytest.mark.slow
def test_a_wall_with_most_of_the_points_does_not_reject_right_poses(cli, tmp_path):
    (tmp_path / "wall.toml").write_text(WALL)
    assert cli("record", tmp_path / "wall.toml", "-o", tmp_path / "wall.mcap").code == 0
    done = cli(
        "run", tmp_path / "wall.mcap", "--init", "auto", "--set", "plan.enabled=false", "--json"
    )
    rows = json.loads(done.out)["rows"]
    assert max(row["inlier_ratio"] for row in rows) < 0.3  # most points are on the wall
    assert all(row["gamma"] == 1 for row in rows)
    assert max(row["reg_pos_err_m"] for row in rows) < 0.02


@pytest.mark.slow  # it plans
def test_without_plans_poses_are_the_same_and_no_capture_is_assessed(cli, fixtures_folder):
    log = fixtures_folder / "tumble.mcap"
    # the log is short: the predicted error leaves no room in a corridor
    soon = "--set", "convergence.criterion=covariance", "--set", "task.approach=free"
    planned, unplanned = (
        json.loads(cli("run", log, "--json", *soon, "--set", f"plan.enabled={value}").out)
        for value in ("true", "false")
    )
    same = ("gamma", "x_m", "y_m", "z_m", "pos_err_m", "rot_err_deg", "nis")
    for one, other in zip(planned["rows"], unplanned["rows"], strict=True):
        assert [one[name] for name in same] == [other[name] for name in same]
        assert other["capture_time_s"] is None
    assert any(row["capture_time_s"] is not None for row in planned["rows"])
    assessment = unplanned["summary"]["assessment"]
    assert assessment["chance"] == "not assessed"
    assert "plan.enabled" in assessment["limit"]


@pytest.mark.slow  # it plans
def test_a_run_that_captures_meets_a_required_verdict(cli, fixtures_folder):
    log = fixtures_folder / "tumble.mcap"
    settings = "task.approach=free", "task.position_m=0.05", "limits.final_deg=30"
    grasp = [word for each in settings for word in ("--set", each)]
    assert cli("run", log, "--require", "pass", *grasp).code == 0  # also after the occlusion


def test_a_required_verdict_decides_the_exit_code(cli, fixtures_folder):
    log = fixtures_folder / "tumble.mcap"
    done = cli("run", log, "--n-scans", 5, "--require", "pass")  # too short to converge
    assert done.code == 1
    assert "CAPTURE not yet decided" in done.err
    done = cli("run", log, "--n-scans", 5, "--require", "capture=0.0001")
    assert (done.code, "CAPTURE not yet decided" in done.err) == (1, True)
    assert cli("run", log, "--n-scans", 5, "--require", "check").code == 0


def test_reading_options_are_stated_in_head_json_page_and_comparison(
    cli, fixtures_folder, tmp_path
):
    given = ["--model-scale", "1.0001", "--crop-range", "0.5,90", "--n-scans", "2"]
    stated = {
        "model_scale = 1.0001 (default 1.0)",
        "crop_range = [0.5, 90.0] (default off)",
        "n_scans = 2 (default all)",
    }
    log, bare, out = fixtures_folder / "tumble.mcap", tmp_path / "bare", tmp_path / "cropped"
    assert "all at their defaults" in cli("run", log, "-o", bare, "--tables", "verdict").out
    done = cli("run", log, "--tables", "verdict", *given, "-o", out, "--report")
    assert done.code == 0, done.err
    record = json.loads((out / "run.json").read_text())
    assert set(record["changed_settings"]) == stated
    assert all(line.split(" (")[0] in done.out for line in stated)
    assert "all at their defaults" not in done.out
    page = (out / "report.html").read_text(encoding="utf-8")
    assert all(line in page for line in stated)
    compared = cli("compare", bare, out, "--json").out
    model, *settings = json.loads(compared)["results"][1]["conclusion"]["settings"]
    assert re.fullmatch(
        r"model = satellite.ply (\w{8}) \(baseline satellite.ply (?!\1)\w{8}\)", model
    )
    assert set(settings) == {
        "model_scale = 1.0001 (baseline 1.0)",
        "crop_range = [0.5, 90.0] (baseline not set)",
        "n_scans = 2 (baseline not set)",
    }
