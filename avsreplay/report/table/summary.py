"""The summary tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from rich.console import Console
from rich.table import Table

from avsreplay.report.episodes import Episode
from avsreplay.report.spread import Spread
from avsreplay.report.summary import Parameter, Summary
from avsreplay.report.table.console import Palette, decimals, new_table
from avsreplay.report.table.scans import scan_table
from avsreplay.rows import Row

__all__ = ["print_summary", "print_tables"]

_STATISTICS: tuple[tuple[str, Callable[[Spread], float]], ...] = (
    ("rmse", lambda s: s.rmse),
    ("mean", lambda s: s.mean),
    ("median", lambda s: s.median),
    ("std", lambda s: s.std),
    ("min", lambda s: s.min),
    ("max", lambda s: s.max),
)


def print_tables(
    console: Console,
    rows: Sequence[Row],
    summary: Summary,
    *,
    every: int | None = None,
    all: bool = False,
    scans_per_s: float | None = None,
) -> None:
    """The per-scan table, then the summary. ``scans_per_s`` is the clock's word and stands in no file."""
    if rows:
        console.print(scan_table(console, rows, every=every, all=all))
        console.print()
    print_summary(console, summary, scans_per_s=scans_per_s)


def print_summary(console: Console, summary: Summary, *, scans_per_s: float | None = None) -> None:
    """Errors, faults, parameters and the rest, each a small table; those with nothing to say are left out."""
    palette = Palette.of(console)
    for table in (_errors(console, summary), _faults(console, summary, palette), _parameters(console, summary)):
        if table.row_count:
            console.print(table)
            console.print()
    facts = new_table(console, "Run")
    facts.add_column("what", no_wrap=True)
    facts.add_column("value", overflow="fold")
    for name, value in _facts(summary, scans_per_s):
        facts.add_row(name, value)
    console.print(facts)


def _errors(console: Console, summary: Summary) -> Table:
    table = new_table(console, "Errors")
    table.add_column("of", no_wrap=True)
    table.add_column("unit")
    for name in ("n", *(name for name, _ in _STATISTICS)):
        table.add_column(name, justify="right", no_wrap=True)
    lines: list[tuple[str, str, Spread | None, int]] = []
    for name, errors in (
        ("pose, healthy", summary.pose_healthy),
        ("pose, coasting", summary.pose_coasting),
        ("registration", summary.registration_healthy),
    ):
        lines.append((name, "m", errors.position_m, 4))
        lines.append((name, "deg", errors.rotation_deg, 3))
    lines.append(("fit error rms", "m", summary.fit_error_m, 5))
    for name, unit, spread, least in lines:
        if spread is not None:
            fmt = f".{decimals([spread.rmse], least)}f"
            table.add_row(name, unit, str(spread.count), *(format(get(spread), fmt) for _, get in _STATISTICS))
    return table


def _faults(console: Console, summary: Summary, palette: Palette) -> Table:
    table = new_table(console, "Injected faults")
    for name in ("kind", "from\n[s]", "to\n[s]", "scans", "flagged", "verdict", "recovered\nafter [s]"):
        table.add_column(name, justify="left" if name in ("kind", "verdict") else "right", no_wrap=True)
    for e in summary.faults.episodes:
        after = palette.dash if e.recover_s is None else f"{e.recover_s:.2f}"
        scans = [str(e.scans), str(e.flagged)]
        table.add_row(e.kind, f"{e.start_s:.1f}", f"{e.end_s:.1f}", *scans, _verdict(e, palette), after)
    return table


def _verdict(episode: Episode, palette: Palette) -> str:
    if episode.detected:
        return f"{palette.healthy} detected" + ("" if episode.scans else " as a gap")
    return f"{palette.flagged} missed" if episode.harmful else f"{palette.coasting} harmless, used"


def _parameters(console: Console, summary: Summary) -> Table:
    table = new_table(console, "Parameters at the last scan")
    for name in ("parameter", "unit", "estimate", "truth", "error", "1 sigma"):
        table.add_column(name, justify="left" if name in ("parameter", "unit") else "right")
    for p in summary.parameters:
        table.add_row(p.name, p.unit, *_values(p))
    return table


def _values(p: Parameter) -> list[str]:
    scalars = [("" if v is None else f"{v:.4f}") for v in (p.error, p.one_sigma)]
    vectors = ["" if v is None else " ".join(f"{x:.4f}" for x in v) for v in (p.estimate, p.truth)]
    return [*vectors, *scalars]


