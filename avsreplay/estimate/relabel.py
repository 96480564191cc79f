"""The 24 ways to name the principal axes: (q, mu, sigma) are known only up to these, so truth is compared modulo them.

A naming is a proper rotation that permutes the axes and turns some round, R_bn (columns: new axes in the old {B}).
sigma follows the permutation and, for an odd one, changes its sign: s'_i = parity * s_perm(i).
"""

from __future__ import annotations

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.chart import to_chart, to_errors
from avsreplay.estimate.layout import DIM, DMU, DQ, SIGMA, VARRHO, W, boxminus
from avsreplay.estimate.motion import sigma3, sigma_join
from avsreplay.estimate.naming import NAMINGS, Naming
from avsreplay.geometry import Array
from avsreplay.records import Belief, State

__all__ = ["nearest", "nees", "relabel", "relabel_covariance"]


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
    named = [relabel(truth, naming) for naming in NAMINGS]
    errors = np.array([boxminus(x, estimate.x) for x in named])
    sizes = np.einsum("ni,in->n", errors, np.linalg.solve(estimate.P, errors.T))
    best = int(np.argmin(sizes))
    return named[best], float(sizes[best])


def nees(belief: Belief, truth: State) -> float:
    """Normalised estimation error squared over the 20 states, in the chart: free of the names of the principal axes.

    Where two moments are nearly equal, sigma and mu are no coordinates and their errors mean nothing; here they are one
    smooth matrix, and what cannot be known is only a wide direction.
    """
    here = to_chart(belief.x)
    T = to_errors(here)
    P = np.linalg.solve(T, np.linalg.solve(T, belief.P).T)
    y = to_chart(truth).minus(here)
    return float(y @ np.linalg.solve(0.5 * (P + P.T), y))
