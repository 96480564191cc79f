"""Random sequences of vision, doubt and faults through supervisor and guidance.

    python tests/benchmarks/plan_sequences.py --count 1000

Checked in every sequence: it ends in a capture or an abort, or the approach never began; the
attempts are limited; a capture or an abort is final; a withdrawal comes no closer to the centre of
mass than braking needs. Exit code 1 if a property does not hold.
"""

from __future__ import annotations

import argparse
import collections
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from test_plan_guidance import CENTRE, DRIFT, PARAMS, ROBOT, WITHDRAWN, flights

from avsreplay.plan.supervisor import Action


def broken(seed):
    """The end of one sequence and the properties that it breaks."""
    out, begin, final, last = set(), None, None, None
    for known, state in flights(seed):
        action, t = state.decision.action, known.t_ns * 1e-9
        if final is not None and action is not final:
            out.add("a capture or an abort is not final")
        final = action if action in (Action.CAPTURE, Action.ABORT) else final
        position, velocity = state.segment.at(known.t_ns)
        away = float(np.linalg.norm(position - CENTRE - t * DRIFT))
        if action in WITHDRAWN:
            speed = float(np.linalg.norm(velocity - DRIFT))
            begin = away - speed**2 / (2 * ROBOT.a_max_mps2) if begin is None else begin
            if away < begin - 1e-3:
                out.add("a withdrawal comes closer than braking needs")
        else:
            begin = None
        last = state
    if final is None and last.supervisor.began_s is not None:
        out.add("the sequence does not end")
    if last.supervisor.attempts > PARAMS.attempts_max:
        out.add("too many attempts")
    return (final.value if final else "never began"), out


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1000)
    args = parser.parse_args()
    ends, faults = collections.Counter(), collections.Counter()
    for seed in range(args.seed, args.seed + args.count):
        end, out = broken(seed)
        ends[end] += 1
        faults.update(out)
    print(f"{args.count} sequences: {', '.join(f'{end} {n}' for end, n in sorted(ends.items()))}")
    print(f"properties broken: {dict(faults) or 'none'}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
