"""Scenarios: strict reading, faults with the effect of their label, equal scans for equal seeds."""

import hashlib
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from true_scans import true_scans

from avsreplay import geometry, toml_document
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.parts import FAULTS
from avsreplay.records import ScanStatus
from avsreplay.report.charts import PLACE_STYLES
from avsreplay.simulate import faults as kinds
from avsreplay.simulate.faults import InjectedFault, active
from avsreplay.simulate.recorded_faults import disturbed
from avsreplay.simulate.scenario import StartParams, belief, load_scenario, scenario_of
from avsreplay.simulate.simulation import SIMULATED_EPOCH_NS, simulate
from avsreplay.simulate.target import builtin_surface

CAMPAIGN_KINDS = {  # what docs/results.md has figures of
    *("occlusion", "partial_occlusion", "dropped", "empty", "clutter", "range_bias"),
    *("noise_burst", "frozen", "stamp_jump"),
}
SURFACE = builtin_surface()
MESH = trimesh.Trimesh(SURFACE.vertices, SURFACE.faces, process=False)
SMALL = """
seed = 5
duration_s = 6.0
rate_hz = 2.0
[motion]
attitude_xyzw = [0.1, 0.7, -0.1, 0.7]
rate_radps = [0.06, 0.064, -0.048]
[scanner]
rays = [40, 40]
outlier_ratio = 0.0
"""


def scenario(extra="", seed=None):
    return scenario_of(toml_document.parse(SMALL + extra, "test.toml"), seed)


def scans(extra="", seed=None):
    return list(true_scans(simulate(scenario(extra, seed), SURFACE)))


def fault(kind, start=2.0, duration=1.0, **more):
    lines = "".join(f"{k} = {str(v).lower()}\n" for k, v in more.items())
    return f'[[fault]]\nkind = "{kind}"\nstart_s = {start}\nduration_s = {duration}\n{lines}'


def on_model(scan):
    return trimesh.proximity.closest_point(MESH, scan.truth.inverse().apply(scan.points))[1]


@pytest.fixture(scope="module")
def plain():
    return scans()


def test_the_builtin_scenario_is_the_documented_one():
    s = load_scenario()
    p = s.params
    assert (p.duration_s, p.rate_hz, p.scanner.noise_m, p.scanner.outlier_ratio) == (
        120.0,
        5.0,
        0.008,
        0.02,
    )
    assert math.hypot(*p.motion.rate_radps) == pytest.approx(0.1, rel=1e-3)
    assert math.hypot(*p.motion.position_m) == pytest.approx(5.0, rel=1e-2)
    kinds = [(f.kind, f.start_s, f.duration_s) for f in p.fault]
    assert [k for k, *_ in kinds].count("dropped") == 2
    assert next(d for k, t, d in kinds if k == "occlusion" and t >= 60.0) == 12.0
    assert next(d for k, _, d in kinds if k == "partial_occlusion") == 6.0
    simulation = simulate(s, SURFACE)
    assert simulation.count == 600
    truth, start = simulation.header.truth, simulation.header.start.x
    assert np.abs(start.w_b - truth.w_b).max() < 0.01
    assert np.abs(start.sigma - truth.sigma).max() < 0.1
    assert np.abs(start.c_b - truth.c_b).max() < 0.1
    assert (
        np.degrees(geometry.angle(geometry.multiply(geometry.conjugate(truth.q_bc), start.q_bc)))
        < 2.0
    )


def test_builtin_scans_have_about_4000_points():
    s = load_scenario()
    thin = replace(s, params=replace(s.params, rate_hz=0.5, fault=()))
    counts = [len(scan.points) for scan in simulate(thin, SURFACE).scans()]
    assert 3500 < np.mean(counts) < 4700
    assert min(counts) > 2000


