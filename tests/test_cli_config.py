"""``avsreplay config``, options derived from declarations, and environment variables."""

import importlib
import json
import tomllib
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

from avsreplay import settings, toml_document
from avsreplay.cli.config import SECTIONS, SettingOption, declared, reference_page
from avsreplay.cli.main import SUMMARIES, group
from avsreplay.config import PAPER, RunConfig, load_config
from avsreplay.monitor.fault_detection import pose_limit
from avsreplay.records import Innovation

ROOT = Path(__file__).resolve().parents[1]


def config(*args, env=None):
    """Output of ``avsreplay config`` as TOML; no process is started."""
    done = CliRunner().invoke(group, ["config", *args], env=env, auto_envvar_prefix="AVSREPLAY")
    assert done.exception is None, done.output
    return done.output


def test_the_reference_page_is_current():
    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    assert page == reference_page(), "run: avsreplay config --markdown > docs/settings.md"


def test_the_reference_page_holds_every_setting():
    page = reference_page()
    for _, _, owner in SECTIONS:
        module, _, name = owner.partition(":")
        for entry in settings.entries(getattr(importlib.import_module(module), name)):
            assert f"- `{entry.key}` (" in page


def test_a_printed_configuration_gives_the_same_run(cli, fixtures_folder, tmp_path):
    log, chosen = (
        fixtures_folder / "tumble.mcap",
        ["--set", "register.gate_m=0.05", "--policy", "all"],
    )
    printed = cli("config", log, *chosen)
    assert printed.code == 0, printed.err
    (tmp_path / "c.toml").write_text(printed.out, encoding="utf-8")
    direct = cli("run", log, "--n-scans", 4, "--json", *chosen)
    read = cli("run", log, "--n-scans", 4, "--json", "--config", tmp_path / "c.toml")
    assert direct.code == read.code == 0
    plain = cli("run", log, "--n-scans", 4, "--json")
    first, second, default = (json.loads(each.out) for each in (direct, read, plain))
    assert first["rows"] == second["rows"]
    assert first["header"]["config"] == second["header"]["config"] != default["header"]["config"]


def test_the_log_brings_its_own_table(cli, tmp_path):
    scenario = tmp_path / "s.toml"
    scenario.write_text(
        "duration_s = 1.0\n[scanner]\nrays = [16, 16]\n[run.faults]\npolicy = 'all'\n",
        encoding="utf-8",
    )
    assert cli("record", scenario, "-o", tmp_path / "s.mcap").code == 0
    assert tomllib.loads(config(str(tmp_path / "s.mcap")))["faults"]["policy"] == "all"
    assert tomllib.loads(config())["faults"]["policy"] == "any"


def test_a_relative_path_of_an_arm_refers_to_the_file_that_states_it(cli, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder, table = tmp_path / "robots", "urdf = 'arm.urdf'\n"
    folder.mkdir()
    (folder / "robot.toml").write_text(f"[robot]\n{table}", encoding="utf-8")
    own = f"duration_s = 1.0\n[scanner]\nrays = [16, 16]\n[run.robot]\n{table}"
    (folder / "s.toml").write_text(own, encoding="utf-8")
    assert cli("record", folder / "s.toml", "-o", folder / "s.mcap").code == 0
    stated = str(Path("robots") / "arm.urdf")
    given = {
        stated: (
            ["--config", "robots/robot.toml"],
            ["--robot", "robots/robot.toml"],
            ["robots/s.mcap"],
        ),
        "arm.urdf": (["--set", "robot.urdf=arm.urdf"],),
    }
    for path, options in given.items():
        for option in options:
            assert tomllib.loads(config(*option))["robot"]["urdf"] == path, option
    (folder / "robot.toml").write_text(f"[robot]\nurdf = '{tmp_path}/arm.urdf'\n", encoding="utf-8")
    assert (
        tomllib.loads(config("--robot", "robots/robot.toml"))["robot"]["urdf"]
        == f"{tmp_path}/arm.urdf"
    )


def test_json_is_the_configuration_of_a_run():
    assert json.loads(config("--json", "--policy", "all")) == settings.dump(
        load_config(None, {}, ["faults.policy=all"])
    )


def test_environment_variables_are_those_of_run_and_options_come_before_them():
    environment = {
        "AVSREPLAY_RUN_POLICY": "all",
        "AVSREPLAY_RUN_SET": "register.n_max=7 deskew=false",
    }
    table = tomllib.loads(config(env=environment))
    assert (table["faults"]["policy"], table["register"]["n_max"], table["deskew"]) == (
        "all",
        7,
        False,
    )
    table = tomllib.loads(config("--set", "faults.policy=any", env=environment))
    assert (table["faults"]["policy"], table["register"]["n_max"]) == ("any", 200)


def test_a_configuration_file_may_come_from_the_environment(tmp_path):
    (tmp_path / "c.toml").write_text("guess = 'last'\n", encoding="utf-8")
    assert (
        tomllib.loads(config(env={"AVSREPLAY_RUN_CONFIG": str(tmp_path / "c.toml")}))["guess"]
        == "last"
    )


@pytest.mark.parametrize("command", [["config"], ["run", "x.mcap"]])
def test_an_unknown_environment_variable_is_an_error(command, cli):
    done = cli(*command, env={"AVSREPLAY_RUN_POLCY": "all"})
    assert done.code == 2
    assert done.err.count("\n") == 1
    assert "AVSREPLAY_RUN_POLCY" in done.err
    assert "did you mean AVSREPLAY_RUN_POLICY?" in done.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--policy", "most"), "'most' is not one of any, all"),
        (("--set", "regster.gate_m=1"), "did you mean 'register.gate_m'"),
        (
            ("--set", "register.gate_m=-1"),
            "--set register.gate_m=-1: register.gate_m is -1.0, must be above 0 [m]",
        ),
    ],
)
def test_a_wrong_value_is_one_line_that_names_the_option(arguments, words, cli):
    done = cli("config", *arguments)
    assert done.code == 2
    assert "Traceback" not in done.err
    assert words in done.err


