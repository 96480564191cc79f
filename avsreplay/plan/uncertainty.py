"""Monte Carlo evaluation of a plan over the belief from which it was made.

The planner does not depend on the estimator: each draw of the error state is passed as one possible future of the
target.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array
from avsreplay.plan.evaluation import Tolerance
from avsreplay.plan.path import RobotPath
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.records import Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Future:
    """One possible motion of the target after the instant of planning.

    Attributes:
        goal: Trajectory of the grasp point.
        attitude: Time after planning [s] -> q_ac (4,); None where the attitude is not evaluated.
    """

    goal: Trajectory
    attitude: Callable[[float], Array] | None = None


@dataclass(frozen=True, slots=True)
class Band:
    """Mean, standard deviation, 5 % and 95 % quantile over the futures."""

    mean: float
    std: float
    p05: float
    p95: float


@dataclass(frozen=True, slots=True)
class Spread:
    """Distribution of capture time and terminal errors over the belief.

    Attributes:
        futures: Number of futures.
        t_go_s: Least time to go in each future.
        infeasible: Number of futures without a capture within the horizon.
        miss_m, speed_mps, angle_deg: Terminal errors of the one plan in each future.
        probability: Fraction of futures in which the errors are within the tolerance.
    """

    futures: int
    t_go_s: Band
    infeasible: int
    miss_m: Band
    speed_mps: Band
    angle_deg: Band
    probability: float


def draws(P: Array, count: int, rng: np.random.Generator) -> Array:
    """Draw error states from a normal distribution.

    Args:
        P: (n, n) covariance; it may be singular.
        count: Number of draws.
        rng: Random generator.

    Returns:
        (count, n) draws.

    Raises:
        ValueError: P is not finite, symmetric and positive semidefinite, or count is below 1.
    """
    if count < 1:
        raise ValueError(f"count is {count}, must be at least 1")
    out: Array = rng.standard_normal((count, len(P))) @ _root(P).T
    return out


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
    path: RobotPath,
    futures: Sequence[Future],
    start: tuple[Array, Array],
    params: PlanParams,
    tolerance: Tolerance,
    attitude: Array | None = None,
) -> Spread:
    """Evaluate one plan in every future, and plan anew for each future.

    Args:
        path: Path planned for the mean of the belief.
        futures: Possible motions of the target, equally probable.
        start: Position and velocity (3,) of the robot at the instant of planning.
        params: Parameters of robot and planner.
        tolerance: Largest errors of a capture.
        attitude: (4,) q_ac of the gripper at the end.

    Raises:
        ValueError: There is no future.
    """
    if not futures:
        raise ValueError("there is no future in which to evaluate the plan")
    end = np.array([path.t_go_s])
    r, v = path.at(end)
    misses = np.array([_terminal_errors(future, end, r[0], v[0], attitude) for future in futures])
    own = np.array([rendezvous(future.goal, *start, params).t_go_s for future in futures])
    limits = (tolerance.position_m, tolerance.speed_mps, tolerance.angle_deg)
    inside = np.all((misses <= limits) | np.isnan(misses), axis=1)
    return Spread(
        futures=len(futures),
        t_go_s=_band(own),
        infeasible=int(np.isnan(own).sum()),
        miss_m=_band(misses[:, 0]),
        speed_mps=_band(misses[:, 1]),
        angle_deg=_band(misses[:, 2]),
        probability=float(inside.mean()),
    )


def _terminal_errors(
    future: Future, end: Array, r: Array, v: Array, attitude: Array | None
) -> tuple[float, float, float]:
    rho, rate = future.goal(end)
    turn = math.nan
    if attitude is not None and future.attitude is not None:
        q = geometry.multiply(geometry.conjugate(future.attitude(float(end[0]))), attitude)
        turn = math.degrees(float(geometry.angle(q)))
    return float(np.linalg.norm(rho[0] - r)), float(np.linalg.norm(rate[0] - v)), turn


def _band(values: Array) -> Band:
    values = values[np.isfinite(values)]
    if not len(values):
        return Band(math.nan, math.nan, math.nan, math.nan)
    weights = np.full(len(values), 1.0 / len(values))
    mean = float(weights @ values)
    std = math.sqrt(max(float(weights @ (values - mean) ** 2), 0.0))
    return Band(mean, std, *np.quantile(values, (0.05, 0.95)).tolist())
