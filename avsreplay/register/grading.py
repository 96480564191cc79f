"""Registration of a scan from one guess, and the quality of the pose, within the budget of the
scan.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Pose
from avsreplay.records import Alignment, AlignStatus
from avsreplay.register import quality
from avsreplay.register.backend import Backend, HornBackend, Target, aligned
from avsreplay.register.budget import Budget
from avsreplay.register.params import RegisterParams
from avsreplay.register.restarts import Restarter

FAR_RAD = np.radians(
    30.0
)  # a result rotated by more from its guess is verified by the global search


class Grader:
    """One back end with the quality of its poses."""

    def __init__(
        self, target: Target, params: RegisterParams, backend: Backend, restarter: Restarter
    ) -> None:
        self._target, self._params, self._backend, self._restarter = (
            target,
            params,
            backend,
            restarter,
        )
        self._accuracy: tuple[float, float] = backend.accuracy
        self._closest = isinstance(backend, HornBackend)

    def graded(
        self,
        scan: NDArray[Any],
        guess: Pose,
        budget: Budget,
        width_m: float | None,
        halves: bool,
        carried: bool,
        rough: bool = False,
    ) -> Alignment:
        """Register a scan and measure the quality of the pose.

        A close fit that is not at a minimum before the last pass that is allowed is registered once
        more from there.

        Args:
            scan: (n, 3) finite, in {A} [m].
            guess: T_ac.
            budget: work that is left.
            width_m: rejection distance from the first pass on, and of inliers [m]; None: that of
                the back end.
            halves: two halves of the scan are compared.
            carried: as of ``Registrar.register``.
            rough: a part of the scan suffices where it shows that the fit is not close; it is then
                not converged.
        """
        start = T_ca = guess.inverse()
        index, limits = self._target.index, self._target.limits
        limits = limits if width_m is None else replace(limits, gate_m=width_m)
        for last in (False, True):
            rule = (width_m, budget.for_alignment(len(scan)), rough and not last)
            fit = aligned(self._params.backend, self._backend, scan, T_ca, *rule)
            if isinstance(fit, str):
                return replace(
                    quality.not_measured(len(scan), AlignStatus.FAILED, guess), message=fit
                )
            of, full = self._restarter.part(scan) if fit.rough else scan, not fit.rough
            options = (self._params, halves and full, self._accuracy, full and not carried, start)
            found = quality.grade(
                index, self._target.visibility, of, fit, limits, *options, full and self._closest
            )
            if fit.rough:
                found = replace(
                    found, points=len(scan), inliers=found.inliers * len(scan) // len(of)
                )
            noisy = full and self._closest and found.rms_m > quality.SMALL_NOISE * index.extent_m
            budget.registered(fit, found, len(of), noisy)
            ended = last or fit.iterations >= limits.n_max or budget.left < budget.healthy
            if (
                ended
                or found.status is not AlignStatus.NOT_CONVERGED
                or not self._worth_more(guess, found)
            ):
                break
            T_ca = fit.T_ca
        if found.status is AlignStatus.FAILED:
            found = replace(
                found, T_ac=guess, message=f"back end '{self._params.backend}' {found.message}"
            )
        return found

    def _worth_more(self, guess: Pose, found: Alignment) -> bool:
        """Whether the fit is close, and its pose need not be verified by a search anyway."""
        turned = float(geometry.angle_between(guess.q, found.T_ac.q))
        return turned <= FAR_RAD and self._restarter.healthy(found.inlier_ratio, found.rms_m)
