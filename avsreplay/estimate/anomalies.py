"""What the estimator does with a large innovation: it defers the scan, decides over the next ones, and acts.

A scan whose NIS is above the 99.99 % point, scaled by the median NIS of the accepted scans, or whose pose jumps, is
doubtful. It does not change the estimate. After
three to five doubtful scans ``hypotheses`` decides. Free motion: the scans are used after all. Manoeuvre: rate and
velocity are fitted anew from its instant on, with inertia, axes and centre of mass kept. Sensor bias: the estimate
coasts while the offset lasts. Before the estimate has converged, the poses before a jump may as well be the biased
ones: it is then initialised anew from the later poses, if these agree with one another.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from avsreplay.estimate.batch import FitParams, Prior, Problem, fit
from avsreplay.estimate.batch_covariance import LATEST, BatchCovariance, final_mixture, moments
from avsreplay.estimate.batch_schedule import FEWEST_TO_FIT, BatchSchedule
from avsreplay.estimate.chart import to_chart, to_errors
from avsreplay.estimate.dynamics import propagate
from avsreplay.estimate.error_state import VEL, W
from avsreplay.estimate.hypotheses import ChangePriors, Explanation, Hypothesis, cholesky_root, explain
from avsreplay.estimate.initialise import BatchResult, PoseFix, poses_of, rough_state, weak_prior
from avsreplay.estimate.noise import GATE
from avsreplay.estimate.params import EstimatorParams, Start
from avsreplay.estimate.track import Epoch, Prediction, SensorBias, Track
from avsreplay.geometry import Array
from avsreplay.records import Belief, Innovation, Manoeuvre, Reason, Verdict

_FEWEST, _MOST, _RECENT = 3, 5, 3  # least and most doubtful scans at a decision; accepted scans kept
_MARGIN = 6.0  # a decision before _MOST scans needs these log odds of the best hypothesis over the next
_FEWEST_NIS, _MOST_NIS, _MEDIAN_CHI2 = 5, 61, 5.348  # NIS values for the scale; median of chi-square with 6 degrees
_READY = 8  # least number of poses of an estimate whose prediction can be tested
_EXPLAINED = 2.5  # chi-square per degree of freedom up to which a hypothesis explains the scans
_LEAST = 1e-9  # of the eigenvalues of the prior after a manoeuvre
_TESTED = (Reason.OK, Reason.POSE_JUMP)

Update = Callable[[Track, Prediction, Innovation, int, bool], Track]


class AnomalyTest:
    """Wraps the filter's update by the test of hypotheses.

    Args:
        params: settings, auto values filled in.
        extent_m: the target's bounding diagonal [m].
        batch: converts healthy scans to the poses of a fit.
        replay: predicts, forms the innovation of a stored scan and updates with it.
    """

    def __init__(
        self, params: EstimatorParams, extent_m: float, batch: BatchSchedule, replay: Callable[[Track, Epoch], Track]
    ) -> None:
        self.params, self.batch, self._replay = params, batch, replay
        self.enabled = params.robust and params.start is not Start.PAPER
        speed = 0.2 * params.length("start_vel_1s_mps")
        self._priors = ChangePriors(0.1 * params.start_rate_1s_radps, speed, 0.05 * extent_m, 0.05)

    def step(
        self, track: Track, epoch: Epoch, verdict: Verdict, update: Callable[[Track], Track]
    ) -> tuple[Track, Verdict]:
        """The track after a measured scan, and the verdict on it. ``update`` applies the scan to a track."""
        nis = epoch.innovation.nis
        suspicious = verdict.reason is Reason.POSE_JUMP or (verdict.gamma == 1 and nis > GATE * _nis_scale(track))
        if not self.enabled or verdict.reason not in _TESTED or not _ready(track):
            return (self._accepted(track, epoch, update) if verdict.gamma else update(track)), verdict
        if not suspicious:
            return self._accepted(track, epoch, update), verdict
        if track.bias is not None and self._still_biased(track.bias, epoch.innovation):
            return replace(track, belief=epoch.prediction.belief), Verdict(0, Reason.SENSOR_BIAS)
        track = replace(track, belief=epoch.prediction.belief, doubtful=(*track.doubtful, epoch), bias=None)
        if len(track.doubtful) < (_FEWEST if track.recent else _MOST):
            return track, Verdict(0, Reason.DOUBTFUL)
        return self._decided(track) if track.recent else self._by_agreement(track)

    def _accepted(self, track: Track, epoch: Epoch, update: Callable[[Track], Track]) -> Track:
        """A scan that agrees with the prediction: the doubtful scans before it were bad."""
        after = update(replace(track, doubtful=(), bias=None))
        return _with_nis(replace(after, recent=(*track.recent, epoch)[-_RECENT:]), track, epoch.innovation.nis)

    def _decided(self, track: Track) -> tuple[Track, Verdict]:
        """The track after a decision, or still in doubt."""
        window, first = (*track.recent, *track.doubtful), len(track.recent)
        ranked = explain(window, first, self._priors, *self.batch.noise_levels(track))
        best, margin = ranked[0], ranked[0].log_evidence - ranked[1].log_evidence
        last_chance = len(track.doubtful) >= _MOST
        explained = best.chi2 < _EXPLAINED * best.dof
        if not last_chance and (margin < _MARGIN or not explained):
            return track, Verdict(0, Reason.DOUBTFUL)
        established = track.doubtful[0].converged or (track.batch is not None and track.batch.gaussian)
        if best.hypothesis is Hypothesis.FREE_MOTION:
            return self._replayed(track), Verdict(1, Reason.OK)
        if best.hypothesis is Hypothesis.MANOEUVRE and explained:
            if _after(window, best) >= FEWEST_TO_FIT:
                return self._manoeuvred(track, window, best), Verdict(1, Reason.OK)
            if len(track.doubtful) < 2 * _MOST:  # the motion after it is not determined yet
                return track, Verdict(0, Reason.DOUBTFUL)
        if best.hypothesis is Hypothesis.SENSOR_BIAS and explained and established:
            return replace(track, doubtful=(), bias=SensorBias(best.size, best.P)), Verdict(0, Reason.SENSOR_BIAS)
        if best.hypothesis is not Hypothesis.FROZEN or not explained:
            return self._by_agreement(track)
        return replace(track, doubtful=()), Verdict(0, Reason.POSE_JUMP)

    def _by_agreement(self, track: Track) -> tuple[Track, Verdict]:
        """The track initialised anew from the doubtful poses if they agree with one another; else they are bad."""
        anew = self._initialised_anew(track)
        if anew is not None:
            return anew, Verdict(1, Reason.OK)
        return replace(track, doubtful=()), Verdict(0, Reason.POSE_JUMP)

    def _still_biased(self, bias: SensorBias, innovation: Innovation) -> bool:
        """Return whether the offset explains this innovation, by the covariances of both."""
        left = innovation.alpha - bias.offset
        return float(left @ np.linalg.solve(innovation.S + bias.P, left)) < GATE

    def _replayed(self, track: Track) -> Track:
        """All doubtful scans used after all, with their Cauchy weights."""
        epochs = track.doubtful
        out = replace(epochs[0].track, recent=track.recent, manoeuvres=track.manoeuvres, drift=track.drift)
        for epoch in epochs:
            out = self._replay(out, epoch)
        return replace(out, recent=(*track.recent, *epochs)[-_RECENT:], doubtful=())

    def _manoeuvred(self, track: Track, window: tuple[Epoch, ...], best: Explanation) -> Track:
        """Rate and velocity fitted anew from the manoeuvre on; everything else is continuous."""
        at = window[0].track.belief
        start_ns, t_ns = at.t_ns, _last_change_ns(window, best)
        for after_s in best.changes_s:
            then_ns = start_ns + round(after_s * 1e9)
            at, _ = propagate(at, then_ns, *self.batch.noise_levels(track))
            P = at.P.copy()
            P[W, W] += self._priors.rate_radps**2 * np.eye(3)
            P[VEL, VEL] += self._priors.velocity_mps**2 * np.eye(3)
            at = replace(at, P=P)
        chart = to_chart(at.x)
        prior = Prior(
            chart, _definite(np.asarray(np.linalg.solve(to_errors(chart), cholesky_root(at.P)), dtype=np.float64))
        )
        after = tuple(e for e in window if e.prediction.belief.t_ns > t_ns)
        fixes = tuple(self.batch.fix(e.prediction, e.innovation) for e in after)
        result = self._fitted(track, fixes, prior, t_ns)
        now_ns = window[-1].prediction.belief.t_ns
        middle_ns = start_ns + round(best.after_s * 1e9)
        found = Manoeuvre(middle_ns, best.after_1s_s, best.size[3:], best.size[:3], best.P, now_ns)
        return replace(
            track,
            belief=result.belief,
            mode="filter" if track.mode == "filter" else "fit",
            fixes=fixes,
            batch=result,
            since=0,
            prior=prior,
            prior_ns=t_ns,
            recent=(),
            doubtful=(),
            manoeuvres=(*track.manoeuvres, found),
        )

    def _fitted(self, track: Track, fixes: tuple[PoseFix, ...], prior: Prior, t_ns: int) -> BatchResult:
        """Fit of the poses after a manoeuvre with the prior at its instant."""
        poses = poses_of(fixes, t_ns)
        inflation = np.ones(2) if track.inflation is None else track.inflation
        window = track.window.factors
        factors = np.array([window[3], window[0]]) * np.sqrt(inflation)
        rules = FitParams(rescale=False)
        fitted = fit(poses, prior.mean, prior, rules, factors)
        now_ns, noise = fixes[-1].scan_ns, self.batch.noise_levels(track)
        found = BatchCovariance(fitted, ())
        after_s = (now_ns - t_ns) * 1e-9
        problem, latest = Problem(poses, prior, fitted.effective), poses.latest(LATEST, after_s)
        components = final_mixture(found, problem, latest, noise, now_ns, after_s)
        plain = np.array([window[3], window[0]])
        return BatchResult(t_ns, fitted.chart, len(fixes), plain, inflation, moments(components), True, components)

    def _initialised_anew(self, track: Track) -> Track | None:
        """A new track from the doubtful poses alone, all or the last of them, that agree through free motion."""
        for first in range(max(1, len(track.doubtful) - _FEWEST)):
            anew = self._from_poses(track, track.doubtful[first:])
            if anew is not None:
                return anew
        return None

    def _from_poses(self, track: Track, epochs: tuple[Epoch, ...]) -> Track | None:
        """A new track from some poses; None where they contradict one another."""
        fixes = tuple(self.batch.fix(e.prediction, e.innovation) for e in epochs)
        poses = poses_of(fixes)
        fitted = fit(poses, to_chart(rough_state(fixes)), weak_prior(poses, self.params), FitParams(rescale=False))
        if 2.0 * fitted.half_chi2 > _EXPLAINED * (6 * len(fixes) - 12):
            return None
        first = epochs[0].prediction.belief
        out = Track(Belief(first.t_ns, first.x, first.P), "start", manoeuvres=track.manoeuvres, drift=track.drift)
        for epoch in epochs:
            out = self._replay(out, epoch)
        return replace(out, reinitialised=track.reinitialised + 1, sigma_hits=track.sigma_hits, r_floors=track.r_floors)


def _definite(root: Array) -> Array:
    """Root root', with eigenvalues, in units of the variances, raised to ``_LEAST``: its inverse is then definite."""
    scale = np.linalg.norm(root, axis=1)
    values, axes = np.linalg.eigh((root / scale[:, None]) @ (root / scale[:, None]).T)
    half = axes * np.sqrt(np.maximum(values, _LEAST)) * scale[:, None]
    return np.asarray(half @ half.T)


