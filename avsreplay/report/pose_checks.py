"""Two checks of a run: errors beyond their covariance where the truth has poses only, and points
without times.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avsreplay.report.moments import median_of
from avsreplay.rows import Row
from avsreplay.tables import column_of, numbers, used_rows

MAX_ERROR_SIGMAS = 5.0  # median error of the pose over its own 1 sigma from which it is reported
_LEAST_JUDGED_ROWS = 10  # used scans with a true pose from which the median is judged
# displacement during a scan over the 1 sigma of the position that matters
_SIGNIFICANT_SIGMAS = 3.0


def error_over_sigma(rows: Sequence[Row]) -> str:
    """Return a finding where the pose errors exceed the standard deviations of the estimate.

    It is the consistency check of runs whose truth has no rates, for which NEES is not known.

    Args:
        rows: one per scan.

    Returns:
        The finding as a text, "" if there is none.
    """
    used = used_rows(rows)
    said = []
    for name, error, sigma in (
        ("position", "pos_err_m", "pos_1s_m"),
        ("attitude", "rot_err_deg", "rot_1s_deg"),
    ):
        stated = numbers(used, sigma)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(stated > 0.0, numbers(used, error) / stated, np.nan)
        ratio = ratio[np.isfinite(ratio)]
        if (
            len(ratio) >= _LEAST_JUDGED_ROWS
            and (typical := median_of(ratio) or 0.0) > MAX_ERROR_SIGMAS
        ):
            said.append(f"{name} {typical:.2g}")
    if not said or any(nees is not None for nees in column_of(used, "nees")):
        return ""
    return (
        f"the error of the pose is many times the 1 sigma that is stated of it (median:"
        f" {', '.join(said)}): the true poses may be late, in another frame or of another model,"
        " or the covariance is too small"
    )


def times_may_matter(rows: Sequence[Row], extent_m: float, period_s: float) -> str:
    """Return a finding where points have no times and the target moves so fast that times would
    matter.

    A scan is assumed to take the whole time to the next one.

    Args:
        rows: one per scan.
        extent_m: extent of the model [m].
        period_s: time between two scans [s].

    Returns:
        The finding as a text, "" if times cannot matter.
    """
    used = used_rows(rows)
    rate = np.linalg.norm([numbers(used, f"w{axis}_radps") for axis in "xyz"], axis=0)
    speed = np.linalg.norm([numbers(used, f"v{axis}_mps") for axis in "xyz"], axis=0)
    motion = median_of(np.asarray(speed + 0.5 * extent_m * rate))
    sigma = median_of(numbers(used, "pos_1s_m"))
    if motion is None or sigma is None or 0.5 * motion * period_s <= _SIGNIFICANT_SIGMAS * sigma:
        return ""
    return (
        f"the points have no times, and the target moves up to {motion * period_s:.2g} m from scan"
        " to scan: whether a scan takes part of this time is not known; record times, or state"
        " --scan-duration, or --point-time none if all points of a scan are measured at once"
    )
