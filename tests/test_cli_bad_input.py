"""Bad input gives one line (what, where, what to do), the documented exit code, no traceback and no
partial output.
"""

import struct

import pytest

GOOD_PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty"
    b" float z\n"
)
FACES = (
    b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 %s\n3 0"
    b" 1 2\n"
)


def check_one_line(done, code, *words):
    assert done.code == code, done.out + done.err
    assert done.out == ""
    lines = done.err.strip().splitlines()
    assert "Traceback" not in done.err
    assert len([line for line in lines if line.startswith("avsreplay: ")]) == 1, done.err
    assert len(lines) == 1, done.err
    for word in words:
        assert word in done.err


@pytest.fixture
def log(fixtures_folder):
    return fixtures_folder / "tumble.mcap"


@pytest.mark.parametrize("verb", ["run", "info"])
def test_a_missing_file(verb, cli, tmp_path):
    check_one_line(cli(verb, tmp_path / "none.mcap"), 3, "none.mcap")


@pytest.mark.parametrize("verb", ["run", "info"])
@pytest.mark.parametrize("content", [b"", b"hello, this is no log", b"\x00" * 4096])
def test_a_file_that_is_not_a_log(verb, content, cli, tmp_path):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    check_one_line(cli(verb, path), 3, "x.mcap")


def test_a_log_truncated_after_its_first_bytes(cli, tmp_path):
    path = tmp_path / "x.mcap"
    path.write_bytes(b"\x89MCAP0\r\n")
    check_one_line(cli("run", path), 3, "x.mcap")
    assert cli("info", path).code == 4  # it says what there is, and that the rest is lost


def test_a_folder_without_scans(cli, tmp_path):
    check_one_line(cli("run", tmp_path), 3)


def test_a_log_without_a_cloud_topic(cli, shared_data):
    bag = shared_data / "mcap-rosbag2" / "cdr_test"
    check_one_line(cli("run", bag), 3, "cloud topic")


def test_no_model(cli, shared_data, tmp_path):
    out = tmp_path / "d.mcap"
    assert cli("record", shared_data / "stanford-dragon", "-o", out, "--n-scans", 1).code == 0
    check_one_line(cli("run", out), 2, "no model", "--model")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (GOOD_PLY + FACES % b"nan", "not finite"),
        (GOOD_PLY + b"end_header\n0 0 0\n1 0 0\n0 1 0\n", "no faces"),
        (b"ply\nnot really", "m.ply"),
        (b"", "m.ply"),
    ],
)
def test_an_invalid_model(text, word, cli, log, tmp_path):
    model = tmp_path / "m.ply"
    model.write_bytes(text)
    check_one_line(cli("run", log, "--model", model), 3, word)