def test_scans_come_at_their_instants_with_their_truth(plain):
    simulation = simulate(scenario(), SURFACE)
    assert [s.seq for s in plain] == list(range(12))
    assert [s.t_ns - SIMULATED_EPOCH_NS for s in plain] == [500_000_000 * k for k in range(12)]
    for scan in plain:
        assert scan.t_ns == scan.log_ns
        assert scan.points.dtype == np.float32
        assert scan.times_s is None
        truth = simulation.truth(scan.log_ns)
        assert_allclose(scan.truth.matrix, truth.T_ac.matrix, atol=1e-15)
        assert np.sqrt(np.mean(on_model(scan) ** 2)) < 0.009


def test_same_seed_same_scans_and_another_seed_others(plain):
    def digest(run):
        return hashlib.sha256(b"".join(s.points.tobytes() for s in run)).hexdigest()

    assert digest(plain) == digest(scans())
    assert digest(plain) != digest(scans(seed=6))


def test_a_fault_leaves_all_other_scans_as_they_were(plain):
    for kind in FAULTS.names():
        run = {s.seq: s for s in scans(fault(kind))}
        for scan in plain:
            if scan.seq not in (4, 5) and scan.seq in run:
                assert np.array_equal(run[scan.seq].points, scan.points)
                assert run[scan.seq].fault is None


def test_faults_do_not_change_the_truth(plain):
    for kind in FAULTS.names():
        for scan in scans(fault(kind)):
            assert_allclose(scan.truth.matrix, plain[scan.seq].truth.matrix, atol=0)


def test_dropped_scans_are_not_there():
    assert [s.seq for s in scans(fault("dropped"))] == [0, 1, 2, 3, 6, 7, 8, 9, 10, 11]


def test_empty_scans_have_no_point():
    run = scans(fault("empty"))
    assert [len(s.points) for s in run[4:6]] == [0, 0]
    assert [s.status for s in run[4:6]] == [ScanStatus.EMPTY] * 2
    assert run[4].fault == "empty"


def test_a_full_occlusion_leaves_a_few_points_far_from_the_target(plain):
    for scan in scans(fault("occlusion"))[4:6]:
        assert 0 < len(scan.points) < 0.12 * len(plain[scan.seq].points)
        assert on_model(scan).min() > 0.5


@pytest.mark.parametrize("hidden", [0.3, 0.8])
def test_a_partial_occlusion_hides_its_share_from_one_side(plain, hidden):
    run = scans(fault("partial_occlusion", strength=hidden))
    for scan in run[4:6]:
        good = on_model(scan) < 0.1
        n = len(plain[scan.seq].points)
        assert abs(np.sum(good) - (1 - hidden) * n) < 3
        assert np.sum(~good) < 3 * 0.05 * n
    middle = [
        np.mean(s.points[on_model(s) < 0.1, :2], axis=0)
        - np.mean(plain[s.seq].points[:, :2], axis=0)
        for s in run[4:6]
    ]
    assert middle[0] @ middle[1] > 0.9 * np.linalg.norm(middle[0]) * np.linalg.norm(middle[1])


def test_clutter_adds_its_share_about_the_target(plain):
    scan = scans(fault("clutter", strength=0.5))[4]
    n = len(plain[4].points)
    assert len(scan.points) == n + round(0.5 * n)
    assert np.array_equal(scan.points[:n], plain[4].points)
    assert np.mean(on_model(scan)[n:] > 0.05) > 0.8
    centre = scan.truth.apply(0.5 * (SURFACE.vertices.min(axis=0) + SURFACE.vertices.max(axis=0)))
    assert np.linalg.norm(scan.points[n:] - centre, axis=1).max() < 1.2 * SURFACE.extent / 2 + 1e-3


def test_a_range_bias_adds_to_every_range(plain):
    scan = scans(fault("range_bias", strength=0.25))[4]
    gain = np.linalg.norm(scan.points, axis=1) - np.linalg.norm(plain[4].points, axis=1)
    assert_allclose(gain, 0.25, atol=1e-5)


