"""The estimator as the replay uses it: one frozen track in, one out.

``near`` speaks from a given start until the first healthy scan, ``start`` from the first poses, ``filter`` afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from avsreplay.estimate import adapt, ekf, horizon
from avsreplay.estimate.adapt import NoiseWindow
from avsreplay.estimate.measure import innovation, measured_pose, noise_of, sensitivity
from avsreplay.estimate.motion import propagate
from avsreplay.estimate.params import Adaptation, EstimatorParams, NoiseSource
from avsreplay.estimate.start import PoseFix, first_belief, guessed_belief
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, Belief, Forecast, Innovation, State, Trajectory

__all__ = ["Estimator", "Prediction", "Track"]

_FREE_RAD = 1.0  # standard deviation of an attitude direction the view leaves free


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """What the estimator carries from scan to scan.

    Attributes:
        belief: after the last scan.  mode: 'near', 'start' or 'filter'.  window: residuals of the noise adaptation.
        sigma_hits: sigma bounds that cut the gain so far.  r_floors: eigenvalues of R raised so far.
        R: (6, 6) noise of the last healthy scan [m, half-angle], None before it.  fixes: first poses, mode 'start'.
    """

    belief: Belief
    mode: str
    window: NoiseWindow = field(default_factory=NoiseWindow.empty)
    sigma_hits: int = 0
    r_floors: int = 0
    R: Array | None = None
    fixes: tuple[PoseFix, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The prior at a scan's instant.

    Attributes:
        belief: prior mean and covariance.  Phi: (20, 20) of the step.  H: (6, 20) at the prior.
        window: the track's noise window.
    """

    belief: Belief
    Phi: Array
    H: Array
    window: NoiseWindow


class Estimator:
    """The 20-state adaptive constrained filter.

    Args:
        params: settings; lengths left out are taken from ``extent_m``, the target's bounding diagonal [m].
        start: the first belief where one is given (near start).
    """

    def __init__(self, params: EstimatorParams, start: Belief | None, extent_m: float) -> None:
        self.params = params.resolved(extent_m)
        self.start = start
        self._R0 = self.params.R0
        self._free = (_FREE_RAD, 0.5 * extent_m)

    def initial(self, t_ns: int, T_ac: Pose) -> Track:
        """The track before the first scan: the given start, else a body at rest at the pose ``T_ac``."""
        if self.start is not None:
            return Track(self.start, "near")
        return Track(guessed_belief(t_ns, T_ac, self.params), "start")

    def predict(self, track: Track, t_ns: int) -> Prediction:
        """The prior at ``t_ns`` (eq:KF_propagate)."""
        belief, Phi = propagate(track.belief, t_ns, self.params.torque_noise_radps15, self.params.force)
        return Prediction(belief, Phi, sensitivity(belief.x), track.window)

    def innovate(self, prediction: Prediction, alignment: Alignment) -> Innovation:
        """alpha, S and R of a measured pose; R is the base noise with the window's adaptation, floored."""
        x = prediction.belief.x
        R = self._noise(prediction.window, self._base(alignment, x))
        return ekf.innovate(prediction.belief.P, prediction.H, innovation(x, alignment.T_ac), R)

    def update(self, track: Track, prediction: Prediction, seen: Innovation | None, gamma: int) -> Track:
        """The posterior; with gamma 0 or nothing seen the prior stands, exactly."""
        if seen is None or gamma == 0:
            return replace(track, belief=prediction.belief)
        if track.mode == "start":
            return self._begin(track, prediction, seen)
        belief, hits = ekf.update(prediction.belief, prediction.H, seen, self.params.sigma_margin)
        window = self._remember(track.window, prediction, seen, belief)
        return replace(
            track,
            belief=belief,
            mode="filter",
            window=window,
            sigma_hits=track.sigma_hits + hits,
            r_floors=track.r_floors + adapt.at_floor(seen.R, self._R0, self.params.r_floor),
            R=seen.R,
        )

    def motion(self, belief: Belief) -> Trajectory:
        """The grasp point after ``belief``'s instant, for the planner."""
        return horizon.trajectory(belief.x)

    def forecast(self, belief: Belief, times_s: Array) -> Forecast:
        """Predicted 1 sigma of the grasp point at ``times_s`` after ``belief``'s instant."""
        return horizon.forecast(belief, times_s, self.params.torque_noise_radps15, self.params.force)

    def _base(self, alignment: Alignment, x: State) -> Array:
        if self.params.noise is NoiseSource.R0 or self.params.adapt is Adaptation.MATRIX:
            return self._R0
        R = noise_of(alignment, x, self._free)
        return self._R0 if R is None else R

    def _noise(self, window: NoiseWindow, base: Array) -> Array:
        length = self.params.window
        if self.params.adapt is Adaptation.MATRIX:
            base = adapt.matrix_noise(window, self._R0, length)
        elif self.params.adapt is Adaptation.SCALE:
            s = adapt.factors(window, length)
            base = base * np.outer(s, s)
        return adapt.floored(base, self._R0, self.params.r_floor)

    def _remember(
        self, window: NoiseWindow, prediction: Prediction, seen: Innovation, posterior: Belief
    ) -> NoiseWindow:
        """The window with this epoch's a posteriori residual z - h(x+), its ratios against the base R."""
        residual = innovation(posterior.x, measured_pose(prediction.belief.x, seen.alpha))
        HPH = prediction.H @ posterior.P @ prediction.H.T
        s = adapt.factors(window, self.params.window)
        return adapt.push(window, residual, HPH, seen.R / np.outer(s, s), self.params.window)

    def _begin(self, track: Track, prediction: Prediction, seen: Innovation) -> Track:
        fix = PoseFix(prediction.belief.t_ns, measured_pose(prediction.belief.x, seen.alpha), seen.R)
        fixes = (*track.fixes, fix)
        belief = first_belief(fixes, self.params)
        if len(fixes) < self.params.start_poses:
            return replace(track, belief=belief, fixes=fixes, R=seen.R)
        return replace(track, belief=belief, fixes=(), mode="filter", R=seen.R)
