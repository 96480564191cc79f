"""Hypotheses of the pose of one scan, the candidates that come of them, and what a generator of
hypotheses is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus
from avsreplay.register.evidence import Evidence, Observed
from avsreplay.register.screening import Screened


class Refine(Enum):
    """How a hypothesis that was chosen is registered to the whole scan."""

    BACKEND = "by the back end"
    NOISE = "within a rejection distance that follows the noise"
    BOTH = "in both ways, of which the nearer result is taken"


@value_class
class Hypothesis:
    """A pose that may be right.

    Attributes:
        T_ca: the pose.
        at: its distances on part of the scan, where they were measured.
    """

    T_ca: Pose
    at: Screened | None = None

    @staticmethod
    def of(at: Screened) -> Hypothesis:
        """Return a screened pose as a hypothesis."""
        return Hypothesis(at.T_ca, at)


@value_class
class Candidate:
    """A hypothesis that was registered to the whole scan, with what is known of it.

    Attributes:
        found: the alignment.
        by_backend: it is one of the back end, not of the program's own method.
        evidence: what the rays say of the pose; None with too few near the model.
        examined: the evidence was measured.
        reason: why the evidence is against it, "" if it is not.
        doubtful: another pose may have more evidence.
        rivals: different poses T_ca that explain the scan as well.
        undetermined: (6, k) motions that turned poses, which explain the scan as well, leave open.
        images: poses T_ca onto which exact symmetries of the model carry it; None: not known yet.
        beside: another minimum near the pose explains the scan as well.
        share, alone: of the result of a search: share of the searched points that are on the model,
            and whether the others are those of another object.
        searched: by a search, not from a guess.
    """

    found: Alignment
    by_backend: bool = False
    evidence: Evidence | None = None
    examined: bool = False
    reason: str = ""
    doubtful: bool = False
    rivals: tuple[Pose, ...] = ()
    undetermined: Array | None = None
    images: tuple[Pose, ...] | None = None
    beside: bool = False
    share: float = 1.0
    alone: bool = False
    searched: bool = False

    @property
    def T_ca(self) -> Pose:
        """Return the pose that takes {A} to {C}."""
        return self.found.T_ac.inverse()

    @property
    def covered(self) -> bool:
        """Return whether the visible side of the model is in the scan."""
        return self.evidence is not None and self.evidence.covered

    @property
    def accepted(self) -> bool:
        """Return whether the status of the alignment is one of an accepted pose."""
        return self.found.status in (AlignStatus.ALIGNED, AlignStatus.DEGENERATE)


class Case:
    """One scan that is being registered, as generators see it.

    Attributes:
        seen: the scan, for its evidence.
        points: (n, 3) those that are registered [m], in {A}.
        few: part of the points by which hypotheses are screened.
        target: (n, 3) part of the scan that is taken for the target, by which poses are compared.
        guess: predicted T_ac; None: none.
        carried, halves: as of ``Registrar.register``.
        unknown: (6, k) motions of the model of which the guess has no information.
        current: the best candidate so far.
    """

    def __init__(
        self,
        seen: Observed,
        points: NDArray[Any],
        few: NDArray[Any],
        guess: Pose | None = None,
        carried: bool = False,
        halves: bool = True,
        unknown: Array | None = None,
    ) -> None:
        self.seen, self.points, self.few, self.target = seen, points, few, points
        self.guess, self.carried, self.halves = guess, carried, halves
        self.unknown = np.zeros((6, 0)) if unknown is None else unknown
        self.current: Candidate | None = None

    @property
    def at(self) -> Candidate:
        """Return the best candidate so far; there is one."""
        assert self.current is not None
        return self.current


class Generator(ABC):
    """Yields hypotheses of the pose of a scan.

    Attributes:
        refine: how the best of its hypotheses is registered to the whole scan.
        examined: the evidence of the candidate so far is needed for the comparison.
    """

    refine = Refine.NOISE
    examined = False

    @abstractmethod
    def hypotheses(self, case: Case) -> Iterator[Hypothesis]:
        """Yield hypotheses."""

    def compared(
        self, case: Case, found: list[Hypothesis]
    ) -> tuple[Hypothesis | None, Candidate | None]:
        """Return the best of the hypotheses, and the candidate so far with what the comparison
        says of it.

        Args:
            case: the scan.
            found: the hypotheses.

        Returns:
            None in place of a hypothesis if the candidate so far is better than all.
        """
        return (found[-1] if found else None), case.current
