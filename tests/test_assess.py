"""The task, contact with the body, and the assessment of a capture."""

import io
import json
import math
import subprocess
import sys
from dataclasses import replace
from functools import partial
from itertools import islice

import numpy as np
import pytest

from avsreplay.assess import (
    FlightLog,
    ScanErrors,
    Setup,
    assess,
    drawn_beliefs,
    measured,
    simulated,
)
from avsreplay.assessment import Assessment, Chance, InFact, chance_of
from avsreplay.build import target_geometry
from avsreplay.estimate.chart import to_chart, to_errors, to_state
from avsreplay.estimate.estimator import Estimator
from avsreplay.estimate.grasp_point import at_grasp
from avsreplay.estimate.params import EstimatorParams
from avsreplay.geometry import covariance_about, exp, matrix
from avsreplay.log import SourceOptions
from avsreplay.monitor.convergence import Convergence, ConvergenceParams, ConvergenceTrack
from avsreplay.outcome import CaptureError
from avsreplay.pipeline import planner_input
from avsreplay.plan.contact import Contact
from avsreplay.plan.guidance import Guidance
from avsreplay.plan.limits import Scene
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.plan.robot import Limits, RobotParams
from avsreplay.plan.supervisor import Supervisor, SupervisorParams
from avsreplay.records import Belief, State, Surface
from avsreplay.report.summary import Summary
from avsreplay.report.summary_tables import print_screen
from avsreplay.report.table import make_console
from avsreplay.report.verdict import verdict_of
from avsreplay.run import Job, Run
from avsreplay.saved_result import task_settings
from avsreplay.simulate.target import Shape, builtin_surface
from avsreplay.task import Approach, TaskParams, patches, task_of

TOLERANCE = CaptureError(0.013, 0.0066, 2.0)
HELD = ConvergenceTrack(True, since_ns=-10_000_000_000)


def body(shape=Shape.CUBE, shift=(0.0, 0.0, 0.0)):
    made = builtin_surface(shape)
    surface = Surface(made.vertices + np.array(shift), made.faces, "body", "")
    return surface, target_geometry(surface, (1.0, 0.0, 0.0)).surface


def task(surface, closest, limits=None, **given):
    return task_of(
        TaskParams(**given),
        SupervisorParams(),
        RobotParams(),
        (1.0, 0.0, 0.0),
        surface,
        closest,
        limits,
    )


@pytest.mark.parametrize("shape", list(Shape))
def test_the_grasp_point_of_every_built_in_body_can_be_used(shape):
    assert task(*body(shape)).problem == ""


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ({"grasp_m": (-0.5, 0.0, 0.0)}, "inside the body"),
        ({"grasp_m": (0.4, 0.0, 0.0)}, "off the surface"),
        ({"grasp_m": (0.0, 0.0, 0.0), "axis": (-1.0, 0.0, 0.0)}, "passes through the body"),
    ],
)
def test_a_grasp_point_that_cannot_be_reached_is_found_before_the_run(given, word):
    assert word in task(*body(), **given).problem


def test_the_task_in_one_line_states_its_tolerances_in_mm():
    given = {"position_m": 0.012349, "speed_mps": 0.0045549, "angle_deg": 1.5, "radius_m": 0.07}
    text = task(*body(), opening_m=0.25, **given).text
    assert "within 12.3 mm, 4.55 mm/s and 1.5 deg" in text
    assert "opening 250 mm, radius 70 mm" in text


@pytest.mark.parametrize("shape", list(Shape))
def test_every_proposed_patch_is_a_grasp_point_on_the_surface_that_can_be_used(shape):
    surface, closest = body(shape, (0.3, -0.2, 0.1))
    found = patches(surface, closest)
    assert 1 <= len(found) <= 3
    for patch in found:
        foot, gap = closest(np.array([patch.point]))
        assert abs(gap[0]) < 1e-3 * surface.extent
        assert np.linalg.norm(foot[0] - patch.point) < 1e-3 * surface.extent
        assert math.hypot(*patch.axis) == pytest.approx(1.0)
        assert task(surface, closest, patch=patch.name).problem == ""
    with pytest.raises(ValueError, match="the model has: flat-1"):
        task(surface, closest, patch="flat-9")


def test_a_corridor_does_not_end_inside_the_part_at_the_grasp_point():
    limits = Limits(final_deg=15.0, clearance_m=0.1)
    surface, closest = body(Shape.BRACKET)
    made = task(surface, closest, limits).corridor(limits).resolved(surface.extent)
    end = np.array([[made.final_range_m, 0.0, 0.0]])
    assert closest(end)[1][0] >= 0.1


