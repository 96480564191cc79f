"""Constrained plans against CasADi with IPOPT, and their excess at 20,000 instants.

    python tests/benchmarks/plan_limits.py --kind cone --count 100 --ipopt 20
    python tests/benchmarks/plan_limits.py --kind body --count 50 --ipopt 10

The reference is a direct transcription with free end time and constant thrust in every interval. Each alternative
(inside the cone, or outside its range) is a smoothed maximum. It starts from five paths of different arrival time and
from the plan itself. Its constraints hold only at the nodes, so it may be slightly too early.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np
from plan_scenes import problems

from avsreplay.plan import Limits, PlanParams, constrained, path_of, rendezvous

EXTENT_M = 8.0
LIMITS = {
    "cone": Limits(cone_deg=35.0),
    "corridor": Limits(cone_deg=35.0, final_deg=10.0),
    "body": Limits(final_deg=15.0, clearance_m=0.25),
}


def excess(problem, limits, plan, instants=20_000):
    """Largest violation along a plan [m], written independently of the package's own check."""
    path = path_of(plan, problem.r0, np.zeros(3))
    t = np.linspace(0.0, plan.t_go_s, instants)[:-1]
    q = problem.scene.attitude(t)
    d = path.at(t)[0] - problem.scene.goal(t)[0]
    x, w = -q[:, :3], q[:, 3:]
    y = d + 2.0 * np.cross(x, np.cross(x, d) + w * d)  # conjugate rotation
    reach, across = np.linalg.norm(y, axis=1), np.hypot(y[:, 1], y[:, 2])
    worst = 0.0
    inside_last = np.full(len(t), -np.inf)
    for degrees, length in ((limits.cone_deg, limits.cone_range_m), (limits.final_deg, limits.final_range_m)):
        if degrees is not None:
            inside = math.tan(math.radians(degrees)) * y[:, 0] + limits.mouth_m - across
            inside_last = np.minimum(inside, length - reach)
            worst = max(worst, float(-np.maximum(inside, reach - length).min()))
    if limits.clearance_m is not None:
        p = np.abs(y - problem.centre_c) - problem.half
        gap = np.linalg.norm(np.maximum(p, 0.0), axis=1) + np.minimum(p.max(axis=1), 0.0)
        worst = max(worst, float(-np.maximum(inside_last, gap - limits.clearance_m).min()))
    return worst


