"""Monitors of a replay: fault detection, observability Gramian, consistency, convergence."""
