"""The tables of one run, the same for terminal and page, and what is printed about it in single
lines.
"""

from __future__ import annotations

import math
import textwrap
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console

from avsreplay.errors import counted
from avsreplay.records import BLOCKS
from avsreplay.report.episodes import Episode
from avsreplay.report.parameters import Parameter
from avsreplay.report.summary import Errors, Summary
from avsreplay.report.summary_parts import Capture, Statistics, length_text, times
from avsreplay.report.table import (
    Table,
    TableCell,
    decimals,
    facts_table,
    number,
    print_line,
    print_sparks,
    print_table,
    scan_table,
    state_cell,
)
from avsreplay.report.verdict import LEAST_SHARE_INSIDE, Grade, RunVerdict
from avsreplay.rows import Row

# The first screen.
SCREEN_ROWS = 10  # scans
SCREEN_MOMENTS = 3  # worst moments
SCREEN_LINES = 23  # lines beside the prompt
LEAST_SCREEN_ROWS = 3  # fewest scans
TABLE_LINES = 6  # of the table over time beside its scans: title, heads, rule, note, empty line
TABLES = (  # names of the tables of a run
    *("verdict", "moments", "capture", "scans", "curves"),
    *("errors", "faults", "manoeuvres", "parameters", "consistency", "run"),
)
_STATISTICS = ("rmse", "mean", "median", "std", "min", "max", "sse")


def print_screen(console: Console, rows: Sequence[Row], verdict: RunVerdict) -> None:
    """Print the answer in 24 lines: the verdict, the worst moments, and the four main quantities
    over time.

    A long verdict leaves room for fewer scans.

    Args:
        console: where to print.
        rows: one per scan.
        verdict: the verdict on the run.
    """
    moments = verdict.moments[:SCREEN_MOMENTS]
    left = SCREEN_LINES - _lines(console, verdict.line) - 1 - len(moments) - TABLE_LINES
    print_line(console, verdict.line)
    console.print()
    for m in moments:
        span = " to ".join(dict.fromkeys((f"{m.start_s:.1f}", f"{m.end_s:.1f}")))
        line = f"{span} s: {m.what}; {m.cause}"
        print_line(console, textwrap.shorten(line, console.width, placeholder=" ..."))
    if rows:
        shown = min(max(left, LEAST_SCREEN_ROWS), SCREEN_ROWS)
        print_table(console, over_time_table(rows, shown), tight=True)


def _lines(console: Console, text: str) -> int:
    """Number of lines that a text takes on the console."""
    return len(textwrap.wrap(text, console.width)) or 1


def over_time_table(rows: Sequence[Row], most: int = SCREEN_ROWS) -> Table:
    """Return the table of pose error, gamma with its reason, condition number of the Gramian and
    planned time of capture over time.

    Args:
        rows: one per scan.
        most: number of scans that are shown, at even intervals, with the first and the last one.
    """
    places = np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int)
    chosen = [rows[k] for k in dict.fromkeys(places.tolist())]
    lines = tuple(
        (
            f"{row.t_s:.1f}",
            state_cell(row.gamma, row.reason),
            number(None if row.pos_err_m is None else 1e3 * row.pos_err_m, ".3g"),
            number(row.rot_err_deg, ".2g"),
            number(row.ogm_log10_cond, ".1f") if row.ogm_log10_cond else f"rank {row.ogm_rank}",
            number(row.capture_time_s, ".2f"),
            row.action or "-",
        )
        for row in chosen
    )
    fitted = bool(rows) and rows[0].reference == "fit"
    error = "from fit" if fitted else "error"
    heads = (
        "time\n[s]",
        "gamma",
        f"position\n{error} [mm]",
        f"attitude\n{error} [deg]",
        "Gramian\nlog10 cond.",
        "planned\ncapture [s]",
        "action",
    )
    note = "more tables: -v or --tables NAME,...; page: -o DIR --report"
    return Table(f"{len(chosen)} of {len(rows)} scans", heads, lines, align="rlrrrrl", note=note)


