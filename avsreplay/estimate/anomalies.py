"""Treatment of large innovations: the scan is deferred, and a decision is made from the scans that
follow.

A scan whose NIS is above the 99.99 % point, scaled by the median NIS of the accepted scans, or
whose pose jumps, is doubtful. It does not change the estimate. After three to five doubtful scans
``hypotheses`` decides. Free motion: the scans are used after all. Manoeuvre: rate and velocity are
fitted anew from its instant on, with inertia, axes and centre of mass kept. Sensor bias: the
estimate coasts while the offset lasts. Before the estimate has converged, the poses before a jump
may be the biased ones: it is then initialised again from the later poses, if these agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from avsreplay.estimate.batch import FitParams, Prior, Problem, fit
from avsreplay.estimate.batch_covariance import LATEST, SPHERE, BatchCovariance, final_mixture
from avsreplay.estimate.batch_schedule import FEWEST_TO_FIT, MOST_FIXES, BatchSchedule
from avsreplay.estimate.chart import to_chart, to_errors
from avsreplay.estimate.driven import DrivenBelief
from avsreplay.estimate.error_state import VARRHO, VEL, W, definite_product, rotation
from avsreplay.estimate.hypotheses import OVER_FREE, Ranked, certain, explain, linear
from avsreplay.estimate.initialise import BatchResult, PoseFix, poses_of, rough_state, weak_prior
from avsreplay.estimate.measurement import (
    GATE,
    gate_of,
    innovation_vector,
    measured_pose,
    measurement_jacobian,
)
from avsreplay.estimate.mixture import moments
from avsreplay.estimate.noise import lasting, risen
from avsreplay.estimate.noise_levels import NO_LEVELS, NoiseLevels
from avsreplay.estimate.params import EstimatorParams, Start
from avsreplay.estimate.pose_differences import MOST_DISTURBED, disturbance_levels
from avsreplay.estimate.pose_noise import cholesky_root
from avsreplay.estimate.scan_points import latest
from avsreplay.estimate.scan_window import (
    EXPLAINED,
    ChangePriors,
    Explanation,
    Hypothesis,
    Window,
    last_change_ns,
    long_run,
    odds_over_free,
    possible_change,
    scans_after,
    window_of,
)
from avsreplay.estimate.sensor_bias import begun, compared, continued, squared
from avsreplay.estimate.track import (
    Epoch,
    SensorBias,
    Track,
    confirmed,
    nis_scale,
    ready,
    with_history,
    with_nis,
)
from avsreplay.geometry import skew
from avsreplay.records import Admission, Belief, Finding, Manoeuvre

# least and most doubtful scans at a decision
_FEWEST_DOUBTFUL = 3
_MOST_DOUBTFUL = 5
# step of the log rms residual, over its spread, that shows which poses are biased
_RMS_STEP = 4.0
_LEAST_SPREAD = 0.02
# of the variance of the poses, over the level that the NIS of the accepted ones show
_LEAST_RISE_OF_NOISE = 2.0
_KEPT_S = 60.0  # time for which the estimate before a new start is kept
_STEPS = (Hypothesis.MANOEUVRE, Hypothesis.SENSOR_BIAS)
_DISTURBANCES = (Hypothesis.DISTURBED, Hypothesis.ACCELERATED)
_USED = (*_DISTURBANCES, Hypothesis.NOISIER)

Replay = Callable[[Track, Epoch], tuple[Track, Epoch]]


class AnomalyTest:
    """Wraps the filter's update by the test of hypotheses.

    Args:
        params: settings, auto values filled in.
        extent_m: the target's bounding diagonal [m].
        batch: converts healthy scans to the poses of a fit.
        replay: predicts, forms the innovation of a stored scan and updates with it; returns the
            scan as it was used.
    """

    def __init__(
        self, params: EstimatorParams, extent_m: float, batch: BatchSchedule, replay: Replay
    ) -> None:
        self.params, self.batch, self._replay = params, batch, replay
        self.enabled = params.robust and params.start is not Start.PAPER
        self._extent_m = extent_m
        self._priors = ChangePriors.of(params, extent_m)

    def step(
        self,
        track: Track,
        epoch: Epoch,
        admission: Admission,
        update: Callable[[Track], Track],
    ) -> tuple[Track, Finding]:
        """The track after a measured scan, and what was found of its pose.

        ``update`` applies an admitted scan to a track; a rejected one only predicts.
        """
        if not self.enabled or admission is Admission.REFUSED:
            if admission is Admission.ADMITTED:
                return self._accepted(track, epoch, update), Finding.AGREES
            return update(track), Finding.UNTESTED
        if track.bias is not None:
            bias = continued(
                track.bias, epoch, lambda *scans: self._windowed(track, *scans), self._priors
            )
            if bias is not None:
                return self._still_biased(track.changed(belief=epoch.prediction.belief), bias)
            track = track.changed(bias=None)
        large = admission is Admission.LARGE or (
            ready(track) and epoch.innovation.chi2 > GATE * nis_scale(track)
        )
        doubtful = track.changed(belief=epoch.prediction.belief, doubtful=(*track.doubtful, epoch))
        comparable = ready(track) and bool(track.recent)
        if large and not comparable:
            return self._undecidable(doubtful)
        if comparable and (large or self._suspected(track, epoch)):
            window, first = (*track.recent, *doubtful.doubtful), len(track.recent)
            window, ranked = self._explained(track, window, first)
            if large or self._contradicted(track, window, ranked):
                return self._decided(doubtful, window, ranked)
        return self._accepted(track, epoch, update), Finding.AGREES

    def _suspected(self, track: Track, epoch: Epoch) -> bool:
        """Whether a scan is tested though its own innovation is not large."""
        return bool(track.doubtful) or long_run((*track.recent, epoch), nis_scale(track))

    def _contradicted(
        self, track: Track, window: tuple[Epoch, ...], ranked: list[Explanation]
    ) -> bool:
        """Whether the last scans together show that free motion is not their explanation, though
        the innovation of the last one is not large.
        """
        best = ranked[0].hypothesis
        if track.doubtful and (
            best is Hypothesis.SENSOR_BIAS or (best is Hypothesis.NOISIER and certain(ranked))
        ):
            return True
        if best not in _STEPS or odds_over_free(ranked) < OVER_FREE:
            return False
        free = next(e for e in ranked if e.hypothesis is Hypothesis.FREE_MOTION)
        return bool(track.doubtful) or linear(free.chi2, free.dof, window)

    def with_possible_change(self, track: Track) -> Track:
        """The track with the possible change of the velocities within its accepted scans."""
        recent = track.recent if self.enabled and ready(track) else ()
        probability, P = possible_change(
            recent, nis_scale(track), self._priors, self.params.change_probability
        )
        return track.changed(change_probability=probability, change_P=P)

    def _accepted(self, track: Track, epoch: Epoch, update: Callable[[Track], Track]) -> Track:
        """A scan that agrees with the prediction: the doubtful scans before it were bad.

        The hypotheses are linear about the prediction from the first recent scan. This one must be
        from an estimate that is based on enough poses: before, its errors are too large for the
        linearisation.
        """
        after = update(
            track.changed(doubtful=(), rejected=(), manoeuvres=confirmed(track), pending=False)
        )
        after = with_nis(after, track, epoch.innovation.chi2)
        after = after.changed(window=lasting(after.window, epoch.innovation))
        return after.changed(recent=latest((*track.recent, epoch))) if ready(track) else after

    def _explained(self, track: Track, window: tuple[Epoch, ...], first: int) -> Ranked:
        allowed = *self.batch.noise_levels(track), self.batch.orbit, track.levels.excluded
        used, ranked = explain(window, first, self._priors, *allowed)
        least = math.sqrt(
            _LEAST_RISE_OF_NOISE * nis_scale(track)
        )  # noise that the accepted poses have as well is no rise
        return used, [
            e for e in ranked if e.hypothesis is not Hypothesis.NOISIER or e.size.max() > least
        ]

    def _windowed(self, track: Track, scans: tuple[Epoch, ...], accepted: int) -> Window:
        start, orbit = scans[0].track.belief, self.batch.orbit
        arc = None if orbit is None else orbit.at(start.t_ns)
        return window_of(scans, accepted, start, *self.batch.noise_levels(track), arc)

    def _still_biased(self, track: Track, bias: SensorBias) -> tuple[Track, Finding]:
        """The track after one more scan of a sensor error, unless its scans have another cause."""
        bias, found = compared(bias, lambda window, first: self._explained(track, window, first))
        biased = track.changed(bias=bias), Finding.OFFSET
        if found is None:
            return biased
        (window, best), track = found, track.changed(bias=None)
        if best.hypothesis is Hypothesis.MANOEUVRE:
            if not best.changes or scans_after(window, best) < FEWEST_TO_FIT:
                return biased
            reported = self._reported(track, window, best)
            return self._manoeuvred(reported, window, best), Finding.EXPLAINED
        if best.hypothesis is not Hypothesis.FREE_MOTION:
            return biased
        return self._used(self._allowing(track, bias.since, best), bias.since), Finding.EXPLAINED

    def _undecidable(self, track: Track) -> tuple[Track, Finding]:
        """Too few scans were accepted for the hypotheses to be compared: the doubtful ones
        may agree by themselves.
        """
        if len(track.doubtful) < _FEWEST_DOUBTFUL:
            return track, Finding.OPEN
        if (resumed := self._resumed(track)) is not None:
            return resumed, Finding.EXPLAINED
        return self._by_agreement(track)

    def _decided(
        self, track: Track, window: tuple[Epoch, ...], ranked: list[Explanation]
    ) -> tuple[Track, Finding]:
        """The track after a decision, or still in doubt."""
        doubtful, in_doubt = len(track.doubtful), (track, Finding.OPEN)
        best, explained = ranked[0], ranked[0].explains
        if doubtful >= _FEWEST_DOUBTFUL and (resumed := self._resumed(track)) is not None:
            return resumed, Finding.EXPLAINED
        if doubtful < _MOST_DOUBTFUL and not certain(ranked):
            return in_doubt
        manoeuvre = best.hypothesis is Hypothesis.MANOEUVRE and explained
        if manoeuvre and (decided := self._pushed(track, window, best)) is not None:
            return decided
        if doubtful < _FEWEST_DOUBTFUL:
            return in_doubt
        free = best.hypothesis is Hypothesis.FREE_MOTION or (manoeuvre and not best.changes)
        if free or (best.hypothesis in _USED and explained):
            before = self._allowing(track, track.doubtful, best)
            return self._used(before, track.doubtful), Finding.EXPLAINED
        if best.hypothesis is Hypothesis.SENSOR_BIAS and explained and self.bias_began(track):
            return self._biased(track, window, best), Finding.OFFSET
        return self._by_agreement(track)

    def _pushed(
        self, track: Track, window: tuple[Epoch, ...], best: Explanation
    ) -> tuple[Track, Finding] | None:
        """The track after a manoeuvre, or in doubt while too few scans follow it; None where these
        do not come.
        """
        waits = len(track.doubtful) < 2 * _MOST_DOUBTFUL
        if not best.changes:
            return (track, Finding.OPEN) if waits else None
        reported = self._reported(track, window, best)
        if scans_after(window, best) >= FEWEST_TO_FIT:
            return self._manoeuvred(reported, window, best), Finding.EXPLAINED
        return (reported, Finding.OPEN) if waits else None

    def _allowing(self, track: Track, scans: tuple[Epoch, ...], found: Explanation) -> Track:
        """The track before scans that were not used, with the disturbances or the noise that
        explain them.
        """
        before = with_history(scans[0].track, track).changed(recent=track.recent)
        if found.hypothesis is Hypothesis.NOISIER:
            return before.changed(window=risen(before.window, found.size))
        return self._disturbed(before, found) if found.hypothesis in _DISTURBANCES else before

    def _disturbed(self, track: Track, found: Explanation) -> Track:
        """The track with levels of the disturbances that explain the scans, until they are
        estimated from all poses.
        """
        rate, velocity = float(found.size[0]), float(found.size[3])
        torque, force = self.batch.noise_levels(track)
        levels = replace(
            track.levels, torque=max(torque, rate / SPHERE), force=max(force, velocity)
        )
        return track.changed(levels=replace(levels, count=max(levels.count, 1)))

    def bias_began(self, track: Track) -> bool:
        """Return whether a step in the pose is the beginning of a sensor error; it may as well be
        the end of one.

        A range error deforms the scan, so the rms residual steps with it where the scan is
        registered. Otherwise the poses that have been consistent for longer than sensor errors
        usually last are taken as correct.

        Args:
            track: with the doubtful scans after the step, and the accepted ones before it.
        """
        before, after = (
            np.array([e.innovation.rms_m for e in epochs if e.innovation.rms_m > 0.0])
            for epochs in (track.recent, track.doubtful)
        )
        if min(len(before), len(after)) >= _FEWEST_DOUBTFUL:
            spread = max(_LEAST_SPREAD, float(np.std(np.log(before))), float(np.std(np.log(after))))
            step = float(np.log(np.median(after) / np.median(before)))
            if abs(step) > _RMS_STEP * spread:
                return step > 0.0
        seconds = (track.doubtful[0].prediction.belief.t_ns - track.started_ns) * 1e-9
        return seconds >= self.params.bias_s

    def _biased(self, track: Track, window: tuple[Epoch, ...], best: Explanation) -> Track:
        """The estimate of the poses before the sensor error, propagated to the present."""
        first, last = len(window) - len(track.doubtful), window[-1]
        bias = begun(window, best)
        if best.onset >= first:
            return with_history(track, track).changed(bias=bias)
        then = window[best.onset].track
        _, again = self._replay(then, last)  # the innovation about the motion that goes on
        return with_history(then, track).changed(
            belief=again.prediction.belief,
            recent=window[: best.onset],
            bias=replace(bias, last=again),
        )

    def _by_agreement(self, track: Track) -> tuple[Track, Finding]:
        """The track initialised anew from the doubtful poses if they agree with one another;
        else they are bad.
        """
        track = self._with_rejected(track)
        levels = self._disturbances(track)
        anew = self._initialised_anew(track, levels)
        if anew is None and levels.count:
            anew = self._started(track, track.doubtful[-_FEWEST_DOUBTFUL:], levels)
        if anew is not None:
            return anew.changed(reinitialised=track.reinitialised + 1), Finding.EXPLAINED
        left = with_history(track, track).changed(doubtful=track.doubtful[1 - _FEWEST_DOUBTFUL :])
        return left, Finding.UNEXPLAINED

    def _with_rejected(self, track: Track) -> Track:
        """The track with the doubtful poses in its list of rejected ones."""
        last_ns = track.rejected[-1].scan_ns if track.rejected else -1
        later = (e for e in track.doubtful if e.prediction.belief.t_ns > last_ns)
        fixes = (self.batch.fix(e.prediction, e.innovation) for e in later)
        return track.changed(rejected=(*track.rejected, *fixes)[-MOST_DISTURBED:])

    def _disturbances(self, track: Track) -> NoiseLevels:
        """Levels of disturbances that the last poses show, such as those of a part on a cable, used
        or not.
        """
        for poses in ((*track.fixes, *track.rejected)[-MOST_DISTURBED:], track.rejected):
            found = disturbance_levels(poses, self._extent_m)
            if found is not None:
                return NoiseLevels(torque=found[0], force=found[1], count=1)
        return NO_LEVELS

    def _resumed(self, track: Track) -> Track | None:
        """The estimate before the last manoeuvre or new start, continued with the doubtful poses,
        if it predicted them to within its errors and the present one did not: what caused the
        change was an error of the sensor. None where it did not predict them.
        """
        old = track.previous
        if (
            old is None
            or (track.doubtful[-1].prediction.belief.t_ns - old.belief.t_ns) * 1e-9 > _KEPT_S
        ):
            return None
        for epoch in track.doubtful:
            prior, seen = epoch.prediction.belief, epoch.innovation
            belief, _ = self.batch.propagated(old, old.belief, prior.t_ns)
            H = measurement_jacobian(belief.x)
            S = H @ belief.P @ H.T + seen.R
            alpha = innovation_vector(belief.x, measured_pose(prior.x, seen.alpha))
            limit = gate_of(seen.dof, seen.R, S)
            if squared(alpha, S) > limit or squared(seen.alpha, S) < limit:
                return None
        found = tuple(m for m in track.manoeuvres if m.t_ns <= old.belief.t_ns)
        used = self._used(with_history(old, track), track.doubtful)
        return used.changed(manoeuvres=found, previous=None, reinitialised=track.reinitialised + 1)

    def _used(self, track: Track, epochs: tuple[Epoch, ...]) -> Track:
        """The track with scans that were in doubt."""
        out, used = track, []
        for epoch in epochs:
            out, again = self._replay(out, epoch)
            used.append(again)
        return out.changed(recent=latest((*track.recent, *used)))

    def _reported(self, track: Track, window: tuple[Epoch, ...], best: Explanation) -> Track:
        """The track with the manoeuvre in its list; a later report of the same one replaces
        the first.
        """
        at_ns = window[0].track.belief.t_ns + round(best.after_s * 1e9)
        now_ns = (
            track.manoeuvres[-1].detected_ns if track.pending else window[-1].prediction.belief.t_ns
        )
        (then, _), P = self.batch.propagated(track, window[0].track.belief, at_ns), best.P.copy()
        turn = rotation(then.x.q_ab) @ skew(
            best.size[:3]
        )  # the linear effect of the rate has the mean of varrho
        P[3:, 3:] += turn @ then.P[VARRHO, VARRHO] @ turn.T
        found = Manoeuvre(at_ns, best.after_1s_s, best.size[3:], best.size[:3], P, now_ns)
        return track.changed(manoeuvres=(*confirmed(track), found), pending=True)

    def _manoeuvred(self, track: Track, window: tuple[Epoch, ...], best: Explanation) -> Track:
        """Rate and velocity fitted anew from the manoeuvre on; everything else is continuous."""
        start_ns, t_ns = window[0].track.belief.t_ns, last_change_ns(window, best)
        at = window[best.onset].track.belief  # belief from all scans before the first change
        for after_s in best.changes_s:
            then_ns = start_ns + round(after_s * 1e9)
            at, _ = self.batch.propagated(track, at, then_ns)
            P = at.P.copy()
            P[W, W] += self._priors.rate_radps**2 * np.eye(3)
            P[VEL, VEL] += self._priors.velocity_mps**2 * np.eye(3)
            at = replace(at, P=P)
        after = tuple(e for e in window if e.prediction.belief.t_ns > t_ns)
        anew = track.changed(
            since=0,
            recent=(),
            doubtful=(),
            pending=False,
            previous=_kept(window[best.onset].track),
        )
        if isinstance(at, DrivenBelief):  # the filter continues, with rate and velocity free
            return self._used(anew.changed(belief=at, mode="filter", fixes=(), older=()), after)
        chart = to_chart(at.x)
        prior = Prior(
            chart,
            definite_product(
                np.asarray(np.linalg.solve(to_errors(chart), cholesky_root(at.P)), dtype=np.float64)
            ),
        )
        fixes = tuple(self.batch.fix(e.prediction, e.innovation) for e in after)
        result = self._fitted(track, fixes, prior, t_ns)
        mode = "filter" if track.mode == "filter" else "fit"
        poses = *track.older, *track.fixes  # a short memory leaves out poses after the change too
        older = tuple(f for f in poses if f.t_ns <= t_ns)[-MOST_FIXES:]
        anew = anew.changed(fixes=fixes, older=older, prior=prior, prior_ns=t_ns)
        return anew.changed(belief=result.belief, mode=mode, batch=result)

    def _fitted(
        self, track: Track, fixes: tuple[PoseFix, ...], prior: Prior, t_ns: int
    ) -> BatchResult:
        """Fit of the poses after a manoeuvre with the prior at its instant."""
        poses = poses_of(fixes, t_ns)
        inflation = np.ones(2) if track.inflation is None else track.inflation
        plain = track.window.blocks
        factors = plain * np.sqrt(inflation)
        fitted = fit(poses, prior.mean, prior, FitParams(rescale=False), factors)
        now_ns, noise = fixes[-1].scan_ns, self.batch.noise_levels(track)
        found = BatchCovariance(fitted, ())
        after_s = (now_ns - t_ns) * 1e-9
        problem, latest = Problem(poses, prior, fitted.effective), poses.latest(LATEST, after_s)
        components = final_mixture(found, problem, latest, noise, now_ns, after_s)
        return BatchResult(
            t_ns, fitted.chart, len(fixes), plain, inflation, moments(components), True, components
        )

    def _initialised_anew(self, track: Track, levels: NoiseLevels) -> Track | None:
        """A new track from the doubtful poses alone, all or the last of them, that agree through
        free motion.
        """
        for first in range(len(track.doubtful) + 1 - _FEWEST_DOUBTFUL):
            anew = self._from_poses(track, track.doubtful[first:], levels)
            if anew is not None:
                return anew
        return None

    def _from_poses(
        self, track: Track, epochs: tuple[Epoch, ...], levels: NoiseLevels
    ) -> Track | None:
        """A new track from some poses; None where they contradict one another."""
        fixes = tuple(self.batch.fix(e.prediction, e.innovation) for e in epochs)
        poses, start = poses_of(fixes), to_chart(rough_state(fixes))
        fitted = fit(poses, start, weak_prior(poses, self.params), FitParams(rescale=False))
        agree = 2.0 * fitted.half_chi2 <= EXPLAINED * (6 * len(fixes) - 12)
        return self._started(track, epochs, levels) if agree else None

    def _started(self, track: Track, epochs: tuple[Epoch, ...], levels: NoiseLevels) -> Track:
        """A new track from some poses and noise levels, with the events of ``track``."""
        prior = epochs[0].prediction.belief
        begin = Belief(prior.t_ns, prior.x, prior.P)
        out = self._used(Track(begin, "start", started_ns=prior.t_ns, levels=levels), epochs)
        out = with_history(out, track).changed(drift=track.drift, previous=_kept(track))
        return out.changed(sigma_hits=track.sigma_hits, r_floors=track.r_floors)


def _kept(track: Track) -> Track | None:
    """An estimate as it is kept while another one is tried; None before it is of use."""
    return track.changed(recent=(), doubtful=(), previous=None, bias=None) if ready(track) else None
