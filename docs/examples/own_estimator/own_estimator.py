"""A tracker that knows no dynamics: angular rate and velocity of the fixture drift at random."""

import numpy as np

from avsreplay.estimate.dynamics import grasp_forecast, propagate
from avsreplay.estimate.error_state import boxplus
from avsreplay.estimate.measurement import in_camera, innovation_vector, measurement_jacobian
from avsreplay.geometry import IDENTITY_QUAT, matrix
from avsreplay.records import Belief, State

RATE_DRIFT = 0.02  # root density of the angular acceleration [rad/s^1.5]
VELOCITY_DRIFT = 0.02  # root density of the acceleration, in extents of the target [1/s^1.5]
FIXED = 1e-9  # standard deviation of the states that this tracker does not estimate
MOVING = 12  # attitude, rate, position and velocity come first


class ConstantTwist:
    """A Kalman filter over attitude, rate, position and velocity of the fixture."""

    about = "locally constant rate and velocity, no dynamics"

    def __init__(self, context):
        self.context = context
        self.drift = RATE_DRIFT, VELOCITY_DRIFT * context.extent_m

    def start(self, t_ns, T_ac):
        """At rest at the first pose, or with the rate and velocity that are given."""
        sd = np.array(self.context.start_1s)
        sd[MOVING:] = FIXED
        rate, velocity = np.zeros(3), np.zeros(3)
        given = self.context.start
        if given is not None:  # of the fixture: its rate in its own axes, its velocity in {A}
            x, t_ns, T_ac = given.x, given.t_ns, given.x.T_ac
            rate = matrix(x.q_bc).T @ x.w_b
            velocity = x.v_a + np.cross(matrix(x.q_ab) @ x.w_b, T_ac.t - x.r_a)
        # a sphere whose centre is the fixture: without torque the rate is constant
        x = State(T_ac.q, rate, T_ac.t, velocity, np.zeros(2), np.zeros(3), IDENTITY_QUAT)
        return Belief(t_ns, x, np.diag(sd**2))

    def predict(self, state, t_ns):
        """The same rate and velocity, less certain."""
        return propagate(state, t_ns, *self.drift)[0]

    def update(self, state, T_ac, C):
        """Kalman's update with the covariance that the registration states."""
        x, H = state.x, measurement_jacobian(state.x)
        S = H @ state.P @ H.T + in_camera(C, T_ac.q, x.q_bc)
        K = np.linalg.solve(S, H @ state.P).T
        P = state.P - K @ S @ K.T
        mean = boxplus(x, K @ innovation_vector(x, T_ac))
        return Belief(state.t_ns, mean, 0.5 * (P + P.T))

    def forecast(self, state, times_s):
        """The 1 sigma of the grasp point later."""
        return grasp_forecast(state, times_s, *self.drift)

    def belief(self, state):
        """The state is a belief already."""
        return state
