"""Recording by the command: the log contains the input, with the same bytes every time, and
no partial file remains.
"""

import hashlib
import json
import os
import subprocess
import sys
import tomllib
from contextlib import contextmanager
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose
from true_scans import true_scans

from avsreplay import record as recording
from avsreplay.cli.record import record_command
from avsreplay.errors import AvsError, DataLost, UnreadableInput, UsageError
from avsreplay.log import SourceOptions, open_source
from avsreplay.record import RecordOptions, record, surface_for
from avsreplay.records import ScanStatus
from avsreplay.simulate.scenario import load_scenario
from avsreplay.simulate.simulation import simulate

FIXTURES = Path(__file__).parent.parent / "fixtures"
DATA = Path(__file__).parent.parent.parent / "shared" / "data"
CASES = sorted(path.stem for path in FIXTURES.glob("*.toml"))
SHORT = """
seed = 3
duration_s = 3.0
rate_hz = 2.0
[motion]
rate_radps = [0.06, 0.064, -0.048]
[scanner]
rays = [30, 30]
[[fault]]
kind = "stamp_jump"
start_s = 1.0
duration_s = 0.2
[start]
"""


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / "short.toml"
    path.write_text(SHORT)
    return path


def labels(header):
    return [astuple(label) for label in header.labels]


def sha(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read(path, **options):
    with open_source(path, SourceOptions(**options)) as source:
        return source.header, list(true_scans(source))


def run(*args, **env):
    command = [sys.executable, "-m", "avsreplay", "record", *map(str, args)]
    return subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, **env}, check=False
    )


def test_a_recorded_simulation_reads_back_as_it_was(scenario, tmp_path):
    record(scenario, tmp_path / "a.mcap")
    header, scans = read(tmp_path / "a.mcap")
    loaded = load_scenario(scenario)
    simulation = simulate(loaded, surface_for(loaded))
    assert header.scenario.replace("\r\n", "\n") == SHORT
    assert header.seed == 3
    assert labels(header) == labels(simulation.header)
    assert header.surface.sha256 == simulation.header.surface.sha256
    assert np.array_equal(header.start.P, simulation.header.start.P)
    assert np.array_equal(header.start.x.q_ab, simulation.header.start.x.q_ab)
    assert np.array_equal(header.truth.c_b, simulation.header.truth.c_b)
    for got, made in zip(scans, true_scans(simulation), strict=True):
        assert np.array_equal(got.points, made.points)
        assert (got.log_ns, got.fault) == (made.log_ns, made.fault)
        assert_allclose(got.truth.matrix, made.truth.matrix, atol=1e-12)
        assert_allclose(got.body.w_b, made.body.w_b, atol=1e-12)
        assert_allclose(got.body.v_a, made.body.v_a, atol=1e-12)


def test_a_stamp_jump_is_in_the_log_and_its_truth_is_not_moved(scenario, tmp_path):
    record(scenario, tmp_path / "a.mcap")
    _, scans = read(tmp_path / "a.mcap")
    assert [s.status is ScanStatus.CLOCK for s in scans] == [
        False,
        False,
        True,
        False,
        False,
        False,
    ]
    loaded = load_scenario(scenario)
    truth = simulate(loaded, surface_for(loaded)).truth(scans[2].log_ns)
    assert_allclose(scans[2].truth.matrix, truth.T_ac.matrix, atol=1e-12)


def test_same_seed_same_bytes_whatever_the_hash_seed(scenario, tmp_path):
    for name, seed in (("a", "1"), ("b", "2")):
        done = run(scenario, "-o", tmp_path / name, PYTHONHASHSEED=seed, OMP_NUM_THREADS=seed)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
    assert sha(tmp_path / "a") == sha(tmp_path / "b")
    record(scenario, tmp_path / "c", seed=4)
    assert sha(tmp_path / "a") != sha(tmp_path / "c")


def test_the_builtin_scenario_needs_no_argument(monkeypatch, tmp_path):
    short = load_scenario()
    short = replace(short, params=replace(short.params, duration_s=2.0, fault=()))
    monkeypatch.setattr(recording, "load_scenario", lambda *_: short)
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(record_command, ["-o", "tumble.mcap"])
    assert done.exit_code == 0
    assert done.output.startswith("tumble.mcap: 10 scans, 1.8 s, ")
    assert "model: satellite.ply, seed 1" in done.output


