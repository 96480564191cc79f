"""The suite of the benchmark: scenarios, seeds, entries, data of others."""

import math

import numpy as np
import pytest

from avsreplay import geometry, toml_document
from avsreplay.benchmark.entries import entries_of
from avsreplay.benchmark.prepare import prepare
from avsreplay.benchmark.suite import CONE_DEG, GROUPS, TILT_DEG, drawn_motion, load_suite, merged
from avsreplay.errors import UsageError
from avsreplay.simulate.scenario import scenario_of


@pytest.fixture(scope="module")
def suite():
    return load_suite()


def test_the_suite_has_24_scenarios_in_six_groups_each_with_a_paragraph(suite):
    scenarios = suite.params.scenario
    assert len({each.name for each in scenarios}) == 24
    assert {each.group for each in scenarios} == set(GROUPS)
    assert all(len(each.about.split()) >= 15 for each in scenarios)


def test_every_simulated_scenario_is_valid_and_the_same_seed_gives_the_same_text(suite):
    for each in suite.params.scenario:
        if not each.data:
            text = suite.scenario_text(each, 5, 1)
            assert text == suite.scenario_text(each, 5, 1)
            assert scenario_of(toml_document.parse(text, each.name)).params.name == each.name
            assert text not in (suite.scenario_text(each, 6, 1), suite.scenario_text(each, 5, 0))


def test_a_drawn_target_turns_as_fast_as_asked_and_shows_its_fixture():
    for seed in range(20):
        motion = drawn_motion(6.0, 0.1, np.random.default_rng(seed))
        axis = geometry.matrix(np.array(motion["attitude_xyzw"]))[:, 0]
        rate = np.array(motion["rate_radps"])
        cone = math.degrees(math.acos(abs(rate[0]) / 0.1))
        assert math.degrees(math.acos(-axis[2])) <= TILT_DEG + 0.1
        assert np.linalg.norm(rate) == pytest.approx(0.1, abs=1e-5)
        assert CONE_DEG[0] - 0.1 <= cone <= CONE_DEG[1] + 0.1


def test_only_selects_groups_and_scenarios_in_the_order_of_the_suite(suite):
    names = [each.name for each in suite.select(["moved-push", "clean"])]
    assert names == ["clean-slow", "clean-medium", "clean-fast", "clean-faster", "moved-push"]
    with pytest.raises(UsageError, match="clear"):
        suite.select(["clear"])


def test_the_quick_part_has_a_scenario_of_each_group(suite):
    quick = suite.select(suite.params.quick)
    assert sorted(each.group for each in quick) == sorted(GROUPS)


def test_an_unknown_suite_is_named():
    with pytest.raises(UsageError, match="capture-0"):
        load_suite("capture-0")


def test_tables_are_merged_and_values_replaced():
    base = {"a": {"b": 1, "c": 2}, "d": 3}
    assert merged(base, {"a": {"b": 4}, "d": [5]}) == {"a": {"b": 4, "c": 2}, "d": [5]}
    assert base["a"]["b"] == 1


def test_data_that_are_missing_or_others_are_said_so(suite, tmp_path):
    (scenario,) = suite.select(["real-tosses"])
    lost = prepare(suite, scenario, 1, 0, tmp_path / "logs", tmp_path)
    assert lost.missing == "not available"
    home = tmp_path / "cube-tosses"
    home.mkdir()
    (home / "tosses.csv").write_text("toss\n")
    (home / "cube.obj").write_text("")
    other = prepare(suite, scenario, 1, 0, tmp_path / "logs", tmp_path)
    assert other.missing.startswith("other files than those of the suite")


def test_entries_are_paired_as_asked():
    every = [entry.name for entry in entries_of()]
    assert every[0] == "horn+own"
    assert {"reference+own", "kiss+own", "gicp+own", "plane+own", "open3d+own"} <= set(every)
    assert {"horn+paper", "horn+ekf"} <= set(every)
    assert [e.name for e in entries_of(["kiss"])] == ["kiss+own"]
    assert [e.name for e in entries_of([], ["ekf"])] == ["horn+ekf"]
    both = [e.name for e in entries_of(["kiss", "horn"], ["own", "ekf"])]
    assert both == ["kiss+own", "kiss+ekf", "horn+own", "horn+ekf"]


def test_an_unknown_entry_is_an_error_and_a_library_that_is_missing_is_not():
    with pytest.raises(UsageError, match="nothing"):
        _ = entries_of(["nothing"])[0].missing
    with pytest.raises(UsageError, match="nothing"):
        _ = entries_of([], ["nothing"])[0].missing
    assert entries_of(["horn"])[0].missing == ""
    assert entries_of(["open3d"])[0].missing in ("", "not installed")
