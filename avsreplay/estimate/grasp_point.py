"""A belief about another point of the target than the origin of {C}."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avsreplay import geometry
from avsreplay.estimate.driven import DrivenBelief
from avsreplay.estimate.error_state import DIM, DMU, VARRHO
from avsreplay.geometry import Array
from avsreplay.records import Belief


def at_grasp(belief: Belief, grasp_c: Array) -> Belief:
    """Return the belief about the grasp point in place of the origin of {C}, to first order.

    The axes remain those of {C}; the arm varrho then leads to the grasp point.

    Args:
        belief: about {C}.
        grasp_c: (3,) grasp point in {C} [m].
    """
    if not np.any(grasp_c):
        return belief
    lever = geometry.matrix(belief.x.q_bc) @ grasp_c
    J = np.eye(DIM)
    J[VARRHO, DMU] = -2.0 * geometry.skew(lever)
    x, P = replace(belief.x, c_b=belief.x.c_b + lever), J @ belief.P @ J.T
    if isinstance(belief, DrivenBelief):
        return replace(belief, x=x, P=P, cross=J @ belief.cross)
    return replace(belief, x=x, P=P)
