"""``avsreplay info`` and ``avsreplay doctor``: the content of a log, its damage, and a
repaired copy.
"""

from __future__ import annotations

import dataclasses
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.config import Command, source_setting
from avsreplay.cli.options import (
    check_outputs,
    pose_options,
    read_options,
    report_losses,
    source_options,
)

if TYPE_CHECKING:
    from avsreplay.log import ClockSummary, LogInfo, Loss, Source
    from avsreplay.log.doctor import Finding, Repaired
    from avsreplay.model_size import Advice
    from avsreplay.report.table import Table

DECODED_BYTES = 256 << 20  # of a larger log, info decodes a few scans only
LISTED_DAMAGED_SCANS = 5  # damaged scans that are listed
# fixed if the output is not a terminal, so that the text is always the same
INFO_WIDTH_CHARACTERS = 120


EPILOG = """\b
Examples:
  avsreplay info tumble.mcap
  avsreplay info drive.bag --model target.stl
  avsreplay info drive.bag --json"""


@click.command(name="info", cls=Command, epilog=EPILOG)
@click.argument("source", type=click.Path(path_type=Path))
@source_options
@pose_options
@source_setting("--poses", is_flag=True)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
@click.option(
    "--write",
    "job_file",
    type=click.Path(path_type=Path),
    help="Write a job file with the options and their reasons, for 'avsreplay run'.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing job file.")
def info_command(
    source: Path, as_json: bool, job_file: Path | None, overwrite: bool, **reading: Any
) -> None:
    """Show topics, types, counts, rates, time span, model, scenario and injected faults of SOURCE.

    With a model (in the log or --model) it also checks what a run needs: unit of the model,
    background points, truth, transforms and time stamps; each finding names the option to add, and
    the first scans are replayed with these options. --write stores them as a job file.

    The exit code is 4 if a part of SOURCE could not be read, or a scan cannot be decoded. All scans
    are decoded, unless SOURCE is larger than 256 MiB.

    \f
    Raises:
        UsageError: an option is invalid.
        UnreadableInput: SOURCE cannot be read.
        DataLost: a part of SOURCE could not be read.
    """  # noqa: D301
    from avsreplay.log import open_source

    check_outputs("job_file", overwrite=overwrite)
    options = read_options(reading)
    built = options.model == Path("auto")
    if built:
        options = dataclasses.replace(options, model=None)
    with open_source(source, options, inspect=True) as opened:
        info = opened.info()
        for _ in opened.scans() if info.bytes <= DECODED_BYTES else ():
            pass  # only whether they can be decoded
        advice = _advice(opened, built)
        known = opened.header.surface is not None or built
    from avsreplay.cli.trial import advised_words, try_advice

    words = list(advised_words(advice))
    if known and info.scans + bool(words):
        more, words = try_advice(source, reading, advice)
        advice += more
    if job_file is not None:
        _write_job(job_file, source, reading, advice, words)
    damaged = dict(sorted(opened.damaged.items()))
    if as_json:
        checks = [dataclasses.asdict(a) for a in advice]
        broken = [{"scan": seq, "why": why} for seq, why in damaged.items()]
        click.echo(
            json.dumps({**_document(info), "damaged_scans": broken, "checks": checks}, indent=2)
        )
    else:
        _print(info, advice, damaged, words)
    report_losses(opened)


def _write_job(
    path: Path, source: Path, reading: dict[str, Any], advice: list[Advice], words: list[str]
) -> None:
    """Write the options of the command, and those that were advised with their reasons."""
    from avsreplay.cli.trial import advised_words, job_with
    from avsreplay.files import output_text
    from avsreplay.job_file import job_text

    job, before = job_with(source, reading, words), job_with(source, reading, [])
    reasons = dict[str, str]()
    for option, why in advised_words(advice).items():
        alone = job_with(source, reading, [option])
        changed = [
            field.name
            for field in dataclasses.fields(alone.options)
            if getattr(alone.options, field.name) != getattr(before.options, field.name)
        ]
        reasons |= dict.fromkeys([*changed, *map(str, alone.assignments)], why)
    text = job_text(source, job.options, list(map(str, job.assignments)), reasons, path.parent)
    result = next((a.text for a in advice if a.about == "replay"), "")
    head = f"# {result}\n" if result else ""
    with output_text(path) as stream:
        stream.write(head + text)


