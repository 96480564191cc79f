"""Which hypothesis explains a run of large innovations: manoeuvre, torque, sensor error, bad scans,
or none of these.

The pose of a free body is continuous and its velocity constant but for small disturbances. A step
in the velocity with a continuous pose is therefore a manoeuvre; a step in the pose that the
velocity does not explain is an error of the sensor; scans that contradict one another are bad.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from avsreplay.estimate import _motion
from avsreplay.estimate.bad_scans import bad_scans, noisier
from avsreplay.estimate.batch_covariance import SPHERE
from avsreplay.estimate.driven import DrivenBelief, impulses
from avsreplay.estimate.relative_orbit import RelativeOrbit
from avsreplay.estimate.scan_window import (
    OFFSETS,
    PRIOR_ODDS,
    ChangePriors,
    Explanation,
    Hypothesis,
    Window,
    log_evidence,
    log_mean,
    mixed,
    odds_over_free,
    offsets,
    window_of,
)
from avsreplay.estimate.track import Epoch
from avsreplay.geometry import Array
from avsreplay.records import Belief

# log odds over free motion and over the next hypothesis of an early decision
OVER_FREE = 3.0
OVER_NEXT = 2.0
# chi-square of free motion over the sum of the NIS from which the linearisation does not hold
_NONLINEAR = 2.0
_DENSITIES = np.logspace(-6.0, -1.0, 21)  # root densities of random impulses that are compared
_MANOEUVRE_INSTANTS = 8  # instants tried for a manoeuvre between two scans
# latest scans over whose intervals a manoeuvre that is not instantaneous may extend
_LONGEST_SPREAD = 6
# instants of a refined grid, refinements, share of evidence neglected
_FINE = 16
_REFINEMENTS = 5
_NEGLIGIBLE_EVIDENCE = 1e-4
# probability that a manoeuvre is earlier, or later, than the interval in which it is allowed for
_TAIL = 0.05
_NOT_BY_CHANCE = 16.3  # 99.9 % point of chi-square with 3 degrees of freedom
_CHANGES = (slice(0, 3), slice(3, 6), slice(0, 6))  # rate, velocity, both
_SPREAD = (
    0.7,
    0.1,
    0.1,
    0.1,
)  # prior share of manoeuvres at one instant, and over one, two and three intervals
# log of the prior odds of a manoeuvre over random disturbances that begin within the scans: 1 to
# 0.01
_BEGINS = 4.6
# prior 1 sigma of a constant acceleration over that of a change of the velocity [1/s]
_PER_S = 0.02

Ranked = tuple[tuple[Epoch, ...], list[Explanation]]
"""Scans and the hypotheses about them, most likely first."""


def explain(
    epochs: Sequence[Epoch],
    first_doubtful: int,
    priors: ChangePriors,
    torque: float,
    force: float,
    orbit: RelativeOrbit | None = None,
    excluded: tuple[float, float] = (0.0, 0.0),
) -> Ranked:
    """The scans that the hypotheses can be compared on, and all hypotheses on them, most likely
    first.

    The hypotheses are linear about the motion predicted from the first scan. Where the accepted
    scans contradict this motion although each agreed with its own prediction, the linearisation
    does not hold so long, and the older half of the accepted scans is left out.

    Args:
        epochs: measured scans in the order of time, ``first_doubtful`` of them accepted, the others
            in doubt.
        first_doubtful: index of the first doubtful scan, 1 at least.
        priors: 1 sigma of the size of a change.
        torque: root density of the angular disturbance [rad/s^1.5].
        force: root density of the linear disturbance [m/s^1.5].
        orbit: the relative orbit of the target; None for free motion.
        excluded: root densities of torque and force from which on the poses before exclude a random
            disturbance.
    """
    start = epochs[0].track.belief
    arc = None if orbit is None else orbit.at(start.t_ns)
    window = window_of(epochs, first_doubtful, start, torque, force, arc)
    white = window.whiten @ window.y
    accepted = white[: 6 * window.points.before(first_doubtful)]
    if first_doubtful > 1 and not linear(
        float(accepted @ accepted), len(accepted), epochs[:first_doubtful]
    ):
        left_out = first_doubtful // 2
        return explain(
            epochs[left_out:], first_doubtful - left_out, priors, torque, force, orbit, excluded
        )
    free = -0.5 * float(white @ white) + float(np.log(np.diagonal(window.whiten)).sum())
    edges = window.edges_s
    between = after_changes(window, start, 0.5 * (edges[1:] + edges[:-1]))
    found = [
        Explanation(Hypothesis.FREE_MOTION, free, float(white @ white), len(white), len(epochs)),
        _manoeuvre(window, start, white, free, priors),
        random_disturbance(edges, between, white, free, excluded),
        constant_acceleration(
            edges, between, white, free, priors, isinstance(epochs[-1].track.belief, DrivenBelief)
        ),
        _sensor_bias(window, white, free, priors),
        bad_scans(window, white, priors, first_doubtful),
        noisier(window, white, first_doubtful),
    ]
    return tuple(epochs), sorted(found, key=lambda e: -e.log_evidence)


def certain(ranked: Sequence[Explanation]) -> bool:
    """Return whether the most likely hypothesis explains the scans and the odds suffice for a
    decision.
    """
    best, free = ranked[0], ranked[0].hypothesis is Hypothesis.FREE_MOTION
    sure = best.explains and best.log_evidence - ranked[1].log_evidence >= OVER_NEXT
    return sure and (free or odds_over_free(ranked) >= OVER_FREE)


def linear(chi2: float, dof: int, epochs: Sequence[Epoch]) -> bool:
    """Return whether the linearisation about the first prediction holds over scans that were all
    used.

    Of a linear system the chi-square of free motion is the sum of the NIS, whatever moved the
    target. Where scans are combined, what they differ by within their points is missing in it.

    Args:
        chi2: of free motion, with ``dof`` degrees of freedom.
        dof: as many as six for each scan that is not combined.
        epochs: the scans.
    """
    total, all_dof = sum(e.innovation.nis for e in epochs), 6 * len(epochs)
    return chi2 < _NONLINEAR * max(total - (all_dof - dof), total * dof / all_dof)


def _manoeuvre(
    window: Window, start: Belief, white: Array, free: float, priors: ChangePriors
) -> Explanation:
    """A change of rate and velocity: at one instant, or spread over one to three intervals between
    scans.

    A thrust or an impact that is not instantaneous is a sum of changes, two in each interval, so
    that both the velocity and the pose at the end of the interval are free. All instants are
    marginalised for the evidence; the explanation is the most likely, with rate and velocity free.
    """
    edges, lengths = window.edges_s[:-1], np.diff(window.edges_s)
    n = len(lengths)
    count = _MANOEUVRE_INSTANTS
    instants = (edges[:, None] + lengths[:, None] * ((np.arange(count) + 0.5) / count)).reshape(-1)
    columns = after_changes(window, start, instants)
    scale = np.repeat([priors.rate_radps, priors.velocity_mps], 3)
    single = free + mixed(columns, white, scale, _CHANGES, priors.scales)
    shares = np.repeat(
        np.log(np.maximum(n * lengths / lengths.sum(), 1e-300)), count
    )  # all instants are as likely
    two = count * np.arange(max(0, n - _LONGEST_SPREAD), n)[:, None] + np.array(
        [count // 8, count - 1 - count // 8]
    )
    M = (columns[two.reshape(-1)] * scale).transpose(1, 0, 2).reshape(len(white), -1)
    G, g = M.T @ M, M.T @ white
    found, total = [], [log_mean((single + shares).tolist())]
    for m in range(1, len(_SPREAD)):
        if m > len(two):
            total.append(-math.inf)
            continue
        values = free + successive_changes(G, g, 12 * m)
        first = int(np.argmax(values))
        c = two[first : first + m].reshape(-1)
        most_likely, likely = _changes(instants[c], columns[c], white, free, scale)
        total.append(log_mean(values.tolist()) if likely else -math.inf)
        if likely:
            found.append(most_likely)
    fine, value = _located(window, start, white, free, scale, priors.scales, instants, single)
    total[0] = max(total[0], value - math.log(float(window.times_s[-1])))
    odds = float(np.logaddexp.reduce(np.log(_SPREAD) + total)) + PRIOR_ODDS
    best = max((fine, *found), key=lambda f: f.log_evidence)
    if best is not fine:
        at = min(int(np.searchsorted(edges, best.after_s)), n - 1)
        best = replace(
            best, after_1s_s=math.hypot(best.after_1s_s, float(lengths[at]) / math.sqrt(12.0))
        )
    onset = int(np.searchsorted(window.times_s, best.changes_s[0], side="right"))
    return replace(best, log_evidence=odds, onset=onset)


def random_disturbance(
    edges: Array, between: Array, white: Array, free: float, excluded: tuple[float, float]
) -> Explanation:
    """Random torque or force beyond what is allowed for: an impulse between every two scans.

    ``size`` holds the most likely root density of the rate [rad/s^1.5] or of the velocity
    [m/s^1.5], three times each. A constant torque changes the velocity in every interval as well,
    unlike a manoeuvre. From the densities ``excluded`` on, which the earlier poses exclude, a
    disturbance is possible only if it begins within these scans.

    Args:
        edges: (n + 1,) ends of the intervals [s].
        between: (n, 6p, 6) whitened effects of a change of (rate, velocity) in each middle.
        white: (6p,) whitened innovations of free motion.
        free: log evidence of free motion.
        excluded: root densities of torque and force.
    """
    columns, found, n = between * np.sqrt(np.diff(edges))[:, None, None], [], len(between)
    for kind, least in zip(_CHANGES[:2], (SPHERE * excluded[0], excluded[1]), strict=True):
        A = columns[:, :, kind].transpose(1, 0, 2).reshape(len(white), -1)
        odds, fall = _motion.impulse_odds(A.T @ A, A.T @ white, _DENSITIES**2)
        possible = least > _DENSITIES
        odds = np.where(
            possible, odds + math.log(len(odds) / max(int(possible.sum()), 1)), odds - _BEGINS
        )
        k, size = int(np.argmax(odds)), np.zeros(6)
        size[kind] = _DENSITIES[k]
        value = free + log_mean(odds.tolist()) - math.log(2.0) + PRIOR_ODDS
        found.append(
            Explanation(
                Hypothesis.DISTURBED,
                value,
                float(white @ white) - float(fall[k]),
                len(white),
                n,
                size=size,
            )
        )
    return max(found, key=lambda f: f.log_evidence)


def constant_acceleration(
    edges: Array, between: Array, white: Array, free: float, priors: ChangePriors, known: bool
) -> Explanation:
    """A constant torque or force: the same change of the velocity per second in every interval, as
    in :func:`random_disturbance`.

    ``size`` holds the root densities of random disturbances that cause changes as large over the
    window.

    Args:
        edges: (n + 1,) ends of the intervals [s].
        between: (n, 6p, 6) whitened effects of a change of (rate, velocity) in each middle.
        white: (6p,) whitened innovations of free motion.
        free: log evidence of free motion.
        priors: 1 sigma of the size of a change.
        known: one is known to act, and an error of its value is as likely as none.
    """
    M, scale = (
        np.tensordot(np.diff(edges), between, 1),
        _PER_S * np.repeat([priors.rate_radps, priors.velocity_mps], 3),
    )
    found = [
        (kind, *log_evidence(white, free, M[:, kind], f * scale[kind])[:2])
        for kind in _CHANGES
        for f in priors.scales
    ]
    kind, _, u = max(found, key=lambda f: f[1])
    left, size = white - M[:, kind] @ u, np.zeros(6)
    size[kind] = math.sqrt(edges[-1] / 3.0) * np.repeat(np.linalg.norm(u.reshape(-1, 3), axis=1), 3)
    value = log_mean([float(value) for _, value, _ in found]) + (0.0 if known else PRIOR_ODDS)
    dof = len(white) - len(u)
    return Explanation(
        Hypothesis.ACCELERATED, value, float(left @ left), dof, len(between), size=size
    )


def _located(
    window: Window,
    start: Belief,
    white: Array,
    free: float,
    scale: Array,
    scales: Sequence[float],
    instants: Array,
    single: Array,
) -> tuple[Explanation, float]:
    """A change at one unknown instant, and the log of the integral of its evidence over the instant
    [s].

    Precise poses determine the instant more finely than the first grid, and the size depends on it:
    the grid is refined where the evidence lies, and size and covariance are moments over the
    instants.

    ``instants`` (k,) is the first grid, ascending, and ``single`` (k,) the log evidence there.
    """
    columns, first, last = None, 0.0, float(window.times_s[-1])
    for _ in range(_REFINEMENTS):
        weight = np.exp(single - single.max())
        held = np.flatnonzero(weight > _NEGLIGIBLE_EVIDENCE * weight.sum())
        low = first if held[0] == 0 else float(instants[held[0] - 1])
        high = last if held[-1] + 1 == len(instants) else float(instants[held[-1] + 1])
        if columns is not None and high - low > 0.5 * (last - first):
            break
        first, last = low, high
        instants = low + (high - low) * ((np.arange(_FINE) + 0.5) / _FINE)
        columns = after_changes(window, start, instants)
        single = free + mixed(columns, white, scale, _CHANGES, scales)
    if columns is None:
        raise AssertionError("the grid is refined at least once")
    weight = np.exp(single - single.max())
    value = float(single.max()) + math.log(float(weight.sum()) * (last - first) / len(instants))
    share = weight / weight.sum()
    after_s, k = float(share @ instants), int(np.argmax(single))
    spread = math.hypot(
        math.sqrt(float(share @ (instants - after_s) ** 2)),
        (last - first) / _FINE / math.sqrt(12.0),
    )
    used = share > _NEGLIGIBLE_EVIDENCE
    _, sizes, C = log_evidence(white, free, columns[used], scale)
    held = share[used] / share[used].sum()
    size = held @ sizes
    P = (held[:, None, None] * (C + (sizes - size)[:, :, None] * (sizes - size)[:, None, :])).sum(
        axis=0
    )
    below = np.cumsum(share)
    ends = np.clip(
        np.searchsorted(below, [_TAIL, 1.0 - _TAIL]) + np.array([-1, 1]), 0, len(instants) - 1
    )
    at_best, _ = _changes(instants[[k]], columns[[k]], white, free, scale)
    changes = tuple(np.unique(instants[ends]).tolist())
    found = replace(at_best, log_evidence=float(single[k]), after_s=after_s, after_1s_s=spread)
    return replace(found, size=size, P=P, changes_s=changes), value


def after_changes(window: Window, start: Belief, instants: Array) -> Array:
    """Return the derivatives (k, 6p, 6) of the whitened innovations by a change of (rate, velocity)
    at each instant.

    Args:
        window: of the scans.
        start: belief at its begin.
        instants: (k,) since then [s].
    """
    which = np.searchsorted(window.times_s, instants, side="right")
    return _motion.after_changes(window.late, which, impulses(start.x, instants), instants)


def successive_changes(G: Array, g: Array, size: int) -> Array:
    """Return the log evidence over free motion of changes in successive intervals, two in each.

    Args:
        G: (12k, 12k) normal matrix of the changes in k intervals, of unit size.
        g: (12k,) its right side.
        size: 12 times the number of intervals of a manoeuvre.

    Returns:
        The values of the manoeuvres that begin in each interval, as far as they end within the k.
    """
    parts = [slice(k, k + size) for k in range(0, len(g) + 1 - size, 12)]
    return _motion.log_ratio(
        np.array([G[part, part] for part in parts]), np.array([g[part] for part in parts])
    )


def _changes(
    instants: Array, columns: Array, white: Array, free: float, scale: Array
) -> tuple[Explanation, bool]:
    """Changes at given instants, and whether they may be those of a thrust or an impact.

    Size and P are those of their sum, ``after_s`` their mean weighted by size.
    """
    m = len(columns)
    M = np.hstack(list(columns))
    value, u, P = log_evidence(white, free, M, np.tile(scale, m))
    left = white - M @ u
    joined = np.tile(np.eye(6), m)
    share = np.linalg.norm(u.reshape(m, 6) / scale, axis=1)
    share = share / max(float(share.sum()), 1e-300)
    after_s = float(share @ instants)
    found = Explanation(
        Hypothesis.MANOEUVRE,
        float(value),
        float(left @ left),
        len(white) - 6 * m,
        0,
        after_s,
        math.sqrt(float(share @ (instants - after_s) ** 2)),
        joined @ u,
        joined @ P @ joined.T,
        tuple(instants.tolist()),
    )
    return found, m > 1 and _thrust_like(instants, u, P, found)


def _thrust_like(instants: Array, u: Array, P: Array, net: Explanation) -> bool:
    """Return whether changes u (6m,) at ``instants`` (m,), with the sum ``net``, may be those of a
    thrust or an impact.

    The velocity during either lies between those before and after, give or take their difference.
    Changes that cancel displace the target further than that, or leave no change of the velocity:
    they imitate a wrong pose.
    """
    if not net.changes:
        return False
    v, acts = u.reshape(-1, 6)[:, 3:], instants[-1] - instants
    change, moved = v.sum(axis=0), acts @ v
    size = float(np.linalg.norm(change))
    early = float(np.clip(moved @ change / max(size * size, 1e-300), 0.0, acts[0]))
    beyond = moved - early * change
    distance = float(np.linalg.norm(beyond))
    along = (acts - early)[:, None] * np.concatenate([np.zeros(3), beyond / max(distance, 1e-300)])
    variance = float(along.reshape(-1) @ P @ along.reshape(-1))
    return distance <= float(acts[0]) * size + math.sqrt(_NOT_BY_CHANCE * max(variance, 0.0))


def _sensor_bias(window: Window, white: Array, free: float, priors: ChangePriors) -> Explanation:
    """A constant offset of the pose in {A} from one of the scans on: of its range, its
    position, or all of it.
    """
    M, scale = offsets(window, priors)
    columns = window.since_each(M)[1:]
    values = free + mixed(columns, white, scale, OFFSETS)
    onset = int(np.argmax(values)) + 1
    whitened = columns[onset - 1][:, :6]
    _, u, P = log_evidence(white, free, whitened, scale[:6])
    left = white - whitened @ u
    odds = log_mean(values.tolist()) + PRIOR_ODDS
    return Explanation(
        Hypothesis.SENSOR_BIAS, odds, float(left @ left), len(white) - 6, onset, size=u, P=P
    )
