"""Whole campaigns: the same bytes with any number of workers, continuation after a kill,
workers that die.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from avsreplay import __version__, arithmetic
from avsreplay.cli.sweep import sweep_command
from avsreplay.errors import DataLost, MissingBackend, UnreadableInput, UsageError
from avsreplay.log import SourceOptions
from avsreplay.run import Job, Run
from avsreplay.sweep.campaign import load_campaign
from avsreplay.sweep.execute import crashed, run_tasks, write_results
from avsreplay.sweep.expansion import Task, expand
from avsreplay.sweep.journal import Journal

pytest.importorskip("pyarrow", reason="pyarrow is not installed")
pytest.importorskip("distributed", reason="Dask is not installed")

FIXTURES = Path(__file__).parent.parent / "fixtures"
SMALL = """
name = "small"
seed = 8
repeats = 3
[set]
"scenario.duration_s" = 3.0
"scenario.rate_hz" = 2.0
"scenario.scanner.rays" = [40, 40]
"scenario.fault" = [{ kind = "empty", start_s = 1.0, duration_s = 0.6 }]
[[grid]]
key = "scenario.scanner.noise_m"
values = [0.004, 0.016]
[[success]]
name = "close"
metric = "pose_healthy.position_m.rmse"
max = 0.05
"""
RESULTS = ("results.parquet", "scans.parquet", "summary.json", "report.html")


@pytest.fixture
def campaign(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The results of one process without Dask."""
    folder = tmp_path_factory.mktemp("reference")
    (folder / "small.toml").write_text(SMALL)
    done = sweep(folder / "small.toml", folder / "out", "--workers", "0")
    assert done.exit_code == 0, done.output
    return {name: (folder / "out" / name).read_bytes() for name in RESULTS}


def sweep(path, output, *more):
    return CliRunner().invoke(sweep_command, [str(path), "-o", str(output), *more])


def results(output):
    return {name: (output / name).read_bytes() for name in RESULTS}


@pytest.mark.slow
def test_the_results_say_what_was_run(reference, tmp_path):
    import pyarrow.parquet as pq

    for name, data in reference.items():
        (tmp_path / name).write_bytes(data)
    table = pq.read_table(tmp_path / "results.parquet").to_pydict()
    assert table["index"] == list(range(6))
    assert table["set:scenario.scanner.noise_m"] == [0.004, 0.016] * 3
    assert table["status"] == ["ok"] * 6
    assert table["faults.missed"] == [0.0] * 6
    assert all(0 < x < 0.05 for x in table["pose_healthy.position_m.rmse"])
    scans = pq.read_table(tmp_path / "scans.parquet").to_pydict()
    assert len(scans["id"]) == 36
    assert sum(scans["harmful"]) == 12
    assert [g for g, h in zip(scans["gamma"], scans["harmful"], strict=True) if h] == [0] * 12
    said = json.loads((tmp_path / "summary.json").read_text())
    assert (said["planned"], said["done"], said["status"]) == (6, 6, {"ok": 6})
    assert [cell["rates"]["close"]["successes"] for cell in said["cells"]] == [3, 3]
    assert said["detector"]["detected"]["share"] == 1.0
    for cell in said["cells"]:
        assert {
            kind: (found["scans"], found["flagged"]["share"])
            for kind, found in cell["kinds"].items()
        } == {
            "empty": (6, 1.0),
            "none": (12, 0.0),
        }
        empty = cell["kinds"]["empty"]
        assert (empty["episodes"], empty["detected"]["share"], empty["lost"]) == (3, 1.0, 0)
        assert empty["delay_scans"] == {"count": 3, "median": 0.0, "worst": 0.0}
        assert (empty["recovery_s"]["worst"], empty["lengths_s"], empty["strengths"]) == (
            0.0,
            [0.6],
            [],
        )
        assert 0 < empty["peak_flagged"]["pos_err_m"] < 0.05
        assert empty["peak_used"] == {"pos_err_m": None, "rot_err_deg": None}