def _advice(opened: Source, built: bool) -> list[Advice]:
    """The checks before a run; for a log without a topic of scans, why a run would fail.

    Args:
        opened: the log, opened for inspection.
        built: the model is to be built from the scans.
    """
    from avsreplay.errors import AvsError
    from avsreplay.log import open_source
    from avsreplay.log.index import CLOUD_TYPES
    from avsreplay.model_size import Advice
    from avsreplay.preflight import preflight

    info = opened.info()
    topics = [topic.name for topic in info.topics if topic.type in CLOUD_TYPES and topic.count]
    if not info.cloud_topic and len(topics) > 1 and not opened.options.poses:
        return _advice_of_topics(opened, built, topics)
    if info.cloud_topic or info.scans:
        found = preflight(opened, opened.header.surface, search=True)
        text = "'avsreplay run' builds it from the scans if these show several sides of the target"
        auto = Advice("ok", "model", text, "--model auto")
        return [auto if built and a.about == "model" else a for a in found]
    try:
        open_source(opened.path, opened.options).close()
    except AvsError as error:
        return [
            Advice("fail", "scans", f"{error.what}; {error.hint}" if error.hint else error.what)
        ]
    return []


def _advice_of_topics(opened: Source, built: bool, topics: list[str]) -> list[Advice]:
    """The checks of the topic of clouds in which the model is found, or its size fits, and the
    option that selects it.

    At most four topics are examined.
    """
    from avsreplay.log import open_source
    from avsreplay.log.bytes_io import shown
    from avsreplay.model_size import Advice

    checked = dict[str, list[Advice]]()
    for topic in topics[:4]:
        with open_source(
            opened.path, dataclasses.replace(opened.options, topic=topic), inspect=True
        ) as source:
            checked[topic] = _advice(source, built)
    wrong = {"size": 1, "pose": 2, "scans": 3}
    best = min(
        checked,
        key=lambda name: sum(wrong.get(a.about, 0) for a in checked[name] if a.grade != "ok"),
    )
    others = ", ".join(shown(topic) for topic in topics if topic != best)
    text = (
        f"{len(topics)} topics have clouds; the next findings are those of {shown(best)}, not of"
        f" {others}"
    )
    return [Advice("check", "topic", text, f"--topic {shown(best)}"), *checked[best]]


def _document(info: LogInfo) -> dict[str, Any]:
    """Return the JSON document: the fields of ``LogInfo`` and the rate of each topic."""
    out = dataclasses.asdict(info)
    for table, topic in zip(out["topics"], info.topics, strict=True):
        table["rate_hz"] = topic.rate_hz
    out["span_s"] = info.span_s
    keys = ("kind", "start_s", "end_s", "harmful")
    out["faults"] = [dict(zip(keys, fault, strict=True)) for fault in info.faults]
    return out


def loss_line(loss: Loss) -> str:
    """Return one line of text about a loss."""
    from avsreplay.log.bytes_io import shown

    parts = [
        f"{loss.file}: " if loss.file else "",
        loss.what,
        f" (byte {loss.offset}, {loss.bytes} bytes",
    ]
    if loss.chunks:
        parts.append(f", {loss.chunks} chunk")
    if loss.messages is not None:
        parts.append(f", {loss.messages} messages")
    if loss.start_ns is not None and loss.end_ns is not None:
        parts.append(f", {(loss.end_ns - loss.start_ns) * 1e-9:.3f} s")
    return shown("".join([*parts, ")"]))


def _print(info: LogInfo, advice: list[Advice], damaged: dict[int, str], words: list[str]) -> None:
    from avsreplay.log.bytes_io import shown
    from avsreplay.report.table import facts_table, make_console, print_line, print_table

    console = make_console(plain_width=INFO_WIDTH_CHARACTERS)
    print_table(console, facts_table("Log", [(name, shown(value)) for name, value in _facts(info)]))
    print_table(console, _topics(info))
    print_table(console, _faults(info))
    print_table(console, _checks(advice))
    if len(words) > 1:
        click.echo(f"options to add: {' '.join(words)}")
    for loss in info.losses:
        print_line(console, "lost: " + loss_line(loss))
    for seq, why in list(damaged.items())[:LISTED_DAMAGED_SCANS]:
        print_line(console, f"lost: scan {seq}: {why}")


