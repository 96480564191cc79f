"""Faults injected into recorded scans: those of a scenario, and three that a scenario sets in its
scanner.

=================  ===========================================  =======
======================================== kind               strength (default)
harmful  what happens =================  ===========================================  =======
======================================== outliers           share of the returns (0.2)
no       a range 0.5 to 1.5 times the median range subsampled         share of the points that is
removed (0.9)    no       fewer points, chosen at random frame_rate         n: every n-th scan is
kept (2)               no       fewer scans =================
===========================================  =======  ========================================

The other kinds are those of ``simulate/faults.py`` with the same strengths. Ranges are measured
from the origin of the scans' frame. A noise burst multiplies the noise that ``range_noise``
estimates from the scan itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.records import Label, Scan, ScanStatus
from avsreplay.simulate.faults import DEFAULTS, MOST_STRENGTH, NS, Kind, clutter, fits, occlude
from avsreplay.simulate.scanner import Returns

OUTLIER_RANGES = 0.5, 1.5  # limits of the range of an outlier, over the median range of the scan
_NEIGHBOURS, _NOISE_SAMPLES = 9, 1000  # neighbours and samples for the estimate of the range noise
# cosine to the mean direction of the points, below which a point is not in front of the scanner
_LEAST_AHEAD = 0.05


@value_class(eq=True)
class RecordedFault:
    """A fault for recorded scans: a kind over [start_s, start_s + duration_s) after the first scan.

    Attributes:
        kind: A kind of a scenario, or outliers, subsampled, frame_rate.
        start_s: Begin [s].
        duration_s: Length [s].
        strength: As in the table of the module.
    """

    kind: str
    start_s: float
    duration_s: float
    strength: float = 0.0

    @classmethod
    def parse(cls, text: str) -> RecordedFault:
        """Return the fault that ``kind:start:duration[:strength]`` describes.

        Args:
            text: kind, start and duration [s], and for some kinds the strength.

        Raises:
            ValueError: The text has another form, or a value is out of range.
        """
        kind, *rest = text.strip().split(":")
        if kind not in RECORDED_KINDS:
            raise ValueError(f"no fault '{kind}'; there are {', '.join(RECORDED_KINDS)}")
        try:
            numbers = [float(word) for word in rest]
        except ValueError:
            numbers = []
        if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
            raise ValueError(
                f"'{text}' is not kind:start:duration[:strength] with times in seconds"
            )
        if max(numbers[:2]) > MOST_STRENGTH:
            raise ValueError(f"'{text}': times of more than {MOST_STRENGTH:g} s")
        default = RECORDED_KINDS[kind][0]
        if numbers[0] < 0.0 or numbers[1] <= 0.0:
            raise ValueError(f"'{text}': the start must be at least 0 s and the duration positive")
        if len(numbers) == 3 and default is None:
            raise ValueError(f"a fault of kind '{kind}' has no strength")
        strength = numbers[2] if len(numbers) == 3 else default or 0.0
        if default is not None and not _fits_recorded(kind, strength):
            raise ValueError(f"strength {strength:g} is out of range for '{kind}'")
        return cls(kind, numbers[0], numbers[1], strength)

    def label(self, epoch_ns: int) -> Label:
        """The label of the fault; its window begins ``start_s`` after ``epoch_ns`` on the log
        clock.

        Args:
            epoch_ns: time of the first scan on the log clock [ns].
        """
        default, harmful = RECORDED_KINDS[self.kind]
        return Label(
            kind=self.kind,
            start_ns=epoch_ns + round(self.start_s * NS),
            end_ns=epoch_ns + round((self.start_s + self.duration_s) * NS),
            harmful=harmful,
            strength=None if default is None else self.strength,
        )


_RECORDED_ONLY: dict[str, tuple[float | None, bool]] = {
    "outliers": (0.2, False),
    "subsampled": (0.9, False),
    "frame_rate": (2.0, False),
}
RECORDED_KINDS = {kind.value: default for kind, default in DEFAULTS.items()} | _RECORDED_ONLY
"""Kinds of fault for recorded scans: default strength (None: the kind has none), and whether it is
harmful.
"""


def _fits_recorded(kind: str, value: float) -> bool:
    if kind in ("outliers", "subsampled"):
        return 0.0 < value < 1.0
    if kind == "frame_rate":
        return value >= 2.0 and value.is_integer()
    return fits(Kind(kind), value)


@dataclass(slots=True)
class _Disturbance:
    """Faults on recorded scans, with what is carried from scan to scan."""

    faults: Sequence[RecordedFault]
    epoch_ns: int
    seed: int
    radius_m: float | None
    last: Scan | None = None
    seen: dict[int, int] = field(default_factory=dict)  # scans so far in the window of each fault

    def take(self, scan: Scan) -> Scan | None:
        """The scan with the faults that are active at its log time; None where it is dropped."""
        now = {k: fault for k, fault in enumerate(self.faults) if self._active(fault, scan.log_ns)}
        kinds = {fault.kind for fault in now.values()}
        places = {k: self.seen.get(k, 0) for k in now}
        self.seen.update({k: place + 1 for k, place in places.items()})
        thinned = any(
            f.kind == "frame_rate" and places[k] % round(f.strength) for k, f in now.items()
        )
        if "dropped" in kinds or thinned:
            return None
        changed = self._points(scan, now)
        for fault in now.values():
            if fault.kind == "stamp_jump":
                changed = replace(changed, t_ns=changed.t_ns + round(fault.strength * NS))
        if "frozen" in kinds and self.last is not None:
            last = self.last
            same = replace(changed, points=last.points, times_s=last.times_s, status=last.status)
            return replace(same, intensities=last.intensities)
        if "frozen" not in kinds:
            self.last = changed
        return changed

    def _active(self, fault: RecordedFault, log_ns: int) -> bool:
        window = fault.label(self.epoch_ns)
        return window.start_ns <= log_ns < window.end_ns

    def _points(self, scan: Scan, now: dict[int, RecordedFault]) -> Scan:
        """The scan with its points changed; unchanged, bit for bit, where no fault changes
        points.
        """
        changing = [(k, fault) for k, fault in now.items() if fault.kind in _ON_POINTS]
        if not changing or not len(scan.points):
            return scan
        returns, timed = _returns(scan), scan.times_s is not None
        for k, fault in sorted(changing, key=lambda item: _ON_POINTS.index(item[1].kind)):
            returns = self._applied(returns, fault, k, scan.seq)
        if timed:
            returns = returns.in_order()
        times = returns.times_s.astype(np.float32) if timed else None
        status = scan.status if len(returns.ranges) else ScanStatus.EMPTY
        seen = None if scan.intensities is None else returns.intensities.astype(np.float32)
        return replace(scan, points=returns.points, times_s=times, status=status, intensities=seen)

    def _applied(self, returns: Returns, fault: RecordedFault, number: int, seq: int) -> Returns:
        """One fault; each fault and scan has a random stream of its own."""
        rng, n, strength = self._rng(1, number, seq), len(returns.ranges), fault.strength
        match fault.kind:
            case "occlusion" | "partial_occlusion":
                side = float(self._rng(0, number, 0).uniform(0.0, 2.0 * math.pi))
                return _occlude_ahead(returns, strength, side, rng)
            case "noise_burst":
                added = math.sqrt(max(strength * strength - 1.0, 0.0)) * range_noise(returns, rng)
                return replace(
                    returns, ranges=np.maximum(returns.ranges + added * rng.standard_normal(n), 0.0)
                )
            case "outliers":
                wrong, median = (
                    rng.random(n) < strength,
                    float(np.median(returns.ranges)) if n else 0.0,
                )
                return replace(
                    returns,
                    ranges=np.where(
                        wrong, median * rng.uniform(*OUTLIER_RANGES, n), returns.ranges
                    ),
                )
            case "subsampled":
                return returns.keep(rng.random(n) >= strength)
            case "range_bias":
                return replace(returns, ranges=np.maximum(returns.ranges + strength, 0.0))
            case "clutter":
                return _clutter_around(returns, strength, self.radius_m, rng)
        return returns.keep(np.zeros(n, dtype=bool))  # empty

    def _rng(self, purpose: int, number: int, seq: int) -> np.random.Generator:
        key = np.random.SeedSequence(self.seed, spawn_key=(5, purpose, number, seq))
        return np.random.Generator(np.random.PCG64(key))


# In the order in which they act, as in a simulation.
_ON_POINTS = (
    *(
        "occlusion",
        "partial_occlusion",
        "noise_burst",
        "outliers",
        "subsampled",
        "range_bias",
        "clutter",
        "empty",
    ),
)


def disturbed(
    scans: Iterable[Scan],
    faults: Sequence[RecordedFault],
    epoch_ns: int,
    seed: int,
    radius_m: float | None,
) -> Iterator[tuple[Scan, Scan | None]]:
    """Inject faults into scans.

    Ranges are measured from the origin of the scans' frame, as a scanner at this origin measures
    them. Each fault and scan has a random stream of its own, so that a further fault does not
    change others.

    Args:
        scans: Recorded scans.
        faults: The faults.
        epoch_ns: Log time of the first scan, from which the windows are counted [ns].
        seed: Seed of all random numbers.
        radius_m: Radius of the target for clutter [m]; None: from the points.

    Yields:
        Each scan as it was, and with the faults; None where a fault removes it.
    """
    disturbance = _Disturbance(faults, epoch_ns, seed, radius_m)
    for scan in scans:
        yield scan, disturbance.take(scan)


def _returns(scan: Scan) -> Returns:
    points = np.asarray(scan.points, dtype=np.float64)
    ranges = np.sqrt(np.sum(points * points, axis=1))
    directions = points / np.where(ranges > 0.0, ranges, 1.0)[:, None]
    times = (
        np.zeros(len(points))
        if scan.times_s is None
        else np.asarray(scan.times_s, dtype=np.float64)
    )
    one, zero = np.ones(len(points)), np.zeros(len(points))
    seen = one if scan.intensities is None else np.asarray(scan.intensities, dtype=np.float64)
    return Returns(directions, ranges, times, one, seen, zero)


def _view(directions: Array) -> Array:
    """Rotation (3, 3) from the frame of the scan to one whose +z axis is the mean direction of the
    points.
    """
    mean = directions.mean(axis=0)
    z = mean / np.sqrt(mean @ mean) if mean @ mean > 0.0 else np.array([0.0, 0.0, 1.0])
    aside = np.eye(3)[int(np.argmin(np.abs(z)))]
    y = np.cross(z, aside)
    y /= np.sqrt(y @ y)
    return np.stack([np.cross(y, z), y, z])


def _occlude_ahead(
    returns: Returns, covered: float, side_rad: float, rng: np.random.Generator
) -> Returns:
    """``occlude`` for a scanner that looks along the mean direction of its points."""
    if not len(returns.ranges):
        return returns
    turn = _view(returns.directions)
    seen = replace(returns, directions=returns.directions @ turn.T)
    ahead = seen.directions[:, 2] > _LEAST_AHEAD
    hidden = occlude(seen.keep(ahead), covered, side_rad, rng).joined(seen.keep(~ahead))
    return replace(hidden, directions=hidden.directions @ turn)


def _clutter_around(
    returns: Returns, ratio: float, radius_m: float | None, rng: np.random.Generator
) -> Returns:
    """``clutter`` about the median point; without a radius it is the 90 % quantile of the
    distances from it.
    """
    if not len(returns.ranges):
        return returns
    points = returns.directions * returns.ranges[:, None]
    centre = np.median(points, axis=0)
    if radius_m is None:
        radius_m = float(np.quantile(np.sqrt(np.sum((points - centre) ** 2, axis=1)), 0.9))
    turn = _view(returns.directions)
    added = clutter(
        replace(returns, directions=returns.directions @ turn.T),
        ratio,
        turn @ centre,
        radius_m,
        rng,
    )
    return replace(added, directions=added.directions @ turn)


def range_noise(returns: Returns, rng: np.random.Generator) -> float:
    """Estimate the noise of the ranges from returns with neighbouring directions.

    The inverse range of a plane is linear in the direction, n . d = 1 / r. The deviations from the
    linear fit to nine neighbours are noise where the surface is flat among them.

    Args:
        returns: The returns of a scan.
        rng: Chooses the returns at which the noise is estimated.

    Returns:
        Standard deviation of the range [m]: the median over up to 1000 returns; 0 for fewer than
        ten returns.
    """
    known = returns.keep(returns.ranges > 0.0)
    count = len(known.ranges)
    if count <= _NEIGHBOURS:
        return 0.0
    chosen = np.sort(rng.choice(count, min(_NOISE_SAMPLES, count), replace=False))
    from scipy.spatial import cKDTree  # takes 0.2 s to import

    _, near = cKDTree(known.directions).query(known.directions[chosen], _NEIGHBOURS)
    ranges, directions = known.ranges[near], known.directions[near]
    inverse = (1.0 / ranges)[:, :, None]
    deviations = (
        (inverse - directions @ (np.linalg.pinv(directions) @ inverse))[:, :, 0] * ranges * ranges
    )
    return float(np.median(np.sqrt(np.sum(deviations * deviations, axis=1) / (_NEIGHBOURS - 3))))
