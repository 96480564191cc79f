"""Properties of guidance over random sequences of healthy and faulty scans, lost convergence,
growing uncertainty.
"""

from dataclasses import replace

import numpy as np
import pytest

from avsreplay.build import target_geometry
from avsreplay.geometry import angle, conjugate, exp, multiply
from avsreplay.plan.contact import Contact
from avsreplay.plan.flights import closed_loop, pushed, relative_path, with_thrust_error
from avsreplay.plan.guidance import Guidance, PlannerInput, Segment
from avsreplay.plan.limits import Scene, margin
from avsreplay.plan.path import StepPath
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.plan.robot import Limits
from avsreplay.plan.supervisor import Action, Supervisor, SupervisorParams
from avsreplay.plan.uncertainty import Disturbance, Tolerance
from avsreplay.plan.withdrawal import COAST_S
from avsreplay.records import Forecast
from avsreplay.simulate.target import Shape, builtin_surface

RADIUS = 1.5
CENTRE = np.array([0.0, 0.0, 6.0])
DRIFT = np.array([0.004, -0.003, 0.002])
PARAMS = SupervisorParams(approach_limit_s=70.0, hold_limit_s=25.0, attempts_max=3).resolved(8.0)
ROBOT = PlanParams(a_max_mps2=0.05, horizon_s=60.0)
WITHDRAWN = (Action.HOLD, Action.RETREAT, Action.ABORT)


def scene(rng):
    """A target that turns at a random constant rate, with the grasp point 1 m from its centre of
    mass.
    """
    w = rng.normal(size=3)
    w *= rng.uniform(0.02, 0.12) / np.linalg.norm(w)
    arm, x = np.array([1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])

    def attitude(t):
        return exp(np.asarray(t)[:, None] * w)

    def goal(t):
        from scipy.spatial.transform import Rotation

        c = Rotation.from_quat(attitude(t)).apply(arm)
        return CENTRE + np.outer(t, DRIFT) + c, DRIFT + np.cross(w, c)

    return Scene(goal, attitude, x, -arm, hull_c=RADIUS * x[None] - arm)


def inputs(rng, end_s=160.0, step_s=0.5):
    """Scans in random runs of healthy, faulty and unconverged; the uncertainty grows while no
    scan is healthy.
    """
    target, growth = scene(rng), rng.uniform(0.0, 1.0)
    mode, until, healthy_s = "healthy", 3.0, 0.0
    for t in np.arange(0.0, end_s, step_s):
        if t >= until:
            mode = rng.choice(["healthy", "faulty", "lost"], p=[0.5, 0.4, 0.1])
            until = t + rng.uniform(0.5, 20.0)
        healthy_s = t if mode == "healthy" else healthy_s

        def forecast(dt, since=t - healthy_s):
            grown = 0.002 * (1.0 + growth * (since + dt))
            return Forecast(dt, grown, 0.3 * grown, 0.1 * grown)

        yield PlannerInput(
            round(t * 1e9), int(mode == "healthy"), mode != "lost", target.after(t), forecast
        )


def flights(seed, limits=None, end_s=160.0):
    """Input and state after each scan of one random sequence."""
    guidance = Guidance(ROBOT, Supervisor(PARAMS), limits)
    yield from guidance.fly(inputs(np.random.default_rng(seed), end_s))


@pytest.mark.parametrize("seed", range(8))
def test_every_sequence_ends_and_attempts_are_limited(seed):
    states = [state for _, state in flights(seed)]
    last = states[-1].decision.action
    assert last in (Action.CAPTURE, Action.ABORT) or states[-1].supervisor.began_s is None
    assert states[-1].supervisor.attempts <= PARAMS.attempts_max
    actions = [state.decision.action for state in states]
    for final in (Action.CAPTURE, Action.ABORT):
        if final in actions:
            assert set(actions[actions.index(final) :]) == {final}


@pytest.mark.parametrize("seed", range(8))
def test_a_withdrawal_comes_no_closer_than_braking_needs(seed):
    """Distance d0, approach speed v0 along the line of sight: never nearer than d0 - v0^2 /
    (2 a).
    """
    begin = None
    for known, state in flights(seed):
        t = known.t_ns * 1e-9
        position, velocity = state.segment.at(known.t_ns)
        centre = CENTRE + t * DRIFT
        away = position - centre
        distance = float(np.linalg.norm(away))
        if state.decision.action not in WITHDRAWN:
            begin = None
            continue
        if begin is None:
            speed = float(np.linalg.norm(velocity - DRIFT))
            begin = (t, distance - speed**2 / (2 * ROBOT.a_max_mps2))
        assert distance >= begin[1] - 1e-3
        if t - begin[0] > 40.0:
            assert distance >= RADIUS + PARAMS.standoff_m - 1e-3


