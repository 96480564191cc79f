"""The charts of a page as plain data for ``charts.js``; arrays are base64 text."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from avsreplay import geometry
from avsreplay.parts import FAULTS
from avsreplay.records import State
from avsreplay.report.episodes import Episode
from avsreplay.report.summary import NEES_BAND, NIS_BAND
from avsreplay.rows import Row
from avsreplay.tables import column_of, numbers

_ARRAY_TYPES = {"f8": "<f8", "f4": "<f4", "i4": "<i4", "i2": "<i2", "u4": "<u4", "u1": "u1"}


def pack(array: ArrayLike, kind: str) -> dict[str, str]:
    """Return an array as ``{"type", "data"}``, its elements in row order as base64 text.

    Args:
        array: of any shape.
        kind: type of the stored elements: f8, f4, i4, i2, u4 or u1.
    """
    flat = np.ascontiguousarray(np.asarray(array), dtype=_ARRAY_TYPES[kind]).reshape(-1)
    return {"type": kind, "data": base64.b64encode(flat.tobytes()).decode("ascii")}


def embed(value: Any) -> str:
    """Return a value as JSON that can stand inside a script element: without ``<``, line separators
    or NaN.
    """
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


Columns = dict[str, NDArray[np.float64]]
Chart = dict[str, Any]

_DIRECT = (
    *("pos_err_m", "rot_err_deg", "reg_pos_err_m", "reg_rot_err_deg", "pos_1s_m", "rot_1s_deg"),
    *("rms_m", "inlier_ratio", "nis", "innov_m", "innov_deg"),
    *("sigma1", "sigma2", "cx_m", "cy_m", "cz_m", "wx_radps", "wy_radps", "wz_radps"),
    *("nees", "ogm_log10_cond", "ogm_log10_cond_scaled", "ogm_rank"),
    *("r_pos_m", "r_rot_deg", "capture_time_s", "earliest_capture_s", "plan_miss_m"),
)
_SPREAD_PLANS = 10
LOGARITHMIC_RATIO = 20.0  # largest over typical value from which an axis is logarithmic
PLACE_STYLES = {  # colour and pattern of each place
    "flagged": (
        *(
            "not_aligned",
            "fit_error",
            "no_scan",
            "frozen",
            "pose_jump",
            "few_inliers",
            "not_converged",
        ),
        "halves_differ",
        *("doubtful", "sensor_bias", "clock", "wrong_scan"),
    ),
    "injected": FAULTS.names(),
    "action": (
        "approach",
        "hold",
        "stand_still",
        "capture",
        "retreat",
        "abort",
        "approach_on_prediction",
    ),
}
FIRST = ("position", "nis", "capture")  # charts that stand beside the states; others are folded
# largest difference of two lines, over the range of the first, that are drawn as one
SAME_LINE_DIFFERENCE = 1e-3
_FIRST_PATTERN = {"flagged": 0, "injected": 2, "action": 4}  # two patterns for each lane


def derived(rows: Sequence[Row]) -> Columns:
    """Return every column (n,) that a chart draws, by name, without those that have no value.

    Args:
        rows: the rows of a run.
    """
    out = {name: numbers(rows, name) for name in _DIRECT}
    out |= {f"mu_{axis}_deg": column for axis, column in zip("xyz", _attitude(rows), strict=True)}
    for name, sigma in (
        ("sigma1", "sigma1_1s"),
        ("sigma2", "sigma2_1s"),
        *((f"c{a}_m", "c_1s_m") for a in "xyz"),
    ):
        _band(out, name, numbers(rows, sigma))
    for axis in "xyz":
        _band(out, f"mu_{axis}_deg", numbers(rows, "mu_1s_deg"))
    out["capture_time_s_lo"], out["capture_time_s_hi"] = _spread(out["capture_time_s"])
    return {name: column for name, column in out.items() if np.isfinite(column).any()}


def _attitude(rows: Sequence[Row]) -> NDArray[np.float64]:
    """Attitude mu as a rotation vector [deg], (3, n)."""
    q = np.stack([numbers(rows, f"mu{a}") for a in "xyzw"], axis=-1)
    known = np.isfinite(q).all(axis=-1)
    out = np.full((len(rows), 3), np.nan)
    out[known] = np.degrees(geometry.log(q[known]))
    return np.ascontiguousarray(out.T)


def _band(out: Columns, name: str, sigma: NDArray[np.float64]) -> None:
    out[f"{name}_lo"], out[f"{name}_hi"] = out[name] - sigma, out[name] + sigma


def _spread(capture_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Smallest and largest of the last ten distinct plans."""
    low, high = np.full_like(capture_s, np.nan), np.full_like(capture_s, np.nan)
    recent: list[float] = []
    for k, value in enumerate(capture_s):
        if np.isfinite(value):
            recent = (
                recent
                if recent and recent[-1] == value
                else [*recent, float(value)][-_SPREAD_PLANS:]
            )
            low[k], high[k] = min(recent), max(recent)
    return low, high


