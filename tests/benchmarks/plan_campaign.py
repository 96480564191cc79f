"""Whole approaches with blackouts on a simulated estimate: captured, aborted, touched.

Truth from the full inertia tensor by DOP853; poses with white noise at 5 Hz; the filter from a near
start; one to three blackouts of 5-30 s at random moments; guidance with a delay of 0.2 s under the
supervisor; errors of the thrust, 2 % of the largest one over 1 s, push the robot off its path. The
body is a ball of 0.6 of the arm's length; the plans keep a clearance of 0.15 m and arrive through a
corridor of 15 degrees. Registration is left out.

python tests/benchmarks/plan_campaign.py [--quick] [--count 200] [--seed 1] [--noise 0.02] [--free]
    [--one-at S --length S]
"""

from __future__ import annotations

import argparse
import collections
import time
from dataclasses import replace
from functools import partial

import numpy as np
import trimesh
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from avsreplay import geometry
from avsreplay.build import target_geometry
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.dynamics import propagate
from avsreplay.estimate.error_state import boxplus
from avsreplay.geometry import Pose
from avsreplay.monitor.convergence import Convergence, ConvergenceParams, ConvergenceTrack
from avsreplay.pipeline import planner_input
from avsreplay.plan.flights import closed_miss, miss, with_thrust_error
from avsreplay.plan.guidance import Guidance
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.plan.robot import Limits
from avsreplay.plan.supervisor import Supervisor, SupervisorParams
from avsreplay.plan.uncertainty import Disturbance, Tolerance
from avsreplay.records import Alignment, AlignStatus, Belief, State, Surface

EXTENT_M, RATE_HZ, SPAN_S = 8.0, 5.0, 120.0
NOISE_M, NOISE_DEG = 0.003, 0.15
TOLERANCE = Tolerance(position_m=0.02, speed_mps=0.01, angle_deg=2.0)


def bodies(rng):
    """A body of random principal moments, tumbling at 0.05-0.15 rad/s some 5 m away: state by
    time.
    """
    J = rng.uniform(1.0, 3.0, 3)
    while np.max(J) > 0.95 * (np.sum(J) - np.max(J)):
        J = rng.uniform(1.0, 3.0, 3)
    sigma = np.array([(J[1] - J[2]) / J[0], (J[2] - J[0]) / J[1]])
    w, arm = rng.normal(size=(2, 3))
    w *= rng.uniform(0.05, 0.15) / np.linalg.norm(w)
    arm *= rng.uniform(0.5, 1.5) / np.linalg.norm(arm)
    mu = geometry.exp(np.radians(5.0) * rng.normal(size=3))
    centre, drift = np.array([0.0, 0.0, 5.0]) + 0.3 * rng.normal(size=3), 0.005 * rng.normal(size=3)

    def flow(_, y):
        q, w = y[:4], y[4:]
        return np.r_[
            0.5 * (q[3] * w + np.cross(q[:3], w)), -0.5 * q[:3] @ w, -np.cross(w, J * w) / J
        ]

    q0 = Rotation.from_rotvec(rng.normal(size=3)).as_quat()
    path = solve_ivp(
        flow, [0, SPAN_S + 130], np.r_[q0, w], "DOP853", rtol=1e-11, atol=1e-12, dense_output=True
    ).sol

    def state(t):
        y = path(t)
        return State(
            y[:4] / np.linalg.norm(y[:4]), y[4:], centre + t * drift, drift, sigma, arm, mu
        )

    def motion(times):
        found = [state(t) for t in times]
        return tuple(
            np.array(x)
            for x in zip(*((s.T_ac.t, s.fixture_velocity, s.T_ac.q) for s in found), strict=True)
        )

    return state, motion


def near_start(truth, rng):
    """A first belief that is off as its covariance says, with inertia ratios that a body can
    have.
    """
    one = (
        [0.01] * 3
        + [0.01] * 3
        + [0.02] * 3
        + [0.005] * 3
        + [0.1] * 2
        + [0.1] * 3
        + [np.radians(1.0)] * 3
    )
    start = boxplus(truth, np.array(one) * rng.standard_normal(20))
    while np.abs(start.sigma).max() >= 1.0:
        start = boxplus(truth, np.array(one) * rng.standard_normal(20))
    return Belief(0, start, np.diag(np.square(one)))


def measured(x, rng):
    """A pose of {C} with white noise."""
    turn = geometry.exp(np.radians(NOISE_DEG) * rng.standard_normal(3))
    pose = Pose(geometry.multiply(x.T_ac.q, turn), x.T_ac.t + NOISE_M * rng.standard_normal(3))
    return Alignment(pose, 1, True, 1000, 1000, 0.005, np.eye(6), AlignStatus.ALIGNED)


def windows(rng, one):
    if one:
        return [(one[0], one[0] + one[1])]
    begins = rng.uniform(2.0, 75.0, rng.integers(1, 4))
    return [(b, b + rng.uniform(5.0, 30.0)) for b in begins]


BALL = 0.6  # radius of the body over the length of the arm
LIMITS = Limits(final_deg=15.0, clearance_m=0.15)


def geometry_of(x):
    """Axis along the arm, and the ball about the true centre of mass, in {C}."""
    centre = -geometry.matrix(x.q_bc).T @ x.c_b
    arm = float(np.linalg.norm(centre))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=BALL * arm)
    surface = Surface(centre + ball.vertices, np.asarray(ball.faces, np.int32), "ball", "")
    return target_geometry(surface, -centre / arm)


