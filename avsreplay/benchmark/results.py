"""The result of a benchmark as one JSON document, its tables, and the comparison of two documents.

Numbers of one document do not depend on the number of workers or on interruptions. On another
processor, counts and figures of ``horn`` and ``reference`` are the same; those of the libraries
agree within AGREE. Times are in a file of their own.
"""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from itertools import groupby
from pathlib import Path
from typing import Any

import avsreplay
from avsreplay.benchmark.scores import ALL, MEASURES, Difference, Estimate, difference, scores
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.report.table import Table, TableCell
from avsreplay.settings import dump

FORMAT = "avsreplay-benchmark/1"
AGREE = 0.01  # largest relative difference of a figure that counts as the same
_LIBRARIES = ("numpy", "scipy", "kiss-icp", "small_gicp", "open3d")
_NOT_COMPARED = ("ms_per_scan",)
_WORDS = {"better": "good", "worse": "bad"}
Record = dict[str, Any]


def document(
    suite: Mapping[str, Any], entries: Sequence[Mapping[str, Any]], runs: Sequence[Record]
) -> Record:
    """Return the result as plain data.

    Args:
        suite: name, hash, seed and repeats.
        entries: name of each row, and why it is missing ("" if it is not).
        runs: scenario, group, repeat, entry, status and scores of every run.
    """
    kept = [{k: v for k, v in run.items() if k not in _NOT_COMPARED} for run in runs]
    return {
        "format": FORMAT,
        "suite": dict(suite),
        "versions": versions(),
        "entries": [dict(entry) for entry in entries],
        "table": table_of(kept),
        "runs": kept,
    }


