"""A linear Gaussian model in time, its likelihood, its smoothed states, and shocks at any instant.

One pass forward (Kalman filter) and one back (de Jong and Penzer, JASA 93, 1998) give the
likelihood, the smoothed states, the derivative of the likelihood by each variance, and, for every
knot, what a shock of the state there would gain and what leaving out the pose there would gain.
An event is a shock of known direction and of unknown size; its evidence is a closed form.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.geometry import Array


@value_class
class LinearModel:
    """State s of n numbers at k knots; s_0 is normal with mean m0 and covariance P0.

    s_j = F_j s_{j-1} + b_j + N(0, Q_j), z_j = H_j s_j + N(0, R_j) where ``used``.

    Attributes:
        F, b, Q: (k, n, n), (k, n) and (k, n, n); those of knot 0 are not used.
        z, H, R: (k, 6), (k, 6, n) and (k, 6, 6).
        used: (k,) knots with a measurement.
        m0, P0: (n,) and (n, n).
    """

    F: Array
    b: Array
    Q: Array
    z: Array
    H: Array
    R: Array
    used: NDArray[np.bool_]
    m0: Array
    P0: Array


@value_class
class Passed:
    """What the two passes give.

    Attributes:
        log_likelihood: of the used measurements.
        before, before_P: (k, n) and (k, n, n): mean and covariance before each measurement.
        score, information: (k, n) and (k, n, n): the derivative of the log likelihood by a shock
            of the state before the measurement of a knot, and minus its second derivative.
        error, weight: (k, 6) and (k, 6, 6) the same by an error of the measurement.
    """

    log_likelihood: float
    before: Array
    before_P: Array
    score: Array
    information: Array
    error: Array
    weight: Array

    @property
    def mean(self) -> Array:
        """(k, n) of the states, given all measurements."""
        return np.asarray(self.before + np.einsum("kij,kj->ki", self.before_P, self.score))

    def covariance(self, k: int) -> Array:
        """(n, n) of the state at a knot, given all measurements."""
        P = self.before_P[k]
        out: Array = P - P @ self.information[k] @ P
        return np.asarray(0.5 * (out + out.T))


def passed(model: LinearModel) -> Passed:
    """Filter and smoother over all knots (``kernel/shocks.cpp``).

    Raises:
        ArithmeticError: a covariance is not positive, because a motion that explains the poses was
            not found.
    """
    try:
        found = _motion.passes(model)
    except ValueError as error:
        raise ArithmeticError(str(error)) from None
    return Passed(**found)


def shock_size(score: Array, information: Array, one_sigma: Array) -> tuple[Array, Array]:
    """Mean (..., p) and covariance (..., p, p) of the size of a shock.

    Args:
        score: (..., p) derivative of the log likelihood by the size.
        information: (..., p, p) minus its second derivative.
        one_sigma: (...) of the size before the measurements.
    """
    prior = np.eye(score.shape[-1]) / np.square(one_sigma)[..., None, None]
    covariance = np.linalg.inv(information + prior)
    size = np.asarray((covariance @ score[..., None])[..., 0], dtype=np.float64)
    return size, np.asarray(covariance, dtype=np.float64)


def shock_gain(
    score: Array, information: Array, one_sigma: Array | None, most: float = np.inf
) -> tuple[Array, Array]:
    """Log evidence (...) that a shock gains, and the 1 sigma (...) of its size before the poses.

    Args:
        score: (..., p) derivative of the log likelihood by the size.
        information: (..., p, p) minus its second derivative.
        one_sigma: (...) of the size before the measurements; None: the root mean square of the
            most likely size, which gives the largest evidence of a shock that is well seen.
        most: largest 1 sigma that is chosen so.
    """
    p = score.shape[-1]
    if one_sigma is None:
        ridge = 1e-9 * np.trace(information, axis1=-2, axis2=-1) / p + 1e-300
        likely = np.linalg.solve(information + ridge[..., None, None] * np.eye(p), score[..., None])
        root = np.sqrt(np.mean(np.square(likely[..., 0]), axis=-1))
        one_sigma = np.minimum(root, most) + 1e-12
    size, covariance = shock_size(score, information, one_sigma)
    scaled = -np.linalg.slogdet(covariance)[1] + 2.0 * p * np.log(one_sigma)
    return np.asarray(0.5 * (np.sum(score * size, axis=-1) - scaled)), np.asarray(one_sigma)