def print_tables(
    console: Console,
    rows: Sequence[Row],
    summary: Summary,
    verdict: RunVerdict | None = None,
    *,
    names: Iterable[str] | None = None,
    every: int | None = None,
    show_all: bool = False,
    scans_per_s: float | None = None,
    plain: bool = False,
) -> None:
    """Print the tables of a run.

    Args:
        console: where to print.
        rows: one per scan.
        summary: the summary of these rows.
        verdict: the verdict on the run; None leaves out what depends on it.
        names: names of tables of ``TABLES``; None prints all of them.
        every: print every N-th scan.
        show_all: print all scans.
        scans_per_s: measured speed; it is printed and never written to a file.
        plain: leave the curves out.
    """
    wanted = set(TABLES if names is None else names)
    listed: list[tuple[str, Table]] = []
    if verdict is not None:
        capture = [] if verdict.capture is None else verdict.capture.described()
        listed += [("verdict", verdict_table(verdict)), ("moments", moments_table(verdict))]
        listed.append(("capture", facts_table("Capture", capture)))
    for name, table in listed:
        if name in wanted:
            print_table(console, table)
    if rows and "scans" in wanted:
        print_table(console, scan_table(console, rows, every=every, show_all=show_all), tight=True)
    if rows and "curves" in wanted and not plain:
        print_sparks(console, rows)
    named = ("errors", "faults", "manoeuvres", "parameters", "consistency")
    for name, table in zip(named, summary_tables(summary, rows), strict=True):
        if name in wanted:
            print_table(console, table)
    if "run" in wanted:
        facts = fact_lines(summary, scans_per_s=scans_per_s)
        print_table(console, facts_table("Run", facts))


def verdict_table(verdict: RunVerdict) -> Table:
    """Return the table of reasons, first pose, robot and the settings that differ from their
    defaults.

    Args:
        verdict: the verdict on a run.
    """
    marks = {Grade.FAIL: "bad", Grade.CHECK: "warn", Grade.PASS: "good"}
    rows: list[tuple[str | TableCell, ...]] = [
        ("reason", TableCell(f"{r.grade.value}: {r.text}", marks[r.grade])) for r in verdict.reasons
    ]
    rows.append(("first pose from", verdict.first_pose))
    if verdict.task:
        rows.append(("task", verdict.task))
    if verdict.robot:
        rows.append(("robot", verdict.robot))
    rows += [("setting", text) for text in verdict.changed] or [
        ("settings", "all at their defaults")
    ]
    return Table("Reasons and settings", ("what", "value"), tuple(rows), align="l")


def moments_table(verdict: RunVerdict, place: Mapping[int, int] | None = None) -> Table:
    """Return the table of the worst moments; ``place`` maps a row to its row on a page, to which a
    click leads.

    Args:
        verdict: the verdict on a run.
        place: the row on the page to which a click on a row leads.
    """
    rows = []
    for m in verdict.moments:
        span = " to ".join(dict.fromkeys((f"{m.start_s:.1f}", f"{m.end_s:.1f}")))
        rows.append((TableCell(span, scan=(place or {}).get(m.row)), m.what, m.cause))
    heads = ("time [s]", "what", "cause")
    return Table("Worst moments", heads, tuple(rows), align="l", wide=True)


def summary_tables(summary: Summary, rows: Sequence[Row] = ()) -> tuple[Table, ...]:
    """Return the tables of errors, injected faults, manoeuvres, parameters and consistency; a table
    without content has no rows.

    Args:
        summary: the summary of a run.
        rows: the rows of a run.
    """
    events = fault_table(summary, rows), manoeuvre_table(summary, rows)
    return error_table(summary), *events, parameter_table(summary), consistency_table(summary)


