"""Monte Carlo evaluation of a plan over the belief from which it was made and over the errors of
the thrust.

The planner does not depend on the estimator: each draw of the error state is passed as one possible
future of the target.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.plan.contact import Contact
from avsreplay.plan.limits import Scene, in_fixture_axes
from avsreplay.plan.path import RobotPath

CONTACT_INSTANTS = 401  # instants of a plan at which contact is checked


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Largest position error, relative speed and attitude error of a successful capture."""

    position_m: float = 0.02
    speed_mps: float = 0.01
    angle_deg: float = 2.0

    def __post_init__(self) -> None:
        for name in ("position_m", "speed_mps", "angle_deg"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}, must be a finite number above 0")

    @property
    def in_si(self) -> tuple[float, float, float]:
        """Position [m], speed [m/s] and angle [rad]."""
        return self.position_m, self.speed_mps, math.radians(self.angle_deg)


@value_class(eq=True)
class Band:
    """Mean, standard deviation, 5 % and 95 % quantile over the futures."""

    mean: float
    std: float
    p05: float
    p95: float


@value_class(eq=True)
class Spread:
    """Distribution of capture time and terminal errors over the belief.

    Attributes:
        futures: Number of futures.
        t_go_s: Least time to go in each future.
        infeasible: Number of futures for which no plan was found.
        miss_m, speed_mps, angle_deg: Terminal errors of the one plan in each future.
        probability: Fraction of futures in which the errors are within the tolerance.
        probability_95: Its Wilson 95 % interval.
        contact: Fraction of futures in which the end-effector touches the body outside the
            grasp; NaN: not checked.
        contact_95: Its Wilson 95 % interval.
    """

    futures: int
    t_go_s: Band
    infeasible: int
    miss_m: Band
    speed_mps: Band
    angle_deg: Band
    probability: float
    probability_95: tuple[float, float]
    contact: float = math.nan
    contact_95: tuple[float, float] = (math.nan, math.nan)

    def described(self) -> list[tuple[str, str]]:
        """Return the figures as names and texts."""
        t, (low, high) = self.t_go_s, self.probability_95
        out = [
            (
                "t_go over belief",
                (
                    f"mean {t.mean:.3f} s, 5-95 % {t.p05:.3f} to {t.p95:.3f} s; no plan in"
                    f" {self.infeasible} of the draws"
                ),
            ),
            ("miss over belief", _text(self.miss_m, 1e3, "mm", 2)),
            ("speed over belief", _text(self.speed_mps, 1e3, "mm/s", 2)),
            ("angle over belief", _text(self.angle_deg, 1.0, "deg", 3)),
            (
                "plan flown blind",
                (f"{self.probability:.3f} (95 % {low:.3f} to {high:.3f}) in {self.futures} draws"),
            ),
        ]
        if self.contact >= 0.0:
            low, high = self.contact_95
            text = f"{self.contact:.3f} (95 % {low:.3f} to {high:.3f}) outside the grasp"
            out.append(("contact, flown blind", text))
        return out


def _text(band: Band, scale: float, unit: str, digits: int) -> str:
    mean, p05, p95 = (f"{scale * value:.{digits}f}" for value in (band.mean, band.p05, band.p95))
    return f"mean {mean} {unit}, 5-95 % {p05} to {p95} {unit}"


