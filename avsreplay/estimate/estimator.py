"""The estimator as the replay uses it: one frozen track in, one out.

Modes: ``near`` speaks from a given start until the first healthy scan, ``start`` from the first poses of a cold one,
``fit`` from the maximum-likelihood fit over all poses so far, ``filter`` afterwards. The filter is set against such a
fit now and then; where it is contradicted, the fit speaks again.
"""

from __future__ import annotations

from dataclasses import replace

from avsreplay.errors import UsageError
from avsreplay.estimate import ekf, horizon
from avsreplay.estimate.fitting import Fitting
from avsreplay.estimate.measure import innovation, sensitivity
from avsreplay.estimate.motion import propagate
from avsreplay.estimate.noise import Noise
from avsreplay.estimate.params import EstimatorParams, Start
from avsreplay.estimate.start import guessed_belief
from avsreplay.estimate.track import Prediction, Track
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, Belief, Forecast, Innovation, Trajectory

__all__ = ["Estimator", "Prediction", "Track"]


class Estimator:
    """The 20-state adaptive constrained filter, and the fit that it begins with and answers to.

    Args:
        params: settings; lengths left out are taken from ``extent_m``, the target's bounding diagonal [m].
        start: the first belief where one is given.

    Raises:
        UsageError: a near start is asked for and none is given.
    """

    def __init__(self, params: EstimatorParams, start: Belief | None, extent_m: float) -> None:
        self.params = params.resolved(extent_m)
        if params.start is Start.NEAR and start is None:
            hint = "use start = cold, or a log whose scenario has a [start] table"
            raise UsageError("a near start is asked for and the log gives none", where="estimator.start", hint=hint)
        self.start = start if params.start in (Start.AUTO, Start.NEAR) else None
        self.noise = Noise(self.params, extent_m)
        self.fitting = Fitting(self.params, self.noise, self.start)
        self._robust = params.robust and params.start is not Start.PAPER

    def initial(self, t_ns: int, T_ac: Pose) -> Track:
        """The track before the first scan: the given start, else a body at rest at the pose ``T_ac``."""
        if self.start is not None:
            return Track(self.start, "near")
        mode = "filter" if self.params.start is Start.PAPER else "start"
        return Track(guessed_belief(t_ns, T_ac, self.params), mode)

    def predict(self, track: Track, t_ns: int) -> Prediction:
        """The prior at ``t_ns`` (eq:KF_propagate)."""
        belief, Phi = propagate(track.belief, t_ns, self.params.torque_noise_radps15, self.params.force)
        return Prediction(belief, Phi, sensitivity(belief.x), track.window)

    def innovate(self, prediction: Prediction, alignment: Alignment) -> Innovation:
        """alpha, S and R of a measured pose, and the weight it is given."""
        x = prediction.belief.x
        R = self.noise.of(alignment, x, prediction.window)
        alpha, share = innovation(x, alignment.T_ac), self.noise.share(alignment)
        return ekf.innovate(prediction.belief.P, prediction.H, alpha, R, self._robust, share)

    def update(
        self, track: Track, prediction: Prediction, seen: Innovation | None, gamma: int, converged: bool = True
    ) -> Track:
        """The posterior; with gamma 0 or nothing seen the prior stands, exactly.

        A fit gives way to the filter once its estimate has ``converged`` (t_1), as the last scan's row says.
        """
        if seen is None or gamma == 0:
            return replace(track, belief=prediction.belief)
        if track.mode in ("start", "fit") or (track.mode == "near" and not self.params.by_gain):
            return self.fitting.begun(track, prediction, seen, converged)
        return self.fitting.audited(self._filtered(track, prediction, seen))

    def motion(self, belief: Belief) -> Trajectory:
        """The grasp point after ``belief``'s instant, for the planner."""
        return horizon.trajectory(belief.x)

    def forecast(self, belief: Belief, times_s: Array) -> Forecast:
        """Predicted 1 sigma of the grasp point at ``times_s`` after ``belief``'s instant."""
        return horizon.forecast(belief, times_s, self.params.torque_noise_radps15, self.params.force)

    def _filtered(self, track: Track, prediction: Prediction, seen: Innovation) -> Track:
        """The filter's posterior, its noise window and its memory of poses."""
        colour = self.noise.colour(track, prediction.belief, seen)
        if self.params.by_gain and track.cold is None:
            belief, hits = ekf.update(prediction.belief, prediction.H, seen, self.params.sigma_margin, colour)
        else:
            belief, hits = ekf.update_in_chart(prediction.belief, prediction.H, seen, colour), 0
        return replace(
            track,
            belief=belief,
            mode="filter",
            window=self.noise.remembered(prediction, seen, belief, colour),
            sigma_hits=track.sigma_hits + hits,
            r_floors=track.r_floors + self.noise.floors(seen.R),
            R=seen.R,
            fixes=self.fitting.remembered(track, prediction, seen),
            since=track.since + 1,
        )
