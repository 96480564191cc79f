"""The measurement noise in force: the registration's word or R0, adapted by the window, and its correlation in time."""

from __future__ import annotations

import numpy as np

from avsreplay.estimate import adapt
from avsreplay.estimate.adapt import NoiseWindow
from avsreplay.estimate.measure import noise_of, residual
from avsreplay.estimate.params import Adaptation, EstimatorParams, NoiseSource, Start
from avsreplay.estimate.track import WHITE, Prediction, Track
from avsreplay.geometry import Array, frozen
from avsreplay.records import Alignment, Belief, Innovation, State

__all__ = ["Noise"]

_ONES = frozen(np.ones(6))
_FREE_RAD = 1.0  # standard deviation of an attitude direction the view leaves free


class Noise:
    """R (6, 6) [m, half-angle] of a measured pose.

    Args:
        params: settings, auto values filled in.
        extent_m: the target's bounding diagonal [m].
    """

    def __init__(self, params: EstimatorParams, extent_m: float) -> None:
        self.params = params
        self._R0 = params.R0
        self._extent_m = extent_m
        self._free = (_FREE_RAD, 0.5 * extent_m)

    def of(self, alignment: Alignment, x: State, window: NoiseWindow) -> Array:
        """The base R under the window's adaptation, floored."""
        R = self._base(alignment, x)
        if self.params.adapt is Adaptation.MATRIX:
            R = adapt.matrix_noise(window, self._R0, self.params.window)
        elif self.params.adapt is Adaptation.SCALE:
            R = R * (window.factors[:, None] * window.factors)
        return adapt.floored(R, self._R0, self.params.r_floor)

    def base(self, R: Array, window: NoiseWindow) -> Array:
        """The base R of an R that ``of`` gave with this window."""
        s = window.factors if self.params.adapt is Adaptation.SCALE else _ONES
        return np.asarray(R / (s[:, None] * s))

    def floors(self, R: Array) -> int:
        """How many eigenvalues of R stand on the floor."""
        return adapt.at_floor(R, self._R0, self.params.r_floor)

    def share(self, alignment: Alignment) -> float:
        """Of R, what the poses of neighbouring scans have in common."""
        return self.params.share(alignment.inliers, alignment.rms_m / self._extent_m)

    def colour(self, track: Track, prior: Belief, seen: Innovation) -> Array:
        """(2,) how many times less than white ones the poses say; the paper's own filter takes them as white."""
        if track.colour is not None:
            return track.colour
        if self.params.start is Start.PAPER:
            return WHITE
        turn = float(np.linalg.norm(prior.x.w_b)) * (prior.t_ns - track.belief.t_ns) * 1e-9
        return np.full(2, self.params.colour(turn, seen.share))

    def remembered(self, prediction: Prediction, seen: Innovation, posterior: Belief, colour: Array) -> NoiseWindow:
        """The window with this epoch's a posteriori residual z - h(x+), its ratios against the base R.

        H P+ H' is taken without the widening: what the fit took up of one scan is what white noise would leave.
        """
        left = residual(posterior.x, prediction.belief.x, seen.alpha)
        HPH = prediction.H @ posterior.P @ prediction.H.T * (2.0 / float(colour[0] + colour[1]))
        window = prediction.window
        return adapt.push(window, left, HPH, self.base(seen.R, window), self.params.window, seen.weight)

    def _base(self, alignment: Alignment, x: State) -> Array:
        if self.params.noise is NoiseSource.R0 or self.params.adapt is Adaptation.MATRIX:
            return self._R0
        R = noise_of(alignment, x, self._free)
        return self._R0 if R is None else R
