"""The verdict on a run: PASS, CHECK or FAIL with its reasons, the origin of the first pose, and the
worst moments.

FAIL means that the result must not be used, for example because most scans were not used. CHECK
means that a person should look at the named part. docs/report.md lists the limits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from itertools import chain, compress
from typing import Any

import numpy as np

from avsreplay.assessment import Assessment
from avsreplay.errors import value_class
from avsreplay.outcome import SURE_EVENT_LOG_ODDS
from avsreplay.report.moments import Moment, median_of, plain, worst_moments
from avsreplay.report.pose_checks import error_over_sigma
from avsreplay.report.summary import Summary
from avsreplay.report.summary_parts import (
    SAME_EVENT_S,
    length_text,
    of_driving,
    of_motion,
    of_sensor,
    times,
)
from avsreplay.rows import Row
from avsreplay.tables import chosen, column_of, numbers, used_rows

# Share of the scans without an injected harmful fault that updated the filter.
USED_SHARE_FAIL = 0.5
USED_SHARE_CHECK = 0.9
# a covariance is called too large if NEES is below its band even with 1 sigma divided by this
SAFE_SIGMA = 2.0
LEAST_SHARE_INSIDE = 0.8  # share of NIS or NEES inside the 95 % band
MAX_FALSE_ALARM_SHARE = 0.05  # share of the scans without a fault
# Median position error over the model's extent, all scans.
POSITION_ERROR_FAIL_OF_EXTENT = 0.05
POSITION_ERROR_CHECK_OF_EXTENT = 0.02
# Median attitude error, all scans.
ATTITUDE_ERROR_FAIL_DEG = 15.0
ATTITUDE_ERROR_CHECK_DEG = 5.0
SHORT_LAPSE_S = 2.0  # a single doubtful scan withdraws convergence for less than this
GROWTH_RATIO = 3.0  # of the median errors of the last and the first third of the used scans
GROWTH_SCANS = 30  # fewest scans of a third
# Smallest median of the last third.
LEAST_GROWN_OF_EXTENT = 0.001
LEAST_GROWN_DEG = 0.25
# spread of the errors of the used scans (5 to 95 %) over their median below which they are the same
SAME_ERROR_SPREAD = 0.2
ALIASED_SHARE = 0.1  # share of the scans whose poses two angular rates explain
FIT_CHECK_OF_EXTENT = 0.02  # median rms distance of the inliers over the model's extent


class Grade(Enum):
    """The grades of a verdict, from best to worst."""

    PASS = "PASS"
    CHECK = "CHECK"
    FAIL = "FAIL"


@value_class(eq=True)
class Concern:
    """A reason for a grade below PASS, in a sentence: what, when, and of which size."""

    grade: Grade
    text: str


@value_class(eq=True)
class RunVerdict:
    """The verdict on one run.

    Attributes:
        grade: the worse one of tracking and capture; a capture that is not likely is a CHECK,
            one that is not assessed because nobody gave a grasp point is not.
        tracking: the worst grade of all reasons.
        reasons: the reasons about the tracking, worst first.
        capture: the assessment of the capture; None where there is none.
        first_pose: where the first pose came from.
        task: what is grasped, with the values that were assumed; "" without an assessment.
        robot: the robot that the planner assumed; "" without configuration.
        changed: settings that differ from their defaults, as ``key = value (default ...)``.
        moments: at most five, worst first.
    """

    grade: Grade
    tracking: Grade
    reasons: tuple[Concern, ...]
    capture: Assessment | None
    first_pose: str
    task: str
    robot: str
    changed: tuple[str, ...]
    moments: tuple[Moment, ...]

    @property
    def line(self) -> str:
        """Return the capture, then the tracking with at most three reasons, in one line."""
        if self.capture is None:
            return self._tracking
        return f"{self.capture.sentence}. TRACKING {self._tracking}"

    @property
    def _tracking(self) -> str:
        if not self.reasons:
            none = ": no reason for concern was found" if self.capture is None else ""
            return f"{self.tracking.value}{none}."
        more = len(self.reasons) - 3
        texts = [reason.text for reason in self.reasons[:3]] + (
            [f"{more} more reason{'s' * (more > 1)}"] if more > 0 else []
        )
        return f"{self.tracking.value}: {'; '.join(texts)}."

    def record(self) -> dict[str, Any]:
        """Return the verdict as plain values for JSON."""
        return {
            "grade": self.grade.value,
            "line": self.line,
            "tracking": self.tracking.value,
            "capture": None if self.capture is None else self.capture.record(),
            "reasons": [{"grade": r.grade.value, "text": r.text} for r in self.reasons],
            "first_pose": self.first_pose,
            "task": self.task,
            "robot": self.robot,
            "changed_settings": list(self.changed),
            "worst_moments": [
                {"t_s": m.start_s, "end_s": m.end_s, "what": m.what, "cause": m.cause}
                for m in self.moments
            ],
        }


def verdict_of(
    rows: Sequence[Row], summary: Summary, header: Mapping[str, Any] | None = None
) -> RunVerdict:
    """Return the verdict on a run.

    Args:
        rows: one per scan.
        summary: of the same rows.
        header: ``run.json``; without it the text does not mention the robot and the settings.

    Returns:
        The verdict.
    """
    header = header or {}
    extent_m = (header.get("model") or {}).get("extent_m")
    stopped, checks = header.get("interrupted_after"), header.get("preflight") or ()
    outside = (
        [Concern(Grade.CHECK, f"the replay was interrupted after {stopped} scans")]
        if stopped
        else []
    )
    found = (
        _use(rows, summary),
        (
            (*_errors(rows, extent_m), *_growth(rows, extent_m)) if summary.healthy else ()
        ),  # without a used scan there is no estimate to judge
        _faults(summary, extent_m),
        _motion(rows, summary, header),
        _filter(rows, summary),
        _data(rows, summary, clock_known=any(a["text"].startswith("time stamps") for a in checks)),
    )
    judged = list(chain.from_iterable(found))
    worst = Grade.FAIL if any(reason.grade is Grade.FAIL for reason in judged) else Grade.CHECK
    for advice in checks:
        # a wrong unit or size explains the other reasons, so that it stands before them
        outside.append(Concern(worst if advice["grade"] == "fail" else Grade.CHECK, advice["text"]))
    reasons = sorted((*outside, *judged), key=lambda reason: reason.grade is not Grade.FAIL)
    tracking, capture = reasons[0].grade if reasons else Grade.PASS, summary.assessment
    bad = capture is not None and capture.lowers_grade
    return RunVerdict(
        grade=Grade.CHECK if bad and tracking is Grade.PASS else tracking,
        tracking=tracking,
        reasons=tuple(reasons),
        capture=capture,
        first_pose=first_pose(rows, header),
        task="" if capture is None else capture.task,
        robot=_robot(header),
        changed=tuple(header.get("changed_settings") or ()),
        moments=tuple(worst_moments(rows)),
    )


def _use(rows: Sequence[Row], summary: Summary) -> Iterator[Concern]:
    """Scans that updated the filter; those with a harmful fault are not expected to."""
    common = max(summary.reasons, key=lambda name: summary.reasons[name], default="no scan")
    if not summary.healthy:
        none = (
            "the only scan was not"
            if summary.scans == 1
            else f"none of the {summary.scans} scans was"
        )
        yield Concern(
            Grade.FAIL, f"{none} used ({'' if summary.scans == 1 else 'mostly '}{plain(common)})"
        )
        return
    expected = summary.scans - (summary.faults.harmful_scans if summary.faults.known else 0)
    share = min(summary.healthy / expected, 1.0) if expected else 1.0
    if share < USED_SHARE_CHECK:
        grade = Grade.FAIL if share < USED_SHARE_FAIL else Grade.CHECK
        text = f"only {summary.healthy} of {summary.scans} scans were used (mostly {plain(common)})"
        yield Concern(grade, text)
    last = int(np.flatnonzero(numbers(rows, "gamma") == 1.0).max(initial=0))
    if rows[-1].t_s - rows[last].t_s > 0.1 * (rows[-1].t_s - rows[0].t_s) and len(rows) - last > 3:
        yield Concern(
            Grade.FAIL,
            f"no scan after {rows[last].t_s:.1f} s was used, the estimate is only a prediction",
        )


def _errors(rows: Sequence[Row], extent_m: float | None) -> Iterator[Concern]:
    """Errors over all scans, coasting included, and the fit to the model."""
    position = median_of(numbers(rows, "pos_err_m")) or 0.0
    turn = median_of(numbers(rows, "rot_err_deg")) or 0.0
    share = position / extent_m if extent_m else 0.0
    of_position = _graded(share, POSITION_ERROR_CHECK_OF_EXTENT, POSITION_ERROR_FAIL_OF_EXTENT)
    of_turn = _graded(turn, ATTITUDE_ERROR_CHECK_DEG, ATTITUDE_ERROR_FAIL_DEG)
    grades = [grade for grade in (of_position, of_turn) if grade]
    if grades:
        yield from _frame(rows, extent_m, Grade.FAIL if Grade.FAIL in grades else Grade.CHECK)
    if of_position:
        size = f"{position:.3g} m, {100 * share:.1f} % of the model"
        yield Concern(of_position, f"the median position error of all scans is {size}")
    if of_turn:
        yield Concern(of_turn, f"the median attitude error of all scans is {turn:.3g} deg")
    fit = median_of(numbers(used_rows(rows), "rms_m"))
    if fit is not None and extent_m and fit > FIT_CHECK_OF_EXTENT * extent_m:
        share = 100 * fit / extent_m
        text = (
            f"the scans fit the model badly: median rms {length_text(fit)}, {share:.1f} % of its"
            " extent"
        )
        yield Concern(Grade.CHECK, f"{text}; check unit, scale and model")


def _graded(size: float, check: float, fail: float) -> Grade | None:
    """FAIL or CHECK of a size that exceeds the limit of that grade; None where it exceeds none."""
    if size <= check:
        return None
    return Grade.FAIL if size > fail else Grade.CHECK


def _frame(rows: Sequence[Row], extent_m: float | None, grade: Grade) -> Iterator[Concern]:
    """Large errors that all used scans share: a constant displacement or rotation between two
    frames of the body.

    With T_true = T X and a constant X the distance |R t_X| and the angle of X are the same at every
    attitude. An equivalent pose of a symmetric body has such an X, too. Either of the two may be
    small.
    """
    known = np.isfinite(numbers(rows, "pos_err_m")) & np.isfinite(numbers(rows, "rot_err_deg"))
    used = chosen(rows, known & (numbers(rows, "gamma") == 1.0))
    if len(used) < GROWTH_SCANS:
        return
    same, small = list[bool](), list[bool]()
    for column, limit in (
        ("pos_err_m", POSITION_ERROR_CHECK_OF_EXTENT * (extent_m or 0.0)),
        ("rot_err_deg", ATTITUDE_ERROR_CHECK_DEG),
    ):
        low, middle, high = np.quantile(numbers(used, column), (0.05, 0.5, 0.95))
        same.append(bool(middle > limit and high - low < SAME_ERROR_SPREAD * middle))
        small.append(bool(middle <= limit))
    if any(same) and all(a or b for a, b in zip(same, small, strict=True)):
        text = (
            "the errors are the same in all used scans: the model has another frame than the true"
            " poses"
        )
        yield Concern(grade, f"{text}, or the target is symmetric; move the model into that frame")


def _growth(rows: Sequence[Row], extent_m: float | None) -> Iterator[Concern]:
    """Errors of the used scans that are larger at the end than at the beginning."""
    used = used_rows(rows)
    third = len(used) // 3
    if third < GROWTH_SCANS:
        return
    for column, name, least in (
        ("pos_err_m", "position", LEAST_GROWN_OF_EXTENT * (extent_m or 0.0)),
        ("rot_err_deg", "attitude", LEAST_GROWN_DEG),
    ):
        first, last = (median_of(numbers(part, column)) for part in (used[:third], used[-third:]))
        if first is None or last is None or not least or last < max(GROWTH_RATIO * first, least):
            continue
        sizes = [length_text(v) if column == "pos_err_m" else f"{v:.3g} deg" for v in (first, last)]
        text = (
            f"the {name} error grows: median {sizes[0]} in the first third of the used scans,"
            f" {sizes[1]} in the last"
        )
        yield Concern(Grade.CHECK, text)


def _faults(summary: Summary, extent_m: float | None) -> Iterator[Concern]:
    faults = summary.faults
    used = max((e.peak_used.pos_err_m or 0.0 for e in faults.episodes if e.harmful), default=0.0)
    if extent_m and used > POSITION_ERROR_CHECK_OF_EXTENT * extent_m:
        grade = Grade.FAIL if used > POSITION_ERROR_FAIL_OF_EXTENT * extent_m else Grade.CHECK
        text = (
            f"{faults.missed_scans} of {faults.harmful_scans} scans that faults make unusable"
            " were used"
        )
        yield Concern(grade, f"{text}, with a position error up to {length_text(used)}")
    missed = [e for e in faults.episodes if e.harmful and not e.detected]
    if missed:
        first = f"{plain(missed[0].kind)} at {missed[0].start_s:.1f} s"
        text = (
            f"{len(missed)} of {faults.injected} faults with unusable scans were not detected,"
            f" the first: {first}"
        )
        yield Concern(Grade.FAIL, text)
    lost = next((e for e in faults.episodes if e.lost), None)
    if lost is not None:
        yield Concern(
            Grade.FAIL,
            f"the estimate did not recover from {plain(lost.kind)} at {lost.start_s:.1f} s",
        )
    if faults.known and faults.false_alarm_rate > MAX_FALSE_ALARM_SHARE:
        share = 100 * faults.false_alarm_rate
        yield Concern(
            Grade.CHECK,
            f"{faults.false_alarms} scans without a fault were rejected ({share:.1f} %)",
        )


def _filter(rows: Sequence[Row], summary: Summary) -> Iterator[Concern]:
    """Consistency, changes of the motion and new starts of the estimate, what it determines."""
    yield from _aliases(rows)
    yield from _consistency(rows, summary)
    yield from _new_starts(rows, summary)
    if (used := column_of(used_rows(rows), "free_directions")) and all(used):
        yield Concern(
            Grade.CHECK,
            f"no scan determines all directions of the pose (last scan: the model {used[-1]})",
        )
    if summary.assessment is None:  # else it states whether the estimate suffices
        yield from _convergence(rows, summary)


def _aliases(rows: Sequence[Row]) -> Iterator[Concern]:
    """Two angular rates that explain the poses alike."""
    named = [row for row in rows if row.alias_fast_radps is not None]
    if len(named) > ALIASED_SHARE * len(rows):
        slow, fast = named[-1].alias_slow_radps, named[-1].alias_fast_radps
        yield Concern(
            Grade.CHECK,
            "the target turns too far from scan to scan: rates of"
            f" {slow:.3g} and {fast:.3g} rad/s both explain the poses; more scans a second tell",
        )


def _consistency(rows: Sequence[Row], summary: Summary) -> Iterator[Concern]:
    """Errors and innovations against their covariances."""
    for name, share in (("NEES", summary.nees), ("NIS", summary.nis)):
        if share is None or share.count < 10:
            continue
        # values below the band show a covariance that is larger than the errors, which is safe; a
        # small NIS, a noise that was assumed too large
        above = 1.0 - share.above < LEAST_SHARE_INSIDE
        below = name == "NEES" and SAFE_SIGMA**2 * share.median < share.low
        if above or below:
            low = "too small (overconfident)" if above else "too large (conservative)"
            where = (
                f"the covariance is {low}: " if not share.low <= share.median <= share.high else ""
            )
            yield Concern(
                Grade.CHECK,
                f"{where}only {100 * share.inside:.0f} % of {name} inside the 95 % band,"
                f" {100 * share.above:.0f} % above it",
            )
    if text := error_over_sigma(rows):
        yield Concern(Grade.CHECK, text)
    consistent = zip(column_of(rows, "t_s"), column_of(rows, "consistent"), strict=True)
    if len(inconsistent := [t_s for t_s, flag in consistent if flag is False]) > 0.1 * len(rows):
        begin = inconsistent[0]
        text = (
            f"the innovations are inconsistent in {len(inconsistent)} of {len(rows)} scans, first"
            f" at {begin:.1f} s"
        )
        yield Concern(Grade.CHECK, text)


def _motion(rows: Sequence[Row], summary: Summary, header: Mapping[str, Any]) -> Iterator[Concern]:
    """What moved the target besides its inertia, and the errors of the sensor.

    The events by all poses of the log are final. What the rows state of the motion was known from
    fewer poses: it is a reason of its own only where all poses show no event.
    """
    stated = tuple(of_motion(rows, summary.velocity_changes, summary.drift))
    known = tuple(_sure_events(header))
    for event in known:
        first = event.get("first_known_s")
        since = "no row states it" if first is None else f"in the rows from {first:.1f} s on"
        yield Concern(Grade.CHECK, f"by all poses of the log: {event.get('words', '')} ({since})")
    kinds = {str(event.get("kind")) for event in known}
    rivals = _rivals(header, kinds)
    if known and rivals:
        instead = " or ".join(" and ".join(map(plain, rival)) for rival in rivals)
        best = " and ".join(map(plain, sorted(kinds)))
        yield Concern(Grade.CHECK, f"nearly as likely: {instead} in place of {best}")
    kinds = kinds.union(*rivals)
    if known and (other := _otherwise(known, kinds, summary)):
        yield Concern(Grade.CHECK, f"rows before the cause was known state {other}")
    elif not known:
        yield from (Concern(Grade.CHECK, text) for text in stated)
    for text in (*of_driving(rows), *of_sensor(rows)):
        yield Concern(Grade.CHECK, text)


def _by_all_poses(header: Mapping[str, Any], name: str) -> Sequence[Any]:
    """A list of the record of the smoothing pass; empty where there is none."""
    record = header.get("smoothed")
    found = record.get(name) if isinstance(record, Mapping) else None
    return found if isinstance(found, list) else ()


def _sure_events(header: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    for event in _by_all_poses(header, "events"):
        if isinstance(event, dict) and (event.get("log_odds") or 0.0) >= SURE_EVENT_LOG_ODDS:
            yield event


def _rivals(header: Mapping[str, Any], kinds: set[str]) -> list[list[str]]:
    """Kinds of the sets of events that are nearly as likely as the one stated, without those that
    only add to it.
    """
    return [
        names
        for rival in _by_all_poses(header, "rivals")
        if (rival.get("log_odds") or 0.0) > -SURE_EVENT_LOG_ODDS
        and (names := rival.get("events") or [])
        and not kinds <= set(names)
    ]


def _otherwise(known: Sequence[Mapping[str, Any]], kinds: set[str], summary: Summary) -> str:
    """What rows state of the motion that the events by all poses, and those nearly as likely, do
    not contain, in words.
    """
    onsets = [
        (event.get("onset_s") or 0.0, 3.0 * (event.get("onset_1s_s") or 0.0) + SAME_EVENT_S)
        for event in known
        if event.get("kind") in ("rate_step", "velocity_step")
    ]
    changes = [
        c
        for c in summary.velocity_changes
        if not any(abs(c.t_s - onset) <= away for onset, away in onsets)
    ]
    parts = []
    if changes:
        parts.append(f"a change of the velocity {times(len(changes))}, at {changes[0].t_s:.1f} s")
    if summary.drift is not None and not kinds & {"torque", "force"}:
        parts.append(f"a constant torque or force ({summary.drift})")
    return " and ".join(parts)


def _new_starts(rows: Sequence[Row], summary: Summary) -> Iterator[Concern]:
    """Where the estimate began again, changed its motion, or its pose was searched again."""
    if summary.reinitialised:
        when = next(compress(column_of(rows, "t_s"), column_of(rows, "reinitialised")))
        text = (
            f"the estimate was reinitialised {times(summary.reinitialised)}, first at {when:.1f} s"
        )
        yield Concern(Grade.CHECK, f"{text}, because the poses contradicted it")
    if summary.violations:
        when = next(compress(column_of(rows, "t_s"), column_of(rows, "violations")))
        text = (
            f"the estimate failed {summary.violations} consistency checks, the first at"
            f" {when:.1f} s"
        )
        yield Concern(Grade.CHECK, text)
    searches = [
        t_s
        for t_s, guess, gamma in zip(
            *(column_of(rows, name)[1:] for name in ("t_s", "guess", "gamma")), strict=True
        )
        if guess == "acquired" and gamma == 1
    ]
    if searches and rows[0].gamma == 1:
        text = f"the pose was searched again {times(len(searches))}, first at {searches[0]:.1f} s"
        yield Concern(Grade.CHECK, text)


def _convergence(rows: Sequence[Row], summary: Summary) -> Iterator[Concern]:
    """Whether the estimate converged, and still is."""
    t1 = summary.convergence
    if rows and t1.t1_s is None:
        blocks = (
            f" (not converged: {rows[-1].unconverged_blocks})"
            if rows[-1].unconverged_blocks
            else ""
        )
        yield Concern(
            Grade.CHECK, f"the estimate did not converge, so no capture is planned{blocks}"
        )
    elif (
        rows
        and rows[-1].t_s
        - (held := max(compress(column_of(rows, "t_s"), column_of(rows, "converged"))))
        > SHORT_LAPSE_S
    ):
        yield Concern(
            Grade.CHECK,
            f"convergence, reached at {t1.t1_s:.1f} s, does not hold after {held:.1f} s",
        )


def _data(rows: Sequence[Row], summary: Summary, *, clock_known: bool) -> Iterator[Concern]:
    """Damaged scans, errors of the back end, losses, and clock problems that the checks before the
    run did not name.
    """
    status = np.array(column_of(rows, "status"))
    damaged = chosen(rows, status == "damaged")
    if damaged:
        text = (
            f"{len(damaged)} of {len(rows)} scans cannot be used, the first at"
            f" {damaged[0].t_s:.1f} s"
        )
        yield Concern(Grade.CHECK, f"{text}: {damaged[0].message}" if damaged[0].message else text)
    failed = chosen(rows, status == "failed")
    if failed:
        grade = Grade.FAIL if len(failed) > 0.5 * len(rows) else Grade.CHECK
        yield Concern(
            grade,
            f"{len(failed)} of {len(rows)} registrations failed, the first: {failed[0].message}",
        )
    counted = {
        "losses": "damaged places of the log were left out",
        "stamps_unset": "scans have no time stamp",
        "stamps_back": "time stamps go backwards",
        "stamps_jumped": "time stamps jump",
    }
    for name, text in counted.items():
        if summary.counts.get(name) and not (clock_known and name.startswith("stamps")):
            yield Concern(Grade.CHECK, f"{summary.counts[name]} {text}")


def first_pose(rows: Sequence[Row], header: Mapping[str, Any]) -> str:
    """Return in words where the first pose came from.

    Args:
        rows: the rows of a run.
        header: the record of the run, ``run.json``.
    """
    if not rows:
        return "no scan"
    config = header.get("config") or {}
    mode = (config.get("estimator") or {}).get("start")
    said = {
        "start": "the log's initial state",
        "truth": "the ground truth of the log",
        "given": f"the option --init {config.get('init', '')}".rstrip(),
        "measured": "the first measured pose",
        "acquired": "a global search without any prior knowledge",
    }.get(rows[0].guess, plain(rows[0].guess))
    first = next((row for row in rows if row.gamma), rows[0])
    if first.guess == "acquired" and first.message:
        said += f": {first.message}"
    return said + (f"; initialisation '{mode}'" if mode else "")


def _robot(header: Mapping[str, Any]) -> str:
    """The robot that the planner assumed."""
    plan = (header.get("config") or {}).get("plan") or {}
    if not plan:
        return ""
    if header.get("robot"):
        return str(header["robot"])
    figures = (("a_max", "a_max_mps2", "m/s2"), ("latency", "latency_s", "s"))
    known = [
        (name, plan[key], unit)
        for name, key, unit in figures
        if isinstance(plan.get(key), (int, float))
    ]
    return ", ".join(
        ["default robot", *(f"{name} {value:g} {unit}" for name, value, unit in known)]
    )