def _checks(found: list[Advice]) -> Table:
    """The findings of the checks before a run, with the option to add for each."""
    from avsreplay.report.table import Table, TableCell

    marks = {"ok": "good", "check": "warn", "fail": "bad"}
    rows = tuple((TableCell(a.about, marks[a.grade]), a.text, a.option) for a in found)
    return Table("Checks before a run", ("check", "finding", "option to add"), rows, align="l")


def _facts(info: LogInfo) -> list[tuple[str, str]]:
    span = "" if info.span_s is None else f"{info.span_s:.3f} s"
    rows = [
        ("file", info.path),
        ("kind", ", ".join(filter(None, (info.kind, info.profile, info.library)))),
        ("size", f"{info.bytes / 1e6:.3g} MB" if info.bytes >= 1e6 else f"{info.bytes} bytes"),
        *([("chunks", info.chunks)] if info.chunks else []),
        ("log clock", " ".join(filter(None, (_time(info.start_ns), "for", span))) if span else "-"),
        (
            "scans",
            str(info.scans)
            + (f" on {info.cloud_topic}" if info.cloud_topic else "")
            + _decoded(info),
        ),
        ("model", _model(info)),
        ("truth", "yes" if info.truth else "no"),
    ]
    if info.scenario:
        rows.append(
            ("scenario", "simulated" + ("" if info.seed is None else f", seed {info.seed}"))
        )
    if (
        info.clock is not None and info.scans and info.topics
    ):  # a folder of scans has no second clock
        rows.append(("clock", _clock(info.clock)))
    return rows + [(name, value) for name, value in info.notes.items()]


def _decoded(info: LogInfo) -> str:
    """A remark where only a few scans of a large log were decoded."""
    return (
        "; 'avsreplay doctor' tests whether all can be decoded"
        if info.bytes > DECODED_BYTES
        else ""
    )


def _time(t_ns: int | None) -> str:
    if t_ns is None:
        return "-"
    if t_ns < 10**17:  # before 1973: a clock that started at zero
        return f"from {t_ns * 1e-9:.3f} s"
    return f"from {datetime.fromtimestamp(t_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _model(info: LogInfo) -> str:
    if info.model is None:
        return "none (give --model)"
    size = (
        f"{info.model_vertices} vertices, {info.model_faces} triangles, diagonal"
        f" {info.model_extent_m:.6g} m"
    )
    return f"{info.model}: {size}"


def _clock(clock: ClockSummary) -> str:
    text = (
        f"{clock.clock}; header minus log {clock.offset_s:+.3f} s; median period"
        f" {clock.period_s:.4f} s"
    )
    counts = ("unset", "jumps", "equal", "back", "header_steps", "log_steps")
    found = [
        f"{getattr(clock, name)} {name.replace('_', ' ')}"
        for name in counts
        if getattr(clock, name)
    ]
    return "; ".join([text, *found, *([clock.note] if clock.note else [])])


def _topics(info: LogInfo) -> Table:
    from avsreplay.log.bytes_io import shown
    from avsreplay.report.table import Table, number

    rows = tuple(
        (
            *map(shown, (topic.name, topic.type, topic.encoding)),
            str(topic.count),
            number(topic.rate_hz, ".3f"),
            (
                "-"
                if topic.first_ns is None or topic.last_ns is None
                else f"{(topic.last_ns - topic.first_ns) * 1e-9:.3f}"
            ),
        )
        for topic in info.topics
    )
    return Table(
        "Topics",
        ("topic", "type", "encoding", "messages", "rate\n[Hz]", "span\n[s]"),
        rows,
        align="lllr",
    )


def _faults(info: LogInfo) -> Table:
    from avsreplay.log.bytes_io import shown
    from avsreplay.report.table import Table

    rows = tuple(
        (shown(kind), f"{start:.3f}", f"{end:.3f}", "no" if harmful else "yes")
        for kind, start, end, harmful in info.faults
    )
    return Table("Injected faults", ("fault", "start\n[s]", "end\n[s]", "scans\nusable"), rows)


