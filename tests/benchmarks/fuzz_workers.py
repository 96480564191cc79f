"""The processes of the campaigns: workers of fuzz_logs.py and fuzz_commands.py, commands of
outputs.py.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from command_server import exit_code

if (
    sys.platform != "win32"
):  # a campaign needs the forks, alarms and limits of POSIX; its inputs do not
    import resource

WALL = 20  # limit of wall time per limit of processor time, because machines are shared

Check = Callable[[Path], str]
Task = Callable[[int], tuple[str, Check]]
Campaign = tuple[Counter[str], list[dict[str, object]], int]


class Hang(BaseException):
    """Raised by an alarm; no handler of the package may catch it."""


def run_campaign(
    inputs: list[int], task: Task, limit_s: int, limit_mib: int, batch: int
) -> Campaign:
    """Run a campaign in batches, each in a process of its own, so that a crash costs one input and
    is named.

    A finding is an exception, a run longer than ``limit_s``, a crash, a process larger than
    ``limit_mib``, a file beside the input's own folder, and anything that a library writes to the
    terminal.

    Args:
        inputs: numbers of the mutations.
        task: gives, for a number, what the input is called and a function of an empty folder that
            runs it and returns one word about the outcome.
        limit_s: processor time for one input [s].
        limit_mib: memory of a process [MiB].
        batch: inputs for one process.

    Returns:
        How often each outcome occurred, the findings, and the largest process [MiB].
    """
    tally: Counter[str] = Counter()
    findings: list[dict[str, object]] = []
    peak, queue = 0, [inputs[i : i + batch] for i in range(0, len(inputs), batch)]

    def finding(number: int, name: str, what: str) -> None:
        findings.append({"input": number, "case": name, "what": what})
        print(json.dumps(findings[-1]), file=sys.stderr, flush=True)

    while queue:
        todo = queue.pop(0)
        here, there = multiprocessing.Pipe(False)
        worker = multiprocessing.get_context("fork").Process(
            target=_work, args=(todo, task, limit_s, there)
        )
        worker.start()
        there.close()
        last: tuple[int, str] | None = None
        for what, number, value in _messages(here):
            if what == "begin":
                last = number, value
            elif what == "peak":
                peak = max(peak, number)
            else:
                bad, name, last = value.startswith("FINDING"), last[1] if last else "", None
                tally["finding" if bad else value] += 1
                if bad:
                    finding(number, name, value)
        worker.join()
        if last is not None:
            tally["finding"] += 1
            finding(*last, f"crash, exit code {worker.exitcode}")
            queue.insert(0, todo[todo.index(last[0]) + 1 :])
        print(
            f"{sum(tally.values())} of {len(inputs)}: {dict(sorted(tally.items()))}",
            file=sys.stderr,
            flush=True,
        )
    if peak > limit_mib:
        finding(-1, "", f"a process of {peak} MiB, over {limit_mib}")
    return tally, findings, peak


def _messages(pipe: Connection) -> Iterator[tuple[str, int, str]]:
    """What a worker sends, until it ends."""
    while True:
        try:
            yield pipe.recv()
        except EOFError:
            return


def _work(numbers: list[int], task: Task, limit_s: int, pipe: Connection) -> None:
    """A worker process: announces each input and its outcome."""
    os.environ["OMP_NUM_THREADS"] = "1"
    for name in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(name, _alarm)
    with tempfile.TemporaryFile() as terminal, _terminal(terminal.fileno()):
        for number in numbers:
            name, check = task(number)
            pipe.send(("begin", number, name))
            outcome = _one(check, limit_s)
            terminal.seek(0)
            if written := terminal.read(2000):
                outcome = f"FINDING on the terminal: {written!r}"
                terminal.truncate(0)
            pipe.send(("end", number, outcome))
    pipe.send(("peak", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024, ""))
    pipe.close()


@contextmanager
def _terminal(file: int) -> Iterator[None]:
    """Send everything that is written to standard output and standard error, by any library, to a
    file.
    """
    kept = os.dup(1), os.dup(2)
    os.dup2(file, 1)
    os.dup2(file, 2)
    yield
    os.dup2(kept[0], 1)
    os.dup2(kept[1], 2)


def _one(check: Check, limit_s: int) -> str:
    """Run one input in an empty folder, which is the working directory."""
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / "in"
        folder.mkdir()
        os.chdir(folder)
        signal.alarm(WALL * limit_s)
        signal.setitimer(signal.ITIMER_PROF, limit_s)
        try:
            outcome = check(folder)
        except (Exception, Hang):
            outcome = "FINDING\n" + traceback.format_exc()
        signal.alarm(0)
        signal.setitimer(signal.ITIMER_PROF, 0)
        os.chdir("/")
        if [p.name for p in Path(root).iterdir()] != ["in"]:
            outcome = "FINDING a file was written outside"
    return outcome


def _alarm(_signal: int, _frame: object) -> None:
    raise Hang


@dataclass(frozen=True)
class Done:
    """A finished command."""

    returncode: int
    stderr: str


class Command:
    """A command in a fork of this process, which has imported the package: it starts in
    milliseconds.
    """

    def __init__(
        self, args: Sequence[str], place: Path, file_bytes: int | None = None, limit_s: int = 600
    ) -> None:
        """Start it.

        Args:
            args: its arguments.
            place: its working directory.
            file_bytes: no file may become larger, as on a full disk.
            limit_s: it is ended after this time.
        """
        self._errors, end = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            os.close(self._errors)
            os.dup2(end, 2)
            self._run(args, place, file_bytes, limit_s)
        os.close(end)

    def kill(self) -> bool:
        """Kill it; True if it was still running."""
        os.kill(self.pid, signal.SIGKILL)
        return self.wait().returncode == -signal.SIGKILL

    def wait(self) -> Done:
        """Wait for its end."""
        with os.fdopen(self._errors, "rb") as stream:
            text = stream.read().decode(errors="replace")
        return Done(os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1]), text)

    def _run(self, args: Sequence[str], place: Path, file_bytes: int | None, limit_s: int) -> None:
        code = 70
        try:
            with Path(os.devnull).open("r+b") as nothing:
                os.dup2(nothing.fileno(), 0)
                os.dup2(nothing.fileno(), 1)
            os.chdir(place)
            if file_bytes is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))
            signal.alarm(limit_s)
            code = exit_code(args)
        except BaseException:
            traceback.print_exc()
        finally:
            for stream in (sys.stdout, sys.stderr):
                with suppress(OSError, ValueError):
                    stream.flush()
            os._exit(code)


def report(campaign: int, count: int, result: Campaign) -> int:
    """Print the result of a campaign as one JSON document; return the exit code, 1 on any
    finding.
    """
    tally, findings, peak = result
    spent = sum(
        resource.getrusage(who).ru_utime for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    document = {
        "campaign": campaign,
        "inputs": count,
        "outcomes": dict(sorted(tally.items())),
        "largest_process_mib": peak,
        "processor_s": round(spent, 1),
        "findings": findings[:40],
        "count_of_findings": len(findings),
    }
    print(json.dumps(document, indent=1))
    return 1 if findings else 0