def error_table(summary: Summary) -> Table:
    """Return the statistics of pose and registration errors in mm (m from 1 m on) and deg.

    Args:
        summary: the summary of a run.
    """
    groups = (
        ("pose, all scans", summary.pose_all if summary.coasting else Errors(None, None)),
        ("pose, healthy", summary.pose_healthy),
        ("pose, coasting", summary.pose_coasting),
        ("registration", summary.registration_healthy),
    )
    found: list[tuple[str, str, Statistics | None]] = []
    for name, errors in groups:
        found += [(name, "m", errors.position_m), (name, "deg", errors.rotation_deg)]
    found.append(("fit error rms", "m", summary.fit_error_m))
    title = "Errors against the fitted motion" if summary.reference == "fit" else "Errors"
    rows = tuple(
        _error_row(name, unit, spread) for name, unit, spread in found if spread is not None
    )
    note = "poses are compared at equal times and without an alignment; sse is the sum of squares"
    return Table(title, ("of", "unit", "n", *_STATISTICS), rows, align="llr", note=note)


def _error_row(name: str, unit: str, spread: Statistics) -> tuple[str, ...]:
    unit, factor = ("mm", 1000.0) if unit == "m" and spread.rmse < 1.0 else (unit, 1.0)
    spec = f".{decimals([factor * spread.rmse], 2)}f"
    return (
        name,
        unit,
        str(spread.count),
        *(format(factor * getattr(spread, s), spec) for s in _STATISTICS[:-1]),
        f"{factor * factor * spread.sse:.3g}",
    )


def consistency_table(summary: Summary) -> Table:
    """Return the normalised errors squared with their degrees of freedom and two-sided 95 %
    chi-square bands.

    Args:
        summary: the summary of a run.
    """
    sizes = {f"NEES {name}": block.stop - block.start for name, block in BLOCKS.items()}
    blocks = [(f"NEES {name}", share) for name, share in summary.nees_blocks.items()]
    listed = [("NIS", 6, summary.nis, 1), ("NEES", 20, summary.nees, 1)]
    listed += [(name, sizes[name], share, sizes[name]) for name, share in blocks]
    rows = tuple(
        (
            name,
            str(share.count),
            str(expected),
            f"{scale * share.median:.2f}",
            f"{scale * share.low:.2f} to {scale * share.high:.2f}",
            TableCell(
                f"{100.0 * share.inside:.1f}", "warn" if share.inside < LEAST_SHARE_INSIDE else ""
            ),
        )
        for name, expected, share, scale in listed
        if share is not None
    )
    heads = ("statistic", "scans", "expected\nmean", "median", "95 % band", "inside the\nband [%]")
    return Table("Consistency of the covariance", heads, rows)


def fault_table(summary: Summary, rows: Sequence[Row] = ()) -> Table:
    """Return the table of the injected faults; with ``rows`` the first cell leads to the first scan
    of the fault.

    Args:
        summary: the summary of a run.
        rows: the rows of a run.
    """
    heads = (
        "kind",
        "from\n[s]",
        "to\n[s]",
        "scans\nflagged",
        "verdict",
        "delay\n[s]",
        "recovery\n[s]",
    )
    lines = tuple(
        (
            TableCell(e.kind, scan=_nearest_row(e.start_s, rows)),
            f"{e.start_s:.1f}",
            f"{e.end_s:.1f}",
            f"{e.flagged}/{e.scans}",
            _verdict(e),
            number(e.delay_s, ".2f"),
            "never" if e.lost else number(e.recover_s, ".2f"),
        )
        for e in summary.faults.episodes
    )
    return Table("Injected faults", heads, lines, align="lrrrlr", wide=True)


def event_table(header: Mapping[str, Any] | None) -> Table:
    """Events of the whole log by the smoothing pass; no rows without it.

    Args:
        header: the record of the run, ``run.json``; None where there is none.
    """
    heads = ("t\n[s]", "1 sigma\n[s]", "event", "log odds", "first known\n[s]")
    record = (header or {}).get("smoothed")
    found = record.get("events") if isinstance(record, dict) else None
    lines = tuple(
        (*(_figure(each.get(name), places) for name, places in _ONSET_COLUMNS), *_told(each))
        for each in (found if isinstance(found, list) else ())
        if isinstance(each, dict)
    )
    return Table("Events by all poses of the log", heads, lines)


