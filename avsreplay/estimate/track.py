"""What the estimator carries from scan to scan, and its prediction for a scan."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from avsreplay.estimate.batch import Prior
from avsreplay.estimate.initialise import BatchResult, PoseFix
from avsreplay.estimate.noise import NoiseWindow
from avsreplay.estimate.noise_levels import NO_LEVELS, NoiseLevels
from avsreplay.geometry import Array, frozen
from avsreplay.records import Belief, Drift, Innovation, Manoeuvre

_FEWEST_NIS, _MOST_NIS, _MEDIAN_CHI2 = 5, 61, 5.348  # NIS values for the scale; median of chi-square with 6 degrees
_READY, _READY_AFTER_MANOEUVRE = 8, 3  # least number of poses of an estimate whose prediction can be tested
_NO_NOISE = frozen(np.zeros((6, 6)))


@dataclass(frozen=True, slots=True, eq=False)
class SensorBias:
    """An error of the sensor in effect.

    Attributes:
        offset: (6,) of the measured poses in {A} at its onset: position [m] and half angle.
        P: (6, 6) its covariance.
        last: the last scan with this error.
    """

    offset: Array
    P: Array
    last: Epoch


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """A scan as the estimator received it: the track before it (without history), its prediction and innovation."""

    track: Track
    prediction: Prediction
    innovation: Innovation
    converged: bool


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The state of the estimator between two scans.

    Attributes:
        belief: mean and covariance after the last scan.
        mode: the estimator in use: 'near', 'start', 'fit' or 'filter'.
        window: of the noise adaptation.
        sigma_hits: sigma bounds that cut the gain so far.  r_floors: eigenvalues of R raised so far.
        R: (6, 6) noise of the last healthy scan [m, half-angle], zero before the first.
        fixes: healthy poses: all of them until the filter is in use, then the newest.
        batch: the last batch fit whose estimate was adopted.  since: healthy poses since the last fit.
        reinitialised: how often a fit replaced the filter's estimate, or the given start was rejected.
        inflation: (2,) factor on R for errors correlated in time (attitude, position) by the last fit; None before it.
        prior, prior_ns: Gaussian prior of the fit and its instant: the given start, or that after a manoeuvre.
        recent: the last accepted scans.  doubtful: the scans not yet decided on.  nis: of the last healthy scans.
        bias: an error of the sensor in effect, None where there is none.
        started_ns: instant of the first scan of this estimate.
        previous: the estimate before the last new start, None where there was none.
        manoeuvres: all that were found.  pending: the last of them is reported, and the motion after it not determined.
        drift: a constant torque or force on the target, None where none is found.  untested: healthy poses since the
            last test for one.
        levels: noise levels estimated so far.  unlevelled: healthy poses since the last estimate of them.
    """

    belief: Belief
    mode: str
    window: NoiseWindow = field(default_factory=NoiseWindow.empty)
    sigma_hits: int = 0
    r_floors: int = 0
    R: Array = field(default_factory=lambda: _NO_NOISE)
    fixes: tuple[PoseFix, ...] = ()
    batch: BatchResult | None = None
    since: int = 0
    reinitialised: int = 0
    inflation: Array | None = None
    prior: Prior | None = None
    prior_ns: int = 0
    recent: tuple[Epoch, ...] = ()
    doubtful: tuple[Epoch, ...] = ()
    nis: tuple[float, ...] = ()
    bias: SensorBias | None = None
    started_ns: int = 0
    previous: Track | None = None
    manoeuvres: tuple[Manoeuvre, ...] = ()
    pending: bool = False
    drift: Drift | None = None
    untested: int = 0
    levels: NoiseLevels = NO_LEVELS
    unlevelled: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The prior at the instant of a scan.

    Attributes:
        belief: prior mean and covariance.  Phi: (20, 20) of the step.  H: (6, 20) at the prior.
        window: the track's noise window.
        lag_s: mean measurement instant of the scan's points after the scan's instant [s].
        blur: (6, 6) covariance in {C} of treating the pose as one of a single instant although its points were
            measured at many; None for zero.
    """

    belief: Belief
    Phi: Array
    H: Array
    window: NoiseWindow
    lag_s: float = 0.0
    blur: Array | None = None


def confirmed(track: Track) -> tuple[Manoeuvre, ...]:
    """The manoeuvres without one that is still pending."""
    return track.manoeuvres[:-1] if track.pending else track.manoeuvres


def with_history(then: Track, now: Track) -> Track:
    """An earlier track, with the events that were found since; no scan is in doubt."""
    return replace(
        then,
        manoeuvres=confirmed(now),
        pending=False,
        drift=then.drift or now.drift,
        previous=now.previous,
        doubtful=(),
    )


def nis_scale(track: Track) -> float:
    """How many times larger than chi-square the NIS of the accepted scans is: their median over that of chi-square.

    Registration errors beyond the claimed covariance enlarge the NIS of all scans, so that of a doubtful scan must be
    large compared with that of the accepted scans. The median is taken over many scans: errors of the registration last
    for the whole log, while a sensor error that grows over some tens of scans must not raise the gate that detects it.
    """
    if len(track.nis) < _FEWEST_NIS:
        return 1.0
    return max(1.0, float(np.median(track.nis)) / _MEDIAN_CHI2)


def with_nis(after: Track, before: Track, nis: float) -> Track:
    """The track with the NIS of one more accepted scan."""
    return replace(after, nis=(*before.nis, nis)[-_MOST_NIS:])


def ready(track: Track) -> bool:
    """Return whether the estimate is based on enough poses for its prediction to be tested.

    After a manoeuvre the prior keeps all but the velocities, so that few poses determine the motion.
    """
    least = _READY_AFTER_MANOEUVRE if track.manoeuvres else _READY
    return track.mode == "filter" or (track.mode == "fit" and track.batch is not None and track.batch.count >= least)
