"""The decision on a registered pose: aligned, ambiguous with its members, degenerate with its
directions, or implausible by the term of the evidence that excludes it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.geometry import Pose
from avsreplay.records import Alignment, AlignStatus
from avsreplay.register import quality
from avsreplay.register.backend import Target
from avsreplay.register.degenerate import turn_words
from avsreplay.register.hypotheses import Candidate, Case
from avsreplay.register.near_symmetry import NearSymmetry
from avsreplay.register.params import AcquireParams
from avsreplay.register.plausibility import PlausibilityTest
from avsreplay.register.poses import Sameness
from avsreplay.register.quality import LEAST_RATIO
from avsreplay.register.screening import Screen
from avsreplay.register.size import SIZE_UNSEEN, size_error, size_remark

ACCEPTED = (AlignStatus.ALIGNED, AlignStatus.DEGENERATE)
SEVERAL = "the scan shows a part of the target, and another pose near this one explains it as well"
PART_ONLY = (
    "the scan shows too little of the visible surface: without a guess it fits the model in many"
    " places"
)
MOST_NAMED = 4  # turned poses that are named in words
# a larger standard deviation of the attitude, caused by noise, is stated
UNCERTAIN_RAD = np.radians(1.0)
# with a smaller rms distance, in gates, the noise is not the cause of an uncertain attitude
NOISY_OF_GATE = 0.2


class Decision:
    """Decides on the poses of one target."""

    def __init__(
        self,
        target: Target,
        params: AcquireParams,
        test: PlausibilityTest,
        screen: Screen,
        poses: Sameness,
        symmetry: Callable[[], NearSymmetry],
    ) -> None:
        """``symmetry``: returns the symmetries of the model, which are found when they are needed
        for the first time.
        """
        self._target, self._params, self._test, self._screen = target, params, test, screen
        self._poses, self._symmetry = poses, symmetry

    def decide(self, case: Case) -> Alignment:
        """Return the alignment with the status of the first rule that holds for the candidate of a
        case; without any, that of the alignment itself.
        """
        at = case.at
        if at.found.status is AlignStatus.FAILED:
            return at.found
        for rule in (
            self._no_overlap,
            self._implausible,
            self._ambiguous,
            self._part_only,
            self._undetermined,
        ):
            decided = rule(case, at)
            if decided is not None:
                return decided
        return at.found

    def _no_overlap(self, case: Case, at: Candidate) -> Alignment | None:  # noqa: ARG002
        """Too few points of the scan are on the model, for a pose without a guess."""
        little = at.searched and (not at.found.measured or self.too_little(at))
        return _without(at.found, AlignStatus.NO_OVERLAP) if little else None

    def too_little(self, at: Candidate) -> bool:
        """Return whether too few points are on the model for the result of a search."""
        p, alone = self._params, at.alone or at.covered
        return at.share < (p.least_separate if alone else p.least_ratio)

    def _implausible(self, case: Case, at: Candidate) -> Alignment | None:  # noqa: ARG002
        """The evidence is against the pose."""
        if not at.reason:
            return None
        return replace(_without(at.found, AlignStatus.IMPLAUSIBLE, at.reason), free_directions="")

    def _ambiguous(self, case: Case, at: Candidate) -> Alignment | None:
        """Another pose explains the scan as well, which differs not only along its unobservable
        directions, and by no exact symmetry.
        """
        if at.beside:
            return _without(at.found, AlignStatus.AMBIGUOUS, SEVERAL)
        if not at.rivals:
            return None
        images = self._symmetry().images(at.T_ca)
        rivals = [each for each in at.rivals if not self._poses.among(each, [at.T_ca, *images])]
        rivals = self._apart(case, at.found, rivals)
        return _named(at.found, rivals) if rivals else None

    def _part_only(self, case: Case, at: Candidate) -> Alignment | None:
        """A pose without a guess is not accepted where the view shows faces of many bodies: they do
        not determine the pose, or no error of the size.
        """
        found, known = at.found, self._target.visibility.sided
        if not at.searched or not at.accepted or at.covered or not known:
            return None
        free = found.free if found.status is AlignStatus.DEGENERATE else None
        images = self.images(case)
        turns_only = free is not None and free.shape[1] == 1 and self._symmetry().images(at.T_ca)
        if turns_only and not images:  # no other body is meant by the free turn
            return None
        if free is None and not found.message.startswith(SIZE_UNSEEN):
            return None
        if images:
            return _named(found, list(images))
        return _without(found, AlignStatus.IMPLAUSIBLE, PART_ONLY)

    def _undetermined(self, case: Case, at: Candidate) -> Alignment | None:  # noqa: ARG002
        """Turned poses leave motions open of which the guess has no information."""
        if at.undetermined is None or not at.accepted:
            return None
        return quality.left_undetermined(at.found, at.undetermined)

    def images(self, case: Case) -> tuple[Pose, ...]:
        """Return the poses T_ca that no scan can tell from the candidate, found once for it."""
        at = case.at
        if at.images is None:
            every = self._symmetry().images(at.T_ca) if at.accepted else []
            at = case.current = replace(at, images=tuple(self._apart(case, at.found, every)))
        return at.images or ()

    def equal(self, case: Case, found: Alignment) -> Alignment:
        """Return an accepted alignment; AMBIGUOUS with the poses that no scan can tell from it."""
        if found.status not in ACCEPTED:
            return found
        images = self.images(case)
        return replace(_named(found, list(images)), equal=True) if images else found

    def _apart(self, case: Case, found: Alignment, others: list[Pose]) -> list[Pose]:
        """Those of other poses T_ca that differ from a result not only along its unobservable
        directions.
        """
        at, target = found.T_ac.inverse(), self._target
        if others and found.status is AlignStatus.DEGENERATE:
            free = quality.view_directions(
                target.index, target.visibility, case.points, at, target.limits.gate_m
            )
            others = [T for T in others if not self._poses.same(T, free.nearest(at, T))]
        return others

    def with_size(self, case: Case, found: Alignment) -> Alignment:
        """Return an alignment with what its scan says about the size, if that is still to be
        fitted.

        The covariance is enlarged by the change of the pose that an error of the size of two
        standard errors causes.
        """
        P, part = found.covariance, found.systematic
        if found.size_1s is None or P is None or part is None:
            return found
        T_ca, target = found.T_ac.inverse(), self._target
        camera_c = target.visibility.camera_c(target.index, case.points, T_ca)
        size = size_error(target.index, case.points, T_ca, camera_c)
        if size is not None and size.likely:
            P, part = (geometry.frozen(C + np.outer(size.shift, size.shift)) for C in (P, part))
        message = size_remark(size, found.size_1s)
        return replace(found, covariance=P, systematic=part, message=message, size_1s=None)

    def stated(self, found: Alignment) -> Alignment:
        """Return the alignment; an attitude that noise leaves uncertain is stated if nothing else
        is.
        """
        P = found.covariance
        if P is None or found.message or found.rms_m <= NOISY_OF_GATE * self._target.limits.gate_m:
            return found
        sigma = float(np.sqrt(np.linalg.eigvalsh(P[:3, :3])[-1]))
        if sigma <= UNCERTAIN_RAD:
            return found
        known = f"with this noise the attitude is known to {np.degrees(sigma):.1f} deg (1 sigma)"
        return replace(found, message=f"{known} only")

    def consistent(self, points: NDArray[Any], guess: Pose, found: Alignment) -> Alignment:
        """Return the alignment with a covariance that is not contradicted by the distances at the
        predicted pose.

        Where little of the target is in the scan, the distances can be nearly as small along a
        curve of poses, far beyond the covariance at its lowest point. With d the step to the
        prediction, x its chi-square by the distances and y that by the covariance P, P + d d' (1 /
        x - 1 / y) has the chi-square x if x < y.

        Args:
            points: (n, 3) in {A} [m], part of the scan.
            guess: predicted T_ac.
            found: the alignment.
        """
        P, predicted = found.covariance, self._test.predicted(found.T_ac.inverse(), guess)
        if P is None or found.inlier_ratio >= LEAST_RATIO or not predicted:
            return found
        at, before = (
            self._screen.measure(points, T_ac.inverse(), guess) for T_ac in (found.T_ac, guess)
        )
        step = found.T_ac.inverse() @ guess
        d = np.concatenate([geometry.log(step.q), step.t])
        tiny = np.finfo(float).tiny
        width, noise = self._screen.width(at), max(at.noise_m, before.noise_m, tiny)
        by_distances = found.points * (before.cost(width) - at.cost(width)) * (width / noise) ** 2
        by_covariance = max(float(d @ np.linalg.solve(P, d)), tiny)
        missing = 1.0 / max(by_distances, 1.0) - 1.0 / by_covariance
        if missing <= 0.0:
            return found
        wider = P + missing * np.outer(d, d)
        info = geometry.frozen(np.linalg.inv(wider))
        return replace(found, covariance=geometry.frozen(wider), info=info)


def _without(found: Alignment, status: AlignStatus, message: str | None = None) -> Alignment:
    """The alignment as one that is not accepted; its message is kept without another one."""
    message = found.message if message is None else message
    return replace(found, status=status, covariance=None, message=message)


def _named(found: Alignment, others: list[Pose]) -> Alignment:
    """The alignment as one of several poses that explain the scan."""
    words = dict.fromkeys(turn_words(found.T_ac.inverse() @ each.inverse()) for each in others)
    return replace(
        _without(found, AlignStatus.AMBIGUOUS),
        free_directions=", ".join([*words][:MOST_NAMED]),
        members=(found.T_ac, *(each.inverse() for each in others)),
    )
