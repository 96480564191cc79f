"""``avsreplay plan`` on a constructed result: printed and exported values, and invalid options."""

import base64
import csv
import json
import re

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.integrate import solve_ivp

from avsreplay.assessment import Assessment, Chance
from avsreplay.cli.plan import plan_command
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import IDENTITY_QUAT, matrix
from avsreplay.outcome import CaptureError
from avsreplay.records import State
from avsreplay.report.export import write_tum
from avsreplay.report.jsonl import write_rows
from avsreplay.result_dir import mean_vector
from avsreplay.rows import Row

STEP_S, SCANS = 0.5, 140
BODY = State(
    IDENTITY_QUAT,
    np.array([0.02, 0.08, -0.03]),
    np.array([0.3, -0.2, 5.0]),
    np.array([0.002, 0.001, -0.003]),
    np.array([0.15, -0.3]),
    np.array([0.6, 0.1, -0.7]),
    IDENTITY_QUAT,
)


def states():
    """The body at every scan, by DOP853 on the sigma dynamics."""
    s1, s2 = BODY.sigma
    ratios = np.array([s1, s2, -(s1 + s2) / (1 + s1 * s2)])

    def flow(_, y):
        q, w = y[:4], y[4:7]
        spin = np.r_[0.5 * (q[3] * w + np.cross(q[:3], w)), -0.5 * q[:3] @ w]
        return np.r_[spin, ratios * w[[1, 0, 0]] * w[[2, 2, 1]]]

    times = STEP_S * np.arange(SCANS)
    y = solve_ivp(
        flow, [0, times[-1]], np.r_[BODY.q_ab, BODY.w_b], "DOP853", times, rtol=1e-12, atol=1e-13
    ).y.T
    for t, v in zip(times, y, strict=True):
        yield State(
            v[:4], v[4:], BODY.r_a + t * BODY.v_a, BODY.v_a, BODY.sigma, BODY.c_b, BODY.q_bc
        )


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A run whose estimate is the truth, with small and honest covariances; converged from 5
    s on.
    """
    folder = tmp_path_factory.mktemp("made") / "result"
    folder.mkdir()
    bodies = list(states())
    stamps = [1_700_000_000_000_000_000 + round(k * STEP_S * 1e9) for k in range(SCANS)]
    rows = [
        Row(
            seq=k,
            t_ns=t,
            t_s=k * STEP_S,
            status="aligned",
            gamma=1,
            reason="ok",
            guess="predicted",
            points=1,
            estimator="filter",
            converged=k >= 10,
            action="stand_still",
            supervisor_rule="not_converged",
        )
        for k, t in enumerate(stamps)
    ]
    write_rows(folder / "rows.jsonl", rows)
    write_tum(folder / "truth.tum", [(t, x.T_ac) for t, x in zip(stamps, bodies, strict=True)])
    P = (
        np.diag(
            [1e-4] * 3 + [1e-5] * 3 + [1e-3] * 3 + [1e-5] * 3 + [1e-4] * 2 + [1e-3] * 3 + [1e-4] * 3
        )
        ** 2
    )
    np.savez(
        folder / "beliefs.npz",
        t_ns=np.array(stamps),
        x=np.array([mean_vector(x) for x in bodies]),
        P=np.tile(P, (SCANS, 1, 1)),
    )
    header = {
        "model": {"name": "m.ply", "sha256": "", "extent_m": 8.0},
        "config": {"plan": {"a_max_mps2": 0.06}},
    }
    (folder / "run.json").write_text(json.dumps(header))
    return folder


def run(*args):
    return CliRunner().invoke(plan_command, [str(a) for a in args], catch_exceptions=True)


def test_plan_spread_hindsight_and_flight(result):
    done = run(result, "--json", "--samples", 16, "--every", 10)
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert document["made_at_s"] == 5.0
    assert document["plan"]["status"] == "optimal"
    assert document["plan"]["a_max_mps2"] == 0.06
    assert document["plan"]["position_error_m"] < 1e-8
    assert document["plan"]["lower_bound_s"] == pytest.approx(document["plan"]["t_go_s"], abs=1e-6)
    assert document["spread"]["futures"] == 16
    assert 0.0 < document["spread"]["miss_m"]["mean"] < 0.02
    assert [h["made_at_s"] for h in document["hindsight"]] == [5.0 + 10 * k for k in range(7)]
    seen = [h["miss"] for h in document["hindsight"] if h["miss"]]
    assert len(seen) >= 3
    assert (
        max(m["distance_m"] for m in seen) < 1e-4
    )  # the estimate is the truth; the truth is a spline through poses
    assert document["capture"]["in_fact"]["captured"]
    assert document["capture"]["in_fact"]["errors"]["speed_mps"] < 1e-3
    rules = [each["rule"] for each in document["actions"]]
    assert (rules[0], rules[-2:]) == ("healthy", ["arrived_sure", "captured"])


def test_the_assessment_is_that_of_the_run_unless_an_option_asks_for_another_flight(result):
    made = Assessment(
        chance=Chance.POSSIBLE,
        probability=0.625,
        probability_95=(0.5, 0.75),
        at_s=31.5,
        tolerance=CaptureError(0.013, 0.0066, 2.0),
        limit="the inertia",
    )
    saved = made.record()
    header = json.loads((result / "run.json").read_text())
    (result / "run.json").write_text(json.dumps({**header, "capture": saved}))
    fast = ("--json", "--samples", 8, "--every", 20, "--flights", 16)
    assert json.loads(run(result, *fast[:-2]).stdout)["capture"] == saved
    for more in (("--at", 6), ("--a-max", 0.05), ("--set", "plan.horizon_s=50"), fast[-2:]):
        assert json.loads(run(result, *fast[:-2], *more).stdout)["capture"] != saved


def test_the_same_input_gives_the_same_bytes(result):
    args = (result, "--json", "--samples", 8, "--every", 20)
    assert run(*args).stdout == run(*args).stdout


def test_tables_name_what_they_show(result):
    text = run(result, "--samples", 4, "--every", 20, "--at", 12).stdout
    for words in (
        "Plan made at 12.00 s",
        "optimal",
        "CAPTURE likely",
        "plan flown blind",
        "active safety",
        "passive safety",
        "not checked: no clearance",
        "Plans against ground truth",
        "in fact captured",
        "arrived_sure",
    ):
        assert words in text


def test_flags_override_the_run(result):
    slow = json.loads(
        run(result, "--json", "--samples", 2, "--every", 99, "--a-max", 0.03, "--at", 6).stdout
    )
    limited = json.loads(
        run(
            result,
            "--json",
            "--samples",
            2,
            "--every",
            99,
            "--speed-max",
            0.25,
            "--at",
            6,
            "--period",
            20,
        ).stdout
    )
    free = json.loads(run(result, "--json", "--samples", 2, "--every", 99, "--at", 6).stdout)
    assert slow["plan"]["capture_time_s"] > free["plan"]["capture_time_s"]
    assert limited["plan"]["status"] == "feasible"
    assert limited["plan"]["capture_time_s"] > free["plan"]["capture_time_s"]


@pytest.mark.parametrize(
    ("limit", "setting", "flag"),
    [
        (("--set", "limits.reach_max_m=2"), "limits.reach_max_m", "--set"),
        (("--horizon", 6), "plan.horizon_s", "--horizon"),
        (("--speed-max", 0.001), "limits.speed_max_mps", "--speed-max"),
    ],
)
def test_without_a_plan_the_limit_that_prevents_it_is_named_and_the_stated_change_gives_one(
    result, limit, setting, flag
):
    args = (result, "--samples", 2, "--every", 99, "--at", 6, *limit)
    document = json.loads(run(*args, "--json").stdout)
    assert document["plan"]["t_go_s"] is None
    change = document["changes"][0]
    assert change["option"].startswith(flag)
    words = " ".join(run(*args).stdout.split())
    assert f"what prevents it {setting}; a capture is found with {change['option']} (at " in words
    found = json.loads(run(*args, "--json", *change["option"].split()).stdout)
    assert found["plan"]["capture_time_s"] == change["capture_time_s"]
    assert found["changes"] == []


def test_a_start_inside_the_target_and_a_turn_that_is_too_slow_are_stated(result):
    inside = ("--from", "0.3,-0.2,5", "--keepout", 0.5)
    text = " ".join(run(result, "--samples", 2, "--every", 99, "--at", 6, *inside).stdout.split())
    assert "start violates a limit by " in text
    slow = ("--set", "robot.angular_accel_radps2=0.0002")
    text = " ".join(run(result, "--samples", 2, "--every", 99, "--at", 6, *slow).stdout.split())
    assert "proven impossible: the gripper cannot reach the fixture's angular rate in time" in text
    assert "what prevents it robot.angular_accel_radps2; a capture is found with --set" in text


def test_settings_of_supervisor_and_robot_can_be_changed(result):
    args = (result, "--json", "--samples", 4, "--every", 99, "--at", 6)
    robot = (
        "--set",
        "robot.mass_kg=100",
        "--set",
        "robot.thrust_max_n=3",
        "--set",
        "robot.thrust_noise=0.5",
    )
    free, heavy = (json.loads(run(*args, *more).stdout) for more in ((), robot))
    assert heavy["plan"]["a_max_mps2"] == pytest.approx(0.03)
    assert heavy["robot"]["mass_kg"] == 100
    assert heavy["spread"]["miss_m"]["mean"] > 10 * free["spread"]["miss_m"]["mean"]
    assert heavy["spread"]["probability"] < free["spread"]["probability"]
    assert "100 kg, at most 0.03 m/s2" in run(*args[:1], *args[2:], *robot).stdout
    strict = json.loads(run(*args, "--set", "supervisor.capture_pos_m=0.0001").stdout)
    assert strict["tolerance"]["position_m"] == 0.0001
    assert strict["capture"]["in_fact"] is None
    assert strict["actions"][-1]["action"] != "capture"


def test_errors_of_the_thrust_lower_the_probability_of_the_capture(result):
    args = (result, "--json", "--samples", 2, "--every", 99, "--at", 12, "--flights", 6)
    calm, rough = (
        json.loads(run(*args, "--set", f"robot.thrust_noise={noise}").stdout)["capture"]
        for noise in (0.0, 2.0)
    )
    for answer in (calm, rough):
        low, high = answer["probability_95"]
        assert 0.0 <= low <= answer["probability"] <= high + 1e-12 <= 1.0 + 1e-9
    assert calm["probability"] > 0.9
    assert rough["probability"] < calm["probability_95"][0]
    assert rough["limit"] == "errors of the thrust"


def test_a_start_of_two_numbers_is_refused(result):
    done = run(result, "--from", "1,2")
    assert done.exit_code == 2
    assert "'1,2' is not 3 numbers" in done.output


def test_export_is_the_plan(result, tmp_path):
    path = tmp_path / "plan.csv"
    assert run(result, "--samples", 2, "--every", 99, "--export", path).exit_code == 0
    with path.open() as stream:
        table = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(stream)]
    assert list(table[0]) == [
        "t_s",
        *(f"{q}{c}_{u}" for q, u in (("r", "m"), ("v", "mps"), ("u", "mps2")) for c in "xyz"),
    ]
    u = np.array([[row[f"u{c}_mps2"] for c in "xyz"] for row in table])
    assert np.allclose(np.linalg.norm(u, axis=1), 0.06)
    again = run(result, "--samples", 2, "--every", 99, "--export", path)
    assert isinstance(again.exception, UsageError)


def test_the_page_of_the_flight_holds_the_plan_in_the_frame_of_the_fixture(result, tmp_path):
    page, again = tmp_path / "flight.html", tmp_path / "again.html"
    asked = ("--samples", 2, "--every", 99, "--final-deg", 15)
    done = run(result, *asked, "--json", "--animate", page)
    assert done.exit_code == 0, done.output
    plan = json.loads(done.stdout)["plan"]
    data = json.loads(
        re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text())[1]
    )
    path = np.frombuffer(
        base64.b64decode(data["scene"]["paths"][0]["points"]["data"]), "<f4"
    ).reshape(-1, 3)
    assert np.linalg.norm(path[-1]) < 1e-5  # the grasp point
    body, start_s = list(states())[10], 5.0  # the belief of the first plan, at 5 s
    rho = body.T_ac
    assert path[0] == pytest.approx(
        matrix(rho.q).T @ -rho.t, abs=1e-4
    )  # the robot is at the origin of {A}
    times = np.frombuffer(base64.b64decode(data["runs"][0]["t"]["data"]), "<f8")
    assert times[-1] == pytest.approx(plan["t_go_s"])
    assert plan["capture_time_s"] == pytest.approx(start_s + times[-1])
    keys = {"distance_m", "speed_mps", "ux_mps2", "uy_mps2", "uz_mps2", "margin_corridor_m"}
    columns = data["runs"][0]["columns"]
    assert columns.keys() == keys
    assert (
        np.frombuffer(base64.b64decode(columns["margin_corridor_m"]["data"]), "<f4").min() > -1e-6
    )
    assert run(result, *asked, "--animate", again).exit_code == 0
    assert again.read_bytes() == page.read_bytes()
    assert isinstance(run(result, *asked, "--animate", page).exception, UsageError)


def test_there_is_no_page_without_a_plan(result, tmp_path):
    done = run(result, "--horizon", 1, "--animate", tmp_path / "flight.html")
    assert "there is no plan to show" in str(done.exception)
    assert not (tmp_path / "flight.html").exists()


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("--a-max", 0), "--a-max is 0"),
        (("--cone-deg", 120), "--cone-deg is 120"),
        (("--horizon", 0), "--horizon is 0"),
        (("--at", 500), "outside the result"),
        (("--every", 0), "not in the range"),
        (("--keepout", 3.0), "keepout_m is 3.0"),
        (("--clearance", 0.1), "contains no model"),
        (("--set", "robot.mass_kg=3"), "must be given together"),
        (("--set", "supervisor.sigma=3"), "sigma"),
    ],
)
def test_an_impossible_request_is_one_line(result, args, says):
    done = run(result, *args)
    assert isinstance(done.exception, UsageError)
    assert says in str(done.exception)
    assert "\n" not in str(done.exception)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("P", -1e-6, "scan 7 has a covariance that is not positive"),
        ("x", np.nan, "scan 7 is not finite"),
    ],
)
def test_an_invalid_belief_is_named(result, tmp_path, name, value, says):
    for file in result.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    with np.load(result / "beliefs.npz") as data:
        arrays = {key: data[key].copy() for key in data.files}
    arrays[name][(7, 5, 5) if name == "P" else (7, 5)] = value
    np.savez(tmp_path / "beliefs.npz", **arrays)
    done = run(tmp_path)
    assert isinstance(done.exception, UnreadableInput)
    assert says in str(done.exception)


def test_no_result_is_unreadable(tmp_path):
    assert isinstance(run(tmp_path / "nothing").exception, UnreadableInput)


@pytest.mark.parametrize("text", ["mass_kg = 1e-320\nthrust_max_n = 5.0", "delay_s = 1e6"])
def test_an_impossible_robot_is_one_line(result, tmp_path, text):
    robot = tmp_path / "robot.toml"
    robot.write_text(f"[robot]\n{text}\n")
    ended = CliRunner().invoke(plan_command, [str(result), "--robot", str(robot), "--at", "20"])
    assert isinstance(ended.exception, UsageError)
    assert "must be" in str(ended.exception)
