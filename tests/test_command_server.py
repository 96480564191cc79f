"""A command in a fork has the output, exit code and environment of a command in a process of its
own.
"""

import os
import subprocess
import sys

import pytest
from command_server import CommandServer

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")


@pytest.fixture(scope="module")
def server():
    made = CommandServer()
    yield made
    made.close()


@pytest.mark.parametrize(
    "args", [["info", "none.mcap"], ["--version"], ["config", "--set", "faults.policy=all"], ["x"]]
)
def test_a_fork_is_like_a_process(server, tmp_path, args):
    command = [sys.executable, "-m", "avsreplay", *args]
    alone = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert server.run(args, tmp_path, dict(os.environ), 60) == (
        alone.returncode,
        alone.stdout,
        alone.stderr,
    )


def test_variables_that_are_read_at_the_start_need_a_process(server):
    assert server.run(["config"], None, {**os.environ, "PYTHONHASHSEED": "7"}, 60) is None
    assert server.run(["config"], None, {**os.environ, "AVSREPLAY_RUN_POLCY": "all"}, 60)[0] == 2


def test_a_command_that_does_not_end_is_killed(server, tmp_path):
    os.mkfifo(tmp_path / "x.mcap")
    code, _, _ = server.run(["info", str(tmp_path / "x.mcap")], tmp_path, dict(os.environ), 1)
    assert code != 0