DOCTOR_EPILOG = """\b
Examples:
  avsreplay doctor x.mcap
  avsreplay doctor x.mcap --repair clean.mcap"""


@click.command("doctor", cls=Command, epilog=DOCTOR_EPILOG)
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--topic", help="The cloud topic, if there are several.")
@click.option(
    "--repair",
    "output",
    type=click.Path(path_type=Path),
    help="Write every intact record to this file (MCAP only).",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing output.")
@click.option("--strict", is_flag=True, help="Exit with code 3 if any part is lost.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
@click.option(
    "--max-message-mib",
    type=int,
    default=128,
    show_default=True,
    help="Largest message that is read [MiB].",
)
def doctor_command(
    source: Path,
    topic: str | None,
    output: Path | None,
    overwrite: bool,
    strict: bool,
    as_json: bool,
    max_message_mib: int,
) -> None:
    """Check SOURCE: structure, checksums, clocks, gaps, duplicates, points, layout and truth.

    The exit code is 0 if no part is lost, else 4 (3 with --strict).

    \f
    Raises:
        UsageError: an option is invalid, or the repaired file cannot be written.
        UnreadableInput: SOURCE cannot be read, or it has errors and --strict is given.
        DataLost: SOURCE has errors.
    """  # noqa: D301
    from avsreplay.errors import UsageError
    from avsreplay.log import SourceOptions
    from avsreplay.log.doctor import examine, repair

    try:
        options = SourceOptions(topic=topic, max_message_mib=max_message_mib)
    except ValueError as error:
        raise UsageError(
            str(error), where="--max-message-mib", hint="give a whole number of MiB"
        ) from None
    check_outputs("output", overwrite=overwrite)
    _, findings = examine(source, options)
    done = None
    if output is not None:
        done = repair(source, output, overwrite=overwrite, max_message_mib=max_message_mib)
    if as_json:
        click.echo(json.dumps(_damage(source, findings, output, done), indent=2))
    else:
        _print_findings(source, findings, output, done)
    _judge(source, findings, strict)


def _judge(source: Path, findings: list[Finding], strict: bool) -> None:
    from avsreplay.errors import DataLost, UnreadableInput, counted
    from avsreplay.log.doctor import Severity
    from avsreplay.log.mcap_format import is_mcap

    errors = [f for f in findings if f.severity is Severity.ERROR]
    if errors:
        what = f"{counted(len(errors), 'error')}, the first: {errors[0].about}: {errors[0].text}"
        repaired = "--repair OUT copies the intact records"
        hint = (
            repaired if is_mcap(source) else "'avsreplay record' writes a log of the intact scans"
        )
        raise (UnreadableInput if strict else DataLost)(what, where=str(source), hint=hint)


def _damage(
    source: Path, findings: list[Finding], output: Path | None, done: Repaired | None
) -> dict[str, Any]:
    import dataclasses

    listed = [{**dataclasses.asdict(f), "severity": f.severity.value} for f in findings]
    repaired = None if done is None else {"output": str(output), **dataclasses.asdict(done)}
    return {"source": str(source), "findings": listed, "repaired": repaired}


def _print_findings(
    source: Path, findings: list[Finding], output: Path | None, done: Repaired | None
) -> None:
    from avsreplay.log.bytes_io import shown
    from avsreplay.report.table import Table, TableCell, make_console, print_line, print_table

    marks = {"error": "bad", "warning": "warn", "note": "", "ok": "good"}
    rows = tuple(
        (
            TableCell(f.severity.value, marks[f.severity.value]),
            f.about,
            shown(f.text),
            ", ".join(map(str, f.places)),
        )
        for f in findings
    )
    console = make_console(plain_width=INFO_WIDTH_CHARACTERS)
    print_table(
        console, Table(shown(source), ("severity", "about", "finding", "at"), rows, align="l")
    )
    if done is not None:
        kept = (
            f"{done.messages} messages, {done.attachments} attachments, {done.records} metadata"
            " records"
        )
        print_line(console, shown(f"repaired: {output}: {kept}"))
        for line in done.dropped:
            print_line(console, shown(f"left out: {line}"))
