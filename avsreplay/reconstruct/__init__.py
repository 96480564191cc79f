"""Reconstruction of the model of an unknown target from the scans of a log."""
