"""``avsreplay run``: replays a log, prints tables, writes a result directory, compares with a
golden file.
"""

from __future__ import annotations

import sys
import time
from contextlib import closing, nullcontext
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.config import Command, run_settings, take_run_settings
from avsreplay.cli.options import (
    PATH,
    check_outputs,
    given_paths,
    log_file,
    pose_options,
    read_options,
    report_losses,
    source_options,
)
from avsreplay.errors import CheckFailed, UsageError, value_class

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping, Sequence

    from avsreplay.log import GrowingLog
    from avsreplay.model_size import Advice
    from avsreplay.report.golden import GoldenResult
    from avsreplay.report.summary import Summary
    from avsreplay.report.verdict import RunVerdict
    from avsreplay.result_dir import ResultDirectory, ResultWriter
    from avsreplay.rows import Row
    from avsreplay.run import Job, Listener, Run
    from avsreplay.viewers import RerunStream

GRADES = ("pass", "check", "any")
EPILOG = """\b
Examples:
  avsreplay run tumble.mcap
  avsreplay run y.mcap --model m.ply -t /points -o results/ --init truth
  avsreplay record scenario.toml -o - | avsreplay run -
  avsreplay run tumble.mcap --set faults.policy=all --set plan.a_max_mps2=0.02
  avsreplay run long.mcap -o results/ --resume          continue after Ctrl-C

\b
Exit codes: 0 ok, 1 the tracking is FAIL, the golden file differs or a requirement is not met,
            2 usage, 3 unreadable input, 4 finished but data was lost, 130 interrupted."""


class Tables(click.ParamType[tuple[str, ...]]):
    """Names of tables, separated by commas, or ``all``."""

    name = "NAME,...|all"

    def convert(
        self,
        value: Any,
        param: click.Parameter | None,
        ctx: click.Context | None,  # noqa: ARG002 -- the signature of click
    ) -> tuple[str, ...]:
        """Return the names."""
        from avsreplay.report.summary_tables import TABLES

        names = tuple(name for name in str(value).lower().split(",") if name)
        if "all" in names:
            return TABLES
        if unknown := [name for name in names if name not in TABLES]:
            self.fail(f"'{unknown[0]}' is none of {', '.join(TABLES)}, all", param)
        return names


class Requirement(click.ParamType[str | float]):
    """The value of ``--require``: ``pass``, ``check`` or ``any``, or ``capture=P`` with the least
    probability of a capture.
    """

    name = "pass|check|any|capture=P"

    def convert(
        self,
        value: Any,
        param: click.Parameter | None,
        ctx: click.Context | None,  # noqa: ARG002 -- the signature of click
    ) -> str | float:
        """Return the name of a grade, or the probability."""
        text = str(value).lower()
        if text in GRADES:
            return text
        name, sign, number = text.partition("=")
        try:
            least = float(number) if name == "capture" and sign else -1.0
        except ValueError:
            least = -1.0
        if not 0.0 <= least <= 1.0:
            self.fail(f"'{value}' is not {', '.join(GRADES)} or capture=P, P from 0 to 1", param)
        return least


@click.command("run", cls=Command, epilog=EPILOG)
@click.argument("log", type=PATH)
@run_settings
@click.option(
    "--paper", is_flag=True, help="Use the method as printed in the paper (docs/equations.md)."
)
@source_options
@pose_options
@click.option(
    "--golden",
    type=PATH,
    help="Compare the rows with this golden file; exit code 1 if they differ.",
)
@click.option("--update-golden", type=PATH, help="Write the rows to this golden file.")
@click.option(
    "-o",
    "--output",
    type=PATH,
    help="Result directory: rows, trajectories, beliefs and settings.",
)
@click.option(
    "--report",
    "page",
    is_flag=True,
    help="Also write the page report.html.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing result directory.")