def test_a_noise_burst_multiplies_the_noise(plain):
    loud = scans(fault("noise_burst", strength=4.0))[4]
    quiet = scans(fault("noise_burst", strength=1e-9))[4]
    ranges = [np.linalg.norm(s.points, axis=1) for s in (loud, plain[4], quiet)]
    assert_allclose(ranges[0] - ranges[2], 4.0 * (ranges[1] - ranges[2]), atol=1e-5)


def test_frozen_scans_repeat_the_last_one_before(plain):
    run = scans(fault("frozen"))
    for scan in run[4:6]:
        assert np.array_equal(scan.points, plain[3].points)
        assert scan.t_ns == plain[scan.seq].t_ns
    assert (
        scans(fault("frozen", start=0.0))[0].points.shape == plain[0].points.shape
    )  # nothing to repeat yet


def test_stamps_jump_and_the_log_clock_does_not(plain):
    run = scans(fault("stamp_jump", strength=-7.5))
    assert [s.t_ns - s.log_ns for s in run] == [0] * 4 + [-7_500_000_000] * 2 + [0] * 6
    assert np.array_equal(run[4].points, plain[4].points)


def test_labels_are_half_open_windows_on_the_log_clock():
    simulation = simulate(scenario(fault("clutter", start=2.0, duration=1.0)), SURFACE)
    (found,) = simulation.header.labels
    assert (found.kind, found.harmful, found.strength) == ("clutter", False, 0.5)
    inside = [s.seq for s in simulation.scans() if found.start_ns <= s.log_ns < found.end_ns]
    assert inside == [4, 5] == [s.seq for s in true_scans(simulation) if s.fault == "clutter"]


def test_a_label_says_harmful_by_kind_unless_the_scenario_says_otherwise():
    said = {kind: InjectedFault(kind, 0.0, 1.0).label(0).harmful for kind in FAULTS.names()}
    harmless = {"partial_occlusion", "clutter", "noise_burst", "outliers", "subsampled"} | {
        "frame_rate"
    }
    assert {kind for kind, harmful in said.items() if not harmful} == harmless
    assert InjectedFault("clutter", 0.0, 1.0, harmful=True).label(0).harmful


def test_faults_may_overlap():
    both = [InjectedFault("clutter", 0.0, 2.0), InjectedFault("noise_burst", 1.0, 2.0)]
    assert active(both, 0, 1_500_000_000) == list(enumerate(both))
    run = scans(fault("range_bias", 2.0, 1.0) + fault("stamp_jump", 2.5, 1.0))
    assert [s.fault for s in run[3:8]] == [None, "range_bias", "range_bias", "stamp_jump", None]
    assert run[5].t_ns - run[5].log_ns == 30_000_000_000


def test_the_first_belief_is_drawn_from_its_own_covariance():
    """Normalised errors over 200 seeds: each of the 20 mean squares inside its 99.99 % band."""
    truth = simulate(scenario(), SURFACE).header.truth
    start = StartParams()
    drawn = [belief(start, truth, 0, np.random.Generator(np.random.PCG64(k))) for k in range(200)]
    errors = np.array([_error(truth, b.x) / np.sqrt(np.diag(b.P)) for b in drawn])
    square = np.mean(errors**2, axis=0)
    assert square.shape == (20,)
    assert np.all((square > 0.63) & (square < 1.48))


def _error(truth, mean):
    """The 20 errors as the state convention has them: q = dq (x) q_hat, mu = mu_hat (x) dmu,
    all else a difference.
    """
    dq = geometry.normalise(geometry.multiply(geometry.conjugate(mean.q_ab), truth.q_ab))
    dmu = geometry.normalise(geometry.multiply(truth.q_bc, geometry.conjugate(mean.q_bc)))
    plain = [getattr(truth, n) - getattr(mean, n) for n in ("w_b", "r_a", "v_a", "sigma", "c_b")]
    return np.concatenate([dq[:3], *plain, dmu[:3]])


