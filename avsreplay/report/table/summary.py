"""The summary tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rich.console import Console
from rich.table import Table

from avsreplay.report.episodes import Episode
from avsreplay.report.parameters import Parameter
from avsreplay.report.spread import Spread
from avsreplay.report.summary import Summary
from avsreplay.report.table.console import Palette, decimals, new_table
from avsreplay.report.table.scans import scan_table
from avsreplay.report.table.sparks import print_sparks
from avsreplay.report.words import fact_lines
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
    plain: bool = False,
) -> None:
    """The per-scan table, sparklines on a wide terminal unless ``plain``, the summary.

    ``scans_per_s`` is the clock's word and stands in no file.
    """
    if rows:
        console.print(scan_table(console, rows, every=every, all=all))
        console.print()
        if not plain:
            print_sparks(console, rows)
    print_summary(console, summary, scans_per_s=scans_per_s)


def print_summary(console: Console, summary: Summary, *, scans_per_s: float | None = None) -> None:
    """Errors, faults, parameters and the rest, each a small table; those with nothing to say are left out."""
    palette = Palette.of(console)
    tables = (
        _errors(console, summary),
        _faults(console, summary, palette),
        _parameters(console, summary),
        _consistency(console, summary),
    )
    for table in tables:
        if table.row_count:
            console.print(table)
            console.print()
    facts = new_table(console, "Run")
    facts.add_column("what", no_wrap=True)
    facts.add_column("value", overflow="fold")
    for name, value in fact_lines(summary, scans_per_s=scans_per_s):
        facts.add_row(name, value)
    console.print(facts)


def _errors(console: Console, summary: Summary) -> Table:
    table = new_table(console, "Errors vs fit" if summary.reference == "fit" else "Errors")
    table.add_column("of", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for name in ("n", *(name for name, _ in _STATISTICS)):
        table.add_column(name, justify="right", no_wrap=True)
    lines: list[tuple[str, str, Spread | None]] = []
    for name, errors in (
        ("pose, healthy", summary.pose_healthy),
        ("pose, coasting", summary.pose_coasting),
        ("registration", summary.registration_healthy),
    ):
        lines.append((name, "m", errors.position_m))
        lines.append((name, "deg", errors.rotation_deg))
    lines.append(("fit error rms", "m", summary.fit_error_m))
    for name, unit, spread in lines:
        if spread is not None:
            unit, factor = ("mm", 1000.0) if unit == "m" and spread.rmse < 1.0 else (unit, 1.0)
            fmt = f".{decimals([factor * spread.rmse], 2)}f"
            table.add_row(name, unit, str(spread.count), *(format(factor * get(spread), fmt) for _, get in _STATISTICS))
    return table


def _consistency(console: Console, summary: Summary) -> Table:
    """Normalised errors squared, whole and block by block, against their two-sided 95 % chi-square bands."""
    table = new_table(console, "Consistency (per degree of freedom: 1 is right)")
    table.add_column("statistic", no_wrap=True)
    for name in ("n", "median", "inside 95 % band [%]", "band"):
        table.add_column(name, justify="right", no_wrap=True)
    whole = [("NIS", summary.nis, 6), ("NEES", summary.nees, 20)]
    blocks = [(f"NEES {name}", share, 1) for name, share in summary.nees_blocks.items()]
    for name, share, size in (*whole, *blocks):
        if share is not None:
            band = f"{share.low / size:.2f} to {share.high / size:.2f}"
            table.add_row(name, str(share.count), f"{share.median / size:.2f}", f"{100.0 * share.inside:.1f}", band)
    return table


def _faults(console: Console, summary: Summary, palette: Palette) -> Table:
    table = new_table(console, "Injected faults")
    for name in ("kind", "from\n[s]", "to\n[s]", "scans\nflagged", "verdict", "delay\n[s]", "recovery\n[s]"):
        table.add_column(name, justify="left" if name in ("kind", "verdict") else "right", no_wrap=True)
    for e in summary.faults.episodes:
        delay = palette.dash if e.delay_s is None else f"{e.delay_s:.2f}"
        after = "never" if e.lost else palette.dash if e.recover_s is None else f"{e.recover_s:.2f}"
        window, scans = [f"{e.start_s:.1f}", f"{e.end_s:.1f}"], f"{e.flagged}/{e.scans}"
        table.add_row(e.kind, *window, scans, _verdict(e, palette), delay, after)
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
