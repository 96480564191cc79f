"""The covariance of a measured pose: its root, and factors on its noise.

A view may leave a direction undetermined that turns and displaces the target together, such as a
turn about the axis of a cylinder that does not pass through the fixture. The covariance is large
along it, and far smaller across. A factor on the rows and columns of the attitude, and another one
on those of the position, would turn this direction: the pose would then state a position that it
has not measured. The two factors are therefore on the attitude, and on the position given the
attitude, which are the columns of the Cholesky root.
"""

from __future__ import annotations

import numpy as np

from avsreplay.geometry import Array

_EXCHANGED = np.array([3, 4, 5, 0, 1, 2])


def cholesky_root(C: Array) -> Array:
    """Lower Cholesky factor of a covariance that rounding may have made indefinite, or of several
    of one size.

    Args:
        C: (..., n, n) covariance.

    Returns:
        (..., n, n) factor of C; if one is indefinite, of each plus the smallest multiple of the
        identity, relative to its mean variance, that suffices for all.

    Raises:
        ValueError: no multiple suffices, as with a matrix that is not finite.
    """
    try:
        return np.asarray(np.linalg.cholesky(C))
    except np.linalg.LinAlgError:
        n = C.shape[-1]
    more = np.trace(C, axis1=-2, axis2=-1)[..., None, None] / n * np.eye(n)
    for k in range(-13, 1):
        try:
            return np.asarray(np.linalg.cholesky(C + 10.0**k * more))
        except np.linalg.LinAlgError:
            continue
    raise ValueError("the covariance of the window is not finite")


def scaled(C: Array, factors: Array) -> Array:
    """Return the covariance of a pose with factors on its noise.

    Args:
        C: (6, 6) of d = [theta; v], attitude first.
        factors: (2,) on the standard deviations of the attitude, and of the position given the
            attitude.
    """
    attitude, position = factors.tolist()
    if attitude == position:
        return np.asarray(C * attitude**2)
    half = cholesky_root(C) * np.repeat(factors, 3)
    return np.asarray(half @ half.T)


def scaled_R(R: Array, factors: Array) -> Array:
    """Return the noise of the filter, position first, with factors on it.

    Args:
        R: (6, 6) of position and half angle.
        factors: (2,) as in ``scaled``.
    """
    exchanged = np.ix_(_EXCHANGED, _EXCHANGED)
    return np.asarray(scaled(R[exchanged], factors)[exchanged])
