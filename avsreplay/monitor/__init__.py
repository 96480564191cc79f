"""Monitors of the estimate: fault detection, observability, consistency, convergence."""
