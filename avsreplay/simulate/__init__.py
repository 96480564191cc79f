"""Simulated scans with truth: target, motion, scanner, faults, scenario.

The same seed gives the same bits.
"""