def test_the_approach_is_along_the_axis_unless_the_limits_set_a_cone():
    free, cone = Limits(), Limits(cone_deg=30.0)
    along = task(*body(Shape.BRACKET))
    assert along.corridor(free).final_deg == pytest.approx(15.0)
    assert along.corridor(free).clearance_m > 0.0
    assert "approach along the axis" in along.assumed
    assert along.corridor(cone) == cone
    anywhere = task(*body(Shape.BRACKET), approach=Approach.FREE)
    assert anywhere.corridor(free) == free
    assert "approach along the axis" not in anywhere.assumed
    off = task(*body(), grasp_m=(0.4, 0.0, 0.0))  # a grasp point that cannot be used
    assert off.problem
    assert off.corridor(free) == free
    assert task_settings(anywhere.record()).approach is Approach.FREE
    assert task_settings(along.record()).approach is Approach.AXIS


def contact(radius_m=0.0, half_m=0.01, mouth_m=0.0):
    _, closest = body()
    return Contact(closest, np.array([1.0, 0.0, 0.0]), radius_m, half_m, mouth_m)


def test_a_straight_approach_is_no_contact_and_a_path_through_the_body_is():
    x = np.linspace(2.0, 0.0, 101)
    straight = np.column_stack([x, 0.0 * x, 0.0 * x])
    through = np.column_stack([-x - 0.5, 0.0 * x, 0.0 * x])[::-1]
    assert contact().touched(np.array([straight, straight[::-1] * [-1, 1, 1]])).tolist() == [
        False,
        True,
    ]
    assert contact(radius_m=0.05).touched(straight[None])[0] == np.False_
    assert contact().touched(through[::-1][None])[0]


def test_a_part_that_the_gripper_encloses_is_entered_through_the_mouth_only():
    _, closest = body(Shape.BRACKET)
    grip = Contact(closest, np.array([1.0, 0.0, 0.0]), 0.0, 0.07, 0.15)
    x = np.linspace(0.6, 0.0, 201)
    along = np.column_stack([x, 0.0 * x, 0.0 * x])
    aside = np.column_stack([0.0 * x + 0.03, x, 0.0 * x])
    assert grip.touched(np.array([along, aside])).tolist() == [False, True]
    back = np.concatenate([along, along[::-1]])  # as a robot that withdraws from the grasp
    assert not grip.touched(back[None])[0]
    assert grip.touched(np.concatenate([along, aside[::-1]])[None])[0]
    assert grip.enclosed(back[None]).sum() == 2 * grip.enclosed(along[None]).sum()


def belief(sigma=(0.1, -0.2), spread=1e-3, seed=0):
    rng = np.random.default_rng(seed)
    x = State(
        exp(rng.normal(size=3)),
        rng.normal(size=3) * 0.1,
        np.array([0.0, 0.0, 5.0]),
        rng.normal(size=3) * 0.01,
        np.array(sigma),
        rng.normal(size=3),
        exp(rng.normal(size=3)),
    )
    A = rng.normal(size=(20, 20)) * spread
    T = to_errors(to_chart(x))
    return Belief(0, x, T @ A @ A.T @ T.T), A @ A.T


@pytest.mark.parametrize("sigma", [(0.1, -0.2), (1e-3, -1e-3), (1e-5, 2e-5)])
def test_draws_have_the_covariance_of_the_chart_also_where_two_moments_are_equal(sigma):
    given, P = belief(sigma)
    steps, drawn = drawn_beliefs(given, 4000, np.random.default_rng(1))
    scale = np.sqrt(np.diag(P))
    assert np.abs((steps.T @ steps / 4000 - P) / np.outer(scale, scale)).max() < 0.1
    chart = to_chart(given.x)
    for y, each in zip(steps[:20], drawn[:20], strict=True):
        expected = to_state(chart.moved(y)).T_ac
        assert np.linalg.norm(each.x.T_ac.t - expected.t) < 1e-12
    # the pose of the fixture varies as its covariance in the chart says, not as that of the axes
    moved = np.array([each.x.T_ac.t - given.x.T_ac.t for each in drawn])
    assert np.abs(moved.std(axis=0) / np.sqrt(np.diag(P)[6:9]) - 1.0).max() < 0.1