_ONSET_COLUMNS = (("onset_s", 2), ("onset_1s_s", 2))


def _told(event: Mapping[str, Any]) -> tuple[str, str, str]:
    known = _figure(event.get("first_known_s"), 1)
    return str(event.get("words", "")), _figure(event.get("log_odds"), 1), known


def _figure(value: Any, places: int) -> str:
    """A number of a file; a dash where there is none."""
    return f"{value:.{places}f}" if isinstance(value, (int, float)) else "-"


def manoeuvre_table(summary: Summary, rows: Sequence[Row] = ()) -> Table:
    """Return the table of the changes of the target's velocity; with ``rows`` the first cell leads
    to the nearest scan.

    Args:
        summary: the summary of a run.
        rows: the rows of a run.
    """
    heads = (
        "t\n[s]",
        "1 sigma\n[s]",
        "velocity\n[mm/s]",
        "1 sigma\n[mm/s]",
        "rate\n[deg/s]",
        "1 sigma\n[deg/s]",
    )
    lines = tuple(
        (
            TableCell(f"{m.t_s:.2f}", scan=_nearest_row(m.t_s, rows)),
            f"{m.t_1s_s:.2f}",
            f"{1000.0 * m.velocity_mps:.3g}",
            f"{1000.0 * m.velocity_1s_mps:.2g}",
            f"{math.degrees(m.rate_radps):.3g}",
            f"{math.degrees(m.rate_1s_radps):.2g}",
            f"{m.reported_s:.1f}",
        )
        for m in summary.velocity_changes
    )
    return Table(
        "Manoeuvres of the target: changes of its velocity", (*heads, "reported\n[s]"), lines
    )


def _nearest_row(t_s: float, rows: Sequence[Row]) -> int | None:
    after = bisect_left(rows, t_s, key=lambda row: row.t_s)
    return min(
        range(max(after - 1, 0), min(after + 1, len(rows))),
        key=lambda k: abs(rows[k].t_s - t_s),
        default=None,
    )


def _verdict(episode: Episode) -> TableCell:
    if episode.detected and not episode.harmful:
        return TableCell("usable, flagged")
    if episode.detected:
        return TableCell("detected" if episode.scans else "detected as a gap", "good")
    return TableCell("missed", "bad") if episode.harmful else TableCell("usable, used")


def parameter_table(summary: Summary) -> Table:
    """Return the table of the estimated and the true constants, one row for each component.

    Args:
        summary: the summary of a run.
    """
    heads = ("parameter", "unit", "estimate", "truth", "error", "1 sigma")
    rows = tuple(row for p in summary.parameters for row in _parameter_rows(p))
    note = (
        "error and 1 sigma of a vector are those of all its components together, given in its first"
        " row; sigma, c and mu refer to one order of the principal axes, which is arbitrary (a"
        " permutation describes the same body), the values below them do not depend on it"
    )
    return Table("Parameters at the last scan", heads, rows, align="llr", note=note)


def _parameter_rows(p: Parameter) -> list[tuple[str, ...]]:
    name, _, listed = p.name.partition(": ")
    components = listed.split() or ["x", "y", "z"] if len(p.estimate) > 1 else [""]
    truth = p.truth or (None,) * len(p.estimate)
    sigma = "undetermined" if p.undetermined else _small(p.one_sigma)
    rows: list[tuple[str, ...]] = []
    for k, component in enumerate(components):
        last = (_small(p.error), sigma) if k == 0 else ("", "")
        label = f"{name} {component}".rstrip()
        rows.append(
            (label, p.unit, number(p.estimate[k], ".4f"), number(truth[k], ".4f", ""), *last)
        )
    return rows


def _small(value: float | None) -> str:
    """Four decimals, or two significant figures where these would hide the value."""
    return number(value, ".1e" if value and abs(value) < 0.001 else ".4f", "")


