"""The adaptive constrained filter and the maximum-likelihood fit."""
