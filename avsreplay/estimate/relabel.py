"""The 24 ways to name the principal axes: (q, mu, sigma) are known only up to these, so truth is compared modulo them.

A naming is a proper rotation that permutes the axes and turns some round, R_bn (columns: new axes in the old {B}).
sigma follows the permutation and, for an odd one, changes its sign: s'_i = parity * s_perm(i).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.layout import DIM, DMU, DQ, SIGMA, VARRHO, W, boxminus
from avsreplay.estimate.motion import sigma3, sigma_join
from avsreplay.geometry import Array
from avsreplay.records import Belief, State

__all__ = ["NAMINGS", "Naming", "nearest", "nees", "relabel", "relabel_covariance"]


@dataclass(frozen=True, slots=True, eq=False)
class Naming:
    """One of the 24: R_bn (3, 3), its quaternion, new axis i is old axis perm[i] up to sign, parity of perm."""

    R_bn: Array
    q_bn: Array
    perm: tuple[int, int, int]
    parity: float


def _namings() -> tuple[Naming, ...]:
    found = []
    for perm in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[perm, (0, 1, 2)] = signs
            if np.linalg.det(R) > 0.0:
                parity = float(np.sign(np.linalg.det(np.abs(R))))
                found.append(Naming(R, geometry.quaternion(R), (perm[0], perm[1], perm[2]), parity))
    return tuple(found)


NAMINGS = _namings()


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


def nees(estimate: Belief, truth: State) -> float:
    """Normalised estimation error squared over the 20 states, modulo the naming of the axes."""
    return nearest(estimate, truth)[1]
