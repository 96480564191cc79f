"""Campaign files and the runs that they describe; no run is executed here."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.simulate.scenario import load_scenario
from avsreplay.sweep.campaign import load_campaign
from avsreplay.sweep.expansion import expand

BASE = """
name = "test"
seed = 4
repeats = 3
[set]
"scenario.duration_s" = 4.0
[[grid]]
key = "scenario.scanner.noise_m"
values = [0.004, 0.008]
[[grid]]
key = "run.faults.policy"
values = ["any", "all"]
"""


def plan_of(tmp_path, text):
    path = tmp_path / "c.toml"
    path.write_text(text)
    return expand(load_campaign(path))


def tables(plan):
    return [tomllib.loads(point.task.scenario) for point in plan.points()]


def test_a_grid_is_every_combination_and_every_repeat(tmp_path):
    plan = plan_of(tmp_path, BASE)
    points = list(plan.points())
    assert len(plan) == len(points) == 12
    assert [p.index for p in points] == list(range(12))
    assert {(p.cell, p.repeat) for p in points} == {(c, r) for c in range(4) for r in range(3)}
    assert len({p.task.id for p in points}) == 12
    assert [p.seed for p in points] == [table["seed"] for table in tables(plan)]
    assert {p.task.assignments for p in points} == {
        ('faults.policy="any"',),
        ('faults.policy="all"',),
    }
    for point, table in zip(points, tables(plan), strict=True):
        assert table["scanner"]["noise_m"] == point.values["scenario.scanner.noise_m"]
        assert table["duration_s"] == 4.0


def test_unset_values_come_from_the_scenario(tmp_path):
    table = tables(plan_of(tmp_path, BASE))[0]
    base = tomllib.loads(load_scenario().text)
    for key in ("motion", "fault", "start", "target", "rate_hz"):
        assert table[key] == base[key]
    assert {**table["scanner"], "noise_m": 0.008} == {**base["scanner"], "noise_m": 0.008}


def test_combinations_of_one_repeat_share_their_seed_and_repeats_do_not(tmp_path):
    plan = plan_of(tmp_path, BASE)
    seeds = {(p.repeat, t["seed"]) for p, t in zip(plan.points(), tables(plan), strict=True)}
    assert len(seeds) == 3
    assert len({seed for _, seed in seeds}) == 3


def test_a_run_keeps_its_name_when_the_campaign_grows(tmp_path):
    names = {p.task.id for p in plan_of(tmp_path, BASE).points()}
    grown = BASE.replace("repeats = 3", "repeats = 5").replace(
        "[0.004, 0.008]", "[0.004, 0.008, 0.016]"
    )
    assert names < {p.task.id for p in plan_of(tmp_path, grown).points()}
    assert names.isdisjoint(
        p.task.id for p in plan_of(tmp_path, BASE.replace("seed = 4", "seed = 5")).points()
    )


def test_cases_are_alternatives(tmp_path):
    text = """
