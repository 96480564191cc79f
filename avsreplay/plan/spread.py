"""How far a plan may be trusted: the end time and the miss over the belief it was made from.

The planner does not know the estimator: it is handed one future of the target per draw of the error state. Draws give
means, quantiles and the probability of a capture; the 2n + 1 sigma points give means and spreads with fewer futures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array
from avsreplay.plan.flight import Path
from avsreplay.plan.hindsight import Tolerance
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.records import Trajectory

__all__ = ["Band", "Future", "Spread", "draws", "sigma_points", "spread"]


@dataclass(frozen=True, slots=True, eq=False)
class Future:
    """One way the target may go on.

    Attributes:
        goal: its grasp point after the instant of planning.
        attitude: seconds after it -> q_ac (4,); None where attitude is not asked for.
        weight: its share; the shares of all futures sum to 1 (a sigma point's may be negative).
    """

    goal: Trajectory
    attitude: Callable[[float], Array] | None = None
    weight: float = math.nan


@dataclass(frozen=True, slots=True)
class Band:
    """Mean, standard deviation and 5-95 % of a quantity over the futures (quantiles NaN for sigma points)."""

    mean: float
    std: float
    p05: float
    p95: float


@dataclass(frozen=True, slots=True)
class Spread:
    """A plan over the belief.

    Attributes:
        futures: how many.  t_go_s: the end time each future would have had on its own.
        infeasible: futures in which no capture lies within the horizon.
        miss_m, speed_mps, angle_deg: of the one plan flown, against each future.
        probability: share of futures inside the tolerance, NaN for sigma points.
    """

    futures: int
    t_go_s: Band
    infeasible: int
    miss_m: Band
    speed_mps: Band
    angle_deg: Band
    probability: float


def draws(P: Array, count: int, rng: np.random.Generator) -> Array:
    """(count, n) draws of an error state with covariance P (n, n).

    Raises ValueError where P is not finite, symmetric and non-negative, or count is not positive.
    """
    if count < 1:
        raise ValueError(f"count is {count}, must be at least 1")
    out: Array = rng.standard_normal((count, len(P))) @ _root(P).T
    return out


def sigma_points(P: Array) -> tuple[Array, Array]:
    """(2n + 1, n) sigma points of covariance P and their weights: 0 and +-sqrt(n) columns of its root (kappa = 0)."""
    root = _root(P) * math.sqrt(len(P))
    points = np.concatenate([np.zeros((1, len(P))), root.T, -root.T])
    weights = np.full(len(points), 0.5 / len(P))
    weights[0] = 0.0
    return points, weights


def _root(P: Array) -> Array:
    if P.ndim != 2 or P.shape[0] != P.shape[1] or not np.isfinite(P).all():
        raise ValueError(f"covariance of shape {P.shape} is not a finite square matrix")
    scale = np.sqrt(np.maximum(np.diagonal(P), 0.0))
    safe = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(0.5 * (P + P.T) / np.outer(safe, safe))
    if values[0] < -1e-6 or np.any(np.diagonal(P) < 0.0):
        raise ValueError(f"covariance is not positive: least eigenvalue of its correlation is {values[0]:.3g}")
    root: Array = safe[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def spread(
    path: Path,
    futures: Sequence[Future],
    start: tuple[Array, Array],
    params: PlanParams,
    tolerance: Tolerance,
    attitude: Array | None = None,
) -> Spread:
    """Fly one plan against every future, and ask what each would have planned.

    Args:
        path: the plan made from the mean.
        futures: from ``draws`` (no weights) or ``sigma_points`` (with weights).
        start: position and velocity (3,) of the robot at the instant of planning.
        params: see PlanParams.
        tolerance: what counts as a capture.
        attitude: (4,) q_ac that the gripper is turned to at the end.

    Raises:
        ValueError: there is no future.
    """
    if not futures:
        raise ValueError("there is no future to fly against")
    drawn = math.isnan(futures[0].weight)
    weights = np.full(len(futures), 1.0 / len(futures)) if drawn else np.array([f.weight for f in futures])
    end = np.array([path.t_go_s])
    r, v = path.at(end)
    misses = np.array([_against(future, end, r[0], v[0], attitude) for future in futures])
    own = np.array([rendezvous(future.goal, *start, params).t_go_s for future in futures])
    limits = (tolerance.position_m, tolerance.speed_mps, tolerance.angle_deg)
    inside = np.all((misses <= limits) | np.isnan(misses), axis=1)
    return Spread(
        futures=len(futures),
        t_go_s=_band(own, weights, drawn),
        infeasible=int(np.isnan(own).sum()),
        miss_m=_band(misses[:, 0], weights, drawn),
        speed_mps=_band(misses[:, 1], weights, drawn),
        angle_deg=_band(misses[:, 2], weights, drawn),
        probability=float(inside.mean()) if drawn else math.nan,
    )


def _against(future: Future, end: Array, r: Array, v: Array, attitude: Array | None) -> tuple[float, float, float]:
    rho, rate = future.goal(end)
    turn = math.nan
    if attitude is not None and future.attitude is not None:
        q = geometry.multiply(geometry.conjugate(future.attitude(float(end[0]))), attitude)
        turn = math.degrees(float(geometry.angle(q)))
    return float(np.linalg.norm(rho[0] - r)), float(np.linalg.norm(rate[0] - v)), turn


def _band(values: Array, weights: Array, drawn: bool) -> Band:
    known = np.isfinite(values)
    if not known.any() or weights[known].sum() <= 0.0:
        return Band(math.nan, math.nan, math.nan, math.nan)
    values, weights = values[known], weights[known] / weights[known].sum()
    mean = float(weights @ values)
    std = math.sqrt(max(float(weights @ (values - mean) ** 2), 0.0))
    p05, p95 = np.quantile(values, (0.05, 0.95)).tolist() if drawn else (math.nan, math.nan)
    return Band(mean, std, p05, p95)
