"""The assessment of a capture: whether the robot would have grasped the target, with which
probability, and if not, why.

It is computed once, after the last scan (``assess``), stored in ``run.json``, and printed in the
same words wherever it appears.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum
from typing import Any

from avsreplay.errors import value_class
from avsreplay.outcome import CaptureError

LIKELY_PROBABILITY = 0.9  # least probability of a capture that is called likely
POSSIBLE_PROBABILITY = 0.5  # least probability of a capture that is called possible


class Chance(Enum):
    """How likely a capture is, in one word."""

    LIKELY = "likely"
    POSSIBLE = "possible"
    UNLIKELY = "unlikely"
    NONE = "none"  # the robot does not close its gripper: no plan, no estimate, or an abort
    UNDECIDED = "not yet decided"  # the log ends while the estimate does not suffice for a plan
    NOT_ASSESSED = "not assessed"


@value_class(eq=True)
class InFact:
    """What happened by the true motion of the target.

    Attributes:
        captured: whether the gripper closed within the tolerances and without contact.
        errors: errors at the instant at which it closed; None where it did not close.
        touched: whether the robot touched the body before; None where this was not checked.
        text: the same in words.
    """

    captured: bool
    errors: CaptureError | None
    touched: bool | None
    text: str


@value_class(eq=True, kw_only=True)
class Assessment:
    """Whether a capture would have succeeded.

    Attributes:
        chance: in one word.
        probability: of a capture within the tolerances and without contact.
        probability_95: its 95 % interval.
        basis: how the probability was found, in words.
        at_s: time of the capture after the first scan [s].
        tolerance: the largest errors of a capture.
        miss: 95 % quantiles of the errors; None where the gripper does not close.
        contact: probability of contact with the body outside the grasp; None: not checked.
        limit: what limits the capture, in words.
        known_s: since when it was known that the capture fails [s after the first scan].
        change: what would change the answer, in words.
        task: the task in one line.
        in_fact: what happened; None where the true motion is not known.
        asked: whether a grasp point was given, in place of the assumed one, and plans are made.
    """

    chance: Chance
    probability: float | None = None
    probability_95: tuple[float, float] | None = None
    basis: str = ""
    at_s: float | None = None
    tolerance: CaptureError
    miss: CaptureError | None = None
    contact: float | None = None
    limit: str = ""
    known_s: float | None = None
    change: str = ""
    task: str = ""
    in_fact: InFact | None = None
    asked: bool = True

    @property
    def lowers_grade(self) -> bool:
        """Whether the assessment is a reason for concern beside the tracking.

        A capture that is neither requested nor assessed is none.
        """
        return not self.succeeds and (self.asked or self.chance is not Chance.NOT_ASSESSED)

    @property
    def succeeds(self) -> bool:
        """Whether a capture is likely, and did not fail where the true motion is known."""
        return self.ok and (self.in_fact is None or self.in_fact.captured)

    @property
    def ok(self) -> bool:
        """Whether a capture is likely."""
        return self.chance is Chance.LIKELY

    @property
    def sentence(self) -> str:
        """The assessment in one line, without a full stop."""
        if self.chance is Chance.NOT_ASSESSED:
            advice = f"; {self.change}" if self.change else ""
            return f"CAPTURE not assessed: {self.limit}{advice}"
        if self.chance in (Chance.NONE, Chance.UNDECIDED):
            since = "" if self.known_s is None else f", known at {self.known_s:.1f} s"
            word = "no" if self.chance is Chance.NONE else self.chance.value
            parts = [f"CAPTURE {word}: {self.limit}{since}", self._contact if self.contact else ""]
        else:
            parts = [self._head, self._contact, f"limited by {self.limit}" if self.limit else ""]
        if not self.ok and self.change:
            parts.append(self.change)
        if self.in_fact is not None:
            parts.append(f"in fact {self.in_fact.text}")
        return "; ".join(part for part in parts if part)

    @property
    def _head(self) -> str:
        low, high = self.probability_95 or (math.nan, math.nan)
        t = self.tolerance
        when = "" if self.at_s is None else f" at {self.at_s:.1f} s"
        return (
            f"CAPTURE {self.chance.value}: {self.probability:.2f} ({low:.2f} to {high:.2f}) within"
            f" {_millimetres(t.distance_m)} and {t.angle_deg:.3g} deg{when}"
        )

    @property
    def _contact(self) -> str:
        if self.contact is None:
            return "contact not checked"
        return "no contact" if self.contact == 0.0 else f"contact {self.contact:.2f}"

    def described(self) -> list[tuple[str, str]]:
        """Return the figures as names and texts."""
        out = [("task", self.task), ("basis", self.basis)]
        if self.miss is not None:
            t, m = self.tolerance, self.miss
            out.append(
                (
                    "miss",
                    (
                        f"95 % of the errors are below {_millimetres(m.distance_m)} of"
                        f" {_millimetres(t.distance_m)}, {1e3 * m.speed_mps:.3g} of"
                        f" {1e3 * t.speed_mps:.3g} mm/s, {m.angle_deg:.3g} of"
                        f" {t.angle_deg:.3g} deg"
                    ),
                )
            )
        known = "" if self.known_s is None else f", known at {self.known_s:.1f} s"
        out += [("contact", self._contact), ("limit", f"{self.limit}{known}" if self.limit else "")]
        out.append(("would change it", self.change))
        out.append(("in fact", "" if self.in_fact is None else self.in_fact.text))
        return [(name, text) for name, text in out if text]

    def record(self) -> dict[str, Any]:
        """Return the assessment as plain values for JSON; a number that is not known is None."""
        own = {
            name: getattr(self, name)
            for name in ("probability", "basis", "at_s", "contact", "limit", "known_s", "change")
        }
        interval = None if self.probability_95 is None else list(self.probability_95)
        fact = self.in_fact
        return {
            "chance": self.chance.value,
            "sentence": f"{self.sentence}.",
            **own,
            "probability_95": interval,
            "tolerance": _errors_record(self.tolerance),
            "miss": _errors_record(self.miss),
            "task": self.task,
            "asked": self.asked,
            "in_fact": None
            if fact is None
            else {
                "captured": fact.captured,
                "errors": _errors_record(fact.errors),
                "touched": fact.touched,
                "text": fact.text,
            },
        }

    @classmethod
    def of_record(cls, record: Mapping[str, Any] | None) -> Assessment | None:
        """Return the assessment of its record; None where there is none.

        Args:
            record: as ``record`` makes it, read from a file.

        Raises:
            ValueError, KeyError, TypeError: the record has another form.
        """
        if record is None:
            return None
        fact, interval = record["in_fact"], record["probability_95"]
        more: dict[str, Any] = {
            name: None if record[name] is None else float(record[name])
            for name in ("probability", "at_s", "contact", "known_s")
        }
        more |= {name: str(record[name]) for name in ("basis", "limit", "change", "task")}
        tolerance = _errors_of(record["tolerance"])
        assert tolerance is not None
        return cls(
            chance=Chance(record["chance"]),
            probability_95=None if interval is None else (float(interval[0]), float(interval[1])),
            tolerance=tolerance,
            miss=_errors_of(record["miss"]),
            asked=bool(record.get("asked", True)),
            in_fact=None
            if fact is None
            else InFact(
                bool(fact["captured"]),
                _errors_of(fact["errors"]),
                None if fact["touched"] is None else bool(fact["touched"]),
                str(fact["text"]),
            ),
            **more,
        )


def chance_of(probability: float) -> Chance:
    """Return how likely a capture is, in one word, from its probability."""
    if probability >= LIKELY_PROBABILITY:
        return Chance.LIKELY
    return Chance.POSSIBLE if probability >= POSSIBLE_PROBABILITY else Chance.UNLIKELY


def errors_text(errors: CaptureError) -> str:
    """Return the errors of a gripper in words.

    Args:
        errors: at the instant at which it closed.
    """
    angle = "" if math.isnan(errors.angle_deg) else f", {errors.angle_deg:.2g} deg"
    return f"{_millimetres(errors.distance_m)}, {1e3 * errors.speed_mps:.2g} mm/s{angle}"


def _millimetres(metres: float) -> str:
    return f"{metres:.3g} m" if metres >= 1.0 else f"{1e3 * metres:.3g} mm"


def _errors_record(errors: CaptureError | None) -> dict[str, float | None] | None:
    if errors is None:
        return None
    values = {
        "distance_m": errors.distance_m,
        "speed_mps": errors.speed_mps,
        "angle_deg": errors.angle_deg,
    }
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def _errors_of(record: Mapping[str, Any] | None) -> CaptureError | None:
    if record is None:
        return None
    names = ("distance_m", "speed_mps", "angle_deg")
    values = (math.nan if record[name] is None else float(record[name]) for name in names)
    return CaptureError(*values)
