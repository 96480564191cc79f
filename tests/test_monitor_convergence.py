"""t_1: thresholds by block, the dwell time, both criteria; an inconsistent filter does not
converge.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from avsreplay.monitor.convergence import Convergence, ConvergenceParams, Criterion, block_1s
from avsreplay.records import BLOCKS, Belief, Forecast, Possible, State

X = State([0, 0, 0, 1.0], *[np.zeros(3)] * 3, np.zeros(2), np.zeros(3), [0, 0, 0, 1.0])
PAPER = ConvergenceParams(criterion=Criterion.COVARIANCE)
TOLERANCE = (0.08, 0.016, math.radians(3.0))
TIMES = np.array([5.0, 30.0])


def belief(t_s: float, **wide: float) -> Belief:
    """Every block well inside its limit for an 8 m target, but the named ones."""
    variances = np.full(20, 1e-10)
    for name, one_sigma in wide.items():
        variances[BLOCKS[name]] = one_sigma**2
    return Belief(round(t_s * 1e9), X, np.diag(variances))


def ahead(pos: float = 1e-3, vel: float = 1e-4, rot: float = 1e-3) -> Forecast:
    return Forecast(TIMES, *(np.array([v / 2, v]) for v in (pos, vel, rot)))


def fold(convergence: Convergence, steps):
    track = convergence.initial()
    for args in steps:
        track = convergence.judge(track, *args)
    return track


def test_t1_is_the_first_epoch_of_the_dwell() -> None:
    convergence = Convergence(PAPER, 8.0, TOLERANCE)
    steps = [(belief(t, **({"sigma": 1.0} if t < 10 else {})),) for t in range(30)]
    assert not fold(convergence, steps[:12]).converged
    track = fold(convergence, steps)
    assert track.converged
    assert track.t1_ns == 10_000_000_000


def test_a_break_starts_the_dwell_again_but_t1_stays() -> None:
    convergence = Convergence(PAPER, 8.0, TOLERANCE)
    bad = {3, 10}
    steps = [(belief(t, **({"rate": 1.0} if t in bad else {})),) for t in range(20)]
    assert fold(convergence, steps[:4]).t1_ns == 0
    assert not fold(convergence, steps[:5]).converged
    assert fold(convergence, steps[:7]).converged
    track = fold(convergence, steps)
    assert track.t1_ns == 0
    assert track.since_ns == 11_000_000_000


@pytest.mark.parametrize("block", list(BLOCKS))
def test_every_block_counts(block: str) -> None:
    track = fold(
        Convergence(PAPER, 8.0, TOLERANCE), [(belief(t, **{block: 0.5}),) for t in range(9)]
    )
    assert not track.converged
    assert track.unknown == (block,)


def test_predictive_test_ignores_an_unobservable_parameter() -> None:
    """A nearly axisymmetric body: sigma and mu wide, the grasp point's motion known."""
    steps = [(belief(t, sigma=0.5, mu=0.5), ahead()) for t in range(9)]
    assert fold(Convergence(ConvergenceParams(), 8.0, TOLERANCE), steps).converged
    track = fold(Convergence(PAPER, 8.0, TOLERANCE), steps)
    assert not track.converged
    assert track.predictive_converged
    assert track.unknown == ("sigma", "mu")


@pytest.mark.parametrize("wide", [{"pos": 0.2}, {"vel": 0.1}, {"rot": 0.1}])
def test_predictive_test_counts_each_of_three(wide: dict[str, float]) -> None:
    assert not fold(
        Convergence(ConvergenceParams(), 8.0, TOLERANCE),
        [(belief(t), ahead(**wide)) for t in range(9)],
    ).converged


@pytest.mark.parametrize("which", [0, 1])
def test_an_error_that_no_scan_reduces_is_compared_as_when_the_gripper_closes(which: int) -> None:
    convergence = Convergence(ConvergenceParams(), 8.0, TOLERANCE, closing_sigmas=3.0)
    for share, expected in ((0.3, True), (0.4, False)):
        lasting = [0.0, 0.0]
        lasting[which] = share * (TOLERANCE[0], TOLERANCE[2])[which]
        found = replace(ahead(*lasting[:1], rot=lasting[1]), lasting=(lasting[0], lasting[1]))
        steps = [(belief(t), found) for t in range(9)]
        assert fold(convergence, steps).converged is expected
        assert fold(convergence, [(*step, True, None, True) for step in steps]).converged


