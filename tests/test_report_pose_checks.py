"""Errors of the pose against its own sigma, and points without times."""

from __future__ import annotations

from dataclasses import replace

from avsreplay.report.pose_checks import error_over_sigma, times_may_matter


def test_errors_of_many_sigmas_are_a_finding_where_nees_is_not_known(make_rows) -> None:  # type: ignore[no-untyped-def]
    rows = [
        replace(row, pos_1s_m=1e-3, rot_1s_deg=0.1, pos_err_m=1e-3, rot_err_deg=0.1, nees=None)
        for row in make_rows(20)
    ]
    assert error_over_sigma(rows) == ""
    late = [replace(row, pos_err_m=2e-2) for row in rows]
    assert "position 20" in error_over_sigma(late)
    assert "attitude" not in error_over_sigma(late)
    assert error_over_sigma(late[:5]) == "", "a few scans are no median"
    assert error_over_sigma([replace(row, nees=60.0) for row in late]) == "", "NEES says it"
    assert error_over_sigma([replace(row, pos_1s_m=0.0) for row in late]) == ""


def test_times_matter_where_the_target_moves_by_more_than_the_noise(make_rows) -> None:  # type: ignore[no-untyped-def]
    still = {f"w{axis}_radps": 0.0 for axis in "xyz"} | {f"v{axis}_mps": 0.0 for axis in "xyz"}
    rows = [replace(row, pos_1s_m=1e-3, **still) for row in make_rows(20)]
    assert times_may_matter(rows, 2.0, 0.1) == ""
    turning = [replace(row, wz_radps=0.5) for row in rows]
    assert "0.05 m" in times_may_matter(turning, 2.0, 0.1)
    assert times_may_matter(turning, 2.0, 1e-3) == ""