@pytest.mark.parametrize(
    ("text", "line", "word"),
    [
        ("duration_s = 10\nrate = 5\n", 2, "did you mean"),
        ('duration_s = "ten"\n', 1, "a number"),
        ("[[fault]]\nkind = 'oclusion'\nstart_s = 1\nduration_s = 1\n", 2, "one of"),
        ("[target\n", None, "not valid TOML"),
    ],
)
def test_a_scenario_with_a_wrong_key(text, line, word, cli, tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(text)
    done = cli("record", path, "-o", tmp_path / "x.mcap")
    check_one_line(done, 2, word, f"s.toml:{line}" if line else "s.toml")
    assert not (tmp_path / "x.mcap").exists()


@pytest.mark.parametrize(
    ("flags", "word"),
    [
        (("--backend", "nonesuch"), "horn"),
        (("--init", "1,2,3"), "seven numbers"),
        (("--init", "0,0,0,1,1,1,1"), "unit length"),
        (("--set", "faults.polcy=any"), "did you mean"),
        (("--set", "plan.a_max_mps2=-1"), "a_max_mps2"),
        (("--topic", "/nothing"), "/points"),
        (("--truth-gap", "nan"), "--truth-gap"),
        (("--every-scan", "0"), "--every-scan is 0"),
        (("--nope",), "see 'avsreplay run --help'"),
        (("--golden", "a", "--update-golden", "b"), "exclude"),
    ],
)
def test_an_invalid_option(flags, word, cli, log):
    check_one_line(cli("run", log, *flags), 2, word)


@pytest.mark.parametrize(
    ("scale", "code", "word"),
    [
        ("1e-320", 3, "the model spans"),
        ("1e90", 3, "a vertex is at"),
        ("1.7e308", 2, "--model-scale is 1.7e+308, must be at most 1e+100"),
    ],
)
@pytest.mark.parametrize("command", ["run", "info"])
def test_a_model_of_an_extreme_scale_is_one_line(command, scale, code, word, cli, log):
    check_one_line(cli(command, log, "--model-scale", scale), code, word)


@pytest.mark.parametrize("extent", ["nan", "inf", "0", "1e308", "1e-320"])
def test_an_extent_that_no_target_has_is_one_line(extent, cli):
    check_one_line(cli("plan", "nothing", "--extent", extent), 2, "--extent")


def test_a_missing_argument_names_the_help(cli):
    check_one_line(cli("completion"), 2, "fish; see 'avsreplay completion --help'")


def test_without_arguments_the_help_is_printed(cli):
    done = cli()
    assert (done.code, done.out) == (2, "")
    assert done.err == cli("--help").out


def test_a_log_or_a_folder_without_rows_is_no_result(cli, log, tmp_path):
    check_one_line(cli("plan", log), 3, "is a log, not a result", "avsreplay run")
    check_one_line(cli("plan", tmp_path), 3, "holds no rows.jsonl")


def test_a_seed_beyond_64_bits_is_one_line(cli, log, tmp_path):
    check_one_line(cli("record", "-o", tmp_path / "a.mcap", "--seed", 2**63), 2, "--seed")
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize("option", ["--end", "--duration"])
def test_a_selection_without_a_scan_is_shown_and_not_replayed(option, cli, log):
    done = cli("info", log, option, "0")
    assert done.code == 0, done.err
    check_one_line(cli("run", log, option, "0"), 3, "no scan to replay")


@pytest.mark.parametrize("size", ["nan", "inf", "0", "-1", "1e-7", "1e7", "1e-320"])
def test_a_size_that_no_target_has_is_one_line(size, cli, log, tmp_path):
    check_one_line(
        cli("odometry", log, "-o", tmp_path / "a.tum", "--n-scans", 2, "--size", size), 2, "--size"
    )


def test_a_config_file_with_a_wrong_key(cli, log, tmp_path):
    config = tmp_path / "c.toml"
    config.write_text("[plan]\n\nhorizon = 3\n")
    check_one_line(cli("run", log, "--config", config), 2, "c.toml:3")


def test_an_existing_log_is_not_overwritten(cli, tmp_path):
    out = tmp_path / "x.mcap"
    out.write_bytes(b"precious")
    check_one_line(cli("record", "-o", out), 2, "--overwrite")
    assert out.read_bytes() == b"precious"


def test_an_output_in_a_missing_folder(cli, tmp_path):
    done = cli("record", "-o", tmp_path / "no" / "x.mcap")
    assert done.code in (2, 3)
    assert "Traceback" not in done.err
    assert list(tmp_path.iterdir()) == []


def test_a_cloud_with_an_unknown_encoding(cli, tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "json.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="", library="test")
        schema = writer.register_schema("sensor_msgs/PointCloud2", "jsonschema", b"{}")
        channel = writer.register_channel("/points", "json", schema)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    check_one_line(cli("run", path), 3, "unknown encoding 'json'")


def test_terminal_escapes_in_names_are_escaped(cli, tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "esc.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/a\x1b[2J\x07b", "cdr", schema)
        writer.add_message(channel, 1, struct.pack("<4sI2s", b"\0\1\0\0", 2, b"x\0"), 1)
        writer.finish()
    done = cli("run", path)
    assert done.code == 3
    assert "\x1b" not in done.err + done.out


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("mass_kg = 1e-320\nthrust_axes_n = [6.0, 4.0, 4.0]", "a_max_mps2 is inf"),
        ("accel_axes_mps2 = [1.0, 1.0, inf]", "accel_axes_mps2 is [1.0, 1.0, inf]"),
        ("delay_s = 1e6", "latency_s is 1000000.0, must be below horizon_s"),
    ],
)
def test_an_impossible_robot_is_one_line(tmp_path, text, what):
    """Values that are allowed one by one, but not together with the planner's."""
    from click.testing import CliRunner

    from avsreplay.cli.config import config_command
    from avsreplay.errors import UsageError

    robot = tmp_path / "robot.toml"
    robot.write_text(f"[robot]\n{text}\n")
    ended = CliRunner().invoke(config_command, ["--robot", str(robot)])
    assert isinstance(ended.exception, UsageError)
    assert what in str(ended.exception)


@pytest.mark.parametrize(
    ("command", "output", "format_"),
    [("record", "x.bag", "MCAP"), ("model", "m.obj", "PLY"), ("model", "m.STL", "PLY")],
)
def test_a_name_that_states_another_format_is_refused(
    cli, tmp_path, fixtures_folder, command, output, format_
):
    done = cli(command, fixtures_folder / "tumble.mcap", "-o", tmp_path / output)
    assert done.code == 2
    assert f"the format is {format_}" in done.err
    assert not (tmp_path / output).exists()


def test_a_scenario_and_a_result_are_no_logs(cli, tmp_path, fixtures_folder):
    scenario = cli("run", fixtures_folder / "tumble.toml")
    assert (scenario.code, "make a log of it: avsreplay record" in scenario.err) == (3, True)
    assert (
        cli("run", fixtures_folder / "tumble.mcap", "--n-scans", 2, "-o", tmp_path / "r").code == 0
    )
    for name in ("", "run.json", "rows.jsonl"):
        result = cli("info", tmp_path / "r" / name)
        assert (result.code, "is the result of a run, not a log" in result.err) == (3, True)


def test_a_mode_given_as_start_time_names_the_option_for_modes(cli, log):
    check_one_line(cli("run", log, "--start", "cold"), 2, "--start-mode cold")
    check_one_line(cli("info", log, "--start", "cold"), 2, "no time in seconds")


def test_a_rate_for_a_log_with_times_is_refused(cli, log):
    check_one_line(cli("run", log, "--rate", 10), 2, "times of their own", "--every-scan")
