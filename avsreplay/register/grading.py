"""Registration of a scan from one pose, and the quality of the result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Pose
from avsreplay.records import Alignment, AlignStatus
from avsreplay.register import quality
from avsreplay.register.backend import Backend, HornBackend, Target, aligned
from avsreplay.register.hypotheses import Case
from avsreplay.register.params import RegisterParams
from avsreplay.register.screening import Screen
from avsreplay.register.work import LEAST_RATIO, TEST_WORK, alignment_work, grade_work

# a result rotated by more from its guess is verified by the global search
FAR_RAD = np.radians(30.0)
# with at least LEAST_RATIO of inliers and a smaller rms (in units of the gate) a fit is close
POOR_OF_GATE = 0.3


class Grader:
    """One back end with the quality of its poses."""

    def __init__(
        self, target: Target, params: RegisterParams, backend: Backend, screen: Screen
    ) -> None:
        self._target, self._params, self._backend = target, params, backend
        self._screen = screen
        self._accuracy: tuple[float, float] = backend.accuracy
        self._closest = isinstance(backend, HornBackend)

    def graded(
        self, case: Case, guess: Pose, width_m: float | None, rough: bool = False
    ) -> tuple[Alignment, int]:
        """Register a scan and measure the quality of the pose; also return the work.

        A close fit that is not at a minimum before the last pass that is allowed is registered once
        more from there.

        Args:
            case: the scan.
            guess: T_ac to begin with.
            width_m: rejection distance from the first pass on, and of inliers [m]; None: that of
                the back end.
            rough: a part of the scan suffices where it shows that the fit is not close; it is then
                not converged.
        """
        start = T_ca = guess.inverse()
        index, limits, scan = self._target.index, self._target.limits, case.points
        limits = limits if width_m is None else replace(limits, gate_m=width_m)
        spent, left = 0, case.work.left
        for last in (False, True):
            most = max(1, left - spent - grade_work(len(scan), noisy=True) - TEST_WORK)
            rule = (width_m, most, rough and not last)
            fit = aligned(self._params.backend, self._backend, scan, T_ca, *rule)
            if isinstance(fit, str):
                none = quality.not_measured(len(scan), AlignStatus.FAILED, guess)
                return replace(none, message=fit), spent
            of, full = self._screen.part(scan) if fit.rough else scan, not fit.rough
            options = (
                self._params,
                case.halves and full,
                self._accuracy,
                full and not case.carried,
                start,
            )
            found = quality.grade(
                index, self._target.visibility, of, fit, limits, *options, full and self._closest
            )
            if fit.rough:
                found = replace(
                    found, points=len(scan), inliers=found.inliers * len(scan) // len(of)
                )
            noisy = full and self._closest and found.rms_m > quality.SMALL_NOISE * index.extent_m
            spent += alignment_work(fit, found, len(of), noisy)
            ended = last or fit.iterations >= limits.n_max or left - spent < case.work.healthy
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
        return found, spent

    def close(self, found: Alignment) -> bool:
        """Return whether an alignment is a close fit of nearly all points."""
        near = found.rms_m <= POOR_OF_GATE * self._target.limits.gate_m
        return found.inlier_ratio >= LEAST_RATIO and near

    def _worth_more(self, guess: Pose, found: Alignment) -> bool:
        """Whether the fit is close, and its pose need not be verified by a search anyway."""
        turned = float(geometry.angle_between(guess.q, found.T_ac.q))
        return turned <= FAR_RAD and self.close(found)
