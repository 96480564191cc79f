"""Constrained plans: excess at 20,000 instants, processor time, and the time later than IPOPT with
200 nodes.

    python tests/benchmarks/plan_limits.py --kind cone --count 100 --ipopt 100
    python tests/benchmarks/plan_limits.py --kind body --count 50 --ipopt 50

The reference has no aborts, so that ``--kind aborts`` shows what they cost. ``--first`` skips
problems, so that a campaign can be made in parts. ``plan_reference`` describes the reference.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace
from functools import partial

import numpy as np
from plan_scenes import problems

from avsreplay.plan.constrained import constrained
from avsreplay.plan.path import path_of
from avsreplay.plan.rendezvous import PlanParams, rendezvous
from avsreplay.plan.robot import Limits

EXTENT_M = 8.0
LIMITS = {
    "cone": Limits(cone_deg=35.0),
    "corridor": Limits(cone_deg=35.0, final_deg=10.0),
    "body": Limits(final_deg=15.0, clearance_m=0.25, abort=False),
    "aborts": Limits(final_deg=15.0, clearance_m=0.25),
}


def violations(problem, limits, t, r):
    """Excess (n,) at instants of a path, positions (n, 3) [m], written independently of the
    package's own check.
    """
    q = problem.scene.attitude(t)
    d = r - problem.scene.goal(t)[0]
    x, w = -q[:, :3], q[:, 3:]
    y = d + 2.0 * np.cross(x, np.cross(x, d) + w * d)  # conjugate rotation
    reach, across = np.linalg.norm(y, axis=1), np.hypot(y[:, 1], y[:, 2])
    least, inside_last = np.full(len(t), np.inf), np.full(len(t), -np.inf)
    for degrees, length in (
        (limits.cone_deg, limits.cone_range_m),
        (limits.final_deg, limits.final_range_m),
    ):
        if degrees is not None:
            inside = math.tan(math.radians(degrees)) * y[:, 0] + limits.mouth_m - across
            inside_last = np.minimum(inside, length - reach)
            least = np.minimum(least, np.maximum(inside, reach - length))
    if limits.clearance_m is not None:
        p = np.abs(y - problem.centre_c) - problem.half
        gap = np.linalg.norm(np.maximum(p, 0.0), axis=1) + np.minimum(p.max(axis=1), 0.0)
        least = np.minimum(least, np.maximum(inside_last, gap - limits.clearance_m))
    return np.maximum(-least, 0.0)


def excess(problem, limits, t_go_s, position, instants=20_000):
    """Largest excess along a path before its end [m]."""
    t = np.linspace(0.0, t_go_s, instants)[:-1]
    return float(violations(problem, limits, t, position(t)).max())


def timed(make):
    """The result of a call and its processor time [ms]."""
    begin = time.process_time()
    made = make()
    return made, 1e3 * (time.process_time() - begin)


def measured(problem, limits, compare):
    """Figures of one problem: plan, excess, times, and the reference where ``compare``."""
    params, rest, scene = PlanParams(a_max_mps2=problem.a_max), np.zeros(3), problem.scene
    free = rendezvous(scene.goal, problem.r0, rest, params)
    plan, cold_ms = timed(
        lambda: constrained(scene, problem.r0, rest, params, limits, extent_m=EXTENT_M)
    )
    resolved, path = limits.resolved(EXTENT_M), None
    out = {"plan": plan, "cold": cold_ms, "later": plan.t_go_s - free.t_go_s}
    if plan.found:
        path = path_of(plan, problem.r0, rest)
        out["excess"] = excess(problem, resolved, plan.t_go_s, lambda t: path.at(t)[0])
        (r, v), ahead = path.at(np.array([1.0])), scene.after(1.0)
        again = timed(
            lambda: constrained(
                ahead, r[0], v[0], params, limits, extent_m=EXTENT_M, warm=(path, 1.0)
            )
        )
        out["warm"], out["warm_later"] = again[1], again[0].t_go_s + 1.0 - plan.t_go_s
    if compare:
        from plan_reference import flown, ipopt

        given = None if path is None else (plan.t_go_s, lambda t: path.at(t)[0], path.thrust)
        over = partial(violations, problem, resolved)
        best, out["ipopt_ms"] = timed(lambda: ipopt(problem, resolved, free.t_go_s, over, given))
        out["best"] = math.nan if best is None else best.t_s
        if best is not None:
            out["best_excess"] = excess(problem, resolved, best.t_s, lambda t: flown(best, t))
    return out


def line(k, of):
    """One line of the table."""
    plan, best = of["plan"], of.get("best")
    text = f"{k:3d} {plan.status.value:9s} {plan.t_go_s:8.3f} s, "
    text += f"{of['cold']:5.0f} ms cold, {of.get('warm', math.nan):4.0f} warm"
    if best is not None:
        text += f"; IPOPT {best:8.3f} s, its excess {1e3 * of.get('best_excess', math.nan):5.1f} mm"
        text += f", {1e-3 * of['ipopt_ms']:.0f} s; later {plan.t_go_s - best:+7.3f} s"
    return text


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kind", choices=LIMITS, default="cone")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="number of the first problem")
    parser.add_argument(
        "--ipopt", type=int, default=0, help="compare the first problems with IPOPT"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--nodes", type=int, default=Limits().nodes)
    args = parser.parse_args()
    limits, done = replace(LIMITS[args.kind], nodes=args.nodes), []
    for k, problem in enumerate(problems(args.first + args.count, args.seed)):
        if k >= args.first:
            done.append(measured(problem, limits, k < args.ipopt))
            print(line(k, done[-1]), flush=True)
    found = [of for of in done if of["plan"].found]
    print(f"{args.kind}, {len(done)} problems, seed {args.seed}: {len(found)} found")
    for name, key, unit, scale in (
        ("excess", "excess", "mm", 1e3),
        ("cold", "cold", "ms", 1.0),
        ("warm", "warm", "ms", 1.0),
        ("later than the free plan", "later", "s", 1.0),
        ("warm plan later than the cold one", "warm_later", "s", 1.0),
    ):
        values = scale * np.array([of[key] for of in (done if key == "cold" else found)])
        print(f"{name}: {np.median(values):.4g} {unit} median, {values.max():.4g} {unit} worst")
    compared = [of for of in done if "best" in of]
    known = [of for of in compared if not math.isnan(of["best"])]
    if known:
        late = np.array(
            [of["plan"].t_go_s - of["best"] if of["plan"].found else math.inf for of in known]
        )
        most = 1e3 * max(of["best_excess"] for of in known)
        print(
            f"IPOPT found {len(known)} of {len(compared)}; its own excess is {most:.1f} mm at worst"
        )
        print(
            f"the plan is at most 0.1 s later than IPOPT in {np.sum(late <= 0.1)} of {len(known)}"
        )
        print(f"later by {np.median(late):+.3f} s in the median, {late.max():+.3f} s at worst")


if __name__ == "__main__":
    main()
