"""Faults injected into recorded scans: those of ``simulate/faults.py`` with the same strengths.

Ranges are measured from the origin of the scans' frame. A noise burst multiplies the noise that
``range_noise`` estimates from the scan itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from avsreplay.records import NS_PER_S, Scan, ScanStatus
from avsreplay.simulate.faults import (
    Circumstances,
    InjectedFault,
    Shot,
    Stage,
    active,
    in_order_of_action,
)
from avsreplay.simulate.scanner import Returns

# For the estimate of the range noise.
_NOISE_NEIGHBOURS = 9
_NOISE_SAMPLES = 1000  # at most


@dataclass(slots=True)
class _Disturbance:
    """Faults on recorded scans, with what is carried from scan to scan."""

    faults: Sequence[InjectedFault]
    epoch_ns: int
    seed: int
    radius_m: float | None
    last: Scan | None = None
    seen: dict[int, int] = field(default_factory=dict)  # scans so far in the window of each fault

    def take(self, scan: Scan) -> Scan | None:
        """The scan with the faults that are active at its log time; None where it is dropped."""
        before = _returns(scan)
        shot = Shot(before)
        for number, fault in in_order_of_action(active(self.faults, self.epoch_ns, scan.log_ns)):
            place = self.seen.get(number, 0)
            self.seen[number] = place + 1
            if fault.stage is Stage.MESSAGE or len(scan.points):
                rng = self._rng(1, number, scan.seq)
                shot = fault.apply(shot, self._circumstances(scan, number, place), rng)
                shot = _with_noise(shot, rng)
        if not shot.written:
            return None
        changed = scan if shot.returns is before else _scan_of(shot.returns, scan)
        if shot.stamp_ns:
            changed = replace(changed, t_ns=changed.t_ns + shot.stamp_ns)
        if not shot.repeated:
            self.last = changed
        elif self.last is not None:
            last = self.last
            same = replace(changed, points=last.points, times_s=last.times_s, status=last.status)
            return replace(same, intensities=last.intensities)
        return changed

    def _circumstances(self, scan: Scan, number: int, place: int) -> Circumstances:
        return Circumstances(
            t_s=(scan.log_ns - self.epoch_ns) / NS_PER_S,
            place=place,
            window=lambda: self._rng(0, number, 0),
            along_z=False,
            radius_m=self.radius_m,
        )

    def _rng(self, purpose: int, number: int, seq: int) -> np.random.Generator:
        key = np.random.SeedSequence(self.seed, spawn_key=(5, purpose, number, seq))
        return np.random.Generator(np.random.PCG64(key))


def _with_noise(shot: Shot, rng: np.random.Generator) -> Shot:
    """The scan with the noise that its factor adds to the noise that it has."""
    if shot.noise == 1.0:
        return shot
    returns = shot.returns
    added = math.sqrt(max(shot.noise * shot.noise - 1.0, 0.0)) * range_noise(returns, rng)
    ranges = returns.ranges + added * rng.standard_normal(len(returns.ranges))
    return replace(shot, noise=1.0, returns=replace(returns, ranges=np.maximum(ranges, 0.0)))


def _scan_of(returns: Returns, scan: Scan) -> Scan:
    """The scan with other returns."""
    timed = scan.times_s is not None
    if timed:
        returns = returns.in_order()
    times = returns.times_s.astype(np.float32) if timed else None
    status = scan.status if len(returns.ranges) else ScanStatus.EMPTY
    seen = None if scan.intensities is None else returns.intensities.astype(np.float32)
    return replace(scan, points=returns.points, times_s=times, status=status, intensities=seen)


def disturbed(
    scans: Iterable[Scan],
    faults: Sequence[InjectedFault],
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
    if count <= _NOISE_NEIGHBOURS:
        return 0.0
    chosen = np.sort(rng.choice(count, min(_NOISE_SAMPLES, count), replace=False))
    from scipy.spatial import cKDTree  # takes 0.2 s to import

    _, near = cKDTree(known.directions).query(known.directions[chosen], _NOISE_NEIGHBOURS)
    ranges, directions = known.ranges[near], known.directions[near]
    inverse = (1.0 / ranges)[:, :, None]
    deviations = (
        (inverse - directions @ (np.linalg.pinv(directions) @ inverse))[:, :, 0] * ranges * ranges
    )
    return float(
        np.median(np.sqrt(np.sum(deviations * deviations, axis=1) / (_NOISE_NEIGHBOURS - 3)))
    )
