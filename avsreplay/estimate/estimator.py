"""The estimator as the replay uses it: one frozen track in, one out.

Modes: ``near`` speaks from a given start until the first healthy scan, ``start`` from the first poses of a cold one,
``fit`` from the maximum-likelihood fit over all poses so far, ``filter`` afterwards. The filter is set against such a
fit now and then; where it is contradicted, the fit speaks again.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field, replace
from operator import attrgetter

import numpy as np

from avsreplay.errors import UsageError
from avsreplay.estimate import adapt, ekf, horizon
from avsreplay.estimate.adapt import NoiseWindow
from avsreplay.estimate.audit import contradicted, start_at
from avsreplay.estimate.cold import ColdFit, refit
from avsreplay.estimate.drift import memory_s
from avsreplay.estimate.fit import FitParams
from avsreplay.estimate.measure import in_fixture, innovation, measured_pose, noise_of, residual, sensitivity
from avsreplay.estimate.motion import propagate
from avsreplay.estimate.params import Adaptation, EstimatorParams, NoiseSource, Start
from avsreplay.estimate.start import PoseFix, first_belief, guessed_belief
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Alignment, Belief, Forecast, Innovation, State, Trajectory

__all__ = ["Estimator", "Prediction", "Track"]

_FEWEST_TO_FIT = 3
_FEWEST_TO_AUDIT, _AUDIT_GROWTH, _FEWEST_IN_DOUBT = 50, 0.25, 10
_LONGEST_S = 1e9  # what nanoseconds hold
_instant = attrgetter("t_ns")
_WHITE = frozen(np.ones(2))
_ONES, _NOTHING = frozen(np.ones(6)), frozen(np.zeros((6, 6)))
_FREE_RAD = 1.0  # standard deviation of an attitude direction the view leaves free


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """What the estimator carries from scan to scan.

    Attributes:
        belief: after the last scan.  mode: 'near', 'start', 'fit' or 'filter'.  window: of the noise adaptation.
        sigma_hits: sigma bounds that cut the gain so far.  r_floors: eigenvalues of R raised so far.
        R: (6, 6) noise of the last healthy scan [m, half-angle], zero before it.
        fixes: healthy poses: all of them until the filter speaks, then the newest.  cold: the last fit that spoke.
        since: healthy poses since the last fit was made.  recalls: how often a fit took the word from the filter.
        charted: does the filter move through the chart (after a fit), or as the paper's.
        colour: (2,) the fit's word on the poses' correlation in time, attitude and position.
    """

    belief: Belief
    mode: str
    window: NoiseWindow = field(default_factory=NoiseWindow.empty)
    sigma_hits: int = 0
    r_floors: int = 0
    R: Array = field(default_factory=lambda: _NOTHING)
    fixes: tuple[PoseFix, ...] = ()
    cold: ColdFit | None = None
    since: int = 0
    recalls: int = 0
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
        self.robust = params.robust and params.start is not Start.PAPER
        self.audits = 0 if params.start is Start.PAPER else params.audit_poses
        self.fit = FitParams(rescale=params.adapt is not Adaptation.OFF)
        self._memory_ns = round(min(memory_s(self.params.torque_noise_radps15), _LONGEST_S) * 1e9)
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
        return ekf.innovate(prediction.belief.P, prediction.H, innovation(x, alignment.T_ac), R, self.robust)

    def update(
        self, track: Track, prediction: Prediction, seen: Innovation | None, gamma: int, converged: bool = True
    ) -> Track:
        """The posterior; with gamma 0 or nothing seen the prior stands, exactly.

        A fit gives way to the filter once its estimate has ``converged`` (t_1), as the last scan's row says.
        """
        if seen is None or gamma == 0:
            return replace(track, belief=prediction.belief)
        if track.mode in ("start", "fit"):
            return self._begin(track, prediction, seen, converged)
        return self._audited(self._filtered(track, prediction, seen))

    def _filtered(self, track: Track, prediction: Prediction, seen: Innovation) -> Track:
        """The filter's posterior, its noise window and its memory of poses."""
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
            fixes=self._remembered(track, prediction, seen)[-self.audits :] if self.audits else (),
            since=track.since + 1,
        )

    def _audited(self, track: Track) -> Track:
        """The track, or the fit's where a fit to the same poses contradicts it.

        A fit whose likelihood is not normal yet has that right only where the poses themselves contradict the filter.
        """
        enough = max(_FEWEST_TO_AUDIT, _AUDIT_GROWTH * len(track.fixes))
        if not self.audits or track.since < (_FEWEST_IN_DOUBT if track.window.doubtful else enough):
            return track
        begin = start_at(track.belief, track.fixes[0].t_ns)
        cold = refit(track.fixes, self.params, self.fit, start=begin)
        if not ((cold.settled or track.window.doubtful) and contradicted(track.belief, cold.belief)):
            return replace(track, since=0)
        return replace(self._adopted(track, cold, cold.settled), recalls=track.recalls + 1)

    def _adopted(self, track: Track, cold: ColdFit, settled: bool) -> Track:
        """The track with a fit's word for its own."""
        s = self._factors(track.window)
        window = adapt.filled(track.R / np.outer(s, s), cold.factors, self.params.window)
        mode = "filter" if settled else "fit"
        spoken = replace(track, belief=cold.belief, mode=mode, window=window, cold=cold, since=0)
        return replace(spoken, charted=True, colour=cold.colour)

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
        if self.params.adapt is Adaptation.MATRIX:
            base = adapt.matrix_noise(window, self._R0, self.params.window)
        elif self.params.adapt is Adaptation.SCALE:
            base = base * (window.factors[:, None] * window.factors)
        return adapt.floored(base, self._R0, self.params.r_floor)

    def _remember(
        self, window: NoiseWindow, prediction: Prediction, seen: Innovation, posterior: Belief, colour: Array
    ) -> NoiseWindow:
        """The window with this epoch's a posteriori residual z - h(x+), its ratios against the base R.

        H P+ H' is taken without the widening: what the fit took up of one scan is what white noise would leave.
        """
        left = residual(posterior.x, prediction.belief.x, seen.alpha)
        HPH = prediction.H @ posterior.P @ prediction.H.T * (2.0 / float(colour[0] + colour[1]))
        s = self._factors(window)
        return adapt.push(window, left, HPH, seen.R / (s[:, None] * s), self.params.window, seen.weight)

    def _begin(self, track: Track, prediction: Prediction, seen: Innovation, converged: bool) -> Track:
        """Another healthy pose of a cold start: fit them all when enough have come, else carry the last fit along."""
        fixes, since = self._remembered(track, prediction, seen), track.since + 1
        if len(fixes) < _FEWEST_TO_FIT:
            return replace(track, belief=first_belief(fixes, self.params), fixes=fixes, R=seen.R)
        count = 0 if track.cold is None else track.cold.count
        if since < max(1.0, self.params.refit_growth * count):
            belief = prediction.belief
            if track.cold is not None and track.cold.settled:
                belief = ekf.update_in_chart(belief, prediction.H, seen, track.colour)
            return replace(track, belief=belief, fixes=fixes, R=seen.R, since=since)
        moved = track.cold is not None and track.cold.epoch_ns != fixes[0].t_ns
        start = start_at(prediction.belief, fixes[0].t_ns) if moved else None
        cold = refit(fixes, self.params, self.fit, track.cold, start)
        return self._adopted(replace(track, R=seen.R, fixes=fixes), cold, cold.settled and converged)

    def _remembered(self, track: Track, prediction: Prediction, seen: Innovation) -> tuple[PoseFix, ...]:
        """The poses a fit may look back on, with this one."""
        oldest = prediction.belief.t_ns - self._memory_ns
        return (*track.fixes[bisect_left(track.fixes, oldest, key=_instant) :], self._fix(prediction, seen))

    def _fix(self, prediction: Prediction, seen: Innovation) -> PoseFix:
        x = prediction.belief.x
        pose = measured_pose(x, seen.alpha)
        s = self._factors(prediction.window)
        return PoseFix(prediction.belief.t_ns, pose, in_fixture(seen.R / (s[:, None] * s), pose.q, x.q_bc))

    def _colour(self, track: Track, prediction: Prediction) -> Array:
        """(2,) how many times less than white ones the poses say; the paper's own filter takes them as white."""
        if self.params.start is Start.PAPER:
            return _WHITE
        prior = prediction.belief
        turn = float(np.linalg.norm(prior.x.w_b)) * (prior.t_ns - track.belief.t_ns) * 1e-9
        return np.full(2, self.params.colour(turn))

    def _factors(self, window: NoiseWindow) -> Array:
        """(6,) factors of the base R in force."""
        return window.factors if self.params.adapt is Adaptation.SCALE else _ONES