def _after(window: tuple[Epoch, ...], found: Explanation) -> int:
    """Number of scans of the window after a manoeuvre."""
    t_ns = _last_change_ns(window, found)
    return sum(e.prediction.belief.t_ns > t_ns for e in window)


def _last_change_ns(window: tuple[Epoch, ...], found: Explanation) -> int:
    """Instant at which a manoeuvre ends [ns]."""
    return window[0].track.belief.t_ns + round(found.changes_s[-1] * 1e9)


def _nis_scale(track: Track) -> float:
    """How many times larger than chi-square the NIS of the accepted scans is: their median over that of chi-square.

    Registration errors beyond the claimed covariance enlarge the NIS of all scans, so that of a doubtful scan must be
    large compared with that of the accepted scans. The median is taken over many scans: errors of the registration last
    for the whole log, while a sensor error that grows over some tens of scans must not raise the gate that detects it.
    """
    if len(track.nis) < _FEWEST_NIS:
        return 1.0
    return max(1.0, float(np.median(track.nis)) / _MEDIAN_CHI2)


def _with_nis(after: Track, before: Track, nis: float) -> Track:
    return replace(after, nis=(*before.nis, nis)[-_MOST_NIS:])


def _ready(track: Track) -> bool:
    """Return whether the estimate is based on enough poses for its prediction to be tested.

    After a manoeuvre the prior keeps all but the velocities, so that few poses determine the motion.
    """
    least = FEWEST_TO_FIT if track.manoeuvres else _READY
    return track.mode == "filter" or (track.mode == "fit" and track.batch is not None and track.batch.count >= least)