def campaign(seed, one=None, limits=LIMITS, noise=0.02, robot=None):
    """One campaign: (outcome, miss, rules seen, could it have captured where it first held, touched
    the body).

    With ``robot`` (RobotParams) its bounds, start, delay, size and error of the thrust are those of
    the approach.
    """
    rng = np.random.default_rng(seed)
    state, motion = bodies(rng)
    blind = windows(rng, one)
    params = EstimatorParams(
        noise=EstimatorParams().noise.__class__("r0"), r0_pos_m=NOISE_M, r0_rot_deg=NOISE_DEG
    )
    estimator = Estimator(params, near_start(state(0.0), rng), EXTENT_M)
    convergence, watch = (
        Convergence(ConvergenceParams(), EXTENT_M, (0.0025 * EXTENT_M, 0.00125 * EXTENT_M, 0.035)),
        ConvergenceTrack(),
    )
    target, touched = geometry_of(state(0.0)), False
    flown, gripper, radius = PlanParams(latency_s=0.2), None, 0.0
    if robot is not None:
        flown, limits, noise = robot.applied(flown), robot.limited(limits), robot.thrust_noise
        gripper, radius = robot.gripper, robot.radius_m
    errors = Disturbance(noise * flown.a_max_mps2, np.random.default_rng([seed, 1]))
    guidance = Guidance(
        flown, Supervisor(SupervisorParams().resolved(EXTENT_M)), limits, EXTENT_M, gripper
    )
    track, memory = estimator.initial(0, state(0.0).T_ac), guidance.initial(0)
    rules, committed, held_good = [], None, None
    for t in np.arange(1, int(SPAN_S * RATE_HZ)) / RATE_HZ:
        t_ns, x = round(t * 1e9), state(t)
        gamma = int(not any(a <= t < b for a, b in blind))
        prior = estimator.predict(track, t_ns)
        seen = estimator.innovate(prior, measured(x, rng)) if gamma else None
        track = estimator.update(track, prior, seen, gamma)
        belief = track.belief
        forecast = estimator.forecast(belief, np.array([30.0]))
        watch = convergence.judge(watch, belief, forecast, True)
        known = planner_input(
            estimator, belief, target, gamma, watch.converged, partial(estimator.forecast, belief)
        )
        wrong = with_thrust_error(memory.segment, t_ns, 1.0 / RATE_HZ, errors)
        memory = replace(memory, segment=wrong)
        before, memory = memory, guidance.step(memory, known)
        for at_s in np.linspace(t, t + 1.0 / RATE_HZ, 5):
            r = memory.segment.at(round(at_s * 1e9))[0]
            touched |= bool(
                np.linalg.norm(r - state(at_s).r_a) < BALL * np.linalg.norm(x.c_b) + radius
            )
        rule = memory.decision.rule
        if not rules or rules[-1] != rule:
            rules.append(rule)
        if rule == "prediction_poor" and held_good is None and before.segment.path is not None:
            lead_s = (before.segment.end_ns - t_ns) * 1e-9
            aimed = propagate(belief, before.segment.end_ns, 0.0, 0.0)[0].x.T_ac.q
            held_good = lead_s > 0 and miss(
                before.segment.path, before.segment.t_ns * 1e-9, motion, aimed
            ).inside(TOLERANCE)
        if rule == "arrived_sure":
            committed = propagate(belief, memory.segment.end_ns, 0.0, 0.0)[0].x.T_ac.q
        if memory.captured_ns is not None:
            if memory.segment.turn is not None:  # the gripper has the attitude of its own turn
                turn = memory.segment.turn
                committed = turn.at(np.array([(memory.segment.end_ns - turn.t_ns) * 1e-9]))[0]
            found = closed_miss(memory, 0, motion, committed)
            return (
                ("captured" if found.inside(TOLERANCE) else "outside"),
                found,
                rules,
                held_good,
                touched,
            )
    return memory.decision.action.value, None, rules, held_good, touched


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--quick", action="store_true")
    args.add_argument("--count", type=int, default=200)
    args.add_argument("--seed", type=int, default=1)
    args.add_argument("--one-at", type=float)
    args.add_argument("--length", type=float, default=12.0)
    args.add_argument(
        "--noise",
        type=float,
        default=0.02,
        help="error of the thrust, as a fraction of the largest one",
    )
    args.add_argument("--free", action="store_true", help="without limits")
    args = args.parse_args()
    one = (args.one_at, args.length) if args.one_at is not None else None
    count, begun = 10 if args.quick else args.count, time.perf_counter()
    done = [
        campaign(args.seed * 10_000 + k, one, None if args.free else LIMITS, args.noise)
        for k in range(count)
    ]
    outcomes = collections.Counter(d[0] for d in done)
    rules = collections.Counter(rule for d in done for rule in set(d[2]))
    closed = [d[1] for d in done if d[1] is not None]
    print(
        f"{count} campaigns, {time.perf_counter() - begun:.0f} s: "
        + ", ".join(f"{k} {v}" for k, v in outcomes.items())
    )
    for name, values in (
        ("miss [mm]", [1e3 * m.distance_m for m in closed]),
        ("relative speed [mm/s]", [1e3 * m.speed_mps for m in closed]),
        ("angle [deg]", [m.angle_deg for m in closed]),
        ("captured at [s]", [m.at_s for m in closed]),
    ):
        if values:
            middle, most = np.quantile(values, (0.5, 0.95))
            print(f"  {name:22s} median {middle:8.3f}  95 % {most:8.3f}  worst {max(values):8.3f}")
    print(
        f"  flew on prediction: {rules['prediction_good']}; held for poor prediction:"
        f" {rules['prediction_poor']}"
    )
    held = [d for d in done if d[3] is not None]
    print(
        f"  of {len(held)} holds, the plan then in force would have captured in"
        f" {sum(bool(d[3]) for d in held)}"
    )
    print(f"  touched the body: {sum(d[4] for d in done)}")
    print(f"  rules: {dict(sorted(rules.items()))}")


if __name__ == "__main__":
    main()