@pytest.mark.slow
def test_noise_matters_in_every_repeat(reference, tmp_path):
    """Repeats share their seed across combinations, so the noisier one fits worse each time, not
    only on average.
    """
    import pyarrow.parquet as pq

    (tmp_path / "results.parquet").write_bytes(reference["results.parquet"])
    fit = pq.read_table(tmp_path / "results.parquet").to_pydict()["fit_error_m.rmse"]
    assert all(2.0 < noisy / quiet < 6.0 for quiet, noisy in zip(fit[::2], fit[1::2], strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("workers", [2])
def test_any_number_of_workers_gives_the_same_bytes(campaign, reference, tmp_path, workers):
    done = sweep(campaign, tmp_path / "out", "--workers", str(workers))
    assert done.exit_code == 0, done.output
    assert "small: 6 of 6 runs done (6 ok)" in done.output
    assert results(tmp_path / "out") == reference


@pytest.mark.slow
def test_faults_by_kind_need_no_lines_a_scan(campaign, reference, tmp_path):
    campaign.write_text(SMALL.replace("repeats = 3", "repeats = 3\nscans = false"))
    done = sweep(campaign, tmp_path / "out", "--workers", "0")
    assert done.exit_code == 0, done.output
    assert "By kind of fault" in done.output
    assert "empty" in done.output
    kinds = [
        [cell["kinds"] for cell in json.loads(text)["cells"]]
        for text in ((tmp_path / "out" / "summary.json").read_bytes(), reference["summary.json"])
    ]
    assert kinds[0] == kinds[1]


@pytest.mark.slow
def test_a_limited_campaign_is_resumed(campaign, reference, tmp_path):
    first = sweep(campaign, tmp_path / "out", "--workers", "0", "--limit", "4")
    assert "4 of 6 runs done" in first.output
    journal = (tmp_path / "out" / "journal.txt").read_bytes()
    assert sweep(campaign, tmp_path / "out", "--workers", "0").exit_code == 0
    assert (tmp_path / "out" / "journal.txt").read_bytes().startswith(journal)
    assert results(tmp_path / "out") == reference
    before = (tmp_path / "out" / "journal.txt").read_bytes()
    assert sweep(campaign, tmp_path / "out", "--workers", "0").exit_code == 0
    assert (tmp_path / "out" / "journal.txt").read_bytes() == before  # nothing was run again


@pytest.mark.slow
def test_a_killed_campaign_is_resumed(campaign, reference, tmp_path):
    args = [
        sys.executable,
        "-m",
        "avsreplay",
        "sweep",
        str(campaign),
        "-o",
        str(tmp_path / "out"),
        "--workers",
        "0",
    ]
    env = os.environ | {
        "AVSREPLAY_ARITHMETIC": "native"
    }  # that of this process, which makes the reference
    process = subprocess.Popen(args, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=env)
    journal = tmp_path / "out" / "journal.txt"
    while process.poll() is None and (
        not journal.exists() or journal.read_bytes().count(b"\n") < 2
    ):
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert 2 <= len(Journal(tmp_path / "out").status) <= 6
    assert sweep(campaign, tmp_path / "out", "--workers", "0").exit_code == 0
    assert results(tmp_path / "out") == reference


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="POSIX signals")
def test_ctrl_c_ends_workers_without_the_messages_of_dask(campaign, tmp_path):
    """A terminal sends it to every process of the command."""
    campaign.write_text(SMALL.replace("repeats = 3", "repeats = 300"))
    args = [
        sys.executable,
        "-m",
        "avsreplay",
        "sweep",
        str(campaign),
        "-o",
        str(tmp_path / "out"),
        "--workers",
        "1",
    ]
    process = subprocess.Popen(
        args, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    journal = tmp_path / "out" / "journal.txt"
    while process.poll() is None and not (
        journal.is_file() and journal.read_bytes().count(b"\n") > 1
    ):
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate()
    assert (process.returncode, out) == (130, "")
    lines = [line for line in err.splitlines() if line]
    assert len(lines) == 2, err
    assert re.fullmatch(
        r"avsreplay: the results of \d+ runs are saved; the same command continues", lines[0]
    )
    assert lines[1] == "avsreplay: interrupted"


@pytest.mark.slow
def test_a_worker_killed_in_the_middle_loses_and_doubles_nothing(campaign, reference, tmp_path):
    """A cluster of our own, reached by its address as a remote one would be; its first worker
    is killed mid-run.
    """
    from distributed import Client, LocalCluster

    plan = expand(load_campaign(campaign))
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
        Client(cluster) as client,
        Journal(tmp_path / "out") as journal,
    ):
        victims = list(client.run(os.getpid).values())
        seen = []
        for outcome in run_tasks(
            (p.task for p in plan.points()), scheduler=cluster.scheduler_address
        ):
            seen.append(outcome.id)
            journal.add(outcome)
            if len(seen) == 1:
                os.kill(victims[0], signal.SIGKILL)
    assert sorted(seen) == sorted(p.task.id for p in plan.points())
    write_results(plan, journal, tmp_path / "out")
    assert results(tmp_path / "out") == reference


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_a_campaign_whose_scheduler_is_killed_is_resumed(campaign, reference, tmp_path):
    """The command ends with one line and keeps the runs that are done."""
    start = [sys.executable, "-m"]
    listed = ["--port", "0", "--no-dashboard", "--scheduler-file", tmp_path / "scheduler.json"]
    scheduler = subprocess.Popen(
        [*start, "distributed.cli.dask_scheduler", *map(str, listed)], stderr=subprocess.DEVNULL
    )
    while not (tmp_path / "scheduler.json").exists():
        assert scheduler.poll() is None
        time.sleep(0.05)
    address = json.loads((tmp_path / "scheduler.json").read_text())["address"]
    worker = subprocess.Popen(
        [*start, "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"],
        stderr=subprocess.DEVNULL,
        cwd=tmp_path,
        env=os.environ | {"AVSREPLAY_ARITHMETIC": "native"},
    )
    out, journal = tmp_path / "out", tmp_path / "out" / "journal.txt"
    args = ["sweep", str(campaign), "-o", str(out), "--scheduler", address]
    command = subprocess.Popen(
        [sys.executable, "-m", "avsreplay", *args],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"AVSREPLAY_ARITHMETIC": "native"},
    )
    try:
        while command.poll() is None and not (
            journal.is_file() and journal.read_bytes().count(b"\n") > 1
        ):
            time.sleep(0.02)
        scheduler.kill()
        _, err = command.communicate(timeout=300)
    finally:
        for process in (scheduler, worker, command):
            process.kill()
            process.wait()
    if command.returncode:  # not where all runs were done before the scheduler ended
        assert command.returncode == 3, err
        assert err.splitlines()[-1].startswith("avsreplay: Dask scheduler: it ended before")
    assert sweep(campaign, out, "--workers", "0").exit_code == 0
    assert results(out) == reference


