"""Predicted probability of a capture against what happened, over simulated flights.

Ten bodies (general, with two equal moments, nearly equal moments, slender, flat), disturbances on
and off, two robots. Poses have white noise at 5 Hz; registration is left out. At t_1 the capture is
assessed from what is known then; after that the flight goes on against the true target with errors
of the thrust and blackouts. Finished flights are appended to a file and not flown again.

python tests/benchmarks/capture_calibration.py FILE.jsonl [--first SEED] [--count N] [--seconds S]
    [--flights N] [--corridor] [--thrust FACTOR]
python tests/benchmarks/capture_calibration.py FILE.jsonl --figure docs/images/calibration.svg
"""

from __future__ import annotations

import argparse
import copy
from dataclasses import replace
from functools import partial
from itertools import pairwise
from operator import itemgetter
from pathlib import Path

import numpy as np
from finished_runs import continued

from avsreplay import geometry
from avsreplay.assess import FlightLog, ScanErrors, Setup, assess
from avsreplay.build import target_geometry
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.dynamics import propagate_state
from avsreplay.estimate.error_state import boxplus
from avsreplay.estimate.params import NoiseSource
from avsreplay.geometry import Pose
from avsreplay.monitor.convergence import Convergence, ConvergenceParams
from avsreplay.pipeline import planner_input
from avsreplay.plan.flights import relative_path, with_thrust_error
from avsreplay.plan.guidance import Guidance
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.plan.robot import Limits, RobotParams
from avsreplay.plan.supervisor import Action, Supervisor, SupervisorParams
from avsreplay.plan.uncertainty import Disturbance
from avsreplay.records import Alignment, AlignStatus, Belief, State
from avsreplay.simulate.target import Shape, builtin_surface
from avsreplay.task import TaskParams, task_of

MOMENTS = (  # principal moments of the ten bodies, in any unit
    *((1.0, 1.4, 1.9), (1.0, 2.0, 2.5), (1.3, 1.5, 1.6), (1.0, 1.0, 1.7), (1.0, 1.8, 1.8)),
    *((1.0, 1.002, 1.5), (1.0, 1.0005, 1.0003), (0.1, 2.0, 2.02), (0.15, 1.0, 1.0)),
    (1.0, 1.1, 2.08),
)
ROBOTS = (  # largest acceleration, delay, thrust noise
    (0.05, 0.0, 0.01),
    (0.02, 0.3, 0.05),
)
STEP_S, SPAN_S = 0.2, 110.0
KICKS = (1e-5, 1e-4)  # root density of the angular acceleration with disturbances [rad/s^1.5]
AXIS = (1.0, 0.0, 0.0)