[[case]]
name = "near"
[[case]]
name = "noisy"
set = { "scenario.scanner.noise_m" = 0.05, "scenario.fault.0.start_s" = 3.0 }
"""
    near, noisy = tables(plan_of(tmp_path, text))
    assert (near["scanner"]["noise_m"], noisy["scanner"]["noise_m"]) == (0.008, 0.05)
    assert noisy["fault"][0]["start_s"] == 3.0
    assert near["fault"][0]["start_s"] != 3.0
    assert {k: v for k, v in near["fault"][0].items() if k != "start_s"} == {
        k: v for k, v in noisy["fault"][0].items() if k != "start_s"
    }
    assert near["fault"][1:] == noisy["fault"][1:]


def test_draws_follow_their_distribution_and_are_independent(tmp_path):
    head = "repeats = 300\n[set]\n"
    one = '[[draw]]\nkey = "scenario.scanner.noise_m"\nkind = "uniform"\nlow = 0.01\nhigh = 0.02\n'
    two = '[[draw]]\nkey = "scenario.motion.attitude_xyzw"\nkind = "attitude"\n'
    three = (
        '[[draw]]\nkey = "scenario.motion.rate_radps"\nkind = "direction"\nlow = 0.1\nhigh = 0.1\n'
    )
    alone = [t["scanner"]["noise_m"] for t in tables(plan_of(tmp_path, head + one))]
    together = tables(plan_of(tmp_path, head + two + three + one))
    assert alone == [t["scanner"]["noise_m"] for t in together]
    assert stats.kstest(alone, "uniform", (0.01, 0.01)).pvalue > 1e-3
    q = np.array([t["motion"]["attitude_xyzw"] for t in together])
    assert_allclose(np.linalg.norm(q, axis=1), 1)
    assert (
        stats.kstest(2 * np.arccos(np.abs(q[:, 3])), lambda a: (a - np.sin(a)) / np.pi).pvalue
        > 1e-3
    )
    w = np.array([t["motion"]["rate_radps"] for t in together])
    assert_allclose(np.linalg.norm(w, axis=1), 0.1)
    assert stats.kstest(w[:, 0] / 0.1, "uniform", (-1, 2)).pvalue > 1e-3


@pytest.mark.parametrize(
    ("kind", "more", "law"),
    [
        (
            "normal",
            "low = 0.5\nhigh = 0.1",
            lambda v: stats.kstest(v, "norm", (0.5, 0.1)).pvalue > 1e-3,
        ),
        (
            "log_uniform",
            "low = 0.1\nhigh = 10",
            lambda v: stats.kstest(np.log10(v), "uniform", (-1, 2)).pvalue > 1e-3,
        ),
        ("choice", "values = [0.25, 0.5]", lambda v: set(v) == {0.25, 0.5}),
        (
            "integer",
            "low = 1\nhigh = 3",
            lambda v: set(v) == {1, 2, 3} and all(isinstance(x, int) for x in v),
        ),
    ],
)
def test_kinds_of_draws(tmp_path, kind, more, law):
    text = f'repeats = 200\n[[draw]]\nkey = "scenario.rate_hz"\nkind = "{kind}"\n{more}\n'
    assert law([t["rate_hz"] for t in tables(plan_of(tmp_path, text))])


def test_scenarios_are_an_axis(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "m.ply").write_bytes(b"one")
    (tmp_path / "sub" / "a.toml").write_text('rate_hz = 1.0\n[target]\nmodel = "m.ply"\n')
    (tmp_path / "b.toml").write_text("rate_hz = 2.0\n")
    text = 'scenarios = ["sub/a.toml", "b.toml"]\nrepeats = 2\n[set]\n"scenario.duration_s" = 4.0\n'
    plan = plan_of(tmp_path, text)
    points = list(plan.points())
    assert [p.values["scenario"] for p in points] == ["sub/a.toml", "b.toml"] * 2
    assert [t["rate_hz"] for t in tables(plan)] == [1.0, 2.0] * 2
    assert [Path(p.task.folder).name for p in points[:2]] == ["sub", tmp_path.name]
    before = [p.task.id for p in points]
    (tmp_path / "sub" / "m.ply").write_bytes(b"two")
    after = [p.task.id for p in plan_of(tmp_path, text).points()]
    assert [a == b for a, b in zip(before, after, strict=True)] == [False, True] * 2


def test_logs_are_an_axis(tmp_path):
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).write_bytes(name.encode())
    text = (
        'logs = ["a.mcap", "b.mcap"]\n[[grid]]\nkey = "run.register.backend"\nvalues = ["horn",'
        ' "kiss"]\n'
    )
    points = list(plan_of(tmp_path, text).points())
    assert [p.values["log"] for p in points] == ["a.mcap", "a.mcap", "b.mcap", "b.mcap"]
    assert all(p.task.scenario == "" for p in points)
    before = {p.task.id for p in points}
    (tmp_path / "a.mcap").write_bytes(b"other")
    after = {p.task.id for p in plan_of(tmp_path, text).points()}
    assert len(before & after) == 2  # another content is another run


@pytest.mark.parametrize("changed", ["job.toml", "m.ply", "bag/a.db3"])
def test_a_job_file_stands_for_all_that_it_names(tmp_path, changed):
    (tmp_path / "bag").mkdir()
    files = {"bag/a.db3": "a", "m.ply": "m", "job.toml": 'log = "bag"\n[input]\nmodel = "m.ply"\n'}
    for name, text in files.items():
        (tmp_path / name).write_text(text)

    def ids() -> list[str]:
        return [p.task.id for p in plan_of(tmp_path, 'logs = ["job.toml"]\n').points()]

    before = ids()
    assert before == ids()
    (tmp_path / changed).write_text(files[changed] + " ")
    assert before != ids()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[[grid]]\nkey = "scenario.scanner.noize"\nvalues = [1.0]\n', "noise_m"),
        ('[[grid]]\nkey = "scenario.scanner.noise_m"\nvalues = [0.1, -1.0]\n', "noise_m = -1.0"),
        ('[[grid]]\nkey = "run.faults.polcy"\nvalues = ["any"]\n', "policy"),
        ('[[grid]]\nkey = "faults.policy"\nvalues = ["any"]\n', "must begin with"),
        ('[[grid]]\nkey = "scenario.seed"\nvalues = []\n', "not empty"),
        ('[set]\n"scenario.fault.9.start_s" = 1.0\n', "names no setting"),
        ('[set]\n"scenario.name.x" = 1.0\n', "names no setting"),
        ("repeats = 0\n", "repeats"),
        ("repets = 1\n", "repeats"),
        ('logs = ["none.mcap"]\n', "No such file"),
        ('logs = ["x"]\n[set]\n"scenario.seed" = 1\n', "cannot be set where logs"),
        ('[[draw]]\nkey = "scenario.seed"\nkind = "choice"\n', "needs values"),
        (
            (
                '[[grid]]\nkey = "run.init"\nvalues = ["log"]\n[[draw]]\nkey = "run.init"\nkind ='
                ' "attitude"\n'
            ),
            "twice",
        ),
    ],
)
def test_wrong_campaigns_are_one_line(tmp_path, text, words):
    with pytest.raises((UsageError, UnreadableInput), match=words) as caught:
        plan_of(tmp_path, text)
    assert "\n" not in str(caught.value)
    assert str(caught.value).count(":") >= 1


def test_settings_given_as_a_table_reach_the_run(tmp_path):
    text = (
        '[[case]]\nname = "a"\nset = { "run.register" = { n_max = 7, backend = "kiss" }, "run.init"'
        ' = "auto" }\n'
    )
    (point,) = plan_of(tmp_path, text).points()
    assert set(point.task.assignments) == {
        "register.n_max=7",
        'register.backend="kiss"',
        'init="auto"',
    }
