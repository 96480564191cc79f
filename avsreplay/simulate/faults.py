"""Faults injected into a simulated log, each over a window of the log clock and labelled in the
log.

=================  ===========================================  =======
======================================== kind               strength (default)
harmful  what happens =================  ===========================================  =======
======================================== occlusion          part of the view covered (1.0)
yes      a plate in front hides it; few plate points partial_occlusion  part of the target's returns
hidden (0.5)    no       the same, from one side dropped            none
yes      no message is written empty              none                                         yes
a message without a point clutter            added points over returns (0.5)              no
points anywhere about the target range_bias         added to every range [m] (0.3)               yes
the target seems farther away noise_burst        factor on the range noise (5.0)              no
more range noise frozen             none                                         yes      the last
scan before the window again stamp_jump         added to the stamps [s] (30.0)               yes
log time stays true =================  ===========================================  =======
========================================

``harmful`` is part of the label: the scan cannot give a correct pose at its stamp. The estimate
should survive a fault that is not harmful. A scenario may set it for each fault.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from avsreplay.records import Label
from avsreplay.settings import Settings, setting
from avsreplay.simulate.scanner import Returns

NS = 1_000_000_000
LONGEST_S = 1e8  # longest log or window: its stamps fit the 31 bits of seconds of a ROS 2 time
PLATE_RETURN_RATIO = 0.05  # a dark plate: share of the rays it blocks that give a return
PLATE_DEPTH_RATIO = 0.4  # range of the plate over the median range of the target
PLATE_TILT = math.tan(math.radians(15.0))
CLUTTER_RADIUS_RATIO = (
    1.2  # radius of the ball of clutter over that of the target's bounding sphere
)


class Kind(Enum):
    """The kinds of fault."""

    OCCLUSION = "occlusion"
    PARTIAL_OCCLUSION = "partial_occlusion"
    DROPPED = "dropped"
    EMPTY = "empty"
    CLUTTER = "clutter"
    RANGE_BIAS = "range_bias"
    NOISE_BURST = "noise_burst"
    FROZEN = "frozen"
    STAMP_JUMP = "stamp_jump"


DEFAULTS: dict[Kind, tuple[float | None, bool]] = {  # strength and whether it is harmful
    Kind.OCCLUSION: (1.0, True),
    Kind.PARTIAL_OCCLUSION: (0.5, False),
    Kind.DROPPED: (None, True),
    Kind.EMPTY: (None, True),
    Kind.CLUTTER: (0.5, False),
    Kind.RANGE_BIAS: (0.3, True),
    Kind.NOISE_BURST: (5.0, False),
    Kind.FROZEN: (None, True),
    Kind.STAMP_JUMP: (30.0, True),
}


@dataclass(frozen=True, slots=True)
class InjectedFault(Settings):
    """One table [[fault]]: a kind of fault over [start_s, start_s + duration_s)."""

    kind: Kind = setting(doc="Kind of the fault.")
    start_s: float = setting(
        doc="Begin of the fault, after the time of the first scan.",
        unit="s",
        low=0.0,
        high=LONGEST_S,
    )
    duration_s: float = setting(doc="Length of the fault.", unit="s", above=0.0, high=LONGEST_S)
    strength: float | None = setting(
        None, "Strength; its meaning and range depend on the kind.", unset="the default of the kind"
    )
    harmful: bool | None = setting(
        None,
        "Whether the label states that such a scan gives no good pose.",
        unset="as usual for the kind",
    )

    def check(self) -> None:
        """Raise ValueError where the strength does not fit the kind."""
        default, _ = DEFAULTS[self.kind]
        if self.strength is not None and default is None:
            raise ValueError(f"a fault of kind '{self.kind.value}' has no strength")
        if self.strength is not None and not fits(self.kind, self.strength):
            raise ValueError(f"strength = {self.strength} is out of range for '{self.kind.value}'")


MOST_CLUTTER = 100.0  # points added for each point of the scan
MOST_STRENGTH = 1e9  # a jump by more seconds leaves the 31 bits of a ROS time


def fits(kind: Kind, value: float) -> bool:
    """Return whether a strength is in the range of its kind."""
    if kind in (Kind.OCCLUSION, Kind.PARTIAL_OCCLUSION):
        return 0.0 < value <= 1.0
    if kind is Kind.CLUTTER:
        return 0.0 < value <= MOST_CLUTTER
    return abs(value) <= MOST_STRENGTH and (
        value > 0.0 or kind in (Kind.RANGE_BIAS, Kind.STAMP_JUMP)
    )


def strength(fault: InjectedFault) -> float:
    """The strength of a fault, the default of its kind where none is given (0 for a kind without
    strength).
    """
    return fault.strength if fault.strength is not None else DEFAULTS[fault.kind][0] or 0.0


def label(fault: InjectedFault, epoch_ns: int) -> Label:
    """The label of a fault: a half-open window on the log clock that begins at ``epoch_ns``."""
    default, harmful = DEFAULTS[fault.kind]
    return Label(
        kind=fault.kind.value,
        start_ns=epoch_ns + round(fault.start_s * NS),
        end_ns=epoch_ns + round((fault.start_s + fault.duration_s) * NS),
        harmful=harmful if fault.harmful is None else fault.harmful,
        strength=default if fault.strength is None else fault.strength,
    )


def active(
    faults: Sequence[InjectedFault], epoch_ns: int, log_ns: int
) -> dict[Kind, InjectedFault]:
    """The faults whose window contains ``log_ns``, the first of each kind, in the order of the
    scenario.
    """
    found: dict[Kind, InjectedFault] = {}
    for fault in faults:
        window = label(fault, epoch_ns)
        if window.start_ns <= log_ns < window.end_ns:
            found.setdefault(fault.kind, fault)
    return found


def occlude(returns: Returns, covered: float, side_rad: float, rng: np.random.Generator) -> Returns:
    """Hide a share of the returns behind a plate; a few returns come from the plate.

    Args:
        returns: The returns of the scan.
        covered: Share that is hidden.
        side_rad: Direction in the image from which the plate enters: 0 from the left, pi / 2 from
            the top.
        rng: For the returns of the plate.
    """
    draw = rng.random(len(returns.ranges))
    if not len(returns.ranges):
        return returns
    image = returns.directions[:, :2] / returns.directions[:, 2:]
    across = image[:, 0] * math.cos(side_rad) + image[:, 1] * math.sin(side_rad)
    order = np.argsort(across, kind="stable")
    hidden = np.zeros(len(across), dtype=bool)
    hidden[order[: math.ceil(covered * len(across))]] = True
    depth = PLATE_DEPTH_RATIO * float(np.median(returns.ranges))
    on_plate = depth / (
        returns.directions[:, 2] + PLATE_TILT * returns.directions[:, 0]
    )  # plane z + tan(tilt) x = depth
    back = hidden & (draw < PLATE_RETURN_RATIO) & (on_plate > 0.0)
    return replace(returns, ranges=np.where(hidden, on_plate, returns.ranges)).keep(~hidden | back)


def clutter(
    returns: Returns, ratio: float, centre_a: ArrayLike, radius_m: float, rng: np.random.Generator
) -> Returns:
    """Add ``ratio`` times as many points, uniform over a ball about the target.

    Args:
        returns: The returns of the scan.
        ratio: Number of points to add over the number of returns.
        centre_a: (3,) centre of the target in {A} [m].
        radius_m: Radius of its bounding sphere [m].
        rng: For the points.
    """
    n = round(ratio * len(returns.ranges))
    towards = rng.standard_normal((n, 3))
    radii = (
        CLUTTER_RADIUS_RATIO
        * radius_m
        * np.cbrt(rng.random(n))
        / np.sqrt(np.sum(towards * towards, axis=1))
    )
    points = np.asarray(centre_a, dtype=np.float64) + towards * radii[:, None]
    times = rng.choice(returns.times_s, n) if n else np.empty(0)
    ranges = np.sqrt(np.sum(points * points, axis=1))
    ahead = points[:, 2] > 0.0
    one, zero = np.ones(int(ahead.sum())), np.zeros(int(ahead.sum()))
    added = Returns(
        points[ahead] / ranges[ahead, None], ranges[ahead], times[ahead], one, zero, zero
    )
    return returns.joined(added)