@value_class
class Disturbance:
    """Errors of the thrust: white noise of the acceleration, independent between the axes.

    Attributes:
        sigma_mps2: 1 sigma of the mean over 1 s of each axis [m/s2].
        rng: Random generator.
    """

    sigma_mps2: float
    rng: np.random.Generator

    def mean_over(self, span_s: float) -> Array:
        """Draw the mean (3,) over an interval [m/s2].

        Args:
            span_s: Its length [s].
        """
        return np.asarray(self.sigma_mps2 / math.sqrt(span_s) * self.rng.standard_normal(3))

    def deviation(self, times: Array) -> tuple[Array, Array]:
        """Draw one deviation of the robot from its planned path, with errors that are constant over
        each second; each call draws a new one from ``rng``.

        Args:
            times: (n,) ascending from 0 [s].

        Returns:
            Deviations of position (n, 3) [m] and velocity (n, 3) [m/s].
        """
        steps = max(math.ceil(float(times[-1])), 1)
        u = self.sigma_mps2 * self.rng.standard_normal((steps, 3))
        v = np.concatenate([np.zeros((1, 3)), np.cumsum(u, axis=0)])
        r = np.concatenate([np.zeros((1, 3)), np.cumsum(v[:-1] + 0.5 * u, axis=0)])
        k = np.minimum(times.astype(np.int64), steps - 1)
        s = (times - k)[:, None]
        return r[k] + s * v[k] + 0.5 * s * s * u[k], v[k] + s * u[k]


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
        raise ValueError(
            f"covariance is not positive: least eigenvalue of its correlation is {values[0]:.3g}"
        )
    root: Array = safe[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def spread(
    path: RobotPath,
    futures: Sequence[Scene],
    time_to_go: Callable[[Scene], float],
    tolerance: Tolerance,
    attitude: Array | None = None,
    disturbance: Disturbance | None = None,
    contact: Contact | None = None,
) -> Spread:
    """Evaluate one plan in every future, with the time to go that each future allows.

    Args:
        path: Path planned for the mean of the belief.
        futures: Possible motions of the target after the instant of planning, equally probable.
        time_to_go: Returns the time to go to a future from the same start, under the same limits
            [s]; NaN where there is no plan.
        tolerance: Largest errors of a capture.
        attitude: (4,) q_ac of the gripper at the end.
        disturbance: Errors of the thrust; none where None.
        contact: Contact with the body; None: it is not checked.

    Raises:
        ValueError: There is no future.
    """
    if not futures:
        raise ValueError("there is no future in which to evaluate the plan")
    times = np.linspace(0.0, path.t_go_s, CONTACT_INSTANTS)
    r, v = path.at(times)
    misses, touched = np.empty((len(futures), 3)), np.zeros(len(futures), dtype=bool)
    for k, future in enumerate(futures):
        dr, dv = disturbance.deviation(times) if disturbance else (0.0 * r, 0.0 * v)
        misses[k] = _terminal_errors(future, times[-1:], r[-1] + dr[-1], v[-1] + dv[-1], attitude)
        if contact is not None and future.attitude is not None:
            R, rho = geometry.matrix(future.attitude(times)), future.goal(times)[0]
            touched[k] = contact.touched(in_fixture_axes(R, r + dr - rho)[None])[0]
    own = np.array([time_to_go(future) for future in futures])
    allowed = (tolerance.position_m, tolerance.speed_mps, tolerance.angle_deg)
    inside = np.all((misses <= allowed) | np.isnan(misses), axis=1)
    checked = contact is not None and futures[0].attitude is not None
    return Spread(
        futures=len(futures),
        t_go_s=_band(own),
        infeasible=int(np.isnan(own).sum()),
        miss_m=_band(misses[:, 0]),
        speed_mps=_band(misses[:, 1]),
        angle_deg=_band(misses[:, 2]),
        probability=float(inside.mean()),
        probability_95=wilson(int(inside.sum()), len(futures)),
        contact=float(touched.mean()) if checked else math.nan,
        contact_95=wilson(int(touched.sum()), len(futures)) if checked else (math.nan, math.nan),
    )


def wilson(successes: int, count: int) -> tuple[float, float]:
    """Return the Wilson 95 % interval of the fraction of ``successes`` in ``count`` trials, at
    least 1.
    """
    z2 = 1.96**2
    centre = (successes + 0.5 * z2) / (count + z2)
    half = 1.96 / (count + z2) * math.sqrt(successes * (count - successes) / count + 0.25 * z2)
    return max(centre - half, 0.0), min(centre + half, 1.0)


def _terminal_errors(
    scene: Scene, end: Array, r: Array, v: Array, attitude: Array | None
) -> tuple[float, float, float]:
    rho, rate = scene.goal(end)
    turn = math.nan
    if attitude is not None and scene.attitude is not None:
        q = geometry.multiply(geometry.conjugate(scene.attitude(end)[0]), attitude)
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