def test_json_states_the_same(scenario, tmp_path):
    done = CliRunner().invoke(
        record_command, [str(scenario), "-o", str(tmp_path / "a.mcap"), "--seed", "9", "--json"]
    )
    said = json.loads(done.output)
    assert (said["scans"], said["span_s"], said["seed"], said["bytes"]) == (
        6,
        2.5,
        9,
        (tmp_path / "a.mcap").stat().st_size,
    )
    assert said["faults"] == [["stamp_jump", 1.0, 1.2, True]]


@pytest.mark.parametrize("case", CASES)
def test_a_fixture_is_reproducible(case, tmp_path):
    """To the bit where this processor rounds as the one that made it, to 1e-12 in the truth in any
    event.
    """
    record(
        FIXTURES / f"{case}.toml", tmp_path / "a.mcap", options=RecordOptions(compression="none")
    )
    if sha(tmp_path / "a.mcap") == sha(FIXTURES / f"{case}.mcap"):
        return
    (one, first), (two, second) = read(tmp_path / "a.mcap"), read(FIXTURES / f"{case}.mcap")
    assert (one.scenario, labels(one), one.surface.sha256) == (
        two.scenario,
        labels(two),
        two.surface.sha256,
    )
    for a, b in zip(first, second, strict=True):
        assert (a.t_ns, a.log_ns, a.status, a.fault) == (b.t_ns, b.log_ns, b.status, b.fault)
        assert_allclose(a.points, b.points, atol=1e-6)
        assert_allclose(a.truth.matrix, b.truth.matrix, atol=1e-12)
        assert_allclose(a.body.v_a, b.body.v_a, atol=1e-12)


@pytest.mark.parametrize("case", CASES)
def test_cases_are_small(case):
    assert (FIXTURES / f"{case}.mcap").stat().st_size < 400_000


def test_a_log_recorded_again_keeps_scans_truth_labels_and_model(tmp_path):
    log = FIXTURES / "spin-raster.mcap"
    record(log, tmp_path / "b.mcap")
    (one, first), (two, second) = read(log), read(tmp_path / "b.mcap")
    assert (labels(one), one.scenario, one.seed, one.surface.sha256) == (
        labels(two),
        two.scenario,
        two.seed,
        two.surface.sha256,
    )
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a.points, b.points)
        assert np.array_equal(a.times_s, b.times_s)
        assert (a.t_ns, a.log_ns, a.fault) == (b.t_ns, b.log_ns, b.fault)
        assert np.array_equal(a.truth.matrix, b.truth.matrix)


def test_without_embreex_the_log_is_recorded_and_a_note_is_printed(scenario, tmp_path, monkeypatch):
    from avsreplay.simulate import rays

    monkeypatch.setattr(rays.importlib.util, "find_spec", lambda name: None)
    done = CliRunner().invoke(record_command, [str(scenario), "-o", str(tmp_path / "a.mcap")])
    assert "note: embreex is not installed" in done.output
    assert len(read(tmp_path / "a.mcap")[1]) == 6


def test_a_duration_replaces_that_of_a_scenario(scenario, tmp_path):
    found = record(scenario, tmp_path / "x.mcap", reading=SourceOptions(duration_s=2.0))
    assert (found.scans, found.seed) == (4, 3)
    with open_source(tmp_path / "x.mcap") as source:
        assert tomllib.loads(source.header.scenario)["duration_s"] == 2.0
    with pytest.raises(UsageError, match="no topics"):
        record(scenario, tmp_path / "y.mcap", reading=SourceOptions(duration_s=2.0, topic="/x"))


def test_every_nth_scan_keeps_its_own_time(tmp_path):
    record(FIXTURES / "tumble.mcap", tmp_path / "c.mcap", reading=SourceOptions(every=5))
    _, all_scans = read(FIXTURES / "tumble.mcap")
    _, some = read(tmp_path / "c.mcap")
    assert [s.t_ns for s in some] == [s.t_ns for s in all_scans[::5]]


def test_a_model_may_replace_the_shape(scenario, tmp_path):
    from avsreplay.simulate.target import Shape, builtin_surface

    model = tmp_path / "bracket.ply"
    model.write_bytes(builtin_surface(Shape.BRACKET).data)
    done = record(scenario, tmp_path / "a.mcap", options=RecordOptions(model=model))
    header, _ = read(tmp_path / "a.mcap")
    assert done.model == header.surface.name == "bracket.ply"
    assert header.surface.sha256 == builtin_surface(Shape.BRACKET).sha256
    named = tmp_path / "named.toml"
    named.write_text(SHORT + '[target]\nmodel = "bracket.ply"\n')
    record(named, tmp_path / "b.mcap")
    assert read(tmp_path / "b.mcap")[0].surface.sha256 == header.surface.sha256