def test_offsets_that_are_given_are_used_as_they_are():
    truth = simulate(scenario(), SURFACE).header.truth
    given = StartParams(
        rate_offset_radps=(0.01, 0, 0), mu_offset_deg=(0, 2.0, 0), sigma_offset=(0.0, 0.05)
    )
    mean = belief(given, truth, 0, np.random.Generator(np.random.PCG64(0))).x
    assert_allclose(mean.w_b - truth.w_b, [0.01, 0, 0], atol=1e-15)
    assert_allclose(mean.sigma - truth.sigma, [0, 0.05], atol=1e-15)
    turn = geometry.multiply(mean.q_bc, geometry.conjugate(truth.q_bc))
    assert_allclose(np.degrees(geometry.log(turn)), [0, 2.0, 0], atol=1e-9)


def test_an_offset_to_an_impossible_inertia_is_one_line():
    truth = simulate(scenario(), SURFACE).header.truth
    given = StartParams(sigma_offset=(1.5, 0.0))
    with pytest.raises(UsageError, match="inertia ratios are") as error:
        belief(given, truth, 0, np.random.Generator(np.random.PCG64(0)))
    assert error.value.where == "start.sigma_offset"


def test_without_a_start_table_there_is_no_first_belief():
    assert simulate(scenario(), SURFACE).header.start is None
    assert simulate(scenario("[start]\n"), SURFACE).header.start is not None


def test_a_run_table_is_passed_on():
    assert scenario("[run]\nbackend = 'kiss'\n[run.horn]\nn_max = 3\n").params.run == {
        "backend": "kiss",
        "horn": {"n_max": 3},
    }


def test_a_motion_that_needs_too_many_steps_is_one_line():
    """Fast for its length, or so fast that a step is below the resolution of the time."""
    found = scenario()
    for rate in (1e5, 1e99):
        motion = replace(found.params.motion, rate_radps=(rate, 0.0, 0.0))
        with pytest.raises(UsageError, match="steps"):
            simulate(replace(found, params=replace(found.params, motion=motion)), SURFACE)


def test_a_motion_that_becomes_too_fast_is_one_line(monkeypatch):
    monkeypatch.setattr("avsreplay.simulate.motion.MAX_INTEGRATION_STEPS", 200)
    found = scenario()
    motion = replace(found.params.motion, torque_std_radps2=100.0, disturbance_step_s=0.1)
    with pytest.raises(UsageError, match="steps"):
        simulate(replace(found, params=replace(found.params, motion=motion)), SURFACE)


@pytest.mark.parametrize(
    ("extra", "line", "words"),
    [
        ("[scaner]\nx = 1\n", 11, "scanner"),
        ("[start]\nsigma_st = 1\n", 12, "sigma_std"),
        (fault("oclusion"), 12, "occlusion"),
        (fault("clutter", strenght=1), 15, "strength"),
        (fault("dropped", strength=1.0), 15, "no strength"),
        (fault("occlusion", strength=1.5), 15, "at most 1"),
        (fault("clutter", start=-1.0), 13, "start_s"),
        ("[target]\nshape = 'boat'\n", 12, "satellite"),
        ("[start]\nmu_std_deg = 0.0\n", 12, "mu_std_deg"),
        ("[motion.x]\ny = 1\n", 11, "unknown key"),
        (fault("occlusion", start=1e15), 13, "start_s"),
        (fault("occlusion", duration=1e300), 14, "duration_s"),
    ],
)
def test_wrong_scenarios_are_refused_with_file_and_line(extra, line, words):
    with pytest.raises(UsageError, match=words) as caught:
        scenario(extra)
    assert str(caught.value).startswith(f"test.toml:{line}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "seed = -1",
        "duration_s = 0.0",
        "rate_hz = inf",
        "duration_s = 1e9",
        "rate_hz = 10.0\n[scanner]\npattern='raster'\nscan_s=0.5",
    ],
)
def test_impossible_totals_are_refused(text):
    with pytest.raises(UsageError):
        scenario_of(toml_document.parse(text, "x.toml"))


