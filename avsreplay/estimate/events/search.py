"""Which events there were: sets of events are proposed and pruned by their evidence."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate.batch import Poses
from avsreplay.estimate.chart import Chart
from avsreplay.estimate.events.kinds import KINDS, Kind, PeriodicTorque
from avsreplay.estimate.events.linear import Passed, passed, shock_gain, shock_size
from avsreplay.estimate.events.problem import Event, Fit, Levels, Problem
from avsreplay.geometry import Array

_LATE = (0.1, 0.3, 0.5, 0.7, 0.9)  # instants of an onset that are compared, as parts of an interval
_QUIET = 0.1  # factor on disturbances for the second search
_DISTURBED = 2.0  # loss of log evidence by it from which random disturbances act
_TRIED = 3  # kinds of which the best event is fitted
_LEAST_LOG_ODDS_TRIED = -4.0  # log odds at fixed noise from which an event is fitted
_FIRST_CYCLES = 0.75  # in a log, of the lowest frequency that is compared
_STEP_CYCLES = 0.5  # between two of them
_MOST_FREQUENCIES = 40
_FINER = (-0.2, -0.1, -0.05, 0.05, 0.1, 0.2)  # cycles in a log by which a frequency is improved
_WHOLE_LOG_INSTANTS = 10  # over which the odds of a kind are divided that acts over the whole log
_MOST_EVENTS = 8
_CERTAIN = 6.0  # log odds from which an event is kept without a fit of the set without it
_MARGIN = 3.0  # log odds that an event must add: fits end within about this of their maximum
_START_ROUNDS = 25  # most improvements of the first fit
_FURTHER_FIT_ROUNDS = 8  # of a further one, which begins at another fit
_START_DENSITY = 0.1  # random torque of the start, by which the rate changes within a radian


@value_class
class Found:
    """An event with its size and onset.

    Attributes:
        event: with the most likely onset.
        size, covariance: (p,) and (p, p) [SI].
        onset_s, onset_1s_s: since the epoch of the poses [s]; 0 where it acts from the begin.
        gain: log odds of the set with it over that without it.
    """

    event: Event
    size: Array
    covariance: Array
    onset_s: float
    onset_1s_s: float
    gain: float


def first_fit(problem: Problem) -> Fit:
    """The fit without events. It begins at the measured poses with large random disturbances,
    which the noise levels then reduce.
    """
    poses = problem.poses
    rates, speeds = _rates(poses)
    sphere, arm = np.zeros((3, 3)), np.zeros(3)
    charts = [
        Chart.of(q, w, t, u, sphere, arm, np.eye(3))
        for q, w, t, u in zip(poses.q, rates, poses.t, speeds, strict=True)
    ]
    rate = max(float(np.median(np.linalg.norm(rates, axis=1))), 1e-3)
    density = _START_DENSITY * rate**1.5
    bend = np.diff(np.diff(poses.t, axis=0) / np.diff(poses.times_s)[:, None], axis=0)
    speed = max(float(np.quantile(np.linalg.norm(bend, axis=1), 0.2)), 1e-5)
    common = np.full(2, problem.claimed_common)
    levels = Levels(np.ones(2), common, density, speed)
    return problem.fit(charts, levels, (), np.zeros(len(poses), bool), _START_ROUNDS)


def _rates(poses: Poses) -> tuple[Array, Array]:
    """Rates in {C} and velocities in {A} at each pose, from its neighbours."""
    n = len(poses)
    before, after = np.maximum(np.arange(n) - 2, 0), np.minimum(np.arange(n) + 2, n - 1)
    h = (poses.times_s[after] - poses.times_s[before])[:, None]
    turns = geometry.log(geometry.multiply(geometry.conjugate(poses.q[:-1]), poses.q[1:]))
    moved = np.diff(poses.t, axis=0)
    total = [np.vstack([np.zeros(3), np.cumsum(a, axis=0)]) for a in (turns, moved)]
    return tuple((a[after] - a[before]) / h for a in total)  # type: ignore[return-value]


def odds(problem: Problem, event: Event) -> float:
    """Log prior odds of an event: those of its kind, divided over the instants."""
    instants = len(problem.times) if event.kind.anywhere else _WHOLE_LOG_INSTANTS
    return event.kind.odds - math.log(instants)


def total(problem: Problem, fit: Fit) -> float:
    """Log evidence of a set with the odds of its events, each of which must add a margin."""
    return fit.evidence + sum(odds(problem, e) - _MARGIN for e in fit.events)


def candidates(problem: Problem, fit: Fit, found: Passed) -> Iterator[tuple[float, Event]]:
    """The most likely event of each kind, with its log odds at fixed noise.

    Args:
        problem: the poses.
        fit: the set to which it is added.
        found: passes of the linear model of this fit.
    """
    for kind in KINDS:
        if kind.periodic:
            continue
        best: tuple[float, Event] | None = None
        for late in _LATE if kind.anywhere else (0.5,):
            W = problem.columns(fit.intervals, kind, late)
            W = W[1:-1] if kind.anywhere else W[:1]
            first = 1 if kind.anywhere else 0
            part = slice(first, first + len(W))
            b = np.einsum("kip,ki->kp", W, found.score[part])
            g = W.swapaxes(1, 2) @ found.information[part] @ W
            gain, size = shock_gain(b, g, None, kind.most)
            k = int(np.argmax(gain))
            event = Event(kind, k + first, late, float(size[k]))
            value = float(gain[k]) + odds(problem, event)
            if best is None or value > best[0]:
                best = value, event
        if best is not None:
            yield best


def search(problem: Problem, fit: Fit) -> list[Fit]:
    """Sets of events that were compared, each once, by falling evidence.

    Each round adds one event and may remove others. A round that ends with the set with which it
    began is the last one, although another linearisation of the same set may have more evidence.
    """
    sets = [fit]
    best = fit
    for _ in range(_MOST_EVENTS):
        tried: list[Fit] = []
        for value, event in proposals(problem, best):
            if value >= _LEAST_LOG_ODDS_TRIED and not any(
                _alike(event, f.events[-1]) for f in tried
            ):
                tried.append(_settled(problem, best, (*best.events, event)))
        sets += tried
        top = max(tried, key=lambda f: total(problem, f), default=None)
        if top is None:
            break
        best = _settled(problem, best, best.events)  # with as many rounds as the larger sets
        sets.append(best)
        if total(problem, top) > total(problem, best):
            top = pruned(problem, top, sets)
        if total(problem, top) <= total(problem, best) or _same(top.events, best.events):
            break
        best = top
    out: list[Fit] = []
    for each in sorted(sets, key=lambda f: -total(problem, f)):
        if not any(_same(each.events, other.events) for other in out):
            out.append(each)
    return out


def proposals(problem: Problem, fit: Fit) -> list[tuple[float, Event]]:
    """Events to try, by falling odds.

    They are found with the noise of the fit, in which random disturbances may stand for an event,
    and with disturbances that are as small as the poses allow without one.
    """
    out = sorted(candidates(problem, fit, fit.found), key=lambda c: -c[0])[:_TRIED]
    quiet = problem.quiet(fit, _QUIET)
    found = passed(quiet)
    if found.log_likelihood < fit.found.log_likelihood - _DISTURBED:
        loss = found.log_likelihood - fit.found.log_likelihood
        more = sorted(candidates(problem, fit, found), key=lambda c: -c[0])[:2]
        out += [(value + max(loss, 0.0), event) for value, event in more]
        if not any(e.hz for e in fit.events):
            out += periodic(problem, fit)
    return sorted(out, key=lambda c: -c[0])


def periodic(problem: Problem, fit: Fit) -> list[tuple[float, Event]]:
    """The most likely periodic torque, with its log odds at fixed noise."""
    span = float(problem.times[-1] - problem.times[0])
    least = 4.0 * float(np.median(np.diff(problem.times)))
    grid = _FIRST_CYCLES + _STEP_CYCLES * np.arange(_MOST_FREQUENCIES)
    kind = PeriodicTorque()
    found = [
        _at_frequency(problem, fit, kind, hz) for hz in (grid / span).tolist() if hz * least < 1.0
    ]
    return [max(found, key=lambda c: c[0])] if found else []


def _at_frequency(problem: Problem, fit: Fit, kind: Kind, hz: float) -> tuple[float, Event]:
    """A periodic torque of a frequency, with its log odds at fixed noise."""
    found = passed(problem.with_frequency(fit, hz))
    W = problem.columns(fit.intervals, kind, 0.5)[0]
    gain, size = shock_gain(W.T @ found.score[0], W.T @ found.information[0] @ W, None, kind.most)
    event = Event(kind, 0, 0.5, float(size), hz)
    return float(gain) + odds(problem, event), event


def _same(a: Sequence[Event], b: Sequence[Event]) -> bool:
    """Whether two sets have the same events, with onsets in the same or neighbouring intervals."""
    left = list(b)
    for event in a:
        near = next((e for e in left if _alike(e, event)), None)
        if near is None:
            return False
        left.remove(near)
    return not left


def _alike(a: Event, b: Event) -> bool:
    return a.kind is b.kind and abs(a.knot - b.knot) <= 1


def _settled(problem: Problem, fit: Fit, events: Sequence[Event]) -> Fit:
    """The fit of another set, begun from this one, with the onsets and scales of its events
    found anew.
    """
    out = problem.fit(fit.charts, fit.levels, events, fit.wrong, _FURTHER_FIT_ROUNDS)
    for _ in range(2):
        moved = tuple(relocated(problem, out, e) for e in out.events)
        if all(
            a.knot == b.knot and a.late == b.late and a.hz == b.hz
            for a, b in zip(moved, out.events, strict=True)
        ):
            break
        out = problem.fit(out.charts, out.levels, moved, out.wrong, _FURTHER_FIT_ROUNDS)
    return out


def pruned(problem: Problem, fit: Fit, sets: list[Fit]) -> Fit:
    """The set without events whose removal raises the evidence, or that the rest of the set makes
    unlikely.
    """
    for event in fit.events:
        gain = described(problem, fit, event).gain
        if gain > _CERTAIN:
            continue
        other = _settled(problem, fit, tuple(e for e in fit.events if e is not event))
        sets.append(other)
        if gain < 0.0:
            sets[:] = [each for each in sets if each is not fit]
        if gain < 0.0 or total(problem, other) > total(problem, fit):
            return pruned(problem, other, sets)
    return fit


def _onsets(problem: Problem, fit: Fit, event: Event) -> tuple[Array, Array, Array, Array]:
    """Evidence (m,) of the event at other onsets near its own, with the rest of the set as it is:
    knots, parts, gains, and score with information of the size.
    """
    found = passed(problem.without(fit, event))
    count = len(problem.times)
    low, high = (
        (max(event.knot - 6, 1), min(event.knot + 7, count)) if event.kind.anywhere else (0, 1)
    )
    knots, lates, scores, infos = [], [], [], []
    for late in _LATE if event.kind.anywhere else (0.5,):
        W = problem.columns(fit.intervals, event.kind, late)[low:high]
        b = np.einsum("kip,ki->kp", W, found.score[low:high])
        g = W.swapaxes(1, 2) @ found.information[low:high] @ W
        knots.append(np.arange(low, high))
        lates.append(np.full(high - low, late))
        scores.append(b)
        infos.append(g)
    return (
        np.concatenate(knots),
        np.concatenate(lates),
        np.concatenate(scores),
        np.concatenate(infos),
    )


def relocated(problem: Problem, fit: Fit, event: Event) -> Event:
    """The event at its most likely onset or frequency, with the scale of its size there."""
    if event.hz:
        rest = problem.fit_without(fit, event)
        span = float(problem.times[-1] - problem.times[0])
        tried = [event.hz + d / span for d in (0.0, *_FINER)]
        return max(
            (_at_frequency(problem, rest, event.kind, hz) for hz in tried), key=lambda c: c[0]
        )[1]
    knots, lates, b, g = _onsets(problem, fit, event)
    gain, size = shock_gain(b, g, None, event.kind.most)
    k = int(np.argmax(gain))
    return replace(event, knot=int(knots[k]), late=float(lates[k]), one_sigma=float(size[k]))


def described(problem: Problem, fit: Fit, event: Event) -> Found:
    """Size and onset of an event, averaged over its possible onsets."""
    knots, lates, b, g = _onsets(problem, fit, event)
    scale = np.full(len(knots), event.one_sigma)
    gain, _ = shock_gain(b, g, scale)
    sizes, covariances = shock_size(b, g, scale)
    p = np.exp(gain - gain.max())
    p /= p.sum()
    begin = problem.times[np.maximum(knots - 1, 0)]
    at = begin + lates * (problem.times[knots] - begin)
    onset = float(p @ at)
    size = p @ sizes
    away = sizes - size
    covariance = np.einsum("m,mij->ij", p, covariances) + np.einsum("m,mi,mj->ij", p, away, away)
    step = float(problem.times[event.knot] - problem.times[max(event.knot - 1, 0)]) * 0.2 / 3.5
    return Found(
        event=event,
        size=size,
        covariance=covariance,
        onset_s=onset if event.kind.anywhere else 0.0,
        onset_1s_s=float(np.sqrt(p @ np.square(at - onset) + step**2))
        if event.kind.anywhere
        else 0.0,
        gain=float(gain.max()) + odds(problem, event),
    )
