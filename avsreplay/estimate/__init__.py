"""The adaptive constrained filter and the maximum-likelihood fit."""

from avsreplay.estimate.estimator import Estimator, Prediction, Track
from avsreplay.estimate.params import EstimatorParams

__all__ = ["Estimator", "EstimatorParams", "Prediction", "Track"]