def in_one_line(summary: Summary) -> str:
    """Return scans used, faults, errors, t_1 and planned capture in one line.

    Args:
        summary: the summary of a run.
    """
    parts = [
        f"{summary.healthy} of {summary.scans} scans used",
        *_fault_words(summary),
        *_error_words(summary),
    ]
    t1, capture = summary.convergence.t1_s, summary.capture.last_s
    parts.append("not converged" if t1 is None else f"converged at {t1:.1f} s")
    parts.append("no capture planned" if capture is None else f"capture planned at {capture:.2f} s")
    miss = summary.capture.miss
    parts += (
        []
        if miss is None
        else [f"gripper closed {length_text(miss.position_m)} from the true grasp point"]
    )
    return "; ".join(parts) + "."


def _fault_words(summary: Summary) -> list[str]:
    faults = summary.faults
    if not faults.known:
        return [f"{faults.false_alarms} flagged"] if faults.false_alarms else []
    found = f"{faults.detected} of {faults.injected} faults with unusable scans detected"
    alarms = f"{faults.false_alarms} false alarms ({100 * faults.false_alarm_rate:.2f} %)"
    return [
        found if faults.injected else "no fault with unusable scans injected",
        alarms if faults.unlabelled else "no scan without a fault",
    ]


def _error_words(summary: Summary) -> list[str]:
    """Errors against the truth in healthy scans; without a healthy scan, while coasting."""
    for errors, scans in (
        (summary.pose_healthy, "healthy scans"),
        (summary.pose_coasting, "coasting scans"),
    ):
        if errors.position_m is not None and errors.rotation_deg is not None:
            rms = (
                f"{length_text(errors.position_m.rmse)} and {errors.rotation_deg.rmse:.3g} deg rms"
                f" in {scans}"
            )
            return [f"pose error {rms}"]
    return ["no truth to compare with"]


def fact_lines(summary: Summary, *, scans_per_s: float | None = None) -> list[tuple[str, str]]:
    """Yield names and values of what takes one line: scans, faults, filter, plan, counts, speed.

    Args:
        summary: the summary of a run.
        scans_per_s: speed of the replay; None where it was not measured.
    """
    facts = [
        *_scan_facts(summary),
        *_fault_facts(summary),
        *_filter_facts(summary),
        *_plan_facts(summary),
    ]
    facts += [
        (name.replace("_", " "), str(count)) for name, count in summary.counts.items() if count
    ]
    if scans_per_s is not None:
        facts.append(("speed", f"{scans_per_s:.1f} scans/s"))
    return facts


def _scan_facts(summary: Summary) -> Iterable[tuple[str, str]]:
    interval = "" if summary.interval_s is None else f", one every {summary.interval_s:.3g} s"
    yield "scans", f"{summary.scans} in {summary.duration_s:.2f} s{interval}"
    yield (
        "used",
        (
            f"{summary.healthy} healthy (gamma 1), {summary.coasting}"
            f" coasting{_counted(summary.reasons)}"
        ),
    )
    if summary.gaps:
        yield (
            "gaps",
            f"{summary.gaps} interval{'s' * (summary.gaps != 1)} longer than 1.5 x the median",
        )
    coast = summary.longest_coast
    if coast is not None:
        error = ""
        if coast.pos_err_m is not None and coast.rot_err_deg is not None:
            error = (
                f"; error at its end {length_text(coast.pos_err_m)}, {coast.rot_err_deg:.3f} deg"
            )
        yield "longest coast", f"{coast.scans} scans, {coast.duration_s:.2f} s{error}"


def _counted(counts: Mapping[str, int]) -> str:
    return ": " + ", ".join(f"{name} {count}" for name, count in counts.items()) if counts else ""