def test_a_belief_about_another_point_has_its_position_and_covariance():
    given, _ = belief(spread=1e-4)
    point = np.array([0.3, -0.4, 0.2])
    moved = at_grasp(given, point)
    assert moved.x.T_ac.t == pytest.approx(given.x.T_ac.t + matrix(given.x.T_ac.q) @ point)
    _, drawn = drawn_beliefs(given, 3000, np.random.default_rng(2))
    _, others = drawn_beliefs(moved, 3000, np.random.default_rng(3))
    far = np.array([d.x.T_ac.t + matrix(d.x.T_ac.q) @ point for d in drawn]) - moved.x.T_ac.t
    near = np.array([d.x.T_ac.t for d in others]) - moved.x.T_ac.t
    A, B = np.cov(far.T), np.cov(near.T)
    assert np.abs(A - B).max() < 0.15 * np.abs(A).max()
    assert at_grasp(given, np.zeros(3)) is given


def setup_of():
    """An assessment of flights to a cube of 1 m without limits."""
    surface = builtin_surface(Shape.CUBE)
    target, robot, limits = target_geometry(surface, (1.0, 0.0, 0.0)), RobotParams(), Limits()
    supervisor = SupervisorParams()
    given = task_of(TaskParams(), supervisor, robot, (1.0, 0.0, 0.0), surface, target.surface)
    supervision = TaskParams().with_tolerance(supervisor).resolved(surface.extent)
    return Setup(
        task=given,
        estimator=Estimator(EstimatorParams(), None, surface.extent),
        guidance=Guidance(PlanParams(), Supervisor(supervision), limits, surface.extent),
        convergence=Convergence(ConvergenceParams(), surface.extent, given.tolerance.in_si),
        target=target,
        solid=True,
        extent_m=surface.extent,
        since_ns=0,
        flights=1,
    )


@pytest.mark.parametrize(("opening_m", "position_m"), [(0.0, 0.01), (0.2, 0.01), (0.1, 0.03)])
def test_the_gripper_encloses_half_its_opening_and_the_error_of_its_position(opening_m, position_m):
    """A path along the face of a cube: no contact as far as the gripper reaches beside the grasp
    point, contact beyond.
    """
    made = setup_of()
    grip = replace(
        made.task,
        opening_m=opening_m,
        tolerance=replace(made.task.tolerance, position_m=position_m),
    )
    made, reach = replace(made, task=grip), 0.5 * opening_m + position_m
    assert made.task.radius_m == 0.0
    for side, touched in ((0.99 * reach, False), (1.01 * reach, True)):
        depth = np.linspace(0.9 * reach, -0.9 * reach, 50)
        path = np.column_stack([depth, 0.0 * depth + side, 0.0 * depth])
        assert made.touched(path) is touched


def test_simulated_flights_keep_what_is_known_of_a_body_whose_principal_axes_are_not():
    """As a cube that turns about one axis: the pose is known, inertia and mass centre are not."""
    x = State(
        exp(np.array([0.3, -0.2, 0.5])),
        np.array([0.1, 0.0, 0.0]),
        np.array([0.0, 0.0, 5.0]),
        np.zeros(3),
        np.array([1e-3, -1e-3]),
        np.array([0.0, 0.02, 0.0]),
        exp(np.array([0.1, 0.2, 0.3])),
    )
    sizes = np.repeat([1e-4, 2e-5, 3e-4, 1e-5, 0.5, 0.01], [3, 3, 3, 3, 5, 3])
    T = to_errors(to_chart(x))
    given = Belief(0, x, T @ np.diag(sizes**2) @ T.T)
    assert 2.0 * np.sqrt(np.trace(given.P[:3, :3])) > 1.0  # the attitude of the axes
    setup, log = setup_of(), FlightLog()
    for k in range(5):
        errors = ScanErrors(np.diag([0.01**2] * 6))
        log.take(Belief(k * 400_000_000, x, given.P), None, 1, HELD, errors)
    ended = simulated(setup, log, None, given)
    assert len(ended) == 1
    assert all(flight.miss.inside(setup.task.tolerance) for flight in ended)


def test_the_noise_of_flights_has_the_mean_information_of_the_last_poses():
    """Two views, of which each leaves one direction free, determine both."""
    log, (given, _) = FlightLog(), belief()
    assert log.noise is None
    for free in (3, 4):
        C = 1e-6 * np.eye(6)
        C[free, free] = 1.0
        log.take(given, None, 1, HELD, ScanErrors(C))
    log.take(given, None, 0, HELD, ScanErrors(np.eye(6)))  # a faulty scan measures nothing
    assert np.diag(log.noise) == pytest.approx([1e-6, 1e-6, 1e-6, 2e-6, 2e-6, 1e-6], rel=1e-3)


