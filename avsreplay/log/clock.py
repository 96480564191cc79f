"""When each scan was: the header's stamp, judged against the recorder's clock.

The order of scans is the recorder's (log time, then file order). The rule, for ``ClockChoice.HEADER``:

1. A header that is never set: the whole log goes by the log clock.
2. The running offset header - log starts as the median of the first nine and follows slowly (a tenth of each scan's
   departure), so that clocks months apart and drifting are the ordinary case.
3. A stamp that departs from log + offset by more than max(0.5 s, 5 periods) is a jump, unless the log clock is the one
   that stepped (its own spacing is odder than the header's): then the offset takes the step and the stamp is good.
4. A jump, an unset stamp (0), one equal to or before the last instant: ``ScanStatus.CLOCK``, placed at log + offset.
5. Three scans in a row that jump to one same new offset are a lasting step of the header clock: from the third on
   stamps are good again, less the step, so that ``t_ns`` goes on without a break.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avsreplay.log.options import ClockChoice, ClockSummary

_FLOOR_NS = 500_000_000
_PERIODS = 5
_FIRST = 9
_CONFIRM = 3
_FOLLOW = 0.1


@dataclass(frozen=True, slots=True)
class Placed:
    """An instant on the chosen clock, and why it is not the stamp's own (None: it is)."""

    t_ns: int
    note: str | None = None


def place(
    log_ns: Sequence[int], publish_ns: Sequence[int], header_ns: Sequence[int], choice: ClockChoice
) -> tuple[list[Placed], ClockSummary]:
    """The instants of all scans of a log, given in recorder's order, and what happened on the way."""
    period = int(np.median(np.diff(log_ns))) if len(log_ns) > 1 else 0
    offsets = [h - r for h, r in zip(header_ns, log_ns, strict=True)]
    summary = ClockSummary(choice.value, len(log_ns), _median(offsets) * 1e-9, period * 1e-9)
    if choice is not ClockChoice.HEADER:
        return _monotone(log_ns if choice is ClockChoice.LOG else publish_ns, summary)
    if len(log_ns) and not any(header_ns) and any(log_ns):
        placed, summary = _monotone(log_ns, replace(summary, clock=ClockChoice.LOG.value, offset_s=0.0))
        return placed, replace(summary, unset=0, note="header stamps are never set: the log clock is used")
    tracker = _Tracker(max(_FLOOR_NS, _PERIODS * period), period, _first_offset(offsets, header_ns))
    placed = [tracker.take(r, h) for r, h in zip(log_ns, header_ns, strict=True)]
    return placed, tracker.summary(summary)


def _median(values: Sequence[int]) -> int:
    return sorted(values)[len(values) // 2] if values else 0


def _first_offset(offsets: Sequence[int], header_ns: Sequence[int]) -> int:
    set_ones = [o for o, h in zip(offsets, header_ns, strict=True) if h != 0]
    return _median((set_ones or list(offsets))[:_FIRST])


def _monotone(instants: Sequence[int], summary: ClockSummary) -> tuple[list[Placed], ClockSummary]:
    """A clock taken as it is; instants that do not move forward are moved by a nanosecond."""
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
    """The running offset between the two clocks, and the last good scan."""

    def __init__(self, tolerance: int, period: int, offset: int) -> None:
        self._tolerance, self._period, self._offset = tolerance, period, offset
        self._correction = 0  # lasting steps of the header clock taken out of t_ns
        self._last: tuple[int, int] | None = None  # log and header of the last good scan
        self._last_t: int | None = None
        self._jumped: list[tuple[int, int]] = []  # departure and header of scans that jumped in a row
        self.counts = {"unset": 0, "jumps": 0, "equal": 0, "back": 0, "header_steps": 0, "log_steps": 0}

    def take(self, log_ns: int, header_ns: int) -> Placed:
        """Place the next scan."""
        departure = header_ns - log_ns - self._offset
        if abs(departure) > self._tolerance and header_ns != 0:
            if self._log_stepped(log_ns, header_ns):
                self._offset += departure
                self.counts["log_steps"] += 1
                departure = 0
            elif self._lasting(departure, header_ns):
                self._correction += departure
                self._offset += departure
                self.counts["header_steps"] += 1
                departure = 0
        trouble = self._trouble(departure, header_ns)
        if trouble is not None:
            return self._by_log(log_ns, departure, trouble)
        self._jumped.clear()
        self._offset += round(_FOLLOW * departure)
        self._last, self._last_t = (log_ns, header_ns), header_ns - self._correction
        return Placed(self._last_t)

    def summary(self, summary: ClockSummary) -> ClockSummary:
        """With what was counted."""
        c = self.counts
        return replace(
            summary, unset=c["unset"], jumps=c["jumps"], equal=c["equal"], back=c["back"],
            header_steps=c["header_steps"], log_steps=c["log_steps"],
        )  # fmt: skip

    def _trouble(self, departure: int, header_ns: int) -> str | None:
        if abs(departure) > self._tolerance:
            return "unset" if header_ns == 0 else "jumps"
        t_ns = header_ns - self._correction
        if self._last_t is None or t_ns > self._last_t:
            return None
        return "equal" if t_ns == self._last_t else "back"

    def _by_log(self, log_ns: int, departure: int, trouble: str) -> Placed:
        self.counts[trouble] += 1
        t_ns = log_ns + self._offset - self._correction
        if self._last_t is not None:
            t_ns = max(t_ns, self._last_t + 1)
        self._last_t = t_ns
        return Placed(t_ns, _NOTES[trouble].format(departure * 1e-9))

    def _log_stepped(self, log_ns: int, header_ns: int) -> bool:
        """Is the odd spacing the log clock's? A header spacing near the period speaks for the header."""
        if self._last is None or self._jumped:
            return False
        log_step, header_step = log_ns - self._last[0], header_ns - self._last[1]
        return header_step > 0 and abs(header_step - self._period) < abs(log_step - self._period)

    def _lasting(self, departure: int, header_ns: int) -> bool:
        if self._jumped:
            first, last = self._jumped[0][0], self._jumped[-1][1]
            if header_ns <= last or abs(departure - first) > self._tolerance // _PERIODS:
                self._jumped.clear()
        self._jumped.append((departure, header_ns))
        if len(self._jumped) < _CONFIRM:
            return False
        self._jumped.clear()
        return True


_NOTES = {
    "unset": "header stamp unset: placed by the log clock",
    "jumps": "header stamp off by {:.3f} s: placed by the log clock",
    "equal": "header stamp equal to the one before: placed by the log clock",
    "back": "header stamp before the one before: placed by the log clock",
}
