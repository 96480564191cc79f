"""Three sets of parameters on one motion, and the command that prints them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tumbling
from click.testing import CliRunner

from avsreplay.estimate import parameter_sets
from avsreplay.estimate.dynamics import sigma3, sigma_join
from avsreplay.monitor.observability import gramian, measure, observe, weakest

LOG = Path(__file__).parent.parent / "fixtures" / "tumble.mcap"


def test_three_ratios_join_to_the_two_state_step() -> None:
    x = tumbling.draw(2, seconds=1.0).states[0]
    _, sets = parameter_sets.step_of_sets(x, 0.7)
    join = np.zeros((21, 20))
    join[:12, :12] = np.eye(12)
    join[12:15, 12:14] = sigma_join(x.sigma)
    join[15:, 14:] = np.eye(6)
    two, three = sets["two"], sets["three"]
    assert np.abs(three[0] @ join - join @ two[0]).max() < 1e-12
    assert np.abs(three[1] @ join - two[1]).max() < 1e-15


def test_each_ratio_moves_the_motion_as_its_column_says() -> None:
    """A free sigma3 is no body; its column is the derivative of Euler's equations all the same."""
    x = tumbling.draw(2, seconds=1.0).states[0]
    Phi = parameter_sets.step_of_sets(x, 0.01)[1]["three"][0]
    w, h = x.w_b, 0.01
    want = np.diag([w[1] * w[2], w[0] * w[2], w[0] * w[1]]) * h
    assert np.abs(Phi[3:6, 12:15] - want).max() < 2e-3 * np.abs(want).max() + 1e-8
    assert abs(sigma3(x.sigma)) < 1.0


def test_knowing_more_never_makes_it_worse() -> None:
    world = tumbling.draw(4, seconds=60.0)
    x = world.states[0]
    scales = parameter_sets.prior_1s(np.full(20, 0.1), x.sigma)
    folds = {name: gramian(scale) for name, scale in scales.items()}
    for h in np.diff(world.times, prepend=0.0):
        x, steps = parameter_sets.step_of_sets(x, float(h))
        folds = {name: observe(folds[name], *steps[name], 1e-24 * np.eye(6)) for name in folds}
    found = {name: measure(fold) for name, fold in folds.items()}
    assert {name: (f.rank, f.size) for name, f in found.items()} == {
        "two": (20, 20),
        "three": (21, 21),
        "known": (12, 12),
    }
    raw = {name: f.log10_cond for name, f in found.items()}
    assert raw["known"] < raw["two"] <= raw["three"] + 1e-9
    for name, fold in folds.items():
        assert len(weakest(fold, 2, parameter_sets.BLOCKS_OF[name])) == 2


@pytest.mark.slow
@pytest.mark.skipif(not LOG.exists(), reason="fixtures/tumble.mcap is not here")
def test_the_command_prints_one_document() -> None:
    from avsreplay.cli.observability import observability_command

    done = CliRunner().invoke(observability_command, [str(LOG), "--json", "--marks", "3"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert len(found["lines"]) == 3
    assert found["lines"][-1]["two"]["of"] == 20
    assert set(found["weakest"]) == {"two", "three", "known"}
    keys = set(found["lines"][-1]["two"])  # the Gramian of the rows is another one, which has other names
    assert keys == {"rank_fitted_motion", "of", "log10_cond_fitted_motion", "log10_cond_scaled_fitted_motion"}