def _line(
    name: str,
    label: str,
    colour: int,
    *,
    dash: bool = False,
    points: bool = False,
    measured: bool = False,
) -> dict[str, Any]:
    """One line of a chart; ``measured``: it is of the measurement alone, so that the axis follows
    the scans that were used, and rejected values beyond it are marked at the edge.
    """
    marks = {"dash": dash, "points": points, "measured": measured}
    return {"column": name, "label": label, "colour": colour, **marks}


def _chart(
    key: str,
    title: str,
    unit: str,
    series: Sequence[dict[str, Any]],
    *,
    bands: Sequence[tuple[str, int]] = (),
    levels: Sequence[tuple[float, str, int]] = (),
    log: bool | None = False,
    sigma: bool = True,
) -> Chart:
    """One chart; ``bands`` are names whose columns end in ``_lo`` and ``_hi`` (1 sigma each if
    ``sigma``).

    The axis is logarithmic if ``log``; if it is None, where the largest value is far above the
    typical one.
    """
    return {
        "key": key,
        "first": key in FIRST,
        "title": title,
        "unit": unit,
        "log": log,
        "series": list(series),
        "bands": [{"stem": stem, "colour": colour, "sigma": sigma} for stem, colour in bands],
        "levels": [{"y": y, "label": label, "colour": colour} for y, label, colour in levels],
    }


def charts(
    columns: Columns,
    truth: State | None = None,
    limits: Mapping[str, float] | None = None,
    used: NDArray[np.bool_] | None = None,
) -> list[Chart]:
    """Return the charts that have data, in reading order.

    Args:
        columns: the columns that ``derived`` returns.
        truth: true parameters, drawn as horizontal lines.
        limits: limits of the fault detector: ``rms_max_m``, ``alpha_max_m`` and ``length_m`` [m].
        used: (n,) whether each scan was used; None if all were.
    """
    whole = [
        *_error_charts(),
        *_measurement_charts(limits or {}),
        *_parameter_charts(truth),
        *_plan_charts(),
    ]
    kept = []
    for chart in whole:
        chart["series"] = distinct(
            [(s, columns[s["column"]]) for s in chart["series"] if s["column"] in columns],
            logarithmic=bool(chart["log"]),
        )
        chart["bands"] = [b for b in chart["bands"] if f"{b['stem']}_lo" in columns]
        if chart["key"] in ("position", "attitude") and not any(
            "_err_" in s["column"] for s in chart["series"]
        ):
            chart["title"] = chart["title"].replace(
                "error", "uncertainty"
            )  # no truth: the predicted 1 sigma alone
        if chart["series"]:
            kept.append(_scaled(chart, columns, used))
    return kept


