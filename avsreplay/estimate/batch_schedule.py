"""When the batch fit runs: it provides the estimate at the start, and replaces a filter that it
contradicts.

The innovations of single steps cannot show every error. One or two biased scans that passed the
fault rule move the parameters of a converged filter by many of its own sigma, and the next
innovations look normal. A fit to the last poses gives such scans a low weight and does not share
the error. Where the two differ by more than the covariance of the fit allows, the fit replaces the
filter's estimate.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace
from operator import attrgetter

import numpy as np

from avsreplay.aliasing import COMPARED_POSES, is_shown
from avsreplay.estimate import _motion
from avsreplay.estimate.batch import FitParams, Prior
from avsreplay.estimate.batch_covariance import SPHERE, memory_s, propagate_chart
from avsreplay.estimate.chart import Chart, to_chart
from avsreplay.estimate.driven import DrivenBelief, propagated
from avsreplay.estimate.dynamics import propagate_state
from avsreplay.estimate.error_state import SIGMA
from avsreplay.estimate.initialise import (
    BatchResult,
    PoseFix,
    batch_estimate,
    first_belief,
    joined,
)
from avsreplay.estimate.measurement import (
    chart_update,
    constrained_update,
    in_fixture,
    measured_pose,
    measurement_jacobian,
)
from avsreplay.estimate.mixture import carried, contradicted, moments, not_worse, without_pose, worn
from avsreplay.estimate.noise import NO_INFLATION, Noise, filled
from avsreplay.estimate.noise_levels import NoiseLevels
from avsreplay.estimate.params import EstimatorParams, Start
from avsreplay.estimate.pose_noise import scaled
from avsreplay.estimate.relative_orbit import RelativeOrbit
from avsreplay.estimate.track import Prediction, Track
from avsreplay.geometry import Array
from avsreplay.records import Belief, Innovation

FEWEST_TO_FIT = 3
MOST_FIXES = 1024  # poses that a fit uses one by one; the work of a fit does not grow with the log
FEWEST_TO_CHECK = 50
CHECK_GROWTH = 0.25
FEWEST_WITH_OUTLIERS = 10
_DRIFT_S = 30.0  # time over which the process noise changes the velocity as much as the drift
# largest age of a given start over the fit's memory; until then disturbances change it little
_RECENT = 0.1
_GAUSSIAN_HALF_RAD = 0.2  # a given attitude with a larger 1 sigma (half angle) is not Gaussian
# a fit looks back as far as this torque noise allows, even without disturbances [rad/s^1.5]
_LEAST_TORQUE = 1e-6
_LONGEST_MEMORY_S = 1e9  # longest memory, which is converted to 64-bit nanoseconds
_GAP = 2  # intervals between poses after which a mixture is propagated by its components
_instant = attrgetter("t_ns")


class BatchSchedule:
    """Runs batch fits to the healthy poses so far.

    Args:
        params: settings, auto values filled in.
        noise: the measurement noise model.
        start: the given belief, None where there is none. It is left out once the poses contradict
            it.
        orbit: the relative orbit of the target; None for free motion.
    """

    def __init__(
        self,
        params: EstimatorParams,
        noise: Noise,
        start: Belief | None,
        orbit: RelativeOrbit | None = None,
    ) -> None:
        self.params, self.noise, self.start, self.orbit = params, noise, start, orbit
        self.checked_poses = 0 if params.start is Start.PAPER else params.audit_poses
        self._rules = FitParams(rescale=False)
        self._given_levels = params.disturbances

    def initialised(
        self,
        track: Track,
        prediction: Prediction,
        innovation: Innovation,
        converged: bool,
    ) -> Track:
        """The track after a healthy pose while the fit is in use: a new fit if enough poses have
        come since the last.

        Between fits the filter's update is applied if the likelihood is Gaussian; otherwise every
        component of the mixture is updated by itself.
        """
        fixes, older = self._with(track, prediction, innovation)
        track = track.changed(fixes=fixes, older=older, R=innovation.R, since=track.since + 1)
        if len(track.fixes) < FEWEST_TO_FIT:
            return track.changed(belief=self._first(track, prediction, innovation))
        last = track.batch
        if last is None or self._due(track, last):
            forgot = last is not None and last.epoch_ns != track.fixes[0].t_ns
            return self._fitted(track, prediction.belief, forgot, converged)
        if last.gaussian:
            belief = chart_update(prediction.belief, prediction.H, innovation, last.inflation)
            return track.changed(belief=belief)
        fix, factors, noise = (
            track.fixes[-1],
            last.factors * np.sqrt(last.inflation),
            self.noise_levels(track),
        )
        root = _motion.roots(fix.C[None])[0]
        mixture = carried(
            last.components, fix.t_ns, fix.T_ac, root, factors, innovation.weight, noise, self.orbit
        )
        C = scaled(fix.C, factors)  # components may lie further apart
        mixture = not_worse(mixture, fix.t_ns, fix.T_ac, C, innovation.weight, noise, self.orbit)
        belief, t_ns = moments(mixture), prediction.belief.t_ns
        belief = belief if belief.t_ns == t_ns else self.propagated(track, belief, t_ns)[0]
        return track.changed(belief=belief, batch=replace(last, components=mixture))

    def _fitted(self, track: Track, belief: Belief, forgot: bool, converged: bool) -> Track:
        """The track with a fit to all its poses. ``forgot``: the last fit began with an earlier
        pose.
        """
        start = self.chart_at(belief, track.fixes[0].t_ns) if forgot else None
        levels, given, last = self._levels(track), self._given(track), track.batch
        result = batch_estimate(track.fixes, self.params, self._rules, levels, last, start, given)
        result = with_last_pose(result, track.fixes[-1], self.noise_levels(track))
        rejected = result.prior_rejected and not (last is not None and last.prior_rejected)
        track = track.changed(reinitialised=track.reinitialised + rejected)
        remembers = (
            forgot and track.levels.slack > 1.0
        )  # the filter keeps information of poses left out of fits
        return self.adopted(track, result, result.gaussian and (converged or remembers))

    def _growth(self, last: BatchResult) -> float:
        """The share by which the poses grow until the next fit; a Gaussian likelihood is
        propagated well in between.
        """
        return CHECK_GROWTH if last.gaussian else self.params.refit_growth

    def _due(self, track: Track, last: BatchResult) -> bool:
        """Return whether the last fit no longer represents the likelihood: by the poses since
        then, or by its drift.
        """
        enough = track.since >= max(1.0, self._growth(last) * last.count)
        return enough or worn(last.components) or bent(last, track.belief)

    def filtered(self, track: Track, prediction: Prediction, innovation: Innovation) -> Track:
        """The filter's posterior after a healthy pose, its noise window and its memory of poses."""
        prior = prediction.belief
        dt_ns = prior.t_ns - track.belief.t_ns
        mean = 0.0 if track.batch is None else track.batch.share
        inflation = self.noise.inflation(
            track.inflation, mean, prior.x.w_b, dt_ns, innovation.share
        )
        if self.params.by_gain and track.batch is None:
            belief, hits = constrained_update(
                prior, prediction.H, innovation, self.params.sigma_margin, inflation
            )
        else:
            belief, hits = chart_update(prior, prediction.H, innovation, inflation), 0
        fixes, older = self._with(track, prediction, innovation) if self.checked_poses else ((), ())
        return track.changed(
            belief=belief,
            mode="filter",
            window=self.noise.updated(
                prediction.window, prior.x, prediction.H, innovation, belief, inflation
            ),
            sigma_hits=track.sigma_hits + hits,
            r_floors=track.r_floors + self.noise.floors(innovation.R),
            R=innovation.R,
            fixes=fixes[-self.checked_poses :],
            older=older,
            since=track.since + 1,
        )

    def checked(self, track: Track) -> Track:
        """The filter's track, or the fit's where a fit to the same poses contradicts it.

        A fit with a non-Gaussian likelihood replaces the filter only where the poses themselves
        contradict the filter. The noise window stays, since the noise of the last scans may differ
        from the level of all poses; with many outliers its residuals are errors of the estimate.

        Args:
            track: after the filter's update.
        """
        enough = max(FEWEST_TO_CHECK, CHECK_GROWTH * len(track.fixes))
        many_outliers = track.window.many_outliers
        due = FEWEST_WITH_OUTLIERS if many_outliers else enough
        if not self.checked_poses or track.drift is not None or track.since < due:
            return track
        epoch_ns, last = track.fixes[0].t_ns, track.batch
        given = None if last is not None and last.prior_rejected else self._given(track)
        last = last if last is not None and last.epoch_ns == epoch_ns else None
        begin, levels = self.chart_at(track.belief, epoch_ns), self._levels(track)
        result = batch_estimate(track.fixes, self.params, self._rules, levels, last, begin, given)
        linear = result.components[0].share == 1.0
        sound = result.gaussian and _better_than_measured(result.belief, track.R)
        if (sound or many_outliers) and contradicted(track.belief, result.belief):
            adopted = self.adopted(track, result, result.gaussian).changed(
                reinitialised=track.reinitialised + 1
            )
            return adopted if many_outliers else adopted.changed(window=track.window)
        if sound and last is not None and linear:
            return self.adopted(track, result, to_filter=True).changed(window=track.window)
        return track.changed(since=0)

    def resolved(self, track: Track) -> Track:
        """The track, begun anew from its last poses where it turns faster than they can show.

        A fit to poses with far larger errors than stated may diverge, and its motion cannot be
        predicted.
        """
        stamps = [fix.t_ns for fix in track.fixes[-COMPARED_POSES:]]
        if is_shown(float(np.linalg.norm(track.belief.x.w_b)), stamps):
            return track
        fixes = track.fixes[1 - FEWEST_TO_FIT :]
        return Track(
            first_belief(fixes, self.params),
            "start",
            R=track.R,
            fixes=fixes,
            started_ns=track.started_ns,
            reinitialised=track.reinitialised + 1,
            manoeuvres=track.manoeuvres,
            errors=track.errors,
        )

    def noise_levels(self, track: Track) -> tuple[float, float]:
        """Root densities of torque [rad/s^1.5] and force [m/s^1.5], given or estimated.

        Those of a drift apply if larger, where it is not part of the motion of the belief. White
        noise of root density q changes the rate by q sqrt(T) within T, a constant acceleration a by
        a T; the two are equal over ``_DRIFT_S``. The torque acts on the rate through B(sigma),
        which is 3 for a sphere.
        """
        driven = isinstance(track.belief, DrivenBelief)
        found, drift = [track.levels.torque, track.levels.force], None if driven else track.drift
        if track.levels.count == 0:  # not yet estimated
            found[0] = _LEAST_TORQUE
        sizes = (
            (0.0, 0.0)
            if drift is None
            else (float(np.linalg.norm(v)) for v in (drift.rate, drift.velocity))
        )
        for k, (fixed, size) in enumerate(zip(self._given_levels, sizes, strict=True)):
            found[k] = max(
                found[k] if fixed is None else fixed, size * np.sqrt(_DRIFT_S) / (SPHERE, 1.0)[k]
            )
        return found[0], found[1]

    def _levels(self, track: Track) -> NoiseLevels:
        torque, force = self.noise_levels(track)
        return replace(track.levels, torque=torque, force=force)

    def _memory_ns(self, track: Track) -> int:
        """How far back a fit looks [ns]."""
        torque, half = max(self.noise_levels(track)[0], _LEAST_TORQUE), np.trace(track.R[3:, 3:])
        return round(
            min(memory_s(torque, 2.0 * float(np.sqrt(half)) or 1.0), _LONGEST_MEMORY_S) * 1e9
        )

    def _first(self, track: Track, prediction: Prediction, innovation: Innovation) -> Belief:
        """The belief after the first poses, too few for a fit."""
        if self.start is None:
            return first_belief(track.fixes, self.params)
        return chart_update(prediction.belief, prediction.H, innovation, NO_INFLATION)

    def _given(self, track: Track) -> Prior | None:
        """The track's prior, propagated to the first pose; None where disturbances or time
        have made it useless.
        """
        t_ns = track.fixes[0].t_ns
        if track.prior is None or t_ns - track.prior_ns > _RECENT * self._memory_ns(track):
            return None
        arc = None if self.orbit is None else self.orbit.at(track.prior_ns)
        mean, step = propagate_chart(track.prior.mean, (t_ns - track.prior_ns) * 1e-9, arc)
        P = step @ track.prior.P @ step.T
        return Prior(mean, P) if float(np.sqrt(np.trace(P[:3, :3]))) < _GAUSSIAN_HALF_RAD else None

    def adopted(self, track: Track, result: BatchResult, to_filter: bool) -> Track:
        """The track with the estimate of a fit; ``to_filter``: the filter continues from it."""
        window = filled(self.noise.base(track.R, track.window), result.factors, self.params.window)
        window = replace(window, rise=track.window.rise)
        track = track.changed(mode="filter" if to_filter else "fit", window=window, since=0)
        return track.changed(belief=result.belief, batch=result, inflation=result.inflation)

    def _with(
        self, track: Track, prediction: Prediction, innovation: Innovation
    ) -> tuple[tuple[PoseFix, ...], tuple[PoseFix, ...]]:
        """Poses within the fit's memory, with this one, and older ones; of many the first
        half is joined in pairs.
        """
        oldest = bisect_left(
            track.fixes, prediction.belief.t_ns - self._memory_ns(track), key=_instant
        )
        refines = (
            track.drift is not None and track.mode == "filter"
        )  # the test for a drift needs all of them
        first = 0 if refines else oldest
        fixes, older = track.fixes[first:], (*track.older, *track.fixes[:first])[-MOST_FIXES:]
        if len(fixes) >= MOST_FIXES:
            half, factors = MOST_FIXES // 2, track.window.blocks
            fixes = (
                joined(fixes[:half], self.chart_at(prediction.belief, fixes[0].t_ns), factors)
                + fixes[half:]
            )
        return (*fixes, self.fix(prediction, innovation)), older

    def fix(self, prediction: Prediction, innovation: Innovation) -> PoseFix:
        """The healthy pose at its own instant: a scan deskewed by the prior's motion is moved
        back by it.
        """
        x, lag_ns = prediction.belief.x, round(prediction.lag_s * 1e9)
        pose = measured_pose(x, innovation.alpha)
        C = in_fixture(self.noise.base(innovation.R, prediction.window), pose.q, x.q_bc)
        if prediction.blur is not None:
            C = C + prediction.blur
        if lag_ns:
            pose = propagate_state(x, lag_ns * 1e-9)[0].T_ac @ x.T_ac.inverse() @ pose
        share, weight = innovation.share, innovation.weight
        return PoseFix(
            prediction.belief.t_ns + lag_ns, pose, C, lag_ns, share, 1, self.orbit, weight
        )

    def propagated(self, track: Track, belief: Belief, t_ns: int) -> tuple[Belief, Array]:
        """A belief at another instant with the disturbances of a track, and the transition matrix
        (20, 20).
        """
        return propagated(belief, t_ns, *self.noise_levels(track), self.orbit)

    def predicted(self, track: Track, t_ns: int) -> tuple[Belief, Array]:
        """The belief of a track at a later instant, and the transition matrix (20, 20) about its
        mean.

        After a gap a mixture has moved as each of its components has, which a propagation about the
        mean does not show.
        """
        belief, Phi = self.propagated(track, track.belief, t_ns)
        last, times = track.batch, [fix.t_ns for fix in track.fixes[-2:]]
        mixed = (
            track.mode == "fit"
            and last is not None
            and len(last.components) > 1
            and len(times) == 2
        )
        if last is None or not mixed or t_ns - times[1] <= _GAP * (times[1] - times[0]):
            return belief, Phi
        mixture = without_pose(
            last.components, t_ns, belief.x.T_ac, self.noise_levels(track), self.orbit
        )
        return moments(mixture), Phi

    def chart_at(self, belief: Belief, t_ns: int) -> Chart:
        """The belief's mean propagated to another instant, as a starting point of a fit."""
        arc = None if self.orbit is None else self.orbit.at(belief.t_ns)
        return to_chart(propagate_state(belief.x, (t_ns - belief.t_ns) * 1e-9, arc)[0])