@pytest.mark.slow
@pytest.mark.skipif(not arithmetic.has_variants(), reason="this system has one arithmetic")
def test_a_worker_with_another_arithmetic_makes_no_run(campaign, tmp_path):
    """Its runs would have other bytes than those of the other workers."""
    from distributed import LocalCluster

    here = arithmetic.state()
    pins = dict.fromkeys(arithmetic.PINS, "") if here == "pinned" else arithmetic.PINS
    start = [sys.executable, "-m", "distributed.cli.dask_worker", "--no-dashboard"]
    with LocalCluster(n_workers=0, dashboard_address=":0") as cluster:
        worker = subprocess.Popen(
            [*start, cluster.scheduler_address],
            stderr=subprocess.DEVNULL,
            cwd=tmp_path,
            env=os.environ | pins,
        )
        try:
            done = sweep(campaign, tmp_path / "out", "--scheduler", cluster.scheduler_address)
        finally:
            worker.kill()
            worker.wait()
    assert isinstance(done.exception, UsageError)
    assert f"this command has version {__version__}, {here} arithmetic" in str(done.exception)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_run_that_fails_is_a_row_and_exit_4(campaign, tmp_path):
    text = SMALL.replace("repeats = 3", "repeats = 1")
    text += (
        '[[case]]\nname = "good"\n[[case]]\nname = "cold"\nset = { "run.init" = "9,9,9,0,0,0,1" }\n'
    )
    text += '[[case]]\nname = "no back end"\nset = { "run.register.backend" = "nobody" }\n'
    campaign.write_text(text)
    done = sweep(campaign, tmp_path / "out", "--workers", "0")
    assert isinstance(done.exception, DataLost)
    assert "2 of 6 runs not ok (2 failed)" in str(done.exception)
    assert "6 of 6 runs done (2 failed, 4 ok)" in done.output
    again = sweep(campaign, tmp_path / "out", "--workers", "0")
    assert isinstance(again.exception, DataLost)
    assert len(Journal(tmp_path / "out").status) == 6
    retried = sweep(campaign, tmp_path / "out", "--workers", "0", "--retry-failed", "--limit", "0")
    assert "4 of 6 runs done (4 ok)" in retried.output