def test_limits_hold_in_every_plan_of_a_flight():
    limits = Limits(cone_deg=30.0, final_deg=12.0).resolved(8.0)
    constrained = 0
    for known, state in flights(3, limits, end_s=20.0):
        plan = state.plan
        if plan is None or not plan.found or plan.t_ns != known.t_ns:
            continue
        constrained += plan.thrust is not None
        assert (
            plan.margin_m >= 0.0
            or margin(known.scene, limits, *state.segment.at(known.t_ns)) < limits.mouth_m
        )
    assert constrained > 3


def recorded(known, asked):
    """The input of guidance, with the times for which it is asked added to a list."""
    target, one_sigma = known.scene, 1e-3

    def noted(found):
        def at(times):
            asked.extend(np.asarray(times).tolist())
            return found(times)

        return at

    sigma = noted(lambda times: (one_sigma + 0.0 * times, one_sigma + 0.0 * times))
    watched = {"goal": noted(target.goal), "attitude": noted(target.attitude), "sigma": sigma}
    target = replace(target, **watched, surface=BRACKET.surface)
    return replace(known, scene=target, forecast=noted(known.forecast))


BRACKET = target_geometry(builtin_surface(Shape.BRACKET), (1.0, 0.0, 0.0))
BODY = Limits(final_deg=15.0, clearance_m=0.02)


@pytest.mark.parametrize("latency_s", [0.0, 0.4])
@pytest.mark.parametrize(
    ("horizon_s", "limits", "gripper"),
    [
        (60.0, None, None),
        (25.0, None, None),
        (22.0, Limits(cone_deg=30.0, final_deg=12.0, speed_max_mps=0.5), None),
        (60.0, BODY, None),
        (30.0, replace(BODY, abort=False), None),
        (30.0, None, (np.array([0.0, 0.0, 0.0, 1.0]), 0.002)),
    ],
)
def test_no_flight_asks_for_the_target_beyond_the_horizon(latency_s, horizon_s, limits, gripper):
    """A robot near a body may coast for ``COAST_S`` after the latest capture; a robot that is sure
    of its target does not withdraw.
    """
    params, asked = replace(ROBOT, latency_s=latency_s, horizon_s=horizon_s), []
    guidance = Guidance(params, Supervisor(PARAMS), limits, 1.0, gripper)
    known = [*inputs(np.random.default_rng(5), 24.0, 1.0)]
    if limits is not BODY:
        known = [replace(each, gamma=1, converged=True) for each in known]
    for _ in guidance.fly(recorded(each, asked) for each in known):
        pass
    more_s = 0.0 if limits is None or limits.clearance_m is None else COAST_S
    assert min(asked) >= 0.0
    assert max(asked) <= horizon_s + more_s + 1e-9


def exactly(target, t, gamma=1, one_sigma=1e-5):
    """Input of guidance at a time [s] with the true target and a small predicted 1 sigma."""
    forecast = lambda dt: Forecast(dt, *(one_sigma * np.ones((3, len(dt)))))  # noqa: E731
    return PlannerInput(round(t * 1e9), gamma, True, target.after(t), forecast)


@pytest.mark.parametrize("accel", [0.002, 0.05])
def test_the_gripper_has_the_attitude_of_the_fixture_at_the_capture(accel):
    rng = np.random.default_rng(3)
    target, start = scene(rng), exp(np.array([1.5, -1.0, 0.4]))
    guidance = Guidance(ROBOT, Supervisor(PARAMS), gripper=(start, accel))
    known = (exactly(target, t, one_sigma=1e-4) for t in np.arange(0.0, 120.0, 0.5))
    attitudes, state = [], None
    for each, state in guidance.fly(known):
        turn = state.segment.turn
        attitudes.append(turn.at(np.array([(each.t_ns - turn.t_ns) * 1e-9]))[0])
        if state.captured_ns is not None:
            break
    assert state.captured_ns is not None
    end_s = (state.segment.end_ns - turn.t_ns) * 1e-9
    truth = target.attitude(np.array([state.segment.end_ns * 1e-9]))[0]
    assert angle(multiply(conjugate(truth), turn.at(np.array([end_s]))[0])) < 1e-3
    steps = angle(multiply(conjugate(np.array(attitudes[:-1])), np.array(attitudes[1:])))
    assert steps.max() < 0.5  # the attitude is continuous over all replans
    free = rendezvous(target.goal, np.zeros(3), np.zeros(3), ROBOT)
    assert state.captured_ns * 1e-9 >= free.t_go_s - 1e-6
    if accel == 0.002:
        assert state.captured_ns * 1e-9 > free.t_go_s + 5.0


