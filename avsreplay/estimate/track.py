"""What the estimator carries from scan to scan, and its word before a scan is seen."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from avsreplay.estimate.adapt import NoiseWindow
from avsreplay.estimate.cold import ColdFit
from avsreplay.estimate.start import PoseFix
from avsreplay.geometry import Array, frozen
from avsreplay.records import Belief

__all__ = ["WHITE", "Prediction", "Track"]

WHITE = frozen(np.ones(2))
_NOTHING = frozen(np.zeros((6, 6)))


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """What the estimator carries from scan to scan.

    Attributes:
        belief: after the last scan.  mode: 'near', 'start', 'fit' or 'filter'.  window: of the noise adaptation.
        sigma_hits: sigma bounds that cut the gain so far.  r_floors: eigenvalues of R raised so far.
        R: (6, 6) noise of the last healthy scan [m, half-angle], zero before it.
        fixes: healthy poses: all of them until the filter speaks, then the newest.  cold: the last fit that spoke.
        since: healthy poses since the last fit was made.  recalls: how often a fit took the word from
            the filter, or left out the given start.
        colour: (2,) the last fit's word on the poses' correlation in time, attitude and position; None before one.
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
    colour: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The prior at a scan's instant.

    Attributes:
        belief: prior mean and covariance.  Phi: (20, 20) of the step.  H: (6, 20) at the prior.
        window: the track's noise window.
        lag_s: after that instant, when the scan's points were measured on the mean.  blur: (6, 6) covariance in {C} of
            what their having been measured at many instants does to a pose taken for one of one, None for nothing.
    """

    belief: Belief
    Phi: Array
    H: Array
    window: NoiseWindow
    lag_s: float = 0.0
    blur: Array | None = None