@pytest.mark.parametrize("name", SUMMARIES)
def test_help_of_an_option_is_the_declared_meaning(name):
    command = group.get_command(click.Context(group), name)
    for option in command.params:
        if isinstance(option, SettingOption):
            setting = declared(option.owner, option.key).declared
            record = option.get_help_record(click.Context(command))
            assert setting.doc.removesuffix(".") in record[1]
            assert setting.unit in record[1]


def test_every_setting_is_written_with_its_meaning():
    text = toml_document.to_toml(RunConfig())
    flat = " ".join(line.removeprefix("# ") for line in text.splitlines())
    for entry in settings.entries(RunConfig):
        assert entry.declared.doc in flat, entry.key


@pytest.mark.parametrize(
    ("words", "env", "begins"),
    [
        (("--init", "foo"), {}, "--init foo: init is 'foo', not log, truth, auto or seven numbers"),
        (
            ("--init", "foo", "--set", "register.gate_m=0.2", "--policy", "all"),
            {},
            "--init foo: init is",
        ),
        (("--init", "5"), {}, "--init 5: init is '5'"),
        (
            ("--init", "0,0,1,0,0,0,9"),
            {},
            "--init 0,0,1,0,0,0,9: init is '0,0,1,0,0,0,9', its quaternion",
        ),
        (("--set", "init=foo"), {}, "--set init=foo: init is 'foo'"),
        ((), {"AVSREPLAY_RUN_INIT": "foo"}, "environment AVSREPLAY_RUN_INIT=foo: init is 'foo'"),
    ],
)
def test_an_error_names_the_option_that_was_given(words, env, begins):
    done = CliRunner().invoke(group, ["config", *words], env=env, auto_envvar_prefix="AVSREPLAY")
    assert str(done.exception).startswith(begins)
    assert "--set init" not in str(done.exception) or "--set" in words


def test_an_initial_pose_of_another_command_is_named_as_given(fixtures_folder):
    words = ["observability", str(fixtures_folder / "tumble.mcap"), "--init", "1,2,3"]
    assert str(CliRunner().invoke(group, words).exception).startswith(
        "--init 1,2,3: init is '1,2,3'"
    )


def test_the_method_of_the_paper_has_none_of_the_additions():
    found = load_config(None, {}, PAPER)
    assert found.estimator.start.value == "paper"
    assert found.estimator.adapt.value == "matrix"
    assert not found.estimator.robust
    assert found.convergence.criterion.value == "covariance"
    seen = Innovation(np.full(6, 0.1), np.eye(6), np.eye(6), 1.0, 1.0, 0.1, 0.1)
    assert (
        pose_limit(seen, 0.05, 1.0, found.faults.sigmas) == 0.05
    )  # constant, whatever the covariance S
    assert pose_limit(seen, 0.05, 1.0, RunConfig().faults.sigmas) > 1.0
