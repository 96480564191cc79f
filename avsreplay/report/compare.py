"""The metrics by which runs are compared and gated, and the settings in which they differ."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from avsreplay.assessment import Assessment
from avsreplay.errors import value_class
from avsreplay.report.summary import Errors, Summary
from avsreplay.report.summary_parts import Statistics
from avsreplay.report.table import Table, number
from avsreplay.settings import dump, entries, value_of


@value_class(eq=True)
class Metric:
    """One metric of a run.

    Attributes:
        name: its name, which ends with its unit.
        unit: its unit, "" without one.
        meaning: what it measures, in words.
        get: returns it from a summary; None where the run has no value.
    """

    name: str
    unit: str
    doc: str
    of: Callable[[Summary], float | None]


def _spread(
    pick: Callable[[Summary], Statistics | None], figure: str
) -> Callable[[Summary], float | None]:
    def get(summary: Summary) -> float | None:
        spread = pick(summary)
        return None if spread is None else float(getattr(spread, figure))

    return get


def _errors(prefix: str, words: str, pick: Callable[[Summary], Errors]) -> list[Metric]:
    out = []
    for figure in ("rmse", "median", "max"):
        position = _spread(lambda s: pick(s).position_m, figure)
        rotation = _spread(lambda s: pick(s).rotation_deg, figure)
        out.append(
            Metric(f"{prefix}_pos_{figure}_m", "m", f"{figure} position error, {words}", position)
        )
        out.append(
            Metric(
                f"{prefix}_rot_{figure}_deg", "deg", f"{figure} attitude error, {words}", rotation
            )
        )
    return out


def _coast(field: str) -> Callable[[Summary], float | None]:
    def get(summary: Summary) -> float | None:
        coast = summary.longest_coast
        return None if coast is None else getattr(coast, field)

    return get


def _parameter(name: str) -> Callable[[Summary], float | None]:
    def get(summary: Summary) -> float | None:
        return next((p.error for p in summary.parameters if p.name == name), None)

    return get


def _miss(field: str) -> Callable[[Summary], float | None]:
    def get(summary: Summary) -> float | None:
        return None if summary.capture.miss is None else getattr(summary.capture.miss, field)

    return get


def _known(pick: Callable[[Summary], float]) -> Callable[[Summary], float | None]:
    """A metric of the injected faults, None where the log does not state them."""

    def get(summary: Summary) -> float | None:
        return pick(summary) if summary.faults.known else None

    return get


def _assessed(pick: Callable[[Assessment], float | None]) -> Callable[[Summary], float | None]:
    def get(summary: Summary) -> float | None:
        return None if summary.assessment is None else pick(summary.assessment)

    return get


METRICS: tuple[Metric, ...] = (
    Metric("scans", "", "scans replayed", lambda s: s.scans),
    Metric("healthy", "", "scans used by the filter", lambda s: s.healthy),
    Metric(
        "healthy_ratio",
        "",
        "scans used over scans replayed",
        lambda s: s.healthy / s.scans if s.scans else None,
    ),
    *_errors("all", "all scans, coasting included", lambda s: s.pose_all),
    *_errors("pose", "healthy scans", lambda s: s.pose_healthy),
    *_errors("coast", "coasting scans", lambda s: s.pose_coasting),
    *_errors("reg", "of the registration, healthy scans", lambda s: s.registration_healthy),
    Metric(
        "coast_end_pos_m",
        "m",
        "position error at the end of the longest coast",
        _coast("pos_err_m"),
    ),
    Metric(
        "coast_end_rot_deg",
        "deg",
        "attitude error at the end of the longest coast",
        _coast("rot_err_deg"),
    ),
    Metric(
        "fit_median_m",
        "m",
        "median fit error, healthy scans",
        _spread(lambda s: s.fit_error_m, "median"),
    ),
    Metric(
        "iterations_median",
        "",
        "median iterations of the registration",
        _spread(lambda s: s.iterations, "median"),
    ),
    Metric(
        "faults_missed",
        "",
        "faults with unusable scans that were not detected",
        _known(lambda s: s.faults.missed),
    ),
    Metric("scans_missed", "", "unusable scans used", _known(lambda s: s.faults.missed_scans)),
    Metric(
        "false_alarms", "", "flagged scans without a fault", _known(lambda s: s.faults.false_alarms)
    ),
    Metric(
        "false_alarm_rate",
        "",
        "of scans without a fault",
        _known(lambda s: s.faults.false_alarm_rate),
    ),
    Metric("recovery_s", "s", "longest time to recover", lambda s: s.faults.longest_recovery_s),
    Metric("sigma1_err", "", "error of sigma1 at the last scan", _parameter("sigma1")),
    Metric("sigma2_err", "", "error of sigma2 at the last scan", _parameter("sigma2")),
    Metric("c_err_m", "m", "error of varrho (c) at the last scan", _parameter("c (varrho)")),
    Metric("mu_err_deg", "deg", "error of mu at the last scan", _parameter("mu")),
    Metric("sigma_hits", "", "times a bound on sigma was active", lambda s: s.sigma_hits),
    Metric(
        "weighed_down", "", "healthy poses with a Cauchy weight below 1", lambda s: s.weighed_down
    ),
    Metric("reinitialised", "", "times the estimate was reinitialised", lambda s: s.reinitialised),
    Metric(
        "nis_median", "", "median NIS (5.35 expected)", lambda s: s.nis.median if s.nis else None
    ),
    Metric(
        "nis_inside",
        "",
        "share of NIS inside its 95 % band",
        lambda s: s.nis.inside if s.nis else None,
    ),
    Metric(
        "nees_median",
        "",
        "median NEES (19.34 expected)",
        lambda s: s.nees.median if s.nees else None,
    ),
    Metric(
        "nees_inside",
        "",
        "share of NEES inside its 95 % band",
        lambda s: s.nees.inside if s.nees else None,
    ),
    Metric(
        "ogm_log10_cond",
        "",
        "log10 condition of the Gramian, at the end",
        lambda s: s.observability.log10_cond,
    ),
    Metric("ogm_rank", "", "rank of the Gramian, at the end", lambda s: s.observability.rank),
    Metric(
        "t1_s",
        "s",
        "convergence time: first scan whose estimate the planner may use",
        lambda s: s.convergence.t1_s,
    ),
    Metric("withdrawn", "", "times convergence was withdrawn", lambda s: s.convergence.withdrawn),
    Metric("capture_s", "s", "planned instant of capture, last plan", lambda s: s.capture.last_s),
    Metric(
        "capture_std_s",
        "s",
        "standard deviation of the planned instant over the replans",
        lambda s: s.capture.std_s,
    ),
    Metric(
        "plan_miss_median_m",
        "m",
        "median distance between planned and true grasp point",
        _spread(lambda s: s.capture.plan_miss_m, "median"),
    ),
    Metric(
        "plan_miss_max_m",
        "m",
        "largest distance between planned and true grasp point",
        _spread(lambda s: s.capture.plan_miss_m, "max"),
    ),
    Metric("capture_miss_m", "m", "true distance when the gripper closed", _miss("position_m")),
    Metric(
        "capture_miss_mps", "m/s", "true relative speed when the gripper closed", _miss("speed_mps")
    ),
    Metric(
        "capture_miss_deg", "deg", "attitude error when the gripper closed", _miss("rotation_deg")
    ),
    Metric(
        "capture_probability",
        "",
        "of a capture within the tolerances and without contact",
        _assessed(lambda a: a.probability),
    ),
    Metric(
        "capture_contact",
        "",
        "probability of contact with the body outside the grasp",
        _assessed(lambda a: a.contact),
    ),
    Metric(
        "captured",
        "",
        "1 where the gripper in fact captured, 0 where it did not",
        _assessed(lambda a: None if a.in_fact is None else float(a.in_fact.captured)),
    ),
    Metric("gaps", "", "intervals longer than 1.5 times the median", lambda s: s.gaps),
    Metric("losses", "", "damaged places in the log", lambda s: s.counts.get("losses")),
)


def metrics(summary: Summary) -> dict[str, float | None]:
    """Return the value of every metric by name, None where the run has no value.

    Args:
        summary: the summary of a run.
    """
    return {m.name: _finite(m.of(summary)) for m in METRICS}


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value


def flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a nested table of settings as one table with dotted keys.

    Args:
        table: the nested table.
        prefix: what stands before every key.
    """
    out: dict[str, Any] = {}
    for key, value in table.items():
        out |= (
            flat(value, f"{prefix}{key}.")
            if isinstance(value, Mapping)
            else {f"{prefix}{key}": value}
        )
    return out


