"""Poses as the measurement: the log holds poses of a tracker (markers, motion capture), and nothing is registered.

The pipeline takes the pose of such a scan as its alignment. The entry point exists so that ``--backend poses`` is
chosen and listed like the other back ends.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import MeasuredPose, Pose, frozen
from avsreplay.records import Alignment, AlignStatus, Fit
from avsreplay.register.backend import Target

POSES = "poses"


def measured_alignment(found: MeasuredPose) -> Alignment:
    """Return a measured pose as an alignment: no points, and no fit whose quality could be graded.

    Args:
        found: the pose. Where it has no covariance, the estimator uses its R0.
    """
    C = found.covariance
    info = frozen(np.zeros((6, 6)) if C is None else np.linalg.inv(C))
    return Alignment(found.T_ac, 0, True, 0, 0, 0.0, info, AlignStatus.MEASURED, C)


class PoseBackend:
    """The entry of ``poses`` in the list of back ends; it cannot align clouds."""

    name = POSES
    same_bytes = True
    about = "no registration: the log holds measured poses of a tracker (pose topic, TUM, CSV)"

    def __init__(self, target: Target) -> None:
        """Take the target like every back end; it is not used."""

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:  # noqa: ARG002 (the protocol names them)
        """Refuse a cloud; it becomes the status FAILED of the scan.

        Args:
            points: (n, 3) in {A} [m].
            guess: initial T_ca.

        Raises:
            ValueError: always.
        """
        raise ValueError(f"the back end '{self.name}' takes the poses of the log and cannot align clouds")
