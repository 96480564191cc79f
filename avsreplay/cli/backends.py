"""``avsreplay backends`` and ``avsreplay bench``: the registration back ends, their contract, and
their speed and error on a log.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.config import Command

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from avsreplay.geometry import Pose
    from avsreplay.parts import LawResult
    from avsreplay.records import Alignment, Surface
    from avsreplay.register.backend import Availability
    from avsreplay.register.registrar import Registrar

    TrueScan = tuple[NDArray[Any], Pose | None]

EPILOG = """\b
Examples:
  avsreplay backends
  avsreplay backends --check horn

\b
"On other processors": the same bytes on every x86-64 Linux machine with the
same libraries, or how far a pose can differ: libraries that stop by their own
rules may take another number of iterations. See docs/ci.md."""


@click.command("backends", cls=Command, epilog=EPILOG)
@click.option(
    "--check",
    "name",
    metavar="NAME",
    help="Run the contract tests on this back end; exit code 1 if one fails.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
def backends_command(name: str | None, as_json: bool) -> None:
    """List the registration back ends, and how to install those that are missing."""
    if name is None:
        _list(as_json)
    else:
        _check(name, as_json)


def _list(as_json: bool) -> None:
    from avsreplay.register.backend import available

    states = available()
    if as_json:
        print_json([dataclasses.asdict(state) for state in states])
    else:
        heads = (
            "name",
            "installed",
            "version",
            "description",
            "on other processors",
            "how to install",
        )
        print_plain_table("Registration back ends", heads, map(_state_row, states))


def _state_row(state: Availability) -> tuple[str, ...]:
    return (
        state.name,
        "yes" if state.installed else "no",
        state.version,
        state.about,
        state.elsewhere,
        state.get,
    )


def _check(name: str, as_json: bool) -> None:
    from avsreplay.register.contract import check

    report_laws("backend", name, check(name), as_json)


def report_laws(kind: str, name: str, findings: Sequence[LawResult], as_json: bool) -> None:
    """Print the laws of a contract and the result of each.

    Args:
        kind: kind of the part, the key of its name in JSON.
        name: name of the part.
        findings: the results of the laws.
        as_json: print JSON.

    Raises:
        CheckFailed: a law does not hold.
    """
    from avsreplay.errors import CheckFailed

    if as_json:
        laws = [dataclasses.asdict(finding) for finding in findings]
        print_json({kind: name, "findings": laws})
    else:
        print_plain_table(
            f"Contract of {name}", ("law", "holds", "measured"), map(_finding_row, findings)
        )
    broken = [finding.law for finding in findings if not finding.held]
    if broken:
        raise CheckFailed(
            f"{len(broken)} of {len(findings)} laws broken: {'; '.join(broken)}", where=name
        )


def _finding_row(finding: LawResult) -> tuple[str, ...]:
    return finding.law, "yes" if finding.held else "NO", finding.detail


def print_json(value: Any) -> None:
    """Print a value as one JSON document."""
    click.echo(json.dumps(value, indent=2))


def print_plain_table(title: str, heads: tuple[str, ...], rows: Iterable[Iterable[str]]) -> None:
    """Print a table of texts.

    Args:
        title: title above the table.
        heads: headings of the columns.
        rows: one text for each column.
    """
    from avsreplay.report.table import Table, make_console, print_table

    print_table(
        make_console(plain_width=120), Table(title, heads, tuple(map(tuple, rows)), align="l")
    )


MEMORY_SCANS = 3
BACKEND_HEADS = (
    *(
        "back end",
        "build\n[s]",
        "median\n[ms]",
        "95 %\n[ms]",
        "iterations\nmedian",
        "rotation\nrms [deg]",
    ),
    *("position\nrms [mm]", "failures", "peak\n[MiB]"),
)


@dataclass(slots=True)
class Tally:
    """Results of one back end, scan by scan. Times are wall clock; errors are relative to the
    log's truth.
    """

    name: str
    build_s: float = 0.0
    peak_mib: float | None = None
    ms: list[float] = field(default_factory=list)
    passes: list[int] = field(default_factory=list)
    rot_deg: list[float] = field(default_factory=list)
    pos_mm: list[float] = field(default_factory=list)
    failures: int = 0

    def summary(self) -> dict[str, Any]:
        """Return one flat record; None for a value that was not measured."""
        import numpy as np

        def rms(values: list[float]) -> float | None:
            return float(np.sqrt(np.mean(np.square(values)))) if values else None

        timed = bool(self.ms)
        return {
            "backend": self.name,
            "build_s": self.build_s,
            "scans": len(self.ms),
            "median_ms": float(np.median(self.ms)) if timed else None,
            "p95_ms": float(np.quantile(self.ms, 0.95)) if timed else None,
            "median_passes": float(np.median(self.passes)) if timed else None,
            "rot_err_rms_deg": rms(self.rot_deg),
            "pos_err_rms_mm": rms(self.pos_mm),
            "failures": self.failures,
            "peak_mib": self.peak_mib,
        }


BENCH_EPILOG = """\b
Examples:
  avsreplay bench tumble.mcap
  avsreplay bench tumble.mcap --backends horn,small_gicp --n-scans 200
  avsreplay bench own.bag --model target.stl --topic /camera/points --json

