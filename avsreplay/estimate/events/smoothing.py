"""The smoothing pass over a whole log: its best motion, and the events with their final sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import UsageError, value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.batch import Poses
from avsreplay.estimate.chart import Chart, separated, to_errors, to_state
from avsreplay.estimate.dynamics import propagate_state, translation
from avsreplay.estimate.events.problem import Body, Fit, Problem
from avsreplay.estimate.events.search import Found, described, first_fit, search, total
from avsreplay.estimate.initialise import PoseFix, poses_of, weak_prior
from avsreplay.estimate.params import EstimatorParams
from avsreplay.estimate.relative_orbit import OrbitArc, RelativeOrbit
from avsreplay.geometry import Array, Pose
from avsreplay.records import Belief, State
from avsreplay.spool import Spool, SpoolFile

_FEWEST = 4  # poses of a smoothed motion
_MOST_SEARCHED = 300  # knots among which events are searched
_MOST_KNOTS = 800  # knots of the motion
_NEAR_RAD = 1.0  # turn from a knot within which poses are averaged
_GROSS = 40.0  # chi-square of a pose against the motion above which it is left out of an average
_REFINED = 4  # rounds of the last fit
_LOWER = np.tril_indices(6)
_RECORD = 1 + 7 + 21 + 1  # count, pose, covariance, share


class PoseStore:
    """The healthy poses of a run, of which only the last ones are in memory."""

    def __init__(self, orbit: RelativeOrbit | None = None) -> None:
        """Start without poses.

        Args:
            orbit: of the target.
        """
        file = SpoolFile()
        self._orbit, self._last_ns = orbit, 0
        self._t_ns, self._values = Spool("i8", (), file), Spool("f8", (_RECORD,), file)

    def __len__(self) -> int:
        return len(self._t_ns)

    def append(self, fix: PoseFix) -> None:
        """Append a pose; one that is not later than those before is left out.

        Args:
            fix: the pose.
        """
        if len(self) and fix.t_ns <= self._last_ns:
            return
        self._orbit, self._last_ns = fix.orbit, fix.t_ns
        self._t_ns.append(fix.t_ns)
        values = (float(fix.count), *fix.T_ac.q, *fix.T_ac.t, *fix.C[_LOWER], fix.correlated_share)
        self._values.append(values)

    def arrays(self) -> tuple[NDArray[np.int64], Array]:
        """Return instants (n,) [ns] and values of the poses."""
        return self._t_ns.read(0, len(self)), self._values.read(0, len(self))

    def extend(self, t_ns: NDArray[np.int64], values: Array) -> None:
        """Append what ``arrays`` returned.

        Args:
            t_ns: instants [ns].
            values: of the poses.
        """
        self._t_ns.extend(t_ns)
        self._last_ns = int(t_ns[-1]) if len(t_ns) else self._last_ns
        self._values.extend(values)

    def fixes(self, places: NDArray[np.int64] | None = None) -> list[PoseFix]:
        """Return the poses.

        Args:
            places: of those that are wanted, ascending; None for all.
        """
        t_ns, values = self.arrays()
        if places is not None:
            t_ns, values = t_ns[places], values[places]
        C = np.zeros((len(t_ns), 6, 6))
        C[:, _LOWER[0], _LOWER[1]] = C[:, _LOWER[1], _LOWER[0]] = values[:, 8:29]
        return [
            PoseFix(t, Pose(v[1:5], v[5:8]), c, 0, float(v[29]), int(v[0]), self._orbit)
            for t, v, c in zip(t_ns.tolist(), values, C, strict=True)
        ]


@value_class
class Smoothed:
    """The best motion of a whole log, and the events in it.

    Attributes:
        epoch_ns: instant of the first pose [ns].
        times_s: (k,) of the knots since then [s].
        beliefs: at the knots.
        events: with their final sizes, by onset.
        rivals: log odds of the next sets of events against this one, and their events' kinds.
        wrong_ns: instants of the poses among the knots that are wrong scans [ns].
        torque, force: root densities of the random disturbances [rad/s^1.5, m/s^1.5].
        orbit: of the target; None for free motion.
    """

    epoch_ns: int
    times_s: Array
    beliefs: tuple[Belief, ...]
    events: tuple[Found, ...]
    rivals: tuple[tuple[float, tuple[str, ...]], ...]
    wrong_ns: tuple[int, ...]
    torque: float
    force: float
    orbit: RelativeOrbit | None = None

    @property
    def end_ns(self) -> int:
        """Instant of the last pose [ns]."""
        return self.beliefs[-1].t_ns

    def at(self, t_ns: int) -> State:
        """The state at an instant [ns] within the span of the poses.

        Between two knots it is the motion from the nearer one that does not lie beyond the onset
        of an event.

        Raises:
            ValueError: outside of the span.
        """
        if not self.epoch_ns <= t_ns <= self.end_ns:
            span = f"{self.epoch_ns} to {self.end_ns}"
            raise ValueError(f"t_ns is {t_ns}, outside the reference's span {span}")
        t = (t_ns - self.epoch_ns) * 1e-9
        after = int(np.searchsorted(self.times_s, t, side="left"))
        before = max(after - 1, 0)
        onsets = [
            e.onset_s for e in self.events if self.times_s[before] < e.onset_s < self.times_s[after]
        ]
        middle = onsets[0] if onsets else 0.5 * (self.times_s[before] + self.times_s[after])
        nearest = self.beliefs[after if t > middle or after == before else before]
        arc = None if self.orbit is None else self.orbit.at(nearest.t_ns)
        return propagate_state(nearest.x, (t_ns - nearest.t_ns) * 1e-9, arc)[0]

    def record(self, first_ns: int) -> dict[str, Any]:
        """Return the events as JSON values for ``run.json``, times from ``first_ns`` on."""
        late_s = (self.epoch_ns - first_ns) * 1e-9
        return {
            "torque_density_radps15": self.torque,
            "force_density_mps15": self.force,
            "wrong_poses": len(self.wrong_ns),
            "events": [_event_record(found, late_s) for found in self.events],
            "rivals": [{"log_odds": value, "events": list(names)} for value, names in self.rivals],
        }


def smoothed(fixes: Sequence[PoseFix], params: EstimatorParams) -> Smoothed:
    """The best motion of all poses of a log, in time order.

    Args:
        fixes: the poses.
        params: of the estimator, auto values filled in.

    Raises:
        UsageError: fewer than four poses, or none of the motions that are tried explains them.
    """
    if len(fixes) < _FEWEST:
        hint = "a smoothed motion needs four healthy poses at least"
        raise UsageError(f"only {len(fixes)} healthy poses", where="--reference fit", hint=hint)
    poses = poses_of(tuple(fixes))
    body = Body(weak_prior(poses, params).one_sigma, params.correlated_rad)
    some = Problem(
        poses.some(np.isin(np.arange(len(poses)), spread(len(poses), _MOST_SEARCHED))), body
    )
    try:
        sets = search(some, first_fit(some))
        problem, fit = some, sets[0]
        if len(poses) > _MOST_SEARCHED:
            problem, fit = _denser(poses, some, fit)
    except ArithmeticError:
        hint = "no motion of a rigid body explains them; is their noise (--pose-sigma) right?"
        raise UsageError(
            "the healthy poses have no smoothed motion", where="--reference fit", hint=hint
        ) from None
    events = sorted((described(problem, fit, e) for e in fit.events), key=lambda f: f.onset_s)
    charts = [c.moved(y[:20]) for c, y in zip(fit.charts, fit.found.mean, strict=True)]
    t_ns = [fixes[0].t_ns + round(t * 1e9) for t in problem.times.tolist()]
    best = total(some, sets[0])
    return Smoothed(
        epoch_ns=fixes[0].t_ns,
        times_s=problem.times,
        beliefs=tuple(
            _belief(t, c, fit.found.covariance(k))
            for k, (t, c) in enumerate(zip(t_ns, charts, strict=True))
        ),
        events=tuple(events),
        rivals=tuple(
            (total(some, other) - best, tuple(e.kind.name for e in other.events))
            for other in sets[1:4]
        ),
        wrong_ns=tuple(t for t, wrong in zip(t_ns, fit.wrong.tolist(), strict=True) if wrong),
        torque=fit.levels.torque,
        force=fit.levels.force,
        orbit=fixes[0].orbit,
    )


def _belief(t_ns: int, chart: Chart, P: Array) -> Belief:
    chart, P = separated(chart, P[:20, :20]), P[:20, :20]
    T = to_errors(chart)
    return Belief(t_ns, to_state(chart), T @ P @ T.T)


def spread(count: int, most: int) -> NDArray[np.int64]:
    """Return the places of at most ``most`` of ``count`` poses: equally spread, with both ends.

    Args:
        count: number of poses.
        most: largest number of places.
    """
    return np.unique(np.round(np.linspace(0, count - 1, min(count, most))).astype(np.int64))


def _denser(poses: Poses, some: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """The fit to all poses, averaged about the motion of a fit to some of them."""
    places = spread(len(poses), _MOST_KNOTS)
    charts = [c.moved(y[:20]) for c, y in zip(fit.charts, fit.found.mean, strict=True)]
    nearest = np.searchsorted(some.times, poses.times_s[places], side="right") - 1
    at = [
        _moved_on(charts[k], some.times[k], poses.times_s[i], poses.arc)
        for k, i in zip(nearest.tolist(), places.tolist(), strict=True)
    ]
    points = _averaged(poses, places, at)
    problem = Problem(points, some.body)
    begins = some.times[[max(e.knot - 1, 0) for e in fit.events]] if fit.events else np.zeros(0)
    events = []
    for event, begin in zip(fit.events, begins.tolist(), strict=True):
        onset = begin + event.late * (some.times[event.knot] - begin)
        knot = int(np.clip(np.searchsorted(problem.times, onset), 1, len(problem.times) - 1))
        length = problem.times[knot] - problem.times[knot - 1]
        late = float(np.clip((onset - problem.times[knot - 1]) / length, 0.1, 0.9))
        events.append(replace(event, knot=0 if event.knot == 0 else knot, late=late))
    wrong = np.zeros(len(places), bool)
    return problem, problem.fit(at, fit.levels, events, wrong, _REFINED)


def _moved_on(chart: Chart, begin: float, end: float, arc: OrbitArc | None) -> Chart:
    """The chart of the undisturbed motion at another time [s]."""
    path = translation(end - begin, None if arc is None else arc.shifted(begin))
    return Chart(_motion.transition(chart.flat, end - begin, path)[0])


def _averaged(poses: Poses, places: NDArray[np.int64], charts: Sequence[Chart]) -> Poses:
    """A pose at each place: the mean of those nearest to it, about the motion from its chart."""
    middle = 0.5 * (poses.times_s[places[1:]] + poses.times_s[places[:-1]])
    bounds = np.concatenate([[0], np.searchsorted(poses.times_s, middle), [len(poses)]])
    q, t, C, counts, shifts = [], [], [], [], []
    for k, chart in enumerate(charts):
        part = np.arange(bounds[k], bounds[k + 1])
        since = poses.times_s[part] - poses.times_s[places[k]]
        part = part[np.abs(since) * float(np.linalg.norm(chart.w_c)) <= _NEAR_RAD]
        begin = poses.times_s[places[k]]
        flat = np.array([_moved_on(chart, begin, t, poses.arc).flat for t in poses.times_s[part]])
        theta = geometry.log(geometry.multiply(geometry.conjugate(poses.q[part]), flat[:, :4]))
        back = geometry.matrix(poses.q[part]).swapaxes(1, 2)
        d = np.hstack([theta, (back @ (flat[:, 7:10] - poses.t[part])[:, :, None])[:, :, 0]])
        d += poses.shifts[part]
        away = d - np.median(d, axis=0)
        squares = np.einsum("ki,kij,kj->k", away, np.linalg.inv(poses.C[part]), away)
        good = squares <= _GROSS * max(1.0, float(np.median(squares)) / 6.0)
        info = np.linalg.inv(poses.C[part][good])
        mean_C = np.linalg.inv(info.sum(axis=0))
        mean = mean_C @ (info @ d[good][:, :, None]).sum(axis=0)[:, 0]
        off = d[good].mean(axis=0)
        q.append(geometry.multiply(chart.q_ac, geometry.exp(-off[:3])))
        t.append(chart.t_a - geometry.matrix(q[-1]) @ off[3:])
        shifts.append(mean - off)
        C.append(0.5 * (mean_C + mean_C.T))
        counts.append(int(good.sum()))
    shares = None if poses.shares is None else poses.shares[places]
    return Poses(
        poses.times_s[places],
        np.array(q),
        np.array(t),
        np.array(C),
        np.array(counts),
        shares,
        arc=poses.arc,
        shift=np.array(shifts),
    )


def _event_record(found: Found, late_s: float) -> dict[str, Any]:
    kind = found.event.kind
    found = replace(found, onset_s=found.onset_s + late_s)
    return {
        "kind": kind.name,
        "words": words(found),
        "onset_s": found.onset_s,
        "onset_1s_s": found.onset_1s_s,
        "size": found.size.tolist(),
        "size_1s": np.sqrt(np.diagonal(found.covariance)).tolist(),
        "unit": kind.si,
        "frequency_hz": found.event.hz or None,
        "log_odds": found.gain,
    }


def words(found: Found) -> str:
    """An event in words, with size and onset and their 1 sigma."""
    kind, size = found.event.kind, found.size
    norm = float(np.linalg.norm(size))
    along = size / max(norm, 1e-300)
    one_sigma = float(np.sqrt(along @ found.covariance @ along))
    if kind.size == 1:
        norm = float(size[0])
    text = f"{norm / kind.factor:.3g} +- {one_sigma / kind.factor:.2g} {kind.unit}"
    when = f" at {found.onset_s:.1f} s" if kind.anywhere else ""
    period = f", period {1.0 / found.event.hz:.3g} s" if found.event.hz else ""
    return kind.words.format(size=text) + period + when
