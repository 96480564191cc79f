"""Estimated parameters of the body: those of the paper, and those that do not depend on the
order of the axes.
"""

from __future__ import annotations

import math

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.records import State
from avsreplay.rows import Row

ANY_ORDER = "does not depend on the order of the principal axes"
ONE_ORDER = "refers to one order of the principal axes; which axis is called x, y or z is arbitrary"


@value_class(eq=True)
class Parameter:
    """An estimated constant at the last scan.

    Attributes:
        estimate, truth: its components, in ``unit``.
        error: length of their difference (rotation angle for mu).
        one_sigma: root of the trace of its covariance.
        note: whether the value depends on the order of the principal axes.
    """

    name: str
    unit: str
    estimate: tuple[float, ...]
    truth: tuple[float, ...] | None
    error: float | None
    one_sigma: float | None
    note: str = ANY_ORDER

    @property
    def undetermined(self) -> bool:
        """Return whether 1 sigma is that of a sigma or mu about which nothing is known."""
        if self.one_sigma is None or self.name not in ("sigma1", "sigma2", "mu"):
            return False
        free = 131.0 if self.name == "mu" else 0.99 * math.sqrt(1.0 / 3.0 + self.estimate[0] ** 2)
        return self.one_sigma >= free


def parameters(row: Row, truth: State | None) -> tuple[Parameter, ...]:
    """Return the parameters of the body at a row: those of the paper, and those in {C}.

    Args:
        row: a row, usually the last.
        truth: the true state; None where it is not known.
    """
    sigma = (None, None) if truth is None else ((float(truth.sigma[0]),), (float(truth.sigma[1]),))
    found = [
        _vector("sigma1", "", (row.sigma1,), sigma[0], row.sigma1_1s, ONE_ORDER),
        _vector("sigma2", "", (row.sigma2,), sigma[1], row.sigma2_1s, ONE_ORDER),
        _vector(
            "c (varrho)",
            "m",
            (row.cx_m, row.cy_m, row.cz_m),
            _of(truth, "c_b"),
            row.c_1s_m,
            ONE_ORDER,
        ),
        _attitude(row, truth),
        *_in_fixture_frame(row, truth),
    ]
    return tuple(p for p in found if p is not None)


def _in_fixture_frame(row: Row, truth: State | None) -> list[Parameter | None]:
    """Parameters that do not depend on the order of the axes: moments, and inertia, mass
    centre and rate in {C}.
    """
    moments = tensor = centre = rate = None
    if truth is not None:
        R_cb, found = geometry.matrix(truth.q_bc).T, relative_moments(truth)
        moments, centre = _tuple(np.sort(found)), _tuple(-R_cb @ truth.c_b)
        rate = _tuple(R_cb @ truth.w_b)
        full = R_cb @ np.diag(found) @ R_cb.T
        tensor = _tuple(full[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    small = (row.moment_small, row.moment_middle, row.moment_large)
    entries = (row.ixx, row.iyy, row.izz, row.ixy, row.ixz, row.iyz)
    return [
        _vector("moments / sum, ascending: 1 2 3", "", small, moments, row.moments_1s),
        _vector("inertia / trace in {C}: xx yy zz xy xz yz", "", entries, tensor, row.inertia_1s),
        _vector(
            "mass centre in {C}", "m", (row.com_x_m, row.com_y_m, row.com_z_m), centre, row.com_1s_m
        ),
        _vector(
            "rate in {C}",
            "rad/s",
            (row.rate_cx_radps, row.rate_cy_radps, row.rate_cz_radps),
            rate,
            row.rate_c_1s_radps,
        ),
    ]


def relative_moments(x: State) -> geometry.Array:
    """Return the principal moments of inertia (3,) over their sum: 1 over the diagonal of B(sigma).

    Args:
        x: a state; its inertia ratios are used.
    """
    s1, s2 = float(x.sigma[0]), float(x.sigma[1])
    xx = 1.0 + (2.0 + s1 * s2 + s1) / (1.0 - s2)
    yy = 1.0 + (2.0 + s1 * s2 - s2) / (1.0 + s1)
    zz = 1.0 + (2.0 + s1 - s2) / (1.0 + s1 * s2)
    return 1.0 / np.array([xx, yy, zz])


def _tuple(values: geometry.Array | None) -> tuple[float, ...] | None:
    return None if values is None else tuple(float(v) for v in values)


def _of(truth: State | None, name: str) -> tuple[float, ...] | None:
    return None if truth is None else _tuple(getattr(truth, name))


def _vector(
    name: str,
    unit: str,
    values: tuple[float | None, ...],
    truth: tuple[float, ...] | None,
    one_sigma: float | None,
    note: str = ANY_ORDER,
) -> Parameter | None:
    estimate = tuple(v for v in values if v is not None)
    if len(estimate) != len(values):
        return None
    error = None if truth is None else math.dist(estimate, truth)
    return Parameter(name, unit, estimate, truth, error, one_sigma, note)


def _attitude(row: Row, truth: State | None) -> Parameter | None:
    """Attitude mu as a rotation vector [deg]; its error is the angle of mu_true^-1 mu."""
    q = (row.mux, row.muy, row.muz, row.muw)
    if None in q:
        return None
    estimate = _tuple(np.degrees(geometry.log(np.array(q, dtype=np.float64)))) or ()
    if truth is None:
        return Parameter("mu", "deg", estimate, None, None, row.mu_1s_deg, ONE_ORDER)
    apart = geometry.multiply(geometry.conjugate(truth.q_bc), np.array(q, dtype=np.float64))
    error = math.degrees(float(geometry.angle(apart)))
    true = _tuple(np.degrees(geometry.log(truth.q_bc)))
    return Parameter("mu", "deg", estimate, true, error, row.mu_1s_deg, ONE_ORDER)