def distinct(
    lines: Sequence[tuple[dict[str, Any], NDArray[np.float64]]], *, logarithmic: bool
) -> list[dict[str, Any]]:
    """Return the lines that differ from every earlier one; the label of a line names those that
    are equal to it.

    Args:
        lines: each with its values (n,).
        logarithmic: whether the axis is.
    """
    kept: list[tuple[dict[str, Any], NDArray[np.float64]]] = []
    for line, column in lines:
        heights = np.log10(np.where(column > 0.0, column, np.nan)) if logarithmic else column
        equal = next((k for k, (_, other) in enumerate(kept) if _equal(other, heights)), None)
        if equal is None:
            kept.append((line, heights))
        else:
            first, other = kept[equal]
            kept[equal] = ({**first, "label": f"{first['label']} = {line['label']}"}, other)
    return [line for line, _ in kept]


def _equal(first: NDArray[np.float64], second: NDArray[np.float64]) -> bool:
    known = np.isfinite(first)
    if first.shape != second.shape or not known.any() or (known != np.isfinite(second)).any():
        return False
    span = float(np.ptp(first[known]))
    return float(np.abs(first - second)[known].max()) <= SAME_LINE_DIFFERENCE * span


def flight_charts(columns: Columns) -> list[Chart]:
    """The charts of one planned flight that have data.

    Args:
        columns: ``distance_m`` and ``speed_mps`` relative to the grasp point, ``ux_mps2`` to
            ``uz_mps2`` in {A}, and ``margin_NAME_m`` of each constraint.
    """
    margins = [name for name in columns if name.startswith("margin_")]
    lines = [_line(name, name[7:-2], k, dash=k % 2 == 1) for k, name in enumerate(margins)]
    thrust = [_line(f"u{a}_mps2", a, k, dash=k == 1) for k, a in _INDEXED_AXES]
    whole = [
        _chart(
            "distance", "Distance to the grasp point", "m", [_line("distance_m", "distance", 0)]
        ),
        _chart(
            "speed", "Speed relative to the grasp point", "m/s", [_line("speed_mps", "speed", 0)]
        ),
        _chart("thrust", "Acceleration of the robot in {A}", "m/s2", thrust),
        _chart("margin", "Margin of the constraints", "m", lines, levels=[(0.0, "limit", 3)]),
    ]
    return [
        _scaled(chart, columns) | {"first": True}
        for chart in whole
        if any(s["column"] in columns for s in chart["series"])
    ]


def _scaled(chart: Chart, columns: Columns, used: NDArray[np.bool_] | None = None) -> Chart:
    """The chart with its axis; typical values in metres below 1 m are drawn in millimetres,
    as in the tables.
    """
    sizes = [
        np.abs(_on_axis(columns[s["column"]], used if s["measured"] else None))
        for s in chart["series"]
    ]
    typical, largest = float(np.nanmedian(sizes[0])), max(float(np.nanmax(size)) for size in sizes)
    if chart["log"] is None:
        chart = chart | {"log": 0.0 < LOGARITHMIC_RATIO * typical < largest}
    if chart["unit"] != "m" or chart["key"] == "arm" or typical >= 1.0:
        return chart
    levels = [level | {"y": 1000.0 * level["y"]} for level in chart["levels"]]
    return chart | {"unit": "mm", "factor": 1000.0, "levels": levels}


def _on_axis(column: NDArray[np.float64], used: NDArray[np.bool_] | None) -> NDArray[np.float64]:
    """The values that an axis follows: those of used scans, all where none of them has one."""
    if used is None or not np.isfinite(column[used]).any():
        return column
    return column[used]


def _error_charts() -> list[Chart]:
    position = [
        _line("pos_err_m", "estimate", 0),
        _line("reg_pos_err_m", "registration", 1, points=True, measured=True),
        _line("pos_1s_m", "predicted 1 sigma", 2, dash=True),
    ]
    attitude = [
        _line("rot_err_deg", "estimate", 0),
        _line("reg_rot_err_deg", "registration", 1, points=True, measured=True),
        _line("rot_1s_deg", "predicted 1 sigma", 2, dash=True),
    ]
    return [
        _chart("position", "Position error", "m", position, log=True),
        _chart("attitude", "Attitude error", "deg", attitude, log=True),
    ]