def versions() -> dict[str, str]:
    """Versions of the package, Python, and the libraries that the entries use."""
    found = {"avsreplay": avsreplay.__version__, "python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def table_of(runs: Sequence[Record]) -> list[Record]:
    """Return the scores of each entry over all runs and over each group.

    Args:
        runs: every run that was made.
    """
    made = [run for run in runs if run["status"] in ("ok", "failed")]
    names = list(dict.fromkeys(run["entry"] for run in made))
    groups = [ALL, *dict.fromkeys(run["group"] for run in made)]
    out = []
    for group in groups:
        for name in names:
            mine = [r for r in made if r["entry"] == name and group in (ALL, r["group"])]
            if mine:
                found = {key: dump(value) for key, value in scores(mine).items()}
                out.append({"group": group, "entry": name, "runs": len(mine), "scores": found})
    return out


def score_table(found: Record, group: str = ALL, times: Mapping[str, float] | None = None) -> Table:
    """Return the table of a group, a row per entry.

    Args:
        found: a document.
        group: name of the group, or "all".
        times: milliseconds per scan by entry, shown in a last column.
    """
    rows: list[tuple[str | TableCell, ...]] = []
    for line in found["table"]:
        if line["group"] == group:
            cells = [_cell(measure.key, line["scores"]) for measure in MEASURES]
            shown = [] if times is None else [f"{times[line['entry']]:.0f}"]
            rows.append((line["entry"], str(line["runs"]), *cells, *shown))
    if group == ALL:
        width = len(MEASURES) + (times is not None)
        rows += [
            (entry["name"], entry["missing"], *("" for _ in range(width)))
            for entry in found["entries"]
            if entry["missing"]
        ]
    heads = ("entry", "runs", *(measure.head for measure in MEASURES))
    last = () if times is None else ("ms\na scan",)
    suite = found["suite"]
    title = f"{suite['name']}, {group}: seed {suite['seed']}, suite {suite['sha256'][:12]}"
    return Table(title, (*heads, *last), tuple(rows), "nr", wide=True)


def _cell(key: str, found: Mapping[str, Any]) -> str | TableCell:
    if key not in found:
        return "-"
    score = Estimate(**found[key])
    measure = next(each for each in MEASURES if each.key == key)
    if score.total is not None:
        runs = round(score.value * score.count)
        text = f"{runs}/{score.count}"
        if key in ("wrong", "wrong_claims"):
            text = f"{text} ({score.total})"
            return TableCell(text, "bad" if runs else "")
    else:
        text = f"{score.value:{measure.digits}}"
    return f"{text} {_interval(score, measure.digits)}".rstrip()


def _interval(score: Estimate, digits: str) -> str:
    if score.low is None or score.high is None:
        return ""
    return f"[{score.low:{digits}}, {score.high:{digits}}]"


def missing_table(found: Record) -> Table:
    """Return the scenarios whose data are not available.

    Args:
        found: a document.
    """
    lost = [run for run in found["runs"] if run["status"] == "not available"]
    rows = tuple(dict.fromkeys((run["scenario"], run["error"]) for run in lost))
    return Table("Scenarios without data", ("scenario", "why"), rows, "nl")


def scenario_table(found: Record, entry: str) -> Table:
    """Return every run of an entry.

    Args:
        found: a document.
        entry: its name.
    """
    names = [m for m in MEASURES if m.key not in ("failed",)]
    rows = []
    for run in found["runs"]:
        if run["entry"] == entry and run["status"] in ("ok", "failed"):
            values = [(m, m.of(run)) for m in names]
            cells = ["-" if v is None else f"{v:{_digits(m.digits, v)}}" for m, v in values]
            rows.append((f"{run['scenario']} {run['repeat']}", *cells))
    heads = ("scenario", *(m.head.removeprefix("runs with a\n") for m in names))
    return Table(f"Runs of {entry}", heads, tuple(rows), "nr", wide=True)


def _digits(digits: str, value: float) -> str:
    return ".0f" if value == int(value) else digits


def write(folder: Path, found: Record, times: Mapping[str, float]) -> None:
    """Write the document, and the times in a file of their own.

    Args:
        folder: where to write ``benchmark.json`` and ``times.json``.
        found: the document.
        times: milliseconds per scan by entry.
    """
    from avsreplay.files import output_text

    for name, content in (("benchmark.json", found), ("times.json", {"ms_per_scan": times})):
        with output_text(folder / name) as stream:
            stream.write(json.dumps(content, indent=1, allow_nan=False) + "\n")


def read(path: Path) -> Record:
    """Return a document.

    Args:
        path: its file.

    Raises:
        UnreadableInput: it is not a result of a benchmark.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UnreadableInput(
            f"cannot be read: {str(error).splitlines()[0]}",
            where=str(path),
            hint="name a benchmark.json",
        ) from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise UnreadableInput(
            f"is not a result in the format {FORMAT}",
            where=str(path),
            hint="name a file that 'avsreplay benchmark' wrote",
        )
    return found


def compared(base: Record, other: Record) -> tuple[list[Difference], tuple[int, int]]:
    """Return the differences of two results, and how many of how many runs agree within AGREE.

    Rows are compared by their names. Where each result has a single row, these two are compared.

    Args:
        base: the baseline.
        other: the other result.

    Raises:
        UsageError: the suites or seeds differ, or no row is in both.
    """
    for key in ("name", "sha256", "seed"):
        if base["suite"][key] != other["suite"][key]:
            what = f"{key} of the suites: {base['suite'][key]} and {other['suite'][key]}"
            raise UsageError(what, where="compare", hint="run both with the same suite and seed")
    ours, theirs = _by_entry(base), _by_entry(other)
    pairs = [(name, name) for name in ours if name in theirs]
    if not pairs and len(ours) == len(theirs) == 1:
        pairs = [(next(iter(ours)), next(iter(theirs)))]
    if not pairs:
        raise UsageError("no entry is in both results", where="compare", hint="see 'entries'")
    found, agreeing, count = [], 0, 0
    for a, b in pairs:
        keys = [key for key in ours[a] if key in theirs[b]]
        left, right = [ours[a][key] for key in keys], [theirs[b][key] for key in keys]
        agreeing += sum(agree(x, y) for x, y in zip(left, right, strict=True))
        count += len(keys)
        name = a if a == b else f"{a} -> {b}"
        listed = (difference(name, measure, left, right) for measure in MEASURES)
        found += [each for each in listed if each is not None]
    return found, (agreeing, count)


def _by_entry(found: Record) -> dict[str, dict[tuple[str, int], Record]]:
    made = [run for run in found["runs"] if run["status"] in ("ok", "failed")]
    ordered = sorted(made, key=lambda run: str(run["entry"]))
    return {
        name: {(run["scenario"], run["repeat"]): run for run in runs}
        for name, runs in groupby(ordered, key=lambda run: str(run["entry"]))
    }


def agree(base: Record, other: Record) -> bool:
    """Return whether all scores of two runs are the same, figures within AGREE.

    Args:
        base: a run.
        other: the same run of another result.
    """
    for measure in MEASURES:
        a, b = measure.of(base), measure.of(other)
        if (a is None) != (b is None):
            return False
        if a is not None and b is not None and not math.isclose(a, b, rel_tol=AGREE, abs_tol=1e-9):
            return False
    return True


def difference_table(found: Sequence[Difference]) -> Table:
    """Return the differences that are not zero.

    Args:
        found: of two results.
    """
    rows = []
    for each in found:
        if each.word != "same":
            digits, low, high = each.measure.digits, each.low, each.high
            span = "" if low is None or high is None else f"{low:{digits}} to {high:{digits}}"
            rows.append(
                (
                    each.entry,
                    each.measure.head.replace("\n", " "),
                    f"{each.base:{digits}}",
                    f"{each.other:{digits}}",
                    span,
                    TableCell(each.word, _WORDS.get(each.word, "")),
                )
            )
    heads = ("entry", "mean of", "first", "second", "95 % of the difference", "second is")
    return Table("Differences", heads, tuple(rows), "nnrrrn", wide=True)
