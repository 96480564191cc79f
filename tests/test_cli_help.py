"""Help and usage of the commands: its length, options that users of other tools type first, and
messages that name the next step.
"""

from __future__ import annotations

import math
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result

from avsreplay.cli.main import SUMMARIES, group
from avsreplay.cli.plan import CHANGES
from avsreplay.cli.run import job_of, run_command
from avsreplay.config import PAPER, RunConfig, load_config
from avsreplay.errors import AvsError
from avsreplay.settings import entries

LINES = 62
FIRST = b'{"seq": 0}\n'


def invoked(*args: object) -> Result:
    return CliRunner().invoke(group, [str(arg) for arg in args], prog_name="avsreplay")


def refused(*args: object) -> str:
    """The message of a command that fails as the user's error."""
    error = invoked(*args).exception
    assert isinstance(error, AvsError)
    return str(error)


def options_of(name: str) -> set[str]:
    command = group.get_command(click.Context(group), name)
    assert command is not None
    return {option for param in command.params for option in param.opts if option[0] == "-"}


@pytest.mark.parametrize("name", SUMMARIES)
def test_the_help_of_a_command_fits_a_screen_and_refers_to_all_options(name):
    short = invoked(name, "--help").stdout
    assert len(short.splitlines()) <= LINES
    whole = invoked(name, "--help-all").stdout if "--help-all" in short else short
    for option in options_of(name):
        assert option in whole


@pytest.mark.parametrize("name", SUMMARIES)
def test_the_help_states_every_default_that_is_a_number_or_a_path(name):
    command = group.get_command(click.Context(group), name)
    assert command is not None
    for param in command.params:
        if isinstance(param, click.Option) and not param.is_flag:
            has_default = isinstance(param.default, (int, float, str, Path)) and param.default != ""
            assert param.show_default or not has_default, param.opts


def test_the_changes_that_are_tried_are_settings_and_become_larger():
    """With the first factor with which a plan is found, the change that is named is the least."""
    known = {entry.key for entry in entries(RunConfig)}
    for key, factors in CHANGES:
        assert key in known
        assert 1.0 not in factors
        sizes = [abs(math.log(max(factor, 1e-9))) for factor in factors]
        assert sizes == sorted(set(sizes)), key


def test_a_command_without_a_model_has_no_option_for_one():
    for name in ("odometry", "model"):
        assert "--topic" in options_of(name)
        without_effect = {"--model", "--model-unit", "--truth", "--truth-topic", "--truth-frame"}
        assert not without_effect & options_of(name)


def test_the_letters_of_other_tools_mean_the_same_here():
    context = run_command.make_context(
        "run", ["log", "-n", "3", "-t", "/points", "-o", "out", "-v"]
    )
    assert (context.params["n_scans"], context.params["topic"]) == (3, "/points")
    assert (context.params["output"], context.params["verbose"]) == (Path("out"), True)
    for name in ("run", "info", "record", "odometry", "model", "observability"):
        assert {"-n", "-t"} <= options_of(name)
    for name in ("run", "record", "odometry", "model", "export", "report", "compare", "sweep"):
        assert "-o" in options_of(name)


def test_the_time_and_the_mode_of_the_start_are_two_options():
    with run_command.make_context(
        "run", ["log", "--start", "2", "--start-mode", "near"]
    ) as context:
        flags = dict(context.params)
        job = job_of(Path(flags.pop("log")), flags)
    assert job.options.start_s == 2.0
    assert load_config(None, {}, job.assignments).estimator.start.value == "near"
    assert invoked("run", "log", "--start", "near").exit_code == 2


@pytest.mark.parametrize("given", [(), ("--paper",), ("--paper", "--set", "faults.sigmas=4")])
def test_the_method_of_the_paper_is_used_where_it_is_asked_for_and_settings_precede_it(given):
    with run_command.make_context("run", ["log", *given]) as context:
        flags = dict(context.params)
        job = job_of(Path(flags.pop("log")), flags)
    found, paper = (load_config(None, {}, each) for each in (job.assignments, PAPER))
    assert (found.estimator == paper.estimator) is ("--paper" in given)
    assert (found.faults == paper.faults) is (given == ("--paper",))


def test_a_log_in_place_of_a_command_suggests_the_command(fixtures_folder, tmp_path):
    log = fixtures_folder / "tumble.mcap"
    assert f"avsreplay run {log} -n 3" in refused(log, "-n", 3)
    (tmp_path / "rows.jsonl").write_bytes(FIRST)
    assert f"avsreplay report {tmp_path}" in refused(tmp_path)
    assert "Did you mean run?" in invoked("rnu").output


def test_an_argument_too_many_names_its_option(fixtures_folder):
    log = fixtures_folder / "tumble.mcap"
    assert "--set faults.policy=all" in refused("run", log, "faults.policy=all")
    assert "-o x.mcap" in refused("record", fixtures_folder / "tumble.toml", "x.mcap")
    assert "see 'avsreplay sweep --help'" in refused("sweep", "a", "b", "-o", "x")


@pytest.mark.parametrize("command", ["plan", "report", "compare"])
def test_a_log_is_no_result_and_the_message_says_how_to_make_one(command, fixtures_folder):
    said = refused(command, fixtures_folder / "tumble.mcap")
    assert "is a log, not a result; replay it first: avsreplay run " in said
    assert "rows.jsonl" not in said


@pytest.mark.parametrize(
    "words",
    [
        ("compare", "a", "b", "-o", "cmp.txt"),
        ("plan", "a", "--export", "plan.xyz"),
        ("plan", "a", "--animate", "flight.mp4"),
        ("report", "a", "-o", "page.pdf"),
    ],
)
def test_an_output_of_another_format_is_refused_before_any_work(words):
    assert "the format is" in refused(*words)


def test_a_mistyped_metric_names_the_nearest_one(tmp_path):
    (tmp_path / "gate.toml").write_text('[[rule]]\nmetric = "pose_pos_rms"\nmax = 1.0\n')
    said = refused("compare", tmp_path, "--gate", tmp_path / "gate.toml")
    assert "did you mean 'pose_pos_rmse_m'?" in said
    assert len(said.replace(str(tmp_path), "")) < 160


def test_the_type_of_a_list_is_said_in_words():
    with pytest.raises(AvsError, match="a list of 3 numbers"):
        load_config(None, {}, ["plan.robot_position_m=1.0"])


def test_logs_that_are_no_parts_of_one_bag_are_not_joined(fixtures_folder, tmp_path):
    content = (fixtures_folder / "tumble.mcap").read_bytes()
    for name in ("first.mcap", "other.mcap"):
        (tmp_path / name).write_bytes(content)
    assert "first.mcap, other.mcap; name one of them" in refused("info", tmp_path)
    for name in ("first", "other"):
        (tmp_path / f"{name}.mcap").rename(tmp_path / f"drive_{name == 'other':d}.mcap")
    assert invoked("info", tmp_path).exception is None