def _measurement_charts(limits: Mapping[str, float]) -> list[Chart]:
    rms, alpha, length = (limits.get(name) for name in ("rms_max_m", "alpha_max_m", "length_m"))
    fit = [(rms, "limit", 3)] if rms else []
    jump = [(alpha, "smallest limit", 3)] if alpha else []
    turn = [(float(np.degrees(alpha / length)), "smallest limit", 3)] if alpha and length else []
    nis = [(NIS_BAND[0], "2.5 %", 3), (NIS_BAND[1], "97.5 %", 3)]
    nees = [(NEES_BAND[0], "2.5 %", 3), (NEES_BAND[1], "97.5 %", 3)]
    return [
        _chart(
            "fit",
            "Fit error",
            "m",
            [_line("rms_m", "rms over inliers", 0, measured=True)],
            levels=fit,
            log=None,
        ),
        _chart("inliers", "Inlier ratio", "", [_line("inlier_ratio", "inliers / points", 0)]),
        _chart(
            "nis",
            "Innovation squared (NIS)",
            "",
            [_line("nis", "NIS", 0, points=True, measured=True)],
            levels=nis,
            log=True,
        ),
        _chart(
            "innovation",
            "Position innovation",
            "m",
            [_line("innov_m", "length", 0, measured=True)],
            levels=jump,
            log=True,
        ),
        _chart(
            "turn",
            "Attitude innovation",
            "deg",
            [_line("innov_deg", "angle", 0, measured=True)],
            levels=turn,
            log=True,
        ),
        _chart(
            "nees",
            "Estimation error squared (NEES)",
            "",
            [_line("nees", "NEES", 0)],
            levels=nees,
            log=True,
        ),
    ]


def _parameter_charts(truth: State | None) -> list[Chart]:
    sigma, c, mu = _truths(truth)
    ratios = [_line("sigma1", "sigma1", 0), _line("sigma2", "sigma2", 1, dash=True)]
    arm = [_line(f"c{a}_m", a, k, dash=k == 1) for k, a in enumerate("xyz")]
    turn = [_line(f"mu_{a}_deg", a, k, dash=k == 1) for k, a in enumerate("xyz")]
    rate = [_line(f"w{a}_radps", a, k, dash=k == 1) for k, a in enumerate("xyz")]
    return [
        _chart(
            "sigma",
            "Inertia ratios",
            "",
            ratios,
            bands=[("sigma1", 0), ("sigma2", 1)],
            levels=sigma,
        ),
        _chart(
            "arm",
            "Fixture from the mass centre",
            "m",
            arm,
            bands=[(f"c{a}_m", k) for k, a in _INDEXED_AXES],
            levels=c,
        ),
        _chart(
            "mu",
            "Fixture attitude mu",
            "deg",
            turn,
            bands=[(f"mu_{a}_deg", k) for k, a in _INDEXED_AXES],
            levels=mu,
        ),
        _chart("rate", "Angular rate", "rad/s", rate),
    ]


_INDEXED_AXES = tuple(enumerate("xyz"))


def _truths(truth: State | None) -> list[list[tuple[float, str, int]]]:
    """Levels of sigma, varrho [m] and mu (rotation vector, deg)."""
    if truth is None:
        return [[], [], []]
    mu = np.degrees(geometry.log(truth.q_bc))
    return [
        [(float(v), "truth", k) for k, v in enumerate(vector)]
        for vector in (truth.sigma, truth.c_b, mu)
    ]