def _better_than_measured(belief: Belief, R: Array) -> bool:
    """Return whether the pose is known at least as well as from a single measurement with the noise
    R (6, 6).
    """
    H = measurement_jacobian(belief.x)
    S = H @ belief.P @ H.T
    return all(
        float(np.trace(S[b, b])) <= float(np.trace(R[b, b])) for b in (slice(0, 3), slice(3, 6))
    )


def bent(last: BatchResult, belief: Belief) -> bool:
    """Return whether the poses since a fit have moved the inertia by more than its 1 sigma along a
    curved likelihood.

    One component stands for such a likelihood where no profile fit was found. It holds near the fit
    only.

    Args:
        last: the fit.
        belief: after the poses since.
    """
    if last.gaussian or len(last.components) > 1:
        return False
    moved = belief.x.sigma - last.belief.x.sigma
    return float(moved @ np.linalg.solve(last.belief.P[SIGMA, SIGMA], moved)) > 1.0


def with_last_pose(result: BatchResult, fix: PoseFix, noise: tuple[float, float]) -> BatchResult:
    """The result of a fit, in no direction less precise at its last pose ``fix`` than that pose
    (``not_worse``).

    Args:
        result: the fit's result.
        fix: the last of its poses.
        noise: root densities of torque [rad/s^1.5] and force [m/s^1.5].
    """
    C = scaled(fix.C, result.factors * np.sqrt(result.inflation))
    mixture = not_worse(result.components, fix.t_ns, fix.T_ac, C, fix.weight, noise, fix.orbit)
    if mixture is result.components:
        return result
    belief, _ = propagated(moments(mixture), result.belief.t_ns, *noise, fix.orbit)
    return replace(result, belief=belief, components=mixture)
