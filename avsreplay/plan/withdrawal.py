"""Where the robot flies when it does not approach: braking, and a rest point that moves with the target."""

from __future__ import annotations

import numpy as np

from avsreplay.geometry import Array
from avsreplay.outcome import Plan
from avsreplay.plan.limits import Scene
from avsreplay.plan.rendezvous import PlanParams, rendezvous


def resting(scene: Scene, r: Array, v: Array, least_m: float, a_max: float) -> Scene:
    """Return the rest point of a hold, a retreat or an abort as the goal of a rendezvous.

    The robot brakes as hard as possible relative to the centre of mass. If it would stop closer to the sphere that
    contains the target than asked for, the rest point has this distance, directly away from the target.

    Args:
        scene: The target now.
        r: (3,) position of the robot in {A} [m].
        v: (3,) its velocity [m/s].
        least_m: Smallest distance to the sphere that contains the target in every attitude [m].
        a_max: Largest acceleration [m/s2].
    """
    centre = scene.centre(np.array([0.0, 1.0]))
    drift = centre[1] - centre[0]
    relative, away = v - drift, r - centre[0]
    distance = float(np.linalg.norm(away))
    outward = away / distance if distance > 0.0 else np.array([1.0, 0.0, 0.0])
    least = scene.radius_m + least_m
    rest = away + relative * np.linalg.norm(relative) / (2.0 * a_max)
    if float(np.linalg.norm(rest)) < least:
        rest = outward * max(least, distance)
    return Scene(lambda t: (centre[0] + rest + t[:, None] * drift, np.tile(drift, (len(t), 1))))


def to_rest(scene: Scene, r0: Array, v0: Array, params: PlanParams, t_ns: int) -> Plan:
    """Return the flight to a rest point in least time.

    Args:
        scene: Of ``resting``, after t_ns.
        r0: (3,) position of the robot in {A} [m].
        v0: (3,) its velocity [m/s].
        params: Thrust, horizon, latency and grid.
        t_ns: Instant of planning.
    """
    return rendezvous(scene.goal, r0, v0, params, t_ns)
