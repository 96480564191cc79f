"""The 24 ways to name the principal axes: (q, mu, sigma) are known only up to these, so truth is compared modulo them.

A naming is a proper rotation that permutes the axes and turns some round, R_bn (columns: new axes in the old {B}).
sigma follows the permutation and, for an odd one, changes its sign: s'_i = parity * s_perm(i).
"""

from __future__ import annotations

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.chart import to_chart, to_errors
from avsreplay.estimate.layout import DIM, DMU, DQ, RHO, SIGMA, VARRHO, VEL, W
from avsreplay.estimate.motion import sigma3, sigma_join
from avsreplay.estimate.naming import NAMINGS, Naming
from avsreplay.geometry import Array
from avsreplay.records import Belief, State

__all__ = ["nearest", "nees", "relabel", "relabel_covariance"]

_R_NB = np.array([naming.R_bn.T for naming in NAMINGS])
_Q_BN = np.array([naming.q_bn for naming in NAMINGS])
_Q_NB = geometry.conjugate(_Q_BN)
_PARITY = np.array([[naming.parity] for naming in NAMINGS])
_PERMS = np.array([naming.perm[:2] for naming in NAMINGS])


def relabel(x: State, naming: Naming) -> State:
    """The same motion with its principal axes named anew."""
    R_nb = naming.R_bn.T
    triple = (float(x.sigma[0]), float(x.sigma[1]), sigma3(x.sigma))
    sigma = naming.parity * np.array([triple[naming.perm[0]], triple[naming.perm[1]]])
    q_an = geometry.multiply(x.q_ab, naming.q_bn)
    q_nc = geometry.multiply(geometry.conjugate(naming.q_bn), x.q_bc)
    return State(q_an, R_nb @ x.w_b, x.r_a, x.v_a, sigma, R_nb @ x.c_b, q_nc)


def relabel_covariance(P: Array, x: State, naming: Naming) -> Array:
    """P (20, 20) about ``x``, about ``relabel(x, naming)``."""
    J = np.eye(DIM)
    for block in (DQ, W, VARRHO, DMU):
        J[block, block] = naming.R_bn.T
    J[SIGMA, SIGMA] = naming.parity * sigma_join(x.sigma)[list(naming.perm[:2])]
    out: Array = J @ P @ J.T
    return out


def nearest(estimate: Belief, truth: State) -> tuple[State, float]:
    """The naming of ``truth`` nearest to the estimate in its own covariance, and e' P^-1 e there (the NEES)."""
    errors = _errors(truth, estimate.x)
    sizes = np.einsum("ni,in->n", errors, np.linalg.solve(estimate.P, errors.T))
    best = int(np.argmin(sizes))
    return relabel(truth, NAMINGS[best]), float(sizes[best])


def _errors(truth: State, x: State) -> Array:
    """(24, 20) ``boxminus(relabel(truth, naming), x)`` of every naming, at once."""
    triple = np.array([truth.sigma[0], truth.sigma[1], sigma3(truth.sigma)])
    d = np.empty((len(NAMINGS), DIM))
    d[:, DQ] = _small(geometry.multiply(geometry.multiply(geometry.conjugate(x.q_ab), truth.q_ab), _Q_BN))
    d[:, DMU] = _small(geometry.multiply(_Q_NB, geometry.multiply(truth.q_bc, geometry.conjugate(x.q_bc))))
    d[:, W], d[:, VARRHO] = _R_NB @ truth.w_b - x.w_b, _R_NB @ truth.c_b - x.c_b
    d[:, RHO], d[:, VEL] = truth.r_a - x.r_a, truth.v_a - x.v_a
    d[:, SIGMA] = _PARITY * triple[_PERMS] - x.sigma
    return d


def _small(q: Array) -> Array:
    """Vector part (n, 3), of the sign with w >= 0."""
    return np.where(q[:, 3:] >= 0.0, q[:, :3], -q[:, :3])


def nees(belief: Belief, truth: State) -> float:
    """Normalised estimation error squared over the 20 states, in the chart: free of the names of the principal axes.

    Where two moments are nearly equal, sigma and mu are no coordinates and their errors mean nothing; here they are one
    smooth matrix, and what cannot be known is only a wide direction.
    """
    here = to_chart(belief.x)
    d = to_errors(here) @ to_chart(truth).minus(here)  # back in error states, where P is
    return float(d @ np.linalg.solve(belief.P, d))
