"""State of the estimator between scans, and its prediction for a scan."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from statistics import median
from typing import Any

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate import _motion
from avsreplay.estimate.batch import Prior
from avsreplay.estimate.common_errors import NO_MODEL_ERRORS, ModelErrors, line_of_sight_1s
from avsreplay.estimate.frame import EstimatorFrame
from avsreplay.estimate.initialise import BatchResult, PoseFix
from avsreplay.estimate.measurement import update_noise
from avsreplay.estimate.noise import NO_INFLATION, NoiseWindow
from avsreplay.estimate.noise_levels import NO_LEVELS, NoiseLevels
from avsreplay.geometry import Array, Pose, frozen
from avsreplay.records import Alignment, AlignStatus, Belief, Drift, Innovation, Manoeuvre, Moves

# NIS values for the scale; median of chi-square with 6 degrees
_FEWEST_NIS = 5
_MOST_NIS = 61
_MEDIAN_CHI2 = 5.348
# least number of poses of an estimate whose prediction can be tested
_READY = 8
_READY_AFTER_MANOEUVRE = 3
_NO_NOISE = frozen(np.zeros((6, 6)))
_NO_MOTION = frozen(np.zeros((6, 0)))
NO_CHANGE = frozen(np.zeros((20, 20)))
# least rotation of a motion of `common_motions` that is one of the model [rad]: its axis is within
# half an extent of the centre, and a displacement is none
_LEAST_ROTATION = 2.0 / math.sqrt(5.0)
# largest change of the other rotations if a rotation that is first determined turns the track
_TURN_WITHIN_RAD = 0.2
_SAME_MOTION_COSINE = 0.966  # cosine of 15 deg, between motions that count as the same


@value_class
class SensorBias:
    """An error of the sensor in effect.

    Attributes:
        offset: (6,) of the measured poses in {A} at its onset: position [m] and half angle.
        P: (6, 6) its covariance.
        last: the last scan with this error.
        before, since: scans without and with it that are compared.
        doubted: another hypothesis is more likely.
        spacing, left_out: scans to the next that is compared, of which so many have passed.
    """

    offset: Array
    P: Array
    last: Epoch
    before: tuple[Epoch, ...] = ()
    since: tuple[Epoch, ...] = ()
    doubted: bool = False
    spacing: int = 1
    left_out: int = 0


@value_class
class Epoch:
    """A scan as the estimator received it: the track before it (without history), its
    prediction and innovation.
    """

    track: Track = field(repr=False)
    prediction: Prediction
    innovation: Innovation
    converged: bool
    _used: Array | None = field(default=None, init=False, repr=False)
    _white: Array | None = field(default=None, init=False, repr=False)

    @property
    def white(self) -> Array:
        """The (6,) whitened innovation; computed once."""
        if (found := self._white) is None:
            root = _motion.roots(self.innovation.S[None])[0]
            object.__setattr__(self, "_white", found := root @ self.innovation.alpha)
        return found

    @property
    def used(self) -> Array:
        """Its transition, innovation and gain as ``_motion.change`` takes them; computed once."""
        if (found := self._used) is None:
            prior, seen, inflation = self.prediction, self.innovation, self.track.inflation
            noise = update_noise(seen, NO_INFLATION if inflation is None else inflation)
            H, P = prior.H, prior.belief.P
            found = _motion.used(prior.Phi, P, H, seen.alpha, seen.S, seen.R, noise)
            object.__setattr__(self, "_used", found)
        return found


@dataclass(frozen=True, eq=False)
class Track:
    """The state of the estimator between two scans.

    Attributes:
        belief: after the last scan.
        mode: the estimator in use: 'near', 'start', 'fit' or 'filter', or the name of a plug-in.
        window: of the noise adaptation.
        sigma_hits: sigma bounds that cut the gain so far.
        r_floors: eigenvalues of R raised so far.
        R: (6, 6) noise of the last healthy scan [m, half angle].
        fixes: healthy poses that fits use.
        older: those before.
        batch: the last batch fit whose estimate was adopted.
        since: healthy poses since the last fit.
        reinitialised: how often a fit replaced the filter's estimate, or the given start was
            rejected.
        inflation: (2,) factor on R for errors correlated in time (attitude, position) by the last
            fit; None before it.
        prior, prior_ns: Gaussian prior of the fit and its instant: the given start, or that after a
            manoeuvre.
        recent: the last accepted scans.
        doubtful: the scans not yet decided on.
        nis: of the last healthy scans.
        rejected: the last poses since the last accepted scan that nothing explained.
        bias: an error of the sensor in effect, or None.
        started_ns: instant of the first scan of this estimate.
        previous: the estimate before the last manoeuvre or new start, None where there was none.
        manoeuvres: all that were found.
        pending: the last of them is reported, and the motion after it not determined.
        drift: a constant torque or force on the target, None where none is found.
        untested: healthy poses since the
            last test for one.
        levels: noise levels estimated so far.
        unlevelled: healthy poses since the last estimate of them.
        undetermined: (6, k) motions d of the model that neither the start nor any healthy scan so
            far determines, each as large as half the extent: 1 sigma.
        change_probability, change_P: of a change of the velocities in the last scans, and what it
            adds to P (20, 20).
        errors: of the model and of the ranges, as the healthy scans so far show them.
        plugged: state of an estimator that is a plug-in (``plugged``).
    """

    belief: Belief
    mode: str
    window: NoiseWindow = field(default_factory=NoiseWindow.empty)
    sigma_hits: int = 0
    r_floors: int = 0
    R: Array = field(default_factory=lambda: _NO_NOISE)
    fixes: tuple[PoseFix, ...] = ()
    older: tuple[PoseFix, ...] = ()
    batch: BatchResult | None = None
    since: int = 0
    reinitialised: int = 0
    inflation: Array | None = None
    prior: Prior | None = None
    prior_ns: int = 0
    recent: tuple[Epoch, ...] = ()
    doubtful: tuple[Epoch, ...] = ()
    rejected: tuple[PoseFix, ...] = ()
    nis: tuple[float, ...] = ()
    bias: SensorBias | None = None
    started_ns: int = 0
    previous: Track | None = field(default=None, repr=False)
    manoeuvres: tuple[Manoeuvre, ...] = ()
    pending: bool = False
    drift: Drift | None = None
    untested: int = 0
    levels: NoiseLevels = NO_LEVELS
    unlevelled: int = 0
    undetermined: Array = field(default_factory=lambda: _NO_MOTION)
    change_probability: float = 0.0
    change_P: Array = field(default_factory=lambda: NO_CHANGE)
    errors: ModelErrors = NO_MODEL_ERRORS
    plugged: Any = None

    def changed(self, **values: Any) -> Track:
        """Return a copy with other values: ``dataclasses.replace``, faster for so many fields.

        Raises:
            TypeError: a name is not that of a field.
        """
        new = object.__new__(Track)
        new.__dict__.update(self.__dict__, **values)
        if len(new.__dict__) != len(self.__dict__):
            raise TypeError(f"no fields of a track: {values.keys() - self.__dict__.keys()}")
        return new


def common_motions(first: Array, other: Array | None, length_m: float) -> Array:
    """Return the motions of the model that two sets contain, as columns d = [theta; v] in {C} (6,
    k).

    Args:
        first: (6, n) independent motions.
        other: (6, m) likewise; None for no motion.
        length_m: a rotation by 1 rad is as large as a displacement by this length; each column is
            twice as large.
    """
    if other is None or not first.size:
        return _NO_MOTION
    scale = np.repeat([length_m, 1.0], 3)[:, None]
    (a, _), (b, _) = (np.linalg.qr(scale * each) for each in (first, other))
    left, cosines, _ = np.linalg.svd(a.T @ b)
    return frozen(
        2.0 * length_m * (a @ left[:, : len(cosines)][:, cosines > _SAME_MOTION_COSINE]) / scale
    )


def undetermined(track: Track, innovation: Innovation, used: bool, length_m: float) -> Array:
    """Return ``Track.undetermined`` after a scan; ``track`` before it, ``length_m`` as in
    ``common_motions``.
    """
    return (
        common_motions(track.undetermined, innovation.free, length_m)
        if used
        else track.undetermined
    )


def turned(track: Track, T_ac: Pose, measured: Pose, alignment: Alignment) -> Track:
    """Return the track after a pose first determines a rotation of the model: all of it is turned
    to this pose.

    No scan before has determined this rotation, so that the earlier poses are as correct after any
    such turn of the model. The next fit begins anew, because the turn is not small.

    Args:
        track: before the scan.
        T_ac: predicted pose.
        measured: pose of the scan, in the frame of the track.
        alignment: of the scan.

    Returns:
        The track itself if the view has unobservable directions, or if not one rotation alone is
        undetermined or explains the difference.
    """
    d, determines = (
        track.undetermined,
        alignment.status is AlignStatus.ALIGNED and alignment.free is None,
    )
    size = float(np.linalg.norm(d[:3])) if d.shape[1] == 1 and determines else 0.0
    if size < _LEAST_ROTATION:
        return track
    axis, moment = np.split(d[:, 0] / size, 2)
    step = T_ac.inverse() @ measured
    q, centre = geometry.exp(float(geometry.log(step.q) @ axis) * axis), np.cross(axis, moment)
    G = Pose(q, centre - geometry.matrix(q) @ centre)
    if float(geometry.angle((G.inverse() @ step).q)) > _TURN_WITHIN_RAD:
        return track
    x, adjoint = track.belief.x, np.kron(np.eye(2), G.R.T)  # d' = adjoint d of T_ac G
    adjoint[3:, :3] = -G.R.T @ geometry.skew(G.t)
    x = replace(x, q_bc=geometry.multiply(x.q_bc, G.q), c_b=x.c_b + geometry.matrix(x.q_bc) @ G.t)
    fixes = tuple(
        replace(
            fix,
            T_ac=fix.T_ac @ G,
            C=adjoint @ fix.C @ adjoint.T,
            shift=None if fix.shift is None else adjoint @ fix.shift,
        )
        for fix in track.fixes
    )
    belief = replace(track.belief, x=x)
    anew = track.changed(belief=belief, fixes=fixes, older=(), mode="start", batch=None)
    return anew.changed(recent=(), doubtful=(), bias=None)


@lru_cache(maxsize=1)  # the belief and its forecasts need it
def common_1s(track: Track, frame: EstimatorFrame) -> Array:
    """Return the 1 sigma (3,) in {A} [m] of the error of the position along the line of sight that
    all poses have.
    """
    r_a = frame.position_out(track.belief.x.r_a, track.belief.t_ns)
    batch, variance = track.batch, _NO_NOISE[:3, :3]
    if batch is not None and batch.position_m2 is not None:
        variance = track.levels.common[1] * batch.share * batch.position_m2
    return frozen(line_of_sight_1s(r_a, variance, track.errors), 3)


@value_class
class Prediction:
    """The prior at the instant of a scan.

    Attributes:
        belief: prior mean and covariance.
        Phi: (20, 20) of the step.
        H: (6, 20) at the prior.
        window: the track's noise window.
        lag_s: mean measurement instant of the scan's points after the scan's instant [s].
        counted: how far systematic errors of its pose count (``ModelErrors.counted``).
        blur: (6, 6) covariance in {C} of treating the pose as one of a single instant although its
            points were measured at many; None for zero.
        plugged: prediction of an estimator that is a plug-in.
    """

    belief: Belief
    Phi: Array
    H: Array
    window: NoiseWindow
    lag_s: float = 0.0
    blur: Array | None = None
    counted: float = 0.0
    plugged: Any = None


def confirmed(track: Track) -> tuple[Manoeuvre, ...]:
    """The manoeuvres without one that is still pending."""
    return track.manoeuvres[:-1] if track.pending else track.manoeuvres


def in_doubt(track: Track) -> bool:
    """Return whether a scan is not decided on, or a bias or an unchanged motion is not the most
    likely cause.
    """
    return (
        bool(track.doubtful)
        or track.change_probability > 0.5
        or (track.bias is not None and track.bias.doubted)
    )


def moves(track: Track) -> Moves:
    """Return what the poses of a track show of the motion."""
    if track.drift is not None:
        return Moves.ACCELERATED
    return Moves.DISTURBED if track.levels.certain else Moves.FREE


def with_history(then: Track, now: Track) -> Track:
    """An earlier track, with the events that were found since; no scan is in doubt."""
    return then.changed(
        manoeuvres=confirmed(now),
        pending=False,
        drift=then.drift or now.drift,
        previous=now.previous,
        doubtful=(),
    )


def nis_scale(track: Track) -> float:
    """How many times larger than chi-square the NIS of the accepted scans is: their median over
    that of chi-square.

    Registration errors beyond the claimed covariance enlarge the NIS of all scans, so that of a
    doubtful scan must be large compared with that of the accepted scans. The median is taken over
    many scans: errors of the registration last for the whole log, while a sensor error that grows
    over some tens of scans must not raise the gate that detects it.
    """
    if len(track.nis) < _FEWEST_NIS:
        return 1.0
    return max(1.0, median(track.nis) / _MEDIAN_CHI2)


def with_nis(after: Track, before: Track, nis: float) -> Track:
    """The track with the NIS of one more accepted scan."""
    return after.changed(nis=(*before.nis, nis)[-_MOST_NIS:])


def ready(track: Track) -> bool:
    """Return whether the estimate is based on enough poses for its prediction to be tested.

    After a manoeuvre the prior keeps all but the velocities, so that few poses determine the
    motion.
    """
    least = _READY_AFTER_MANOEUVRE if track.manoeuvres else _READY
    return track.mode == "filter" or (
        track.mode == "fit" and track.batch is not None and track.batch.count >= least
    )
