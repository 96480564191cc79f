"""The certified planner against an exhaustive search, an independent integration, and direct
transcription.

python tests/benchmarks/plan_solver.py [--quick] [--casadi N]      (N problems also through CasADi +
IPOPT) Times are of the process, so that other work on the machine does not count.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from plan_problems import problems
from scipy.integrate import solve_ivp

from avsreplay.outcome import PlanStatus
from avsreplay.plan.path import CostatePath
from avsreplay.plan.reachable_set import gauge
from avsreplay.plan.rendezvous import PlanParams, rendezvous

ORIGIN = np.zeros(3)
HEAD = (
    "set       problems  optimal  median_ms  worst_ms  later_s   missed  false_infeasible "
    " split_sets  r_err_m   v_err_mps  gap_s"
)


def timed(goal, params, repeats):
    """The plan and the median of its solve times [s]."""
    spans = []
    for _ in range(repeats):
        begin = time.process_time()
        plan = rendezvous(goal, ORIGIN, ORIGIN, params)
        spans.append(time.process_time() - begin)
    return plan, float(np.median(spans))


def scan(goal, a_max, step, end):
    """Feasible or not at every multiple of ``step``: the gauge at each, its residual checked."""
    times = np.arange(step, end, step)
    rho, rate = goal(times)
    out = np.empty(len(times), dtype=bool)
    for i, t in enumerate(times):
        found = gauge(rho[i], t * rate[i] - rho[i])
        if found.residual > 1e-10:
            raise SystemExit(f"gauge not solved at {t}: {found.residual}")
        out[i] = found.value <= a_max * t * t
    return times, out


def flown(plan, goal):
    """Terminal errors by DOP853 through the plan's thrust alone."""
    flight = CostatePath.of(plan, ORIGIN, ORIGIN)

    def fly(t, y):
        return np.r_[y[3:], flight.thrust(np.array([min(t, plan.t_go_s)]))[0]]

    dv = flight.p(np.array([0.0, plan.t_go_s]))
    turn = (
        float(
            np.clip(dv[0] @ (dv[0] - dv[1]) / max(np.sum((dv[0] - dv[1]) ** 2), 1e-300), 0.0, 1.0)
        )
        * plan.t_go_s
    )
    y, at = np.zeros(6), 0.0
    for stop in (turn, plan.t_go_s):
        if stop > at:
            y = solve_ivp(fly, [at, stop], y, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
            at = stop
    rho, rate = goal(np.array([plan.t_go_s]))
    return float(np.linalg.norm(y[:3] - rho[0])), float(np.linalg.norm(y[3:] - rate[0]))


def transcribe(goal, a_max, nodes, horizon):
    """CasADi + IPOPT: steps of thrust, free end time. Returns t_f (NaN: failed) and seconds."""
    import casadi as ca

    grid = np.linspace(0.0, horizon, int(horizon / 0.1) + 1)
    rho, rate = goal(grid)
    where = ca.interpolant("rho", "bspline", [grid], rho.ravel())
    how = ca.interpolant("rate", "bspline", [grid], rate.ravel())
    opti = ca.Opti()
    t, X, U = opti.variable(), opti.variable(6, nodes + 1), opti.variable(3, nodes)
    h = t / nodes
    opti.minimize(t)
    opti.subject_to(opti.bounded(0.1, t, horizon))
    opti.subject_to(X[:, 0] == 0)
    for k in range(nodes):
        opti.subject_to(X[:3, k + 1] == X[:3, k] + h * X[3:, k] + 0.5 * h**2 * U[:, k])
        opti.subject_to(X[3:, k + 1] == X[3:, k] + h * U[:, k])
        opti.subject_to(ca.sumsqr(U[:, k]) <= a_max**2)
    opti.subject_to(X[:3, -1] == where(t))
    opti.subject_to(X[3:, -1] == how(t))
    guess = 2.0 * float(np.sqrt(np.linalg.norm(rho[0]) / a_max))
    end, speed = goal(np.array([guess]))
    s = np.linspace(0.0, 1.0, nodes + 1)
    b = 6 * (end[0] - 0.5 * guess * speed[0]) / guess**2 * 2
    opti.set_initial(t, guess)
    opti.set_initial(X[:3, :], np.outer(end[0], s))
    opti.set_initial(U, np.outer(b, 0.5 - (s[1:] + s[:-1]) / 2))
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "max_iter": 500})
    begin = time.process_time()
    try:
        return float(opti.solve().value(t)), time.process_time() - begin
    except RuntimeError:
        return float("nan"), time.process_time() - begin


def measured(name, cases):
    """One row of the table; returns what the comparison needs."""
    spans, later, errors, gaps, compare = [], [], [], [], []
    optimal = missed = false_infeasible = split = 0
    for goal, a_max in cases:
        plan, span = timed(goal, PlanParams(a_max_mps2=a_max), 5)
        times, ok = scan(goal, a_max, 0.02, 60.0)
        split += int(np.sum(np.diff(ok.astype(int)) == 1) + int(ok[0]) > 1)
        spans.append(span)
        optimal += plan.status is PlanStatus.OPTIMAL
        false_infeasible += ok.any() and plan.status is PlanStatus.INFEASIBLE
        missed += ok.any() and not plan.found
        if plan.found:
            later.append(plan.t_go_s - times[np.argmax(ok)])
            errors.append(flown(plan, goal))
            gaps.append(plan.t_go_s - plan.lower_bound_s)
            compare.append((goal, a_max, plan.t_go_s, span))
    r, v = np.max(errors, axis=0)
    print(
        f"{name:9s} {len(spans):8d} {optimal:8d} {1e3 * np.median(spans):10.2f}"
        f" {1e3 * np.max(spans):9.2f} {np.max(later):8.1e} {missed:8d} {false_infeasible:17d}"
        f" {split:11d} {r:9.1e} {v:10.1e} {np.max(gaps):7.1e}"
    )
    return compare


def versus(compare):
    """The same problems through CasADi + IPOPT, 50 intervals."""
    ours, theirs, late, failed, beaten = [], [], [], 0, 0
    for goal, a_max, t_go, span in compare:
        t, seconds = transcribe(goal, a_max, 50, 120.0)
        ours.append(span)
        theirs.append(seconds)
        failed += int(not np.isfinite(t))
        if np.isfinite(t):
            late.append(t - t_go)
            beaten += int(t < t_go - 1e-4)
    factor, late = np.array(theirs) / np.array(ours), np.array(late)
    print(f"\nCasADi + IPOPT, 50 nodes, {len(compare)} problems, failed {failed}")
    print(
        f"  median {1e3 * np.median(theirs):.1f} ms; ours {np.median(factor):.0f}x faster (least"
        f" {factor.min():.0f}x)"
    )
    print(
        f"  IPOPT earlier in {beaten}; later by {np.median(late):.4f} s (median), {late.max():.2f}"
        " s (worst),"
    )
    print(f"  by more than 0.1 s in {np.sum(late > 0.1)}")


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--quick", action="store_true")
    args.add_argument("--casadi", type=int, default=0)
    args = args.parse_args()
    print(HEAD)
    measured("ordinary", problems(6 if args.quick else 18, hard=False))
    compare = measured("hard", problems(20 if args.quick else 180, hard=True))
    if args.casadi:
        versus(compare[: args.casadi])


if __name__ == "__main__":
    main()
