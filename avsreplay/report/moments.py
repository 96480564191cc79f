"""The worst moments of a run with their cause: intervals without a used scan, and scans whose error
or NIS is far above the median.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.report.summary import NIS_LIMIT
from avsreplay.report.summary_parts import length_text
from avsreplay.rows import Row
from avsreplay.tables import column_of, numbers

MAX_MOMENTS = 5


@value_class(eq=True)
class Moment:
    """An interval with a large error or without a used scan.

    Attributes:
        row: index of its worst row.
        start_s, end_s: its begin and end, in seconds since the first scan.
        what: what happened, its size, and the usual size.
        cause: its cause as far as the rows show it.
    """

    row: int
    start_s: float
    end_s: float
    what: str
    cause: str


def worst_moments(rows: Sequence[Row]) -> list[Moment]:
    """Return the five worst intervals, which do not overlap: those without a used scan, and those
    whose error or NIS is far above the median.

    Args:
        rows: the rows of a run.
    """
    kept: list[Moment] = []
    for _, moment in sorted(_moments(rows), key=lambda item: -item[0]):
        if len(kept) == MAX_MOMENTS:
            break
        if all(moment.end_s < other.start_s or other.end_s < moment.start_s for other in kept):
            kept.append(moment)
    return kept


def _moments(rows: Sequence[Row]) -> Iterator[tuple[float, Moment]]:
    """Candidates with a weight: flagged intervals and single scans whose error or NIS stands
    out.
    """
    gammas, errors = column_of(rows, "gamma"), np.nan_to_num(numbers(rows, "pos_err_m"))
    for flagged, group in groupby(range(len(rows)), key=lambda k: gammas[k] == 0):
        places = list(group)
        if flagged:
            yield _flagged_moment(rows, gammas, places, errors)
    used = np.array(gammas) != 0  # the others belong to their interval
    for column, name in (("pos_err_m", "position error"), ("rot_err_deg", "attitude error")):
        typical = median_of(figures := numbers(rows, column))
        for value, k in _largest(figures, used):
            if typical and value > 3.0 * typical:
                size = length_text(value) if column == "pos_err_m" else f"{value:.3g} deg"
                text = f"{name} {size}, {value / typical:.0f} times the median"
                yield (
                    value / typical,
                    Moment(k, rows[k].t_s, rows[k].t_s, text, _cause(rows, gammas, k)),
                )
    for value, k in _largest(numbers(rows, "nis"), used):
        if value > NIS_LIMIT:
            text = f"NIS {value:.3g}, above its 99.99 % point {NIS_LIMIT:.1f}"
            yield (
                3.0 * value / NIS_LIMIT,
                Moment(k, rows[k].t_s, rows[k].t_s, text, _cause(rows, gammas, k)),
            )


def _largest(figures: Array, used: NDArray[np.bool_]) -> list[tuple[float, int]]:
    places = np.flatnonzero(used & np.isfinite(figures))
    chosen = places[np.argsort(figures[places], kind="stable")[: -MAX_MOMENTS - 1 : -1]]
    return list(zip(figures[chosen].tolist(), chosen.tolist(), strict=True))


def _flagged_moment(
    rows: Sequence[Row], gammas: Sequence[int], places: Sequence[int], errors: Array
) -> tuple[float, Moment]:
    """The moment of scans that were not used one after the other."""
    worst = places[int(np.argmax(errors[places[0] : places[-1] + 1]))]
    largest = rows[worst].pos_err_m
    error = "" if largest is None else f", position error up to {length_text(largest)}"
    count = "1 scan" if len(places) == 1 else f"{len(places)} scans"
    span = rows[places[0]].t_s, rows[places[-1]].t_s
    return 3.0 * len(places), Moment(
        worst, *span, f"{count} not used{error}", _cause(rows, gammas, places[0], places[-1])
    )


def _cause(rows: Sequence[Row], gammas: Sequence[int], k: int, last: int | None = None) -> str:
    """The cause, by the rows, of a moment that begins at row k and ends at row ``last``, or
    at k.
    """
    row, end = rows[k], rows[k if last is None else last]
    before = next((rows[j] for j in range(k - 1, -1, -1) if gammas[j] != 0), None)
    if row.fault:
        return f"injected: {plain(row.fault)}"
    manoeuvre = _manoeuvre(before, end)
    if row.gamma == 0:
        return f"rejected: {plain(row.reason)}" + (f"; {manoeuvre}" if manoeuvre else "")
    if manoeuvre:
        return manoeuvre
    return _cause_in_estimate(rows, gammas, k, before)


def _manoeuvre(before: Row | None, end: Row) -> str:
    """The manoeuvre that was found between two rows, in words; "" without one."""
    if before is None or (end.manoeuvres or 0) <= (before.manoeuvres or 0):
        return ""
    when = "" if end.manoeuvre_s is None else f" at {end.manoeuvre_s:.1f} s"
    return f"manoeuvre of the target{when}"


def _cause_in_estimate(
    rows: Sequence[Row], gammas: Sequence[int], k: int, before: Row | None
) -> str:
    """Why the estimate of a used scan has a large error; ``before`` is the last used row."""
    row = rows[k]
    if before is not None and (row.reinitialised or 0) > (before.reinitialised or 0):
        return "the estimate was reinitialised"
    if k and gammas[k - 1] == 0:
        return "first used scan after rejected scans"
    if row.guess == "acquired":
        return "pose found by a search"
    if not row.converged:
        return "the estimate is not converged"
    return f"undetermined: {row.free_directions}" if row.free_directions else "none known"


def plain(name: str) -> str:
    """Return a status or reason in words.

    Args:
        name: a value of the columns ``status`` or ``reason``.
    """
    return "no usable points" if name == "no_scan" else name.replace("_", " ")


def median_of(figures: Array) -> float | None:
    """Return the median of the finite figures, None if there is none."""
    return (
        float(known[len(known) // 2])
        if len(known := np.sort(figures[np.isfinite(figures)]))
        else None
    )
