"""One builder for every HTML page: of a run, a comparison, a campaign, a flight. Self-contained, no
network, no server.

Text reaches a page through Jinja templates with autoescape. Charts are drawn by uPlot (50 kB, MIT,
bundled) and the 3D view by plain WebGL, so that a page is its data plus 0.1 MB.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.records import State, Surface
from avsreplay.report import charts
from avsreplay.report.approach import approach_picture, flown_parts
from avsreplay.report.conclusion import ComparedRun, Conclusion, changes_table, settings_table
from avsreplay.report.export import StampedPose
from avsreplay.report.flown import flight_facts
from avsreplay.report.gate import RuleOutcome, gate_table
from avsreplay.report.summary import Summary
from avsreplay.report.summary_tables import (
    event_table,
    fact_lines,
    in_one_line,
    moments_table,
    summary_tables,
    verdict_table,
)
from avsreplay.report.table import Table, as_cell, facts_table
from avsreplay.report.verdict import verdict_of
from avsreplay.report.view import View, cone_lines, scene, thin_surface
from avsreplay.rows import Row
from avsreplay.tables import chosen, column_of, numbers

MAX_PAGE_ROWS = 20_000
_SCRIPTS = ("uPlot.iife.min.js", "charts.js", "scene.js", "page.js")


@value_class(eq=True)
class Section:
    """A heading with a paragraph, between the tables of a page."""

    heading: str
    text: str = ""


@value_class(eq=True)
class Folded:
    """Parts, or preformatted text, that are folded until the reader opens them."""

    title: str
    text: str = ""
    parts: tuple[Part, ...] = ()

    @property
    def listed(self) -> list[tuple[str, Part]]:
        """The parts with their kinds, for the template."""
        return _listed(self.parts)


Part = Table | Section | Folded | Markup
"""What stands under the charts, in order; Markup is a figure made by ``render``."""


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("avsreplay.report", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["cell"] = as_cell
    return environment


def render(template: str, **context: Any) -> Markup:
    """Render a template of ``assets/``; every value is escaped."""
    return Markup(_environment().get_template(template).render(**context))


def build_html(
    title: str,
    lines: Sequence[str],
    parts: Iterable[Part],
    data: Mapping[str, Any] | None = None,
    lead: Iterable[Part] = (),
    grade: str = "",
) -> str:
    """Build a page.

    Args:
        title: title of the page, also its first heading.
        lines: lines under the title, the verdict first.
        parts: tables, headings, figures and folded parts, in order; a table without rows is left
            out.
        data: charts and 3D view for the scripts; without it the page has no script.
        lead: parts beside the 3D view.
        grade: pass, check or fail, which determines the colour of the first line.

    Returns:
        The page as text; the same arguments give the same bytes.
    """
    listed, first = _listed(parts), _listed(lead)
    style = Markup(_asset("uPlot.min.css") if data else "") + render("page.css")
    script = Markup("\n".join(map(_asset, _SCRIPTS))) if data else ""
    embedded = Markup(charts.embed(data)) if data else ""
    return str(
        render(
            "page.html",
            title=title,
            lines=lines,
            grade=grade,
            lead=first,
            parts=listed,
            style=style,
            script=script,
            data=embedded,
            more=any(not chart["first"] for chart in (data or {}).get("charts", ())),
            shown=bool(data and data["scene"]),
        )
    )


def _listed(parts: Iterable[Part]) -> list[tuple[str, Part]]:
    return [(_kind(part), part) for part in parts if _has_content(part)]


def _has_content(part: Part) -> bool:
    if isinstance(part, Folded):
        return bool(part.text or _listed(part.parts))
    return not isinstance(part, Table) or bool(part.rows)


def _kind(part: Part) -> str:
    return "figure" if isinstance(part, Markup) else type(part).__name__.lower()


def _asset(name: str) -> str:
    return (files("avsreplay.report") / "assets" / name).read_text(encoding="utf-8")


def build_page(
    rows: Sequence[Row],
    summary: Summary,
    header: Mapping[str, Any] | None = None,
    *,
    title: str = "run",
    truth: State | None = None,
    poses: Iterable[StampedPose] = (),
    view: View | None = None,
) -> str:
    """Build the page of one run.

    Args:
        rows: one per scan.
        summary: the summary of these rows.
        header: the content of ``run.json``, folded away at the end.
        title: title of the page.
        truth: true parameters, drawn as horizontal lines.
        poses: true poses of {C} in {A}.
        view: model, clouds and paths for the 3D view.

    Returns:
        The page as text.
    """
    verdict = verdict_of(rows, summary, header)
    kept = charts.most_telling(rows, MAX_PAGE_ROWS, (moment.row for moment in verdict.moments))
    place, all_rows = {k: n for n, k in enumerate(kept)}, rows
    rows = chosen(rows, np.array(kept, int))
    stamps = set(column_of(rows, "t_ns"))
    columns = charts.derived(rows)
    used = numbers(rows, "gamma") == 1.0
    t1 = summary.convergence.t1_s
    flown = [] if view is None else flown_parts(rows, view)
    data = {
        "runs": [_run_data(title, rows, columns)],
        "charts": charts.charts(columns, truth, (header or {}).get("limits"), used),
        "spans": charts.spans(rows, summary.faults.episodes),
        "marks": [] if t1 is None else [{"t": t1, "label": "t_1"}],
        "states": [
            [gamma, reason, fault or ""]
            for gamma, reason, fault in zip(
                *(column_of(rows, name) for name in ("gamma", "reason", "fault")), strict=True
            )
        ],
        "scans": column_of(rows, "seq"),
        "scene": scene(rows, {t_ns: pose for t_ns, pose in poses if t_ns in stamps}, view)
        | {"flown": _flown_data(flown)},
        "chosen": flown[-1][0] + len(flown[-1][1]) - 1 if flown else 0,
    }
    errors, faults, manoeuvres, *others = summary_tables(summary, rows)
    picture = approach_picture(rows, view, header or {})
    parts: list[Part] = [moments_table(verdict, place)]
    if picture is not None:
        parts += [Section("Approach"), render("approach.svg", **picture)]
    parts += [
        Folded("Faults and manoeuvres", parts=(event_table(header), faults, manoeuvres)),
        Folded("Reasons and settings", parts=(verdict_table(verdict),)),
        Folded(
            "Errors, parameters and consistency",
            parts=(errors, *others, facts_table("Run", fact_lines(summary))),
        ),
    ]
    if header:
        text = json.dumps(header, indent=2, ensure_ascii=False, default=str)
        parts.append(Folded("Configuration and versions", text))
    capture = [] if verdict.capture is None else verdict.capture.described()
    capture += flight_facts(all_rows, view, header or {}, verdict.capture)
    lead = [facts_table("Capture", capture)]
    lines = [verdict.line, in_one_line(summary)]
    if len(rows) < len(all_rows):
        count = f"{len(rows)} of {len(all_rows)} scans"
        lines.append(
            f"The charts show {count}: of every interval the first scan and those with the largest"
            " errors."
        )
    return build_html(title, lines, parts, data, lead, verdict.grade.value.lower())


def _run_data(name: str, rows: Sequence[Row], columns: charts.Columns) -> dict[str, Any]:
    """Times, columns and gamma of one run."""
    return {
        "name": name,
        "t": charts.pack(numbers(rows, "t_s"), "f8"),
        "columns": _packed(columns),
        "used": charts.pack(column_of(rows, "gamma"), "u1"),
    }


def _flown_data(flown: Sequence[tuple[int, Array]]) -> list[dict[str, Any]]:
    """Flown parts in {C}: the row of the first position, and the positions."""
    return [{"first": k, "points": charts.pack(points, "f4")} for k, points in flown]


def _packed(columns: charts.Columns) -> dict[str, Any]:
    return {name: charts.pack(column, "f4") for name, column in columns.items()}


def build_comparison(
    runs: Sequence[ComparedRun],
    conclusions: Sequence[Conclusion],
    outcomes: Sequence[RuleOutcome] = (),
) -> str:
    """Build the page of several runs: conclusions, metrics in tables, and charts with a line for
    each run.

    Args:
        runs: the runs; the first is the baseline, whose flagged scans are shaded.
        conclusions: one for each of the other runs.
        outcomes: the outcomes of the rules of a gate.

    Returns:
        The page as text.
    """
    columns = [charts.derived(run.rows) for run in runs]
    data = {
        "runs": [
            _run_data(run.name, run.rows, own) for run, own in zip(runs, columns, strict=True)
        ],
        "charts": _overlaid(runs, columns),
        "spans": charts.spans(runs[0].rows),
        "marks": [],
        "states": None,
        "scene": None,
    }
    lines = [c.sentence for c in conclusions] or [runs[0].name]
    lead = [*(settings_table(c) for c in conclusions), gate_table(outcomes)]
    parts = [changes_table(runs[0].name, c, show_all=True) for c in conclusions]
    names = ", ".join(run.name for run in runs)
    return build_html(
        "Comparison",
        [*lines, f"{len(runs)} runs: {names}.{_gate_sentence(outcomes)}"],
        parts,
        data,
        lead,
    )


_COMPARED_FIRST = ("pos_err_m", "rot_err_deg", "nis", "capture_time_s")  # charts not folded


def _gate_sentence(outcomes: Sequence[RuleOutcome]) -> str:
    if not outcomes:
        return ""
    broken = sum(not o.ok for o in outcomes)
    return (
        f" {broken} of {len(outcomes)} rules broken."
        if broken
        else f" All {len(outcomes)} rules hold."
    )


def _overlaid(runs: Sequence[ComparedRun], columns: Sequence[charts.Columns]) -> list[charts.Chart]:
    """One chart for each line of the single-run charts, with a line per run."""
    everything: charts.Columns = {
        name: column for own in reversed(columns) for name, column in own.items()
    }
    instants = [[row.t_s for row in run.rows] for run in runs]
    together = all(own == instants[0] for own in instants)
    out = []
    for chart in charts.charts(everything):
        for line in chart["series"]:
            name = line["column"]
            lines = [
                ({**line, "run": k, "label": run.name, "colour": k, "dash": k % 2 == 1}, of[name])
                for k, (run, of) in enumerate(zip(runs, columns, strict=True))
                if name in of
            ]
            series = (
                charts.distinct(lines, logarithmic=bool(chart["log"]))
                if together
                else [line for line, _ in lines]
            )
            alone = len(chart["series"]) == 1
            title = chart["title"] if alone else f"{chart['title']}: {line['label']}"
            levels = chart["levels"] if alone else []
            out.append(
                chart
                | {
                    "key": line["column"],
                    "title": title,
                    "series": series,
                    "bands": [],
                    "levels": levels,
                    "first": line["column"] in _COMPARED_FIRST,
                }
            )
    return out


@value_class
class Flight:
    """A planned flight in {C}.

    Attributes:
        t_s: (n,) instants [s after the instant of planning].
        position_c: (n, 3) position of the gripper [m]; the grasp point is the origin.
        figures: Names of columns (see ``flight_charts``) and their values (n,).
        axis_c: (3,) outward axis of the fixture, unit.
        cones: Half-angle [deg] and length [m] of each approach cone that is required.
        mouth_m: Radius of the cones at the grasp point.
        surface: Model of the target in {C}; None where the result has none.
    """

    t_s: Array
    position_c: Array
    figures: Mapping[str, Array]
    axis_c: Array
    cones: Sequence[tuple[float, float]] = ()
    mouth_m: float = 0.0
    surface: Surface | None = None


def build_flight_page(
    title: str, lines: Sequence[str], flight: Flight, facts: Iterable[tuple[str, str]]
) -> str:
    """Return the page of a flight as text; the same arguments give the same bytes.

    Args:
        title: title of the page.
        lines: lines under the title, the verdict first.
        flight: the flight.
        facts: figures of the plan, as names and texts.
    """
    columns = {
        name: np.asarray(values, dtype=np.float64) for name, values in flight.figures.items()
    }
    data = {
        "runs": [
            {
                "name": title,
                "t": charts.pack(flight.t_s, "f8"),
                "columns": _packed(columns),
                "used": None,
            }
        ],
        "charts": charts.flight_charts(columns),
        "spans": [],
        "marks": [],
        "states": None,
        "scene": _scene(flight),
    }
    note = (
        "3D view: frame of the fixture {C}, in which the target is at rest. Time counts from the"
        " instant of planning."
    )
    return build_html(title, [*lines, note], [], data, [facts_table("Plan", facts)])


def _scene(flight: Flight) -> dict[str, Any]:
    """Data for ``scene.js``: the model at rest, the path in {C}, the gripper at every
    instant, the cones.
    """
    view = None if flight.surface is None else View(*thin_surface(flight.surface))
    still = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(flight.t_s), 1))
    cones = [cone_lines(flight.axis_c, *cone, flight.mouth_m) for cone in flight.cones]
    nearest = min((length for _, length in flight.cones), default=0.5)
    return scene([], {}, view) | {
        "estimate": charts.pack(still, "f4"),
        "truth": charts.pack(np.full_like(still, np.nan), "f4"),
        "paths": [{"t_s": 0.0, "points": charts.pack(flight.position_c, "f4"), "miss_m": None}],
        "flight": {
            "axis": flight.axis_c.tolist(),
            "cones": charts.pack(np.concatenate([np.zeros((0, 3)), *cones]), "f4"),
            "near_m": nearest,
        },
    }
