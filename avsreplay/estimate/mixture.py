"""The result of a fit as a mixture of Gaussians, carried on from scan to scan until the next fit.

Each component is linearised about its own trajectory: a pose corrects its mean and covariance as in
the filter, and its weight by the likelihood of the pose. No new fit is needed while the weights are
still those of a quadrature.

Covariance and Jacobians of a component follow the trajectory that the fit gave it, not its
corrected mean. In a spin about a principal axis the effect of the inertia is proportional to the
nutation, whose estimate is noise. With a point of linearisation that moves from pose to pose, a
direction without information would seem to have some (first-estimates Jacobians: Huang, Mourikis,
Roumeliotis, Int. J. Robotics Research 29, 2010), and the predicted covariance of an instant would
rise and fall from pose to pose. Along one trajectory and without disturbances, each pose can only
reduce it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.chart import Chart, separated, to_chart, to_errors, to_state
from avsreplay.estimate.dynamics import MOST_RAD, forecast_of, torque_density, translation
from avsreplay.estimate.error_state import DIM, definite, rotation
from avsreplay.estimate.noise import BOUND, NO_INFLATION
from avsreplay.estimate.pose_noise import cholesky_root
from avsreplay.estimate.relative_orbit import RelativeOrbit
from avsreplay.geometry import Array, Pose
from avsreplay.records import Belief, Forecast

_NO_POSE = np.zeros((6, 6))  # root of the information of a scan without a pose
_SMALL_EXCESS = 1.1  # largest ratio of the corrected covariance to that of the last pose
_POSE = np.ix_(
    [0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8]
)  # half angle in {C} and position in {A} of the chart's steps
_ORIGIN = (0.0, 0.0, 0.0)
_MOVED = 0.5  # sum of the changes of the weights above which the mixture is not a quadrature


@value_class
class Component:
    """One Gaussian of a mixture.

    The covariance is in the chart: where two moments are nearly equal, rounding of the much larger
    error states of mu would spoil that of the other states.

    Attributes:
        weight: by now.
        quadrature: its weight at the fit.
        t_ns: instant of ``chart``, its mean, and of ``P`` (20, 20), its covariance in the chart.
        share: part of the correction by process noise that the mean contains.
        reference: motion about which ``P`` is linearised, ``chart`` where it is None.
    """

    weight: float
    quadrature: float
    t_ns: int
    chart: Chart
    P: Array
    share: float = 1.0
    reference: Chart | None = None


def moments(components: tuple[Component, ...]) -> Belief:
    """Mean and second moments about it: the mean of the first component, and what the weights
    have moved it since.
    """
    return _belief(_joined(components))


@lru_cache(maxsize=4)
def _belief(joined: Component) -> Belief:
    chart = separated(joined.chart, joined.P)
    T = to_errors(chart)
    P = T @ joined.P @ T.T
    return Belief(joined.t_ns, to_state(chart), 0.5 * (P + P.T))


@lru_cache(maxsize=4)
def _joined(components: tuple[Component, ...]) -> Component:
    """One Gaussian with the moments of the mixture."""
    first = components[0]
    if len(components) == 1:
        return first
    chart, P = _motion.join(
        np.array([c.chart.flat for c in components]),
        np.array([c.P for c in components]),
        np.array([c.weight for c in components]),
        np.array([c.quadrature for c in components]),
    )
    return Component(1.0, 1.0, first.t_ns, Chart(chart), P, first.share)


def worn(components: tuple[Component, ...]) -> bool:
    """Return whether the poses since the fit have changed the weights so much that another fit is
    due.
    """
    return sum(abs(c.weight - c.quadrature) for c in components) > _MOVED


def volumes(P: Sequence[Array], rows: Sequence[Array]) -> Array:
    """Volumes (n,) of 1 sigma of n covariances, relative to the largest one.

    The probability of a fit with some directions fixed is that of its cost times this volume
    (Laplace's approximation): a spin that is unstable for an inertia needs initial values in a
    small volume to look like the measured one.

    Args:
        P: n covariances (20, 20) in chart steps.
        rows: (20,) each, of the coordinates along the fixed directions, which are given.
    """
    R = np.reshape(rows, (-1, DIM))
    logs = np.array([np.linalg.slogdet(C)[1] - np.linalg.slogdet(R @ C @ R.T)[1] for C in P])
    return (
        np.asarray(np.exp(0.5 * (logs - logs.max())))
        if np.isfinite(logs).all()
        else np.ones(len(P))
    )


def _along(components: tuple[Component, ...], references: list[Chart]) -> _motion.Mixture:
    """The components as the extension takes them; ``references``: charts along which their
    covariances are taken.
    """
    return _motion.Mixture(
        charts=np.array([c.chart.flat for c in components]),
        references=np.array([chart.flat for chart in references]),
        P=np.array([c.P for c in components]),
    )


def carried(
    components: tuple[Component, ...],
    t_ns: int,
    pose: Pose,
    root: Array,
    factors: Array,
    weight: float,
    noise: tuple[float, float],
    orbit: RelativeOrbit | None = None,
) -> tuple[Component, ...]:
    """The mixture at a later pose, and corrected by it.

    Args:
        components: after an earlier pose.
        t_ns: instant of the pose [ns].
        pose: measured T_ac.
        root: (6, 6), lower triangular; root' root is the information of d = [theta; v] in {C} [rad,
            m], T_true = T_ac Exp(d). It may be singular.
        factors: (2,) on the standard deviations of attitude and position.
        weight: Cauchy weight of the pose.
        noise: root densities of torque [rad/s^1.5] and force [m/s^1.5].
        orbit: the relative orbit that the target is on; None for free motion.
    """
    h = (t_ns - components[0].t_ns) * 1e-9
    path = translation(h, None if orbit is None else orbit.at(components[0].t_ns))
    scale = float(factors[0]), float(factors[1])
    after, misfits = _motion.carry(
        _along(components, [c.reference or c.chart for c in components]),
        _motion.Step(h=h, path=path, torque=noise[0], force=noise[1] ** 2),
        _motion.Weighed(q=pose.q, t=pose.t, root=root, factors=scale, weight=weight),
    )
    charts, references, P, found = after.charts, after.references, after.P, misfits.tolist()
    # one of weight 0 keeps it, however well it explains the pose
    best = min(value for c, value in zip(components, found, strict=True) if c.weight > 0.0)
    weights = [
        c.weight * math.exp(0.5 * (best - value)) if c.weight > 0.0 else 0.0
        for c, value in zip(components, found, strict=True)
    ]
    total = sum(weights)
    return tuple(
        Component(
            weights[k] / total,
            c.quadrature,
            t_ns,
            Chart(charts[k]),
            definite(P[k]),
            c.share,
            Chart(references[k]),
        )
        for k, c in enumerate(components)
    )


def without_pose(
    components: tuple[Component, ...],
    t_ns: int,
    near: Pose,
    noise: tuple[float, float],
    orbit: RelativeOrbit | None,
) -> tuple[Component, ...]:
    """The mixture at another instant, as ``carried`` with a pose ``near`` its own that has no
    information.
    """
    return carried(components, t_ns, near, _NO_POSE, NO_INFLATION, 1.0, noise, orbit)


def not_worse(
    components: tuple[Component, ...],
    t_ns: int,
    pose: Pose,
    C: Array,
    weight: float,
    noise: tuple[float, float],
    orbit: RelativeOrbit | None = None,
) -> tuple[Component, ...]:
    """The result of a fit, corrected by its last pose where it states that pose less precisely than
    it was measured.

    A fit weights all poses alike and adds the covariance that disturbances cause afterwards. Where
    these are large, its mean at the last pose is far from that pose. In the directions in which the
    pose's covariance S exceeds C, the pose is used as a measurement with the information C^-1 -
    S^-1, which makes the posterior covariance C. As the fit has used the pose before, it is not
    made smaller than that.

    Args:
        components: the result of the fit.
        t_ns: instant of its last pose [ns]: the mean instant of the points, where each has its own
            time.
        pose: that pose T_ac, as measured.
        C: (6, 6) covariance of d = [theta; v] in {C} [rad, m], T_true = T_ac Exp(d).
        weight: Cauchy weight of the pose.
        noise: root densities of torque [rad/s^1.5] and force [m/s^1.5].
        orbit: the relative orbit that the target is on; None for free motion.
    """
    whiten = _motion.roots(C[None])[0]
    if components[0].t_ns != t_ns:
        components = without_pose(components, t_ns, pose, noise, orbit)
    values, axes = _excess(components, whiten)
    if values[-1] <= 1.0:
        return components
    root = _missing(values, axes, whiten)
    after = carried(components, t_ns, pose, root, np.ones(2), weight, noise, orbit)
    if _excess(after, whiten)[0][-1] <= _SMALL_EXCESS:
        return after
    # the components lie further apart than C: the pose can only move each of them within its own
    # covariance
    return carried((_joined(components),), t_ns, pose, root, np.ones(2), weight, noise, orbit)


def _excess(components: tuple[Component, ...], whiten: Array) -> tuple[Array, Array]:
    """Ascending eigenvalues of S in units of C, and their directions in columns; ``whiten`` C
    whiten' = 1.
    """
    joined = _joined(components)
    R_ac = rotation(joined.chart.q_ac)
    J = np.hstack([2.0 * whiten[:, :3], whiten[:, 3:] @ R_ac.T])
    values, axes = np.linalg.eigh(J @ joined.P[_POSE] @ J.T)
    return values, axes


def _missing(values: Array, axes: Array, whiten: Array) -> Array:
    """Lower triangular root of C^-1 - S^-1 in the directions in which S exceeds C."""
    G = np.sqrt(1.0 - 1.0 / np.maximum(values, 1.0))[:, None] * axes.T @ whiten
    _, upper = np.linalg.qr(G[:, ::-1])
    return np.ascontiguousarray(upper[::-1, ::-1])


def mixture_forecast(
    components: tuple[Component, ...],
    t_ns: int,
    times_s: Array,
    torque: float,
    force: float,
    origin_c: tuple[float, float, float] = _ORIGIN,
) -> Forecast:
    """Predicted 1 sigma of the grasp point about the published motion, each component about its own
    trajectory.

    About the mean alone the propagation would be wrong by orders of magnitude where the components
    differ in inertia: a spin that is stable for one of them is unstable for another.

    Args:
        components: at the last pose.
        t_ns: the present instant [ns].
        times_s: (n,) >= 0, ascending [s after the present].
        torque: root density of the angular disturbance [rad/s^1.5].
        force: root density of the linear disturbance [m/s^1.5].
        origin_c: (3,) the grasp point in the frame of the components' fixture [m].
    """
    times = np.asarray(times_s, dtype=np.float64)
    ahead, published = times + (t_ns - components[0].t_ns) * 1e-9, _joined(components)
    about = [separated(c.reference or c.chart, c.P) for c in components]
    fastest = max(
        float(np.abs(chart.w_c).max())
        for chart in (*about, *(c.chart for c in components), published.chart)
    )
    if fastest * float(ahead.max(initial=0.0)) > MOST_RAD:
        return Forecast(times, *np.full((3, len(times)), np.inf))
    moments = _motion.mixture_forecast(
        _along(components, about),
        np.array([c.weight for c in components]),
        np.array([torque_density(to_state(chart).sigma, torque) for chart in about]),
        separated(published.chart, published.P).flat,
        force**2,
        ahead,
        origin_c,
    )
    return forecast_of(times, moments)


def contradicted(belief: Belief, fitted: Belief) -> bool:
    """Return whether the means differ by more than 99.99 % of the larger covariance, both at one
    instant.

    Both use the same poses. Where a fit is efficient, their difference has the covariance P - P_fit
    (Hausman's test), which is below P; a belief that claims less than the fit may differ by the
    fit's covariance. In each generalised eigendirection of P and P_fit the larger of the two is
    therefore the scale. The difference is taken in the chart, where the order of the axes has no
    effect.
    """
    here, there = to_chart(belief.x), to_chart(fitted.x)
    T = to_errors(there)
    root = cholesky_root(fitted.P)
    claimed = np.linalg.solve(root, T @ np.linalg.solve(to_errors(here), cholesky_root(belief.P)))
    ratios, axes = np.linalg.eigh(claimed @ claimed.T)
    y = axes.T @ np.linalg.solve(root, T @ here.minus(there))
    return float(np.sum(y * y / np.maximum(ratios, 1.0))) > BOUND
