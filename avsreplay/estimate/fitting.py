"""The fit's part in a run: it speaks first where nothing is known, and again where the filter is contradicted."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace
from operator import attrgetter

import numpy as np

from avsreplay.estimate import adapt, ekf
from avsreplay.estimate.audit import contradicted, start_at
from avsreplay.estimate.chart import to_chart
from avsreplay.estimate.cold import ColdFit, given_prior, refit
from avsreplay.estimate.drift import memory_s
from avsreplay.estimate.fit import FitParams, Prior
from avsreplay.estimate.measure import in_fixture, measured_pose
from avsreplay.estimate.motion import moved
from avsreplay.estimate.noise import Noise
from avsreplay.estimate.params import Adaptation, EstimatorParams, Start
from avsreplay.estimate.spread import carried
from avsreplay.estimate.start import PoseFix, first_belief
from avsreplay.estimate.track import WHITE, Prediction, Track
from avsreplay.records import Belief, Innovation

__all__ = ["Fitting"]

_FEWEST_TO_FIT = 3
_FEWEST_TO_AUDIT, _AUDIT_GROWTH, _FEWEST_IN_DOUBT = 50, 0.25, 10
_RECENT = 0.1  # of the fit's memory: pushes have done little to what was given so long ago
_SURE_HALF_RAD = 0.2  # 1 sigma of the given attitude beyond which it is not normal any more
_LONGEST_S = 1e9  # what nanoseconds hold
_instant = attrgetter("t_ns")


class Fitting:
    """Fits to the healthy poses so far.

    Args:
        params: settings, auto values filled in.
        noise: the measurement noise in force.
        start: the belief that is given, None where there is none. It is left out once the poses contradict it.
    """

    def __init__(self, params: EstimatorParams, noise: Noise, start: Belief | None) -> None:
        self.params, self.noise, self.start = params, noise, start
        self.audits = 0 if params.start is Start.PAPER else params.audit_poses
        self._prior = None if start is None or params.start is Start.PAPER else given_prior(start)
        self._rules = FitParams(rescale=params.adapt is not Adaptation.OFF)
        self._memory_ns = round(min(memory_s(params.torque_noise_radps15), _LONGEST_S) * 1e9)

    def begun(self, track: Track, prediction: Prediction, seen: Innovation, converged: bool) -> Track:
        """Another healthy pose where the fit speaks: fit them all when enough have come, else go on with the last fit.

        Between fits the filter's update joins in only where the likelihood is normal: a bent one is carried along as it
        is.
        """
        track = replace(track, fixes=self._with(track, prediction, seen), R=seen.R, since=track.since + 1)
        if len(track.fixes) < _FEWEST_TO_FIT:
            return replace(track, belief=self._first(track, prediction, seen))
        last = track.cold
        if last is None or track.since >= max(1.0, self._growth(last) * last.count):
            forgot = last is not None and last.epoch_ns != track.fixes[0].t_ns
            start = start_at(prediction.belief, track.fixes[0].t_ns) if forgot else None
            cold = refit(track.fixes, self.params, self._rules, last, start, self._given(track.fixes[0].t_ns))
            dropped = cold.forsaken and not (last is not None and last.forsaken)
            track = replace(track, recalls=track.recalls + dropped)
            return self._adopted(track, cold, cold.settled and converged)
        if last.settled:
            return replace(track, belief=ekf.update_in_chart(prediction.belief, prediction.H, seen, last.colour))
        return replace(track, belief=prediction.belief)

    def _growth(self, last: ColdFit) -> float:
        """Share by which the poses grow until the next fit; a normal likelihood is carried along well in between."""
        return _AUDIT_GROWTH if last.settled else self.params.refit_growth

    def remembered(self, track: Track, prediction: Prediction, seen: Innovation) -> tuple[PoseFix, ...]:
        """The newest poses, for an audit of the filter."""
        return self._with(track, prediction, seen)[-self.audits :] if self.audits else ()

    def audited(self, track: Track) -> Track:
        """The filter's track, or the fit's where a fit to the same poses contradicts it.

        A fit whose likelihood is not normal yet has that right only where the poses themselves contradict the filter.
        """
        enough = max(_FEWEST_TO_AUDIT, _AUDIT_GROWTH * len(track.fixes))
        if not self.audits or track.since < (_FEWEST_IN_DOUBT if track.window.doubtful else enough):
            return track
        epoch_ns = track.fixes[0].t_ns
        forsaken = track.cold is not None and track.cold.forsaken
        begin, given = start_at(track.belief, epoch_ns), None if forsaken else self._given(epoch_ns)
        cold = refit(track.fixes, self.params, self._rules, start=begin, given=given)
        if (cold.settled or track.window.doubtful) and contradicted(track.belief, cold.belief):
            return replace(self._adopted(track, cold, cold.settled), recalls=track.recalls + 1)
        return replace(track, since=0)

    def _first(self, track: Track, prediction: Prediction, seen: Innovation) -> Belief:
        """The belief after the first poses, too few for a fit."""
        if self.start is None:
            return first_belief(track.fixes, self.params)
        return ekf.update_in_chart(prediction.belief, prediction.H, seen, WHITE)

    def _given(self, t_ns: int) -> Prior | None:
        """What was given, at the first pose's instant; nothing where the way there has made little of it."""
        if self.start is None or self._prior is None or t_ns - self.start.t_ns > _RECENT * self._memory_ns:
            return None
        x, step = carried(self._prior.mean, (t_ns - self.start.t_ns) * 1e-9)
        P = step @ self._prior.P @ step.T
        return Prior(to_chart(x), P) if float(np.sqrt(np.trace(P[:3, :3]))) < _SURE_HALF_RAD else None

    def _adopted(self, track: Track, cold: ColdFit, settled: bool) -> Track:
        """The track with a fit's word for its own; the filter goes on from it once ``settled``."""
        window = adapt.filled(self.noise.base(track.R, track.window), cold.factors, self.params.window)
        mode = "filter" if settled else "fit"
        return replace(track, belief=cold.belief, mode=mode, window=window, cold=cold, since=0, colour=cold.colour)

    def _with(self, track: Track, prediction: Prediction, seen: Innovation) -> tuple[PoseFix, ...]:
        """The poses that a fit may look back on, with this one."""
        oldest = bisect_left(track.fixes, prediction.belief.t_ns - self._memory_ns, key=_instant)
        return (*track.fixes[oldest:], self._fix(prediction, seen))

    def _fix(self, prediction: Prediction, seen: Innovation) -> PoseFix:
        """The healthy pose, at the instant it was seen: a scan carried by the prior is carried back by it."""
        x, lag_ns = prediction.belief.x, round(prediction.lag_s * 1e9)
        pose = measured_pose(x, seen.alpha)
        C = in_fixture(self.noise.base(seen.R, prediction.window), pose.q, x.q_bc)
        if prediction.blur is not None:
            C = C + prediction.blur
        if lag_ns:
            then, _ = moved(x, lag_ns * 1e-9)
            pose = then.T_ac @ x.T_ac.inverse() @ pose
        return PoseFix(prediction.belief.t_ns + lag_ns, pose, C, lag_ns, seen.share)
