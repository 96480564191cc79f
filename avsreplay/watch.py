"""The monitors in one fold: what the measurements can tell, whether the filter is honest, whether it has converged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from avsreplay.estimate import Estimator, Prediction, Track
from avsreplay.monitor.consistency import Consistency, ConsistencyTrack
from avsreplay.monitor.convergence import Convergence, ConvergenceTrack
from avsreplay.monitor.observability import Gramian, measure, observe
from avsreplay.records import Forecast, Innovation

__all__ = ["Monitors", "Watch", "look"]


@dataclass(frozen=True, slots=True, eq=False)
class Monitors:
    """The stages that only watch."""

    consistency: Consistency
    convergence: Convergence


@dataclass(frozen=True, slots=True, eq=False)
class Watch:
    """What they remember."""

    gramian: Gramian
    consistency: ConsistencyTrack
    convergence: ConvergenceTrack


def look(
    monitors: Monitors,
    watch: Watch,
    estimator: Estimator,
    prediction: Prediction,
    seen: Innovation | None,
    gamma: int,
    track: Track,
) -> tuple[Watch, dict[str, Any]]:
    """One scan on; the second value is the row's monitor columns."""
    gramian = observe(watch.gramian, prediction.Phi, prediction.H, gamma)
    honest = monitors.consistency.observe(watch.consistency, seen, gamma)
    said = monitors.consistency.judge(honest)
    consistent = said.consistent and not track.window.many_outliers
    forecast = estimator.forecast(track.belief, monitors.convergence.params.times_s)
    convergence = monitors.convergence.judge(watch.convergence, track.belief, forecast, consistent is True)
    columns = _observability(gramian) | _forecast(forecast) | _convergence(convergence)
    columns |= {"consistent": consistent, "nis_mean": said.nis_mean, "autocorrelation": said.autocorrelation}
    columns |= {"sigma_hits": track.sigma_hits, "r_floors": track.r_floors, "recalls": track.reinitialised}
    return Watch(gramian, honest, convergence), columns


def _observability(gramian: Gramian) -> dict[str, Any]:
    found = measure(gramian)
    return {
        "ogm_rank": found.rank,
        "ogm_log10_cond": found.log10_cond,
        "ogm_log10_cond_scaled": found.log10_cond_scaled,
    }


def _convergence(track: ConvergenceTrack) -> dict[str, Any]:
    return {
        "covariance_holds": track.covariance_holds,
        "predictive_holds": track.predictive_holds,
        "unknown": ", ".join(track.unknown) or None,
    }


def _forecast(forecast: Forecast) -> dict[str, Any]:
    return {
        "grasp_pos_1s_m": float(forecast.pos_1s_m.max()),
        "grasp_vel_1s_mps": float(forecast.vel_1s_mps.max()),
        "grasp_rot_1s_deg": float(np.degrees(forecast.rot_1s_rad.max())),
    }