def loop(noise_mps2, seed=0, latency_s=0.0):
    """Result of one flight with an exact estimate and errors of the thrust."""
    rng = np.random.default_rng(seed)
    target = scene(rng)
    known = (exactly(target, t) for t in np.arange(0.4, 120.0, 0.2))
    guidance = Guidance(replace(ROBOT, latency_s=latency_s), Supervisor(PARAMS))
    thrust = Disturbance(noise_mps2, rng)
    return closed_loop(guidance, known, target, 0, thrust).outcome(Tolerance(0.02, 0.01))


def test_replanning_removes_errors_of_the_thrust_as_far_as_the_last_second():
    assert all(
        loop(0.0, seed, latency_s) == "captured" for seed in range(3) for latency_s in (0.0, 0.3)
    )
    assert all(loop(0.001, seed, 0.3) == "captured" for seed in range(3))
    assert any(loop(0.2, seed, 0.3) != "captured" for seed in range(3))


def pin(y):
    """Closest points and distances of a ball of 6 cm that ends 3 cm beyond the grasp point."""
    centre = np.array([-0.03, 0.0, 0.0])
    far = np.linalg.norm(y - centre, axis=1)
    return centre + 0.06 * (y - centre) / far[:, None], far - 0.06


@pytest.mark.slow
def test_a_flight_that_is_continued_inside_the_grasp_touches_what_the_whole_flight_touches():
    target = scene(np.random.default_rng(2))
    known = [exactly(target, t) for t in np.arange(0.0, 60.0, 0.2)]
    guidance = Guidance(ROBOT, Supervisor(PARAMS), Limits(final_deg=12.0).resolved(8.0))
    grip = Contact(pin, np.array([1.0, 0.0, 0.0]), 0.0, 0.07, 0.15)
    whole = closed_loop(guidance, (each for each in known), target, 0)
    assert whole.miss is not None
    assert not grip.touched(whole.path[None])[0]
    state, path, inside = guidance.initial(0), [np.zeros((0, 3))], 0
    for last, each, rest in zip(known, known[1:], range(2, len(known)), strict=False):
        path.append(relative_path(target, state.segment, 0, last.t_ns, each.t_ns))
        state = guidance.step(state, each)
        if state.captured_ns is not None:
            break
        before = np.concatenate(path)
        if np.linalg.norm(before[-1]) < 0.1:
            inside += np.linalg.norm(before[-1]) < 0.075
            inputs = (each for each in known[rest:])
            flown = closed_loop(guidance, inputs, each.scene, each.t_ns, state=state)
            assert not grip.touched(np.concatenate([before, flown.path])[None])[0]
    assert inside > 0


def test_the_errors_of_the_thrust_over_one_second_do_not_depend_on_the_rate_of_the_scans():
    path = StepPath(np.zeros(3), np.zeros(3), np.zeros((1, 3)), 0.0, 1.0)
    spreads = []
    for scans in (1, 10):
        thrust, ends = Disturbance(0.02, np.random.default_rng(1)), []
        for _ in range(400):
            segment = Segment(0, path.r0, path.v0, path)
            for k in range(scans):
                t_ns = (k + 1) * 10**9 // scans
                segment = with_thrust_error(segment, t_ns, 1.0 / scans, thrust)
            ends.append(segment.at(10**9)[1])
        spreads.append(np.std(ends))
    assert spreads == pytest.approx(
        [0.02, 0.02], rel=0.06
    )  # m/s after 1 s; 1200 values each: 2 % is 1 sigma
    coasting = Segment(0, path.r0, path.v0)
    assert with_thrust_error(coasting, 10**9, 1.0, thrust) is coasting


def test_a_pushed_segment_keeps_its_thrust_and_moves_on_from_the_new_state():
    path = StepPath(
        np.zeros(3), np.zeros(3), np.array([[0.1, 0, 0], [0, 0.2, 0], [0, 0, -0.1]]), 0.5, 6.5
    )
    segment = Segment(10**9, path.r0, path.v0, path)
    dr, dv = np.array([0.01, -0.02, 0.03]), np.array([0.002, 0.001, -0.003])
    moved = pushed(segment, 3 * 10**9, dr, dv)
    for t_ns in (3 * 10**9, 5 * 10**9, 7_500_000_000):
        (r, v), (s, w) = segment.at(t_ns), moved.at(t_ns)
        assert np.allclose(s - r, dr + (t_ns - 3 * 10**9) * 1e-9 * dv, atol=1e-12)
        assert np.allclose(w - v, dv, atol=1e-12)


