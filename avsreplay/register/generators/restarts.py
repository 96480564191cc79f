"""Restarts of a registration whose fit is poor or whose pose is implausible: graduated
registrations of part of the scan from the guess and the first result, and from both turned by a few
degrees.
"""

from __future__ import annotations

from collections.abc import Generator as Steps
from collections.abc import Iterator

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.register.backend import Target
from avsreplay.register.hypotheses import Candidate, Case, Generator, Hypothesis
from avsreplay.register.screening import Screen, Screened
from avsreplay.register.work import FAR_WORK

RESTART_TURN_RAD = np.radians(4.0)  # rotation of the turned starts
EQUAL = 1e-9  # two starts with entries nearer than this (lengths: times the extent) are one
LEAST_TO_TURN = 0.2  # share of the points on the model at the best pose, to try turned starts
KEPT_SCANS = 2  # work that is kept, in ordinary registrations


class Restarts(Generator):
    """Graduated registrations, of which the first that is accepted is taken."""

    until_accepted = True

    def __init__(self, target: Target, screen: Screen, turned: bool, kept: int = 0) -> None:
        """``turned``: from turned poses; ``kept``: more work that a later step needs."""
        self._extent, self._gate = target.surface.extent, target.limits.gate_m
        self._screen, self._turned, self._kept = screen, turned, kept

    def hypotheses(self, case: Case) -> Steps[Hypothesis, None, int]:
        """Yield the candidate so far, the best of the restarts before, and the others."""
        assert case.guess is not None
        at = self._screen.measure(case.few, case.at.T_ca)
        yield Hypothesis.of(at)
        before = case.restarted
        if before is not None:
            if np.mean(before.distance < self._gate) < LEAST_TO_TURN:
                return 0
            yield Hypothesis(before.T_ca, at=before)
        centre = case.few.mean(axis=0)
        for T_ca, start in self._starts(case.guess.inverse(), case.at.T_ca, centre):
            if not case.work.allows(
                self.cost(case, start), self._kept + KEPT_SCANS * case.work.healthy
            ):
                break
            yield Hypothesis.of(self._screen.graduated(case.few, T_ca, start))
        return 0

    def cost(self, case: Case, start_m: float) -> int:
        """Return the usual work of one restart."""
        return self._screen.passes(start_m) * FAR_WORK * len(case.few)

    def compared(
        self, case: Case, found: list[Hypothesis]
    ) -> tuple[Hypothesis | None, Candidate | None]:
        """Return the pose of least cost if it is not the candidate so far."""
        case.restarted = best = self._screen.least(screened(found))
        if best.T_ca.matrix.tobytes() == case.at.T_ca.matrix.tobytes():
            return None, case.current
        return Hypothesis(best.T_ca, at=best), case.current

    def _starts(self, guess: Pose, result: Pose, centre_a: Array) -> Iterator[tuple[Pose, float]]:
        """Guess and result with a narrow and a wide start, or both rotated by TURN_RAD about each
        axis of {C}.
        """
        narrow = self._screen.narrow_m
        apart = np.abs(guess.matrix - result.matrix) / np.array([1.0, 1.0, 1.0, self._extent])
        bases = (guess, result) if apart.max() > EQUAL else (guess,)
        if not self._turned:
            yield from ((base, narrow) for base in bases)
            yield guess, self._screen.wide_m
        for base in bases if self._turned else ():
            centre = base.apply(centre_a)
            for axis in np.eye(3):
                for sign in (1.0, -1.0):
                    turn = geometry.exp(sign * RESTART_TURN_RAD * axis)
                    yield Pose(turn, centre - geometry.matrix(turn) @ centre) @ base, narrow


def screened(found: list[Hypothesis]) -> list[Screened]:
    """Return the distances of hypotheses that were measured."""
    return [each.at for each in found if each.at is not None]
