"""Which parameters are shown as undetermined."""

from __future__ import annotations

import math

import pytest

from avsreplay.report.parameters import Parameter


@pytest.mark.parametrize("estimate", [0.0, -0.4, 0.9])
@pytest.mark.parametrize("name", ["sigma1", "sigma2"])
def test_a_sigma_whose_uncertainty_is_that_of_any_is_undetermined(name, estimate):
    """A sigma lies between -1 and 1: its mean square distance from an estimate e, if nothing is
    known, is 1/3 + e^2.
    """
    nothing_known = math.sqrt(1.0 / 3.0 + estimate**2)
    for share, undetermined in ((1.0, True), (0.95, False), (0.1, False)):
        found = Parameter(name, "", (estimate,), None, None, share * nothing_known)
        assert found.undetermined is undetermined


def test_other_parameters_have_no_such_limit():
    assert not Parameter("c (varrho)", "m", (0.0, 0.0, 0.0), None, None, 1e9).undetermined
    assert not Parameter("sigma1", "", (0.0,), None, None, None).undetermined
    assert Parameter("mu", "deg", (0.0, 0.0, 0.0), None, None, 132.0).undetermined
    assert not Parameter("mu", "deg", (0.0, 0.0, 0.0), None, None, 125.0).undetermined
