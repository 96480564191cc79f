"""Generators of hypotheses of the pose of a scan, one file each."""
