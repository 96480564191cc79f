"""A run in words: one line, or one line a fact."""

from __future__ import annotations

from collections.abc import Mapping

from avsreplay.report.capture import Capture
from avsreplay.report.summary import Summary

__all__ = ["fact_lines", "verdict"]


def verdict(summary: Summary) -> str:
    """Scans used, faults, errors, t_1 and capture, in one sentence each."""
    parts = [f"{summary.healthy} of {summary.scans} scans used", *_fault_words(summary), *_error_words(summary)]
    t1, capture = summary.convergence.t1_s, summary.capture.last_s
    parts.append("not converged" if t1 is None else f"converged at {t1:.1f} s")
    parts.append("no capture planned" if capture is None else f"capture planned at {capture:.2f} s")
    miss = summary.capture.miss
    parts += [] if miss is None else [f"gripper closed {_mm(miss.position_m)} from the true grasp"]
    return "; ".join(parts) + "."


def _fault_words(summary: Summary) -> list[str]:
    faults = summary.faults
    if not faults.known:
        return [f"{faults.false_alarms} flagged"] if faults.false_alarms else []
    return [
        f"{faults.detected} of {faults.injected} harmful faults detected",
        f"{faults.false_alarms} false alarms ({100 * faults.false_alarm_rate:.2f} %)",
    ]


def _error_words(summary: Summary) -> list[str]:
    position, rotation = summary.pose_healthy.position_m, summary.pose_healthy.rotation_deg
    if position is None or rotation is None:
        return ["no truth to compare with"]
    return [f"pose error {1000 * position.rmse:.3g} mm and {rotation.rmse:.3g} deg rms in healthy scans"]


def fact_lines(summary: Summary, *, scans_per_s: float | None = None) -> list[tuple[str, str]]:
    """(name, value) of everything that is one line: scans, faults, filter, plan, counts, speed."""
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
    if summary.recalls is not None:
        taken = f"{summary.weighed_down} healthy scans beyond belief, weighed down"
        facts.append(("outliers", f"{taken}; the poses contradicted filter or start {summary.recalls} times"))
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
    return facts + _flight_facts(capture)


def _flight_facts(capture: Capture) -> list[tuple[str, str]]:
    facts = []
    if capture.hindsight_m is not None:
        found, n = capture.hindsight_m, capture.hindsight_m.count
        facts.append(("hindsight", f"{n} plans miss by {_mm(found.median)} in the median, {_mm(found.max)} at most"))
    if capture.miss is not None:
        speed = "" if capture.miss.speed_mps is None else f", {1000 * capture.miss.speed_mps:.3g} mm/s"
        turn = "" if capture.miss.rotation_deg is None else f", {capture.miss.rotation_deg:.3g} deg"
        facts.append(("gripper", f"closed {_mm(capture.miss.position_m)}{speed}{turn} from the true grasp"))
    if capture.actions:
        facts.append(("robot", ", ".join(f"{action} {count} scans" for action, count in capture.actions.items())))
    return facts


def _mm(metres: float) -> str:
    return f"{1000 * metres:.3g} mm"
