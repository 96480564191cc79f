"""The same motion with other parameter sets, for the observability of each (the paper's claim on two ratios).

``two``: the 20 states as they are. ``three``: sigma1, sigma2, sigma3 independent, 21 states. ``known``: sigma, varrho
and mu known, the 12 states of motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from avsreplay.estimate.dynamics import advance, flow, sigma_join, transition
from avsreplay.estimate.error_state import DIM, SIGMA
from avsreplay.estimate.measurement import measurement_jacobian
from avsreplay.geometry import Array
from avsreplay.records import BLOCKS, State

SETS = ("two", "three", "known")
_MOTION = 12
_THREE = {"sigma": slice(12, 15), "varrho": slice(15, 18), "mu": slice(18, 21)}
BLOCKS_OF: Mapping[str, Mapping[str, slice]] = MappingProxyType(
    {
        "two": BLOCKS,
        "three": MappingProxyType({name: _THREE.get(name, where) for name, where in BLOCKS.items()}),
        "known": MappingProxyType({name: where for name, where in BLOCKS.items() if where.stop <= _MOTION}),
    }
)


def step_of_sets(x: State, h: float) -> tuple[State, dict[str, tuple[Array, Array]]]:
    """The state h seconds later, and Phi (n, n) and H (6, n) of each set over that step."""
    moved = flow(x.w_b, x.sigma, h)
    then = advance(x, moved, h)
    Phi, H = transition(moved, x.sigma, h), measurement_jacobian(then)
    wide = np.eye(DIM + 1)
    wide[:_MOTION, :_MOTION] = Phi[:_MOTION, :_MOTION]
    wide[:6, _THREE["sigma"]] = moved.S[:, 6:]
    H_wide = np.insert(H, SIGMA.stop, 0.0, axis=1)
    return then, {
        "two": (Phi, H),
        "three": (wide, H_wide),
        "known": (Phi[:_MOTION, :_MOTION], H[:, :_MOTION]),
    }


def prior_1s(one_sigma: Array, sigma: Array) -> dict[str, Array]:
    """Prior standard deviations (n,) of each set from the 20; that of sigma3 follows from sigma1 and sigma2."""
    third = np.sqrt(np.sum((sigma_join(sigma)[2] * one_sigma[SIGMA]) ** 2))
    return {
        "two": one_sigma,
        "three": np.insert(one_sigma, SIGMA.stop, third),
        "known": one_sigma[:_MOTION],
    }
