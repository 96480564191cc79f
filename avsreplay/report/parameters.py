"""Estimated constants of the target against the true ones."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from avsreplay import geometry
from avsreplay.records import State
from avsreplay.rows import Row

__all__ = ["Parameter", "parameters"]


@dataclass(frozen=True, slots=True)
class Parameter:
    """An estimated constant at the last scan.

    Attributes:
        estimate, truth: its components, in ``unit``.  error: length of their difference (rotation angle for mu).
        one_sigma: root of the trace of its covariance.
    """

    name: str
    unit: str
    estimate: tuple[float, ...]
    truth: tuple[float, ...] | None
    error: float | None
    one_sigma: float | None


def parameters(row: Row, truth: State | None) -> tuple[Parameter, ...]:
    """Inertia ratios, varrho and mu of a row, against ``truth`` where it is known."""
    sigma = (None, None) if truth is None else ((float(truth.sigma[0]),), (float(truth.sigma[1]),))
    found = [
        _vector("sigma1", "", (row.sigma1,), sigma[0], row.sigma1_1s),
        _vector("sigma2", "", (row.sigma2,), sigma[1], row.sigma2_1s),
        _vector(
            "c (varrho)", "m", (row.cx_m, row.cy_m, row.cz_m), None if truth is None else _tuple(truth.c_b), row.c_1s_m
        ),
        _attitude(row, truth),
    ]
    return tuple(p for p in found if p is not None)


def _tuple(values: geometry.Array | None) -> tuple[float, ...] | None:
    return None if values is None else tuple(float(v) for v in values)


def _vector(
    name: str, unit: str, values: tuple[float | None, ...], truth: tuple[float, ...] | None, one_sigma: float | None
) -> Parameter | None:
    estimate = tuple(v for v in values if v is not None)
    if len(estimate) != len(values):
        return None
    error = None if truth is None else math.dist(estimate, truth)
    return Parameter(name, unit, estimate, truth, error, one_sigma)


def _attitude(row: Row, truth: State | None) -> Parameter | None:
    """Attitude mu as a rotation vector [deg]; its error is the angle of mu_true^-1 mu."""
    q = (row.mux, row.muy, row.muz, row.muw)
    if None in q:
        return None
    estimate = _tuple(np.degrees(geometry.log(np.array(q, dtype=np.float64)))) or ()
    if truth is None:
        return Parameter("mu", "deg", estimate, None, None, row.mu_1s_deg)
    apart = geometry.multiply(geometry.conjugate(truth.q_bc), np.array(q, dtype=np.float64))
    error = math.degrees(float(geometry.angle(apart)))
    return Parameter("mu", "deg", estimate, _tuple(np.degrees(geometry.log(truth.q_bc))), error, row.mu_1s_deg)
