"""The filter set against a fit to the poses it has lived on: what one step's innovations cannot show, all poses do.

A biased scan or two that passed the fault rule move the parameters of a converged filter by many of its own sigma, and
the next innovations look normal. A fit to the last poses, which weighs such scans down, does not share the error.
Where the two differ by more than the fit's own spread allows, the fit is right: the filter has less to say than the
poses that it was made of.
"""

from __future__ import annotations

import numpy as np

from avsreplay.estimate.chart import Chart, to_chart, to_errors
from avsreplay.estimate.motion import moved
from avsreplay.estimate.robust import BOUND
from avsreplay.records import Belief

__all__ = ["contradicted", "start_at"]


def start_at(belief: Belief, t_ns: int) -> Chart:
    """The belief's motion at another instant, where the fit begins."""
    there, _ = moved(belief.x, (t_ns - belief.t_ns) * 1e-9)
    return to_chart(there)


def contradicted(belief: Belief, fitted: Belief) -> bool:
    """Does the belief's mean lie outside the fit's 99.99 % region, at one instant?

    Both stand on the same poses, so a right belief differs by less than the fit's covariance. The difference is taken
    in the chart, where names of axes do not matter.
    """
    there = to_chart(fitted.x)
    T = to_errors(there)
    y = T @ to_chart(belief.x).minus(there)
    return float(y @ np.linalg.solve(fitted.P, y)) > BOUND
