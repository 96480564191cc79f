"""A process that has imported the package and runs each command in a fork of itself: 20 ms instead
of 0.7 s.

A command is run as in a process of its own: own standard streams, working directory, environment
and exit code. What must be known when a process starts (variables of Python and of the arithmetic)
is compared with that of the server; the test then starts a process. Modules that a command imports
are imported by the server, too, for the following commands.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import traceback
from pathlib import Path

START_ONLY = (
    "PYTHON",
    "LD_",
    "LC_",
    "LANG",
    "OPENBLAS",
    "OMP_",
    "NPY_",
    "GLIBC_",
    "AVSREPLAY_ARITHMETIC",
)
KEPT = (
    "avsreplay",
    "scipy",
    "rich",
    "rosbags",
    "trimesh",
    "clarabel",
    "jinja2",
    "tomli_w",
    "mcap",
    "msgspec",
    "embreex",
)


def fixed(environment):
    """The variables that take effect when a process starts."""
    return {name: value for name, value in environment.items() if name.startswith(START_ONLY)}


class CommandServer:
    """The client: starts the server with the first command and ends it with ``close``.

    Attributes:
        spent_s: processor time of the server and its commands until now.
    """

    def __init__(self):
        self._process, self._folder, self.spent_s = None, None, 0.0
        self._environment = fixed(os.environ)

    def run(self, args, cwd, environment, timeout):
        """Run a command; exit code, standard output and error, or None where it needs a
        process of its own.
        """
        if not hasattr(os, "fork") or fixed(environment) != self._environment:
            return None
        if self._process is None:
            self._start()
        names = [str(Path(self._folder.name) / name) for name in ("out", "err")]
        request = {
            "args": args,
            "cwd": str(cwd or Path.cwd()),
            "env": environment,
            "files": names,
            "limit": timeout,
        }
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        code, self.spent_s = json.loads(self._process.stdout.readline())
        return (code, *(Path(name).read_text(encoding="utf-8") for name in names))

    def _start(self):
        from avsreplay import arithmetic

        pins = arithmetic.PINS if arithmetic.has_variants() and not arithmetic_is_native() else {}
        environment = {**os.environ, **pins, arithmetic.THREADS: "1"}
        self._folder = tempfile.TemporaryDirectory()
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self._process = subprocess.Popen(
            [sys.executable, __file__], env=environment, text=True, **pipes
        )

    def close(self):
        """End the server."""
        if self._process is not None:
            self._process.stdin.close()
            self._process.wait()
            self._folder.cleanup()


def arithmetic_is_native():
    return os.environ.get("AVSREPLAY_ARITHMETIC") == "native"


def serve():
    """Answer requests, one line each, until standard input ends."""
    import avsreplay.__main__
    import avsreplay.cli.run
    import avsreplay.run  # noqa: F401

    requests, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    with Path(os.devnull).open("r+b") as nothing:
        os.dup2(nothing.fileno(), 0)
        os.dup2(nothing.fileno(), 1)
    pinned = {name: value for name, value in os.environ.items() if name.startswith(START_ONLY)}
    for line in requests:
        there, here = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(there)
            _child(json.loads(line), pinned, here)
        os.close(here)
        with os.fdopen(there) as names:
            known = [name for name in names.read().split() if name.partition(".")[0] in KEPT]
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        answers.write(json.dumps([code, sum(os.times()[:4])]) + "\n")
        answers.flush()
        for name in known:
            with contextlib.suppress(Exception):
                importlib.import_module(name)


def exit_code(args):
    """Run a command in this process, which must be a fork that ends after it; other
    exceptions are not caught.
    """
    sys.argv = ["avsreplay", *args]
    from avsreplay.__main__ import main

    try:
        main()
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    raise RuntimeError("the command returned in place of leaving with an exit code")


def _child(request, pinned, learned):
    code = 1
    try:
        for number, name in enumerate(request["files"], 1):
            file = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            os.dup2(file, number)
            os.close(file)
        os.chdir(request["cwd"])
        os.environ.clear()
        os.environ.update({**request["env"], **pinned})
        tempfile.tempdir = None
        signal.alarm(int(request["limit"]))
        before = set(sys.modules)
        code = exit_code(request["args"])
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            os.write(learned, " ".join(sorted(set(sys.modules) - before)).encode()[:60_000])
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(BaseException):
                stream.flush()
        os._exit(code)


if __name__ == "__main__":
    serve()
