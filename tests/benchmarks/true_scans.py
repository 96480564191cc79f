"""The scans of a source or a simulation with the ground truth beside each, for tests and
benchmarks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from types import SimpleNamespace


def true_scans(source) -> Iterator[SimpleNamespace]:
    """Every scan with its fields, and ``truth`` (pose), ``body`` (full state) and ``fault`` from
    ``truth_of``.
    """
    for scan in source.scans():
        truth = source.truth_of(scan)
        fields = {field.name: getattr(scan, field.name) for field in dataclasses.fields(scan)}
        yield SimpleNamespace(**fields, truth=truth.pose, body=truth.state, fault=truth.fault)
