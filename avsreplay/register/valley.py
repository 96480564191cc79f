"""The best pose along the two directions in which a scan determines a pose least.

Points of another object next to the surface can hold a pose away from the minimum that the surface
alone has; the cost is then lower along the floor of the valley.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Pose
from avsreplay.register.backend import Target
from avsreplay.register.generators.weak_directions import weak_motions
from avsreplay.register.screening import Screen

# steps of half a gate each way along the two directions; points
VALLEY_STEPS = 8
VALLEY_POINTS = 250
VALLEY_WORK = 16_000  # cost of the search along the valley [point searches]


def along_valley(
    target: Target, screen: Screen, points: NDArray[Any], T_ca: Pose
) -> tuple[Pose, int]:
    """Return the best pose along the two directions that points (n, 3) in {A} determine least, or
    the registered pose itself; and the work.
    """
    few = points[:: max(1, len(points) // VALLEY_POINTS)]
    weak, work = weak_motions(target, screen, few, T_ca, 2)
    work += VALLEY_WORK
    if weak is None:
        return T_ca, work
    width, middle = screen.width(weak.at), weak.centre
    steps = (
        0.5
        * target.limits.gate_m
        * np.delete(np.arange(-VALLEY_STEPS, VALLEY_STEPS + 1), VALLEY_STEPS)
    )
    tried = np.concatenate(
        [np.zeros((1, 6)), np.multiply.outer(steps, weak.motions).reshape(-1, 6)]
    )
    turns = geometry.exp(tried[:, :3] / weak.radius_m)
    moved = np.einsum("kij,nj->kni", geometry.matrix(turns), T_ca.apply(few) - middle)
    moved += (middle + tried[:, 3:])[:, None]
    found = target.index.closest(moved.reshape(-1, 3), camera_c=weak.camera_c, most_m=width)
    d2 = np.minimum(found.d2.reshape(len(tried), -1), width**2)
    best = int(np.argmin(d2.mean(axis=1)))
    return weak.displaced(tried[best]) if best else T_ca, work
