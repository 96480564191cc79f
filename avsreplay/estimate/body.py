"""Physical parameters of the target in {C}: they do not depend on the order and the signs of the principal axes."""

from __future__ import annotations

import numpy as np

from avsreplay.estimate.chart import ARM, INERTIA, RATE, inertia_matrices, to_chart, to_errors
from avsreplay.geometry import Array
from avsreplay.records import Belief, BodyParameters

_LARGEST_1S = 3.0  # largest 1 sigma of the logarithm of the mass moments; above it the inertia is undetermined


def body_parameters(belief: Belief) -> BodyParameters:
    """Inertia, mass centre and rate in {C} with their 1 sigma.

    The inertia is a nonlinear function of the chart's five numbers, so its standard deviations come from sigma points
    (unscented transform); as the tensor is divided by its trace, they cannot leave the physical range.
    """
    chart = to_chart(belief.x)
    T = to_errors(chart)
    P = np.linalg.solve(T, np.linalg.solve(T, belief.P).T)
    values, vectors = np.linalg.eigh(0.5 * (P + P.T)[INERTIA, INERTIA])
    n = len(values)
    steps = vectors * np.minimum(np.sqrt(np.maximum(values, 0.0)), _LARGEST_1S) * np.sqrt(n)
    tensors = _inertia(chart.M + inertia_matrices(np.concatenate([np.zeros((1, n)), steps.T, -steps.T])))
    moments = np.linalg.eigvalsh(tensors)
    spread = [np.sqrt(np.mean((found[1:] - found[0]) ** 2, axis=0)) for found in (tensors, moments)]
    return BodyParameters(
        inertia=tensors[0],
        inertia_1s=spread[0],
        moments=moments[0],
        moments_1s=spread[1],
        centre_c=-chart.arm_c,
        centre_1s_m=float(np.sqrt(np.trace(P[ARM, ARM]))),
        rate_c=chart.w_c,
        rate_1s_radps=float(np.sqrt(np.trace(P[RATE, RATE]))),
    )


def _inertia(M: Array) -> Array:
    """Inertia tensors (n, 3, 3) over their trace, from the logarithms M (n, 3, 3) of the second mass moments."""
    values, vectors = np.linalg.eigh(M)
    mass = np.exp(values - values.max(axis=1, keepdims=True))
    mass /= 2.0 * mass.sum(axis=1, keepdims=True)  # the trace of the inertia is twice that of the mass moments
    moments = mass.sum(axis=1, keepdims=True) - mass
    return np.asarray((vectors * moments[:, None, :]) @ np.swapaxes(vectors, 1, 2))