def _facts(summary: Summary, scans_per_s: float | None) -> list[tuple[str, str]]:
    facts = [
        *_scan_facts(summary),
        *_fault_facts(summary),
        *_filter_facts(summary),
        *_plan_facts(summary),
    ]
    facts += [(name, str(count)) for name, count in summary.counts.items() if count]
    if scans_per_s is not None:
        facts.append(("speed", f"{scans_per_s:.1f} scans/s"))
    return facts


def _scan_facts(summary: Summary) -> list[tuple[str, str]]:
    interval = "" if summary.interval_s is None else f", one every {summary.interval_s:.3g} s"
    facts = [("scans", f"{summary.scans} in {summary.duration_s:.2f} s{interval}")]
    healthy = f"{summary.healthy} healthy (gamma 1), {summary.coasting} coasting"
    facts.append(("used", healthy + _counted(summary.reasons)))
    if summary.gaps:
        facts.append(("gaps", f"{summary.gaps} intervals longer than 1.5 x the median"))
    coast = summary.longest_coast
    if coast is not None:
        error = ""
        if coast.pos_err_m is not None and coast.rot_err_deg is not None:
            error = f"; error at its end {coast.pos_err_m:.4f} m, {coast.rot_err_deg:.3f} deg"
        facts.append(("longest coast", f"{coast.scans} scans, {coast.duration_s:.2f} s{error}"))
    return facts


def _counted(counts: Mapping[str, int]) -> str:
    return ": " + ", ".join(f"{name} {count}" for name, count in counts.items()) if counts else ""


def _fault_facts(summary: Summary) -> list[tuple[str, str]]:
    faults = summary.faults
    if not faults.known:
        return [("flagged", f"{faults.false_alarms} scans; the log does not say what was injected")]
    events = f"{faults.injected} injected, {faults.detected} detected, {faults.missed} missed"
    scans = f"{faults.harmful_scans - faults.missed_scans} of {faults.harmful_scans} harmful scans flagged"
    rate = 100.0 * faults.false_alarm_rate
    facts = [
        ("harmful faults", f"{events}; {scans}"),
        ("false alarms", f"{faults.false_alarms} of {faults.unlabelled} scans without a fault ({rate:.2f} %)"),
    ]
    if faults.longest_recovery_s is not None:
        facts.append(("recovery", f"at most {faults.longest_recovery_s:.2f} s after the first scan past a fault"))
    return facts


def _filter_facts(summary: Summary) -> list[tuple[str, str]]:
    facts: list[tuple[str, str]] = []
    for name, share in (("NIS", summary.nis), ("NEES", summary.nees)):
        if share is not None:
            band = f"[{share.low:.1f}, {share.high:.1f}]"
            facts.append((name, f"median {share.median:.2f}; {100 * share.inside:.1f} % inside the 95 % band {band}"))
    if summary.sigma_hits is not None:
        floors = f", floor of R acted {summary.r_floors} times" if summary.r_floors is not None else ""
        facts.append(("constraints", f"sigma bound hit {summary.sigma_hits} times{floors}"))
    seen = summary.observability
    if seen.rank is not None:
        full = "never full" if seen.full_rank_s is None else f"full from {seen.full_rank_s:.2f} s"
        facts.append(("Gramian", f"rank {seen.rank} of 20 ({full}); log10 condition {_conditions(summary)}"))
    return facts


def _conditions(summary: Summary) -> str:
    seen = summary.observability
    raw = "none" if seen.log10_cond is None else f"{seen.log10_cond:.1f}"
    scaled = "none" if seen.log10_cond_scaled is None else f"{seen.log10_cond_scaled:.1f}"
    return f"{raw} raw, {scaled} scaled"


def _plan_facts(summary: Summary) -> list[tuple[str, str]]:
    t1, capture = summary.convergence, summary.capture
    end = "" if t1.at_end else "; not at the last scan"
    back = f"; taken back {t1.withdrawn} times" if t1.withdrawn else ""
    facts = [("t_1", "not reached" if t1.t1_s is None else f"{t1.t1_s:.2f} s{back}{end}")]
    if capture.last_s is None:
        facts.append(("capture", f"no plan ({capture.status or 'never asked for'})"))
    else:
        spread = f"std {capture.std_s:.3f} s, range {capture.range_s:.3f} s"
        facts.append(("capture", f"planned at {capture.last_s:.2f} s; {spread} over {capture.replans} plans"))
    return facts
