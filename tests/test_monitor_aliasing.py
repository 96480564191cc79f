"""Two rates that explain the poses alike."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avsreplay.monitor.aliasing import Instants, in_words, other_rate


def poses(spans):
    instants = Instants()
    for t in np.cumsum([0.0, *spans]):
        instants = instants.after(round(t * 1e9))
    return instants


@given(
    rate=st.floats(0.1, 20.0),
    period=st.floats(0.05, 2.0),
    lost=st.lists(st.integers(1, 4), min_size=3),
)
def test_both_rates_turn_the_target_alike_at_every_pose(rate, period, lost):
    """The oracle is the rotation itself: cos and sin of both angles at each instant."""
    spans = [period, *(k * period for k in lost)]
    other = other_rate(poses(spans), np.array([0.0, 0.0, rate]))
    if rate * period <= 2.0:
        assert other is None
        return
    at = np.cumsum([0.0, *spans])
    alike = [np.abs(np.exp(1j * rate * at) - np.exp(1j * s * other * at)).max() for s in (-1, 1)]
    assert min(alike) < 1e-3


def test_intervals_that_are_no_multiples_of_one_exclude_the_other_rate():
    w = np.array([2.0, 5.0, 1.0])
    assert other_rate(poses([0.5] * 9), w) == pytest.approx(2 * np.pi / 0.5 - np.linalg.norm(w))
    assert other_rate(poses([0.5, 0.63, 0.5, 0.57]), w) is None
    assert "and 7.09 rad/s both" in in_words(w, 2 * np.pi / 0.5 - np.linalg.norm(w))


def test_a_single_pose_shows_no_rate():
    assert other_rate(poses([]), np.array([0.0, 0.0, 9.0])) is None