def _plan_charts() -> list[Chart]:
    condition = [
        _line("ogm_log10_cond", "raw", 0),
        _line("ogm_log10_cond_scaled", "scaled by the prior", 1, dash=True),
    ]
    return [
        _chart("gramian", "Gramian condition, log10", "", condition),
        _chart("rank", "Gramian rank of 20", "", [_line("ogm_rank", "rank", 0)]),
        _chart(
            "noise",
            "Adapted noise, position",
            "m",
            [_line("r_pos_m", "1 sigma", 0, measured=True)],
            log=None,
        ),
        _chart(
            "noise_turn",
            "Adapted noise, attitude",
            "deg",
            [_line("r_rot_deg", "1 sigma", 0, measured=True)],
            log=None,
        ),
        _chart(
            "capture",
            "Planned capture time",
            "s",
            [
                _line("capture_time_s", "planned", 0),
                _line("earliest_capture_s", "certified lower bound", 1, dash=True),
            ],
            bands=[("capture_time_s", 0)],
            sigma=False,
        ),
        _chart(
            *("miss", "Miss distance in hindsight", "m"),
            [_line("plan_miss_m", "of the plan made then", 1, points=True)],
            log=None,
        ),
    ]


def spans(rows: Sequence[Row], episodes: Sequence[Episode] = ()) -> list[dict[str, Any]]:
    """Return the intervals of the chart of states: of flagged scans by their reason (lane
    "flagged"), of injected faults ("injected") and of actions ("action").

    Args:
        rows: one per scan.
        episodes: the injected faults; of these only the ones without any scan are drawn from here,
            over their window.
    """
    gammas, reasons = column_of(rows, "gamma"), column_of(rows, "reason")
    flagged = [None if gamma == 1 else why for gamma, why in zip(gammas, reasons, strict=True)]
    bare = [_bare(e, rows) for e in episodes if not e.scans and rows]
    actions = _runs(rows, [action or None for action in column_of(rows, "action")], "action")
    found = (
        _runs(rows, flagged, "flagged")
        + _runs(rows, column_of(rows, "fault"), "injected")
        + bare
        + actions
    )
    return [span | _style(span["lane"], span["word"]) for span in found]


def _style(lane: str, word: str) -> dict[str, int]:
    """Colour and pattern of a kind, the same on every page."""
    known = PLACE_STYLES[lane]
    place = known.index(word) if word in known else zlib.crc32(word.encode())
    return {"colour": place % 6, "pattern": (place // 6 + _FIRST_PATTERN[lane]) % 6}


def _bare(episode: Episode, rows: Sequence[Row]) -> dict[str, Any]:
    near = int(np.argmin(np.abs(numbers(rows, "t_s") - episode.start_s)))
    window = {"from": episode.start_s, "to": episode.end_s, "first": near, "last": near}
    return {"lane": "injected", "word": episode.kind, **window}


def _runs(rows: Sequence[Row], words: Sequence[str | None], lane: str) -> list[dict[str, Any]]:
    out: list[dict[str, Any]] = []
    for k, word in enumerate(words):
        if word is None:
            continue
        if k and words[k - 1] == word:
            out[-1]["last"] = k
        else:
            out.append({"lane": lane, "word": word, "first": k, "last": k})
    for span in out:
        span["from"], span["to"] = rows[span["first"]].t_s, rows[span["last"]].t_s
    return out


def most_telling(rows: Sequence[Row], most: int, always: Iterable[int] = ()) -> list[int]:
    """Return the indices of at most about ``most`` rows: the first row of every interval, and the
    rows with the largest errors.

    Args:
        rows: one per scan.
        most: number of rows.
        always: indices that are kept, as are the rows at which gamma, reason, fault or action
            change.
    """
    if len(rows) <= most:
        return list(range(len(rows)))
    turns: set[int] = set()
    for name in ("gamma", "reason", "fault", "action"):
        words = column_of(rows, name)
        turns.update(k for k, (before, now) in enumerate(pairwise(words), 1) if now != before)
    kept = {0, len(rows) - 1, *always, *(turns if len(turns) <= most // 4 else ())}
    step = -(-len(rows) * 5 // (most - len(kept)))
    peaks = [
        np.nan_to_num(numbers(rows, name), nan=-1.0)
        for name in ("pos_err_m", "rot_err_deg", "nis", "rms_m")
    ]
    for begin in range(0, len(rows), step):
        kept |= {begin, *(begin + int(np.argmax(peak[begin : begin + step])) for peak in peaks)}
    return sorted(kept)
