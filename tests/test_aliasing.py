"""Two rates that explain the poses alike."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avsreplay import geometry
from avsreplay.aliasing import (
    COMPARED_POSES,
    LEAST_TURNS,
    Turns,
    in_words,
    is_shown,
    two_rates,
)


def poses(spans, rate, axis=(0.0, 0.6, 0.8)):
    """Of a rotation about one axis."""
    turns = Turns()
    for t in np.cumsum([0.0, *spans]):
        turns = turns.after(round(t * 1e9), geometry.exp(rate * t * np.array(axis)))
    return turns


@given(
    rate=st.floats(0.1, 20.0),
    period=st.floats(0.05, 2.0),
    # so many that the intervals of one period are among those that are compared
    lost=st.lists(st.integers(1, 4), min_size=3, max_size=COMPARED_POSES - 1 - LEAST_TURNS),
)
def test_both_rates_turn_the_target_alike_at_every_pose(rate, period, lost):
    """The oracle is the rotation itself: cos and sin of both angles at each instant."""
    spans = [*([period] * LEAST_TURNS), *(k * period for k in lost)]
    found = two_rates(poses(spans, rate))
    turn = abs((rate * period + np.pi) % (2.0 * np.pi) - np.pi)  # as the poses show it
    if abs(turn - 2.0) < 1e-6:
        return
    assert (found is not None) == (turn > 2.0)
    if found is None:
        return
    at = np.cumsum([0.0, *spans])
    for each in found:
        alike = [np.abs(np.exp(1j * rate * at) - np.exp(1j * s * each * at)).max() for s in (-1, 1)]
        assert min(alike) < 1e-3
    assert found[0] <= found[1]


def test_intervals_that_are_no_multiples_of_one_exclude_the_other_rate():
    assert two_rates(poses([0.5] * 9, 7.0)) == pytest.approx((4.0 * np.pi - 7.0, 7.0))
    assert two_rates(poses([0.5, 0.63, 0.5, 0.57, *([0.5] * 6)], 5.48)) is None
    assert "of 5.57 and 7 rad/s both" in in_words((4.0 * np.pi - 7.0, 7.0))


def test_a_few_poses_and_poses_at_random_show_no_rate():
    assert two_rates(poses([], 9.0)) is None
    assert two_rates(poses([0.5] * (LEAST_TURNS - 1), 7.0)) is None
    rng = np.random.default_rng(3)
    turns = Turns()
    for k in range(32):
        q = rng.normal(size=4)
        turns = turns.after(k * 500_000_000, q / np.linalg.norm(q))
    assert two_rates(turns) is None


def test_the_faster_of_two_rates_is_shown_and_no_rate_beyond():
    """Turns of 2.1 rad at 2 Hz: 4.2 and 8.37 rad/s; a repeated stamp is no interval."""
    turns = poses([0.5] * 9, 4.2)
    slow, fast = two_rates(turns)
    assert is_shown(slow, turns.t_ns)
    assert is_shown(fast, turns.t_ns)
    assert not is_shown(8.6, turns.t_ns)
    assert not is_shown(8.6, (*turns.t_ns, turns.t_ns[-1]))
    assert is_shown(8.6, (*turns.t_ns, turns.t_ns[-1] + 100_000_000))
    assert is_shown(8.6, turns.t_ns[:1])
