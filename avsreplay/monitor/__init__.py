"""Watching the estimate: faults, observability, consistency, convergence."""