def changed_settings(*tables: Any, stated: Collection[str] | None = None) -> list[str]:
    """Return the settings that differ from their defaults, each as ``key = value (default ...)``.

    Args:
        tables: dataclasses of settings, such as the configuration of a run and the options for
            reading its log.
        stated: those that the user has given, as this function returns them; every other one is
            marked as given by the log. None marks none.
    """
    found = []
    for table in tables:
        for entry in entries(type(table)):
            value, default = dump(value_of(table, entry.key)), dump(entry.default)
            if value != default:
                unset = entry.declared.automatic or "off"
                text = f"{entry.key} = {_value(value, unset)} (default {_value(default, unset)}"
                of_log = stated is not None and f"{text})" not in stated
                found.append(f"{text}; by the log)" if of_log else f"{text})")
    return found


def different_logs(base: Mapping[str, Any], other: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return the names of the logs of two runs, with the first digits of their SHA-256 if the names
    are equal.

    Args:
        base: ``run.json`` of the baseline.
        other: of the run that is compared with it.

    Returns:
        The names; None if the logs are the same, or one of the two does not state its log.
    """
    logs = [header.get("log") or {} for header in (base, other)]
    sums = [log.get("sha256") for log in logs]
    if sums[0] == sums[1] or not all(sums):
        return None
    return _names(logs[0], logs[1])


def _names(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[str, str]:
    """Names of two different files; of equal names the first digits of the SHA-256
    distinguish them.
    """
    names = [str(given.get("name", "unknown")) for given in (first, second)]
    if names[0] == names[1]:
        names = [f"{names[0]} {str(given.get('sha256'))[:8]}" for given in (first, second)]
    return names[0], names[1]


def different_inputs(base: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Log, model, reading options and settings that differ, each as ``key = value (baseline ...)``.

    Args:
        base: ``run.json`` of the baseline; what one of the two does not state is not compared.
        other: of the run that is compared with it.
    """
    found = []
    for part in ("log", "model"):
        ours, theirs = (header.get(part) or {} for header in (other, base))
        if ours.get("sha256") != theirs.get("sha256"):
            names = _names(ours, theirs)
            found.append(f"{part} = {names[0]} (baseline {names[1]})")
    for part in ("selection", "config"):
        ours, theirs = (header.get(part) for header in (other, base))
        if ours and theirs:
            ours, theirs = flat(ours), flat(theirs)
            keys = [
                key for key in dict.fromkeys((*ours, *theirs)) if ours.get(key) != theirs.get(key)
            ]
            keys = [key for key in keys if key != "model"]  # compared above, by its content
            found += [
                f"{key} = {_value(ours.get(key))} (baseline {_value(theirs.get(key))})"
                for key in keys
            ]
    return found


def _value(value: Any, unset: str = "not set") -> str:
    return unset if value is None else json.dumps(value)


def metrics_table(name: str, figures: Sequence[tuple[str, float | None]]) -> Table:
    """Return the table of the metrics of a single run.

    Args:
        name: name of the run.
        figures: name and value of each metric.
    """
    meaning = {m.name: m.doc for m in METRICS}
    rows = tuple(
        (metric, meaning[metric], number(value)) for metric, value in figures if value is not None
    )
    return Table(name, ("metric", "meaning", "value"), rows, align="llr")
