"""Simulated scans with truth: target, motion, scanner, faults, scenario."""