def flown(seed: int, flights: int, corridor: bool, thrust_errors: float) -> dict[str, object]:
    """One flight: what was predicted at t_1 and at its end, and what happened.

    Args:
        seed: of the body, the motion and all noise.
        flights: simulated flights of the prediction.
        corridor: whether the robot approaches through the corridor along the axis, as by default.
        thrust_errors: factor of the errors of the thrust.
    """
    rng = np.random.default_rng([seed, 77])
    J = np.array(MOMENTS[seed % 10])
    disturbed, robot_at = bool(seed // 10 % 2), seed // 20 % 2
    a_max, delay_s, thrust = ROBOTS[robot_at]
    thrust *= thrust_errors
    # Larger ones turn the target by more than the tolerance within the planned time: no t_1.
    kick = np.exp(np.random.default_rng([seed, 78]).uniform(*np.log(KICKS))) if disturbed else 0.0
    cube = builtin_surface(Shape.CUBE)
    surface = replace(cube, vertices=3.0 * cube.vertices)
    extent = surface.extent
    w = rng.normal(size=3)
    w *= rng.uniform(0.03, 0.12) / np.linalg.norm(w)
    x = State(
        geometry.exp(rng.normal(size=3)),
        w,
        np.array([0.0, 0.0, 6.0]) + 0.3 * rng.normal(size=3),
        0.004 * rng.normal(size=3),
        np.clip([(J[1] - J[2]) / J[0], (J[2] - J[0]) / J[1]], -0.98, 0.98),
        0.5 * rng.normal(size=3),
        geometry.exp(0.3 * rng.normal(size=3)),
    )
    noise_m, noise_rad = rng.uniform(0.001, 0.008), np.radians(rng.uniform(0.05, 0.4))
    share = rng.uniform(0.3, 1.0)  # of the usual tolerances
    sizes = {"position_m": share * 0.0025 * extent, "speed_mps": share * 0.00125 * extent}
    params = EstimatorParams(
        r0_pos_m=noise_m,
        r0_rot_deg=float(np.degrees(noise_rad)),
        correlated_share=0.0,
        noise=NoiseSource.R0,
        torque_noise_radps15=kick,
        force_noise_mps15=0.0,
    )
    limits = Limits()
    geometry_c = target_geometry(surface, AXIS)
    supervisor, robot = SupervisorParams(), RobotParams(thrust_noise=thrust)
    given = TaskParams(**sizes, angle_deg=2.0 * share)
    task = task_of(given, supervisor, robot, AXIS, surface, geometry_c.surface, limits)
    limits = task.corridor(limits) if corridor else limits
    plan = PlanParams(a_max_mps2=a_max, latency_s=delay_s)
    supervision = given.with_tolerance(supervisor).resolved(extent)
    guidance = Guidance(plan, Supervisor(supervision), limits, extent)
    sigma = np.concatenate(
        [
            np.full(3, 0.02), np.full(3, 0.02), np.full(3, 0.05), np.full(3, 0.02),
            np.full(2, 0.2), np.full(3, 0.05), np.full(3, 0.05),
        ]
    )  # fmt: skip
    d = sigma * rng.standard_normal(20)
    start = Belief(0, boxplus(x, d), np.diag(sigma**2))
    start = replace(start, x=replace(start.x, sigma=np.clip(start.x.sigma, -0.95, 0.95)))
    estimator = Estimator(params, start, extent)
    convergence = Convergence(ConvergenceParams(), extent, task.tolerance.in_si)
    C = np.diag([noise_rad**2] * 3 + [noise_m**2] * 3)
    setup = Setup(
        task=task,
        estimator=Estimator(params, None, extent),
        guidance=guidance,
        convergence=convergence,
        target=geometry_c,
        solid=True,
        extent_m=extent,
        since_ns=0,
        thrust_noise_mps2=thrust * a_max,
        flights=flights,
        seed=seed,
    )
    gaps = [(t, t + rng.uniform(2.0, 8.0)) for t in rng.uniform(5.0, SPAN_S, 2)]
    track, held = estimator.initial(0, start.x.T_ac), convergence.initial()
    state, log, path = guidance.initial(0), FlightLog(), []
    errors = Disturbance(thrust * a_max, rng)
    predicted, known_s, aimed, last_ns = None, None, None, 0
    for k in range(1, round(SPAN_S / STEP_S)):
        t_ns = round(k * STEP_S * 1e9)
        moved = Belief(last_ns, x, np.zeros((20, 20)))
        scene = planner_input(
            setup.estimator, moved, geometry_c, 1, True, partial(estimator.forecast, moved)
        ).scene
        if state.supervisor.moving:
            path.append(relative_path(scene, state.segment, last_ns, last_ns, t_ns))
        if state.decision.action is Action.CAPTURE and state.segment.end_ns < t_ns:
            break
        state = replace(state, segment=with_thrust_error(state.segment, t_ns, STEP_S, errors))
        x, _ = propagate_state(x, STEP_S)
        if disturbed:
            x = replace(x, w_b=x.w_b + kick * np.sqrt(STEP_S) * rng.standard_normal(3))
        gamma = int(not any(a <= k * STEP_S < b for a, b in gaps))
        prior = estimator.predict(track, t_ns)
        innovation = None
        if gamma:
            pose = x.T_ac
            seen = Pose(
                geometry.multiply(pose.q, geometry.exp(noise_rad * rng.standard_normal(3))),
                pose.t + noise_m * rng.standard_normal(3),
            )
            flat = np.eye(6)
            innovation = estimator.innovate(
                prior, Alignment(seen, 1, True, 1000, 1000, 0.0, flat, AlignStatus.ALIGNED)
            )
        track = estimator.update(track, prior, innovation, gamma, held.converged)
        belief, last_ns = estimator.published(track), t_ns
        flying = state.segment.capture
        after = max((state.segment.end_ns - t_ns) * 1e-9, 0.0) if flying else None
        if after is None:
            made = rendezvous(estimator.motion(belief), np.zeros(3), np.zeros(3), plan, t_ns)
            after = made.t_go_s if made.found else plan.horizon_s
        forecast = estimator.track_forecast(track, np.array([after]))
        held = convergence.judge(held, belief, forecast, True, flown=flying)
        known = planner_input(
            estimator, belief, geometry_c, gamma, held.converged,
            partial(estimator.track_forecast, track),
        )  # fmt: skip
        state = guidance.step(state, known)
        log.take(belief, state, gamma, held, ScanErrors(C))
        if state.decision.action is Action.CAPTURE and aimed is None:
            aimed = known.scene.attitude(np.array([(state.segment.end_ns - t_ns) * 1e-9]))[0]
        if predicted is None and held.converged and state.plan is not None and state.plan.found:
            at_t1 = copy.copy(log)
            predicted, known_s = assess(setup, at_t1), t_ns * 1e-9
        if state.decision.action is Action.ABORT or state.captured_ns is not None:
            break
    ended = assess(replace(setup, flights=1), log) if log.ended or aimed is not None else None
    touched = bool(setup.touched(np.concatenate([np.zeros((0, 3)), *path])))
    captured = aimed is not None and not touched and _inside(setup, state, x, last_ns, aimed)
    return {
        "seed": seed,
        "body": seed % 10,
        "disturbed": disturbed,
        "robot": robot_at,
        "corridor": corridor,
        "thrust": thrust_errors,
        "t1_s": known_s,
        "predicted": None if predicted is None else predicted.probability,
        "contact": None if predicted is None else predicted.contact,
        "ended": None if ended is None else ended.probability,
        "captured": captured,
        "touched": touched,
        "action": state.decision.action.value,
        "rule": state.decision.rule,
    }


def _inside(setup, state, x, last_ns, aimed):
    """Whether the gripper closes within the tolerances: true state ``x`` at the last scan."""
    after = np.array([(state.segment.end_ns - last_ns) * 1e-9])
    if after[0] < 0.0:
        x, _ = propagate_state(x, float(after[0]))
        after = np.zeros(1)
    true = Belief(last_ns, x, np.zeros((20, 20)))
    (rho, rate), q = setup.estimator.motion(true)(after), setup.estimator.attitude(true)(after)
    r, v = state.segment.at(state.segment.end_ns)
    turn = geometry.angle(geometry.multiply(geometry.conjugate(q[0]), aimed))
    errors = [np.linalg.norm(rho[0] - r), np.linalg.norm(rate[0] - v), np.degrees(turn)]
    return bool((np.array(errors) <= setup.limits).all())


def in_turn(first: int, count: int) -> list[int]:
    """Seeds in an order in which kinds of flights take turns: with and without disturbances, and
    robots, before the next body.
    """
    return sorted(range(first, first + count), key=lambda seed: (seed // 40, seed % 10, seed))


def judged(rows: list[dict[str, object]], key: str) -> list[dict[str, object]]:
    """Flights with a prediction whose outcome is known: they ended within the log, or touched."""
    return [r for r in rows if r[key] is not None and (r["ended"] is not None or r["touched"])]


def table(rows: list[dict[str, object]], key: str, outcome: str) -> list[tuple[float, ...]]:
    """Bins of a predicted probability: mean prediction, frequency, count."""
    known = [(float(r[key]), float(r[outcome])) for r in judged(rows, key)]
    edges, out = (0.0, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0001), []
    for low, high in pairwise(edges):
        part = [(p, o) for p, o in known if low <= p < high]
        if part:
            p, o = np.mean(part, axis=0)
            out.append((float(p), float(o), len(part)))
    return out


def report(rows: list[dict[str, object]]) -> None:
    """Print bins and Brier scores."""
    reached = sum(r["predicted"] is not None for r in rows)
    print(f"{len(rows)} flights, {reached} reached t_1, {len(judged(rows, 'predicted'))} judged")
    for key, outcome in (("predicted", "captured"), ("contact", "touched"), ("ended", "captured")):
        known = [(float(r[key]), float(r[outcome])) for r in judged(rows, key)]
        brier = np.mean([(p - o) ** 2 for p, o in known]) if known else np.nan
        base = np.var([o for _, o in known]) if known else np.nan
        print(
            f"{key}: Brier score {brier:.3f} (constant frequency {base:.3f}), {len(known)} flights"
        )
        for p, o, n in table(rows, key, outcome):
            print(f"  predicted {p:.2f}  happened {o:.2f}  in {n}")
    for name in ("disturbed", "robot", "body"):
        for value in sorted({r[name] for r in rows}):
            part = [r for r in judged(rows, "predicted") if r[name] == value]
            if part:
                p, o = (np.mean([float(r[k]) for r in part]) for k in ("predicted", "captured"))
                print(f"{name} {value}: predicted {p:.2f}, happened {o:.2f}, {len(part)} flights")


def figure(rows: list[dict[str, object]], path: Path) -> None:
    """Write the reliability diagram as SVG."""
    dots = []
    for p, o, n in table(rows, "predicted", "captured"):
        radius = 3.0 + 6.0 * np.sqrt(n / len(rows))
        dots.append(
            f'<circle cx="{40 + 240 * p:.1f}" cy="{270 - 240 * o:.1f}" r="{radius:.1f}"'
            f' fill="#0072B2"/><text x="{46 + 240 * p:.1f}" y="{286 - 240 * o:.1f}">{n}</text>'
        )
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 320 320" font-family="sans-serif"'
        ' font-size="11"><rect x="40" y="30" width="240" height="240" fill="none" stroke="#888"/>'
        '<path d="M40 270L280 30" stroke="#888" stroke-dasharray="4"/>'
        + "".join(dots)
        + '<text x="100" y="300">predicted probability of a capture</text>'
        '<text transform="translate(20 200)rotate(-90)">share that captured</text>'
        '<text x="36" y="284">0</text><text x="276" y="284">1</text><text x="26" y="34">1</text>'
        "</svg>\n",
        encoding="utf-8",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--flights", type=int, default=12)
    parser.add_argument("--corridor", action="store_true", help="approach along the axis")
    parser.add_argument("--thrust", type=float, default=1.0, help="factor of the errors of thrust")
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    seeds = [] if given.figure else in_turn(given.first, given.count)
    fly = lambda seed: [flown(seed, given.flights, given.corridor, given.thrust)]  # noqa: E731
    rows = continued(given.file, seeds, itemgetter("seed"), fly, given.seconds)
    report(rows)
    if given.figure:
        figure(rows, given.figure)


if __name__ == "__main__":
    main()
