"""How far the truth may lie from a fit: its covariance, mended where the likelihood is not normal.

Before a few turns are seen, some directions of the inertia are known so poorly that the valley of the cost bends within
its own 1 sigma; the curvature at its bottom then denies most of it. Two sigma along each of the weakest directions
the cost is compared with the normal one. Where it is bent, the fit is repeated with that direction held to either side
where the cost, minimised over all else, has risen by 3/2, as it does at root three sigma of a normal one: with weights
1/6, 4/6, 1/6 (Gauss-Hermite) the three fits, each with the covariance that is left there, carry the second moments.
They are taken at the instant asked for, after each has moved there, in the chart's coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avsreplay.estimate.chart import Chart, to_chart, to_errors, to_state
from avsreplay.estimate.fit import FitParams, Fitted, Pin, Poses, Prior, cost, pinned
from avsreplay.estimate.layout import DIM
from avsreplay.estimate.motion import moved
from avsreplay.geometry import Array
from avsreplay.records import Belief, State

__all__ = ["Bend", "Node", "Spread", "belief_at", "carried", "spread"]

_NODE, _WEIGHT = np.sqrt(3.0), 1.0 / 6.0
_TRIAL = 2.0  # sigma
_RISE, _TRIES = 0.5 * _NODE**2, 4
_PIN_1S = 0.02  # of the direction's sigma


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """A fit held to one side of a bent direction, and what is left of its covariance P (20, 20) there."""

    chart: Chart
    P: Array


@dataclass(frozen=True, slots=True, eq=False)
class Bend:
    """A bent direction: its part of P_chart, ``ray ray'``, and the fits held to either side."""

    ray: Array
    sides: tuple[Node, Node]


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """A fit with its bent directions; ``settled`` where there are none: the covariance alone then tells the truth."""

    fitted: Fitted
    bends: tuple[Bend, ...]

    @property
    def settled(self) -> bool:
        """Is the likelihood normal as far as two sigma?"""
        return not self.bends


def spread(poses: Poses, fitted: Fitted, prior: Prior, params: FitParams) -> Spread:
    """Try the weakest directions of a fit (relative to the prior) and follow the bent ones."""
    scale = prior.one_sigma
    values, vectors = np.linalg.eigh(fitted.P_chart / np.outer(scale, scale))
    bends = []
    for value, vector in zip(values[::-1][: params.try_directions], vectors.T[::-1], strict=False):
        ray = vector * scale * np.sqrt(max(float(value), 0.0))
        if _bent(poses, fitted, prior, params, ray):
            row = vector / scale / np.sqrt(value)  # 1 at the end of the ray
            sides = [_held(poses, fitted, prior, params, ray, row, s) for s in (_NODE, -_NODE)]
            bends.append(Bend(ray, (sides[0], sides[1])))
    return Spread(fitted, tuple(bends))


def _bent(poses: Poses, fitted: Fitted, prior: Prior, params: FitParams, ray: Array) -> bool:
    normal = 0.5 * _TRIAL**2
    for side in (_TRIAL, -_TRIAL):
        rise = cost(poses, fitted.chart.moved(side * ray), prior, params, fitted.effective) - fitted.half_chi2
        if not normal / params.bend_max < rise < normal * params.bend_max:
            return True
    return False


def _held(poses: Poses, fitted: Fitted, prior: Prior, params: FitParams, ray: Array, row: Array, side: float) -> Node:
    """The fit held to one side, at most ``_TRIES`` times, until the cost has risen as it should."""
    there, P = fitted.chart.moved(side * ray), fitted.P_chart
    for _ in range(_TRIES):
        there, P = pinned(poses, there, prior, params, fitted.effective, Pin(fitted.chart, row, side, _PIN_1S))
        rise = cost(poses, there, prior, params, fitted.effective) - fitted.half_chi2
        if abs(rise - _RISE) < 0.2 * _RISE:
            break
        side *= float(np.clip(np.sqrt(_RISE / max(rise, 1e-9)), 0.4, 2.5))
    return Node(there, P)


def belief_at(found: Spread, t_ns: int, after_s: float) -> Belief:
    """Mean of the fit and its mended covariance, ``after_s`` after the epoch; ``t_ns`` is that instant."""
    fitted = found.fitted
    x, step = carried(fitted.chart, after_s)
    here = to_chart(x)
    P0 = fitted.P_chart - sum((np.outer(b.ray, b.ray) for b in found.bends), np.zeros((DIM, DIM)))
    P = (1.0 - 2.0 * _WEIGHT * len(found.bends)) * step @ P0 @ step.T
    for node in (side for bend in found.bends for side in bend.sides):
        there, step = carried(node.chart, after_s)
        y = to_chart(there).minus(here)
        P += _WEIGHT * (np.outer(y, y) + step @ node.P @ step.T)
    T = to_errors(here)
    P = T @ P @ T.T
    return Belief(t_ns, x, 0.5 * (P + P.T))


def carried(chart: Chart, h: float) -> tuple[State, Array]:
    """The state h seconds on, and the derivative (20, 20) of its chart by the one at the epoch."""
    there, Phi = moved(to_state(chart), h)
    return there, np.asarray(np.linalg.solve(to_errors(to_chart(there)), Phi @ to_errors(chart)))