def test_a_run_that_raises_is_a_row():
    def broken(task):
        raise ZeroDivisionError("by nought\nsecond line")

    task = Task("ab", "", "", "", "", (), True)
    (outcome,) = run_tasks([task], work=broken)
    assert (outcome.status, outcome.error) == ("crashed", "ZeroDivisionError: by nought")
    killed = type("KilledWorker", (Exception,), {})("tcp://10.0.0.1:5000")
    assert "10.0.0.1" not in crashed("ab", killed).error


@pytest.mark.slow
def test_recorded_logs_are_swept_as_well(tmp_path):
    path = tmp_path / "logs.toml"
    path.write_text(
        f'logs = ["{FIXTURES / "tumble.mcap"}"]\n[[grid]]\nkey = "run.guess"\nvalues ='
        ' ["predicted", "last"]\n'
    )
    done = sweep(path, tmp_path / "out", "--workers", "0", "--json")
    assert done.exit_code == 0, done.output
    said = json.loads(done.output)
    assert [cell["values"]["run.guess"] for cell in said["cells"]] == ["predicted", "last"]
    assert said["status"] == {"ok": 2}


@pytest.mark.slow
def test_a_job_file_is_swept_as_its_log_with_its_options(tmp_path):
    (tmp_path / "job.toml").write_text(
        f'log = "{FIXTURES / "tumble.mcap"}"\nset = ["guess=last"]\n[input]\nn_scans = 4\n'
    )
    path = tmp_path / "jobs.toml"
    path.write_text('logs = ["job.toml"]\n')
    done = sweep(path, tmp_path / "out", "--workers", "0")
    assert done.exit_code == 0, done.output
    import pyarrow.parquet as pq

    options, log = SourceOptions(n_scans=4), FIXTURES / "tumble.mcap"
    with Run(Job(source=log, options=options, assignments=("guess=last",))) as run:
        expected = [row.rms_m for row in run.rows()]
    assert pq.read_table(tmp_path / "out" / "scans.parquet").to_pydict()["rms_m"] == expected


def test_a_dry_run_only_prints_the_plan(campaign, tmp_path):
    done = CliRunner().invoke(sweep_command, [str(campaign), "--plan"])
    assert done.output.startswith(
        "small: 6 runs, 2 combinations x 3 repeats\n  scanner.noise_m=0.004\n"
    )
    assert sorted(p.name for p in tmp_path.iterdir()) == ["small.toml"]


