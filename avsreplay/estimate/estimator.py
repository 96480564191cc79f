"""The estimator as the replay uses it: one frozen track in, one out.

Modes: ``near`` speaks from a given start until the first healthy scan, ``start`` from the first poses of a cold one,
``fit`` from the maximum-likelihood fit over all poses so far, ``filter`` afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from avsreplay.errors import UsageError
from avsreplay.estimate import adapt, ekf, horizon
from avsreplay.estimate.adapt import NoiseWindow
from avsreplay.estimate.cold import ColdFit, refit
from avsreplay.estimate.fit import FitParams
from avsreplay.estimate.measure import in_fixture, innovation, measured_pose, noise_of, residual, sensitivity
from avsreplay.estimate.motion import propagate
from avsreplay.estimate.params import Adaptation, EstimatorParams, NoiseSource, Start
from avsreplay.estimate.start import PoseFix, first_belief, guessed_belief
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Alignment, Belief, Forecast, Innovation, State, Trajectory

__all__ = ["Estimator", "Prediction", "Track"]

_FEWEST_TO_FIT = 3
_WHITE = frozen(np.ones(2))
_FREE_RAD = 1.0  # standard deviation of an attitude direction the view leaves free


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """What the estimator carries from scan to scan.

    Attributes:
        belief: after the last scan.  mode: 'near', 'start', 'fit' or 'filter'.  window: of the noise adaptation.
        sigma_hits: sigma bounds that cut the gain so far.  r_floors: eigenvalues of R raised so far.
        R: (6, 6) noise of the last healthy scan [m, half-angle], None before it.
        fixes: healthy poses, cold: the last fit to them, both of modes 'start' and 'fit' only.
        charted: does the filter move through the chart (after a fit), or as the paper's.
        colour: (2,) the fit's word on the poses' correlation in time, attitude and position.
    """

    belief: Belief
    mode: str
    window: NoiseWindow = field(default_factory=NoiseWindow.empty)
    sigma_hits: int = 0
    r_floors: int = 0
    R: Array | None = None
    fixes: tuple[PoseFix, ...] = ()
    cold: ColdFit | None = None
    charted: bool = False
    colour: Array = field(default_factory=lambda: _WHITE)


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
        self.fit = FitParams(rescale=params.adapt is not Adaptation.OFF)
        self._R0 = self.params.R0
        self._free = (_FREE_RAD, 0.5 * extent_m)

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
        """alpha, S and R of a measured pose; R is the base noise with the window's adaptation, floored."""
        x = prediction.belief.x
        R = self._noise(prediction.window, self._base(alignment, x))
        return ekf.innovate(prediction.belief.P, prediction.H, innovation(x, alignment.T_ac), R)

    def update(self, track: Track, prediction: Prediction, seen: Innovation | None, gamma: int) -> Track:
        """The posterior; with gamma 0 or nothing seen the prior stands, exactly."""
        if seen is None or gamma == 0:
            return replace(track, belief=prediction.belief)
        if track.mode in ("start", "fit"):
            return self._begin(track, prediction, seen)
        colour = track.colour if track.charted else self._colour(track, prediction)
        if track.charted:
            belief, hits = ekf.update_in_chart(prediction.belief, prediction.H, seen, colour), 0
        else:
            belief, hits = ekf.update(prediction.belief, prediction.H, seen, self.params.sigma_margin, colour)
        window = self._remember(track.window, prediction, seen, belief, colour)
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
        self, window: NoiseWindow, prediction: Prediction, seen: Innovation, posterior: Belief, colour: Array
    ) -> NoiseWindow:
        """The window with this epoch's a posteriori residual z - h(x+), its ratios against the base R.

        H P+ H' is taken without the widening: what the fit took up of one scan is what white noise would leave.
        """
        left = residual(posterior.x, prediction.belief.x, seen.alpha)
        HPH = prediction.H @ posterior.P @ prediction.H.T / float(colour.mean())
        s = self._factors(window)
        return adapt.push(window, left, HPH, seen.R / np.outer(s, s), self.params.window)

    def _begin(self, track: Track, prediction: Prediction, seen: Innovation) -> Track:
        """Another healthy pose of a cold start: fit them all when enough have come, else carry the last fit along."""
        fixes = (*track.fixes, self._fix(prediction, seen))
        if len(fixes) < _FEWEST_TO_FIT:
            return replace(track, belief=first_belief(fixes, self.params), fixes=fixes, R=seen.R)
        count = 0 if track.cold is None else track.cold.count
        if len(fixes) < count + max(1.0, self.params.refit_growth * count):
            belief = ekf.update_in_chart(prediction.belief, prediction.H, seen, track.colour)
            return replace(track, belief=belief, fixes=fixes, R=seen.R)
        cold = refit(fixes, track.cold, self.params, self.fit)
        window = adapt.filled(seen.R / np.outer(s := self._factors(track.window), s), cold.factors, self.params.window)
        track = replace(track, belief=cold.belief, window=window, R=seen.R, colour=cold.colour)
        if cold.settled:
            return replace(track, mode="filter", fixes=(), cold=None, charted=True)
        return replace(track, mode="fit", fixes=fixes, cold=cold, charted=True)

    def _fix(self, prediction: Prediction, seen: Innovation) -> PoseFix:
        x = prediction.belief.x
        pose = measured_pose(x, seen.alpha)
        s = self._factors(prediction.window)
        return PoseFix(prediction.belief.t_ns, pose, in_fixture(seen.R / np.outer(s, s), pose.q, x.q_bc))

    def _colour(self, track: Track, prediction: Prediction) -> Array:
        """(2,) how many times less than white ones the poses say; the paper's own filter takes them as white."""
        if self.params.start is Start.PAPER:
            return _WHITE
        prior = prediction.belief
        turn = float(np.linalg.norm(prior.x.w_b)) * (prior.t_ns - track.belief.t_ns) * 1e-9
        return np.full(2, self.params.colour(turn))

    def _factors(self, window: NoiseWindow) -> Array:
        """(6,) factors of the base R in force."""
        return adapt.factors(window, self.params.window) if self.params.adapt is Adaptation.SCALE else np.ones(6)
