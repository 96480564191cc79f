"""What is known of a scan before its pose is judged: whether it can be registered at all, its noise
at a pose, and whether it shows a part of the target only.

Whether a pose is right is judged by :mod:`~avsreplay.register.evidence`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus
from avsreplay.register.backend import Target
from avsreplay.register.evidence import (
    MEASURED_OF_EXTENT,
    REGION_OF_EXTENT,
    TOO_FEW,
    Evidence,
    EvidenceModel,
    Observed,
    robust_noise,
)
from avsreplay.register.quality import not_measured
from avsreplay.register.sampling import sample_evenly
from avsreplay.register.size import size_error
from avsreplay.register.surface_index import kernel_module

SURFACE_POINTS = 1500
NOISE_OF_EXTENT = 0.012  # with more noise than this a pose is not registered to the whole scan
# a smaller scan is about as large as the rejection distance, and any face explains it
LEAST_SCAN_OF_EXTENT = 0.05
SIZED_POINTS = 200  # points of the scan that nearly always suffice to show that it is larger
# a pose whose surface is in the mean within so many gates of the predicted one agrees with it
PREDICTED = 1.0
# where a smaller share of the points is near, the noise at a predicted pose is theirs
MOST_HIDDEN = 0.5
# a scan narrower than so much of the model, in one of four directions of the image, shows a part of
# it
PARTIAL_IMAGE = 0.8
MOST_OTHER_SIZE = 0.1  # error of the size of the model with which a pose can be accepted
LEAST_COMPARED = 30  # with fewer points the noise is that of all


class PlausibilityTest:
    """Tests of whether a scan agrees with a pose of one model."""

    def __init__(self, target: Target) -> None:
        self._index, self._visibility, self._gate, self._extent = (
            target.index,
            target.visibility,
            target.limits.gate_m,
            target.surface.extent,
        )
        vertices = target.surface.vertices
        self._middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        self._points = np.ascontiguousarray(sample_evenly(target.surface, SURFACE_POINTS)[0])
        self._evidence = EvidenceModel(target)

    def refused(
        self, scan: NDArray[Any], points: int, guess: Pose | None = None
    ) -> Alignment | None:
        """Return the alignment of a scan that is not registered at all; None for others.

        Args:
            scan: (n, 3) finite points in {A} [m].
            points: of the scan, also those that are not finite.
            guess: T_ac.

        Returns:
            NO_POINTS; or IMPLAUSIBLE for a scan so much smaller than the model that any of its
            faces would explain it.
        """
        if len(scan) == 0:
            return not_measured(points, AlignStatus.NO_POINTS, guess)
        least = LEAST_SCAN_OF_EXTENT * self._extent
        if geometry.bounding_diagonal(scan[:: max(1, len(scan) // SIZED_POINTS)]) >= least:
            return None
        size = geometry.bounding_diagonal(scan)
        if size >= least:
            return None
        text = (
            f"the scan measures {size:.3g} m, the model {self._extent:.3g} m: is --model-unit"
            " right?"
        )
        return replace(not_measured(points, AlignStatus.IMPLAUSIBLE, guess), message=text)

    def around(self, scan: NDArray[Any], guess: Pose) -> NDArray[Any]:
        """Return the points of a scan (n, 3) in {A} around the model at a predicted T_ac; all where
        few are there.

        A wall, the ground or a neighbour are thereby left out, which could have nearly all points
        of a scan.
        """
        middle = guess.apply(self._middle[None])[0]
        away = np.asarray(scan, dtype=np.float64) - middle
        near = np.einsum("ij,ij->i", away, away) < (REGION_OF_EXTENT * self._extent) ** 2
        return scan if near.all() or np.count_nonzero(near) < LEAST_COMPARED else scan[near]

    def noise(self, distance: Array, T_ca: Pose, guess: Pose | None) -> float:
        """Return the robust noise [m] of distances (n,) [m] at a pose; of the smaller ones where
        most are not near.

        The latter only at the predicted pose ``guess``: elsewhere the points near the model may be
        so by chance.
        """
        near = distance[distance < MEASURED_OF_EXTENT * self._extent]
        few = LEAST_COMPARED <= len(near) < MOST_HIDDEN * len(distance)
        return robust_noise(near if few and self.predicted(T_ca, guess) else distance)

    def predicted(self, T_ca: Pose, guess: Pose | None) -> bool:
        """Return whether a pose T_ca agrees with the predicted T_ac ``guess``; False where
        the camera is not known.
        """
        if guess is None or not self._visibility.may_be_camera(T_ca):
            return False
        moved = T_ca.inverse().apply(self._points) - guess.apply(self._points)
        return float(np.linalg.norm(moved, axis=1).mean()) < PREDICTED * self._gate

    def partial(self, points: NDArray[Any], T_ca: Pose) -> bool:
        """Return whether the scan (n, 3) in {A} shows only a part of the target: it is narrower in
        some direction.

        Compared in the image, with the whole surface at the pose T_ca; False where the camera is
        not known.
        """
        if not self._visibility.may_be_camera(T_ca):
            return False
        return bool(kernel_module().is_narrower(points, T_ca.matrix, self._points, PARTIAL_IMAGE))

    def turned_away(self, points: NDArray[Any], T_ca: Pose) -> bool:
        """Return whether most points (n, 3) in {A} are on faces that face away from a camera at the
        origin.
        """
        return (
            self._visibility.may_be_camera(T_ca)
            and self._visibility.camera_c(self._index, points, T_ca) is None
        )

    def check(self, scan: Observed, T_ca: Pose) -> Evidence | None:
        """Return what the rays of a scan say of a pose; None with too few near the model."""
        return self._evidence.at(scan, T_ca)

    def judged(
        self, scan: Observed, T_ca: Pose, guess: Pose | None = None
    ) -> tuple[Evidence | None, str]:
        """Return what the rays of a scan say of a pose, None with too few near the model; and why
        it is not accepted, "" if it is, also with another size of the target.

        Args:
            scan: the scan.
            T_ca: the pose.
            guess: predicted T_ac. At a pose that agrees with it, hidden surface says nothing.
        """
        found = self.check(scan, T_ca)
        if found is None:
            return None, TOO_FEW
        reason = found.reason(self.predicted(T_ca, guess))
        return found, "" if reason and self._has_other_size(scan, T_ca) else reason

    def _has_other_size(self, scan: Observed, T_ca: Pose) -> bool:
        """Whether the pose is accepted with the size of the target that the scan shows."""
        points = self.around(scan.points, T_ca.inverse())
        camera_c = self._visibility.camera_c(self._index, points, T_ca)
        size = size_error(self._index, points, T_ca, camera_c)
        if size is None or not size.significant or abs(size.delta) > MOST_OTHER_SIZE:
            return False
        turn = Pose(geometry.exp(size.shift[:3]), size.shift[3:]).inverse() @ T_ca
        factor = 1.0 / (1.0 + size.delta)
        at = self.check(Observed(factor * scan.points), Pose(turn.q, factor * turn.t))
        return at is not None and not at.reason()

    def measure(self, points: NDArray[Any], T_ca: Pose) -> Array:
        """Return the distances (n,) [m] of points (n, 3) in {A} to the visible faces, at most the
        reach.
        """
        return self._visibility.distances(self._index, points, T_ca, np.inf)[0]
