"""A scenario that can be replayed."""

from __future__ import annotations

from dataclasses import dataclass, field

from avsreplay.log import SourceOptions


@dataclass(frozen=True, slots=True)
class Prepared:
    """A scenario that can be replayed.

    Attributes:
        scenario, group: its name and its group.
        repeat: number of the motion.
        source: the log, or "" where the data are not available.
        sha256: hash of what it was made of.
        options: how to read it.
        assignments: settings ``a.b=value`` of its replay.
        pushes_s: instants at which the motion changes [s after the first scan].
        loaded: whether a constant torque or force acts.
        truth_m, truth_deg: accuracy of the true poses.
        poses: whether it holds poses in place of scans.
        thin_m: edge of the voxels for a back end that needs thinned scans; 0: none.
        missing: why it is not available, "" if it is.
    """

    scenario: str
    group: str
    repeat: int
    source: str = ""
    sha256: str = ""
    options: SourceOptions = field(default_factory=SourceOptions)
    assignments: tuple[str, ...] = ()
    pushes_s: tuple[float, ...] = ()
    loaded: bool = False
    truth_m: float = 0.0
    truth_deg: float = 0.0
    poses: bool = False
    thin_m: float = 0.0
    missing: str = ""
