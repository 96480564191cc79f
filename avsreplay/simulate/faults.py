"""Kinds of fault, one class each, and the faults of a scenario or of ``record --fault``.

A kind of fault is a part (``avsreplay.parts``): a class that derives from ``Fault`` and is
registered in the entry-point group ``avsreplay.faults``. Its ``apply`` serves simulated and
recorded scans. The keys of a scenario, the help of ``record``, the table in docs/scenario.md, which
``python -m avsreplay.simulate.faults`` prints, and the colours of a page follow from the classes.

``harmful`` is part of the label: the scan is unusable, because it cannot give a correct pose at its
stamp. Scans with another fault are usable.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import ClassVar, cast

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.parts import FAULTS
from avsreplay.records import NS_PER_S, Label
from avsreplay.settings import NoParameters, SettingError, Settings, declared_of, setting
from avsreplay.simulate.scanner import Returns

MAX_WINDOW_S = 1e8  # longest log or window: its stamps fit the 31 bits of seconds of a ROS 2 time
MAX_STRENGTH = 1e9  # a jump by more seconds leaves the 31 bits of a ROS time
MAX_CLUTTER_RATIO = 100.0  # points added for each point of the scan
PLATE_RETURN_RATIO = 0.05  # a dark plate: share of the rays it blocks that give a return
PLATE_DEPTH_RATIO = 0.4  # range of the plate over the median range of the target
PLATE_TILT = math.tan(math.radians(15.0))
# radius of the ball of clutter over that of the target's bounding sphere
CLUTTER_RADIUS_RATIO = 1.2
OUTLIER_RANGES = 0.5, 1.5  # limits of the range of an outlier, over the median range of the scan
# cosine to the mean direction of the points, below which a point is not in front of the scanner
LEAST_AHEAD_COSINE = 0.05
RADIUS_QUANTILE = 0.9  # of the distances from the median point: the radius of an unknown target


class Stage(IntEnum):
    """The part of a scan on which a fault acts. Faults act in this order, those of one stage by
    name.
    """

    LIGHT = 0  # what the rays meet, before the noise of the scanner
    NOISE = 1  # the noise of the ranges
    RETURNS = 2  # measured returns
    OBJECTS = 3  # returns that are added or all missing
    MESSAGE = 4  # the message with the scan


@value_class
class Shot:
    """A scan before it is written to a log.

    Attributes:
        returns: the returns of the scanner.
        noise: factor by which the noise of the ranges is multiplied.
        stamp_ns: time that is added to its stamp [ns].
        written: whether the log gets a message of it.
        repeated: whether the message has the points of the last scan without this fault.
    """

    returns: Returns
    noise: float = 1.0
    stamp_ns: int = 0
    written: bool = True
    repeated: bool = False


@value_class
class Circumstances:
    """What a fault can use about the scan on which it acts.

    Attributes:
        t_s: time of the scan after the first one [s].
        place: number of scans before it in the window of the fault.
        window: makes a random generator that is the same for all scans of the window.
        along_z: whether the scanner looks along +z of the frame of the directions; otherwise it
            looks along the mean direction of the returns.
        centre_a: (3,) centre of the target in that frame [m]; None takes the median point.
        radius_m: radius of its bounding sphere [m]; None takes it from the points.
    """

    t_s: float
    place: int
    window: Callable[[], np.random.Generator]
    along_z: bool = True
    centre_a: Array | None = None
    radius_m: float | None = None


class Fault(ABC):
    """A fault that acts on scans; the base class of every kind.

    Attributes:
        name: name of the kind, as in ``kind = "..."``.
        about: what happens, in one line.
        harmful: whether a scan with it is unusable: it cannot give a correct pose at its stamp.
        stage: the part of the scan on which it acts.
        parameters: parameter class, which has the field ``strength`` or not.
    """

    name: ClassVar[str]
    about: ClassVar[str]
    harmful: ClassVar[bool]
    stage: ClassVar[Stage]
    parameters: ClassVar[type[Settings]] = NoParameters

    def __init__(self, strength: float = 0.0) -> None:
        """Create the fault.

        Args:
            strength: its strength, in the range of the kind; not used by a kind without one.
        """
        self.strength = strength

    @abstractmethod
    def apply(self, shot: Shot, at: Circumstances, rng: np.random.Generator) -> Shot:
        """Return the scan with the fault.

        Args:
            shot: the scan, with the faults that act before this one.
            at: what the fault can use about the scan.
            rng: generator of the random numbers of this scan.
        """


@dataclass(frozen=True, slots=True)
class _Covered(Settings):
    strength: float = setting(1.0, "share of the view that is covered", above=0.0, high=1.0)


class Occlusion(Fault):
    """A plate that hides returns; it enters from the same side in all scans of the window."""

    name = "occlusion"
    about = "a plate in front of the target; 5 % of the rays it blocks give a return from it"
    harmful = True
    stage = Stage.LIGHT
    parameters: ClassVar[type[Settings]] = _Covered

    def apply(self, shot: Shot, at: Circumstances, rng: np.random.Generator) -> Shot:
        """Return the scan behind the plate."""
        side_rad = float(at.window().uniform(0.0, 2.0 * math.pi))
        if at.along_z:
            hidden = occlude(shot.returns, self.strength, side_rad, rng)
            return replace(shot, returns=hidden)
        if not len(shot.returns.ranges):
            return shot
        turn = view_of(shot.returns.directions)
        seen = _turned(shot.returns, turn)
        ahead = seen.directions[:, 2] > LEAST_AHEAD_COSINE
        hidden = occlude(seen.keep(ahead), self.strength, side_rad, rng).joined(seen.keep(~ahead))
        return replace(shot, returns=replace(hidden, directions=hidden.directions @ turn))


@dataclass(frozen=True, slots=True)
class _Hidden(Settings):
    strength: float = setting(0.5, "share of the returns that is hidden", above=0.0, high=1.0)


class PartialOcclusion(Occlusion):
    """A plate that hides a part of the view."""

    name = "partial_occlusion"
    about = "the same plate from one side"
    harmful = False
    parameters = _Hidden


class Dropped(Fault):
    """The scan is not written."""

    name = "dropped"
    about = "no message is written"
    harmful = True
    stage = Stage.MESSAGE

    def apply(self, shot: Shot, at: Circumstances, rng: np.random.Generator) -> Shot:  # noqa: ARG002
        """Return the scan that is not written."""
        return replace(shot, written=False)


class Empty(Fault):
    """The message has no points."""

    name = "empty"
    about = "a message without points"
    harmful = True
    stage = Stage.OBJECTS

    def apply(self, shot: Shot, at: Circumstances, rng: np.random.Generator) -> Shot:  # noqa: ARG002
        """Return the scan without returns."""
        none = np.zeros(len(shot.returns.ranges), dtype=bool)
        return replace(shot, returns=shot.returns.keep(none))


@dataclass(frozen=True, slots=True)
class _Added(Settings):
    strength: float = setting(0.5, "added points over returns", above=0.0, high=MAX_CLUTTER_RATIO)


class Clutter(Fault):
    """Additional points about the target."""

    name = "clutter"
    about = "points uniform in a ball about the target"
    harmful = False
    stage = Stage.OBJECTS
    parameters = _Added

    def apply(self, shot: Shot, at: Circumstances, rng: np.random.Generator) -> Shot:
        """Return the scan with the points."""
        returns, radius_m = shot.returns, at.radius_m
        if not len(returns.ranges):
            return shot
        points = returns.directions * returns.ranges[:, None]
        centre = np.median(points, axis=0) if at.centre_a is None else at.centre_a
        if radius_m is None:
            distances = np.sqrt(np.sum((points - centre) ** 2, axis=1))
            radius_m = float(np.quantile(distances, RADIUS_QUANTILE))
        if at.along_z:
            return replace(shot, returns=clutter(returns, self.strength, centre, radius_m, rng))
        turn = view_of(returns.directions)
        added = clutter(_turned(returns, turn), self.strength, turn @ centre, radius_m, rng)
        return replace(shot, returns=replace(added, directions=added.directions @ turn))


@dataclass(frozen=True, slots=True)
class _Bias(Settings):
    strength: float = setting(
        0.3, "metres added to every range", unit="m", low=-MAX_STRENGTH, high=MAX_STRENGTH
    )


class RangeBias(Fault):
    """Ranges that are too long or too short."""

    name = "range_bias"
    about = "the target appears farther away"
    harmful = True
    stage = Stage.RETURNS
    parameters = _Bias

    def apply(self, shot: Shot, at: Circumstances, rng: np.random.Generator) -> Shot:  # noqa: ARG002
        """Return the scan with the other ranges, none below zero."""
        ranges = np.maximum(shot.returns.ranges + self.strength, 0.0)
        return replace(shot, returns=replace(shot.returns, ranges=ranges))


@dataclass(frozen=True, slots=True)
class _Factor(Settings):
    strength: float = setting(5.0, "factor on the noise", above=0.0, high=MAX_STRENGTH)


class NoiseBurst(Fault):
    """Larger range noise."""

    name = "noise_burst"
    about = "more range noise"
    harmful = False
    stage = Stage.NOISE
    parameters = _Factor

    def apply(self, shot: Shot, at: Circumstances, rng: np.random.Generator) -> Shot:  # noqa: ARG002
        """Return the scan with the larger factor."""
        return replace(shot, noise=shot.noise * self.strength)


class Frozen(Fault):
    """The last scan is repeated."""

    name = "frozen"
    about = "the last scan before the window is repeated"
    harmful = True
    stage = Stage.MESSAGE

    def apply(self, shot: Shot, at: Circumstances, rng: np.random.Generator) -> Shot:  # noqa: ARG002
        """Return the scan that repeats the last one."""
        return replace(shot, repeated=True)


@dataclass(frozen=True, slots=True)
class _Jump(Settings):
    strength: float = setting(
        30.0, "seconds added to the stamp", unit="s", low=-MAX_STRENGTH, high=MAX_STRENGTH
    )


class StampJump(Fault):
    """A wrong time stamp."""

    name = "stamp_jump"
    about = "the log clock stays correct"
    harmful = True
    stage = Stage.MESSAGE
    parameters = _Jump

    def apply(self, shot: Shot, at: Circumstances, rng: np.random.Generator) -> Shot:  # noqa: ARG002
        """Return the scan with the other stamp."""
        return replace(shot, stamp_ns=shot.stamp_ns + round(self.strength * NS_PER_S))


@dataclass(frozen=True, slots=True)
class _Wrong(Settings):
    strength: float = setting(0.2, "share of the returns", above=0.0, below=1.0)


class Outliers(Fault):
    """Wrong ranges."""

    name = "outliers"
    about = "their ranges are 0.5 to 1.5 times the median range of the scan"
    harmful = False
    stage = Stage.RETURNS
    parameters = _Wrong

    def apply(self, shot: Shot, at: Circumstances, rng: np.random.Generator) -> Shot:  # noqa: ARG002
        """Return the scan with wrong ranges."""
        ranges = shot.returns.ranges
        n = len(ranges)
        wrong = rng.random(n) < self.strength
        median = float(np.median(ranges)) if n else 0.0
        ranges = np.where(wrong, median * rng.uniform(*OUTLIER_RANGES, n), ranges)
        return replace(shot, returns=replace(shot.returns, ranges=ranges))


@dataclass(frozen=True, slots=True)
class _Removed(Settings):
    strength: float = setting(0.9, "share of the points that is removed", above=0.0, below=1.0)


class Subsampled(Fault):
    """Fewer points in each scan."""

    name = "subsampled"
    about = "fewer points, chosen at random"
    harmful = False
    stage = Stage.RETURNS
    parameters = _Removed

    def apply(self, shot: Shot, at: Circumstances, rng: np.random.Generator) -> Shot:  # noqa: ARG002
        """Return the scan with the points that are kept."""
        kept = rng.random(len(shot.returns.ranges)) >= self.strength
        return replace(shot, returns=shot.returns.keep(kept))


@dataclass(frozen=True, slots=True)
class _Every(Settings):
    strength: float = setting(2.0, "n, a whole number", low=2.0)

    def check(self) -> None:
        """Raise ValueError where n is not a whole number."""
        if not float(self.strength).is_integer():
            raise SettingError("strength", f"strength is {self.strength}, must be a whole number")


class FrameRate(Fault):
    """Fewer scans in each second."""

    name = "frame_rate"
    about = "only every n-th scan is written"
    harmful = False
    stage = Stage.MESSAGE
    parameters = _Every

    def apply(self, shot: Shot, at: Circumstances, rng: np.random.Generator) -> Shot:  # noqa: ARG002
        """Return the scan, written or not."""
        return replace(shot, written=shot.written and at.place % round(self.strength) == 0)


@dataclass(frozen=True, slots=True)
class InjectedFault(Settings):
    """The table [[fault]]: a kind of fault in the interval [start_s, start_s + duration_s)."""

    kind: str = setting(doc="Kind of the fault.", one_of=FAULTS)
    start_s: float = setting(
        doc="Begin of the fault, after the time of the first scan.",
        unit="s",
        low=0.0,
        high=MAX_WINDOW_S,
    )
    duration_s: float = setting(doc="Length of the fault.", unit="s", above=0.0, high=MAX_WINDOW_S)
    strength: float | None = setting(
        None, "Strength; its meaning and range depend on the kind.", unset="the default of the kind"
    )
    harmful: bool | None = setting(
        None,
        "Whether such a scan is unusable: it gives no correct pose.",
        unset="as usual for the kind",
    )

    def check(self) -> None:
        """Raise SettingError where the strength does not fit the kind."""
        has_strength = any(f.name == "strength" for f in fields(cast(type, self.type.parameters)))
        if self.strength is not None and not has_strength:
            raise SettingError("strength", f"a fault of kind '{self.kind}' has no strength")
        if self.strength is not None:
            try:
                self.type.parameters(strength=self.strength)  # type: ignore[call-arg]
            except SettingError as error:
                raise SettingError("strength", f"{error} for '{self.kind}'") from None

    @classmethod
    def parse(cls, text: str) -> InjectedFault:
        """Return the fault that ``kind:start:duration[:strength]`` describes.

        Args:
            text: kind, start and duration [s], and for some kinds the strength.

        Raises:
            ValueError: The text has another form, or a value is out of range.
        """
        kind, *rest = text.strip().split(":")
        if kind not in FAULTS.names():
            raise ValueError(f"no fault '{kind}'; there are {', '.join(FAULTS.names())}")
        try:
            numbers = [float(word) for word in rest]
        except ValueError:
            numbers = []
        if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
            raise ValueError(
                f"'{text}' is not kind:start:duration[:strength] with times in seconds"
            )
        return cls(kind, numbers[0], numbers[1], numbers[2] if numbers[2:] else None)

    @property
    def type(self) -> type[Fault]:
        """The class of the kind."""
        return cast("type[Fault]", FAULTS.load(self.kind))

    @property
    def known_strength(self) -> float | None:
        """The strength, the default of the kind where none is given; None for a kind without."""
        default = getattr(self.type.parameters(), "strength", None)
        return default if self.strength is None else self.strength

    def fault(self) -> Fault:
        """Return the fault itself."""
        return self.type(self.known_strength or 0.0)

    def label(self, epoch_ns: int) -> Label:
        """Return the label: a half-open window on the log clock.

        Args:
            epoch_ns: time of the first scan on the log clock [ns].
        """
        return Label(
            kind=self.kind,
            start_ns=epoch_ns + round(self.start_s * NS_PER_S),
            end_ns=epoch_ns + round((self.start_s + self.duration_s) * NS_PER_S),
            harmful=self.type.harmful if self.harmful is None else self.harmful,
            strength=self.known_strength,
        )

    def active(self, epoch_ns: int, log_ns: int) -> bool:
        """Return whether a scan is in the window.

        Args:
            epoch_ns: time of the first scan on the log clock [ns].
            log_ns: time of the scan on the log clock [ns].
        """
        window = self.label(epoch_ns)
        return window.start_ns <= log_ns < window.end_ns


Active = list[tuple[int, InjectedFault]]
"""Faults with their numbers in the list from which they come."""


def active(faults: Sequence[InjectedFault], epoch_ns: int, log_ns: int) -> Active:
    """Return the faults whose window contains an instant, in their order.

    Args:
        faults: All faults.
        epoch_ns: Time of the first scan on the log clock [ns].
        log_ns: The instant on the log clock [ns].
    """
    return [(k, each) for k, each in enumerate(faults) if each.active(epoch_ns, log_ns)]


def first_of_each_kind(now: Active) -> Active:
    """Return the first fault of each kind, in their order.

    Args:
        now: the active faults with their numbers.
    """
    first: dict[str, tuple[int, InjectedFault]] = {}
    for number, each in now:
        first.setdefault(each.kind, (number, each))
    return list(first.values())


def in_order_of_action(now: Active) -> list[tuple[int, Fault]]:
    """Return faults in the order in which they act; those of one kind keep their order.

    Args:
        now: the active faults with their numbers.
    """
    found = [(number, each.fault()) for number, each in now]
    return sorted(found, key=lambda item: (item[1].stage, item[1].name))


def view_of(directions: Array) -> Array:
    """Rotation (3, 3) from the frame of the scan to one whose +z axis is the mean direction of the
    points.

    Args:
        directions: unit directions (n, 3) of the points in the frame of the scan.
    """
    mean = directions.mean(axis=0)
    z = mean / np.sqrt(mean @ mean) if mean @ mean > 0.0 else np.array([0.0, 0.0, 1.0])
    aside = np.eye(3)[int(np.argmin(np.abs(z)))]
    y = np.cross(z, aside)
    y /= np.sqrt(y @ y)
    return np.stack([np.cross(y, z), y, z])


def _turned(returns: Returns, turn: Array) -> Returns:
    return replace(returns, directions=returns.directions @ turn.T)


def occlude(returns: Returns, covered: float, side_rad: float, rng: np.random.Generator) -> Returns:
    """Hide a share of the returns behind a plate; a few returns come from the plate.

    Args:
        returns: The returns of the scan, of a scanner that looks along +z.
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
    returns: Returns, ratio: float, centre_a: Array, radius_m: float, rng: np.random.Generator
) -> Returns:
    """Add ``ratio`` times as many points, uniform over a ball about the target.

    Args:
        returns: The returns of the scan, of a scanner that looks along +z.
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


def kinds_with_strengths() -> str:
    """Return the kinds with their default strengths, as the help of ``record`` lists them."""
    words = []
    for name in FAULTS.names():
        strength = getattr(FAULTS.load(name).parameters(), "strength", None)
        words.append(name if strength is None else f"{name}:{strength:g}")
    return "  ".join(words)


def table() -> Iterator[str]:
    """Yield the lines of the table of the kinds in docs/scenario.md."""
    yield "| kind | strength (default; range) | harmful | what happens |"
    yield "|---|---|---|---|"
    for name in FAULTS.names():
        kind = cast("type[Fault]", FAULTS.load(name))
        strength = "–"  # noqa: RUF001 (a dash in a table)
        for each in fields(cast(type, kind.parameters)):
            declared = declared_of(each)
            strength = f"{declared.doc} ({each.default:g}; {declared.range})"
        harmful = "yes" if kind.harmful else "no"
        yield f"| `{name}` | {strength} | {harmful} | {kind.about} |"


if __name__ == "__main__":
    print("\n".join(table()))  # noqa: T201 (the table is the output)
