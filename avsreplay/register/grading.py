"""Registration of a scan from one pose, and the quality of the result.

Hypotheses are registered by the program's own method, whatever the back end is: most of them are
wrong, and a library can need hundreds of times its usual work to find no fit. The back end
registers the guess where few points confirm it, and the pose that the decision would accept.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Pose
from avsreplay.records import Alignment, AlignStatus, Fit
from avsreplay.register import quality
from avsreplay.register.backend import Backend, HornBackend, Target, aligned
from avsreplay.register.hypotheses import Case
from avsreplay.register.params import RegisterParams, RegistrationLimits
from avsreplay.register.quality import LEAST_RATIO
from avsreplay.register.screening import Screen

# a result rotated by more from its guess is verified by the global search
FAR_RAD = np.radians(30.0)
# with at least LEAST_RATIO of inliers and a smaller rms (in units of the gate) a fit is close
POOR_OF_GATE = 0.3


class Grader:
    """One back end with the quality of its poses.

    Attributes:
        own: the program's own method, ``horn``; the back end itself if it is that.
        foreign: the back end is another one.
    """

    def __init__(
        self, target: Target, params: RegisterParams, backend: Backend, screen: Screen
    ) -> None:
        self._target, self._params, self._backend = target, params, backend
        self._screen = screen
        self.own = backend if isinstance(backend, HornBackend) else HornBackend(target)
        self.foreign = self.own is not backend

    def graded(
        self,
        case: Case,
        guess: Pose,
        width_m: float | None = None,
        by_backend: bool = False,
        rough: bool = False,
    ) -> Alignment:
        """Register a scan and measure the quality of the pose.

        A close fit that is not at a minimum before the last pass that is allowed is registered once
        more from there.

        Args:
            case: the scan.
            guess: T_ac to begin with.
            width_m: rejection distance from the first pass on, and of inliers [m], for the own
                method; None: the usual ones.
            by_backend: by the back end, not by the own method.
            rough: a part of the scan suffices where it shows that the fit is not close; it is then
                not converged.
        """
        start = T_ca = guess.inverse()
        limits, scan = self._target.limits, case.points
        limits = limits if width_m is None else replace(limits, gate_m=width_m)
        used = self._backend if by_backend else self.own
        name = self._params.backend if by_backend else used.name
        closest = used is self.own
        for last in (False, True):
            align = used.align_roughly if rough and not last else used.align
            if width_m is not None:
                align = partial(self.own.align_within, gate_m=width_m, near=True)
            fit = aligned(name, partial(align, scan, T_ca))
            if isinstance(fit, str):
                none = quality.not_measured(len(scan), AlignStatus.FAILED, guess)
                return replace(none, message=fit)
            found = self._measured(case, fit, limits, used.accuracy, start, closest)
            ended = last or fit.iterations >= limits.n_max
            open_end = found.status is AlignStatus.NOT_CONVERGED and self._worth_more(guess, found)
            if ended or not open_end:
                break
            T_ca = fit.T_ca
        if found.status is AlignStatus.FAILED:
            found = replace(found, T_ac=guess, message=f"back end '{name}' {found.message}")
        return found

    def _measured(
        self,
        case: Case,
        fit: Fit,
        limits: RegistrationLimits,
        accuracy: tuple[float, float],
        start: Pose,
        closest: bool,
    ) -> Alignment:
        """Measure the quality of a fit, of a rough one by a part of the scan."""
        scan, full = case.points, not fit.rough
        of = scan if full else self._screen.part(scan)
        found = quality.grade(
            self._target.index,
            self._target.visibility,
            of,
            fit,
            limits,
            self._params,
            halves=case.halves and full,
            accuracy=accuracy,
            systematic=full and not case.carried,
            guess=start,
            simulated=full and closest,
        )
        if full:
            return found
        inliers = found.inliers * len(scan) // len(of)
        return replace(found, points=len(scan), inliers=inliers)

    def close(self, found: Alignment) -> bool:
        """Return whether an alignment is a close fit of nearly all points."""
        near = found.rms_m <= POOR_OF_GATE * self._target.limits.gate_m
        return found.inlier_ratio >= LEAST_RATIO and near

    def _worth_more(self, guess: Pose, found: Alignment) -> bool:
        """Whether the fit is close, and its pose need not be verified by a search anyway."""
        turned = float(geometry.angle_between(guess.q, found.T_ac.q))
        return turned <= FAR_RAD and self.close(found)