@click.option("--resume", is_flag=True, help="Continue an interrupted run in the directory.")
@click.option(
    "--follow",
    is_flag=True,
    help="LOG is still being written: replay each scan as soon as it is complete.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
@click.option(
    "--require",
    "required",
    type=Requirement(),
    metavar="GRADE|capture=P",
    multiple=True,
    help="Exit code 1 if the verdict is worse: pass, check or any, or capture=0.9 for the least"
    " probability of a capture. Without it FAIL gives code 1; any accepts every verdict. May be"
    " repeated.",
)
@click.option(
    "--tables",
    type=Tables(),
    default="",
    metavar="NAME,...|all",
    help="Print more tables: verdict, moments, capture, scans, curves, errors, faults, manoeuvres,"
    " parameters, consistency, run.",
)
@click.option("-v", "--verbose", is_flag=True, help="Print all tables, as --tables all.")
@click.option("--every", "table_every", type=click.IntRange(1), help="Print every N-th scan.")
@click.option("--all", "table_all", is_flag=True, help="Print every scan.")
@click.option("--plain", is_flag=True, help="Leave out curves of errors and flagged scans.")
@click.option(
    "--rerun",
    "to_rerun",
    metavar="FILE.rrd|view|connect",
    help="Show the run in Rerun (extra 'rerun').",
)
def run_command(log: Path, **flags: Any) -> None:
    """Replay LOG: an MCAP file, a ROS bag, a folder of scans, a job file, or - for standard input.

    A log of 'avsreplay record' needs no option; for any other log 'avsreplay info LOG --model FILE'
    names the options that it needs, and --write stores them as a job file.

    \f
    A log from standard input, or one that --follow reads while it is written, is replayed scan by
    scan; the results are those of a replay of the complete log.

    Raises:
        UsageError: options contradict each other.
    """  # noqa: D301
    from avsreplay.result_dir import ResultDirectory

    log = _with_job_file(log, flags)
    wanted = Wanted(**{field.name: flags.pop(field.name) for field in fields(Wanted)})
    wanted.check()
    again = wanted.overwrite or wanted.resume
    inputs = given_paths("output", "update_golden")
    target = (
        ResultDirectory(wanted.output, overwrite=again, inputs=inputs) if wanted.output else None
    )
    with log_file(log, follow=wanted.follow) as (path, growing):
        job = job_of(path, flags)
        streamed = growing is not None and job.options.model != Path("auto") and not wanted.resume
        if wanted.follow and not streamed:
            raise UsageError(
                "--follow excludes --resume and --model auto", hint="leave out --follow"
            )
        try:
            _whole(replace(job, growing=growing if streamed else None), target, wanted)
        except Outdated:
            click.echo(
                "avsreplay: later records change times or true poses: the log is replayed once"
                " more",
                err=True,
            )
            _whole(job, target, wanted)


def _whole(job: Job, target: ResultDirectory | None, wanted: Wanted) -> None:
    """Replay a log and print and check the result."""
    from avsreplay.run import Run

    with Run(job) as run:
        advice = _checked(run)
        done = _replayed(run, advice, target, wanted)
        _print(wanted, done)
        if wanted.page and wanted.output:
            from avsreplay.cli.record import write_page

            click.echo(write_page(wanted.output, wanted.output / "report.html"), err=True)
        if wanted.as_json or not sys.stdout.isatty():  # else it stands above the table already
            click.echo(done.verdict.line, err=True)
        _gate(wanted, done)
        report_losses(run.source, done.summary.status.get("damaged", 0))
        if not wanted.required:
            _check_required(["check"], done.verdict, where="tracking")


@value_class(kw_only=True, eq=True)
class Wanted:
    """The options that select the outputs of a run."""

    golden: Path | None
    update_golden: Path | None
    output: Path | None
    page: bool
    overwrite: bool
    resume: bool
    follow: bool
    as_json: bool
    tables: tuple[str, ...]
    verbose: bool
    table_every: int | None
    table_all: bool
    plain: bool
    to_rerun: str | None
    required: tuple[str | float, ...]

    def check(self) -> None:
        """Raise UsageError if two options contradict each other, UnreadableInput for an unusable
        golden file.
        """
        from avsreplay.report.golden import read_golden

        if self.golden and self.update_golden:
            raise UsageError(
                "--golden and --update-golden exclude each other", hint="give one of them"
            )
        if self.page and self.output is None:
            raise UsageError("--report needs a result directory", hint="add -o DIR")
        if self.resume and self.output is None:
            raise UsageError(
                "--resume needs the result directory of the interrupted run", hint="add -o DIR"
            )
        check_outputs("update_golden")
        if self.golden:
            read_golden(self.golden)
        if self.update_golden and self.update_golden.is_file():
            read_golden(self.update_golden)


def _with_job_file(log: Path, flags: dict[str, Any]) -> Path:
    """Return the log of a job file and put its options into ``flags`` where none is given; any
    other log is returned as it is.
    """
    from avsreplay.job_file import read_job

    job = read_job(log)
    if job is None:
        return log
    given = {**job.given, "golden": job.golden, "config_file": job.config}
    for name, value in given.items():
        if flags.get(name) is None:
            flags[name] = value
    flags["assigned"] = job.assignments
    return job.log


def job_of(log: Path, flags: dict[str, Any]) -> Job:
    """Return the run that the options of the command describe.

    Args:
        log: the log.
        flags: the options by the names of their parameters; those that are used are taken out.

    Raises:
        UsageError: a value is not allowed.
    """
    from avsreplay.run import Job

    for field in fields(Wanted):
        flags.pop(field.name, None)
    of_file = tuple(flags.pop("assigned", ()))
    config_file, assignments = take_run_settings(flags)
    assignments = (*of_file, *assignments)
    if flags.pop("paper"):
        from avsreplay.config import PAPER

        assignments = PAPER + assignments
    return Job(
        source=log, options=read_options(flags), config_file=config_file, assignments=assignments
    )


def _checked(run: Run) -> list[Advice]:
    """Check the log before the replay: findings are printed on stderr, and are reasons of the
    verdict.
    """
    from avsreplay.preflight import preflight

    followed = bool(run.config.region)
    checked = (
        preflight(run.source, run.surface, run.registrar, followed=followed)
        if len(run.source)
        else []
    )
    found = [advice for advice in checked if advice.grade != "ok"]
    for each in run.source.meaning.inferences:
        if each.grade == "ok":
            click.echo(f"avsreplay: {each.about}: {each.sentence}", err=True)
    for advice in found:
        click.echo(f"avsreplay: {advice.about}: {advice.sentence}", err=True)
    return found


class Outdated(Exception):
    """A log that has grown gives other rows than before; it is replayed again."""


@value_class(eq=True)
class _Finished:
    """Result of a replay; ``record`` is the content of ``run.json``."""

    rows: Sequence[Row]
    summary: Summary
    record: dict[str, Any]
    verdict: RunVerdict
    scans_per_s: float


def _replayed(
    run: Run, advice: list[Advice], target: ResultDirectory | None, wanted: Wanted
) -> _Finished:
    """Replay the log; ``target`` receives all results.

    An interrupt ends the replay and keeps what there is.
    """
    from avsreplay.report.verdict import verdict_of
    from avsreplay.result_dir import ResultWriter
    from avsreplay.viewers import RerunStream

    keeper = ResultWriter(target, run) if target else None
    viewer = RerunStream(run, wanted.to_rerun) if wanted.to_rerun else None
    with keeper or nullcontext():
        begun = time.perf_counter()
        if keeper and wanted.resume:
            _resume(run, keeper)
        rows, kept = run.taken, run.done
        found: list[tuple[tuple[str, ...], str]] = []
        interrupted = _take_scans(
            run,
            keeper,
            viewer,
            live_allowed=not wanted.as_json,
            then=lambda: found.append(_model_notes(run, advice)),
        )
        seconds = max(time.perf_counter() - begun, 1e-9)
        if viewer:
            viewer.close()
        summary = run.summary()
        notes, remark = found[0] if found else ((), "")
        for note in (*notes, remark) if remark else notes:
            click.echo(f"avsreplay: {note}", err=True)
        record = _record(run, summary) | {"preflight": _findings(run, advice, summary, notes)}
        if interrupted:
            record["interrupted_after"] = len(rows)
            _say_interrupted(run, rows, resumable=keeper is not None)
        if keeper:
            record["smoothed"] = _smoothed_record(run, rows, summary)
            keeper.finish(record, resumable=interrupted and not run.job.growing)
    return _Finished(
        rows, summary, record, verdict_of(rows, summary, record), (len(rows) - kept) / seconds
    )


def _take_scans(
    run: Run,
    keeper: ResultWriter | None,
    viewer: RerunStream | None,
    *,
    live_allowed: bool,
    then: Callable[[], None],
) -> bool:
    """Replay the scans that follow those taken, then call ``then``; return whether this was
    interrupted.

    Raises:
        Outdated: the log has grown, and what was recorded later changes rows.
    """
    from avsreplay.cli.options import tracked

    takers = [taker for taker in (viewer, keeper) if taker]
    listeners: list[Listener] = [viewer] if viewer else []
    listeners += keeper.listeners if keeper else ()
    if run.config.reference.value == "fit" and not run.done:
        run.fit_reference(tracked)
    growing = run.job.growing
    live = growing is not None and live_allowed
    found = run.rows(listeners, None if live else tracked)
    interrupted = collect(found, run.taken, growing, live=live, then=then)
    if growing and not interrupted and growing.outdated():
        raise Outdated
    changed = run.rescore() if growing else []
    for taker in takers if changed else ():
        taker.correct(run.taken, changed)
    return interrupted


def _findings(
    run: Run, advice: list[Advice], summary: Summary, notes: Sequence[str]
) -> list[dict[str, str]]:
    """What the checks before the replay, of the model and of the times found, with grades."""
    of_model = "check" if summary.healthy else "fail"  # a wrong model explains why no scan was used
    graded = [
        *((each.grade, each.sentence) for each in advice),
        *((of_model, note) for note in notes),
        *(("check", note) for note in _untimed_notes(run, run.taken)),
    ]
    return [{"grade": grade, "text": text} for grade, text in graded]


def _say_interrupted(run: Run, rows: Sequence[Row], *, resumable: bool) -> None:
    how = "; add --resume to continue" if resumable and not run.job.growing else ""
    text = f"interrupted; the results of {len(rows)} of {len(run)} scans are kept{how}"
    click.echo(f"avsreplay: {text}", err=True)


def _resume(run: Run, keeper: ResultWriter) -> None:
    """Let the open run continue from the state of the interrupted one."""
    from avsreplay.cli.main import versions

    keeper.resume({**run.facts(), "versions": versions()})
    click.echo(f"avsreplay: continuing after {run.done} of {len(run)} scans", err=True)


def _model_notes(run: Run, advice: list[Advice]) -> tuple[tuple[str, ...], str]:
    """Return the findings on the model from the rows, and a remark on it; nothing where size or
    background explain them.
    """
    if any(
        a.about in ("unit", "size") or (a.about == "background" and a.grade == "fail")
        for a in advice
    ):
        return (), ""
    return run.model_check.notes(), run.model_check.remark()


def _untimed_notes(run: Run, rows: Sequence[Row]) -> tuple[str, ...]:
    """Return the finding on points without times, unless the log is simulated, the user has stated
    their meaning, or the order of the points excludes a duration of the scans.
    """
    from avsreplay.report.pose_checks import times_may_matter

    options, source = run.job.options, run.source
    stated = options.point_time is not None or options.scan_duration_s is not None
    timed = source.meaning.time is not None or stated or run.header.scenario
    if timed or run.config.register.backend == "poses" or run.model_check.duration_known:
        return ()
    period_s = source.clock.period_s * source.options.every
    note = times_may_matter(rows, run.surface.extent, period_s)
    if note:
        click.echo(f"avsreplay: {note}", err=True)
    return (note,) if note else ()


def collect(
    found: Generator[Row],
    rows: Sequence[Row],
    growing: GrowingLog | None = None,
    *,
    live: bool = False,
    then: Callable[[], None] = lambda: None,
) -> bool:
    """Take all rows, which the run keeps, and call ``then``.

    All results hold the same scans: an interrupt takes effect between two of them.

    Args:
        found: the rows as they are made.
        rows: the rows that the run has kept so far.
        growing: the log, where it is still written.
        live: print a line for each row.
        then: what follows the last row.

    Returns:
        Whether the user interrupted after one or more rows.

    Raises:
        KeyboardInterrupt: the user interrupted before the first row.
    """
    from avsreplay.cli.options import interruptible, say_live

    try:
        with (
            interruptible(rows, growing.stop if growing else lambda: None) as stopped,
            closing(found),
        ):
            for row in found:
                if live:
                    say_live(row)
                if stopped() and not growing:
                    break
            then()
            return stopped()
    except KeyboardInterrupt:
        if not rows:
            raise
        return True


def _changed(run: Run) -> list[str]:
    """The settings that differ from their defaults, each marked if the user has not given it."""
    from avsreplay.config import load_config
    from avsreplay.report.compare import changed_settings

    given = load_config(run.job.config_file, {}, run.job.assignments)
    stated = changed_settings(run.job.options, given)
    return changed_settings(run.job.options, run.config, stated=stated)


def _record(run: Run, summary: Summary) -> dict[str, Any]:
    from avsreplay.cli.main import versions
    from avsreplay.report.result import facts_record
    from avsreplay.settings import dump

    header = run.source.header
    labels = header.labels if header.labels or header.seed is not None else None
    facts = facts_record(labels=labels, truth=run.truth, counts=dict(summary.counts))
    limits = dump(run.config.faults.resolved(run.surface.extent))
    return {
        **run.facts(),
        "limits": limits,
        "changed_settings": _changed(run),
        "facts": facts,
        "versions": versions(),
        "capture": None if summary.assessment is None else summary.assessment.record(),
        "measured_covariance": None if run.flight.noise is None else run.flight.noise.tolist(),
    }


def _smoothed_record(run: Run, rows: Sequence[Row], summary: Summary) -> dict[str, Any] | None:
    """The events of the whole log, with the time at which each was first known from the scans so
    far; None where too few poses are healthy.
    """
    motion = run.smoothed()
    if motion is None:
        return None
    record = motion.smoothed.record(run.taken[0].t_ns)
    for event in record["events"]:
        event["first_known_s"] = _first_known_s(run, event, rows, summary)
    return record


def _first_known_s(
    run: Run, event: Mapping[str, Any], rows: Sequence[Row], summary: Summary
) -> float | None:
    """Time of the first row that contains an event of the whole log; None where none does."""
    from avsreplay.report.summary_parts import SAME_EVENT_S
    from avsreplay.tables import column_of

    kind, onset_s = event["kind"], event["onset_s"]
    away = 3.0 * event["onset_1s_s"] + SAME_EVENT_S
    times = column_of(rows, "t_s")
    instants = zip(times, column_of(rows, "t_ns"), strict=True)
    known = [t for t, t_ns in instants if run.cause_names(kind, t_ns)]
    if kind in ("torque", "force"):
        stated = zip(times, column_of(rows, "drift_s"), strict=True)
        known += [t for t, since in stated if since is not None]
    if kind == "sensor_offset":
        reasons = zip(times, column_of(rows, "reason"), strict=True)
        known += [t for t, why in reasons if why == "sensor_bias"]
    if kind in ("rate_step", "velocity_step"):
        near = [c.reported_s for c in summary.velocity_changes if abs(c.t_s - onset_s) <= away]
        return min(near, default=min((t for t in known if t >= onset_s), default=None))
    return min((t for t in known if t >= onset_s - away), default=None)


def _print(wanted: Wanted, done: _Finished) -> None:
    if wanted.as_json:
        from avsreplay.report.export import document_parts

        for part in document_parts(done.rows, done.summary, done.record):
            click.echo(part, nl=False)
        return
    from avsreplay.report.summary_tables import TABLES, print_screen, print_tables
    from avsreplay.report.table import make_console

    console = make_console()
    names = set(TABLES if wanted.verbose else wanted.tables)
    if wanted.table_all or wanted.table_every:
        names.add("scans")
    print_screen(console, done.rows, done.verdict)
    print_tables(
        console,
        done.rows,
        done.summary,
        done.verdict,
        names=names,
        every=wanted.table_every,
        show_all=wanted.table_all,
        plain=wanted.plain,
        scans_per_s=done.scans_per_s,
    )


def _gate(wanted: Wanted, done: _Finished) -> None:
    """Golden file and verdict: raise CheckFailed if a requested check fails."""
    from avsreplay.report.golden import compare_golden, update_golden

    rows = done.rows
    if wanted.update_golden:
        update_golden(wanted.update_golden, rows)
        click.echo(f"golden rows written: {wanted.update_golden} ({len(rows)} scans)", err=True)
    if wanted.golden:
        result = compare_golden(wanted.golden, rows)
        if not result.ok:
            _print_differences(result, done.verdict, to_stderr=wanted.as_json)
        result.check(str(wanted.golden))
        click.echo(f"golden rows agree: {wanted.golden} ({result.rows} scans)", err=True)
    if "interrupted_after" in done.record:
        raise KeyboardInterrupt
    if wanted.required:
        _check_required(wanted.required, done.verdict)


def _check_required(required: Sequence[str | float], verdict: RunVerdict, where: str = "") -> None:
    """Raise CheckFailed for a verdict that is worse than required; where no grade is required, FAIL
    is worse.
    """
    capture = verdict.capture
    probability = (None if capture is None else capture.probability) or 0.0
    for least in required:
        if isinstance(least, float) and (probability < least or not (capture and capture.succeeds)):
            at = f"--require capture={least:g}"
            raise CheckFailed(f"the verdict is {verdict.line}", where=at)
    order = ["pass", "check", "fail"]
    grades = [least for least in required if isinstance(least, str)] or ["check"]
    for grade in grades:
        if grade != "any" and order.index(verdict.grade.value.lower()) > order.index(grade):
            at = where or f"--require {grade}"
            raise CheckFailed(f"the verdict is {verdict.line}", where=at)


def _print_differences(result: GoldenResult, verdict: RunVerdict, *, to_stderr: bool) -> None:
    from avsreplay.report.golden import golden_table
    from avsreplay.report.table import make_console, print_line, print_table

    console = make_console(sys.stderr if to_stderr else sys.stdout)
    print_line(
        console,
        "settings that differ from their defaults: " + ("; ".join(verdict.changed) or "none"),
    )
    print_table(console, golden_table(result))
