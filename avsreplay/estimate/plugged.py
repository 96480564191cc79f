"""The stage of the processing chain around an estimator that is a plug-in of five functions.

It has the functions of ``Estimator`` that the chain calls. What a plug-in does not do, such as a
correction of the measured pose for errors of the model, is left out; what it does not state, such
as the transition of the Gramian, follows from the motion of a free body along its mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from avsreplay.estimate import _motion, dynamics
from avsreplay.estimate.common_errors import ModelErrors
from avsreplay.estimate.estimator import Estimator
from avsreplay.estimate.frame import ZERO, EstimatorFrame
from avsreplay.estimate.measurement import (
    in_fixture,
    innovation_of,
    innovation_vector,
    measured_pose,
    measurement_jacobian,
)
from avsreplay.estimate.noise import Noise
from avsreplay.estimate.params import Adaptation, EstimatorParams, Start
from avsreplay.estimate.plugin import Context, Method, load_method
from avsreplay.estimate.reference import FittedMotion, GramianRows
from avsreplay.estimate.track import Prediction, Track
from avsreplay.geometry import Array, Pose
from avsreplay.parts import ESTIMATORS, OWN, PRINTED
from avsreplay.records import (
    Admission,
    Alignment,
    Belief,
    Finding,
    Forecast,
    Innovation,
    Trajectory,
)
from avsreplay.settings import NoParameters


class PluggedEstimator:
    """One plug-in in the processing chain.

    Args:
        name: of the plug-in, which the column ``estimator`` shows.
        method: class of the plug-in.
        params: settings of the measurement noise and of the start.
        start: a given belief in {A}, or None.
        extent_m: the target's bounding diagonal [m].
    """

    def __init__(
        self,
        name: str,
        method: Callable[[Context], Method[Any]],
        params: EstimatorParams,
        start: Belief | None,
        extent_m: float,
    ) -> None:
        self.name, self.params, self.start = name, params.resolved(extent_m), start
        self.frame = EstimatorFrame(ZERO, ZERO, 0)
        self._noise = Noise(replace(self.params, adapt=Adaptation.OFF), extent_m)
        kind = ESTIMATORS.parameters(name) or NoParameters
        own = self.params.own.of(name, kind).resolved(extent_m)
        self._method = method(Context(extent_m, start, self.params.start_1s, own))

    def initial(self, t_ns: int, T_ac: Pose, acquired: bool = False) -> Track:  # noqa: ARG002
        """The state before the first scan, at a pose that was given or found."""
        return self._track(self._method.start(t_ns, T_ac), Track)

    def predict(self, track: Track, t_ns: int) -> Prediction:
        """The prediction at the instant of a scan [ns]."""
        plugged = self._method.predict(track.plugged, t_ns)
        belief, before = self._method.belief(plugged), track.belief
        _, Phi = dynamics.propagate_state(before.x, dynamics.seconds_to(before, t_ns))
        H = measurement_jacobian(belief.x)
        return Prediction(belief, Phi, H, track.window, plugged=plugged)

    def determined(
        self,
        track: Track,
        prediction: Prediction,
        alignment: Alignment,  # noqa: ARG002
    ) -> tuple[Track, Prediction]:
        """The same: a plug-in has no motions of the model that are not determined yet."""
        return track, prediction

    def innovate(self, prediction: Prediction, alignment: Alignment) -> Innovation:
        """The innovation of a registered pose with the covariance that the registration states."""
        x, P = prediction.belief.x, prediction.belief.P
        R, alpha = (
            self._noise.of(alignment, x, prediction.window),
            innovation_vector(x, alignment.T_ac),
        )
        more = 0.0, self._noise.dof(alignment), alignment.rms_m, alignment.free
        return innovation_of(P, prediction.H, alpha, R, False, *more)

    def step(
        self,
        track: Track,
        prediction: Prediction,
        innovation: Innovation | None,
        admission: Admission,
        converged: bool,
    ) -> tuple[Track, Finding]:
        """The posterior after an admitted pose; a plug-in finds no causes of a large innovation."""
        used = admission is Admission.ADMITTED and innovation is not None
        after = self.update(track, prediction, innovation, int(used), converged)
        return after, Finding.AGREES if used else Finding.UNTESTED

    def update(
        self,
        track: Track,
        prediction: Prediction,
        innovation: Innovation | None,
        gamma: int,
        converged: bool = True,  # noqa: ARG002
    ) -> Track:
        """The posterior; with gamma 0 or no innovation it is the prediction."""
        plugged = prediction.plugged
        if gamma and innovation is not None:
            x = prediction.belief.x
            T_ac = measured_pose(x, innovation.alpha)
            plugged = self._method.update(plugged, T_ac, in_fixture(innovation.R, T_ac.q, x.q_bc))
        return self._track(plugged, track.changed)

    def disturbances_of(self, track: Track) -> tuple[float, float] | None:  # noqa: ARG002
        """None: what a plug-in allows for is its own."""
        return None

    def published(self, track: Track) -> Belief:
        """The belief in {A}."""
        return track.belief

    def motion(self, belief: Belief) -> Trajectory:
        """The predicted path of the grasp point, see ``Estimator.motion``."""
        return dynamics.grasp_trajectory(belief.x)

    def attitude(self, belief: Belief) -> Callable[[Array], Array]:
        """The predicted attitudes of the fixture, see ``Estimator.attitude``."""
        return dynamics.fixture_attitude(belief.x)

    def track_forecast(self, track: Track, times_s: Array, grasp_c: Array = ZERO) -> Forecast:
        """The predicted 1 sigma of the grasp point (3,) in {C} at times (n,) [s after the scan].

        A plug-in predicts the origin of {C}; the error of the attitude acts on the distance to it.
        """
        found, arm_m = self._method.forecast(track.plugged, times_s), float(np.linalg.norm(grasp_c))
        moved = np.hypot(found.pos_1s_m, arm_m * found.rot_1s_rad)
        return Forecast(found.times_s, moved, found.vel_1s_mps, found.rot_1s_rad)

    def pose_covariance(self, belief: Belief) -> Array:
        """Covariance (6, 6) of the pose of {C}, see ``Estimator.pose_covariance``."""
        return _motion.pose_covariance(belief.P, measurement_jacobian(belief.x))

    def gramian_rows(
        self,
        track: Track,  # noqa: ARG002
        prediction: Prediction,
        innovation: Innovation | None,
        last: FittedMotion | None,
    ) -> GramianRows:
        """What a scan gives to the observability Gramian, see ``Estimator.gramian_rows``."""
        R = None if innovation is None else innovation.R
        return GramianRows(last, False, prediction.Phi, prediction.H, R)

    def residual_after(
        self,
        track: Track,
        prediction: Prediction,
        innovation: Innovation,
    ) -> None:
        """None: the tests of consistency after the update belong to the program's own estimator."""

    def _track(self, plugged: Any, make: Callable[..., Track]) -> Track:
        belief = self._method.belief(plugged)
        return make(
            belief=Belief(belief.t_ns, belief.x, np.array(belief.P)),
            mode=self.name,
            plugged=plugged,
            errors=ModelErrors(kept=False),
        )


AnyEstimator = Estimator | PluggedEstimator
"""What the chain calls: the program's own estimator, or a plug-in in its place."""


def estimator_of(
    params: EstimatorParams, start: Belief | None, extent_m: float, epoch_ns: int, centre_c: Array
) -> AnyEstimator:
    """Return the estimator that the settings name.

    Args:
        params: settings; ``method`` is the name.
        start: a given belief in {A}, or None.
        extent_m: the target's bounding diagonal [m].
        epoch_ns: instant of the first scan [ns].
        centre_c: (3,) centre of the model in {C} [m].

    Raises:
        UsageError: no estimator has this name.
    """
    if params.method == OWN:
        return Estimator(params, start, extent_m, epoch_ns, centre_c)
    if params.method == PRINTED:
        return Estimator(params.as_printed(), start, extent_m, epoch_ns, centre_c)
    given = start if params.start in (Start.AUTO, Start.NEAR) else None
    return PluggedEstimator(params.method, load_method(params.method), params, given, extent_m)
