"""State estimation: the noise-adaptive constrained Kalman filter and the maximum-likelihood batch fit."""

from avsreplay.estimate.estimator import Estimator
from avsreplay.estimate.params import EstimatorParams
from avsreplay.estimate.track import Prediction, Track

__all__ = ["Estimator", "EstimatorParams", "Prediction", "Track"]
