"""The estimate of a target that does not move freely: pose and rates as a tracker of poses has
them.

Nothing is known of inertia and centre of mass. Their standard deviations are those of a start, and
the part of the covariance that the poses determine follows from them as from a measurement.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate.batch_covariance import SPHERE
from avsreplay.estimate.error_state import DIM, VARRHO, VEL, W
from avsreplay.estimate.frame import EstimatorFrame
from avsreplay.estimate.initialise import guessed_belief
from avsreplay.estimate.measurement import measurement_jacobian
from avsreplay.estimate.params import EstimatorParams
from avsreplay.estimate.track import Track
from avsreplay.geometry import Array, Pose
from avsreplay.records import State

MODE = "kinematic"
"""Value of the column ``estimator``."""


@value_class
class Motion:
    """Pose and rates at an instant, without a model of what moves the target.

    Attributes:
        T_ac: pose of {C} in {A}.
        rate: (3,) angular rate of the target in {A} [rad/s].
        velocity: (3,) of the middle of the model in {A} [m/s].
        rot_1s, pos_1s: 1 sigma of an axis of the attitude [rad] and of the position of the middle
            [m].
        rate_1s, velocity_1s: the same of the rates [rad/s, m/s].
        turning, pushing: root densities of the accelerations [rad/s^1.5, m/s^1.5].
    """

    T_ac: Pose
    rate: Array
    velocity: Array
    rot_1s: float
    pos_1s: float
    rate_1s: float
    velocity_1s: float
    turning: float
    pushing: float


def kinematic_track(
    frame: EstimatorFrame, params: EstimatorParams, track: Track, t_ns: int, motion: Motion
) -> Track:
    """Return a track whose estimate is a motion, to be published in place of that of a free body.

    Args:
        frame: of the estimator.
        params: of the estimator, auto values filled in.
        track: the estimate of the free body, which gives all that is no motion.
        t_ns: instant of the motion.
        motion: the motion.
    """
    belief = guessed_belief(t_ns, motion.T_ac, params)
    R = geometry.matrix(motion.T_ac.q)
    middle, none = motion.T_ac.apply(frame.centre_c), np.zeros(2)
    rates, unmoved = (R.T @ motion.rate, middle, motion.velocity), geometry.IDENTITY_QUAT
    about_c = State(motion.T_ac.q, *rates, none, -np.asarray(frame.centre_c), unmoved)
    x = frame.state_into(about_c, t_ns)
    H = np.zeros((12, DIM))
    H[:6] = measurement_jacobian(x)
    H[6:9, W], H[9:, VEL] = np.eye(3), np.eye(3)
    H[9:, VARRHO] = geometry.skew(motion.rate) @ R
    sigma = (motion.pos_1s, 0.5 * motion.rot_1s, motion.rate_1s, motion.velocity_1s)
    info = np.linalg.inv(belief.P) + H.T @ (H / np.repeat(np.square(sigma), 3)[:, None])
    P = np.linalg.inv(info)
    levels = replace(track.levels, torque=motion.turning / SPHERE, force=motion.pushing, count=1)
    return track.changed(
        belief=replace(belief, x=x, P=0.5 * (P + P.T)),
        mode=MODE,
        levels=levels,
        batch=None,
        drift=None,
    )