def test_the_noise_about_another_point_is_that_of_the_point_that_a_pose_carries():
    rng, point = np.random.default_rng(5), np.array([0.4, -1.0, 2.0])
    A = 1e-4 * rng.normal(size=(6, 6))
    d = rng.normal(size=(20000, 6)) @ A.T
    moved = d[:, 3:] + np.cross(d[:, :3], point)
    found = covariance_about(A @ A.T, point)
    assert np.abs(np.cov(moved.T) - found[3:, 3:]).max() < 0.05 * np.abs(found).max()
    assert covariance_about(found, -point) == pytest.approx(A @ A.T)


def test_a_log_that_ends_blind_at_its_first_plan_is_assessed():
    """At the last scan a plan exists, and the approach has not begun."""
    setup, x = setup_of(), belief()[0].x
    sizes = np.repeat([1e-4, 1e-5, 1e-4, 1e-6, 1e-3, 1e-4], [3, 3, 3, 3, 5, 3])
    T = to_errors(to_chart(x))
    given, log = Belief(0, x, T @ np.diag(sizes**2) @ T.T), FlightLog()
    guidance, estimator = setup.guidance, setup.estimator
    known = planner_input(
        estimator, given, setup.target, 1, True, partial(estimator.forecast, given)
    )
    state = guidance.step(guidance.initial(0), replace(known, gamma=0))
    assert state.plan.found
    assert not state.supervisor.moving
    log.take(given, state, 1, HELD)
    log.gammas = [1, 0]
    assert assess(setup, log).probability is not None


@pytest.mark.parametrize(
    ("lasting", "chance", "words"),
    [
        ((0.002, 0.0), Chance.NONE, "3 sigma of the position error that all poses have in common"),
        ((0.0, 0.02), Chance.NONE, "error that all poses have in common are 3.44 of 2 deg"),
        ((0.0, 0.0), Chance.UNDECIDED, "not suffice: it has to be consistent and within"),
    ],
)
def test_a_robot_that_waits_says_which_condition_its_estimate_misses(lasting, chance, words):
    """Only an error that no further scan reduces decides that it does not capture."""
    setup, x = setup_of(), belief()[0].x
    given, log = Belief(0, x, 1e-16 * np.eye(20)), FlightLog()
    forecast = partial(setup.estimator.forecast, given)
    known = planner_input(setup.estimator, given, setup.target, 1, False, forecast)
    state = setup.guidance.step(setup.guidance.initial(0), known)
    log.take(given, state, 1, ConvergenceTrack(), ScanErrors(lasting=lasting))
    found = assess(setup, log)
    assert words in found.sentence
    assert (found.chance, found.succeeds, found.lowers_grade) == (chance, False, True)
    assert found.probability == (0.0 if chance is Chance.NONE else None)
    again = Assessment.of_record(json.loads(json.dumps(found.record(), allow_nan=False)))
    assert again.sentence == found.sentence


def after_two_scans(given, torque):
    """The begin of simulated flights from a belief, with a random torque [rad/s^1.5]."""
    setup, log = setup_of(), FlightLog()
    for k in range(2):
        errors = ScanErrors(np.diag([1e-8] * 6), (torque, 0.0))
        log.take(replace(given, t_ns=k * 400_000_000), None, 1, HELD, errors)
    log.convergence = HELD
    return setup, log, replace(given, t_ns=400_000_000)


def flown_inputs(given, torque, count):
    """What guidance is told in a simulated flight at rest."""
    setup, log, last = after_two_scans(given, torque)
    target = Scene(setup.estimator.motion(last), setup.estimator.attitude(last))
    rng = np.random.default_rng(1)
    return list(islice(measured(setup, log, last, target, None, rng), count))


def test_simulated_flights_have_the_random_torques_of_the_log():
    """The 1 sigma that guidance is told grows with them."""
    given, _ = belief()
    told = [
        float(flown_inputs(given, torque, 1)[0].forecast(np.array([10.0])).rot_1s_rad[-1])
        for torque in (0.0, 1e-3)
    ]
    assert told[1] > told[0] + 1e-3


def test_convergence_is_lost_in_a_simulated_flight_as_in_that_of_a_log():
    """A torque makes the error at the planned capture larger than the tolerance."""
    x = replace(belief()[0].x, w_b=np.array([0.05, 0.02, 0.01]), c_b=np.zeros(3))
    given = Belief(0, replace(x, v_a=np.zeros(3)), 1e-16 * np.eye(20))
    assert all(known.converged for known in flown_inputs(given, 1e-6, 20))
    assert not any(known.converged for known in flown_inputs(given, 1e-2, 20)[1:])


