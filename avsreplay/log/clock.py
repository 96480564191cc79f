"""The time of each scan: the stamp in its header, checked against the clock of the recorder.

Scans are ordered by log time, then by file order. The rules for ``ClockChoice.HEADER``:

1. If no header stamp is set, all times are taken from the log clock. 2. The offset (header minus
log clock) starts as the median of the first nine scans and follows each deviation by one
   tenth, so that clocks that differ by months or drift are handled.
3. A stamp that deviates from log time + offset by more than max(0.5 s, 5 periods) is a jump. If
   instead the log clock has stepped (its interval differs more from the period than the header's),
   the offset is corrected by the step and the stamp is used.
4. A jump, an unset stamp (0), or a stamp not after the previous one gives ``ScanStatus.CLOCK`` and
   the time log + offset.
5. Three consecutive jumps to the same new offset are a permanent step of the header clock: from the
   third on, the stamps minus the step are used, so that ``t_ns`` is continuous.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from avsreplay.errors import value_class
from avsreplay.log.options import ClockChoice, ClockSummary

_LEAST_JUMP_NS = 500_000_000  # a smaller deviation from the log clock is never a jump [ns]
_JUMP_PERIODS = 5  # least jump, in periods of the scans
_OFFSET_SCANS = 9  # first scans whose median deviation is the offset of the clocks at the begin
_STEP_SCANS = 3  # scans in a row with the same jump that make it a permanent step of the clock
_FOLLOWED_SHARE = 0.1  # share of a deviation by which the offset follows it from scan to scan


@value_class(eq=True)
class Placed:
    """A time on the chosen clock, and the reason if it is not the stamp of the scan."""

    t_ns: int
    note: str | None = None


def place(
    log_ns: Sequence[int], publish_ns: Sequence[int], header_ns: Sequence[int], choice: ClockChoice
) -> tuple[list[Placed], ClockSummary]:
    """Return the times of all scans, given in the order of the recorder, and a summary of the
    corrections.
    """
    period = (
        int(statistics.median(np.diff(log_ns).tolist())) if len(log_ns) > 1 else 0
    )  # np.median loads numpy.ma
    offsets = [h - r for h, r in zip(header_ns, log_ns, strict=True)]
    summary = ClockSummary(choice.value, len(log_ns), _median(offsets) * 1e-9, period * 1e-9)
    if choice is not ClockChoice.HEADER:
        return _monotone(log_ns if choice is ClockChoice.LOG else publish_ns, summary)
    if len(log_ns) and not any(header_ns) and any(log_ns):
        placed, summary = _monotone(
            log_ns, replace(summary, clock=ClockChoice.LOG.value, offset_s=0.0)
        )
        return placed, replace(
            summary, unset=0, note="header stamps are never set: the log clock is used"
        )
    tracker = _Tracker(
        max(_LEAST_JUMP_NS, _JUMP_PERIODS * period), period, _first_offset(offsets, header_ns)
    )
    placed = [tracker.take(r, h) for r, h in zip(log_ns, header_ns, strict=True)]
    return placed, tracker.summary(summary)


def _median(values: Sequence[int]) -> int:
    return sorted(values)[len(values) // 2] if values else 0


def _first_offset(offsets: Sequence[int], header_ns: Sequence[int]) -> int:
    set_ones = [o for o, h in zip(offsets, header_ns, strict=True) if h != 0]
    return _median((set_ones or list(offsets))[:_OFFSET_SCANS])


def _monotone(instants: Sequence[int], summary: ClockSummary) -> tuple[list[Placed], ClockSummary]:
    """Use a clock unchanged; a time that is not after the previous one is set one nanosecond
    after it.
    """
    placed, last = list[Placed](), None
    equal = back = 0
    for instant in instants:
        if last is None or instant > last:
            placed.append(Placed(instant))
        else:
            equal, back = equal + (instant == last), back + (instant < last)
            placed.append(Placed(last + 1, "the clock does not move forward"))
        last = placed[-1].t_ns
    return placed, replace(summary, equal=equal, back=back)


class _Tracker:
    """The running offset between the two clocks."""

    def __init__(self, tolerance: int, period: int, offset: int) -> None:
        self._tolerance, self._period, self._offset = tolerance, period, offset
        self._correction = 0  # sum of the permanent steps of the header clock, subtracted from t_ns
        self._last: tuple[int, int] | None = (
            None  # log and header time of the last scan whose stamp was used
        )
        self._last_t: int | None = None
        self._jumped: list[tuple[int, int]] = []  # deviation and header time of consecutive jumps
        self.counts = {
            "unset": 0,
            "jumps": 0,
            "equal": 0,
            "back": 0,
            "header_steps": 0,
            "log_steps": 0,
        }

    def take(self, log_ns: int, header_ns: int) -> Placed:
        """Return the time of the next scan."""
        deviation = header_ns - log_ns - self._offset
        if abs(deviation) > self._tolerance and header_ns != 0:
            if self._log_stepped(log_ns, header_ns):
                self._offset += deviation
                self.counts["log_steps"] += 1
                deviation = 0
            elif self._permanent(deviation, header_ns):
                self._correction += deviation
                self._offset += deviation
                self.counts["header_steps"] += 1
                deviation = 0
        trouble = self._trouble(deviation, header_ns)
        if trouble is not None:
            return self._by_log(log_ns, deviation, trouble)
        self._jumped.clear()
        self._offset += round(_FOLLOWED_SHARE * deviation)
        self._last, self._last_t = (log_ns, header_ns), header_ns - self._correction
        return Placed(self._last_t)

    def summary(self, summary: ClockSummary) -> ClockSummary:
        """Return the summary with the counts."""
        c = self.counts
        return replace(
            summary,
            unset=c["unset"],
            jumps=c["jumps"],
            equal=c["equal"],
            back=c["back"],
            header_steps=c["header_steps"],
            log_steps=c["log_steps"],
        )

    def _trouble(self, deviation: int, header_ns: int) -> str | None:
        if abs(deviation) > self._tolerance:
            return "unset" if header_ns == 0 else "jumps"
        t_ns = header_ns - self._correction
        if self._last_t is None or t_ns > self._last_t:
            return None
        return "equal" if t_ns == self._last_t else "back"

    def _by_log(self, log_ns: int, deviation: int, trouble: str) -> Placed:
        self.counts[trouble] += 1
        t_ns = log_ns + self._offset - self._correction
        if self._last_t is not None:
            t_ns = max(t_ns, self._last_t + 1)
        self._last_t = t_ns
        return Placed(t_ns, _NOTES[trouble].format(deviation * 1e-9))

    def _log_stepped(self, log_ns: int, header_ns: int) -> bool:
        """Return whether the log clock stepped: the interval of the header is closer to the
        period.
        """
        if self._last is None or self._jumped:
            return False
        log_step, header_step = log_ns - self._last[0], header_ns - self._last[1]
        return header_step > 0 and abs(header_step - self._period) < abs(log_step - self._period)

    def _permanent(self, deviation: int, header_ns: int) -> bool:
        if self._jumped:
            first, last = self._jumped[0][0], self._jumped[-1][1]
            if header_ns <= last or abs(deviation - first) > self._tolerance // _JUMP_PERIODS:
                self._jumped.clear()
        self._jumped.append((deviation, header_ns))
        if len(self._jumped) < _STEP_SCANS:
            return False
        self._jumped.clear()
        return True


_NOTES = {
    "unset": "header stamp unset: placed by the log clock",
    "jumps": "header stamp off by {:.3f} s: placed by the log clock",
    "equal": "header stamp equal to the one before: placed by the log clock",
    "back": "header stamp before the one before: placed by the log clock",
}