@pytest.mark.slow
def test_bad_input_is_one_line(campaign, tmp_path, monkeypatch):
    assert isinstance(CliRunner().invoke(sweep_command, [str(campaign)]).exception, UsageError)
    monkeypatch.setattr(sys.modules["avsreplay.sweep.execute"], "CONNECT_TIMEOUT_S", 1)
    done = sweep(campaign, tmp_path / "out", "--scheduler", "tcp://127.0.0.1:9")
    assert isinstance(done.exception, UnreadableInput)
    assert "does not answer" in str(done.exception)
    assert "\n" not in str(done.exception)
    monkeypatch.setitem(sys.modules, "distributed", None)
    done = sweep(campaign, tmp_path / "out2", "--workers", "2")
    assert isinstance(done.exception, MissingBackend)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    done = sweep(campaign, tmp_path / "out3", "--workers", "0")
    assert isinstance(done.exception, MissingBackend)
    assert not (tmp_path / "out3").exists()  # said before anything was run


def test_a_cut_log_is_lossy_and_exit_4_as_in_run(cli, tmp_path):
    data = (FIXTURES / "tumble.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    (tmp_path / "c.toml").write_text('logs = ["cut.mcap"]\n')
    replay = cli("run", tmp_path / "cut.mcap", "--json", "--require", "any")
    assert replay.code == DataLost.exit_code
    done = sweep(tmp_path / "c.toml", tmp_path / "out", "--workers", "0", "--json")
    assert isinstance(done.exception, DataLost)
    assert "1 of 1 run not ok (1 lossy)" in str(done.exception)
    assert "damaged place" in str(done.exception)
    said = json.loads(done.output)
    assert said["status"] == {"lossy": 1}
    (worst,) = said["worst"]
    assert (worst["status"], worst["seed"]) == ("lossy", None)


@pytest.mark.slow
def test_the_worst_run_is_made_again_by_one_command(campaign, reference, tmp_path):
    said = json.loads(reference["summary.json"])
    worst = said["worst"][0]
    assert len(said["worst"]) == 5
    (tmp_path / "results.parquet").write_bytes(reference["results.parquet"])
    import pyarrow.parquet as pq

    table = pq.read_table(tmp_path / "results.parquet").to_pylist()
    errors = {
        row["id"]: max(row["pose_healthy.position_m.max"], row["worst_coast.pos_err_m"])
        for row in table
    }
    assert worst["id"] == max(errors, key=errors.get)
    row = next(row for row in table if row["id"] == worst["id"])
    assert row["seed"] == worst["seed"]
    again = CliRunner().invoke(
        sweep_command,
        [str(campaign), "--run", worst["id"][:10], "-o", str(tmp_path / "again"), "--report"],
    )
    assert again.exit_code == 0, again.output
    assert (tmp_path / "again" / "report.html").exists()
    rows = [
        json.loads(line) for line in (tmp_path / "again" / "rows.jsonl").read_text().splitlines()
    ]
    assert len(rows) == row["scans"]
    assert max(r["pos_err_m"] for r in rows) == pytest.approx(errors[worst["id"]], rel=1e-12)
    unknown = CliRunner().invoke(
        sweep_command, [str(campaign), "--run", "zz", "-o", str(tmp_path / "x")]
    )
    assert isinstance(unknown.exception, UsageError)


@pytest.mark.slow
def test_a_damaged_line_costs_its_own_run_only(campaign, reference, tmp_path):
    """One byte of line 2 of 6 is changed: that run is made again and the results are the same."""
    assert sweep(campaign, tmp_path / "out", "--workers", "0").exit_code == 0
    path = tmp_path / "out" / "journal.txt"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(lines[0] + lines[1].replace(b"ok", b"oK", 1) + b"".join(lines[2:]))
    done = sweep(campaign, tmp_path / "out", "--workers", "0")
    assert done.exit_code == 0, done.output
    assert "1 damaged line of the journal was moved" in done.output
    assert sorted(path.read_bytes().splitlines(keepends=True)) == sorted(lines)
    assert path.read_bytes().splitlines(keepends=True)[:-1] == [lines[0], *lines[2:]]
    assert results(tmp_path / "out") == reference


def test_two_campaigns_in_one_directory_end_in_one_line(campaign, tmp_path):
    with Journal(tmp_path / "out"):
        done = sweep(campaign, tmp_path / "out", "--workers", "0")
    assert isinstance(done.exception, UsageError)
    assert "in use by process" in str(done.exception)
    assert sweep(campaign, tmp_path / "out", "--workers", "0", "--limit", "1").exit_code == 0


@pytest.mark.slow
def test_results_hold_a_few_runs_in_memory(campaign, reference, tmp_path, monkeypatch):
    """Batches of 2 runs and of 1 scan give the same values."""
    import pyarrow.parquet as pq

    monkeypatch.setattr(sys.modules["avsreplay.sweep.execute"], "RUN_BATCH", 2)
    monkeypatch.setattr(sys.modules["avsreplay.sweep.execute"], "SCAN_BATCH", 1)
    assert sweep(campaign, tmp_path / "out", "--workers", "0").exit_code == 0
    for name in ("results.parquet", "scans.parquet"):
        (tmp_path / name).write_bytes(reference[name])
        assert pq.read_table(tmp_path / "out" / name).equals(pq.read_table(tmp_path / name))
    assert (tmp_path / "out" / "summary.json").read_bytes() == reference["summary.json"]


@pytest.mark.slow
def test_dask_listens_on_the_loopback_only():
    psutil = pytest.importorskip("psutil")
    from avsreplay.cli.sweep import sweep_command
    from avsreplay.sweep.execute import connected

    dashboard = next(param.default for param in sweep_command.params if param.name == "dashboard")
    with connected(1, None, dashboard) as client:
        me = psutil.Process()
        found = [c for p in (me, *me.children(recursive=True)) for c in p.net_connections("inet")]
        assert client.dashboard_link.startswith("http://127.0.0.1:")
    listening = {c.laddr.ip for c in found if c.status == psutil.CONN_LISTEN}
    assert listening == {"127.0.0.1"}


@pytest.mark.slow
def test_whole_flights_of_a_campaign_are_counted(tmp_path):
    """Without errors of the thrust every flight captures, with three times the largest thrust none
    does.
    """
    import pyarrow.parquet as pq

    log = FIXTURES / "tumble.mcap"
    grid = '[[grid]]\nkey = "run.robot.thrust_noise"\nvalues = [0.0, 3.0]\n'
    # the log is short
    grid += '[[grid]]\nkey = "run.convergence.criterion"\nvalues = ["covariance"]\n'
    sure = '[[success]]\nname = "sure"\nmetric = "flights.captured_share"\nmin = 0.9\n'
    text = f'logs = ["{log.as_posix()}"]\nscans = false\nflights = 3\n{grid}{sure}'
    (tmp_path / "flights.toml").write_text(text)
    done = sweep(tmp_path / "flights.toml", tmp_path / "out", "--workers", "0")
    assert done.exit_code == 0, done.output
    table = pq.read_table(tmp_path / "out" / "results.parquet").to_pydict()
    assert table["flights.count"] == [3.0, 3.0]
    assert table["flights.captured"] == [3.0, 0.0]
    cells = json.loads((tmp_path / "out" / "summary.json").read_text())["cells"]
    assert [cell["rates"]["flights captured"]["successes"] for cell in cells] == [3, 0]
    assert [cell["rates"]["flights captured"]["count"] for cell in cells] == [3, 3]
    assert [cell["rates"]["sure"]["successes"] for cell in cells] == [1, 0]