def test_missing_and_broken_files_are_one_line(tmp_path):
    with pytest.raises(UnreadableInput, match="no such file"):
        load_scenario(tmp_path / "none.toml")
    broken = tmp_path / "broken.toml"
    broken.write_text("seed = \n")
    with pytest.raises(UsageError, match="not valid TOML"):
        load_scenario(broken)


def test_a_model_is_named_beside_the_scenario(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text("[target]\nmodel = 'm.stl'\n")
    assert load_scenario(path).model == tmp_path / "m.stl"
    assert load_scenario().model is None
    assert isinstance(load_scenario(path).folder, Path)


@pytest.mark.parametrize(
    "path",
    sorted((Path(__file__).parent.parent / "docs" / "scenarios").glob("*.toml")),
    ids=lambda p: p.stem,
)
def test_the_ready_scenarios_see_their_target(path):
    loaded = load_scenario(path)
    simulation = simulate(loaded, builtin_surface(loaded.params.target.shape))
    first = next(true_scans(simulation))
    assert len(first.points) > 100
    assert loaded.params.name == path.stem


def test_the_three_strengths_of_faults_hold_the_same_kinds():
    for level in ("weak", "medium", "strong"):
        params = load_scenario(
            Path(__file__).parent.parent / "docs" / "scenarios" / f"faults-{level}.toml"
        ).params
        assert {f.kind for f in params.fault} == CAMPAIGN_KINDS


def test_the_documentation_has_the_table_of_the_kinds():
    page = (Path(__file__).parent.parent / "docs" / "scenario.md").read_text(encoding="utf-8")
    table = "\n".join(kinds.table())
    assert table in page, "copy what 'python -m avsreplay.simulate.faults' prints"
    assert table.count("\n") == 1 + len(FAULTS.names())


def test_every_kind_is_registered_under_its_name_and_has_a_colour():
    """A class without an entry in pyproject.toml could not be used."""
    classes = [each for each in vars(kinds).values() if isinstance(each, type)]
    own = {
        each.name: each
        for each in classes
        if issubclass(each, kinds.Fault) and each is not kinds.Fault
    }
    assert own == {name: FAULTS.load(name) for name in FAULTS.names()}
    assert set(PLACE_STYLES["injected"]) == set(FAULTS.names())


@pytest.mark.parametrize("kind", FAULTS.names())
def test_every_kind_changes_the_scans_of_its_window(kind, plain):
    """Other points, another stamp, or no scan; frame_rate leaves the first scan of the window."""
    run = {s.seq: s for s in scans(fault(kind))}
    changed = [
        k not in run
        or run[k].t_ns != plain[k].t_ns
        or run[k].points.tobytes() != plain[k].points.tobytes()
        for k in range(12)
    ]
    expected = [k == 5 if kind == "frame_rate" else k in (4, 5) for k in range(12)]
    assert changed == expected


def test_a_kind_of_another_package_needs_no_change_here(plain, monkeypatch):
    class Shrunk(kinds.Fault):
        """The ranges are halved."""

        name = "shrunk"
        about = "half of every range"
        harmful = True
        stage = kinds.Stage.RETURNS

        def apply(self, shot, at, rng):
            halved = replace(shot.returns, ranges=0.5 * shot.returns.ranges)
            return replace(shot, returns=halved)

    monkeypatch.setitem(FAULTS.built_in, "shrunk", Shrunk)
    found = scans(fault("shrunk"))
    assert_allclose(found[4].points, 0.5 * plain[4].points, rtol=1e-6)
    assert found[4].fault == "shrunk"
    given = list(simulate(scenario(), SURFACE).scans())[4:5]
    fault_now = InjectedFault.parse("shrunk:0:1")
    ((_, recorded),) = disturbed(given, [fault_now], given[0].log_ns, 0, None)
    assert_allclose(recorded.points, 0.5 * plain[4].points, rtol=1e-6)
    assert any(line.startswith("| `shrunk` |") and "| yes |" in line for line in kinds.table())
