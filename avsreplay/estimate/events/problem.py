"""The problem: motion at every knot, parameters of the body, noise levels, and a set of events.

The motion is nonlinear. It is linearised about charts at the knots, which need not lie on one
free motion: what is missing between two of them is taken by random disturbances and by events.
The state at a knot is a chart step (20) and what ``kinds`` adds to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.batch import Poses
from avsreplay.estimate.chart import ETA, INERTIA, POSITION, RATE, VELOCITY, Chart
from avsreplay.estimate.dynamics import translation
from avsreplay.estimate.events.kinds import (
    COLOUR,
    DRAG,
    DRIFT,
    FORCE,
    OFFSET,
    SINE,
    STATES,
    TORQUE,
    Intervals,
    Kind,
)
from avsreplay.estimate.events.linear import LinearModel, Passed, passed
from avsreplay.estimate.pose_noise import cholesky_root
from avsreplay.geometry import Array

_TURN_RAD = 0.4  # largest turn over which effects of accelerations are integrated by Simpson's rule
_GROSS = 40.0  # chi-square of a pose at which it is more likely a wrong scan than one of the noise
_MOST_FIRST = 2.0  # largest factor on the claimed noise until the motion is found
_FIRST_ROUNDS = 8
_SETTLED = 0.05  # change of the evidence from which on a fit has settled
_WORST = 0.1  # part of the largest chi-square above which poses are found wrong in one round
_KNOWN = 150.0  # variance of the motion over that of a pose up to which a wrong pose is tested
_PRIOR_DOF = 6.0  # weight of the claimed variances, in measured numbers
_COMMON_DOF = 3.0  # the same of the claimed common errors
_LEAST_DENSITY = 1e-9  # of random disturbances [rad/s^1.5, m/s^1.5]: without effect over a log
_LEAST_COMMON = 1e-3  # least variance of common errors over that of the others
_LARGEST_COMMON = 1e3  # largest one
_LARGEST_RAD = 0.5  # largest step of the attitude
_LARGEST_LOG = 1.0  # largest step of the logarithm of inertia


@value_class
class Levels:
    """Noise levels.

    Attributes:
        factors: (2,) on the claimed standard deviations of attitude and position.
        common: (2,) variance of the common errors over the claimed one of a single pose.
        torque, force: root densities of random disturbances [rad/s^1.5, m/s^1.5].
    """

    factors: Array
    common: Array
    torque: float
    force: float


@value_class
class Event:
    """One event of a set.

    Attributes:
        kind: its kind.
        knot, late: its onset lies in the interval that ends at this knot, at this part of it.
        one_sigma: of its size before the poses.
        hz: frequency of a periodic one.
    """

    kind: Kind
    knot: int
    late: float
    one_sigma: float
    hz: float = 0.0


@dataclass(frozen=True, slots=True)
class Body:
    """What is given of the target: prior 1 sigma of the chart (20,), and turn that decorrelates
    the common errors [rad].
    """

    prior_1s: Array
    correlated_rad: float


@value_class
class Fit:
    """A set of events and the motion that fits the poses with it.

    Attributes:
        events: the set.
        charts: of the motion at the knots.
        levels: noise.
        wrong: (k,) poses that are wrong scans.
        evidence: log evidence of the set, without the odds of its events.
        linear: the model about the charts.
        found: its passes.
        intervals: effects of shocks.
    """

    events: tuple[Event, ...]
    charts: tuple[Chart, ...]
    levels: Levels
    wrong: NDArray[np.bool_]
    evidence: float
    linear: LinearModel
    found: Passed
    intervals: Intervals


class Problem:
    """Poses at knots, and fits of sets of events to them.

    Args:
        poses: measured poses or normal points (``counts``), ascending in time.
        body: prior of the motion.
    """

    def __init__(self, poses: Poses, body: Body) -> None:
        self.poses, self.body = poses, body
        self.times = poses.times_s
        self.root = cholesky_root(poses.C)
        counts = np.ones(len(poses)) if poses.counts is None else poses.counts
        self.single = self.root * np.sqrt(counts)[:, None, None]
        share = 0.0 if poses.shares is None else float(np.mean(poses.shares))
        self.claimed_common = max(share / max(1.0 - share, _LEAST_COMMON), _LEAST_COMMON)
        self.R_c = geometry.matrix(poses.q)

    def fit(
        self,
        charts: Sequence[Chart],
        levels: Levels,
        events: Sequence[Event],
        wrong: NDArray[np.bool_],
        rounds: int,
    ) -> Fit:
        """Relinearise, and improve motion and noise levels, at most ``rounds`` times.

        Args:
            charts: where to begin.
            levels: likewise.
            events: the set.
            wrong: (k,) poses that are wrong scans.
            rounds: largest number of improvements.
        """
        charts, before = tuple(charts), -np.inf
        for round_ in range(rounds):
            flow = self._linearised(charts, events)
            model = self._model(flow, levels, events, wrong)
            found = passed(_plain(model))
            evidence = found.log_likelihood + self._wrong_cost(wrong, levels)
            if abs(evidence - before) < _SETTLED:
                break
            before = evidence
            most = _MOST_FIRST if round_ < _FIRST_ROUNDS < rounds else np.inf
            charts = self._moved(charts, found)
            levels = self._improved(levels, found, flow, wrong, most)
            wrong = self._wrong(model, found, wrong)
        flow = self._linearised(charts, events)
        model = self._model(flow, levels, events, wrong)
        found = passed(model)
        evidence = found.log_likelihood + self._wrong_cost(wrong, levels)
        return Fit(tuple(events), charts, levels, wrong, evidence, model, found, flow.intervals)

    def _wrong_cost(self, wrong: NDArray[np.bool_], levels: Levels) -> float:
        logs = np.log(np.abs(np.einsum("kii->ki", self.root[wrong]))).sum()
        factors = 3.0 * int(wrong.sum()) * float(np.log(levels.factors).sum())
        return -float(logs) - factors - 0.5 * _GROSS * int(wrong.sum())

    def _wrong(
        self, model: LinearModel, found: Passed, wrong: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Which poses are wrong scans: their deletion gains more than a wrong scan costs."""
        out = wrong.copy()
        for k in np.flatnonzero(wrong).tolist():
            H, C = model.H[k][:, : found.before.shape[1]], found.covariance(k)
            e = model.z[k] - H @ found.before[k] - H @ found.before_P[k] @ found.score[k]
            S = H @ C @ H.T
            known = np.trace(np.linalg.solve(model.R[k], S)) < _KNOWN
            out[k] = not known or e @ np.linalg.solve(model.R[k] + S, e) > 0.75 * _GROSS
        u, D = found.error[~wrong], found.weight[~wrong]
        ridge = 1e-12 * np.trace(D, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        squares = np.einsum("ki,ki->k", u, np.linalg.solve(D + ridge, u[:, :, None])[:, :, 0])
        out[~wrong] = squares > max(_GROSS, _WORST * float(squares.max(initial=0.0)))
        return out

    def _moved(self, charts: Sequence[Chart], found: Passed) -> tuple[Chart, ...]:
        """The charts at the smoothed states, a part of the way where the step is long."""
        y = found.mean[:, :20]
        most = max(
            float(np.abs(y[:, ETA]).max()) / _LARGEST_RAD,
            float(np.abs(y[:, INERTIA]).max()) / _LARGEST_LOG,
            1.0,
        )
        return tuple(c.moved(step) for c, step in zip(charts, y / most, strict=True))

    def _improved(
        self,
        levels: Levels,
        found: Passed,
        flow: _Flow,
        wrong: NDArray[np.bool_],
        most: float,
    ) -> Levels:
        """The levels after one multiplicative step to the largest likelihood.

        Of each variance, the derivative of the likelihood is a difference of two positive sums;
        the variance is multiplied by their ratio.
        """
        on = ~wrong
        u, D = found.error[on], found.weight[on]
        half = self._noise_root(levels)[on]
        factors = np.empty(2)
        for b, part in enumerate((slice(0, 3), slice(3, 6))):
            own = half[:, :, part]
            squares = np.sum((u[:, None] @ own) ** 2)
            traces = np.sum(own * (D @ own))
            prior = _PRIOR_DOF / levels.factors[b] ** 2
            factors[b] = levels.factors[b] * np.sqrt((squares + prior) / (traces + _PRIOR_DOF))
            factors[b] = min(factors[b], most)
        common = np.empty(2)
        for b, part in enumerate((slice(20, 23), slice(23, 26))):
            size = np.where(np.arange(len(flow.keep)) > 0, 1.0 - flow.keep**2, 1.0)
            squares = np.float64(size @ np.square(found.score[:, part]).sum(axis=1))
            traces = np.float64(size @ np.einsum("kii->k", found.information[:, part, part]))
            claimed = _COMMON_DOF * self.claimed_common / levels.common[b]
            ratio = (squares + claimed) / (traces + _COMMON_DOF)
            common[b] = np.clip(levels.common[b] * ratio, _LEAST_COMMON, _LARGEST_COMMON)
        densities = []
        for value, G in ((levels.torque, flow.torque), (levels.force, flow.force)):
            b_ = np.einsum("kip,ki->kp", G, found.score[:, :20])
            g = np.sum(G * (found.information[:, :20, :20] @ G))
            ratio = float(np.square(b_).sum()) / max(float(g), 1e-300)
            densities.append(max(value * np.sqrt(ratio), _LEAST_DENSITY))
        return Levels(factors, common, *densities)

    def _noise_root(self, levels: Levels) -> Array:
        """(k, 6, 6) roots of the noise R of each pose, R = root root'."""
        return np.asarray(self.root * np.repeat(levels.factors, 3))

    def _model(
        self,
        flow: _Flow,
        levels: Levels,
        events: Sequence[Event],
        wrong: NDArray[np.bool_],
    ) -> LinearModel:
        count = len(self.times)
        Q = np.zeros((count, STATES, STATES))
        Q[:, :20, :20] = levels.torque**2 * flow.torque @ flow.torque.swapaxes(1, 2)
        Q[:, :20, :20] += levels.force**2 * flow.force @ flow.force.swapaxes(1, 2)
        Q[:, COLOUR, COLOUR] = (1.0 - flow.keep**2)[:, None, None] * np.eye(6)
        P0 = np.zeros((STATES, STATES))
        P0[:20, :20] = np.diag(self.body.prior_1s**2)
        P0[COLOUR, COLOUR] = np.eye(6)
        for event in events:
            W = self.columns(flow.intervals, event.kind, event.late)[event.knot]
            added = event.one_sigma**2 * W @ W.T
            if event.knot:
                Q[event.knot] += added
            else:
                P0 += added
        H, half = flow.H.copy(), self._noise_root(levels)
        sizes = np.repeat(levels.factors, 3) * np.repeat(np.sqrt(levels.common), 3)
        H[:, :, COLOUR] = self.single * sizes
        R = half @ half.swapaxes(1, 2)
        return LinearModel(flow.F, flow.b, Q, flow.z, H, R, ~wrong, flow.m0, P0)

    @staticmethod
    def columns(intervals: Intervals, kind: Kind, late: float) -> Array:
        """(k, STATES, size) shocks of a kind at each knot, ``late`` in the interval before."""
        return kind.columns(intervals, np.full(len(intervals.times_s), late))

    def _linearised(
        self, charts: tuple[Chart, ...], events: Sequence[Event], hz: float = 0.0
    ) -> _Flow:
        hz = hz or next((e.hz for e in events if e.hz), 0.0)
        count, lengths = len(charts), np.diff(self.times)
        flat = np.array([c.flat for c in charts])
        flow = _flow(flat, lengths, self.times - self.times[0], hz, self.poses)
        F = np.tile(np.eye(STATES), (count, 1, 1))
        b = np.zeros((count, STATES))
        turn, torque = np.zeros((count, 3, 20, 3)), np.zeros((count, 20, 3))
        force, drag = np.zeros((count, 20, 3)), np.zeros((count, 20, 1))
        F[1:, :20, :20], b[1:, :20], turn[1:] = flow.F, flow.b, flow.turn
        torque[1:], drag[1:], F[1:, :20, SINE] = flow.torque, flow.drag, flow.sine
        force[1:, POSITION] = 0.5 * lengths[:, None, None] ** 2 * np.eye(3)
        force[1:, VELOCITY] = lengths[:, None, None] * np.eye(3)
        keep = np.ones(count)
        turned = np.linalg.norm(flat[:-1, 4:7], axis=1) * lengths
        keep[1:] = np.exp(-turned / self.body.correlated_rad)
        F[1:, :20, TORQUE], F[1:, :20, FORCE], F[1:, :20, DRAG] = torque[1:], force[1:], drag[1:]
        F[1:, OFFSET, DRIFT] = lengths[:, None, None]
        F[:, COLOUR, COLOUR] *= keep[:, None, None]
        q, p = flat[:, :4], flat[:, 7:10]
        back = self.R_c.swapaxes(1, 2)
        z, H = np.empty((count, 6)), np.zeros((count, 6, STATES))
        z[:, :3] = -geometry.log(geometry.multiply(geometry.conjugate(self.poses.q), q))
        z[:, 3:] = -(back @ (p - self.poses.t)[:, :, None])[:, :, 0]
        z -= self.poses.shifts
        H[:, :3, ETA], H[:, 3:, POSITION] = 2.0 * np.eye(3), back
        line = p / np.maximum(np.linalg.norm(p, axis=1), 1e-300)[:, None]
        H[:, 3:, OFFSET] = back @ line[:, :, None]
        m0 = np.zeros(STATES)
        m0[:20] = self.prior_mean().minus(charts[0])
        roots = np.sqrt(np.diff(self.times, prepend=self.times[0]))[:, None, None]
        return _Flow(
            F=F,
            b=b,
            z=z,
            H=H,
            m0=m0,
            keep=keep,
            torque=roots * turn[:, 1] @ _torque_axes(charts[0]),
            force=roots * _velocity_middle(self.times),
            intervals=Intervals(self.times, turn, torque, force, drag),
        )

    def fit_without(self, fit: Fit, event: Event) -> Fit:
        """The same charts and levels, without one of the events."""
        return replace(fit, events=tuple(e for e in fit.events if e is not event))

    def with_frequency(self, fit: Fit, hz: float) -> LinearModel:
        """The linear model of a fit in which a periodic torque of this frequency may act."""
        flow = self._linearised(fit.charts, fit.events, hz)
        return self._model(flow, fit.levels, fit.events, fit.wrong)

    def quiet(self, fit: Fit, factor: float) -> LinearModel:
        """The linear model of a fit with other random disturbances, smaller by a factor."""
        less = replace(
            fit.levels, torque=factor * fit.levels.torque, force=factor * fit.levels.force
        )
        flow = self._linearised(fit.charts, fit.events)
        return self._model(flow, less, fit.events, fit.wrong)

    def prior_mean(self) -> Chart:
        """A sphere at rest at the first pose."""
        zero = np.zeros(3)
        q, t = self.poses.q[0], self.poses.t[0]
        return Chart.of(q, zero, t, zero, np.zeros((3, 3)), zero, np.eye(3))

    def without(self, fit: Fit, event: Event) -> LinearModel:
        """The linear model of a fit without one of its events, at the same charts and levels."""
        W = self.columns(fit.intervals, event.kind, event.late)[event.knot]
        added = event.one_sigma**2 * W @ W.T
        if event.knot == 0:
            return replace(fit.linear, P0=fit.linear.P0 - added)
        Q = fit.linear.Q.copy()
        Q[event.knot] -= added
        return replace(fit.linear, Q=Q)


@value_class
class _Flow:
    """The linearised motion of all knots; ``torque`` and ``force`` are effects of impulses of unit
    density.
    """

    F: Array
    b: Array
    z: Array
    H: Array
    m0: Array
    keep: Array
    torque: Array
    force: Array
    intervals: Intervals


@value_class
class _Intervals:
    """All intervals between knots: transition, offset of the chart at the end, and effects."""

    F: Array
    b: Array
    turn: Array
    torque: Array
    drag: Array
    sine: Array


def _plain(model: LinearModel) -> LinearModel:
    """The model without the states of lasting events, where none acts."""
    n = COLOUR.stop
    if model.P0[n:, n:].any() or model.Q[:, n:, n:].any():
        return model
    F, b, Q, H = model.F[:, :n, :n], model.b[:, :n], model.Q[:, :n, :n], model.H[:, :, :n]
    F, b, Q, H = (np.ascontiguousarray(a) for a in (F, b, Q, H))
    m0, P0 = model.m0[:n].copy(), model.P0[:n, :n].copy()
    return LinearModel(F, b, Q, model.z, H, model.R, model.used, m0, P0)


def _flow(charts: Array, lengths: Array, since: Array, hz: float, poses: Poses) -> _Intervals:
    """The motion from each chart (k, 34) to the next one, relative to it.

    Args:
        charts: at the knots.
        lengths: (k - 1,) of the intervals [s].
        since: (k,) times since the first knot [s].
        hz: frequency of a periodic torque.
        poses: with the orbit.
    """
    n = len(lengths)
    turned = np.linalg.norm(charts[:-1, 4:7], axis=1) * lengths
    counts = 2 * np.maximum(1, np.ceil(turned / _TURN_RAD - 1e-9)).astype(np.int64)
    steps = lengths / counts
    each, ends = np.repeat(np.arange(n), counts), np.cumsum(counts)
    place = np.arange(len(each)) - (ends - counts)[each]
    if poses.arc is None:
        paths = np.tile(np.eye(6), (len(each), 1, 1))
        paths[:, [0, 1, 2], [3, 4, 5]] = steps[each][:, None]
    else:
        begins = since[:-1][each] + place * steps[each]
        paths = np.array(
            [
                translation(h, poses.arc.shifted(begin))
                for h, begin in zip(steps[each].tolist(), begins.tolist(), strict=True)
            ]
        )
    nodes, F = _motion.chains(np.ascontiguousarray(charts[:-1]), steps, counts, paths)
    out = [
        np.empty((n, *shape)) for shape in ((20, 20), (20,), (3, 20, 3), (20, 3), (20, 1), (20, 6))
    ]
    for count in np.unique(counts).tolist():
        which = np.flatnonzero(counts == count)
        at = (ends - counts)[which][:, None] + np.arange(count)
        found = _interval(charts[which], nodes[at], F[at], steps[which], since[which], hz)
        for array, part in zip(out, found, strict=True):
            array[which] = part
    out[1][:] = [_motion.minus(a, b) for a, b in zip(nodes[ends - 1], charts[1:], strict=True)]
    return _Intervals(*out)


def _interval(
    first: Array, nodes: Array, F: Array, steps: Array, since: Array, hz: float
) -> tuple[Array, ...]:
    """Effects over m intervals of as many steps each; see ``_Intervals``."""
    m, count = F.shape[:2]
    charts = np.concatenate([first[:, None], nodes], axis=1)
    effects = np.zeros((m, count + 1, 20, 3))
    own = _turning(charts)
    left = np.tile(np.eye(20), (m, 1, 1))
    for k in range(count, -1, -1):
        effects[:, k] = left @ own[:, k]
        if k:
            left = left @ F[:, k - 1]
    simpson = np.ones(count + 1)
    simpson[1:-1:2], simpson[2:-1:2] = 4.0, 2.0
    weights = steps[:, None] / 3.0 * simpson
    weighted = weights[:, :, None, None] * effects
    drag = -np.einsum("mkij,mkj->mi", weighted, charts[:, :, 4:7])[:, :, None]
    sine = np.zeros((m, 20, 6))
    if hz:
        phase = 2.0 * np.pi * hz * (since[:, None] + steps[:, None] * np.arange(count + 1))
        sine[:, :, :3] = np.einsum("mk,mkij->mij", np.sin(phase), weighted)
        sine[:, :, 3:] = np.einsum("mk,mkij->mij", np.cos(phase), weighted)
    turn = effects[:, [0, count // 2, count]]
    return left, np.zeros((m, 20)), turn, weighted.sum(axis=1), drag, sine


def _turning(charts: Array) -> Array:
    """(..., 20, 3) chart step of a change of the rate in {C} that leaves the velocity of the mass
    centre.
    """
    out = np.zeros((*charts.shape[:-1], 20, 3))
    out[..., RATE, :] = np.eye(3)
    out[..., VELOCITY, :] = -geometry.matrix(charts[..., :4]) @ geometry.skew(charts[..., 22:25])
    return out


def _torque_axes(chart: Chart) -> Array:
    """(3, 3) angular acceleration in {C} of a torque per unit of the inertia's trace."""
    values, axes = np.linalg.eigh(chart.M)
    moments = np.exp(values - values.max())
    inertia = moments.sum() - moments
    out: Array = axes @ np.diag(inertia.sum() / inertia) @ axes.T
    return out


def _velocity_middle(times: Array) -> Array:
    """(k, 20, 3) effect of a change of velocity in the middle of each interval."""
    out = np.zeros((len(times), 20, 3))
    half = 0.5 * np.diff(times, prepend=times[0])
    out[:, VELOCITY], out[:, POSITION] = np.eye(3), half[:, None, None] * np.eye(3)
    return out
