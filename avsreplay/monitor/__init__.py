"""Monitors of a replay: fault detection and the observability Gramian; consistency and convergence in ``convergence``.

Fault rule (section 6 of the equations): gamma for each scan, and why it is 0. The pose test is
|alpha|_W = sqrt(|d rho|^2 + (L theta)^2) against a limit. While the filter tracks, the limit is ``alpha_max_m``. Where
the prediction is uncertain (at the start, after a blackout) it is ``sigmas`` times the predicted 1 sigma of the same
norm, sqrt(tr S_rho + (2 L)^2 tr S_half). The first healthy scan is thus accepted.

Observability (eq after [eq:S_recursive]): W_o = sum of (H Phi)' (H Phi). Its triangular root is stored,
[root; H Phi] re-triangularised: the condition number of W_o is the square of the root's, so values up to 10^30 are
resolved; from the sum itself, up to 10^16. Scaled by the prior standard deviations it has no units. The rank is
relative to the measurement noise: it counts the directions about which the poses, weighted by R^-1, give more
information than the prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array, frozen
from avsreplay.monitor import _root
from avsreplay.records import BLOCKS, Alignment, AlignStatus, Belief, Innovation, Reason, ScanStatus, Verdict
from avsreplay.settings import Settings, setting

_WORDS: Mapping[str, str] = {
    "attitude": "attitude of the principal axes",
    "rate": "angular rate",
    "position": "centre of mass",
    "velocity": "velocity of the centre of mass",
    "sigma": "inertia ratios",
    "varrho": "fixture position in the body",
    "mu": "misalignment of the fixture",
}


@value_class
class Gramian:
    """The Gramian so far.

    Attributes:
        root: (n, n) upper triangular with W_o = root' root.  white: (n, n) the same root with rows weighted by R^-1/2.
        Phi_k0: (n, n) transition from the first scan to the last.  scale: (n,) prior 1 sigma.
    """

    root: Array
    white: Array
    Phi_k0: Array
    scale: Array


@value_class(eq=True)
class Observability:
    """The Gramian in numbers.

    Attributes:
        rank: directions that the poses determine better than the prior.  size: number of states.
        log10_cond, log10_cond_scaled: log10 of the condition number of W_o, None below full rank.
    """

    rank: int
    size: int
    log10_cond: float | None
    log10_cond_scaled: float | None


def gramian(prior_1s: Array) -> Gramian:
    """Return the Gramian before the first scan.

    Args:
        prior_1s: (n,) prior standard deviations in the states' units.

    Raises:
        ValueError: one of them is not positive and finite.
    """
    scale = frozen(prior_1s, -1)
    if not np.all(np.isfinite(scale)) or np.any(scale <= 0.0):
        raise ValueError("prior standard deviations must be positive and finite")
    zero = np.zeros((scale.size, scale.size))
    return Gramian(zero, zero, np.eye(scale.size), scale)


def observe(state: Gramian, Phi: Array, H: Array, R: Array | None, from_first: bool = False) -> Gramian:
    """Return the Gramian after one more scan: Phi_k0 = Phi Phi_k-1,0, and H Phi_k0 is added for a healthy scan.

    Args:
        state: the Gramian so far.
        Phi: (n, n) transition from the last scan.
        H: (m, n) measurement Jacobian.
        R: (m, m) measurement noise, None for a faulty scan.
        from_first: ``Phi`` begins at the first scan instead of the last one.
    """
    Phi_k0 = Phi if from_first else Phi @ state.Phi_k0
    if R is None:
        return Gramian(state.root, state.white, Phi_k0, state.scale)
    return _added(state, (H @ Phi_k0)[None], R[None], Phi_k0)


def from_trajectory(scale: Array, rows: Array, R: Array, Phi_k0: Array) -> Gramian:
    """Return the Gramian of many healthy scans along one trajectory.

    Args:
        scale: (n,) prior standard deviations.
        rows: (k, m, n) H Phi from the first scan.
        R: (k, m, m) measurement noise.
        Phi_k0: (n, n) transition from the first scan to the last.
    """
    return _added(gramian(scale), rows, R, Phi_k0)


def _added(state: Gramian, rows: Array, R: Array, Phi_k0: Array) -> Gramian:
    root, whitened = _root.extended(state.root, state.white, rows, R)
    return Gramian(root, whitened, Phi_k0, state.scale)


def measure(state: Gramian) -> Observability:
    """Return the rank and the condition numbers."""
    n = state.scale.size
    told = np.linalg.svd(state.white * state.scale, compute_uv=False)
    if (rank := int(np.count_nonzero(told > 1.0))) < n:
        return Observability(rank, n, None, None)
    raw, scaled = np.linalg.svd(np.array([state.root, state.root * state.scale]), compute_uv=False)
    return Observability(rank, n, _log10_cond(raw), _log10_cond(scaled))


def _log10_cond(singular: NDArray[Any]) -> float | None:
    return 2.0 * math.log10(singular[0] / singular[-1]) if singular[-1] > 0.0 else None


def unobserved(state: Gramian, blocks: Mapping[str, slice] = BLOCKS) -> tuple[str, ...]:
    """Return in words the directions about which the poses give less information than the prior, each once.

    Args:
        state: the Gramian.
        blocks: names of the states.

    Returns:
        One text for each of the ``size - rank`` directions of ``measure``.
    """
    told, directions = _directions(state)
    return _in_words(directions[told <= 1.0], blocks)


def weakest(state: Gramian, count: int = 3, blocks: Mapping[str, slice] = BLOCKS) -> tuple[str, ...]:
    """Return in words the directions with the least information among those that the poses do determine, each once.

    Args:
        state: the Gramian.
        count: number of directions.
        blocks: names of the states.
    """
    told, directions = _directions(state)
    return _in_words(directions[told > 1.0][::-1][:count], blocks)


def _directions(state: Gramian) -> tuple[Array, Array]:
    """Singular values (n,) of the whitened and scaled root, largest first, and its directions (n, n) as rows."""
    _, told, rows = np.linalg.svd(state.white * state.scale)
    return told, rows


def _in_words(directions: Array, blocks: Mapping[str, slice]) -> tuple[str, ...]:
    """A text for each of k orthonormal directions (k, n): its states, each with its block and axis.

    The directions are replaced by others that span the same space and each of which alone contains one of k states,
    because the axes within a space of equal information are arbitrary.
    """
    if not len(directions):
        return ()
    own, rest = list[int](), directions.copy()
    for _ in directions:  # QR decomposition with column pivoting
        own.append(int(np.argmax(np.sum(rest**2, axis=0))))
        q = rest[:, own[-1]] / np.linalg.norm(rest[:, own[-1]])
        rest -= np.outer(q, q @ rest)
    own.sort()
    basis = np.linalg.solve(directions[:, own], directions)
    shares = basis**2 / np.sum(basis**2, axis=1, keepdims=True)
    return tuple(_text_of(share, state, blocks) for share, state in zip(shares, own, strict=True))


def _text_of(share: Array, own: int, blocks: Mapping[str, slice]) -> str:
    """The state ``own`` and those with at least a tenth of a direction, by block, with shares unless one is all."""
    place = {i: (name, i - where.start) for name, where in blocks.items() for i in range(where.start, where.stop)}
    named = sorted({own, *map(int, np.flatnonzero(share >= 0.1))}, key=lambda i: (i != own, -share[i], i))
    together = dict.fromkeys(place[i][0] for i in named)
    texts = []
    for name in together:
        axes = ", ".join(
            "123"[place[i][1]] if name == "sigma" else "xyz"[place[i][1]] for i in named if place[i][0] == name
        )
        held = float(np.sum(share[blocks[name]]))
        texts.append(f"{_WORDS.get(name, name)} {axes}" + ("" if len(together) == 1 else f" ({held:.0%})"))
    return " with ".join(texts)


class Policy(Enum):
    """How the fit test and the pose test are combined."""

    ANY = "any"  # either one is a fault
    ALL = "all"  # as printed: a fault only where both fail


@dataclass(frozen=True, slots=True)
class FaultParams(Settings):
    """Limits of fault detection."""

    policy: Policy = setting(
        Policy.ANY,
        "How the fit test and the pose test are joined: a scan is faulty if either fails (any), or only if both"
        " fail, as printed in the paper (all).",
    )
    rms_max_m: float | None = setting(
        None,
        "Rms distance of the inliers from the model from which a scan is faulty. A larger value accepts worse"
        " registrations.",
        unit="m",
        above=0.0,
        of_extent=0.01,
    )
    alpha_max_m: float | None = setting(
        None,
        "Innovation of the pose, in the weighted norm, from which a scan is faulty. A larger value accepts"
        " larger deviations from the prediction.",
        unit="m",
        above=0.0,
        of_extent=0.02,
    )
    length_m: float | None = setting(
        None,
        "Characteristic length that converts an angle to a length in the weighted norm. A larger value gives errors"
        " of attitude more weight.",
        unit="m",
        above=0.0,
        of_extent=0.25,
    )
    sigmas: float = setting(
        4.0,
        "The limit on the innovation is never below this multiple of its predicted 1 sigma. A larger value"
        " accepts more poses after a blackout.",
        above=0.0,
    )
    min_inliers: int = setting(
        50,
        "Smallest number of inliers of a healthy scan. A larger value rejects more scans of small or distant targets.",
        low=0,
    )
    split_nis_max: float = setting(
        60.0,
        "A scan is faulty if the normalised squared difference of the poses from its two halves is above this value.",
        above=0.0,
    )
    min_inlier_ratio: float = setting(
        0.3,
        "Smallest ratio of inliers to points of a healthy scan. A larger value rejects more scans with background"
        " or clutter.",
        low=0.0,
        high=1.0,
    )


def weighted_norm(seen: Innovation, length_m: float) -> float:
    """|alpha|_W [m]: the printed W = diag(I, L I) on metres and the full rotation angle."""
    return math.hypot(seen.distance_m, length_m * seen.angle_rad)


def pose_limit(seen: Innovation, alpha_max_m: float, length_m: float, sigmas: float) -> float:
    """The limit on |alpha|_W [m]: ``alpha_max_m``, or ``sigmas`` predicted 1 sigma where that is more."""
    variances = np.diagonal(seen.S)
    predicted = math.sqrt(float(variances[:3].sum()) + (2.0 * length_m) ** 2 * float(variances[3:].sum()))
    return max(alpha_max_m, sigmas * predicted)


class FaultDetector:
    """Decides on one scan at a time, without state.

    Args:
        params: limits; those left out are taken from ``extent_m``, the target's bounding diagonal [m].
    """

    def __init__(self, params: FaultParams, extent_m: float) -> None:
        self.params = params.resolved(extent_m)
        p = self.params
        self._rms, self._alpha, self._length = (float(v or 0.0) for v in (p.rms_max_m, p.alpha_max_m, p.length_m))

    def judge(
        self, scan_status: ScanStatus, alignment: Alignment | None, innovation: Innovation | None, prior: Belief
    ) -> Verdict:
        """Gamma and the first reason that holds, in ``Reason``'s order."""
        reason = self._unusable(scan_status, alignment, innovation, prior)
        if reason is None and alignment is not None and innovation is not None:
            reason = self._doubtful(alignment, innovation)
        if reason is None and scan_status is ScanStatus.CLOCK:
            reason = Reason.CLOCK
        return Verdict(1, Reason.OK) if reason is None else Verdict(0, reason)

    def _unusable(
        self, status: ScanStatus, alignment: Alignment | None, seen: Innovation | None, prior: Belief
    ) -> Reason | None:
        """Return why the scan has no pose that can be tested, whatever the policy; None if it has one."""
        if status in (ScanStatus.EMPTY, ScanStatus.DAMAGED) or (
            alignment and alignment.status is AlignStatus.NO_POINTS
        ):
            return Reason.NO_SCAN
        lost = alignment is None or not alignment.measured or alignment.status is AlignStatus.AMBIGUOUS
        if lost or seen is None or not np.isfinite(seen.nis):
            return Reason.NOT_ALIGNED
        return None if np.all(np.isfinite(prior.P)) else Reason.NOT_ALIGNED

    def _doubtful(self, alignment: Alignment, seen: Innovation) -> Reason | None:
        p = self.params
        poor_fit = not alignment.rms_m < self._rms
        jump = weighted_norm(seen, self._length) >= pose_limit(seen, self._alpha, self._length, p.sigmas)
        if alignment.status is AlignStatus.MEASURED:  # nothing was fitted: the pose test alone decides
            return Reason.POSE_JUMP if jump else None
        if p.policy is Policy.ALL:
            return Reason.FIT_ERROR if poor_fit and jump else None
        if not alignment.converged or alignment.status is AlignStatus.NOT_CONVERGED:
            return Reason.NOT_CONVERGED
        if alignment.inliers < p.min_inliers or alignment.inlier_ratio < p.min_inlier_ratio:
            return Reason.FEW_INLIERS
        if poor_fit:
            return Reason.FIT_ERROR
        if (alignment.split_nis or 0.0) > p.split_nis_max:
            return Reason.HALVES_DIFFER
        return Reason.POSE_JUMP if jump else None