def _fault_facts(summary: Summary) -> Iterable[tuple[str, str]]:
    faults = summary.faults
    if not faults.known:
        yield (
            "flagged",
            f"{counted(faults.false_alarms, 'scan')}; the log does not state the injected faults",
        )
        return
    events = f"{faults.injected} injected, {faults.detected} detected, {faults.missed} missed"
    scans = (
        f"{faults.harmful_scans - faults.missed_scans} of {faults.harmful_scans} unusable scans"
        " flagged"
    )
    alarms = f"{faults.false_alarms} of {faults.unlabelled} scans without a fault"
    yield "faults to detect", f"{events}; {scans}"
    rate = f"{alarms} ({100.0 * faults.false_alarm_rate:.2f} %)"
    yield "false alarms", rate if faults.unlabelled else "unknown: every scan carries a fault"
    if faults.longest_recovery_s is not None:
        yield (
            "recovery",
            f"at most {faults.longest_recovery_s:.2f} s after the first scan past a fault",
        )


def _filter_facts(summary: Summary) -> Iterable[tuple[str, str]]:
    if summary.sigma_hits is not None:
        floors = (
            f", eigenvalue floor of R active {times(summary.r_floors)}"
            if summary.r_floors is not None
            else ""
        )
        yield "constraints", f"sigma bound active {times(summary.sigma_hits)}{floors}"
    if summary.reinitialised is not None:
        taken = f"{summary.weighed_down} healthy poses down-weighted (NIS above its 99.99 % point)"
        yield "outliers", f"{taken}; estimate reinitialised {times(summary.reinitialised)}"
    if summary.manoeuvres is not None:
        yield (
            "manoeuvres",
            f"{summary.manoeuvres} found; {summary.violations or 0} consistency checks failed",
        )
    if summary.acceleration is not None:
        yield "acceleration", summary.acceleration
    if summary.drift is not None:
        yield "drift", f"constant torque or force: {summary.drift}"
    seen = summary.observability
    if seen.rank is not None:
        full = "never full" if seen.full_rank_s is None else f"full from {seen.full_rank_s:.2f} s"
        raw, scaled = (number(value, ".1f") for value in (seen.log10_cond, seen.log10_cond_scaled))
        condition = (
            "" if seen.log10_cond is None else f"; log10 condition {raw} raw, {scaled} scaled"
        )
        yield "Gramian", f"along the estimates: rank {seen.rank} of 20 ({full}){condition}"


def _plan_facts(summary: Summary) -> Iterable[tuple[str, str]]:
    t1, capture = summary.convergence, summary.capture
    end = "" if t1.at_end else "; not at the last scan"
    back = f"; withdrawn {times(t1.withdrawn)}" if t1.withdrawn else ""
    yield "t_1", "not reached" if t1.t1_s is None else f"{t1.t1_s:.2f} s{back}{end}"
    if capture.last_s is None:
        yield "capture", f"no plan ({capture.status or 'the planner was not called'})"
    else:
        spread = f"{capture.replans} plans are {capture.range_s:.3f} s apart, no uncertainty"
        yield "capture", f"last planned at {capture.last_s:.2f} s; {spread}"
    yield from _flight_facts(capture)


def _flight_facts(capture: Capture) -> Iterable[tuple[str, str]]:
    if capture.plan_miss_m is not None:
        found, n = capture.plan_miss_m, capture.plan_miss_m.count
        yield (
            "hindsight",
            (
                f"{n} plans miss by {length_text(found.median)} in the median,"
                f" {length_text(found.max)} at most"
            ),
        )
    if capture.miss is not None:
        speed = (
            "" if capture.miss.speed_mps is None else f", {1000 * capture.miss.speed_mps:.3g} mm/s"
        )
        turn = "" if capture.miss.rotation_deg is None else f", {capture.miss.rotation_deg:.3g} deg"
        yield (
            "gripper",
            f"closed {length_text(capture.miss.position_m)}{speed}{turn} from the true grasp point",
        )
    if capture.actions:
        yield (
            "actions",
            ", ".join(
                f"{action} {counted(count, 'scan')}" for action, count in capture.actions.items()
            ),
        )
