"""The density of a random disturbance: its likelihood, and the one density that stands for all of
them.

The whitened residuals of the poses are linear in the initial values y and in impulses u of the
disturbance between the poses, with u ~ N(0, q^2). Those of other disturbances are further unknowns
with a prior, not a part of the covariance of the residuals: over a long log they are so large that
this covariance could no longer be factored. The likelihood of every root density q is a
closed form in the eigenvalues of the information on u.

Half of the prior probability is that of no disturbance, the other half that of the densities that
the poses do not exclude, in equal parts a decade. Were it spread over all densities, most of it
would be that of excluded ones, and what they lose would count for no disturbance.

The estimator uses one density, whose square is the posterior mean of q^2: a disturbance to come has
this second moment, which is what forecasts and covariances need.
"""

from __future__ import annotations

import math

import numpy as np

from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.pose_noise import cholesky_root
from avsreplay.geometry import Array

# root densities of a disturbance that are compared with none; over a log of 100 s the least changes
# a velocity by 1e-5 [rad/s, m/s], which is none for every task
DENSITIES = np.logspace(-6.0, 0.0, 49)
_EXCLUDED = math.log(0.01)  # log likelihood ratio to none below which a density is excluded
# prior probability that torque and force are both random where one is, and neither where one is not
_TOGETHER = 0.9
_SQUARES = np.append(0.0, DENSITIES**2)
_FEW_ROWS = 36  # rows up to which a triangular matrix is inverted


@value_class
class Residuals:
    """Whitened residuals e (n,) and their Jacobian J (n, m) by unknowns with a Gaussian prior.

    ``root`` (p, m) is a root of the prior's information, root' root, and ``off`` (m,) the offset of
    the unknowns from the prior's mean.
    """

    e: Array
    J: Array
    root: Array
    off: Array

    def extended(self, effects: Array, off: Array) -> Residuals:
        """The residuals with k more unknowns of prior 1 sigma 1: effects (n, k), off (k,)."""
        k, (p, m) = len(off), self.root.shape
        root = np.zeros((p + k, m + k))
        root[:p, :m], root[p:, m:] = self.root, np.eye(k)
        J = np.hstack([self.J, effects])
        return Residuals(self.e, J, root, np.concatenate([self.off, off]))


def information_root(info: Array) -> Array:
    """A root (m, m) of an information matrix (m, m), root' root; directions of which rounding makes
    the information negative have none.
    """
    values, axes = np.linalg.eigh(info)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * axes.T)


@value_class
class Marginal:
    """The likelihood of k impulses with the initial values marginal over them.

    Attributes:
        none: log likelihood of no impulses, without its constant.
        values: (k,) eigenvalues of the information on the impulses.
        along: (k,) the gradient of the log likelihood along its eigenvectors.
    """

    none: float
    values: Array
    along: Array

    @property
    def log_odds(self) -> Array:
        """(n,) increase of the log likelihood by the squares of ``DENSITIES``."""
        gain = _SQUARES[1:, None] * self.values
        fitted = _SQUARES[1:, None] * self.along**2 / (1.0 + gain)
        return np.asarray(0.5 * (fitted - np.log1p(gain)).sum(axis=1))

    @property
    def evidence(self) -> float:
        """Log likelihood of a disturbance, all decades of whose root density are equally likely,
        over none.
        """
        return float(np.logaddexp.reduce(self.log_odds)) - math.log(len(DENSITIES))

    @property
    def excluded(self) -> float:
        """The least root density that is excluded together with all larger ones; inf where
        none is.
        """
        possible = np.flatnonzero(self.log_odds > _EXCLUDED)
        first = int(possible[-1]) + 1 if possible.size else 0
        return float(DENSITIES[first]) if first < len(DENSITIES) else math.inf

    @property
    def likeliest(self) -> tuple[float, float]:
        """The root density of the greatest likelihood, 0 for none, and its log likelihood."""
        odds = np.append(0.0, self.log_odds)
        k = int(np.argmax(odds))
        return math.sqrt(_SQUARES[k]), self.none + float(odds[k])


def marginal(V: Array, effects: Array, data: Residuals) -> Marginal:
    """Marginal likelihood of residuals with noise V (n, n) and impulses with ``effects`` (n, k).

    V is the covariance of the errors of the poses alone, which is well conditioned.
    """
    root = cholesky_root(V)
    prior, k = data.root, effects.shape[1]
    white = divided(root, np.hstack([effects, data.J, data.e[:, None]]))
    columns = np.vstack([white[:, :k], np.zeros((len(prior), k))])
    Q, R = np.linalg.qr(np.vstack([white[:, k:-1], prior]))
    e = np.concatenate([white[:, -1], prior @ data.off])
    left, cross = e - Q @ (Q.T @ e), Q.T @ columns
    chi2 = float(left @ left)
    none = -0.5 * chi2 - float(
        np.log(np.abs(np.diagonal(R))).sum() + np.log(np.diagonal(root)).sum()
    )
    values, vectors = np.linalg.eigh(columns.T @ columns - cross.T @ cross)
    values = np.maximum(values, 0.0)
    most = np.sqrt(chi2 * values)  # the bound of Cauchy and Schwarz, which rounding can exceed
    return Marginal(none, values, np.clip(vectors.T @ (columns.T @ left), -most, most))


def divided(L: Array, B: Array) -> Array:
    """L^-1 B for a lower triangular L (n, n) and B (n, m), by halves: numpy has the general
    solution only.
    """
    if len(L) <= _FEW_ROWS:
        return np.asarray(_motion.lower_inverse(np.ascontiguousarray(L)) @ B)
    half = len(L) // 2
    first = divided(L[:half, :half], B[:half])
    return np.concatenate([first, divided(L[half:, half:], B[half:] - L[half:, :half] @ first)])


def probability_beside(evidence: float) -> float:
    """Prior probability of a random torque or force given the ``evidence`` of the other one.

    A force whose line of action misses the mass centre turns the body, so that the two come
    together. Each by itself has the probability 0.5.
    """
    other = 1.0 / (1.0 + math.exp(-min(max(evidence, -700.0), 700.0)))
    return _TOGETHER * other + (1.0 - _TOGETHER) * (1.0 - other)


def posterior(found: Marginal, probability: float) -> Array:
    """(n + 1,) probabilities of no disturbance and of the ``DENSITIES``, after the poses.

    Args:
        found: the likelihood of the impulses.
        probability: prior probability that there is a disturbance, of a density that the poses do
            not exclude.
    """
    possible = found.excluded > DENSITIES
    each = math.log(probability / max(int(np.count_nonzero(possible)), 1))
    log = np.append(math.log1p(-probability), np.where(possible, found.log_odds + each, -math.inf))
    weights = np.exp(log - log.max())
    return np.asarray(weights / weights.sum())


def mean_square(found: Marginal, probability: float = 0.5) -> float:
    """The posterior mean of the squared root density, which is the density that the estimator uses.

    Args:
        found: the likelihood of the impulses.
        probability: prior probability that there is a disturbance.
    """
    return float(posterior(found, probability) @ _SQUARES)
