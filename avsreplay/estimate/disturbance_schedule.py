"""When the noise levels are estimated and a constant torque or force is tested for."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import replace
from statistics import median

import numpy as np

from avsreplay.errors import value_class
from avsreplay.estimate.batch_schedule import (
    CHECK_GROWTH,
    MOST_FIXES,
    BatchSchedule,
)
from avsreplay.estimate.chart import Chart
from avsreplay.estimate.drift import DriftFound, find_drift
from avsreplay.estimate.driven import DrivenBelief, driven_moments
from avsreplay.estimate.driven_fit import levels_of
from avsreplay.estimate.driven_motion import DrivenMotion, driven_motion
from avsreplay.estimate.initialise import (
    BatchResult,
    PoseFix,
    improved_levels,
    pose_count,
    poses_of,
)
from avsreplay.estimate.measurement import (
    chart_update,
    in_camera,
    innovation_of,
    innovation_vector,
    measurement_jacobian,
)
from avsreplay.estimate.noise import NO_INFLATION
from avsreplay.estimate.noise_levels import FEWEST, NoiseLevels
from avsreplay.estimate.normal_points import PositionRows, position_rows
from avsreplay.estimate.params import Adaptation
from avsreplay.estimate.pose_noise import cholesky_root, scaled
from avsreplay.estimate.track import Track
from avsreplay.geometry import Array
from avsreplay.records import UNLIKELY, Drift
from avsreplay.settings import given

# poses for a test of drift, and between two tests
FEWEST_WITH_DRIFT = 40
FEWEST_TO_TEST = 10
DRIFT_GROWTH = 0.1
LEVEL_GROWTH = 0.2  # share by which the poses grow between two estimates of the noise levels
# prior 1 sigma of a drift's acceleration over that of the velocity at the start [1/s]
_DRIFT_OF_SPEED = 5e-3
# age of the poses over that at the report of a drift, until which it is tested for as often as
# before
_EARLY = 2.0
# least variance of a belief over that of a pose, less 1, for which the pose is used
_LEAST_EXCESS = 1e-6
_POSITIONS = 36  # points of the positions from which the density of a force is estimated
# chi-square with 6 degrees of freedom: a median of FEWEST values is below with probability 1e-5
_LEAST_NIS = 1.6
_MORE = 1.3  # factor on a disturbance from which the poses are fitted again at once


@value_class
class _Driven:
    """A drift, the noise levels with it, and the motion of each hypothesis with its weight, none
    where one is bent.
    """

    found: DriftFound
    levels: NoiseLevels
    motions: list[tuple[float, DrivenMotion]]


class DisturbanceSchedule:
    """Runs the tests.

    Args:
        batch: runs the fits.
    """

    def __init__(self, batch: BatchSchedule) -> None:
        self.batch, self.params = batch, batch.params
        self._drift_scale = (1e-3, _DRIFT_OF_SPEED * given(batch.params.start_vel_1s_mps))

    def tested(self, track: Track) -> Track:
        """The track after a healthy scan, with a test of the noise levels, else of a drift, if one
        is due.

        A drift is tested for each time the poses have grown enough, with all poses: those that have
        left the fit as well, because the random disturbances that shorten it are the other
        explanation. From its first detection on it is part of the motion that the filter predicts.
        The value that is reported is that of the last fit to all poses: where inertia and torque
        explain each other, the filter's covariance becomes too small between fits.

        Args:
            track: after the scan.
        """
        track = track.changed(untested=track.untested + 1, unlevelled=track.unlevelled + 1)
        if not self.batch.checked_poses or track.batch is None:
            return track
        fixes = self._for_levels(track)
        if fixes:
            return self._levelled(track, track.batch, fixes)
        if track.untested <= FEWEST_TO_TEST or track.since == 0:
            return track
        return self._with_drift(track, track.batch)

    def _for_levels(self, track: Track) -> tuple[PoseFix, ...]:
        """The poses with which the noise levels are tested, empty if no test is due.

        Disturbances that are too large shorten the fit to fewer poses than are needed to estimate
        them again.
        """
        count, fixes = pose_count(track.fixes), track.fixes
        if track.drift is not None or track.unlevelled <= max(FEWEST_TO_TEST, LEVEL_GROWTH * count):
            return ()
        if count < FEWEST and _overestimated(track):
            fixes = _all_poses(track).fixes[-FEWEST:]
        return fixes if pose_count(fixes) >= FEWEST else ()

    def _levelled(self, track: Track, last: BatchResult, fixes: tuple[PoseFix, ...]) -> Track:
        """The track with new noise levels."""
        start = self._start(track, last, fixes[0].t_ns)
        levels = improved_levels(
            fixes, last, start, self.params, track.levels, _positions(track, start)
        )
        used, found = (track.levels.torque, track.levels.force), (levels.torque, levels.force)
        more = any(new > _MORE * old for new, old in zip(found, used, strict=True))
        # estimated without these disturbances: fit again
        since = pose_count(track.fixes) if more else track.since
        return track.changed(levels=levels, since=since, unlevelled=0)

    def _with_drift(self, track: Track, last: BatchResult) -> Track:
        """The track after a test of a drift, if one is due."""
        known = track.drift
        every = _all_poses(track) if known is None else track
        count, epoch_ns = pose_count(every.fixes), every.fixes[0].t_ns
        age_ns = track.belief.t_ns - epoch_ns
        early = known is None or age_ns < _EARLY * (known.detected_ns - epoch_ns)
        growth = DRIFT_GROWTH if early else CHECK_GROWTH
        if count < FEWEST_WITH_DRIFT or track.untested <= growth * count:
            return track
        track, begun = track.changed(untested=0), None
        if known is not None:
            if last.epoch_ns != epoch_ns or not isinstance(track.belief, DrivenBelief):
                return track
            begun = max(0.0, (known.t_ns - epoch_ns) * 1e-9), track.belief.u
        driven = self._driven_motions(every, self._start(track, last, epoch_ns), begun)
        return track if driven is None else self._driven(track, last, every, driven)

    def _start(self, track: Track, last: BatchResult, epoch_ns: int) -> Chart:
        """Initial values at an instant: those of the last fit, or of the belief propagated back."""
        return (
            last.chart if last.epoch_ns == epoch_ns else self.batch.chart_at(track.belief, epoch_ns)
        )

    def _driven_motions(
        self, track: Track, start: Chart, begun: tuple[float, Array] | None
    ) -> _Driven | None:
        """The test for a drift. ``begun``: onset and size of one that is known."""
        factors = track.window.blocks
        try:
            found = find_drift(
                track.fixes, start, self.params, factors, self._drift_scale, track.levels, begun
            )
            if found is None:
                return None
            claimed, best, widths = (
                self.params.adapt is Adaptation.OFF,
                found.hypotheses[0],
                found.widths,
            )
            forced = bool(best.fitted.u[3:].any())  # a constant force would count as a random one
            seen = None if forced else _positions(track, best.fitted.chart)
            first = replace(
                track.levels, torque=0.0, force=0.0
            )  # the acceleration may have caused these disturbances
            before = first if begun is None else track.levels
            levels = levels_of(best.fitted, before, widths, claimed, self.params.disturbances, seen)
            if (
                begun is None and levels.established
            ):  # with random disturbances beside it, these may explain everything
                return None
            motions = []
            for h in found.hypotheses:
                motion = driven_motion(h.fitted, h.onset_1s_s, widths, levels)
                if motion is None:
                    return _Driven(found, levels, [])
                motions.append((h.weight, motion))
            return _Driven(found, levels, motions)
        except (
            np.linalg.LinAlgError
        ):  # an unstable spin over so long a time that its motion cannot be inverted
            return None

    def _driven(self, track: Track, last: BatchResult, every: Track, driven: _Driven) -> Track:
        """The track with the estimate of a fit with a constant torque or force.

        Args:
            track: after the scan.
            last: its last fit.
            every: the track with all poses of the fit.
            driven: the fit.
        """
        now_ns, known = track.belief.t_ns, track.drift
        epoch_ns, count = every.fixes[0].t_ns, pose_count(every.fixes)
        if not driven.motions:
            return (
                track
                if known is None
                else track.changed(levels=replace(driven.levels, count=track.levels.count))
            )
        parts = [(weight, motion.belief(epoch_ns, now_ns)) for weight, motion in driven.motions]
        fitted = driven_moments(parts)
        if not np.isfinite(fitted.P).all() or (known is None and not significant(fitted)):
            return track
        track, best = every.changed(untested=0), driven.found.hypotheses[0]
        inflation, plain = driven.motions[0][1].inflation, driven.levels.factors(last.share)
        moved = no_worse_than_pose(fitted, track.fixes[-1], plain * np.sqrt(inflation))
        onset_ns, spread = epoch_ns + round(best.fitted.onset_s * 1e9), driven.found.onset_1s_s
        if onset_ns == epoch_ns:  # it may have acted before the first of these poses
            since_ns = (epoch_ns - min(track.started_ns, epoch_ns)) // 2
            onset_ns, spread = (
                onset_ns - since_ns,
                math.hypot(spread, since_ns * 1e-9 / math.sqrt(3.0)),
            )
        detected_ns = now_ns if known is None else known.detected_ns
        drift = Drift(onset_ns, spread, fitted.u[3:], fitted.u[:3], fitted.P_u, detected_ns)
        result = BatchResult(
            epoch_ns, best.fitted.chart, count, plain, inflation, moved, last.gaussian
        )
        result = replace(
            result,
            prior_rejected=last.prior_rejected,
            share=last.share,
            position_m2=last.position_m2,
        )
        track = track.changed(drift=drift, levels=replace(driven.levels, count=count))
        return self.batch.adopted(track, result, to_filter=True)


def _overestimated(track: Track) -> bool:
    """Return whether the last accepted scans agree with their predictions much better than the
    covariance claims.
    """
    return len(track.nis) >= FEWEST and median(track.nis[-FEWEST:]) < _LEAST_NIS


def significant(fitted: DrivenBelief) -> bool:
    """Return whether the acceleration is none by chance only, with the random disturbances that are
    found beside it.

    Args:
        fitted: the belief with the acceleration u (6,), of which components that were not estimated
            are zero, and its covariance.
    """
    open_ = np.flatnonzero(fitted.u)
    u, P = fitted.u[open_], fitted.P_u[np.ix_(open_, open_)]
    return bool(np.isfinite(P).all()) and float(u @ np.linalg.solve(P, u)) > UNLIKELY[len(open_)]


def _all_poses(track: Track) -> Track:
    """The track with a fit to all poses since the last manoeuvre."""
    last_ns = max([0, *(m.t_ns for m in track.manoeuvres)])
    begin = bisect_left(track.older, last_ns, key=_instant)
    return track.changed(
        fixes=(*track.older[begin:], *track.fixes)[-MOST_FIXES:], older=track.older[:begin]
    )


def _instant(fix: PoseFix) -> int:
    return fix.t_ns


def _positions(track: Track, chart: Chart) -> PositionRows | None:
    """The positions of all poses, where some have left the fit because of disturbances or a
    manoeuvre since.
    """
    if not track.older or track.fixes[0].orbit is not None:
        return None
    # poses that a new start used again are in both
    by_instant = {f.t_ns: f for f in (*track.older, *track.fixes)}
    every = tuple(by_instant[t_ns] for t_ns in sorted(by_instant))
    weights, epoch_ns = np.array([f.weight for f in every]), every[0].t_ns
    return position_rows(
        poses_of(every), weights, chart.arm_c, _POSITIONS, epoch_ns, track.manoeuvres
    )


def no_worse_than_pose(belief: DrivenBelief, fix: PoseFix, factors: Array) -> DrivenBelief:
    """The belief, in no direction less precise at its pose than the last pose ``fix``, as by
    ``mixture.not_worse``.

    ``factors`` (2,) are on the standard deviations of attitude and position.
    """
    x, H = belief.x, measurement_jacobian(belief.x)
    root = cholesky_root(in_camera(scaled(fix.C, factors), fix.T_ac.q, x.q_bc))
    whiten = np.linalg.inv(root)
    values, axes = np.linalg.eigh(whiten @ H @ belief.P @ H.T @ whiten.T)
    if values[-1] <= 1.0 or fix.lag_ns:
        return belief
    half = root @ axes / np.sqrt(fix.weight * (1.0 - 1.0 / np.maximum(values, 1.0 + _LEAST_EXCESS)))
    innovation = innovation_of(belief.P, H, innovation_vector(x, fix.T_ac), half @ half.T)
    found = chart_update(belief, H, innovation, NO_INFLATION)
    return found if isinstance(found, DrivenBelief) else belief