\b
Exit codes: 0 ok, 2 usage, 3 unreadable input, 4 finished but data was lost."""


@click.command("bench", cls=Command, epilog=BENCH_EPILOG)
@click.argument("log", type=click.Path(path_type=Path))
@click.option(
    "--backends",
    default="horn,kiss",
    show_default=True,
    help="Names of back ends, separated by commas.",
)
@click.option(
    "--model", type=click.Path(path_type=Path), help="Model of the target, if the log has none."
)
@click.option("--topic", help="The cloud topic, where there are several.")
@click.option(
    "--n-scans",
    "scans",
    default=50,
    show_default=True,
    type=click.IntRange(1),
    help="Number of scans, from the first one on.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
def bench_command(
    log: Path, backends: str, model: Path | None, topic: str | None, scans: int, as_json: bool
) -> None:
    """Measure the time and the error of registration back ends, one after the other on each scan of
    LOG.

    The initial guess is the pose of the previous scan: the true pose if the log has it, otherwise
    the pose that the same back end found. Times can be compared within one run, but not between two
    runs.

    \f
    Raises:
        UsageError: no back end is named, a back end is unknown, or the log has no model.
        MissingBackend: a back end is not installed.
        UnreadableInput: the log or the model cannot be read.
        DataLost: a part of the log could not be read.
    """  # noqa: D301
    from avsreplay.cli.options import report_losses
    from avsreplay.errors import UsageError
    from avsreplay.log import SourceOptions, open_source

    names = list(dict.fromkeys(name.strip() for name in backends.split(",") if name.strip()))
    if not names:
        raise UsageError(
            "no back end is named", where="--backends", hint="for example --backends horn,kiss"
        )
    with open_source(log, SourceOptions(topic=topic, model=model, n_scans=scans)) as source:
        surface = source.header.surface
        taken = [(scan.points, source.truth_of(scan).pose) for scan in source.scans()]
    if surface is None:
        raise UsageError("the log has no model", where=str(log), hint="name one with --model")
    summaries = [tally.summary() for tally in benchmark_backends(names, surface, taken)]
    if as_json:
        click.echo(json.dumps({"log": str(log), "backends": summaries}, indent=2))
    else:
        _print_tallies(summaries)
    report_losses(source)


def benchmark_backends(names: list[str], surface: Surface, scans: list[TrueScan]) -> list[Tally]:
    """Measure the time of every back end on every scan that has points. All back ends process a
    scan before the next scan is taken.

    Args:
        names: names of the back ends.
        surface: model of the target.
        scans: points (n, 3) of each scan in {A} [m] and its true pose T_ac, or None.

    Raises:
        UsageError, MissingBackend: a back end does not exist or is not installed; this is found
            before anything is measured.
    """
    from avsreplay.cli.options import tracked
    from avsreplay.errors import UsageError

    tallies, registrars = [], []
    for name in names:
        begun = time.perf_counter()
        try:
            registrars.append(_registrar(name, surface))
        except UsageError as error:  # it names the option of a run
            error.where = "--backends"
            raise
        tallies.append(Tally(name, build_s=time.perf_counter() - begun))
    usable = [scan for scan in scans if len(scan[0])]
    last: list[Pose | None] = [None] * len(names)
    truth: Pose | None = None
    for scan in tracked(usable, len(usable), "bench"):
        for k, (tally, registrar) in enumerate(zip(tallies, registrars, strict=True)):
            last[k] = _one(tally, registrar, scan, truth if truth is not None else last[k])
        truth = scan[1]
    for tally in tallies:
        tally.peak_mib = _peak_mib(tally.name, surface, usable[:MEMORY_SCANS])
    return tallies


def _one(tally: Tally, registrar: Registrar, scan: TrueScan, guess: Pose | None) -> Pose | None:
    """Register one scan, count it, and give the next guess; the first scan is acquired and
    not counted.
    """
    from avsreplay.records import AlignStatus

    points, truth = scan
    if guess is None:
        found = registrar.acquire(points)
        return found.T_ac if found.status is AlignStatus.ALIGNED else None
    begun = time.perf_counter()
    found = registrar.register(points, guess)
    tally.ms.append(1e3 * (time.perf_counter() - begun))
    tally.passes.append(found.iterations)
    if found.status is not AlignStatus.ALIGNED:
        tally.failures += 1
        return guess
    if truth is not None:
        _count_error(tally, truth, found)
    return found.T_ac


def _count_error(tally: Tally, truth: Pose, found: Alignment) -> None:
    import numpy as np

    from avsreplay import geometry

    step = truth.inverse() @ found.T_ac
    tally.rot_deg.append(float(np.degrees(geometry.angle(step.q))))
    tally.pos_mm.append(1e3 * float(np.linalg.norm(step.t)))


def _registrar(name: str, surface: Surface) -> Registrar:
    from avsreplay.register.params import RegisterParams
    from avsreplay.register.registrar import Registrar

    return Registrar(surface, RegisterParams(backend=name))


def _peak_mib(name: str, surface: Surface, scans: list[TrueScan]) -> float | None:
    """Peak memory of a fresh process that builds the back end and registers three scans; None
    if it is unknown.
    """
    if sys.platform == "win32":
        return None
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_peak_of_run, name, surface, scans).result()


def _peak_of_run(name: str, surface: Surface, work: list[TrueScan]) -> float:
    import resource

    registrar = _registrar(name, surface)
    for points, truth in work:
        if truth is not None:
            registrar.register(points, truth)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20) if sys.platform == "darwin" else peak / 1024  # bytes there, KiB here


def _print_tallies(summaries: list[dict[str, Any]]) -> None:
    from avsreplay.report.table import Table, make_console, number, print_table

    keys = ("build_s", "median_ms", "p95_ms", "median_passes", "rot_err_rms_deg", "pos_err_rms_mm")
    specs = (".2f", ".2f", ".2f", ".0f", ".4f", ".3f")
    rows = tuple(
        (
            row["backend"],
            *(number(row[key], spec) for key, spec in zip(keys, specs, strict=True)),
            f"{row['failures']} of {row['scans']}",
            number(row["peak_mib"], ".0f"),
        )
        for row in summaries
    )
    print_table(
        make_console(plain_width=120),
        Table("Registration back ends on this log", BACKEND_HEADS, rows),
    )
