"""Start without a belief: the rate from the first poses, then the fit over all of them, until the filter may go on.

The fit is repeated each time the poses have grown by a stated share (``fitting`` says when). It has settled once its
likelihood is normal (``spread`` finds no bent direction) and the poses, not the prior, tell every direction: then the
filter may take over with the fit's mean and covariance. A body of which something can never be told stays with the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.chart import Chart, to_chart
from avsreplay.estimate.drift import disturbed
from avsreplay.estimate.fit import FitParams, Fitted, Poses, Prior, cost, fit
from avsreplay.estimate.layout import DIM, boxplus
from avsreplay.estimate.params import EstimatorParams
from avsreplay.estimate.robust import BOUND
from avsreplay.estimate.spread import Spread, belief_at, spread
from avsreplay.estimate.start import PoseFix, rates
from avsreplay.geometry import Array
from avsreplay.records import Belief, State

__all__ = ["ColdFit", "given_prior", "poses_of", "prior_of", "refit", "rough_state"]

_PAIR_RAD = 0.7
_DRAWS, _EDGE = 500, 0.99
_TOLD = 0.5  # of the prior's sigma: what is known no better is told by the prior


@dataclass(frozen=True, slots=True, eq=False)
class ColdFit:
    """The last fit: its values at the epoch (the first pose), how many poses it had, and what came of it.

    Attributes:
        epoch_ns: instant of the first pose.  chart: values there, where the next fit starts.  count: poses.
        factors, colour: (2,) noise factors and time correlation, of attitude and position.
        belief: at the last pose.  settled: may the filter take over.
        forsaken: the poses contradict what was given, and it was left out.
    """

    epoch_ns: int
    chart: Chart
    count: int
    factors: Array
    colour: Array
    belief: Belief
    settled: bool
    forsaken: bool = False


def poses_of(fixes: tuple[PoseFix, ...]) -> Poses:
    """The fixes as the fit takes them, times from the first."""
    t0 = fixes[0].t_ns
    return Poses(
        np.array([(f.t_ns - t0) * 1e-9 for f in fixes]),
        np.array([f.T_ac.q for f in fixes]),
        np.array([f.T_ac.t for f in fixes]),
        np.array([f.C for f in fixes]),
    )


def prior_of(poses: Poses, params: EstimatorParams) -> Prior:
    """The weak belief: a sphere at rest at the first pose, centred at its fixture, everything wide."""
    mean = Chart(poses.q[0], np.zeros(3), poses.t[0], np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.eye(3))
    arm = params.length("start_varrho_1s_m")
    speed = params.length("start_vel_1s_mps") + params.start_rate_1s_radps * arm
    widths = [2.0, params.start_rate_1s_radps, 4.0 * arm, speed, params.start_log_inertia_1s, arm]
    return Prior(mean, np.diag(np.repeat(widths, [3, 3, 3, 3, 5, 3]) ** 2))


def given_prior(belief: Belief) -> Prior:
    """A given belief in the chart's coordinates, by draws from it.

    Its derivative would not do: where two moments are nearly equal, what the belief says of the axes mu matters as far
    as the moments differ, and that the belief does not know.
    """
    mean, root = to_chart(belief.x), np.linalg.cholesky(belief.P)
    draws = np.random.Generator(np.random.PCG64(0)).standard_normal((_DRAWS, DIM)) @ root.T
    y = np.array([to_chart(_bounded(boxplus(belief.x, d))).minus(mean) for d in np.concatenate([draws, -draws])])
    return Prior(mean, y.T @ y / len(y))


def _bounded(x: State) -> State:
    return replace(x, sigma=np.clip(x.sigma, -_EDGE, _EDGE))


def rough_state(fixes: tuple[PoseFix, ...]) -> State:
    """A sphere spinning about its fixture at the poses' rate: medians, so that single false poses do not matter.

    Neighbours give a coarse rate; pairs as far apart as turns by about 0.7 rad then give a finer one.
    """
    coarse = _median_rates(fixes, 1)[0]
    step = (fixes[-1].t_ns - fixes[0].t_ns) * 1e-9 / max(1, len(fixes) - 1)
    angle = float(np.linalg.norm(coarse)) * step
    apart = int(np.clip(_PAIR_RAD / max(angle, 1e-3), 1, max(1, len(fixes) // 2)))
    w, v = _median_rates(fixes[: 3 * apart], apart)
    first = fixes[0].T_ac
    return State(first.q, w, first.t, v, np.zeros(2), np.zeros(3), geometry.IDENTITY_QUAT)


def _median_rates(fixes: tuple[PoseFix, ...], apart: int) -> tuple[Array, Array]:
    """Rate in {C} and velocity in {A}: medians over pairs of poses ``apart``."""
    found = [rates((a, b)) for a, b in zip(fixes, fixes[apart:], strict=False)]
    return np.median([w for w, _ in found], axis=0), np.median([v for _, v in found], axis=0)


def refit(
    fixes: tuple[PoseFix, ...],
    params: EstimatorParams,
    rules: FitParams,
    last: ColdFit | None = None,
    start: Chart | None = None,
    given: Prior | None = None,
) -> ColdFit:
    """Fit all poses, from ``start`` or the last fit's values if there are any; ``given``: known at the first pose.

    What is given is left out once the poses contradict it.
    """
    poses = poses_of(fixes)
    prior = weak = prior_of(poses, params)
    if start is None:
        start = to_chart(rough_state(fixes)) if last is None else last.chart
    rules = replace(rules, least_colour=params.colour(_mean_turn(poses), float(np.mean([f.share for f in fixes]))))
    factors = None if last is None else last.factors * np.sqrt(last.colour)
    fitted = fit(poses, start, weak, rules, factors)
    forsaken = last is not None and last.forsaken
    if given is not None and not forsaken:
        joint = fit(poses, start, given, rules, factors)
        forsaken = _contradicts(poses, fitted, weak, joint, given, rules)
        fitted, prior = (fitted, weak) if forsaken else (joint, given)
    found = spread(poses, fitted, prior, rules)
    found = disturbed(found, poses, prior, rules, params.torque_noise_radps15, params.force)
    now_ns = fixes[-1].scan_ns
    belief = belief_at(found, now_ns, (now_ns - fixes[0].t_ns) * 1e-9)
    settled = _settled(found, weak)
    return ColdFit(fixes[0].t_ns, fitted.chart, len(poses), fitted.factors, fitted.colour, belief, settled, forsaken)


def _contradicts(poses: Poses, fitted: Fitted, weak: Prior, joint: Fitted, given: Prior, rules: FitParams) -> bool:
    """Do the poses, at the noise that they show by themselves, cost too much more with what is given than without it?

    Where it is right, twice the difference is chi-square with 20 degrees of freedom at most.
    """
    alone = cost(poses, fitted.chart, weak, rules, fitted.effective)
    return 2.0 * (cost(poses, joint.chart, given, rules, fitted.effective) - alone) > BOUND


def _mean_turn(poses: Poses) -> float:
    """Rotation from one pose to the next [rad], mean."""
    steps = geometry.multiply(geometry.conjugate(poses.q[:-1]), poses.q[1:])
    return float(np.mean(geometry.angle(steps)))


def _settled(found: Spread, weak: Prior) -> bool:
    fitted = found.fitted
    told = np.linalg.eigvalsh(fitted.P_chart / np.outer(weak.one_sigma, weak.one_sigma))[-1] < _TOLD**2
    return found.settled and bool(told) and fitted.converged
