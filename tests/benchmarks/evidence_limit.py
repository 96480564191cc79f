"""The limit on the log likelihood ratio per patch, by which a pose is accepted, on bodies and seeds
that it was not chosen on.

    python tests/benchmarks/evidence_limit.py [--bodies probe:901,...] [--views 2] [--seed 9001]

Every scene of ``scenes.py`` that shows the target is registered from the true pose, and from poses
turned by 30 to 180 deg about random axes. The results within 2 deg and 0.02 of the extent of the
true pose are the right ones; those farther than 10 deg or 0.1 of the extent are wrong. The table
has the share of the right poses and the number of the wrong ones that each limit accepts. No other
pose is compared with them here, so that the numbers are those of one test and not of
``Registrar.acquire``.
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import numpy as np
import scenes

from avsreplay import geometry
from avsreplay.geometry import Pose
from avsreplay.register.evidence import EvidenceModel, Observed
from avsreplay.register.registrar import Registrar
from avsreplay.register.work import LEAST_RATIO

LIMITS = (0.4, 0.6, 0.8, 0.9, 1.0, 1.2)
TURNS = 6  # wrong starts of each scan
SCENES = (
    "clean, 3 deg",
    "closer, 1 deg",
    "outliers 60 %, 3 deg",
    "wall 50 %, 3 deg",
    "30 % visible, 3 deg",
    "second object, 3 deg",
    "noise 0.008, 3 deg",
)
BODIES = "probe:901,guitar:902,comsat:903,chair:904,lander:905,wing:906"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bodies", default=BODIES)
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--points", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=9001)
    args = parser.parse_args()
    means: dict[tuple[str, bool], list[float]] = defaultdict(list)
    for surface in scenes.meshes(args.bodies.split(",")).values():
        registrar = Registrar(surface)
        model = EvidenceModel(registrar.target)
        for name in SCENES:
            for k in range(args.views):
                case = scenes.SCENES[name](surface, args.points, args.seed + 100 * k)
                for right, mean in _poses(registrar, model, case, args.seed + k):
                    means[name, right].append(mean)
    print(f"{'scene':24} right wrong " + " ".join(f"{limit:>11}" for limit in LIMITS))
    for name in (*SCENES, "all"):
        found = {
            right: np.array(
                [x for (n, r), xs in means.items() if r is right and name in (n, "all") for x in xs]
            )
            for right in (True, False)
        }
        cells = (
            f"{np.mean(found[True] >= limit):5.3f} / {np.count_nonzero(found[False] >= limit):3d}"
            for limit in LIMITS
        )
        print(f"{name:24} {len(found[True]):5d} {len(found[False]):5d} " + " ".join(cells))


def _poses(registrar, model, case, seed):
    """Whether each of the registered poses of a scan is right, and its evidence."""
    rng = np.random.Generator(np.random.PCG64(seed))
    scan, extent = Observed(case.points), registrar.index.extent_m
    vertices = registrar.target.surface.vertices
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    starts = [case.truth]
    for degrees in np.linspace(30.0, 180.0, TURNS):
        axis = rng.normal(size=3)
        q = geometry.exp(np.radians(degrees) * axis / np.linalg.norm(axis))
        turn = Pose(q, middle - geometry.matrix(q) @ middle)
        starts.append(case.truth @ turn)
    for start in starts:
        found = registrar.backend.align_within(case.points, start.inverse(), 0.05 * extent)
        found = registrar.backend.align_within(case.points, found.T_ca, 0.01 * extent, near=True)
        at = model.at(scan, found.T_ca)
        step = case.truth.inverse() @ found.T_ca.inverse()
        angle = float(np.degrees(geometry.angle(step.q)))
        moved = float(np.linalg.norm(step.apply(middle) - middle)) / extent
        accepted = at is not None and not (at.away and at.share < LEAST_RATIO)
        if angle < 2.0 and moved < 0.02:
            yield True, at.mean if accepted else -np.inf
        elif angle > 10.0 or moved > 0.1:
            yield False, at.mean if accepted else -np.inf


if __name__ == "__main__":
    main()