@pytest.mark.parametrize(("off_m", "made_s"), [(0.0, [4.0]), (0.01, [4.0, 8.0])])
def test_without_measurements_a_plan_is_renewed_only_where_the_robot_has_left_its_path(
    off_m, made_s
):
    target, planned, state = scene(np.random.default_rng(3)), [], None
    guidance = Guidance(ROBOT, Supervisor(PARAMS))
    for t in np.arange(0.0, 12.0, 0.5):
        t_ns = round(t * 1e9)
        state = state or guidance.initial(t_ns)
        if t == 8.0:
            state = replace(
                state, segment=pushed(state.segment, t_ns, np.array([off_m, 0.0, 0.0]), np.zeros(3))
            )
        state = guidance.step(state, exactly(target, t, int(t < 4.0)))
        planned += [state.plan.t_ns * 1e-9] if t > 4.0 else []
    assert state.decision.action is Action.APPROACH_ON_PREDICTION
    assert sorted(set(planned)) == made_s


def test_a_robot_that_begins_inside_a_limit_returns_from_it_and_is_not_withdrawn():
    """What a plan violates at its start shrinks within 0.3 of the flight, and does not end the
    approach.
    """
    target = scene(np.random.default_rng(3))
    limits = Limits(keepout_m=1.5, keepout_release_m=0.9).resolved(8.0)
    where = CENTRE + np.array([0.0, 0.0, -1.4])
    start = replace(ROBOT, robot_position_m=tuple(where.tolist()))
    guidance = Guidance(start, Supervisor(PARAMS), limits)
    known = [exactly(target, t) for t in (0.0, 0.5)]
    states = [state for _, state in guidance.fly(known)]
    assert margin(target, limits, where, np.zeros(3)) < -0.05
    assert states[0].plan.violation_m == pytest.approx(0.1, abs=1e-6)
    assert [state.decision.action for state in states] == [Action.APPROACH] * 2
    end_ns = states[0].segment.end_ns
    times = np.linspace(0.3, 1.0, 50) * end_ns
    r = states[0].segment.positions(times.astype(np.int64))
    centre, goal = target.centre(1e-9 * times), target.goal(1e-9 * times)[0]
    free = np.linalg.norm(r - centre, axis=1) >= 1.5
    assert (free | (np.linalg.norm(r - goal, axis=1) <= 0.9)).all()


def test_a_capture_that_an_arm_delayed_is_tried_again_at_the_instant_of_the_earlier_plan():
    class Slow:
        """An arm that reaches the fixture 30 s after the first plan at the earliest."""

        def __init__(self):
            self.hints = []

        def fitted(self, make, path, scene, limits, first_s, horizon_s, hint_s):
            self.hints.append(hint_s)
            return replace(make(hint_s or 30.0, 1.0), delayed_by="arm"), None

    wait_s, target, arm = 0.3, scene(np.random.default_rng(3)), Slow()
    guidance = Guidance(replace(ROBOT, latency_s=wait_s), Supervisor(PARAMS), arm=arm)
    known = [exactly(target, t) for t in (0.0, 1.5, 3.0)]
    ends = [state.segment.end_ns * 1e-9 for _, state in guidance.fly(known)]
    assert ends == pytest.approx([30.3] * 3, abs=1e-6)
    assert arm.hints == pytest.approx([0.0, 30.0 - 1.5, 30.0 - 3.0], abs=1e-6)


def test_the_path_about_the_target_is_that_of_both_motions():
    """In seconds after the instant from which the times of the scene count."""
    w, v = np.array([0.0, 0.0, 0.2]), np.array([0.3, 0.0, -0.1])
    turning = Scene(
        lambda t: (np.outer(t, DRIFT), np.tile(DRIFT, (len(t), 1))),
        lambda t: exp(np.asarray(t)[:, None] * w),
    )
    segment = Segment(4 * 10**9, np.array([1.0, 2.0, 3.0]), v)
    start_ns, begin_ns, end_ns = 10**9, 5 * 10**9, 7 * 10**9
    y = relative_path(turning, segment, start_ns, begin_ns, end_ns)
    at = 5.0 + 2.0 * np.arange(10) / 10
    for t, found in zip(at, y, strict=True):
        c, s = np.cos(0.2 * (t - 1.0)), np.sin(0.2 * (t - 1.0))
        away = segment.r0 + (t - 4.0) * v - (t - 1.0) * DRIFT
        assert np.allclose(found, np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ away, atol=1e-12)


@pytest.mark.slow
def test_errors_of_the_thrust_belong_to_the_generator_of_the_flight():
    target = scene(np.random.default_rng(1))
    known = [exactly(target, t) for t in np.arange(0.5, 40.0, 1.0)]
    guidance = Guidance(ROBOT, Supervisor(PARAMS))

    def missed_m(seed, noise_mps2=0.01):
        thrust = None if seed is None else Disturbance(noise_mps2, np.random.default_rng(seed))
        inputs = (each for each in known)
        return closed_loop(guidance, inputs, target, 0, thrust).miss.distance_m

    assert missed_m(None) == missed_m(5, 0.0) < 1e-9
    assert missed_m(5) == missed_m(5) > 1e-4
    assert missed_m(5) != missed_m(6)
