"""The cause of a motion that is not free, named from the poses so far while a log is replayed.

Free motion costs nothing: causes are searched only once the rows state a change of the velocity, a
torque or force, or random disturbances, and again each time the poses have grown by half. The
search is that of the smoothing pass over fewer knots. A cause is named while its set of events is
far more likely than none; sets that are nearly as likely are named beside it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from avsreplay.errors import value_class
from avsreplay.estimate.events.problem import Body, Fit, Problem
from avsreplay.estimate.events.search import described, first_fit, search, total
from avsreplay.estimate.events.smoothing import PoseStore, spread, words
from avsreplay.estimate.initialise import poses_of, weak_prior
from avsreplay.estimate.params import EstimatorParams
from avsreplay.outcome import SURE_EVENT_LOG_ODDS

_MOST_POSES = 60  # poses of a search: about 1 s of processor time
_GROWTH = 1.5  # of the healthy poses between two searches
_FIRST_SEARCH = 30  # healthy poses of the first search
_MOST_STATED = 3  # sets


@value_class
class Cause:
    """What the poses so far show besides free motion.

    Attributes:
        words: the events with sizes, onsets and 1 sigma, in words; "" where none is known.
        searched: number of healthy poses at the last search, 0 before the first.
        kinds: instant of the scan [ns] of each search, and the names of the kinds of events that
            are named from then on.
    """

    words: str = ""
    searched: int = 0
    kinds: tuple[tuple[int, tuple[str, ...]], ...] = ()

    def after(
        self, shown: bool, poses: PoseStore, params: EstimatorParams, start_ns: int, t_ns: int
    ) -> Cause:
        """Return what is known after a scan.

        Args:
            shown: the estimate shows that the motion is not free.
            poses: the healthy ones so far.
            params: of the estimator, auto values filled in.
            start_ns: instant of the first scan, from which onsets are stated [ns].
            t_ns: instant of the scan [ns].
        """
        count = len(poses)
        if not shown or count < max(_FIRST_SEARCH, _GROWTH * self.searched):
            return self
        words, kinds = _named(poses, params, start_ns)
        return Cause(words, count, (*self.kinds, (t_ns, kinds)))

    def names(self, kind: str, t_ns: int) -> bool:
        """Return whether an event of a kind was named at an instant.

        Args:
            kind: name of the kind.
            t_ns: the instant [ns].
        """
        known = [kinds for since_ns, kinds in self.kinds if since_ns <= t_ns]
        return bool(known) and kind in known[-1]


def _named(store: PoseStore, params: EstimatorParams, start_ns: int) -> tuple[str, tuple[str, ...]]:
    """The most likely set of events and those that are nearly as likely, in words, and the names of
    their kinds; none where one of the sets is empty.
    """
    fixes = store.fixes(spread(len(store), _MOST_POSES))
    poses = poses_of(tuple(fixes))
    problem = Problem(poses, Body(weak_prior(poses, params).one_sigma, params.correlated_rad))
    try:
        sets = search(problem, first_fit(problem))
    except ArithmeticError:  # no motion of a rigid body explains the poses
        return "", ()
    least = total(problem, sets[0]) - SURE_EVENT_LOG_ODDS
    kinds: dict[tuple[str, ...], Fit] = {}
    for fit in sets:
        if total(problem, fit) > least:
            kinds.setdefault(tuple(sorted(e.kind.name for e in fit.events)), fit)
    if () in kinds:
        return "", ()
    likely = [fit for names, fit in kinds.items() if not any(_within(k, names) for k in kinds)]
    likely = likely[:_MOST_STATED]
    late_s = (fixes[0].t_ns - start_ns) * 1e-9
    named = dict.fromkeys(e.kind.name for fit in likely for e in fit.events)
    return " or ".join(_words(problem, fit, late_s) for fit in likely), tuple(named)


def _within(some: tuple[str, ...], names: tuple[str, ...]) -> bool:
    """Whether a set of kinds is a smaller part of another one, whose further events are then not
    needed.
    """
    return len(some) < len(names) and not Counter(some) - Counter(names)


def _words(problem: Problem, fit: Fit, late_s: float) -> str:
    found = sorted((described(problem, fit, e) for e in fit.events), key=lambda f: f.onset_s)
    return " and ".join(words(replace(f, onset_s=f.onset_s + late_s)) for f in found)