def test_an_inconsistent_filter_is_not_converged() -> None:
    convergence = Convergence(ConvergenceParams(), 8.0, TOLERANCE)
    steps = [(belief(t), ahead(), t < 10) for t in range(20)]
    assert fold(convergence, steps[:10]).converged
    assert not fold(convergence, steps).converged


def test_the_test_of_the_paper_looks_at_the_covariance_only() -> None:
    """Consistency of the innovations and a possible change of the motion are additions to the
    printed method.
    """
    convergence = Convergence(PAPER, 8.0, TOLERANCE)
    track = fold(
        convergence, [(belief(t), ahead(), False, Possible(1.0, ahead(1e9))) for t in range(9)]
    )
    assert track.converged
    assert track.t1_ns == 0


def test_not_a_number_is_not_converged() -> None:
    P = np.full((20, 20), np.nan)
    nothing = Belief(0, X, P)
    assert not fold(Convergence(PAPER, 8.0, TOLERANCE), [(nothing,)] * 3).covariance_converged
    assert not fold(
        Convergence(ConvergenceParams(), 8.0, TOLERANCE),
        [(belief(t), ahead(np.nan)) for t in range(9)],
    ).converged


def test_blocks_are_roots_of_traces() -> None:
    assert block_1s(np.diag(np.arange(20.0)))["sigma"] == pytest.approx(5.0)
    assert list(block_1s(np.eye(20))) == list(BLOCKS)


def test_params() -> None:
    assert ConvergenceParams().resolved(8.0).position_m == pytest.approx(0.08)
    with pytest.raises(ValueError, match="dwell_s"):
        ConvergenceParams(dwell_s=-1.0)
    with pytest.raises(ValueError, match="sigmas"):
        ConvergenceParams(sigmas=0.0)


def test_a_possible_change_withholds_convergence_and_does_not_interrupt_the_dwell() -> None:
    convergence, far = Convergence(ConvergenceParams(), 8.0, TOLERANCE), Possible(0.4, ahead(1.0))
    steps = [(belief(float(t)), ahead(), True, far if t in (1, 6) else None) for t in range(9)]
    assert [fold(convergence, steps[: n + 1]).converged for n in range(9)] == [
        t >= 2 and t != 6 for t in range(9)
    ]
    assert fold(convergence, steps[:7]).predictive_converged
    assert fold(convergence, steps).t1_ns == 0


def test_the_tolerance_of_the_task_decides_and_a_flight_goes_on_up_to_twice_the_error() -> None:
    convergence = Convergence(ConvergenceParams(), 8.0, TOLERANCE)
    for share, rests, flies in ((0.9, True, True), (1.5, False, True), (2.1, False, False)):
        seen = ahead(pos=share * TOLERANCE[0])
        assert convergence.ratio(seen) == pytest.approx(share)
        for flown, expected in ((False, rests), (True, flies)):
            track = convergence.initial()
            for t in range(5):
                track = convergence.judge(track, belief(float(t)), seen, flown=flown)
            assert track.converged is expected


@pytest.mark.parametrize("sigmas", [1.0, 2.0])
def test_a_possible_change_counts_by_the_probability_of_an_error_above_the_tolerance(
    sigmas: float,
) -> None:
    """Against the distribution itself: a normal error with a second component of the change."""
    convergence = Convergence(ConvergenceParams(sigmas=sigmas), 8.0, TOLERANCE)
    most = 2.0 * norm.sf(sigmas)
    counted = {False: 0, True: 0}
    for share in (0.1, 0.5, 0.9, 0.99):
        for probability in (0.001, 0.02, 0.1, 0.3, 0.4, 0.9):
            for far in (0.0, 0.5, 2.0, 1e6):
                free, more = share / sigmas, far * TOLERANCE[0]
                seen, change = ahead(pos=free * TOLERANCE[0]), Possible(probability, ahead(more))
                wide = 2.0 * norm.sf(1.0 / math.hypot(free, far))
                beyond = (1 - probability) * 2.0 * norm.sf(1.0 / free) + probability * wide
                steps = [(belief(float(t)), seen, True, change) for t in range(5)]
                converged = fold(convergence, steps).converged
                assert converged == (beyond <= most)
                counted[converged] += 1
    assert min(counted.values()) > 20
