"""The predicted pose, and the pose that a registration from it gave."""

from __future__ import annotations

from collections.abc import Iterator

from avsreplay.register.backend import Target
from avsreplay.register.hypotheses import Case, Generator, Hypothesis, Refine
from avsreplay.register.plausibility import NOISE_OF_EXTENT
from avsreplay.register.quality import LEAST_RATIO
from avsreplay.register.screening import BETTER_THAN, Screen

# The second of two results from these poses replaces the first with a cost below this share of its
# cost, so that equal ones are not exchanged.
NEARER = 0.999


class Guess(Generator):
    """The predicted pose, registered by the back end as it is built for a target in view."""

    refine = Refine.BACKEND

    def hypotheses(self, case: Case) -> Iterator[Hypothesis]:
        """Yield the predicted pose."""
        assert case.guess is not None
        yield Hypothesis(case.guess.inverse())


class WithinNoise(Generator):
    """The first result, and the guess if part of the points is off and it is as near, both to be
    registered within a rejection distance that follows the noise.

    The wide rejection distance of the first passes can lead away from a good guess on a target
    that is hidden.
    """

    def __init__(self, target: Target, screen: Screen) -> None:
        self._gate, self._screen = target.limits.gate_m, screen
        self._most_noise = NOISE_OF_EXTENT * target.surface.extent

    def hypotheses(self, case: Case) -> Iterator[Hypothesis]:
        """Yield none, one or both of these poses."""
        assert case.guess is not None
        first, guess = case.at.found, case.guess
        at, before = (
            self._screen.measure(case.few, T_ac.inverse(), guess) for T_ac in (first.T_ac, guess)
        )
        worse = BETTER_THAN * before.cost(self._gate) > at.cost(self._gate)
        found = [at] if worse or first.inlier_ratio >= LEAST_RATIO else [at, before]
        for each in found:
            if first.measured and each.noise_m <= self._most_noise:
                yield Hypothesis.of(each)