def ipopt(problem, limits, free, plan=None, n=60):
    """Earliest end time that IPOPT finds from several starts [s]; NaN if it finds none."""
    import casadi as ca

    scene, a_max = problem.scene, problem.a_max
    grid = np.arange(0.0, 120.2, 0.2)
    q = scene.attitude(grid)
    from scipy.spatial.transform import Rotation

    R = Rotation.from_quat(q).as_matrix().reshape(-1, 9)
    table = np.concatenate([scene.goal(grid)[0], R], axis=1)
    motion = ca.interpolant("motion", "bspline", [grid], table.ravel())
    tau = ca.MX.sym("tau")
    rate = ca.Function("rate", [tau], [ca.jacobian(motion(tau), tau)])

    opti = ca.Opti()
    r, v, u, T = opti.variable(3, n + 1), opti.variable(3, n + 1), opti.variable(3, n), opti.variable()
    opti.minimize(T)
    h = T / n
    opti.subject_to(r[:, 0] == problem.r0)
    opti.subject_to(v[:, 0] == 0)
    for k in range(n):
        opti.subject_to(r[:, k + 1] == r[:, k] + h * v[:, k] + 0.5 * h * h * u[:, k])
        opti.subject_to(v[:, k + 1] == v[:, k] + h * u[:, k])
        opti.subject_to(ca.sumsqr(u[:, k]) <= a_max**2)
    opti.subject_to(r[:, n] == motion(T)[:3])
    opti.subject_to(v[:, n] == rate(T)[:3])
    opti.subject_to(opti.bounded(0.5 * free, T, 119.0))

    def either(first, second):
        """The larger of both is at least 0, smoothed by 5 mm to the safe side."""
        opti.subject_to(first + second + ca.sqrt((first - second) ** 2 + 1e-4) - 1e-2 >= 0)

    def norm(x):
        return ca.sqrt(ca.sumsqr(x) + 1e-10)

    for k in range(1, n):
        m = motion(k * h)
        y = ca.mtimes(ca.reshape(m[3:], 3, 3), r[:, k] - m[:3])  # column-major reshape is the transpose
        reach, across = norm(y), norm(y[1:])
        corridor = None
        for degrees, length in ((limits.cone_deg, limits.cone_range_m), (limits.final_deg, limits.final_range_m)):
            if degrees is not None:
                inside = math.tan(math.radians(degrees)) * y[0] + limits.mouth_m - across
                either(inside, reach - length)
                corridor = ca.fmin(inside, length - reach)
        if limits.clearance_m is not None:
            p = ca.fabs(y - problem.centre_c) - problem.half
            gap = norm(ca.fmax(p, 0)) + ca.fmin(ca.mmax(p), 0)
            either(corridor, gap - limits.clearance_m)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "max_iter": 200, "tol": 1e-5})
    guesses = [] if plan is None else [(plan.t_go_s, path_of(plan, problem.r0, np.zeros(3)))]
    guesses += [(min(factor * free, 118.0), None) for factor in (1.0, 1.15, 1.4, 1.8, 2.3)]
    best = math.nan
    for t_end, path in guesses:
        times = np.linspace(0.0, t_end, n + 1)
        rho, turn = scene.goal(times)[0], Rotation.from_quat(scene.attitude(times)).as_matrix()
        length, last = 2.1, 0.35 * t_end
        left = np.clip((t_end - times) / last, 0.0, 1.0)[:, None]
        s = np.clip(times / (t_end - last), 0.0, 1.0)[:, None]
        entry = rho + length * left**2 * turn[:, :, 0]
        guess = entry * s**2 * (3 - 2 * s) if path is None else path.at(times)[0]
        opti.set_initial(r, guess.T)
        opti.set_initial(v, np.gradient(guess, times, axis=0).T)
        opti.set_initial(u, 0.0)
        opti.set_initial(T, t_end)
        try:
            found = float(opti.solve().value(T))
        except RuntimeError:
            continue
        best = found if math.isnan(best) else min(best, found)
    return best


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", choices=LIMITS, default="cone")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--ipopt", type=int, default=0, help="compare the first problems with IPOPT")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--nodes", type=int, default=40)
    args = parser.parse_args()
    from dataclasses import replace

    limits = replace(LIMITS[args.kind], nodes=args.nodes)
    ms, warm_ms, later, worst, found, late = [], [], [], 0.0, 0, []
    for k, problem in enumerate(problems(args.count, args.seed)):
        params = PlanParams(a_max_mps2=problem.a_max)
        rest = np.zeros(3)
        free = rendezvous(problem.scene.goal, problem.r0, rest, params)
        begin = time.process_time()
        plan = constrained(problem.scene, problem.r0, rest, params, limits, extent_m=EXTENT_M)
        ms.append(1e3 * (time.process_time() - begin))
        found += plan.found
        if plan.found:
            worst = max(worst, excess(problem, limits.resolved(EXTENT_M), plan))
            later.append(plan.t_go_s - free.t_go_s)
            path = path_of(plan, problem.r0, rest)
            r, v = path.at(np.array([1.0]))
            begin = time.process_time()
            constrained(problem.scene.after(1.0), r[0], v[0], params, limits, extent_m=EXTENT_M, warm=(path, 1.0))
            warm_ms.append(1e3 * (time.process_time() - begin))
        if k < args.ipopt:
            best = ipopt(problem, limits.resolved(EXTENT_M), free.t_go_s, plan if plan.found else None)
            late.append((plan.t_go_s if plan.found else math.inf) - best)
            print(f"{k:3d} {plan.status.value:9s} plan {plan.t_go_s:8.3f} s, IPOPT {best:8.3f} s", flush=True)
    print(f"{args.kind}, {args.count} problems, seed {args.seed}: {found} found, worst excess {worst:.1e} m")
    print(f"cold {np.median(ms):.0f} ms median, {max(ms):.0f} ms worst")
    print(f"warm {np.median(warm_ms):.0f} ms median, {max(warm_ms):.0f} ms worst")
    print(f"later than the free plan: {np.median(later):.2f} s median, {max(later):.2f} s worst")
    if np.isfinite(late).any():
        late = np.array(late)
        known = np.isfinite(late)
        near, none = np.sum(known & (late <= 0.1)), np.isnan(late).sum()
        print(f"against IPOPT: {near} of {len(late)} at most 0.1 s later, IPOPT found none in {none}")
        print(f"later by {np.median(late[known]):+.3f} s in the median, {late[known].max():+.3f} s at worst")


if __name__ == "__main__":
    main()
