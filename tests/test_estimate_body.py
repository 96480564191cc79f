"""Physical parameters in {C}: correct for a known body, equal for every axis permutation,
inside their range.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tumbling
from state_errors import permute_covariance

from avsreplay import geometry
from avsreplay.estimate.chart import (
    AXIS_PERMUTATIONS,
    body_parameters,
    permute_axes,
)
from avsreplay.records import Belief


@pytest.mark.parametrize("seed", range(5))
def test_the_tensor_is_that_of_the_body(seed: int) -> None:
    world = tumbling.draw(seed, seconds=1.0, mu_deg=120.0)
    x = world.states[0]
    found = body_parameters(Belief(0, x, np.eye(20) * 1e-12))
    R_cb = geometry.matrix(x.q_bc).T
    want = R_cb @ np.diag(world.moments) @ R_cb.T / world.moments.sum()
    assert np.abs(found.inertia - want).max() < 1e-9
    assert found.moments == pytest.approx(np.sort(world.moments) / world.moments.sum())
    centre = x.T_ac.inverse() @ geometry.Pose(x.q_ab, x.r_a)
    assert found.centre_c == pytest.approx(centre.t)
    assert found.rate_c == pytest.approx(R_cb @ x.w_b)


def test_nothing_depends_on_the_axis_permutation() -> None:
    rng = np.random.Generator(np.random.PCG64(2))
    x = tumbling.draw(7, seconds=1.0, mu_deg=60.0, sigma_max=0.8).states[0]
    root = 0.01 * rng.normal(size=(20, 20))
    P = root @ root.T + 1e-8 * np.eye(20)
    first = body_parameters(Belief(0, x, P))
    for permutation in AXIS_PERMUTATIONS:
        other = body_parameters(
            Belief(0, permute_axes(x, permutation), permute_covariance(P, x, permutation))
        )
        for name in ("inertia", "inertia_1s", "moments", "moments_1s", "centre_c", "rate_c"):
            assert np.abs(getattr(other, name) - getattr(first, name)).max() < 1e-7, name
        assert other.centre_1s_m == pytest.approx(first.centre_1s_m, rel=1e-6)
        assert other.rate_1s_radps == pytest.approx(first.rate_1s_radps, rel=1e-6)


def test_an_unknown_inertia_stays_in_its_range() -> None:
    """However large the covariance, entries over the trace have a standard deviation below 1/2."""
    x = tumbling.draw(3, seconds=1.0, sigma_max=0.8).states[0]
    found = body_parameters(Belief(0, x, 1e4 * np.eye(20)))
    assert np.all(found.inertia_1s < 0.5)
    assert np.all(found.moments_1s < 0.5)
    assert np.all(np.isfinite(found.inertia_1s))


def test_a_small_spread_is_the_linear_one() -> None:
    """1 sigma of the moments against draws of the chart's numbers."""
    from avsreplay.estimate.chart import to_chart, to_errors, to_state

    x = tumbling.draw(5, seconds=1.0, sigma_max=0.7).states[0]
    chart, rng = to_chart(x), np.random.Generator(np.random.PCG64(1))
    y = np.zeros(20)
    y[12:17] = 0.01
    T = to_errors(chart)
    found = body_parameters(Belief(0, x, T @ np.diag(y**2 + 1e-16) @ T.T))
    draws = [
        body_parameters(Belief(0, to_state(chart.moved(y * d)), np.eye(20)))
        for d in rng.normal(size=(400, 20))
    ]
    assert found.moments_1s == pytest.approx(np.std([d.moments for d in draws], axis=0), rel=0.15)
    assert found.inertia_1s == pytest.approx(np.std([d.inertia for d in draws], axis=0), rel=0.2)


@pytest.mark.parametrize("gap", [1e-6, 1e-3, 0.3])
@pytest.mark.parametrize("wide", [1e-3, 1.0, 100.0])
def test_standard_deviations_stay_in_the_physical_range(gap: float, wide: float) -> None:
    """However wide the covariance and however undetermined the axes: no sigma beyond that of
    no information.
    """
    x = tumbling.draw(3, seconds=1.0).states[0]
    x = replace(x, sigma=np.array([gap, 0.4]))
    P = np.diag(np.repeat([0.1, 0.1, 0.1, 0.1, 1.0, 1.0, 10.0], [3, 3, 3, 3, 2, 3, 3]) * wide) ** 2
    body = body_parameters(Belief(0, x, P))
    first, second, varrho, mu = body.limited_1s
    raw = np.sqrt(np.diag(P))
    assert 0.0 < first <= min(raw[12], 1.16)
    assert 0.0 < second <= min(raw[13], 1.16)
    assert 0.0 < mu <= min(np.sqrt(3.0) * raw[17], np.pi / 2.0)
    assert varrho**2 <= body.centre_1s_m**2 + 2.0 * float(x.c_b @ x.c_b) + 1e-12
    if wide == 1e-3:
        assert first == pytest.approx(raw[12])
        assert mu == pytest.approx(np.sqrt(3.0) * raw[17])