def test_an_existing_output_is_kept_without_overwrite(scenario, tmp_path):
    output = tmp_path / "a.mcap"
    output.write_bytes(b"mine")
    with pytest.raises(UsageError, match="--overwrite"):
        record(scenario, output)
    assert output.read_bytes() == b"mine"
    record(scenario, output, options=RecordOptions(overwrite=True))
    assert output.stat().st_size > 1000


def test_a_log_is_not_recorded_onto_itself(tmp_path):
    log = tmp_path / "a.mcap"
    log.write_bytes((FIXTURES / "tumble.mcap").read_bytes())
    with pytest.raises(UsageError, match="the output is the source"):
        record(log, log, options=RecordOptions(overwrite=True))
    assert sha(log) == sha(FIXTURES / "tumble.mcap")


def test_a_failure_during_recording_leaves_no_file(scenario, tmp_path):
    @contextmanager
    def failing(scans, due):
        def some():
            yield next(iter(scans))
            raise RuntimeError("the cable")

        yield some()

    with pytest.raises(RuntimeError, match="the cable"):
        record(scenario, tmp_path / "a.mcap", ticker=failing)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["short.toml"]


@pytest.mark.parametrize(
    ("source", "more", "error", "words"),
    [
        ("short.toml", {"reading": SourceOptions(topic="/x")}, UsageError, "no topics"),
        (
            "short.toml",
            {"options": RecordOptions(model=Path("none.ply"))},
            UnreadableInput,
            "none.ply",
        ),
        ("none.mcap", {}, UnreadableInput, "no such file"),
        ("none.toml", {}, UnreadableInput, "no such file"),
        ("empty.mcap", {}, UnreadableInput, "empty"),
        ("empty.mcap", {"seed": 3}, UsageError, "no seed"),
    ],
)
def test_bad_input_is_one_line(scenario, tmp_path, source, more, error, words):
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(error, match=words) as caught:
        record(tmp_path / source, tmp_path / "out.mcap", **more)
    assert isinstance(caught.value, AvsError)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out.mcap").exists()


def test_damage_in_the_source_is_reported_with_exit_4(tmp_path):
    data = bytearray((FIXTURES / "tumble.mcap").read_bytes())
    data[len(data) // 2] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(bytes(data))
    done = CliRunner().invoke(record_command, [str(damaged), "-o", str(tmp_path / "out.mcap")])
    assert isinstance(done.exception, DataLost)
    assert done.exception.exit_code == 4
    assert "scans" in done.output
    assert 20 < len(read(tmp_path / "out.mcap")[1]) < 35


def test_messages_that_cannot_be_decoded_are_left_out_and_counted():
    with open_source(FIXTURES / "tumble.mcap", SourceOptions()) as source:
        scans, truth_of = list(source.scans()), source.truth_of
    scans[3] = replace(scans[3], status=ScanStatus.DAMAGED)
    written = []

    class Writer:
        def write(self, scan):
            written.append(scan.seq)

        def write_truth(self, *truth):
            assert len(truth) == 4

    tally = recording.write_recorded(
        [(scan, scan) for scan in scans],
        truth_of,
        Writer(),
        true_clock=False,
        camera_of=lambda _: [],
    )
    assert (tally.damaged, tally.scans, 3 in written) == (1, 34, False)


def test_the_dragon_becomes_a_log(tmp_path):
    folder = DATA / "stanford-dragon"
    if not folder.exists():
        pytest.skip("../shared/data is not here")
    options = RecordOptions(model=folder / "dragon_vrip_res3.ply")
    done = record(folder, tmp_path / "dragon.mcap", options=options)
    _, scans = read(tmp_path / "dragon.mcap")
    assert (done.scans, len(scans)) == (15, 15)
    assert_allclose(np.diff([s.t_ns for s in scans]) * 1e-9, 1.0)
    assert all(s.truth is not None for s in scans)
    turns = [
        np.degrees(2 * np.arccos(min(1.0, abs(float(s.truth.q @ scans[0].truth.q)))))
        for s in scans[1:3]
    ]
    assert_allclose(turns, [24, 48], atol=1.0)