def test_an_assessment_reads_back_from_its_record_and_says_the_same():
    fact = InFact(True, CaptureError(0.001, 0.0002, math.nan), False, "captured")
    made = Assessment(
        chance=Chance.LIKELY,
        probability=0.96,
        probability_95=(0.86, 1.0),
        at_s=30.4,
        tolerance=TOLERANCE,
        miss=TOLERANCE,
        contact=0.0,
        limit="the rate about z",
        in_fact=fact,
    )
    again = Assessment.of_record(json.loads(json.dumps(made.record(), allow_nan=False)))
    assert again is not None
    assert again.sentence == made.sentence
    assert again.record() == made.record()
    assert made.sentence.startswith(
        "CAPTURE likely: 0.96 (0.86 to 1.00) within 13 mm and 2 deg at 30.4 s; no contact;"
        " limited by the rate about z"
    )
    assert Assessment.of_record(None) is None


def test_the_word_follows_the_probability():
    assert [chance_of(p) for p in (1.0, 0.9, 0.6, 0.1)] == [
        Chance.LIKELY,
        Chance.LIKELY,
        Chance.POSSIBLE,
        Chance.UNLIKELY,
    ]


def _run(fixtures_folder, *more):
    command = [sys.executable, "-m", "avsreplay", "run", str(fixtures_folder / "tumble.mcap")]
    done = subprocess.run([*command, *more, "--json"], capture_output=True, text=True, check=False)
    return done.returncode, json.loads(done.stdout)["verdict"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("more", "chance", "code"),
    [
        (("--set", "plan.a_max_mps2=0.0001", "--require", "pass"), "none", 1),
        (("--set", "task.grasp_m=[-0.5,0,0.3]", "--require", "capture=0.1"), "not assessed", 1),
        (("--set", "plan.a_max_mps2=0.0001"), "none", 0),
    ],
)
def test_a_run_without_a_capture_is_no_pass(fixtures_folder, more, chance, code):
    returned, verdict = _run(fixtures_folder, *more)
    assert (verdict["capture"]["chance"], returned) == (chance, code)
    assert verdict["grade"] != "PASS"


@pytest.mark.parametrize(("point", "grade"), [(None, "PASS"), ("[0.0,0.0,0.1]", "CHECK")])
def test_only_a_given_grasp_point_lowers_the_grade(tmp_path, point, grade):
    """Poses of a body whose origin nobody can grasp: the tracking passes all the same."""
    rng = np.random.Generator(np.random.PCG64(4))
    lines = [
        [1.0 + 0.5 * k, *(0.004 * rng.normal(size=3) + (0, 0, 5)), *exp(0.05 * k * np.ones(3))]
        for k in range(24)
    ]
    log = tmp_path / "log.tum"
    log.write_text("\n".join(" ".join(map(str, line)) for line in lines))
    words = ["register.backend=poses", *([f"task.grasp_m={point}"] if point else [])]
    words += ["task.position_m=0.2", "task.angle_deg=20.0", "task.speed_mps=0.1"]
    options = SourceOptions(extent_m=2.0)
    with Run(Job(source=log, options=options, assignments=tuple(words), prefetch=0)) as run:
        rows = list(run.rows())
        summary = run.summary()
    verdict = verdict_of(rows, summary)
    assert verdict.capture is not None
    assert verdict.capture.chance is Chance.NOT_ASSESSED
    assert (verdict.grade.value, verdict.tracking.value) == (grade, "PASS")
    again = Assessment.of_record(verdict.capture.record())
    assert again == verdict.capture


@pytest.mark.parametrize("columns", [80, 160])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"pos_err_m": None, "rot_err_deg": None, "reference": None},
        {"reference": "fit"},
        {"gamma": 0, "reason": "not_aligned", "converged": False},
        {"action": "abort", "pos_err_m": 5.0, "rot_err_deg": 170.0, "nees": 1e4, "violations": 7},
    ],
)
def test_the_first_screen_has_the_answer_and_the_four_quantities(make_rows, columns, changes):
    rows = make_rows(600, **changes)
    checks = [{"grade": "fail", "text": f"the {name} of the model is wrong"} for name in "abcd"]
    verdict = verdict_of(rows, Summary.fold(rows), {"preflight": checks if changes else []})
    stream = io.StringIO()
    print_screen(make_console(stream, width=columns), rows, verdict)
    lines = stream.getvalue().splitlines()
    assert len(lines) <= 23  # and the prompt
    assert max(map(len, lines)) <= columns
    assert lines[0].startswith(verdict.line[:40])
    shown = " ".join(lines)
    for head in ("position", "attitude", "gamma", "log10 cond.", "capture [s]"):
        assert head in shown
